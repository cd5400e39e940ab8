"""Which variables of a dataset are quantities, what their errors are, and along which axes they vary."""

import json
from collections.abc import Collection, Container, Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from linksweep.sweep.contract import FEWEST_SAMPLES, SweepError, shown, small_sample_factor, suggest
from linksweep.sweep.formatting import ERRORS
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.studies.record import FUNCTION, outer_draw_of
from linksweep.sweep.studies.study import POINT, POINT_TABLE

COUNTS = ("status", "n_sim_done", "code")
"""Integer variables of every dataset that are not results."""

ERROR_SUFFIXES = ("mc_error", "catalogue_error")
"""Outputs NAME_SUFFIX beside NAME are its one-sigma errors from Monte Carlo; those that exist add in quadrature."""

PREDICTION_SUFFIXES = ("rms_predicted", "predicted")
"""Outputs NAME_SUFFIX beside NAME predict it; the first that exists predicts all of it, the other may be a part."""

BESIDE = (*ERROR_SUFFIXES, *PREDICTION_SUFFIXES, "published", "published_rounding")
"""Variables NAME_SUFFIX that belong to NAME and are in its unit."""

COVARIANCE_SUFFIX = "mc_covariance"
"""A variable NAME_mc_covariance_OVER with the dimensions of NAME and OVER_other is the covariance of NAME between
points along the axis OVER, where these share random numbers.  It includes all of their error, and replaces both
error variables.  Its attribute ``samples`` is the number of independent samples that it was estimated from; without
that attribute it is exact.
"""

SHARES_RANDOM_NUMBERS = "common_random_numbers"
"""An attribute that is true if points of the grid share random numbers, along the axes that `shared_axes` gives."""

SHARED_AXES = "shared_axes"
ERROR_CONVENTION = "error_convention"
CONVENTION = 2
"""The attribute that says how errors were computed, and its value since catalogues count as independent samples."""

OLD_ERRORS = "errors are those of an earlier version; `sweep run` the study again (nothing is computed anew)"


def standard_error(dataset: xr.Dataset, variable: str) -> xr.DataArray | None:
    """Return the one-sigma error of a variable from all its error variables in quadrature; None if it has none.

    A NaN in one of several is an error that is not known, such as that of few catalogues, and is left out; if none is
    known, the result is NaN.
    """
    parts = [dataset[f"{variable}_{s}"] for s in ERROR_SUFFIXES if f"{variable}_{s}" in dataset]
    if not parts:
        return None
    squares: xr.DataArray = sum((part.fillna(0.0) ** 2 for part in parts[1:]), parts[0].fillna(0.0) ** 2)
    known: xr.DataArray = sum((part.notnull() for part in parts[1:]), parts[0].notnull())
    return (squares**0.5).where(known)


