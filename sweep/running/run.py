"""Runs a study: lets an executor compute what the ledger lacks of the plan, and writes it into the store."""

from collections.abc import Collection, Sequence
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Protocol

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.executor import Run, choose_executor, of_study
from linksweep.sweep.executing.pools import ANY_RESOURCES, Resources
from linksweep.sweep.executing.task import Place, RefusedError, TaskResult
from linksweep.sweep.interrupt import watched
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.checked_grid import make_grid
from linksweep.sweep.planning.plan import Plan, Survey, Work
from linksweep.sweep.planning.tuning import TUNED, Tuning
from linksweep.sweep.running.failures import FailureCount, MaxFailures, TooManyFailuresError
from linksweep.sweep.running.study_store import check_points, create_store, find_store, open_store, replace_store
from linksweep.sweep.running.subset import part_of_larger
from linksweep.sweep.running.writer import Taken, Writer
from linksweep.sweep.stores.code import check_code, record_code
from linksweep.sweep.stores.location import Where, writing
from linksweep.sweep.stores.lock import locked
from linksweep.sweep.stores.store import OpenStore, Store
from linksweep.sweep.studies.record import RECORD, as_recorded, provenance, recorded
from linksweep.sweep.studies.study import Study

if TYPE_CHECKING:
    import xarray as xr


GOES_ON = (
    "what was done is kept; the same command goes on from there, and `sweep run --retry` tries failed points again; "
    '--max-failures 100% (in Python max_failures="100%") goes on whatever fails'
)
"""What follows why a run was ended."""


class Progress(Protocol):
    """What watches a run; methods that such a class leaves out do nothing."""

    def start(self, survey: Survey, where: str, workers: int | None) -> None:
        """Work begins, at the place that ``where`` names, with so many workers if that is known."""
        return

    def advance(self, works: Sequence[Work], result: TaskResult, taken: Taken) -> None:
        """A task's result is in the ledger."""
        return

    def written(self) -> None:
        """All results are on disk; the workers are about to end."""
        return

    def say(self, text: str) -> None:
        """Tell something in a sentence."""
        return


class Silent(Progress):
    """Watches nothing."""


def plan_study(study: Study, store: Where, accept_code: bool = False) -> tuple[Plan, Survey]:
    """Return the plan of a study and what of it is pending in its store, writing nothing; raises SweepError for bad
    input, and for a store that other code made unless ``accept_code``.
    """
    plan = Plan(make_grid(study))
    found = find_store(store, study)
    plan, opened = _with_store(plan, found, accept_code)
    if study.points is not None and found is not None and part_of_larger(found, plan.grid) is None:
        check_points(found, study)
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
    max_failures: MaxFailures | None = None,
    tuning: Tuning = TUNED,
) -> "tuple[xr.Dataset, dict[str, str]]":
    """Compute what the store does not hold yet, write it as it comes, and return the dataset and the failures by place.

    The same call after an interruption goes on where it stopped.  Points that failed before are left as they are; with
    ``retry`` they, and only they, are computed again.  Where the store holds a larger study it is left as it is, and
    these points of it are returned.  A store that other code made is continued with ``accept_code`` only; ``fresh``
    replaces whatever store is there.  Raises SweepError for bad input before anything is written, and for a store that
    another process writes to (``break_lock`` as `locked` says); with everything that was finished in the store
    TooManyFailuresError where more than ``max_failures`` fail, by default where the first points all fail for one
    reason, and RunInterruptedError on SIGINT, SIGTERM and SIGHUP.
    """
    progress = progress or Silent()
    plan = Plan(make_grid(study))
    for sentence in plan.grid.warnings:
        progress.say(f"warning: {sentence}")
    with watched() as interruptions, ExitStack() as stack:
        try:
            stack.enter_context(locked(store, break_lock=break_lock))
        except SweepError:  # a store that cannot be locked can still be read
            found = None if fresh else find_store(store, study)
            if retry or found is None or (part := part_of_larger(found, plan.grid)) is None:
                raise
            return _left_alone(part, store, progress)
        found = replace_store(store, study, provenance(study)) if fresh else find_store(store, study)
        plan, opened = _with_store(plan, found, accept_code)
        study = plan.grid.study
        if not retry and found is not None and (part := part_of_larger(found, plan.grid)) is not None:
            return _left_alone(part, store, progress)
        if found is not None:
            check_points(found, study)
        again = _clear_failures(opened, plan, progress) if retry else None
        accumulator = _accumulator(plan, opened, again)
        pending = accumulator.survey.pending
        where = choose_executor(study, pending.cost, resources if pending.blocks else ANY_RESOURCES, progress.say)
        place, execute = stack.enter_context(where)
        run = of_study(study, execute)
        progress.start(accumulator.survey, place.words, place.workers)
        total = accumulator.survey.total.points
        failing = FailureCount(study, total, total - accumulator.survey.pending.points, most=max_failures)
        opened = _opened(store, opened, plan)
        record_code(opened, study, progress.say)
        if unused := len(opened.rows) - accumulator.survey.held.blocks:
            progress.say(f"{unused:,} blocks in the store are not part of this study; they are kept")
        writer = Writer(accumulator, opened, interruptions.held, tuning=tuning)
        try:
            return _computed(writer, place, run, progress, failing)
        except RefusedError:
            if found is None and not opened.rows:  # as if nothing had been begun
                with writing(opened.location):
                    opened.location.clear()
            raise


