"""Runs a study: plan minus ledger, through an executor, into the store; the one place where the pieces meet."""

from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import Protocol

import numpy as np
import xarray as xr

from sweep.contract import SweepError
from sweep.executing.execute import NO_LIMITS, Executor, Limits, Place, Pool, Say, available_cores, serial
from sweep.executing.worker import TaskResult
from sweep.interrupt import watched
from sweep.planning.grid import make_grid
from sweep.planning.pending import Pending
from sweep.planning.plan import Plan, Work
from sweep.planning.tally import Survey, Tally
from sweep.running.larger import part_of_larger
from sweep.running.writer import Taken, Writer
from sweep.stores.location import Where
from sweep.stores.lock import locked
from sweep.stores.store import Store, check_store, create_or_resume, existing_store
from sweep.studies.provenance import provenance
from sweep.studies.study import Study

SERIAL_COST = 5e7
"""Below this many random numbers (half a second) starting a cluster takes longer than the work."""


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


class Progress(Protocol):
    """Who watches a run."""

    def start(self, survey: Survey, where: str, workers: int | None) -> None:
        """Work begins, at the place that ``where`` names, with so many workers if that is known."""

    def advance(self, works: Sequence[Work], result: TaskResult, taken: Taken) -> None:
        """A task's result is in the ledger."""

    def written(self) -> None:
        """All results are on disk; the workers are about to end."""

    def say(self, text: str) -> None:
        """Tell something in a sentence."""


class Silent:
    """Watches nothing."""

    def start(self, survey: Survey, where: str, workers: int | None) -> None:
        """Do nothing."""

    def advance(self, works: Sequence[Work], result: TaskResult, taken: Taken) -> None:
        """Do nothing."""

    def written(self) -> None:
        """Do nothing."""

    def say(self, text: str) -> None:
        """Do nothing."""


def plan_study(study: Study, store: Where) -> tuple[Plan, Survey]:
    """Return the plan of a study and what of it is pending in its store, writing nothing; raises SweepError for bad
    input.
    """
    plan = Plan(make_grid(study))
    return plan, _tally(plan, existing_store(store, study)).survey


def run_study(
    study: Study,
    store: Where,
    resources: Resources = Resources(),
    progress: Progress | None = None,
    retry: bool = False,
    break_lock: bool = False,
) -> tuple[xr.Dataset, dict[str, str]]:
    """Compute what the store does not hold yet, write it as it comes, and return the dataset and the failures by place.

    The same call after an interruption goes on where it stopped.  Points that failed before are left as they are; with
    ``retry`` they, and only they, are computed again.  Where the store holds a larger study it is left as it is, and
    these points of it are returned.  Raises SweepError for bad input before anything is written, and for a store that
    another process writes to (``break_lock`` as `locked` says); RunInterruptedError on SIGINT, SIGTERM and SIGHUP with
    everything that was finished in the store.
    """
    progress = progress or Silent()
    plan = Plan(make_grid(study))
    check_store(store, study)
    if not retry and (part := part_of_larger(store, plan.grid)) is not None:
        progress.say(f"{store} holds more than this study asks for; it is left as it is, and these are its points")
        return part, {}
    with watched() as interruptions, locked(store, break_lock=break_lock):
        opened = existing_store(store, study)
        again = None
        if retry:
            again = _forgive(opened, plan)
            if not again:
                progress.say(f"no point in {store} has failed")
        tally = _tally(plan, opened, again)
        with choose_executor(study, tally.survey, resources, progress.say) as (place, run):
            opened = opened or create_or_resume(store, study, provenance(study))
            opened.verify()
            if unused := len(opened.rows) - tally.survey.held.blocks:
                progress.say(f"{unused:,} blocks in the store are not part of this study; they are kept")
            pending = Pending(plan, tally)
            writer = Writer(plan, tally, pending, opened, interruptions.held)
            try:
                if tally.survey.pending.blocks:
                    writer.write()  # so that there is a labelled, if empty, dataset from the start
                progress.start(tally.survey, place.words, place.workers)
                if place.dashboard:
                    progress.say(f"Dask dashboard: {place.dashboard}")
                for works, result in run(pending.take):
                    progress.advance(works, result, writer.take(works, result))
                dataset = writer.write(final=True)
                progress.written()
                return dataset, writer.failures()
            except KeyboardInterrupt:
                writer.stop()
                raise
            except BaseException:
                with suppress(SweepError):
                    writer.store.flush()
                raise


def _forgive(store: Store | None, plan: Plan) -> frozenset[bytes]:
    """Forget the failures of a plan's points, and return their digests."""
    if store is None:
        return frozenset()
    failed = frozenset(store.failures.keys() & {point.digest for point in plan.grid.points()})
    store.forgive(failed)
    return failed


def _tally(plan: Plan, store: Store | None, only: Collection[bytes] | None = None) -> Tally:
    if store is None:
        return Tally(plan, {}, np.empty((0, 0)))
    return Tally(plan, store.rows, store.sums(), store.failures, only)


def choose_executor(
    study: Study, survey: Survey, resources: Resources, say: Say
) -> AbstractContextManager[tuple[Place, Executor]]:
    """Return the place where a run will be and its executor, to be entered.

    Without a wish: a local cluster with one worker process a core, or this process where the work is less than
    starting one and needs no limits.
    """
    limits = resources.limits
    small = resources.workers is None and survey.pending.cost < SERIAL_COST and not limits
    pool = resources.pool or ("serial" if small else "processes")
    elsewhere = resources.scheduler is not None or resources.cluster is not None
    if pool == "serial" and not elsewhere:
        return serial(study, limits)
    from sweep.executing.clusters import dask_from_file, dask_local, dask_scheduler, tls

    if resources.scheduler is not None:
        security = tls(*resources.tls) if resources.tls else None
        return dask_scheduler(study, resources.scheduler, security, say, limits)
    if resources.cluster is not None:
        return dask_from_file(study, resources.cluster, say, limits)
    assert pool != "serial"
    # xarray takes half a second to look at its first array, workers to start: both at once
    Thread(target=import_module, args=["dask.array"], daemon=True).start()
    return dask_local(study, resources.workers or available_cores(), pool, say, limits)
