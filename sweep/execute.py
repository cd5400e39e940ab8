"""Runs tasks: a serial reference that defines what is meant, and Dask."""

import asyncio
import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import dask
import numpy as np
from threadpoolctl import threadpool_limits

from sweep.contract import SweepError
from sweep.plan import Work
from sweep.study import Study
from sweep.worker import Failure, Task, TaskResult, Unit, run_task

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

Pool = Literal["serial", "threads", "processes"]
Take = Callable[[int], list[list[Work]]]
"""Gives up to so many tasks' work that can be done now; after a result has been taken there may be more."""

Results = Iterator[tuple[list[Work], TaskResult]]
Executor = Callable[[Take], Results]

TASKS_IN_FLIGHT = 4
"""For each worker thread: enough that none waits, few enough that a grid of any size makes no large graph."""

CONNECT_TIMEOUT_S = 10

PATIENCE_S = 0.5
"""What workers get to finish in when a run is stopped."""

LOOPBACK = "127.0.0.1"

KEEP_BYTES = 2**28
"""Freed memory that a worker's allocator keeps: arrays of some MB are made anew for each catalogue, and giving them
back to the system each time costs a fifth of the run."""


def make_task(study: Study, works: list[Work]) -> Task:
    """Return what a worker must know to do this work."""
    defaults = study.experiment.defaults()
    units = tuple(
        Unit(
            tuple({k: v for k, v in point.parameters.items() if v != defaults[k]} for point in work.points),
            work.points[0].stream,
            work.block,
        )
        for work in works
    )
    return Task(study.experiment_reference, study.sampling.seed, units, study.sampling.keep_samples)


@contextmanager
def serial(study: Study) -> Iterator[Executor]:
    """Give an executor that computes one task after the other in this process: the definition of the result."""
    with threadpool_limits(1):  # sums of products must not depend on the number of cores
        yield partial(_one_by_one, study)


def _one_by_one(study: Study, take: Take) -> Results:
    while batches := take(1):
        yield batches[0], run_task(make_task(study, batches[0]))


@contextmanager
def dask_local(study: Study, workers: int, pool: Pool) -> Iterator[Executor]:
    """Give an executor on a Dask cluster of this machine, in worker processes or in threads of this process."""
    from distributed import LocalCluster

    options: dict[str, Any] = {"dashboard_address": f"{LOOPBACK}:0", "silence_logs": logging.CRITICAL}
    if pool == "processes":
        options |= {"n_workers": workers, "threads_per_worker": 1, "processes": True, "host": LOOPBACK}
    else:
        options |= {"n_workers": 1, "threads_per_worker": workers, "processes": False}
    environment = dict.fromkeys(("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"), KEEP_BYTES)
    with ExitStack() as stack:
        stack.enter_context(
            dask.config.set({f"distributed.nanny.pre-spawn-environ.{k}": v for k, v in environment.items()})
        )
        stack.enter_context(threadpool_limits(1))
        cluster = stack.enter_context(_deaf_to_interrupts(partial(LocalCluster, **options)))
        client = stack.enter_context(cluster.get_client())
        stack.enter_context(_prompt_end(cluster))
        yield _on_client(study, client)


def _deaf_to_interrupts(make: Callable[[], "LocalCluster"]) -> "LocalCluster":
    """Start a cluster whose processes do not get SIGINT and SIGHUP: a terminal sends them to all of them, but they
    are the client's to answer (distributed#1925).

    They inherit the signal mask of the thread that starts them, which is not this one, so that this one can be
    interrupted meanwhile.
    """
    from multiprocessing import resource_tracker

    made: Future[LocalCluster] = Future()

    def start() -> None:
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])
            resource_tracker.ensure_running()  # before the other: where it starts, it unblocks SIGINT in this thread
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            made.set_result(make())
        except BaseException as error:
            made.set_exception(error)

    threading.Thread(target=start, name="start-cluster", daemon=True).start()
    return made.result()


@contextmanager
def _prompt_end(cluster: "LocalCluster") -> Iterator[None]:
    """Where an exception ends the run, do not wait for blocks under way: nobody will take their results."""

    async def close_workers() -> None:
        await asyncio.gather(*(worker.close(timeout=PATIENCE_S) for worker in cluster.workers.values()))

    try:
        yield
    except BaseException:
        with suppress(TimeoutError):
            cluster.sync(close_workers)
        raise


@contextmanager
def dask_scheduler(study: Study, address: str) -> Iterator[Executor]:
    """Give an executor on a Dask scheduler that runs elsewhere; raises SweepError where none answers, it has no workers
    or they cannot import linksweep.
    """
    from distributed import Client
    from distributed.comm.addressing import get_address_host_port

    try:
        get_address_host_port(address)  # a client of a malformed address would hang at its end
        client = Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise SweepError(f"no Dask scheduler answers at {address!r} within {CONNECT_TIMEOUT_S} s: {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
        except TimeoutError as error:
            raise SweepError(f"the Dask scheduler at {address!r} has no workers") from error
        yield _on_client(study, client)


def available_cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _on_client(study: Study, client: "Client") -> Executor:
    from distributed import as_completed

    from sweep.pin import PinBlas

    try:
        client.register_plugin(PinBlas(), name="linksweep-pin-blas")
    except Exception as error:  # whatever keeps a worker from importing it
        raise SweepError(f"the workers cannot run linksweep: {type(error).__name__}: {error}") from error

    def run(take: Take) -> Results:
        works_of: dict[Any, list[Work]] = {}
        window = TASKS_IN_FLIGHT * max(1, sum(client.nthreads().values()))

        def submit() -> list[Any]:
            futures = []
            for works in take(window - len(works_of)):
                future = client.submit(run_task, make_task(study, works), pure=False)
                works_of[future] = works
                futures.append(future)
            return futures

        finished = as_completed(submit(), loop=client.loop)
        for future in finished:
            works = works_of.pop(future)
            failure = future.exception() if future.status != "finished" else None
            result = _lost(study, works, failure) if failure is not None else future.result()
            future.release()
            yield works, result
            finished.update(submit())  # after the result has been taken, since it may make more work known

    return run


def _lost(study: Study, works: list[Work], failure: BaseException) -> TaskResult:
    """A task that Dask gave up on, for example because it killed its workers: all of its blocks failed, the rest goes
    on.
    """
    reason = Failure("killed", f"{type(failure).__name__}: {failure}")
    rows = sum(len(work.points) for work in works)
    sums = np.full((rows, study.experiment.sums_width), np.nan)
    return TaskResult(sums, np.zeros(rows), dict.fromkeys(range(rows), reason))
