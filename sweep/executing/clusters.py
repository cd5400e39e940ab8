"""The Dask workers that a run may use: of a scheduler that runs elsewhere, of a cluster that a file describes, and of
this machine where they are to have a dashboard; and how jobs are computed there when workers die, stall or come late.
"""

import asyncio
import importlib
import inspect
import logging
import multiprocessing
import os
import signal
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future as Fetching, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Annotated, Any, Literal, get_args

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, Security, SpecCluster, WorkerPlugin, get_worker, rpc
from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, ValidationError, ValidationInfo, field_validator
from tornado.ioloop import PeriodicCallback

from linksweep.sweep.code import provide, sendable, source_digest
from linksweep.sweep.contract import SweepError, refused, shown, suggest
from linksweep.sweep.executing.executor import KEEP_BYTES, Children
from linksweep.sweep.executing.pools import ONE_THREAD, Limits, Place, Resources, available_cores
from linksweep.sweep.executing.task import AnyJob, Executor, Failure, Identity, Task, TaskResult, other_versions
from linksweep.sweep.executing.worker import Deadlines, compute, leave_signals_to_parent, one_thread, set_environment
from linksweep.sweep.planning.accumulator import TASK_S, TASKS_IN_FLIGHT, task_seconds
from linksweep.sweep.studies.reader import parsed, read_text

CONNECT_TIMEOUT_S = 10

# An adaptive cluster has as many workers as the tasks in flight would keep busy for this time; tasks are short.
ADAPT_WITHIN = "500ms"

# Seconds that workers get to finish when a run is stopped.
CLOSE_S = 0.5

# Seconds between two looks whether a cluster has lost workers.
REPLACE_EVERY_S = 5

