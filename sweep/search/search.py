"""A search for galaxies in a star catalogue: what to search, from the options of the command line, the matches on the
sphere with how sure each one is, and what it gives: the matches as a dataset, its tables and sentences, 46 bytes a row.

All positions are for one epoch (`at_epoch`).  Every star-galaxy pair within a catalogue's radius is found with k-d
trees of unit vectors, entries that are one galaxy are merged, the rest is resolved one to one, closest pair first, and
each match is classified.

Source: Metz & Geffert 2004, Sect. 3; the rules of the classes replace the paper's inspection by eye.
"""

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from scipy.spatial import KDTree

from linksweep.core.frames import ARCSEC, DEGREE, MAS, Array, Flags, Indices, position, triad
from linksweep.sweep.contract import Parameter, SweepError, refused
from linksweep.sweep.formatting import first_of, with_error
from linksweep.sweep.result import Result, write_at_once
from linksweep.sweep.search.options import SearchOptions
from linksweep.sweep.table_writer import Column, Table
from linksweep.sweep.tables.columns import EPOCHS, Columns, conditions, rows_where, unit_of
from linksweep.sweep.tables.options import by_table, number
from linksweep.sweep.tables.reader import read_table

MAX_RADIUS = 1.0 * DEGREE

# Largest number of chance pairs within a radius, half a minute of work: more are no search for counterparts.
MAX_PAIRS = 2e6

# Source: Metz & Geffert 2004, Sect. 3.1.
CLASSES = ("certain", "uncertain", "supplement")

# Chance pairs are counted in a ring between these multiples of the radius, where no true counterpart is left.
RING = (5.0, 10.0)


DEFAULT_RADIUS_ARCSEC = 5.0

MOTIONS = ("pmra", "pmdec", "pmra_error", "pmdec_error")
# The columns of magnitudes, best first.
MAGNITUDES = ("vt_mag", "phot_g_mean_mag")

NUMBERS = ("ra", "dec", "ra_error", "dec_error", *MOTIONS, "ref_epoch", *MAGNITUDES)
# The parts of a Tycho identifier and their largest values.  Source: Hog et al. 2000, the Tycho-2 catalogue (CDS I/259),
# notes on TYC1-3.
TYC = {"TYC1": 9537, "TYC2": 12121, "TYC3": 3}
QUANTITIES = (*NUMBERS, *TYC, "TYC", "PGC", "source_id", "name")

# What stands for a missing identifier, as integers have no NaN.
MISSING = {**dict.fromkeys((*TYC, "PGC"), 0), "source_id": np.iinfo(np.int64).min, "name": ""}

_TYC_TEXT = re.compile(r"\s*(?:TYC\s*)?(\d{1,9})-(\d{1,9})-(\d{1,9})\s*", re.ASCII)


# ---- matches of positions, in rad


class Positions(NamedTuple):
    """Positions at one epoch: ra, dec and their standard errors (that of ra with cos dec) in rad, shape (N,)."""

    ra: Array
    dec: Array
    ra_error: Array
    dec_error: Array

    @property
    def vectors(self) -> Array:
        """The unit vectors; shape (N, 3)."""
        return np.ascontiguousarray(triad(self.ra, self.dec).r.T)

    def take(self, rows: Indices) -> "Positions":
        """Return the positions in some rows."""
        return Positions(*(column[rows] for column in self))


def at_epoch(
    positions: Positions, pmra: Array, pmdec: Array, pmra_error: Array, pmdec_error: Array, years: Array
) -> Positions:
    """Return positions ``years`` later, with their errors, moved on straight lines in space at unknown distance.

    ``pmra`` (with cos dec), ``pmdec`` and their errors in rad/yr, all of shape (N,).  At a pole the motion is along the
    triad there.  Source: ESA 1997, The Hipparcos and Tycho Catalogues, vol. 1, Sect. 1.5.5, without parallax
    and radial velocity.
    """
    p, q, r = triad(positions.ra, positions.dec)
    errors = np.hypot([positions.ra_error, positions.dec_error], np.array([pmra_error, pmdec_error]) * years)
    return Positions(*position(r + (p * pmra + q * pmdec) * years), *errors)


def sky_tree(positions: Positions) -> KDTree:
    """Return a k-d tree of the unit vectors of N positions."""
    # not balanced: built and searched twice as fast for points all over a sphere, 2.5 million in 0.7 s
    return KDTree(positions.vectors, balanced_tree=False, compact_nodes=False)


def chord(angle: float) -> float:
    """Return the distance of two unit vectors that enclose an angle (rad)."""
    return float(2.0 * np.sin(0.5 * angle))


def uniform_pairs(n_first: int, n_second: int, radius: float) -> float:
    """Return the expected number of pairs within ``radius`` (rad) of objects scattered uniformly over the sphere.

    A cap of angular radius t is the fraction (1 - cos t)/2 = sin^2(t/2) of the sphere.
    """
    return float(n_first) * float(n_second) * float(np.sin(0.5 * radius)) ** 2


