"""Star and galaxy tables from files: Gaia's column names and units, and one error that lists all that is wrong."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from linksweep.core.arrays import Array, Indices
from linksweep.core.constants import DEGREE
from linksweep.core.table_catalogue import ALONG_RA
from linksweep.sweep.contract import SweepError
from linksweep.sweep.search.columns import NAME, TYC, ColumnReader
from linksweep.sweep.tables.reader import read_table

MAGNITUDES = ("vt_mag", "phot_g_mean_mag")
"""The columns of magnitudes, best first."""

TYC_LIMITS = {"TYC1": 9537, "TYC2": 12121, "TYC3": 3}
"""Largest values.  Source: Hog et al. 2000, the Tycho-2 catalogue (CDS I/259), notes on TYC1-3."""

EPOCHS = (1700.0, 2300.0)

_TYC_TEXT = re.compile(r"\s*(?:TYC\s*)?(\d{1,9})-(\d{1,9})-(\d{1,9})\s*", re.ASCII)


@dataclass(frozen=True)
class Reading:
    """How one table is read: names of its columns, units that it does not give, and values in place of a column.

    ``error_arcsec`` is the error of each coordinate, ``ref_epoch`` (yr) the epoch of all positions.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    error_arcsec: float | None = None
    ref_epoch: float | None = None
    missing_pm: Literal["error", "zero"] = "error"


@dataclass(frozen=True)
class SkyTable:
    """A table of N objects: columns in the units of `UNITS`, each of shape (N,).

    ``numbers`` has the columns of `UNITS` that the table has; NaN is a missing magnitude or proper motion; nothing
    else may be missing.  ``tyc`` is (N, 3), ``pgc`` 0 where there is none, ``source_id`` Gaia's identifier, ``names``
    are those of galaxies, '' where there is none.
    """

    path: Path
    name: str
    numbers: Mapping[str, Array]
    tyc: Indices | None
    pgc: Indices
    source_id: Indices | None
    names: NDArray[np.str_] | None

    def __len__(self) -> int:
        return len(self.numbers["ra"])


def table_name(path: Path) -> str:
    """Return the name of a table in options: its file name up to the first dot."""
    return path.name.split(".")[0]


def read_stars(path: Path, reading: Reading | None = None) -> SkyTable:
    """Return a star table: ra, dec and their errors, any proper motions and their epoch, magnitudes, identifiers.

    Raises SweepError with all problems: missing or unusable columns and units, rows without a value or with an
    impossible one, repeated identifiers.
    """
    return _read(path, reading or Reading(), stars=True)


def read_galaxies(path: Path, reading: Reading | None = None) -> SkyTable:
    """Return a galaxy table: ra, dec, their errors and PGC numbers; raises SweepError as `read_stars`.

    Proper motions are not read: galaxies do not move, and measured motions are noise.
    """
    return _read(path, reading or Reading(), stars=False)


def _read(path: Path, reading: Reading, stars: bool) -> SkyTable:
    table = read_table(path)
    reader = ColumnReader(table, reading.columns, reading.units)
    if len(table) == 0:
        raise SweepError("has no rows", str(path))
    numbers = _positions(reader, reading)
    tyc = source_id = names = None
    pgc: Indices = np.zeros(len(table), dtype=np.int64)
    if stars:
        _add_motions(numbers, reader, reading)
        for key in MAGNITUDES:
            if reader.has(key) and (magnitude := reader.number(key, may_miss=True)) is not None:
                numbers[key] = magnitude
        tyc = _tyc(reader)
        source_id = reader.integer("source_id") if reader.has("source_id") else None
    else:
        if reader.has("PGC") and (found := reader.integer("PGC", may_miss=True)) is not None:
            reader.check(found < 0, "a negative PGC number", found)
            pgc = found
        names = reader.text(NAME) if reader.has(NAME) else None
    if reader.problems:
        raise SweepError(reader.problems, str(path))
    return SkyTable(path, table_name(path), numbers, tyc, pgc, source_id, names)


