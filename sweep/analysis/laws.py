"""A quantity along an axis, for every combination of the other axes: laws, ratios, crossings and values in between.

The points of a quantity along an axis are a `Line`, with errors that are found by the names which
`linksweep.sweep.analysis.quantity` describes.  To each a law is fitted, the power law or one that levels off; between
two points a value or a crossing is interpolated: linearly in the logarithm of the quantity where both, and the limit,
are above 0, and in that of the axis if all its values are above 0 and its unit is not logarithmic already, as
magnitudes are.
"""

import json
import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.linalg import LinAlgError
from numpy.typing import NDArray
from scipy.special import exprel  # scipy.stats takes longer to import than a small study to run

from linksweep.sweep.analysis import quantity
from linksweep.sweep.analysis.tables import STEP, derived
from linksweep.sweep.contract import SweepError, factor_between, refused, rescaled, shown, unit_problem
from linksweep.sweep.contract.rows import LENGTH, Array, Status, p_value, small_sample_factor
from linksweep.sweep.formatting import LOGARITHMIC_UNITS, RAGGED, described, plain, units_of, with_error, with_unit
from linksweep.sweep.studies.study import POINT

LEVELLING_POINTS = 4  # the fewest for the levelling law, which has three parameters
SURE = 3.0  # errors by which a value must be beyond a limit for its side to be decided
DEVIATION_ALLOWED = 3.0  # an exponent may deviate from the expected one by this many of its errors
P_VALUE_ALLOWED = 1e-3  # a law is said not to hold if the probability of its chi2 is lower
# Errors of crossings and plateaus are made so that the truth is within this many of them as often as for a normal law.
SIGMAS = 2.0
# A law is judged only if the errors that points do not share are this many times the neglected second order.
FIRST_ORDER = 5.0
STARTS = (0.5, 2.0, 6.0)  # first guesses of the rate, times the range of the points; the best fit is kept

# Where a condition is met along a line: at no point, at all points, from or up to one crossing, between several.
# Lines are left out that have less than two points, or a unit that cannot be converted to that of the limit.
MET_WORDS = ("never", "always", "from", "up to", "several times", "left out")
NEVER, ALWAYS, FROM, UP_TO, SEVERAL, LEFT_OUT = range(len(MET_WORDS))

# What is derived from a line: whether its unit is that of the quantity, of the axis, or one over it, and its meaning.
MEANINGS = {
    "exponent": ("", "exponent of {variable} over {over}"),
    "amplitude": ("quantity", "{variable} of the law at the pivot"),
    "correlation": ("", "correlation of the errors of exponent and amplitude"),
    "pivot": ("axis", "{over} of the amplitude"),
    "plateau": ("quantity", "{variable} that the law tends to; NaN if it does not level off"),
    "rate": ("per axis", "rate at which the square of {variable} levels off"),
    "end_fall": ("per axis", "fraction by which {variable} falls per unit at its rate at the last {over}"),
    "limit": ("axis", "{over} beyond which {variable} falls by less than wanted"),
    "chi2": ("", "sum of squared residuals in units of their errors"),
    "dof": ("", "degrees of freedom of chi2"),
    "p_value": ("", "probability of a chi2 at least as large, if the law holds"),
    "points": ("", "points of the fit"),
    "expected": ("", "exponent expected"),
    "deviation": ("", "exponent - expected, in errors of the exponent"),
    "met": ("", "when the condition is met"),
    "crossings": ("", "how often the limit is crossed"),
    "first": ("axis", "{over} at the first crossing"),
    "last": ("axis", "{over} at the last crossing"),
    "nearest": ("quantity", "{variable} that is nearest to the limit, if that is never crossed"),
    "nearest_at": ("axis", "{over} of the nearest"),
    "conclusion": ("", "what is concluded"),
}

_COMPARE = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_LIMIT = re.compile(rf"(?P<variable>\w+)\s*(?P<sign><=|>=|<|>)\s*(?P<number>{_NUMBER})(?:\s+(?P<unit>\S.*))?")


# A quantity along an axis


@dataclass(frozen=True)
class Line:
    """The points along an axis that the study does not exclude, in its order: ``y`` (n,) at ``x`` (n,), of ``status``.

    ``errors`` are one sigma of independent points (n,), NaN where there are none or they are not known, or the
    covariance of all (n, n), which was estimated from ``samples``: infinity if it is exact or points are independent,
    NaN if too few errors are known, or points share random numbers and their covariance is not known.  ``index`` is the
    place of the line along the other dimensions.
    """

    index: Mapping[str, int]
    unit: str
    x: Array
    y: Array
    errors: Array
    status: NDArray[Any]
    samples: float

    def decided(self, level: float) -> NDArray[np.bool_]:
        """Return which points are surely on one side of a level, as far as their errors are known."""
        return ~(abs(self.y - level) < SURE * self.sigmas())

    def undecided(self, level: float, met: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.intp], int]]:
        """Yield each row of points that are not decided, and how often ``met`` changes along and beside it."""
        ends = np.flatnonzero(~self.decided(level))
        for some in np.split(ends, np.flatnonzero(np.diff(ends) > 1) + 1) if ends.size else ():
            beside = met[max(some[0] - 1, 0) : some[-1] + 2]
            yield some, int(np.count_nonzero(beside[1:] != beside[:-1]))

    def sigmas(self) -> Array:
        """Return the one-sigma error of each point, (n,)."""
        if self.errors.ndim == 1:
            return self.errors
        return np.asarray(np.sqrt(np.diag(self.errors) * small_sample_factor(self.samples)))

    def fitted(self, fit: Callable[..., dict[str, Any]]) -> dict[str, Any]:
        """Return the numbers of a ``fit`` to the points with a known error above 0, and how many these are; to all
        points where there are none, or too few.
        """
        known = (self.errors > 0.0) & np.isfinite(self.errors)
        used = known if self.errors.ndim == 1 and known.any() and not np.isnan(self.samples) else slice(None)
        return fit(self.x[used], self.y[used], self.errors[used], self.samples) | {"points": len(self.x[used])}