def pairs_within(first: KDTree, second: KDTree, radius: float) -> tuple[Indices, Indices, Array]:
    """Return all pairs of two sky trees at most ``radius`` (rad) apart, in no particular order: an index into each, and
    the angle between them.

    Raises ValueError for a radius that is expected to give more than `MAX_PAIRS`.
    """
    expected = uniform_pairs(first.n, second.n, radius)
    if expected > MAX_PAIRS:
        said = f"radius = {radius / ARCSEC:g} arcsec: about {expected:.1e} chance pairs of {first.n} and {second.n}"
        raise ValueError(f"{said} objects, more than {MAX_PAIRS:.0e}; take a smaller one")
    pairs = first.sparse_distance_matrix(second, chord(radius), output_type="ndarray")
    return pairs["i"].astype(np.int64), pairs["j"].astype(np.int64), 2.0 * np.arcsin(np.minimum(0.5 * pairs["v"], 1.0))


def one_to_one(pairs: pd.DataFrame, first: str, second: str) -> pd.DataFrame:
    """Return the pairs, best first, that are kept if a pair counts only where neither of its objects is taken yet."""
    kept: list[bool] = []
    taken: tuple[set[int], set[int]] = set(), set()
    for a, b in zip(pairs[first].tolist(), pairs[second].tolist(), strict=True):
        kept.append(a not in taken[0] and b not in taken[1])
        if kept[-1]:
            taken[0].add(a)
            taken[1].add(b)
    return pairs[np.array(kept, dtype=bool)]


def chance_pairs(stars: KDTree, galaxies: KDTree, radius: float) -> dict[str, float]:
    """Return how many pairs of two sky trees within ``radius`` (rad) chance would make: of two uniform skies, and, with
    an error, from the pairs in a ring about the galaxies.
    """
    inner, outer = (chord(multiple * radius) for multiple in RING)
    in_inner, in_outer = np.asarray(stars.count_neighbors(galaxies, np.array([inner, outer])), dtype=np.float64)
    to_circle = chord(radius) ** 2 / (outer**2 - inner**2)  # the area of a cap is pi chord^2
    in_ring = float(in_outer - in_inner)
    return {
        "chance_pairs_uniform": uniform_pairs(stars.n, galaxies.n, radius),
        "chance_pairs_local": in_ring * to_circle,
        # at least one pair, also where there is none
        "chance_pairs_local_error": float(np.sqrt(max(in_ring, 1.0))) * to_circle,
    }


@dataclass(frozen=True)
class GalaxyCatalogue:
    """Positions, an identifier that galaxy catalogues share (the PGC number; 0 for none; shape (N,)) and the match
    radius (rad).
    """

    positions: Positions
    identifier: Indices
    radius: float

    @cached_property
    def tree(self) -> KDTree:
        """The sky tree of the positions."""
        return sky_tree(self.positions)


def merge_galaxies(
    catalogues: Sequence[GalaxyCatalogue], merge_radius: float | None = None
) -> tuple[list[Indices], Indices]:
    """Return a galaxy's number for every entry of every catalogue, and the identifier of every galaxy (0 for none).

    Entries with the same identifier are one galaxy wherever they stand.  Otherwise an entry is the galaxy of an entry
    of an earlier catalogue within ``merge_radius`` (rad; by default the sum of both match radii, so that two entries
    found at one star are one galaxy), one to one and closest first, unless both have identifiers.  Raises ValueError as
    `pairs_within`.
    """
    labels: list[Indices] = []
    known = np.empty(0, dtype=np.int64)  # identifier of each galaxy so far
    for catalogue in catalogues:
        identifier, where = catalogue.identifier, catalogue.positions
        label = _label_by_identifier(identifier, known)
        # entries of one identifier count as one
        names, _ = pd.factorize(np.where(identifier > 0, identifier, -1 - np.arange(len(identifier))))
        links = []
        for earlier, earlier_label in zip(catalogues, labels, strict=False):
            radius = earlier.radius + catalogue.radius if merge_radius is None else merge_radius
            at, entry, offset = pairs_within(earlier.tree, catalogue.tree, radius)
            galaxy, there, here = earlier_label[at], earlier.positions.take(at), where.take(entry)
            columns = {"offset": offset, "dec": there.dec, "ra": there.ra, "entry_dec": here.dec, "entry_ra": here.ra}
            numbers = {"galaxy": galaxy, "entry": entry, "known": known[galaxy], "mine": identifier[entry]}
            links.append(pd.DataFrame(columns).assign(name=names[entry], **numbers))
        if links:
            link = pd.concat(links)
            galaxy, entry = link["galaxy"].to_numpy(), link["entry"].to_numpy()
            # neither side is linked yet, and at most one has an identifier
            free = ~np.isin(galaxy, label) & (label[entry] < 0) & ((link["known"] == 0) | (link["mine"] == 0))
            # the place of a row decides nothing
            order = ["offset", "dec", "ra", "entry_dec", "entry_ra", "mine", "known"]
            best = one_to_one(link[free].sort_values(order).drop_duplicates(["galaxy", "name"]), "galaxy", "name")
            galaxy, entry = best["galaxy"].to_numpy(), best["entry"].to_numpy()
            label[entry] = galaxy
            known[galaxy] = np.maximum(known[galaxy], identifier[entry])
            label = np.where(label < 0, _label_by_identifier(identifier, known), label)
        new = np.flatnonzero(label < 0)
        numbers, _ = pd.factorize(names[new])
        label[new] = len(known) + numbers
        known = np.concatenate([known, identifier[new[np.unique(numbers, return_index=True)[1]]]])
        labels.append(label)
    return labels, known


