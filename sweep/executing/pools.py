"""The pools: what a study can run on in this machine.  A further one is an entry of `POOLS`, and its name."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from sweep.executing.execute import Executor, Limits, Place, Say
    from sweep.studies.study import Study

PoolName = Literal["processes", "threads", "serial"]

Opened = AbstractContextManager["tuple[Place, Executor]"]


class Pool(NamedTuple):
    """A pool in words, how it is opened for a study with so many workers, and whether it has any."""

    words: str
    open: Callable[["Study", int, "Say", "Limits"], Opened]
    has_workers: bool = True


def _processes(study: "Study", workers: int, say: "Say", limits: "Limits") -> Opened:
    from sweep.executing.clusters import worker_processes

    return worker_processes(study, workers, say, limits)


def _threads(study: "Study", workers: int, say: "Say", limits: "Limits") -> Opened:
    from sweep.executing.clusters import worker_threads

    return worker_threads(study, workers, say, limits)


def _serial(study: "Study", _workers: int, _say: "Say", limits: "Limits") -> Opened:
    from sweep.executing.execute import serial

    return serial(study, limits)


POOLS: Mapping[PoolName, Pool] = {
    "processes": Pool("worker processes", _processes),
    "threads": Pool("threads of this process", _threads),
    "serial": Pool("this process alone", _serial, has_workers=False),
}
DEFAULT_POOL: PoolName = "processes"
