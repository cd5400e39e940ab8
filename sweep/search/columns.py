"""Columns of an astropy table as plain arrays in known units, and one list of all that is wrong with them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.core.arrays import Array, Flags, Indices
from linksweep.core.table_catalogue import ALONG_RA
from linksweep.sweep.contract import suggest
from linksweep.sweep.tables.columns import column_values, in_time, missing_values, rows_listed
from linksweep.sweep.tables.names import error_column, first_found, value_column

UNITS: Mapping[str, str] = {
    "ra": "deg",
    "dec": "deg",
    "ra_error": "mas",
    "dec_error": "mas",
    "pmra": "mas / yr",
    "pmdec": "mas / yr",
    "pmra_error": "mas / yr",
    "pmdec_error": "mas / yr",
    "ref_epoch": "yr",
    "vt_mag": "mag",
    "phot_g_mean_mag": "mag",
}
"""The columns that are read, named as in the Gaia archive, and their units where the file gives none."""

TYC = ("TYC1", "TYC2", "TYC3")

NAME = "name"
NAMES = ("name", "objname", "object", "designation", "main_id", "id")
"""Columns that may hold an object's name, in order of preference."""

_MOTIONS_AND_POSITIONS = ("ra", "dec", "pmra", "pmdec")
"""Quantities that, like their errors, are also found under the names of other archives."""

COLUMNS = (*UNITS, *TYC, "TYC", "PGC", "source_id", NAME)


class ColumnReader:
    """Reads columns of one table and collects what is wrong with them."""

    def __init__(self, table: Any, columns: Mapping[str, str], units: Mapping[str, str] | None = None) -> None:
        self.table, self.columns, self.units = table, columns, units or {}
        self.problems: list[str] = []
        for key, column in columns.items():
            if key not in COLUMNS:
                self.problems.append(f"column map {key}={column}: there is no quantity {key!r}{suggest(key, COLUMNS)}")
            elif column not in table.colnames:
                self.problems.append(
                    f"column map {key}={column}: no column {column!r}{suggest(column, table.colnames)}"
                )

    def column(self, key: str) -> str:
        """Return the name of the column of a quantity, whether or not the table has it."""
        if key in self.columns:
            return self.columns[key]
        names = self.table.colnames
        if key in _MOTIONS_AND_POSITIONS:
            found = value_column(key, names)
        elif (quantity := key.removesuffix("_error")) != key:
            found = error_column(quantity, names, value_column(quantity, names))
        else:
            found = first_found(NAMES if key == NAME else (key,), names)
        return found or key

    def has(self, key: str) -> bool:
        """Return whether the table has the column of a quantity."""
        return self.column(key) in self.table.colnames

    def label(self, key: str) -> str:
        """Return the name of a quantity for messages, with that of its column if the two differ."""
        column = self.column(key)
        return key if column == key else f"{key} (column {column!r})"

    def check(self, bad: Flags, what: str, values: NDArray[Any] | None = None) -> None:
        """Record what is wrong with the rows where ``bad`` is true; their ``values`` are shown."""
        if bad.any():
            rows, have = ("rows", "have") if np.count_nonzero(bad) > 1 else ("row", "has")
            self.problems.append(f"{rows} {rows_listed(bad, values)} {have} {what}")

    def require(self, key: str, hint: str = "") -> bool:
        """Return whether the table has the column of a quantity, and record a problem if it does not."""
        there = self.has(key)
        if not there and key not in self.columns:  # `__init__` has reported a column of the map
            self.problems.append(f"no column {key!r}{suggest(key, self.table.colnames)}{hint}")
        return there

    def number(self, key: str, may_miss: bool = False) -> Array | None:
        """Return a column as float64 in its unit of `UNITS`, NaN where it is missing."""
        column, stated = self.column(key), self.units.get(key)
        try:
            numbers = column_values(self.table, column, UNITS[key], stated, key in ALONG_RA)
        except ValueError as error:
            self.problems.append(f"{error}" if column == key else f"{key}: {error}")
            return None
        if not may_miss:
            self.check(np.isnan(numbers), f"no {self.label(key)}")
        self.check(np.isinf(numbers), f"an infinite {self.label(key)}")
        return numbers

    def in_time(self, key: str) -> bool:
        """Return whether a column is in units of time, so that it does not include cos(dec)."""
        return in_time(self.table, self.column(key), self.units.get(key))

    def integer(self, key: str, may_miss: bool = False) -> Indices | None:
        """Return a column of integers, 0 where it is missing."""
        column = self.table[self.column(key)]
        values = self._plain(key, column, "iuf")
        if values is None:
            return None
        missing = missing_values(column)
        if values.dtype.kind == "f":
            whole = np.where(missing, 0.0, values)
            fraction = ~(np.abs(whole) < 2.0**53) | (whole != np.floor(whole))
            self.check(fraction, f"a {self.label(key)} that is no integer")
            values = np.where(fraction, 0.0, whole)
        integers = values.astype(np.int64)
        integers[missing] = 0
        if not may_miss:
            self.check(missing, f"no {self.label(key)}")
        return integers

    def text(self, key: str) -> NDArray[np.str_] | None:
        """Return a column of strings or integers as strings, '' where it is missing."""
        column = self.table[self.column(key)]
        values = self._plain(key, column, "USOiu")
        if values is None:
            return None
        missing = missing_values(column).tolist()
        texts = ["" if gone else _as_text(value) for value, gone in zip(values.tolist(), missing, strict=True)]
        return np.array(texts, dtype=np.str_)

    def _plain(self, key: str, column: Any, kinds: str) -> NDArray[Any] | None:
        """Return a column's values; record a problem and return None if they are not of these kinds, one per row."""
        dtype = getattr(column, "dtype", None)
        if dtype is None or dtype.kind not in kinds or column.ndim != 1:
            kind = type(column).__name__ if dtype is None else f"{dtype}, {getattr(column, 'ndim', 0)}-dimensional"
            wanted = "strings" if "U" in kinds else "numbers"
            self.problems.append(f"{self.label(key)} is not a column of {wanted} but of {kind}")
            return None
        return np.asarray(np.ma.getdata(getattr(column, "data", column)))


def _as_text(value: Any) -> str:
    return (value.decode("ascii", "replace") if isinstance(value, bytes) else str(value)).strip()
