"""The galaxy search: matches of a star catalogue with galaxy catalogues on the sphere, and how sure each one is.

All positions are for one epoch (`at_epoch`); angles are radians.  Every star-galaxy pair within a catalogue's radius is
found with k-d trees of unit vectors, entries that are one galaxy are merged, the rest is resolved one to one, closest
pair first, and each match is classified.

Source: Metz & Geffert 2004, Sect. 3; the rules of the classes replace the paper's inspection by eye.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from linksweep.core.frames import ARCSEC, DEGREE, Array, Flags, Indices, position, triad

MAX_RADIUS = 1.0 * DEGREE

MAX_PAIRS = 2e6
"""Largest number of chance pairs within a radius, half a minute of work: more are no search for counterparts."""


@dataclass(frozen=True)
class Positions:
    """N positions at one epoch: ra, dec and their standard errors (that of ra with cos dec) in rad, shape (N,)."""

    ra: Array
    dec: Array
    ra_error: Array
    dec_error: Array

    def __len__(self) -> int:
        return len(self.ra)

    def taken(self, rows: Indices) -> "Positions":
        """Return the positions in some rows."""
        return Positions(self.ra[rows], self.dec[rows], self.ra_error[rows], self.dec_error[rows])


class Pairs(NamedTuple):
    """Pairs of objects: an index into each side and the angle between them (rad), all of shape (M,)."""

    first: Indices
    second: Indices
    offset: Array


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
    """Return a k-d tree of the unit vectors of N positions.

    It is not balanced: it is then built and searched twice as fast for points all over a sphere, 2.5 million in 0.7 s.
    """
    vectors = np.ascontiguousarray(triad(positions.ra, positions.dec).r.T)
    return KDTree(vectors, balanced_tree=False, compact_nodes=False)


def chord(angle: float) -> float:
    """Return the distance of two unit vectors that enclose an angle (rad)."""
    return float(2.0 * np.sin(0.5 * angle))


def pairs_within(first: KDTree, second: KDTree, radius: float) -> Pairs:
    """Return all pairs of two sky trees at most ``radius`` (rad) apart, in no particular order.

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
    found = first.sparse_distance_matrix(second, chord(radius), output_type="ndarray")
    return Pairs(
        found["i"].astype(np.int64), found["j"].astype(np.int64), 2.0 * np.arcsin(np.minimum(0.5 * found["v"], 1.0))
    )


def uniform_pairs(n_first: int, n_second: int, radius: float) -> float:
    """Return the expected number of pairs within ``radius`` (rad) of objects scattered uniformly over the sphere.

    A cap of angular radius t is the fraction (1 - cos t)/2 = sin^2(t/2) of the sphere.
    """
    return float(n_first) * float(n_second) * float(np.sin(0.5 * radius)) ** 2


def count_near(tree: KDTree, members: Positions, radius: float) -> Indices:
    """Return how many other objects of a sky tree stand within ``radius`` (rad) of each of its ``members``."""
    vectors = np.ascontiguousarray(triad(members.ra, members.dec).r.T)
    counts = tree.query_ball_point(vectors, chord(radius), return_length=True)
    return np.asarray(counts, dtype=np.int64).reshape(len(members)) - 1


def one_to_one(first: Indices, second: Indices) -> Flags:
    """Return which of M pairs are kept when, best pair first, a pair is kept if neither of its objects is taken.

    The pairs (first[i], second[i]) must come in order of preference; no pair may occur twice.  Pairs that share no
    object with another are settled at once, so the loop is over the ambiguous ones only.
    """
    kept: Flags = np.ones(len(first), dtype=bool)
    ambiguous = np.flatnonzero((occurrences(first) > 1) | (occurrences(second) > 1))
    taken_first: set[int] = set()
    taken_second: set[int] = set()
    for i, a, b in zip(ambiguous.tolist(), first[ambiguous].tolist(), second[ambiguous].tolist(), strict=True):
        if a in taken_first or b in taken_second:
            kept[i] = False
        else:
            taken_first.add(a)
            taken_second.add(b)
    return kept


def occurrences(labels: Indices) -> Indices:
    """Return for each element how often its value occurs; shape (M,)."""
    _, inverse, counts = np.unique(labels, return_inverse=True, return_counts=True)
    return np.asarray(counts[inverse], dtype=np.int64)


