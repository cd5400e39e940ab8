"""First-order Sobol indices from any points: how much of the variance the mean at each value of a parameter explains.

Of a number the conditional mean is followed by cosines over the parameter's range (Plischke 2012, Reliability
Engineering & System Safety 107, 149), of a text or few different numbers by the means of the groups.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sweep.contract import Array, SweepError

HARMONICS = 8
"""Half-waves over the range of a parameter at most."""

POINTS_FOR_EACH = 8
"""So many points are needed for each coefficient."""

FEW_VALUES = 12
"""A parameter with no more different values than these is one of groups."""

PARTS = 32
"""Parts of the points that are left out in turn for the errors."""


def first_order(values: Array, places: Sequence[Array], even: bool = False, seed: int = 0) -> tuple[Array, Array]:
    """Return first-order indices and their one-sigma errors, each (parameters,).

    ``places`` has for each parameter its places (points,) in the unit interval.  The errors are those of a jackknife
    over random parts of the points, with what the two shortest waves change.  Independent points explain some of the
    variance by chance, which is taken out; of points that are ``even``, spread by a design, it is not known how much of
    that there is: half of it is taken out, and stands in the errors.  Raises SweepError for too few points.
    """
    n = len(values)
    if n < (least := 2 * POINTS_FOR_EACH + 2):
        raise SweepError(f"{n} points are too few for indices: at least {least} are needed")
    if not np.ptp(values) > 0.0:
        return np.full(len(places), np.nan), np.full(len(places), np.nan)
    part = np.random.default_rng(seed).permutation(n) % min(PARTS, n // 2)
    found = np.empty((2, len(places)))
    for k, place in enumerate(places):
        waves, shorter = _basis(place)
        parts = _moments(values, waves, part)
        whole = parts.sum(axis=0)
        index, chance = _explained(whole)
        left = np.array([_explained(whole - one)[0] for one in parts])
        variance = (len(left) - 1) / len(left) * np.sum((left - left.mean()) ** 2)
        kept = [*range(1 + shorter), -1]
        truncation = index - _explained(whole[np.ix_(kept, kept)])[0]
        half = 0.5 * chance if even else 0.0
        found[:, k] = index + half, np.sqrt(variance + truncation**2 + half**2)
    return found[0], found[1]


def _basis(place: Array) -> tuple[Array, int]:
    """Return functions of a parameter at the points, (points, functions), and how many of them are the longer waves;
    all, where they are groups.
    """
    different, group = np.unique(place, return_inverse=True)
    if len(different) <= FEW_VALUES:
        return np.eye(len(different))[group][:, 1:], len(different) - 1
    count = max(2, min(HARMONICS, len(place) // POINTS_FOR_EACH))
    return np.cos(np.pi * place[:, None] * np.arange(1, count + 1)), count - min(2, count - 1)


def _moments(values: Array, functions: Array, part: NDArray[np.intp]) -> Array:
    """Return the sums of products of 1, the functions and the values over each part, (parts, products, products)."""
    columns = np.column_stack([np.ones(len(values)), functions, values - values.mean()])
    return np.array([columns[part == j].T @ columns[part == j] for j in range(int(part.max()) + 1)])


def _explained(moments: Array) -> tuple[float, float]:
    """Return the share of the variance that a regression explains, less what it would of noise (adjusted R²), and how
    much that is.
    """
    products, right, squares = moments[:-1, :-1], moments[:-1, -1], moments[-1, -1]
    n = products[0, 0]
    whole = squares - right[0] ** 2 / n
    used = np.linalg.matrix_rank(products, hermitian=True) - 1
    if not whole > 0.0 or n <= used + 1:
        return float("nan"), float("nan")
    rest = max(0.0, squares - right @ np.linalg.pinv(products, hermitian=True) @ right)
    chance = rest / whole * used / (n - 1 - used)
    return float(1.0 - rest / whole - chance), float(chance)
