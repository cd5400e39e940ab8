"""The Dask workers that a run may use: of a scheduler that runs elsewhere, of a cluster that a file describes, and of
this machine where they are to have a dashboard.
"""

import asyncio
import importlib
import inspect
import logging
import math
import os
import signal
import tempfile
import tomllib
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Annotated, Any

import dask
from distributed import Client, LocalCluster, SpecCluster, rpc
from distributed.security import Security
from pydantic import BaseModel, BeforeValidator, Field, ValidationError, model_validator
from tornado.ioloop import PeriodicCallback

from linksweep.sweep.contract import SweepError, shown, suggest
from linksweep.sweep.executing.children import KEEP_BYTES, ONE_THREAD
from linksweep.sweep.executing.dask_driver import DaskDriver
from linksweep.sweep.executing.pools import Resources, available_cores
from linksweep.sweep.executing.process import set_environment
from linksweep.sweep.executing.task import Executor, Place, Say
from linksweep.sweep.interrupt import SIGNALS

CONNECT_TIMEOUT_S = 10

# An adaptive cluster has as many workers as the tasks in flight would keep busy for this time; tasks are short.
ADAPT_WITHIN = "500ms"

# Seconds that workers get to finish when a run is stopped.
PATIENCE_S = 0.5

# Seconds that an interrupted run waits for what it has begun to start, so as to end it: usually less than one.
UNDO_S = 5.0

# Seconds between two looks whether a cluster has lost workers.
REPLACE_EVERY_S = 5

# Keeps modules of the present folder, which may be a stranger's, out of the processes of a cluster.
SAFE_PATH = "PYTHONSAFEPATH"

# Environment of every worker; Python and libraries read it as they start, before Dask could set anything.
ENVIRONMENT = {
    "MALLOC_TRIM_THRESHOLD_": str(KEEP_BYTES),
    "MALLOC_MMAP_THRESHOLD_": str(KEEP_BYTES),
    "DASK_LOGGING__DISTRIBUTED": "critical",
    "PYTHONHASHSEED": "6640",  # Dask's: sets of strings are in the same order on all workers of all runs
    SAFE_PATH: "1",
    **dict.fromkeys(ONE_THREAD, "1"),
}

OWN_CLUSTER = {
    "distributed.admin.low-level-log-length": 10,  # messages kept in memory, with all that they carried
    "distributed.scheduler.allowed-failures": 0,  # we do a dead worker's task again, in a child process
    "distributed.worker.http.routes": [],  # everybody on this machine could open them
    "distributed.worker.multiprocessing-method": "spawn",  # this process has threads, and must not be forked
    **{f"distributed.nanny.pre-spawn-environ.{name}": value for name, value in ENVIRONMENT.items()},
}


@contextmanager
def dask_workers(reference: str, resources: Resources, say: Say) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on the Dask scheduler, client or cluster of the resources, or on workers with a dashboard.

    Raises SweepError where none answers, for anything wrong in the file, and for workers that would compute other
    numbers than this process.
    """
    with without_logs(), ExitStack() as stack:
        if (client := resources.client) is not None:
            words = f"the Dask scheduler at {client.scheduler_info()['address']}"
        elif (address := resources.scheduler) is not None:
            words = f"the Dask scheduler at {address}"
            client = stack.enter_context(client_at(address, tls(*resources.tls) if resources.tls else None))
        elif (path := resources.cluster) is not None:
            file = read_cluster_file(path)
            words = f"the {file.class_name.rpartition('.')[2]} of {path}"
            client = stack.enter_context(_client_of(file, str(path)))
        else:
            workers = resources.workers or available_cores()
            words = f"{workers} local worker {'process' if workers == 1 else 'processes'}"
            memory = {} if resources.limits.memory is None else {"memory_limit": resources.limits.memory}
            options = {"n_workers": workers, "threads_per_worker": 1, **memory}
            local = ClusterFile.model_validate(
                {"class": "distributed.LocalCluster", "options": options, "scale": workers}
            )
            client = stack.enter_context(_client_of(local, "--dashboard"))
        driver = DaskDriver(client, words, reference, resources.limits, say)
        stack.callback(driver.cancel)
        driver.prepare()
        yield Place(f"on {words}", dashboard=_link(client)), driver


def _link(client: Client) -> str:
    """Return the address of a client's dashboard, empty if there is none: the scheduler needs bokeh for it."""
    try:
        client.run_on_scheduler(importlib.import_module, "bokeh")
    except Exception:  # also a scheduler that runs nothing for clients
        return ""
    return str(client.dashboard_link or "")