def displacement(stars: Positions, galaxies: Positions) -> tuple[Array, Array, Array]:
    """Return the components of galaxy - star along ra (with cos dec) and dec in rad, and the normalised offset.

    The normalised offset is sqrt((d_ra/s_ra)^2 + (d_dec/s_dec)^2) with the errors of both sides added in quadrature;
    for normal errors it is larger than k with probability exp(-k^2/2).  All of shape (M,).
    """
    p, q, r = triad(stars.ra, stars.dec)
    step = triad(galaxies.ra, galaxies.dec).r - r
    d_ra, d_dec = np.sum(p * step, axis=0), np.sum(q * step, axis=0)
    n_sigma = np.hypot(
        d_ra / np.hypot(stars.ra_error, galaxies.ra_error), d_dec / np.hypot(stars.dec_error, galaxies.dec_error)
    )
    return d_ra, d_dec, n_sigma


CERTAIN, UNCERTAIN, SUPPLEMENT = 0, 1, 2

CLASS_NAMES = ("certain", "uncertain", "supplement")
"""Names of the codes `CERTAIN`, `UNCERTAIN` and `SUPPLEMENT`.  Source: Metz & Geffert 2004, Sect. 3.1."""

CROWDED, OFFSET, RIVAL = 1, 2, 4

REASON_NAMES = {CROWDED: "crowded", OFFSET: "offset", RIVAL: "rival"}
"""Names of the bits in `Matches.reason`."""

RING = (5.0, 10.0)
"""Chance pairs are counted in a ring between these multiples of the radius, where no true counterpart is left."""


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


@dataclass(frozen=True)
class Chance:
    """One catalogue's pairs within its radius, and how many of them chance would make.

    ``uniform`` is for two uniform skies, ``local`` (+- ``local_error``) from the pairs in a ring about the galaxies.
    """

    pairs: int
    uniform: float
    local: float
    local_error: float


def classify(
    supplement: Flags, n_sigma: Array, n_near: Indices, n_rival: Indices, rules: Rules
) -> tuple[Indices, Indices]:
    """Return the class of each match and the bits of the reasons for doubt; all of shape (M,).

    A match is in doubt if its star field is crowded (`CROWDED`), if its offset exceeds k sigma (`OFFSET`) or if there
    was another candidate for the star or the galaxy (`RIVAL`).  Stars of the supplement are a class of their own, as
    in the paper, whatever the doubts.
    """
    reason = (
        CROWDED * (n_near >= rules.crowding_stars) + OFFSET * (n_sigma > rules.k_sigma) + RIVAL * (n_rival > 0)
    ).astype(np.int64)
    code = np.where(supplement, SUPPLEMENT, np.where(reason > 0, UNCERTAIN, CERTAIN))
    return code.astype(np.int64), reason


def chance_pairs(stars: KDTree, galaxies: KDTree, radius: float, n_pairs: int) -> Chance:
    """Return the chance pairs of two sky trees within ``radius`` (rad), beside the ``n_pairs`` that were found."""
    inner, outer = (chord(multiple * radius) for multiple in RING)
    in_inner, in_outer = np.asarray(stars.count_neighbors(galaxies, np.array([inner, outer])), dtype=np.float64)
    to_circle = chord(radius) ** 2 / (outer**2 - inner**2)  # the area of a cap is pi chord^2
    in_ring = float(in_outer - in_inner)
    return Chance(
        pairs=n_pairs,
        uniform=uniform_pairs(stars.n, galaxies.n, radius),
        local=in_ring * to_circle,
        local_error=float(np.sqrt(max(in_ring, 1.0))) * to_circle,  # at least one pair, also where there is none
    )


