"""From a study file, a function or a mapping to a Study: reads it, and reports every problem at once."""

import csv
import hashlib
import json
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from linksweep.sweep.code.load import Code, absolute_reference, keep
from linksweep.sweep.contract import (
    DefinitionError,
    Experiment,
    Function,
    Named,
    Parameter,
    SweepError,
    Value,
    shown,
    suggest,
)
from linksweep.sweep.functions.adapter import is_plain_function, name_of
from linksweep.sweep.studies.claims import ClaimContext, check_figure, checked_claim, checked_conclusion
from linksweep.sweep.studies.document import (
    Overrides,
    Place,
    Problems,
    find_study,
    override,
    parsed,
    read_text,
    reference_in,
)
from linksweep.sweep.studies.points import plain, plain_points, read_points
from linksweep.sweep.studies.study import (
    DEFAULT_EXPERIMENT,
    POINT,
    Condition,
    Form,
    PointTable,
    Published,
    PublishedForm,
    Sampling,
    Study,
)
from linksweep.sweep.studies.values import Values, is_number, number_problem
from linksweep.sweep.tables.file import TableFile, content_digest

ONCE = Sampling(n_sim=1)
"""The sampling of a deterministic experiment, which is evaluated once at each point."""

GOOD_NAME = re.compile(r"[A-Za-z_][\w.+-]{0,59}", re.ASCII)
"""Names that can be written on the command line wherever it takes a value of an axis."""

Mentioned = Callable[..., Any] | Experiment

Axes = Mapping[str, tuple[Value, ...] | None]
"""Values of axes, None for an axis that is itself wrong."""


def load_study(
    name_or_path: str,
    settings: Sequence[str] = (),
    axes: Sequence[str] = (),
    points: str | None = None,
    design: str | None = None,
    ranges: Sequence[str] = (),
) -> Study:
    """Read and check a study, without running it.

    Args:
        name_or_path: the name of a built-in study, the path of a file, or ``file.py:function`` and
            ``module:function``, which are studies by themselves.
        settings: ``KEY=VALUE``, overrides like those of ``sweep run --set``.
        axes: ``NAME=SPEC``, overrides like those of ``sweep run --axis``.
        points: the file of a table of points that replaces the study's, as in ``sweep run --points``.
        design: ``NAME:N`` or ``NAME:N:SEED``, replaces the study's points, as in ``sweep run --design``.
        ranges: ``NAME=LOW:HIGH``, ``NAME=LOW:HIGH:log`` or ``NAME=A,B,C`` of a design, as in ``sweep run --range``.

    Returns:
        The study; all its parameters have values that the experiment allows.

    Raises:
        SweepError: with all problems, each with its key and, if it has one, its line in the file.

    Example:
        >>> study = load_study("quasars", settings=["n_sim=50"], axes=["v_max=14:16:0.5"])
        >>> study.axes["v_max"], study.sampling.n_sim
        ((14.0, 14.5, 15.0, 15.5, 16.0), 50)
    """
    if (function := reference_in(name_or_path)) is not None:
        path, text = Path.cwd() / f"{function.rpartition(':')[2]}.toml", ""
        document: dict[str, Any] = {"title": path.stem, "experiment": function}
    else:
        path = find_study(name_or_path)
        text = read_text(path)
        document = parsed(text, path)
    overrides = override(document, settings, axes, points, design, ranges)
    return _Reader(document, text, path, function or str(path), overrides, Code()).study()


def study_from_dict(
    document: Mapping[str, Any], name: str = "study", where: str | None = None, code: Code | None = None
) -> Study:
    """Return the study that a mapping of the same shape as the TOML file describes; raises SweepError, which says
    ``where``, as `load_study`.
    """
    path = Path.cwd() / f"{name}.toml"
    return _Reader(dict(document), "", path, where or str(path), Overrides(), code or Code()).study()


def study_of_attributes(attributes: Mapping[str, Any], where: str, code: Code) -> Study:
    """Return the study whose results have these attributes; raises SweepError as `load_study`, for example where the
    file of its experiment is gone.

    All that it names is loaded by ``code`` or not at all.  Published numbers are left out if their file is gone.
    """
    try:
        document = json.loads(attributes["study_document"])
        text, overrides, name = (str(attributes[key]) for key in ("study", "study_overrides", "study_name"))
    except (KeyError, TypeError, ValueError) as error:
        raise SweepError("does not say which study it holds", where) from error
    if "published" in document and not Path(document["published"]["file"]).is_file():
        del document["published"]
    laid = Overrides()
    if overrides:
        laid = Overrides([overrides], {(table, k): "" for table in ("axes", "fixed") for k in document.get(table, {})})
    return replace(_Reader(document, text, Path(where), where, laid, code).study(), name=name)


