"""A search for galaxies in a star catalogue: what to search, from the options of the command line, and its matches."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from linksweep.core.frames import ARCSEC, DEGREE, MAS, Array
from linksweep.sweep.contract import Parameter, SweepError
from linksweep.sweep.search import crossmatch
from linksweep.sweep.search.options import SearchOptions
from linksweep.sweep.tables.columns import EPOCHS, Columns
from linksweep.sweep.tables.options import Pairs, by_table, number
from linksweep.sweep.tables.reader import read_table
from linksweep.sweep.tables.where import conditions, rows_where

DEFAULT_RADIUS_ARCSEC = 5.0

MOTIONS = ("pmra", "pmdec", "pmra_error", "pmdec_error")
MAGNITUDES = ("vt_mag", "phot_g_mean_mag")
"""The columns of magnitudes, best first."""

NUMBERS = ("ra", "dec", "ra_error", "dec_error", *MOTIONS, "ref_epoch", *MAGNITUDES)
TYC = ("TYC1", "TYC2", "TYC3")
QUANTITIES = (*NUMBERS, *TYC, "TYC", "PGC", "source_id", "name")

TYC_LIMITS = {"TYC1": 9537, "TYC2": 12121, "TYC3": 3}
"""Largest values.  Source: Hog et al. 2000, the Tycho-2 catalogue (CDS I/259), notes on TYC1-3."""

_TYC_TEXT = re.compile(r"\s*(?:TYC\s*)?(\d{1,9})-(\d{1,9})-(\d{1,9})\s*", re.ASCII)


@dataclass(frozen=True)
class Reading:
    """How one table is read: names of its columns, units that it does not give, and values in place of a column.

    ``error_arcsec`` is the error of each coordinate, ``ref_epoch`` (yr) the epoch of all positions.  ``where`` is a
    condition that its rows must meet, as in `rows_where`.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    error_arcsec: float | None = None
    ref_epoch: float | None = None
    missing_pm: str = "error"
    where: str | None = None


@dataclass(frozen=True)
class Search:
    """What to search and how: files, match radius and `Reading` by table name, and the other options.

    ``stars`` are the star catalogue and, if there is one, the supplement.
    """

    stars: tuple[Path, ...]
    galaxies: tuple[Path, ...]
    radius_arcsec: Mapping[str, float]
    readings: Mapping[str, Reading]
    asked: SearchOptions

    @property
    def rules(self) -> crossmatch.Rules:
        """What makes a match uncertain."""
        asked = self.asked
        merge = None if asked.merge_radius is None else asked.merge_radius * ARCSEC
        return crossmatch.Rules(asked.k_sigma, asked.crowding_radius * ARCSEC, asked.crowding_stars, merge)


@dataclass(frozen=True)
class Matches:
    """A search, the rows of its star tables and of its galaxy tables (see `read_sky_table`), and the matches."""

    search: Search
    stars: tuple[pd.DataFrame, ...]
    galaxies: tuple[pd.DataFrame, ...]
    matches: crossmatch.Matches


def table_name(path: Path) -> str:
    """Return the name of a table in options: its file name up to the first dot."""
    return path.name.split(".")[0]


def plan_search(stars: Path, galaxies: Sequence[Path], supplement: Path | None = None, **options: Any) -> Search:
    """Return the search that `SearchOptions` ask for; no file is read yet.

    Raises SweepError for two tables with the same name, unknown names and values out of range.
    """
    asked = SearchOptions.named("match", options)
    star_paths = (stars,) if supplement is None else (stars, supplement)
    star_names, galaxy_names = [table_name(path) for path in star_paths], [table_name(path) for path in galaxies]
    names = star_names + galaxy_names
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise SweepError(f"two tables are called {', '.join(map(repr, twice))}; give the files different names")
    columns, units = (by_table(n, getattr(asked, n), names, star_names) for n in ("columns", "units"))
    radii = _numbers("radius", asked.radius, galaxy_names, galaxy_names)
    errors, epochs = (
        _numbers("error", asked.error, names, galaxy_names),
        _numbers("ref_epoch", asked.ref_epoch, star_names, star_names),
    )
    chosen = conditions(asked.where.split(";"), names, star_names)
    readings = {
        name: Reading(
            *(columns.get(name, {}), units.get(name, {}), errors.get(name), epochs.get(name)),
            *(asked.missing_pm, chosen.get(name)),
        )
        for name in names
    }
    radius = dict.fromkeys(galaxy_names, DEFAULT_RADIUS_ARCSEC) | radii
    return Search(star_paths, tuple(galaxies), radius, readings, asked)


