"""Positions with errors on the sphere: moved to another epoch, paired within a radius, resolved one to one.

Pairs are found with k-d trees of unit vectors.  Angles are radians, objects come first in arrays of directions, as a
tree needs them.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from linksweep.core.arrays import Array, Flags, Indices
from linksweep.core.constants import ARCSEC, DEGREE
from linksweep.core.frames import position, triad

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
