"""Exact motion of stars between epochs, the parallax factors of an epoch, and differences on the sky."""

from functools import lru_cache

import erfa
import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.constants import ARCSEC
from linksweep.core.frames import triad

J2000 = 2451545.0
DAYS_PER_YEAR = 365.25
KEPT_EPOCHS = 10_000


def propagated(values: Array, radial_velocity: Array | None, epoch: Array, new_epoch: Array) -> Array:
    """Return (ra, dec, parallax, pmra, pmdec) at another epoch; all (5, N) in rad and rad/yr, epochs in Julian years.

    Uniform motion in space with light time (ERFA `pmsafe`).  ``radial_velocity`` is in km/s.  A missing value (NaN)
    counts as zero here and stays missing; a parallax that is not positive stays as it is and means a great distance.
    """
    found = values.copy()
    moving = np.flatnonzero(new_epoch != epoch)
    if not len(moving):
        return found
    ra, dec, parallax, pmra, pmdec = np.where(np.isfinite(values[:, moving]), values[:, moving], 0.0)
    velocity = np.zeros(len(moving)) if radial_velocity is None else np.nan_to_num(radial_velocity[moving])
    distant = parallax <= 0.0
    velocity = np.where(distant, 0.0, velocity)
    # the ufunc itself, because erfa.pmsafe warns about every distance that it has to assume
    ra2, dec2, motion_ra, motion_dec, parallax2, _, _ = erfa.ufunc.pmsafe(
        ra,
        dec,
        pmra / np.cos(dec),
        pmdec,
        np.maximum(parallax, 0.0) / ARCSEC,
        velocity,
        J2000,
        (epoch[moving] - 2000.0) * DAYS_PER_YEAR,
        J2000,
        (new_epoch[moving] - 2000.0) * DAYS_PER_YEAR,
    )
    known = np.isfinite(values[:, moving])
    # at an assumed distance the parallax that comes back is not that of the star
    near = ~distant & (np.abs(parallax2 * ARCSEC - parallax) < 0.1 * np.abs(parallax))
    found[:2, moving] = ra2, dec2
    found[2, moving] = np.where(near & known[2], parallax2 * ARCSEC, values[2, moving])
    found[3, moving] = np.where(known[3], motion_ra * np.cos(dec2), np.nan)
    found[4, moving] = np.where(known[4], motion_dec, np.nan)
    return found


@lru_cache(maxsize=4)
def _earth(epochs: bytes) -> Array:
    """Return the Earth from the barycentre in au, shape (3, N); it takes most of the time of small problems."""
    # the ufunc itself, because erfa.epv00 warns about epochs before 1900, where it is off by 1e-5 au
    _, earth, _ = erfa.ufunc.epv00(J2000, (np.frombuffer(epochs) - 2000.0) * DAYS_PER_YEAR)
    return np.moveaxis(np.asarray(earth["p"]), -1, 0)


def parallax_factors(ra: Array, dec: Array, epoch: Array) -> Array:
    """Return (p.s, q.s) with s from the Earth to the barycentre in au: the displacement by parallax; shape (2, N)."""
    to_barycentre = -(_earth if len(epoch) < KEPT_EPOCHS else _earth.__wrapped__)(epoch.tobytes())
    p, q, _ = triad(ra, dec)
    return np.stack([np.sum(p * to_barycentre, axis=0), np.sum(q * to_barycentre, axis=0)])


def offsets(ra: Array, dec: Array, from_ra: Array, from_dec: Array) -> Array:
    """Return (d alpha*, d dec) of positions as seen from others, in their tangent plane; shape (2, N), rad.

    No large numbers are subtracted except the angles themselves, and 24 h is not a discontinuity.
    """
    d_ra = ra - from_ra
    east = np.cos(dec) * np.sin(d_ra)
    north = np.sin(dec - from_dec) + 2.0 * np.cos(dec) * np.sin(from_dec) * np.sin(0.5 * d_ra) ** 2
    return np.stack([east, north])
