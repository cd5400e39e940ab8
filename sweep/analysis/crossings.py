"""Between the points of a grid: where a quantity crosses a limit, and its value at a place that is not in the grid.

Both interpolate linearly between two points: in the logarithm of the quantity where that is above 0, and in that of the
axis if all its values are above 0 and its unit is not logarithmic already, as magnitudes are.
"""

from contextlib import suppress
from typing import Any

import numpy as np
import xarray as xr

from linksweep.sweep.analysis.conditions import Limit, parse_limit
from linksweep.sweep.analysis.lines import Lines, lines, require_done
from linksweep.sweep.analysis.quantity import require_quantity
from linksweep.sweep.contract import Array, SweepError, shown, small_sample_factor
from linksweep.sweep.formatting import LOGARITHMIC_UNITS, described, units_of
from linksweep.sweep.studies.study import POINT

MET_WORDS = ("never", "always", "from", "up to", "several times", "left out")
"""Where a condition is met along a line: at no point, at all points, from or up to one crossing, between several.
Lines are left out if the study excludes them, or if their unit cannot be converted to that of the limit.
"""
NEVER, ALWAYS, FROM, UP_TO, SEVERAL, LEFT_OUT = range(len(MET_WORDS))


def find(dataset: xr.Dataset, limit: Limit | str, over: str, covariance: xr.DataArray | None = None) -> xr.Dataset:
    """Return where along an axis a condition is met, for every combination of the other axes.

    Args:
        dataset: results, as `linksweep.run` and `linksweep.open` return them.
        limit: a variable, one of < <= > >=, and a number with or without a unit: "sigma_spin < 1 uas/yr".
        over: the axis.
        covariance: the covariance of the variable's points, with dimensions (..., over, over_other); that of the
            dataset by default.

    Returns:
        A dataset over the other axes with the variables ``met`` (whether and where the condition is met; its
        attributes give the meaning of the numbers), ``crossings`` (how many), ``first`` and ``last`` (the axis at the
        first and last crossing; NaN if there is none) with ``_error`` (one sigma, from the errors of the points on both
        sides), ``nearest`` (if the condition is never or always met, the value nearest to the limit; otherwise NaN) and
        ``nearest_at`` (the axis there).

    Raises:
        SweepError: for an unknown variable or axis, points that are not done, and a unit of another kind.

    Example:
        >>> import linksweep
        >>> study = linksweep.load_study("quasars", ["n_sim=100", "n_cat=1"], ["v_max=14,15,16,17"])
        >>> ds = linksweep.run(study, "quasars.zarr", pool="serial")
        >>> round(float(find(ds, "sigma_spin < 1 uas/yr", over="v_max")["first"].sel(model="gaia")), 3)
        16.066
    """
    if isinstance(limit, str):
        limit = parse_limit(limit)
    found = lines(dataset, limit.variable, over, covariance)
    thresholds = _thresholds(limit, found)
    rows = np.array([_cross(found, line, limit, threshold) for line, threshold in enumerate(thresholds)])
    where = found.over_unit
    columns = {
        "met": ("", "when the condition is met"),
        "crossings": ("", "how often the limit is crossed"),
        "first": (where, f"{over} at the first crossing"),
        "first_error": (where, "its one-sigma error"),
        "last": (where, f"{over} at the last crossing"),
        "last_error": (where, "its one-sigma error"),
        "nearest": (found.common_unit, f"{limit.variable} that is nearest to the limit, if that is never crossed"),
        "nearest_at": (where, f"{over} of the nearest"),
    }
    result = found.with_variables({name: (rows[:, i], *columns[name]) for i, name in enumerate(columns)})
    result["met"] = result["met"].astype("int8").assign_attrs(result["met"].attrs)
    result["met"].attrs |= {"flag_values": list(range(len(MET_WORDS))), "flag_meanings": ", ".join(MET_WORDS)}
    return result.assign_attrs(condition=str(limit), errors=found.errors)


def points_where(dataset: xr.Dataset, limit: Limit) -> xr.Dataset:
    """Return the points of a table or a design at which a condition is met, with all their results.

    Raises SweepError for an unknown quantity, one with further dimensions, and points that are not done.
    """
    require_quantity(dataset, limit.variable)
    array = dataset[limit.variable]
    if further := ", ".join(str(d) for d in array.dims if d != POINT):
        raise SweepError(f"{limit.variable} has {further} at each point: fix it with --at, or name it with --over")
    require_done(dataset)
    threshold = limit.number_in(units_of(array.attrs))
    return dataset.isel({POINT: np.flatnonzero(limit.is_met(dataset[limit.variable].values.astype(float), threshold))})


