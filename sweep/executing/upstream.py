"""Functions that need private names of libraries, each with the reason upstream that makes it necessary."""

import atexit
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

REPLACE_EVERY_S = 5


def dask_arrays_only_where_imported() -> None:
    """Keep xarray from importing dask.array only to see that an array is not one of Dask's, which takes a quarter of
    the time of `sweep show`: there is no such array where nobody has imported it.  Since pydata/xarray#7179 other
    imports of xarray wait until they are needed.
    """
    from xarray.namedarray import pycompat

    known: Any = getattr(pycompat, "_cached_duck_array_modules", {})  # a version without it does this in another way
    known.setdefault("dask", _DaskArrays(partial(pycompat.DuckArrayModule, "dask")))


def environment() -> dict[Any, Any]:
    """Return a copy of what os.environ holds, which takes a hundredth of the time of its own ``copy``: that decodes all
    of it.
    """
    return dict(getattr(os.environ, "_data", os.environ))


class _DaskArrays:
    """Replaces xarray's record of a module of arrays: has the class if it was imported, and imports it for the rest."""

    def __init__(self, imported: Callable[[], Any]) -> None:
        self._imported = imported

    @property
    def type(self) -> tuple[type, ...]:
        module = sys.modules.get("dask.array")
        return () if module is None or not hasattr(module, "Array") else (module.Array,)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._imported(), name)


@contextmanager
def lost_workers_replaced(cluster: Any) -> Iterator[None]:
    """Let a cluster replace the workers that it has lost, such as batch jobs that have ended.

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


@contextmanager
def only_scripts_with_a_file_run() -> Iterator[None]:
    """Keep worker processes that are started in this block from running a script that came by standard input: Python
    gives the name of its file as ``<stdin>``, which is no file.
    """
    script = sys.modules["__main__"]
    name = getattr(script, "__file__", None)
    if name is None or Path(name).is_file():
        yield
        return
    del script.__file__
    try:
        yield
    finally:
        script.__file__ = name


def leave_a_worker_that_runs_its_script() -> None:
    """End a worker process whose script calls linksweep without a guard: it would start workers too.

    distributed#4751.  The process that started it tells the user why.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(1)