def _numbers(name: str, pairs: Pairs, tables: Sequence[str], common: Sequence[str]) -> dict[str, float]:
    """Return a radius, an error (arcsec) or an epoch (yr) by table; raises SweepError for one out of range."""
    low, high, unit = (*EPOCHS, "yr") if name == "ref_epoch" else (0.0, crossmatch.MAX_RADIUS / ARCSEC, "arcsec")
    allowed = Parameter(name, "float", unit=unit, above=low, maximum=high)
    of_tables = tuple((f"{table.removesuffix(':')}:", text) for table, text in pairs)
    try:
        said = by_table(name, of_tables, tables, common)
        return {table: allowed.parse(number(one[""])) for table, one in said.items()}
    except ValueError as error:
        raise SweepError(str(error)) from error


def find_matches(search: Search) -> Matches:
    """Read the tables of a search and match them.

    Raises SweepError with the problems of all tables, and for a radius that would pair everything with everything.
    """
    problems: list[str] = []
    tables: list[pd.DataFrame] = []
    for path in (*search.stars, *search.galaxies):
        try:
            tables.append(read_sky_table(path, search.readings[table_name(path)], path in search.stars))
        except SweepError as bad:
            problems += [f"{path}: {problem}" for problem in bad.problems]
    if problems:
        raise SweepError(problems)
    stars, galaxies = tuple(tables[: len(search.stars)]), tuple(tables[len(search.stars) :])
    if all(set(TYC) <= set(table) for table in stars):
        both = pd.concat([table[list(TYC)] for table in stars])
        if len(again := both[both.duplicated()]):
            names = ", ".join("-".join(map(str, tyc)) for tyc in again[:5].itertuples(index=False))
            more = f" and {len(again) - 5} more" if len(again) > 5 else ""
            raise SweepError(f"TYC {names}{more}: in the star table and again in the supplement")
    parts = [_star_positions(table, search.asked.epoch) for table in stars]
    positions = crossmatch.Positions(*map(np.concatenate, zip(*parts, strict=True)))
    supplement = np.repeat(np.arange(len(stars)) == 1, [len(table) for table in stars])
    catalogues = [
        crossmatch.GalaxyCatalogue(_positions(table), table["PGC"].to_numpy(), radius * ARCSEC)
        for table, radius in zip(galaxies, search.radius_arcsec.values(), strict=True)
    ]
    try:
        return Matches(search, stars, galaxies, crossmatch.cross_match(positions, supplement, catalogues, search.rules))
    except ValueError as error:
        raise SweepError(str(error)) from error


def _positions(table: pd.DataFrame) -> crossmatch.Positions:
    units = {"ra": DEGREE, "dec": DEGREE, "ra_error": MAS, "dec_error": MAS}
    return crossmatch.Positions(*(table[name].to_numpy() * unit for name, unit in units.items()))


def _star_positions(table: pd.DataFrame, epoch: float) -> crossmatch.Positions:
    positions = _positions(table)
    if "pmra" not in table:
        return positions
    none = np.zeros(len(table))
    motions = {key: np.nan_to_num(table.get(key, none)) * MAS for key in MOTIONS}
    return crossmatch.at_epoch(positions, **motions, years=epoch - table["ref_epoch"].to_numpy())


def read_sky_table(path: Path, reading: Reading, stars: bool) -> pd.DataFrame:
    """Return the rows of a table of stars, or of galaxies: ra, dec and their errors; of stars also proper motions and
    their epoch, magnitudes and identifiers, of galaxies PGC numbers (0 where there is none) and names.  The index has
    the numbers of the rows in the file, from 0.

    Columns are those of `QUANTITIES` in deg, mas, mas/yr, yr and mag; NaN is a missing magnitude or proper motion,
    nothing else may be missing.  Proper motions of galaxies are not read: galaxies do not move, and measured motions
    are noise.  Raises SweepError with all problems: missing or unusable columns and units, rows without a value or with
    an impossible one, repeated identifiers.
    """
    table = read_table(path)
    rows = np.flatnonzero(rows_where(table, reading.where, str(path))) if reading.where else np.arange(len(table))
    read = Columns(table[rows] if reading.where else table, str(path), reading.columns, reading.units, QUANTITIES)
    if not len(read):
        raise SweepError("has no rows", str(path))
    columns: dict[str, Any] = _read_positions(read, reading.error_arcsec)
    if stars:
        columns |= _read_motions(read, reading)
        columns |= {key: read.quantity(key, "allowed") for key in MAGNITUDES if read.has(key)}
        columns |= _read_tyc(read)
        columns |= {"source_id": read.integers("source_id")} if read.has("source_id") else {}
    else:
        columns["PGC"] = read.integers("PGC", may_miss=True) if read.has("PGC") else np.zeros(len(read), dtype=np.int64)
        read.check(columns["PGC"] < 0, "a negative PGC number", columns["PGC"])
        columns |= {"name": read.text(str(read.name("name")), missing="")} if read.has("name") else {}
    read.finish()
    return pd.DataFrame(columns).set_axis(rows)


