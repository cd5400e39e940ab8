"""Studies from Python objects: functions and experiments in place of references, arrays as axes."""

import hashlib
import json
from collections.abc import Callable, Iterator, KeysView, Mapping, ValuesView
from os import PathLike
from typing import Any

import numpy as np

from linksweep.sweep.code.load import Code, keep
from linksweep.sweep.contract import Experiment, SweepError, shown
from linksweep.sweep.contract.units import is_quantity
from linksweep.sweep.functions.adapter import is_plain_function
from linksweep.sweep.functions.signature import name_of
from linksweep.sweep.studies.points import columns_of
from linksweep.sweep.studies.reader import study_from_dict
from linksweep.sweep.studies.source import DEFAULT_EXPERIMENT
from linksweep.sweep.studies.study import Study
from linksweep.sweep.tables.file import content_digest

Mentioned = Callable[..., Any] | Experiment

PLAIN = frozenset("biufU")
"""Kinds of arrays whose ``tolist`` returns Python's own numbers and texts."""


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
    plain: dict[str, Any] = {
        str(key): _points(value) if key == "points" else _plain(value, str(key))
        for key, value in document.items()
        if key != "experiment"
    }
    given = document.get("experiment", DEFAULT_EXPERIMENT)
    plain["experiment"] = given if isinstance(given, str) else reference_of(given)
    name = plain["experiment"].rpartition(":")[2] if isinstance(given, str) else _name_of(given)
    plain.setdefault("title", name)
    code = Code(afresh=isinstance(given, str))
    text = json.dumps(plain, sort_keys=True, default=_digest)
    return study_from_dict(plain, f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:8]}", name, code)


def reference_of(function: Mentioned) -> str:
    """Return the reference by which a function or experiment is found, here and on workers."""
    if not isinstance(function, Experiment) and not is_plain_function(function):
        raise SweepError(f"{shown(function)} is neither a function nor an Experiment")
    return keep(function)


def _name_of(function: Mentioned) -> str:
    return function.name if isinstance(function, Experiment) else name_of(function)


def _plain(value: Any, where: str) -> Any:
    """Return a value as TOML would give it: lists for arrays, ranges, tuples and indexes, Python's own numbers.

    Raises SweepError that names the place for a quantity of astropy: the unit to convert it to is not known here.
    """
    if isinstance(value, Mapping):
        return _plain_table(value, where)
    if is_quantity(value):
        unit = str(value.unit)
        told = f"in {unit}" if unit else "without a unit"
        numbers = f"give numbers in the unit of the parameter, .to_value({unit!r})"
        raise SweepError(f"{where}: is a quantity {told}; {numbers}")
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "tolist"):  # arrays of NumPy, pandas and xarray
        items = value.tolist()
        return items if getattr(getattr(value, "dtype", None), "kind", "") in PLAIN else _plain(items, where)
    if hasattr(value, "values") and hasattr(value.values, "tolist"):
        return _plain(value.values.tolist(), where)
    if isinstance(value, Iterator):
        once = f"is a {type(value).__name__}, which gives its values only once"
        raise SweepError(f"{where}: {once}; give a list, list(...), of them")
    if isinstance(value, list | tuple | range | set | frozenset | KeysView | ValuesView):
        items = _in_order(value, where) if isinstance(value, set | frozenset) else value
        return [_plain(item, where) for item in items]
    return value


def _in_order(values: set[Any] | frozenset[Any], where: str) -> list[Any]:
    """Return the values of a set from the least to the largest: its own order differs between processes."""
    try:
        return sorted(values)
    except TypeError:
        kinds = ", ".join(sorted({type(value).__name__ for value in values}))
        raise SweepError(f"{where}: is a set of {kinds}, which have no order; give a list") from None


def _plain_table(table: Mapping[Any, Any], where: str) -> dict[str, Any]:
    return {str(key): _plain(item, f"{where}.{key}") for key, item in table.items()}


def _points(given: Any) -> dict[str, Any]:
    """Return a table of points as a study file has it, from a DataFrame, an astropy Table, a mapping of columns, the
    name of a file, or what a study file may have there.
    """
    if isinstance(given, str | PathLike):
        return {"file": str(given)}
    if isinstance(given, Mapping):
        if any(isinstance(given.get(key), str) for key in ("file", "design")) or isinstance(given.get("columns"), dict):
            return _plain_table(given, "points")
        quantities, units = columns_of({name: column for name, column in given.items() if is_quantity(column)})
        columns = _plain_table({name: quantities.get(name, column) for name, column in given.items()}, "points")
    elif hasattr(given, "colnames"):
        columns, units = columns_of({name: given[name] for name in given.colnames})
    elif hasattr(given, "columns") and hasattr(given, "to_dict"):
        if twice := given.columns[given.columns.duplicated()].tolist():
            raise SweepError(f"points: two columns are called {shown(twice[0])}")
        columns, units = {str(name): _with_gaps(given[name]) for name in given.columns}, {}
    else:
        wanted = "must be a DataFrame, a Table, a mapping of columns, a file or a design"
        raise SweepError(f"points = {shown(given)}: {wanted}")
    return {"columns": columns, **({"units": units} if units else {})}


def _with_gaps(series: Any) -> list[Any]:
    """Return the values of a pandas Series, None where one is missing."""
    known = zip(series.tolist(), series.notna().tolist(), strict=True)
    return [value if there else None for value, there in known]


def _digest(value: object) -> str:
    try:
        return content_digest(value)
    except TypeError:
        return repr(value)