@dataclass(frozen=True)
class Lines:
    """A quantity along the axis ``over``: a line for each combination of the dimensions ``dims``, in C order.

    Coordinates of these dimensions are in ``grid``; ``errors`` says where the errors come from.
    """

    variable: str
    over: str
    over_unit: str
    dims: tuple[str, ...]
    grid: xr.Dataset
    lines: Sequence[Line]
    errors: str

    @property
    def unit(self) -> str:
        """The unit of all lines; '' if they differ: the coordinate of the components' units then gives them."""
        units = {line.unit for line in self.lines}
        return units.pop() if len(units) == 1 else ""

    def thresholds(self, limit: "Limit") -> dict[str, float]:
        """Return the number of a limit in each unit of the lines, NaN in those of another kind.

        Raises SweepError where all are of another kind.
        """
        numbers = {unit: limit.number_in(unit) for unit in dict.fromkeys(line.unit for line in self.lines)}
        if np.isnan([*numbers.values()]).all():
            raise limit.refused_in(self.lines[0].unit)
        return numbers

    def place(self, line: Line) -> dict[str, Any]:
        """Return the coordinates of a line by name, those of dimensions first."""
        one = self.grid.isel(line.index)
        names = dict.fromkeys([*self.dims, *map(str, one.coords)])
        return {n: quantity.listed(one, n, [])[0] for n in names if n in one.coords and not n.endswith("_unit")}

    def at(self, line: Line, x: float | None = None) -> str:
        """Return the place of a line, or of its point at ``x``, as the end of a sentence."""
        place = self.place(line) | ({} if x is None else {self.over: plain([x, *line.x.tolist()])[0]})
        words = quantity.place_in_words(place, self.grid)
        return f" at {words}" if words else ""

    def dataset(
        self, rows: Sequence[Mapping[str, Any]], shown: Sequence[str], notes: list[str], **about: Any
    ) -> xr.Dataset:
        """Return what is derived from the lines, a row for each; what a row lacks is NaN."""
        per = f"1 / ({self.over_unit})" if self.over_unit else ""
        units = {"": "", "quantity": self.unit, "axis": self.over_unit, "per axis": per}
        meanings = {name: (units[unit], words.format_map(vars(self))) for name, (unit, words) in MEANINGS.items()}
        columns = {name: [row.get(name, np.nan) for row in rows] for name in max(rows, key=len)}
        about |= {"variable": self.variable, "over": self.over, "errors": self.errors, "notes": json.dumps(notes)}
        result = derived(self.grid, self.dims, columns, meanings, shown).assign_attrs(about)
        if "pivot" in result:  # a place without an error
            result["pivot"].attrs[STEP] = min(float(np.diff(line.x).min()) for line in self.lines if len(line.x) > 1)
        return result


def lines(dataset: xr.Dataset, variable: str, over: str, least: int = 2) -> Lines:
    """Return a quantity along an axis, for every combination of the others.

    Points that the study excludes do not belong to a line, and a line may have none.  Raises SweepError for an unknown
    quantity or axis, points that are not done, values that are not finite, and where no line has ``least`` points.
    """
    quantity.require_axis(dataset, variable, over)
    made = lines_of(dataset, variable, over, least)
    quantity.require_done(dataset)
    for line in made.lines:
        if (bad := ~np.isfinite(line.y)).any():
            raise SweepError(f"{variable} is not a finite number{made.at(line, line.x[bad][0])}")
    longest = max(made.lines, key=lambda line: len(line.x))
    if (n := len(longest.x)) < least:
        words = f"at least {least} points are needed along {over}; there are {n}{made.at(longest)}"
        raise SweepError(words if n else "the study has no point there")
    return made


def lines_of(dataset: xr.Dataset, variable: str, over: str, least: int = 2) -> Lines:
    """Return a quantity along an axis like `lines`, but with points that are not done.

    Points at which the axis has no effect belong to no line, or where ``least`` is 1 to one without any others.  The
    ``samples`` of a line are NaN where fewer than ``least`` of its errors are known.
    """
    dimension = str(dataset[over].dims[0])
    pair, along = (dimension, f"{dimension}_other"), dataset[over].values
    order = np.argsort(along, kind="stable")
    if dimension == POINT:  # a table may repeat a point
        order = np.unique(along, return_index=True)[1]
    dataset = dataset.isel({dimension: order})
    others = tuple(str(d) for d in dataset[variable].dims if d != dimension)
    covariance = quantity.covariance_along(dataset, variable, dimension)
    if covariance is not None:
        covariance = covariance.isel({pair[1]: quantity.places_of_others(dataset, variable, dimension)})
    samples, error = quantity.samples_along(dataset, variable, dimension), quantity.standard_error(dataset, variable)

    def rows(array: xr.DataArray, *last: str) -> NDArray[Any]:
        """Return values of shape (lines, *last)."""
        shape = {d: dataset.sizes[d.removesuffix("_other")] for d in (*others, *last)}
        values = array.variable.set_dims(shape).values  # type: ignore[no-untyped-call]
        return np.asarray(values.reshape(-1, *values.shape[len(others) :]))

    status_of = dataset["status"]
    if (ragged := dataset[variable].attrs.get(RAGGED)) is not None:
        status_of = status_of.where(~(dataset[ragged] >= dataset[variable + LENGTH]), int(Status.EXCLUDED))
    x, numbers = quantity.numbers(dataset, over).values, quantity.numbers(dataset, variable)
    value, status = rows(numbers, dimension), rows(status_of, dimension)
    errors = rows(np.nan * numbers if error is None else error, dimension)
    if covariance is not None:
        errors = rows(covariance, *pair)
    made = []
    for number, (index, unit) in enumerate(
        zip(quantity.places_along(dataset, others), quantity.units_along(dataset, variable, others), strict=True)
    ):
        there = status[number] != Status.EXCLUDED
        used = there & ~np.isnan(x) if least > 1 or np.isfinite(x[there]).any() else there
        spread = errors[number][np.ix_(*[used] * errors[number].ndim)]
        are_few = np.count_nonzero((spread > 0.0) & np.isfinite(spread)) < least and spread.any()
        n = np.nan if are_few and covariance is None and error is not None else samples
        made.append(Line(index, unit, x[used], value[number, used], spread, status[number, used], n))
    grid = quantity.grid_of(dataset, others)
    words = "covariance between points" + (f", from {samples:.0f} samples" if np.isfinite(samples) else "")
    if covariance is None:
        words = _errors_in_words(made, dimension, error is not None and bool(error.any()), samples)
    return Lines(variable, over, units_of(dataset[over].attrs), others, grid, made, words)


