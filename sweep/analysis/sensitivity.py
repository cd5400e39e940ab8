"""How much of the variation of a result each parameter causes: indices of grids, designs and tables, with errors.

For a full grid by analysis of variance: every value of an axis counts the same.  The values of an axis of real numbers
are taken as the midpoints of equal cells, on the scale on which they are equally spaced; the errors include the
differences from integrals of splines through them.

For Saltelli and Morris designs by SALib, with bootstrap errors from a fixed seed.

For any other points only the first order: how much of the variance the mean at each value of a parameter explains.  For
numbers this mean is fitted with cosines over the parameter's range (Plischke 2012, Reliability Engineering & System
Safety 107, 149); for texts and for few different numbers it is the mean of each group.
"""

import json
import math
import warnings
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.interpolate import make_interp_spline

from linksweep.sweep.analysis import quantity
from linksweep.sweep.analysis.tables import derived
from linksweep.sweep.contract import FEWEST_SAMPLES, Array, Parameter, Status, SweepError, small_sample_factor
from linksweep.sweep.formatting import units_of
from linksweep.sweep.studies.points import DESIGNS, MORRIS_LEVELS, read_range, salib, unit_cube
from linksweep.sweep.studies.study import POINT, POINT_TABLE

# The attribute of a dataset of indices that says how they were made.
METHOD = "sensitivity_method"

INDICES, EFFECTS = ("first", "first_error", "total", "total_error"), ("mu_star", "mu_star_error", "mu", "sigma")
MEANINGS = {
    "first": "first-order index: share of the variance that the parameter causes by itself",
    "total": "total index: share of the variance that it causes, interactions included",
    "mu_star": "mean absolute effect of the parameter over its range",
    "mu": "mean effect of the parameter over its range",
    "sigma": "standard deviation of its effects: interactions and curvature",
}
COARSE = 8  # on an axis of real numbers with fewer values, a function may change much between them
CORRELATED = 0.3  # a note names the parameters of a table that are correlated more than this
RESAMPLES = 200
DEGREES = (2, 3, 5)  # of the splines through the values of a grid that are compared with their mean
ONE_SIGMA = 0.6826894921370859  # probability: half the width of SALib's confidence intervals is then a one-sigma error
HARMONICS = 8  # the most half-waves over the range of a parameter
POINTS_FOR_EACH = 8  # points that are needed for each coefficient
FEW_VALUES = 12  # the points of a parameter with no more different values are treated as groups
PARTS = 32  # parts of the points that are left out in turn for the errors
MORRIS_STEP = 0.5 * MORRIS_LEVELS / (MORRIS_LEVELS - 1)  # of the unit interval
ROUNDING = 1e-12  # indices below this share of the largest are rounding errors of a parameter without any effect


class _Method(NamedTuple):
    """How to compute ``indices``, by their names, from the values and errors of a variable over some dimensions."""

    name: str
    parameters: list[str]
    over: list[str]
    indices: Sequence[str]
    estimate: Callable[[Array, Array], Sequence[Array]]
    notes: list[str]


