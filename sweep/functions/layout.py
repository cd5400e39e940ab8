"""The layout of a plain function's results: names, types, dimensions with coordinates, units; and how two differ."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Output, shown, suggest
from linksweep.sweep.contract.declaration import name_problem

Type = Literal["float", "int", "bool", "text", "datetime"]

DTYPES: dict[Type, str] = {"float": "<f8", "int": "<i8", "bool": "<i8", "datetime": "<M8[ns]", "text": "V16"}
"""How a row holds a value of each type; in place of a text its digest."""

NUMBERS: frozenset[Type] = frozenset({"float", "int"})
"""Types that are joined: the results of all points are floats where one of them is."""

SLOTS: dict[Type, int] = {"float": 1, "int": 1, "bool": 1, "datetime": 1, "text": 2}
"""How many numbers of a row (8 bytes each) hold one value."""

EXACT_INT = 2**53
"""Up to here a float holds every integer exactly."""

TAGGED = 52
"""How many results one number at the head of a row can tell the type of: a bit for each, and one for itself."""

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
    """All results of a point, in their order, with the coordinates of their dimensions.

    Whether a number is an integer is known of each row by itself, not by the layout: `with_head`.
    """

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

    @cached_property
    def numbers(self) -> tuple[Field, ...]:
        """The results that are floats or integers."""
        return tuple(field for field in self.fields if field.type in NUMBERS)

    @cached_property
    def head(self) -> int:
        """How many numbers precede the results in a row (`with_head`)."""
        return max(1, math.ceil(len(self.numbers) / TAGGED))

    @cached_property
    def floats(self) -> "Layout":
        """The same results, all numbers floats."""
        fields = (replace(field, type="float") if field.type == "int" else field for field in self.fields)
        return replace(self, fields=tuple(fields))

    def joined(self, rows: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
        """Return each result from rows with heads, as `values`: integers where they are in all rows, else floats."""
        found = self.values(rows[:, self.head :])
        for field, whole in self._integers(rows[:, : self.head]):
            integers = found[field.name].view("<i8")
            found[field.name] = integers if whole.all() else integers.view("<f8").copy()
            if not whole.all():
                found[field.name][whole] = integers[whole]
        return found

    def not_joined(self, rows: NDArray[np.float64], some: NDArray[np.intp]) -> dict[int, str]:
        """Return which of ``some`` rows have an integer that no float can hold where another of them has a float, and
        why that is wrong.
        """
        found: dict[int, str] = {}
        for field, whole in self._integers(rows[some, : self.head]):
            if whole.any() and not whole.all():
                place = self.places[field.name]
                part = rows[some[whole], self.head + place.start : self.head + place.stop]
                integers = np.ascontiguousarray(part).view("<i8")
                large = _beyond_floats(integers)
                for row, values, wrong in zip(some[whole].tolist(), integers, large, strict=True):
                    if wrong.any():
                        number = int(values[wrong][0])
                        found[row] = f"{field.name!r} is {number}, which is beyond 2**53, and other points have floats"
        return found

    def _integers(self, heads: NDArray[np.float64]) -> Iterator[tuple[Field, NDArray[np.bool_]]]:
        """Yield each result that is a number, and which rows have integers of it, from the heads of the rows."""
        tags = heads.astype(np.int64) - 1
        for number, field in enumerate(self.numbers):
            other = (tags[:, number // TAGGED] >> (number % TAGGED)) & 1
            yield field, other.astype(bool) ^ (field.type == "int")

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

    The order does not matter, and integers and floats are joined.
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
    types = {expected.type, found.type}
    if len(types) > 1 and not types <= NUMBERS:
        hint = "; return the number float(...) at every point" if types <= NUMBERS | {"bool"} else ""
        wanted = "a number" if expected.type in NUMBERS else expected.type
        yield f"{name!r} is of type {found.type}, expected {wanted}{hint}"
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


def with_head(row: bytes, found: Layout, expected: Layout) -> bytes:
    """Return a row that has no `differences` in the order of the expected layout, after numbers that say where it has
    integers in place of floats, or the reverse: 1 if nowhere.
    """
    if found == expected:
        return expected.head * _ONE + row
    return _head(found, expected) + b"".join(_parts(row, found, expected))


_ONE = np.float64(1.0).tobytes()


@lru_cache(maxsize=256)
def _head(found: Layout, expected: Layout) -> bytes:
    types = {field.name: field.type for field in found.fields}
    tags = expected.head * [1]
    for number, field in enumerate(expected.numbers):
        if types[field.name] != field.type:
            tags[number // TAGGED] += 1 << (number % TAGGED)
    return np.array(tags, dtype="<f8").tobytes()


def as_floats(row: bytes, found: Layout, expected: Layout) -> bytes | None:
    """Return a row that has no `differences` in the order of the expected layout, which has no integers; None where an
    integer is too large to be a float.
    """
    types = {field.name: field.type for field in found.fields}
    parts = list(_parts(row, found, expected))
    for number, field in enumerate(expected.fields):
        if types[field.name] == "int":
            whole = np.frombuffer(parts[number], dtype="<i8")
            if np.any(_beyond_floats(whole)):
                return None
            parts[number] = whole.astype("<f8").tobytes()
    return b"".join(parts)


def _beyond_floats(whole: NDArray[np.int64]) -> NDArray[np.bool_]:
    return (whole > EXACT_INT) | (whole < -EXACT_INT)


def _parts(row: bytes, found: Layout, expected: Layout) -> Iterator[bytes]:
    """Yield what a row has of each result, in the order of the expected layout."""
    places = [found.places[field.name] for field in expected.fields]
    yield from (row[8 * place.start : 8 * place.stop] for place in places)
