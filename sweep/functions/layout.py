"""What a plain function returns: the layout of its results (names, types, dimensions with coordinates, units), how two
differ, and the outputs that are declared of them.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Outcome, Output, ResultError, shown, suggest
from linksweep.sweep.contract.declaration import name_problem
from linksweep.sweep.contract.reducer import beyond_floats

Type = Literal["float", "int", "bool", "text", "datetime"]

DTYPES: dict[Type, str] = {"float": "<f8", "int": "<i8", "bool": "?", "datetime": "<M8[ns]", "text": "O"}
"""How a row holds a value of each type."""

NUMBERS: frozenset[Type] = frozenset({"float", "int"})
"""Types that are joined: the results of all points are floats where one of them is."""


@dataclass(frozen=True)
class Coordinate:
    """The values along a dimension; those of times are nanoseconds since 1970."""

    name: str
    type: Type
    values: tuple[Any, ...]
    unit: str = ""

    def array(self) -> NDArray[Any]:
        """Return the values as a dataset has them."""
        return np.array(self.values, dtype=DTYPES[self.type])


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
    def dtype(self) -> np.dtype[np.void]:
        """The type of a row: each result as itself."""
        return np.dtype([(field.name, DTYPES[field.type], self.shape(field)) for field in self.fields])

    @cached_property
    def floats(self) -> "Layout":
        """The same results, all numbers floats."""
        return self.widened(["int"])

    def widened(self, types: Sequence[Type], names: Iterable[str] | None = None) -> "Layout":
        """Return the layout in which results of these types, all or those with these ``names``, are floats."""
        known = {field.name for field in self.fields} if names is None else set(names)
        change = [field.type in types and field.name in known for field in self.fields]
        fields = [replace(f, type="float") if now else f for f, now in zip(self.fields, change, strict=True)]
        return replace(self, fields=tuple(fields)) if any(change) else self

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


@lru_cache(maxsize=256)
def joined(one: Layout, other: Layout) -> Layout:
    """Return the layout of results of both, between which there are no `differences`: floats where one has floats."""
    return one.widened(["int"], [field.name for field in other.fields if field.type == "float"])


def as_row(outcome: Outcome, expected: Layout) -> Any:
    """Return the fields of a result that has no `differences` in the order, and with the floats, of a layout.

    Raises ResultError where an integer is too large to be a float.
    """
    found: Layout = outcome.layout
    if found is expected or found == expected:
        return outcome.row
    values = {field.name: (field.type, value) for field, value in zip(found.fields, outcome.row, strict=True)}
    row = []
    for field in expected.fields:
        kind, value = values[field.name]
        if field.type == "float" and kind == "int" and (large := beyond_floats(value)) is not None:
            raise ResultError(f"{field.name!r} is {large}, which is beyond 2**53, and other points have floats")
        row.append(value)
    return tuple(row)


def same_value(one: Any, other: Any) -> bool:
    """Return whether two results are the same; NaN is NaN."""
    first, second = np.asarray(one), np.asarray(other)
    return np.array_equal(first, second, equal_nan=first.dtype.kind in "fM" and second.dtype.kind in "fM")
