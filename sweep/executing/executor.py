"""Chooses where jobs are computed, and computes them there: in this process, until they turn out long, or by Dask."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import count, islice
from typing import Any

from threadpoolctl import threadpool_limits

from linksweep.sweep.code.load import identity
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.children import Children
from linksweep.sweep.executing.forkserver import start_method
from linksweep.sweep.executing.pools import (
    DEFAULT_POOL,
    NO_LIMITS,
    POOLS,
    Limits,
    Resources,
    available_cores,
    uncollected,
)
from linksweep.sweep.executing.task import AnyJob, Batch, Call, Executor, Opened, Place, RefusedError, Say, TaskResult
from linksweep.sweep.executing.worker import compute
from linksweep.sweep.planning.plan import Work
from linksweep.sweep.studies.study import Study

Map = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[Any]]

WORKERS_START_S = 1.5
"""Seconds that worker processes take to start, imports included."""

JUDGED_S = 0.05
"""Seconds of work that show how long the rest takes: a first call may take a hundred times as long as the others."""

CERTAINLY_LONG = 5e7
"""Random numbers that take half a second to draw: a run of more is worth the start of workers, whatever it computes."""


Run = Callable[[Callable[[int], list[list[Work]]]], Iterator[tuple[list[Work], TaskResult]]]
"""An executor of the work of one study."""


def choose_executor(study: Study, cost: float, resources: Resources, say: Say) -> Opened:
    """Return a context manager that gives the place and the executor of a run with this ``cost``.

    Where nothing is requested these are worker processes, one per core.  Unless the cost that the experiment declares
    shows that they are needed, they are started only once the time that the first points take does.
    """
    if resources.none_requested and (not study.experiment.says_cost or cost < CERTAINLY_LONG):
        return measured_first(study, cost, lambda: _opened(study.experiment_reference, resources, say), say)
    return _opened(study.experiment_reference, resources, say)


def _opened(reference: str, resources: Resources, say: Say) -> Opened:
    if resources.scheduler is not None or resources.cluster is not None:
        from linksweep.sweep.executing.clusters import elsewhere

        return elsewhere(reference, resources, say)
    pool, workers = POOLS[resources.pool or DEFAULT_POOL], resources.workers or available_cores()
    opened: Opened = pool.open(reference, workers, say, resources.limits, resources.dashboard)
    return opened


def of_study(study: Study, execute: Executor) -> Run:
    """Return an executor of the work of a study; it raises RefusedError where a worker refuses its results."""

    def run(take: Callable[[int], list[list[Work]]]) -> Iterator[tuple[list[Work], TaskResult]]:
        results = execute(lambda number: [Batch(study, works) for works in take(number)])
        return (_accepted(batch.works, result) for batch, result in results)

    return run


def _accepted(works: list[Work], result: TaskResult) -> tuple[list[Work], TaskResult]:
    if result.refused:
        raise RefusedError(f"{result.refused}.")
    return works, result


@contextmanager
def processes(
    reference: str, workers: int, say: Say, limits: Limits = NO_LIMITS, dashboard: bool = False
) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on worker processes of one thread each, on this machine."""
    with ExitStack() as stack:
        with uncollected():
            stack.enter_context(start_method())  # its server imports Dask while this process does
            from linksweep.sweep.executing.clusters import on_processes

            opened = stack.enter_context(on_processes(reference, workers, say, limits, dashboard))
        yield opened


@contextmanager
def serial(
    reference: str,
    _workers: int = 1,
    _say: Say = print,
    limits: Limits = NO_LIMITS,
    _dashboard: bool = False,
    apart: bool = False,
) -> Iterator[tuple[Place, Executor]]:
    """Give an executor that computes one job after the other in this process: the definition of the result.

    With limits, or ``apart``, a child process computes them, since this one must not be ended or changed.
    """
    with ExitStack() as stack:
        stack.enter_context(threadpool_limits(1))  # sums of products must not depend on the number of cores
        run: Callable[[Any], Any] = compute
        if apart or limits:
            run = stack.enter_context(Children(identity(reference), limits.memory, forked=True)).run

        def execute(take: Callable[[int], Sequence[AnyJob]]) -> Iterator[tuple[AnyJob, Any]]:
            while jobs := take(1):
                yield jobs[0], run(jobs[0].task(limits, 0.0))

        yield Place("one process" if apart else "this process", 1), execute


@contextmanager
def measured_first(
    study: Study, cost: float, elsewhere: Callable[[], Opened], say: Say
) -> Iterator[tuple[Place, Executor]]:
    """Give an executor for work of unknown length: it computes in one process and measures the time, until
    what is left is worth the start of workers ``elsewhere``, which then do the rest.

    The process is this one for code of linksweep's own, and a child for that of others.  ``cost`` is that of all work,
    in the unit of `Work.cost`.
    """
    with ExitStack() as stack:
        first = stack.enter_context(ExitStack())
        place, compute_here = first.enter_context(serial(study.experiment_reference, apart=not study.is_ours))
        moved: list[Executor] = []
        done = busy = 0.0
        slowest = (1.0, 0.0)  # the cost and the seconds of that task, which may have imported: it decides nothing

        def execute(take: Callable[[int], Sequence[AnyJob]]) -> Iterator[tuple[AnyJob, Any]]:
            nonlocal done, busy, slowest
            if moved:
                yield from moved[0](take)
                return
            for job, result in compute_here(take):
                yield job, result
                one = job.cost * len(result.seconds) / len(job), float(result.seconds.sum())
                done, busy = done + one[0], busy + one[1]
                slowest = max(slowest, one, key=lambda task: task[1] / task[0])
                usual = busy - slowest[1]
                left = max(0.0, cost - done) * usual / max(done - slowest[0], 1e-9)
                if usual > JUDGED_S and left * (1.0 - 1.0 / available_cores()) > WORKERS_START_S:
                    first.close()
                    there, executor = stack.enter_context(elsewhere())
                    moved.append(executor)
                    say(f"the first points took long enough: the rest is done on {there.words}")
                    if there.dashboard:
                        say(f"Dask dashboard: {there.dashboard}")
                    yield from executor(take)
                    return

        yield Place(place.words), execute


@contextmanager
def mapped(reference: str, resources: Resources, say: Say) -> Iterator[Map]:
    """Give a function that maps another one over many pieces, with results in the order of the pieces: in this process
    where nothing is requested, else on the workers, which must have the code of this experiment.

    A piece gives the same bits wherever it is computed; what the function raises is raised here.  Raises SweepError
    for limits without worker processes, which alone may be ended.
    """
    if resources.limits and resources.pool not in (None, DEFAULT_POOL):
        raise SweepError("limits of time and memory need worker processes here")
    opened = serial(reference) if resources.none_requested else _opened(reference, resources, say)
    with opened as (_, execute):

        def ordered(function: Callable[..., Any], pieces: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
            numbers, arguments = count(), iter(pieces)
            early: dict[int, Any] = {}
            turn = 0

            def take(most: int) -> list[Call]:
                room = max(0, most - len(early))  # results that wait for others are in memory too
                return [Call(reference, next(numbers), function, piece) for piece in islice(arguments, room)]

            for call, (value, error) in execute(take):
                if error is not None:
                    raise error
                early[call.number] = value
                while turn in early:
                    yield early.pop(turn)
                    turn += 1

        yield ordered
