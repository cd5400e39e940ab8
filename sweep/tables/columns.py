"""The one reader of star tables: columns by quantity, under the names of archives, in known units, and what is wrong;
rows by a condition like ``ruwe < 1.4 & phot_g_mean_mag < 13``; and files of them as values of parameters.

Catalogues in files, `sweep tie`, `sweep forecast` and `sweep match` read their tables with it.
"""

import ast
import hashlib
import json
import math
import operator
import re
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property, lru_cache, partial, reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Array, Named, SweepError, suggest, unit_problem
from linksweep.sweep.formatting import first_of
from linksweep.sweep.tables.reader import BRACKETS, MISSING, has_unit, read_table, readme_of

Flags = NDArray[np.bool_]

# How names of positions end, best first; VizieR computes those that begin with _.
_ENDS = ("", "deg", "rad", "_icrs", "icrs", ".icrs", "j", "j2000", "_j2000")
# Column names of quantities, best first, in any case.
NAMES: Mapping[str, tuple[str, ...]] = {
    "ra": tuple(f"{mark}ra{end}" for mark in ("", "_") for end in _ENDS),
    "dec": tuple(f"{mark}{stem}{end}" for mark in ("", "_") for end in _ENDS for stem in ("dec", "de")),
    "parallax": ("parallax", "plx", "px"),
    "pmra": ("pmra", "pm_ra_cosdec", "pm_ra"),
    "pmdec": ("pmdec", "pm_dec", "pmDE"),
    "ref_epoch": ("ref_epoch", "epoch", "pos_epoch", "posepoch", "mjd"),
    "radial_velocity": ("radial_velocity", "dr2_radial_velocity", "rv"),
    "v_mag": ("v_mag", "vmag", "phot_g_mean_mag", "gmag", "vt_mag", "vtmag"),
    "name": (
        *("name", "objname", "object", "designation", "main_id", "source_name", "iers", "id", "source_id"),
        *("hip", "tyc"),
    ),
}

ERROR_NAMES = ("{}_error", "{}_err", "e_{}", "sigma_{}", "{}_sigma")

PARAMETERS = ("ra", "dec", "parallax", "pmra", "pmdec")
# What solutions of accelerated stars have beside the five parameters.
ACCELERATIONS = ("accel_ra", "accel_dec", "deriv_accel_ra", "deriv_accel_dec")
_NINE = (*PARAMETERS, *ACCELERATIONS)
_AT_VIZIER = ("RA", "DE", "Plx", "pmRA", "pmDE", *ACCELERATIONS)
# The correlations as the Gaia archive calls them, as VizieR does, and with the parameters in the other order: the ten
# of five parameters in the archive's order, and then those with accelerations.
ALL_PAIRS = tuple((i, j) for start in (0, 5) for i in range(9) for j in range(max(i + 1, start), 9) if start or j < 5)
CORRELATIONS: Mapping[str, tuple[str, ...]] = {
    f"{_NINE[i]}_{_NINE[j]}_corr": (f"{_AT_VIZIER[i]}{_AT_VIZIER[j]}cor", f"{_NINE[j]}_{_NINE[i]}_corr")
    for i, j in ALL_PAIRS
}

# Units of quantities other than positions, and of the errors of all quantities.
_UNITS = {
    **dict.fromkeys(("ra", "dec", "parallax", "calibrator"), "mas"),
    **dict.fromkeys(("pmra", "pmdec", "omega_x", "omega_y", "omega_z"), "mas / yr"),
    **dict.fromkeys(ACCELERATIONS[:2], "mas / yr2") | dict.fromkeys(ACCELERATIONS[2:], "mas / yr3"),
    **{"ref_epoch": "yr", "radial_velocity": "km / s", "period": "d", "t_periastron": "d"},
    **dict.fromkeys(("nu_eff_used_in_astrometry", "pseudocolour"), "1 / um"),
    **dict.fromkeys(("nodeangle", "inclination", "arg_periastron", "ecl_lat"), "deg"),
}

# The smallest and the largest angle (deg), but for rounding where it is in radians.
LIMITS = {"ra": (-180.0, 360.0), "dec": (-90.0, 90.0)}
ROUNDING = 1e-7

ALONG_RA = ("ra", "ra_error", "pmra", "pmra_error")
# The smallest and the largest epoch that is allowed, Julian years.
EPOCHS = (1700.0, 2300.0)

