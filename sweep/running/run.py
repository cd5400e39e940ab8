"""Runs a study in a session: its grid, its store and its pending work, opened once, computed and published."""

import math
import time
from collections.abc import Callable, Iterator, Sequence, Set
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.executor import choose_executor, of_study
from linksweep.sweep.executing.pools import ANY_RESOURCES, Resources, available_cores
from linksweep.sweep.executing.task import Executor, RefusedError, TaskResult
from linksweep.sweep.interrupt import watched
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import Grid, make_grid
from linksweep.sweep.planning.plan import TARGET, Plan, Survey, Work
from linksweep.sweep.planning.work_queue import TUNED, Tuning
from linksweep.sweep.running.beside import ALL, Beside, again_where, with_stored
from linksweep.sweep.running.code import check_code, record_code
from linksweep.sweep.running.failures import FailureCount, MaxFailures, TooManyFailuresError
from linksweep.sweep.running.results import Labelled, masked
from linksweep.sweep.running.writer import Taken, Writer, attributes_of, check_points, find_store, open_store
from linksweep.sweep.stores.location import Where, locked, writing
from linksweep.sweep.stores.store import BLOCKS, Store, create_store, replace_store
from linksweep.sweep.studies.record import as_recorded
from linksweep.sweep.studies.study import Study

# What follows why a run was ended.
GOES_ON = (
    "what was done is kept; the same command goes on from there, and `sweep run --retry` tries failed points again; "
    '--max-failures 100% (in Python max_failures="100%") goes on whatever fails'
)


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


