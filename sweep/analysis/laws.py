"""Laws along an axis, for every combination of the other axes: power laws, the law that levels off, and ratios.

A quantity along an axis is first made `Lines` of arrays, to each of which a law of `linksweep.sweep.analysis.fits` is
fitted.  Errors are found by the names that `linksweep.sweep.analysis.quantity` describes, expected exponents in the
claims of the study.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from linksweep.sweep.analysis.compare import claims_of
from linksweep.sweep.analysis.fits import Levelling, PowerLaw, levelling, p_value, power_law
from linksweep.sweep.analysis.quantity import (
    COVARIANCE_SUFFIX,
    axis_coordinates,
    covariance_along,
    error_of_sum,
    indices,
    listed,
    place_in_words,
    require_axis,
    require_done,
    require_quantity,
    samples_along,
    standard_error,
)
from linksweep.sweep.contract import FEW, FEWEST_SAMPLES, Array, SweepError
from linksweep.sweep.formatting import described, fixed, prefixed, units_of, with_error
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.studies.record import outer_draw_of
from linksweep.sweep.studies.study import POINT
from linksweep.sweep.table_writer import Column, Table

LEVELLING_POINTS = 4
"""The fewest points for the levelling law, which has three parameters."""

DEVIATION_ALLOWED = 3.0
"""An exponent may deviate from the expected one by this many of its errors."""

P_VALUE_ALLOWED = 1e-3
"""A law is said not to hold if the probability of its chi2 is lower than this."""

RATE_WANTED = 2.0
"""A levelling off is significant if its rate is more than this many errors above 0."""

CONCLUSION = 24
"""The least width of the column of conclusions in words, in characters."""


# A quantity along an axis


@dataclass(frozen=True)
class Lines:
    """A quantity along the axis ``over``: ``value``, ``error`` and ``used`` (lines, n) at ``x`` (n,), which ascends.

    ``error`` is one sigma, NaN or 0 where there is none; ``covariance`` (lines, n, n) is there if the dataset has it.
    Points that a study excludes are not ``used``.  The lines are those of the dimensions ``dims`` in C order, whose
    coordinates are in ``grid``; ``unit`` (lines,) is the unit of each, ``errors`` says where the errors come from.
    ``samples`` is the number of independent samples from which the covariance was estimated: infinity if it is exact
    or points are independent, NaN if they share random numbers and their covariance is not known.
    """

    variable: str
    over: str
    over_unit: str
    x: Array
    value: Array
    error: Array
    used: NDArray[np.bool_]
    covariance: Array | None
    dims: tuple[str, ...]
    grid: xr.Dataset
    unit: tuple[str, ...]
    errors: str
    samples: float = np.inf

    def __len__(self) -> int:
        return len(self.value)

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each of ``dims``."""
        return tuple(self.grid.sizes[d] for d in self.dims)

    @property
    def common_unit(self) -> str:
        """The unit of all lines; '' if they differ: the coordinate of the components' units then gives them."""
        return self.unit[0] if len(set(self.unit)) == 1 else ""

    def place(self, line: int) -> dict[str, Any]:
        """Return the coordinates of a line by name, those of dimensions first."""
        one = self.grid.isel(dict(zip(self.dims, np.unravel_index(line, self.shape), strict=True)))
        names = [*self.dims, *(n for n in map(str, one.coords) if n not in self.dims and not n.endswith("_unit"))]
        return {n: one[n].item() for n in names if n in one.coords}

    def errors_of(self, line: int) -> Array:
        """Return the errors (k,) or the covariance (k, k) of the k used points of a line."""
        used = self.used[line]
        return np.asarray(
            self.error[line, used] if self.covariance is None else self.covariance[line][np.ix_(used, used)]
        )

    def with_variables(self, columns: Mapping[str, tuple[Any, str, str]]) -> xr.Dataset:
        """Return the grid with variables, each given by values (lines,), unit and meaning, and with attributes."""
        variables = {
            name: (self.dims, np.reshape(values, self.shape), described(unit, meaning))
            for name, (values, unit, meaning) in columns.items()
        }
        return self.grid.assign(variables).assign_attrs(variable=self.variable, over=self.over, errors=self.errors)


