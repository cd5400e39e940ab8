"""Estimators of sensitivity indices, with one-sigma errors: arrays in, arrays out.

For a full grid by analysis of variance: every value of an axis counts the same.  The values of an axis of real numbers
are taken as the midpoints of equal cells, on the scale on which they are equally spaced; the errors include the
differences from integration rules of higher order.

For Saltelli and Morris designs by SALib, with bootstrap errors from a fixed seed.

For any other points only the first order: how much of the variance the mean at each value of a parameter explains.  For
numbers this mean is fitted with cosines over the parameter's range (Plischke 2012, Reliability Engineering & System
Safety 107, 149); for texts and for few different numbers it is the mean of each group.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from linksweep.sweep.contract import Array, SweepError
from linksweep.sweep.studies.values import MORRIS_LEVELS, salib, unit_cube

RESAMPLES = 200

ORDERS = (3, 5, 7)
"""How many neighbouring values of a grid the rules of higher order fit with a polynomial."""

EFFECTS: tuple[str, ...] = ("mu_star", "mu_star_error", "mu", "sigma")
"""What `morris_effects` returns."""

ONE_SIGMA = 0.6826894921370859
"""Probability within one sigma: half the width of SALib's confidence intervals is then a one-sigma error."""

HARMONICS = 8
"""The most half-waves over the range of a parameter."""

POINTS_FOR_EACH = 8
"""Points that are needed for each coefficient."""

FEW_VALUES = 12
"""The points of a parameter with no more different values than this are treated as groups."""

PARTS = 32
"""Parts of the points that are left out in turn for the errors."""


def indices_of_grid(
    values: Array, errors: Array | None, continuous: Sequence[bool], seed: int = 0
) -> tuple[Array, Array, Array, Array]:
    """Return first-order and total indices with one-sigma errors, each (axes,), of values with one dimension per axis.

    ``errors`` are one sigma of independent values: their variance is subtracted from the indices, and their effect is
    in the errors of the indices.  ``continuous`` says which axes are of real numbers.

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
    if not whole > 0.0 or values.min() == values.max():  # rounding: the weights may not add up to exactly one
        return np.full((2, values.ndim), np.nan)
    axes = range(values.ndim)
    alone = [_variance(values, noise, weights, [k for k in axes if k != axis]) for axis in axes]
    without = [_variance(values, noise, weights, [axis]) for axis in axes]
    return np.array([alone, [whole - rest for rest in without]]) / whole


def _variance(values: Array, noise: Array, weights: Sequence[Array], averaged: Sequence[int]) -> float:
    """Return the variance of the mean over some axes, less the part that is noise."""
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


def saltelli_indices(values: Array, parameters: int, seed: int = 0) -> list[Array]:
    """Return first-order and total indices with one-sigma errors, each (parameters,), of values (points,) in the order
    of the design; NaN where these do not vary.  Raises SweepError without SALib.

    Source: Saltelli et al. 2010, Computer Physics Communications 181, 259.
    """
    if not np.ptp(values) > 0.0:
        return [np.full(parameters, np.nan)] * 4
    salib()
    from SALib.analyze import sobol

    options = {"calc_second_order": False, "num_resamples": RESAMPLES, "conf_level": ONE_SIGMA}
    found = sobol.analyze(unit_cube(parameters), values, seed=seed + 1, **options)  # SALib takes 0 for no seed
    return [np.asarray(found[key]) for key in ("S1", "S1_conf", "ST", "ST_conf")]


def morris_effects(values: Array, places: Array, seed: int = 0) -> list[Array]:
    """Return the mean of absolute elementary effects with its error, the mean effect, and their standard deviation,
    each (parameters,), of values (points,) at ``places`` (points, parameters) of the unit cube.

    An effect is the change of the value over the whole range of a parameter.  Raises SweepError without SALib.
    Source: Campolongo et al. 2007, Environmental Modelling & Software 22, 1509.
    """
    salib()
    from SALib.analyze import morris

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # SALib warns that there are no groups
        options: dict[str, Any] = {"num_levels": MORRIS_LEVELS, "num_resamples": RESAMPLES, "conf_level": ONE_SIGMA}
        found = morris.analyze(unit_cube(places.shape[1]), places, values, seed=seed + 1, **options)
    return [np.ma.getdata(found[key]).astype(float) for key in ("mu_star", "mu_star_conf", "mu", "sigma")]


def first_order(values: Array, places: Sequence[Array], even: bool = False, seed: int = 0) -> tuple[Array, Array]:
    """Return first-order indices and their one-sigma errors, each (parameters,).

    ``places`` has for each parameter its places (points,) in the unit interval.  The errors are those of a jackknife
    over random parts of the points, and include the contribution of the two shortest waves.  Independent points explain
    some of the variance by chance, which is subtracted.  For points that are ``even``, spread by a design, this share
    is not known: half of it is subtracted, and included in the errors.  Raises SweepError for too few points.
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
        columns = np.column_stack([np.ones(n), waves, values - values.mean()])
        parts = np.array([columns[part == j].T @ columns[part == j] for j in range(int(part.max()) + 1)])
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
    all of them for groups.
    """
    different, group = np.unique(place, return_inverse=True)
    if len(different) <= FEW_VALUES:
        return np.eye(len(different))[group][:, 1:], len(different) - 1
    count = max(2, min(HARMONICS, len(place) // POINTS_FOR_EACH))
    return np.cos(np.pi * place[:, None] * np.arange(1, count + 1)), count - min(2, count - 1)


def _explained(moments: Array) -> tuple[float, float]:
    """Return the share of the variance that a regression explains, less the share that it would explain of noise
    (adjusted R²), and this second share; ``moments`` are the sums of products of 1, the functions and the values.
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