def _label_by_identifier(identifier: Indices, known: Indices) -> Indices:
    """Return the number of the galaxy with each entry's identifier, -1 for none."""
    named = np.flatnonzero(known)
    numbers = pd.Series(named, index=known[named]).reindex(identifier, fill_value=-1)
    return np.array(numbers, dtype=np.int64)


@dataclass(frozen=True)
class Matches:
    """M star-galaxy matches in order of the star's ra and dec at the epoch of the search; none occurs twice.

    The columns of ``table``: ``star`` indexes the stars, ``catalogue`` and ``entry`` the closest galaxy entry,
    ``galaxy`` the merged galaxies, ``identifier`` is the galaxy's (0 for none).  ``offset`` (rad) and its components
    ``d_ra`` (with cos dec) and ``d_dec`` are galaxy - star, ``n_sigma`` is the offset in units of the combined errors:
    for normal errors it is larger than k with probability exp(-k^2/2).  ``n_near`` counts other stars within the
    crowding radius, ``n_rival`` the other stars and galaxies within the match radius.  ``class`` is one of `CLASSES`.

    ``found_in`` (M, number of catalogues) says which catalogues have the galaxy within their radius, ``reasons``
    has a column of truth values for each reason for doubt.
    """

    table: pd.DataFrame
    found_in: Flags
    reasons: pd.DataFrame
    chance: tuple[Mapping[str, float], ...]
    n_galaxies: int

    def __getitem__(self, name: str) -> Any:
        return self.table[name].to_numpy()


def cross_match(
    stars: Positions, supplement: Flags, catalogues: Sequence[GalaxyCatalogue], asked: SearchOptions
) -> Matches:
    """Return the one-to-one matches of stars with galaxies, with their class.

    All positions are for one epoch.  ``supplement`` (N,) marks stars of the supplement, which match like the others.
    The result does not depend on the order of rows: pairs at equal offset are ordered by the place of their
    catalogue, then by position and identifier.  Raises ValueError as `pairs_within`.
    """
    merge_radius = None if asked.merge_radius is None else asked.merge_radius * ARCSEC
    star_tree = sky_tree(stars)
    within = [pairs_within(star_tree, catalogue.tree, catalogue.radius) for catalogue in catalogues]
    labels, identifiers = merge_galaxies(catalogues, merge_radius)
    each = []
    for place, ((star, entry, offset), label, catalogue) in enumerate(zip(within, labels, catalogues, strict=True)):
        galaxy, (ra, dec, ra_error, dec_error) = label[entry], catalogue.positions.take(entry)
        columns = {"star": star, "catalogue": place, "entry": entry, "galaxy": galaxy, "offset": offset}
        columns |= {"identifier": identifiers[galaxy], "galaxy_ra": ra, "galaxy_dec": dec}
        each.append(pd.DataFrame(columns | {"ra_error": ra_error, "dec_error": dec_error}))
    pairs = pd.concat(each)
    star = pairs["star"].to_numpy()
    pairs = pairs.assign(supplement=supplement[star], dec=stars.dec[star], ra=stars.ra[star])
    order = ["offset", "catalogue", "supplement", "dec", "ra", "galaxy_dec", "galaxy_ra", "identifier"]
    nearest = pairs.sort_values(order).drop_duplicates(["star", "galaxy"])
    n_rival = sum(nearest.groupby(name)["offset"].transform("size") for name in ("star", "galaxy")) - 2
    table = one_to_one(nearest.assign(n_rival=n_rival), "star", "galaxy").sort_values(["ra", "dec"], kind="stable")

    here = stars.take(table["star"].to_numpy())
    p, q, r = triad(here.ra, here.dec)
    step = triad(table["galaxy_ra"].to_numpy(), table["galaxy_dec"].to_numpy()).r - r
    d_ra, d_dec = np.sum(p * step, axis=0), np.sum(q * step, axis=0)
    ra_error, dec_error = np.hypot(here.ra_error, table["ra_error"]), np.hypot(here.dec_error, table["dec_error"])
    n_sigma = np.hypot(d_ra / ra_error, d_dec / dec_error).to_numpy()
    n_near = star_tree.query_ball_point(here.vectors, chord(asked.crowding_radius * ARCSEC), return_length=True) - 1
    crowded, far = n_near >= asked.crowding_stars, n_sigma > asked.k_sigma
    reasons = pd.DataFrame({"crowded": crowded, "offset": far, "rival": table["n_rival"].to_numpy() > 0})
    # the supplement is a class of its own, as in the paper, whatever the doubts
    code = np.where(table["supplement"], 2, reasons.any(axis=1))
    match = table[["star", "galaxy"]].assign(match=np.arange(len(table)))
    inside = pairs.merge(match, on=["star", "galaxy"])
    found_in = np.zeros((len(table), len(catalogues)), dtype=bool)
    found_in[inside["match"], inside["catalogue"]] = True
    counted = zip(catalogues, within, strict=True)
    chance = tuple({"pairs": len(near[0])} | chance_pairs(star_tree, c.tree, c.radius) for c, near in counted)
    columns = {"d_ra": d_ra, "d_dec": d_dec, "n_sigma": n_sigma, "n_near": n_near, "class": np.array(CLASSES)[code]}
    table = table.assign(**columns).reset_index(drop=True)
    return Matches(table, found_in, reasons, chance, len(identifiers))