def lines(
    dataset: xr.Dataset, variable: str, over: str, covariance: xr.DataArray | None = None, least: int = 2
) -> Lines:
    """Return a quantity along an axis, for every combination of the others.

    ``covariance`` takes the place of NAME_mc_covariance_OVER in the dataset.  Points that the study excludes do not
    belong to a line, and a line may have none.  Raises SweepError for an unknown quantity or axis, points that are not
    done, values that are not finite, and lines of fewer than ``least`` points.
    """
    require_axis(dataset, variable, over)
    dimension = str(dataset[over].dims[0])
    if dimension == POINT:  # a table may repeat a point
        once = np.unique(dataset[over].values, return_index=True)[1]
        dataset = dataset.isel({d: once for d in (POINT, f"{POINT}_other") if d in dataset.dims})
    others = [str(d) for d in dataset[variable].dims if d != dimension]
    order = np.argsort(dataset[over].values, kind="stable")
    if covariance is None:
        covariance = covariance_along(dataset, variable, dimension)
    samples = samples_along(dataset, dimension, covariance)
    error = standard_error(dataset, variable)

    def rows(array: xr.DataArray, *last: str) -> NDArray[Any]:
        """Return values of shape (lines, *last), in the order of the axis."""
        shape = {d: dataset.sizes[d.removesuffix("_other")] for d in (*others, *last)}
        whole: xr.Variable = array.variable.set_dims(shape)  # type: ignore[no-untyped-call]
        values = whole.isel(dict.fromkeys(last, order)).transpose(*others, *last).values
        return np.asarray(values.reshape(-1, *values.shape[len(others) :]))

    pair = (dimension, f"{dimension}_other")
    if covariance is not None and (
        set(covariance.dims) - {*others, *pair} or any(covariance.sizes[d] != dataset.sizes[dimension] for d in pair)
    ):
        name = f"{variable}_{COVARIANCE_SUFFIX}_{dimension}"
        raise SweepError(
            f"{name} is {dict(covariance.sizes)}: it needs {' and '.join(pair)} of one length, and no more"
        )
    along = {n: c.variable for n, c in dataset.coords.items() if set(c.dims) <= set(others)}
    made = Lines(
        variable=variable,
        over=over,
        over_unit=units_of(dataset[over].attrs),
        x=dataset[over].values[order].astype(float),
        value=rows(dataset[variable].astype(float), dimension),  # integers too: errors may be NaN
        error=rows(xr.full_like(dataset[variable], np.nan, dtype=float) if error is None else error, dimension),
        used=rows(dataset["status"], dimension) != Status.EXCLUDED,
        covariance=None if covariance is None else rows(covariance, *pair),
        dims=tuple(others),
        grid=xr.Dataset(
            coords=along | {d: dataset[d].variable for d in others},
            attrs={"title": str(dataset.attrs.get("title", ""))},
        ),
        unit=_units(dataset, variable, others),
        errors=_errors_in_words(dataset, error is not None, covariance is not None, samples),
        samples=samples,
    )
    require_done(dataset)
    if problems := _unusable(made, least):
        raise SweepError(problems[:FEW])
    return made


def _units(dataset: xr.Dataset, variable: str, others: Sequence[str]) -> tuple[str, ...]:
    """Return the unit of each line: that of the variable, or of the components that its own unit lists."""
    unit = units_of(dataset[variable].attrs)
    listed_units = [c.variable.astype(object) for n, c in dataset.coords.items() if str(n).endswith("_unit")]
    parts = [part for part in listed_units if set(part.dims) <= set(others)] if "," in unit else []
    whole = xr.Variable(others, np.full([dataset.sizes[d] for d in others], "" if parts else unit, dtype=object))
    for part in parts:
        whole = whole + (part if len(parts) == 1 else "(" + part + ") ")
    return tuple(str(each).strip() for each in whole.values.reshape(-1))


