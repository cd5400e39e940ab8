"""Takes what a plain function returned, of whatever type, as the fields of a row with their layout: names, types,
dimensions with coordinates and units; and says how two layouts differ.
"""

import datetime
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import NotFiniteError, Outcome, Output, ResultError, check_finite, shown, suggest
from linksweep.sweep.contract.experiment import names_problems, same_unit
from linksweep.sweep.contract.rows import LENGTH, REFERENCE, beyond_floats, chunk_grid, is_large, padded

Type = Literal["float", "int", "bool", "text", "datetime"]

# How a row holds a value of each type.
DTYPES: dict[Type, str] = {"float": "<f8", "int": "<i8", "bool": "?", "datetime": "<M8[ns]", "text": "O"}

# Types that are joined: the results of all points are floats where one of them is.
NUMBERS: frozenset[Type] = frozenset({"float", "int"})

ALLOWED = "results are numbers (durations: seconds), strings, truth values, dates, arrays of these, or xarray objects"


@dataclass(frozen=True)
class Coordinate:
    """The values along a dimension, or how many there are of 0, 1, 2 ...; those of times are nanoseconds since 1970.  A
    ``ragged`` one has numbers, at least as many as there are values at any point.
    """

    name: str
    type: Type
    values: tuple[Any, ...] | int
    unit: str = ""
    ragged: bool = False
    meaning: str = ""

    def __post_init__(self) -> None:
        """Keep only the count where a million numbers say no more."""
        if self.type == "int" and isinstance(self.values, tuple) and self.values == tuple(range(len(self.values))):
            object.__setattr__(self, "values", len(self.values))

    @property
    def labels(self) -> Sequence[Any]:
        """All values."""
        return range(self.values) if isinstance(self.values, int) else self.values


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
    """All results of a point, or of a realisation if they are ``drawn``, in their order, with the coordinates of their
    dimensions.
    """

    fields: tuple[Field, ...] = ()
    coordinates: tuple[Coordinate, ...] = ()
    drawn: bool = False

    @cached_property
    def sizes(self) -> dict[str, int]:
        """The length of each dimension."""
        return {coordinate.name: len(coordinate.labels) for coordinate in self.coordinates}

    def shape(self, field: Field) -> tuple[int, ...]:
        """Return the shape of one result."""
        return tuple(self.sizes[dim] for dim in field.dims)

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """The type of a row: each result as itself, or the references to its chunks."""
        shapes = [(field, self.shape(field)) for field in self.fields]
        chunks = {field.name: (REFERENCE, math.prod(chunk_grid(s))) for field, s in shapes if field.name in self.large}
        return np.dtype([(field.name, *chunks.get(field.name, (DTYPES[field.type], s))) for field, s in shapes])

    @cached_property
    def large(self) -> dict[str, np.dtype[Any]]:
        """The types of results that are large arrays of numbers, as long at every point: rows refer to their chunks."""
        whole = () if self.drawn else self.fields  # moments of realisations are in rows
        some = (field for field in whole if field.type in NUMBERS and field.name not in self.ragged)
        return {field.name: np.dtype(DTYPES[field.type]) for field in some if is_large(self.shape(field))}

    @cached_property
    def ragged(self) -> dict[str, str]:
        """The ragged dimension of each result that has one."""
        ragged = {coordinate.name for coordinate in self.coordinates if coordinate.ragged}
        return {field.name: dim for field in self.fields for dim in field.dims if dim in ragged}

    def with_floats(self, names: Iterable[str]) -> "Layout":
        """Return the layout in which the integers with these names are floats."""
        change = {field.name for field in self.fields if field.type == "int"} & set(names)
        fields = tuple(replace(one, type="float") if one.name in change else one for one in self.fields)
        return replace(self, fields=fields) if change else self

    def headline(self, declared: Iterable[Output]) -> set[str]:
        """Return the names of headline results: those declared so, else those without dimensions, else all."""
        names = {output.name for output in declared if output.headline}
        names = names or {field.name for field in self.fields if not field.dims}
        return names or {field.name for field in self.fields}


# The layout before the first result.
UNKNOWN = Layout()


