"""One result of a plain function, of whatever type, as a row of numbers and texts with their layout."""

import dataclasses
import datetime
import math
import struct
import sys
from collections.abc import Mapping
from functools import cached_property
from hashlib import blake2b
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.contract import NotFiniteError, Output, ResultError, shown, suggest
from sweep.contract.units import same_unit
from sweep.functions.layout import Coordinate, Field, Layout, Type, problems_of_names

TEXT_BYTES = 16
"""Bytes of the digest that stands for a text in a row."""

WHAT_RESULTS_ARE = "results are numbers, strings, truth values, times, arrays of these, or xarray objects"


class Flat(NamedTuple):
    """The result of a point: its layout, a row of numbers as bytes, the texts in it by their digests, and of random
    realisations those that are kept.
    """

    layout: Layout
    row: bytes
    texts: dict[bytes, str]
    kept: NDArray[np.float64] | None = None


class _Value(NamedTuple):
    """One output: type, values, dimensions, those of their coordinates that it brings, unit, meaning."""

    type: Type
    array: NDArray[Any]
    dims: tuple[str, ...] | None = None
    coordinates: tuple[Coordinate, ...] = ()
    unit: str = ""
    meaning: str = ""


@dataclasses.dataclass(frozen=True)
class Declared:
    """What a function declares of its results: ``outputs`` by name, ``single`` the name of a result without one, and
    the names of its parameters.
    """

    function: str
    single: str
    outputs: tuple[Output, ...] = ()
    parameters: tuple[str, ...] = ()

    @cached_property
    def by_name(self) -> dict[str, Output]:
        """The outputs by name."""
        return {output.name: output for output in self.outputs}

    @cached_property
    def coordinates(self) -> dict[str, Coordinate]:
        """The coordinates that outputs declare, by dimension."""
        pairs = [(dim, given) for output in self.outputs for dim, given in (output.coords or {}).items()]
        return {dim: coordinate_of(dim, given) for dim, given in pairs}

    @cached_property
    def without_dimensions(self) -> bool:
        """Whether no declared output is an array."""
        return not any(output.dims for output in self.outputs)

    @cached_property
    def layouts(self) -> dict[Any, tuple[Layout, struct.Struct] | None]:
        """The layouts of results of scalars that were met, by names and types."""
        return {}


def flatten(result: Any, declared: Declared) -> Flat:
    """Return the result of one point as a row.

    Raises ResultError that names every output that is none or not what is declared, and NotFiniteError.
    """
    if type(result) is dict and declared.without_dimensions and (quick := _scalars(result, declared)) is not None:
        return quick
    named = named_results(result, declared)
    problems = [
        f"does not return the output {name!r}{suggest(name, [n for n in named if n not in declared.by_name])}"
        for name in declared.by_name
        if name not in named
    ]
    values: dict[str, _Value] = {}
    for name, value in named.items():
        try:
            values[name] = _as_declared(name, _value(value), declared)
        except ResultError as error:
            problems.append(f"{name!r} {error}")
    if not problems:
        coordinates, problems = _coordinates(values, declared)
    if problems:
        raise ResultError(f"{declared.function}: {'; '.join(problems)}")
    fields = tuple(
        Field(name, value.type, value.dims or (), value.unit, value.meaning) for name, value in values.items()
    )
    used = dict.fromkeys(dim for field in fields for dim in field.dims)
    layout = Layout(fields, tuple(coordinates[dim] for dim in used))
    if wrong := problems_of_names(layout, declared.parameters):
        raise ResultError(f"{declared.function}: {'; '.join(wrong)}")
    _check_finite(values, declared)
    texts: dict[bytes, str] = {}
    row = b"".join(_bytes(value, texts) for value in values.values())
    return Flat(layout, row, texts)