ROWS_NAMED = 5
# A column of right ascensions without a unit, all within -24 to 24, may be in hours (or radians) as well.
HOURS = 24.0

# Epochs above the first are modified Julian dates, and those above the second Julian dates; what 0 of the former is in
# the latter, and 2000.0 in the former.
MJD_FROM, JD_FROM, JD_OF_MJD, MJD_OF_2000 = 15000.0, 2.3e6, 2400000.5, 51544.5

# A table with these columns is of the Gaia archive, whose ra is in degrees.
GAIA_MARKS = {"source_id", "ref_epoch"}

# J2000 in the name of a position is the equinox, and may be the epoch too, to which VizieR moves what it computes. The
# description of a column says the epoch like "at Ep=2016.0", its metadata in the Gaia archive like "J2016.0".
_MAYBE_J2000 = re.compile(r"^_|2000$")
_STATED = re.compile(r"Ep(?:och)?\W{1,4}J?(\d{4}(?:\.\d+)?)")
SAME_EPOCH = 0.01
_YEAR = re.compile(r"\A\d{4}(\.\d*)?\Z")

# Units of angles that are text, and whether these are hours.
SEXAGESIMAL = {"deg": False, "d:m:s": False, "hourangle": True, "h": True, "h:m:s": True}

_SIDES = ("reference_", "satellite_")
_NAMED_TIME = re.compile(
    r"^_?ra(h|hr|hrs|hours?|m|s)$|^_?(ra|alpha)\w*[\W_](h|hr|hrs|hours?|hms|m|min|s|sec)\W*$", re.I
)
_NAMED_RADIANS = re.compile(r"[\W_]rad\W*$|^(ra|de|dec)rad$", re.I)
_ANGLE = (
    r"\A\s*(?P<sign>[+\-\u2212]?)\s*(?P<first>\d{1,3})\s*(?P<mark>[:hd°\s])\s*(?P<minutes>\d{1,2})"
    r"(?:\s*[:m'′\s]\s*(?P<seconds>\d{1,2}(?:\.\d*)?)\s*(?:s|\"|″)?|(?P<fraction>\.\d*))?\s*m?\s*\Z"
)


def first_found(wanted: Iterable[str], names: Collection[str]) -> str | None:
    """Return the column of the first wanted name that is found, ignoring case and a unit in brackets behind it if need
    be; None if there is none.
    """
    in_any_case = _in_any_case(tuple(names))
    columns = (name if name in names else in_any_case.get(name.casefold()) for name in wanted)
    return next((name for name in columns if name is not None), None)


@lru_cache(maxsize=8)
def _in_any_case(names: tuple[str, ...]) -> dict[str, str]:
    plain = {BRACKETS.sub(r"\1", name).casefold(): name for name in reversed(names)}
    return plain | {name.casefold(): name for name in reversed(names)}


def column_of(quantity: str, names: Collection[str], columns: Mapping[str, str] | None = None) -> str | None:
    """Return the column among ``names`` that holds a quantity, or its error (``ra_error``); None if there is none.

    ``columns`` are the names that a user gave, by quantity.
    """
    columns = columns or {}
    if quantity in columns:
        return columns[quantity]
    stem = quantity.removesuffix("_error")
    if stem != quantity and not quantity.startswith(_SIDES):
        stems = dict.fromkeys([column_of(stem, names, columns) or stem, stem, *NAMES.get(stem, ())])
        return first_found([form.format(one) for one in stems for form in ERROR_NAMES], names)
    return first_found((quantity, *CORRELATIONS.get(quantity, NAMES.get(quantity, ()))), names)


def unit_of(quantity: str) -> str:
    """Return the unit in which a quantity is read, which is also that of a column without one; '' for pure numbers."""
    plain = _plain(quantity)
    if plain in ("ra", "dec"):
        return "deg"
    stem = plain.removesuffix("_error")
    return _UNITS.get(stem, "mag" if stem.endswith("_mag") else "")


def _plain(quantity: str) -> str:
    """Return a quantity without the side that has it for its own, as ra_error of reference_ra_error."""
    return quantity.removeprefix(_SIDES[0]).removeprefix(_SIDES[1])