def errors_beside(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return the variables that are declared as errors of a variable, each of another kind."""
    return [name for name in str(dataset[variable].attrs.get(ERRORS, "")).split() if name in dataset]


def where_they_change(dataset: xr.Dataset, names: Sequence[str]) -> xr.Dataset:
    """Return a dataset without the axes of the study along which none of some variables changes."""
    arrays = [dataset[name].drop_vars(list(dataset.coords), errors="ignore") for name in names]
    axes = dataset["status"].dims
    alike = [d for d in axes if all(array.isel({d: [0] * array.sizes[d]}).equals(array) for array in arrays)]
    return dataset.isel(dict.fromkeys(alike, 0), drop=True)


def error_bar(dataset: xr.Dataset, variable: str) -> xr.DataArray | None:
    """Return the errors with which figures show a variable: its `standard_error`, else the first that is declared."""
    known, declared = standard_error(dataset, variable), errors_beside(dataset, variable)
    return dataset[declared[0]] if known is None and declared else known


def with_values(dataset: xr.Dataset, names: Sequence[str]) -> list[str]:
    """Return those of some quantities that have a value at any point, or all if none has one: a link that does not
    solve for the spin, for example, has no error of it.
    """
    if len(names) < 2:
        return list(names)  # whatever its values, which need not be read
    return [name for name in names if bool(dataset[name].notnull().any())] or list(names)


def headline_variables(dataset: xr.Dataset) -> list[str]:
    """Return the headline outputs of an experiment, those with errors first."""
    names = [str(name) for name, variable in dataset.data_vars.items() if variable.attrs.get("headline")]
    return sorted(names, key=lambda name: standard_error(dataset, name) is None)


def headlines(dataset: xr.Dataset) -> list[str]:
    """Return the quantities that a study is about: the headline outputs that have values, or the first quantity if
    there are none.
    """
    known = quantities(dataset)
    return with_values(dataset, [name for name in headline_variables(dataset) if name in known]) or known[:1]


def unknown_parts(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return a sentence for every part of the error of a variable that is not known at points that are done."""
    done = dataset["status"] == Status.DONE
    draw = outer_draw_of(dataset.attrs)
    words = {"mc_error": "its Monte-Carlo error", "catalogue_error": f"the choice of {draw}s"}
    needed = "more realisations" if FUNCTION in dataset.attrs else f"{FEWEST_SAMPLES} {draw}s"
    return [
        f"{variable}: {words[suffix]} is not in the error, as {needed} are needed to know it"
        for suffix in ERROR_SUFFIXES
        if f"{variable}_{suffix}" in dataset and bool((dataset[f"{variable}_{suffix}"].isnull() & done).any())
    ]


def has_old_errors(dataset: xr.Dataset) -> bool:
    """Return whether a dataset of `sweep run` has errors that are now computed differently (docs/errors.md)."""
    about = dataset.attrs
    several = int(about.get("n_cat", 1)) > 1 or bool(about.get(SHARES_RANDOM_NUMBERS))
    return several and about.get(ERROR_CONVENTION) != CONVENTION


def shares_random_numbers(dataset: xr.Dataset, dimensions: Collection[str]) -> bool:
    """Return whether points that differ along these dimensions, and no others, have random numbers in common."""
    if not dataset.attrs.get(SHARES_RANDOM_NUMBERS):
        return False
    if SHARED_AXES not in dataset.attrs:
        return True
    shared = set(json.loads(dataset.attrs[SHARED_AXES]))
    axes = {str(n) for n, c in dataset.coords.items() if set(c.dims) & set(dimensions) and not str(n).endswith("_unit")}
    return axes - {POINT} <= shared


def covariance_along(dataset: xr.Dataset, variable: str, dimension: str) -> xr.DataArray | None:
    """Return the covariance of a variable between points along a dimension; None if there is none, or only
    one of an earlier version, which took blocks of one catalogue to be independent.
    """
    name = f"{variable}_{COVARIANCE_SUFFIX}_{dimension}"
    if name not in dataset or f"{dimension}_other" not in dataset[name].dims:
        return None
    old = dataset.attrs.get(SHARES_RANDOM_NUMBERS) and "samples" not in dataset[name].attrs
    return None if old else dataset[name]


def samples_along(dataset: xr.Dataset, dimension: str, covariance: xr.DataArray | None) -> float:
    """Return the number of independent samples that the covariance of points along a dimension was estimated from:
    infinity if it is exact or points are independent, NaN if they share random numbers and it is not known.
    """
    if covariance is not None:
        return float(covariance.attrs.get("samples", np.inf))
    return np.nan if shares_random_numbers(dataset, [dimension]) else np.inf


def error_of_sum(
    dataset: xr.Dataset, variable: str, one: Mapping[str, int], other: Mapping[str, int], weights: tuple[Any, Any]
) -> xr.DataArray | None:
    """Return the one-sigma error of a weighted sum of a variable at two indices along dimensions.

    If the two share random numbers, it includes their covariance, and is NaN if the dataset does not have it; otherwise
    they are independent.  ``weights`` are numbers or arrays over the other dimensions.  None if there are no errors.
    """
    known = [standard_error(dataset.isel(place), variable) for place in (one, other)]
    along = [name for name, coordinate in dataset.coords.items() if set(coordinate.dims) & {*one, *other}]
    errors = [error.drop_vars(along, errors="ignore") for error in known if error is not None]
    if not errors:
        return None
    first, second = weights
    differing = [d for d in one if one[d] != other[d]]
    if not differing:
        return xr.DataArray(abs(first + second) * errors[0])
    if len(differing) == 1 and (found := covariance_along(dataset, variable, differing[0])) is not None:
        (dimension,) = differing
        pair = found.isel({d: one[d] for d in one if d != dimension}, drop=True)
        i, j = one[dimension], other[dimension]
        part = {(a, b): pair.isel({dimension: a, f"{dimension}_other": b}, drop=True) for a in (i, j) for b in (i, j)}
        variance = first**2 * part[i, i] + second**2 * part[j, j] + 2.0 * first * second * part[i, j]
        factor = float(small_sample_factor(samples_along(dataset, dimension, found)))
        variance = xr.DataArray(variance * factor).clip(min=0.0)
    else:
        variance = xr.DataArray((first * errors[0]) ** 2 + (second * errors[1]) ** 2)
        if shares_random_numbers(dataset, differing):
            variance = xr.full_like(variance, np.nan)
    return xr.DataArray(variance**0.5)


def prediction_name(names: Container[Hashable], variable: str) -> str:
    """Return the name of a variable's prediction: the one that includes biases, if ``names`` has it."""
    whole, part = (f"{variable}_{suffix}" for suffix in PREDICTION_SUFFIXES)
    return whole if whole in names else part


def quantities(dataset: xr.Dataset) -> list[str]:
    """Return the variables that are results of their own: numbers at each point, not errors, predictions or samples."""
    axes = set(dataset["status"].dims)
    numbers = [str(n) for n, v in dataset.data_vars.items() if _is_number(dataset, str(n)) and axes <= set(v.dims)]
    covariances = {f"{COVARIANCE_SUFFIX}_{axis}" for axis in dataset.coords}
    beside = {f"{name}_{suffix}" for name in numbers for suffix in (*BESIDE, *covariances)}
    return [name for name in numbers if name not in beside and "sample" not in dataset[name].dims]


def _is_number(dataset: xr.Dataset, name: str) -> bool:
    """Return whether a variable holds numbers; for a plain function these may be integers and truth values."""
    kind = dataset[name].dtype.kind
    return kind == "f" or (kind in "ib" and FUNCTION in dataset.attrs and name not in COUNTS)


def main_quantity(dataset: xr.Dataset) -> str:
    """Return the variable to use if none is named: the first headline output (with errors, if any), or quantity."""
    if names := headlines(dataset):
        return names[0]
    raise SweepError("holds no results that are numbers")


def require_quantity(dataset: xr.Dataset, variable: str) -> None:
    """Raise SweepError unless a variable is one of the dataset's quantities."""
    names = quantities(dataset)
    if variable not in names:
        if variable in dataset.data_vars and (kind := dataset[variable].dtype.kind) not in "biufc":
            raise SweepError(f"{variable} has no numbers, but {'times' if kind in 'Mm' else 'texts'}")
        raise SweepError(f"no quantity {shown(variable)}{suggest(variable, names) if names else '; there are none'}")


def numeric_axes(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return the numeric coordinates along which a variable has at least two points, longest first: axes of the study,
    and dimensions of its own.  Points of a table or a design have no order, so that they have no such axis.
    """
    dims = [d for d in dataset[variable].dims if d != POINT]
    names = [str(n) for n, c in dataset.coords.items() if c.ndim == 1 and c.dims[0] in dims and c.dtype.kind in "if"]
    axes = [n for n in names if dataset[n].size > 1]
    return sorted(axes, key=lambda n: (-dataset[n].size, n not in dims, n))


def varied_parameters(dataset: xr.Dataset) -> list[str]:
    """Return the parameters in which the points of a table or a design differ, in the order of its columns."""
    if POINT_TABLE not in dataset.attrs:
        return []
    names = [n for n in json.loads(dataset.attrs[POINT_TABLE])["parameters"] if n in dataset.coords]
    return [n for n in names if dataset[n].dims == (POINT,) and len(set(dataset[n].values.tolist())) > 1]


def require_axis(dataset: xr.Dataset, variable: str, over: str | None) -> str:
    """Return ``over`` if it is an axis of numbers of the variable, or the only one; raises SweepError otherwise, and
    for an unknown quantity.
    """
    require_quantity(dataset, variable)
    axes = numeric_axes(dataset, variable)
    varied = varied_parameters(dataset) if POINT in dataset[variable].dims else []
    if len(varied) == 1 and dataset[varied[0]].dtype.kind in "if":
        axes += varied
    elif over in varied:
        others = ", ".join(name for name in varied if name != over)
        raise SweepError(f"the points differ in {others} too, so that {over} is no axis of {variable}")
    if over is None:
        dimensions = {dataset[axis].dims[0] for axis in axes}
        if len(dimensions) == 1:
            return next(axis for axis in axes if axis in dimensions or len(axes) == 1)
        if not axes:
            raise SweepError(f"{variable} has no axis with several numbers")
        raise SweepError(f"name the axis; {variable} has {', '.join(axes)}")
    if over not in axes:
        raise SweepError(
            f"{shown(over)} is no axis with several numbers of {variable}; there are {', '.join(axes) or 'none'}"
        )
    return over
