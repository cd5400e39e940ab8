"""Starts and ends a Dask cluster that belongs to one run, on loopback and with temporary credentials, without log
messages or files left behind.
"""

import asyncio
import inspect
import logging
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import dask
from distributed import LocalCluster, Worker

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.forkserver import ENVIRONMENT, SAFE_PATH, signals_blocked, start_method
from linksweep.sweep.executing.upstream import (
    leave_a_worker_that_runs_its_script,
    lost_workers_replaced,
    only_scripts_with_a_file_run,
)

PATIENCE_S = 0.5
"""Seconds that workers get to finish when a run is stopped."""

LOOPBACK = "127.0.0.1"

OWN_CLUSTER = {
    "distributed.admin.low-level-log-length": 10,  # messages kept in memory, with all that they carried
    "distributed.scheduler.allowed-failures": 0,  # we do a dead worker's task again, in a child process
    "distributed.worker.http.routes": [],  # everybody on this machine could open them
    **{f"distributed.nanny.pre-spawn-environ.{name}": value for name, value in ENVIRONMENT.items()},
}

NOT_WATCHED = {
    "distributed.worker.profile.enabled": False,  # looks at all threads a hundred times a second
    "distributed.admin.tick.interval": "1s",  # of measuring how late event loops are; by default 20 ms, in each process
    "distributed.admin.system-monitor.interval": "2s",
    "distributed.scheduler.http.routes": [],
}
"""Settings without a dashboard, which alone shows these measurements: they take a hundredth of a run's time."""

STARTS = 5
"""How often worker processes are started that end before they are ready: something may have killed them."""

GUARD = (
    "a script that computes in worker processes must call linksweep under `if __name__ == '__main__':`, because each "
    "of them begins by running the script too; or use pool='threads'"
)


class _Worker(Worker):
    """A worker in this process without Dask's pages about it: they need bokeh, and everybody on this machine could open
    them.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **{**options, "dashboard": False})


class NoWorkersError(SweepError, SystemExit):
    """Worker processes cannot be started.  A script that does not catch this ends with the message and no traceback:
    none of the lines in it would be the one to change.
    """

    def __init__(self, reason: object, unguarded: bool) -> None:
        why = (
            f"{reason} Note that {GUARD}"
            if unguarded
            else f"some ended before they were ready, {STARTS} times ({str(reason).rstrip('.')}). Something may kill "
            "them, or this machine lacks memory; what was finished is kept, the same command goes on from there"
        )
        super().__init__(f"worker processes cannot be started: {why}")
        self.code = f"error: {self}"


@contextmanager
def local_cluster(options: Mapping[str, Any], dashboard: bool = False, method: str | None = None) -> Iterator[Any]:
    """Start a Dask cluster on this machine as `own_cluster` does; raises NoWorkersError.

    Its scheduler is in this process, where a ``dashboard`` takes a second to import bokeh.  Without one nothing is
    profiled (`NOT_WATCHED`): profiling can make Python before 3.11.9 hang (gh-106883).
    """
    leave_a_worker_that_runs_its_script()
    with ExitStack() as stack:
        stack.enter_context(dask.config.set({} if dashboard else NOT_WATCHED))
        whole = {**options, "scheduler_kwargs": {"dashboard": dashboard}}
        for number in range(1, STARTS + 1):
            try:
                cluster = stack.enter_context(own_cluster(LocalCluster, whole, method))
                break
            except RuntimeError as error:
                if number == STARTS or _script_without_guard():  # Dask's own traceback has sixty lines
                    raise NoWorkersError(error, _script_without_guard()) from None
        yield cluster


def _script_without_guard() -> bool:
    """Return whether workers run a script whose text does not ask whether it is the main one."""
    script = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
    return script.suffix == ".py" and script.is_file() and "__main__" not in script.read_text(errors="replace")


@contextmanager
def own_cluster(kind: Any, options: Mapping[str, Any], method: str | None = None) -> Iterator[Any]:
    """Start a cluster that belongs to this run and ends with it; worker processes on this machine are started by a
    ``method`` of multiprocessing, by default that of `start_method`.

    What listens asks for a key that is made for this run, because who reaches a scheduler or a worker without one can
    run code in it.  Options that name a ``protocol`` or a ``security`` are left as they are.
    """
    with ExitStack() as stack:
        stack.enter_context(without_logs())
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="linksweep-", ignore_cleanup_errors=True))
        stack.enter_context(dask.config.set({**OWN_CLUSTER, "temporary-directory": scratch}))
        here = f"{LOOPBACK}:0"
        defaults: dict[str, Any] = {}
        if issubclass(kind, LocalCluster):
            defaults = {"dashboard_address": here, "silence_logs": False}
            if options.get("processes", True):
                stack.enter_context(only_scripts_with_a_file_run())
                method = method or stack.enter_context(start_method())
                stack.enter_context(dask.config.set({"distributed.worker.multiprocessing-method": method}))
                defaults["env"] = {SAFE_PATH: os.environ.get(SAFE_PATH, "")}  # the process they are forked from has it
                defaults["security"] = True
            else:  # without an address on all of them: such workers have no host
                defaults |= {"worker_class": _Worker, "worker_dashboard_address": here}
        elif any("scheduler_options" in inspect.signature(base).parameters for base in kind.__mro__[:-1]):
            defaults = {"scheduler_options": {"dashboard_address": here} | dict(options.get("scheduler_options", {}))}
            options = {key: value for key, value in options.items() if key != "scheduler_options"}
            defaults["security"] = True
        if "protocol" in options:
            defaults.pop("security", None)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Creating scratch directories is taking")  # even our own, if it is busy
            warnings.filterwarnings("ignore", "Using a temporary security object")  # in the folder that jobs start in
            make: Callable[[], Any] = partial(kind, **{**defaults, **options})
            made = signals_blocked(make, lambda made: made.close())
            cluster = stack.enter_context(made)
        stack.enter_context(_prompt_end(cluster))
        stack.enter_context(lost_workers_replaced(cluster))
        yield cluster


@contextmanager
def _prompt_end(cluster: Any) -> Iterator[None]:
    """Do not wait for blocks under way where an exception ends the run: nobody will take their results."""

    async def close_workers() -> None:
        await asyncio.gather(*(worker.close(timeout=PATIENCE_S) for worker in cluster.workers.values()))

    try:
        yield
    except BaseException:
        if isinstance(cluster, LocalCluster):
            with suppress(TimeoutError):
                cluster.sync(close_workers)
        raise


@contextmanager
def without_logs() -> Iterator[None]:
    """Keep Dask's log off standard error in this block, since we say in a sentence what it says at length; other
    handlers of its loggers are left alone.
    """
    removed = [
        (logger, handler)
        for name, logger in list(logging.root.manager.loggerDict.items())
        if name.partition(".")[0] in ("distributed", "tornado", "bokeh") and isinstance(logger, logging.Logger)
        for handler in logger.handlers
        if type(handler) is logging.StreamHandler
    ]
    nothing = logging.NullHandler()  # without a handler Python would print to standard error after all
    for logger, handler in removed:
        logger.removeHandler(handler)
        logger.addHandler(nothing)
    try:
        yield
    finally:
        for logger, handler in removed:
            logger.removeHandler(nothing)
            logger.addHandler(handler)
