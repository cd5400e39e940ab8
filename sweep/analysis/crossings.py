"""Between the points of a grid: where a quantity crosses a limit, and its value at a place that is not in the grid.

Both interpolate linearly between two points: in the logarithm of the quantity where that is above 0, and in that of the
axis if all its values are above 0 and its unit is not logarithmic already, as magnitudes are.
"""

import math
import operator
import re
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from linksweep.sweep.analysis.laws import Lines, lines, records_of_lines, table_of_lines
from linksweep.sweep.analysis.quantity import require_done, require_quantity
from linksweep.sweep.contract import Array, SweepError, shown, small_sample_factor
from linksweep.sweep.formatting import LOGARITHMIC_UNITS, described, units_of, with_error, with_unit
from linksweep.sweep.studies.study import POINT
from linksweep.sweep.table_writer import Table

MET_WORDS = ("never", "always", "from", "up to", "several times", "left out")
"""Where a condition is met along a line: at no point, at all points, from or up to one crossing, between several.
Lines are left out if the study excludes them, or if their unit cannot be converted to that of the limit.
"""
NEVER, ALWAYS, FROM, UP_TO, SEVERAL, LEFT_OUT = range(len(MET_WORDS))

_COMPARE = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}
_LIMIT = re.compile(
    r"\s*(?P<variable>\w+)\s*(?P<sign><=|>=|<|>)\s*(?P<number>[-+.\w]*\d[-+.\w]*?)(?:\s+(?P<unit>\S.*))?"
)


# Conditions, which are parsed and never run as code


@dataclass(frozen=True)
class Limit:
    """A condition ``variable sign number``; the number is in ``unit``, or in that of the variable where it is empty."""

    variable: str
    sign: str
    number: float
    unit: str = ""

    def number_in(self, unit: str) -> float:
        """Return the number in a unit; raises SweepError if it cannot be converted."""
        if not self.unit:
            return self.number
        from astropy import units

        try:
            return float(units.Unit(self.unit).to(units.Unit(unit), self.number))
        except ValueError as error:  # of another kind, or a unit of an experiment that astropy does not know
            raise SweepError(f"{self.variable} is in {unit or 'no unit'}, not convertible to {self.unit}") from error

    def is_met(self, values: Array, number: float) -> NDArray[np.bool_]:
        """Return where values meet the condition; ``number`` is the limit in their unit."""
        return np.asarray(_COMPARE[self.sign](values, number))

    def __str__(self) -> str:
        return f"{self.variable} {self.sign} {self.number:g} {self.unit}".rstrip()


def parse_limit(text: str) -> Limit:
    """Return the limit that a text like "sigma_spin < 1 uas/yr" states; raises SweepError that says what is allowed."""

    def refused(why: str) -> SweepError:
        return SweepError(f"{shown(text)}: {why}", "--where")

    wanted = "a condition is VARIABLE, one of < <= > >=, and a number with or without a unit, like 'sigma < 1 uas/yr'"
    match = _LIMIT.fullmatch(text.strip())
    if match is None:
        raise refused(wanted)
    try:
        number = float(match["number"])
    except ValueError as error:
        raise refused(f"{shown(match['number'])} is not a number; {wanted}") from error
    if not math.isfinite(number):
        raise refused("the number must be finite")
    if unit := match["unit"] or "":
        from astropy import units

        try:
            units.Unit(unit)
        except (ValueError, TypeError) as error:
            raise refused(f"{shown(unit)} is not a unit that astropy knows") from error
    return Limit(match["variable"], match["sign"], number, unit)


def parse_range(text: str) -> tuple[float, float]:
    """Return both ends of a range like "50:500", either of which may be left out; raises SweepError."""
    low, colon, high = text.partition(":")
    with suppress(ValueError):
        ends = (float(low or "-inf"), float(high or "inf"))
        if colon and ends[0] <= ends[1]:
            return ends
    raise SweepError(f"{shown(text)}: a range is LOW:HIGH, two numbers of which one may be left out", "--range")


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


# Between points


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
    limit = parse_limit(limit) if isinstance(limit, str) else limit
    made = lines(dataset, limit.variable, over, covariance)
    rows = np.array([_cross(made, line, limit, threshold) for line, threshold in enumerate(_thresholds(limit, made))])
    where = made.over_unit
    columns = {
        "met": ("", "when the condition is met"),
        "crossings": ("", "how often the limit is crossed"),
        "first": (where, f"{over} at the first crossing"),
        "first_error": (where, "its one-sigma error"),
        "last": (where, f"{over} at the last crossing"),
        "last_error": (where, "its one-sigma error"),
        "nearest": (made.common_unit, f"{limit.variable} that is nearest to the limit, if that is never crossed"),
        "nearest_at": (where, f"{over} of the nearest"),
    }
    result = made.with_variables({name: (rows[:, i], *columns[name]) for i, name in enumerate(columns)})
    flags = {"flag_values": list(range(len(MET_WORDS))), "flag_meanings": ", ".join(MET_WORDS)}
    result["met"] = result["met"].astype("int8").assign_attrs(result["met"].attrs | flags)
    return result.assign_attrs(condition=str(limit))


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
    made = lines(dataset, variable, over, covariance)
    at = _number(over, at)
    rows = np.full((len(made), 2), np.nan)
    for line, used in enumerate(made.used):
        x, y, errors = made.x[used], made.value[line, used], made.errors_of(line)
        if not len(x):
            continue
        if not x[0] <= at <= x[-1]:
            raise SweepError(f"{over} = {at:g} is beyond the points, which go from {x[0]:g} to {x[-1]:g}")
        i = min(max(int(np.searchsorted(x, at)) - 1, 0), len(x) - 2)
        *_, z = scale = _on_scale(np.append(x, at), made.over_unit)
        fraction = (z - scale[i]) / (scale[i + 1] - scale[i])
        logarithm = bool(np.all(y[i : i + 2] > 0.0))
        u, spread = _pair(y, errors, i, logarithm)
        weights = np.array([1.0 - fraction, fraction])
        value = np.exp(weights @ u) if logarithm else weights @ u
        rows[line] = value, _error(weights, spread, made.samples) * (value if logarithm else 1.0)
    attributes = dataset[variable].attrs
    of_error = described(units_of(attributes), f"one-sigma error of {variable}")
    result = made.grid.drop_attrs(deep=False).assign_coords({over: xr.Variable((), at, dataset[over].attrs)})
    result[variable] = made.dims, rows[:, 0].reshape(made.shape), attributes
    result[f"{variable}_mc_error"] = made.dims, rows[:, 1].reshape(made.shape), of_error
    return result


