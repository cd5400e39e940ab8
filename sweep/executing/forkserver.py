"""Starts child processes that a terminal's signals do not reach, and early the one that workers are forked from.

Imports nothing that takes time: the process that workers are forked from imports Dask while this one imports xarray.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from multiprocessing import forkserver, resource_tracker
from typing import Any, TypeVar

Made = TypeVar("Made")

PRELOADED = ["linksweep", "distributed", "sweep.executing.worker_plugin"]
"""What every worker imports; linksweep first, which keeps a ``sweep.py`` of the user's from being taken for ours.  None
of it starts a thread: a process that has several must not be forked."""

KEEP_BYTES = 2**28
"""Freed memory that a worker's allocator keeps: arrays of some MB are made anew for each catalogue, and giving them
back to the system each time costs a fifth of the run."""

ENVIRONMENT = {
    "MALLOC_TRIM_THRESHOLD_": str(KEEP_BYTES),
    "MALLOC_MMAP_THRESHOLD_": str(KEEP_BYTES),
    "DASK_LOGGING__DISTRIBUTED": "critical",
    "PYTHONHASHSEED": "6640",  # Dask's: sets of strings are in the same order on all workers of all runs
    **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
}
"""Of every worker, and read by Python and libraries as it starts, before Dask can say anything."""

SAFE_PATH = "PYTHONSAFEPATH"
"""Keeps modules of the folder that a run is started in out of the process that workers are forked from."""


class _Server:
    """The process that workers of this process's runs are forked from, and how many clusters of its need it now."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pid: int | None = None
        self._needed = 0
        self._of_python: Any = forkserver._forkserver

    def start(self, needed: int = 0) -> bool:
        """Start it unless it runs already, for so many clusters; return whether it does.

        One of the user's own is left alone: it has neither our environment nor our signal mask.
        """
        with self._lock:
            self._needed += needed
            if self._of_python._forkserver_pid is None and "forkserver" in multiprocessing.get_all_start_methods():
                with suppress(OSError):  # its socket is in the temporary directory, whose name may be too long for one
                    signals_blocked(_start)
                    self._pid = self._of_python._forkserver_pid
            return self._is_ours()

    def need_no_more(self) -> None:
        """End it if no other cluster needs it: it is not to outlive a run, nor pools of the user's to be forked from
        it.
        """
        with self._lock:
            self._needed -= 1
            if not self._needed and self._is_ours():
                with suppress(ProcessLookupError):
                    os.kill(self._of_python._forkserver_pid, signal.SIGKILL)
                self._of_python._stop()

    def _is_ours(self) -> bool:
        return self._pid is not None and self._of_python._forkserver_pid == self._pid


_server = _Server()


def start_forkserver() -> None:
    """Start early the process that workers will be forked from, where there can be one."""
    _server.start()


@contextmanager
def start_method() -> Iterator[str]:
    """Give multiprocessing's name for the way in which workers are to be started in this block: "spawn" where they
    cannot be forked from a process of ours.
    """
    try:
        yield "forkserver" if _server.start(needed=1) else "spawn"
    finally:
        _server.need_no_more()


def _start() -> None:
    multiprocessing.get_context("forkserver").set_forkserver_preload(PRELOADED)
    ours = {**ENVIRONMENT, SAFE_PATH: "1"}
    before = {name: os.environ.get(name) for name in ours}
    os.environ.update(ours)
    try:
        forkserver.ensure_running()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def signals_blocked(make: Callable[[], Made]) -> Made:
    """Return ``make()``, whose processes do not get SIGINT and SIGHUP: a terminal sends them to all of them, but they
    are the client's to answer (distributed#1925).

    They inherit the signal mask of the thread that starts them, which is not this one, so that this one can be
    interrupted meanwhile.
    """
    made: Future[Made] = Future()

    def start() -> None:
        try:
            if hasattr(signal, "pthread_sigmask"):
                signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])
                resource_tracker.ensure_running()  # before the other: where it starts, it unblocks SIGINT here
                signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
            made.set_result(make())
        except BaseException as error:
            made.set_exception(error)

    threading.Thread(target=start, name="start-children", daemon=True).start()
    return made.result()
