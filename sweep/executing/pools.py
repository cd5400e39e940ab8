"""What a run may compute on: the pools of this machine, a Dask scheduler or a cluster that a file describes; limits.

A new pool needs an entry in `POOLS` and a name in `PoolName`.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

if TYPE_CHECKING:
    from distributed import Client

PoolName = Literal["processes", "threads", "serial"]

MOST_WORKERS = 4096

# Variables that libraries of linear algebra read as they are loaded.
ONE_THREAD = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")

# Bytes that a worker needs for itself.
MEMORY_AT_LEAST = 200 * 10**6


class Pool(NamedTuple):
    """A pool in words, what opens it as ``module:name``, and whether it has workers.

    What opens it takes the reference of an experiment and the number of workers, for processes also limits, and returns
    a context manager that gives the place and the executor.
    """

    words: str
    opener: str
    has_workers: bool = True


POOLS: Mapping[PoolName, Pool] = {
    "processes": Pool("worker processes", "linksweep.sweep.executing.executor:processes"),
    "threads": Pool("threads of this process", "linksweep.sweep.executing.executor:threads"),
    "serial": Pool("this process alone", "linksweep.sweep.executing.executor:serial", has_workers=False),
}
DEFAULT_POOL: PoolName = "processes"


@dataclass(frozen=True)
class Place:
    """Where a run is, in ``words`` such as "on 2 local threads": how many workers if that is known, and the Dask
    dashboard if there is one.
    """

    words: str
    workers: int | None = None
    dashboard: str = ""


@dataclass(frozen=True)
class Limits:
    """The time and memory that one block may take.

    Args:
        time_s: seconds; None is no limit.
        memory: bytes in its process; None is no limit.
    """

    time_s: float | None = None
    memory: int | None = None


NO_LIMITS = Limits()


@dataclass(frozen=True)
class Resources:
    """What to run on; never part of a study, because it cannot change a number.

    ``tls`` are the files of the authority, the certificate and the key for a ``scheduler``.  With ``dashboard`` the
    local worker processes are Dask's and have its dashboard, which needs bokeh.  A ``client`` of the user's stays open.
    """

    workers: int | None = None
    pool: PoolName | None = None
    scheduler: str | None = None
    tls: tuple[Path, Path, Path] | None = None
    cluster: str | Path | None = None
    limits: Limits = NO_LIMITS
    dashboard: bool = False
    client: "Client | None" = None

    def __post_init__(self) -> None:
        """Raise SweepError for a pool, a number of workers, limits, a dashboard or a client that cannot be, and for
        several places to run on.
        """
        if all(getattr(self, one.name) is one.default for one in fields(self)):
            return
        # Imported here, since it imports NumPy, and the help of a command needs only the names of pools.
        from linksweep.sweep.contract import SweepError, shown, suggest

        if self.workers is not None and not (type(self.workers) is int and 1 <= self.workers <= MOST_WORKERS):
            raise SweepError(f"workers = {shown(self.workers)}: must be an integer from 1 to {MOST_WORKERS}")
        if self.pool not in (None, *POOLS):
            raise SweepError(f"no pool {shown(self.pool)}{suggest(str(self.pool), list(POOLS))}")
        if self.workers is not None and self.pool is not None and not POOLS[self.pool].has_workers:
            raise SweepError(f"workers = {self.workers}: pool {self.pool} has none; leave out one of the two")
        if not isinstance(self.limits, Limits):
            raise SweepError(f"limits = {shown(self.limits)}: must be linksweep.Limits(time_s, memory)")
        time_s, memory = self.limits.time_s, self.limits.memory
        if time_s is not None and not (isinstance(time_s, int | float) and 0.0 < time_s <= 1e9):
            raise SweepError(f"time_s = {shown(time_s)}: must be seconds, more than 0, up to 1e9; None is no limit")
        if memory is not None and not (type(memory) is int and memory >= MEMORY_AT_LEAST):
            least = f"at least the {MEMORY_AT_LEAST // 10**6} MB that a worker needs itself"
            raise SweepError(f"memory = {shown(memory)}: must be an integer of bytes, {least}; None is no limit")
        elsewhere = [name for name in ("client", "scheduler", "cluster") if getattr(self, name) is not None]
        here = {"workers": self.workers, "pool": self.pool, "memory": memory, "dashboard": self.dashboard}
        local = [name for name, value in here.items() if value not in (None, False)]
        if elsewhere and (local or len(elsewhere) > 1):
            raise SweepError(f"{' and '.join([*local, *elsewhere])} are for different places to run on: leave out one")
        if self.dashboard and self.pool not in (None, DEFAULT_POOL):
            raise SweepError("a dashboard is for local worker processes")
        if self.dashboard and find_spec("bokeh") is None:
            raise SweepError("a dashboard needs bokeh: `pip install 'linksweep[report]'`")
        if (one := self.client) is not None:
            from distributed import Client

            if not isinstance(one, Client) or one.asynchronous or one.status != "running":
                state = f", which is {one.status}" if isinstance(one, Client) else ""
                wanted = "a distributed.Client that is connected, without asynchronous=True"
                raise SweepError(f"client = {shown(one)}{state}: must be {wanted}")

    def open(self, reference: str, say: Callable[[str], None]) -> Any:
        """Return what the opener of the pool does, for an experiment with this reference."""
        if (self.scheduler, self.cluster, self.client, self.dashboard) != (None, None, None, False):
            return resolve_name("linksweep.sweep.executing.clusters:dask_workers")(reference, self, say)
        pool = POOLS[self.pool or DEFAULT_POOL]
        workers = (self.workers or available_cores()) if pool.has_workers else 1
        if self.limits != NO_LIMITS:  # a process that reaches them is ended: not this one
            return resolve_name(POOLS["processes"].opener)(reference, workers, self.limits)
        return resolve_name(pool.opener)(reference, workers)


# The choice of where to run is left to linksweep.
ANY_RESOURCES = Resources()


def available_cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