_Links = tuple[Indices, Indices, Array, Array, Array]
"""Galaxies and entries that may be one, their offsets, and ra and dec of the galaxies' entries, which settle ties."""


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
    for c, catalogue in enumerate(catalogues):
        label = _label_by_identifier(catalogue.identifier, known)
        linked = np.zeros(len(known), dtype=bool)
        linked[label[label >= 0]] = True
        links: list[_Links] = []
        for earlier, tree, earlier_label in zip(catalogues[:c], trees[:c], labels, strict=True):
            radius = earlier.radius + catalogue.radius if merge_radius is None else merge_radius
            pairs = pairs_within(tree, trees[c], radius)
            galaxy, entry = earlier_label[pairs.first], pairs.second
            # neither side is linked yet, and at most one has an identifier
            free = ~linked[galaxy] & (label[entry] < 0) & ((known[galaxy] == 0) | (catalogue.identifier[entry] == 0))
            where, at = earlier.positions, pairs.first[free]
            links.append((galaxy[free], entry[free], pairs.offset[free], where.ra[at], where.dec[at]))
        if links:
            galaxy, entry = _closest_links(links, catalogue, known)
            label[entry] = galaxy
            known = known.copy()
            known[galaxy] = np.maximum(known[galaxy], catalogue.identifier[entry])
            label = np.where(label < 0, _label_by_identifier(catalogue.identifier, known), label)
        known = _number_the_rest(label, catalogue.identifier, known)
        labels.append(label)
    return labels, known


def _label_by_identifier(identifier: Indices, known: Indices) -> Indices:
    """Return the number of the galaxy with each entry's identifier, -1 for none."""
    label = np.full(len(identifier), -1, dtype=np.int64)
    named = np.flatnonzero(known)
    if len(named):
        named = named[np.argsort(known[named])]
        at = np.minimum(np.searchsorted(known[named], identifier), len(named) - 1)
        hit = (identifier > 0) & (known[named[at]] == identifier)
        label[hit] = named[at[hit]]
    return label


def _closest_links(links: Sequence[_Links], catalogue: GalaxyCatalogue, known: Indices) -> tuple[Indices, Indices]:
    """Return galaxies and their entries, one to one, closest first; entries of one identifier count as one."""
    galaxy, entry, offset, ra, dec = (np.concatenate(column) for column in zip(*links, strict=True))
    where, identifier = catalogue.positions, catalogue.identifier
    ties = (known[galaxy], identifier[entry], where.ra[entry], where.dec[entry], ra, dec)
    order = np.lexsort((*ties, offset))
    galaxy, entry = galaxy[order], entry[order]
    object_of_entry = np.where(identifier > 0, identifier, -1 - np.arange(len(identifier)))[entry]
    _, number = np.unique(object_of_entry, return_inverse=True)
    first = np.sort(np.unique(galaxy * (len(number) + 1) + number, return_index=True)[1])
    first = first[one_to_one(galaxy[first], number[first])]
    return galaxy[first], entry[first]


def _number_the_rest(label: Indices, identifier: Indices, known: Indices) -> Indices:
    """Number the entries that have no galaxy yet, in place; return the identifiers of all galaxies."""
    new = np.flatnonzero(label < 0)
    named, nameless = new[identifier[new] > 0], new[identifier[new] == 0]
    names, inverse = np.unique(identifier[named], return_inverse=True)
    label[named] = len(known) + inverse
    label[nameless] = len(known) + len(names) + np.arange(len(nameless))
    return np.concatenate([known, names, np.zeros(len(nameless), dtype=np.int64)])


@dataclass(frozen=True)
class Matches:
    """M star-galaxy matches in order of the star's ra and dec at the epoch of the search; none occurs twice.

    ``star`` indexes the stars, ``catalogue`` and ``entry`` the closest galaxy entry, ``galaxy`` the merged galaxies.
    ``offset`` (rad) and its components ``d_ra`` (with cos dec) and ``d_dec`` are galaxy - star, ``n_sigma`` is the
    offset in units of the combined errors.  ``n_near`` counts other stars within the crowding radius, ``n_rival`` the
    other stars and galaxies within the match radius.  ``found_in`` (M, number of catalogues) says which catalogues
    have the galaxy within their radius, ``code`` is the class, ``reason`` the bits that made it uncertain, and
    ``identifier`` the galaxy's (0 for none).
    """

    star: Indices
    catalogue: Indices
    entry: Indices
    galaxy: Indices
    identifier: Indices
    offset: Array
    d_ra: Array
    d_dec: Array
    n_sigma: Array
    n_near: Indices
    n_rival: Indices
    found_in: Flags
    code: Indices
    reason: Indices
    chance: tuple[Chance, ...]
    n_galaxies: int

    def __len__(self) -> int:
        return len(self.star)


