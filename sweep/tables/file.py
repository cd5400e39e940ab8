"""A table in a file as the value of a parameter: known by its content, read where it is needed."""

import hashlib
import json
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from linksweep.sweep.contract import Array, Named, SweepError
from linksweep.sweep.tables.cds import readme_of
from linksweep.sweep.tables.columns import column_values, in_time, rows_listed
from linksweep.sweep.tables.names import first_found
from linksweep.sweep.tables.reader import read_table

NAMES = ("name", "main_id", "object", "source_name", "iers", "designation", "id", "source_id", "hip", "tyc")
"""Columns that name a row, in upper or lower case, best first."""


@dataclass(frozen=True)
class TableFile:
    """A table file and the SHA-256 of its content, which is what identifies a point that uses it."""

    path: str
    digest: str

    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(_load(self).colnames)

    def label(self, row: int) -> str:
        """Return the name of a row, counted from 0, from the first column of `NAMES`; empty where it has none."""
        table = _load(self)
        name = first_found(NAMES, table.colnames)
        return "" if name is None or np.ma.is_masked(table[name][row]) else str(table[name][row]).strip()

    def numbers(self, name: str, unit: str, stated: str | None = None, right_ascension: bool = False) -> Array:
        """Return a column as float64 in ``unit`` as `column_values` does.

        Raises SweepError as `column_values`, and for missing values, whose rows (counted from 1) it names.
        """
        try:
            values = column_values(_load(self), name, unit, stated, right_ascension)
        except ValueError as error:
            raise SweepError(str(error), self.path) from error
        if not np.all(good := np.isfinite(values)):
            raise SweepError(f"column {name!r} has no finite value in row {rows_listed(~good)}", self.path)
        return values

    def in_time(self, name: str, stated: str | None = None) -> bool:
        """Return whether a column is in units of time, and so does not include the factor cos(dec)."""
        return in_time(_load(self), name, stated)


def table_file(path: Path) -> TableFile:
    """Return the value of a file parameter; raises SweepError where there is no table that can be read."""
    if not path.is_file():
        raise SweepError("no such file", str(path))
    content = hashlib.sha256(path.read_bytes())
    if (readme := readme_of(path)) is not None:
        content.update(readme.read_bytes())
    table = TableFile(str(path.resolve()), content.hexdigest())
    if not len(_load(table)):
        raise SweepError("has no rows", str(path))
    return table


def content_digest(value: object) -> str:
    """Return what stands in a point's identity for a value that JSON does not know: the digest of a table's content or
    of a definition, whatever their names.
    """
    if isinstance(value, TableFile):
        return f"sha256:{value.digest}"
    if isinstance(value, Named):
        return f"sha256:{hashlib.sha256(value.identity.encode()).hexdigest()}"
    raise TypeError(f"{type(value).__name__} is no value of a parameter")


def as_json(value: object) -> str:
    """Return a parameter's value, or a mapping of such, as JSON with sorted keys."""
    if type(value) is float and math.isfinite(value):
        return repr(value)  # the same text in a tenth of the time: tables of points have millions of values
    return json.dumps(value, sort_keys=True, default=content_digest)


@lru_cache(maxsize=4)
def _load(table: TableFile) -> Any:
    """Read a table once in a process: workers evaluate many blocks of the same file."""
    return read_table(Path(table.path))
