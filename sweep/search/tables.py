"""Star and galaxy tables from files, in Gaia's names and units, and one error that lists all that is wrong."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from linksweep.core.frames import Array, Indices
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tables.columns import Columns, unit_of
from linksweep.sweep.tables.reader import read_table

MOTIONS = ("pmra", "pmdec", "pmra_error", "pmdec_error")
MAGNITUDES = ("vt_mag", "phot_g_mean_mag")
"""The columns of magnitudes, best first."""

NUMBERS = ("ra", "dec", "ra_error", "dec_error", *MOTIONS, "ref_epoch", *MAGNITUDES)
TYC = ("TYC1", "TYC2", "TYC3")
QUANTITIES = (*NUMBERS, *TYC, "TYC", "PGC", "source_id", "name")
WITH_UNITS = tuple(quantity for quantity in NUMBERS if unit_of(quantity))

TYC_LIMITS = {"TYC1": 9537, "TYC2": 12121, "TYC3": 3}
"""Largest values.  Source: Hog et al. 2000, the Tycho-2 catalogue (CDS I/259), notes on TYC1-3."""

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
    """A table of N objects: columns of `NUMBERS` that it has in deg, mas, mas/yr, yr and mag, each of shape (N,).

    NaN is a missing magnitude or proper motion; nothing else may be missing.  ``tyc`` is (N, 3), ``pgc`` 0 where there
    is none, ``source_id`` Gaia's identifier, ``names`` are those of galaxies, '' where there is none.
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


def read_sky_table(path: Path, reading: Reading, stars: bool) -> SkyTable:
    """Return a table of stars, or of galaxies: ra, dec and their errors; of stars also proper motions and their epoch,
    magnitudes and identifiers, of galaxies PGC numbers and names.

    Proper motions of galaxies are not read: galaxies do not move, and measured motions are noise.  Raises SweepError
    with all problems: missing or unusable columns and units, rows without a value or with an impossible one, repeated
    identifiers.
    """
    read = Columns(read_table(path), str(path), reading.columns, reading.units, QUANTITIES)
    if not len(read):
        raise SweepError("has no rows", str(path))
    numbers = _positions(read, reading.error_arcsec)
    tyc = source_id = names = None
    pgc: Indices = np.zeros(len(read), dtype=np.int64)
    if stars:
        numbers |= _motions(read, reading)
        numbers |= {key: read.quantity(key, "allowed") for key in MAGNITUDES if read.has(key)}
        tyc = _tyc(read)
        source_id = read.integers("source_id") if read.has("source_id") else None
    else:
        if read.has("PGC"):
            pgc = read.integers("PGC", may_miss=True)
            read.check(pgc < 0, "a negative PGC number", pgc)
        names = read.text(str(read.name("name")), missing="") if read.has("name") else None
    read.finish()
    return SkyTable(path, table_name(path), numbers, tyc, pgc, source_id, names)


def _positions(read: Columns, error_arcsec: float | None) -> dict[str, Array]:
    numbers = {key: read.quantity(key) for key in ("ra", "dec") if read.require(key)}
    if len(numbers) == 2:
        ra, dec = numbers["ra"], numbers["dec"]
        read.check((ra < 0.0) | (ra > 360.0), "an ra outside 0..360 deg", ra)
        swapped = "; are ra and dec swapped?" if np.all(np.abs(ra) <= 90.0) else ""
        read.check(np.abs(dec) > 90.0, "a dec outside -90..90 deg", dec, swapped)
    for key in ("ra_error", "dec_error"):
        if error_arcsec is not None:
            numbers[key] = np.full(len(read), 1000.0 * error_arcsec)
        elif read.require(key, "; or give its error in arcsec with --error"):
            numbers[key] = read.quantity(key)
            read.check(numbers[key] <= 0.0, f"a {read.label(key)} that is not above 0", numbers[key])
    return numbers


def _motions(read: Columns, reading: Reading) -> dict[str, Array]:
    """Return the proper motions, NaN in rows that lack one of them, and the epoch of the positions."""
    numbers: dict[str, Array] = {}
    known = len(read.problems)
    has_motions = read.has("pmra") or read.has("pmdec")
    if has_motions and all([read.require("pmra"), read.require("pmdec")]):
        numbers = {key: read.quantity(key, "allowed") for key in MOTIONS if read.has(key)}
        missing = np.isnan(numbers["pmra"]) | np.isnan(numbers["pmdec"])
        for key, values in numbers.items():
            read.check(np.isinf(values), f"an infinite {read.label(key)}")
            if key.endswith("_error"):
                read.check(values < 0.0, f"a negative {read.label(key)}", values)
                read.check(np.isnan(values) & ~missing, f"no {read.label(key)}")
            numbers[key] = np.where(missing, np.nan, values)
        if reading.missing_pm == "error" and len(read.problems) == known:
            read.check(missing, "no proper motion (--missing-pm zero takes it as zero)")
    if reading.ref_epoch is not None:
        numbers["ref_epoch"] = np.full(len(read), reading.ref_epoch)
    elif read.has("ref_epoch"):
        numbers["ref_epoch"] = read.epochs()
    elif has_motions:
        read.require("ref_epoch", "; proper motions need the epoch of the positions, e.g. --ref-epoch NAME=2000")
    return numbers


def _tyc(read: Columns) -> Indices | None:
    """Return the Tycho identifiers from three columns or one of text, None for a table without them."""
    import pandas as pd

    known = len(read.problems)
    if any(read.has(key) for key in TYC):
        columns = [read.integers(key) for key in TYC if read.require(key)]
    elif read.has("TYC"):
        matches = [_TYC_TEXT.fullmatch(text) for text in read.text(str(read.name("TYC")), missing="")]
        bad = np.array([one is None for one in matches])
        read.check(bad, f"a {read.label('TYC')} that is no Tycho identifier like '1-13-1'")
        columns = list(np.array([one.groups() for one in matches if one], dtype=np.int64).reshape(-1, 3).T)
    else:
        return None
    if len(read.problems) > known:
        return None
    tyc = np.stack(columns, axis=1)
    for key, column in zip(TYC, columns, strict=True):
        limit = TYC_LIMITS[key]
        read.check((column < 1) | (column > limit), f"a {read.label(key)} outside 1..{limit}")
    if len(read.problems) == known:
        read.check(pd.Index(tyc_code(tyc)).duplicated(), "the Tycho identifier of an earlier row")
    return tyc


def tyc_code(tyc: Indices) -> Indices:
    """Return one number for each Tycho identifier; (N, 3) becomes (N,)."""
    return np.asarray(tyc @ np.array([1_000_000, 10, 1]))
