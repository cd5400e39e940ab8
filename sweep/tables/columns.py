"""Columns of a table as numbers in a wanted unit: units of files, sexagesimal angles, and right ascensions in hours."""

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Array

ROWS_NAMED = 5

HOURS = 24.0
"""A column of right ascensions without a unit, all within -24 to 24, may be in hours (or radians) as well."""

SEXAGESIMAL = {"deg": False, "d:m:s": False, "hourangle": True, "h": True, "h:m:s": True}
"""Units of angles that are text, and whether these are hours."""

_NAMED_TIME = re.compile(
    r"^_?ra(h|hr|hrs|hours?|m|s)$|^_?(ra|alpha)\w*[\W_](h|hr|hrs|hours?|hms|m|min|s|sec)\W*$", re.I
)
_NAMED_RADIANS = re.compile(r"[\W_]rad\W*$|^(ra|de|dec)rad$", re.I)
_ANGLE = re.compile(
    r"\s*([+\-\u2212]?)\s*(\d{1,3})\s*[:hd°\s]\s*(\d{1,2})(?:\s*[:m'′\s]\s*(\d{1,2}(?:\.\d*)?)\s*(?:s|\"|″)?)?"
    r"(\.\d*)?\s*m?\s*",
    re.I,
)


def column_values(table: Any, name: str, unit: str, stated: str | None = None, right_ascension: bool = False) -> Array:
    """Return a column of an astropy Table as float64 in ``unit``, NaN where it is missing; shape (N,).

    Values are converted from the unit in the file, or from the ``stated`` one if the file gives none; without either
    they are taken to be in ``unit``.  In a column along ``right_ascension`` a unit of time stands for an angle,
    15 arcsec a second.  An angle, ``unit`` "deg", may be text like '12 34 56.7' or '12:34:56.7', in hours if it is a
    right ascension.
    Raises ValueError that names the column, and rows (from 1) and values, for an unknown column, one that does not hold
    numbers, a unit of another kind or one that contradicts ``stated``, and a right ascension without a unit that may be
    in hours.
    """
    if name not in table.colnames:
        raise ValueError(f"no column {name!r}; there are {', '.join(table.colnames)}")
    column = table[name]
    kind = getattr(getattr(column, "dtype", None), "kind", "V")  # times and sky coordinates have no dtype
    if column.ndim != 1 or kind not in "fiuUSO":
        raise ValueError(f"column {name!r} does not hold numbers")
    wanted = _unit_of(table, name, stated)
    missing = missing_values(column)
    if kind in "USO":
        if unit != "deg":
            raise ValueError(f"column {name!r} does not hold numbers: row 1 has {str(column[0])!r}")
        return _sexagesimal(column, missing, name, wanted, right_ascension)
    values = np.asarray(np.ma.getdata(getattr(column, "value", column))).astype(np.float64)
    values[missing] = np.nan
    if wanted is None:
        _check_without_unit(name, values, unit, right_ascension)
        return values
    factor = _factor(wanted, unit, right_ascension)
    if factor is None:
        raise ValueError(f"column {name!r} is in {wanted}, not convertible to {unit}")
    return values if factor == 1.0 else values * factor


def in_time(table: Any, name: str, stated: str | None = None) -> bool:
    """Return whether a column is in units of time or hour angle, and so does not include the factor cos(dec)."""
    from astropy.units import hourangle

    unit = _unit_of(table, name, stated)
    if unit is None:
        return False
    return hourangle in getattr(unit, "bases", ()) or any(
        _factor(unit, wanted, False) is None and _factor(unit, wanted, True) is not None
        for wanted in ("deg", "deg / yr")
    )


def rows_listed(bad: NDArray[np.bool_], values: Any = None) -> str:
    """Return the first rows (from 1) where ``bad`` holds, with their values: '3 (95.2), 7 (91) and 2 more'."""
    rows = np.flatnonzero(bad)
    shown = [str(row + 1) if values is None else f"{row + 1} ({values[row]})" for row in rows[:ROWS_NAMED]]
    return ", ".join(shown) + (f" and {len(rows) - ROWS_NAMED} more" if len(rows) > ROWS_NAMED else "")


def _unit_of(table: Any, name: str, stated: str | None) -> Any:
    from astropy.units import Unit

    unit = table[name].unit
    own = None if unit is None or str(unit) == "" else Unit(unit, parse_strict="silent")
    if stated is None:
        return own
    try:
        said = Unit(stated)
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"units: {stated!r} for column {name!r} is no unit that astropy knows, like 'mas / yr'"
        ) from error
    if own is not None and own != said:
        raise ValueError(f"column {name!r} is in {own} as its file says, but units say {stated}")
    return said