# ---- what to search


@dataclass(frozen=True)
class Search:
    """What to search and how: files by name, the options, and what these say of each table, by option and name.

    ``stars`` are the star catalogue and, if there is one, the supplement.
    """

    stars: dict[str, Path]
    galaxies: dict[str, Path]
    asked: SearchOptions
    said: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class SearchResult:
    """A search, the rows of its star and galaxy tables by name (see `read_sky_table`), and the matches."""

    search: Search
    stars: dict[str, pd.DataFrame]
    galaxies: dict[str, pd.DataFrame]
    matches: Matches


def plan_search(stars: Path, galaxies: Sequence[Path], supplement: Path | None = None, **options: Any) -> Search:
    """Return the search that `SearchOptions` ask for; no file is read yet.

    Raises SweepError for two tables with the same name, unknown names and values out of range.
    """
    asked = SearchOptions.named("match", options)
    star_paths = [stars] if supplement is None else [stars, supplement]
    names = [path.name.split(".")[0] for path in (*star_paths, *galaxies)]
    star_names, galaxy_names = names[: len(star_paths)], names[len(star_paths) :]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise SweepError(f"two tables are called {', '.join(map(repr, twice))}; give the files different names")
    said: dict[str, Mapping[str, Any]] = {
        **{option: by_table(option, getattr(asked, option), names, star_names) for option in ("columns", "units")},
        "radius": dict.fromkeys(galaxy_names, DEFAULT_RADIUS_ARCSEC) | _numbers(asked, "radius", galaxy_names),
        "error": _numbers(asked, "error", galaxy_names, star_names),
        "ref_epoch": _numbers(asked, "ref_epoch", star_names),
        "where": conditions(asked.where.split(";"), names, star_names),
    }
    paths = dict(zip(star_names, star_paths, strict=True)), dict(zip(galaxy_names, galaxies, strict=True))
    return Search(*paths, asked, said)


def _numbers(asked: SearchOptions, name: str, common: Sequence[str], further: Sequence[str] = ()) -> dict[str, float]:
    """Return a radius, an error (arcsec) or an epoch (yr) by table, one without a table for all ``common`` ones; raises
    SweepError for one out of range.
    """
    low, high, unit = (*EPOCHS, "yr") if name == "ref_epoch" else (0.0, MAX_RADIUS / ARCSEC, "arcsec")
    allowed = Parameter(name, "float", unit=unit, above=low, maximum=high)
    of_tables = tuple((f"{table.removesuffix(':')}:", text) for table, text in getattr(asked, name))
    said = by_table(name, of_tables, [*common, *further], common)
    with refused(ValueError):
        return {table: allowed.parse(number(one[""])) for table, one in said.items()}


def find_matches(search: Search) -> SearchResult:
    """Read the tables of a search and match them.

    Raises SweepError with the problems of all tables, and for a radius that would pair everything with everything.
    """
    problems: list[str] = []
    stars, galaxies = dict[str, pd.DataFrame](), dict[str, pd.DataFrame]()
    for tables, paths in ((stars, search.stars), (galaxies, search.galaxies)):
        for name, path in paths.items():
            try:
                tables[name] = read_sky_table(name, path, search)
            except SweepError as bad:
                problems += [f"{path}: {problem}" for problem in bad.problems]
    if problems:
        raise SweepError(problems)
    if all(set(TYC) <= set(table) for table in stars.values()):
        both = pd.concat([table[list(TYC)] for table in stars.values()])
        if again := ["-".join(map(str, tyc)) for tyc in both[both.duplicated()].itertuples(index=False)]:
            raise SweepError(f"TYC {first_of(again, 5)}: in the star table and again in the supplement")
    asked = search.asked
    parts = [_star_positions(table, asked.epoch) for table in stars.values()]
    positions = Positions(*map(np.concatenate, zip(*parts, strict=True)))
    supplement = np.repeat(np.arange(len(stars)) == 1, [len(table) for table in stars.values()])
    radii = search.said["radius"]
    catalogues = [GalaxyCatalogue(_positions(t), t["PGC"].to_numpy(), radii[n] * ARCSEC) for n, t in galaxies.items()]
    with refused(ValueError):
        return SearchResult(search, stars, galaxies, cross_match(positions, supplement, catalogues, asked))


def _positions(table: pd.DataFrame) -> Positions:
    units = {"ra": DEGREE, "dec": DEGREE, "ra_error": MAS, "dec_error": MAS}
    return Positions(*(table[name].to_numpy() * unit for name, unit in units.items()))


