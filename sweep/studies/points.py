"""The table [points] of a study: many parameters at once, from a file, a design, or columns of values."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from linksweep.sweep.code.load import Code
from linksweep.sweep.contract import Experiment, SweepError, shown, suggest
from linksweep.sweep.contract.units import factor_between, is_quantity
from linksweep.sweep.studies.designs import DESIGNS, MORRIS_LEVELS
from linksweep.sweep.studies.form import PointsForm
from linksweep.sweep.studies.problems import Problems
from linksweep.sweep.studies.ranges import read_range
from linksweep.sweep.studies.source import Place
from linksweep.sweep.tables.columns import rows_listed
from linksweep.sweep.tables.reader import read_table

MOST_ROWS = 1_000_000

_DECIMAL_COMMA = str.maketrans(",.", ".,")

Columns = Mapping[str, list[Any]]


def read_points(
    form: PointsForm, experiment: Experiment, fixed: Mapping[str, Any], folder: Path, code: Code, problems: Problems
) -> tuple[Columns, dict[str, Any]]:
    """Return the columns of a table of points as they are written, all of one length, and where they come from.

    ``fixed`` are the other parameters that the study sets; ``problems`` takes what is wrong, and the columns are empty
    then.
    """
    given = [key for key in ("file", "design", "columns") if getattr(form, key) is not None]
    columns: Columns = {}
    origin: dict[str, Any] = {}
    if len(given) != 1:
        named = f"not {' and '.join(given)}" if given else "and has none of them"
        problems.add(("points",), f"needs exactly one of file, design and columns, {named}")
    elif stray := sorted(form.model_fields_set - _KEYS[given[0]]):
        problems.add(("points", stray[0]), f"does not go with {given[0]}")
    elif form.design is not None:
        columns, origin = _of_design(form, experiment, problems)
    elif form.file is not None:
        columns, origin = _of_file(form, experiment, folder, problems), {"file": Path(form.file).name}
    else:
        columns, origin = form.columns or {}, dict(form.origin or {})
        if not columns:
            problems.add(("points", "columns"), "has no columns")
        columns = _in_units(columns, form.units, experiment, ("points", "columns"), problems)
    columns = _checked(columns, problems)
    if form.derive is not None and columns:
        settings = experiment.defaults() | dict(fixed)
        columns = {**columns, **_derived(form.derive, columns, settings, folder, code, problems)}
        origin["derive"] = form.derive
    return columns, origin


_KEYS: Mapping[str, set[str]] = {
    "file": {"file", "units", "derive"},
    "columns": {"columns", "units", "derive", "origin"},
    "design": {"design", "n", "seed", "ranges", "derive"},
}


def _checked(columns: Columns, problems: Problems) -> Columns:
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        sizes = ", ".join(f"{name} has {n}" for name, n in lengths.items())
        problems.add(("points",), f"columns must have the same number of values: {sizes}")
        return {}
    rows = max(lengths.values(), default=1)
    if not 1 <= rows <= MOST_ROWS:
        problems.add(("points",), f"has {rows:,} points; from 1 to {MOST_ROWS:,} are allowed")
        return {}
    return columns


def _of_file(form: PointsForm, experiment: Experiment, folder: Path, problems: Problems) -> Columns:
    with problems.at(("points", "file"), f"{shown(form.file)}: "):
        table = read_table(folder / str(form.file))
        columns, units = columns_of({name: table[name] for name in table.colnames})
        columns = {name: _read_where_possible(values, experiment, name) for name, values in columns.items()}
        return _in_units(columns, units | form.units, experiment, ("points", "file"), problems)
    return {}


def _read_where_possible(values: list[Any], experiment: Experiment, name: str) -> list[Any]:
    """Return a column of a file that is text because of some cells, with the others as what the parameter takes: only
    those that are wrong are then refused.  A column in which no cell is wrong is text on purpose, and stays so, unless
    it is text for an integer beyond 64 bits.
    """
    kind = next((p.kind for p in experiment.parameters if p.name == name), "any")
    if kind not in ("float", "int", "bool") or not any(isinstance(value, str) for value in values):
        return values
    marks: list[Mapping[int, int]] = [{}, _DECIMAL_COMMA]
    readings = [[_cell(value, kind, swapped) for value in values] for swapped in marks]
    found = min(readings, key=lambda cells: sum(isinstance(cell, str) for cell in cells))
    return found if any(isinstance(cell, str) or _is_beyond_64_bits(cell) for cell in found) else values


def _is_beyond_64_bits(cell: Any) -> bool:
    return isinstance(cell, int) and not -(2**63) <= cell < 2**63


def _cell(value: Any, kind: str, swapped: Mapping[int, int]) -> Any:
    """Return a number, once characters are swapped, or a truth value that a cell holds, or the text as it is."""
    if not isinstance(value, str) or "_" in value:  # which Python allows between digits
        return value
    if kind == "bool":
        return {"true": True, "false": False}.get(value.lower(), value)
    for number in (int, float):
        with suppress(ValueError):
            return number(value.translate(swapped))
    return value


def columns_of(table: Mapping[str, Any]) -> tuple[dict[str, list[Any]], dict[str, str]]:
    """Return astropy columns by name as lists of Python values, None where one is missing, and units by column."""
    columns = {str(name): _values(column) for name, column in table.items()}
    units = {str(name): str(unit) for name, column in table.items() if (unit := getattr(column, "unit", None))}
    return columns, units


def _values(column: Any) -> list[Any]:
    if is_quantity(column):
        column = np.ma.masked_array(getattr(column, "unmasked", column).value, getattr(column, "mask", False))
    return list(np.atleast_1d(np.ma.asarray(column)).tolist())


def _in_units(
    columns: Columns, units: Mapping[str, str], experiment: Experiment, where: Place, problems: Problems
) -> Columns:
    """Return columns in the units of their parameters, none if anything is wrong."""
    found: dict[str, list[Any]] = {}
    for name in {**columns, **units}:
        with problems.at((*where, name)):
            parameter = experiment.parameter(name)
            if name not in columns:
                raise ValueError("has a unit, but is no column")
            found[name] = _column(columns[name], units.get(name, ""), parameter.unit)
    return found if len(found) == len(columns) else {}


def _column(values: list[Any], own: str, unit: str) -> list[Any]:
    missing = np.array([value is None or value != value for value in values], dtype=bool)  # noqa: PLR0124 (NaN)
    if missing.any():
        raise ValueError(f"has no value in row {rows_listed(missing)}")
    values = [value.decode() if isinstance(value, bytes) else value for value in values]
    factor = factor_between(own, unit) if own else 1.0
    if factor is None:
        raise ValueError(f"its column is in {own}, and the parameter {f'is in {unit}' if unit else 'has no unit'}")
    if factor == 1.0 or not all(isinstance(value, int | float) for value in values):
        return values
    return [factor * value for value in values]


def _derived(
    reference: str, columns: Columns, settings: Mapping[str, Any], folder: Path, code: Code, problems: Problems
) -> Columns:
    """Return the columns that a user's function returns for each row of a table."""
    found: dict[str, list[Any]] = {}
    names = list(columns)
    with problems.at(("points", "derive")):
        function = code.function(reference, folder)
        for number, values in enumerate(zip(*columns.values(), strict=True), start=1):
            try:
                given = function({**settings, **dict(zip(names, values, strict=True))})
            except Exception as error:  # whatever a user's function raises
                raise ValueError(f"row {number}: {reference} raises {type(error).__name__}: {error}") from error
            if not isinstance(given, Mapping) or (found and given.keys() != found.keys()):
                expected = f"a mapping of {', '.join(found)}" if found else "a mapping of parameters to their values"
                raise ValueError(f"row {number}: {reference} returns {shown(given)}, not {expected}")
            for name, value in given.items():
                found.setdefault(str(name), []).append(value.item() if hasattr(value, "item") else value)
        if twice := sorted(found.keys() & columns.keys()):
            raise ValueError(f"{', '.join(twice)} is a column already")
        return found
    return {}


