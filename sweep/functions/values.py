"""One value that a plain function returns: an array of one type, with dimensions, coordinates, unit and meaning."""

import datetime
import sys
from collections.abc import Mapping
from hashlib import blake2b
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import ResultError, shown
from linksweep.sweep.contract.units import is_quantity
from linksweep.sweep.functions.layout import EXACT_INT, Coordinate, Type

TEXT_BYTES = 16
"""Bytes of the digest that stands for a text in a row."""

WHAT_RESULTS_ARE = "results are numbers, strings, truth values, times, arrays of these, or xarray objects"


class Value(NamedTuple):
    """One output: type, values, dimensions, the coordinates that come with it, unit, meaning."""

    type: Type
    array: NDArray[Any]
    dims: tuple[str, ...] | None = None
    coordinates: tuple[Coordinate, ...] = ()
    unit: str = ""
    meaning: str = ""


def coordinate_of(dim: str, given: Any) -> Coordinate:
    """Return a coordinate from values, or from (values, unit); raises ResultError where they cannot be one."""
    unit = ""
    if isinstance(given, tuple) and len(given) == 2 and isinstance(given[1], str) and np.ndim(given[0]) == 1:
        given, unit = given
    value = value_of(given)
    if value.array.ndim != 1:
        raise ResultError(f"the coordinate {dim!r} has the shape {value.array.shape}, expected one dimension")
    try:
        return _coordinate(dim, value, unit or value.unit)
    except ResultError as error:
        raise ResultError(f"the coordinate {dim!r} {error}") from error


def _coordinate(dim: str, value: Value, unit: str) -> Coordinate:
    array = value.array
    if (value.type == "float" and not np.isfinite(array).all()) or (value.type == "datetime" and np.isnat(array).any()):
        raise ResultError("has values that are not finite")
    plain = array.view("i8") if value.type == "datetime" else array
    return Coordinate(dim, value.type, tuple(plain.tolist()), "" if value.type == "datetime" else unit)


def _coordinate_of_xarray(dim: str, along: Any) -> Coordinate:
    try:
        return _coordinate(dim, value_of(along.values), str(along.attrs.get("units", "")))
    except ResultError as error:
        raise ResultError(f"along {dim!r} {error}") from error


def is_xarray(value: object) -> bool:
    """Return whether a value is an xarray object, without importing xarray."""
    xarray = sys.modules.get("xarray")  # while another thread imports it, it has no classes yet, and nobody has a value
    kinds = tuple(getattr(xarray, name, ()) for name in ("DataArray", "Dataset"))
    return isinstance(value, kinds)


def value_of(value: Any) -> Value:
    """Return a value of any allowed type; raises ResultError that says why another one is not allowed."""
    if hasattr(value, "to_xarray") and not isinstance(value, type):
        value = value.to_xarray()
    if is_xarray(value):
        if not hasattr(value, "dims") or hasattr(value, "data_vars"):
            raise ResultError("is a Dataset; results are not nested: return its variables under names of their own")
        inner = value_of(value.values)
        dims = tuple(map(str, value.dims))
        if twice := [dim for dim in dims if dims.count(dim) > 1]:
            raise ResultError(f"has the dimension {twice[0]!r} twice")
        coordinates = [_coordinate_of_xarray(dim, value.coords[dim]) for dim in dims if dim in value.coords]
        unit, meaning = (str(value.attrs.get(key, "")) for key in ("units", "long_name"))
        return inner._replace(dims=dims, coordinates=tuple(coordinates), unit=unit, meaning=meaning)
    if isinstance(value, np.ma.MaskedArray) or hasattr(value, "unmasked"):  # of NumPy or astropy
        if n := int(np.sum(value.mask)):
            raise ResultError(f"has {n} masked values; fill them, with NaN where the output declares nan=True")
        value = value.unmasked if hasattr(value, "unmasked") else value.data
    unit = ""
    if is_quantity(value):
        unit, value = str(value.unit), value.value
    return Value(*_typed(value), unit=unit)


def _typed(value: Any) -> tuple[Type, NDArray[Any]]:
    """Return the type of a value that is no xarray object, and its array; raises ResultError as `value_of`."""
    if value is None:
        raise ResultError("is None")
    if isinstance(value, int) and not isinstance(value, bool | np.generic):
        if not -(2**63) <= value < 2**63:
            raise ResultError(f"is {shown(value)}; integers have 64 bits at most")
        return "int", np.array(value, dtype="i8")
    if isinstance(value, str):
        return "text", _texts(np.array(str(value), dtype=object))
    if isinstance(value, Mapping):
        raise ResultError("is a dict; results are not nested: return its entries under names of their own")
    if isinstance(value, datetime.timedelta | np.timedelta64):
        raise ResultError("is a duration; return a number and declare its unit")
    if isinstance(value, list | tuple):
        return _of_list(value)
    if isinstance(value, bool | float | complex | datetime.date) or hasattr(value, "__array__"):
        return _of_array(np.asarray(value))
    if hasattr(value, "jyear"):  # of astropy
        raise ResultError("is a Time of astropy; return .utc.datetime64, or a number such as .jyear")
    raise ResultError(f"is of type {type(value).__name__}; {WHAT_RESULTS_ARE}")