def json_of_layout(layout: Layout) -> dict[str, Any]:
    """Return a layout as a dictionary, quickly for many values."""
    parts = {"fields": [*map(vars, layout.fields)], "coordinates": [*map(vars, layout.coordinates)]}
    return {**parts, "drawn": layout.drawn}


def layout_of_json(document: Mapping[str, Any]) -> Layout:
    """Return the layout that was recorded as a dictionary; raises ValueError for one that is no layout."""
    from pydantic import TypeAdapter  # here: workers, which read no records, need not import it

    layout: Layout = TypeAdapter(Layout).validate_python(document)
    if strange := [dim for field in layout.fields for dim in field.dims if dim not in layout.sizes]:
        raise ValueError(f"the dimension {shown(strange[0])} has no coordinate")
    return layout


@lru_cache(maxsize=256)
def problems_of_names(layout: Layout, parameters: tuple[str, ...]) -> tuple[str, ...]:
    """Return what is wrong with the names of results, which share one dataset with the parameters."""
    names = [*(("output", field.name) for field in layout.fields), *(("dimension", name) for name in layout.sizes)]
    return tuple(names_problems(parameters, names))


@lru_cache(maxsize=256)  # workers send equal layouts again and again, each time as a new object
def layout_differences(expected: Layout, other: Layout) -> tuple[str, ...]:
    """Return a phrase for each difference between results and those of the first point, none if they fit the layout.

    The order does not matter, and integers and floats are joined.
    """
    wanted, names = ([field.name for field in layout.fields] for layout in (expected, other))
    extra = [name for name in names if name not in wanted]
    phrases = [f"{name!r} is missing{suggest(name, extra)}" for name in wanted if name not in names]
    phrases += [f"{name!r} was not returned by the first point" for name in extra]
    common = {*expected.coordinates} & {*other.coordinates}
    before, now = _facts(expected, common), _facts(other, common)
    phrases += [
        f"{what} is {shown(now[what])}, expected {shown(value)}"
        for what, value in before.items()
        if what in now and now[what] != value
    ]
    return tuple(phrases[:5])


def layout_refusals(expected: Layout, other: Layout) -> tuple[str, ...]:
    """Return the differences for which results are refused beside others: of realisations their order, too, since
    samples are kept without their names.
    """
    wrong = layout_differences(expected, other)
    orders = [[field.name for field in layout.fields] for layout in (expected, other)]
    is_other = expected.drawn and not wrong and orders[0] != orders[1]
    return ("its results are in another order",) if is_other else wrong


def _facts(layout: Layout, common: Set[Coordinate]) -> dict[str, Any]:
    facts: dict[str, Any] = {}
    for field in layout.fields:
        kind = "number" if field.type in NUMBERS and field.name not in layout.large else field.type
        qualities = {"dims": field.dims, "type": kind, "unit": field.unit}
        facts |= {f"the {quality} of {field.name!r}": value for quality, value in qualities.items()}
    for one in (coordinate for coordinate in layout.coordinates if not coordinate.ragged and coordinate not in common):
        facts |= {f"the length of {one.name!r}": len(one.labels), f"the unit of the coordinate {one.name!r}": one.unit}
        facts[f"the type of the coordinate {one.name!r}"] = one.type
        facts |= {f"value {i} of the coordinate {one.name!r}": value for i, value in enumerate(one.labels)}
    return facts


@lru_cache(maxsize=256)
def joined(one: Layout, other: Layout) -> Layout:
    """Return the layout of results of both, between which there are no `differences`: floats where one has floats, and
    the longer of ragged dimensions.
    """
    layout = one.with_floats(field.name for field in other.fields if field.type == "float")
    theirs = {coordinate.name: coordinate for coordinate in other.coordinates}
    longer = (max(mine, theirs[mine.name], key=lambda c: len(c.labels)) for mine in one.coordinates)
    return replace(layout, coordinates=tuple(longer))


def as_row(outcome: Outcome, expected: Layout, function: str) -> Any:
    """Return the fields of a result that has no `differences` in the order, with the floats and the lengths, of a
    layout.

    Raises ResultError, with the name of the function, where an integer is too large to be a float.
    """
    layout: Layout = outcome.layout
    if layout == expected and not layout.ragged:
        return outcome.row
    values = {field.name: (field.type, value) for field, value in zip(layout.fields, outcome.row, strict=True)}
    for field in expected.fields:
        kind, value = values[field.name]
        if field.type == "float" and kind == "int" and (large := beyond_floats(value)) is not None:
            raise ResultError(f"{function}: {field.name!r} is {large}, which is beyond 2**53, and is to be a float")
    return tuple(
        padded(values[field.name][1], expected.shape(field)) if field.name in expected.ragged else values[field.name][1]
        for field in expected.fields
    )


