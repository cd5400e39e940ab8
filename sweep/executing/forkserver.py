"""The process that workers are forked from: it imports what all of them need, once.

Two worker processes forked from it begin to compute after 0.75 of the time that they need when each is started anew and
imports for itself.  It has one thread: a process that has several must not be forked.
"""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from multiprocessing import forkserver, resource_tracker
from pathlib import Path
from typing import Any, TypeVar

Made = TypeVar("Made")

PRELOADED = ["linksweep", "linksweep.sweep.executing.dask_worker", "linksweep.core.experiment"]
"""What workers import; last the experiment that is run most: its workers begin 0.05 s sooner, those of others lose half
of that."""

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
"""Environment of every worker; Python and libraries read it as they start, before Dask could set anything."""

UNDO_S = 5.0
"""Seconds that an interrupted run waits for what it has begun to start, so as to end it: usually less than one."""

SAFE_PATH = "PYTHONSAFEPATH"
"""Keeps modules of the folder that a run is started in out of the process that workers are forked from."""

_users = [0]
"""How many blocks with `start_method` use the server that this module has started."""


@contextmanager
def start_method() -> Iterator[str]:
    """Give the start method of multiprocessing that workers are to be started with in this block.

    It is "spawn" where the user has a fork server already, which has neither our environment nor our signal mask, and
    where none can be started: its socket is in the temporary directory, whose path may be too long for a socket.  Our
    server ends with the last of these blocks: it must not outlive a run, and the user's own pools must not be forked
    from it.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods() or (not _users[0] and _servers()):
        yield "spawn"
        return
    if not _users[0]:
        try:
            signals_blocked(_start, lambda _: _end_servers())
        except OSError:
            yield "spawn"
            return
    _users[0] += 1
    try:
        yield "forkserver"
    finally:
        _users[0] -= 1
        if not _users[0]:
            _end_servers()


def _end_servers() -> None:
    for server in _servers():
        server.kill()
        # `multiprocessing` reaps it when it next needs a fork server, and must find it ended then.
        os.waitid(os.P_PID, server.pid, os.WEXITED | os.WNOWAIT)


def _servers() -> list[Any]:
    """Return the fork servers of this process, as psutil has them; one that has ended has no command line."""
    import psutil

    servers = []
    for child in psutil.Process().children():
        with suppress(psutil.Error):
            if any("multiprocessing.forkserver" in word for word in child.cmdline()):
                servers.append(child)
    return servers


def _start() -> None:
    multiprocessing.get_context("forkserver").set_forkserver_preload(PRELOADED)
    # Not documented: starts the server without a first worker, so that it imports while this process does: two workers
    # are ready after 1.3 s instead of 1.7 s.
    _with_environment(ENVIRONMENT, forkserver.ensure_running)


def _with_environment(ours: Mapping[str, str], start: Callable[[], object]) -> None:
    """Start a process with these variables, and without modules of the present folder, which may be a stranger's."""
    ours = {**ours, SAFE_PATH: "1"}
    before = {name: os.environ.get(name) for name in ours}
    os.environ.update(ours)
    try:
        start()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def signals_blocked(make: Callable[[], Made], undo: Callable[[Made], object]) -> Made:
    """Return ``make()``; the processes that it starts do not get SIGINT, SIGHUP and SIGTERM: a terminal or a batch
    system sends these to every process, but only the client is to answer (distributed#1925).  A worker unblocks SIGTERM
    (`TaskPlugin`), which its experiment may need; the process that workers are forked from outlives all of them.

    Processes inherit the signal mask of the thread that starts them.  Here that is another thread, so that this one can
    be interrupted meanwhile: what is made then is given to ``undo``.
    """
    made: Future[Made] = Future()

    def start() -> None:
        try:
            if hasattr(signal, "pthread_sigmask"):
                signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])
                # before the other two: its start unblocks these in this thread
                _with_environment({}, resource_tracker.ensure_running)
                signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
            made.set_result(make())
        except BaseException as error:
            made.set_exception(error)

    def undone(made: Future[Made]) -> None:
        with suppress(Exception):
            undo(made.result())

    try:
        threading.Thread(target=start, name="start-children", daemon=True).start()
        return made.result()
    except BaseException:  # a process that is starting while this one ends would print a traceback
        wait([made], UNDO_S)
        made.add_done_callback(undone)
        raise


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

    distributed#4751.  The process that started it tells the user why.  While multiprocessing runs a script again, as
    ``__mp_main__``, this is not the main module yet.
    """
    again = sys.modules.get("__mp_main__")
    if again is not None and sys.modules["__main__"] is not again:
        raise SystemExit(1)
