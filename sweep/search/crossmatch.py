"""The galaxy search: matches of a star catalogue with galaxy catalogues on the sphere, and how sure each one is.

All positions are for one epoch (`at_epoch`); angles are radians.  Every star-galaxy pair within a catalogue's radius is
found with k-d trees of unit vectors, entries that are one galaxy are merged, the rest is resolved one to one, closest
pair first, and each match is classified.

Source: Metz & Geffert 2004, Sect. 3; the rules of the classes replace the paper's inspection by eye.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.spatial import KDTree

from linksweep.core.frames import ARCSEC, DEGREE, Array, Flags, Indices, position, triad

MAX_RADIUS = 1.0 * DEGREE

MAX_PAIRS = 2e6
"""Largest number of chance pairs within a radius, half a minute of work: more are no search for counterparts."""

CLASSES = ("certain", "uncertain", "supplement")
"""Source: Metz & Geffert 2004, Sect. 3.1."""

RING = (5.0, 10.0)
"""Chance pairs are counted in a ring between these multiples of the radius, where no true counterpart is left."""


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
    ra, dec = position(r + (p * pmra + q * pmdec) * years)
    return Positions(
        ra, dec, np.hypot(positions.ra_error, pmra_error * years), np.hypot(positions.dec_error, pmdec_error * years)
    )


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

    Raises ValueError for a radius outside (0, 1 degree], or one that is expected to give more than `MAX_PAIRS`.
    """
    if not 0.0 < radius <= MAX_RADIUS:
        raise ValueError(f"radius = {radius / ARCSEC:g} arcsec: must be above 0 and at most {MAX_RADIUS / ARCSEC:g}")
    expected = uniform_pairs(first.n, second.n, radius)
    if expected > MAX_PAIRS:
        raise ValueError(
            f"radius = {radius / ARCSEC:g} arcsec: about {expected:.1e} chance pairs of {first.n} and {second.n} "
            f"objects, more than {MAX_PAIRS:.0e}; take a smaller one"
        )
    pairs = first.sparse_distance_matrix(second, chord(radius), output_type="ndarray")
    return pairs["i"].astype(np.int64), pairs["j"].astype(np.int64), 2.0 * np.arcsin(np.minimum(0.5 * pairs["v"], 1.0))


def one_to_one(pairs: pd.DataFrame, first: str, second: str) -> pd.DataFrame:
    """Return the pairs, best first, that are kept if a pair counts only where neither of its objects is taken yet."""
    # pairs that share no object with another are settled at once, so the loop is over the ambiguous ones only
    ambiguous = pairs.duplicated(first, keep=False) | pairs.duplicated(second, keep=False)
    kept = ~ambiguous.to_numpy()
    taken: tuple[set[int], set[int]] = set(), set()
    columns = (pairs.loc[ambiguous, name].tolist() for name in (first, second))
    for row, a, b in zip(np.flatnonzero(ambiguous).tolist(), *columns, strict=True):
        if a not in taken[0] and b not in taken[1]:
            kept[row] = True
            taken[0].add(a)
            taken[1].add(b)
    return pairs[kept]


@dataclass(frozen=True)
class Rules:
    """What makes a match uncertain: a normalised offset above ``k_sigma``, or at least ``crowding_stars`` other stars
    within ``crowding_radius`` (rad).

    ``merge_radius`` (rad) is how far apart entries of two galaxy catalogues may be one galaxy; None for the sum of
    their match radii, so that two entries found at one star are one galaxy.
    """

    k_sigma: float = 3.0
    crowding_radius: float = 120.0 * ARCSEC
    crowding_stars: int = 3
    merge_radius: float | None = None


class Chance(NamedTuple):
    """One catalogue's pairs within its radius, and how many of them chance would make.

    ``uniform`` is for two uniform skies, ``local`` (+- ``local_error``) from the pairs in a ring about the galaxies.
    """

    pairs: int
    uniform: float
    local: float
    local_error: float


def chance_pairs(stars: KDTree, galaxies: KDTree, radius: float, n_pairs: int) -> Chance:
    """Return the chance pairs of two sky trees within ``radius`` (rad), beside the ``n_pairs`` that were found."""
    inner, outer = (chord(multiple * radius) for multiple in RING)
    in_inner, in_outer = np.asarray(stars.count_neighbors(galaxies, np.array([inner, outer])), dtype=np.float64)
    to_circle = chord(radius) ** 2 / (outer**2 - inner**2)  # the area of a cap is pi chord^2
    in_ring = float(in_outer - in_inner)
    # at least one pair, also where there is none
    error = float(np.sqrt(max(in_ring, 1.0))) * to_circle
    return Chance(n_pairs, uniform_pairs(stars.n, galaxies.n, radius), in_ring * to_circle, error)