def same_value(one: Any, other: Any) -> bool:
    """Return whether two results are the same; NaN is NaN."""
    first, second = np.asarray(one), np.asarray(other)
    return np.array_equal(first, second, equal_nan=first.dtype.kind in "fM" and second.dtype.kind in "fM")


class Value(NamedTuple):
    """One output: type, values, dimensions, the coordinates that come with it, unit, meaning, its ragged dimension."""

    type: Type
    array: NDArray[Any]
    dims: tuple[str, ...] | None = None
    coordinates: tuple[Coordinate, ...] = ()
    unit: str = ""
    meaning: str = ""
    ragged: str = ""


def coordinate_of(dim: str, values: Any) -> Coordinate:
    """Return a coordinate from values, or from (values, unit); raises ResultError where they cannot be one."""
    unit = ""
    # (values, unit) and not two values: the second one is a text, and the first has several
    if isinstance(values, tuple) and len(values) == 2 and isinstance(values[1], str) and np.ndim(values[0]) == 1:
        values, unit = values
    try:
        value = value_of(values)
        if value.array.ndim != 1:
            raise ResultError(f"has the shape {value.array.shape}, expected one dimension")
        if value.type in ("float", "datetime") and not np.isfinite(value.array).all():
            raise ResultError("has values that are not finite")
        if unit and value.unit and not same_unit(unit, value.unit):
            raise ResultError(f"is in {value.unit}, expected {unit}")
    except ResultError as error:
        raise ResultError(f"has a coordinate {dim!r} that {error}") from error
    is_time = value.type == "datetime"
    numbers = value.array.view("i8") if is_time else value.array
    unit = "" if is_time else unit or value.unit
    return Coordinate(dim, value.type, tuple(numbers.tolist()), unit, meaning=value.meaning)


def is_xarray(value: object) -> bool:
    """Return whether a value is an xarray object, without importing xarray."""
    xarray = sys.modules.get("xarray")  # while another thread imports it, it has no classes yet, and nobody has a value
    return isinstance(value, tuple(getattr(xarray, name, ()) for name in ("DataArray", "Dataset", "Variable")))


def unit_of(value: Any) -> str:
    """Return the unit that a value has: a column, a quantity of astropy, pint or unyt, or in xarray; '' for none."""
    stated, data = (value.attrs.get("units"), getattr(value, "data", None)) if is_xarray(value) else (None, value)
    unit = getattr(data, "unit", None)
    unit = unit if hasattr(unit, "is_equivalent") else getattr(data, "units", "")  # times of pandas have texts
    return str(stated or unit).replace("dimensionless", "")


LONE_SURROGATE = re.compile("[\ud800-\udfff]")

IN_UTC = (
    "results are in UTC without one: .astimezone(timezone.utc).replace(tzinfo=None), or .tz_convert(None) in pandas"
)


def value_of(value: Any) -> Value:
    """Return a value of any allowed type; raises ResultError that says why another one is not allowed."""
    if hasattr(value, "to_xarray") and not isinstance(value, type):
        value = value.to_xarray()
    if isinstance(value, Mapping):  # a Dataset of xarray too
        raise ResultError(f"is a {type(value).__name__}; results are not nested: return its entries by their names")
    dims, coordinates, unit, meaning = None, tuple[Coordinate, ...](), unit_of(value), ""
    if "since" in unit:  # a word by which readers of CF take any numbers for dates, or refuse the whole file
        raise ResultError(f"has the unit {shown(unit)}: return times, or numbers with a unit such as 'd'")
    if is_xarray(value):
        dims = tuple(map(str, value.dims))
        if len(set(dims)) < len(dims):
            raise ResultError(f"has the dimensions ({', '.join(dims)}), one of them twice")
        known = getattr(value, "coords", {})
        along = [(dim, known[dim]) for dim in dims if dim in known]
        for dim, one in along:  # whose values would be those in UTC, without a word
            if (zone := getattr(one.to_index(), "tz", None)) is not None:
                raise ResultError(f"has a coordinate {dim!r} of times with the zone {zone}; {IN_UTC}")
        coordinates = tuple(coordinate_of(dim, one.variable) for dim, one in along)
        meaning, value = str(value.attrs.get("long_name", "")), value.values
    elif isinstance(value, np.ma.MaskedArray) or hasattr(value, "unmasked"):  # of NumPy or astropy
        if n := int(np.sum(value.mask)):
            raise ResultError(f"has {n} masked values; fill them, with NaN where the output declares nan=True")
        value = value.unmasked if hasattr(value, "unmasked") else value.data
    return Value(*_typed(value), dims, coordinates, unit, meaning)


