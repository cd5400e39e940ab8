"""Makes the Dask clusters that a run may use: of this machine, one that runs elsewhere, one that a file describes."""

import asyncio
import importlib.metadata
import inspect
import logging
import signal
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Literal

import dask
from distributed import Client, LocalCluster
from distributed.comm.addressing import get_address_host_port
from distributed.security import Security
from threadpoolctl import threadpool_limits

from sweep.clusterfile import cluster_class, read_cluster_file
from sweep.contract import SweepError
from sweep.execute import GUARD, NO_LIMITS, Executor, Limits, Place, Say
from sweep.on_client import OnClient
from sweep.study import Study

CONNECT_TIMEOUT_S = 10

PATIENCE_S = 0.5
"""What workers get to finish in when a run is stopped."""

LOOPBACK = "127.0.0.1"

KEEP_BYTES = 2**28
"""Freed memory that a worker's allocator keeps: arrays of some MB are made anew for each catalogue, and giving them
back to the system each time costs a fifth of the run."""

OWN_CLUSTER = {
    "distributed.scheduler.allowed-failures": 0,  # what a dead worker had is done again, guarded
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": KEEP_BYTES,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": KEEP_BYTES,
    "distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED": "critical",
}

ADAPT_WITHIN = "500ms"
"""An adaptive cluster has as many workers as the tasks in flight would keep busy for so long: they are short."""


@contextmanager
def dask_local(
    study: Study, workers: int, pool: Literal["threads", "processes"], say: Say, limits: Limits = NO_LIMITS
) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on a Dask cluster of this machine, in worker processes or in threads of this process."""
    options: dict[str, Any]
    if pool == "processes":
        options = {"n_workers": workers, "threads_per_worker": 1, "processes": True, "host": LOOPBACK}
        if limits.memory is not None:
            options["memory_limit"] = limits.memory
    else:
        options = {"n_workers": 1, "threads_per_worker": workers, "processes": False, "memory_limit": None}
    noun = {"processes": ("worker process", "worker processes"), "threads": ("thread", "threads")}[pool][workers > 1]
    with ExitStack() as stack:
        stack.enter_context(threadpool_limits(1))
        try:
            cluster = stack.enter_context(_cluster(LocalCluster, options))
        except RuntimeError as error:
            message = f"worker processes cannot be started: {error} Note that {GUARD}"
            raise SweepError(message) from None  # Dask's own traceback is of sixty lines, none of them the script's
        client = stack.enter_context(cluster.get_client())
        words = f"{workers} local {noun}"
        guarded = pool == "threads" and bool(limits)
        yield _place(client, words, workers), _executor(client, study, words, say, limits, guarded)


@contextmanager
def dask_from_file(study: Study, path: Path, say: Say, limits: Limits = NO_LIMITS) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on the cluster that a file describes; raises SweepError for anything wrong in the file."""
    file = read_cluster_file(path)
    kind = cluster_class(file)
    words = f"the {file.class_name.rpartition('.')[2]} of {path}"
    with ExitStack() as stack:
        try:
            cluster = stack.enter_context(_cluster(kind, file.options))
            if file.scale is not None:
                cluster.scale(**file.scale)
            else:
                cluster.adapt(**{"target_duration": ADAPT_WITHIN, **(file.adapt or {})})
            client = stack.enter_context(cluster.get_client())
        except SweepError:
            raise
        except Exception as error:  # whatever a cluster's class makes of its options
            raise SweepError(f"{file.class_name}: {type(error).__name__}: {error}", str(path)) from error
        yield _place(client, words), _executor(client, study, words, say, limits)


