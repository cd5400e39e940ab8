"""Values of parameters, alone, along an axis and in a column, checked against the experiment."""

import math
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from linksweep.sweep.contract import Experiment, SweepError, Value, shown
from linksweep.sweep.contract.parameter import HUGE, bound_in_words
from linksweep.sweep.formatting import first_of
from linksweep.sweep.studies.problems import Problems
from linksweep.sweep.studies.source import Place
from linksweep.sweep.tables.file import table_file

MAX_AXIS_VALUES = 1_000_000


class Values:
    """Reads values of the parameters of an experiment; ``problems`` takes what is wrong.

    Paths of files are relative to ``folder``, or to the working directory where an option gives them.
    """

    def __init__(self, experiment: Experiment, folder: Path, problems: Problems) -> None:
        self.experiment, self.problems = experiment, problems
        self._folder = folder

    def one(self, place: Place, name: str, raw: object, which: str = "") -> Value:
        """Return the value at a place, None if it is wrong; problems begin with ``which``."""
        try:
            parameter = self.experiment.parameter(name)
            value = parameter.parse(raw)
            folder = Path.cwd() if place[:2] in self.problems.overridden else self._folder
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
            repeated = [shown(value) for value, n in Counter(values or ()).items() if n > 1]
            if repeated:
                self.problems.add(place, f"duplicate value{'s' if len(repeated) > 1 else ''} {first_of(repeated, 10)}")
            return values
        return None

    def several(
        self, place: Place, name: str, raw_values: Sequence[object], rows: bool = False
    ) -> tuple[Value, ...] | None:
        """Return values of one type, None if any is wrong; problems name the row, from 1, where they are ``rows``."""
        before = len(self.problems.found)
        values = []
        for number, raw in enumerate(raw_values, start=1):
            values.append(self.one(place, name, raw, f"row {number}: " if rows else ""))
            if len(self.problems.found) >= before + 5:
                self.problems.add(place, "... and perhaps more values like these")
                return None
        if len(self.problems.found) > before:
            return None
        if self.experiment.parameter(name).kind == "any":
            kinds = {type(value) for value in values}
            if kinds == {int, float}:
                values = [float(value) for value in values]
            elif len(kinds) > 1:
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
    spacing = spec.get("spacing", "linear")
    if keys not in ({"start", "stop", "step"}, {"start", "stop", "num"}, {"start", "stop", "num", "spacing"}):
        raise ValueError(
            f"keys {shown(sorted(map(str, keys)))}: allowed are values; start, stop, step; start, stop, num and spacing"
        )
    for key in ("start", "stop", "step", "num"):
        if key in spec and (wrong := number_problem(spec[key])):
            raise ValueError(f"{key} = {wrong}")
    start, stop = spec["start"], spec["stop"]
    if "step" in spec:
        return _stepped(start, stop, spec["step"], whole)
    return _numbered(start, stop, spec["num"], spacing, whole)


def _numbered(start: float, stop: float, num: object, spacing: object, whole: bool) -> list[float]:
    if not isinstance(num, int) or not 1 <= num <= MAX_AXIS_VALUES:
        raise ValueError(f"num = {shown(num)}: must be an integer from 1 to {MAX_AXIS_VALUES}")
    parts = max(num - 1, 1)
    if spacing == "linear":
        if whole and _are_integers(start, stop) and (stop - start) % parts == 0:
            return [start + (stop - start) // parts * i for i in range(num)]
        return [_rounded(start + (stop - start) * i / parts, (stop - start) / parts) for i in range(num)]
    if spacing != "log":
        raise ValueError(f"spacing = {shown(spacing)}: must be 'linear' or 'log'")
    if start <= 0 or stop <= 0:
        raise ValueError(f"log spacing needs start and stop > 0, not {shown(start)} and {shown(stop)}")
    values = [_rounded(start * (stop / start) ** (i / parts)) for i in range(num)]
    if not whole:
        return values
    ends = {0: start, parts: stop} if _are_integers(start, stop) else {}  # they may have more than 12 digits
    return [ends.get(i, round(v) if math.isfinite(v) else v) for i, v in enumerate(values)]


def _stepped(start: float, stop: float, step: float, whole: bool) -> list[float]:
    if step == 0 or (stop - start) / step < 0:
        raise ValueError(f"step = {shown(step)}: does not lead from start = {shown(start)} to stop = {shown(stop)}")
    count = (stop - start) / step
    if count > MAX_AXIS_VALUES:
        raise ValueError(f"start, stop, step make about {count:.3g} values; at most {MAX_AXIS_VALUES} are allowed")
    if whole and _are_integers(start, stop, step):
        return [start + step * i for i in range(int((stop - start) // step) + 1)]
    unsure = 1e-9 + 2 * sys.float_info.epsilon * max(abs(start), abs(stop)) / abs(step)  # rounding of start and stop
    return [_rounded(start + step * i, step) for i in range(math.floor(count + min(unsure, 1e-3)) + 1)]


def _are_integers(*numbers: float) -> bool:
    return all(isinstance(number, int) for number in numbers)


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
