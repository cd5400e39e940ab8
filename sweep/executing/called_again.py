"""Calls a function again at a point that it has just computed: without random numbers of its own it must return the
same.
"""

from collections.abc import Sequence

import numpy as np

from linksweep.sweep.contract import Point, shown
from linksweep.sweep.executing.captured import undisturbed
from linksweep.sweep.executing.deadlines import Deadlines, TimeLimitError
from linksweep.sweep.executing.own_process import is_interruption
from linksweep.sweep.executing.task import Task
from linksweep.sweep.functions.adapter import FunctionExperiment
from linksweep.sweep.functions.layout import differences
from linksweep.sweep.functions.results import Flat

LONGEST_S = 1.0
"""Seconds of a first call after which there is no second one."""

WHAT_TO_DO = (
    "A function that draws random numbers takes them from its argument rng; one whose results need not be the same "
    "declares @experiment(deterministic=False)"
)

_agreed: set[tuple[str, str | None]] = set()
"""The functions that returned the same twice in this process, by reference and digest."""


def how_it_differs(
    experiment: FunctionExperiment, task: Task, first: Sequence[Flat], seconds: float, deadlines: Deadlines
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
            second = experiment.many(points) if experiment.vectorised else experiment.block(points, 1, iter(()))
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


def _difference(first: Flat, second: Flat) -> str:
    """Return how two results differ, '' where they do not: their order does not matter, and NaN is NaN."""
    if (wrong := differences(first.layout, second.layout)) or differences(second.layout, first.layout):
        return f"and then another one: {'; '.join(wrong) or 'of another type'}"
    one, other = (flat.layout.values(np.frombuffer(flat.row, dtype="<f8")[None]) for flat in (first, second))
    for name, value in one.items():
        if not np.array_equal(value, other[name], equal_nan=value.dtype.kind in "fM"):
            return f"and then one with another {name!r}"
    return ""


def _at(points: Sequence[Point]) -> str:
    if len(points) > 1:
        return f"for the same {len(points):,} points"
    return f"at {', '.join(f'{name} = {shown(value)}' for name, value in points[0].items()) or 'its only point'}"
