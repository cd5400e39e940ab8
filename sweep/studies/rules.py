"""Checks of the sections of a study that depend on its axes or its experiment, and what these sections mean."""

import csv
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from linksweep.sweep.contract import Experiment, Parameter, SweepError, Value, shown, suggest
from linksweep.sweep.studies.form import PublishedForm, Sampling
from linksweep.sweep.studies.problems import Problems
from linksweep.sweep.studies.source import read_text
from linksweep.sweep.studies.study import Condition, Published
from linksweep.sweep.studies.values import Values, is_number, number_problem


def check_sampling(sampling: Sampling, experiment: Experiment, problems: Problems) -> None:
    """Report settings of the sampling that contradict each other or the experiment, by their place in its table."""
    if experiment.deterministic:
        if given := sorted(sampling.model_fields_set):
            problems.add(
                (),
                f"{experiment.name} takes no rng and is evaluated once at each point: there is nothing to sample, "
                f"leave out {', '.join(given)}",
            )
        return
    if not experiment.outer_draw and sampling.n_cat > 1:
        problems.add(("n_cat",), f"{experiment.name} has no outer draw that realisations share; leave it out")
    if sampling.keep_samples and experiment.samples is None:
        problems.add(("keep_samples",), f"the experiment {experiment.name!r} has no samples to keep")
    if sampling.common_random_numbers and not experiment.shared:
        message = f"the experiment {experiment.name!r} declares no parameter that leaves its random numbers unchanged"
        problems.add(("common_random_numbers",), message)
    if sampling.precision is None:
        if sampling.max_n_sim is not None:
            problems.add(("max_n_sim",), "has an effect only with a precision, which is not set")
        return
    if sampling.max_n_sim is not None and sampling.max_n_sim < sampling.n_sim:
        message = f"{sampling.max_n_sim}: must be at least n_sim = {sampling.n_sim}, with which every point begins"
        problems.add(("max_n_sim",), message)
    if sampling.keep_samples:
        problems.add(("precision",), "cannot go with keep_samples: points would keep different numbers")
    if not experiment.errors_of_headline():
        message = f"no headline result X of the experiment {experiment.name!r} has an error X_mc_error to judge by"
        problems.add(("precision",), message)


def zipped_axes(
    groups: Sequence[Sequence[str]], axes: Mapping[str, tuple[Value, ...] | None], problems: Problems
) -> tuple[tuple[str, ...], ...]:
    """Return the groups of zipped axes, and report those that cannot be zipped."""
    seen: set[str] = set()
    known = [name for name, values in axes.items() if values is not None]  # others may hold control characters
    for i, group in enumerate(groups):
        where = ("grid", "zip", i)
        if len(group) < 2:
            problems.add(where, f"{shown(group)}: name at least two axes that advance together")
        for name in group:
            if name not in axes:
                problems.add(where, f"{shown(name)} is not an axis{suggest(name, known) if known else ''}")
            if name in seen:
                problems.add(where, f"{shown(name)} is zipped twice")
            seen.add(name)
        lengths = {name: len(values) for name in group if (values := axes.get(name)) is not None}
        if len(set(lengths.values())) > 1:
            sizes = ", ".join(f"{name} has {n}" for name, n in lengths.items())
            problems.add(where, f"zipped axes must have the same number of values: {sizes}")
    return tuple(tuple(group) for group in groups)


def exclusion(
    index: int, clause: Mapping[str, object], given: Collection[str], values: Values
) -> tuple[Condition, ...]:
    """Return the conditions of one exclusion; ``given`` are the parameters that the study sets."""
    if not clause:
        values.problems.add(("exclude", index), "is empty and would leave out every point")
    return tuple(_condition(index, name, rule, given, values) for name, rule in clause.items())