class Session:
    """A study, its grid, its store and its pending work.

    `open` reads them and writes nothing, `compute` lets an executor do what is pending and keeps it as it comes, and
    `publish` writes the labelled dataset.  Whoever computes holds the lock of the store.
    """

    def __init__(
        self,
        plan: Plan,
        where: Where,
        store: Store | None,
        wanted: Set[bytes] | None = None,
        again: Set[bytes] = frozenset(),
    ) -> None:
        """Start with the open ``store`` if there is one; only points that are ``wanted`` are pending if these are
        given, of those that failed only the ones to compute ``again``.
        """
        self._where, self.store, self._is_new = where, store, store is None
        if store is None:
            self.accumulator = Accumulator(plan)
        else:
            failed = store.failures.keys() - again
            self.accumulator = Accumulator(
                plan, store.rows, store.read(), failed, wanted, store.samples, store.seconds()
            )
        self._asked: Study | None = None
        self.is_left_alone = False
        self._too_many = ""
        self._writer: Writer | None = None

    @classmethod
    def open(
        cls,
        grid: Grid,
        where: Where,
        *,
        accept_code: bool = False,
        retry: bool = False,
        fresh: bool = False,
        beside: Beside = ALL,
    ) -> "Session":
        """Open the study of a grid and its store, if there is one, with the points that this holds ``beside`` it.

        With ``retry`` the points that failed, and no others, are pending; with ``fresh`` the store begins anew.  Raises
        SweepError for a store that cannot go on with this study, and for one that other code made unless
        ``accept_code``.
        """
        study, store = grid.study, None
        whole, wanted, again = study, None, frozenset[bytes]()
        opened = replace_store(where, attributes_of(Plan(grid))) if fresh else find_store(where, study, beside.keep)
        if retry and opened is None:
            raise SweepError("no store is there whose failed points could be computed again", str(where))
        if opened is not None:
            study = whole = as_recorded(study, opened.attributes) if study.experiment.undeclared else study
            store = open_store(opened, study)
            if not beside.only:
                check_points(opened, study)
                whole, wanted = with_stored(store, study)
            records = again_where(store, whole, beside.redo) if beside.redo else {}
            if not accept_code:
                check_code(store, study, records)
            store.again(records)
            again = frozenset(records)
            if retry:
                wanted = again = frozenset(store.failures.keys() & set(grid.digests(grid.indices())))
            wanted = None if wanted is None else wanted | again
        plan = Plan(grid) if whole is grid.study else Plan(Grid(whole, grid.warnings))
        session = cls(plan, where, store, wanted, again)
        if store is not None and whole is not study:
            session._asked = study
            is_stored = store.attributes.get("study_digest") == whole.digest() and "points" in store.attributes
            is_stored &= store.attributes.get(BLOCKS) == len(store.rows)
            failed = wanted is not None and not store.failures.keys().isdisjoint(wanted)
            session.is_left_alone = is_stored and not failed and not session.accumulator.survey.pending.blocks
        return session

    @property
    def study(self) -> Study:
        """The study, with what is known of its results."""
        return self.accumulator.plan.grid.study

    @property
    def survey(self) -> Survey:
        """How much there is of what was asked for, and how much is pending; of all points if more than these are."""
        whole = self.accumulator.survey
        asked = whole if self._asked is None else self._part().accumulator.survey
        return asked if asked.pending.blocks == whole.pending.blocks else whole

    def _part(self) -> "Session":
        """Return the session of the points of the study that was asked for alone, with what is there now."""
        assert self._asked is not None, "the store has more"
        study = self.study
        known = replace(self._asked, experiment=study.experiment, sampling=study.sampling, counts=study.counts)
        return Session(self.accumulator.plan.for_study(known), self._where, self.store)

    def part(self) -> tuple[Labelled, dict[str, str]]:
        """Return the results of the points of the study that was asked for, and its failures by place."""
        assert self.store is not None, "it has more points"
        writer = Writer(self._part().accumulator, self.store)
        return masked(writer.assembled(final=True)), writer.failures()

    def compute(
        self,
        execute: Executor,
        progress: "Progress | None" = None,
        max_failures: MaxFailures | None = None,
        postponed: Callable[[], AbstractContextManager[None]] = nullcontext,
        tuning: Tuning = TUNED,
    ) -> None:
        """Compute what is pending, and keep it as it comes; end early where more than ``max_failures`` fail.

        ``postponed`` gives contexts in which interruptions wait.  Raises SweepError for results that are refused, and
        whatever the executor raises, with everything that was finished in the store.
        """
        progress = progress or Silent()
        total, pending = self.survey.total.points, self.survey.pending
        failing = FailureCount(self.study, total, total - pending.points, most=max_failures)
        writer = self._writer = Writer(self.accumulator, self._begun(progress), postponed, tuning=tuning)
        most_blocks = writer.pending.most_blocks
        with self._kept(writer):
            writer.pending.most_blocks = min(failing.most_at_once or most_blocks, most_blocks)
            run = of_study(self.study, execute, self.accumulator.is_missing, writer.store.keep)
            results = run(writer.pending.take)  # workers begin while this process writes
            if pending.blocks:
                writer.write()  # so that there is a labelled, if empty, dataset from the start
            with writer:
                for task, result in results:
                    works = writer.pending.settle(task, result.seconds, result.cold)
                    with postponed():  # so that an interruption leaves nothing taken that was not told
                        taken = writer.take(works, result)
                        progress.advance(works, result, taken)
                    writer.write_when_due()
                    failing.take(taken.ended, taken.failed, taken.begun)
                    writer.pending.most_blocks = min(failing.most_at_once or most_blocks, most_blocks)
                    if too_many := failing.too_many():
                        self._too_many = too_many
                        break

    def publish(self, progress: "Progress | None" = None) -> Labelled:
        """Write the dataset of everything that was computed, and return it.

        Raises TooManyFailuresError where that was ended early.
        """
        writer = self._writer
        assert writer is not None, "it is computed first"
        with self._kept(writer):
            dataset = writer.write(final=not self._too_many)
        writer.require_whole()
        if self._asked is not None:
            dataset = self.part()[0]
        (progress or Silent()).written()
        if self._too_many:
            raise TooManyFailuresError(f"stopped: {self._too_many}; {GOES_ON}", str(writer.store.location))
        return dataset

    def failures(self) -> dict[str, str]:
        """Return the points of the study that failed, by their place on the axes, and why."""
        if self._asked is not None:
            return self.part()[1]
        return {} if self._writer is None else self._writer.failures()

    def _begun(self, progress: "Progress") -> Store:
        """Return the store, a new one if need be, which is found whole and says which code continues it."""
        study, store = self.study, self.store
        if store is None:
            made = create_store(self._where, attributes_of(self.accumulator.plan))
            store = self.store = open_store(made, study)
            store.keep_copy()
        store.verify()
        record_code(store, study, progress.say)
        if unused := len(store.rows) - self.accumulator.survey.stored.blocks:
            progress.say(f"{unused:,} blocks in the store are not part of this study; they are kept")
        return store

    @contextmanager
    def _kept(self, writer: Writer) -> Iterator[None]:
        """Make everything that was taken durable where an exception leaves this block."""
        try:
            yield
        except BaseException as error:
            if isinstance(error, RefusedError) and self._is_new and not writer.store.rows:
                with writing(writer.store.location):
                    writer.store.location.clear()  # as if nothing had been begun
                raise
            with suppress(SweepError):
                writer.stop() if isinstance(error, KeyboardInterrupt) else writer.flush()
            writer.require_whole(error.problems if isinstance(error, SweepError) else ())
            raise


def plan_study(study: Study, store: Where, accept_code: bool = False) -> tuple[Plan, Survey]:
    """Return the plan of a study and what of it is pending in its store, writing nothing; raises SweepError for bad
    input, and for a store that other code made unless ``accept_code``.
    """
    session = Session.open(make_grid(study), store, accept_code=accept_code)
    asked = session if session._asked is None else session._part()
    return asked.accumulator.plan, session.survey