def split_points(result: Any, n: int, declared: Declared, noun: str) -> list[Flat]:
    """Return the results of n points or realisations (``noun``) from those of all, whose first axis counts them.

    Raises ResultError as `flatten`, and for arrays of another length.
    """
    columns: dict[str, NDArray[Any]] = {}
    problems = []
    for name, given in named_results(result, declared).items():
        try:
            value = _value(given)
            if value.dims is not None:
                raise ResultError("is an xarray object; a function that is called for many at once returns arrays")
            output = declared.by_name.get(name)
            if value.unit and (output is None or not same_unit(output.unit, value.unit)):
                raise ResultError(f"is in {value.unit}; declare that as the unit of its output")
            array = np.broadcast_to(value.array, (n,)) if value.array.ndim == 0 else value.array
            if len(array) != n:
                raise ResultError(f"has {len(array)} values, expected one for each of {n} {noun}")
            columns[name] = array
        except ResultError as error:
            problems.append(f"{name!r} {error}")
    if problems:
        raise ResultError(f"{declared.function}: {'; '.join(problems)}")
    layout = flatten({name: array[0] for name, array in columns.items()}, declared).layout
    values = {field.name: _Value(field.type, columns[field.name]) for field in layout.fields}
    _check_finite(values, declared)
    texts: dict[bytes, str] = {}
    parts = [np.frombuffer(_bytes(value, texts), dtype=np.uint8).reshape(n, -1) for value in values.values()]
    return [Flat(layout, row.tobytes(), texts) for row in np.concatenate(parts, axis=1)]


def coordinate_of(dim: str, given: Any) -> Coordinate:
    """Return a coordinate from values, or from (values, unit); raises ResultError for what is none."""
    unit = ""
    if isinstance(given, tuple) and len(given) == 2 and isinstance(given[1], str) and np.ndim(given[0]) == 1:
        given, unit = given
    value = _value(given)
    if value.array.ndim != 1:
        raise ResultError(f"the coordinate {dim!r} has the shape {value.array.shape}, expected one dimension")
    return _coordinate(dim, value, unit or value.unit)


def _coordinate(dim: str, value: _Value, unit: str) -> Coordinate:
    array = value.array
    if (value.type == "float" and not np.isfinite(array).all()) or (value.type == "datetime" and np.isnat(array).any()):
        raise ResultError(f"the coordinate {dim!r} has values that are not finite")
    plain = array.view("i8") if value.type == "datetime" else array
    return Coordinate(dim, value.type, tuple(plain.tolist()), "" if value.type == "datetime" else unit)


FAST: dict[type, tuple[Type, str]] = {
    float: ("float", "d"),
    np.float64: ("float", "d"),
    int: ("int", "q"),
    np.int64: ("int", "q"),
    bool: ("bool", "q"),
    np.bool_: ("bool", "q"),
    str: ("text", f"{TEXT_BYTES}s"),
}
"""How scalars of these types are packed."""


def _scalars(result: dict[Any, Any], declared: Declared) -> Flat | None:
    """Return the row of plain scalars, the quick way; None where anything is not so plain."""
    key = tuple(zip(result, map(type, result.values()), strict=True))
    if key not in declared.layouts:
        declared.layouts[key] = _scalar_layout(key, declared)
    if (found := declared.layouts[key]) is None:
        return None
    layout, packing = found
    texts: dict[bytes, str] = {}
    packed: list[Any] = []
    for value, field in zip(result.values(), layout.fields, strict=True):
        if field.type == "float" and not math.isfinite(value):
            return None
        if field.type == "text":
            try:
                packed.append(text_digest(value))
            except ResultError:
                return None
            texts[packed[-1]] = value
        else:
            packed.append(value)
    try:
        return Flat(layout, packing.pack(*packed), texts)
    except struct.error:  # an integer of more than 64 bits
        return None


def _scalar_layout(types: tuple[tuple[Any, type], ...], declared: Declared) -> tuple[Layout, struct.Struct] | None:
    names = [name for name, _ in types]
    if not types or not all(type(name) is str for name in names) or not all(kind in FAST for _, kind in types):
        return None
    if not declared.by_name.keys() <= set(names):
        return None
    told = [declared.by_name.get(name, Output(name)) for name in names]
    kinds = [FAST[kind] for _, kind in types]
    fields = (Field(o.name, kind[0], (), o.unit, o.meaning) for o, kind in zip(told, kinds, strict=True))
    layout = Layout(tuple(fields))
    if problems_of_names(layout, declared.parameters):
        return None
    return layout, struct.Struct("<" + "".join(code for _, code in kinds))


