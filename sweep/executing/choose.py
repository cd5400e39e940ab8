"""Chooses where a run computes: as requested, or else as the amount of work suggests."""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from linksweep.sweep.contract import SweepError, shown, suggest
from linksweep.sweep.executing.execute import NO_LIMITS, Limits, Opened, Say, available_cores, measured_first
from linksweep.sweep.executing.pools import DEFAULT_POOL, POOLS, PoolName
from linksweep.sweep.studies.study import Study

CERTAINLY_LONG = 5e7
"""Random numbers that take half a second to draw: a run of more is worth the start of workers, whatever it computes."""


@dataclass(frozen=True)
class Resources:
    """What to run on; never part of a study, because it cannot change a number.

    ``tls`` are the files of the authority, the certificate and the key for a ``scheduler``.  With ``dashboard`` local
    workers have the dashboard of Dask, which needs bokeh.
    """

    workers: int | None = None
    pool: PoolName | None = None
    scheduler: str | None = None
    tls: tuple[Path, Path, Path] | None = None
    cluster: Path | None = None
    limits: Limits = NO_LIMITS
    dashboard: bool = False

    def __post_init__(self) -> None:
        """Raise SweepError for a pool that is not known, and for a dashboard where there can be none."""
        if self.pool is not None and self.pool not in POOLS:
            raise SweepError(f"no pool {shown(self.pool)}{suggest(self.pool, list(POOLS))}")
        if not self.dashboard:
            return
        if self.scheduler is not None or self.cluster is not None:
            raise SweepError("a dashboard is made for local workers; a scheduler and a cluster have their own")
        if not POOLS[self.pool or DEFAULT_POOL].has_workers:
            raise SweepError(f"pool {shown(self.pool)} has no workers and no dashboard")
        if find_spec("bokeh") is None:
            raise SweepError("a dashboard needs bokeh: `pip install 'linksweep[report]'`")

    @property
    def none_requested(self) -> bool:
        """Whether the user has left the choice of where to run to linksweep."""
        wishes = (self.workers, self.pool, self.scheduler, self.cluster, self.limits, self.dashboard)
        return not any(wishes)


ANY_RESOURCES = Resources()


def choose_executor(study: Study, cost: float, resources: Resources, say: Say) -> Opened:
    """Return a context manager that gives the place and the executor of a run with this ``cost``.

    Where nothing is requested these are worker processes, one per core.  Unless the cost that the experiment declares
    shows that they are needed, they are started only once the time that the first points take does.
    """
    limits = resources.limits
    if resources.scheduler is not None:
        from linksweep.sweep.executing.clusters import dask_scheduler, tls

        security = tls(*resources.tls) if resources.tls else None
        return dask_scheduler(study, resources.scheduler, security, say, limits)
    if resources.cluster is not None:
        from linksweep.sweep.executing.clusters import dask_from_file

        return dask_from_file(study, resources.cluster, say, limits)
    pool, workers = POOLS[resources.pool or DEFAULT_POOL], resources.workers or available_cores()
    if resources.none_requested and (not study.experiment.says_cost or cost < CERTAINLY_LONG):
        return measured_first(study, cost, workers, lambda: pool.open(study, workers, say, limits, False), say)
    return pool.open(study, workers, say, limits, resources.dashboard)
