"""Values of parameters, checked against the experiment: alone, along an axis, in the ranges of a design, and in the
table [points] of a study, which is a file, a design, columns, or a table in Python; and the problems of a study.
"""

import datetime
import inspect
import json
import math
import re
import tomllib
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from decimal import Context, Decimal
from enum import Enum
from fractions import Fraction
from functools import cached_property, partial
from importlib import import_module
from itertools import accumulate, pairwise, repeat
from os import PathLike
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from linksweep.sweep.code import Code, reach_of
from linksweep.sweep.contract import (
    OBJECTS,
    Experiment,
    Named,
    Parameter,
    SweepError,
    Value,
    is_number,
    nearest,
    needed,
    number_at,
    shown,
    suggest,
)
from linksweep.sweep.contract.experiment import (
    LABEL,
    factor_between,
    is_quantity,
    name_problem,
    quantity_of,
    refused,
    rescaled,
    same_unit,
)
from linksweep.sweep.contract.rows import Array
from linksweep.sweep.formatting import first_of, is_missing
from linksweep.sweep.functions.results import unit_of
from linksweep.sweep.studies.study import POINT, Form, PointsForm, PointTable, Sampling
from linksweep.sweep.tables import options
from linksweep.sweep.tables.columns import content_digest, rows_listed, table_file
from linksweep.sweep.tables.reader import BRACKETS, is_parquet, objects_in, read_table

# The most values of an axis, and the most rows of a table of points.
MAX_VALUES = 1_000_000

# Relative difference of numbers that are meant to be the same.
NEAR = 1e-12

# Values of each parameter in a Morris design; an even number.
MORRIS_LEVELS = 4

# Characters of what Python prints for an object that can be its label.
LONGEST_LABEL = 100

# Types of values that a parameter of any kind has as they are; all others are objects with a label.
PLAIN_TYPES = (bool, int, float, str, type(None), Named)

# Kinds of arrays whose ``tolist`` returns Python's own numbers and texts.
PLAIN = frozenset("biufU")

# After this many problems of one study, or reasons why its points cannot be computed, no more are looked for.
MAX_PROBLEMS = 20

# Keys and indices that lead to a value of the document.
KeyPath = tuple[str | int, ...]

Cells = dict[str, list[Any]]


class Column(NamedTuple):
    """A column of a table: its cells, None where one is missing, and their unit, '' for none."""

    cells: list[Any]
    unit: str = ""


def _lines_of_keys(text: str) -> dict[KeyPath, int]:
    """Return the 1-based line of every key of a TOML text, as far as patterns find it: the parser gives no lines."""
    table: KeyPath = ()
    counts: dict[str, int] = {}
    lines: dict[KeyPath, int] = {}
    for number, whole in enumerate(text.split("\n"), 1):
        line = whole[:200]  # a key is at the beginning; the patterns are slow on a long line
        if header := re.match(r"\s*(\[\[?)\s*([\w.\"' -]+?)\s*\]\]?\s*(?:#.*)?$", line):
            counts[header[2]] = index = counts.get(header[2], -1) + 1
            table = tuple(part.strip(" \"'") for part in header[2].split("."))
            lines.setdefault(table, number)
            table = (*table, index) if header[1] == "[[" else table
            lines[table] = number
        elif entry := re.match(r"\s*([\w.\"'-]+)\s*=", line):
            lines[*table, *entry[1].replace('"', "").replace("'", "").split(".")] = number
    return lines


class Problems:
    """Takes problems of a study by their place in its document, so that all are reported at once.

    ``where`` names the study, ``text`` is the text of its file, and ``options`` says which option of the command line
    gave the value at a place.
    """

    def __init__(self, where: str, text: str = "", options: Mapping[KeyPath, str] | None = None) -> None:
        self.where, self.text, self.options = where, text, {} if options is None else options
        self.sentences: list[str] = []
        self._line_of: dict[str, int] = {}  # of those that are in the file

    @cached_property
    def _lines(self) -> dict[KeyPath, int]:
        return _lines_of_keys(self.text)

    def add(self, place: KeyPath, message: str) -> None:
        """Take one problem; raises SweepError where there are too many."""
        if len(self.sentences) >= MAX_PROBLEMS:
            raise SweepError([*self.sentences, "... and perhaps more problems like these"], self.where)
        around = [place[:n] for n in range(len(place), 0, -1)]  # the value, and the tables that it is in
        sources = [self.options[table] for table in around if self.options.get(table)]
        lines = [self._lines[table] for table in around if table in self._lines]
        sources += [f"line {line}" for line in lines]
        key = ".".join(str(p) if re.fullmatch(r"[\w-]{1,60}", str(p)) else shown(p) for p in place)
        self.sentences.append(f"{key}{f' ({sources[0]})' if sources else ''}: {message}")
        if lines:
            self._line_of[self.sentences[-1]] = lines[0]

    @contextmanager
    def at(self, place: KeyPath, before: str = "") -> Iterator[None]:
        """Take the message of a ValueError or SweepError as problems of a place, with the text ``before`` it; without
        one, with the place that the error itself is about.
        """
        try:
            yield
        except (SweepError, ValueError) as error:
            problems, where = (error.problems, error.where) if isinstance(error, SweepError) else ([str(error)], "")
            for problem in problems:
                self.add(place, f"{before or (where and f'{where}: ')}{problem}")

    def report(self) -> None:
        """Raise SweepError with all problems, if there are any: those of the file in the order of its lines."""
        if self.sentences:
            raise SweepError(sorted(self.sentences, key=lambda one: self._line_of.get(one, 0)), self.where)


