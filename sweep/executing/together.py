"""Blocks that are computed in one call: points of a vectorised function, small catalogues of one point."""

import time
from collections.abc import Iterator, Sequence
from itertools import chain, groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Experiment, Point, check_finite, checked, shown
from linksweep.sweep.executing.called_again import how_it_differs
from linksweep.sweep.executing.captured import captured, undisturbed
from linksweep.sweep.executing.deadlines import Deadlines
from linksweep.sweep.executing.own_process import is_interruption
from linksweep.sweep.executing.task import Failure, PointBlock, Task, TaskResult, failed
from linksweep.sweep.functions.adapter import FunctionExperiment
from linksweep.sweep.functions.layout import Layout
from linksweep.sweep.functions.results import Flat
from linksweep.sweep.planning.streams import block_generators

MOST_CATALOGUES = 256
"""Most catalogues in one call."""

CHECKED = 3
"""Points of a process's first call of a vectorised function for more than these that are also computed alone."""

_DEPENDENCE: dict[tuple[str, str | None], str] = {}
"""How points of vectorised functions depend on those beside them, by the reference and the digest of the function."""


def points_together(experiment: FunctionExperiment, task: Task, deadlines: Deadlines) -> TaskResult | None:
    """Return the results of all points of a task from one call of a vectorised function, or None where it raises.

    The first call in a process also computes some points alone; where a result differs, all points fail, in this call
    and later ones.
    """
    defaults = experiment.defaults()
    points = [defaults | unit.points[0] for unit in task.units]
    who = task.experiment_reference, task.source_digest
    if wrong := _DEPENDENCE.get(who, ""):
        return failed(len(points), experiment.sums_width, Failure("exception", wrong))
    begun = time.perf_counter()
    with captured() as said:
        try:
            limit = None if task.time_limit_s is None else task.time_limit_s * (len(points) + CHECKED)
            with undisturbed(task.seed_of(task.units[0])), deadlines.within(limit):
                values = experiment.many(points)
                if who not in _DEPENDENCE:
                    wrong = dependence(experiment, points, values, [unit.stream for unit in task.units])
                    if wrong or len(points) > CHECKED:
                        _DEPENDENCE[who] = wrong
        except BaseException as error:  # which point is to blame is found out one by one
            if is_interruption(error):
                raise
            return None
        told, seconds = said.taken(), time.perf_counter() - begun
        refused = how_it_differs(experiment, task, values, seconds, deadlines)
    result = failed(len(points), experiment.sums_width, Failure("exception", wrong) if wrong else None)
    if not wrong:
        result.values.update(enumerate(values))
    if told is not None:
        result.said[0] = told
    result.seconds[:] = seconds / len(points)
    result.refused = refused
    return result


def dependence(
    experiment: FunctionExperiment, points: Sequence[Point], values: Sequence[Flat], digests: Sequence[bytes]
) -> str:
    """Return how one of many points differs from the result of that point alone, in words; '' where none does.

    The points with the least digests are compared: the same of the same points, whatever their order, and at least one
    that is neither the first nor the last.  Raises whatever the function raises.
    """
    among = _columns(values[0].layout, values)
    for place in sorted(range(len(points)), key=digests.__getitem__)[:CHECKED]:
        (own,) = experiment.many([points[place]])
        alone = _columns(own.layout, [own])
        for name in among.keys() & alone.keys():
            there, here = among[name][place], alone[name][0]
            differ = _differ(there, here, among[name], experiment.tolerance)
            if differ.any():
                where = ", ".join(f"{parameter}={shown(value)}" for parameter, value in points[place].items())
                return (
                    f"{experiment.name}: {name!r} is {_shown(there, differ)} in a call for {len(points):,} points, but "
                    f"{_shown(here, differ)} for the same point ({where}) alone; what a vectorised function returns "
                    "for a point must not depend on the others by more than its tolerance (1e-12 if it declares none)"
                )
    return ""


def _columns(layout: Layout, values: Sequence[Flat]) -> dict[str, NDArray[Any]]:
    rows = np.frombuffer(b"".join(value.row for value in values), dtype="<f8").reshape(len(values), -1)
    return layout.values(rows)


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
    return "another text" if value.dtype.kind == "V" else str(first)


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
    shapes = {name: (sum(n_cat), len(points), *shape) for name, shape in experiment.sums.items()}
    begun = time.perf_counter()
    try:
        blocks = block_generators(task.seed, [(unit.stream, unit.block) for unit in units])
        with undisturbed(task.seed_of(units[0])):
            drawn = experiment.evaluate_catalogues(points, units[0].block.n_sim, list(chain.from_iterable(blocks)))
        sums = checked("evaluate_catalogues", drawn, "sum", shapes)
        check_finite(sums, experiment.nan_sums)
    except BaseException as error:
        if is_interruption(error):
            raise
        return None
    flat = iter(np.concatenate([array.reshape(sum(n_cat), len(points), -1) for array in sums.values()], axis=2))
    result = failed(len(units) * len(points), experiment.sums_width)
    for number, catalogues in enumerate(n_cat):
        total = np.zeros((len(points), experiment.sums_width))
        for _ in range(catalogues):
            total += next(flat)  # in the order in which `run_block` adds them
        result.sums[number * len(points) : (number + 1) * len(points)] = total
    result.seconds[:] = (time.perf_counter() - begun) / len(result.seconds)
    return result
