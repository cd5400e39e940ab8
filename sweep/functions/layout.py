"""The layout of a plain function's results: names, types, dimensions with coordinates, units; and how two differ."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sweep.contract import Output, shown, suggest
from sweep.contract.declaration import name_problem

Type = Literal["float", "int", "bool", "text", "datetime"]

DTYPES: dict[Type, str] = {"float": "<f8", "int": "<i8", "bool": "<i8", "datetime": "<M8[ns]", "text": "V16"}
"""How a row holds a value of each type; in place of a text its digest."""

SLOTS: dict[Type, int] = {"float": 1, "int": 1, "bool": 1, "datetime": 1, "text": 2}
"""How many numbers of a row (8 bytes each) hold one value."""

EXACT_INT = 2**53
"""Up to here a float holds every integer exactly."""

MISSING_INT = int(np.iinfo(np.int64).min)
"""Stands for a missing integer where some integer of the array is too large for a float to hold exactly."""


@dataclass(frozen=True)
class Coordinate:
    """The values along a dimension; those of times are nanoseconds since 1970."""

    name: str
    type: Type
    values: tuple[Any, ...]
    unit: str = ""

    def array(self) -> NDArray[Any]:
        """Return the values as a dataset has them."""
        dtypes = {"float": "f8", "int": "i8", "bool": "bool", "datetime": "M8[ns]", "text": "object"}
        return np.array(self.values, dtype=dtypes[self.type])


@dataclass(frozen=True)
class Field:
    """One result of a point."""

    name: str
    type: Type
    dims: tuple[str, ...] = ()
    unit: str = ""
    meaning: str = ""


@dataclass(frozen=True)
class Layout:
    """All results of a point, in their order, with the coordinates of their dimensions."""

    fields: tuple[Field, ...]
    coordinates: tuple[Coordinate, ...] = ()

    @cached_property
    def sizes(self) -> dict[str, int]:
        """The length of each dimension."""
        return {coordinate.name: len(coordinate.values) for coordinate in self.coordinates}

    def shape(self, field: Field) -> tuple[int, ...]:
        """Return the shape of one result."""
        return tuple(self.sizes[dim] for dim in field.dims)

    @cached_property
    def width(self) -> int:
        """Numbers of 8 bytes in a row."""
        return sum(math.prod(self.shape(field)) * SLOTS[field.type] for field in self.fields)

    @cached_property
    def places(self) -> dict[str, slice]:
        """The part of a row that holds each result, in numbers of 8 bytes."""
        ends = accumulate((math.prod(self.shape(field)) * SLOTS[field.type] for field in self.fields), initial=0)
        return {field.name: slice(*ends) for field, ends in zip(self.fields, pairwise(ends), strict=True)}

    def values(self, rows: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
        """Return each result from rows (points, width), of shape (points, *shape); in place of texts their digests."""
        found: dict[str, NDArray[Any]] = {}
        for field in self.fields:
            part = np.ascontiguousarray(rows[:, self.places[field.name]])
            typed = part.view(DTYPES[field.type]).reshape(len(rows), *self.shape(field))
            found[field.name] = typed.astype(bool) if field.type == "bool" else typed
        return found

    def headline(self, declared: Iterable[Output]) -> set[str]:
        """Return the names of headline results: those declared so, else those without dimensions, else all."""
        names = {output.name for output in declared if output.headline}
        names = names or {field.name for field in self.fields if not field.dims}
        return names or {field.name for field in self.fields}


def layout_of_json(document: Mapping[str, Any]) -> Layout:
    """Return the layout that was recorded as a dictionary."""
    fields = tuple(Field(**{**one, "dims": tuple(one["dims"])}) for one in document["fields"])
    coordinates = tuple(Coordinate(**{**one, "values": tuple(one["values"])}) for one in document["coordinates"])
    return Layout(fields, coordinates)


@lru_cache(maxsize=256)
def problems_of_names(layout: Layout, parameters: tuple[str, ...]) -> tuple[str, ...]:
    """Return what is wrong with the names of results, which share one dataset with the parameters."""
    found = []
    names = [field.name for field in layout.fields]
    for kind, name in [("output", n) for n in names] + [("dimension", n) for n in layout.sizes]:
        if wrong := name_problem(name):
            found.append(f"the {kind} {shown(name)}: {wrong}")
        elif name in parameters:
            found.append(f"the {kind} {name!r} has the name of a parameter; take another")
        elif kind == "dimension" and name in names:
            found.append(f"the dimension {name!r} has the name of an output; take another")
    return tuple(found)


@lru_cache(maxsize=256)
def differences(expected: Layout, found: Layout) -> tuple[str, ...]:
    """Return a phrase for each difference between results and those of the first point, none if they fit the layout.

    The order does not matter, and an integer may stand for a float.
    """
    wanted = {field.name: field for field in expected.fields}
    given = {field.name: field for field in found.fields}
    extra = [name for name in given if name not in wanted]
    lost = [name for name in wanted if name not in given]
    phrases = [f"{name!r} is missing{suggest(name, extra) if extra else ''}" for name in lost]
    phrases += [f"{name!r} was not returned by the first point" for name in extra]
    before, after = ({c.name: c for c in layout.coordinates} for layout in (expected, found))
    compared: set[str] = set()
    for name in [name for name in wanted if name in given]:
        phrases += _differences_of_field(wanted[name], given[name])
        if wanted[name].dims == given[name].dims:
            compared.update(wanted[name].dims)
    for dim in sorted(compared):
        phrases += _differences_of_coordinate(before[dim], after[dim])
    return tuple(phrases)


def _differences_of_field(expected: Field, found: Field) -> Iterator[str]:
    name = expected.name
    if expected.type != found.type and (expected.type, found.type) != ("float", "int"):
        hint = "; return it as float(...) at every point" if (expected.type, found.type) == ("int", "float") else ""
        yield f"{name!r} is of type {found.type}, expected {expected.type}{hint}"
    if expected.dims != found.dims:
        yield f"{name!r} has {_dims(found.dims)}, expected {_dims(expected.dims)}"
    if expected.unit != found.unit:
        yield f"{name!r} is in {found.unit or 'no unit'}, expected {expected.unit or 'no unit'}"


def _dims(dims: Sequence[str]) -> str:
    return f"the dimensions ({', '.join(dims)})" if dims else "no dimensions"


def _differences_of_coordinate(expected: Coordinate, found: Coordinate) -> Iterator[str]:
    name = expected.name
    if len(expected.values) != len(found.values):
        yield f"the dimension {name!r} has {len(found.values)} values, expected {len(expected.values)}"
    elif expected.type != found.type:
        yield f"the coordinate {name!r} is of type {found.type}, expected {expected.type}"
    elif expected.unit != found.unit:
        yield f"the coordinate {name!r} is in {found.unit or 'no unit'}, expected {expected.unit or 'no unit'}"
    elif expected.values != found.values:
        pairs = zip(expected.values, found.values, strict=True)
        place = next(i for i, (one, other) in enumerate(pairs) if one != other)
        yield (
            f"the coordinate {name!r} has {shown(found.values[place])} at index {place}, "
            f"expected {shown(expected.values[place])}"
        )


def held(row: bytes, found: Layout, expected: Layout) -> bytes | None:
    """Return a row that has no `differences`, converted to the expected layout; None where an integer is too large to
    be a float.
    """
    if found == expected:
        return row
    numbers = np.frombuffer(row, dtype="<f8")
    types = {field.name: field.type for field in found.fields}
    parts = []
    for field in expected.fields:
        part = numbers[found.places[field.name]]
        if field.type == "float" and types[field.name] == "int":
            whole = part.view("<i8")
            if np.any(np.abs(whole) > EXACT_INT):
                return None
            part = whole.astype("<f8")
        parts.append(part.tobytes())
    return b"".join(parts)
