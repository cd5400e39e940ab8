"""Star and galaxy tables from files: Gaia's column names and units, and one error that lists all that is wrong."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sweep.contract import SweepError, suggest
from sweep.tablefile import read_astropy_table

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

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
"""The columns that are read, as in the Gaia archive, and the units they have where the file does not say."""

MAGNITUDES = ("vt_mag", "phot_g_mean_mag")
TYC = ("TYC1", "TYC2", "TYC3")
TYC_LIMITS = {"TYC1": 9537, "TYC2": 12121, "TYC3": 3}
"""Largest values.  Source: Hog et al. 2000, the Tycho-2 catalogue (CDS I/259), notes on TYC1-3."""

COLUMNS = (*UNITS, *TYC, "TYC", "PGC", "source_id")
ROWS_NAMED = 5
EPOCHS = (1700.0, 2300.0)
_TYC_TEXT = re.compile(r"\s*(?:TYC\s*)?(\d{1,9})-(\d{1,9})-(\d{1,9})\s*", re.ASCII)


@dataclass(frozen=True)
class Reading:
    """How one table is read: columns with another name, and values to take instead of a column.

    ``error_arcsec`` is the error of each coordinate, ``ref_epoch`` (yr) the epoch of all positions.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    error_arcsec: float | None = None
    ref_epoch: float | None = None
    missing_pm: Literal["error", "zero"] = "error"


@dataclass(frozen=True)
class SkyTable:
    """A table of N objects: columns in the units of `UNITS`, each of shape (N,).

    ``numbers`` has the columns of `UNITS` that the table has; NaN is a missing magnitude or proper motion, nothing else
    is missing.  ``tyc`` is (N, 3), ``pgc`` 0 where there is none, ``source_id`` Gaia's identifier.  ``n_missing_pm``
    rows have no proper motion.
    """

    path: Path
    name: str
    numbers: Mapping[str, Array]
    tyc: Indices | None
    pgc: Indices | None
    source_id: Indices | None
    n_missing_pm: int = 0

    def __len__(self) -> int:
        return len(self.numbers["ra"])

    @property
    def magnitude(self) -> str | None:
        """Name of the magnitude that is used: vt_mag before phot_g_mean_mag."""
        return next((name for name in MAGNITUDES if name in self.numbers), None)


def table_name(path: Path) -> str:
    """Return the name by which options call a table: its file name up to the first dot."""
    return path.name.split(".")[0]


def read_stars(path: Path, reading: Reading | None = None) -> SkyTable:
    """Return a star table: ra, dec and their errors, proper motions with an epoch or none, magnitudes, identifiers.

    Raises SweepError with all that is wrong: a column or unit that is missing or strange, rows without a value or
    with an impossible one, an identifier twice.
    """
    return _read(path, reading or Reading(), ("pmra", "pmdec", "pmra_error", "pmdec_error", "ref_epoch", *MAGNITUDES))


def read_galaxies(path: Path, reading: Reading | None = None) -> SkyTable:
    """Return a galaxy table: ra, dec, their errors and PGC numbers; raises SweepError as `read_stars`.

    Proper motions are not read: a galaxy has none, a measured one is noise.
    """
    return _read(path, reading or Reading(), ())


def rows_text(bad: Flags, what: str) -> str:
    """Return 'row 3 has ...' or 'rows 3, 5 and 7 more have ...' for the rows (counted from 1) where ``bad`` holds."""
    rows = np.flatnonzero(bad) + 1
    shown = ", ".join(str(row) for row in rows[:ROWS_NAMED])
    more = f" and {len(rows) - ROWS_NAMED} more" if len(rows) > ROWS_NAMED else ""
    return f"row{'s' if len(rows) > 1 else ''} {shown}{more} {'have' if len(rows) > 1 else 'has'} {what}"


