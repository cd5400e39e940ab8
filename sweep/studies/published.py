"""Reads the published table of a study."""

import csv
from collections.abc import Collection
from pathlib import Path

from sweep.contract import Experiment, Parameter, SweepError, shown
from sweep.studies.axes import is_number
from sweep.studies.form import PublishedForm
from sweep.studies.problems import Problems
from sweep.studies.source import read_text
from sweep.studies.study import Published


def read_published(
    form: PublishedForm, folder: Path, experiment: Experiment, axes: Collection[str], problems: Problems
) -> Published | None:
    """Return the published numbers that a study names, from a CSV file in its ``folder``; ``problems`` takes what is
    wrong.
    """
    if (form.tolerance is None) != (form.tolerance_reason is None):
        message = "a tolerance needs a tolerance_reason, and the other way round"
        problems.add(("published", "tolerance"), message)
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