def _star_positions(table: pd.DataFrame, epoch: float) -> Positions:
    positions = _positions(table)
    if "pmra" not in table:
        return positions
    motions = {key: np.nan_to_num(table.get(key, np.zeros(len(table)))) * MAS for key in MOTIONS}
    return at_epoch(positions, **motions, years=epoch - table["ref_epoch"].to_numpy())


def read_sky_table(name: str, path: Path, search: Search) -> pd.DataFrame:
    """Return the rows of a table of stars, or of galaxies: ra, dec and their errors; of stars also proper motions and
    their epoch, magnitudes and identifiers, of galaxies PGC numbers (0 where there is none) and names.  The index has
    the numbers of the rows in the file, from 0.

    Columns are those of `QUANTITIES` in deg, mas, mas/yr, yr and mag; NaN is a missing magnitude or proper motion,
    nothing else may be missing.  Proper motions of galaxies are not read: galaxies do not move, and measured motions
    are noise.  Raises SweepError with all problems: missing or unusable columns and units, rows without a value or with
    an impossible one, repeated identifiers.
    """
    table, said = read_table(path), {option: by.get(name) for option, by in search.said.items()}
    rows = np.flatnonzero(rows_where(table, said["where"], str(path))) if said["where"] else np.arange(len(table))
    read = Columns(table[rows] if said["where"] else table, str(path), said["columns"], said["units"], QUANTITIES)
    columns: dict[str, Any] = _read_positions(read, said["error"])
    if name in search.stars:
        columns |= _read_motions(read, search.asked.missing_pm, said["ref_epoch"])
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
    for key in ("ra_error", "dec_error"):
        if error_arcsec is not None:
            columns[key] = np.full(len(read), 1000.0 * error_arcsec)
        elif read.require(key, "; or give its error in arcsec with --error"):
            columns[key] = read.quantity(key)
            read.check(columns[key] == 0.0, f"a {read.label(key)} that is not above 0", columns[key])
    return columns


def _read_motions(read: Columns, missing_pm: str, ref_epoch: float | None) -> dict[str, Array]:
    """Return the proper motions, NaN in rows that lack one of them, and the epoch of the positions."""
    columns: dict[str, Array] = {}
    known = len(read.problems)
    has_motions = read.has("pmra") or read.has("pmdec")
    if has_motions and all([read.require("pmra"), read.require("pmdec")]):
        columns = {key: read.quantity(key, "allowed") for key in MOTIONS if read.has(key)}
        missing = np.isnan(columns["pmra"]) | np.isnan(columns["pmdec"])
        for key, values in columns.items():
            # Barnard's star, the fastest, has 10 400 mas/yr
            read.check(np.abs(values) > 12_000.0, f"a {read.label(key)} beyond 12 arcsec/yr, as no star has", values)
            if key.endswith("_error"):
                read.check(np.isnan(values) & ~missing, f"no {read.label(key)}")
            columns[key] = np.where(missing, np.nan, values)
        if missing_pm == "error" and len(read.problems) == known:
            read.check(missing, "no proper motion (--missing-pm zero takes it as zero)")
    if ref_epoch is not None:
        columns["ref_epoch"] = np.full(len(read), ref_epoch)
    elif read.has("ref_epoch"):
        columns["ref_epoch"] = read.epochs()
    elif has_motions:
        read.require("ref_epoch", "; proper motions need the epoch of the positions, e.g. --ref-epoch NAME=2000")
    return columns


def _read_tyc(read: Columns) -> dict[str, Any]:
    """Return the Tycho identifiers from three columns or one of text, nothing for a table without them."""
    if any(read.has(key) for key in TYC):
        if sum(read.require(key) for key in TYC) < len(TYC):
            return {}
        tyc = {key: read.integers(key) for key in TYC}
    elif read.has("TYC"):
        matches = [_TYC_TEXT.fullmatch(text) for text in read.text(str(read.name("TYC")), missing="")]
        bad = np.array([match is None for match in matches])
        read.check(bad, f"a {read.label('TYC')} that is no Tycho identifier like '1-13-1'")
        if bad.any():
            return {}
        numbers = np.array([match.groups() for match in matches if match], dtype=np.int64)
        tyc = dict(zip(TYC, numbers.T, strict=True))
    else:
        return {}
    for key, limit in TYC.items():
        read.check((tyc[key] < 1) | (tyc[key] > limit), f"a {read.label(key)} outside 1..{limit}")
    read.check(pd.DataFrame(tyc).duplicated().to_numpy(), "the Tycho identifier of an earlier row")
    return tyc


# ---- what it gives

# More entries of galaxy catalogues would fill the map: of a larger number a random share is drawn.
MOST_ENTRIES = 30_000

# Columns of the stars under other names: measured proper motions, which a study must not take for the galaxies' (zero).
OF_STARS = {name: f"star_{name}" for name in (*MOTIONS, "table", "row")}
# Columns of `Matches` and their names in results.
OF_MATCHES = {name: name for name in ("class", "n_near", "n_rival", "offset")} | {"identifier": "PGC"}
OF_MATCHES |= {"d_ra": "offset_ra", "d_dec": "offset_dec", "n_sigma": "offset_sigma"}