def _errors_in_words(made: Sequence[Line], dimension: str, known: bool, samples: float) -> str:
    if np.isnan(samples):
        return f"not known, as points along {dimension} share random numbers, and there is no covariance of them"
    if not known:
        return "none"
    unknown = np.concatenate([np.isnan(line.errors) for line in made])
    some = f", not known at {unknown.sum():,} of {unknown.size:,}" if unknown.any() else ""
    return f"Monte Carlo, independent points{some}"


# Laws


def fit_power_law(dataset: xr.Dataset, variable: str, over: str, expected: float | None = None) -> xr.Dataset:
    """Fit variable = amplitude (over / pivot)^exponent along an axis, for every combination of the other axes.

    Args:
        dataset: results, as `linksweep.run` and `linksweep.open` return them.
        variable: the name of an output.
        over: the axis.
        expected: the expected exponent; by default that of a claim of the study.

    Points are weighted by their Monte-Carlo errors, and left out where these are not known.  The errors of a law of
    points that share random numbers are NaN unless the dataset has their covariance, NAME_mc_covariance_OVER.

    Returns:
        A dataset over the other axes with the variables ``exponent`` and ``amplitude`` with ``_error``, their
        ``correlation``, ``pivot``, ``chi2``, ``dof``, ``p_value`` (NaN if points have no errors) and ``points``; if an
        exponent is expected also ``expected`` and ``deviation``, (exponent - expected) / exponent_error.

    Raises:
        SweepError: for an unknown variable or axis, points that are not done, and numbers that are not above 0.

    Example:
        >>> import linksweep
        >>> study = linksweep.load_study("sqrt-n", ["n_sim=100", "n_cat=1"], ["n_obj=50,100,200"])
        >>> ds = linksweep.run(study, "sqrt-n.zarr", pool="serial")
        >>> fit = fit_power_law(ds, "sigma_spin", over="n_obj")
        >>> round(float(fit["exponent"].mean()), 2), round(float(fit["exponent_error"].mean()), 2)
        (-0.51, 0.04)
    """
    made = lines(dataset, variable, over)
    if not_above := [x for line in made.lines for x in line.x if not x > 0.0]:
        raise SweepError(f"a power law needs {over} above 0; there is {plain(not_above)[0]}")
    rows = _fitted(made, power_law)
    wanted = [_expected(dataset, made, line) if expected is None else expected for line in made.lines]
    for row, exponent in zip(rows, wanted, strict=True):
        error = row.get("exponent_error", 0.0)
        apart = (row["exponent"] - exponent) / error if error > 0.0 else math.nan
        if np.isfinite(wanted).any():
            row |= {"expected": exponent, "deviation": apart}
        if math.isfinite(apart):
            row["conclusion"] = "as expected" if abs(apart) <= DEVIATION_ALLOWED else "NOT as expected"
    shown = ["exponent", "expected", "deviation", "p_value", "points", "chi2", "dof", "amplitude", "pivot"]
    notes = _notes(f"{variable} = amplitude x ({over} / pivot)^exponent", made, rows)
    return made.dataset(rows, [*shown, "conclusion"], notes, result="law", law="power")


def fit_levelling(dataset: xr.Dataset, variable: str, over: str, fall: float = 0.05) -> xr.Dataset:
    """Fit variable^2 = plateau^2 + c exp(-rate over), a law that levels off, for every combination of the other axes.

    Args:
        dataset: results, as `linksweep.run` and `linksweep.open` return them.
        variable: the name of an output.
        over: the axis.
        fall: the fraction by which the variable falls per unit of the axis at the limit.

    Returns:
        A dataset over the other axes with the variables ``plateau``, ``rate``, ``end_fall`` (relative, per unit of the
        axis, at the last point) and ``limit`` (beyond it the variable falls by less than ``fall`` per unit; -inf:
        everywhere, inf: not yet at the last point, and the law has no plateau), with ``_error``, and ``chi2``, ``dof``,
        ``p_value``, ``points``.  Errors are multiplied by sqrt(chi2/dof) if that is above one.

    Raises:
        SweepError: for an unknown variable or axis, points that are not done, numbers that are not above 0, and a fit
            that does not converge.

    Example:
        >>> import linksweep
        >>> study = linksweep.load_study("quasars", ["n_sim=100", "n_cat=1"], ["v_max=14:18:0.5"])
        >>> ds = linksweep.run(study, "quasars.zarr", pool="serial")
        >>> fit = fit_levelling(ds, "sigma_spin", over="v_max").sel(model="amex")
        >>> round(float(fit["plateau"]), 2), round(float(fit["limit"]), 1)
        (0.59, 14.9)
    """
    if not 0.0 < fall < 1.0:
        raise SweepError(f"fall = {fall:g}: must be above 0 and below 1, a fraction")
    made = lines(dataset, variable, over, least=LEVELLING_POINTS)
    rows = _fitted(made, lambda x, y, errors, samples: levelling(x, y, errors, fall, samples), LEVELLING_POINTS)
    for row, line in zip(rows, made.lines, strict=True):
        if "plateau" in row:
            row["conclusion"] = _levelling_in_words(row, line.x, made.over_unit)
    formula = f"{variable}^2 = plateau^2 + c exp(-rate x {over}); errors are scaled where chi2 > dof"
    shown = ["plateau", "p_value", "points", "chi2", "dof", "conclusion"]
    return made.dataset(rows, shown, _notes(formula, made, rows), result="law", law="levelling", fall=fall)