def sensitivity(dataset: xr.Dataset, output: str | None = None, seed: int = 0) -> xr.Dataset:
    """Estimate how much of the variance of an output is due to each parameter.

    For a full grid these are first-order and total Sobol indices by analysis of variance over all axes, in which every
    value of an axis has the same weight.  For a saltelli design they are the same two indices, by SALib; for a morris
    design ``mu_star``, ``mu`` and ``sigma``; for any other points only first-order indices, which need no special
    design.  All points have the same weight: the indices are for the distribution of the design or table.

    Args:
        dataset: results, as `linksweep.run` and `linksweep.open` return them.
        output: the name of an output; the main one by default.
        seed: the seed of the resampling from which errors are computed.

    Returns:
        A dataset over ``parameter``, and over the dimensions that are not parameters of the table or grid (those of the
        output itself, and axes crossed with points), with ``first`` and, if available, ``total``, each with a one-sigma
        ``NAME_error``.  Its attributes say how they were computed; ``notes`` (JSON) has warnings.

    Raises:
        SweepError: for an unknown output, points that are not done or not finite, and grids that are not full.

    Example:
        >>> import linksweep
        >>> def area(width: float, height: float):
        ...     return width * height
        >>> axes = {"width": [0.5, 1.5, 2.5], "height": [1.0, 2.0, 3.0]}
        >>> indices = sensitivity(linksweep.run(area, "area.zarr", axes=axes, pool="serial"))
        >>> indices.parameter.values.tolist(), indices["first"].values.round(3).tolist()
        (['width', 'height'], [0.578, 0.325])
    """
    output = output or quantity.main_quantity(dataset)
    quantity.require_quantity(dataset, output)
    quantity.require_done(dataset)
    dataset = quantity.without_excluded(dataset)
    if np.any(dataset["status"].values == Status.EXCLUDED):
        raise SweepError("the study excludes points, and indices need all: take a part without gaps, --at AXIS=VALUE")
    method = _of_points(dataset, seed) if POINT in dataset[output].dims else _of_grid(dataset, seed)
    others = [str(d) for d in dataset[output].dims if d not in method.over]
    values = quantity.numbers(dataset, output).transpose(*others, *method.over).values
    if not np.isfinite(values).all():
        raise SweepError(f"{output} is not a finite number at {int(np.sum(~np.isfinite(values)))} points")
    errors = quantity.sigmas(dataset, output, [*others, *method.over])
    made = np.array([_estimated(method, values[i], errors[i]) for i in np.ndindex(values.shape[: len(others)])])
    index, sigma, *_ = indices = made.swapaxes(0, 1)  # (indices, places, parameters)
    points = math.prod(dataset.sizes[d] for d in method.over)
    notes = [f"sensitivity of {output} by {method.name}, from {points:,} points", *method.notes]
    if (np.isnan(sigma) & np.isfinite(index)).any():
        why = "points share random numbers, or their Monte-Carlo errors are not known, and noise counts as variation"
        few = f"there are fewer than {FEWEST_SAMPLES} base points or trajectories"
        notes.append(f"errors of the indices are not known: {few if POINT in method.over else why}")
    if unknown := np.isnan(index).all(axis=1).sum():
        where = f" at {unknown} of {len(made)} places" if len(made) > 1 else ""
        notes.append(f"{output} does not vary{where}, or no more than its errors: no indices")
    unit = units_of(dataset[output].attrs) if method.indices is EFFECTS else ""
    columns = dict(zip(method.indices, indices, strict=True))
    grid = quantity.grid_of(dataset, others).assign_coords(parameter=np.array(method.parameters, dtype=object))
    meanings = {name: (unit, meaning) for name, meaning in MEANINGS.items()}
    about = {"result": "sensitivity", "output": output, METHOD: method.name, "points": points}
    result = derived(grid, [*others, "parameter"], columns, meanings, [n for n in columns if n in MEANINGS])
    return result.assign_attrs(about, notes=json.dumps(notes))


@np.errstate(over="ignore")  # an effect may be no float
def _estimated(method: _Method, values: Array, errors: Array) -> Array:
    """Return the indices at one place, (indices, parameters), of values over a power of two with float squares."""
    power = np.frexp(max(np.abs(values).max(), np.abs(errors[np.isfinite(errors)]).max(initial=0.0)))[1]
    made = np.array(method.estimate(np.ldexp(values, -power), np.ldexp(errors, -power)))
    made[np.abs(made) < ROUNDING * np.nanmax(np.abs(made), initial=0.0)] = 0.0
    return np.ldexp(made, power if method.indices is EFFECTS else 0)


def _of_points(dataset: xr.Dataset, seed: int) -> _Method:
    table = json.loads(dataset.attrs.get(POINT_TABLE, "{}"))
    design, ranges = table.get("design", ""), table.get("ranges", {})
    parameters = [n for n in table.get("ranges", table.get("parameters", [])) if n in dataset.coords]
    if gaps := [name for name in parameters if design != "saltelli" and dataset[name].isnull().any()]:
        raise SweepError(f"{gaps[0]} is missing at points where it has no effect: choose others, --at PARAMETER=VALUE")
    if design not in ("saltelli", "morris"):
        parameters = [name for name in quantity.varied_parameters(dataset) if name in parameters]
    elif DESIGNS[design].size(table["n"], len(parameters)) != dataset.sizes[POINT]:
        raise SweepError(f"indices of a {design} design need all of its points")
    if not parameters:
        raise SweepError("the points do not differ in any parameter")
    places = [_places(dataset, name, ranges.get(name), design) for name in parameters]
    if design == "saltelli":
        noise = "Monte-Carlo errors of the points count as interactions: they are in the total indices"
        notes = [noise] if "seed" in dataset.attrs else []  # a function without random numbers has no seed
        name, indices = "SALib, of a saltelli design", INDICES
        return _Method(name, parameters, [POINT], indices, lambda y, _: saltelli_indices(y, len(places), seed), notes)
    if design == "morris":
        notes = ["effects are over the whole range of each parameter; they rank parameters, and are not shares"]
        unit, name = np.stack(places, axis=1), "SALib, of a morris design"
        return _Method(name, parameters, [POINT], EFFECTS, lambda y, _: morris_effects(y, unit, seed), notes)
    even = design not in ("", "random")
    notes = ["total indices need a full grid or a saltelli design"]
    notes += [] if design else _correlated(parameters, places)
    name = f"regression on each parameter, of {design or 'given'} points"
    return _Method(name, parameters, [POINT], INDICES[:2], lambda y, _: first_order(y, places, even, seed), notes)


