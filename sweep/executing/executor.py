"""Chooses where jobs are computed, and computes them there: in this process, until they turn out long, in threads or
child processes of it, or by Dask.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import count, islice
from queue import SimpleQueue
from threading import Thread
from typing import Any

from threadpoolctl import threadpool_limits

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.children import Children
from linksweep.sweep.executing.pools import DEFAULT_POOL, NO_LIMITS, POOLS, Limits, Resources, available_cores
from linksweep.sweep.executing.task import (
    AnyJob,
    Batch,
    Call,
    Executor,
    Keep,
    Opened,
    Place,
    RefusedError,
    Say,
    TaskResult,
)
from linksweep.sweep.executing.worker import compute
from linksweep.sweep.planning.plan import Work
from linksweep.sweep.studies.study import Study

Map = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[Any]]

# Seconds of work that are worth the start of worker processes: each imports for itself what its first point needs.
WORKERS_START_S = 0.3

# Seconds of work that show how long the rest takes: a first call may take a hundred times as long as the others.
JUDGED_S = 0.05

# Random numbers that take half a second to draw: a run of more is worth the start of workers, whatever it computes.
CERTAINLY_LONG = 5e7

# Results that may wait in memory for one before them.
MOST_WAITING = 16

# An executor of the work of one study.
Run = Callable[[Callable[[int], list[list[Work]]]], Iterator[tuple[list[Work], TaskResult]]]


def choose_executor(study: Study, cost: float, resources: Resources, say: Say) -> Opened:
    """Return a context manager that gives the place and the executor of a run with this ``cost``.

    Where nothing is requested these are worker processes, one per core.  Unless the cost that the experiment declares
    shows that they are needed, they are started only once the time that the first points take does.
    """
    if resources.none_requested and (not study.experiment.says_cost or cost < CERTAINLY_LONG):
        return _measured_first(study, cost, say)
    return _opened(study.experiment_reference, resources, say)


def _opened(reference: str, resources: Resources, say: Say) -> Opened:
    if (resources.scheduler, resources.cluster, resources.client, resources.dashboard) != (None, None, None, False):
        from linksweep.sweep.executing.clusters import dask_workers

        return dask_workers(reference, resources, say)
    pool, workers = POOLS[resources.pool or DEFAULT_POOL], resources.workers or available_cores()
    opened: Opened = pool.open(reference, workers, resources.limits)
    return opened


def of_study(study: Study, execute: Executor, is_missing: Callable[[int], bool], keep: Keep) -> Run:
    """Return an executor of the work of a study, as long as its points are missing, that lets workers ``keep`` what is
    large; it raises RefusedError where a
    worker refuses its results.
    """

    def run(take: Callable[[int], list[list[Work]]]) -> Iterator[tuple[list[Work], TaskResult]]:
        results = execute(lambda number: [Batch(study, works, is_missing, keep) for works in take(number)])
        return (_accepted(batch.works, result) for batch, result in results)

    return run


def _accepted(works: list[Work], result: TaskResult) -> tuple[list[Work], TaskResult]:
    if result.refused:
        raise RefusedError(f"{result.refused}.")
    return works, result


@contextmanager
def processes(reference: str, workers: int, limits: Limits = NO_LIMITS) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on worker processes of one thread each, with an equal share of the memory by default."""
    import psutil

    limits = Limits(limits.time_s, limits.memory or psutil.virtual_memory().total // workers)
    words = f"on {workers} local worker {'process' if workers == 1 else 'processes'}"
    with threadpool_limits(1), Children(reference, workers, limits) as children:
        yield Place(words, workers), children


@contextmanager
def threads(reference: str, workers: int, limits: Limits = NO_LIMITS) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on threads of this process; with limits jobs run in a child process for each."""
    place = Place(f"on {workers} local {'thread' if workers == 1 else 'threads'}", workers)
    if limits:
        with Children(reference, workers, limits) as children:
            yield place, children
        return
    todo: SimpleQueue[Any] = SimpleQueue()

    def execute(take: Callable[[int], Sequence[AnyJob]]) -> Iterator[tuple[AnyJob, Any]]:
        done: SimpleQueue[tuple[AnyJob, Any, BaseException | None]] = SimpleQueue()
        under_way = 0
        while True:
            # One job more than threads, so that none waits while the results of another are used.
            for job in take(workers + 1 - under_way):
                todo.put((job, done))
                under_way += 1
            if not under_way:
                return
            job, result, error = done.get()
            under_way -= 1
            if error is not None:
                raise error
            yield job, result

    def work() -> None:
        for job, done in iter(todo.get, None):
            try:
                done.put((job, compute(job.task(limits, 0.0)), None))
            except BaseException as error:  # raised again in the thread of the run
                done.put((job, None, error))

    with threadpool_limits(1):
        for _ in range(workers):
            Thread(target=work, daemon=True).start()  # Python would wait for others at its end
        try:
            yield place, execute
        finally:
            while not todo.empty():  # nobody will take these results
                todo.get()
            for _ in range(workers):
                todo.put(None)


@contextmanager
def serial(
    reference: str, _workers: int = 1, limits: Limits = NO_LIMITS, apart: bool = False
) -> Iterator[tuple[Place, Executor]]:
    """Give an executor that computes one job after the other in this process: the definition of the result.

    With limits, or ``apart``, a child process computes them, since this one must not be ended or changed.
    """

    def execute(take: Callable[[int], Sequence[AnyJob]]) -> Iterator[tuple[AnyJob, Any]]:
        while jobs := take(1):
            yield jobs[0], compute(jobs[0].task(limits, 0.0))

    place = Place("in one process" if apart else "in this process", 1)
    with threadpool_limits(1):  # sums of products must not depend on the number of cores
        if apart or limits:
            with Children(reference, 1, limits) as child:
                yield place, child
        else:
            yield place, execute


@contextmanager
def _measured_first(study: Study, cost: float, say: Say) -> Iterator[tuple[Place, Executor]]:
    """Give an executor for work of unknown length: it computes in one process and measures the time, until
    what is left is worth the start of worker processes, which then do the rest.

    The process is this one for code of linksweep's own, and a child for that of others.  ``cost`` is that of all work,
    in the unit of `Work.cost`.
    """
    with ExitStack() as stack:
        first = stack.enter_context(ExitStack())
        place, compute_here = first.enter_context(serial(study.experiment_reference, apart=not study.is_ours))

        def execute(take: Callable[[int], Sequence[AnyJob]]) -> Iterator[tuple[AnyJob, Any]]:
            done = busy = 0.0
            slowest = (1.0, 0.0)  # the cost and the seconds of that task, which may have imported: it decides nothing
            for job, result in compute_here(take):
                yield job, result
                one = job.cost * len(result.seconds) / len(job), float(result.seconds.sum())
                done, busy = done + one[0], busy + one[1]
                slowest = max(slowest, one, key=lambda task: task[1] / task[0])
                usual = busy - slowest[1]
                left = max(0.0, cost - done) * usual / max(done - slowest[0], 1e-9)
                if usual > JUDGED_S and left * (1.0 - 1.0 / available_cores()) > WORKERS_START_S:
                    break
            else:
                return
            first.close()
            there, executor = stack.enter_context(processes(study.experiment_reference, available_cores()))
            say(f"the first points took some time: the rest runs {there.words}")
            yield from executor(take)

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
                room = most if len(early) < MOST_WAITING else 0
                return [Call(reference, next(numbers), function, piece) for piece in islice(arguments, room)]

            for call, (value, error) in execute(take):
                if error is not None:
                    raise error
                early[call.number] = value
                while turn in early:
                    yield early.pop(turn)
                    turn += 1

        yield ordered