def _errors_in_words(dataset: xr.Dataset, known: bool, correlated: bool, samples: float) -> str:
    if correlated:
        return "covariance between points" + (f", from {samples:.0f} samples" if np.isfinite(samples) else "")
    if np.isnan(samples):
        return (
            "not known, as points share random numbers and the store has no covariance of them "
            f"(it needs {FEWEST_SAMPLES} {outer_draw_of(dataset.attrs)}s, or as many blocks of one, and no `precision`)"
        )
    return "Monte Carlo, independent points" if known else "none: points weigh the same, errors come from the scatter"


def _unusable(made: Lines, least: int) -> list[str]:
    problems = []
    finite, count = np.isfinite(made.value) | ~made.used, made.used.sum(axis=1)
    for line in range(len(made)):
        if not finite[line].all():
            place = made.place(line) | {made.over: made.x[~finite[line]][0]}
            problems.append(f"{made.variable} is not a finite number at {place_in_words(place)}")
        elif 0 < count[line] < least:
            where = _at(made, line)
            problems.append(f"at least {least} points are needed along {made.over}; there are {count[line]}{where}")
    return problems if count.any() else [*problems, "every point is excluded by the study"]


def _at(made: Lines, line: int, more: Mapping[str, Any] | None = None) -> str:
    words = place_in_words(made.place(line) | dict(more or {}))
    return f" at {words}" if words else ""


# Laws