def rows_listed(bad: Flags, values: Any = None) -> str:
    """Return the first rows (from 1) where ``bad`` holds, with their values: '3 (95.2), 7 (91) and 2 more'."""
    rows, shown = np.flatnonzero(bad), []
    for row in rows[:ROWS_NAMED].tolist():
        value = "" if values is None else values[row]
        text = f"{value:.10g}" if isinstance(value, float) else str(value)
        shown.append(f"{row + 1} ({text})" if text else str(row + 1))
    return first_of([*shown, *rows[ROWS_NAMED:]], ROWS_NAMED)


class Columns:
    """Columns of an astropy Table by quantity; ``problems`` are all that is wrong with them, ``notes`` what is odd.

    Args:
        table: the table, as `sweep.tables.reader.read_table` returns it.
        where: its file, for errors.
        columns: names of columns by quantity, where they differ from `NAMES`.
        units: units of quantities whose columns have none in the file.
        known: the quantities that these may name.
    """

    def __init__(
        self,
        table: Any,
        where: str = "",
        columns: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        known: Collection[str] = (),
    ) -> None:
        self.table, self.where, self.columns, self.units = table, where, columns or {}, units or {}
        self.names: list[str] = list(table.colnames)
        self.problems: list[str] = []
        self.notes: list[str] = []
        for what, pairs in (("columns", self.columns), ("units", self.units)):
            for quantity, value in pairs.items():
                if quantity not in known or (what == "units" and not unit_of(quantity)):
                    self.problems.append(f"{what}: {quantity} is no quantity{suggest(quantity, list(known))}")
                elif what == "columns" and value not in self.names:
                    self.problems.append(f"columns: no column {value!r} for {quantity}{suggest(value, self.names)}")
                elif what == "units" and not self.has(quantity):
                    self.problems.append(f"units: no column of {quantity}, in {value!r}")

    def __len__(self) -> int:
        return len(self.table)

    def finish(self) -> None:
        """Raise SweepError if there are problems."""
        if self.problems:
            raise SweepError(list(dict.fromkeys(self.problems)), self.where)

    def name(self, quantity: str) -> str | None:
        """Return the name of the column of a quantity; None if the table has none."""
        return column_of(quantity, self.names, self.columns)

    @property
    def from_archive(self) -> bool:
        """Whether the table is one of the Gaia archive, whose CSV has no units: a small field may lie anywhere."""
        return self.name("ra") == "ra" and {*self.names} >= GAIA_MARKS

    def has(self, *quantities: str) -> bool:
        """Return whether the table has the columns of all these quantities."""
        return all(self.name(quantity) in self.names for quantity in quantities)

    def require(self, quantity: str, hint: str = "") -> bool:
        """Return whether the table has the column of a quantity, and record a problem if it does not."""
        if not self.has(quantity) and quantity not in self.columns:  # a column of the map has been reported
            alike = [name for name in self.names if name.endswith("_error") == quantity.endswith("_error")]
            self.problems.append(f"no column {quantity!r}{suggest(quantity, alike)}{hint}")
        return self.has(quantity)

    def label(self, quantity: str) -> str:
        """Return a quantity for messages, with the name of its column if the two differ."""
        name = self.name(quantity)
        return quantity if name in (quantity, None) else f"{quantity} (column {name!r})"

    def check(self, bad: Flags, what: str, values: Any = None, hint: str = "") -> None:
        """Record what is wrong with the rows where ``bad`` is true; their ``values`` are shown."""
        if bad.any():
            self.problems.append(f"{what} in row {rows_listed(bad, values)}{hint}")

    def kind(self, name: str) -> str:
        """Return NumPy's letter for the kind of a column's values, "V" if it is not one value per row."""
        column = self.table[name]  # times and places on the sky have no dtype
        return str(getattr(getattr(column, "dtype", None), "kind", "V")) if np.ndim(column) == 1 else "V"

    def quantity(
        self, quantity: str, missing: str = "refused", scale: float = 1.0, cos_dec: bool | None = None
    ) -> Array:
        """Return a quantity as float64 in its unit (`unit_of`) times ``scale``, NaN where it is missing; shape (N,).

        Values are converted from the unit in the file, or from that of ``units`` if the file gives none; without either
        they are in `unit_of`, or in radians if the name of the column says so.  Angles may be text like '12 34 56.7' or
        '12:34:56.7', in hours if it is a right ascension.  Along right ascension a second of time is 15 arcsec.
        ``cos_dec`` says whether an error or motion has the factor cos(dec), which it gets if not; by default it lacks
        it in units of time only.  The column must be there.  NaN everywhere, and a problem, for one that cannot be
        read; positions beyond `LIMITS` and negative errors are a problem, and so are rows that are not finite unless
        they are "allowed" to be ``missing``.
        """
        name, plain, label = str(self.name(quantity)), _plain(quantity), self.label(quantity)
        try:
            values = self._converted(name, quantity)
        except ValueError as error:
            self.problems.append(str(error))
            return np.full(len(self), np.nan)
        if plain in LIMITS:
            low, high = LIMITS[plain]
            outside = (values < low - ROUNDING) | (values > high + ROUNDING)
            self.check(outside, f"a {label} outside {low:g}..{high:g} deg", values)
        elif plain.endswith("_error"):
            self.check(values < 0.0, f"a negative {label}", values)
        values = values * scale
        known = len(self.problems)
        if self.lacks_cos_dec(quantity, cos_dec):
            values = values * self._cos_dec
        if missing == "refused" and len(self.problems) == known:
            self.check(np.isnan(values), f"no {label}")
            self.check(np.isinf(values), f"an infinite {label}")
        return values

    def lacks_cos_dec(self, quantity: str, cos_dec: bool | None) -> bool:
        """Return whether a quantity is to get the factor cos(dec); ``cos_dec`` as in `quantity`."""
        return _plain(quantity) in ALONG_RA[1:] and (self.in_time(quantity) if cos_dec is None else not cos_dec)

    @cached_property
    def _cos_dec(self) -> Array:
        dec = self.quantity("dec", "allowed") if self.has("dec") else np.zeros(len(self))
        return np.cos(dec * (np.pi / 180.0))

    def in_time(self, quantity: str) -> bool:
        """Return whether a column of numbers is in units of time or hour angle, and so does not include cos(dec)."""
        from astropy.units import hourangle

        unit, wanted = self.unit(quantity) if self.kind(str(self.name(quantity))) in "fiu" else None, unit_of(quantity)
        if unit is None or hourangle in getattr(unit, "bases", ()):
            return unit is not None
        return _factor(unit, wanted, False) is None and _factor(unit, wanted, True) is not None

    def numbers(self, name: str) -> Array:
        """Return a column by its own name as float64 without its unit, NaN where it is missing."""
        column = self.table[name]
        if self.kind(name) not in "fiu":
            self.problems.append(self._no_numbers(name))
            return np.full(len(self), np.nan)
        values = np.array(np.ma.getdata(getattr(column, "value", column)), dtype=np.float64)
        values[gaps(column)] = np.nan
        return values

    def epochs(self) -> Array:
        """Return the epochs as Julian years; rows with none, or with what is no epoch, are a problem."""
        name = str(self.name("ref_epoch"))
        known = len(self.problems)
        years = self.julian_years(name)
        if len(self.problems) == known:
            self.check(np.isnan(years), f"no epoch (column {name!r})")
            wrong = f"an epoch (column {name!r}) that is no Julian year, MJD or JD from {EPOCHS[0]:g} to {EPOCHS[1]:g}"
            self.check((years < EPOCHS[0]) | (years > EPOCHS[1]), wrong)
        if "ra" not in self.columns and self.has("ra"):
            ra, stated = str(self.name("ra")), self.stated_epoch()
            whose = "may be of 2000" if stated is None else f"is of {stated:g}, as its description says"
            different = _MAYBE_J2000.search(ra) if stated is None else np.any(np.abs(years - stated) > SAME_EPOCH)
            if different:
                say = f"give the epoch, or name the column, ra={ra}, if its positions are of {name!r}"
                self.problems.append(f"column {ra!r} {whose}, or of the epochs in {name!r}: {say}")
        return years

    def stated_epoch(self) -> float | None:
        """Return the epoch that the description of the right ascensions says, in Julian years; None for none."""
        column = self.table[self.name("ra")] if self.has("ra") else None
        said = _STATED.search(f"{getattr(column, 'description', '')} {getattr(column, 'meta', '')}")
        return None if said is None else float(said[1])

    def integers(self, quantity: str, may_miss: bool = False) -> NDArray[np.int64]:
        """Return a column of integers, 0 where it is missing."""
        name = str(self.name(quantity))
        column = self.table[name]
        if self.kind(name) not in "iuf":
            self.problems.append(self._no_numbers(name))
            return np.zeros(len(self), dtype=np.int64)
        missing = gaps(column)
        values = np.where(missing, 0, np.ma.getdata(getattr(column, "value", column)))
        if values.dtype.kind == "f":
            broken = ~(np.abs(values) < 2.0**53) | (values != np.floor(values))
            self.check(broken, f"a {self.label(quantity)} that is no integer")
            values = np.where(broken, 0.0, values)
        if not may_miss:
            self.check(missing, f"no {self.label(quantity)}")
        return values.astype(np.int64)

    def text(self, name: str, missing: str | None = None) -> NDArray[np.str_]:
        """Return a column by its own name as text, whole numbers as integers; ``missing`` stands where there is none,
        by default what NumPy writes there.
        """
        column = self.table[name]
        gone = gaps(column)
        if self.kind(name) in "iu" and not gone.any():
            return np.asarray(column).astype(np.str_)  # fast for millions of source_id
        texts = [" ".join(_written(value).split()) for value in column]
        return np.array(texts if missing is None else np.where(gone, missing, texts).tolist(), dtype=np.str_)

    def _no_numbers(self, name: str) -> str:
        clause = ""
        if self.kind(name) in "USO" and len(self):
            import pandas as pd

            texts = self.text(name)
            row = np.argmax(np.isnan(pd.to_numeric(texts, errors="coerce")) & ~np.isin(texts, MISSING))
            clause = f": row {row + 1} has the text {str(texts[row])!r}"
        return f"column {name!r} does not hold numbers{clause}"

    def unit(self, quantity: str) -> Any:
        """Return the unit of a column, as its file or as ``units`` say; None for none, ValueError if they differ."""
        from astropy.units import Unit

        name, stated = str(self.name(quantity)), self.units.get(quantity)
        in_file = self.table[name].unit
        if stated is None:
            return None if str(in_file or "") == "" else in_file
        if wrong := unit_problem(stated):
            raise ValueError(f"units: {quantity}: {wrong}")
        if has_unit(self.table[name]) and in_file != Unit(stated):
            raise ValueError(f"units: {quantity} in {stated}, but column {name!r} is in {in_file} as its file says")
        return Unit(stated)

    def _converted(self, name: str, quantity: str) -> Array:
        """Return a column in the unit of its quantity; raises ValueError for one that cannot be read."""
        is_text = self.kind(name) in "USO"
        if self.kind(name) not in "fiuUSO" or (is_text and unit_of(quantity) != "deg"):
            raise ValueError(self._no_numbers(name))
        if is_text:
            return self._sexagesimal(name, self.unit(quantity), _plain(quantity) in ALONG_RA)
        return self.numbers(name) * self.factor(quantity)

    def factor(self, quantity: str) -> float:
        """Return what the numbers of a column are multiplied by to be in the unit of a quantity; raises ValueError."""
        name, unit, wanted = str(self.name(quantity)), self.unit(quantity), unit_of(quantity)
        if unit is None:
            values = self.numbers(name)
            size = float(np.max(np.abs(values), where=~np.isnan(values), initial=0.0))
            if wanted == "deg" and _NAMED_RADIANS.search(name) and size <= 2.0 * np.pi:
                return 180.0 / np.pi
            if quantity == "ra" and np.isfinite(values).any() and not self.from_archive:
                _check_hours(name, values, size)
            return 1.0
        factor = _factor(unit, wanted, _plain(quantity) in ALONG_RA)
        if factor is None:
            hint = "" if has_unit(self.table[name]) else f"; say it like --unit {quantity}={wanted.replace(' ', '')}"
            raise ValueError(f"column {name!r} is in {unit}, not convertible to {wanted}{hint}")
        return factor

    def _sexagesimal(self, name: str, unit: Any, right_ascension: bool) -> Array:
        import pandas as pd

        form = "" if unit is None else str(unit).strip('"').replace(" ", ":")  # VizieR writes quotes around it
        if form not in ("", *SEXAGESIMAL):
            raise ValueError(f"column {name!r} is text and in {unit}; an angle as text is in {', '.join(SEXAGESIMAL)}")
        hours = SEXAGESIMAL.get(form, right_ascension)
        texts = pd.Series([_written(item) for item in self.table[name]], dtype=object)
        there = ~gaps(self.table[name]) & (texts.str.strip() != "").to_numpy()
        parts = texts.str.extract(_ANGLE, flags=re.IGNORECASE)
        mark, first = parts["mark"].str.lower(), parts["first"].astype(float)
        in_hours = (mark == "h") | (hours & ~mark.isin(["d", "°"]))
        minutes = (parts["minutes"] + parts["fraction"].fillna("")).astype(float)
        seconds = parts["seconds"].astype(float).fillna(0.0)
        good = (minutes < 60.0) & (seconds <= 60.0) & ~(in_hours & (not right_ascension or first >= HOURS))
        if (bad := there & ~good.to_numpy()).any():
            rows, words = rows_listed(bad, [repr(text) for text in texts]), "hours" if hours else "degrees"
            hint = "; is it in degrees? Say it: units ra = deg" * bool(hours and not form and first[bad].notna().any())
            raise ValueError(f"column {name!r} is text that is no angle in {words} like 12:34:56.7 in row {rows}{hint}")
        values = (first + minutes / 60.0 + seconds / 3600.0) * np.where(in_hours, 15.0, 1.0)
        return np.asarray(values.where(~parts["sign"].isin(["-", "\u2212"]), -values).where(there), dtype=np.float64)

    def julian_years(self, name: str) -> Array:
        """Return a column of epochs in any form (years, MJD, JD, dates or times) as Julian years, NaN where missing."""
        from astropy.time import Time

        column = self.table[name]
        if isinstance(column, Time):
            return np.asarray(np.ma.filled(np.ma.asarray(column.jyear), np.nan), dtype=np.float64)
        if self.kind(name) in "USOM":
            texts, years = self.text(name), np.full(len(self), np.nan)
            there = ~gaps(column) & ~np.isin(texts, ("", "--", "None", "NaT"))
            for row in np.flatnonzero(there):
                # astropy warns of years whose leap seconds are not known
                with warnings.catch_warnings(action="ignore"), suppress(ValueError):
                    years[row] = Time(_YEAR.sub(r"J\g<0>", _in_utc(texts[row]))).jyear
            self.check(there & np.isnan(years), f"no date like 2015-06-01 or J2015.5 (column {name!r})", texts)
            return years
        values, unit = self.numbers(name), str(column.unit)
        in_days = unit == "d" or (np.nanmin(values, initial=np.inf) > MJD_FROM and unit not in ("yr", "a"))
        return years_of_days(values) if in_days else values