def ratio(dataset: xr.Dataset, variable: str, axis: str, of: Any, to: Any) -> xr.Dataset:
    """Return the ratio of a variable at two values of an axis, with error, for every combination of the other axes.

    Args:
        dataset: results, as `linksweep.run` and `linksweep.open` return them.
        variable: the name of an output.
        axis: the axis.
        of: the value of the axis in the numerator.
        to: the value of the axis in the denominator.

    Returns:
        A dataset over the other axes with the variables ``ratio`` and ``ratio_error`` (one sigma).  If the two points
        share random numbers, the error includes their covariance, and is NaN if the dataset does not have it.  The
        ratio is NaN if one of the points is excluded or the denominator is 0.

    Raises:
        SweepError: for an unknown variable, values that are not in the grid or at several points of a table, and points
            that are not done.

    Example:
        >>> import linksweep
        >>> study = linksweep.load_study("quasars", ["n_sim=100", "n_cat=1"], ["v_max=14,15,16,17"])
        >>> ds = linksweep.run(study, "quasars.zarr", pool="serial")
        >>> better = ratio(ds, "sigma_spin", "model", of="amex", to="gaia")
        >>> [round(float(x)) for x in better["ratio"]]
        [405, 485, 585, 731]
    """
    quantity.require_quantity(dataset, variable)
    places = []
    for value in (of, to):
        ((dimension, hits),) = quantity.indices(dataset, {axis: value}).items()
        if len(hits) > 1:
            raise SweepError(f"{axis} = {value} is at {len(hits):,} points along {dimension}, and a ratio is of two")
        places.append(place := {dimension: hits[0]})
        quantity.require_done(dataset.isel(place))
        quantity.numbers(dataset.isel(place), variable)
    dims = [str(d) for d in dataset[variable].dims if d not in places[0]]
    meanings = f"{variable} at {axis} = {of} over that at {axis} = {to}", "one-sigma error of ratio"
    columns = zip(("ratio", "ratio_error"), quantity.ratio_at(dataset, variable, *places), meanings, strict=True)
    values = {name: (dims, array, described("", meaning)) for name, array, meaning in columns}
    return quantity.grid_of(dataset, dims).assign(values)


def _fitted(made: Lines, fit: Callable[..., dict[str, Any]], least: int = 2) -> list[dict[str, Any]]:
    """Return the numbers of a fit to every line; of one with fewer than ``least`` points why it has none.

    Raises SweepError for a fit that fails, and for values that are not above 0.
    """
    rows: list[dict[str, Any]] = []
    for line in made.lines:
        n = len(line.x)
        row = {"points": n, "conclusion": "" if n >= least else "too few points" if n else quantity.EXCLUDED}
        rows.append(row)
        if (bad := ~(line.y > 0.0)).any():
            value, place = line.y[bad][0], made.at(line, line.x[bad][0])
            raise SweepError(f"{made.variable} must be above 0; it is {value:g}{place}")
        if n >= least:
            with refused(ValueError, more=f": {made.variable} over {made.over}{made.at(line)}"):
                row |= (law := line.fitted(fit))
            row["p_value"] = p_value(law["chi2"], law["dof"], line.samples)
    return rows


