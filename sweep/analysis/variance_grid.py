"""Sobol indices of a full grid by analysis of variance.

Every value of an axis counts the same.  Where an axis is of real numbers its values are taken as the midpoints of equal
cells, on the scale on which they are equally spaced; how far rules of higher order give other indices is in their
errors.
"""

from collections.abc import Sequence

import numpy as np

from sweep.contract import Array

RESAMPLES = 200
ORDERS = (3, 5, 7)
"""Neighbouring values through which the rules of higher order lay a polynomial."""


def indices_of_grid(
    values: Array, errors: Array | None, continuous: Sequence[bool], seed: int = 0
) -> tuple[Array, Array, Array, Array]:
    """Return first-order and total indices with one-sigma errors, each (axes,), of values with one dimension an axis.

    ``errors`` are one sigma of independent values: their variance is taken out of the indices, and their effect is in
    the errors of these.  ``continuous`` says which axes are of real numbers.

    The indices of y = a + b, both uniform on two values, where b varies twice as much:

    >>> a, b = np.array([0.0, 1.0]), np.array([0.0, 2.0])
    >>> first, _, total, _ = indices_of_grid(a[:, None] + b, None, [False, False])
    >>> first.tolist(), total.tolist()
    ([0.2, 0.8], [0.2, 0.8])
    """
    equal = [np.full(n, 1.0 / n) for n in values.shape]
    noise = np.zeros(values.shape) if errors is None else np.nan_to_num(errors) ** 2
    found = _indices(values, noise, equal)
    coarseness = np.zeros(found.shape)
    for order in ORDERS if any(continuous) else ():
        finer = [
            weights_of_order(order, n) if whole else w
            for n, w, whole in zip(values.shape, equal, continuous, strict=True)
        ]
        coarseness = np.fmax(coarseness, np.abs(_indices(values, noise, finer) - found))
    variance = coarseness**2
    if noise.any():
        rng = np.random.default_rng(seed)
        drawn = (values + rng.standard_normal(values.shape) * np.sqrt(noise) for _ in range(RESAMPLES))
        variance += np.var([_indices(one, 2.0 * noise, equal) for one in drawn], axis=0, ddof=1)
    sigma = np.where(np.isnan(found), np.nan, np.sqrt(variance))
    return found[0], sigma[0], found[1], sigma[1]


def weights_of_order(order: int, n: int) -> Array:
    """Return weights of n midpoints of equal cells: each cell is integrated through its ``order`` nearest midpoints.

    >>> [round(24 * 5 * w) for w in weights_of_order(3, 5)]
    [26, 21, 26, 21, 26]
    """
    order = min(order, n)
    powers = np.arange(order)
    weights = np.zeros(n)
    for cell in range(n):
        first = min(max(cell - order // 2, 0), n - order)
        nodes = np.arange(first, first + order) - cell  # in cells from the middle of this one
        moments = (0.5 ** (powers + 1) - (-0.5) ** (powers + 1)) / (powers + 1)
        weights[first : first + order] += np.linalg.solve(np.vander(nodes, order, increasing=True).T, moments)
    return weights / n


def _indices(values: Array, noise: Array, weights: Sequence[Array]) -> Array:
    """Return first-order and total indices, (2, axes)."""
    whole = _variance(values, noise, weights, ())
    if not whole > 0.0 or values.min() == values.max():  # the weights do not add up to one to the last bit
        return np.full((2, values.ndim), np.nan)
    axes = range(values.ndim)
    alone = [_variance(values, noise, weights, [k for k in axes if k != axis]) for axis in axes]
    without = [_variance(values, noise, weights, [axis]) for axis in axes]
    return np.array([alone, [whole - rest for rest in without]]) / whole


def _variance(values: Array, noise: Array, weights: Sequence[Array], averaged: Sequence[int]) -> float:
    """Return the variance of the mean over some axes, less what is of the noise."""
    means, spread = values, noise
    for axis in sorted(averaged, reverse=True):
        means = np.tensordot(means, weights[axis], (axis, 0))
        spread = np.tensordot(spread, weights[axis] ** 2, (axis, 0))
    left = [w for axis, w in enumerate(weights) if axis not in averaged]
    mean, of_mean = _sum(means, left), _sum(spread, [w**2 for w in left])
    return _sum((means - mean) ** 2, left) - (_sum(spread, left) - of_mean)


def _sum(values: Array, weights: Sequence[Array]) -> float:
    for w in reversed(weights):
        values = values @ w
    return float(values)