def _of_grid(dataset: xr.Dataset, seed: int) -> _Method:
    over = [str(d) for d in dataset["status"].dims if dataset.sizes[d] > 1]
    if not over:
        raise SweepError("indices need several points")
    axes = {str(n): c for n, c in dataset.coords.items() if not str(n).endswith("_unit")}
    joint = {d: [d, *(name for name, c in axes.items() if c.dims == (d,) and name != d)] for d in over}
    parameters = ["+".join(names) for names in joint.values()]
    continuous = [len(joint[d]) == 1 and d in dataset.coords and dataset[d].dtype.kind == "f" for d in over]
    shared = any(quantity.shares_random_numbers(dataset, [d]) for d in over)

    def estimate(values: Array, errors: Array) -> Sequence[Array]:
        return indices_of_grid(values, np.nan * errors if shared else errors, continuous, seed)

    notes = ["every value of an axis counts the same: real numbers are midpoints of equal cells"]
    notes += [f"{n}: zipped axes advance together, and have one index" for n in parameters if "+" in n]
    coarse = [n for n, c, d in zip(parameters, continuous, over, strict=True) if c and dataset.sizes[d] < COARSE]
    if names := ", ".join(coarse):
        notes.append(f"{names} with fewer than {COARSE} values: what happens between them is not in the errors")
    return _Method("analysis of variance of the grid", parameters, over, INDICES, estimate, notes)


def _places(dataset: xr.Dataset, name: str, spec: Any, design: str) -> Array:
    """Return the places of a parameter's values in the unit interval: by its range in the design, or by their order.

    In a morris design, whose effects are over the whole range, all numbers go from 0 to 1.
    """
    array, is_morris = dataset[name], design == "morris"
    if is_morris and isinstance(spec, dict) and "values" in spec:
        spec = [min(spec["values"]), max(spec["values"])]
    if isinstance(spec, list) or (isinstance(spec, dict) and "low" in spec):
        kind: Any = "int" if array.dtype.kind == "i" and not is_morris else "float"
        return read_range(Parameter(name, kind), spec).places(array.values)
    values = array.values.astype(str) if array.dtype.kind == "O" else array.values
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    before = np.cumsum(counts) - counts
    return np.asarray((before + 0.5 * counts)[place] / array.size)


def _correlated(parameters: Sequence[str], places: Sequence[Array]) -> list[str]:
    """Return a sentence if parameters of a table are correlated, so that each has a part in the index of the other."""
    correlation = np.triu(np.abs(np.atleast_2d(np.corrcoef(np.stack(places)))), 1)
    pair = np.unravel_index(np.argmax(correlation), correlation.shape)
    one, other = (parameters[int(place)] for place in pair)
    words = f"{one} and {other} go together in these points: their indices share a part"
    return [words] if correlation[pair] > CORRELATED else []


# Estimators: arrays in, arrays out