def _typed(value: Any) -> tuple[Type, NDArray[Any]]:
    """Return the type of a value that is no xarray object, and its array; raises ResultError as `value_of`."""
    if isinstance(value, list | tuple):
        kinds = {kind for kind in set(map(type, value)) if {"unit", "units", "attrs"} & {*dir(kind)}}
        if kinds and any(unit_of(one) for one in value if type(one) in kinds):
            raise ResultError("is a list of quantities; make one of them: astropy.units.Quantity(...)")
        try:
            array = np.asarray(value)
            # By itself NumPy makes texts of numbers beside texts, and floats of integers that no float holds.
            array = array if array.dtype.kind in "mM" else np.array(value, dtype=object)
        except (ValueError, OverflowError) as error:
            raise ResultError("has parts of different lengths, or integers beyond 64 bits") from error
    else:
        is_array = hasattr(value, "__array__") and not isinstance(value, str)  # NumPy's texts lose a zero at their end
        array = np.asarray(value) if is_array else np.array(None, dtype=object)
        if not is_array:
            array[()] = value
    code = array.dtype.kind
    if code in "OUT" or (code == "u" and array.max(initial=0) >= 2**63):
        return _of_objects(array.astype(object), "int" if code == "O" else "text")
    if code == "M":
        return "datetime", _times(array)
    if code in CODES and array.dtype.itemsize <= 8:
        return CODES[code], array.astype(DTYPES[CODES[code]])
    raise ResultError(f"is of type {array.dtype}; {ALLOWED}")


# The types of arrays by the codes of NumPy's kinds.
CODES: dict[str, Type] = {"b": "bool", "i": "int", "u": "int", "f": "float"}

# The classes of single values of each type.
CLASSES: dict[Type, tuple[type, ...]] = {
    "bool": (bool, np.bool_),  # before integers: Python's truth values are some
    "int": (int, np.integer),
    "float": (float, np.float32, np.float16),
    "text": (str,),
    "datetime": (datetime.date,),
}


def _of_objects(array: NDArray[Any], empty: Type) -> tuple[Type, NDArray[Any]]:
    """Return the type of an array of Python's objects, ``empty`` if it has none, and its array; raises ResultError as
    `value_of`.
    """
    elements = array.reshape(-1).tolist()
    kinds = {
        kind: next((t for t in CLASSES if issubclass(kind, CLASSES[t])), None) for kind in set(map(type, elements))
    }
    types = set(kinds.values()) or {empty}
    if None in types or (len(types) > 1 and types != NUMBERS):
        raise ResultError(f"is of type {', '.join(sorted(kind.__name__ for kind in kinds))}; {ALLOWED}")
    if "int" in types:
        whole = [int(e) for e in elements if kinds[type(e)] == "int"]
        if large := [n for n in whole if not -(2**63) <= n < 2**63]:
            raise ResultError(f"is {shown(large[0])}; integers are below 2**63 in size")
        if len(types) > 1 and (beyond := beyond_floats(whole)) is not None:
            raise ResultError(f"has {beyond}, an integer beyond 2**53, beside floats, which cannot hold it")
    kind: Any = "float" if len(types) > 1 else types.pop()
    if kind == "text":
        texts = [str.__str__(element) for element in elements]  # members of an enumeration have another str()
        if strange := [text for text in texts if LONE_SURROGATE.search(text)]:
            raise ResultError(f"is {strange[0]!a}, which has a lone surrogate: no file can hold it")
        return "text", np.array(texts, dtype=object).reshape(array.shape)
    if kind == "datetime":
        return "datetime", np.array([_time(element) for element in elements], dtype="M8[ns]").reshape(array.shape)
    return kind, array.astype(DTYPES[kind])


