"""Chooses where a run computes: what the user wishes, or what suits the work."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import Literal

from sweep.executing.execute import (
    NO_LIMITS,
    Executor,
    Limits,
    Place,
    Pool,
    Say,
    available_cores,
    measured_first,
    serial,
)
from sweep.functions.adapter import FunctionExperiment
from sweep.studies.study import Study

CERTAINLY_LONG = 5e7
"""Random numbers that take half a second to draw: more are worth the start of workers, whatever is made of them."""


@dataclass(frozen=True)
class Resources:
    """What to run on; never part of a study, because it cannot change a number.

    ``tls`` are the files of the authority, the certificate and the key for a ``scheduler``.
    """

    workers: int | None = None
    pool: Pool | None = None
    scheduler: str | None = None
    tls: tuple[Path, Path, Path] | None = None
    cluster: Path | None = None
    limits: Limits = NO_LIMITS

    @property
    def none_requested(self) -> bool:
        """Whether where to run is ours to choose."""
        return not (self.workers or self.pool or self.scheduler or self.cluster or self.limits)


NO_WISHES = Resources()


def choose_executor(
    study: Study, cost: float, resources: Resources, say: Say
) -> AbstractContextManager[tuple[Place, Executor]]:
    """Return the place where a run of so many random numbers will be and its executor, to be entered.

    Where nothing is requested it is worker processes, one a core; if the cost that the experiment declares does not
    show that they are needed, only once the time that the first points take does.
    """
    limits, workers = resources.limits, resources.workers or available_cores()
    if resources.pool == "serial":
        return serial(study, limits)
    unknown = isinstance(study.experiment, FunctionExperiment)
    if resources.none_requested and (unknown or cost < CERTAINLY_LONG):
        return measured_first(study, cost, workers, lambda: _local(study, workers, "processes", say, limits), say)
    from sweep.executing.clusters import dask_from_file, dask_scheduler, tls

    if resources.scheduler is not None:
        security = tls(*resources.tls) if resources.tls else None
        return dask_scheduler(study, resources.scheduler, security, say, limits)
    if resources.cluster is not None:
        return dask_from_file(study, resources.cluster, say, limits)
    return _local(study, workers, resources.pool or "processes", say, limits)


def _local(
    study: Study, workers: int, pool: Literal["threads", "processes"], say: Say, limits: Limits
) -> AbstractContextManager[tuple[Place, Executor]]:
    from sweep.executing.clusters import dask_local

    # xarray takes a third of a second to look at its first array, workers to start nearly as long: both at once
    Thread(target=import_module, args=["dask.array"], daemon=True).start()
    return dask_local(study, workers, pool, say, limits)