def indices_of_grid(
    values: Array, errors: Array | float, continuous: Sequence[bool], seed: int = 0
) -> tuple[Array, Array, Array, Array]:
    """Return first-order and total indices with one-sigma errors, each (axes,), of values with one dimension per axis.

    ``errors`` are one sigma of independent values: their variance is subtracted from the indices, and their effect is
    in the errors of the indices, which are NaN where some are not known.  ``continuous`` says which axes are of real
    numbers.

    The indices of y = a + b, both uniform on two values, where b varies twice as much:

    >>> a, b = np.array([0.0, 1.0]), np.array([0.0, 2.0])
    >>> first, _, total, _ = indices_of_grid(a[:, None] + b, 0.0, [False, False])
    >>> first.round(9).tolist(), total.round(9).tolist()
    ([0.2, 0.8], [0.2, 0.8])
    """
    equal = [np.full(n, 1.0 / n) for n in values.shape]
    are_known = np.isfinite(errors).all()
    noise = np.broadcast_to(np.square(errors) if are_known else 0.0, values.shape)
    estimated = _indices(values, noise, equal)
    coarseness = np.zeros(estimated.shape)
    for degree in DEGREES if any(continuous) else ():
        axes = zip(equal, continuous, strict=True)
        finer = [weights_of_degree(degree, len(w)) if is_real else w for w, is_real in axes]
        coarseness = np.fmax(coarseness, np.abs(_indices(values, noise, finer) - estimated))
    variance = coarseness**2
    if noise.any():
        rng = np.random.default_rng(seed)
        drawn = (values + rng.standard_normal(values.shape) * np.sqrt(noise) for _ in range(RESAMPLES))
        variance += np.var([_indices(one, 2.0 * noise, equal) for one in drawn], axis=0, ddof=1)
        estimated[np.isnan(variance)] = np.nan  # the variation might be noise: one of them has no more
    sigma = np.where(np.isfinite(estimated) & are_known, np.sqrt(variance), np.nan)
    return estimated[0], sigma[0], estimated[1], sigma[1]


def weights_of_degree(degree: int, n: int) -> Array:
    """Return weights of n midpoints of equal cells, whose sum is the integral of a spline through them.

    >>> (24 * weights_of_degree(2, 3)).round(9).tolist()
    [9.0, 6.0, 9.0]
    """
    spline = make_interp_spline((np.arange(n) + 0.5) / n, np.eye(n), k=min(degree, n - 1))
    return np.asarray(spline.integrate(0.0, 1.0))


@np.errstate(over="ignore", invalid="ignore")  # then they are not known
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
    for axis in sorted(averaged, reverse=True):
        values = np.tensordot(values, weights[axis], (axis, 0))
        noise = np.tensordot(noise, weights[axis] ** 2, (axis, 0))
    left = [w for axis, w in enumerate(weights) if axis not in averaged]
    share = reduce(np.multiply.outer, left, np.ones(()))
    squares = (values - np.sum(share * values)) ** 2
    return float(np.sum(share * (squares - noise)) + np.sum(share**2 * noise))


def saltelli_indices(values: Array, parameters: int, seed: int = 0) -> list[Array]:
    """Return first-order and total indices with one-sigma errors, each (parameters,), of values (points,) in the order
    of the design; NaN where these do not vary.  Raises SweepError without SALib.

    Source: Saltelli et al. 2010, Computer Physics Communications 181, 259.
    """
    if not np.ptp(values) > 0.0:
        return [np.full(parameters, np.nan)] * 4
    keys = ("S1", "S1_conf", "ST", "ST_conf")
    base = len(values) // (parameters + 2)
    return _by_salib("sobol", parameters, keys, base, values, seed=seed, calc_second_order=False)


def morris_effects(values: Array, places: Array, seed: int = 0) -> list[Array]:
    """Return the mean of absolute elementary effects with its error, the mean effect, and their standard deviation,
    each (parameters,), of values (points,) at ``places`` (points, parameters) of the unit cube.

    An effect is the change of the value over the whole range of a parameter.  SALib takes all steps for equal: those of
    the values are made so, where integers and listed numbers go by other steps.  Raises SweepError without SALib.
    Source: Campolongo et al. 2007, Environmental Modelling & Software 22, 1509.
    """
    paths = values.reshape(-1, places.shape[1] + 1).copy()
    steps = np.abs(np.diff(places.reshape(*paths.shape, -1), axis=1)).max(axis=-1) / MORRIS_STEP
    longer = np.where(np.isclose(steps, 1.0), 0.0, 1.0 / steps - 1.0)
    paths[:, 1:] += np.cumsum(np.diff(paths, axis=1) * longer, axis=1)
    keys = ("mu_star", "mu_star_conf", "mu", "sigma")
    data = places, paths.ravel()
    return _by_salib("morris", places.shape[1], keys, len(paths), *data, seed=seed, num_levels=MORRIS_LEVELS)