def study_of_function(
    function: Mentioned | str,
    axes: Mapping[str, Any] | None = None,
    fixed: Mapping[str, Any] | None = None,
    sampling: Mapping[str, Any] | None = None,
    title: str | None = None,
    points: Any = None,
) -> Study:
    """Return the study of a function, named after it; raises SweepError as `load_study`."""
    tables = {"axes": axes or None, "fixed": fixed or None, "sampling": sampling or None}
    document = {"experiment": function, "title": title, "points": points, **tables}
    return live_study({key: value for key, value in document.items() if value is not None})


def live_study(document: Mapping[str, Any]) -> Study:
    """Return the study that a mapping of the shape of a study file describes.

    Its experiment may be a function or an `Experiment`, its axes may be arrays, ranges or pandas indexes, its points a
    table, and it needs no title.  Two such studies have the same name only where they are about the same function and
    say the same.
    """
    written: dict[str, Any] = {
        str(key): plain_points(value) if key == "points" else plain(value, str(key))
        for key, value in document.items()
        if key != "experiment"
    }
    function = document.get("experiment", DEFAULT_EXPERIMENT)
    if isinstance(function, str):
        written["experiment"], name = function, function.rpartition(":")[2]
    elif isinstance(function, Experiment) or is_plain_function(function):
        written["experiment"] = keep(function)
        name = function.name if isinstance(function, Experiment) else name_of(function)
    else:
        raise SweepError(f"{shown(function)} is neither a function nor an Experiment")
    written.setdefault("title", name)
    digest = hashlib.sha256(json.dumps(written, sort_keys=True, default=_digest).encode()).hexdigest()
    return study_from_dict(written, f"{name}-{digest[:8]}", name, Code(afresh=isinstance(function, str)))


def _digest(value: object) -> str:
    try:
        return content_digest(value)
    except TypeError:
        return repr(value)


