"""Laws and ratios of results: functions that take a Dataset of results and return a Dataset.

Every function works along one axis for all combinations of the others at once, and for any experiment: errors are found
by the names that `sweep.analysis.quantity` describes, expected exponents in the claims of the study.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from linksweep.sweep.analysis.fits import PowerLaw, p_value, power_law
from linksweep.sweep.analysis.levelling import Levelling, levelling
from linksweep.sweep.analysis.lines import Lines, lines, require_done
from linksweep.sweep.analysis.measured_claims import claims_of
from linksweep.sweep.analysis.quantity import error_of_sum, require_quantity
from linksweep.sweep.analysis.selection import indices, place_in_words
from linksweep.sweep.contract import FEW, Array, SweepError
from linksweep.sweep.formatting import described

LEVELLING_POINTS = 4
"""The fewest points for the levelling law, which has three parameters."""


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
    found = lines(dataset, variable, over, covariance)
    _require_positive(found, axis_too=True)
    columns = {
        "exponent": ("", f"exponent of {variable} over {over}"),
        "amplitude": (found.common_unit, f"{variable} of the law at the pivot"),
        "correlation": ("", "correlation of the errors of exponent and amplitude"),
        "pivot": (found.over_unit, f"{over} of the amplitude"),
    }
    result = _fitted(found, columns, power_law)
    wanted = [_expected(dataset, found, line) if expected is None else expected for line in range(len(found))]
    if np.isfinite(wanted).any():
        result["expected"] = (found.dims, np.reshape(wanted, found.shape), described("", "exponent expected"))
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
    found = lines(dataset, variable, over, covariance, least=LEVELLING_POINTS)
    _require_positive(found)
    per_step = f"1 / ({found.over_unit})" if found.over_unit else ""
    columns = {
        "plateau": (found.common_unit, f"{variable} that the law tends to; NaN if it does not level off"),
        "limit": (found.over_unit, f"{over} beyond which {variable} falls by less than {100 * fall:g} % a unit"),
        "end_fall": (per_step, f"relative fall at the last {over}"),
        "rate": (per_step, "rate at which the square of the variable levels off"),
    }
    result = _fitted(found, columns, lambda x, y, errors, samples: levelling(x, y, errors, fall, samples))
    return result.assign_attrs(law="levelling", fall=fall, last=float(found.x[-1]))


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
    ((dimension, found),) = indices(dataset, {axis: value}).items()
    if len(found) > 1:
        raise SweepError(f"{axis} = {value} is at {len(found):,} points along {dimension}, and a ratio is of two")
    return {dimension: found[0]}


def _fitted(
    found: Lines,
    columns: Mapping[str, tuple[str, str]],
    fit: Callable[[Array, Array, Array, float], PowerLaw | Levelling],
) -> xr.Dataset:
    """Return the results of a fit to every line: the ``columns``, given with unit and meaning, their errors if they
    have any, and the quality of the fit; NaN for lines that the study excludes.  Raises SweepError listing failed fits.
    """
    fits: list[PowerLaw | Levelling | None] = []
    problems = []
    for line, used in enumerate(found.used):
        try:
            points = found.x[used], found.value[line, used], found.errors_of(line), found.samples
            fits.append(fit(*points) if used.any() else None)
        except ValueError as error:
            problems.append(f"{error}: {found.variable} over {found.over}{_at(found, line)}")
    if problems:
        raise SweepError(problems[:FEW])

    def values(name: str) -> list[float]:
        return [np.nan if one is None else float(getattr(one, name)) for one in fits]

    variables: dict[str, tuple[Any, str, str]] = {}
    for name, (unit, meaning) in columns.items():
        variables[name] = values(name), unit, meaning
        if any(hasattr(one, f"{name}_error") for one in fits):
            variables[f"{name}_error"] = values(f"{name}_error"), unit, "its one-sigma error"
    p_values = [np.nan if one is None else p_value(one.chi2, one.dof, found.samples) for one in fits]
    return found.with_variables(
        variables
        | {
            "chi2": (values("chi2"), "", "sum of squared residuals in units of their errors"),
            "dof": (values("dof"), "", "degrees of freedom of chi2"),
            "p_value": (p_values, "", "probability of a chi2 at least as large, if the law holds"),
            "points": (found.used.sum(axis=1).astype(float), "", "points of the fit"),
        }
    ).assign_attrs(errors=found.errors)


def _expected(dataset: xr.Dataset, found: Lines, line: int) -> float:
    """Return the exponent that a claim of the study states for a line, NaN if none does."""
    place = found.place(line)
    for claim in claims_of(dataset):
        law = claim.slope
        if law is None or (law.variable, law.over) != (found.variable, found.over):
            continue
        if law.component in (None, *place.values()) and all(place.get(k) == v for k, v in claim.where.items()):
            return float(claim.published)
    return np.nan


def _require_positive(found: Lines, axis_too: bool = False) -> None:
    problems = []
    if axis_too and not np.all(found.x > 0.0):
        problems.append(f"a power law needs {found.over} above 0; there is {found.x.min():g}")
    for line, (values, used) in enumerate(zip(found.value, found.used, strict=True)):
        if not np.all(values[used] > 0.0):
            at, value = next((x, v) for x, v in zip(found.x[used], values[used], strict=True) if not v > 0.0)
            problems.append(f"{found.variable} must be above 0; it is {value:g}{_at(found, line, {found.over: at})}")
    if problems:
        raise SweepError(problems[:FEW])


def _at(found: Lines, line: int, more: Mapping[str, Any] | None = None) -> str:
    words = place_in_words(found.place(line) | dict(more or {}))
    return f" at {words}" if words else ""
