"""A table in a file as the value of a parameter: known by its content, read where it is needed."""

import hashlib
import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from linksweep.sweep.contract import Named, SweepError
from linksweep.sweep.tables.columns import Columns, column_of
from linksweep.sweep.tables.reader import read_table, readme_of


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


def sorted_json(value: object) -> str:
    """Return a parameter's value, or a mapping of such, as JSON with sorted keys."""
    if type(value) is float and math.isfinite(value):
        return repr(value)  # the same text in a tenth of the time: tables of points have millions of values
    return json.dumps(value, sort_keys=True, default=content_digest)


@lru_cache(maxsize=4)
def _load(table: TableFile) -> Any:
    """Read a table once in a process: workers evaluate many blocks of the same file."""
    return read_table(Path(table.path))