class Values:
    """Reads values of the parameters of an experiment; ``problems`` takes what is wrong.

    Paths of files are relative to ``folder``, or to the working directory where an option gives them.
    """

    def __init__(self, experiment: Experiment, folder: Path, problems: Problems) -> None:
        self.experiment, self.folder, self.problems = with_default_objects(experiment), folder, problems

    def one(self, place: KeyPath, name: str, raw: object, which: str = "") -> Value:
        """Return the value at a place, None if it is wrong; problems begin with ``which``."""
        with self.problems.at(place, which):
            parameter = self._parameter(name)
            value = (compared if place[0] == "when" else parsed)(parameter, raw)
            if parameter.kind not in ("file", "files"):
                return value
            folder = Path.cwd() if place[:2] in self.problems.options else self.folder
            with self.problems.at(place, f"{which}{shown(raw)}: "):  # tables do not name their file in a problem
                if parameter.kind == "files":
                    return tuple((key, table_file(folder / path)) for key, path in value)
                return table_file(folder / value)
        return None

    def _parameter(self, name: str) -> Parameter:
        """Return the declared parameter; raises ValueError, with a hint for what is set in [sampling]."""
        parameters, sampling = self.experiment.defaults(), Sampling.model_fields
        if name not in parameters:
            there = f"; it is set in [sampling]: --set {name}=VALUE, in Python sampling={{{name!r}: VALUE}}"
            near = nearest(name, [*parameters, *sampling]) or suggest(name, [*parameters])
            raise ValueError(f"unknown parameter {shown(name)}{there if name in sampling else near}")
        return self.experiment.parameter(name)

    def axis(self, name: str, spec: object) -> tuple[Value, ...] | None:
        """Return the values of an axis, a list or a range of them; None if any is wrong."""
        place = ("axes", name)
        with self.problems.at(place):
            parameter = self._parameter(name)
            if not parameter.may_be_axis:
                raise ValueError(f"a {parameter.kind} cannot be an axis")
            if isinstance(spec, dict):
                spec = {key: without_unit(one, parameter) for key, one in spec.items()}
            spec = without_unit(spec, parameter)
            if not (raw_values := axis_values(spec, whole=parameter.kind == "int")):
                raise ValueError("an axis needs at least one value")
            return self.several(place, name, raw_values)
        return None

    def several(
        self, place: KeyPath, name: str, raw_values: Sequence[object], rows: bool = False
    ) -> tuple[Value, ...] | None:
        """Return values, None if any is wrong, equal numbers of one type; problems name the row, from 1, where they are
        ``rows``.
        """
        before = len(self.problems.sentences)
        values = []
        for number, raw in enumerate(raw_values, start=1):
            values.append(self.one(place, name, raw, f"row {number}: " if rows else ""))
            if len(self.problems.sentences) >= before + 5:  # of a million values all may be wrong
                self.problems.add(place, "... and perhaps more values like these")
                break
        if len(self.problems.sentences) > before:
            return None
        is_any = self.experiment.parameter(name).kind == "any"  # others have numbers of one type
        alike = numbers_like(values, values) if is_any else tuple(values)
        with self.problems.at(place):
            require_distinct(alike, may_repeat=rows)
        return alike

    @staticmethod
    def require_labels(values: Iterable[Value]) -> None:
        """Raise ValueError for two values of which a coordinate would have the same label."""
        known: dict[str, Value] = {}
        for value in values:
            if known.setdefault(str(value), value) != value:
                raise ValueError(f"two values have the label {shown(str(value))}: give each its own")


def has_unit(value: Any) -> bool:
    """Return whether a value is a quantity, a column with a unit, or an array of xarray with one."""
    is_list = getattr(value, "ndim", 0) and hasattr(value, "units") and hasattr(value, "to")  # of those of pint or unyt
    return is_quantity(value) or bool(unit_of(value) and not is_list)


def without_unit(value: Any, parameter: Parameter) -> Any:
    """Return what carries a unit as `in_unit` does, anything else as it is."""
    if type(value) in PLAIN_TYPES or not has_unit(value):
        return value
    numbers = in_unit(*column_of(value), parameter)
    return numbers if np.ndim(value) else numbers[0]


def in_unit(cells: list[Any], theirs: str, parameter: Parameter) -> list[Any]:
    """Return numbers in the unit of a parameter, or quantities for one that takes objects alone.

    Raises ValueError where its unit is of another kind, or it has none.
    """
    unit = parameter.unit
    if parameter.kind == "object":
        return [cell if cell is None or isinstance(cell, str) else quantity_of(cell, theirs) for cell in cells]
    factor = factor_between(theirs, unit)
    if factor is None or (factor != 1.0 and not set(map(type, cells)) <= {int, float, str, bool, type(None)}):
        words = f"is in {unit}" if unit else "has no unit; give numbers, declare its unit, or annotate it with Quantity"
        raise ValueError(f"is in {theirs or 'no unit'}, and the parameter {words}")
    return [rescaled(cell, factor) if type(cell) in (int, float) else cell for cell in cells]


def numbers_like(known: Iterable[Value], values: Iterable[Value]) -> tuple[Value, ...]:
    """Return values with numbers in the type that the first equal one of those that are ``known`` has: 2.0 as 2, which
    a parameter of any type would take for another value.
    """
    first = {value: value for value in reversed([*known]) if type(value) in (int, float)}
    return tuple(first.get(value, value) if type(value) in (int, float) else value for value in values)


