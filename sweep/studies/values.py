"""Values of parameters, checked against the experiment: alone, along an axis, in a column, and drawn by a design."""

import math
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from linksweep.sweep.contract import Array, Experiment, Parameter, SweepError, Value, shown
from linksweep.sweep.contract.parameter import HUGE, bound_in_words
from linksweep.sweep.formatting import first_of
from linksweep.sweep.studies.document import Place, Problems
from linksweep.sweep.tables.file import table_file

MAX_AXIS_VALUES = 1_000_000

MORRIS_LEVELS = 4
"""Values of each parameter in a Morris design; an even number."""


class Values:
    """Reads values of the parameters of an experiment; ``problems`` takes what is wrong.

    Paths of files are relative to ``folder``, or to the working directory where an option gives them.
    """

    def __init__(self, experiment: Experiment, folder: Path, problems: Problems) -> None:
        self.experiment, self.folder, self.problems = experiment, folder, problems

    def one(self, place: Place, name: str, raw: object, which: str = "") -> Value:
        """Return the value at a place, None if it is wrong; problems begin with ``which``."""
        try:
            parameter = self.experiment.parameter(name)
            value = parameter.parse(raw)
            folder = Path.cwd() if place[:2] in self.problems.overridden else self.folder
            return table_file(folder / value) if parameter.kind == "file" else value
        except ValueError as error:
            self.problems.add(place, f"{which}{error}")
        except SweepError as error:
            self.problems.add(place, f"{shown(raw)}: {error}")
        return None

    def axis(self, name: str, spec: object) -> tuple[Value, ...] | None:
        """Return the values of an axis, a list or a range of them; None if any is wrong."""
        place = ("axes", name)
        with self.problems.at(place):
            parameter = self.experiment.parameter(name)
            if not parameter.may_be_axis:
                raise ValueError(f"a {parameter.kind} cannot be an axis")
            raw_values = axis_values(spec, whole=parameter.kind == "int")
            if not raw_values:
                self.problems.add(place, "an axis needs at least one value")
            values = self.several(place, name, raw_values)
            if repeated := [shown(value) for value, n in Counter(values or ()).items() if n > 1]:
                self.problems.add(place, f"duplicate value{'s' if len(repeated) > 1 else ''} {first_of(repeated, 10)}")
            return values
        return None

    def several(
        self, place: Place, name: str, raw_values: Sequence[object], rows: bool = False
    ) -> tuple[Value, ...] | None:
        """Return values of one type, None if any is wrong; problems name the row, from 1, where they are ``rows``."""
        before = len(self.problems.sentences)
        values = []
        for number, raw in enumerate(raw_values, start=1):
            values.append(self.one(place, name, raw, f"row {number}: " if rows else ""))
            if len(self.problems.sentences) >= before + 5:
                self.problems.add(place, "... and perhaps more values like these")
                return None
        if len(self.problems.sentences) > before:
            return None
        kinds = {type(value) for value in values} if self.experiment.parameter(name).kind == "any" else set()
        if kinds == {int, float}:
            return tuple(float(value) for value in values)
        if len(kinds) > 1:
            named = ", ".join(sorted(kind.__name__ for kind in kinds))
            self.problems.add(place, f"has values of several types ({named}); an axis is of one")
            return None
        return tuple(values)


def axis_values(spec: object, whole: bool = False) -> list[Any]:
    """Return the values of an axis written as a list, {values}, {start, stop, step} or {start, stop, num, spacing}.

    A range includes its stop; values are rounded to 12 digits, so that 14.1 from a range is the 14.1 of a list, or to
    more where 12 would move them by a thousandth of a step.  If ``whole``, those that are log-spaced are rounded to
    integers, and a range of integers is exact.  Raises ValueError that says what is allowed.

    >>> axis_values({"start": 14, "stop": 16, "step": 0.5})
    [14.0, 14.5, 15.0, 15.5, 16.0]
    >>> axis_values({"start": 10, "stop": 1000, "num": 5, "spacing": "log"}, whole=True)
    [10, 32, 100, 316, 1000]
    """
    if isinstance(spec, list):
        return spec
    if not isinstance(spec, dict):
        raise ValueError(f"{shown(spec)}: write a list, {{ start, stop, step }} or {{ start, stop, num, spacing }}")
    keys = set(spec)
    if keys == {"values"}:
        if not isinstance(spec["values"], list):
            raise ValueError(f"values = {shown(spec['values'])}: must be a list")
        return list(spec["values"])
    if keys not in ({"start", "stop", "step"}, {"start", "stop", "num"}, {"start", "stop", "num", "spacing"}):
        raise ValueError(
            f"keys {shown(sorted(map(str, keys)))}: allowed are values; start, stop, step; start, stop, num and spacing"
        )
    for key in ("start", "stop", "step", "num"):
        if key in spec and (wrong := number_problem(spec[key])):
            raise ValueError(f"{key} = {wrong}")
    if "step" in spec:
        return _stepped(spec["start"], spec["stop"], spec["step"], whole)
    return _numbered(spec["start"], spec["stop"], spec["num"], spec.get("spacing", "linear"), whole)