def _by_salib(
    method: str, parameters: int, keys: Sequence[str], samples: int, *data: Array, seed: int, **options: Any
) -> list[Array]:
    """Return results of SALib by their ``keys``, with bootstrap errors enlarged as so few samples need it: their
    scatter is divided by n, not n - 1.
    """
    widened = np.sqrt(small_sample_factor(samples) * samples / max(samples - 1, 1))
    options |= {"num_resamples": RESAMPLES, "conf_level": ONE_SIGMA, "seed": seed + 1}  # SALib takes 0 for no seed
    with warnings.catch_warnings(action="ignore"):  # SALib warns that there are no groups
        estimated = salib(f"analyze.{method}").analyze(unit_cube(parameters), *data, **options)
    factors = [widened if key.endswith("_conf") else 1.0 for key in keys]
    return [np.ma.getdata(estimated[key]).astype(float) * by for key, by in zip(keys, factors, strict=True)]


def first_order(values: Array, places: Sequence[Array], even: bool = False, seed: int = 0) -> tuple[Array, Array]:
    """Return first-order indices and their one-sigma errors, each (parameters,).

    ``places`` has for each parameter its places (points,) in the unit interval.  The errors are those of a jackknife
    over random parts of the points, and include the contribution of the two shortest waves.  Independent points explain
    some of the variance by chance, which is subtracted; its scatter is in the errors.  For points that are ``even``,
    spread by a design, this share is not known, and half of it is subtracted.  Raises SweepError for too few points.
    """
    n = len(values)
    if n < (least := 2 * POINTS_FOR_EACH + 2):
        raise SweepError(f"{n} points are too few for indices: at least {least} are needed")
    if not np.ptp(values) > 0.0:
        return np.full(len(places), np.nan), np.full(len(places), np.nan)
    part = np.random.default_rng(seed).permutation(n) % min(PARTS, n // 2)
    estimated = np.empty((2, len(places)))
    for k, place in enumerate(places):
        waves, shorter = _basis(place)
        columns = np.column_stack([np.ones(n), waves, values - values.mean()])
        parts = np.array([columns[part == j].T @ columns[part == j] for j in range(int(part.max()) + 1)])
        whole = parts.sum(axis=0)
        index, chance, scatter = _explained(whole)
        left = np.array([_explained(whole - one)[0] for one in parts])
        variance = (len(left) - 1) / len(left) * np.sum((left - left.mean()) ** 2)
        kept = [*range(1 + shorter), -1]
        truncation = index - _explained(whole[np.ix_(kept, kept)])[0]
        index += 0.5 * chance if even else 0.0
        estimated[:, k] = index, np.sqrt(variance + truncation**2 + scatter**2)
    return estimated[0], estimated[1]


def _basis(place: Array) -> tuple[Array, int]:
    """Return functions of a parameter at the points, (points, functions), and how many of them are the longer waves;
    all of them for groups.
    """
    different, group = np.unique(place, return_inverse=True)
    if len(different) <= FEW_VALUES:
        return np.eye(len(different))[group][:, 1:], len(different) - 1
    count = max(2, min(HARMONICS, len(place) // POINTS_FOR_EACH))
    return np.cos(np.pi * place[:, None] * np.arange(1, count + 1)), count - min(2, count - 1)


def _explained(moments: Array) -> tuple[float, float, float]:
    """Return the share of the variance that a regression explains, less the share that it would explain of noise
    (adjusted R²), this second share, and by how much it scatters; ``moments`` are the sums of products of 1, the
    functions and the values.
    """
    products, right, squares = moments[:-1, :-1], moments[:-1, -1], moments[-1, -1]
    n = products[0, 0]
    whole = squares - right[0] ** 2 / n
    used = np.linalg.matrix_rank(products, hermitian=True) - 1
    if not whole > 0.0 or n <= used + 1:
        return (math.nan,) * 3
    rest = max(0.0, squares - right @ np.linalg.pinv(products, hermitian=True) @ right)
    chance = rest / whole * used / (n - 1 - used)
    # a chi2 over its degrees of freedom, and as much again: its law is skewed, and the jackknife sees little of it
    return float(1.0 - rest / whole - chance), float(chance), float(chance * np.sqrt(4.0 / max(used, 1)))