# The columns of the ECSV beside those of the star table, their units and what they mean.
MATCH_COLUMNS: Mapping[str, tuple[str | None, str]] = {
    "class": (None, "certain, uncertain or supplement"),
    "reason": (None, "why it is in doubt: crowded, offset, rival; or none"),
    "offset": ("arcsec", "angle between star and galaxy at the epoch of the search"),
    "offset_ra": ("arcsec", "galaxy - star along ra, with cos(dec)"),
    "offset_dec": ("arcsec", "galaxy - star along dec"),
    "offset_sigma": (None, "offset in units of the combined position errors"),
    "n_near": (None, "other stars within the crowding radius"),
    "n_rival": (None, "other stars and galaxies within the match radius"),
    "galaxy_table": (None, "catalogue of the closest entry of the galaxy"),
    "galaxy_row": (None, "row of that entry, from 1"),
    "galaxy_name": (None, "name of that entry in its catalogue, if that gives one"),
    "galaxy_ra": ("deg", "position of that entry"),
    "galaxy_dec": ("deg", "position of that entry"),
    "found_in": (None, "all catalogues with the galaxy within their radius"),
    "star_table": (None, "catalogue of the star"),
    "star_row": (None, "row of the star, from 1"),
}

# The letters of the classes in the 46-byte table.
LETTERS = dict(zip(CLASSES, "GUS", strict=True))

# The largest number that fits the 46-byte table.
LARGEST_PGC = 99999

PROBLEMS_NAMED = 10


def find_galaxies(
    search: Search, output: Path, table: Path | None = None, figure: Path | None = None, overwrite: bool = False
) -> xr.Dataset:
    """Read the tables, match them, and write the matches as ECSV or as a store, and where asked for in 46 bytes a row
    and as a map, each in one step; return them.

    Raises SweepError for all that is wrong with tables, options and names of files; then nothing is written.
    """
    _check(search, [path for path in (output, table, figure) if path is not None], overwrite)
    result, contents = find_matches(search), dict[Path, bytes]()
    matches = matches_dataset(result)
    if output.suffix.lower() == ".ecsv":
        contents[output] = records(matches).ecsv().encode()
    if table is not None:
        if without := [path for name, path in search.stars.items() if not {*TYC} <= {*result.stars[name]}]:
            needed = "the 46-byte table needs columns TYC1, TYC2 and TYC3, or TYC with strings like '1-13-1'"
            raise SweepError([f"{path}: {needed}" for path in without])
        contents[table] = galaxy_table(matches.drop_dims("entry").to_dataframe()).encode("ascii")
    if figure is not None:
        from linksweep.sweep.plots import figure as drawing, style

        with style.settings():
            style.save(drawing.draw_figure(matches), figure)
    for path, content in contents.items():
        write_at_once(path, partial(Path.write_bytes, data=content))
    if output not in contents:
        Result(matches).save(output)
    return matches


def _check(search: Search, paths: Sequence[Path], overwrite: bool) -> None:
    """Raise SweepError if an output cannot or must not be written: better before a long search than after it."""
    inputs, wanted = (search.stars | search.galaxies).values(), [path.resolve() for path in paths]
    problems = [] if paths[0].suffix.lower() in (".ecsv", ".zarr") else [f"{paths[0]} must end in .ecsv or .zarr"]
    for path in paths:
        parent = next(p for p in path.absolute().parents if p.exists())
        if path.resolve() in [one.resolve() for one in inputs]:
            problems.append(f"{path} is one of the tables that are read")
        elif wanted.count(path.resolve()) > 1:
            problems.append(f"{path} is named for two outputs")
        elif path.is_dir():
            problems.append(f"{path} is a directory")
        elif path.exists() and not overwrite:
            problems.append(f"{path} exists; --overwrite replaces it")
        elif not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
            problems.append(f"{path} cannot be written: {parent} is not a directory that can be written")
    if problems:
        raise SweepError(list(dict.fromkeys(problems)))