def _time(value: datetime.date) -> Any:
    if (zone := getattr(value, "tzinfo", None)) is not None:
        raise ResultError(f"is a time with the zone {zone}; {IN_UTC}")
    exact = value.to_datetime64() if hasattr(value, "to_datetime64") else np.datetime64(value)  # pandas: nanoseconds
    return _times(np.array(exact))[()]


def _times(array: NDArray[Any]) -> NDArray[Any]:
    """Return times in nanoseconds; raises ResultError for times that 64 bits cannot hold."""
    try:
        fine = array.astype("M8[ns]")
        exact = np.array_equal(fine.astype(array.dtype), array, equal_nan=True)
    except OverflowError:  # older NumPy wraps around instead
        exact = False
    if not exact:
        raise ResultError("has times beyond the years 1678 to 2261 or finer than nanoseconds, the unit of times")
    return fine


@dataclass(frozen=True)
class Declared:
    """What results are checked against: the ``outputs`` that a function declares, the names of its ``parameters``, and
    the name of a ``single`` result; and whether they are ``drawn``.
    """

    function: str
    single: str
    outputs: tuple[Output, ...] = ()
    parameters: tuple[str, ...] = ()
    drawn: bool = False

    @cached_property
    def by_name(self) -> dict[str, Output]:
        """The outputs by name."""
        return {output.name: output for output in self.outputs}

    @cached_property
    def coordinates(self) -> dict[str, Coordinate]:
        """The coordinates that outputs declare, by dimension."""
        pairs = [(dim, values) for output in self.outputs for dim, values in (output.coords or {}).items()]
        return {dim: coordinate_of(dim, values) for dim, values in pairs}

    @cached_property
    def layouts(self) -> dict[Any, Layout]:
        """The layouts of results of scalars that have occurred, by names and types."""
        return {}

    def named(self, result: Any) -> dict[str, Any]:
        """Return the outputs by name that the function has returned."""
        if result is None:
            raise ResultError(f"{self.function} returns nothing (None); it must return its results")
        if hasattr(result, "to_xarray") and not isinstance(result, type):  # of pandas
            result = result.to_xarray()
        named: dict[Any, Any]
        if is_xarray(result):
            coords = getattr(result, "coords", None)  # a bare Variable has none, and no name
            name = self.single if coords is None else getattr(result, "name", None) or self.single
            named = dict(result.data_vars) if hasattr(result, "data_vars") else {name: result}
            beside = {str(n): one.reset_coords(drop=True) for n, one in (coords or {}).items() if n not in result.dims}
            # They are results too, but for the one value that a selection by a parameter leaves.
            named |= {n: one for n, one in beside.items() if one.ndim or n not in self.parameters}
        elif isinstance(result, Mapping):
            named = dict(result)
        elif is_dataclass(result) and not isinstance(result, type):
            named = {field.name: getattr(result, field.name) for field in fields(result)}
        elif hasattr(result, "_asdict"):
            named = result._asdict()
        elif isinstance(result, tuple) and len(self.outputs) > 1:
            if len(result) != len(self.outputs):
                expected = f"one for each declared output: {', '.join(self.by_name)}"
                raise ResultError(f"{self.function} returns a tuple of {len(result)} values, expected {expected}")
            named = dict(zip(self.by_name, result, strict=True))
        else:
            named = {self.single: result}
        if not named:
            raise ResultError(f"{self.function} returns no results: an empty {type(result).__name__}")
        if strange := [name for name in named if not isinstance(name, str)]:
            raise ResultError(f"{self.function}: the name {shown(strange[0])} of an output is no text")
        return named


# Types of results whose layout depends on nothing else.
SCALARS = frozenset({float, np.float64, int, np.int64, bool, np.bool_, str})


def _is_plain(scalar: Any) -> bool:
    """Return whether a row takes a scalar as it is, without a closer look."""
    if isinstance(scalar, int):
        return -(2**63) <= scalar < 2**63
    return scalar.isascii() if isinstance(scalar, str) else not isinstance(scalar, float) or math.isfinite(scalar)


