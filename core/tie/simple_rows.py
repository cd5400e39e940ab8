"""The elimination in closed form where each source has one row of its own epoch: millions of sources."""

import numpy as np

from core.arrays import Array
from core.tie.astrometry import PAIRS, Astrometry
from core.tie.elimination import UNDETERMINED, Eliminated
from core.tie.motion import offsets


def eliminate_simple(satellite: Astrometry, rows: Astrometry, taken_out: Array | None) -> Eliminated | None:
    """Return what `eliminate` does for the best weights, where row i is the only one of source i, all rows are
    positions of the sources' epochs or all are motions, and the satellite has both; None where that is not so.

    All rows are in the reference's frame.  The row is then the difference itself: W is the inverse of V + C, and
    nothing is eliminated.
    """
    if rows.frame is not None:
        return None
    motion, position = np.isfinite(rows.errors[3]), np.isfinite(rows.errors[0])
    if np.all(motion) and not np.any(position):
        pair = (3, 4)
    elif np.all(position) and not np.any(motion) and _same_epoch(satellite, rows):
        pair = (0, 1)
    else:
        return None
    inside = list(pair)
    absent = [row for row in range(5) if row not in pair]
    if np.any(np.isfinite(rows.errors[absent])) or not (
        np.all(rows.present[inside]) and np.all(satellite.present[inside])
    ):
        return None
    if pair == (0, 1):
        found = offsets(*rows.values[:2], *satellite.values[:2])
    else:
        found = rows.values[inside] - satellite.values[inside]
    if taken_out is not None:
        found = found - taken_out[inside]
    first, second, cross = (
        _covariance(satellite, i, j) + _covariance(rows, i, j) for i, j in (pair[:1] * 2, pair[1:] * 2, pair)
    )
    determinant = first * second - cross**2
    if not np.all((first > 0.0) & (second > 0.0) & (determinant > UNDETERMINED * first * second)):
        return None  # the general form names the source
    weight = np.empty((len(rows), 2, 2))
    weight[:, 0, 0], weight[:, 1, 1] = second / determinant, first / determinant
    weight[:, 0, 1] = weight[:, 1, 0] = -cross / determinant
    right = np.stack([weight[:, k, 0] * found[0] + weight[:, k, 1] * found[1] for k in range(2)], axis=1)
    two = np.full(len(rows), 2.0)
    squares = right[:, 0] * found[0] + right[:, 1] * found[1]
    return Eliminated(weight, right, squares, two, two, parameters=pair)


def _same_epoch(satellite: Astrometry, rows: Astrometry) -> bool:
    mean = rows.apparent is None or not np.any(rows.apparent)
    return mean and bool(np.all(np.isnan(rows.epoch) | np.isnan(satellite.epoch) | (rows.epoch == satellite.epoch)))


def _covariance(table: Astrometry, i: int, j: int) -> Array:
    product = table.errors[i] * table.errors[j]
    if i == j:
        return np.asarray(product)
    if table.correlations is None:
        return np.zeros(len(table))
    return np.asarray(np.nan_to_num(table.correlations[PAIRS.index((i, j))]) * product)