def _of_list(value: list[Any] | tuple[Any, ...]) -> tuple[Type, NDArray[Any]]:
    if any(map(is_quantity, set(map(type, value)))):
        raise ResultError("is a list of quantities; make one of them: astropy.units.Quantity(...)")
    try:
        array = np.asarray(value)
        elements = np.array(value, dtype=object)
    except ValueError as error:
        raise ResultError("has parts of different lengths") from error
    except OverflowError as error:
        raise ResultError("has integers of more than 64 bits") from error
    kinds = {bool if type(e) is np.bool_ else type(e) for e in elements.reshape(-1).tolist()}
    if kinds & {list, tuple}:
        raise ResultError("has parts of different lengths")
    if array.dtype.kind in "fO" and kinds == {int}:
        raise ResultError("has integers of more than 64 bits")
    if array.dtype.kind == "f" and any(issubclass(kind, int | np.integer) for kind in kinds):
        whole = [e for e in elements.reshape(-1).tolist() if isinstance(e, int | np.integer)]
        if large := [e for e in whole if not -EXACT_INT <= int(e) <= EXACT_INT]:
            raise ResultError(f"has {large[0]}, an integer beyond 2**53, beside floats, which cannot hold it")
    if (array.dtype.kind == "U" or array.dtype.kind in "biuf") and len(kinds & {str, bool}) and len(kinds) > 1:
        raise ResultError(f"mixes values of types {', '.join(sorted(kind.__name__ for kind in kinds))}")
    return _of_array(elements if array.dtype.kind == "U" else array)


def _of_array(array: NDArray[Any]) -> tuple[Type, NDArray[Any]]:
    if array.size == 0:
        raise ResultError(f"has no values: its shape is {array.shape}")
    kind = array.dtype.kind
    if kind == "b":
        return "bool", array
    if kind in "iu":
        if kind == "u" and array.max() >= 2**63:
            raise ResultError(f"has {shown(int(array.max()))}; integers have 63 bits and a sign at most")
        return "int", array.astype("i8")
    if kind == "f":
        if array.dtype.itemsize > 8:
            raise ResultError(f"is of type {array.dtype}; numbers have 64 bits at most")
        return "float", array.astype("f8")
    if kind == "U":
        return "text", _texts(array.astype(object))
    if kind == "M":
        return "datetime", _times(array)
    if kind == "c":
        raise ResultError("is complex; return its real and imaginary parts under names of their own")
    if kind == "m":
        raise ResultError("is a duration; return a number and declare its unit")
    if kind == "O":
        return _of_objects(array)
    raise ResultError(f"is of type {array.dtype}; {WHAT_RESULTS_ARE}")


def _of_objects(array: NDArray[Any]) -> tuple[Type, NDArray[Any]]:
    elements = array.reshape(-1).tolist()
    if all(isinstance(element, str) for element in elements):
        return "text", _texts(array)
    if all(isinstance(element, datetime.date) for element in elements):
        return "datetime", np.array([_time(element) for element in elements], dtype="M8[ns]").reshape(array.shape)
    strange = next(e for e in elements if not isinstance(e, str))
    if isinstance(strange, list | tuple | np.ndarray):
        raise ResultError("has parts of different lengths")
    kinds = sorted({type(element).__name__ for element in elements})
    if len(kinds) > 1:
        raise ResultError(f"mixes values of types {', '.join(kinds)}")
    number = isinstance(strange, int | float)
    hint = f"make it an array of numbers, .astype({kinds[0]})" if number else WHAT_RESULTS_ARE
    raise ResultError(f"holds objects of type {kinds[0]}; {hint}")


def _texts(array: NDArray[Any]) -> NDArray[Any]:
    for text in array.reshape(-1).tolist():
        text_digest(text)
    return array


def text_digest(text: str) -> bytes:
    """Return the digest that stands for a text in a row; raises ResultError for a text that no file can hold."""
    try:
        return blake2b(text.encode(), digest_size=TEXT_BYTES).digest()
    except UnicodeEncodeError as error:
        raise ResultError(f"is {text!a}, which has a lone surrogate: no file can hold it") from error


def _time(value: datetime.date) -> Any:
    zone = getattr(value, "tzinfo", None)
    if zone is not None:
        raise ResultError(
            f"is a time with the zone {zone}; results are in UTC without one: "
            "return it .astimezone(timezone.utc).replace(tzinfo=None)"
        )
    exact = value.to_datetime64() if hasattr(value, "to_datetime64") else np.datetime64(value)
    return _times(np.array(exact))[()]


def _times(array: NDArray[Any]) -> NDArray[Any]:
    """Return times in nanoseconds; raises ResultError for times that 64 bits cannot hold."""
    try:
        fine = array.astype("M8[ns]")
        exact = np.array_equal(fine.astype(array.dtype), array, equal_nan=True)
    except OverflowError:  # older NumPy wraps around instead
        exact = False
    if not exact:
        raise ResultError("has times beyond the years 1678 to 2261, which nanoseconds of 64 bits can hold")
    return fine
