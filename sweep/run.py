"""Runs a study: plan minus ledger, through an executor, into the store; the one place where the pieces meet."""

from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Protocol

import xarray as xr

from sweep.contract import SweepError
from sweep.execute import Executor, Pool, available_cores, dask_local, dask_scheduler, serial
from sweep.grid import make_grid
from sweep.plan import Plan, PlanSize, Survey, tasks
from sweep.provenance import provenance
from sweep.store import create_or_resume, done_rows
from sweep.study import Study
from sweep.writer import Writer

SERIAL_COST = 5e7
"""Below this many random numbers (half a second) starting a cluster takes longer than the work."""


class RunInterruptedError(Exception):
    """The user stopped the run; what was done is in the store."""


@dataclass(frozen=True)
class Resources:
    """What to run on; never part of a study, because it cannot change a number."""

    workers: int | None = None
    pool: Pool | None = None
    scheduler: str | None = None


class Progress(Protocol):
    """Who watches a run."""

    def start(self, survey: Survey, where: str) -> None:
        """Work begins, at the place that ``where`` names."""

    def advance(self, done: PlanSize) -> None:
        """Tell that this much more is done."""


class Silent:
    """Watches nothing."""

    def start(self, survey: Survey, where: str) -> None:
        """Do nothing."""

    def advance(self, done: PlanSize) -> None:
        """Do nothing."""


def plan_study(study: Study, store: Path) -> tuple[Plan, Survey]:
    """Return the plan of a study and what of it is pending in its store, writing nothing; raises SweepError for bad
    input.
    """
    plan = Plan(make_grid(study))
    return plan, plan.survey(done_rows(store, study))


def run_study(
    study: Study, store: Path, resources: Resources = Resources(), progress: Progress | None = None
) -> tuple[xr.Dataset, dict[int, str]]:
    """Compute what the store does not hold yet, write it as it comes, and return the dataset and the failures by point
    index.

    The same call after an interruption goes on where it stopped.  Raises SweepError for bad input before anything is
    written, and RunInterruptedError on SIGINT with everything that was finished in the store.
    """
    progress = progress or Silent()
    plan, survey = plan_study(study, store)
    where, executor = choose_executor(study, survey, resources)
    with executor as run:
        writer = Writer(plan, survey.remaining, create_or_resume(store, study, provenance(study)))
        if survey.pending.blocks:
            writer.write()  # so that there is a labelled, if empty, dataset from the start
        progress.start(survey, where)
        try:
            queue = tasks(plan.pending(frozenset(writer.store.rows)))
            for works, result in run(lambda count: list(islice(queue, count))):
                progress.advance(writer.take(works, result))
        except KeyboardInterrupt as stop:
            writer.write()
            raise RunInterruptedError from stop
        except BaseException:
            with suppress(SweepError):
                writer.store.flush()
            raise
        return writer.write(), writer.failures


def choose_executor(study: Study, survey: Survey, resources: Resources) -> tuple[str, AbstractContextManager[Executor]]:
    """Return in words where a run will be, and its executor.

    Without a wish: a local cluster with one worker process a core, or this process where the work is less than
    starting one.
    """
    if resources.scheduler is not None:
        return f"the Dask scheduler at {resources.scheduler}", dask_scheduler(study, resources.scheduler)
    small = resources.workers is None and survey.pending.cost < SERIAL_COST
    pool = resources.pool or ("serial" if small else "processes")
    if pool == "serial":
        return "this process", serial(study)
    workers = resources.workers or available_cores()
    noun = {"processes": ("worker process", "worker processes"), "threads": ("thread", "threads")}[pool][workers > 1]
    return f"{workers} local {noun}", dask_local(study, workers, pool)
