"""A table in a file as the value of a parameter: known by its content, read by astropy where it is needed."""

import hashlib
import json
import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.contract import Named, SweepError

Array = NDArray[np.float64]

FORMATS = {
    ".ecsv": "ascii.ecsv",
    ".csv": "ascii.csv",
    ".fits": "fits",
    ".fit": "fits",
    ".vot": "votable",
    ".xml": "votable",
    ".mrt": "ascii.mrt",
    ".parquet": "parquet",
    ".dat": "ascii.cds",
}
"""The astropy format of each file ending; a further .gz is allowed.  A .dat has its CDS ReadMe beside it."""

NAMES = ("name", "main_id", "object", "source_name", "iers", "designation", "id", "source_id", "hip", "tyc")
"""Columns that name a row, in any case of letters, best first."""

ROWS_NAMED = 5


@dataclass(frozen=True)
class TableFile:
    """A table file and the SHA-256 of its content, which is what identifies a point that uses it."""

    path: str
    digest: str

    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(_load(self).colnames)

    def label(self, row: int) -> str:
        """Return what the table calls a row, counted from 0, by the first of `NAMES`; empty where it has none."""
        table = _load(self)
        known = {column.lower(): column for column in table.colnames}
        name = next((known[name] for name in NAMES if name in known), None)
        return "" if name is None or np.ma.is_masked(table[name][row]) else str(table[name][row]).strip()

    def numbers(self, name: str, unit: str) -> Array:
        """Return a column as float64 in ``unit`` (that of the file is converted; none is taken for granted).

        Raises SweepError for an unknown column, one of text, another kind of unit, or missing values, whose rows
        (counted from 1) it names.
        """
        from astropy import units

        table = _load(self)
        if name not in table.colnames:
            raise SweepError(f"no column {name!r}; there are {', '.join(table.colnames)}", self.path)
        column = table[name]
        if getattr(column, "dtype", np.dtype(object)).kind not in "fiu" or column.ndim != 1:
            raise SweepError(f"column {name!r} does not hold numbers", self.path)
        values = np.ma.filled(np.ma.asarray(getattr(column, "value", column)).astype(np.float64), np.nan)
        bad = np.flatnonzero(~np.isfinite(values)) + 1
        if len(bad):
            more = f" and {len(bad) - ROWS_NAMED} more" if len(bad) > ROWS_NAMED else ""
            listed = ", ".join(map(str, bad[:ROWS_NAMED]))
            raise SweepError(f"column {name!r} has no finite value in row {listed}{more}", self.path)
        if column.unit is None:
            return values
        try:
            return np.asarray(values * units.Unit(column.unit).to(unit))
        except (units.UnitsError, ValueError, TypeError) as error:
            raise SweepError(f"column {name!r} is in {column.unit}, not convertible to {unit}", self.path) from error


def table_file(path: Path) -> TableFile:
    """Return the value of a file parameter; raises SweepError where there is no table that can be read."""
    if not path.is_file():
        raise SweepError("no such file", str(path))
    content = hashlib.sha256(path.read_bytes())
    if _format(path) == "ascii.cds":
        if not (path.parent / "ReadMe").is_file():
            raise SweepError("a CDS table needs its ReadMe beside it", str(path))
        content.update((path.parent / "ReadMe").read_bytes())
    table = TableFile(str(path.resolve()), content.hexdigest())
    if not len(_load(table)):
        raise SweepError("has no rows", str(path))
    return table


def read_astropy_table(path: Path) -> Any:
    """Return the astropy Table in a file; raises SweepError where there is none that can be read."""
    file_format = _format(path)
    if not path.is_file():
        raise SweepError("no such file", str(path))
    from astropy.table import Table

    options = {"readme": str(path.parent / "ReadMe")} if file_format == "ascii.cds" else {}
    try:
        with warnings.catch_warnings():  # of units and headers that do not matter for the columns that are used
            warnings.simplefilter("ignore")
            return Table.read(path, format=file_format, **options)
    except Exception as error:  # each of astropy's readers has its own
        text = " ".join(str(error).split())[:300]
        raise SweepError(f"cannot be read as {file_format}: {type(error).__name__}: {text}", str(path)) from error


def content_digest(value: object) -> str:
    """Return what stands for a value that JSON does not know, in a point's identity: the content of a table or of a
    definition, whatever their names.
    """
    if isinstance(value, TableFile):
        return f"sha256:{value.digest}"
    if isinstance(value, Named):
        return f"sha256:{hashlib.sha256(value.identity.encode()).hexdigest()}"
    raise TypeError(f"{type(value).__name__} is no value of a parameter")


def as_json(value: object) -> str:
    """Return a parameter's value, or a mapping of such, as JSON with sorted keys."""
    return json.dumps(value, sort_keys=True, default=content_digest)


def _format(path: Path) -> str:
    suffixes = [suffix.lower() for suffix in path.suffixes if suffix.lower() != ".gz"]
    if not suffixes or suffixes[-1] not in FORMATS:
        raise SweepError(f"cannot tell its format from its name; known endings are {', '.join(FORMATS)}", str(path))
    return FORMATS[suffixes[-1]]


@lru_cache(maxsize=4)
def _load(table: TableFile) -> Any:
    """Read a table once in a process: workers evaluate many blocks of the same file."""
    return read_astropy_table(Path(table.path))
