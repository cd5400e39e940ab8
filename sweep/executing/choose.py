"""Chooses where a run computes: what the user wishes, or what suits the work."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from threading import Thread

import numpy as np

from sweep.executing.execute import NO_LIMITS, Executor, Limits, Place, Pool, Say, available_cores, serial
from sweep.executing.forkserver import start_forkserver
from sweep.planning.accumulator import Accumulator
from sweep.planning.grid import Grid, make_grid
from sweep.planning.plan import Plan
from sweep.studies.study import Study

SERIAL_COST = 5e7
"""Below this many random numbers (half a second) starting a cluster takes longer than the work."""

FEW_POINTS = 1000
"""More are taken for much work: to add up their cost for a guess would take too long."""


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

    def pool_for(self, cost: float) -> Pool | None:
        """Return the pool for work of so many random numbers, None if it is not of this machine.

        Without a wish: worker processes, or this process where the work is less than starting one and has no limits.
        """
        if self.scheduler is not None or self.cluster is not None:
            return None
        small = self.workers is None and cost < SERIAL_COST and not self.limits
        return self.pool or ("serial" if small else "processes")


NO_WISHES = Resources()


def expect(study: Study, resources: Resources) -> None:
    """Start what takes time and a run of this study will probably need, before this process begins its own imports.

    Raises SweepError for a grid that cannot be computed.
    """
    cost = SERIAL_COST
    if len(Grid(study)) <= FEW_POINTS:
        cost = Accumulator(Plan(make_grid(study)), {}, np.empty((0, 0))).survey.pending.cost
    if resources.pool_for(cost) == "processes":
        start_forkserver()


def choose_executor(
    study: Study, cost: float, resources: Resources, say: Say
) -> AbstractContextManager[tuple[Place, Executor]]:
    """Return the place where a run of so many random numbers will be and its executor, to be entered."""
    limits, pool = resources.limits, resources.pool_for(cost)
    if pool == "serial":
        return serial(study, limits)
    from sweep.executing.clusters import dask_from_file, dask_local, dask_scheduler, tls

    if resources.scheduler is not None:
        security = tls(*resources.tls) if resources.tls else None
        return dask_scheduler(study, resources.scheduler, security, say, limits)
    if resources.cluster is not None:
        return dask_from_file(study, resources.cluster, say, limits)
    assert pool is not None
    # xarray takes a third of a second to look at its first array, workers to start nearly as long: both at once
    Thread(target=import_module, args=["dask.array"], daemon=True).start()
    return dask_local(study, resources.workers or available_cores(), pool, say, limits)