def cross_match(
    stars: Positions, supplement: Flags, catalogues: Sequence[GalaxyCatalogue], rules: Rules | None = None
) -> Matches:
    """Return the one-to-one matches of stars with galaxies, with their class.

    All positions are for one epoch.  ``supplement`` (N,) marks stars of the supplement, which match like the others.
    The result does not depend on the order of rows: pairs at equal offset are ordered by the place of their
    catalogue, then by position and identifier.  Raises ValueError as `pairs_within`.
    """
    rules = rules or Rules()
    star_tree, trees = sky_tree(stars), [sky_tree(c.positions) for c in catalogues]
    found = [pairs_within(star_tree, tree, c.radius) for tree, c in zip(trees, catalogues, strict=True)]
    labels, identifiers = merge_galaxies(catalogues, trees, rules.merge_radius)
    pairs = _Pairs(
        star=np.concatenate([pairs.first for pairs in found]),
        catalogue=np.repeat(np.arange(len(found)), [len(pairs.first) for pairs in found]),
        entry=np.concatenate([pairs.second for pairs in found]),
        galaxy=np.concatenate([label[pairs.second] for label, pairs in zip(labels, found, strict=True)]),
        offset=np.concatenate([pairs.offset for pairs in found]),
    )
    kept, n_rival, found_in = _resolve(pairs, stars, supplement, catalogues, identifiers)

    here, there = stars.taken(kept.star), _galaxies(catalogues, kept)
    d_ra, d_dec, n_sigma = displacement(here, there)
    n_near = count_near(star_tree, here, rules.crowding_radius)
    code, reason = classify(supplement[kept.star], n_sigma, n_near, n_rival, rules)
    chance = tuple(
        chance_pairs(star_tree, tree, c.radius, len(pairs.first))
        for tree, c, pairs in zip(trees, catalogues, found, strict=True)
    )
    return Matches(
        **kept._asdict(),
        identifier=identifiers[kept.galaxy],
        d_ra=d_ra,
        d_dec=d_dec,
        n_sigma=n_sigma,
        n_near=n_near,
        n_rival=n_rival,
        found_in=found_in,
        code=code,
        reason=reason,
        chance=chance,
        n_galaxies=len(identifiers),
    )


class _Pairs(NamedTuple):
    """Star-galaxy pairs of all catalogues, each of shape (M,); as in `Matches`."""

    star: Indices
    catalogue: Indices
    entry: Indices
    galaxy: Indices
    offset: Array


def _resolve(
    pairs: _Pairs, stars: Positions, supplement: Flags, catalogues: Sequence[GalaxyCatalogue], identifiers: Indices
) -> tuple[_Pairs, Indices, Flags]:
    """Return the pairs that are matches in order of the star's position, and their ``n_rival`` and ``found_in``."""
    star, which, _, galaxy, offset = pairs
    there = _galaxies(catalogues, pairs)
    ra, dec = stars.ra[star], stars.dec[star]
    best_first = np.lexsort((identifiers[galaxy], there.ra, there.dec, ra, dec, supplement[star], which, offset))
    _, first, inverse = np.unique(
        (star * len(identifiers) + galaxy)[best_first], return_index=True, return_inverse=True
    )
    nearest = best_first[np.sort(first)]  # the closest entry of each star-galaxy pair
    rivals = occurrences(star[nearest]) + occurrences(galaxy[nearest]) - 2
    winner = np.flatnonzero(one_to_one(star[nearest], galaxy[nearest]))
    winner = winner[np.lexsort((dec[nearest[winner]], ra[nearest[winner]]))]
    kept = nearest[winner]

    match_of_pair = np.full(len(nearest), -1)  # by number of the pair in `inverse`
    match_of_pair[inverse[np.argsort(best_first)[kept]]] = np.arange(len(kept))
    row = match_of_pair[inverse]
    found_in = np.zeros((len(kept), len(catalogues)), dtype=bool)
    found_in[row[row >= 0], which[best_first][row >= 0]] = True
    return _Pairs(*(column[kept] for column in pairs)), rivals[winner], found_in


def _galaxies(catalogues: Sequence[GalaxyCatalogue], pairs: _Pairs) -> Positions:
    """Return the positions of the galaxies of pairs; shape (M,)."""
    parts = [(c.positions.ra, c.positions.dec, c.positions.ra_error, c.positions.dec_error) for c in catalogues]
    starts = np.cumsum([0, *(len(c.positions) for c in catalogues)])
    return Positions(*map(np.concatenate, zip(*parts, strict=True))).taken(starts[pairs.catalogue] + pairs.entry)