def _numbered(start: float, stop: float, num: object, spacing: object, whole: bool) -> list[float]:
    if not isinstance(num, int) or not 1 <= num <= MAX_AXIS_VALUES:
        raise ValueError(f"num = {shown(num)}: must be an integer from 1 to {MAX_AXIS_VALUES}")
    parts = max(num - 1, 1)
    exact = whole and isinstance(start, int) and isinstance(stop, int)
    if spacing == "linear":
        if exact and (stop - start) % parts == 0:
            return [start + (stop - start) // parts * i for i in range(num)]
        return [_rounded(start + (stop - start) * i / parts, (stop - start) / parts) for i in range(num)]
    if spacing != "log":
        raise ValueError(f"spacing = {shown(spacing)}: must be 'linear' or 'log'")
    if start <= 0 or stop <= 0:
        raise ValueError(f"log spacing needs start and stop > 0, not {shown(start)} and {shown(stop)}")
    values = [_rounded(start * (stop / start) ** (i / parts)) for i in range(num)]
    if not whole:
        return values
    ends = {0: start, parts: stop} if exact else {}  # they may have more than 12 digits
    return [ends.get(i, round(v) if math.isfinite(v) else v) for i, v in enumerate(values)]


def _stepped(start: float, stop: float, step: float, whole: bool) -> list[float]:
    if step == 0 or (count := (stop - start) / step) < 0:
        raise ValueError(f"step = {shown(step)}: does not lead from start = {shown(start)} to stop = {shown(stop)}")
    if count > MAX_AXIS_VALUES:
        raise ValueError(f"start, stop, step make about {count:.3g} values; at most {MAX_AXIS_VALUES} are allowed")
    if whole and all(isinstance(number, int) for number in (start, stop, step)):
        return [start + step * i for i in range(int((stop - start) // step) + 1)]
    unsure = 1e-9 + 2 * sys.float_info.epsilon * max(abs(start), abs(stop)) / abs(step)  # rounding of start and stop
    return [_rounded(start + step * i, step) for i in range(math.floor(count + min(unsure, 1e-3)) + 1)]


def _rounded(x: float, step: float = math.inf) -> float:
    """Return x with 12 digits, or with 15 where 12 would move it by a thousandth of a step, as they do Julian dates
    that are a second apart.
    """
    short = float(f"{x:.12g}")
    return short if step == 0 or abs(short - x) <= 1e-3 * abs(step) else float(f"{x:.15g}")


def is_number(x: object) -> bool:
    """Return whether x is a finite number that a study may contain."""
    return isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) < HUGE


def number_problem(x: object) -> str | None:
    """Return why x is not a finite number that a study may contain, None if it is one."""
    return None if is_number(x) else f"{shown(x)}: must be a finite number{bound_in_words(x)}"


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
            exponents = first + unit * (math.log(self.high + self.whole) - first)
            numbers = [float(f"{x:.12g}") for x in np.exp(exponents).tolist()]
        else:
            numbers = (self.low + (self.high - self.low) * unit).tolist()
        numbers = [min(max(x, self.low), self.high) for x in numbers]
        return [math.floor(x) for x in numbers] if self.whole else numbers

    def places(self, values: Array) -> Array:
        """Return the places of values in the unit interval; for integers and listed values the middle of their part."""
        if self.values:
            order = {value: i for i, value in enumerate(self.values)}
            return np.array([(order[value] + 0.5) / len(self.values) for value in values.tolist()])
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
        if not isinstance(values, list) or not values:
            raise ValueError(f"values = {shown(values)}: must be a list with at least one value")
        if len({parameter.parse(value) for value in values}) < len(values):
            raise ValueError(f"values = {shown(values)}: a value is listed twice")
        return Range(parameter.name, values=tuple(values))
    if isinstance(spec, list) and len(spec) == 2:
        spec = {"low": spec[0], "high": spec[1]}
    if not isinstance(spec, dict) or {"low", "high"} - set(spec) or set(spec) - {"low", "high", "spacing"}:
        ways = 'write [low, high], { low, high, spacing = "log" } or { values = [...] }'
        raise ValueError(f"{shown(spec)}: {ways}")
    if parameter.kind not in ("float", "int", "any") or (parameter.choices and parameter.kind != "float"):
        raise ValueError(f"{parameter.name} is {parameter.allowed()}: write {{ values = [...] }}")
    low, high, spacing = spec["low"], spec["high"], spec.get("spacing", "linear")
    for key in ("low", "high"):
        if wrong := number_problem(spec[key]):
            raise ValueError(f"{key} = {wrong}")
        parameter.parse(spec[key])
    if not low < high:
        raise ValueError(f"low = {shown(low)} must be less than high = {shown(high)}")
    if spacing not in ("linear", "log"):
        raise ValueError(f"spacing = {shown(spacing)}: must be 'linear' or 'log'")
    if spacing == "log" and low <= 0:
        raise ValueError(f"log spacing needs low > 0, not {shown(low)}")
    return Range(parameter.name, low, high, spacing == "log", whole=parameter.kind == "int")


class Design(NamedTuple):
    """Points in the unit cube that sample many parameters at once.

    How to ``draw`` it from n and the number of parameters; whether it ``grows``: a larger n begins with the same
    points; what n ``counts``; how many points each of these has ``beside`` one for each parameter, None if it is a
    single point; and whether it is ``of_sobol``, a sequence that is even for powers of two.
    """

    draw: Callable[[int, int, np.random.Generator], Any]
    grows: bool
    counts: str = "points"
    beside: int | None = None
    of_sobol: bool = False

    def size(self, n: int, dimensions: int) -> int:
        """Return how many points it has."""
        return n if self.beside is None else n * (dimensions + self.beside)

    def make(self, n: int, dimensions: int, seed: int) -> Array:
        """Return its points, (points, parameters), in the unit cube."""
        with warnings.catch_warnings():  # `remarks` says it in our words
            warnings.filterwarnings("ignore", message="The balance properties", category=UserWarning)
            return np.asarray(self.draw(n, dimensions, np.random.default_rng(seed)))


def _scipy(name: str, n: int, dimensions: int, rng: np.random.Generator) -> Any:
    from scipy.stats import qmc

    return getattr(qmc, name)(dimensions, seed=rng).random(n)


def _salib(name: str, n: int, dimensions: int, rng: np.random.Generator, **options: Any) -> Any:
    return getattr(salib().sample, name).sample(unit_cube(dimensions), n, seed=rng, **options)


DESIGNS: Mapping[str, Design] = {
    "sobol": Design(partial(_scipy, "Sobol"), grows=True, of_sobol=True),
    "latin-hypercube": Design(partial(_scipy, "LatinHypercube"), grows=False),
    "halton": Design(partial(_scipy, "Halton"), grows=True),
    "random": Design(lambda n, dimensions, rng: rng.random((n, dimensions)), grows=True),
    "saltelli": Design(
        partial(_salib, "sobol", calc_second_order=False),
        grows=True,
        counts="base points, of (parameters + 2) points each",
        beside=2,
        of_sobol=True,
    ),
    "morris": Design(
        partial(_salib, "morris", num_levels=MORRIS_LEVELS),
        grows=True,
        counts="trajectories, of (parameters + 1) points each",
        beside=1,
    ),
}


def salib() -> Any:
    """Return SALib with its samplers; raises SweepError unless it can be imported."""
    try:
        import SALib
        import SALib.sample.morris
        import SALib.sample.sobol
    except ImportError as error:
        raise SweepError("needs SALib, which is not installed: pip install 'linksweep[sensitivity]'") from error
    return SALib


def remarks(origin: Mapping[str, Any]) -> list[str]:
    """Return the warnings of a run about a design."""
    n, design = origin.get("n", 1), DESIGNS.get(origin.get("design", ""))
    if design is None or not design.of_sobol or n & (n - 1) == 0:
        return []
    below = 1 << (n.bit_length() - 1)
    return [
        f"points.n = {n:,} is not a power of two, for which Sobol points are spread most evenly; take {below:,} or "
        f"{2 * below:,}"
    ]


def unit_cube(dimensions: int) -> dict[str, Any]:
    """Return SALib's definition of a problem with this many parameters between 0 and 1."""
    names = [f"x{k}" for k in range(dimensions)]
    return {"num_vars": dimensions, "names": names, "bounds": [[0.0, 1.0]] * dimensions}