def require_distinct(values: Sequence[Value], may_repeat: bool = False) -> None:
    """Raise ValueError for what cannot be values of one coordinate: integers that no float equals beside floats, equal
    numbers of two types, and unless values ``may_repeat`` those that do, and numbers that differ by rounding alone.
    """
    if not may_repeat:  # a table may have a million rows
        counts = Counter((type(value), value) for value in values)
        if repeated := dict.fromkeys(shown(value) for value in values if counts[type(value), value] > 1):
            raise ValueError(f"duplicate values {first_of([*repeated], 10)}")
    kinds = {*map(type, values)} & {int, float}
    if kinds == {int} or (may_repeat and len(kinds) < 2):
        return
    numbers = sorted(value for value in values if type(value) in kinds)
    if inexact := next((value for value in numbers if value != float(value)), None):
        raise ValueError(f"{inexact} cannot stand beside numbers with a fraction: no float equals it")
    for one, other in pairwise(numbers):
        is_repeated = type(one) is type(other) if one == other else may_repeat
        if math.isclose(one, other, rel_tol=NEAR) and not is_repeated:
            raise ValueError(f"{one!r} and {other!r}, two points, are equal but for rounding: give one of them")


def _is_log(spec: Mapping[str, Any], *ends: float) -> bool:
    """Return whether a range is spaced in equal ratios; raises ValueError where that is not possible."""
    spacing = spec.get("spacing", "linear")
    if spacing not in ("linear", "log"):
        raise ValueError(f"spacing = {shown(spacing)}: must be 'linear' or 'log'")
    if spacing == "log" and min(ends) <= 0:
        raise ValueError(f"log spacing needs numbers above 0, not {' and '.join(map(shown, ends))}")
    return bool(spacing == "log")


