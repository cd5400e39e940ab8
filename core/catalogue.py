"""Reference catalogues (step A): synthetic skies and the quasar counts of the paper."""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.constants import GALACTIC_AXES
from core.frames import position

Array = NDArray[np.float64]

QUASAR_V_MAX = np.arange(14.0, 20.5, 0.5)
QUASAR_COUNT = np.array([28, 49, 88, 163, 315, 624, 1156, 2056, 3453, 5542, 8095, 11442, 15533])
"""Quasars brighter than each of `QUASAR_V_MAX`.  Source: Metz & Geffert 2004, Table 1 (from Veron-Cetty & Veron
2001).
"""

QUASAR_BRIGHTEST_MAG = 12.8
"""Where the counts end; 3C 273 has V = 12.9."""


@dataclass(frozen=True)
class Catalogue:
    """Objects as arrays of shape (N,): ra, dec (rad), pmra, pmdec (rad/yr, pmra with cos dec) and V magnitude."""

    ra: Array
    dec: Array
    pmra: Array
    pmdec: Array
    v_mag: Array

    def __len__(self) -> int:
        return len(self.ra)

    def take(self, index: NDArray[np.intp]) -> "Catalogue":
        """Return the objects at these indices."""
        return Catalogue(self.ra[index], self.dec[index], self.pmra[index], self.pmdec[index], self.v_mag[index])


def isotropic_positions(rng: np.random.Generator, n_obj: int, zone_of_avoidance: float = 0.0) -> tuple[Array, Array]:
    """Return ra, dec (rad, shape (n_obj,)) uniform over the sky outside Galactic latitudes |b| < zone_of_avoidance
    (rad).
    """
    longitude = rng.uniform(0.0, 2.0 * np.pi, n_obj)
    height = rng.uniform(-1.0, 1.0, n_obj)
    floor = np.sin(zone_of_avoidance)
    sin_b = np.sign(height) * (floor + (1.0 - floor) * np.abs(height))
    cos_b = np.sqrt(1.0 - sin_b**2)
    galactic = np.stack([cos_b * np.cos(longitude), cos_b * np.sin(longitude), sin_b])
    return position(GALACTIC_AXES.T @ galactic)


def synthetic(
    rng: np.random.Generator,
    n_obj: int,
    v_min: float,
    v_max: float,
    mean_pm: float = 0.0,
    zone_of_avoidance: float = 0.0,
) -> Catalogue:
    """Return objects with isotropic positions, uniform magnitudes and isotropic proper motions.

    The paper has "equally distributed apparent brightnesses and proper motions" (Metz & Geffert 2004, Sect. 4.1); that
    the modulus of a proper motion is uniform between 0 and twice its mean ``mean_pm`` (rad/yr) is our reading of it.
    """
    ra, dec = isotropic_positions(rng, n_obj, zone_of_avoidance)
    v_mag = rng.uniform(v_min, v_max, n_obj)
    modulus = rng.uniform(0.0, 2.0, n_obj) * mean_pm
    direction = rng.uniform(0.0, 2.0 * np.pi, n_obj)
    return Catalogue(ra, dec, modulus * np.sin(direction), modulus * np.cos(direction), v_mag)


def quasar_count(v_max: float) -> int:
    """Return how many quasars are brighter than ``v_max``: the paper's number at its half magnitudes, log-linear
    between.

    Below V = 14 the first slope is extrapolated.  Raises ValueError outside 12.8 <= v_max <= 20.
    """
    if not QUASAR_BRIGHTEST_MAG <= v_max <= QUASAR_V_MAX[-1]:
        raise ValueError(
            f"v_max = {v_max:g} mag is outside the quasar counts: the brightest object has V = {QUASAR_BRIGHTEST_MAG}, "
            f"the counts end at V = {QUASAR_V_MAX[-1]:g}"
        )
    return round(_smooth_count(v_max))


def quasars(rng: np.random.Generator, v_max: float) -> Catalogue:
    """Return the quasars brighter than ``v_max`` at isotropic positions, without proper motion, brightest bin first.

    Catalogues drawn from equal generators are nested: that of a brighter limit at a half magnitude is the beginning of
    that of a fainter one.  Within a half-magnitude bin log N is linear in V; quasars that the extrapolation would put
    above V = 12.8 stand at 12.8, as in the calibration of the mission curves.  Raises ValueError as `quasar_count`.
    """
    last = quasar_count(v_max)
    edges = [0, *(int(n) for n in QUASAR_COUNT if n < last), last]
    bins = [_quasar_bin(rng, low, high) for low, high in itertools.pairwise(edges)]
    ra, dec, v_mag = (np.concatenate(column) for column in zip(*bins, strict=True))
    return Catalogue(ra, dec, np.zeros(last), np.zeros(last), np.minimum(v_mag, v_max))


def _quasar_bin(rng: np.random.Generator, low: int, high: int) -> tuple[Array, Array, Array]:
    ra, dec = isotropic_positions(rng, high - low)
    rank = high - (high - low) * rng.random(high - low)  # in (low, high]: never log 0
    return ra, dec, np.maximum(_magnitude_of_rank(rank), QUASAR_BRIGHTEST_MAG)


def _smooth_count(v_mag: float) -> float:
    log_count = np.log(QUASAR_COUNT)
    slope = (log_count[1] - log_count[0]) / (QUASAR_V_MAX[1] - QUASAR_V_MAX[0])
    bright = log_count[0] + slope * (v_mag - QUASAR_V_MAX[0])
    return float(np.exp(bright if v_mag < QUASAR_V_MAX[0] else np.interp(v_mag, QUASAR_V_MAX, log_count)))


def _magnitude_of_rank(rank: Array) -> Array:
    """Return the V at which the smooth count reaches ``rank``: the inverse of `_smooth_count`."""
    log_count, log_rank = np.log(QUASAR_COUNT), np.log(rank)
    slope = (log_count[1] - log_count[0]) / (QUASAR_V_MAX[1] - QUASAR_V_MAX[0])
    bright = QUASAR_V_MAX[0] + (log_rank - log_count[0]) / slope
    return np.asarray(np.where(rank < QUASAR_COUNT[0], bright, np.interp(log_rank, log_count, QUASAR_V_MAX)))
