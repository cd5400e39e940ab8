"""Values of an axis, written as a list or a range."""

import math
import sys
from typing import Any

from sweep.contract import shown
from sweep.contract.parameter import HUGE, bound_in_words

MAX_AXIS_VALUES = 1_000_000


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
    if keys - {"spacing"} not in ({"start", "stop", "step"}, {"start", "stop", "num"}) or (
        "step" in keys and "spacing" in keys
    ):
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
    ends = {0: start, parts: stop} if _are_integers(start, stop) else {}  # 12 digits may not be all of theirs
    return [ends.get(i, round(v) if math.isfinite(v) else v) for i, v in enumerate(values)]


def _stepped(start: float, stop: float, step: float, whole: bool) -> list[float]:
    if step == 0 or (stop - start) / step < 0:
        raise ValueError(f"step = {shown(step)}: does not lead from start = {shown(start)} to stop = {shown(stop)}")
    count = (stop - start) / step
    if count > MAX_AXIS_VALUES:
        raise ValueError(f"start, stop, step make about {count:.3g} values; at most {MAX_AXIS_VALUES} are allowed")
    if whole and _are_integers(start, stop, step):
        return [start + step * i for i in range(int((stop - start) // step) + 1)]
    unsure = 1e-9 + 2 * sys.float_info.epsilon * max(abs(start), abs(stop)) / abs(step)  # of start and stop as stored
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
    """Return whether x is a finite number that may stand in a study."""
    return isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) < HUGE


def number_problem(x: object) -> str | None:
    """Return why x is no such number, None for one."""
    return None if is_number(x) else f"{shown(x)}: must be a finite number{bound_in_words(x)}"
