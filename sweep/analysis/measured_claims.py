"""What a dataset of results says about the claims of its study: values, ratios and slopes, with their errors."""

import json
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from linksweep.sweep.analysis.fits import power_law
from linksweep.sweep.analysis.quantity import covariance_along, error_of_sum, samples_along, standard_error
from linksweep.sweep.analysis.selection import coordinates_along, place_in_words, places_along
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import units_of
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.studies.study import Claim, Derived, Ratio, Reading, Slope

Index = Mapping[str, int]

NOT_DONE = "not done yet"
"""Why a number is missing before its points are done."""


class OutsideGridError(Exception):
    """A claim is about a place or a result that this store does not have."""


@dataclass(frozen=True)
class Measured:
    """Our number at one place, or why there is none: ``missing`` if it was not computed, ``broken`` if it cannot be."""

    where: Mapping[str, Any]
    value: float = math.nan
    error: float = 0.0
    missing: str = ""
    broken: str = ""


def claims_of(dataset: xr.Dataset) -> list[Claim]:
    """Return the claims that a dataset carries in its attributes; raises SweepError if they cannot be read."""
    try:
        return [Claim.model_validate(claim) for claim in json.loads(dataset.attrs.get("claims", "[]"))]
    except (ValueError, TypeError) as error:
        raise SweepError(f"the attribute 'claims' cannot be read: {error}") from error


def in_words(quantity: Slope | Ratio | Reading) -> str:
    """Return how the quantity of a claim is derived."""
    name = quantity.variable + (f"[{quantity.component}]" if quantity.component else "")
    if isinstance(quantity, Slope):
        return f"slope of {name} over {quantity.over}"
    if isinstance(quantity, Ratio):
        return f"{name}({place_in_words(quantity.of)}) / {name}({place_in_words(quantity.to)})"
    return name


def unit_of(dataset: xr.Dataset, quantity: Slope | Ratio | Reading) -> str:
    """Return the unit of a result, or of its component where these differ; '' for a result that is not there, and
    for ratios and slopes.
    """
    if not isinstance(quantity, Reading) or quantity.variable not in dataset:
        return ""
    variable = dataset[quantity.variable]
    units = f"{variable.dims[-1]}_unit" if quantity.component is not None else ""
    if units in dataset.coords:
        return str(dataset[units].isel(_component(dataset, quantity.variable, quantity.component)).item())
    return units_of(variable.attrs)


def measure(dataset: xr.Dataset, claim: Derived, quantity: Slope | Ratio | Reading) -> Iterator[Measured]:
    """Yield our number at every place that a claim is about; raises OutsideGridError for one that is not there."""
    points = Points.of(dataset, quantity.variable, quantity.component)
    if isinstance(quantity, Slope):
        if quantity.over not in dataset.coords:
            raise OutsideGridError(f"{quantity.over} is not an axis of this store")
        dimension = str(dataset[quantity.over].dims[0])
        for line in points.combinations(points.index(claim.where), but=dimension):
            yield points.slope(line, quantity.over)
    elif isinstance(quantity, Ratio):
        top, bottom = (points.index({**claim.where, **place}) for place in (quantity.of, quantity.to))
        for one, other in zip(points.combinations(top), points.combinations(bottom), strict=True):
            yield points.ratio(one, other, {str(dataset[axis].dims[0]) for axis in quantity.of})
    else:
        for point in points.combinations(points.index({**claim.where, **quantity.at})):
            yield points.at(point)