# Lets through what a logger of this name logs: nothing.
NO_RECORDS = logging.Filter("linksweep.nobody")

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
def dask_workers(reference: str, resources: Resources, say: Callable[[str], None]) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on the Dask scheduler, client or cluster of the resources, or on workers with a dashboard.

    Raises SweepError where none answers, for anything wrong in the file, and for workers that would compute other
    numbers than this process.
    """
    with without_logs(), ExitStack() as stack:
        if (client := resources.client) is not None:
            words = f"the Dask scheduler at {client.scheduler_info()['address']}"
            stack.enter_context(_lost_workers_replaced(client.cluster))
        elif (address := resources.scheduler) is not None:
            words = f"the Dask scheduler at {address}"
            client = stack.enter_context(client_at(address, tls(*resources.tls) if resources.tls else None))
        elif (path := resources.cluster) is not None:
            file = read_cluster_file(Path(path))
            words = f"the {file.class_name.rpartition('.')[2]} of {path}"
            client = stack.enter_context(_client_of(file, str(path)))
        else:
            workers = resources.workers or available_cores()
            words = f"{workers} local worker {'process' if workers == 1 else 'processes'}"
            memory = {} if resources.limits.memory is None else {"memory_limit": resources.limits.memory}
            options = {"n_workers": workers, "threads_per_worker": 1, **memory}
            local = {"class": "distributed.LocalCluster", "options": options, "scale": workers}
            client = stack.enter_context(_client_of(ClusterFile.model_validate(local), "--dashboard"))
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
            cluster = stack.enter_context(own_cluster(cluster_class(file.class_name), file.options))
            if file.adapt is None:
                cluster.scale(**(file.scale or {}))
            else:
                cluster.adapt(**{"target_duration": ADAPT_WITHIN} | file.adapt)
            client = stack.enter_context(cluster.get_client())
        except SweepError as error:
            raise SweepError(error.problems, where) from error
        except (Exception, SystemExit) as error:  # whatever a cluster's class makes of its options
            cause = _first_cause(error)
            raise SweepError(f"{file.class_name}: {type(cause).__name__}: {cause}", where) from error
        yield client


def _first_cause(error: BaseException) -> BaseException:
    """Return from what an error, or what it was raised from, was raised: Dask says only that something failed."""
    return error if error.__cause__ is None else _first_cause(error.__cause__)


@contextmanager
def client_at(address: str, security: Security | None = None) -> Iterator[Client]:
    """Give a client of a Dask scheduler that runs elsewhere; raises SweepError where none answers."""
    options = (security or Security()).get_connection_args("client")
    if address.startswith("tls://") and options["ssl_context"] is None:
        raise SweepError(f"no certificates for {address!r}: give --tls-ca, --tls-cert and --tls-key, or configure Dask")
    protocol, _, rest = address.partition("://")
    if protocol not in ("tcp", "tls") or not rest.rpartition(":")[0] or not rest.rpartition(":")[2].isdecimal():
        raise SweepError(f"no Dask scheduler has the address {address!r}; expected tcp://HOST:PORT or tls://HOST:PORT")
    try:
        with ThreadPoolExecutor(1) as pool:  # a notebook has an event loop in this thread
            kind = pool.submit(lambda: asyncio.run(_kind_of_server(address, options))).result()
        if kind in ("Worker", "Nanny"):
            raise SweepError(f"{address!r} is the address of a Dask {kind.lower()}, not of a scheduler")
        with warnings.catch_warnings(action="ignore"):  # of other versions: `DaskDriver` says it in words
            client = Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False, security=security)
    except SweepError:
        raise
    except Exception as error:  # also whatever Dask makes of the words of another kind of server
        other = "" if isinstance(cause := _first_cause(error), OSError) else "what answers is no Dask server: "
        reason = f": {other}{cause}" if str(cause) else ""
        raise SweepError(f"no Dask scheduler answers at {address!r} within {CONNECT_TIMEOUT_S} s{reason}") from error
    with client:
        yield client


async def _kind_of_server(address: str, options: dict[str, Any]) -> str:
    """Return what kind of Dask server answers; raises whatever Dask makes of another one.

    A client would wait for ever for the handshake of a server that says nothing, such as a scheduler that is stopped.
    """
    async with rpc(address, timeout=CONNECT_TIMEOUT_S, connection_args=options) as server:
        return str((await asyncio.wait_for(server.identity(), CONNECT_TIMEOUT_S))["type"])


def tls(ca: Path, cert: Path, key: Path) -> Security:
    """Return what the ends of a TLS connection ask of each other; raises SweepError for files that cannot be used."""
    pair = {"cert": str(cert), "key": str(key)}
    roles = {f"tls_{role}_{name}": pair[name] for role in ("client", "scheduler", "worker") for name in pair}
    security = Security(tls_ca_file=str(ca), require_encryption=True, **roles)
    with refused(OSError, said=f"cannot use the TLS files {ca}, {cert} and {key}: "):  # ssl.SSLError is one
        security.get_connection_args("client")
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
    """Return the cluster that is made; its processes do not get SIGINT and SIGHUP: a terminal sends these to every
    process, but only the client is to answer (distributed#1925).  It ends by SIGTERM what Dask has not ended.

    Processes inherit the signal mask of the thread that starts them.  Here that is another thread, so that this one can
    be interrupted meanwhile: then what was begun is ended.
    """

    def start() -> Any:
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGHUP])
        return make()

    with ThreadPoolExecutor(1) as pool:
        made = pool.submit(start)
        try:
            return made.result()
        except BaseException:
            with suppress(Exception):
                made.result().close()  # the pool would wait for it, too
            raise


@contextmanager
def _prompt_end(cluster: Any) -> Iterator[None]:
    """Do not wait for blocks under way where an exception ends the run: nobody will take their results."""

    async def close_workers() -> None:
        await asyncio.gather(*(worker.close(timeout=CLOSE_S) for worker in cluster.workers.values()))

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

    dask-jobqueue#691: a cluster forgets them, and starts others only when its size is set, here to what it is.  One
    whose process died while it started it would keep.
    """

    def replace_lost() -> None:
        for name in [name for name, one in cluster.workers.items() if one.status.name == "failed"]:
            del cluster.workers[name]
        cluster.scale(len(cluster.plan))

    if not isinstance(cluster, SpecCluster) or cluster.loop is None:
        yield
        return
    replacing = PeriodicCallback(replace_lost, REPLACE_EVERY_S * 1000)
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
    # One of Dask's is that of all its loggers, of tornado's and of bokeh's.  Dask's own `silence_logging_cmgr` only
    # raises its level, which what starts or ends a cluster meanwhile sets again.
    handlers = [one for one in logging.getLogger("distributed").handlers if type(one) is logging.StreamHandler]
    for handler in handlers:
        handler.addFilter(NO_RECORDS)
    try:
        yield
    finally:
        for handler in handlers:
            handler.removeFilter(NO_RECORDS)


# The arguments of the `adapt` of a cluster, which takes any other without a word and then does nothing.
Adapt = Literal["minimum", "maximum", "minimum_jobs", "maximum_jobs", "interval", "wait_count", "target_duration"]

Count = Annotated[int, Field(strict=True, ge=1)]


def _usable(options: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments of a cluster's class; raises ValueError where Dask would fail or wait for ever."""
    if options.get("asynchronous") or (isinstance(n := options.get("n_workers"), int) and n < 0):
        raise ValueError("options: n_workers must be >= 0, and asynchronous is not for runs")
    return options


class ClusterFile(BaseModel, extra="forbid"):
    """What a file says of a cluster: its class, the arguments of the class and of its `scale` or `adapt`."""

    class_name: Annotated[str, AfterValidator(lambda name: cluster_class(name) and name)] = Field(
        alias="class", pattern=r"^[^\W\d]\w*(\.[^\W\d]\w*)+$"
    )
    options: Annotated[dict[str, Any], AfterValidator(_usable)] = {}
    scale: Annotated[dict[str, Count], BeforeValidator(lambda n: n if isinstance(n, dict) else {"n": n})] | None = None
    adapt: dict[Adapt, Any] | None = Field(None, validate_default=True)

    @field_validator("adapt")
    @classmethod
    def _has_one_size(cls, adapt: dict[str, Any] | None, others: ValidationInfo) -> dict[str, Any] | None:
        if "scale" in others.data and bool(others.data["scale"]) == (adapt is not None):
            raise ValueError("write either scale = WORKERS or adapt = { minimum = WORKERS, maximum = WORKERS }")
        if adapt is not None and not adapt.keys() & {"maximum", "maximum_jobs"}:
            raise ValueError("adapt: must say a maximum; without one the cluster would grow with the work")
        return adapt


def read_cluster_file(path: Path) -> ClusterFile:
    """Return what a TOML or YAML file says about a cluster; raises SweepError with everything that is wrong in it."""
    import yaml

    text = read_text(path)
    with refused(yaml.YAMLError, said="not valid YAML: ", where=path):
        document = yaml.safe_load(text) if path.suffix in (".yaml", ".yml") else parsed(text, path)
    try:
        return ClusterFile.model_validate(document)
    except ValidationError as error:
        raise SweepError([_problem(item) for item in error.errors()], str(path)) from error


def _problem(item: Any) -> str:
    """Return what pydantic finds wrong in a file, in our words."""
    key = ".".join(map(str, item["loc"])).removesuffix(".n")  # which is no key where the scale is a number
    if item["type"] in ("extra_forbidden", "literal_error"):
        key, known = key.removesuffix(".[key]"), ["class", "options", "scale", "adapt"]
        return f"unknown key {key}{suggest(key, [*known, *(f'adapt.{name}' for name in get_args(Adapt))])}"
    if item["type"] == "value_error":
        return str(item["ctx"]["error"])
    hint = ", the import path of a cluster's class such as 'dask_jobqueue.SLURMCluster'" if key == "class" else ""
    return f"{key} = {shown(item['input'])}: {item['msg']}{hint}"


def cluster_class(name: str) -> Any:
    """Return the class of this name; raises ValueError where there is none or it is no Dask cluster."""
    module, _, attribute = name.rpartition(".")
    try:
        answer = signal.getsignal(signal.SIGINT)
        kind = getattr(importlib.import_module(module), attribute)
        if signal.getsignal(signal.SIGINT) is not answer:  # dask_jobqueue answers Ctrl-C by sys.exit once imported
            signal.signal(signal.SIGINT, answer)
    except (Exception, SystemExit) as error:  # whatever a module raises while it is imported
        missing = isinstance(error, ModuleNotFoundError) and error.name == "dask_jobqueue"
        hint = "; pip install 'linksweep[jobqueue]'" if missing else ""
        raise ValueError(f"class = {name!r}: {type(error).__name__}: {error}{hint}") from error
    if not isinstance(kind, type) or not all(hasattr(kind, method) for method in ("scale", "adapt", "close")):
        raise ValueError(f"class = {name!r}: is no class of a Dask cluster")
    return kind


PLUGIN = "linksweep"

# Seconds between two looks at the number of workers.
LOOK_EVERY_S = 1.0

# Seconds between two looks at the state of each worker, of which there may be thousands, while results come.
STATES_EVERY_S = 30.0

# Seconds without workers before the user is told: a worker that died is replaced sooner.
PATIENCE_S = 3.0

# Attempts to bring a task that fails outside of the experiment to an end, with a pause after each.
MAX_ATTEMPTS = 6

PAUSE_S = 0.25

# Most tasks that are sent in one message: with a message for each, the round trip to a worker limited a run to 60 tasks
# a second.
MOST_SENT = 32

# How often a block may be with a worker that dies: in a task, in a child process, and in one of its own.
MAX_LOSSES = 3

KEPT = "what was finished is kept, the same command goes on from there"


class TaskPlugin(WorkerPlugin):
    """Limits BLAS to one thread for as long as the plugin is on a worker, and holds the deadlines of its blocks.

    Dask's nanny limits BLAS for the workers that it starts, but not in other processes (distributed#9075): sums of
    products there would depend on the number of cores, and workers would compete for the cores.
    """

    name = PLUGIN
    idempotent = True  # a second client of the same workers must not reset their alarm

    def setup(self, worker: Any) -> None:
        """Set the limits when the plugin reaches a worker; in a process of its own this runs in the main thread."""
        self._limits = ExitStack()
        self._limits.enter_context(one_thread())
        self.deadlines = Deadlines()
        if getattr(worker, "nanny", None):  # a process of its own
            os.dup2(2, 1)  # standard output goes to standard error, also that of C code and of programs it starts
            multiprocessing.current_process().daemon = False  # else a block could not use multiprocessing
            leave_signals_to_parent()  # Dask would let the worker go, and every other one that then gets the block

    def teardown(self, worker: Any) -> None:
        """Lift the limit of one thread."""
        self._limits.close()


class SourcesPlugin(WorkerPlugin):
    """Brings the sources of an experiment's file and of its local modules, which a worker may not have; in each run
    anew, since the cell of a class may have been executed again, and its members are others then.
    """

    def __init__(self, sources: Any) -> None:
        self._sources = sources
        self.name = f"{PLUGIN}-{sources.path}-{sources.digest}"

    def setup(self, worker: Any) -> None:
        """Let the worker load the experiment."""
        provide(self._sources)


@dataclass(frozen=True)
class Reply:
    """A worker's answer: its address, how it differs from the client, and the result unless it is ``another``, which
    may compute other numbers.
    """

    worker: str
    another: Identity | None
    others: list[str]
    result: Any = None


def run_on_worker(task: Task, expected: Identity, guarded: bool, memory_limit: int | None) -> Reply:
    """Run a task on the worker that this is called on, if it computes the same numbers as the client.

    With ``guarded`` blocks run in a child process of at most ``memory_limit`` bytes (None: no limit); so they do with a
    time limit, which may end their process, on a worker without a nanny: that may be a thread of the user's session.
    """
    worker = get_worker()
    guarded |= task.time_limit_s is not None and not worker.nanny
    here = Identity.here(task.experiment_reference, task.source_digest)
    another, result = here if expected.differences(here) else None, None
    if another is None and guarded:
        with Children(1, Limits(task.time_limit_s, memory_limit), forked=False, expected=expected) as child:
            result = child.run(task)
    elif another is None:
        plugin = worker.plugins[PLUGIN]
        assert isinstance(plugin, TaskPlugin)
        result = compute(task, plugin.deadlines)
    return Reply(worker.address, another, other_versions(expected.others, here.others), result)


@dataclass
class _Submission:
    """A job on its way to a worker: how often it was with a worker that died, and how often Dask failed with it.

    ``succeeded`` counts the tasks of the run that had succeeded when this job was last lost; ``future`` is Dask's.
    """

    job: Any
    losses: int = 0
    troubles: int = 0
    succeeded: int = 0
    future: "Future[Any] | None" = None


class DaskDriver:
    """An executor on the workers of a Dask ``client``; ``where`` these are in words.

    The work of a worker that died is done again in a child process of another one, where a block that ends its process
    ends nothing else and can be identified: no block is blamed for another.
    """

    def __init__(self, client: Client, where: str, reference: str, limits: Limits, say: Callable[[str], None]) -> None:
        self.client, self._where, self._reference, self._limits, self._say = client, where, reference, limits, say
        self._expected = Identity.here(reference)
        self._threads = 1
        self._warned: set[str] = set()
        self._looked = self._had_workers = self._knew_states = time.monotonic()
        self._waiting = False
        self._in_flight: dict[Fetching[Any], _Submission] = {}

    def cancel(self) -> None:
        """Take back the tasks whose results nobody will take: the client may be used for others."""
        if self._in_flight and self.client.status == "running":
            with suppress(OSError, TimeoutError):
                self.client.cancel([one.future for one in self._in_flight.values()])

    def prepare(self, troubles: int = 0) -> None:
        """Wait for a worker, bring the workers what they need, and compare them with the client; again if there were
        ``troubles``, as a worker left meanwhile.

        Raises SweepError with a list where a worker would compute other numbers.
        """
        arguments = self._reference, source_digest(self._reference)
        try:
            self.client.register_plugin(TaskPlugin())
            in_this_process = str(self.client.scheduler_info()["address"]).startswith("inproc://")
            if not in_this_process and (sources := sendable(self._reference)) is not None:
                self.client.register_plugin(SourcesPlugin(sources))
            # Where there is no worker yet, an adaptive cluster starts one for this.
            probe = self._fetch(self.client.submit(Identity.here, *arguments, pure=False))
            while not wait([probe], LOOK_EVERY_S).done:
                self._look(idle=True)
            answers = self.client.run(Identity.here, *arguments, on_error="return")
        except SweepError:
            raise
        except Exception as error:  # whatever keeps a worker from importing what it is sent
            if self.client.status != "running":
                raise self._gone() from error
            if not isinstance(error, OSError) or troubles + 1 >= MAX_ATTEMPTS:
                raise self._unable(error) from error
            time.sleep(PAUSE_S)
            self.prepare(troubles + 1)
            return
        problems = []
        for worker, answer in sorted(answers.items()):
            if isinstance(answer, Identity):
                self._warn(worker, other_versions(self._expected.others, answer.others))
                problems += self._differences(worker, answer)
            elif not isinstance(answer, OSError):  # else it has gone; should it return, its first task is compared
                problems.append(f"{worker}: {type(answer).__name__}: {answer}")
        if problems:
            raise SweepError(problems, "workers that would not compute what this process would")
        self._look()

    def _differences(self, worker: str, there: Identity) -> list[str]:
        """Return a phrase for everything that decides the numbers and differs in a worker."""
        self._expected = self._expected.beside(there, self._reference)
        return [f"{worker}: {text}" for text in self._expected.differences(there)]

    def _look(self, idle: bool = False) -> None:
        """Count the threads of the workers, and at times, or if they seem ``idle``, see whether Dask has paused some
        of them; raises SweepError where the connection is lost.

        Dask leaves what it has sent to a worker there when it pauses that, for ever where a function leaks memory.
        """
        if self.client.status != "running":
            raise self._gone()
        idle = idle or time.monotonic() - self._knew_states > STATES_EVERY_S
        try:
            threads = sum(self.client.nthreads().values())
            workers = self.client.scheduler_info()["workers"] if idle and threads else {}
        except (OSError, TimeoutError) as error:
            raise self._gone() from error
        self._looked, self._threads = time.monotonic(), max(1, threads)
        self._knew_states = self._looked if idle else self._knew_states
        paused = {address: one for address, one in workers.items() if one["status"] == "paused"}
        # Nothing is lost where a worker has only tasks that are ready to begin.
        waiting = [a for a, one in paused.items() if one["nanny"] and {*one["metrics"]["task_counts"]} == {"ready"}]
        if waiting:
            self._say(f"Dask has paused {' and '.join(waiting)}, whose memory is nearly full; starts it anew")
            with suppress(OSError, TimeoutError):  # then it is seen again
                self.client.restart_workers(waiting, CONNECT_TIMEOUT_S, raise_for_error=False)
        is_paused = bool(paused) and len(paused) == len(workers)
        if threads and not is_paused:
            if self._waiting:
                self._say(f"{self._where} has workers again")
            self._had_workers, self._waiting = self._looked, False
        elif not self._waiting and self._looked - self._had_workers > PATIENCE_S:
            why = "paused all workers, as their memory is nearly full" if is_paused else "no workers"
            self._say(f"{self._where} has {why}; waiting for some")
            self._waiting = True

    def _warn(self, worker: str, texts: list[str]) -> None:
        """Say once how a worker differs in what decides at most how sums are rounded."""
        for text in texts:
            if text not in self._warned:
                self._warned.add(text)
                self._say(f"warning: {text} (worker {worker}); the last digits of results may differ")

    def _gone(self) -> SweepError:
        return SweepError(f"the connection to {self._where} is lost; {KEPT}")

    def _unable(self, error: BaseException) -> SweepError:
        return SweepError(f"the workers of {self._where} cannot run linksweep: {type(error).__name__}: {error}")

    def __call__(self, take: Callable[[int], Sequence[AnyJob]]) -> Iterator[tuple[AnyJob, Any]]:
        """Compute everything that ``take`` gives; begin now, not when the first result is asked for."""
        self._take: Callable[[int], Sequence[Any]] = take
        self._ended: SimpleQueue[Fetching[Any]] = SimpleQueue()
        self._succeeded = 0
        self._send_what_is_new()
        return self._results()

    def _room(self) -> int:
        return max(0, TASKS_IN_FLIGHT * self._threads - len(self._in_flight))

    def _send_what_is_new(self) -> None:
        """Send as much as there is room for: in several messages, so that workers need not wait for all to be sent."""
        while (room := min(self._room(), MOST_SENT)) and (jobs := self._take(room)):
            self._send([_Submission(job) for job in jobs])

    def _results(self) -> Iterator[tuple[Any, Any]]:
        """Yield each job with its result until there are no more."""
        while self._in_flight:
            fetching = None
            with suppress(Empty):
                fetching = self._ended.get(timeout=LOOK_EVERY_S)
            if time.monotonic() - self._looked > LOOK_EVERY_S:
                self._look(idle=fetching is None)
            if fetching is None:
                continue
            one = self._in_flight.pop(fetching)
            one.future = None  # its worker need not keep the result any longer
            try:
                answer = self._received(fetching)
            except SweepError:
                raise
            except KilledWorker as error:
                yield from self._lost(one, error)
            except Exception as error:
                self._send([self._after_trouble(one, error)])
            else:
                if answer.another is None:
                    self._succeeded += 1
                    yield one.job, answer.result
                else:  # in values that are known now to differ from process to process
                    self._send([one])
            if self._ended.empty() or self._room() >= self._threads:
                self._send_what_is_new()

    def _send(self, submissions: Sequence[_Submission]) -> None:
        """Send jobs in one message; all of them were with a worker that died equally often."""
        if not submissions:
            return
        seconds = task_seconds(self._threads)
        enough_s = 2.0 * seconds if seconds > TASK_S else 0.0
        guarded = submissions[0].losses > 0
        futures = self.client.map(
            run_on_worker,
            [one.job.task(self._limits, enough_s) for one in submissions],
            expected=self._expected,
            guarded=guarded,
            memory_limit=self._memory_limit() if guarded else None,
            pure=False,
        )
        for future, one in zip(futures, submissions, strict=True):
            fetching = self._fetch(future)
            self._in_flight[fetching] = replace(one, future=future)
            fetching.add_done_callback(self._ended.put)

    def _memory_limit(self) -> int | None:
        """Return the bytes that a child of a worker may take: by default those of the worker that has least."""
        limits = (worker["memory_limit"] for worker in self.client.scheduler_info()["workers"].values())
        return self._limits.memory or min(filter(None, limits), default=None)

    def _lost(self, one: _Submission, error: KilledWorker) -> Iterator[tuple[Any, Any]]:
        """Try again what was with a worker that died: the work in a child process, and if that takes its worker with
        it, each block in one of its own; yield the failure of one that does so again.
        """
        losses = one.losses + 1
        if losses < MAX_LOSSES:
            self._say(f"a worker died; a child process of another one does its work again ({losses})")
            jobs = [one.job] if losses == 1 else one.job.alone()
            self._send([replace(one, job=job, losses=losses, succeeded=self._succeeded) for job in jobs])
        elif one.succeeded == self._succeeded:  # that is no proof against a block
            words = f"the workers of {self._where} die whatever they do; no point is blamed for it, {KEPT}"
            raise SweepError(words) from error
        else:
            reason = Failure("killed", f"its worker died {MAX_LOSSES} times: {error}")
            yield one.job, TaskResult.failed(len(one.job), reason)

    def _after_trouble(self, one: _Submission, error: Exception) -> _Submission:
        """Return what is to be tried after an error that is not the experiment's; raises SweepError after too many."""
        what = f"{type(error).__name__}: {error}"
        if one.troubles + 1 >= MAX_ATTEMPTS:
            raise SweepError(
                f"a task on {self._where} failed {MAX_ATTEMPTS} times outside of the experiment, last with {what}; "
                f"no point is blamed for it, {KEPT}"
            ) from error
        self._say(f"warning: a task failed outside of the experiment ({what}); it is tried again")
        time.sleep(PAUSE_S)  # what ails Dask may pass
        return replace(one, troubles=one.troubles + 1)

    def _fetch(self, future: "Future[Any]") -> Fetching[Any]:
        """Begin to fetch the result of a future, once it has one; Dask fetches several in one message.

        Fetching goes on whether it is waited for or not.  Dask cancels what takes longer than its timeouts; if it had
        not begun yet, as on a machine that stalls for a moment, all that the client fetches later fails.
        """
        loop: Any = self.client.loop
        return asyncio.run_coroutine_threadsafe(self.client.gather(future, asynchronous=True), loop.asyncio_loop)

    def _received(self, fetching: Fetching[Any]) -> Reply:
        """Return a worker's answer; raises the error with which Dask lost it.  What the experiment raises is in it.

        Raises SweepError where the worker differs, where it cannot run linksweep, and where the connection is lost.
        """
        try:
            answer: Reply = fetching.result()
        except ImportError as error:
            raise self._unable(error) from error
        except Exception as error:
            if self.client.status != "running":
                raise self._gone() from error
            raise
        self._warn(answer.worker, answer.others)
        if answer.another is not None and (problems := self._differences(answer.worker, answer.another)):
            raise SweepError(problems, "a worker that differs")
        return answer
