"""What is done to the rows of a reference before the solution: jitter, and Galactic aberration."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from core.arrays import Array
from core.constants import GALACTIC_AXES, MAS
from core.frames import triad
from core.tie.astrometry import KINDS, PAIRS, Astrometry, kinds
from sweep.contract import SweepError

ICRF3_EPOCH = 2015.0

ALL = "all"
"""Stands for every kind of row that has no jitter of its own."""


def with_jitter(rows: Astrometry, jitter: Mapping[str, tuple[float, float]]) -> Astrometry:
    """Return rows with (mas, mas/yr) added in quadrature to the errors of each kind, or of "all"; correlations keep
    covariances.

    Raises SweepError for sizes that are none, and kinds that there are not or that no row is of.
    """
    if not jitter:
        return rows
    known = [*KINDS.values(), "single epoch", ALL]
    if unknown := sorted(set(jitter) - set(known)):
        raise SweepError(f"jitter: no kind of row {', '.join(unknown)}; kinds are {', '.join(known)}")
    of = kinds(rows)
    if absent := sorted(set(jitter) - {ALL, *of.tolist()}):
        raise SweepError(f"jitter: no row is of the kind {', '.join(absent)}; there are {', '.join(np.unique(of))}")
    added = np.zeros_like(rows.errors)
    for kind, (position, motion) in jitter.items():
        if not (0.0 <= position < np.inf and 0.0 <= motion < np.inf):
            raise SweepError(f"jitter of {kind}: {position:g}, {motion:g}: errors are finite and not negative")
        at = of == kind if kind != ALL else ~np.isin(of, list(jitter))  # a kind that is named has its own
        added[:, at] = MAS * np.array([position, position, position, motion, motion])[:, None]
    errors = np.hypot(rows.errors, added)
    correlations = rows.correlations
    if correlations is not None:
        with np.errstate(invalid="ignore", divide="ignore"):
            shrunk = np.where(errors > 0.0, rows.errors / errors, 1.0)
        correlations = np.array([c * shrunk[i] * shrunk[j] for c, (i, j) in zip(correlations, PAIRS, strict=True)])
    return replace(rows, errors=errors, correlations=correlations)


def aberrated(rows: Astrometry, to_epoch: Array, aberration: float) -> Astrometry:
    """Return positions without an epoch carried from 2015.0 to another by the Galactic aberration (uas/yr).

    Sources seem to move towards the Galactic centre.  Source: Charlot et al. 2020, A&A 644, A159.  Raises SweepError
    where that does nothing.
    """
    if not np.any(rows.present[0] & np.isnan(rows.epoch) & np.isfinite(to_epoch)):
        raise SweepError(
            "aberration carries positions without an epoch from 2015.0 to that of their source, and no row of the "
            "reference is such a position"
        )
    p, q, _ = triad(rows.values[0], rows.values[1])
    years = np.where(np.isfinite(rows.epoch) | ~np.isfinite(to_epoch), 0.0, to_epoch - ICRF3_EPOCH)
    glide = GALACTIC_AXES[0] * aberration * MAS / 1000.0
    values = rows.values.copy()
    values[0] += years * (glide @ p) / np.cos(rows.values[1])
    values[1] += years * (glide @ q)
    return replace(rows, values=values)