def _of_design(form: PointsForm, experiment: Experiment, problems: Problems) -> tuple[Columns, dict[str, Any]]:
    before = len(problems.found)
    name = str(form.design)
    if name not in DESIGNS:
        problems.add(("points", "design"), f"no design {shown(name)}{suggest(name, list(DESIGNS))}")
    if form.n is None:
        what = DESIGNS[name].counts if name in DESIGNS else "points"
        problems.add(("points", "n"), f"is required: how many {what}")
    if not form.ranges:
        problems.add(("points", "ranges"), "is required: the range of each parameter that the design varies")
    ranges = []
    for key, spec in form.ranges.items():
        with problems.at(("points", "ranges", key)):
            ranges.append(read_range(experiment.parameter(key), spec))
    if name == "morris":
        for one in ranges:
            if one.levels < MORRIS_LEVELS or any(isinstance(value, str | bool) for value in one.values):
                sentence = f"a Morris design takes steps between {MORRIS_LEVELS} numbers at least"
                problems.add(("points", "ranges", one.name), sentence)
    if len(problems.found) > before or form.n is None:
        return {}, {}
    if (size := DESIGNS[name].size(form.n, len(ranges))) > MOST_ROWS:
        problems.add(("points", "n"), f"makes {size:,} points; at most {MOST_ROWS:,} are allowed")
        return {}, {}
    try:
        unit = DESIGNS[name].make(form.n, len(ranges), form.seed)
    except (SweepError, ValueError) as error:
        problems.add(("points", "design"), f"{name}: {' '.join(str(error).split())}")
        return {}, {}
    columns = {one.name: one(unit[:, k]) for k, one in enumerate(ranges)}
    return columns, {"design": name, "n": form.n, "seed": form.seed, "ranges": dict(form.ranges)}
