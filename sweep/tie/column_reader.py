"""Columns of an astrometric table as numbers, angles, epochs and text, and one list of all that is wrong with them."""

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.core.arrays import Array, Flags
from linksweep.core.constants import DEGREE
from linksweep.core.tie.astrometry import named_rows
from linksweep.sweep.formatting import first_of
from linksweep.sweep.tables.columns import column_values, in_time, missing_values
from linksweep.sweep.tables.rows import MISSING

MJD_FROM = 15000.0
"""Larger epochs are modified Julian dates, and those above `JD_FROM` Julian dates."""

JD_FROM, JD_OF_MJD = 2.3e6, 2400000.5


class ColumnReader:
    """Reads columns of one astropy Table and collects what is wrong with them."""

    def __init__(self, table: Any) -> None:
        self.table = table
        self.problems: list[str] = []

    def kind(self, name: str) -> str:
        """Return NumPy's letter for the kind of a column's values, "O" if they are not an array."""
        return str(getattr(getattr(self.table[name], "dtype", None), "kind", "O"))

    def rounding(self, name: str) -> float:
        """Return the relative rounding error of a column in single precision; 0 for other columns."""
        return 2.0**-24 if self.kind(name) == "f" and self.table[name].dtype.itemsize < 8 else 0.0

    def angle(self, name: str, hours: bool) -> Array:
        """Return a column of angles in rad; text is sexagesimal, in ``hours`` (a right ascension) unless it
        or its unit says degrees.
        """
        from astropy import units

        column = self.table[name]
        if self.kind(name) in "USO":
            return self._sexagesimal(name, hours)
        lower = name.casefold()
        unit = column.unit or (units.rad if lower.endswith("rad") else units.deg)
        if hours and column.unit is None and not lower.endswith(("deg", "rad")) and _like_hours(self.numbers(name)):
            self.problems.append(
                f"column {name!r} has no unit and runs over 0..24, as hours do; say --unit ra=hourangle (or ra=deg)"
            )
        try:
            return np.asarray(self.numbers(name) * units.Unit(unit).to("rad"))
        except (units.UnitsError, ValueError, TypeError):
            if hours and in_time(self.table, name):
                return column_values(self.table, name, "deg", right_ascension=True) * DEGREE
            self.problems.append(f"column {name!r} is in {unit}, which is no angle")
            return np.full(len(self.table), np.nan)

    def _sexagesimal(self, name: str, hours: bool) -> Array:
        try:
            return column_values(self.table, name, "deg", right_ascension=hours) * DEGREE
        except ValueError as error:
            self.problems.append(str(error))
            return np.full(len(self.table), np.nan)

    def in_time(self, name: str) -> bool:
        """Return whether a column of numbers is in units of time; along right ascension it then lacks cos(dec)."""
        return self.kind(name) in "fiu" and in_time(self.table, name)

    def in_unit(self, name: str, unit: str) -> Array:
        """Return a column in a unit, which is also that of a column without one; a second of time is 15 arcsec."""
        from astropy import units

        values, own = self.numbers(name), self.table[name].unit
        if own is None:
            return values
        if self.in_time(name):
            return column_values(self.table, name, unit, right_ascension=True)
        try:
            return np.asarray(values * units.Unit(own).to(unit))
        except (units.UnitsError, ValueError, TypeError):
            self.problems.append(f"column {name!r} is in {own}, not convertible to {unit}")
            return values

    def numbers(self, name: str) -> Array:
        """Return a column as float64 without its unit, NaN where it is missing."""
        column = self.table[name]
        if self.kind(name) not in "fiu" or column.ndim != 1:
            text = self._first_text(name)
            self.problems.append(f"column {name!r} does not hold numbers" + (f": {text}" if text else ""))
            return np.full(len(self.table), np.nan)
        return np.asarray(np.ma.filled(np.ma.asarray(getattr(column, "value", column)).astype(np.float64), np.nan))

    def julian_years(self, name: str) -> Array:
        """Return a column of epochs (years, MJD, JD, dates or times) as Julian years, NaN where it is missing."""
        from astropy.time import Time

        column = self.table[name]
        if isinstance(column, Time):
            return np.asarray(np.ma.filled(np.ma.asarray(column.jyear), np.nan), dtype=np.float64)
        if self.kind(name) in "USO" and np.ndim(column) == 1:
            return self._of_dates(name)
        values, unit = self.numbers(name), str(column.unit)
        values = np.where(values > JD_FROM, values - JD_OF_MJD, values)
        if unit == "d" or (np.nanmin(values, initial=np.inf) > MJD_FROM and unit not in ("yr", "a")):
            values = 2000.0 + (values - 51544.5) / 365.25
        return values

    def _of_dates(self, name: str) -> Array:
        from astropy.time import Time

        texts = self.text(name)
        found = np.full(len(texts), np.nan)
        for row in np.flatnonzero(~missing_values(self.table[name]) & ~np.isin(texts, ("", "--", "None"))):
            try:
                with warnings.catch_warnings():  # astropy warns of years whose leap seconds are not known
                    warnings.simplefilter("ignore")
                    found[row] = Time(texts[row].removesuffix("Z")).jyear
            except ValueError:
                said = f"row {row + 1} has {str(texts[row])!r}"
                self.problems.append(f"column {name!r} is text that is no date like 2015-06-01 or J2015.5: {said}")
                break
        return found

    def text(self, name: str) -> NDArray[np.str_]:
        """Return a column of names, integers too, as text."""
        column = self.table[name]
        if self.kind(name) in "iu" and not np.any(np.ma.getmaskarray(column)):
            return np.asarray(column).astype(np.str_)  # fast for millions of source_id
        return np.array([" ".join(_written(v).split()) for v in column])

    def _first_text(self, name: str) -> str:
        """Return a clause about the first text of a column that is not a number, or else about its first row."""
        if self.kind(name) not in "USO" or np.ndim(self.table[name]) != 1:
            return ""
        texts = [str(text) for text in self.text(name)]
        row = next((row for row, text in enumerate(texts) if text not in MISSING and not _is_number(text)), 0)
        return f"row {row + 1} has the text {texts[row]!r}" if texts else ""

    def check(self, bad: Flags, what: str) -> None:
        """Record what is wrong with the rows where ``bad`` is true."""
        rows = np.flatnonzero(bad)
        if len(rows):
            self.problems.append(f"{what} in {named_rows(rows)}")

    def listed(self) -> str:
        """Return the names of the first columns."""
        return first_of(list(self.table.colnames), 20)


def _written(value: Any) -> str:
    """Return a name as text; whole numbers are the same whether they were stored as integers or not."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    if isinstance(value, (float, np.floating)) and float(value).is_integer() and abs(float(value)) < 2.0**53:
        return str(int(value))
    return str(value)


def _is_number(text: str) -> bool:
    try:
        return not np.isnan(float(text))
    except ValueError:
        return False


def _like_hours(ra: Array) -> bool:
    """Return whether numbers without a unit may be hours: ten or more within 0 to 24, over more than half of it."""
    known = ra[np.isfinite(ra)]
    return len(known) >= 10 and known.min() >= 0.0 and known.max() <= 24.0 and bool(np.ptp(known) > 12.0)