@contextmanager
def _client_of(file: "ClusterFile", where: str) -> Iterator[Client]:
    """Give a client of the cluster that a file describes; raises SweepError for anything wrong in it."""
    with ExitStack() as stack:
        try:
            cluster = stack.enter_context(own_cluster(cluster_class(file), file.options))
            if file.adapt is None:
                cluster.scale(**(file.scale or {}))
            else:
                cluster.adapt(**{"target_duration": ADAPT_WITHIN} | file.adapt)
            client = stack.enter_context(cluster.get_client())
        except SweepError as error:
            raise SweepError(error.problems, where) from error
        except Exception as error:  # whatever a cluster's class makes of its options
            cause: BaseException = error
            while cause.__cause__ is not None:
                cause = cause.__cause__
            raise SweepError(f"{file.class_name}: {type(cause).__name__}: {cause}", where) from error
        yield client


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
                warnings.simplefilter("ignore")  # of other versions: `DaskDriver` says it in words
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
    """Return what the ends of a TLS connection ask of each other; raises SweepError for files that cannot be used."""
    pair = {"cert": str(cert), "key": str(key)}
    roles = {f"tls_{role}_{name}": pair[name] for role in ("client", "scheduler", "worker") for name in pair}
    security = Security(tls_ca_file=str(ca), require_encryption=True, **roles)
    try:
        security.get_connection_args("client")
    except OSError as error:  # ssl.SSLError is one
        raise SweepError(f"cannot use the TLS files {ca}, {cert} and {key}: {error}") from error
    return security


@contextmanager
def _key_in_files(folder: Path) -> Iterator[Security]:
    """Make a key for the jobs of a batch system, in files below a folder that they share with this process, which only
    the owner can read.  Those that dask-jobqueue writes itself are left behind.
    """
    with tempfile.TemporaryDirectory(prefix=".linksweep-key-", dir=folder, ignore_cleanup_errors=True) as private:
        made = Security.temporary()
        files = [Path(private, name) for name in ("ca.pem", "cert.pem", "key.pem")]
        for file, text in zip(files, (made.tls_ca_file, made.tls_client_cert, made.tls_client_key), strict=True):
            file.write_text(text)
        yield tls(*files)


def _takes(kind: Any, option: str) -> bool:
    """Return whether a class of clusters, or one of its bases, has a parameter of this name."""
    return any(option in inspect.signature(base).parameters for base in kind.__mro__[:-1])


@contextmanager
def own_cluster(kind: Any, options: Mapping[str, Any]) -> Iterator[Any]:
    """Start a cluster that belongs to this run and ends with it.

    What listens asks for a key that is made for this run, because who reaches a scheduler or a worker without one can
    run code in it.  Options that name a ``protocol`` or a ``security`` are left as they are.
    """
    with ExitStack() as stack:
        stack.enter_context(without_logs())
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="linksweep-", ignore_cleanup_errors=True))
        stack.callback(set_environment, dict(os.environ))  # Dask, too, adds to it before it starts workers
        stack.enter_context(dask.config.set({**OWN_CLUSTER, "temporary-directory": scratch}))
        dashboard = {"dashboard_address": "127.0.0.1:0"}
        defaults: dict[str, Any] = {}
        if issubclass(kind, LocalCluster):
            defaults = {**dashboard, "silence_logs": False}
            if options.get("processes", True):
                defaults["security"] = True
                os.environ[SAFE_PATH] = "1"
                resource_tracker.ensure_running()  # its start would unblock signals in the thread that starts workers
        elif _takes(kind, "scheduler_options"):
            defaults = {"scheduler_options": dashboard | dict(options.get("scheduler_options", {})), "security": True}
            options = {key: value for key, value in options.items() if key != "scheduler_options"}
            if _takes(kind, "shared_temp_directory") and not {"protocol", "security"} & options.keys():
                shared = options.get("shared_temp_directory", ".")
                defaults["security"] = stack.enter_context(_key_in_files(Path(shared).expanduser().resolve()))
        if "protocol" in options:
            defaults.pop("security", None)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Creating scratch directories is taking")  # even our own, if it is busy
            cluster = stack.enter_context(_started(lambda: kind(**{**defaults, **options})))
        stack.enter_context(_prompt_end(cluster))
        stack.enter_context(_lost_workers_replaced(cluster))
        yield cluster


