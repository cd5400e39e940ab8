"""Makes the Dask clusters that a run may use: of this machine, one that runs elsewhere, one that a file describes."""

import asyncio
import importlib.metadata
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from distributed import Client
from distributed.comm.addressing import get_address_host_port
from distributed.comm.core import connect
from distributed.security import Security
from distributed.utils import LoopRunner
from threadpoolctl import threadpool_limits

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.clusterfile import cluster_class, read_cluster_file
from linksweep.sweep.executing.dask_executor import DaskExecutor
from linksweep.sweep.executing.dask_workers import DaskWorkers
from linksweep.sweep.executing.execute import NO_LIMITS, Executor, Limits, Place, Say
from linksweep.sweep.executing.local_cluster import LOOPBACK, local_cluster, own_cluster, without_logs
from linksweep.sweep.studies.study import Study

CONNECT_TIMEOUT_S = 10

ADAPT_WITHIN = "500ms"
"""An adaptive cluster has as many workers as the tasks in flight would keep busy for this time; tasks are short."""


@contextmanager
def local_workers(
    study: Study, workers: int, say: Say, limits: Limits = NO_LIMITS, dashboard: bool = False, method: str | None = None
) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on a Dask cluster on this machine.  With a ``method`` of multiprocessing its workers are
    processes of one thread each; without one they are threads of this process, and with limits each task runs in a
    child process.
    """
    options: dict[str, Any] = {"n_workers": 1, "threads_per_worker": workers, "processes": False, "memory_limit": None}
    noun = "thread" if workers == 1 else "threads"
    if method is not None:
        options = {"n_workers": workers, "threads_per_worker": 1, "processes": True}
        if limits.memory is not None:
            options["memory_limit"] = limits.memory
        noun = "worker process" if workers == 1 else "worker processes"
    words = f"{workers} local {noun}"
    with threadpool_limits(1), local_cluster(options, dashboard, method) as cluster, cluster.get_client() as client:
        place = Place(words, workers, _dashboard(client) if dashboard else "")
        yield place, _executor(client, study, words, say, limits, guarded=method is None and bool(limits))


@contextmanager
def dask_from_file(study: Study, path: Path, say: Say, limits: Limits = NO_LIMITS) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on the cluster that a file describes; raises SweepError for anything wrong in the file."""
    file = read_cluster_file(path)
    kind = cluster_class(file)
    words = f"the {file.class_name.rpartition('.')[2]} of {path}"
    with ExitStack() as stack:
        try:
            cluster = stack.enter_context(own_cluster(kind, file.options))
            if file.scale is not None:
                cluster.scale(**file.scale)
            else:
                cluster.adapt(**{"target_duration": ADAPT_WITHIN, **(file.adapt or {})})
            client = stack.enter_context(cluster.get_client())
        except SweepError:
            raise
        except Exception as error:  # whatever a cluster's class makes of its options
            cause: BaseException = error
            while cause.__cause__ is not None:
                cause = cause.__cause__
            raise SweepError(f"{file.class_name}: {type(cause).__name__}: {cause}", str(path)) from error
        executor = _executor(client, study, words, say, limits)
        yield _place(client, words, executor.threads), executor


@contextmanager
def dask_scheduler(
    study: Study, address: str, security: Security | None, say: Say, limits: Limits = NO_LIMITS
) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on a Dask scheduler that runs elsewhere; raises SweepError where none answers or its workers
    would compute other numbers than this process.
    """
    with client_at(address, security) as client:
        words = f"the Dask scheduler at {address}"
        executor = _executor(client, study, words, say, limits)
        yield _place(client, words, executor.threads), executor


@contextmanager
def client_at(address: str, security: Security | None = None) -> Iterator[Client]:
    """Give a client of a Dask scheduler that runs elsewhere; raises SweepError where none answers."""
    options = (security or Security()).get_connection_args("client")
    if address.startswith("tls://") and options["ssl_context"] is None:
        raise SweepError(
            f"no certificates for {address!r}: give --tls-ca, --tls-cert and --tls-key, or configure Dask with them"
        )
    try:
        get_address_host_port(address)
    except (ValueError, TypeError) as error:
        message = f"no Dask scheduler has the address {address!r}; expected tcp://HOST:PORT or tls://HOST:PORT"
        raise SweepError(message) from error
    with without_logs(), ExitStack() as stack:
        try:
            kind = LoopRunner().run_sync(_server_at, address, options)
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


async def _server_at(address: str, options: dict[str, Any]) -> str:
    """Return what kind of Dask server answers; raises OSError or TimeoutError.

    A client would wait for ever for the handshake of a server that says nothing, such as a scheduler that is stopped.
    """

    async def ask() -> str:
        server = await connect(address, timeout=CONNECT_TIMEOUT_S, **options)
        try:
            await server.write({"op": "identity", "reply": True})
            return str((await server.read())["type"])
        finally:
            server.abort()

    try:
        return await asyncio.wait_for(ask(), CONNECT_TIMEOUT_S)
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


def _executor(
    client: Client, study: Study, words: str, say: Say, limits: Limits, guarded: bool = False
) -> DaskExecutor:
    workers = DaskWorkers(client, words, study.experiment_reference, say)
    workers.prepare()
    return DaskExecutor(study, workers, say, limits, guarded)


def _place(client: Client, words: str, threads: int) -> Place:
    """Return the place of a client whose workers are there, with the dashboard if the scheduler can show one: this
    needs bokeh.
    """
    try:
        client.run_on_scheduler(importlib.metadata.version, "bokeh")
    except Exception:  # a missing package there, or a scheduler that runs nothing for clients
        link = ""
    else:
        link = _dashboard(client)
    return Place(words, dashboard=link, threads=threads)


def _dashboard(client: Client) -> str:
    """Return the address of a client's dashboard, empty if there is none.

    The link to a scheduler within this process has the machine's outer address, on which nothing listens.
    """
    protocol, _, rest = str(client.scheduler_info()["address"]).partition("://")
    link = client.dashboard_link or ""
    return link.replace(f"//{rest.partition('/')[0]}:", f"//{LOOPBACK}:") if protocol == "inproc" else link