def axis_values(spec: object, whole: bool = False) -> list[Any]:
    """Return the values of an axis written as a list, {values}, {start, stop, step} or {start, stop, num, spacing}.

    A range includes its stop; values are computed from the decimals that are written and rounded once, so that 14.1
    from a range is the 14.1 of a list, and steps of integers make integers.  If ``whole``, values that are log-spaced
    are rounded to integers, too.  Raises ValueError that says what is allowed.

    >>> axis_values({"start": 14, "stop": 16, "step": 0.5}), axis_values({"start": 14, "stop": 16, "step": 1})
    ([14.0, 14.5, 15.0, 15.5, 16.0], [14, 15, 16])
    >>> axis_values({"start": 10, "stop": 1000, "num": 5, "spacing": "log"}, whole=True)
    [10, 32, 100, 316, 1000]
    """
    if isinstance(spec, dict) and spec.keys() == {"values"}:
        spec = spec["values"]
    if isinstance(spec, list):
        return list(spec)
    ways = ({"start", "stop", "step"}, {"start", "stop", "num"}, {"start", "stop", "num", "spacing"})
    if not isinstance(spec, dict) or spec.keys() not in ways:
        alone = " is a single value: fix it, or" if isinstance(spec, str | int | float) else ":"
        raise ValueError(
            f"{shown(spec)}{alone} write a list, {{ start, stop, step }} or {{ start, stop, num, spacing }}"
        )
    start, stop = number_at("start", spec), number_at("stop", spec)
    first, last = Decimal(str(start)), Decimal(str(stop))
    low, distance, reaches = Fraction(first), Fraction(last) - Fraction(first), True
    whole |= all(isinstance(one, int) for one in (start, stop, spec.get("step")))
    if "step" in spec:
        step = Fraction(str(number_at("step", spec)))
        if step == 0 or (distance and distance / step < 1 - Fraction(1, 10**9)):
            problem = f"does not lead from start = {shown(start)} to stop = {shown(stop)}"
            raise ValueError(f"step = {shown(spec['step'])}: {problem}")
        # The stop is one of the values although a step that was computed may not divide the distance.
        noise = 0 if whole else min(max(abs(low), abs(low + distance)) / 2**50, abs(step) / 1000)
        unsure = 0 if whole else noise + abs(step) / 10**9
        parts = math.floor((abs(distance) + unsure) / abs(step))
        if parts >= MAX_VALUES:
            raise ValueError(f"start, stop, step make more than {MAX_VALUES} values; no more are allowed")
        beside = abs(distance - parts * step)
        step, reaches = distance / parts if parts and beside <= noise else step, beside <= unsure
    else:
        num = number_at("num", spec)
        if not isinstance(num, int) or not 1 <= num <= MAX_VALUES:
            raise ValueError(f"num = {shown(num)}: must be an integer from 1 to {MAX_VALUES}")
        parts = num - 1
        step = distance / max(parts, 1)
    if "num" in spec and _is_log(spec, start, stop):
        digits = Context(prec=40)
        ratio = digits.power(digits.divide(last, first), digits.divide(1, max(parts, 1)))
        logs = accumulate(repeat(ratio, parts), digits.multiply, initial=first)
        values = [round(x) if whole else float(x) for x in logs]
    else:
        unit = math.lcm(low.denominator, step.denominator)
        begin, each = int(low * unit), int(step * unit)
        numbers = (begin + each * i for i in range(parts + 1))
        values = [n // unit if whole and n % unit == 0 else n / unit for n in numbers]
    if parts and reaches and not whole:
        values[-1] = float(stop)
    return values


@dataclass(frozen=True)
class Range:
    """Equally probable values of one parameter: between ``low`` and ``high``, on a linear or ``log`` scale, or
    ``values``.

    Integers go from ``low`` to ``high``, both included.
    """

    name: str
    low: float = 0.0
    high: float = 1.0
    log: bool = False
    whole: bool = False
    values: tuple[Any, ...] = ()

    def __call__(self, unit: Array) -> list[Any]:
        """Return the values at places of the unit interval.

        >>> Range("k", 1, 3, whole=True)(np.array([0.0, 0.4, 1.0]))
        [1, 2, 3]
        >>> Range("x", 0.01, 1.0, log=True)(np.array([0.0, 0.5, 1.0]))
        [0.01, 0.1, 1.0]
        """
        if self.values or (self.whole and not self.log):
            n = int(self.levels)
            steps = [int(i) for i in np.minimum(np.floor(unit * n), n - 1).tolist()]
            return [self.values[i] if self.values else int(self.low) + i for i in steps]
        if self.log:
            first = math.log(self.low)
            # an integer stands for the interval up to the next one, so the last one needs its own
            exponents = first + unit * (math.log(self.high + self.whole) - first)
            numbers = [float(f"{x:.12g}") for x in np.exp(exponents).tolist()]
        else:
            numbers = (self.low + (self.high - self.low) * unit).tolist()
        numbers = [min(max(x, self.low), self.high) for x in numbers]
        return [math.floor(x) for x in numbers] if self.whole else numbers

    def places(self, values: Array) -> Array:
        """Return the places of numbers in the unit interval; for integers the middle of their part.

        >>> Range("k", 1, 4, whole=True).places(np.array([1, 4])).tolist()
        [0.125, 0.875]
        """
        numbers = values.astype(float) + (0.5 if self.whole else 0.0)
        top = self.high + self.whole
        if self.log:
            return np.asarray((np.log(numbers) - math.log(self.low)) / (math.log(top) - math.log(self.low)))
        return np.asarray((numbers - self.low) / (top - self.low))

    @property
    def levels(self) -> float:
        """How many different values there are, infinity for real numbers."""
        if self.values:
            return len(self.values)
        return self.high - self.low + 1 if self.whole else math.inf


def read_range(parameter: Parameter, spec: object) -> Range:
    """Return the range that a study writes for a parameter; raises ValueError that says what is allowed."""
    if not parameter.may_be_axis:
        raise ValueError(f"a {parameter.kind} has no range")
    if isinstance(spec, dict) and set(spec) == {"values"}:
        values = spec["values"]
        different = {parameter.parse(value) for value in values} if isinstance(values, list) else set()
        if not different or len(different) < len(values):
            raise ValueError(f"values = {shown(values)}: must be a list of different values")
        return Range(parameter.name, values=tuple(values))
    if isinstance(spec, list) and len(spec) == 2:
        spec = {"low": spec[0], "high": spec[1]}
    is_number_ = parameter.kind in ("float", "int", "any") and (not parameter.choices or parameter.kind == "float")
    if not is_number_ or not isinstance(spec, dict) or set(spec) - {"spacing"} != {"low", "high"}:
        ways = '[low, high], { low, high, spacing = "log" } or ' if is_number_ else ""
        raise ValueError(f"{shown(spec)}: {parameter.name} is {parameter.allowed()}; write {ways}{{ values = [...] }}")
    low, high = number_at("low", spec), number_at("high", spec)
    parameter.parse(low)  # within the bounds of the parameter, so that all values between are
    parameter.parse(high)
    if not low < high:
        raise ValueError(f"low = {shown(low)} must be less than high = {shown(high)}")
    return Range(parameter.name, low, high, _is_log(spec, low, high), whole=parameter.kind == "int")


class Design(NamedTuple):
    """Points in the unit cube that sample many parameters at once.

    How to ``draw`` it from n and the number of parameters; whether it is even only for powers of two; and how many
    points each of n has ``beside`` one for each parameter, None if it is a single point.
    """

    draw: Callable[[int, int, np.random.Generator], Any]
    powers_of_two: bool = False
    beside: int | None = None

    def size(self, n: int, dimensions: int) -> int:
        """Return how many points it has."""
        return n if self.beside is None else n * (dimensions + self.beside)


def _scipy(name: str, n: int, dimensions: int, rng: np.random.Generator) -> Any:
    from scipy.stats import qmc

    return getattr(qmc, name)(dimensions, seed=rng).random(n)


def _salib(name: str, n: int, dimensions: int, rng: np.random.Generator, **options: Any) -> Any:
    return salib(f"sample.{name}").sample(unit_cube(dimensions), n, seed=rng, **options)


DESIGNS: Mapping[str, Design] = {
    "sobol": Design(partial(_scipy, "Sobol"), powers_of_two=True),
    "latin-hypercube": Design(partial(_scipy, "LatinHypercube")),
    "halton": Design(partial(_scipy, "Halton")),
    "random": Design(lambda n, dimensions, rng: rng.random((n, dimensions))),
    "saltelli": Design(partial(_salib, "sobol", calc_second_order=False), powers_of_two=True, beside=2),
    "morris": Design(partial(_salib, "morris", num_levels=MORRIS_LEVELS), beside=1),
}


def salib(module: str) -> Any:
    """Return a module of SALib; raises SweepError unless it can be imported."""
    with needed("SALib", "sensitivity"):
        return import_module(f"SALib.{module}")


def unit_cube(dimensions: int) -> dict[str, Any]:
    """Return SALib's definition of a problem with this many parameters between 0 and 1."""
    names = [f"x{k}" for k in range(dimensions)]
    return {"num_vars": dimensions, "names": names, "bounds": [[0.0, 1.0]] * dimensions}


def remarks(origin: Mapping[str, Any]) -> list[str]:
    """Return the warnings of a run about a design."""
    n, design = origin.get("n"), DESIGNS.get(str(origin.get("design")))
    if design is None or not design.powers_of_two or type(n) is not int or n & (n - 1) == 0:
        return []
    below = 1 << (n.bit_length() - 1)
    return [f"points.n = {n:,} is not a power of two, and Sobol points spread less evenly: {below:,} or {2 * below:,}?"]


# The table [points]


def read_points(
    form: Form, values: Values, code: Code
) -> tuple[dict[str, tuple[Value, ...] | None], PointTable | None]:
    """Return the values of a table of points by parameter, and what is known of it; nothing where anything is wrong,
    which the problems of ``values`` say.
    """
    experiment, problems, asked = values.experiment, values.problems, form.points
    if asked is None:
        return {}, None
    if POINT in {*experiment.defaults(), *(output.name for output in experiment.outputs), *experiment.coordinates}:
        problems.add(("points",), f"{experiment.name} has a {POINT!r} of its own, the name of this dimension")
    before = len(problems.sentences)
    columns, labels, origin = dict[str, list[Any]](), dict[str, list[Any]](), dict(asked.origin or {})
    with problems.at(("points", asked.source), "" if asked.columns is not None else f"{asked.file or asked.design}: "):
        if asked.design is not None:
            columns, origin = _designed(asked, values)
        else:
            table = {name: Column(cells) for name, cells in (asked.columns or {}).items()}
            table |= {} if asked.file is None else _in_file(asked.file, values)
            columns, labels = _apart(table, asked, values)
            origin |= {} if asked.file is None else {"file": Path(asked.file).name}
        lengths = {name: len(column) for name, column in (columns | labels).items()}
        is_table = len({*lengths.values()}) == 1 and 1 <= max(lengths.values()) <= MAX_VALUES
        if len(problems.sentences) == before and not is_table:
            sizes = ", ".join(f"{name} has {n}" for name, n in lengths.items()) or "there are none"
            raise ValueError(f"needs columns with the same number of values, from 1 to {MAX_VALUES:,}; {sizes}")
    if len(problems.sentences) == before and asked.derive is not None:
        settings = {n: v for n, v in experiment.defaults().items() if n not in form.axes}
        with problems.at(("points", "derive")):
            fixed = {n: v for n, v in form.fixed.items() if n in settings}
            settings |= {n: without_unit(v, experiment.parameter(n)) for n, v in fixed.items()}
            columns |= _derived(asked.derive, columns, settings, values, code)
            origin["derive"] = asked.derive
    if len(problems.sentences) > before:
        return {}, None
    points: dict[str, tuple[Value, ...] | None] = {}
    for name, raw_values in columns.items():
        where = ("points", "ranges" if asked.design else asked.source, name)
        if name in {**form.axes, **form.fixed}:
            problems.add(where, f"is {'an axis' if name in form.axes else 'fixed'} too; leave out one of the two")
        with problems.at(where):
            if not (parameter := experiment.parameter(name)).may_be_axis:
                raise ValueError(f"a {parameter.kind} cannot differ from point to point")
            points[name] = values.several(where, name, raw_values, rows=True)
    return points, PointTable(tuple(columns), origin, labels)


def _apart(table: Mapping[str, Column], form: PointsForm, values: Values) -> tuple[Cells, Cells]:
    """Return the columns that are parameters, in their units, and those that label the rows; all under names that are
    known, behind which a column's own may have a unit: ``x [cm]``.
    """
    experiment, problems = values.experiment, values.problems
    parameters, stated = {one.name: one for one in experiment.parameters}, dict(form.units)
    columns, labels = dict[str, list[Any]](), dict[str, list[Any]]()
    for written, (cells, in_table) in table.items():
        match = BRACKETS.fullmatch(written)
        is_known = match and match[1] in {*parameters, *form.labels}.difference(table, columns, labels)
        name, behind = match.groups() if match and is_known else (written, "")
        unit, said = in_table or behind, "" if name in form.labels else stated.pop(written, stated.pop(name, ""))
        columns[name] = cells
        with problems.at(("points", form.source, name)):
            if name in form.labels:
                labels[name] = columns.pop(name)
            elif name not in parameters:
                hint = f"{suggest(name, list(parameters))}; as a label: labels = [{json.dumps(name)}]"
                raise ValueError(f"unknown parameter {shown(name)}{hint}")
            elif unit and said and not same_unit(unit, said):
                raise ValueError(f"its column is in {unit}, and not in {said}")
            else:
                one, unit, missing = parameters[name], unit or said, np.array([cell is None for cell in cells])
                if missing.any() and not one.optional and not one.when:
                    raise ValueError(f"has no value in row {rows_listed(missing)}")
                columns[name] = in_unit(cells, unit, one) if unit else cells
    for name in stated:
        problems.add(("points", "units", name), f"is no column of a parameter{suggest(name, [*columns])}")
    results = [POINT, *experiment.coordinates, *(output.name for output in experiment.outputs)]
    taken = "is a parameter or a result; labels are other columns (reset_index() makes a column of an index)"
    for name in form.labels:
        problem = taken if name in (*parameters, *results) else name_problem(name)
        problem = problem if name in labels else f"is no column{suggest(name, [*columns, *labels])}"
        with problems.at(("points", "labels"), f"{shown(name)}: "):
            if problem:
                raise ValueError(problem)
            labels[name] = labels_of(labels[name])
    return columns, labels


def is_empty(cell: object) -> bool:
    """Return whether there is no value in a cell."""
    return cell is None or cell is np.ma.masked or is_missing(cell)


def labels_of(cells: Sequence[Any]) -> list[Any]:
    """Return the cells of a column as labels: numbers, floats if one has a fraction, truth values, all else as texts.

    A missing label is NaN among numbers with a fraction, else an empty text.  Raises ValueError as `label_of`.

    >>> labels_of([4472832130942575872, 7]), labels_of(["Sirius", 7, None])
    ([4472832130942575872, 7], ['Sirius', '7', ''])
    """
    cells = [cell.decode() if isinstance(cell, bytes) else None if is_empty(cell) else cell for cell in cells]
    kinds = {type(cell) for cell in cells}
    exact = all(type(cell) is not int or abs(cell) <= 2**53 for cell in cells)
    if exact and float in kinds <= {float, int, type(None)}:
        return [math.nan if cell is None else float(cell) for cell in cells]
    if kinds == {bool} or (kinds == {int} and all(-(2**63) <= cell < 2**63 for cell in cells)):
        return cells
    printed = (*PLAIN_TYPES, list, tuple, dict)
    return ["" if cell is None else str(cell) if type(cell) in printed else label_of(cell, str(cell)) for cell in cells]


def _in_file(file: str, values: Values) -> dict[str, Column]:
    """Return the columns of a file, with cells as their parameters take them."""
    path = values.folder / file
    table = read_table(path)
    known = {one.name: one for one in values.experiment.parameters}
    ours = {name: known.get(name, known.get(BRACKETS.sub(r"\1", name), Parameter(name))) for name in table.colnames}
    columns = {name: column_of(table[name], is_whole=True) for name in table.colnames}
    cells = {name: _read_cells(column.cells, ours[name]) for name, column in columns.items()}
    doubtful = [n for n, one in ours.items() if one.kind in ("any", "str") and {*map(type, cells[n])} != {str}]
    written = read_table(path, texts=doubtful) if doubtful else {}
    for name in doubtful:  # 0071 is a name, and not the number 71; and "none" is a value where the choices have it
        one, pairs = ours[name], zip(cells[name], column_of(written[name], is_whole=True).cells, strict=True)
        is_text = one.kind == "str" and not one.optional
        texts = [text if is_text or cell is not None or text in one.choices else None for cell, text in pairs]
        if one.kind == "str" or any(re.fullmatch(r"0\d+", str(text)) for text in texts):
            cells[name] = texts
        else:  # an integer stays one when a row with a fraction is appended
            cells[name] = [
                int(str(text)) if re.fullmatch(r"[+-]?\d+", str(text)) else text if cell is None else cell
                for text, cell in zip(texts, cells[name], strict=True)
            ]
    objects = objects_in(path) if is_parquet(path) else {}
    cells |= {name: some for name, some in objects.items() if name in ours and ours[name].takes_objects}
    return {name: column._replace(cells=cells[name]) for name, column in columns.items()}


def _read_cells(cells: list[Any], parameter: Parameter) -> list[Any]:
    """Return a column of a file that is text because of some cells, with the others as what the parameter takes, so
    that only those that are wrong are refused.  A column in which no cell is wrong is text on purpose, and stays so.
    """
    kind, choices = parameter.kind, parameter.choices
    if kind == "object":
        return [parse_value(cell) if isinstance(cell, str) else cell for cell in cells]
    if kind == "any" and choices:
        ways = [(cell, read_cell(cell, "bool"), read_cell(cell, "float")) for cell in cells]
        return [next((way for way in some if way in choices), some[0]) for some in ways]
    if kind not in ("float", "int", "bool") or not any(isinstance(cell, str) for cell in cells):
        return cells
    read = [read_cell(cell, kind) for cell in cells]
    large = any(isinstance(cell, int) and not -(2**63) <= cell < 2**63 for cell in read)
    return read if large or any(isinstance(cell, str) for cell in read) else cells


def read_cell(cell: Any, kind: str) -> Any:
    """Return what a cell with text is for a parameter that is no text, the cell itself where it is nothing else."""
    if not isinstance(cell, str):
        return cell
    if kind == "bool":  # of pandas and NumPy True, of TOML true, of spreadsheets TRUE
        return {"true": True, "false": False}.get(cell.lower(), cell)
    number = options.number(cell)
    return cell if isinstance(number, str) else number


def parse_value(text: str, is_text: bool = False) -> Any:
    """Return a value as TOML would read it, truth values in any case, or the text itself where it is another bare word,
    or is to be one.

    >>> parse_value("1e3"), parse_value("[1, 2]"), parse_value("-.5"), parse_value("False"), parse_value("gaia")
    (1000.0, [1, 2], -0.5, False, 'gaia')
    >>> parse_value("1e3", is_text=True), parse_value("'1e3'", is_text=True)
    ('1e3', '1e3')
    """
    try:
        document = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text if is_text else read_cell(text, "float" if "." in text else "bool")  # TOML has no .5
    value = document["value"] if len(document) == 1 else text
    return text if is_text and not isinstance(value, str) else value


def column_of(column: Any, is_whole: bool = False) -> Column:
    """Return a column, an array or a value as Python has it; where it ``is_whole``, of a table of astropy, NaN is
    missing, and elsewhere it is a value.
    """
    numbers, mask = getattr(column, "unmasked", getattr(column, "magnitude", column)), getattr(column, "mask", False)
    array = np.ma.masked_array(numbers.value if is_quantity(column) else numbers, mask)
    cells = [None if is_whole and is_empty(cell) else cell for cell in np.atleast_1d(array).tolist()]
    return Column([cell.decode() if isinstance(cell, bytes) else cell for cell in cells], unit_of(column))


def _derived(reference: str, columns: Cells, settings: Mapping[str, Any], values: Values, code: Code) -> Cells:
    """Return the columns that a user's function returns for each row of a table; raises ValueError as it should."""
    derived: dict[str, list[Any]] = {}
    function = code.function(reference, values.folder)
    for number, row in enumerate(zip(*columns.values(), strict=True), start=1):
        try:
            point = {**settings, **dict(zip(columns, row, strict=True))}
            result = function({n: one.value if isinstance(one, Named) else one for n, one in point.items()})
        except Exception as error:  # whatever a user's function raises
            raise ValueError(f"row {number}: {reference} raises {type(error).__name__}: {error}") from error
        if not isinstance(result, Mapping) or (derived and result.keys() != derived.keys()) or result.keys() & columns:
            expected = f"a mapping of {', '.join(derived) or 'parameters'} that are no columns to their values"
            raise ValueError(f"row {number}: {reference} returns {shown(result)}, not {expected}")
        for name, value in result.items():
            one = value.item() if hasattr(value, "item") and not has_unit(value) else value
            derived.setdefault(str(name), []).append(one)
    return derived


def _designed(form: PointsForm, values: Values) -> tuple[Cells, dict[str, Any]]:
    """Return the columns of a design, and where they come from; raises ValueError or SweepError."""
    name, n, problems = str(form.design), form.n or 0, values.problems
    ranges = []
    for key, spec in form.ranges.items():
        with problems.at(("points", "ranges", key)):
            ranges.append(one := read_range(values.experiment.parameter(key), spec))
            if name == "morris" and (one.levels < MORRIS_LEVELS or not all(map(is_number, one.values))):
                raise ValueError(f"a Morris design takes steps between {MORRIS_LEVELS} numbers at least")
    if len(ranges) < len(form.ranges):
        return {}, {}
    if (size := DESIGNS[name].size(n, len(ranges))) > MAX_VALUES:
        raise ValueError(f"makes {size:,} points of n = {n:,}; at most {MAX_VALUES:,} are allowed")
    with warnings.catch_warnings():  # `remarks` says it in our words
        warnings.filterwarnings("ignore", message="The balance properties", category=UserWarning)
        unit = np.asarray(DESIGNS[name].draw(n, len(ranges), np.random.default_rng(form.seed)))
    columns = {one.name: one(unit[:, k]) for k, one in enumerate(ranges)}
    return columns, {"design": name, "n": n, "seed": form.seed, "ranges": dict(form.ranges)}


# Objects of Python in place of a file


def label_of(value: Any, printed: str, otherwise: str = "") -> str:
    """Return the name of an object, else what Python ``printed`` for it, ``otherwise`` where others may have that too.

    Raises ValueError for an object that has no label of its own and gets none.
    """
    name = value.name if isinstance(value, Enum) else getattr(value, "__name__", "")
    label = name or " ".join(printed.split())
    if label == "<lambda>" or " at 0x" in label or "..." in label or len(label) > LONGEST_LABEL:
        label = otherwise
    if not label:
        raise ValueError(f"{shown(value)} has no label of its own; give it one, {{'label': value}}")
    return str(label)


def labelled(value: Any, label: str = "", otherwise: str = "") -> Named:
    """Return an object as the value of a parameter: under a label, by default as `label_of`, and known by its canonical
    form and the code that it reaches.

    Raises ValueError for an object without a canonical form, and as `label_of`.

    >>> labelled((1, "a")).name, labelled(Path("a/b")).name, labelled(math.sqrt).name, labelled({*"cdab"}).name
    ("(1, 'a')", 'a/b', 'sqrt', "{'a', 'b', 'c', 'd'}")
    """
    reach = reach_of({"value": value})
    if reach.unnoticed:
        raise ValueError(f"{shown(value)} has no canonical form, so that it cannot be told from others")
    if not label:
        is_text = isinstance(value, PurePath | datetime.date | datetime.time | np.datetime64) or is_quantity(value)
        printed = str(value) if is_text else repr(value)
        if isinstance(value, set | frozenset) and "{" in printed:  # in an order that is the same in all processes
            inside = ", ".join(sorted(map(repr, value)))
            printed = f"{printed.partition('{')[0]}{{{inside}}}{printed.rpartition('}')[2]}"
        label = label_of(value, printed, otherwise)
    named = Named(str(label), json.dumps(reach.parts, sort_keys=True), value)
    OBJECTS[named.identity] = named
    return named


def parsed(parameter: Parameter, raw: Any, otherwise: str = "") -> Any:
    """Return a value of a parameter, an object as `labelled`; raises ValueError as that and `Parameter.parse`."""
    if not parameter.takes_objects or (is_quantity(raw) and parameter.kind != "object"):
        raw = without_unit(raw, parameter)
    is_plain = type(raw) in PLAIN_TYPES or (isinstance(raw, dict) and raw.keys() == {LABEL})
    return parameter.parse(raw if is_plain or not parameter.takes_objects else labelled(raw, "", otherwise))


def compared(parameter: Parameter, raw: Any) -> Value:
    """Return a value of a condition; where it may be an object, a text is a label, too, and an object is its digest.

    Raises ValueError as `parsed`.
    """
    if parameter.takes_objects and type(raw) is str:
        return raw
    value = parsed(parameter, raw, "object")
    return content_digest(value) if isinstance(value, Named) and parameter.kind != "str" else value


def with_default_objects(experiment: Experiment) -> Experiment:
    """Return the experiment of a function with the objects among its defaults, where they have labels of their own."""
    arguments = inspect.signature(call).parameters if (call := getattr(experiment, "call", None)) else {}
    defaults: dict[str, Named] = {}
    for one in experiment.parameters if arguments else ():
        may_be = one.takes_objects or one.kind == "float"  # which may be infinite
        if may_be and one.default is None and not one.required and arguments[one.name].default is not None:
            with suppress(ValueError):
                defaults[one.name] = labelled(arguments[one.name].default)
    return experiment.with_setting("default", defaults)


def plain_value(value: Any) -> Any:
    """Return a value as a study has it: numbers and texts of NumPy as those of Python."""
    return value.item() if isinstance(value, np.generic) and value.dtype.kind in PLAIN else value


def plain(value: Any, where: str, deep: bool = True) -> Any:
    """Return a value as TOML would give it: lists for arrays, ranges, tuples and indexes, Python's own numbers.

    Unless it is ``deep``, it is the values of an axis or a column: each of these that is no number or text is an object
    and stays as it is, or is under the label that it has.  Raises SweepError that names the place for numbers with a
    unit where there is no parameter with a unit.
    """
    if has_unit(value):
        if deep:
            raise SweepError(f"{where}: is in {unit_of(value) or 'no unit'}; give numbers")
        return value  # converted or refused where that of its parameter is known
    if isinstance(value, Mapping):
        if deep or value.keys() & {"start", "values"}:
            return {str(key): plain(item, f"{where}.{key}", deep) for key, item in value.items()}
        with refused(ValueError, said=f"{where}: "):
            return [labelled(one, label) for label, one in value.items()]
    if not hasattr(value, "tolist") and hasattr(getattr(value, "values", None), "tolist"):  # of xarray
        value = value.values
    kind = getattr(getattr(value, "dtype", None), "kind", "")
    if not deep and getattr(value, "ndim", 1) > 1:
        value = list(np.asanyarray(value))  # each an object
    elif hasattr(value, "tolist") and kind in PLAIN and not unit_of(value):
        return value.tolist()
    # Neither what gives its values only once, nor a set, whose order differs between processes: both are refused later.
    if not np.iterable(value) or isinstance(value, str | bytes | set | frozenset | Iterator):
        return value
    return [plain(item, where) if deep else plain_value(item) for item in value]


def plain_study(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document of a study as TOML would give it, but for objects, which have labels."""
    written: dict[str, Any] = {}
    for key, value in document.items():
        if key == "when":
            written[key] = plain_conditions(value, key)
        elif key == "exclude" and isinstance(value, list | tuple):
            written[key] = [plain_conditions(one, key, listed=False) for one in value]
        elif key == "axes" and isinstance(value, Mapping):
            written[key] = plain_columns(value, key)
        elif key == "fixed" and isinstance(value, Mapping):
            written[key] = {str(name): plain_value(one) for name, one in value.items()}
        else:
            written[str(key)] = plain_points(value) if key == "points" else plain(value, str(key))
    return written


def plain_columns(columns: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the values of axes or columns, by name, as a study has them."""
    return {str(name): plain(values, f"{where}.{name}", deep=False) for name, values in columns.items()}


def plain_conditions(raw: Any, where: str, listed: bool = True) -> Any:
    """Return conditions as a study has them, those on a parameter's value being ``listed``."""
    if isinstance(raw, Mapping):
        return {str(key): plain_conditions(one, f"{where}.{key}", listed or key == "in") for key, one in raw.items()}
    return plain(raw, where, deep=False) if listed else plain_value(raw)


def plain_points(points: Any) -> dict[str, Any]:
    """Return a table of points as a study file has it, from a DataFrame, an astropy Table, a mapping of columns, the
    name of a file, or what a study file may have there.  The index of a DataFrame labels the points unless it only
    counts them.
    """
    further = dict[str, Any]()
    if isinstance(points, str | PathLike):
        return {"file": str(points)}
    if isinstance(points, Mapping) and isinstance(columns := points.get("columns"), dict):
        further, table = plain({key: one for key, one in points.items() if key != "columns"}, "points"), columns
    elif isinstance(points, Mapping) and any(isinstance(points.get(key), str) for key in ("file", "design")):
        return dict(plain(points, "points"))  # a column may be called so, but it is no text
    elif isinstance(points, Mapping) or hasattr(points, "colnames"):
        is_whole = hasattr(points, "colnames")
        table = {str(name): points[name] for name in getattr(points, "colnames", points)}
        read = {name: column_of(one, is_whole) for name, one in table.items() if is_whole or has_unit(one)}
        table |= {name: cells for name, (cells, _) in read.items() if not cells or not isinstance(cells[0], list)}
        units = {name: f" [{unit}]" for name, (_, unit) in read.items() if unit}
        table = {name + units.get(name, ""): one for name, one in table.items()}
    elif hasattr(points, "columns") and hasattr(points, "reset_index"):
        if points.index.names != [None] or points.index.tolist() != list(range(len(points))):
            before, points = set(points), points.reset_index(allow_duplicates=True)
            further = {"labels": [str(name) for name in points if name not in before]}
        if not points.columns.is_unique:
            raise SweepError("points: two columns have the same name")
        table = {str(name): points[name].astype(object).where(points[name].notna(), None).tolist() for name in points}
    else:
        wanted = "must be a DataFrame, a Table, a mapping of columns, a file or a design"
        raise SweepError(wanted, f"points = {shown(points)}")
    return {"columns": plain_columns(table, "points"), **further}


def with_labels(points: Any, labels: Any) -> dict[str, Any]:
    """Return a table of points as `plain_points`, in which the columns with these names label the points, too."""
    table, names = plain_points(points), plain(labels, "labels")
    return table | {"labels": [*table.get("labels", ()), *(names if isinstance(names, list) else [names])]}