def _read_positions(read: Columns, error_arcsec: float | None) -> dict[str, Array]:
    columns = {key: read.quantity(key) for key in ("ra", "dec") if read.require(key)}
    if len(columns) == 2:
        ra, dec = columns["ra"], columns["dec"]
        read.check((ra < 0.0) | (ra > 360.0), "an ra outside 0..360 deg", ra)
        swapped = "; are ra and dec swapped?" if np.all(np.abs(ra) <= 90.0) else ""
        read.check(np.abs(dec) > 90.0, "a dec outside -90..90 deg", dec, swapped)
    for key in ("ra_error", "dec_error"):
        if error_arcsec is not None:
            columns[key] = np.full(len(read), 1000.0 * error_arcsec)
        elif read.require(key, "; or give its error in arcsec with --error"):
            columns[key] = read.quantity(key)
            read.check(columns[key] <= 0.0, f"a {read.label(key)} that is not above 0", columns[key])
    return columns


def _read_motions(read: Columns, reading: Reading) -> dict[str, Array]:
    """Return the proper motions, NaN in rows that lack one of them, and the epoch of the positions."""
    columns: dict[str, Array] = {}
    known = len(read.problems)
    has_motions = read.has("pmra") or read.has("pmdec")
    if has_motions and all([read.require("pmra"), read.require("pmdec")]):
        columns = {key: read.quantity(key, "allowed") for key in MOTIONS if read.has(key)}
        missing = np.isnan(columns["pmra"]) | np.isnan(columns["pmdec"])
        for key, values in columns.items():
            read.check(np.isinf(values), f"an infinite {read.label(key)}")
            if key.endswith("_error"):
                read.check(values < 0.0, f"a negative {read.label(key)}", values)
                read.check(np.isnan(values) & ~missing, f"no {read.label(key)}")
            columns[key] = np.where(missing, np.nan, values)
        if reading.missing_pm == "error" and len(read.problems) == known:
            read.check(missing, "no proper motion (--missing-pm zero takes it as zero)")
    if reading.ref_epoch is not None:
        columns["ref_epoch"] = np.full(len(read), reading.ref_epoch)
    elif read.has("ref_epoch"):
        columns["ref_epoch"] = read.epochs()
    elif has_motions:
        read.require("ref_epoch", "; proper motions need the epoch of the positions, e.g. --ref-epoch NAME=2000")
    return columns


def _read_tyc(read: Columns) -> dict[str, Any]:
    """Return the Tycho identifiers from three columns or one of text, nothing for a table without them."""
    known = len(read.problems)
    if any(read.has(key) for key in TYC):
        tyc = pd.DataFrame({key: read.integers(key) for key in TYC if read.require(key)})
    elif read.has("TYC"):
        matches = [_TYC_TEXT.fullmatch(text) for text in read.text(str(read.name("TYC")), missing="")]
        bad = np.array([one is None for one in matches])
        read.check(bad, f"a {read.label('TYC')} that is no Tycho identifier like '1-13-1'")
        tyc = pd.DataFrame([list(map(int, one.groups())) for one in matches if one], columns=list(TYC))
    else:
        return {}
    if len(read.problems) > known:
        return {}
    for key, limit in TYC_LIMITS.items():
        read.check(((tyc[key] < 1) | (tyc[key] > limit)).to_numpy(), f"a {read.label(key)} outside 1..{limit}")
    if len(read.problems) == known:
        read.check(tyc.duplicated().to_numpy(), "the Tycho identifier of an earlier row")
    return dict(tyc)
