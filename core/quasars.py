"""The quasar counts of the paper, and catalogues drawn from them."""

import itertools
from functools import lru_cache

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.catalogue import Catalogue, Sky

V_MAX = np.arange(14.0, 20.5, 0.5)
COUNT = np.array([28, 49, 88, 163, 315, 624, 1156, 2056, 3453, 5542, 8095, 11442, 15533])
"""Quasars brighter than each of `V_MAX`.  Source: Metz & Geffert 2004, Table 1 (from Veron-Cetty & Veron 2001)."""

BRIGHTEST_MAG = 12.8
"""Bright end of the counts; 3C 273 has V = 12.9."""

_COMPLETENESS = ((16.5, 0.57), (19.0, 0.054))
"""Fraction of all quasars brighter than V that the catalogue holds.  Source: Metz & Geffert 2004, Sect. 5.1 (57 +- 16
% and 5.4 +- 0.1 %, from the SDSS)."""


@lru_cache(maxsize=1024)
def quasar_count(v_max: float, completed: bool = False) -> int:
    """Return how many quasars are brighter than ``v_max``: the paper's number at its half magnitudes, log-linear
    between.

    Below V = 14 the first slope is extrapolated.  ``completed`` divides by `completeness`.  Raises ValueError outside
    12.8 <= v_max <= 20.
    """
    if not BRIGHTEST_MAG <= v_max <= V_MAX[-1]:
        raise ValueError(
            f"v_max = {v_max:g} mag is outside the quasar counts: the brightest object has V = {BRIGHTEST_MAG}, "
            f"the counts end at V = {V_MAX[-1]:g}"
        )
    in_catalogue = np.exp(_log_count(np.array([v_max])))[0]
    return round(float(in_catalogue / (completeness(v_max) if completed else 1.0)))


def completeness(v_max: float) -> float:
    """Return which fraction of the quasars brighter than ``v_max`` the paper's catalogue holds.

    Log-linear through the two values of the paper, also beyond them, and at most 1: everything brighter than V = 15.9
    is known.  At V = 20 this gives 2.1 % of 740 000 quasars; the paper speaks of about 500 000 for GAIA.
    """
    (bright, f_bright), (faint, f_faint) = _COMPLETENESS
    slope = np.log(f_faint / f_bright) / (faint - bright)
    return float(min(1.0, f_bright * np.exp(slope * (v_max - bright))))


def quasars(
    rng: np.random.Generator, v_max: float, sky: Sky, completed: bool = False, v_min: float = BRIGHTEST_MAG
) -> Catalogue:
    """Return the quasars between two limits at random positions, without proper motion, brightest bin first.

    Catalogues drawn from equal generators are nested: that of a brighter ``v_max`` at a half magnitude is the beginning
    of that of a fainter one.  Within a half-magnitude bin log N is linear in V; quasars that the extrapolation would
    put above V = 12.8 stand at 12.8, as in the calibration of the mission curves.  Raises ValueError as `quasar_count`.
    """
    known = [float(v) for v in V_MAX if v_min < v < v_max]
    if v_min > BRIGHTEST_MAG:
        edges, counts = [v_min, *known, v_max], [quasar_count(v_min, completed)]
    else:
        edges, counts = [0.0, BRIGHTEST_MAG, *known, v_max], [0]
    counts += [quasar_count(v, completed) for v in edges[1:]]
    bins = [
        _bin(rng, sky, *magnitudes, *numbers)
        for magnitudes, numbers in zip(itertools.pairwise(edges), itertools.pairwise(counts), strict=True)
    ]
    ra, dec, v_mag = (np.concatenate(column, axis=-1) for column in zip(*bins, strict=True))
    return Catalogue(ra, dec, np.zeros_like(ra), np.zeros_like(ra), v_mag)


def _bin(
    rng: np.random.Generator, sky: Sky, bright: float, faint: float, low: int, high: int
) -> tuple[Array, Array, Array]:
    ra, dec = sky.positions(rng, high - low)
    rank = high - (high - low) * rng.random(high - low)  # in (low, high]: never log 0
    if low == 0:
        return ra, dec, np.full_like(rank, faint)
    return ra, dec, bright + (faint - bright) * np.log(rank / low) / np.log(high / low)


def _log_count(v_mag: Array) -> Array:
    log_count = np.log(COUNT)
    slope = (log_count[1] - log_count[0]) / (V_MAX[1] - V_MAX[0])
    bright = log_count[0] + slope * (v_mag - V_MAX[0])
    return np.asarray(np.where(v_mag < V_MAX[0], bright, np.interp(v_mag, V_MAX, log_count)))