def _notes(formula: str, made: Lines, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    bad = sum(row.get("p_value", math.nan) < P_VALUE_ALLOWED for row in rows)
    more = f"{bad} of {len(rows)} lines: the law does not hold within the errors, p < {P_VALUE_ALLOWED:g}"
    weights = ": points weigh the same, errors come from the scatter" if made.errors == "none" else ""
    left_out = sum(len(line.x) for line in made.lines) - sum(row["points"] for row in rows)
    fewer = f"points without a known error above 0 are left out: {left_out:,}"
    return [f"{formula}; errors: {made.errors}{weights}", *([fewer] if left_out else []), *([more] if bad else [])]


def _expected(dataset: xr.Dataset, made: Lines, line: Line) -> float:
    """Return the exponent that a claim of the study states for a line, NaN if none does."""
    place = made.place(line)
    for claim in quantity.claims_of(dataset):
        if (law := claim.slope) is None or (law.variable, law.over) != (made.variable, made.over):
            continue
        is_meant = law.component is None or any(quantity.is_meant(one, law.component) for one in place.values())
        if is_meant and all(place.get(k) == v for k, v in claim.where.items()):
            return float(claim.published)
    return np.nan


# Conditions, which are parsed and never run as code


@dataclass(frozen=True)
class Limit:
    """A condition ``variable sign number``; the number is in ``unit``, or in that of the variable where it is empty."""

    variable: str
    sign: str
    number: float
    unit: str = ""

    def number_in(self, unit: str) -> float:
        """Return the number in a unit; NaN if that is of another kind, or none that astropy knows."""
        factor = factor_between(self.unit, unit) if self.unit else 1.0
        return math.nan if factor is None else rescaled(self.number, factor)

    def refused_in(self, unit: str) -> SweepError:
        """Return an error for a variable that is in a unit of another kind."""
        return SweepError(f"{self.variable} is in {unit or 'no unit'}, not convertible to {self.unit}")

    def is_met(self, values: Array, number: float) -> NDArray[np.bool_]:
        """Return where values meet the condition; ``number`` is the limit in their unit."""
        return np.asarray(_COMPARE[self.sign](values, number))

    def __str__(self) -> str:
        return f"{self.variable} {self.sign} {plain([self.number])[0]} {self.unit}".rstrip()


def parse_limit(text: str) -> Limit:
    """Return the limit that a text like "sigma_spin < 1 uas/yr" states; raises SweepError that says what is allowed."""
    wanted = "a condition is VARIABLE, one of < <= > >=, a finite number and perhaps its unit, like 'x < 1 uas/yr'"
    match = _LIMIT.fullmatch(text.strip())
    number = float(match["number"]) if match else math.nan
    if match is None or not math.isfinite(number):
        raise SweepError(f"{shown(text)}: {wanted}", "--where")
    if wrong := unit_problem(unit := match["unit"] or ""):
        raise SweepError(f"{shown(text)}: {wrong}", "--where")
    return Limit(match["variable"], match["sign"], number, unit)


def points_where(dataset: xr.Dataset, limit: Limit) -> tuple[xr.Dataset, str]:
    """Return the points of a table or a design at which a condition is met, with all their results, and in words how
    many points are not decided.

    Raises SweepError for an unknown quantity, one with further dimensions, and points that are not done.
    """
    quantity.require_quantity(dataset, limit.variable)
    array = quantity.numbers(dataset, limit.variable)
    if further := ", ".join(str(d) for d in array.dims if d != POINT):
        raise SweepError(f"{limit.variable} has {further} at each point: fix it with --at, or name it with --over")
    quantity.require_done(dataset)
    threshold = limit.number_in(unit := units_of(array.attrs))
    if math.isnan(threshold):
        raise limit.refused_in(unit)
    unsure = (abs(array.values - threshold) < SURE * quantity.sigmas(dataset, limit.variable, [POINT])).sum()
    return dataset.isel({POINT: np.flatnonzero(limit.is_met(array.values, threshold))}), _doubt(unsure, array.size)


# Between points


def find(dataset: xr.Dataset, limit: Limit | str, over: str) -> xr.Dataset:
    """Return where along an axis a condition is met, for every combination of the other axes.

    Args:
        dataset: results, as `linksweep.run` and `linksweep.open` return them.
        limit: a variable, one of < <= > >=, and a number with or without a unit: "sigma_spin < 1 uas/yr".
        over: the axis.

    Returns:
        A dataset over the other axes with the variables ``met`` (whether and where the condition is met; its
        attributes give the meaning of the numbers), ``crossings`` (how many), ``first`` and ``last`` (the axis at the
        first and last crossing; NaN if there is none) with ``_error`` (one sigma, from the errors of the points around
        it; NaN where these are so large that there may be no crossing), ``nearest`` (if the condition is never or
        always met, the value nearest to the limit; otherwise NaN) with ``_error``, and ``nearest_at`` (the axis there).

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
    made = lines(dataset, limit.variable, over, least=1)
    thresholds = made.thresholds(limit)
    rows = [_cross(line, limit, thresholds[line.unit], made.over_unit) for line in made.lines]
    axis = np.unique(quantity.numbers(dataset, over))
    for row, line in zip(rows, made.lines, strict=True):
        words = _crossing_in_words(row, made.over_unit, line, limit, thresholds[line.unit])
        row["conclusion"] = words + _part_in_words(line.x, axis[np.isfinite(axis)])
    notes = [f"{limit} along {over}; errors: {made.errors}"]
    result = made.dataset(rows, ["conclusion"], notes, result="crossings", condition=str(limit))
    flags = {"flag_values": list(range(len(MET_WORDS))), "flag_meanings": ", ".join(MET_WORDS)}
    result["met"] = result["met"].astype("int8").assign_attrs(result["met"].attrs | flags)
    return result


def interpolate(dataset: xr.Dataset, variable: str, over: str, at: float) -> xr.Dataset:
    """Interpolate a variable between the points of an axis, for every combination of the other axes.

    Args:
        dataset: results, as `linksweep.run` and `linksweep.open` return them.
        variable: the name of an output.
        over: the axis.
        at: the value of the axis, in its unit.

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
    made = lines(dataset, variable, over)
    if not isinstance(at, bool | int | float | np.number) or np.isnan(at):  # a text may be meant in another unit
        raise SweepError(f"{over} = {shown(at)}: must be a number, in the unit of the axis")
    at, rows = float(at), np.full((len(made.lines), 2), np.nan)
    for row, line in ((row, line) for row, line in zip(rows, made.lines, strict=True) if len(line.x) > 1):
        x = line.x
        if not x[0] <= at <= x[-1]:
            wanted, first, *_, last = plain([at, *x.tolist()])
            raise SweepError(f"{over} = {wanted} is beyond the points, which go from {first} to {last}")
        i = min(max(int(np.searchsorted(x, at)) - 1, 0), len(x) - 2)
        u, spread, unit = _pair(line, i)
        *_, z = scale = on_scale(np.append(x, at), made.over_unit)
        fraction = (z - scale[i]) / (scale[i + 1] - scale[i])
        weights = np.array([1.0 - fraction, fraction])
        value, error = weights @ u, np.sqrt(max(weights @ spread @ weights, 0.0) * small_sample_factor(line.samples))
        row[:] = (np.exp(value), np.exp(value) * error) if unit is None else (value * unit, error * unit)
    attributes, rows = dataset[variable].attrs, rows.T.reshape(2, *(made.grid.sizes[d] for d in made.dims))
    of_error = described(units_of(attributes), f"one-sigma error of {variable}")
    values = {variable: (made.dims, rows[0], attributes), f"{variable}_mc_error": (made.dims, rows[1], of_error)}
    return made.grid.drop_attrs(deep=False).assign_coords({over: ((), at, dataset[over].attrs)}).assign(values)


def _cross(line: Line, limit: Limit, threshold: float, over_unit: str) -> dict[str, Any]:
    """Return the numbers of one line, which are the variables of `find`."""
    names = ("first", "first_error", "last", "last_error", "nearest", "nearest_error", "nearest_at")
    row: dict[str, Any] = {"met": LEFT_OUT, "crossings": 0} | dict.fromkeys(names, np.nan)
    # One point is a line only where the axis has no effect.
    if np.isnan(threshold) or (len(line.x) < 2 and not np.isnan(line.x).any()):
        return row
    met = limit.is_met(line.y, threshold)
    flips = np.flatnonzero(met[1:] != met[:-1]).tolist()
    if not flips:
        low = limit.sign.startswith("<") != bool(met[0])
        nearest = int(np.argmin(line.y) if low else np.argmax(line.y))
        numbers = {"nearest": line.y[nearest], "nearest_error": line.sigmas()[nearest], "nearest_at": line.x[nearest]}
        return row | {"met": int(met[0])} | numbers
    row |= {"met": SEVERAL if len(flips) > 1 else FROM if met[-1] else UP_TO, "crossings": len(flips)}
    for name, i in (("first", flips[0]), ("last", flips[-1])):
        row[name], row[f"{name}_error"] = _crossing(line, i, threshold, over_unit)
    return row


def _crossing(line: Line, i: int, threshold: float, over_unit: str) -> tuple[float, float]:
    """Return where the line from point i to the next one meets the threshold, and the error of that.

    The line is within two of its errors of the threshold up to two errors of the place, in the unit of the axis, on the
    side where that is farther (Fieller 1954): noise, which chooses the points on both sides, makes the line between
    them too steep.  Where it also makes the line cross back, the last crossing before a point that is surely beyond
    counts.  The error is NaN where the line does not leave the threshold, on the side that it crosses to.
    """
    (u, *_), z = _pair(line, i, threshold), on_scale(line.x, over_unit)
    place = z[i] + u[0] / (u[0] - u[1]) * (z[i + 1] - z[i])
    mirrored = replace(line, y=np.flip(line.y), errors=np.flip(line.errors))
    after = _reach(line, z, i, threshold)
    before = _reach(mirrored, -z[::-1], len(z) - 2 - i, threshold)
    back = np.positive if z is line.x else np.exp
    with np.errstate(over="ignore"):  # a reach beyond all floats is not known
        places = back(np.array([place, after, -before]))
    error = np.abs(places - places[0]).max() / SIGMAS
    return float(places[0]), float(error) if error < np.inf else np.nan


@np.errstate(all="ignore")  # what is no number is no reach
def _reach(line: Line, z: Array, start: int, threshold: float) -> float:
    """Return up to which place a line is within `SIGMAS` of its errors of a threshold, or on the side it comes from,
    from where it last meets it between point ``start`` and one that is surely beyond; after the last point the line
    goes on.  NaN if there is no such place.
    """
    side = np.sign(line.y[start + 1] - line.y[start])
    beyond = (side * (line.y - threshold) / line.sigmas())[start + 1 :]
    # The more points there are, the farther noise drives one of them.
    sure = np.argmax([*(beyond >= np.sqrt(SURE**2 + 2.0 * np.log(len(z)))), True])
    back = np.flatnonzero(beyond[:sure] < 0.0)
    start += int(back[-1]) + 1 if back.size else 0
    for i in range(start, len(z) - 1):
        u, spread, _ = _pair(line, i, threshold)
        fraction = u[0] / (u[0] - u[1]) if i == start else 0.0
        at, along = np.array([1.0 - fraction, fraction]), np.array([-1.0, 1.0])
        spread = SIGMAS**2 * small_sample_factor(line.samples) * spread
        # The square of the line less that of its errors is c + 2 b s + a s^2 at a distance s.
        off, slope = at @ u if i > start else 0.0, along @ u
        a, b, c = slope**2 - along @ spread @ along, off * slope - at @ spread @ along, off**2 - at @ spread @ at
        if np.isnan(c):  # errors that are not known
            break
        root = -b - np.copysign(np.sqrt(b * b - a * c), b)
        ends = np.array([c / root, root / a])  # of which the first is exact where a is small
        ends = ends[(ends >= 0.0) & (side * (off + slope * ends) > 0.0)]
        s = 0.0 if c >= 0.0 <= side * off else min(ends, default=np.inf)
        if np.isfinite(s) and (fraction + s <= 1.0 or i == len(z) - 2):
            return float(z[i] + (fraction + s) * (z[i + 1] - z[i]))
    return np.nan


def _pair(line: Line, i: int, threshold: float | None = None) -> tuple[Array, Array, float | None]:
    """Return two neighbouring values less a threshold, if there is one, and their covariance (2, 2), as logarithms
    where all are above 0 and None; else in a unit, a power of two with which squares are floats, and this.
    """
    part = slice(i, i + 2)
    values, errors = line.y[part], line.errors[(part,) * line.errors.ndim]
    if min(*values, 1.0 if threshold is None else threshold) > 0.0:
        return np.log(values / (threshold or 1.0)), _relative(errors, values), None
    unit = float(np.ldexp(0.5, np.frexp(np.abs([*values, threshold or 0.0]).max())[1]))
    return values / unit - (threshold or 0.0) / unit, _relative(errors, np.full(2, unit)), unit


def on_scale(x: Array, unit: str) -> Array:
    """Return the axis on the scale for interpolation: its logarithm, or itself if it is one already or has none."""
    return np.log(x) if np.all(x > 0.0) and unit not in LOGARITHMIC_UNITS else x


# Fits: arrays in, numbers out


def power_law(x: Array, y: Array, errors: Array, samples: float = np.inf) -> dict[str, Any]:
    """Return the power law y = amplitude (x / pivot)^exponent through points, by generalised least squares of log y
    against log x: these numbers with one-sigma errors of the first and the last, and their ``correlation``, which the
    pivot makes 0 unless the covariance was estimated from samples.  ``chi2`` is NaN where the points have no errors.

    ``x`` and ``y`` (n,) are positive; ``errors`` are one sigma of y, (n,), or the covariance of y, (n, n).  The errors
    of the law follow from the errors of y, whatever the scatter.  Unless all errors (n,) are known and positive, all
    points weigh the same, and the errors of the law come from the scatter (0 for two points, which have none), which is
    at least that of rounding.
    If the covariance was estimated from ``samples``, only its diagonal gives weights, as its inverse would follow its
    noise; the errors of the law with these weights are computed from all of it.  If ``samples`` is NaN, the
    covariance of points with errors (n,) is not known: the errors give weights, and the errors of the law are NaN.
    Raises ValueError for a covariance that is not positive definite.
    """
    relative, known = _relative_covariance(y, errors)
    whiten, covariance = _weigh(relative, samples)
    ones, u, v = whiten(np.ones_like(x)), whiten(np.log(x)), whiten(np.log(y))
    total = ones @ ones
    centre, mean = ones @ u / total, ones @ v / total
    u, v = u - centre * ones, v - mean * ones  # about the centre, amplitude and exponent are not correlated
    information = u @ u
    exponent = u @ v / information
    dof = len(x) - 2
    chi2 = _chi2(v - exponent * u, np.stack([ones, u], axis=1), covariance, relative, samples)
    rounding = np.finfo(float).eps * (1.0 + np.abs([np.log(x), np.log(y)]).max())
    unit = 1.0 if known else max(chi2 / dof, rounding**2) if dof > 0 else 0.0
    solve = np.stack([u / information, ones / total])
    spread = unit * float(small_sample_factor(samples)) * solve @ covariance @ solve.T
    exponent_error, relative_error = np.sqrt(np.diag(spread).clip(min=0.0))  # 0 but for rounding where all is shared
    both = exponent_error * relative_error
    amplitude = np.exp(mean)
    return {
        "exponent": float(exponent),
        "exponent_error": float(exponent_error),
        "amplitude": float(amplitude),
        "amplitude_error": float(amplitude * relative_error),
        "correlation": float(spread[0, 1] / both) if both > 0.0 else 0.0,
        "pivot": float(np.exp(centre)),
        "chi2": chi2 if known and not np.isnan(samples) else np.nan,
        "dof": dof,
    }


def levelling(x: Array, y: Array, errors: Array, fall: float, samples: float = np.inf) -> dict[str, Any]:
    """Return the law that levels off, y^2 = plateau^2 + c exp(-rate x), and where it falls by the fraction ``fall`` per
    unit of x: `MEANINGS` has what these numbers are.  ``plateau`` is NaN where the points do not level off; ``limit``
    is -inf if y falls by less everywhere, inf if it falls by more at the end and does not level off, and may lie beyond
    the points.

    ``x`` (n,) ascends, ``y`` (n,) is positive, n at least 4; ``errors`` and ``samples`` are as in `power_law`.  Unless
    all errors are known, those of the law come from the scatter.  They are scaled up if points are farther from the law
    than their own errors allow.
    Raises ValueError where it does not converge, or for a covariance that is not positive definite.
    """
    # here, as a run that only compares with claims does not need to read it
    from scipy.optimize import approx_fprime, least_squares

    relative, known = _relative_covariance(y, errors)
    whiten, covariance = _weigh(relative, samples)
    first, length, scale = x[0], x[-1] - x[0], y[-1]
    z, target = (x - first) / length, np.log(y / scale)  # z runs from 0 at the first point to 1 at the last

    # The parameters are log y^2 at both ends and the rate: they are hardly correlated, and y^2 is positive in between
    # whatever their values are.
    def misfit(parameters: Array) -> Array:
        start, end, rate = np.exp(parameters[0]), np.exp(parameters[1]), parameters[2]
        square = start + (end - start) * z * exprel(-rate * z) / exprel(-rate)
        return whiten(0.5 * np.log(np.asarray(square)) - target)

    converged = []
    for guess in STARTS:
        with np.errstate(all="ignore"), suppress(ValueError, LinAlgError):
            # a trial value of the rate may overflow and is then rejected; a parameter that nothing depends on has
            # no error, and its matrix no inverse
            begin = np.array([2.0 * target[0], 0.0, guess])
            fit = least_squares(misfit, begin, jac="3-point", xtol=1e-10, ftol=1e-12, gtol=1e-12, max_nfev=300)
            jacobian = np.asarray(fit.jac, dtype=np.float64)
            np.linalg.inv(jacobian.T @ jacobian)
            if fit.success:
                converged.append((2.0 * float(fit.cost), fit.x, jacobian))
    if not converged:
        raise ValueError("the levelling law does not converge")
    misfit_squared, best, slopes = min(converged, key=lambda each: each[0])
    dof = len(x) - 3
    solve = np.linalg.pinv(slopes)
    spread = solve @ covariance @ solve.T * float(small_sample_factor(samples))
    if misfit_squared > dof or not known:
        spread = spread * misfit_squared / dof

    def derived(parameters: Array) -> Array:
        start, end, rate = np.exp(parameters[0]), np.exp(parameters[1]), parameters[2]
        bound = 0.0 if start > end else np.inf
        floor = max(start + (end - start) / -np.expm1(-rate), 0.0) if rate > 0.0 else bound  # what y^2 tends to
        end_fall = -np.expm1(0.5 * (end - start) / end / exprel(rate) / length)
        limit, most = np.inf if end_fall > fall else -np.inf, -0.5 * rate / length / np.log1p(-fall)
        if floor > 0.0 and end < start and most > 1.0:  # where the plateau does not count yet, it falls by most
            limit = first + length * np.log((start - floor) / floor * (most - 1.0)) / rate
        return np.array([scale * np.sqrt(floor), rate / length, end_fall, limit])

    values = derived(best)
    with np.errstate(invalid="ignore"):
        jacobian = approx_fprime(best, derived)
        # Each is computed at both ends of its own interval, as the first order is far too small for a plateau near 0.
        steps = SIGMAS * jacobian @ spread / np.sqrt(np.einsum("ij,jk,ik->i", jacobian, spread, jacobian))[:, None]
        ends = np.array([np.diag([derived(best + sign * step) for step in steps]) for sign in (-1.0, 1.0)])
        sigmas = np.abs(ends - values).max(axis=0) / SIGMAS
    values[0] = values[0] if 0.0 < values[0] < np.inf else np.nan
    sigmas = np.where(np.isfinite(values + sigmas), sigmas, np.nan)
    judged = known and not np.isnan(samples)
    chi2 = _chi2(misfit(best), slopes, covariance, relative, samples) if judged else np.nan
    law: dict[str, Any] = {}
    for name, *both in zip(("plateau", "rate", "end_fall", "limit"), values.tolist(), sigmas.tolist(), strict=True):
        law[name], law[f"{name}_error"] = both
    return law | {"chi2": chi2, "dof": dof}


def _relative(errors: Array, y: Array) -> Array:
    """Return the covariance (n, n) of values relative to ``y`` (n,), from their errors (n,) or covariance (n, n)."""
    return np.diag((errors / y) ** 2) if errors.ndim == 1 else errors / y / y[:, None]


def _relative_covariance(y: Array, errors: Array) -> tuple[Array, bool]:
    """Return the covariance of log y to first order, (n, n), from errors (n,) or a covariance (n, n) of y, and whether
    it is known: unless errors (n,) are all finite and positive, it is the unit matrix, for points of equal weight.
    """
    known = errors.ndim == 2 or bool(np.all((errors > 0.0) & np.isfinite(errors)))
    return _relative(errors, y) if known else np.eye(len(y)), known


def _weigh(covariance: Array, samples: float) -> tuple[Callable[[Array], Array], Array]:
    """Return the function that weights points, and the covariance (n, n) of weighted points.  An exact covariance
    gives all weights, and leaves the unit matrix; one estimated from ``samples`` gives weights by its diagonal only.
    Raises ValueError for a covariance that is not positive definite.
    """
    try:
        root = np.sqrt(np.diag(np.diag(covariance))) if np.isfinite(samples) else np.linalg.cholesky(covariance)
    except LinAlgError:
        root = np.zeros_like(covariance)
    if not np.isfinite(root).all() or not np.diag(root).all():  # NaN in is NaN out, without an error
        raise ValueError("the covariance between the points is not positive definite")

    def whiten(values: Array) -> Array:
        return np.linalg.solve(root, values)

    return whiten, whiten(whiten(covariance).T)


def _chi2(residual: Array, design: Array, covariance: Array, relative: Array, samples: float) -> float:
    """Return the sum of squared residuals of weighted points, in units of their errors, about a law with the ``design``
    (n, parameters).  NaN if points with a ``relative`` covariance from ``samples`` share so much of their errors that
    the rest is not known: the covariance is of first order, and the second is about the square of the relative error.
    """
    rest = np.linalg.qr(design, mode="complete")[0][:, design.shape[1] :]
    free = rest.T @ covariance @ rest
    if not free.size:
        return 0.0
    error = float(np.sqrt(np.max(np.diag(relative)))) if np.isfinite(samples) else 0.0
    if np.linalg.eigvalsh(free)[0] < (FIRST_ORDER * error) ** 2:
        return np.nan
    return float(residual @ rest @ np.linalg.solve(free, rest.T @ residual))


# Words


def _place_on(x: Array, place: float, error: float) -> str:
    """Return a place between the points of an axis with its error, or with two digits of the step around it."""
    after = np.clip(np.searchsorted(x, place), 1, len(x) - 1)
    return with_error(place, error, float(x[after] - x[after - 1]))


def _levelling_in_words(row: Mapping[str, float], x: Array, unit: str) -> str:
    limit = row["limit"]
    if limit == -math.inf:
        return "falls by less everywhere"
    per = f" per {unit}" if unit else ""
    end = f"at the end it falls by {with_error(100.0 * row['end_fall'], 100.0 * row['end_fall_error'])} %{per}"
    if limit == math.inf:
        return f"no plateau; {end}"
    place = f"{_place_on(x, limit, row['limit_error'])} {unit}".rstrip()
    words = f"falls by less from {place}" if limit <= x[-1] else f"no plateau yet: not before {place}, by the law"
    doubt = "" if row["plateau"] > SIGMAS * row["plateau_error"] else "; the levelling off is not significant"
    if math.isnan(row["plateau_error"]):
        doubt = "; whether the levelling off is significant is not known"
    return f"{words}; {end}{doubt}"


def _crossing_in_words(row: Mapping[str, Any], unit: str, line: Line, limit: Limit, threshold: float) -> str:
    if (met := row["met"]) == LEFT_OUT:
        return MET_WORDS[met]
    names, n = ("first", "last") if row["crossings"] else (), len(line.x)
    places = [f"{_place_on(line.x, row[name], row[f'{name}_error'])} {unit}".rstrip() for name in names]
    if met == SEVERAL:
        what = f", first at {places[0]}, last at {places[1]}"
    elif places:
        what = f" {places[0]}"
    else:
        at = plain([row["nearest_at"], *line.x.tolist()])[0]
        where = f" at {at} {unit}".rstrip() if at else ""
        what = f"; {with_unit(row['nearest'], row['nearest_error'], line.unit)}{where} is nearest to the limit"
    rows = line.undecided(threshold, limit.is_met(line.y, threshold))
    # A single crossing between points that are decided is sure.
    unsure = sum(len(some) for some, changes in rows if changes != 1 or some[0] == 0 or some[-1] == n - 1)
    return "; ".join(filter(None, (f"{MET_WORDS[met]}{what}", _doubt(unsure, n))))


def _doubt(unsure: int, n: int) -> str:
    return f"not decided: {unsure} of {n} points are within {SURE:g} errors of the limit" if unsure else ""


def _part_in_words(x: Array, axis: Array) -> str:
    """Return which part of an axis the points of a line cover, as the end of a sentence; '' if they cover all of it."""
    if not len(x) or np.isnan(x[0]) or (x[0] <= axis[0] and x[-1] >= axis[-1]):
        return ""
    first, last, *_ = plain([x[0], x[-1], *axis.tolist()])
    return f"; only 1 of {len(axis)} points: {first}" if len(x) == 1 else f"; points go only from {first} to {last}"