def named_results(result: Any, declared: Declared) -> dict[str, Any]:
    """Return the outputs by name that a function has returned."""
    if result is None:
        raise ResultError(f"{declared.function} returns nothing (None); it must return its results")
    if hasattr(result, "to_xarray") and not isinstance(result, type):  # of pandas
        result = result.to_xarray()
    if isinstance(result, Mapping) and not _is_xarray(result):
        named = dict(result)
    elif dataclasses.is_dataclass(result) and not isinstance(result, type):
        named = {field.name: getattr(result, field.name) for field in dataclasses.fields(result)}
    elif hasattr(result, "_asdict"):
        named = dict(result._asdict())
    elif _is_xarray(result) and hasattr(result, "data_vars"):
        named = dict(result.data_vars) | _beside_dimensions(result, declared)
    elif _is_xarray(result):
        named = {result.name or declared.single: result} | _beside_dimensions(result, declared)
    else:
        return {declared.single: result}
    if not named:
        raise ResultError(f"{declared.function} returns no results: an empty {type(result).__name__}")
    if strange := [name for name in named if not isinstance(name, str)]:
        raise ResultError(f"{declared.function}: the name {shown(strange[0])} of an output is no text")
    return named


def _beside_dimensions(result: Any, declared: Declared) -> dict[str, Any]:
    """Return the coordinates of an xarray object that are not those of its dimensions: they are results too, unless
    they repeat a parameter.
    """
    return {
        str(name): array.reset_coords(drop=True)
        for name, array in result.coords.items()
        if name not in result.dims and name not in declared.parameters
    }


def _is_xarray(value: object) -> bool:
    xarray = sys.modules.get("xarray")
    return xarray is not None and isinstance(value, (xarray.DataArray, xarray.Dataset))


def _value(value: Any) -> _Value:
    """Return a value of any allowed type; raises ResultError that says why it is none."""
    if hasattr(value, "to_xarray") and not isinstance(value, type):
        value = value.to_xarray()
    if _is_xarray(value):
        if not hasattr(value, "dims") or hasattr(value, "data_vars"):
            raise ResultError("is a Dataset; results are not nested: return its variables under names of their own")
        inner = _value(value.values)
        dims = tuple(map(str, value.dims))
        coordinates = []
        for dim in dims:
            if dim in value.coords:
                along = value.coords[dim]
                coordinates.append(_coordinate(dim, _value(along.values), str(along.attrs.get("units", ""))))
        unit, meaning = (str(value.attrs.get(key, "")) for key in ("units", "long_name"))
        return inner._replace(dims=dims, coordinates=tuple(coordinates), unit=unit, meaning=meaning)
    if isinstance(value, np.ma.MaskedArray):
        if n := int(np.ma.getmaskarray(value).sum()):
            raise ResultError(f"has {n} masked values; fill them, with NaN where the output declares nan=True")
        value = value.data
    unit = ""
    if hasattr(value, "unit") and hasattr(value, "value") and hasattr(value, "to_value"):  # of astropy
        unit, value = str(value.unit), value.value
    return _Value(*_typed(value), unit=unit)


def _typed(value: Any) -> tuple[Type, NDArray[Any]]:  # noqa: PLR0911 (one for each type)
    if value is None:
        raise ResultError("is None")
    if isinstance(value, bool | np.bool_):
        return "bool", np.array(bool(value))
    if isinstance(value, int) and not isinstance(value, np.generic):
        if not -(2**63) <= value < 2**63:
            raise ResultError(f"is {shown(value)}; integers have 64 bits at most")
        return "int", np.array(value, dtype="i8")
    if isinstance(value, float):
        return "float", np.array(float(value))
    if isinstance(value, str):
        return "text", _texts(np.array(str(value), dtype=object))
    if isinstance(value, datetime.datetime | datetime.date):
        return "datetime", np.array(_time(value))
    if isinstance(value, complex | np.complexfloating):
        raise ResultError("is complex; return its real and imaginary parts under names of their own")
    if isinstance(value, Mapping):
        raise ResultError("is a dict; results are not nested: return its entries under names of their own")
    if isinstance(value, datetime.timedelta | np.timedelta64):
        raise ResultError("is a duration; return a number and declare its unit")
    if isinstance(value, list | tuple):
        return _of_list(value)
    if isinstance(value, np.ndarray | np.generic) or hasattr(value, "__array__"):
        return _of_array(np.asarray(value))
    raise ResultError(f"is of type {type(value).__name__}; {WHAT_RESULTS_ARE}")


def _of_list(value: list[Any] | tuple[Any, ...]) -> tuple[Type, NDArray[Any]]:
    try:
        array = np.asarray(value)
        elements = np.array(value, dtype=object)
    except ValueError as error:
        raise ResultError("has parts of different lengths") from error
    except OverflowError as error:
        raise ResultError("has integers of more than 64 bits") from error
    kinds = {type(element) for element in elements.reshape(-1).tolist()}
    if kinds & {list, tuple}:
        raise ResultError("has parts of different lengths")
    if array.dtype.kind in "fO" and kinds == {int}:
        raise ResultError("has integers of more than 64 bits")
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
    raise ResultError(f"holds a value of type {type(strange).__name__}; {WHAT_RESULTS_ARE}")


