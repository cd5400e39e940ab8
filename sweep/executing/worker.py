"""Computes a task on a worker: its blocks, one after the other."""

import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from itertools import chain, groupby
from typing import Any

from linksweep.sweep.code.load import load_experiment
from linksweep.sweep.contract import Experiment, GeneratorPair, Point, SweepError
from linksweep.sweep.executing.function_calls import how_it_differs, points_together
from linksweep.sweep.executing.process import (
    Captured,
    Deadlines,
    TimeLimitError,
    captured,
    is_interruption,
    undisturbed,
)
from linksweep.sweep.executing.task import (
    Call,
    Failure,
    PointBlock,
    Task,
    TaskResult,
    failed,
    failure_of,
    joined,
    too_long,
)
from linksweep.sweep.planning.plan import generators_of

ENOUGH_S = 2.0
"""Seconds after which a task returns what it has, so that its results do not wait for those of slower points."""

MOST_CATALOGUES = 256
"""Most catalogues in one call."""

IMPORTS_S = 30.0
"""A first call in a process that takes longer is slow by itself; a shorter one may be so for what it imports."""

_called: set[tuple[str, str | None, int]] = set()
"""The experiments that were called in this process, by reference, digest and thread."""


def compute(task: Task | Call, deadlines: Deadlines | None = None) -> Any:
    """Return the result of a task; of a call its value and None, or None and what it raised."""
    if isinstance(task, Task):
        return run_task(task, deadlines)
    try:
        with (deadlines or Deadlines()).within(task.time_limit_s):
            return task.function(*task.arguments), None
    except TimeLimitError:
        return None, SweepError(f"a piece of the work took longer than the time limit of {task.time_limit_s:g} s")
    except Exception as error:  # raised again by the client
        return None, error


def run_task(task: Task, deadlines: Deadlines | None = None) -> TaskResult:
    """Compute the blocks of a task, but begin no further one after `ENOUGH_S` or the task's ``enough_s``, whichever is
    longer; a point that raises is recorded and the rest goes on.

    ``deadlines`` are those of this process if it has any.
    """
    begun = time.monotonic()
    results: list[TaskResult] = []
    for result in run_units(task, deadlines or Deadlines()):
        results.append(result)
        if time.monotonic() - begun > max(ENOUGH_S, task.enough_s):
            break
    return joined(results)


def run_units(task: Task, deadlines: Deadlines) -> Iterator[TaskResult]:
    """Yield the result of each unit of a task; the other blocks of a point that took too long are not tried."""
    who = task.experiment_reference, task.source_digest, threading.get_ident()
    for result in _run_units(task, deadlines):
        result.cold = who not in _called and float(result.seconds[0]) < IMPORTS_S
        _called.add(who)
        yield result


def _run_units(task: Task, deadlines: Deadlines) -> Iterator[TaskResult]:
    experiment = load_experiment(task.experiment_reference, digest=task.source_digest)
    if experiment.vectorised and len(task.units) > 1:
        together = points_together(experiment, task, deadlines)
        if together is not None:
            yield together
            return
    with captured() if task.caught else nullcontext(Captured()) as said:
        several = takes_several(experiment, task)
        for units in alike(task.units) if several else [task.units]:
            known = catalogues_together(experiment, task, units) if several else None
            if known is None:
                said.taken()  # the units say it again, one by one
                yield from _one_by_one(experiment, task, units, deadlines, said)
                continue
            if (told := said.taken()) is not None:
                known.said[0] = told
            yield known


