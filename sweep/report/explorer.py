"""The interactive view of a grid: its numbers as the page's script reads them, and the library that draws them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from bokeh.resources import Resources

from linksweep.sweep.analysis.quantity import error_bar, prediction_name, quantities
from linksweep.sweep.formatting import is_truth, meaning_beside, prefixed, units_of, written
from linksweep.sweep.plots.style import SCALE, is_logarithmic, with_scales
from linksweep.sweep.studies.study import POINT

DIGITS = 7
"""Significant digits of a number in the page: more than any Monte-Carlo result needs."""

MOST_NUMBERS = 200_000
"""The most numbers in a page for all its interactive views together, some 2 MB."""

BESIDE = ("published", "published_rounding")


def library() -> str:
    """Return the script of BokehJS that draws in the page, without anything that needs a network or a server."""
    resources = Resources(mode="inline", minified=True, log_level="error", components=["bokeh", "bokeh-api"])
    return "\n".join(resources.js_raw)


def explorer(dataset: xr.Dataset, first: Sequence[str], room: int) -> tuple[dict[str, Any], int, list[str]]:
    """Return the contents of a grid in at most ``room`` numbers, how many these are, and the quantities left out.

    ``first`` are the quantities that come first; each has flat lists in C order of its own dimensions, None where a
    value is missing.
    """
    dataset = with_scales(dataset, list(map(str, dataset.variables)))
    everything = [*first, *(name for name in quantities(dataset) if name not in first)]
    names = [name for name in everything if np.isfinite(dataset[name].values).any()]
    shown: list[dict[str, Any]] = []
    left_out, used = [], 0
    for name in names:
        parts = _parts(dataset, name)
        size = sum(part.size for part in parts.values())
        if used + size > room:
            left_out.append(name)
            continue
        used += size
        shown.append(_quantity(dataset, name, parts))
    dims = list(dict.fromkeys(d for quantity in shown for d in quantity["dims"]))
    return {"quantities": shown, "axes": [_axis(dataset, name) for name in _axes(dataset, dims)]}, used, left_out


def _parts(dataset: xr.Dataset, name: str) -> dict[str, xr.DataArray]:
    """Return a quantity and what belongs to it, all with its own dimensions."""
    value = dataset[name]
    found = {"value": value, "error": error_bar(dataset, name)}
    found["predicted"] = dataset.get(prediction_name(dataset, name))
    found |= {suffix: dataset.get(f"{name}_{suffix}") for suffix in BESIDE}
    wanted = {suffix: part for suffix, part in found.items() if part is not None and set(part.dims) <= set(value.dims)}
    return {
        suffix: part.broadcast_like(value).transpose(*value.dims)
        for suffix, part in wanted.items()
        if suffix == "value" or np.nan_to_num(part.values).any()  # without errors of observation a prediction is 0
    }


def _quantity(dataset: xr.Dataset, name: str, parts: dict[str, xr.DataArray]) -> dict[str, Any]:
    attributes = dataset[name].attrs
    unit, factors = units_of(attributes), xr.DataArray(1.0)
    components: dict[str, Any] = {}
    own = [str(d) for d in dataset[name].dims if f"{d}_unit" in dataset.coords]  # a unit for each component
    if "," in unit and len(own) == 1:
        (dimension,) = own
        units = dataset[f"{dimension}_unit"].values.tolist()
        chosen = [prefixed(dataset[name].isel({dimension: i}).values, str(unit)) for i, unit in enumerate(units)]
        factors = xr.DataArray([one.factor for one in chosen], dims=dimension)
        unit, components = "", {"unit_dim": dimension, "units": [written(one.unit) for one in chosen]}
    elif "," in unit:  # of each element of a matrix
        unit = ", ".join(dict.fromkeys(part.strip(" ()") for part in unit.split(",")))
    return {
        "name": name,
        "unit": written(unit),
        **components,
        "meaning": meaning_beside(name, attributes),
        "dims": list(map(str, dataset[name].dims)),
        "scale": str(attributes.get(SCALE, "")),
        "truth": is_truth(dataset[name]),
        **{suffix: _numbers((part * factors).transpose(*part.dims).values) for suffix, part in parts.items()},
    }


def _axes(dataset: xr.Dataset, dims: Sequence[str]) -> list[str]:
    """Return the coordinates along dimensions, and the dimensions without one; those along points without order
    come last, and only if they are numeric.
    """
    names = [str(n) for n, c in dataset.coords.items() if c.ndim == 1 and str(n).removesuffix("_unit") == str(n)]
    found = [n for d in dims for n in dict.fromkeys([d, *(m for m in names if dataset[m].dims == (d,))])]
    unordered = [n for n in found if n != POINT and dataset[n].dims == (POINT,) and dataset[n].dtype.kind in "iuf"]
    return [n for n in found if dataset[n].dims != (POINT,)] + unordered + [n for n in found if n == POINT]


def _axis(dataset: xr.Dataset, name: str) -> dict[str, Any]:
    array = dataset[name]  # a dimension without a coordinate gives 0, 1, 2, ...
    numeric = array.dtype.kind in "iuf"
    values = _numbers(array.values) if numeric else list(map(str, array.values.tolist()))
    return {
        "name": name,
        "dim": str(array.dims[0]),
        "unit": written(units_of(array.attrs)),
        "numeric": numeric,
        "ordered": array.dims[0] != POINT,
        "logarithmic": numeric and is_logarithmic(array),
        "values": values,
    }


def _numbers(values: np.ndarray[Any, Any]) -> list[float | int | None]:
    """Return the numbers of an array in C order with `DIGITS` digits, None for those that are not finite."""
    return [_number(value) for value in values.reshape(-1).tolist()]


def _number(value: float) -> float | int | None:
    if not np.isfinite(value):
        return None
    short = float(f"{value:.{DIGITS}g}")
    return int(short) if short.is_integer() and abs(short) < 1e15 else short