def _computed(
    writer: Writer,
    place: Place,
    run: Run,
    progress: Progress,
    failing: FailureCount,
) -> "tuple[xr.Dataset, dict[str, str]]":
    """Compute what is pending; return the dataset and the failures.

    Raises TooManyFailuresError, with what was done in the store, where too many points fail.
    """
    most_blocks = writer.pending.most_blocks
    try:
        if place.dashboard:
            progress.say(f"Dask dashboard: {place.dashboard}")
        writer.pending.most_blocks = min(failing.most_at_once or most_blocks, most_blocks)
        why = ""
        if writer.accumulator.survey.pending.blocks:
            writer.write()  # so that there is a labelled, if empty, dataset from the start
        with writer:
            for given, result in run(writer.pending.take):
                works = writer.pending.settle(given, result.seconds, result.cold)
                taken = writer.take(works, result)
                failing.take(taken.ended, taken.failed)
                writer.pending.most_blocks = min(failing.most_at_once or most_blocks, most_blocks)
                progress.advance(works, result, taken)
                if why := failing.too_many():
                    break
        dataset = writer.write(final=not why)
    except BaseException as error:
        with suppress(SweepError):
            writer.stop() if isinstance(error, KeyboardInterrupt) else writer.flush()
        writer.require_whole(error.problems if isinstance(error, SweepError) else ())
        raise
    writer.require_whole()
    progress.written()
    if why:
        raise TooManyFailuresError(f"stopped: {why}; {GOES_ON}", str(writer.store.location))
    return dataset, writer.failures()


def _with_store(plan: Plan, found: OpenStore | None, accept_code: bool) -> tuple[Plan, Store | None]:
    """Return a plan, for a plain function with the layout of results that its store has, and the open store.

    Raises SweepError for a store that other code made unless ``accept_code``.
    """
    if found is None:
        return plan, None
    if plan.grid.study.experiment.undeclared:
        plan = plan.of(as_recorded(plan.grid.study, found.attributes))
    opened = open_store(found, plan.grid.study)
    if not accept_code:
        check_code(opened, plan.grid.study)
    return plan, opened


def _opened(place: Where, store: Store | None, plan: Plan) -> Store:
    """Return the store of a plan: the one that is there, or a new one."""
    study = plan.grid.study
    if store is None:
        attributes = provenance(study) | {RECORD: recorded(study, plan.costs())}
        store = open_store(create_store(place, study, attributes), study)
        store.keep_copy()
    store.verify()
    return store


def _left_alone(part: "xr.Dataset", store: Where, progress: Progress) -> "tuple[xr.Dataset, dict[str, str]]":
    progress.say(f"{store} holds more than this study asks for; it is left as it is, and these are its points")
    return part, {}


def _clear_failures(store: Store | None, plan: Plan, progress: Progress) -> frozenset[bytes]:
    """Forget the failures of a plan's points, and return their digests; say so where there are none."""
    failed: frozenset[bytes] = frozenset()
    if store is not None:
        failed = frozenset(store.failures.keys() & {point.digest for point in plan.grid.points()})
        store.clear_failures(failed)
    if not failed:
        progress.say(f"no point in {store.location if store else 'the store'} has failed")
    return failed


def _accumulator(plan: Plan, store: Store | None, only: Collection[bytes] | None = None) -> Accumulator:
    if store is None:
        return Accumulator(plan)
    return Accumulator(plan, store.rows, store.read(), store.failures, only, store.samples)
