"""Maps a function over many pieces on Dask workers: results in the order of the pieces, few in memory at a time."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from sweep.contract import SweepError

Result = TypeVar("Result")
Map = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[Any]]

AHEAD = 2
"""Pieces for each worker thread that are computed before their turn."""


def here(function: Callable[..., Result], pieces: Iterable[tuple[Any, ...]]) -> Iterator[Result]:
    """Yield the results one after the other, computed in this process."""
    for piece in pieces:
        yield _on_one_thread(function, *piece)


@contextmanager
def ordered_map(workers: int | None, scheduler: str | None, experiment: str) -> Iterator[Map]:
    """Give a map over so many local worker processes or the workers of a scheduler; in this process by default.

    A piece gives the same bits wherever it is computed.  Raises SweepError where there are no workers, where one dies,
    and where the workers of a scheduler would not compute ``experiment`` as this process would.
    """
    if scheduler is None and (workers is None or workers == 1):
        yield here
        return
    with _local(workers) if scheduler is None else _elsewhere(scheduler, experiment) as client:
        yield lambda function, pieces: _mapped(client, function, pieces)


def _mapped(client: Any, function: Callable[..., Any], pieces: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
    from distributed import KilledWorker

    threads = sum(client.nthreads().values())
    sent = (client.submit(_on_one_thread, function, *piece, pure=False) for piece in pieces)
    waiting = deque(islice(sent, AHEAD * max(threads, 1)))
    while waiting:
        future = waiting.popleft()
        try:
            result = future.result()
        except KilledWorker as error:
            raise SweepError(f"a worker died, perhaps for lack of memory: {error}") from error
        waiting.extend(islice(sent, 1))
        del future  # Dask forgets the result
        yield result


def _on_one_thread(function: Callable[..., Result], *arguments: Any) -> Result:
    with threadpool_limits(1):  # the same bits whatever the machine
        return function(*arguments)


@contextmanager
def _local(workers: int | None) -> Iterator[Any]:
    from sweep.executing.local_cluster import local_cluster

    options = {"n_workers": workers, "threads_per_worker": 1, "processes": True}
    with local_cluster(options) as cluster, cluster.get_client() as client:
        yield client


@contextmanager
def _elsewhere(scheduler: str, experiment: str) -> Iterator[Any]:
    from sweep.executing.clusters import client_at
    from sweep.executing.versions import identity, require_same

    with client_at(scheduler) as client:
        own, asked = identity(experiment).deciding, set[str]()
        while new := client.nthreads().keys() - asked:  # others may join, or leave, while these are asked
            found = client.run(identity, experiment, workers=sorted(new), on_error="return")
            there = client.nthreads()
            require_same(own, {worker: what for worker, what in found.items() if worker in there})
            asked |= new
        if not client.nthreads():
            raise SweepError(f"the Dask scheduler at {scheduler} has no workers")
        yield client