@dataclass(frozen=True)
class GalaxyCatalogue:
    """Positions, an identifier that galaxy catalogues share (the PGC number; 0 for none; shape (N,)) and the match
    radius (rad).
    """

    positions: Positions
    identifier: Indices
    radius: float


def merge_galaxies(
    catalogues: Sequence[GalaxyCatalogue], trees: Sequence[KDTree], merge_radius: float | None = None
) -> tuple[list[Indices], Indices]:
    """Return a galaxy's number for every entry of every catalogue, and the identifier of every galaxy (0 for none).

    Entries with the same identifier are one galaxy wherever they stand.  Otherwise an entry is the galaxy of an entry
    of an earlier catalogue within ``merge_radius`` (see `Rules`), one to one and closest first, unless both have
    identifiers.  ``trees`` are the catalogues' sky trees.  Raises ValueError as `pairs_within`.
    """
    labels: list[Indices] = []
    known = np.empty(0, dtype=np.int64)  # identifier of each galaxy so far
    for catalogue, tree in zip(catalogues, trees, strict=True):
        identifier, where = catalogue.identifier, catalogue.positions
        label = _label_by_identifier(identifier, known)
        # entries of one identifier count as one
        names, _ = pd.factorize(np.where(identifier > 0, identifier, -1 - np.arange(len(identifier))))
        links = []
        for earlier, earlier_tree, earlier_label in zip(catalogues, trees, labels, strict=False):
            radius = earlier.radius + catalogue.radius if merge_radius is None else merge_radius
            at, entry, offset = pairs_within(earlier_tree, tree, radius)
            galaxy, there = earlier_label[at], earlier.positions.take(at)
            links.append(
                pd.DataFrame({"offset": offset, "dec": there.dec, "ra": there.ra, "galaxy": galaxy, "entry": entry})
            )
        if links:
            link = pd.concat(links)
            galaxy, entry = link["galaxy"].to_numpy(), link["entry"].to_numpy()
            link = link.assign(name=names[entry], known=known[galaxy], mine=identifier[entry])
            link = link.assign(entry_dec=where.dec[entry], entry_ra=where.ra[entry])
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
    chance: tuple[Chance, ...]
    n_galaxies: int

    def __getitem__(self, name: str) -> Any:
        return self.table[name].to_numpy()

    def __len__(self) -> int:
        return len(self.table)


def cross_match(
    stars: Positions, supplement: Flags, catalogues: Sequence[GalaxyCatalogue], rules: Rules | None = None
) -> Matches:
    """Return the one-to-one matches of stars with galaxies, with their class.

    All positions are for one epoch.  ``supplement`` (N,) marks stars of the supplement, which match like the others.
    The result does not depend on the order of rows: pairs at equal offset are ordered by the place of their
    catalogue, then by position and identifier.  Raises ValueError as `pairs_within`.
    """
    rules = rules or Rules()
    star_tree, trees = sky_tree(stars), [sky_tree(catalogue.positions) for catalogue in catalogues]
    within = [pairs_within(star_tree, tree, c.radius) for tree, c in zip(trees, catalogues, strict=True)]
    labels, identifiers = merge_galaxies(catalogues, trees, rules.merge_radius)
    each = []
    for number, ((star, entry, offset), label, catalogue) in enumerate(zip(within, labels, catalogues, strict=True)):
        galaxy, (ra, dec, ra_error, dec_error) = label[entry], catalogue.positions.take(entry)
        columns = {"star": star, "catalogue": number, "entry": entry, "galaxy": galaxy, "offset": offset}
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
    n_near = star_tree.query_ball_point(here.vectors, chord(rules.crowding_radius), return_length=True) - 1
    n_rival = table["n_rival"].to_numpy()
    reasons = pd.DataFrame(
        {"crowded": n_near >= rules.crowding_stars, "offset": n_sigma > rules.k_sigma, "rival": n_rival > 0}
    )
    # the supplement is a class of its own, as in the paper, whatever the doubts
    code = np.where(table["supplement"], 2, reasons.any(axis=1))
    match = table[["star", "galaxy"]].assign(match=np.arange(len(table)))
    inside = pairs.merge(match, on=["star", "galaxy"])
    found_in = np.zeros((len(table), len(catalogues)), dtype=bool)
    found_in[inside["match"], inside["catalogue"]] = True
    chance = tuple(
        chance_pairs(star_tree, tree, c.radius, len(near[0]))
        for tree, c, near in zip(trees, catalogues, within, strict=True)
    )
    columns = {"d_ra": d_ra, "d_dec": d_dec, "n_sigma": n_sigma, "n_near": n_near, "class": np.array(CLASSES)[code]}
    table = table.assign(**columns).reset_index(drop=True)
    return Matches(table, found_in, reasons, chance, len(identifiers))