def flatten(result: Any, declared: Declared) -> Outcome:
    """Return the result of one point as the fields of a row, with their layout.

    Raises ResultError that names every output that is invalid or not as declared, and NotFiniteError.
    """
    scalars = result if type(result) is dict else {declared.single: result}
    key = tuple(zip(scalars, map(type, scalars.values()), strict=True))
    # Names and types of scalars that have occurred take two microseconds, the way below sixty: points are millions.
    if (layout := declared.layouts.get(key)) is not None and all(map(_is_plain, scalars.values())):
        return Outcome(tuple(scalars.values()), None, layout)
    row, layout = _read(result, declared)
    if wrong := _not_finite(row, layout, declared):
        raise wrong
    if SCALARS.issuperset(kind for _, kind in key):
        declared.layouts[key] = layout
    return Outcome(tuple(array[()] for array in row), None, layout)


def split_points(result: Any, n: int, declared: Declared, noun: str) -> list[Outcome]:
    """Return the result of each of n points or realisations (``noun``) from arrays whose first axis counts them.

    Of several points, those whose results are not finite have a NotFiniteError in place of a row.  Raises ResultError
    as `flatten`, and for arrays of another length.
    """
    each = f"expected an array, one for each of {n} {noun}"

    def column(value: Value) -> Value:
        if value.dims is not None:
            raise ResultError(f"is an xarray object, {each}")
        if value.array.ndim == 0 and value.type in {*NUMBERS, "bool"}:  # perhaps a sum, a mean or `any`
            raise ResultError(f"is one value, {each}")
        array = np.broadcast_to(value.array, (n,)) if value.array.ndim == 0 else value.array
        if len(array) != n:
            raise ResultError(f"has {len(array)} values, {each}")
        return value._replace(array=array)

    columns, layout = _read(result, declared, column)
    # scalars as those of Python, whose pickles are small
    elements = [c.tolist() if c.ndim == 1 and c.dtype.kind != "M" else list(c) for c in columns]
    rows: list[Any] = [*zip(*elements, strict=True)]
    if wrong := _not_finite(columns, layout, declared):
        if n == 1 or declared.drawn:
            raise wrong
        rows = [_not_finite([c[k] for c in columns], layout, declared) or row for k, row in enumerate(rows)]
    return [Outcome(row, None, layout) for row in rows]


def _read(
    result: Any, declared: Declared, column: Callable[[Value], Value] | None = None
) -> tuple[list[NDArray[Any]], Layout]:
    """Return the arrays of a result, and its layout; with ``column``, which checks them, that of their elements."""
    named = declared.named(result)
    problems = [
        f"does not return the output {name!r}{suggest(name, [n for n in named if n not in declared.by_name])}"
        for name in declared.by_name
        if name not in named
    ]
    arrays, values = list[NDArray[Any]](), dict[str, Value]()
    for name, raw in named.items():
        try:
            value = value_of(raw)
            if column is not None:
                value = column(value)
                arrays.append(value.array)
                value = value._replace(array=np.asarray(value.array[0]))  # all have the layout of the first
            values[name] = _as_declared(name, value, declared)
        except ResultError as error:
            problems.append(f"{name!r} {error}")
    if not problems:
        coordinates, problems = _coordinates(values, declared)
        problems += _add_lengths(values, coordinates)
    if problems:
        raise ResultError(f"{declared.function}: {'; '.join(problems)}")
    fields = tuple(Field(name, one.type, one.dims or (), one.unit, one.meaning) for name, one in values.items())
    used = dict.fromkeys(dim for field in fields for dim in field.dims)
    layout = Layout(fields, tuple(coordinates[dim] for dim in used), declared.drawn)
    if wrong := problems_of_names(layout, declared.parameters):
        raise ResultError(f"{declared.function}: {'; '.join(wrong)}")
    return arrays or [value.array for value in values.values()], layout