@dataclass(frozen=True)
class Points:
    """One result, or component of one, at the points of a grid: value, one-sigma error (0 where there is none) and
    status, with the dimensions of the grid.
    """

    dataset: xr.Dataset
    variable: str
    value: xr.DataArray
    error: xr.DataArray
    status: xr.DataArray

    @classmethod
    def of(cls, dataset: xr.Dataset, variable: str, component: str | None = None) -> "Points":
        """Return a result of a dataset; raises OutsideGridError where it is not there."""
        if variable not in dataset:
            raise OutsideGridError(f"{variable} is not a result of this store")
        part = dataset.isel(_component(dataset, variable, component))
        known = standard_error(part, variable)
        status = part["status"]
        error = xr.zeros_like(status, dtype=float) if known is None else known
        return cls(part, variable, part[variable].broadcast_like(status), error.broadcast_like(status), status)

    def index(self, places: Mapping[str, Any]) -> dict[str, int]:
        """Return the index along each dimension that values of axes fix."""
        found: dict[str, NDArray[np.bool_]] = {}
        for axis, value in places.items():
            if axis not in self.dataset.coords or not self.dataset[axis].dims:
                raise OutsideGridError(f"{axis} is not an axis of this store")
            dimension = str(self.dataset[axis].dims[0])
            found[dimension] = found.get(dimension, True) & np.asarray(self.dataset[axis].values == value)
            if not found[dimension].any():
                raise OutsideGridError(f"{axis} = {value} is not in the grid of this store")
        return {dimension: int(np.argmax(mask)) for dimension, mask in found.items()}

    def combinations(self, fixed: Index, but: str = "") -> Iterator[dict[str, int]]:
        """Yield an index for each combination of the dimensions that are not fixed, except ``but``."""
        free = [str(d) for d in self.status.dims if d not in fixed and d != but]
        for place in places_along(self.status, free):
            yield dict(fixed) | place

    def places(self, index: Index, but: Collection[str] = ()) -> dict[str, Any]:
        """Return the axes at an index, in the order of the grid (Zarr sorts them by name)."""
        axes: dict[str, Any] = {}
        for dimension in map(str, self.status.dims):
            if dimension in index and dimension not in but:
                along = coordinates_along(self.dataset, dimension)
                axes |= {name: self.dataset[name][index[dimension]].item() for name in along}
        return axes

    def at(self, index: Index) -> Measured:
        """Return our number at a point, or why there is none."""
        where, status = self.places(index), int(self.status[dict(index)])
        if status != Status.DONE:
            return Measured(where, missing=_why({status}, "the point"))
        return Measured(where, float(self.value[dict(index)]), float(self.error[dict(index)]))

    def ratio(self, of: Index, to: Index, differing: set[str]) -> Measured:
        """Return the value at one point over that at another; its error includes their covariance."""
        where = self.places(of, but=differing)
        top, bottom = self.at(of), self.at(to)
        if missing := top.missing or bottom.missing:
            return Measured(where, missing=missing)
        if bottom.value == 0.0 or not math.isfinite(top.value / bottom.value):
            return Measured(where, broken="the ratio is not a finite number")
        ratio = top.value / bottom.value
        weights = (1.0 / bottom.value, -ratio / bottom.value)
        error = error_of_sum(self.dataset, self.variable, of, to, weights)
        return Measured(where, ratio, 0.0 if error is None else float(error))

    def slope(self, line: Index, over: str) -> Measured:
        """Return the slope along a line of points; those that the study excludes do not belong to it."""
        where, dimension = self.places(line), str(self.dataset[over].dims[0])
        status = self.status[dict(line)].values
        used = status != Status.EXCLUDED
        undone = used & (status != Status.DONE)
        if undone.any():
            some = f"{np.count_nonzero(undone):,} of {np.count_nonzero(used):,} points"
            return Measured(where, missing=_why(set(status[undone].tolist()), some))
        x, y = (np.asarray(v, dtype=float)[used] for v in (self.dataset[over].values, self.value[dict(line)].values))
        if len(x) < 2:
            return Measured(where, missing=f"a slope needs two values of {over}; this grid has {len(x)}")
        if not (np.all(x > 0.0) and np.all(np.isfinite(y)) and np.all(y > 0.0)):
            return Measured(where, broken="there are values that are not above 0, which have no power law")
        errors = self.error[dict(line)].values[used]
        if (covariance := covariance_along(self.dataset, self.variable, dimension)) is not None:
            errors = covariance.isel(dict(line)).transpose(dimension, f"{dimension}_other").values[np.ix_(used, used)]
        try:
            law = power_law(x, y, errors, samples_along(self.dataset, dimension, covariance))
        except ValueError as error:
            return Measured(where, missing=str(error))
        return Measured(where, law.exponent, law.exponent_error)


def _component(dataset: xr.Dataset, variable: str, component: str | None) -> dict[str, int]:
    if component is None:
        return {}
    dimension = str(dataset[variable].dims[-1])
    return {dimension: dataset[dimension].values.tolist().index(component)}


def _why(codes: set[int], subject: str) -> str:
    if Status.FAILED in codes:
        return f"failed: {subject}"
    return f"excluded by the study: {subject}" if Status.EXCLUDED in codes else f"{NOT_DONE}: {subject}"