def plan_report(study: Study, store: Where, workers: int | None = None, accept_code: bool = False) -> dict[str, Any]:
    """Return what a run would do; the time is the least that computing takes with so many ``workers`` (one per core by
    default), from a short timing of random numbers on this machine.
    """
    plan, survey = plan_study(study, store, accept_code)
    grid = plan.grid
    floats = len(grid) * sum(study.experiment.size_of(output) for output in study.experiment.outputs)
    samples = study.experiment.samples_width * survey.total.realisations if study.keeps_samples else 0
    result_mb = 8e-6 * (floats + samples)
    ledger_mb = 1e-6 * study.experiment.reducer.dtype.itemsize * survey.total.blocks + 8e-6 * samples
    tasks = math.ceil(survey.pending.cost / TARGET) if study.experiment.cost_unit else None  # else time is not known
    most = survey.pending.blocks if tasks is None else tasks
    cores = max(1, min(workers or available_cores(), available_cores(), most))
    realisations = {"realisations": survey.total.realisations, "realisations_pending": survey.pending.realisations}
    seconds = {}
    if study.experiment.cost_unit:
        seconds["seconds"] = round(survey.pending.cost / (_normals_per_second() * cores), 1)
    return {
        "title": study.title,
        "grid": " x ".join(f"{name} {n}" for name, n in zip(grid.dimensions, grid.shape, strict=True)) or "one point",
        "points": survey.total.points,
        "points_done": survey.total.points - survey.pending.points - survey.failed,
        "points_failed": survey.failed,
        **({} if study.experiment.deterministic else realisations),
        "blocks_pending": survey.pending.blocks,
        "tasks_about": tasks,
        "result_mb": round(result_mb, 3),
        "ledger_mb": round(ledger_mb, 3),
        "memory_mb": round(result_mb + ledger_mb, 3),
        **seconds,
        "cores": cores,
        "store": str(store),
        "warnings": list(grid.warnings),
    }


def _normals_per_second() -> float:
    """Time a quarter of a million normals: what a realisation costs is nearly all random numbers."""
    rng = np.random.Generator(np.random.SFC64(0))
    buffer = np.empty(65536)
    begun = time.perf_counter()
    for _ in range(4):
        rng.standard_normal(out=buffer)
    return 4 * buffer.size / (time.perf_counter() - begun)


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
    beside: Beside = ALL,
) -> tuple[Labelled, dict[str, str]]:
    """Compute what the store does not hold yet, write it as it comes, and return the dataset and the failures by place.

    The same call after an interruption goes on where it stopped.  Points that failed before are left as they are; with
    ``retry`` they, and only they, are computed again.  The dataset in the store has its other points too, unless
    ``beside`` says otherwise; a store that has all that is asked for is left as it is.  One that other code made is
    continued with ``accept_code`` only; ``fresh`` replaces whatever store is there.  Raises SweepError for bad input
    before anything is written, and for a store that another process writes to (``break_lock`` as `locked` says); with
    everything that was finished in the store TooManyFailuresError where more than ``max_failures`` fail, by default
    where the first points all fail for one reason, and RunInterruptedError on SIGINT, SIGTERM and SIGHUP.
    """
    progress = progress or Silent()
    grid = make_grid(study)
    for sentence in grid.warnings:
        progress.say(f"warning: {sentence}")
    with watched() as interruptions, ExitStack() as stack:
        try:
            stack.enter_context(locked(store, break_lock=break_lock))
        except SweepError:  # a store that cannot be locked can still be read
            if retry or fresh or beside != ALL:
                raise
            session = Session.open(grid, store, accept_code=accept_code)
            if not session.is_left_alone:
                raise
            return _left_alone(session, progress)
        session = Session.open(grid, store, accept_code=accept_code, retry=retry, fresh=fresh, beside=beside)
        if session.is_left_alone:
            return _left_alone(session, progress)
        pending = session.survey.pending
        if retry and not pending.blocks:
            progress.say(f"no point in {store} has failed")
        if beside.redo and not pending.blocks:
            progress.say(f"no point in {store} is there where {beside.redo}")
        where = choose_executor(
            session.study, pending.cost, resources if pending.blocks else ANY_RESOURCES, progress.say
        )
        place, execute = stack.enter_context(where)
        progress.start(session.survey, place.words, place.workers)
        if place.dashboard:
            progress.say(f"Dask dashboard: {place.dashboard}")
        session.compute(execute, progress, max_failures, interruptions.postponed, tuning)
        return session.publish(progress), session.failures()


def _left_alone(session: Session, progress: Progress) -> tuple[Labelled, dict[str, str]]:
    assert session.store is not None, "it has more points"
    where = session.store.location
    progress.say(f"{where} holds more than this study asks for; it is left as it is, and these are its points")
    return session.part()
