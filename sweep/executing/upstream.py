"""What needs names of libraries that are not public, each with the reason upstream that makes it necessary."""

import atexit
import multiprocessing
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

REPLACE_EVERY_S = 5


@contextmanager
def lost_workers_replaced(cluster: Any) -> Iterator[None]:
    """Let a cluster start again the workers that it is to have and has lost, which batch jobs that ended are.

    dask-jobqueue#691: a cluster forgets them, and starts others only when its size is changed.
    """
    from distributed import SpecCluster
    from tornado.ioloop import PeriodicCallback

    if not isinstance(cluster, SpecCluster) or cluster.loop is None:
        yield
        return
    replacing = PeriodicCallback(cluster._correct_state, REPLACE_EVERY_S * 1000)
    loop = cluster.loop
    loop.add_callback(replacing.start)
    try:
        yield
    finally:
        loop.add_callback(replacing.stop)


def skip_end_of_clusters() -> None:
    """Let the process end without Dask's own clean-up, which waits ten seconds for a cluster that has half started."""
    if distributed := sys.modules.get("distributed"):
        atexit.unregister(distributed.deploy.spec.close_clusters)


def leave_a_worker_that_runs_its_script() -> None:
    """End a worker process that runs the script it belongs to and meets no guard: it would start workers too.

    distributed#4751.  The process that started it says why.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(1)
