"""Epochs of a table as Julian years: years, MJD, JD, dates and times."""

import warnings

import numpy as np

from core.arrays import Array
from sweep.tables.columns import missing_values
from sweep.tie.column_reader import ColumnReader

MJD_FROM = 15000.0
"""Numbers above are modified Julian dates, and those above `JD_FROM` Julian dates."""

JD_FROM, JD_OF_MJD = 2.3e6, 2400000.5


def julian_years(reader: ColumnReader, name: str) -> Array:
    """Return a column of epochs as Julian years, NaN where it is missing: years, MJD, JD, dates and times."""
    from astropy.time import Time

    column = reader.table[name]
    if isinstance(column, Time):
        return np.asarray(np.ma.filled(np.ma.asarray(column.jyear), np.nan), dtype=np.float64)
    if reader.kind(name) in "USO" and np.ndim(column) == 1:
        return _of_dates(reader, name)
    values, unit = reader.numbers(name), str(column.unit)
    values = np.where(values > JD_FROM, values - JD_OF_MJD, values)
    if unit == "d" or (np.nanmin(values, initial=np.inf) > MJD_FROM and unit not in ("yr", "a")):
        values = 2000.0 + (values - 51544.5) / 365.25
    return values


def _of_dates(reader: ColumnReader, name: str) -> Array:
    from astropy.time import Time

    texts = reader.text(name)
    found = np.full(len(texts), np.nan)
    for row in np.flatnonzero(~missing_values(reader.table[name]) & ~np.isin(texts, ("", "--", "None"))):
        try:
            with warnings.catch_warnings():  # of years without leap seconds
                warnings.simplefilter("ignore")
                found[row] = Time(texts[row].removesuffix("Z")).jyear
        except ValueError:
            said = f"row {row + 1} has {str(texts[row])!r}"
            reader.problems.append(f"column {name!r} is text that is no date like 2015-06-01 or J2015.5: {said}")
            break
    return found