def missing_values(column: Any) -> NDArray[np.bool_]:
    """Return where a column is masked or NaN; shape (N,)."""
    missing = np.broadcast_to(np.asarray(getattr(column, "mask", False), dtype=bool), (len(column),)).copy()
    if column.dtype.kind == "f":
        missing |= np.isnan(np.ma.getdata(getattr(column, "value", column)))
    return missing


def _factor(unit: Any, wanted: str, right_ascension: bool) -> float | None:
    """Return the factor from one unit to another, None if there is none; an hour of right ascension is 15 deg."""
    from astropy.units import Unit, UnitsError, hour, hourangle

    for as_angle in (False, True) if right_ascension else (False,):
        try:
            return float((unit * hourangle / hour if as_angle else unit).to(Unit(wanted)))
        except (UnitsError, TypeError, ValueError):
            continue
    return None


def _check_without_unit(name: str, values: Array, unit: str, right_ascension: bool) -> None:
    """Raise ValueError where an angle without a unit may well be in a unit other than degrees."""
    if unit != "deg" or not np.any(np.isfinite(values)):
        return
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    key = "ra" if right_ascension else "dec"
    if right_ascension and max(-low, high) <= HOURS:
        doubt = f"lies within {low:g} to {high:g}: hours, degrees or radians?"
    elif right_ascension and _NAMED_TIME.match(name) and not re.search(r"h|H", name[2:]):
        doubt = "has a name that suggests units of time"
    elif _NAMED_RADIANS.search(name) and max(-low, high) <= 2.0 * np.pi:
        doubt = "has a name that suggests radians"
    else:
        return
    raise ValueError(
        f'column {name!r} has no unit and {doubt}  Say it: units = {{ {key} = "deg" }}, or '
        f'"{"hourangle" if right_ascension else "rad"}" (with `sweep match`: --unit {key}=deg)'
    )


def _sexagesimal(column: Any, missing: NDArray[np.bool_], name: str, unit: Any, right_ascension: bool) -> Array:
    text = "" if unit is None else str(unit).strip('"').replace(" ", ":")  # VizieR writes quotes around it
    if text not in ("", *SEXAGESIMAL):
        raise ValueError(f"column {name!r} is text and in {unit}; an angle as text is in {', '.join(SEXAGESIMAL)}")
    hours = SEXAGESIMAL.get(text, right_ascension)
    values = np.full(len(column), np.nan)
    bad = np.zeros(len(column), dtype=bool)
    texts = [item.decode("ascii", "replace") if isinstance(item, bytes) else str(item) for item in column]
    for row, (item, gone) in enumerate(zip(texts, missing.tolist(), strict=True)):
        if gone or not item.strip():
            continue
        match = _ANGLE.fullmatch(item)
        angle = None if match is None else _angle(match, item, hours, right_ascension)
        bad[row] = angle is None
        values[row] = np.nan if angle is None else angle
    if bad.any():
        example = "12 34 56.7 or 12:34:56.7" if hours else "-12 34 56.7 or -12:34:56.7"
        quoted = [repr(item) for item in texts]
        sentence = f"column {name!r} is text that is no angle like {example} in row {rows_listed(bad, quoted)}"
        too_many = hours and not text and any(map(_ANGLE.fullmatch, np.array(texts)[bad]))
        raise ValueError(sentence + ("; is it in degrees? Say it: units ra = deg" if too_many else ""))
    return values


def _angle(match: "re.Match[str]", text: str, hours: bool, right_ascension: bool) -> float | None:
    """Return the degrees of a sexagesimal angle, None where its minutes, seconds or hours are too many."""
    sign, first, minutes, seconds, fraction = match.groups()
    if fraction and seconds is not None:
        return None
    marked = re.search("[hd°]", text, re.I)
    if marked:
        hours = marked[0] in "hH"
    if hours and not right_ascension:
        return None
    whole, part, rest = float(first), float(minutes + (fraction or "")), float(seconds or 0.0)
    if part >= 60.0 or rest > 60.0 or (hours and whole >= HOURS):
        return None
    angle = (whole + part / 60.0 + rest / 3600.0) * (15.0 if hours else 1.0)
    return -angle if sign in ("-", "\u2212") and sign else angle