def matches_dataset(result: SearchResult) -> xr.Dataset:
    """Return the matches: the columns of `match_columns` along ``match`` with units and meanings, ``entry_ra`` and
    ``entry_dec`` of a share of the galaxy catalogues along ``entry``, and the summary.

    Numbers that a table does not have are NaN, texts empty, and integers what the attribute ``missing`` says.
    """
    columns, variables = match_columns(result), dict[str, Any]()
    for name, column in columns.items():
        unit, meaning = MATCH_COLUMNS.get(name, (unit_of(name.removeprefix("star_")) or None, None))
        about = {"units": unit, "description": meaning, "missing": MISSING.get(name)}
        values = column.to_numpy() if column.dtype.kind in "if" else column.to_numpy(dtype=str)
        variables[name] = "match", values, {key: value for key, value in about.items() if value is not None}
    entries = pd.concat([one[["ra", "dec"]] for one in result.galaxies.values()])
    # rows of a catalogue are often sorted by position, so a random choice instead of every so many-th row
    few = entries.sample(len(entries) // max(1, -(-len(entries) // MOST_ENTRIES)), random_state=0)
    variables |= {f"entry_{name}": ("entry", few[name].to_numpy(), {"units": "deg"}) for name in few}
    about = {"result": "match", "title": f"Galaxies in {next(iter(result.stars))}", "columns": list(columns)}
    summary = json.dumps({"linksweep": version("linksweep"), **summarise(result, columns)})
    return xr.Dataset(variables, attrs=about | {"entries": len(entries), "summary": summary})


def match_columns(result: SearchResult) -> pd.DataFrame:
    """Return a table with a row for each match: columns of the star tables, then those of `MATCH_COLUMNS`.

    Numbers that a table does not have are NaN, identifiers `MISSING`.
    """
    matches, galaxy_tables = result.matches, np.array(list(result.galaxies))
    starts, reasons = np.cumsum([0, *map(len, result.galaxies.values())]), matches.reasons.columns.to_numpy()
    star = _together(result.stars).iloc[matches["star"]].rename(columns=OF_STARS)
    galaxy = _together(result.galaxies).iloc[starts[matches["catalogue"]] + matches["entry"]].add_prefix("galaxy_")
    of_match = matches.table[[*OF_MATCHES]].rename(columns=OF_MATCHES)
    of_match[["offset", "offset_ra", "offset_dec"]] /= ARCSEC
    of_match["reason"] = [",".join(reasons[doubts]) or "none" for doubts in matches.reasons.to_numpy()]
    of_match["found_in"] = [",".join(galaxy_tables[there]) for there in matches.found_in]
    columns = pd.concat([part.reset_index(drop=True) for part in (star, galaxy, of_match)], axis=1)
    names = (*TYC, "source_id", "PGC", *(OF_STARS.get(name, name) for name in NUMBERS), *MATCH_COLUMNS)
    return columns[[name for name in names if name in columns]]


def _together(tables: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Return the rows of several tables, with the table's name and the number of each row, from 1."""
    known = {name for table in tables.values() for name in table} & set(MISSING)
    each = {name: table.assign(**{k: MISSING[k] for k in known - set(table)}) for name, table in tables.items()}
    together = pd.concat(each, names=["table", "row"]).reset_index()
    return together.assign(row=together["row"] + 1)


def galaxy_table(columns: pd.DataFrame) -> str:
    r"""Return the matches in the format of the paper's tables at CDS: one line of 46 bytes and a ``\n`` for each.

    TYC1 (bytes 1-4), TYC2 (6-10), TYC3 (12) and PGC (14-18) are integers, ra (20-31) and dec (33-44) of the star are
    F12.8, byte 46 is the class, one of `LETTERS`.  Right ascensions are from 0 to below 360, also rounded.  Raises
    SweepError that names stars with a PGC number that does not fit, such as the 0 of a galaxy without one.
    """
    problems, lines = list[str](), list[str]()
    for tyc1, tyc2, tyc3, pgc, ra, dec, name in columns[[*TYC, "PGC", "ra", "dec", "class"]].itertuples(index=False):
        if not 1 <= pgc <= LARGEST_PGC:
            said = f": PGC = {pgc} does not fit bytes 14-18, from 1 to {LARGEST_PGC}" if pgc else " has no PGC number"
            problems.append(f"TYC {tyc1}-{tyc2}-{tyc3}{said}")
        wrapped = round(ra % 360.0, 8) % 360.0
        lines.append(f"{tyc1:4d} {tyc2:5d} {tyc3:1d} {pgc:5d} {wrapped:12.8f} {dec:12.8f} {LETTERS[name]}\n")
    if problems:
        raise SweepError(first_of(problems, PROBLEMS_NAMED, "\n"))
    return "".join(lines)


def summarise(result: SearchResult, columns: pd.DataFrame) -> dict[str, Any]:
    """Return the summary of a search: what was searched, chance matches, and counts and means of the matches' columns
    for each class.

    A mean of no values is NaN.
    """
    search, matches, asked = result.search, result.matches, result.search.asked
    magnitude = next((name for name in MAGNITUDES if name in columns), None)
    notes = []
    for name, table in result.stars.items():
        if "pmra" not in table:
            notes.append(f"{name} has no proper motions: its positions were taken as they are")
        elif missing := np.count_nonzero(np.isnan(table["pmra"])):
            notes.append(f"stars of {name} without a proper motion, which was taken as zero: {missing:,}")
    catalogues = zip(result.galaxies.items(), matches.chance, matches.found_in.sum(axis=0), strict=True)
    return {
        "stars": {name: len(table) for name, table in result.stars.items()},
        "galaxies": matches.n_galaxies,
        "catalogues": {
            name: {
                "entries": len(table),
                "radius_arcsec": search.said["radius"][name],
                "matches": int(matched),
                **chance,
            }
            for (name, table), chance, matched in catalogues
        },
        "classes": {name: _means(columns[columns["class"] == name], magnitude, search) for name in CLASSES}
        | {"all": _means(columns, magnitude, search)},
        "reasons": {name: int(doubt.sum()) for name, doubt in matches.reasons.items()},
        "magnitude": magnitude,
        **{name: getattr(asked, name) for name in ("epoch", "k_sigma", "crowding_stars")},
        **{f"{name}_arcsec": getattr(asked, name) for name in ("crowding_radius", "merge_radius")},
        "epoch_difference_yr": asked.epoch_difference,
        "second_epoch_error_mas": asked.second_epoch_error,
        "notes": notes,
    }


def _means(columns: pd.DataFrame, magnitude: str | None, search: Search) -> dict[str, Any]:
    """Return number, means and scatter of a class, and the proper-motion error from a second epoch,
    sqrt(s1^2 + s2^2)/years.

    Source: Metz & Geffert 2004, Sect. 3.2: 117 and 127 mas give about 6 mas/yr, which is 20 yr with a second epoch
    without error.
    """

    def stats(name: str) -> dict[str, float]:
        return {"mean": float(columns[name].mean()), "scatter": float(columns[name].std())}

    errors = {key: stats(f"{key}_error") for key in ("ra", "dec")}
    years, second = search.asked.epoch_difference, search.asked.second_epoch_error
    return {
        "n": len(columns),
        "ra_error_mas": errors["ra"],
        "dec_error_mas": errors["dec"],
        "magnitude": None if magnitude is None else stats(magnitude),
        "pm_error_mas_yr": {key: float(np.hypot(error["mean"], second)) / years for key, error in errors.items()},
    }


def _summary(matches: xr.Dataset) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads(matches.attrs["summary"])
    return summary


def headline(matches: xr.Dataset) -> list[str]:
    """Return in a sentence how many stars are galaxies."""
    summary = _summary(matches)
    numbers = [f"{summary['classes'][name]['n']:,} {name}" for name in CLASSES]
    stars = sum(summary["stars"].values())
    return [f"{matches.sizes['match']:,} of {stars:,} stars are at a galaxy: {', '.join(numbers)}."]


def records(matches: xr.Dataset) -> Table:
    """Return a row for each match, beside the summary."""
    columns = []
    for name in matches.attrs["columns"]:
        cells, about = matches[name].values.tolist(), matches[name].attrs
        values = [np.nan if cell == about.get("missing", "") else cell for cell in cells]
        columns.append(Column(name, values, unit=about.get("units", ""), meaning=about.get("description", "")))
    return Table(columns, about=_summary(matches), meta=_summary(matches))


def tables(matches: xr.Dataset) -> list[Table]:
    """Return the tables for reading: the classes of matches, with what was searched, and the galaxy catalogues."""
    summary = _summary(matches)

    def column(name: str, cells: Sequence[str], unit: str = "", left: bool = False) -> Column:
        return Column(name, cells, cells, unit, name, rank=0 if left else 1, left=left)

    def with_scatter(value: Mapping[str, float] | None, digits: int) -> str:
        known = [] if value is None else [one for one in value.values() if not np.isnan(one)]
        return " ± ".join(f"{one:.{digits}f}" for one in known)

    rows = summary["classes"].values()
    motions = [", ".join(f"{v:.2g}" for v in row["pm_error_mas_yr"].values() if not np.isnan(v)) for row in rows]
    classes = [
        column("class", list(summary["classes"]), left=True),
        column("n", [f"{row['n']:,}" for row in rows]),
        column("ra_error", [with_scatter(row["ra_error_mas"], 0) for row in rows], "mas"),
        column("dec_error", [with_scatter(row["dec_error_mas"], 0) for row in rows], "mas"),
        column(summary["magnitude"] or "magnitude", [with_scatter(row["magnitude"], 1) for row in rows]),
        column("second-epoch pm error\nra, dec", motions, "mas / yr"),
    ]
    rows = summary["catalogues"].values()
    local = [with_error(row["chance_pairs_local"], row["chance_pairs_local_error"]) for row in rows]
    catalogues = [
        column("catalogue", list(summary["catalogues"]), left=True),
        column("entries", [f"{row['entries']:,}" for row in rows]),
        column("radius", [f"{row['radius_arcsec']:g}" for row in rows], "arcsec"),
        *(column(name, [f"{row[name]:,}" for row in rows]) for name in ("pairs", "matches")),
        column("chance pairs\nuniform sky", [f"{row['chance_pairs_uniform']:.3g}" for row in rows]),
        column("chance pairs\nfrom surroundings", local),
    ]
    stars = " + ".join(f"{n:,} in {name}" for name, n in summary["stars"].items())
    reasons = ", ".join(f"{name} {n}" for name, n in summary["reasons"].items())
    about = [
        f"stars: {stars}; galaxies after merging: {summary['galaxies']:,}; epoch {summary['epoch']:g}",
        f"second epoch: {summary['epoch_difference_yr']:g} yr later, error {summary['second_epoch_error_mas']:g} mas",
        f"in doubt (a match may be for several reasons): {reasons}",
    ]
    return [Table(classes, "\n".join(about)), Table(catalogues, "catalogues of galaxies:")]


def notes(matches: xr.Dataset) -> list[str]:
    """Return the sentences below the tables."""
    return [f"note: {note}" for note in _summary(matches)["notes"]]
