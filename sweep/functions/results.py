"""Takes what a plain function returned, of whatever type, as the fields of a row with their layout: names, types,
dimensions with coordinates and units; and says how two layouts differ.
"""

import dataclasses
import datetime
import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import NotFiniteError, Outcome, Output, ResultError, shown, suggest
from linksweep.sweep.contract.declaration import name_problem
from linksweep.sweep.contract.reducer import EXACT_INT, beyond_floats, not_finite
from linksweep.sweep.contract.units import is_quantity, same_unit

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
        _check_text(text)
    return array


def _check_text(text: str) -> None:
    """Raise ResultError for a text that no file can hold."""
    try:
        text.encode()
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


@dataclasses.dataclass(frozen=True)
class Declared:
    """What results are checked against: the ``outputs`` that a function declares, the names of its ``parameters``, and
    the name of a ``single`` result.
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
    def layouts(self) -> dict[Any, Layout | None]:
        """The layouts of results of scalars that have occurred, by names and types."""
        return {}


def named_results(result: Any, declared: Declared) -> dict[str, Any]:
    """Return the outputs by name that a function has returned."""
    if result is None:
        raise ResultError(f"{declared.function} returns nothing (None); it must return its results")
    if hasattr(result, "to_xarray") and not isinstance(result, type):  # of pandas
        result = result.to_xarray()
    if isinstance(result, Mapping) and not is_xarray(result):
        named = dict(result)
    elif dataclasses.is_dataclass(result) and not isinstance(result, type):
        named = {field.name: getattr(result, field.name) for field in dataclasses.fields(result)}
    elif hasattr(result, "_asdict"):
        named = dict(result._asdict())
    elif is_xarray(result):
        own = dict(result.data_vars) if hasattr(result, "data_vars") else {result.name or declared.single: result}
        named = own | _beside_dimensions(result, declared)
    elif isinstance(result, tuple) and len(declared.outputs) > 1:
        named = _in_order(result, declared)
    else:
        return {declared.single: result}
    if not named:
        raise ResultError(f"{declared.function} returns no results: an empty {type(result).__name__}")
    if strange := [name for name in named if not isinstance(name, str)]:
        raise ResultError(f"{declared.function}: the name {shown(strange[0])} of an output is no text")
    return named


def _in_order(result: tuple[Any, ...], declared: Declared) -> dict[str, Any]:
    """Return the values of a tuple by the names of the declared outputs, in their order."""
    names = [output.name for output in declared.outputs]
    if len(result) != len(names):
        expected = f"one for each declared output: {', '.join(names)}"
        raise ResultError(f"{declared.function} returns a tuple of {len(result)} values, expected {expected}")
    return dict(zip(names, result, strict=True))


def _beside_dimensions(result: Any, declared: Declared) -> dict[str, Any]:
    """Return the non-dimension coordinates: they are results too, unless they repeat a parameter."""
    return {
        str(name): array.reset_coords(drop=True)
        for name, array in result.coords.items()
        if name not in result.dims and name not in declared.parameters
    }


def flatten(result: Any, declared: Declared) -> Outcome:
    """Return the result of one point as the fields of a row, with their layout.

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
    row = tuple(value.array if value.array.ndim else value.array[()] for value in values.values())
    return Outcome(row, None, layout)


def split_points(result: Any, n: int, declared: Declared, noun: str) -> list[Outcome]:
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
    elements = (_elements(columns[field.name]) for field in layout.fields)
    return [Outcome(row, None, layout) for row in zip(*elements, strict=True)]


def _elements(column: NDArray[Any]) -> list[Any]:
    """Return the values along the first axis: scalars as those of Python, whose pickles are small."""
    return column.tolist() if column.ndim == 1 and column.dtype.kind != "M" else list(column)


FAST: dict[type, Type] = {
    float: "float",
    np.float64: "float",
    int: "int",
    np.int64: "int",
    bool: "bool",
    np.bool_: "bool",
    str: "text",
}
"""Types of scalars whose layout is known without looking at them."""


def _scalars(result: dict[Any, Any], declared: Declared) -> Outcome | None:
    """Return the row of plain scalars, the quick way; None if anything else is among them."""
    key = tuple(zip(result, map(type, result.values()), strict=True))
    if key not in declared.layouts:
        declared.layouts[key] = _scalar_layout(key, declared)
    if (layout := declared.layouts[key]) is None:
        return None
    row = tuple(result.values())
    for value, field in zip(row, layout.fields, strict=True):
        if field.type == "float":
            if not math.isfinite(value):
                return None
        elif field.type == "int":
            if not -(2**63) <= value < 2**63:
                return None
        elif field.type == "text":
            try:
                value.encode()
            except UnicodeEncodeError:
                return None
    return Outcome(row, None, layout)


def _scalar_layout(types: tuple[tuple[Any, type], ...], declared: Declared) -> Layout | None:
    names = [name for name, _ in types]
    if not types or not all(type(name) is str for name in names) or not all(kind in FAST for _, kind in types):
        return None
    if not declared.by_name.keys() <= set(names):
        return None
    outputs = [declared.by_name.get(name, Output(name)) for name in names]
    kinds = [FAST[kind] for _, kind in types]
    layout = Layout(tuple(Field(o.name, kind, (), o.unit, o.meaning) for o, kind in zip(outputs, kinds, strict=True)))
    return None if problems_of_names(layout, declared.parameters) else layout


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