def _as_declared(name: str, value: Value, declared: Declared) -> Value:
    """Return a value with dimensions, and with what is declared of its output; raises ResultError where they differ."""
    output = declared.by_name.get(name, Output(name))
    dims, shape = tuple(output.dims), value.array.shape
    if dims and value.dims is not None and set(value.dims) == set(dims):
        value = value._replace(array=value.array.transpose([value.dims.index(dim) for dim in dims]), dims=dims)
    if dims and (len(dims) != len(shape) if value.dims is None else value.dims != dims):
        what = f"shape {shape}" if value.dims is None else f"dimensions ({', '.join(value.dims)})"
        raise ResultError(f"has the {what}, expected the dimensions ({', '.join(dims)})")
    if output.unit and value.unit and not same_unit(output.unit, value.unit):
        raise ResultError(f"is in {value.unit}, expected {output.unit}")
    dims = value.dims or dims or tuple(f"{name}_dim_{k}" for k in range(len(shape)))
    ragged = dims[0] if output.ragged is True and len(dims) == 1 else output.ragged
    if ragged and ragged not in dims:
        raise ResultError(f"has the dimensions ({', '.join(dims)}): declare which of them is ragged, not {ragged!r}")
    return value._replace(
        dims=dims, unit=output.unit or value.unit, meaning=output.meaning or value.meaning, ragged=str(ragged or "")
    )


def _coordinates(values: Mapping[str, Value], declared: Declared) -> tuple[dict[str, Coordinate], list[str]]:
    """Return the coordinate of each dimension: that which is declared or came with an output, or 0, 1, 2 ...

    Ragged dimensions have a power of two of values, so that few longer results make longer rows of all others.
    """
    known = dict(declared.coordinates)
    ragged = {value.ragged for value in values.values()} - {""}
    problems: dict[str, None] = {}  # each once, in order: outputs share dimensions
    for name, value in values.items():
        for one in value.coordinates:
            before = known.setdefault(one.name, one)
            known[one.name] = replace(before, unit=before.unit or one.unit, meaning=before.meaning or one.meaning)
            if (before.type, before.values) != (one.type, one.values):
                wrong = f"{name!r} has other values along {one.name!r} than are declared or than another output"
                problems[wrong] = None
            elif before.unit and one.unit and not same_unit(before.unit, one.unit):
                problems[f"{name!r} has a coordinate {one.name!r} in {one.unit}, expected {before.unit}"] = None
    for name, value in values.items():
        for dim, size in zip(value.dims or (), value.array.shape, strict=True):
            expected = len(known.setdefault(dim, Coordinate(dim, "int", size)).labels)
            if expected != size:
                problems[f"{name!r} has {size} values along {dim!r}, expected {expected}"] = None
            if size == 0 and dim not in ragged:
                problems[f"{name!r} has no values: its shape is {value.array.shape}"] = None
    for dim in ragged:
        size = len(known[dim].labels)
        if known[dim].values != size:
            problems[f"{dim!r} is ragged, and so it is numbered: return its coordinate as another output"] = None
        known[dim] = Coordinate(dim, "int", 1 << max(size - 1, 0).bit_length(), ragged=True)
    return known, list(problems)


def _add_lengths(values: dict[str, Value], coordinates: Mapping[str, Coordinate]) -> list[str]:
    """Add the length of each value that has a ragged dimension, as another one; return what is wrong with that."""
    problems = []
    for name, value in list(values.items()):
        lengths = [n for dim, n in zip(value.dims or (), value.array.shape, strict=True) if coordinates[dim].ragged]
        if len(lengths) > 1:
            problems.append(f"{name!r} has several ragged dimensions, and may have one")
        elif lengths and name + LENGTH in values:
            problems.append(f"{name!r} is ragged, and {name + LENGTH!r} is the name of its length; take another")
        elif lengths:
            values[name + LENGTH] = Value("int", np.array(lengths[0]), (), meaning=f"number of values of {name}")
    return problems


def _not_finite(arrays: Sequence[NDArray[Any]], layout: Layout, declared: Declared) -> NotFiniteError | None:
    """Return the error that says which results are NaN or infinite, None where none are."""
    pairs = zip(layout.fields, arrays, strict=True)
    try:
        check_finite(
            {field.name: array for field, array in pairs if field.type in ("float", "datetime")},
            [output.name for output in declared.outputs if output.nan],
        )
    except NotFiniteError as error:
        return NotFiniteError(f"{declared.function}: {error} (declare Output(..., nan=True) where that is a value)")
    return None
