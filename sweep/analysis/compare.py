"""Computed against published: every published number of a dataset, and every claim, with its verdict.

A number is reproduced if it differs from the published one by no more than the allowance: half a unit of the last
printed digit plus three times our own Monte-Carlo error.  The error of the published number itself, which comes from a
Monte Carlo too, is not printed anywhere and not allowed for.
"""

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.fits import power_law
from sweep.analysis.quantity import standard_error
from sweep.analysis.selection import place_in_words
from sweep.contract import SweepError
from sweep.planning.accumulator import DONE, EXCLUDED, FAILED
from sweep.studies.study import Claim, Ratio, Reading, Slope, printed_rounding

Verdict = Literal["reproduced", "within tolerance", "NOT reproduced", "incomplete"]
VERDICTS: tuple[Verdict, ...] = ("reproduced", "within tolerance", "NOT reproduced", "incomplete")

MC_ERRORS_ALLOWED = 3.0
ARITHMETIC = 1e-9
"""Relative difference that is no difference: 0.605 - 0.6 in binary is a little more than 0.005."""

VALUE, ERROR = "our value", "our error"
"""Names inside this module that no axis has."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Comparison:
    """One published number beside ours, in ``unit``; ``where`` is its place on the axes.

    ``what`` is the name of the output or the words of the claim, ``quantity`` how it is derived; ``mc_error`` is one
    sigma of ``value`` (0 where there is none), ``difference`` value - published, ``allowance`` what of it rounding and
    Monte-Carlo error explain.  A value that is not there is NaN, and ``reason`` says why; a tolerance that was needed
    has its reason there.
    """

    study: str
    what: str
    quantity: str
    where: Mapping[str, Any]
    unit: str
    value: float
    mc_error: float
    published: float
    rounding: float
    allowance: float
    difference: float
    verdict: Verdict
    source: str
    reason: str = ""


@dataclass(frozen=True)
class _Published:
    """One number that was published; ``counted`` is a number of things, which has neither rounding nor tolerance."""

    number: float
    rounding: float
    source: str
    tolerance: float = 0.0
    reason: str = ""
    counted: bool = False


@dataclass(frozen=True)
class _Measured:
    """Our number at one place, or why there is none: ``missing`` if it was not computed, ``broken`` if it cannot be."""

    where: Mapping[str, Any]
    value: float = math.nan
    error: float = 0.0
    missing: str = ""
    broken: str = ""


class _OutsideGridError(Exception):
    """A claim speaks of a place that this grid does not have."""


def compare(dataset: xr.Dataset) -> list[Comparison]:
    """Return a comparison for every published number and every claim of a dataset of results; empty if it has none."""
    return [*_published_numbers(dataset), *_claims(dataset)]


def remarks(dataset: xr.Dataset) -> list[str]:
    """Return sentences about what a comparison of this dataset does not show or that changes what it means."""
    sentences = []
    if overrides := dataset.attrs.get("study_overrides"):
        sentences.append(f"the study was changed on the command line: {overrides}")
    for name, variable in dataset.data_vars.items():
        if outside := int(variable.attrs.get("outside_grid", 0)):
            numbers = "1 published number is" if outside == 1 else f"{outside} published numbers are"
            sentences.append(f"{str(name).removesuffix('_published')}: {numbers} not in this grid and not compared")
    return sentences


def summary(comparisons: Sequence[Comparison]) -> dict[Verdict, int]:
    """Return how many comparisons have each verdict."""
    counts = Counter(c.verdict for c in comparisons)
    return {verdict: counts[verdict] for verdict in VERDICTS}


def all_is_well(comparisons: Sequence[Comparison]) -> bool:
    """Return whether everything is reproduced or within tolerance."""
    return all(c.verdict in ("reproduced", "within tolerance") for c in comparisons)


def _published_numbers(dataset: xr.Dataset) -> Iterator[Comparison]:
    """Yield the comparisons of NAME with NAME_published, point by point."""
    for name in map(str, dataset.data_vars):
        table = f"{name}_published"
        if table not in dataset:
            continue
        values = _quantity(dataset, name, None)
        for index in np.argwhere(np.isfinite(dataset[table].values)):
            here = dict(zip(map(str, dataset[table].dims), map(int, index), strict=True))
            point = values.isel(here)
            yield _judged(dataset, name, name, _unit(dataset, name, None), _at(point), _printed(dataset, name, here))


def _printed(dataset: xr.Dataset, name: str, here: Mapping[str, int]) -> _Published:
    published = dataset[f"{name}_published"]
    if f"{name}_published_rounding" not in dataset:
        raise SweepError("was written by an earlier version; `sweep run` the study again (nothing is computed anew)")
    number, attributes = float(published[here]), published.attrs
    rounding = float(dataset[f"{name}_published_rounding"][here])
    has_error = standard_error(dataset, name) is not None
    counted = not has_error and rounding == 0.5 and number.is_integer()
    tolerance, reason = float(attributes.get("tolerance", 0.0)), str(attributes.get("tolerance_reason", ""))
    return _Published(number, rounding, str(attributes["source"]), tolerance, reason, counted)


def _claims(dataset: xr.Dataset) -> Iterator[Comparison]:
    for claim in claims_of(dataset):
        quantity = claim.quantity()
        words = _in_words(quantity)
        rounding = 0.0 if claim.exact else printed_rounding(claim.published)
        tolerance, reason = claim.tolerance or 0.0, claim.tolerance_reason or ""
        published = _Published(float(claim.published), rounding, claim.source, tolerance, reason)
        unit = _unit(dataset, quantity.variable, quantity.component) if isinstance(quantity, Reading) else ""
        try:
            measured = list(_measure(dataset, claim, quantity))
        except _OutsideGridError as error:
            measured = [_Measured(claim.where, missing=str(error))]
        for one in measured:
            yield _judged(dataset, claim.text, words, unit, one, published)


def claims_of(dataset: xr.Dataset) -> list[Claim]:
    """Return the claims that a dataset carries in its attributes; raises SweepError if they cannot be read."""
    try:
        return [Claim.model_validate(claim) for claim in json.loads(dataset.attrs.get("claims", "[]"))]
    except (ValueError, TypeError) as error:
        raise SweepError(f"the attribute 'claims' cannot be read: {error}") from error


def _judged(
    dataset: xr.Dataset, what: str, quantity: str, unit: str, ours: _Measured, published: _Published
) -> Comparison:
    rounding = 0.0 if published.counted else published.rounding
    tolerance = 0.0 if published.counted else published.tolerance * abs(published.number)
    allowance = rounding + MC_ERRORS_ALLOWED * ours.error
    verdict, reason = _verdict(ours, published, allowance, tolerance)
    return Comparison(
        study=str(dataset.attrs.get("study_name", "")),
        what=what,
        quantity=quantity,
        where=ours.where,
        unit=unit,
        value=ours.value,
        mc_error=ours.error,
        published=published.number,
        rounding=rounding,
        allowance=allowance,
        difference=ours.value - published.number,
        verdict=verdict,
        source=published.source,
        reason=reason,
    )


def _verdict(ours: _Measured, published: _Published, allowance: float, tolerance: float) -> tuple[Verdict, str]:
    if ours.missing:
        return "incomplete", ours.missing
    if ours.broken or not math.isfinite(ours.value):
        return "NOT reproduced", ours.broken or "the result is not a finite number"
    off = abs(ours.value - published.number) - ARITHMETIC * abs(published.number)
    if off <= allowance:
        return "reproduced", ""
    if tolerance > 0.0 and off <= allowance + tolerance:
        return "within tolerance", f"{100.0 * published.tolerance:g} %: {published.reason}"
    return "NOT reproduced", ""


def _quantity(dataset: xr.Dataset, variable: str, component: str | None) -> xr.Dataset:
    """Return the value, the one-sigma error (0 where there is none) and the status of each point of the grid."""
    if variable not in dataset:
        raise _OutsideGridError(f"{variable} is not a result of this store")
    value = _component(dataset[variable], component)
    known = standard_error(dataset, variable)
    error = xr.zeros_like(dataset["status"], dtype=float) if known is None else _component(known, component)
    whole = {VALUE: value.drop_attrs(), ERROR: error.drop_attrs(), "status": dataset["status"].drop_attrs()}
    order = [n for d in dataset["status"].dims for n in (d, *dataset.coords) if d in dataset[n].dims]
    return xr.Dataset(whole).broadcast_like(dataset["status"]).assign_attrs(axes=list(map(str, dict.fromkeys(order))))


def _component(variable: xr.DataArray, component: str | None) -> xr.DataArray:
    if component is None:
        return variable
    dimension = str(variable.dims[-1])
    return variable.isel({dimension: variable[dimension].values.tolist().index(component)}, drop=True)


def _unit(dataset: xr.Dataset, variable: str, component: str | None) -> str:
    if variable not in dataset:
        return ""
    units = f"{dataset[variable].dims[-1]}_unit" if component is not None else ""
    if units in dataset.coords:
        return str(_component(dataset[units], component).item())
    return str(dataset[variable].attrs.get("units", ""))


def _measure(dataset: xr.Dataset, claim: Claim, quantity: Slope | Ratio | Reading) -> Iterator[_Measured]:
    points = _quantity(dataset, quantity.variable, quantity.component)
    if isinstance(quantity, Slope):
        if quantity.over not in points.coords:
            raise _OutsideGridError(f"{quantity.over} is not an axis of this store")
        for line in _combinations(_pick(points, claim.where), along=quantity.over):
            yield _slope(line, quantity.over)
    elif isinstance(quantity, Ratio):
        top, bottom = (_pick(points, {**claim.where, **place}) for place in (quantity.of, quantity.to))
        dimensions = [points[axis].dims for axis in quantity.of]
        differing = {str(name) for name, axis in points.coords.items() if axis.dims in dimensions}
        for one, other in zip(_combinations(top), _combinations(bottom), strict=True):
            yield _ratio(_at(one), _at(other), differing)
    else:
        for point in _combinations(_pick(points, {**claim.where, **quantity.at})):
            yield _at(point)


def _pick(points: xr.Dataset, places: Mapping[str, Any]) -> xr.Dataset:
    """Return the part of a grid at values of its axes, without the dimensions that these fix."""
    found: dict[str, NDArray[np.bool_]] = {}
    for axis, value in places.items():
        if axis not in points.coords or not points[axis].dims:
            raise _OutsideGridError(f"{axis} is not an axis of this store")
        dimension = str(points[axis].dims[0])
        found[dimension] = found.get(dimension, True) & np.asarray(points[axis].values == value)
        if not found[dimension].any():
            raise _OutsideGridError(f"{axis} = {value} is not in the grid of this store")
    return points.isel({dimension: int(np.argmax(mask)) for dimension, mask in found.items()})


def _combinations(points: xr.Dataset, along: str = "") -> Iterator[xr.Dataset]:
    """Yield the parts of a grid, one for each combination of its dimensions but that of the axis ``along``."""
    kept = points[along].dims if along else ()
    others = [d for d in points["status"].dims if d not in kept]
    for index in np.ndindex(*(points.sizes[d] for d in others)):
        yield points.isel(dict(zip(others, index, strict=True)))


def _places(points: xr.Dataset) -> dict[str, Any]:
    """Return the axes that have one value here, in the order of the grid (Zarr sorts them by name)."""
    return {name: points[name].item() for name in points.attrs["axes"] if not points[name].dims}


def _at(point: xr.Dataset) -> _Measured:
    where, status = _places(point), int(point["status"])
    if status != DONE:
        return _Measured(where, missing=_why({status}, "the point"))
    return _Measured(where, float(point[VALUE]), float(point[ERROR]))


def _slope(line: xr.Dataset, over: str) -> _Measured:
    """Return the slope along a line of points; those that the study excludes do not belong to it."""
    where = _places(line)
    line = line.isel({line["status"].dims[0]: line["status"].values != EXCLUDED})
    status = line["status"].values
    if np.any(status != DONE):
        some = f"{np.count_nonzero(status != DONE)} of {status.size} points"
        return _Measured(where, missing=_why(set(status[status != DONE].tolist()), some))
    x, y, error = (np.asarray(line[name].values, dtype=float) for name in (over, VALUE, ERROR))
    if len(x) < 2:
        return _Measured(where, missing=f"a slope needs two values of {over}; this grid has {len(x)}")
    if not (np.all(x > 0.0) and np.all(np.isfinite(y)) and np.all(y > 0.0)):
        return _Measured(where, broken="there are values that are not above 0, which have no power law")
    law = power_law(x, y, error)
    return _Measured(where, law.exponent, law.exponent_error)


def _ratio(top: _Measured, bottom: _Measured, differing: set[str]) -> _Measured:
    """Return top/bottom; their errors are independent, as every point has random streams of its own."""
    where = {axis: value for axis, value in top.where.items() if axis not in differing}
    if missing := top.missing or bottom.missing:
        return _Measured(where, missing=missing)
    if bottom.value == 0.0 or not math.isfinite(top.value / bottom.value):
        return _Measured(where, broken="the ratio is not a finite number")
    ratio = top.value / bottom.value
    return _Measured(where, ratio, math.hypot(top.error, ratio * bottom.error) / abs(bottom.value))


def _why(codes: set[int], subject: str) -> str:
    if FAILED in codes:
        return f"failed: {subject}"
    return f"excluded by the study: {subject}" if EXCLUDED in codes else f"not done yet: {subject}"


def _in_words(quantity: Slope | Ratio | Reading) -> str:
    name = quantity.variable + (f"[{quantity.component}]" if quantity.component else "")
    if isinstance(quantity, Slope):
        return f"slope of {name} over {quantity.over}"
    if isinstance(quantity, Ratio):
        return f"{name}({place_in_words(quantity.of)}) / {name}({place_in_words(quantity.to)})"
    return name