def _texts(array: NDArray[Any]) -> NDArray[Any]:
    for text in array.reshape(-1).tolist():
        text_digest(text)
    return array


def text_digest(text: str) -> bytes:
    """Return what stands for a text in a row; raises ResultError for one that no file can hold."""
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
    """Return times in nanoseconds; raises ResultError for those that have none in 64 bits."""
    try:
        fine = array.astype("M8[ns]")
        exact = np.array_equal(fine.astype(array.dtype), array, equal_nan=True)
    except OverflowError:  # older NumPy wraps around instead
        exact = False
    if not exact:
        raise ResultError("has times beyond the years 1678 to 2261, which nanoseconds of 64 bits can hold")
    return fine


def _as_declared(name: str, value: _Value, declared: Declared) -> _Value:
    """Return a value with dimensions, and with what is declared of its output; raises ResultError where they differ."""
    output = declared.by_name.get(name)
    dims = () if output is None else tuple(output.dims)
    ndim = value.array.ndim
    if value.dims is not None and dims and value.dims != dims:
        if set(value.dims) != set(dims):
            raise ResultError(f"has the dimensions ({', '.join(value.dims)}), expected ({', '.join(dims)})")
        value = value._replace(array=value.array.transpose([value.dims.index(dim) for dim in dims]), dims=dims)
    if value.dims is None and dims and len(dims) != ndim:
        raise ResultError(f"has the shape {value.array.shape}, expected the dimensions ({', '.join(dims)})")
    found = value.dims or dims or tuple(f"{name}_dim_{k}" for k in range(ndim))
    value = value._replace(dims=found)
    if output is None:
        return value
    if output.unit and value.unit and not same_unit(output.unit, value.unit):
        raise ResultError(f"is in {value.unit}, expected {output.unit}")
    return value._replace(unit=output.unit or value.unit, meaning=output.meaning or value.meaning)


def _coordinates(values: Mapping[str, _Value], declared: Declared) -> tuple[dict[str, Coordinate], list[str]]:
    """Return the coordinate of each dimension: that which is declared or came with an output, or 0, 1, 2 ..."""
    known = dict(declared.coordinates)
    problems: list[str] = []
    for name, value in values.items():
        for one in value.coordinates:
            before = known.setdefault(one.name, one)
            if before != one and (before.type, before.values) != (one.type, one.values):
                problems.append(
                    f"{name!r} has other values along {one.name!r} than are declared or than another output"
                )
    for name, value in values.items():
        for dim, size in zip(value.dims or (), value.array.shape, strict=True):
            expected = len(known.setdefault(dim, Coordinate(dim, "int", tuple(range(size)))).values)
            if expected != size:
                problems.append(f"{name!r} has {size} values along {dim!r}, expected {expected}")
    return known, list(dict.fromkeys(problems))


def _check_finite(values: Mapping[str, _Value], declared: Declared) -> None:
    problems = []
    for name, value in values.items():
        if (output := declared.by_name.get(name)) is not None and output.nan:
            continue
        if value.type == "float" and not (finite := np.isfinite(value.array)).all():
            bad = value.array[~finite]
            nan = int(np.isnan(bad).sum())
            words = " and ".join(f"{n} {word}" for n, word in ((nan, "NaN"), (bad.size - nan, "infinite")) if n)
            whole = value.array.ndim == 0
            problems.append(
                f"{name} is {'NaN' if nan else 'infinite'}"
                if whole
                else f"{name} has {words} of {value.array.size} values"
            )
        elif value.type == "datetime" and np.isnat(value.array).any():
            problems.append(f"{name} has {int(np.isnat(value.array).sum())} times that are NaT")
    if problems:
        hint = "declare Output(..., nan=True) where that is a value"
        raise NotFiniteError(f"{declared.function}: {'; '.join(problems)} ({hint})")


def _bytes(value: _Value, texts: dict[bytes, str]) -> bytes:
    if value.type == "text":
        digests = []
        for text in value.array.reshape(-1).tolist():
            digests.append(text_digest(text))
            texts[digests[-1]] = text
        return b"".join(digests)
    dtype = "<f8" if value.type == "float" else "<i8"
    array = value.array.view("i8") if value.type == "datetime" else value.array
    return np.ascontiguousarray(array, dtype=dtype).tobytes()
