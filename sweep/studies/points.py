"""Many parameters at once, the table [points] of a study: from a file, a design, columns, or a table in Python."""

from collections.abc import Iterator, KeysView, Mapping, ValuesView
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from linksweep.sweep.code.load import Code
from linksweep.sweep.contract import Experiment, SweepError, shown, suggest
from linksweep.sweep.contract.units import factor_between, is_quantity
from linksweep.sweep.studies.document import Place, Problems
from linksweep.sweep.studies.study import PointsForm
from linksweep.sweep.studies.values import DESIGNS, MORRIS_LEVELS, Values, read_range
from linksweep.sweep.tables.columns import rows_listed
from linksweep.sweep.tables.reader import read_table

MOST_ROWS = 1_000_000

PLAIN = frozenset("biufU")
"""Kinds of arrays whose ``tolist`` returns Python's own numbers and texts."""

_DECIMAL_COMMA = str.maketrans(",.", ".,")

Columns = Mapping[str, list[Any]]

_KEYS: Mapping[str, set[str]] = {
    "file": {"file", "units", "derive"},
    "columns": {"columns", "units", "derive", "origin"},
    "design": {"design", "n", "seed", "ranges", "derive"},
}


def read_points(
    form: PointsForm, values: Values, fixed: Mapping[str, Any], code: Code
) -> tuple[Columns, dict[str, Any]]:
    """Return the columns of a table of points as they are written, all of one length, and where they come from.

    ``fixed`` are the other parameters that the study sets; the columns are empty where anything is wrong, and the
    problems of ``values`` say what.
    """
    problems, experiment = values.problems, values.experiment
    chosen = [key for key in ("file", "design", "columns") if getattr(form, key) is not None]
    columns: Columns = {}
    origin: dict[str, Any] = {}
    if len(chosen) != 1:
        named = f"not {' and '.join(chosen)}" if chosen else "and has none of them"
        problems.add(("points",), f"needs exactly one of file, design and columns, {named}")
    elif stray := sorted(form.model_fields_set - _KEYS[chosen[0]]):
        problems.add(("points", stray[0]), f"does not go with {chosen[0]}")
    elif form.design is not None:
        columns, origin = _designed(form, experiment, problems)
    elif form.file is not None:
        columns, origin = _in_file(form, values), {"file": Path(form.file).name}
    else:
        origin = dict(form.origin or {})
        if not form.columns:
            problems.add(("points", "columns"), "has no columns")
        columns = _in_units(form.columns or {}, form.units, experiment, ("points", "columns"), problems)
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        sizes = ", ".join(f"{name} has {n}" for name, n in lengths.items())
        problems.add(("points",), f"columns must have the same number of values: {sizes}")
        columns = {}
    elif not 1 <= (rows := max(lengths.values(), default=1)) <= MOST_ROWS:
        problems.add(("points",), f"has {rows:,} points; from 1 to {MOST_ROWS:,} are allowed")
        columns = {}
    if form.derive is not None and columns:
        with problems.at(("points", "derive")):
            columns = {**columns, **_derived(form.derive, columns, experiment.defaults() | dict(fixed), values, code)}
        origin["derive"] = form.derive
    return columns, origin


def _in_file(form: PointsForm, values: Values) -> Columns:
    with values.problems.at(("points", "file"), f"{shown(form.file)}: "):
        table = read_table(values.folder / str(form.file))
        columns, units = columns_of({name: table[name] for name in table.colnames})
        kinds = {parameter.name: parameter.kind for parameter in values.experiment.parameters}
        read = {name: _read_where_possible(cells, kinds.get(name, "any")) for name, cells in columns.items()}
        return _in_units(read, units | form.units, values.experiment, ("points", "file"), values.problems)
    return {}


def _read_where_possible(values: list[Any], kind: str) -> list[Any]:
    """Return a column of a file that is text because of some cells, with the others as what the parameter takes: only
    those that are wrong are then refused.  A column in which no cell is wrong is text on purpose, and stays so, unless
    it is text for an integer beyond 64 bits.
    """
    if kind not in ("float", "int", "bool") or not any(isinstance(value, str) for value in values):
        return values

    def cell(value: Any, swapped: Mapping[int, int]) -> Any:
        if not isinstance(value, str) or "_" in value:  # which Python allows between digits
            return value
        if kind == "bool":
            return {"true": True, "false": False}.get(value.lower(), value)
        for number in (int, float):
            with suppress(ValueError):
                return number(value.translate(swapped))
        return value

    marks: list[Mapping[int, int]] = [{}, _DECIMAL_COMMA]
    readings = [[cell(value, swapped) for value in values] for swapped in marks]
    best = min(readings, key=lambda cells: sum(isinstance(one, str) for one in cells))
    wrong = any(isinstance(one, str) or (isinstance(one, int) and not -(2**63) <= one < 2**63) for one in best)
    return best if wrong else values


def columns_of(table: Mapping[str, Any]) -> tuple[dict[str, list[Any]], dict[str, str]]:
    """Return astropy columns by name as lists of Python values, None where one is missing, and units by column."""
    columns, units = {}, {}
    for name, column in table.items():
        if unit := getattr(column, "unit", None):
            units[str(name)] = str(unit)
        numbers, mask = getattr(column, "unmasked", column), getattr(column, "mask", False)
        cells = np.ma.masked_array(numbers.value, mask) if is_quantity(column) else column
        columns[str(name)] = list(np.atleast_1d(np.ma.asarray(cells)).tolist())
    return columns, units