def _condition(index: int, name: str, rule: object, given: Collection[str], values: Values) -> Condition:
    where, problems = ("exclude", index, name), values.problems
    with problems.at(where):
        parameter = values.experiment.parameter(name)
        if not isinstance(rule, dict):
            return Condition(name, among=(values.one(where, name, rule),))
        unknown = [key for key in rule if key not in ("above", "below", "equal", "in")]
        if unknown or not rule:
            wrong = f"unknown condition {shown(unknown)}" if unknown else "has no condition"
            raise ValueError(f"{wrong}; allowed are above, below, equal, in")
        listed = [rule["equal"]] if "equal" in rule else rule.get("in")
        if listed is not None:
            if not isinstance(listed, list) or len(rule) > 1:
                raise ValueError("'in' takes a list, and 'in' or 'equal' stands alone")
            return Condition(name, among=tuple(values.one(where, name, raw) for raw in listed))
        if parameter.kind not in ("float", "int"):
            problems.add(where, f"{name} has no order: use equal or in")
        elif parameter.default is None and name not in given:
            problems.add(where, f"{name} has no value to compare: it is neither an axis nor fixed, and has no default")
        bounds: dict[str, float] = {}
        for key, raw in rule.items():
            if problem := number_problem(raw):
                problems.add((*where, key), problem)
            else:
                bounds[key] = float(raw)
        return Condition(name, above=bounds.get("above"), below=bounds.get("below"))
    return Condition(name)


def read_published(
    form: PublishedForm, folder: Path, experiment: Experiment, axes: Collection[str], problems: Problems
) -> Published | None:
    """Return the published numbers that a study names, from a CSV file in its ``folder``; ``problems`` takes what is
    wrong.
    """
    if (form.tolerance is None) != (form.tolerance_reason is None):
        problems.add(("published", "tolerance"), "a tolerance needs a tolerance_reason, and the other way round")
    where = ("published", "file")
    file = shown(form.file)
    try:
        text = read_text(folder / form.file)
    except SweepError as error:
        problems.add(where, f"{file} {error}")
        return None
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line and not line.startswith("#")]
    reader = csv.DictReader((line for _, line in lines), restkey="")
    try:
        rows = [(lines[reader.line_num - 1][0], row) for row in reader]
    except csv.Error as error:
        problems.add(where, f"{file} is not a CSV table: {error}")
        return None
    if not rows:
        problems.add(where, f"{file} holds no rows")
        return None
    outputs = {o.name for o in experiment.outputs}
    parameters = {p.name: p for p in experiment.parameters}
    columns = list(reader.fieldnames or ())
    unknown = [column for column in columns if column not in outputs and column not in parameters]
    if unknown:
        problems.add(where, f"{file}: columns {shown(unknown)} are neither parameters nor outputs")
        return None
    for number, row in rows:
        if "" in row or None in row.values():
            problems.add(where, f"{file}, line {number}: does not have {len(columns)} cells as the header has")
            continue
        for column, cell in row.items():
            optional = column in outputs and column not in axes
            if wanted := _wrong_cell(parameters.get(column), cell, optional):
                problems.add(where, f"{file}, line {number}: {column} = {shown(cell)}: must be {wanted}")
    return Published(
        source=form.source,
        rows=tuple(row for _, row in rows),
        tolerance=form.tolerance or 0.0,
        tolerance_reason=form.tolerance_reason or "",
    )


def _wrong_cell(parameter: Parameter | None, cell: str, optional: bool) -> str | None:
    """Return what a cell of a published table ought to be, or None if it is; an optional one may be empty."""
    if optional and not cell:
        return None
    if parameter is None or parameter.kind in ("float", "int"):
        try:
            number = float(cell)
        except ValueError:
            return "a number" + (" or empty" if optional else "")
        return None if optional or is_number(number) else "a finite number"
    if parameter.kind == "bool":
        return None if cell in ("True", "False") else "True or False"
    known = (*parameter.choices, *(named.name for named in parameter.defined))
    return parameter.allowed() if parameter.choices and cell not in known else None