def interpolate(
    dataset: xr.Dataset, variable: str, over: str, at: float, covariance: xr.DataArray | None = None
) -> xr.Dataset:
    """Interpolate a variable between the points of an axis, for every combination of the other axes.

    Args:
        dataset: results, as `linksweep.run` and `linksweep.open` return them.
        variable: the name of an output.
        over: the axis.
        at: the value of the axis, in its unit.
        covariance: the covariance of the variable's points, with dimensions (..., over, over_other); that of the
            dataset by default.

    Returns:
        A dataset over the other axes with ``variable`` and ``NAME_mc_error`` (one sigma, from the errors of the points
        on both sides; the curvature between them is not included).

    Raises:
        SweepError: for an unknown variable or axis, points that are not done, and a value of the axis outside the
            points of a line.

    Example:
        >>> import linksweep
        >>> study = linksweep.load_study("quasars", ["n_sim=100", "n_cat=1"], ["v_max=14,15,16,17"])
        >>> ds = linksweep.run(study, "quasars.zarr", pool="serial")
        >>> between = interpolate(ds, "sigma_spin", over="v_max", at=16.2)
        >>> [round(float(x), 5) for x in between["sigma_spin"]]
        [0.59264, 0.00097]
    """
    found = lines(dataset, variable, over, covariance)
    at = _number(over, at)
    rows = np.full((len(found), 2), np.nan)
    for line, used in enumerate(found.used):
        x, y, errors = found.x[used], found.value[line, used], found.errors_of(line)
        if not len(x):
            continue
        if not x[0] <= at <= x[-1]:
            raise SweepError(f"{over} = {at:g} is beyond the points, which go from {x[0]:g} to {x[-1]:g}")
        i = min(max(int(np.searchsorted(x, at)) - 1, 0), len(x) - 2)
        *_, z = scale = _on_scale(np.append(x, at), found.over_unit)
        fraction = (z - scale[i]) / (scale[i + 1] - scale[i])
        logarithm = bool(np.all(y[i : i + 2] > 0.0))
        u, spread = _pair(y, errors, i, logarithm)
        weights = np.array([1.0 - fraction, fraction])
        value = np.exp(weights @ u) if logarithm else weights @ u
        rows[line] = value, _error(weights, spread, found.samples) * (value if logarithm else 1.0)
    attributes = dataset[variable].attrs
    of_error = described(units_of(attributes), f"one-sigma error of {variable}")
    result = found.grid.assign_coords({over: xr.Variable((), at, dataset[over].attrs)})
    result[variable] = found.dims, rows[:, 0].reshape(found.shape), attributes
    result[f"{variable}_mc_error"] = found.dims, rows[:, 1].reshape(found.shape), of_error
    return result


def _thresholds(limit: Limit, found: Lines) -> list[float]:
    """Return the limit in the unit of each line, NaN if it cannot be converted; raises SweepError if none can."""
    known: dict[str, float] = {}
    refusals = []
    for unit in dict.fromkeys(found.unit):
        try:
            known[unit] = limit.number_in(unit)
        except SweepError as error:
            refusals.append(error)
    if not known:
        raise refusals[0]
    return [known.get(unit, np.nan) for unit in found.unit]


def _cross(found: Lines, line: int, limit: Limit, threshold: float) -> tuple[float, ...]:
    used = found.used[line]
    x, y, errors = found.x[used], found.value[line, used], found.errors_of(line)
    nothing = (np.nan,) * 4
    if np.isnan(threshold) or not used.any():
        return (LEFT_OUT, 0.0, *nothing, np.nan, np.nan)
    met = limit.is_met(y, threshold)
    flips = np.flatnonzero(met[1:] != met[:-1])
    if not len(flips):
        low = (limit.sign in ("<", "<=")) != bool(met[0])
        nearest = int(np.argmin(y) if low else np.argmax(y))
        return (float(met[0]), 0.0, *nothing, y[nearest], x[nearest])
    state = SEVERAL if len(flips) > 1 else FROM if met[-1] else UP_TO
    ends = [part for i in (flips[0], flips[-1]) for part in _crossing(found, x, y, errors, int(i), threshold)]
    return (float(state), float(len(flips)), *ends, np.nan, np.nan)


def _number(over: str, at: Any) -> float:
    """Return a value of an axis as a number; raises SweepError for texts and quantities with a unit."""
    if not isinstance(at, str):
        with suppress(TypeError, ValueError):
            return float(at)
    raise SweepError(f"{over} = {shown(at)}: must be a number, in the unit of the axis")


def _crossing(found: Lines, x: Array, y: Array, errors: Array, i: int, threshold: float) -> tuple[float, float]:
    """Return where the line from point i to the next one meets the threshold, and the error of that."""
    logarithm = bool(np.all(y[i : i + 2] > 0.0)) and threshold > 0.0
    u, spread = _pair(y, errors, i, logarithm)
    fraction = ((np.log(threshold) if logarithm else threshold) - u[0]) / (u[1] - u[0])
    z = _on_scale(x, found.over_unit)
    step = z[i + 1] - z[i]
    weights = np.array([1.0 - fraction, fraction])
    place, error = z[i] + fraction * step, abs(step / (u[1] - u[0])) * _error(weights, spread, found.samples)
    if _is_logarithmic(x, found.over_unit):
        return float(np.exp(place)), float(np.exp(place) * error)
    return float(place), float(error)


def _pair(y: Array, errors: Array, i: int, logarithm: bool) -> tuple[Array, Array]:
    """Return two neighbouring values and their covariance (2, 2), of their logarithms if asked for."""
    values = y[i : i + 2]
    spread = np.diag(errors[i : i + 2] ** 2) if errors.ndim == 1 else errors[i : i + 2, i : i + 2]
    return (np.log(values), spread / np.outer(values, values)) if logarithm else (values, spread)


def _error(weights: Array, spread: Array, samples: float) -> float:
    """Return the one-sigma error of a weighted sum; NaN where the covariance is not known."""
    return float(np.sqrt(np.maximum(weights @ spread @ weights, 0.0) * small_sample_factor(samples)))


def _is_logarithmic(x: Array, unit: str) -> bool:
    return bool(np.all(x > 0.0)) and unit not in LOGARITHMIC_UNITS


def _on_scale(x: Array, unit: str) -> Array:
    """Return the axis on the scale for interpolation: its logarithm, or itself if it is one already or has none."""
    return np.log(x) if _is_logarithmic(x, unit) else x
