"""One value that a plain function returns, with what it says itself: dimensions, coordinates, unit and meaning."""

import sys
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.contract import ResultError
from sweep.functions.layout import Coordinate, Type
from sweep.functions.value_types import typed


class Value(NamedTuple):
    """One output: type, values, dimensions, those of their coordinates that it brings, unit, meaning."""

    type: Type
    array: NDArray[Any]
    dims: tuple[str, ...] | None = None
    coordinates: tuple[Coordinate, ...] = ()
    unit: str = ""
    meaning: str = ""


def coordinate_of(dim: str, given: Any) -> Coordinate:
    """Return a coordinate from values, or from (values, unit); raises ResultError for what is none."""
    unit = ""
    if isinstance(given, tuple) and len(given) == 2 and isinstance(given[1], str) and np.ndim(given[0]) == 1:
        given, unit = given
    value = value_of(given)
    if value.array.ndim != 1:
        raise ResultError(f"the coordinate {dim!r} has the shape {value.array.shape}, expected one dimension")
    return _coordinate(dim, value, unit or value.unit)


def _coordinate(dim: str, value: Value, unit: str) -> Coordinate:
    array = value.array
    if (value.type == "float" and not np.isfinite(array).all()) or (value.type == "datetime" and np.isnat(array).any()):
        raise ResultError(f"the coordinate {dim!r} has values that are not finite")
    plain = array.view("i8") if value.type == "datetime" else array
    return Coordinate(dim, value.type, tuple(plain.tolist()), "" if value.type == "datetime" else unit)


def is_xarray(value: object) -> bool:
    """Return whether a value is an xarray object, without importing xarray where nobody has."""
    xarray = sys.modules.get("xarray")
    return xarray is not None and isinstance(value, (xarray.DataArray, xarray.Dataset))


def value_of(value: Any) -> Value:
    """Return a value of any allowed type; raises ResultError that says why it is none."""
    if hasattr(value, "to_xarray") and not isinstance(value, type):
        value = value.to_xarray()
    if is_xarray(value):
        if not hasattr(value, "dims") or hasattr(value, "data_vars"):
            raise ResultError("is a Dataset; results are not nested: return its variables under names of their own")
        inner = value_of(value.values)
        dims = tuple(map(str, value.dims))
        coordinates = []
        for dim in dims:
            if dim in value.coords:
                along = value.coords[dim]
                coordinates.append(_coordinate(dim, value_of(along.values), str(along.attrs.get("units", ""))))
        unit, meaning = (str(value.attrs.get(key, "")) for key in ("units", "long_name"))
        return inner._replace(dims=dims, coordinates=tuple(coordinates), unit=unit, meaning=meaning)
    if isinstance(value, np.ma.MaskedArray):
        if n := int(np.ma.getmaskarray(value).sum()):
            raise ResultError(f"has {n} masked values; fill them, with NaN where the output declares nan=True")
        value = value.data
    unit = ""
    if hasattr(value, "unit") and hasattr(value, "value") and hasattr(value, "to_value"):  # of astropy
        unit, value = str(value.unit), value.value
    return Value(*typed(value), unit=unit)
