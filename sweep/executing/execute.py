"""Defines what an executor is, and the serial executor, which is the reference for all others."""

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass

from threadpoolctl import threadpool_limits

from linksweep.sweep.code.load import source_digest
from linksweep.sweep.executing.isolated import Children
from linksweep.sweep.executing.task import PointBlock, Task, TaskResult
from linksweep.sweep.executing.versions import identity
from linksweep.sweep.executing.worker import run_task
from linksweep.sweep.functions.adapter import FunctionExperiment
from linksweep.sweep.planning.plan import Work
from linksweep.sweep.studies.study import Study

Take = Callable[[int], list[list[Work]]]
"""Returns the work of at most so many tasks that can begin now; once a result has been taken, there may be more."""

Results = Iterator[tuple[list[Work], TaskResult]]
"""The work of each task and its result, which has no rows for the last blocks if they were not started."""

Executor = Callable[[Take], Results]
Opened = AbstractContextManager[tuple["Place", Executor]]
Say = Callable[[str], None]


@dataclass(frozen=True)
class Limits:
    """The time and memory that one block may take.

    Args:
        time_s: seconds; None is no limit.
        memory: bytes in its process; None is no limit.
    """

    time_s: float | None = None
    memory: int | None = None

    def __bool__(self) -> bool:
        return self.time_s is not None or self.memory is not None


NO_LIMITS = Limits()

WORKERS_START_S = 1.5
"""Seconds that worker processes take to start, imports included."""

JUDGED_S = 0.05
"""Seconds of work that show how long the rest takes: a first call may take a hundred times as long as the others."""


@dataclass(frozen=True)
class Place:
    """Where a run is, in words: how many workers if that is known, the Dask dashboard if there is one, and how many
    ``threads`` there are as it begins.
    """

    words: str
    workers: int | None = None
    dashboard: str = ""
    threads: int = 1


def make_task(study: Study, works: list[Work], limits: Limits = NO_LIMITS, enough_s: float = 0.0) -> Task:
    """Return this work as a task; after ``enough_s`` seconds its worker is to return what it has."""
    defaults = study.experiment.defaults()
    units = tuple(
        PointBlock(
            tuple({k: v for k, v in point.parameters.items() if v != defaults[k]} for point in work.points),
            work.points[0].stream,
            work.block,
        )
        for work in works
    )
    reference, sampling = study.experiment_reference, study.sampling
    digest = source_digest(reference)
    repeatable = isinstance(study.experiment, FunctionExperiment) and study.experiment.repeatable
    return Task(reference, sampling.seed, units, sampling.keep_samples, limits.time_s, digest, enough_s, repeatable)


@contextmanager
def serial(study: Study, limits: Limits = NO_LIMITS, apart: bool = False) -> Iterator[tuple[Place, Executor]]:
    """Give an executor that computes one task after the other in this process: the definition of the result.

    With limits, or ``apart``, a child process computes them, since this one must not be ended or changed.
    """
    with ExitStack() as stack:
        stack.enter_context(threadpool_limits(1))  # sums of products must not depend on the number of cores
        compute: Callable[[Task], TaskResult] = run_task
        if apart or limits:
            children = Children(identity(study.experiment_reference), limits.memory, forked=True)
            compute = stack.enter_context(children).run

        def run(take: Take) -> Results:
            while batches := take(1):
                yield batches[0], compute(make_task(study, batches[0], limits))

        yield Place("one process" if apart else "this process", 1), run


@contextmanager
def measured_first(
    study: Study, cost: float, cores: int, elsewhere: Callable[[], Opened], say: Say
) -> Iterator[tuple[Place, Executor]]:
    """Give an executor for work of unknown length: it computes in one process and measures the time, until
    what is left is worth the start of workers ``elsewhere``, which then do the rest.

    The process is this one for code of linksweep's own, and a child for that of others.  ``cost`` is that of all work,
    in the unit of `Work.cost`.
    """
    with ExitStack() as stack:
        first = stack.enter_context(ExitStack())
        place, compute = first.enter_context(serial(study, apart=not study.is_ours))
        moved: list[Executor] = []
        done = busy = 0.0
        slowest = (1.0, 0.0)  # the cost and the seconds of that task, which may have imported: it decides nothing

        def run(take: Take) -> Results:
            nonlocal done, busy, slowest
            if moved:
                yield from moved[0](take)
                return
            for works, result in compute(take):
                yield works, result
                share = len(result.seconds) / sum(len(work.points) for work in works)
                one = (sum(work.cost for work in works) * share, float(result.seconds.sum()))
                done, busy = done + one[0], busy + one[1]
                slowest = max(slowest, one, key=lambda task: task[1] / task[0])
                usual = busy - slowest[1]
                left = max(0.0, cost - done) * usual / max(done - slowest[0], 1e-9)
                if usual > JUDGED_S and left * (1.0 - 1.0 / cores) > WORKERS_START_S:
                    first.close()
                    there, executor = stack.enter_context(elsewhere())
                    moved.append(executor)
                    say(f"the first points took long enough: the rest is done on {there.words}")
                    if there.dashboard:
                        say(f"Dask dashboard: {there.dashboard}")
                    yield from executor(take)
                    return

        yield Place(place.words), run


def available_cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
