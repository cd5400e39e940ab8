"""Calls plain functions for many points at once, and again: what they return must depend on the point alone."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Experiment, Outcome, Point, shown
from linksweep.sweep.executing.process import Deadlines, TimeLimitError, captured, is_interruption, undisturbed
from linksweep.sweep.executing.task import Failure, Task, TaskResult, failed
from linksweep.sweep.functions.results import differences, same_value

CHECKED = 3
"""Points of a process's first call of a vectorised function for more than these that are also computed alone."""

_DEPENDENCE: dict[tuple[str, str | None], str] = {}
"""How points of vectorised functions depend on those beside them, by the reference and the digest of the function."""

LONGEST_S = 1.0
"""Seconds of a first call after which there is no second one."""

WHAT_TO_DO = (
    "A function that draws random numbers takes them from its argument rng; one whose results need not be the same "
    "declares @experiment(deterministic=False)"
)

_agreed: set[tuple[str, str | None]] = set()
"""The functions that returned the same twice in this process, by reference and digest."""


def points_together(experiment: Experiment, task: Task, deadlines: Deadlines) -> TaskResult | None:
    """Return the results of all points of a task from one call of a vectorised function, or None where it raises.

    The first call in a process also computes some points alone; where a result differs, all points fail, in this call
    and later ones.
    """
    defaults = experiment.defaults()
    points = [defaults | unit.points[0] for unit in task.units]
    who = task.experiment_reference, task.source_digest
    if wrong := _DEPENDENCE.get(who, ""):
        return failed(len(points), Failure("exception", wrong))
    begun = time.perf_counter()
    with captured() as said:
        try:
            limit = None if task.time_limit_s is None else task.time_limit_s * (len(points) + CHECKED)
            with undisturbed(task.seed_of(task.units[0])), deadlines.within(limit):
                outcomes = experiment.compute(points, 1, ())
                if who not in _DEPENDENCE:
                    wrong = dependence(experiment, points, outcomes, [unit.stream for unit in task.units])
                    if wrong or len(points) > CHECKED:
                        _DEPENDENCE[who] = wrong
        except BaseException as error:  # which point is to blame is found out one by one
            if is_interruption(error):
                raise
            return None
        taken, seconds = said.taken(), time.perf_counter() - begun
        refused = how_it_differs(experiment, task, outcomes, seconds, deadlines)
    result = failed(len(points), Failure("exception", wrong) if wrong else None)
    if not wrong:
        result.outcomes.update(enumerate(outcomes))
    if taken is not None:
        result.said[0] = taken
    result.seconds[:] = seconds / len(points)
    result.refused = refused
    return result


def dependence(
    experiment: Experiment, points: Sequence[Point], outcomes: Sequence[Outcome], digests: Sequence[bytes]
) -> str:
    """Return how one of many points differs from the result of that point alone, in words; '' where none does.

    The points with the least digests are compared: the same of the same points, whatever their order, and at least one
    that is neither the first nor the last.  Raises whatever the function raises.
    """
    among = _columns(outcomes)
    for place in sorted(range(len(points)), key=digests.__getitem__)[:CHECKED]:
        alone = _columns(experiment.compute([points[place]], 1, ()))
        for name in among.keys() & alone.keys():
            there, here = np.asarray(among[name][place]), np.asarray(alone[name][0])
            differ = _differ(there, here, among[name], experiment.tolerance)
            if differ.any():
                where = ", ".join(f"{parameter}={shown(value)}" for parameter, value in points[place].items())
                return (
                    f"{experiment.name}: {name!r} is {_shown(there, differ)} in a call for {len(points):,} points, but "
                    f"{_shown(here, differ)} for the same point ({where}) alone; what a vectorised function returns "
                    "for a point must not depend on the others by more than its tolerance (1e-12 if it declares none)"
                )
    return ""


def _columns(outcomes: Sequence[Outcome]) -> dict[str, NDArray[Any]]:
    """Return the results of points of one layout by name, (points, ...)."""
    fields = outcomes[0].layout.fields
    return {field.name: np.array([outcome.row[k] for outcome in outcomes]) for k, field in enumerate(fields)}


def _differ(one: NDArray[Any], other: NDArray[Any], everything: NDArray[Any], tolerance: float) -> NDArray[np.bool_]:
    """Return which values differ, or that the shapes do; floats by more than the tolerance, relative to them or to a
    hundredth of the largest that another point has in their place, as for those that are zero but for rounding.
    """
    if one.shape != other.shape:
        return np.array(True)
    if one.dtype.kind != "f" or other.dtype.kind != "f":
        return np.asarray(one != other)
    finite = np.isfinite(one) & np.isfinite(other)
    size = 0.01 * np.max(np.abs(everything), axis=0, where=np.isfinite(everything), initial=0.0)
    largest = np.maximum(np.maximum(np.abs(one), np.abs(other)), size)
    far = np.abs(np.where(finite, one, 0.0) - np.where(finite, other, 0.0)) > tolerance * largest
    same = (one == other) | (np.isnan(one) & np.isnan(other))
    return np.asarray(np.where(finite, far, ~same))


def _shown(value: NDArray[Any], differ: NDArray[np.bool_]) -> str:
    """Return the first of the values that differ, or the shape where these do."""
    if value.shape != differ.shape:
        return f"of the shape {value.shape}"
    first = value.reshape(-1)[int(np.argmax(differ))]
    return "another text" if value.dtype.kind in "UO" else str(first)


def how_it_differs(
    experiment: Experiment, task: Task, first: Sequence[Outcome], seconds: float, deadlines: Deadlines
) -> str:
    """Return a sentence if a second call at the points of a task gives other results than the ``first``, which took so
    many ``seconds``; '' if it gives the same, and where there is no second one.
    """
    who = task.experiment_reference, task.source_digest
    if not task.repeatable or who in _agreed or seconds > LONGEST_S:
        return ""
    points = [experiment.defaults() | unit.points[0] for unit in task.units]
    try:
        limit = None if task.time_limit_s is None else task.time_limit_s * len(points)
        # Other random numbers than at first, if it takes those of the process.
        with undisturbed(task.seed_of(task.units[0]) ^ 1), deadlines.within(limit):
            second = experiment.compute(points, 1, ())
        differing = (found for one, other in zip(first, second, strict=True) if (found := _difference(one, other)))
        found = next(differing, "")
    except TimeLimitError:
        return ""
    except BaseException as error:
        if is_interruption(error):
            raise
        found = f"and then raises {type(error).__name__}"
    if not found:
        _agreed.add(who)
        return ""
    return f"{experiment.name}: called twice {_at(points)}, it returns a result {found}. {WHAT_TO_DO}"


def _difference(first: Outcome, second: Outcome) -> str:
    """Return how two results differ, '' where they do not: their order does not matter, and NaN is NaN."""
    if (wrong := differences(first.layout, second.layout)) or differences(second.layout, first.layout):
        return f"and then another one: {'; '.join(wrong) or 'of another type'}"
    other = dict(zip((field.name for field in second.layout.fields), second.row, strict=True))
    for field, value in zip(first.layout.fields, first.row, strict=True):
        if not same_value(value, other[field.name]):
            return f"and then one with another {field.name!r}"
    return ""


def _at(points: Sequence[Point]) -> str:
    if len(points) > 1:
        return f"for the same {len(points):,} points"
    return f"at {', '.join(f'{name} = {shown(value)}' for name, value in points[0].items()) or 'its only point'}"