def years_of_days(days: Array) -> Array:
    """Return the Julian years of Julian dates, modified or not."""
    return np.asarray(2000.0 + (days - np.where(days > JD_FROM, JD_OF_MJD, 0.0) - MJD_OF_2000) / 365.25)


def _in_utc(text: str) -> str:
    """Return a time with a zone as that in UTC without one, and any other text as it is."""
    with suppress(ValueError):
        if (time := datetime.fromisoformat(text)).tzinfo:
            return time.astimezone(UTC).replace(tzinfo=None).isoformat()
    return text


def gaps(column: Any) -> Flags:
    """Return where a column is masked or NaN; shape (N,)."""
    missing = np.broadcast_to(np.asarray(getattr(column, "mask", False), dtype=bool), (len(column),)).copy()
    if column.dtype.kind == "f":
        missing |= np.isnan(np.ma.getdata(getattr(column, "value", column)))
    return missing


def _written(value: Any) -> str:
    """Return a value as text; whole numbers are the same whether they were stored as integers or not."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    if isinstance(value, (float, np.floating)) and float(value).is_integer() and abs(float(value)) < 2.0**53:
        return str(int(value))
    return str(value)


def _factor(unit: Any, wanted: str, right_ascension: bool) -> float | None:
    """Return the factor from one unit to another, None if there is none; an hour of right ascension is 15 deg."""
    from astropy.units import DexUnit, Unit, UnitsError, hour, hourangle

    if isinstance(unit, DexUnit):  # as CDS has it, [mas] is the logarithm
        return None
    for as_angle in (False, True) if right_ascension else (False,):
        try:
            return float((unit * hourangle / hour if as_angle else unit).to(Unit(wanted)))
        except (UnitsError, TypeError, ValueError):
            continue
    return None


def _check_hours(name: str, values: Array, size: float) -> None:
    """Raise ValueError where right ascensions without a unit may well be in another one than degrees."""
    if size <= HOURS:
        doubt = f"lies within {np.nanmin(values):g} to {np.nanmax(values):g}: hours, degrees or radians?"
    elif _NAMED_TIME.match(name) and not re.search(r"h|H", name[2:]):
        doubt = "has a name that suggests units of time"
    else:
        return
    said = f'column {name!r} has no unit and {doubt}  Say it: units = {{ ra = "deg" }} in a study'
    raise ValueError(f'{said}, --unit [TABLE:]ra=deg with a command, or "hourangle"')


# ---- rows by a condition

# `&` binds more tightly than comparisons in Python, and `and` does not.
_OPERATORS = {"&": " and ", "|": " or ", "~": " not "}
_PIECES = re.compile(r"`([^`]+)`|'[^']*'|\"[^\"]*\"|\s|.", re.DOTALL)

_COMPARISONS: Mapping[type, Callable[[Any, Any], Any]] = {
    **{ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge},
    **{ast.Eq: operator.eq, ast.NotEq: operator.ne},
    **{ast.In: np.isin, ast.NotIn: partial(np.isin, invert=True)},
}
_ALLOWED = "allowed are columns, numbers, text, comparisons, in, not in, &, |, ~ and parentheses"


class _Operand(NamedTuple):
    """Values (N,), or one, or a list of them, and where they are missing."""

    values: Any
    missing: Any = False

    @property
    def kind(self) -> str:
        return {"U": "text", "b": "true or false"}.get(self.values.dtype.kind, "numbers")


def rows_where(table: Any, condition: str, where: str = "", may_be_none: bool = False) -> Flags:
    """Return which rows of an astropy Table meet a condition; shape (N,).

    It compares columns with numbers, text and each other: ``<``, ``<=``, ``>``, ``>=``, ``==``, ``!=``, ``in`` and
    ``not in`` a list, joined by ``&``, ``|`` and ``~`` or ``and``, ``or`` and ``not``, with parentheses.  Backticks
    enclose a name that is no word.  Numbers are those in the file, without its units.  Every comparison with a missing
    value is false.  Nothing of it is run as Python.  Raises SweepError, with the piece, for what it does not
    understand, and unless there ``may_be_none`` for a condition that no row meets.
    """
    read = Columns(table, where)
    try:
        flags = _flags(_parsed(condition), read)
    except (ValueError, RecursionError, MemoryError, OverflowError) as error:
        raise SweepError(f"where {condition!r}: {error}; {_ALLOWED}", where) from None
    if not flags.any() and not may_be_none:
        raise SweepError(f"where {condition!r} keeps none of {len(read)} rows", where)
    return flags


def conditions(texts: Iterable[str], tables: Collection[str], common: Sequence[str]) -> dict[str, str]:
    """Return the condition of each table from texts like ``ruwe < 1.4``, for all ``common`` ones, and ``TABLE: ruwe <
    1.4``; a row must meet all of a table.
    """
    by_table: dict[str, str] = {}
    for text in filter(str.strip, texts):
        table, colon, condition = text.partition(":")
        named = bool(colon) and table.strip() in tables
        for one in [table.strip()] if named else common:
            new = (condition if named else text).strip()
            by_table[one] = f"({by_table[one]}) & ({new})" if one in by_table else new
    return by_table


def _parsed(condition: str) -> ast.expr:
    """Return a condition as Python reads it, with the names in backticks as those of columns."""
    quoted: dict[str, str] = {}

    def in_python(piece: re.Match[str]) -> str:
        if piece[1]:
            quoted[word := f"_quoted_{len(quoted)}"] = piece[1]
            return word
        return _OPERATORS.get(piece[0], " " if piece[0].isspace() else piece[0])

    text = _PIECES.sub(in_python, condition).strip()
    try:
        with warnings.catch_warnings(action="ignore"):  # of the compiler, about what is refused below
            tree = ast.parse(text, mode="eval").body
    except SyntaxError as error:
        rest = text[error.offset - 1 :] if error.offset else ""  # it has no offset at the end
        at = f" at {rest!r}" if rest else " at the end"
        raise ValueError(f"{error.msg}{at if rest in condition else ''}") from None  # else it is not as it was written
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            node.id = quoted.get(node.id, node.id)
    return tree


def _flags(node: ast.expr, read: Columns) -> Flags:
    if isinstance(node, ast.BoolOp):
        join = np.logical_and if isinstance(node.op, ast.And) else np.logical_or
        return np.asarray(reduce(join, (_flags(value, read) for value in node.values)))
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        return np.logical_not(_flags(node.operand, read))
    flags = np.ones(len(read), dtype=bool)
    if not isinstance(node, ast.Compare):
        one = _operand(node, read)
        if one.kind == "text" or not np.all(np.isin(one.values, (0, 1)) | one.missing):
            raise ValueError(f"{one.kind} without a comparison, {ast.unparse(node)}")
        return np.asarray(flags & (one.values == 1) & np.logical_not(one.missing))
    left = _operand(node.left, read)
    for comparison, other in zip(node.ops, node.comparators, strict=True):
        is_in = isinstance(comparison, (ast.In, ast.NotIn))
        right, compare = _operand(other, read, is_in), _COMPARISONS.get(type(comparison))
        if compare is None or (left.kind != right.kind and "text" in (left.kind, right.kind)):
            said = f"{left.kind} cannot be compared with {right.kind} in this way (text is in quotes, '1')"
            raise ValueError(f"{said}, {ast.unparse(node)}")
        flags &= compare(left.values, right.values) & np.logical_not(left.missing | right.missing)
        left = right
    return flags


def _operand(node: ast.expr, read: Columns, is_list: bool = False) -> _Operand:
    if isinstance(node, ast.Name) and not is_list:
        return _column(node.id, read)
    with suppress(ValueError):  # of what is no literal, or no list of one length
        literal = np.asarray(ast.literal_eval(node))
        if literal.ndim == is_list and literal.dtype.kind in "biufU":
            return _Operand(literal)
    allowed = "a list of numbers or of text like [1, 2]" if is_list else "allowed"
    raise ValueError(f"{ast.unparse(node)} is not {allowed}")


def _column(asked: str, read: Columns) -> _Operand:
    if (name := first_found([asked], read.names)) is None:
        raise ValueError(f"no column {asked!r}{suggest(asked, read.names)}")
    kind, column = read.kind(name), read.table[name]
    if kind not in "biufUSO":
        raise ValueError(f"column {name!r} holds neither numbers nor text")
    missing, values = gaps(column), np.ma.getdata(getattr(column, "value", column))
    if kind in "USO":
        values = read.text(name, missing="")
        missing = missing | (values == "")
    return _Operand(values, missing)


# ---- a table in a file as the value of a parameter: known by its content, read where it is needed


@dataclass(frozen=True)
class TableFile:
    """A table file and the SHA-256 of its content, which is what identifies a point that uses it."""

    path: str
    digest: str

    def columns(self, columns: Mapping[str, str], units: Mapping[str, str], known: Collection[str]) -> Columns:
        """Return a reader of the columns; the arguments are those of `Columns`."""
        return Columns(_load(self), self.path, columns, units, known)

    def label(self, row: int) -> str:
        """Return the name of a row, counted from 0, from its column of names; empty where it has none."""
        table = _load(self)
        name = column_of("name", table.colnames)
        return "" if name is None or np.ma.is_masked(table[name][row]) else str(table[name][row]).strip()

    def unchanged(self) -> str:
        """Return the path; raises SweepError if the file has another content when a worker comes to read it."""
        if not Path(self.path).is_file() or _digest(Path(self.path)) != self.digest:
            raise SweepError("was changed since the study was read", self.path)
        return self.path


def table_file(path: Path) -> TableFile:
    """Return the value of a file parameter; raises SweepError where there is no table that can be read."""
    if not path.is_file():
        raise SweepError("no such file", str(path))
    table = TableFile(str(path.resolve()), _digest(path))
    _load(table)  # raises for what is no table
    return table


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file and of the ReadMe that describes it."""
    content = hashlib.sha256(path.read_bytes())
    if (readme := readme_of(path)) is not None:
        content.update(readme.read_bytes())
    return content.hexdigest()


def content_digest(value: object) -> str:
    """Return what stands in a point's identity for a value that JSON does not know: the digest of a table's content or
    of a definition, whatever their names.
    """
    if isinstance(value, TableFile):
        return f"sha256:{value.digest}"
    if isinstance(value, Named):
        return f"sha256:{hashlib.sha256(value.identity.encode()).hexdigest()}"
    raise TypeError(f"{type(value).__name__} is no value of a parameter")


def sorted_json(value: object) -> str:
    """Return a parameter's value, or a mapping of such, as JSON with sorted keys."""
    if type(value) is float and math.isfinite(value):
        return repr(value)  # the same text in a tenth of the time: tables of points have millions of values
    return json.dumps(value, sort_keys=True, default=content_digest)


@lru_cache(maxsize=4)
def _load(table: TableFile) -> Any:
    """Read a table once in a process: workers evaluate many blocks of the same file."""
    return read_table(Path(table.unchanged()))
