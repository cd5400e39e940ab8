"""The Dask clusters that a run may use: of this machine, one that a file describes, one that runs elsewhere."""

import asyncio
import importlib
import importlib.metadata
import inspect
import logging
import os
import sys
import tempfile
import tomllib
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import dask
from distributed import Client, LocalCluster, SpecCluster, Worker, rpc
from distributed.security import Security
from pydantic import BaseModel, BeforeValidator, Field, ValidationError, model_validator
from threadpoolctl import threadpool_limits
from tornado.ioloop import PeriodicCallback

from linksweep.sweep.contract import SweepError, shown, suggest
from linksweep.sweep.executing.dask_driver import DaskDriver, DaskWorkers
from linksweep.sweep.executing.forkserver import (
    ENVIRONMENT,
    SAFE_PATH,
    leave_a_worker_that_runs_its_script,
    only_scripts_with_a_file_run,
    signals_blocked,
    start_method,
)
from linksweep.sweep.executing.pools import NO_LIMITS, Limits, Resources
from linksweep.sweep.executing.task import Executor, Place, Say

CONNECT_TIMEOUT_S = 10

ADAPT_WITHIN = "500ms"
"""An adaptive cluster has as many workers as the tasks in flight would keep busy for this time; tasks are short."""

PATIENCE_S = 0.5
"""Seconds that workers get to finish when a run is stopped."""

REPLACE_EVERY_S = 5
"""Seconds between two looks whether a cluster has lost workers."""

STARTS = 5
"""How often worker processes are started that end before they are ready: something may have killed them."""

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

GUARD = (
    "a script that computes in worker processes must call linksweep under `if __name__ == '__main__':`, because each "
    "of them begins by running the script too; or use pool='threads'"
)


@contextmanager
def on_processes(
    reference: str, workers: int, say: Say, limits: Limits = NO_LIMITS, dashboard: bool = False
) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on worker processes of one thread each."""
    memory = {} if limits.memory is None else {"memory_limit": limits.memory}
    options = {"n_workers": workers, "threads_per_worker": 1, "processes": True, **memory}
    words = f"{workers} local worker {'process' if workers == 1 else 'processes'}"
    with threadpool_limits(1), local_cluster(options, dashboard) as cluster, cluster.get_client() as client:
        driver = _driver(client, words, reference, say, limits)
        yield Place(words, workers, _link(client) if dashboard else ""), driver


@contextmanager
def threads(
    reference: str, workers: int, say: Say, limits: Limits = NO_LIMITS, dashboard: bool = False
) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on threads of this process; with limits each task runs in a child process."""
    options = {"n_workers": 1, "threads_per_worker": workers, "processes": False, "memory_limit": None}
    words = f"{workers} local {'thread' if workers == 1 else 'threads'}"
    with threadpool_limits(1), local_cluster(options, dashboard) as cluster, cluster.get_client() as client:
        driver = _driver(client, words, reference, say, limits, guarded=bool(limits))
        yield Place(words, workers, _link(client) if dashboard else ""), driver