class _Reader:
    """Reads one document into a Study, gathering every problem on the way."""

    def __init__(
        self, document: dict[str, Any], text: str, path: Path, where: str, overrides: Overrides, code: Code
    ) -> None:
        self.document, self.text, self.path, self.where = document, text, path, where
        self.folder, self.overrides, self.code = path.parent, overrides, code
        self.problems = Problems(where, text, overrides.problems, overrides.by_place)

    def study(self) -> Study:
        if (form := _read_form(self.document, self.problems)) is None:
            raise SweepError(self.problems.sentences, self.where)
        try:
            experiment = self.code.experiment(form.experiment, self.folder)
        except SweepError as error:
            for problem in error.problems:
                self.problems.add(("experiment",), f"{error.where}: {problem}" if error.where else problem)
            raise SweepError(self.problems.sentences, self.where) from error
        if experiment.deterministic:
            form = self._without_sampling_of_parameters(form, experiment)
        experiment, definitions = self._defined(experiment, form.define)
        values = Values(experiment, self.folder, self.problems)
        points, origin, columns = self._points(values, form)
        axes = points | {name: values.axis(name, spec) for name, spec in form.axes.items()}
        fixed = {}
        for name, raw in form.fixed.items():
            if name in form.axes:
                self.problems.add(("fixed", name), "is an axis too; leave out one of the two")
            fixed[name] = values.one(("fixed", name), name, raw)
        if points or "points" not in self.document:  # else the table is wrong: what it has is not known
            for name in (one.name for one in experiment.parameters if one.required):
                if name not in {**form.axes, **form.fixed, **points}:
                    sentence = f"{name} has no default: the study must set it, here or in [axes]"
                    self.problems.add(("fixed", name), sentence)
        crossed = {name: axes[name] for name in form.axes}
        zipped = _zipped_axes(form.grid.zip, crossed, self.problems)
        excluded = tuple(_exclusion(i, clause, {*axes, *form.fixed}, values) for i, clause in enumerate(form.exclude))
        published = None if form.published is None else _read_published(form.published, values, axes)
        _check_sampling(form.sampling, experiment, self.problems.inside("sampling"))
        changed = frozenset(str(place[1]) for place in self.problems.overridden if place[0] in ("axes", "fixed"))
        context = ClaimContext(experiment, crossed, form.grid.zip, changed)
        claims = tuple(checked_claim(c, context, self.problems.inside("claim", i)) for i, c in enumerate(form.claim))
        conclusion = form.conclusion
        if conclusion is not None:
            conclusion = checked_conclusion(conclusion, context, self.problems.inside("conclusion"))
        check_figure(form.figure, context, self.problems.inside("figure"))
        if self.problems.sentences:
            raise SweepError(self.problems.sentences, self.where)
        return Study(
            name=self.path.stem,
            title=form.title,
            question=form.question or "",
            experiment_reference=absolute_reference(form.experiment, self.folder),
            experiment=experiment,
            axes={name: one for name, one in axes.items() if one is not None},
            fixed=fixed,
            sampling=ONCE if experiment.deterministic else form.sampling,
            zipped=zipped,
            points=None if form.points is None else PointTable(tuple(points), origin),
            excluded=excluded,
            published=published,
            source=self.where,
            claims=claims,
            conclusion=conclusion,
            text=self.text,
            overrides=tuple(self.overrides.written),
            document=self._portable(form, fixed, columns, origin) | ({"define": definitions} if definitions else {}),
        )

    def _portable(
        self, form: Form, fixed: Mapping[str, Value], columns: Mapping[str, list[Any]], origin: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return the document with absolute paths of files, and with the values of a table of points in place of its
        file or design.
        """
        document = {**self.document, "experiment": absolute_reference(form.experiment, self.folder)}
        if "fixed" in document:
            paths = {name: value.path for name, value in fixed.items() if isinstance(value, TableFile)}
            document["fixed"] = document["fixed"] | paths
        if form.points is not None:
            document["points"] = {"columns": dict(columns), **({"origin": dict(origin)} if origin else {})}
        if form.published is not None:
            file = str((self.folder / form.published.file).resolve())
            document["published"] = document["published"] | {"file": file}
        return document

    def _without_sampling_of_parameters(self, form: Form, experiment: Experiment) -> Form:
        """Return the form of a deterministic experiment in which ``--set seed=3`` has set its own parameter seed."""
        sampling = form.sampling.model_dump(include=form.sampling.model_fields_set)
        names = {parameter.name for parameter in experiment.parameters}
        names = {key for key in sampling if key in names and ("sampling", key) in self.problems.overridden}
        if not names:
            return form
        rest = {key: value for key, value in self.document["sampling"].items() if key not in names}
        moved = {key: value for key, value in sampling.items() if key in names}
        axes = {key: value for key, value in form.axes.items() if key not in names}
        changed = {"sampling": rest, "fixed": form.fixed | moved, "axes": axes}
        self.document = {**self.document, **changed}
        if not rest:
            del self.document["sampling"]
        return form.model_copy(update={**changed, "sampling": Sampling(**rest)})

    def _points(
        self, values: Values, form: Form
    ) -> tuple[dict[str, tuple[Value, ...] | None], dict[str, Any], Mapping[str, list[Any]]]:
        """Return the values of a table of points by parameter, where it comes from, and its columns as written."""
        if form.points is None:
            return {}, {}, {}
        experiment = values.experiment
        parameters, outputs = ({one.name for one in ones} for ones in (experiment.parameters, experiment.outputs))
        if POINT in parameters | outputs | experiment.coordinates.keys():
            self.problems.add(("points",), f"{experiment.name} has a {POINT!r} of its own, the name of this dimension")
        columns, origin = read_points(form.points, values, form.fixed, self.code)
        points: dict[str, tuple[Value, ...] | None] = {}
        for name, raw_values in columns.items():
            where = ("points", "columns" if form.points.columns else "file" if form.points.file else "ranges", name)
            if name in {**form.axes, **form.fixed}:
                what = "an axis" if name in form.axes else "fixed"
                self.problems.add(where, f"is {what} too; leave out one of the two")
            with self.problems.at(where):
                if not (parameter := experiment.parameter(name)).may_be_axis:
                    raise ValueError(f"a {parameter.kind} cannot differ from point to point")
                points[name] = values.several(where, name, raw_values, rows=True)
        return points, origin, columns

    def _defined(
        self, experiment: Experiment, tables: Mapping[str, Mapping[str, Mapping[str, Any]]]
    ) -> tuple[Experiment, dict[str, dict[str, dict[str, Any]]]]:
        """Return the experiment with the values that the tables [define.PARAMETER.NAME] define, and these with
        references that work from any directory.
        """
        known: dict[str, Parameter] = {}
        portable: dict[str, dict[str, dict[str, Any]]] = {}
        for name, by_name in tables.items():
            with self.problems.at(("define", name, *list(by_name)[:1])):
                parameter = experiment.parameter(name)
                if parameter.define is None:
                    raise ValueError(f"{name} takes no values that a study defines, but {parameter.allowed()}")
                defined = []
                for word, table in by_name.items():
                    problems = self.problems.inside("define", name, word)
                    if not GOOD_NAME.fullmatch(word):
                        problems.add(
                            (), "a name begins with a letter and has at most 60 letters, digits and any of _ . + -"
                        )
                    if word in parameter.choices:
                        problems.add((), f"{shown(word)} is there already; take another name")
                    loaded: dict[str, str] = {}
                    defined.append(self._named(parameter.define, word, table, loaded, problems))
                    portable.setdefault(name, {})[word] = {
                        key: loaded.get(text, text) if isinstance(text, str) else text for key, text in table.items()
                    }
                known[name] = replace(parameter, defined=tuple(defined))
        parameters = tuple(known.get(parameter.name, parameter) for parameter in experiment.parameters)
        return replace(experiment, parameters=parameters), portable

    def _named(
        self,
        define: Callable[..., Any],
        name: str,
        table: Mapping[str, Any],
        loaded: dict[str, str],
        problems: Problems,
    ) -> Named:
        def load(reference: str) -> Function:
            function = self.code.function(reference, self.folder)
            loaded[reference] = function.reference  # which works from any directory
            return function

        try:
            value, identity = define(table, load)
            return Named(name, json.dumps(identity, sort_keys=True), value)
        except DefinitionError as error:
            for key, sentence in error.problems:
                problems.add((key,) if key else (), sentence)
        except Exception as error:  # whatever a user's experiment raises
            problems.add((), f"the experiment cannot make anything of it: {type(error).__name__}: {error}")
        return Named(name, name, None)  # so that its name is known where it is used


def _read_form(document: Mapping[str, Any], problems: Problems) -> Form | None:
    """Return the form of a document without its broken sections, so that the others are checked too; None where the
    key ``experiment`` is wrong.
    """
    try:
        return Form.model_validate(document)
    except ValidationError as error:
        errors = error.errors()
    for item in errors:
        where = tuple(item["loc"])
        if item["type"] == "extra_forbidden":
            problems.add(where, f"unknown key{suggest(str(where[-1]), _known_keys(where))}")
        elif item["type"] == "missing":
            problems.add(where, "is required")
        elif item["type"] == "value_error":
            problems.add(where, f"{shown(item['input'])} {item['ctx']['error']}")
        else:
            problems.add(where, f"{item['msg'][0].lower()}{item['msg'][1:]}, not {shown(item['input'])}")
    broken = {item["loc"][0] for item in errors}
    if "experiment" in broken:
        return None
    if {"axes", "points"} & broken:
        broken |= {"grid", "claim", "conclusion", "published", "figure"}
    if "grid" in broken:
        broken |= {"claim", "conclusion"}
    return Form.model_validate({"title": "", **{key: one for key, one in document.items() if key not in broken}})


def _known_keys(where: Place) -> list[str]:
    """Return the keys that are allowed beside the one at a place."""
    table: type[BaseModel] = Form
    for key in where[:-1]:
        field = table.model_fields.get(str(key))
        if field is not None:  # the one model in types such as Slope | None, list[Claim] and dict[str, ConclusionValue]
            todo: list[Any] = [field.annotation]
            for one in todo:  # which grows meanwhile
                todo += getattr(one, "__args__", ())
            table = next((one for one in todo if isinstance(one, type) and issubclass(one, BaseModel)), table)
    return list(table.model_fields)


def _check_sampling(sampling: Sampling, experiment: Experiment, problems: Problems) -> None:
    """Report settings of the sampling that contradict each other or the experiment, by their place in its table."""
    name, most = experiment.name, sampling.max_n_sim
    if experiment.deterministic:
        if keys := sorted(sampling.model_fields_set):
            problems.add(
                (),
                f"{name} takes no rng and is evaluated once at each point: there is nothing to sample, "
                f"leave out {', '.join(keys)}",
            )
        return

    def report(key: str, wrong: bool, sentence: str) -> None:
        if wrong:
            problems.add((key,), sentence)

    precise, keeps = sampling.precision is not None, sampling.keep_samples
    alone = f"{name} has no outer draw that realisations share; leave it out"
    report("n_cat", sampling.n_cat > 1 and not experiment.outer_draw, alone)
    report("keep_samples", keeps and experiment.samples is None, f"the experiment {name!r} has no samples to keep")
    unshared = f"the experiment {name!r} declares no parameter that leaves its random numbers unchanged"
    report("common_random_numbers", sampling.common_random_numbers and not experiment.shared, unshared)
    report("max_n_sim", most is not None and not precise, "has an effect only with a precision, which is not set")
    least = f"must be at least n_sim = {sampling.n_sim}, with which every point begins"
    report("max_n_sim", precise and most is not None and most < sampling.n_sim, f"{most}: {least}")
    report("precision", precise and keeps, "cannot go with keep_samples: points would keep different numbers")
    unjudged = f"no headline result X of the experiment {name!r} has an error X_mc_error to judge by"
    report("precision", precise and not experiment.errors_of_headline(), unjudged)


def _zipped_axes(groups: Sequence[Sequence[str]], axes: Axes, problems: Problems) -> tuple[tuple[str, ...], ...]:
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


def _exclusion(
    index: int, clause: Mapping[str, object], known: Collection[str], values: Values
) -> tuple[Condition, ...]:
    """Return the conditions of one exclusion; ``known`` are the parameters that the study sets."""
    if not clause:
        values.problems.add(("exclude", index), "is empty and would leave out every point")
    return tuple(_condition(("exclude", index, name), name, rule, known, values) for name, rule in clause.items())


def _condition(where: Place, name: str, written: object, known: Collection[str], values: Values) -> Condition:
    with values.problems.at(where):
        parameter = values.experiment.parameter(name)
        rule: dict[str, Any] = written if isinstance(written, dict) else {"equal": written}
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
            values.problems.add(where, f"{name} has no order: use equal or in")
        elif parameter.default is None and name not in known:
            why = "it is neither an axis nor fixed, and has no default"
            values.problems.add(where, f"{name} has no value to compare: {why}")
        for key, raw in rule.items():
            if problem := number_problem(raw):
                values.problems.add((*where, key), problem)
        bounds = {key: float(raw) for key, raw in rule.items() if not number_problem(raw)}
        return Condition(name, above=bounds.get("above"), below=bounds.get("below"))
    return Condition(name)


def _read_published(form: PublishedForm, values: Values, axes: Collection[str]) -> Published | None:
    """Return the published numbers that a study names, from a CSV file in its folder."""
    problems, file = values.problems, shown(form.file)
    if (form.tolerance is None) != (form.tolerance_reason is None):
        problems.add(("published", "tolerance"), "a tolerance needs a tolerance_reason, and the other way round")
    where = ("published", "file")
    try:
        text = read_text(values.folder / form.file)
        lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line and not line.startswith("#")]
        reader = csv.DictReader((line for _, line in lines), restkey="")
        rows = [(lines[reader.line_num - 1][0], row) for row in reader]
    except SweepError as error:
        problems.add(where, f"{file} {error}")
        return None
    except csv.Error as error:
        problems.add(where, f"{file} is not a CSV table: {error}")
        return None
    outputs = {output.name for output in values.experiment.outputs}
    parameters = {parameter.name: parameter for parameter in values.experiment.parameters}
    columns = list(reader.fieldnames or ())
    unknown = [column for column in columns if column not in outputs and column not in parameters]
    if unknown or not rows:
        wrong = f": columns {shown(unknown)} are neither parameters nor outputs" if rows else " holds no rows"
        problems.add(where, f"{file}{wrong}")
        return None
    for number, row in rows:
        if "" in row or None in row.values():
            problems.add(where, f"{file}, line {number}: does not have {len(columns)} cells as the header has")
            continue
        for column, cell in row.items():
            optional = column in outputs and column not in axes
            if wanted := _wrong_cell(parameters.get(column), cell, optional):
                problems.add(where, f"{file}, line {number}: {column} = {shown(cell)}: must be {wanted}")
    tolerance, reason = form.tolerance or 0.0, form.tolerance_reason or ""
    return Published(form.source, tuple(row for _, row in rows), tolerance, reason)


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
