"""Starts child processes that a terminal's signals do not reach, and early the one that workers are forked from.

Imports nothing that takes time: the process that workers are forked from imports Dask while this one imports xarray.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from multiprocessing import forkserver, resource_tracker
from typing import TypeVar

Made = TypeVar("Made")

PRELOADED = ["distributed", "sweep.executing.pin"]
"""What every worker imports.  It starts no thread: a process that has several must not be forked."""

KEEP_BYTES = 2**28
"""Freed memory that a worker's allocator keeps: arrays of some MB are made anew for each catalogue, and giving them
back to the system each time costs a fifth of the run."""

ENVIRONMENT = {
    "MALLOC_TRIM_THRESHOLD_": str(KEEP_BYTES),
    "MALLOC_MMAP_THRESHOLD_": str(KEEP_BYTES),
    "DASK_LOGGING__DISTRIBUTED": "critical",
    **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
}
"""Of every worker, and read by libraries as it starts, before Dask can say anything."""


def start_forkserver() -> str:
    """Start the process that workers are forked from, unless it runs already; return multiprocessing's name for the
    way in which they can be started: "spawn" where there can be no such process.
    """
    if "forkserver" in multiprocessing.get_all_start_methods():
        with suppress(OSError):  # its socket is in the temporary directory, whose name may be too long for one
            deaf_to_interrupts(_start_forkserver)
            return "forkserver"
    return "spawn"


def _start_forkserver() -> None:
    multiprocessing.get_context("forkserver").set_forkserver_preload(PRELOADED)
    before = {name: os.environ.get(name) for name in ENVIRONMENT}
    os.environ.update(ENVIRONMENT)
    try:
        forkserver.ensure_running()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def deaf_to_interrupts(make: Callable[[], Made]) -> Made:
    """Return ``make()``, whose processes do not get SIGINT and SIGHUP: a terminal sends them to all of them, but they
    are the client's to answer (distributed#1925).

    They inherit the signal mask of the thread that starts them, which is not this one, so that this one can be
    interrupted meanwhile.
    """
    made: Future[Made] = Future()

    def start() -> None:
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])
            resource_tracker.ensure_running()  # before the other: where it starts, it unblocks SIGINT in this thread
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            made.set_result(make())
        except BaseException as error:
            made.set_exception(error)

    threading.Thread(target=start, name="start-children", daemon=True).start()
    return made.result()