def _number(over: str, at: Any) -> float:
    """Return a value of an axis as a number; raises SweepError for texts and quantities with a unit."""
    if not isinstance(at, str):
        with suppress(TypeError, ValueError):
            return float(at)
    raise SweepError(f"{over} = {shown(at)}: must be a number, in the unit of the axis")


def _thresholds(limit: Limit, made: Lines) -> list[float]:
    """Return the limit in the unit of each line, NaN if it cannot be converted; raises SweepError if none can."""
    known: dict[str, float] = {}
    refusals = []
    for unit in dict.fromkeys(made.unit):
        try:
            known[unit] = limit.number_in(unit)
        except SweepError as error:
            refusals.append(error)
    if not known:
        raise refusals[0]
    return [known.get(unit, np.nan) for unit in made.unit]


def _cross(made: Lines, line: int, limit: Limit, threshold: float) -> tuple[float, ...]:
    """Return the numbers of one line in the order of the variables of `find`."""
    used = made.used[line]
    x, y, errors = made.x[used], made.value[line, used], made.errors_of(line)
    nothing = (np.nan,) * 4
    if np.isnan(threshold) or not used.any():
        return (LEFT_OUT, 0.0, *nothing, np.nan, np.nan)
    met = limit.is_met(y, threshold)
    flips = np.flatnonzero(met[1:] != met[:-1])
    if not len(flips):
        low = limit.sign.startswith("<") != bool(met[0])
        nearest = int(np.argmin(y) if low else np.argmax(y))
        return (float(met[0]), 0.0, *nothing, y[nearest], x[nearest])
    state = SEVERAL if len(flips) > 1 else FROM if met[-1] else UP_TO
    ends = [part for i in (flips[0], flips[-1]) for part in _crossing(made, x, y, errors, int(i), threshold)]
    return (float(state), float(len(flips)), *ends, np.nan, np.nan)


def _crossing(made: Lines, x: Array, y: Array, errors: Array, i: int, threshold: float) -> tuple[float, float]:
    """Return where the line from point i to the next one meets the threshold, and the error of that."""
    logarithm = bool(np.all(y[i : i + 2] > 0.0)) and threshold > 0.0
    u, spread = _pair(y, errors, i, logarithm)
    fraction = ((np.log(threshold) if logarithm else threshold) - u[0]) / (u[1] - u[0])
    z = _on_scale(x, made.over_unit)
    step = z[i + 1] - z[i]
    weights = np.array([1.0 - fraction, fraction])
    place, error = z[i] + fraction * step, abs(step / (u[1] - u[0])) * _error(weights, spread, made.samples)
    if _is_logarithmic(x, made.over_unit):
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


# Tables of crossings


def tables(result: xr.Dataset) -> list[Table]:
    """Return the table of crossings for reading: places on the axes, and where the condition is met in words."""
    return [table_of_lines(result, [], _conclusions(result))]


def records(result: xr.Dataset) -> Table:
    """Return all numbers of crossings with their conclusions, for programs."""
    return records_of_lines(result, _conclusions(result))


def notes(result: xr.Dataset) -> list[str]:
    """Return the sentence below the table: the condition, and the origin of errors."""
    return [f"{result.attrs['condition']} along {result.attrs['over']}; errors: {result.attrs['errors']}"]


def _conclusions(result: xr.Dataset) -> list[str]:
    names = ("met", "first", "first_error", "last", "last_error", "nearest", "nearest_at")
    unit, value_unit = (units_of(result[name].attrs) for name in ("first", "nearest"))
    return [
        _in_words(*row, unit, value_unit)
        for row in zip(*(result[n].values.ravel().tolist() for n in names), strict=True)
    ]


def _in_words(
    met: int, first: float, first_error: float, last: float, last_error: float, nearest: float, at: float, *units: str
) -> str:
    unit, value_unit = units

    def place(value: float, error: float) -> str:
        return f"{with_error(value, error)} {unit}".rstrip()

    if met in (FROM, UP_TO):
        return f"{MET_WORDS[met]} {place(first, first_error)}"
    if met in (NEVER, ALWAYS):
        where = f"{at:g} {unit}".rstrip()
        return f"{MET_WORDS[met]}; {with_unit(nearest, 0.0, value_unit)} at {where} is nearest to the limit"
    ends = f", first at {place(first, first_error)}, last at {place(last, last_error)}"
    return MET_WORDS[met] + ("" if met == LEFT_OUT else ends)
