"""The pools that a study can run on, on this machine.  A new one needs an entry in `POOLS` and a name in `PoolName`."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Literal, NamedTuple

from linksweep.sweep.executing.uncollected import uncollected

if TYPE_CHECKING:
    from linksweep.sweep.executing.execute import Executor, Limits, Opened, Place, Say
    from linksweep.sweep.studies.study import Study

PoolName = Literal["processes", "threads", "serial"]

OpenPool = Callable[["Study", int, "Say", "Limits", bool], "Opened"]
"""Opens a pool for a study with so many workers, with Dask's dashboard where it is asked for and there can be one."""


class Pool(NamedTuple):
    """A pool in words, how it is opened, and whether it has workers."""

    words: str
    open: OpenPool
    has_workers: bool = True


@contextmanager
def _processes(
    study: "Study", workers: int, say: "Say", limits: "Limits", dashboard: bool
) -> "Iterator[tuple[Place, Executor]]":
    from linksweep.sweep.executing.forkserver import start_method

    with ExitStack() as stack:
        with uncollected():
            method = stack.enter_context(start_method())  # its server imports Dask while this process does
            from linksweep.sweep.executing.clusters import local_workers

            opened = stack.enter_context(local_workers(study, workers, say, limits, dashboard, method))
        yield opened


def _threads(study: "Study", workers: int, say: "Say", limits: "Limits", dashboard: bool) -> "Opened":
    from linksweep.sweep.executing.clusters import local_workers

    return local_workers(study, workers, say, limits, dashboard)


def _serial(study: "Study", _workers: int, _say: "Say", limits: "Limits", _dashboard: bool) -> "Opened":
    from linksweep.sweep.executing.execute import serial

    return serial(study, limits)


POOLS: Mapping[PoolName, Pool] = {
    "processes": Pool("worker processes", _processes),
    "threads": Pool("threads of this process", _threads),
    "serial": Pool("this process alone", _serial, has_workers=False),
}
DEFAULT_POOL: PoolName = "processes"
