"""Part of a dataset: at values of its axes, or where an axis is in a range."""

from collections.abc import Hashable, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import xarray as xr

from linksweep.sweep.contract import FEW, SweepError, shown, suggest
from linksweep.sweep.formatting import first_of


def select(dataset: xr.Dataset, places: Mapping[str, Any]) -> xr.Dataset:
    """Return the part of a dataset at values of axes; these become coordinates without a dimension.

    Where several points have the values, as rows of a table may, all of them are returned and keep their dimension.
    A value may be given as text, as on a command line.  Raises SweepError like `indices`.
    """
    part: dict[str, Any] = {}
    for dimension, found in indices(dataset, places).items():
        if len(found) == 1:
            part[dimension] = found[0]
        else:
            part |= dict.fromkeys(_both(dataset, dimension), found)
    return dataset.isel(part)


def indices(dataset: xr.Dataset, places: Mapping[str, Any]) -> dict[str, list[int]]:
    """Return the indices along each dimension that values of axes stand for.

    Raises SweepError that lists every name that is not an axis, every value that is not in the grid, and values of axes
    along one dimension that are not those of any point.
    """
    problems: list[str] = []
    found: dict[str, set[int]] = {}
    axes = [str(n) for n, c in dataset.coords.items() if c.ndim == 1 and not str(n).endswith("_unit")]
    for name, wanted in places.items():
        if name not in axes:
            problems.append(f"{shown(name)} is not an axis{suggest(name, axes) if axes else '; there are none'}")
            continue
        values = dataset[name].values.tolist()
        hits = {i for i, value in enumerate(values) if _is_meant(value, wanted)}
        dimension = str(dataset[name].dims[0])
        if not hits:
            problems.append(f"{name} = {wanted} is not in the grid, which has {first_of(values, FEW)}")
        elif not found.setdefault(dimension, hits) & hits:
            problems.append(f"{name} = {wanted} is at no point with the other values that are given along {dimension}")
        else:
            found[dimension] &= hits
    if problems:
        raise SweepError(problems)
    return {dimension: sorted(hits) for dimension, hits in found.items()}


def between(dataset: xr.Dataset, axis: str, low: float, high: float) -> xr.Dataset:
    """Return the part of a dataset where low <= axis <= high; raises SweepError if there is none."""
    inside = (dataset[axis].values >= low) & (dataset[axis].values <= high)
    if not inside.any():
        values = dataset[axis].values
        raise SweepError(
            f"{axis} has no value from {low:g} to {high:g}; it goes from {values.min():g} to {values.max():g}"
        )
    dimension = str(dataset[axis].dims[0])
    return dataset.isel(dict.fromkeys(_both(dataset, dimension), np.flatnonzero(inside)))


def places_along(dataset: xr.Dataset | xr.DataArray, dimensions: Iterable[Hashable]) -> Iterator[dict[str, int]]:
    """Yield the index of every combination along some dimensions, in C order."""
    names = list(map(str, dimensions))
    for index in np.ndindex(*(dataset.sizes[name] for name in names)):
        yield dict(zip(names, index, strict=True))


def coordinates_along(dataset: xr.Dataset, dimension: str) -> list[str]:
    """Return the coordinates along a dimension, its own first."""
    names = dict.fromkeys([dimension, *map(str, dataset.coords)])
    return [name for name in names if name in dataset.coords and dataset[name].dims == (dimension,)]


def place_in_words(where: Mapping[str, Any]) -> str:
    """Return a place on the axes as ``model=gaia, v_max=16``."""
    return ", ".join(f"{k}={f'{v:g}' if isinstance(v, float) else v}" for k, v in where.items())


def _both(dataset: xr.Dataset, dimension: str) -> list[str]:
    """Return a dimension, and the second one that covariances along it have."""
    return [d for d in (dimension, f"{dimension}_other") if d in dataset.dims]


def _is_meant(value: object, wanted: object) -> bool:
    """Return whether a value of a grid is the one wanted, which may be its text on a command line."""
    if not isinstance(wanted, str) or isinstance(value, str):
        return value == wanted
    if isinstance(value, bool):
        return wanted.lower() == str(value).lower()
    for number in (int, float):  # an integer beyond 2**53 is no float
        with suppress(ValueError):
            return value == number(wanted)
    return False