def _one_by_one(
    experiment: Experiment, task: Task, units: Sequence[PointBlock], deadlines: Deadlines, said: Captured
) -> Iterator[TaskResult]:
    """Yield the result of each of these units of a task, with what was ``said`` meanwhile."""
    defaults = experiment.defaults()
    given_up: list[tuple[bytes, dict[str, Any], Failure]] = []
    for unit in units:
        pairs = [] if experiment.deterministic else generators_of(task.seed, unit.stream, unit.block)
        result = failed(len(unit.points))
        for stream, point, reason in given_up:
            known = [row for row, own in enumerate(unit.points) if (stream, point) == (unit.stream, own)]
            result.failures.update(dict.fromkeys(known, reason))
        rows = [row for row in range(len(unit.points)) if row not in result.failures]
        begun = time.perf_counter()
        points = [defaults | unit.points[row] for row in rows]
        if rows and not _try(experiment, points, rows, unit, pairs, task, result, deadlines) and len(rows) > 1:
            for point, row in zip(points, rows, strict=True):  # which of those that share the draw is to blame?
                afresh = generators_of(task.seed, unit.stream, unit.block)
                _try(experiment, [point], [row], unit, afresh, task, result, deadlines)
        if (told := said.taken()) is not None:
            result.said[min(rows, default=0)] = told
        result.seconds[rows] = (time.perf_counter() - begun) / max(1, len(rows))
        if task.repeatable and 0 in result.outcomes:
            seconds = float(result.seconds[0])
            alone = replace(task, units=(unit,))
            result.refused = how_it_differs(experiment, alone, [result.outcomes[0]], seconds, deadlines)
            said.taken()  # what the second call says was said by the first
        late = [row for row in rows if row in result.failures and result.failures[row].kind == "time limit"]
        given_up += [(unit.stream, unit.points[row], result.failures[row]) for row in late]
        yield result


def _try(
    experiment: Experiment,
    points: Sequence[Point],
    rows: list[int],
    unit: PointBlock,
    pairs: Sequence[GeneratorPair],
    task: Task,
    result: TaskResult,
    deadlines: Deadlines,
) -> bool:
    """Compute some points of a unit and fill in these rows of its result; return whether that succeeded."""
    try:
        with (
            undisturbed(task.seed_of(unit)),
            deadlines.within(None if task.time_limit_s is None else task.time_limit_s * len(rows)),
        ):
            outcomes = experiment.compute(points, unit.block.n_sim, pairs, task.keep_samples)
    except TimeLimitError:
        reason = too_long(task, traceback.format_exc())
    except BaseException as error:  # a point that fails, or leaves with sys.exit, must not take others with it
        if is_interruption(error) or not task.caught:
            raise
        reason = failure_of(error)
    else:
        result.outcomes.update(zip(rows, outcomes, strict=True))
        for row in rows:
            result.failures.pop(row, None)
        return True
    result.failures.update(dict.fromkeys(rows, reason))
    return False


def alike(units: Sequence[PointBlock]) -> Iterator[tuple[PointBlock, ...]]:
    """Yield units in groups: those of small catalogues of one point with equally many realisations, and those between
    them, whose blocks have only one catalogue.
    """
    for small, group in groupby(units, lambda u: (u.stream, u.block.n_sim, u.points) if u.block.n_cat > 1 else None):
        if small is None:
            yield tuple(group)
        else:
            whole = tuple(group)
            most = max(1, MOST_CATALOGUES // max(unit.block.n_cat for unit in whole))
            yield from (whole[first : first + most] for first in range(0, len(whole), most))


def takes_several(experiment: Experiment, task: Task) -> bool:
    """Return whether catalogues may be evaluated in one call: no realisation is kept, no block has a time limit."""
    return experiment.evaluate_catalogues is not None and not task.keep_samples and task.time_limit_s is None


def catalogues_together(experiment: Experiment, task: Task, units: tuple[PointBlock, ...]) -> TaskResult | None:
    """Return the sums of blocks of one point whose catalogues are evaluated in one call.

    None where they are large, and where the call raises: one by one the blocks show which is to blame.
    """
    n_cat = [unit.block.n_cat for unit in units]
    if experiment.evaluate_catalogues is None or n_cat[0] == 1:
        return None
    points = [experiment.defaults() | point for point in units[0].points]
    begun = time.perf_counter()
    try:
        blocks = [generators_of(task.seed, unit.stream, unit.block) for unit in units]
        with undisturbed(task.seed_of(units[0])):
            pairs = list(chain.from_iterable(blocks))
            outcomes = experiment.compute_catalogues(points, units[0].block.n_sim, pairs, n_cat)
    except BaseException as error:
        if is_interruption(error):
            raise
        return None
    result = failed(len(outcomes))
    result.outcomes.update(enumerate(outcomes))
    result.seconds[:] = (time.perf_counter() - begun) / len(result.seconds)
    return result