def _positions(reader: ColumnReader, reading: Reading) -> dict[str, Array]:
    numbers: dict[str, Array] = {}
    for key in ("ra", "dec"):
        if reader.require(key) and (values := reader.number(key)) is not None:
            numbers[key] = values
    if "ra" in numbers:
        reader.check((numbers["ra"] < 0.0) | (numbers["ra"] > 360.0), "an ra outside 0..360 deg", numbers["ra"])
    if "dec" in numbers:
        swapped = "; are ra and dec swapped?" if np.all(np.abs(numbers.get("ra", 360.0)) <= 90.0) else ""
        reader.check(np.abs(numbers["dec"]) > 90.0, f"a dec outside -90..90 deg{swapped}", numbers["dec"])
    keys = ("ra_error", "dec_error")
    if reading.error_arcsec is not None:
        return {**numbers, **{key: np.full(len(reader.table), 1000.0 * reading.error_arcsec) for key in keys}}
    for key in keys:
        there = reader.require(key, "; or give its error in arcsec with --error")
        if there and (values := reader.number(key)) is not None:
            reader.check(values <= 0.0, f"a {reader.label(key)} that is not above 0", values)
            numbers[key] = _with_cos_dec(reader, key, values, numbers)
    return numbers


def _with_cos_dec(reader: ColumnReader, key: str, values: Array, numbers: Mapping[str, Array]) -> Array:
    """Return the values of a column, times cos(dec) if it is along ra and in units of time, which lack it."""
    if key not in ALONG_RA or not reader.in_time(key) or "dec" not in numbers:
        return values
    return np.asarray(values * np.cos(numbers["dec"] * DEGREE))


def _add_motions(numbers: dict[str, Array], reader: ColumnReader, reading: Reading) -> None:
    """Add the proper motions, NaN in rows that lack one of them, and the epoch of the positions."""
    has_motions = reader.has("pmra") or reader.has("pmdec")
    if has_motions:
        values = {key: reader.number(key, may_miss=True) for key in ("pmra", "pmdec") if reader.require(key)}
        errors = {
            key: reader.number(key, may_miss=True)
            for key in ("pmra_error", "pmdec_error")
            if reader.has(key) or key in reader.columns
        }
        missing = np.zeros(len(reader.table), dtype=bool)
        for column in values.values():
            if column is not None:
                missing |= np.isnan(column)
        for key, column in (values | errors).items():
            if column is not None:
                if key in errors:
                    reader.check(column < 0.0, f"a negative {reader.label(key)}", column)
                    reader.check(np.isnan(column) & ~missing, f"no {reader.label(key)}")
                numbers[key] = np.where(missing, np.nan, _with_cos_dec(reader, key, column, numbers))
        if reading.missing_pm == "error":
            reader.check(missing, "no proper motion (--missing-pm zero takes it as zero)")
    if reading.ref_epoch is not None:
        numbers["ref_epoch"] = np.full(len(reader.table), reading.ref_epoch)
    elif reader.has("ref_epoch"):
        if (epoch := reader.number("ref_epoch")) is not None:
            low, high = EPOCHS
            outside = (epoch < low) | (epoch > high)
            reader.check(outside, f"a ref_epoch that is no Julian year ({low:g}..{high:g})", epoch)
            numbers["ref_epoch"] = epoch
    elif has_motions:
        reader.require("ref_epoch", "; proper motions need the epoch of the positions, e.g. --ref-epoch NAME=2000")


def _tyc(reader: ColumnReader) -> Indices | None:
    import pandas as pd

    parts = [key for key in TYC if reader.has(key)]
    if parts:
        columns = [reader.integer(key) for key in TYC if reader.require(key)]
    elif reader.has("TYC") and (texts := reader.text("TYC")) is not None:
        found = [_TYC_TEXT.fullmatch(text) for text in texts]
        bad = np.array([match is None for match in found])
        reader.check(bad, f"a {reader.label('TYC')} that is no Tycho identifier like '1-13-1'")
        if bad.any():
            return None
        columns = list(np.array([match.groups() for match in found if match], dtype=np.int64).T)
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
        again = pd.Index(tyc_code(tyc)).duplicated()
        reader.check(again, "the Tycho identifier of an earlier row")
    return tyc


def tyc_code(tyc: Indices) -> Indices:
    """Return one number for each Tycho identifier; (N, 3) becomes (N,)."""
    return np.asarray(tyc @ np.array([1_000_000, 10, 1]))