def _in_units(
    columns: Columns, units: Mapping[str, str], experiment: Experiment, where: Place, problems: Problems
) -> Columns:
    """Return columns in the units of their parameters, none if anything is wrong."""
    right: dict[str, list[Any]] = {}
    for name in {**columns, **units}:
        with problems.at((*where, name)):
            unit, theirs = experiment.parameter(name).unit, units.get(name, "")
            if name not in columns:
                raise ValueError("has a unit, but is no column")
            values = columns[name]
            missing = np.array([value is None or value != value for value in values], dtype=bool)  # noqa: PLR0124 (NaN)
            if missing.any():
                raise ValueError(f"has no value in row {rows_listed(missing)}")
            values = [value.decode() if isinstance(value, bytes) else value for value in values]
            factor = factor_between(theirs, unit) if theirs else 1.0
            if factor is None:
                expected = f"is in {unit}" if unit else "has no unit"
                raise ValueError(f"its column is in {theirs}, and the parameter {expected}")
            scaled = factor != 1.0 and all(isinstance(value, int | float) for value in values)
            right[name] = [factor * value for value in values] if scaled else values
    return right if len(right) == len(columns) else {}


def _derived(reference: str, columns: Columns, settings: Mapping[str, Any], values: Values, code: Code) -> Columns:
    """Return the columns that a user's function returns for each row of a table; raises ValueError as it should."""
    derived: dict[str, list[Any]] = {}
    function = code.function(reference, values.folder)
    for number, row in enumerate(zip(*columns.values(), strict=True), start=1):
        try:
            result = function({**settings, **dict(zip(columns, row, strict=True))})
        except Exception as error:  # whatever a user's function raises
            raise ValueError(f"row {number}: {reference} raises {type(error).__name__}: {error}") from error
        if not isinstance(result, Mapping) or (derived and result.keys() != derived.keys()):
            expected = f"a mapping of {', '.join(derived)}" if derived else "a mapping of parameters to their values"
            raise ValueError(f"row {number}: {reference} returns {shown(result)}, not {expected}")
        for name, value in result.items():
            derived.setdefault(str(name), []).append(value.item() if hasattr(value, "item") else value)
    if twice := sorted(derived.keys() & columns.keys()):
        raise ValueError(f"{', '.join(twice)} is a column already")
    return derived


def _designed(form: PointsForm, experiment: Experiment, problems: Problems) -> tuple[Columns, dict[str, Any]]:
    before = len(problems.sentences)
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
            ranges.append(one := read_range(experiment.parameter(key), spec))
            few = one.levels < MORRIS_LEVELS or any(isinstance(value, str | bool) for value in one.values)
            if name == "morris" and few:
                raise ValueError(f"a Morris design takes steps between {MORRIS_LEVELS} numbers at least")
    if len(problems.sentences) > before or form.n is None:
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


def plain(value: Any, where: str) -> Any:
    """Return a value as TOML would give it: lists for arrays, ranges, tuples and indexes, Python's own numbers.

    Raises SweepError that names the place for a quantity of astropy: the unit to convert it to is not known here.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item, f"{where}.{key}") for key, item in value.items()}
    if is_quantity(value):
        unit = str(value.unit)
        kind = f"a quantity in {unit}" if unit else "a quantity without a unit"
        raise SweepError(f"{where}: is {kind}; give numbers in the unit of the parameter, .to_value({unit!r})")
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "tolist"):  # arrays of NumPy, pandas and xarray
        items = value.tolist()
        return items if getattr(getattr(value, "dtype", None), "kind", "") in PLAIN else plain(items, where)
    if hasattr(value, "values") and hasattr(value.values, "tolist"):
        return plain(value.values.tolist(), where)
    if isinstance(value, Iterator):
        once = f"is a {type(value).__name__}, which gives its values only once"
        raise SweepError(f"{where}: {once}; give a list, list(...), of them")
    if isinstance(value, set | frozenset):
        try:
            value = sorted(value)  # its own order differs between processes
        except TypeError:
            kinds = ", ".join(sorted({type(item).__name__ for item in value}))
            raise SweepError(f"{where}: is a set of {kinds}, which have no order; give a list") from None
    if isinstance(value, list | tuple | range | KeysView | ValuesView):
        return [plain(item, where) for item in value]
    return value


def plain_points(points: Any) -> dict[str, Any]:
    """Return a table of points as a study file has it, from a DataFrame, an astropy Table, a mapping of columns, the
    name of a file, or what a study file may have there.
    """
    units: dict[str, str] = {}
    if isinstance(points, str | PathLike):
        return {"file": str(points)}
    if isinstance(points, Mapping):
        if any(isinstance(points.get(key), str) for key in ("file", "design")) or isinstance(
            points.get("columns"), dict
        ):
            return dict(plain(points, "points"))
        quantities, units = columns_of({name: column for name, column in points.items() if is_quantity(column)})
        columns = plain({name: quantities.get(name, column) for name, column in points.items()}, "points")
    elif hasattr(points, "colnames"):
        columns, units = columns_of({name: points[name] for name in points.colnames})
    elif hasattr(points, "columns") and hasattr(points, "to_dict"):
        if twice := points.columns[points.columns.duplicated()].tolist():
            raise SweepError(f"points: two columns are called {shown(twice[0])}")
        columns = {str(name): points[name].astype(object).where(points[name].notna(), None).tolist() for name in points}
    else:
        wanted = "must be a DataFrame, a Table, a mapping of columns, a file or a design"
        raise SweepError(f"points = {shown(points)}: {wanted}")
    return {"columns": columns, **({"units": units} if units else {})}