@contextmanager
def dask_scheduler(
    study: Study, address: str, security: Security | None, say: Say, limits: Limits = NO_LIMITS
) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on a Dask scheduler that runs elsewhere; raises SweepError where none answers or its workers
    are not like this process.
    """
    with _quiet(), ExitStack() as stack:
        try:
            get_address_host_port(address)  # a client of a malformed address would hang at its end
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of other versions: said below, in words
                client = Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False, security=security)
        except (OSError, ValueError, TypeError, TimeoutError) as error:
            message = f"no Dask scheduler answers at {address!r} within {CONNECT_TIMEOUT_S} s: {error}"
            raise SweepError(message) from error
        stack.enter_context(client)
        words = f"the Dask scheduler at {address}"
        yield _place(client, words), _executor(client, study, words, say, limits)


def tls(ca: Path, cert: Path, key: Path) -> Security:
    """Return what a TLS scheduler asks of its clients; raises SweepError for files that are not such."""
    security = Security(
        tls_ca_file=str(ca), tls_client_cert=str(cert), tls_client_key=str(key), require_encryption=True
    )
    try:
        security.get_connection_args("client")
    except OSError as error:  # ssl.SSLError is one
        raise SweepError(f"cannot use the TLS files {ca}, {cert} and {key}: {error}") from error
    return security


def _executor(client: Client, study: Study, words: str, say: Say, limits: Limits, guarded: bool = False) -> Executor:
    executor = OnClient(study, client, words, say, limits, guarded)
    executor.prepare()
    return executor


def _place(client: Client, words: str, workers: int | None = None) -> Place:
    """Return the place of a client, with the dashboard if its scheduler can show one: this needs bokeh."""
    try:
        client.run_on_scheduler(importlib.metadata.version, "bokeh")
    except Exception:  # a missing package there, or a scheduler that runs nothing for clients
        return Place(words, workers)
    return Place(words, workers, client.dashboard_link or "")


@contextmanager
def _cluster(kind: Any, options: Mapping[str, Any]) -> Iterator[Any]:
    """Start a cluster that belongs to this run, to be ended with it."""
    with ExitStack() as stack:
        stack.enter_context(_quiet())
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="linksweep-", ignore_cleanup_errors=True))
        stack.enter_context(dask.config.set({**OWN_CLUSTER, "temporary-directory": scratch}))
        here = f"{LOOPBACK}:0"
        defaults: dict[str, Any] = {}
        if issubclass(kind, LocalCluster):
            # In threads the worker's pages would be served to the world (its host is none).
            pages = {} if options.get("processes", True) else {"worker_dashboard_address": here}
            defaults = {"dashboard_address": here, "silence_logs": False, **pages}
        elif any("scheduler_options" in inspect.signature(base).parameters for base in kind.__mro__[:-1]):
            defaults = {"scheduler_options": {"dashboard_address": here} | dict(options.get("scheduler_options", {}))}
            options = {key: value for key, value in options.items() if key != "scheduler_options"}
        cluster = stack.enter_context(_deaf_to_interrupts(partial(kind, **{**defaults, **options})))
        stack.enter_context(_prompt_end(cluster))
        yield cluster


def _deaf_to_interrupts(make: Callable[[], Any]) -> Any:
    """Start a cluster whose processes do not get SIGINT and SIGHUP: a terminal sends them to all of them, but they
    are the client's to answer (distributed#1925).

    They inherit the signal mask of the thread that starts them, which is not this one, so that this one can be
    interrupted meanwhile.
    """
    made: Future[Any] = Future()

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
def _prompt_end(cluster: Any) -> Iterator[None]:
    """Where an exception ends the run, do not wait for blocks under way: nobody will take their results."""

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
def _quiet() -> Iterator[None]:
    """Keep Dask's log off standard error in this block, where it says at length what we say in a sentence; other
    handlers of its loggers are left alone.
    """
    removed = [
        (logger, handler)
        for name, logger in list(logging.root.manager.loggerDict.items())
        if name.partition(".")[0] in ("distributed", "tornado", "bokeh") and isinstance(logger, logging.Logger)
        for handler in logger.handlers
        if type(handler) is logging.StreamHandler
    ]
    nothing = logging.NullHandler()  # without any, Python would print to standard error after all
    for logger, handler in removed:
        logger.removeHandler(handler)
        logger.addHandler(nothing)
    try:
        yield
    finally:
        for logger, handler in removed:
            logger.removeHandler(nothing)
            logger.addHandler(handler)