@contextmanager
def elsewhere(reference: str, resources: Resources, say: Say) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on the Dask scheduler or on the cluster that these name.

    Raises SweepError where none answers, for anything wrong in the file, and for workers that would compute other
    numbers than this process.
    """
    with ExitStack() as stack:
        if (address := resources.scheduler) is not None:
            words = f"the Dask scheduler at {address}"
            client = stack.enter_context(client_at(address, tls(*resources.tls) if resources.tls else None))
        else:
            assert resources.cluster is not None
            file = read_cluster_file(resources.cluster)
            words = f"the {file.class_name.rpartition('.')[2]} of {resources.cluster}"
            client = stack.enter_context(_client_of(file, resources.cluster))
        driver = _driver(client, words, reference, say, resources.limits)
        try:
            client.run_on_scheduler(importlib.metadata.version, "bokeh")  # which its dashboard needs
            link = _link(client)
        except Exception:  # a missing package there, or a scheduler that runs nothing for clients
            link = ""
        yield Place(words, dashboard=link, threads=max(1, sum(client.nthreads().values()))), driver


@contextmanager
def _client_of(file: "ClusterFile", path: Path) -> Iterator[Client]:
    """Give a client of the cluster that a file describes; raises SweepError for anything wrong in it."""
    with ExitStack() as stack:
        try:
            cluster = stack.enter_context(own_cluster(cluster_class(file), file.options))
            if file.adapt is None:
                cluster.scale(**(file.scale or {}))
            else:
                cluster.adapt(**{"target_duration": ADAPT_WITHIN} | file.adapt.model_dump(exclude_unset=True))
            client = stack.enter_context(cluster.get_client())
        except SweepError as error:
            raise SweepError(error.problems, str(path)) from error
        except Exception as error:  # whatever a cluster's class makes of its options
            cause: BaseException = error
            while cause.__cause__ is not None:
                cause = cause.__cause__
            raise SweepError(f"{file.class_name}: {type(cause).__name__}: {cause}", str(path)) from error
        yield client


def _driver(client: Client, words: str, reference: str, say: Say, limits: Limits, guarded: bool = False) -> DaskDriver:
    workers = DaskWorkers(client, words, reference, say, limits.memory)
    workers.prepare()
    return DaskDriver(workers, limits, guarded)


def _link(client: Client) -> str:
    """Return the address of a client's dashboard, empty if there is none.

    The link to a scheduler within this process has the machine's outer address, on which nothing listens.
    """
    protocol, _, rest = str(client.scheduler_info()["address"]).partition("://")
    link = client.dashboard_link or ""
    return link.replace(f"//{rest.partition('/')[0]}:", f"//{LOOPBACK}:") if protocol == "inproc" else link


@contextmanager
def client_at(address: str, security: Security | None = None) -> Iterator[Client]:
    """Give a client of a Dask scheduler that runs elsewhere; raises SweepError where none answers."""
    options = (security or Security()).get_connection_args("client")
    if address.startswith("tls://") and options["ssl_context"] is None:
        raise SweepError(
            f"no certificates for {address!r}: give --tls-ca, --tls-cert and --tls-key, or configure Dask with them"
        )
    protocol, _, rest = address.partition("://")
    if protocol not in ("tcp", "tls") or not rest.rpartition(":")[0] or not rest.rpartition(":")[2].isdecimal():
        raise SweepError(f"no Dask scheduler has the address {address!r}; expected tcp://HOST:PORT or tls://HOST:PORT")
    with without_logs(), ExitStack() as stack:
        try:
            with ThreadPoolExecutor(1) as pool:  # a notebook has an event loop in this thread
                kind = pool.submit(lambda: asyncio.run(_kind_of_server(address, options))).result()
            if kind in ("Worker", "Nanny"):
                raise SweepError(f"{address!r} is the address of a Dask {kind.lower()}, not of a scheduler")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of other versions: `DaskWorkers` says it in words
                client = Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False, security=security)
        except (OSError, ValueError, TypeError, TimeoutError) as error:
            reason = f": {error}" if str(error) else ""
            message = f"no Dask scheduler answers at {address!r} within {CONNECT_TIMEOUT_S} s{reason}"
            raise SweepError(message) from error
        yield stack.enter_context(client)


async def _kind_of_server(address: str, options: dict[str, Any]) -> str:
    """Return what kind of Dask server answers; raises OSError or TimeoutError.

    A client would wait for ever for the handshake of a server that says nothing, such as a scheduler that is stopped.
    """
    try:
        async with rpc(address, timeout=CONNECT_TIMEOUT_S, connection_args=options) as server:
            return str((await asyncio.wait_for(server.identity(), CONNECT_TIMEOUT_S))["type"])
    except (OSError, TimeoutError):
        raise
    except Exception as error:  # whatever Dask makes of the words of another kind of server
        raise OSError(f"what answers is no Dask server ({type(error).__name__}: {error})") from error


def tls(ca: Path, cert: Path, key: Path) -> Security:
    """Return what a TLS scheduler asks of its clients; raises SweepError for files that cannot be used."""
    security = Security(
        tls_ca_file=str(ca), tls_client_cert=str(cert), tls_client_key=str(key), require_encryption=True
    )
    try:
        security.get_connection_args("client")
    except OSError as error:  # ssl.SSLError is one
        raise SweepError(f"cannot use the TLS files {ca}, {cert} and {key}: {error}") from error
    return security


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
def local_cluster(options: Mapping[str, Any], dashboard: bool = False) -> Iterator[Any]:
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
                cluster = stack.enter_context(own_cluster(LocalCluster, whole))
                break
            except RuntimeError as error:  # Dask's own traceback has sixty lines
                script = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
                unguarded = script.suffix == ".py" and script.is_file()
                unguarded = unguarded and "__main__" not in script.read_text(errors="replace")
                if number == STARTS or unguarded:
                    raise NoWorkersError(error, unguarded) from None
        yield cluster


class _Worker(Worker):
    """A worker in this process without Dask's pages about it: they need bokeh, and everybody on this machine could open
    them.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **{**options, "dashboard": False})