def _started(make: Callable[[], Any]) -> Any:
    """Return the cluster that is made; its processes do not get SIGINT, SIGHUP and SIGTERM: a terminal or a batch
    system sends these to every process, but only the client is to answer (distributed#1925).

    Processes inherit the signal mask of the thread that starts them.  Here that is another thread, so that this one can
    be interrupted meanwhile: then what was begun is ended.
    """

    def start() -> Any:
        signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        return make()

    with ThreadPoolExecutor(1) as pool:
        made = pool.submit(start)
        try:
            return made.result()
        except BaseException:
            with suppress(Exception):
                made.result(UNDO_S).close()
            raise


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


# The arguments of the `adapt` of a cluster, which takes any other without a word and then does nothing.
ADAPT = ("minimum", "maximum", "minimum_jobs", "maximum_jobs", "interval", "wait_count", "target_duration")

Count = Annotated[int, Field(strict=True, ge=1)]


class ClusterFile(BaseModel, extra="forbid"):
    """What a file says of a cluster: its class, the arguments of the class and of its `scale` or `adapt`."""

    class_name: str = Field(alias="class", pattern=r"^[^\W\d]\w*(\.[^\W\d]\w*)+$")
    options: dict[str, Any] = {}
    scale: Annotated[dict[str, Count], BeforeValidator(lambda n: {"n": n} if type(n) is int else n)] | None = None
    adapt: dict[str, Any] | None = None

    @model_validator(mode="after")
    def _has_one_size(self) -> "ClusterFile":
        if bool(self.scale) == (self.adapt is not None):
            raise ValueError("write either scale = WORKERS or adapt = { minimum = WORKERS, maximum = WORKERS }")
        adapt = {"maximum": 1} if self.adapt is None else self.adapt
        if unknown := adapt.keys() - set(ADAPT):
            raise ValueError(f"unknown key adapt.{min(unknown)}{suggest(min(unknown), ADAPT)}")
        if not adapt.keys() & {"maximum", "maximum_jobs"}:
            raise ValueError("adapt: must say a maximum; without one the cluster would grow with the work")
        for unit in ("", "_jobs"):
            least, most = adapt.get(f"minimum{unit}", 0), adapt.get(f"maximum{unit}", math.inf)
            if (
                type(least) is not int
                or not (type(most) is int or most == math.inf)
                or not 0 <= least <= most
                or most < 1
            ):
                raise ValueError(
                    f"adapt: minimum{unit} = {least} must be at most maximum{unit} = {most}, that at least 1"
                )
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
    except (tomllib.TOMLDecodeError, yaml.YAMLError) as error:
        kind = "YAML" if isinstance(error, yaml.YAMLError) else "TOML"
        raise SweepError(f"not valid {kind}: {' '.join(str(error).split())}", str(path)) from error
    except ValidationError as error:
        raise SweepError([_problem(item) for item in error.errors()], str(path)) from error


def _problem(item: Any) -> str:
    """Return what pydantic finds wrong in a file, in our words."""
    key = ".".join(map(str, item["loc"]))
    if item["type"] == "extra_forbidden":
        return f"unknown key {key}{suggest(key, ['class', 'options', 'scale', 'adapt'])}"
    if item["type"] == "value_error":
        return str(item["ctx"]["error"])
    hint = ", the import path of a cluster's class such as 'dask_jobqueue.SLURMCluster'" if key == "class" else ""
    return f"{key} = {shown(item['input'])}: {item['msg']}{hint}"


def cluster_class(file: ClusterFile) -> Any:
    """Return the class that a cluster file names; raises SweepError where there is none or it is no Dask cluster."""
    module, _, attribute = file.class_name.rpartition(".")
    try:
        kind = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # whatever a module raises while it is imported
        missing = isinstance(error, ModuleNotFoundError) and error.name == "dask_jobqueue"
        hint = "; pip install 'linksweep[jobqueue]'" if missing else ""
        raise SweepError(f"class = {file.class_name!r}: {type(error).__name__}: {error}{hint}") from error
    if not isinstance(kind, type) or not all(hasattr(kind, name) for name in ("scale", "adapt", "close")):
        raise SweepError(f"class = {file.class_name!r}: is no class of a Dask cluster")
    return kind
