"""Runs a study: plan minus ledger, through an executor, into the store; the one place where the pieces meet."""

from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from typing import Protocol

import numpy as np
import xarray as xr

from sweep.contract import SweepError
from sweep.executing.choose import ANY_RESOURCES, Resources, choose_executor
from sweep.executing.execute import Executor, Place
from sweep.executing.worker import TaskResult
from sweep.interrupt import watched
from sweep.planning.accumulator import Accumulator, Survey
from sweep.planning.grid import make_grid
from sweep.planning.plan import Plan, Work
from sweep.planning.work_queue import Pending
from sweep.running.subset import part_of_larger
from sweep.running.writer import Taken, Writer
from sweep.stores.code import check_code, record_code
from sweep.stores.fresh import replace_store
from sweep.stores.location import Where
from sweep.stores.lock import locked
from sweep.stores.store import Store, create_store, find_store, open_store
from sweep.studies.provenance import provenance
from sweep.studies.record import RECORD, recorded
from sweep.studies.study import Study


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


def plan_study(study: Study, store: Where, accept_code: bool = False) -> tuple[Plan, Survey]:
    """Return the plan of a study and what of it is pending in its store, writing nothing; raises SweepError for bad
    input, and for a store that other code made unless ``accept_code``.
    """
    plan = Plan(make_grid(study))
    opened = open_store(find_store(store, study), study)
    if opened is not None and not accept_code:
        check_code(opened, study)
    return plan, _accumulator(plan, opened).survey


def run_study(
    study: Study,
    store: Where,
    resources: Resources = ANY_RESOURCES,
    progress: Progress | None = None,
    retry: bool = False,
    break_lock: bool = False,
    accept_code: bool = False,
    fresh: bool = False,
) -> tuple[xr.Dataset, dict[str, str]]:
    """Compute what the store does not hold yet, write it as it comes, and return the dataset and the failures by place.

    The same call after an interruption goes on where it stopped.  Points that failed before are left as they are; with
    ``retry`` they, and only they, are computed again.  Where the store holds a larger study it is left as it is, and
    these points of it are returned.  A store that other code made is continued with ``accept_code`` only; ``fresh``
    replaces whatever store is there.  Raises SweepError for bad input before anything is written, and for a store that
    another process writes to (``break_lock`` as `locked` says); RunInterruptedError on SIGINT, SIGTERM and SIGHUP with
    everything that was finished in the store.
    """
    progress = progress or Silent()
    plan = Plan(make_grid(study))
    for sentence in plan.grid.warnings:
        progress.say(f"warning: {sentence}")
    told = provenance(study)
    with watched() as interruptions, ExitStack() as stack:
        try:
            stack.enter_context(locked(store, break_lock=break_lock))
        except SweepError:  # what another process writes to, or nobody may, can be looked at
            found = None if fresh else find_store(store, study)
            if retry or found is None or (part := part_of_larger(found, plan.grid)) is None:
                raise
            return _left_alone(part, store, progress)
        found = replace_store(store, study, told) if fresh else find_store(store, study)
        opened = open_store(found, study)
        if opened is not None and not accept_code:
            check_code(opened, study)
        if not retry and found is not None and (part := part_of_larger(found, plan.grid)) is not None:
            return _left_alone(part, store, progress)
        again = None
        if retry:
            again = _clear_failures(opened, plan)
            if not again:
                progress.say(f"no point in {store} has failed")
        accumulator = _accumulator(plan, opened, again)
        pending = accumulator.survey.pending
        where = choose_executor(study, pending.cost, resources if pending.blocks else ANY_RESOURCES, progress.say)
        place, run = stack.enter_context(where)
        if opened is None:
            opened = Store(create_store(store, study, told | {RECORD: recorded(study, plan.costs())}), study)
            opened.keep_copy()
        opened.verify()
        record_code(opened, study, progress.say)
        if unused := len(opened.rows) - accumulator.survey.held.blocks:
            progress.say(f"{unused:,} blocks in the store are not part of this study; they are kept")
        return _computed(plan, accumulator, opened, place, run, progress, interruptions.held)


def _computed(
    plan: Plan,
    accumulator: Accumulator,
    store: Store,
    place: Place,
    run: Executor,
    progress: Progress,
    held: Callable[[], AbstractContextManager[None]],
) -> tuple[xr.Dataset, dict[str, str]]:
    """Compute what is pending into an open store, and return the dataset and the failures."""
    pending = Pending(plan, accumulator)
    writer = Writer(plan, accumulator, pending, store, held)
    try:
        progress.start(accumulator.survey, place.words, place.workers)
        if place.dashboard:
            progress.say(f"Dask dashboard: {place.dashboard}")
        results = run(pending.take)
        if accumulator.survey.pending.blocks:
            writer.write()  # so that there is a labelled, if empty, dataset from the start
        with writer:
            for given, result in results:
                works = pending.settle(given, result.seconds)
                progress.advance(works, result, writer.take(works, result))
        dataset = writer.write(final=True)
        progress.written()
        return dataset, writer.failures()
    except KeyboardInterrupt:
        writer.stop()
        raise
    except BaseException:
        with suppress(SweepError):
            writer.flush()
        raise


def _left_alone(part: xr.Dataset, store: Where, progress: Progress) -> tuple[xr.Dataset, dict[str, str]]:
    progress.say(f"{store} holds more than this study asks for; it is left as it is, and these are its points")
    return part, {}


def _clear_failures(store: Store | None, plan: Plan) -> frozenset[bytes]:
    """Forget the failures of a plan's points, and return their digests."""
    if store is None:
        return frozenset()
    failed = frozenset(store.failures.keys() & {point.digest for point in plan.grid.points()})
    store.clear_failures(failed)
    return failed


def _accumulator(plan: Plan, store: Store | None, only: Collection[bytes] | None = None) -> Accumulator:
    if store is None:
        return Accumulator(plan, {}, np.empty((0, 0)))
    return Accumulator(plan, store.rows, store.sums(), store.failures, only)
