"""Reference rows minus the satellite's five parameters at the rows' epochs, and the derivatives of the differences."""

from dataclasses import dataclass

import numpy as np

from linksweep.core.arrays import Array, Flags, Indices
from linksweep.core.tie.astrometry import Astrometry
from linksweep.core.tie.motion import offsets, parallax_factors, propagated


@dataclass(frozen=True)
class Differences:
    """R rows: ``values`` f (R, 5), zero where absent, ``partials`` M (R, 5, 5), ``covariance`` V (R, 5, 5) and which
    of the five are ``present`` (R, 5).

    ``by_frames`` (R, 5, 5 F) are the derivatives of f by the changes of the source's five parameters in the satellite's
    frame, and then in those of F - 1 further missions: M, and -M for the mission's frame that the row is in.
    """

    values: Array
    partials: Array
    covariance: Array
    present: Flags
    by_frames: Array


def differences(
    satellite: Astrometry, rows: Astrometry, source: Indices, spin: Array | None = None, frames: int = 1
) -> Differences:
    """Return rows - satellite.  ``source`` (R,) says to which source of the satellite a row belongs.

    A row without an epoch has that of its source.  f is the row minus the exact propagation of the satellite's
    parameters, and for the position of a single epoch minus the parallax times its factors.  A motion or parallax
    that the satellite lacks counts as zero here; it is free in the solution, so nothing depends on that.  ``spin`` is
    a known (5, S) displacement of the sources' parameters that is taken out.  ``frames`` is 1 more than the number of
    missions whose rows are in frames of their own.
    """
    own = satellite.taken(source)
    epoch = np.where(np.isfinite(rows.epoch), rows.epoch, own.epoch)
    start = np.nan_to_num(np.where(np.isfinite(own.epoch), own.epoch, epoch), nan=2000.0)
    years = np.where(np.isfinite(epoch), epoch - start, 0.0)
    there = propagated(own.values, own.radial_velocity, start, start + years)
    there[2:] = np.nan_to_num(there[2:])
    present = rows.present
    apparent = np.zeros(len(rows), dtype=bool) if rows.apparent is None else rows.apparent
    apparent = apparent & present[0] & ~present[2] & ~present[3]

    partials = np.zeros((len(rows), 5, 5))
    partials[:, range(5), range(5)] = 1.0
    partials[:, 0, 3] = partials[:, 1, 4] = years
    with np.errstate(invalid="ignore"):
        found = rows.values - there
        found[:2] = offsets(rows.values[0], rows.values[1], there[0], there[1])
    if np.any(apparent):
        at = np.flatnonzero(apparent)
        factors = parallax_factors(there[0, at], there[1, at], epoch[at])
        partials[at, :2, 2] = factors.T
        found[:2, at] -= factors * there[2, at]
    if spin is not None:
        found -= np.einsum("rij,jr->ir", partials, spin[:, source])
    partials = partials * present.T[:, :, None]
    return Differences(
        values=np.where(present, found, 0.0).T,
        partials=partials,
        covariance=rows.covariance(),
        present=present.T,
        by_frames=_by_frames(partials, rows.frame, frames),
    )


def _by_frames(partials: Array, frame: Indices | None, frames: int) -> Array:
    if frames == 1:
        return partials
    found = np.zeros((len(partials), 5, 5 * frames))
    found[:, :, :5] = partials
    for number in range(1, frames):
        own = np.zeros(len(partials), dtype=bool) if frame is None else frame == number
        found[own, :, 5 * number : 5 * number + 5] = -partials[own]
    return found
