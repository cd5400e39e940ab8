"""Takes the layout of a plain function's results from the first one, and requires it of later ones."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from linksweep.sweep.executing.executor import Run
from linksweep.sweep.executing.task import Failure, TaskResult
from linksweep.sweep.functions.adapter import FunctionExperiment
from linksweep.sweep.functions.layout import differences, with_head
from linksweep.sweep.functions.results import Flat
from linksweep.sweep.planning.plan import PlanSize, Work
from linksweep.sweep.planning.work_queue import Pending
from linksweep.sweep.running.failures import FailureCount
from linksweep.sweep.running.writer import Taken, size_of
from linksweep.sweep.studies.study import Study

Done = tuple[list[Work], TaskResult]


def first_results(
    study: Study,
    pending: Pending,
    run: Run,
    workers: int,
    failing: FailureCount,
    tell: Callable[[list[Work], TaskResult, Taken], None],
) -> tuple[Study, list[Done]]:
    """Return a study with the layout of the first result, and all work done to get one; where its outputs are declared,
    return it as it is.

    Each of the ``workers`` gets one task; the first of these, in the order of the points, that has a result decides.
    Where every point fails nothing is known of the results, and the study stays as it is.  Tasks without any result are
    counted by ``failing``, which ends this too, and told at once.
    """
    experiment = study.experiment
    if not isinstance(experiment, FunctionExperiment) or not experiment.undeclared:
        return study, []
    done: list[Done] = []
    values: dict[int, Flat] = {}  # by the index of their point
    failed: set[int] = set()
    tasks = points_out = 0
    most_blocks = pending.most_blocks

    def take(_count: int) -> list[list[Work]]:
        nonlocal tasks, points_out
        if tasks == workers or values or failing.too_many():
            return []
        pending.most_blocks = min(failing.most_at_once or most_blocks, most_blocks)
        given = pending.take(1)
        tasks += len(given)
        points_out += sum(len(work.points) for works in given for work in works)
        return given

    for given, result in run(take):
        works = pending.settle(given, result.seconds, result.cold)
        done.append((works, result))
        points = [point for work in works for point in work.points]
        values |= {points[row].index: value for row, value in result.values.items()}
        points_out -= sum(len(work.points) for work in given)
        if not result.values:
            why = {points[row].index: failure for row, failure in result.failures.items()}
            ended = {point.index: point for point in points if point.index not in failed}
            failed |= why.keys()
            failing.take(ended.values(), why)
            size = replace(size_of(works, len(ended)), realisations=0)
            tell(works, result, Taken(size, PlanSize(0, 0, 0, 0.0), tuple(ended.values()), why))
            if failing.too_many():
                break  # without waiting for tasks under way
        if not points_out:
            tasks = 0
    if not values:
        return study, done
    return replace(study, experiment=experiment.with_layout(values[min(values)].layout.floats)), done


def as_rows(experiment: FunctionExperiment, works: Sequence[Work], result: TaskResult) -> TaskResult:
    """Return the result of a task with a row for each value that has the layout of the first; others fail."""
    sums = np.full((len(result.seconds), experiment.sums_width), np.nan)
    failures, samples, texts = dict(result.failures), {}, {}
    counts = [work.block.realisations for work in works for _ in work.points]
    for row, value in result.values.items():
        if row in failures:
            continue
        content = _held(experiment, value, counts[row])
        if isinstance(content, Failure):
            failures[row] = content
            continue
        sums[row] = np.frombuffer(content, dtype="<f8")
        texts.update(value.texts)
        if value.kept is not None:
            samples[row] = value.kept
    return replace(result, sums=sums, failures=failures, samples=samples, texts=texts)


def _held(experiment: FunctionExperiment, value: Flat, realisations: int) -> bytes | Failure:
    expected, found = experiment.layout, value.layout
    assert expected is not None, "the first value says what it is"
    wrong = () if found is expected or found == expected else differences(expected, found)
    if experiment.rng and not wrong and found.places != expected.places:
        wrong = ("its results are in another order",)
    if wrong:
        return Failure("exception", f"{experiment.name}: not as at the first point: {'; '.join(wrong)}")
    if experiment.rng:
        return np.float64(realisations).tobytes() + value.row
    return with_head(value.row, found, expected)
