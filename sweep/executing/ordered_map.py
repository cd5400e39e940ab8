"""Maps a function over many pieces on Dask workers: results in the order of the pieces, few in memory at a time."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from itertools import islice
from threading import Event
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.versions import identity, require_same

Result = TypeVar("Result")
Map = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[Any]]

LOOK_EVERY_S = 1.0
"""Seconds between two looks at the workers while a result is waited for."""

WITHOUT_WORKERS_S = 60.0
"""Seconds that workers may be missing, for instance until a batch system starts others."""

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
    if scheduler is None:
        with _local(workers) as client:
            yield partial(_mapped, client, _on_one_thread)
    else:
        with _elsewhere(scheduler, experiment) as (client, expected):
            yield partial(_mapped, client, partial(_as_expected, expected, experiment))


def _mapped(
    client: Any, compute: Callable[..., Any], function: Callable[..., Any], pieces: Iterable[tuple[Any, ...]]
) -> Iterator[Any]:
    threads = sum(client.nthreads().values())
    sent = (client.submit(compute, function, *piece, pure=False) for piece in pieces)
    waiting = deque(islice(sent, AHEAD * max(threads, 1)))
    while waiting:
        future = waiting.popleft()
        result = _result(client, future)
        waiting.extend(islice(sent, 1))
        del future  # Dask forgets the result
        yield result


def _result(client: Any, future: Any) -> Any:
    """Wait for a result while there are workers; Dask itself would wait for others for ever."""
    from distributed import CancelledError, KilledWorker

    ended = Event()
    future.add_done_callback(lambda _: ended.set())
    had_workers = time.monotonic()
    while not ended.wait(LOOK_EVERY_S):
        now = time.monotonic()
        with suppress(Exception):  # where the connection is lost, the future says so
            if client.nthreads():
                had_workers = now
        if now - had_workers > WITHOUT_WORKERS_S:
            raise SweepError(f"the workers have gone, and there have been none for {WITHOUT_WORKERS_S:g} s")
    try:
        return future.result()
    except KilledWorker as error:
        raise SweepError(f"a worker died, perhaps for lack of memory: {error}") from error
    except CancelledError as error:
        raise SweepError(f"the connection to the Dask scheduler is lost: {error}") from error


def _on_one_thread(function: Callable[..., Result], *arguments: Any) -> Result:
    with threadpool_limits(1):  # the same bits whatever the machine
        return function(*arguments)


@contextmanager
def _local(workers: int | None) -> Iterator[Any]:
    from linksweep.sweep.executing.local_cluster import local_cluster

    options = {"n_workers": workers, "threads_per_worker": 1, "processes": True}
    with local_cluster(options) as cluster, cluster.get_client() as client:
        yield client


@contextmanager
def _elsewhere(scheduler: str, experiment: str) -> Iterator[tuple[Any, Mapping[str, str]]]:
    """Give a client of a scheduler whose workers are as this process is, and what is expected of those that join."""
    from linksweep.sweep.executing.clusters import client_at

    expected = identity(experiment).deciding
    with client_at(scheduler) as client:
        require_same(expected, client.run(identity, experiment, on_error="return"))
        if not client.nthreads():
            raise SweepError(f"the Dask scheduler at {scheduler} has no workers")
        yield client, expected


def _as_expected(
    expected: Mapping[str, str], experiment: str, function: Callable[..., Result], *arguments: Any
) -> Result:
    """Compute a piece on a worker that would compute what the client would; raises SweepError on any other."""
    from distributed import get_worker

    require_same(expected, {get_worker().address: identity(experiment)})
    return _on_one_thread(function, *arguments)