def fit_power_law(
    dataset: xr.Dataset,
    variable: str,
    over: str,
    expected: float | None = None,
    covariance: xr.DataArray | None = None,
) -> xr.Dataset:
    """Fit variable = amplitude (over / pivot)^exponent along an axis, for every combination of the other axes.

    Args:
        dataset: results, as `linksweep.run` and `linksweep.open` return them.
        variable: the name of an output.
        over: the axis.
        expected: the expected exponent; by default that of a claim of the study.
        covariance: the covariance of the variable's points, with dimensions (..., over, over_other); that of the
            dataset by default.  Without it the errors of points that share random numbers are NaN; other points are
            weighted by their Monte-Carlo errors.

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
    made = lines(dataset, variable, over, covariance)
    _require_positive(made, axis_too=True)
    columns = {
        "exponent": ("", f"exponent of {variable} over {over}"),
        "amplitude": (made.common_unit, f"{variable} of the law at the pivot"),
        "correlation": ("", "correlation of the errors of exponent and amplitude"),
        "pivot": (made.over_unit, f"{over} of the amplitude"),
    }
    result = _fitted(made, columns, power_law)
    wanted = [_expected(dataset, made, line) if expected is None else expected for line in range(len(made))]
    if np.isfinite(wanted).any():
        result["expected"] = (made.dims, np.reshape(wanted, made.shape), described("", "exponent expected"))
        error = result["exponent_error"]
        result["deviation"] = (result["exponent"] - result["expected"]) / error.where(error > 0.0)
        result["deviation"].attrs = described("", "exponent - expected, in errors of the exponent")
    return result.assign_attrs(law="power")


def fit_levelling(
    dataset: xr.Dataset, variable: str, over: str, fall: float = 0.05, covariance: xr.DataArray | None = None
) -> xr.Dataset:
    """Fit variable^2 = plateau^2 + c exp(-rate over), a law that levels off, for every combination of the other axes.

    Args:
        dataset: results, as `linksweep.run` and `linksweep.open` return them.
        variable: the name of an output.
        over: the axis.
        fall: the fraction by which the variable falls per unit of the axis at the limit.
        covariance: the covariance of the variable's points, as in `fit_power_law`.

    Returns:
        A dataset over the other axes with the variables ``plateau``, ``rate``, ``end_fall`` (relative, per unit of the
        axis, at the last point) and ``limit`` (beyond it the variable falls by less than ``fall`` per unit; -inf:
        everywhere, inf: nowhere), with ``_error``, and ``chi2``, ``dof``, ``p_value``, ``points``.  Errors are
        multiplied by sqrt(chi2/dof) if that is above one.

    Raises:
        SweepError: for an unknown variable or axis, points that are not done, numbers that are not above 0, and a fit
            that does not converge.

    Example:
        >>> import linksweep
        >>> study = linksweep.load_study("quasars", ["n_sim=100", "n_cat=1"], ["v_max=14:18:0.5"])
        >>> ds = linksweep.run(study, "quasars.zarr", pool="serial")
        >>> fit = fit_levelling(ds, "sigma_spin", over="v_max").sel(model="amex")
        >>> round(float(fit["plateau"]), 2), round(float(fit["limit"]), 1)
        (0.59, 15.0)
    """
    if not 0.0 < fall < 1.0:
        raise SweepError(f"fall = {fall:g}: must be above 0 and below 1, a fraction")
    made = lines(dataset, variable, over, covariance, least=LEVELLING_POINTS)
    _require_positive(made)
    per_step = f"1 / ({made.over_unit})" if made.over_unit else ""
    columns = {
        "plateau": (made.common_unit, f"{variable} that the law tends to; NaN if it does not level off"),
        "limit": (made.over_unit, f"{over} beyond which {variable} falls by less than {100 * fall:g} % a unit"),
        "end_fall": (per_step, f"relative fall at the last {over}"),
        "rate": (per_step, "rate at which the square of the variable levels off"),
    }
    result = _fitted(made, columns, lambda x, y, errors, samples: levelling(x, y, errors, fall, samples))
    return result.assign_attrs(law="levelling", fall=fall, last=float(made.x[-1]))


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
    require_quantity(dataset, variable)
    above_at, below_at = (_one_place(dataset, axis, value) for value in (of, to))
    parts = [dataset.isel(place) for place in (above_at, below_at)]
    for part in parts:
        require_done(part)
    dimension = str(dataset[axis].dims[0])
    along = [name for name, coordinate in dataset.coords.items() if dimension in coordinate.dims]
    above, below = (part[variable].astype(float).drop_vars(along, errors="ignore") for part in parts)
    bottom = below.where(below != 0.0)
    meaning = f"{variable} at {axis} = {of} over that at {axis} = {to}"
    result = (above / bottom).rename("ratio").drop_attrs(deep=False).assign_attrs(described("", meaning)).to_dataset()
    error = error_of_sum(dataset, variable, above_at, below_at, (1.0 / bottom, -above / bottom**2))
    if error is not None:
        result["ratio_error"] = error.drop_attrs(deep=False).assign_attrs(described("", "one-sigma error of ratio"))
    return result


def _one_place(dataset: xr.Dataset, axis: str, value: Any) -> dict[str, int]:
    """Return the index along the dimension of an axis at which it has a value; raises SweepError where several have."""
    ((dimension, hits),) = indices(dataset, {axis: value}).items()
    if len(hits) > 1:
        raise SweepError(f"{axis} = {value} is at {len(hits):,} points along {dimension}, and a ratio is of two")
    return {dimension: hits[0]}


def _fitted(
    made: Lines,
    columns: Mapping[str, tuple[str, str]],
    fit: Callable[[Array, Array, Array, float], PowerLaw | Levelling],
) -> xr.Dataset:
    """Return the results of a fit to every line: the ``columns``, given with unit and meaning, their errors if they
    have any, and the quality of the fit; NaN for lines that the study excludes.  Raises SweepError listing failed fits.
    """
    fits: list[PowerLaw | Levelling | None] = []
    problems = []
    for line, used in enumerate(made.used):
        try:
            points = made.x[used], made.value[line, used], made.errors_of(line), made.samples
            fits.append(fit(*points) if used.any() else None)
        except ValueError as error:
            problems.append(f"{error}: {made.variable} over {made.over}{_at(made, line)}")
    if problems:
        raise SweepError(problems[:FEW])

    def values(name: str) -> list[float]:
        return [np.nan if one is None else float(getattr(one, name)) for one in fits]

    variables: dict[str, tuple[Any, str, str]] = {}
    for name, (unit, meaning) in columns.items():
        variables[name] = values(name), unit, meaning
        if any(hasattr(one, f"{name}_error") for one in fits):
            variables[f"{name}_error"] = values(f"{name}_error"), unit, "its one-sigma error"
    p_values = [np.nan if one is None else p_value(one.chi2, one.dof, made.samples) for one in fits]
    variables["chi2"] = values("chi2"), "", "sum of squared residuals in units of their errors"
    variables["dof"] = values("dof"), "", "degrees of freedom of chi2"
    variables["p_value"] = p_values, "", "probability of a chi2 at least as large, if the law holds"
    variables["points"] = made.used.sum(axis=1).astype(float), "", "points of the fit"
    return made.with_variables(variables)


def _expected(dataset: xr.Dataset, made: Lines, line: int) -> float:
    """Return the exponent that a claim of the study states for a line, NaN if none does."""
    place = made.place(line)
    for claim in claims_of(dataset):
        law = claim.slope
        if law is None or (law.variable, law.over) != (made.variable, made.over):
            continue
        if law.component in (None, *place.values()) and all(place.get(k) == v for k, v in claim.where.items()):
            return float(claim.published)
    return np.nan


def _require_positive(made: Lines, axis_too: bool = False) -> None:
    problems = []
    if axis_too and not np.all(made.x > 0.0):
        problems.append(f"a power law needs {made.over} above 0; there is {made.x.min():g}")
    for line, bad in enumerate(made.used & ~(made.value > 0.0)):
        if bad.any():
            at, value = made.x[bad][0], made.value[line, bad][0]
            problems.append(f"{made.variable} must be above 0; it is {value:g}{_at(made, line, {made.over: at})}")
    if problems:
        raise SweepError(problems[:FEW])


# Tables of laws


def tables(result: xr.Dataset) -> list[Table]:
    """Return the table of fits for reading: places on the axes, the law, how well it holds, and a conclusion."""
    return [table_of_lines(result, _columns(result), _conclusions(result))]


def records(result: xr.Dataset) -> Table:
    """Return all numbers of fits with their conclusions, for programs."""
    return records_of_lines(result, _conclusions(result))


def notes(result: xr.Dataset) -> list[str]:
    """Return the sentences below the table: the law, the origin of errors, and how many lines do not follow the law."""
    variable, over = result.attrs["variable"], result.attrs["over"]
    law = {
        "power": f"{variable} = amplitude x ({over} / pivot)^exponent",
        "levelling": f"{variable}^2 = plateau^2 + c exp(-rate x {over}); errors are scaled where chi2 > dof",
    }[result.attrs["law"]]
    bad = int((result["p_value"] < P_VALUE_ALLOWED).sum())
    more = (
        [f"{bad} of {result['p_value'].size} lines: the law does not hold within the errors, p < 0.001"] if bad else []
    )
    return [f"{law}; errors: {result.attrs['errors']}", *more]


def table_of_lines(result: xr.Dataset, numbers: Sequence[Column], conclusions: Sequence[str]) -> Table:
    """Return a table with one row per line of a grid: its place, numbers, and what is concluded in words."""
    dims = _dims(result)
    names = axis_coordinates(result, dims)
    places = [Column(name, listed(result, name, dims), unit=units_of(result[name].attrs)) for name in names]
    words = [Column("conclusion", conclusions, conclusions, wrap=CONCLUSION)] if any(conclusions) else []
    return Table([*places, *numbers, *words], str(result.attrs["title"]))


def records_of_lines(result: xr.Dataset, conclusions: Sequence[str]) -> Table:
    """Return all variables of a result and its conclusions with one row per line of a grid, and its attributes."""
    dims = _dims(result)
    columns = [Column(str(n), listed(result, str(n), dims)) for n in (*result.coords, *result.data_vars)]
    units = {str(n): v.attrs["units"] for n, v in result.variables.items() if v.attrs.get("units")}
    return Table([*columns, Column("conclusion", conclusions)], about={**result.attrs, "units": units})


def _dims(result: xr.Dataset) -> list[str]:
    return [str(d) for d in next(iter(result.data_vars.values())).dims]


def _columns(result: xr.Dataset) -> list[Column]:
    """Return the columns of numbers; those of a larger rank are left out first where there is no room."""
    rows = {str(name): result[name].values.reshape(-1).tolist() for name in result.data_vars}

    def column(name: str, cells: list[str], rank: int, unit: str = "") -> Column:
        return Column(name, cells, cells, unit, name, rank)

    def number(name: str, rank: int) -> Column:
        unit, factor = prefixed(rows[name], units_of(result[name].attrs))
        pairs = zip(rows[name], rows[f"{name}_error"], strict=True)
        return column(name, [with_error(factor * value, factor * error) for value, error in pairs], rank, unit)

    def formatted(name: str, source: str, digits: str, rank: int, unit: str = "", after: str = "") -> Column:
        return column(name, [fixed(value, digits, after) for value in rows[source]], rank, unit)

    power = result.attrs["law"] == "power"
    columns = [formatted("points", "points", ".0f", 2), number("exponent" if power else "plateau", 0)]
    if "expected" in rows:
        columns += [
            formatted("expected", "expected", "g", 1),
            formatted("deviation", "deviation", "+.1f", 1, after=" errors"),
        ]
    if power:
        pivot = formatted("pivot", "pivot", ".4g", 4, units_of(result["pivot"].attrs))
        columns += [number("amplitude", 4), pivot]
    else:
        pairs = zip(rows["end_fall"], rows["end_fall_error"], strict=True)
        falls = [with_error(100.0 * fall, 100.0 * error) for fall, error in pairs]
        columns.append(column("fall at the end", falls, 2, f"% / {units_of(result['limit'].attrs) or 'unit'}"))
    pairs = zip(rows["chi2"], rows["dof"], strict=True)
    columns.append(column("chi2 / dof", [f"{fixed(c, '.3g') or '-'} / {fixed(d, '.0f')}" for c, d in pairs], 3))
    return [*columns, formatted("p", "p_value", ".2g", 3)]


def _conclusions(result: xr.Dataset) -> list[str]:
    rows = {name: result[name].values.reshape(-1).tolist() for name in map(str, result.data_vars)}
    about, unit = result.attrs, units_of(result["limit"].attrs) if "limit" in result else ""
    found = []
    for i, points in enumerate(rows["points"]):
        if points == 0.0:
            found.append("excluded by the study")
        elif about["law"] == "levelling":
            limit, rate = ((rows[name][i], rows[f"{name}_error"][i]) for name in ("limit", "rate"))
            found.append(_levelling_in_words(*limit, rate[0] > RATE_WANTED * rate[1], about["last"], unit))
        elif "deviation" not in rows or not math.isfinite(rows["deviation"][i]):
            found.append("")
        else:
            found.append("as expected" if abs(rows["deviation"][i]) <= DEVIATION_ALLOWED else "NOT as expected")
    return found


def _levelling_in_words(limit: float, error: float, significant: bool, last: float, unit: str) -> str:
    if limit == -math.inf:
        return "falls by less everywhere"
    if not math.isfinite(limit):
        return "no plateau: falls by more everywhere"
    place = f"{with_error(limit, error)} {unit}".rstrip()
    words = f"falls by less from {place}" if limit <= last else f"no plateau yet: not before {place}, by the law"
    return words if significant else f"{words}; the levelling off is not significant"