@contextmanager
def own_cluster(kind: Any, options: Mapping[str, Any]) -> Iterator[Any]:
    """Start a cluster that belongs to this run and ends with it; worker processes on this machine are started as
    `start_method` says.

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
                method = stack.enter_context(start_method())
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
        stack.enter_context(_lost_workers_replaced(cluster))
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
def _lost_workers_replaced(cluster: Any) -> Iterator[None]:
    """Let a cluster replace the workers that it has lost, such as batch jobs that have ended.

    dask-jobqueue#691: a cluster forgets them, and starts others only when its size is set, here to what it is.
    """
    if not isinstance(cluster, SpecCluster) or cluster.loop is None:
        yield
        return
    replacing = PeriodicCallback(lambda: cluster.scale(len(cluster.plan)), REPLACE_EVERY_S * 1000)
    loop = cluster.loop
    loop.add_callback(replacing.start)
    try:
        yield
    finally:
        loop.add_callback(replacing.stop)


@contextmanager
def without_logs() -> Iterator[None]:
    """Keep Dask's log off standard error in this block, since we say in a sentence what it says at length; other
    handlers of its loggers are left alone.
    """
    handlers = [
        handler
        for name, logger in list(logging.root.manager.loggerDict.items())
        if name.partition(".")[0] in ("distributed", "tornado", "bokeh") and isinstance(logger, logging.Logger)
        for handler in logger.handlers
        if type(handler) is logging.StreamHandler
    ]
    for handler in handlers:
        handler.addFilter(_no_record)
    try:
        yield
    finally:
        for handler in handlers:
            handler.removeFilter(_no_record)


def _no_record(_record: logging.LogRecord) -> bool:
    return False


Count = Annotated[int, Field(strict=True, ge=1)]


class Adapt(BaseModel, extra="forbid"):
    """The arguments of the `adapt` of a cluster."""

    minimum: int = Field(0, strict=True, ge=0)
    maximum: Count | None = None
    minimum_jobs: int = Field(0, strict=True, ge=0)
    maximum_jobs: Count | None = None
    interval: Any = None
    wait_count: Any = None
    target_duration: Any = None

    @model_validator(mode="after")
    def _has_bounds(self) -> "Adapt":
        bounds = {"": (self.minimum, self.maximum), "_jobs": (self.minimum_jobs, self.maximum_jobs)}
        if all(most is None for _, most in bounds.values()):
            raise ValueError("must say a maximum; without one the cluster would grow with the work")
        for name, (least, most) in bounds.items():
            if most is not None and least > most:
                raise ValueError(f"minimum{name} = {least}: must be at most maximum{name} = {most}")
        return self


class ClusterFile(BaseModel, extra="forbid"):
    """What a file says of a cluster: its class, the arguments of the class and of its `scale` or `adapt`."""

    class_name: str = Field(alias="class", pattern=r"^[^\W\d]\w*(\.[^\W\d]\w*)+$")
    options: dict[str, Any] = {}
    scale: Annotated[dict[str, Count], BeforeValidator(lambda n: {"n": n} if type(n) is int else n)] | None = None
    adapt: Adapt | None = None

    @model_validator(mode="after")
    def _has_one_size(self) -> "ClusterFile":
        if (not self.scale and self.adapt is None) or (self.scale and self.adapt):
            raise ValueError("write either scale = WORKERS or adapt = { minimum = WORKERS, maximum = WORKERS }")
        return self


def read_cluster_file(path: Path) -> ClusterFile:
    """Return what a TOML or YAML file says about a cluster; raises SweepError with everything that is wrong in it."""
    import yaml

    try:
        text = path.read_text(encoding="utf-8")
        document = yaml.safe_load(text) if path.suffix in (".yaml", ".yml") else tomllib.loads(text)
        return ClusterFile.model_validate(document)
    except (OSError, UnicodeDecodeError) as error:
        raise SweepError(f"cannot be read: {error}", str(path)) from error
    except tomllib.TOMLDecodeError as error:
        raise SweepError(f"not valid TOML: {error}", str(path)) from error
    except yaml.YAMLError as error:
        raise SweepError(f"not valid YAML: {' '.join(str(error).split())}", str(path)) from error
    except ValidationError as error:
        raise SweepError([_problem(item) for item in error.errors()], str(path)) from error


def _problem(item: Any) -> str:
    """Return what pydantic finds wrong in a file, in our words."""
    key = ".".join(map(str, item["loc"]))
    if item["type"] == "extra_forbidden":
        known = Adapt.model_fields if item["loc"][0] == "adapt" else ("class", "options", "scale", "adapt")
        return f"unknown key {key}{suggest(str(item['loc'][-1]), list(known))}"
    if item["type"] == "value_error":
        return f"{key}: {item['ctx']['error']}".removeprefix(": ")
    if key == "class":
        value = "missing" if item["type"] == "missing" else shown(item["input"])
        return f"class = {value}: must be the import path of a cluster's class, e.g. 'dask_jobqueue.SLURMCluster'"
    return f"{key} = {shown(item['input'])}: {item['msg'][0].lower()}{item['msg'][1:]}"


def cluster_class(file: ClusterFile) -> Any:
    """Return the class that a cluster file names; raises SweepError where there is none or it is no Dask cluster."""
    module, _, attribute = file.class_name.rpartition(".")
    try:
        kind = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # whatever a module raises while it is imported
        missing = isinstance(error, ModuleNotFoundError) and error.name == "dask_jobqueue"
        hint = "; pip install 'linksweep[jobqueue]'" if missing else ""
        name = "" if isinstance(error, ModuleNotFoundError | AttributeError) else f"{type(error).__name__}: "
        raise SweepError(f"class = {file.class_name!r}: {name}{error}{hint}") from error
    if not isinstance(kind, type) or not all(hasattr(kind, name) for name in ("scale", "adapt", "close")):
        raise SweepError(f"class = {file.class_name!r}: is no class of a Dask cluster")
    return kind
