"""What of a dataset is a quantity: its names, its errors, the axes that it can be followed along."""

from collections.abc import Container, Hashable

import xarray as xr

from sweep.contract import SweepError, shown, suggest

ERROR_SUFFIXES = ("mc_error", "catalogue_error")
"""Outputs NAME_SUFFIX beside NAME are its one-sigma errors from Monte Carlo; those that exist add in quadrature."""

PREDICTION_SUFFIXES = ("rms_predicted", "predicted")
"""Outputs NAME_SUFFIX beside NAME predict it; the first there is predicts all of it, the others may be a part."""

COVARIANCE_SUFFIX = "mc_covariance"
"""A variable NAME_mc_covariance_OVER with the dimensions of NAME and OVER_other is the covariance of NAME between
points along the axis OVER, where these share random numbers.  It has all of their error: it stands for both error
variables.
"""

SHARES_RANDOM_NUMBERS = "common_random_numbers"
"""An attribute that is true where points of the grid share random numbers."""


def standard_error(dataset: xr.Dataset, variable: str) -> xr.DataArray | None:
    """Return the one-sigma error of a variable from all its error variables in quadrature; None if it has none.

    A NaN in one of several is an error that is not known, such as that of one catalogue, and does not count.
    """
    parts = [dataset[f"{variable}_{s}"] for s in ERROR_SUFFIXES if f"{variable}_{s}" in dataset]
    if not parts:
        return None
    squares: xr.DataArray = sum((part.fillna(0.0) ** 2 for part in parts[1:]), parts[0].fillna(0.0) ** 2)
    return squares**0.5


def prediction_name(names: Container[Hashable], variable: str) -> str:
    """Return which variable of some predicts another: with known biases, if the experiment predicts them too."""
    whole, part = (f"{variable}_{suffix}" for suffix in PREDICTION_SUFFIXES)
    return whole if whole in names else part


def covariance_between(
    dataset: xr.Dataset, variable: str, dimension: str, one: int, other: int
) -> xr.DataArray | float:
    """Return the covariance of a variable between two indices along a dimension, 0 where the dataset has none."""
    name, partner = f"{variable}_{COVARIANCE_SUFFIX}_{dimension}", f"{dimension}_other"
    if name not in dataset or partner not in dataset[name].dims:
        return 0.0
    return dataset[name].isel({dimension: one, partner: other}, drop=True)


def quantities(dataset: xr.Dataset) -> list[str]:
    """Return the variables that are results of their own: numbers, with one value a point, no errors or predictions."""
    axes = set(dataset["status"].dims)
    numbers = [str(n) for n, v in dataset.data_vars.items() if v.dtype.kind == "f" and axes <= set(v.dims)]
    covariances = {f"{COVARIANCE_SUFFIX}_{axis}" for axis in dataset.coords}
    attached = (*ERROR_SUFFIXES, *covariances, *PREDICTION_SUFFIXES, "published", "published_rounding")
    beside = {f"{name}_{suffix}" for name in numbers for suffix in attached}
    return [name for name in numbers if name not in beside and "sample" not in dataset[name].dims]


def main_quantity(dataset: xr.Dataset) -> str:
    """Return the variable to use where none is named: the first headline with an error, headline, or quantity."""
    names = quantities(dataset)
    if not names:
        raise SweepError("holds no results that are numbers")
    headline = [name for name in names if dataset[name].attrs.get("headline")]
    with_error = [name for name in headline if standard_error(dataset, name) is not None]
    return (with_error or headline or names)[0]


def require_quantity(dataset: xr.Dataset, variable: str) -> None:
    """Raise SweepError unless a variable is one of the dataset's quantities."""
    names = quantities(dataset)
    if variable not in names:
        raise SweepError(f"no quantity {shown(variable)}{suggest(variable, names)}")


def numeric_axes(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return the coordinates of numbers along which a variable has at least two points, longest first."""
    dims = dataset[variable].dims
    names = [str(n) for n, c in dataset.coords.items() if c.ndim == 1 and c.dims[0] in dims and c.dtype.kind in "if"]
    axes = [n for n in names if dataset[n].size > 1 and dataset[n].dims[0] in dataset["status"].dims]
    return sorted(axes, key=lambda n: (-dataset[n].size, n not in dims, n))


def require_axis(dataset: xr.Dataset, variable: str, over: str | None) -> str:
    """Return ``over`` if it is an axis of numbers of the variable, or the only one; raises SweepError otherwise, and
    for an unknown quantity.
    """
    require_quantity(dataset, variable)
    axes = numeric_axes(dataset, variable)
    if over is None:
        dimensions = {dataset[axis].dims[0] for axis in axes}
        if len(dimensions) == 1:
            return next(axis for axis in axes if axis in dimensions or len(axes) == 1)
        raise SweepError(f"name the axis; {variable} has {', '.join(axes) or 'none with several numbers'}")
    if over not in axes:
        raise SweepError(
            f"{shown(over)} is no axis with several numbers of {variable}; there are {', '.join(axes) or 'none'}"
        )
    return over
