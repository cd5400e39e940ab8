"""One result of a plain function, of whatever type, as a row of numbers and texts with their layout."""

import math
import struct
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import NotFiniteError, Output, ResultError, suggest
from linksweep.sweep.contract.checked import not_finite
from linksweep.sweep.contract.units import same_unit
from linksweep.sweep.functions.layout import Coordinate, Field, Layout, Type, problems_of_names
from linksweep.sweep.functions.named_results import Declared, named_results
from linksweep.sweep.functions.values import TEXT_BYTES, Value, text_digest, value_of


class Flat(NamedTuple):
    """A point's result: layout, numbers as bytes, texts by their digests, and the random realisations that are kept."""

    layout: Layout
    row: bytes
    texts: dict[bytes, str]
    kept: NDArray[np.float64] | None = None


def flatten(result: Any, declared: Declared) -> Flat:
    """Return the result of one point as a row.

    Raises ResultError that names every output that is invalid or not as declared, and NotFiniteError.
    """
    if type(result) in FAST:
        result = {declared.single: result}
    if type(result) is dict and declared.without_dimensions and (quick := _scalars(result, declared)) is not None:
        return quick
    named = named_results(result, declared)
    problems = [
        f"does not return the output {name!r}{suggest(name, [n for n in named if n not in declared.by_name])}"
        for name in declared.by_name
        if name not in named
    ]
    values: dict[str, Value] = {}
    for name, value in named.items():
        try:
            values[name] = _as_declared(name, value_of(value), declared)
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
    """Return the result of each of n points or realisations (``noun``) from arrays whose first axis counts them.

    Raises ResultError as `flatten`, and for arrays of another length.
    """
    columns: dict[str, NDArray[Any]] = {}
    problems, each = [], f"one for each of {n} {noun}"
    for name, given in named_results(result, declared).items():
        try:
            value = value_of(given)
            if value.dims is not None:
                raise ResultError("is an xarray object; a function that is called for many at once returns arrays")
            output = declared.by_name.get(name)
            if value.unit and (output is None or not same_unit(output.unit, value.unit)):
                raise ResultError(f"is in {value.unit}; declare that as the unit of its output")
            if value.array.ndim == 0 and value.type in ("float", "int"):
                raise ResultError(f"is one number, perhaps a sum or mean; expected an array, {each}")
            array = np.broadcast_to(value.array, (n,)) if value.array.ndim == 0 else value.array
            if len(array) != n:
                raise ResultError(f"has {len(array)} values, expected {each}")
            columns[name] = array
        except ResultError as error:
            problems.append(f"{name!r} {error}")
    if problems:
        raise ResultError(f"{declared.function}: {'; '.join(problems)}")
    layout = flatten({name: array[0] for name, array in columns.items()}, declared).layout
    values = {field.name: Value(field.type, columns[field.name]) for field in layout.fields}
    _check_finite(values, declared)
    texts: dict[bytes, str] = {}
    parts = [np.frombuffer(_bytes(value, texts), dtype=np.uint8).reshape(n, -1) for value in values.values()]
    return [Flat(layout, row.tobytes(), texts) for row in np.concatenate(parts, axis=1)]


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
    """Return the row of plain scalars, the quick way; None if anything else is among them."""
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


def _as_declared(name: str, value: Value, declared: Declared) -> Value:
    """Return a value with dimensions, and with what is declared of its output; raises ResultError where they differ."""
    output = declared.by_name.get(name, Output(name))
    dims = tuple(output.dims)
    ndim = value.array.ndim
    if value.dims is not None and dims and value.dims != dims:
        if set(value.dims) != set(dims):
            raise ResultError(f"has the dimensions ({', '.join(value.dims)}), expected ({', '.join(dims)})")
        value = value._replace(array=value.array.transpose([value.dims.index(dim) for dim in dims]), dims=dims)
    if value.dims is None and dims and len(dims) != ndim:
        raise ResultError(f"has the shape {value.array.shape}, expected the dimensions ({', '.join(dims)})")
    found = value.dims or dims or tuple(f"{name}_dim_{k}" for k in range(ndim))
    if output.unit and value.unit and not same_unit(output.unit, value.unit):
        raise ResultError(f"is in {value.unit}, expected {output.unit}")
    return value._replace(dims=found, unit=output.unit or value.unit, meaning=output.meaning or value.meaning)


def _coordinates(values: Mapping[str, Value], declared: Declared) -> tuple[dict[str, Coordinate], list[str]]:
    """Return the coordinate of each dimension: that which is declared or came with an output, or 0, 1, 2 ..."""
    known = dict(declared.coordinates)
    problems: list[str] = []
    for name, value in values.items():
        for one in value.coordinates:
            before = known.setdefault(one.name, one)
            if (before.type, before.values) != (one.type, one.values):
                text = f"{name!r} has other values along {one.name!r} than are declared or than another output"
                problems.append(text)
    for name, value in values.items():
        for dim, size in zip(value.dims or (), value.array.shape, strict=True):
            expected = len(known.setdefault(dim, Coordinate(dim, "int", tuple(range(size)))).values)
            if expected != size:
                problems.append(f"{name!r} has {size} values along {dim!r}, expected {expected}")
    return known, list(dict.fromkeys(problems))


def _check_finite(values: Mapping[str, Value], declared: Declared) -> None:
    problems = []
    for name, value in values.items():
        if (output := declared.by_name.get(name)) is not None and output.nan:
            continue
        if value.type == "float" and (problem := not_finite(name, value.array, is_one=value.array.ndim == 0)):
            problems.append(problem)
        elif value.type == "datetime" and (n := np.count_nonzero(np.isnat(value.array))):
            problems.append(f"{name} has {n} times that are NaT")
    if problems:
        hint = "declare Output(..., nan=True) where that is a value"
        raise NotFiniteError(f"{declared.function}: {'; '.join(problems)} ({hint})")


def _bytes(value: Value, texts: dict[bytes, str]) -> bytes:
    if value.type == "text":
        digests = []
        for text in value.array.reshape(-1).tolist():
            digests.append(text_digest(text))
            texts[digests[-1]] = text
        return b"".join(digests)
    dtype = "<f8" if value.type == "float" else "<i8"
    array = value.array.view("i8") if value.type == "datetime" else value.array
    return np.ascontiguousarray(array, dtype=dtype).tobytes()