class _Reader:
    """Reads columns of one table and collects what is wrong with them."""

    def __init__(self, table: Any, columns: Mapping[str, str]) -> None:
        self.table, self.columns = table, columns
        self.problems: list[str] = []
        for key, column in columns.items():
            if key not in COLUMNS:
                self.problems.append(f"column map {key}={column}: there is no quantity {key!r}{suggest(key, COLUMNS)}")
            elif column not in table.colnames:
                self.problems.append(
                    f"column map {key}={column}: no column {column!r}{suggest(column, table.colnames)}"
                )

    def has(self, key: str) -> bool:
        return self.columns.get(key, key) in self.table.colnames

    def label(self, key: str) -> str:
        column = self.columns.get(key, key)
        return key if column == key else f"{key} (column {column!r})"

    def check(self, bad: Flags, what: str) -> None:
        if bad.any():
            self.problems.append(rows_text(bad, what))

    def require(self, key: str, hint: str = "") -> bool:
        if not self.has(key):
            column = self.columns.get(key, key)
            if key not in self.columns:
                self.problems.append(f"no column {column!r}{suggest(column, self.table.colnames)}{hint}")
            return False
        return True

    def number(self, key: str, may_miss: bool = False) -> Array | None:
        """Return a column as float64 in its unit of `UNITS`, NaN where it is missing."""
        from astropy import units

        column = self.table[self.columns.get(key, key)]
        values = self._plain(key, column, "fiub")
        if values is None:
            return None
        numbers = values.astype(np.float64)
        unit = getattr(column, "unit", None)
        if unit is not None:
            try:
                factor = units.Unit(unit).to(units.Unit(UNITS[key]))
            except (units.UnitsError, TypeError, ValueError) as error:
                self.problems.append(f"{self.label(key)} is in {str(unit)!r}, which is no {UNITS[key]!r}: {error}")
                return None
            numbers = numbers if factor == 1.0 else numbers * factor
        missing = np.isnan(numbers) | self._mask(column)
        numbers[missing] = np.nan
        if not may_miss:
            self.check(missing, f"no {self.label(key)}")
        self.check(np.isinf(numbers), f"an infinite {self.label(key)}")
        return numbers

    def integer(self, key: str, may_miss: bool = False) -> Indices | None:
        """Return a column of integers, 0 where it is missing."""
        column = self.table[self.columns.get(key, key)]
        values = self._plain(key, column, "iuf")
        if values is None:
            return None
        missing = self._mask(column)
        if values.dtype.kind == "f":
            missing = missing | np.isnan(values)
            whole = np.where(missing, 0.0, values)
            fraction = ~(np.abs(whole) < 2.0**53) | (whole != np.floor(whole))
            self.check(fraction, f"a {self.label(key)} that is no integer")
            values = np.where(fraction, 0.0, whole)
        integers = values.astype(np.int64)
        integers[missing] = 0
        if not may_miss:
            self.check(missing, f"no {self.label(key)}")
        return integers

    def text(self, key: str) -> list[str] | None:
        """Return a column of strings, '' where it is missing."""
        column = self.table[self.columns.get(key, key)]
        values = self._plain(key, column, "USO")
        if values is None:
            return None
        missing = self._mask(column)
        return ["" if gone else _as_text(value) for value, gone in zip(values.tolist(), missing.tolist(), strict=True)]

    def _plain(self, key: str, column: Any, kinds: str) -> NDArray[Any] | None:
        """Return a column's values, or None and a problem if they are not of these kinds, one a row."""
        dtype = getattr(column, "dtype", None)
        if dtype is None or dtype.kind not in kinds or column.ndim != 1:
            kind = type(column).__name__ if dtype is None else f"{dtype}, {getattr(column, 'ndim', 0)}-dimensional"
            wanted = "strings" if "U" in kinds else "numbers"
            self.problems.append(f"{self.label(key)} is not a column of {wanted} but of {kind}")
            return None
        return (
            np.asarray(getattr(column, "data", column)) if not hasattr(column, "mask") else np.ma.getdata(column.data)
        )

    def _mask(self, column: Any) -> Flags:
        return np.broadcast_to(np.asarray(getattr(column, "mask", False), dtype=bool), (len(self.table),))


def _read(path: Path, reading: Reading, optional: Sequence[str]) -> SkyTable:
    table = read_astropy_table(path)
    reader = _Reader(table, reading.columns)
    if len(table) == 0:
        raise SweepError("has no rows", str(path))
    numbers = _positions(reader, reading)
    missing_pm = _motions(reader, reading, numbers) if "pmra" in optional else 0
    for key in MAGNITUDES:
        if key in optional and reader.has(key) and (magnitude := reader.number(key, may_miss=True)) is not None:
            numbers[key] = magnitude
    tyc = _tyc(reader) if optional else None
    pgc = None if optional else _optional_integer(reader, "PGC", may_miss=True)
    source_id = _optional_integer(reader, "source_id") if optional else None
    if pgc is not None:
        reader.check(pgc < 0, "a negative PGC number")
    if reader.problems:
        raise SweepError(reader.problems, str(path))
    return SkyTable(path, table_name(path), numbers, tyc, pgc, source_id, missing_pm)


def _positions(reader: _Reader, reading: Reading) -> dict[str, Array]:
    numbers: dict[str, Array] = {}
    for key in ("ra", "dec"):
        if reader.require(key) and (values := reader.number(key)) is not None:
            numbers[key] = values
    if "ra" in numbers:
        reader.check((numbers["ra"] < 0.0) | (numbers["ra"] > 360.0), "an ra outside 0..360 deg")
    if "dec" in numbers:
        reader.check(np.abs(numbers["dec"]) > 90.0, "a dec outside -90..90 deg")
    keys = ("ra_error", "dec_error")
    if reading.error_arcsec is not None:
        return {**numbers, **{key: np.full(len(reader.table), 1000.0 * reading.error_arcsec) for key in keys}}
    for key in keys:
        if reader.require(key, "; or give its error in arcsec with --error") and (
            (values := reader.number(key)) is not None
        ):
            reader.check(values <= 0.0, f"a {reader.label(key)} that is not above 0")
            numbers[key] = values
    return numbers


def _motions(reader: _Reader, reading: Reading, numbers: dict[str, Array]) -> int:
    """Read proper motions and epoch into ``numbers``; return how many rows have no proper motion."""
    motions, n_missing = [key for key in ("pmra", "pmdec") if reader.has(key)], 0
    if motions:
        values = {key: reader.number(key, may_miss=True) for key in ("pmra", "pmdec") if reader.require(key)}
        errors = {
            key: reader.number(key, may_miss=True)
            for key in ("pmra_error", "pmdec_error")
            if reader.has(key) or key in reader.columns
        }
        missing = np.zeros(len(reader.table), dtype=bool)
        for key, column in values.items():
            if column is not None:
                numbers[key] = column
                missing |= np.isnan(column)
        for key, column in errors.items():
            if column is not None:
                reader.check(column < 0.0, f"a negative {reader.label(key)}")
                reader.check(np.isnan(column) & ~missing, f"no {reader.label(key)}")
                numbers[key] = np.where(missing, np.nan, column)
        n_missing = int(missing.sum())
        if reading.missing_pm == "error":
            reader.check(missing, "no proper motion (--missing-pm zero takes it as zero)")
        for key in motions:
            if key in numbers:
                numbers[key][missing] = np.nan
    _epoch(reader, reading, numbers, needed=bool(motions))
    return n_missing


def _epoch(reader: _Reader, reading: Reading, numbers: dict[str, Array], needed: bool) -> None:
    if reading.ref_epoch is not None:
        numbers["ref_epoch"] = np.full(len(reader.table), reading.ref_epoch)
    elif reader.has("ref_epoch"):
        if (epoch := reader.number("ref_epoch")) is not None:
            low, high = EPOCHS
            reader.check((epoch < low) | (epoch > high), f"a ref_epoch that is no Julian year ({low:g}..{high:g})")
            numbers["ref_epoch"] = epoch
    elif needed:
        reader.require("ref_epoch", "; proper motions need the epoch of the positions, e.g. --ref-epoch NAME=2000")


def _tyc(reader: _Reader) -> Indices | None:
    parts = [key for key in TYC if reader.has(key)]
    if parts:
        columns = [reader.integer(key) for key in TYC if reader.require(key)]
    elif reader.has("TYC") and (texts := reader.text("TYC")) is not None:
        parsed = np.array([_parse_tyc(text) for text in texts], dtype=np.int64)
        bad = parsed[:, 0] < 0
        reader.check(bad, f"a {reader.label('TYC')} that is no Tycho identifier like '1-13-1'")
        if bad.any():
            return None
        columns = list(parsed.T)
    else:
        return None
    good = [column for column in columns if column is not None]
    if len(good) < len(TYC):
        return None
    tyc = np.stack(good, axis=1)
    n_problems = len(reader.problems)
    for key, column in zip(TYC, good, strict=True):
        limit = TYC_LIMITS[key]
        reader.check((column < 1) | (column > limit), f"a {reader.label(key)} outside 1..{limit}")
    if len(reader.problems) == n_problems:
        reader.check(_repeated(tyc), "a Tycho identifier that stands in the table before")
    return tyc


def _parse_tyc(text: str) -> tuple[int, int, int]:
    """Return the three numbers of '1-13-1' or 'TYC 1-13-1', negative ones if it is nothing like that."""
    match = _TYC_TEXT.fullmatch(text)
    return (int(match[1]), int(match[2]), int(match[3])) if match else (-1, -1, -1)


def _repeated(tyc: Indices) -> Flags:
    code = (tyc[:, 0] * 100_000 + tyc[:, 1]) * 10 + tyc[:, 2]
    first = np.zeros(len(code), dtype=bool)
    first[np.unique(code, return_index=True)[1]] = True
    return np.asarray(~first)


def _optional_integer(reader: _Reader, key: str, may_miss: bool = False) -> Indices | None:
    return reader.integer(key, may_miss) if reader.has(key) else None


def _as_text(value: Any) -> str:
    return value.decode("ascii", "replace") if isinstance(value, bytes) else str(value)


def per_table(
    option: str, values: Sequence[str], names: Sequence[str], common_for: Sequence[str], convert: Callable[[str], float]
) -> dict[str, float]:
    """Return {name: value} of an option that is given as NAME=VALUE for one of ``names``, or VALUE for ``common_for``.

    Raises SweepError for an unknown name, a value that ``convert`` refuses with ValueError, or one given twice.
    """
    found: dict[str, float] = {}
    problems: list[str] = []
    for text in values:
        name, equals, value = text.rpartition("=")
        if equals and name not in names:
            problems.append(f"{option} {text}: no table {name!r}{suggest(name, names)}")
        elif name in found:
            problems.append(f"{option} {text}: given twice{f' for {name!r}' if name else ' without a table'}")
        else:
            try:
                found[name] = convert(value)
            except ValueError as error:
                problems.append(f"{option} {text}: {error}")
    if problems:
        raise SweepError(problems)
    common = found.pop("", None)
    return found if common is None else {**dict.fromkeys(common_for, common), **found}
