"""The store of a study: whether what is there can go on with it, and the writer that puts a run's results into the
ledger as they come, to disk every second, and as a dataset every few seconds.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from threading import Event, RLock, Thread
from types import MappingProxyType
from typing import Any

import numpy as np

from linksweep.sweep.contract import Experiment, Named, Rows, SweepError
from linksweep.sweep.contract.rows import Block, ledger_key, lost_integers
from linksweep.sweep.executing.task import Failure, TaskResult, failure_of
from linksweep.sweep.formatting import host, now
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import AT_ONCE, GridPoint, describe
from linksweep.sweep.planning.plan import Plan, PlanSize, Work
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.planning.refined import REFINED
from linksweep.sweep.planning.union import UNITED
from linksweep.sweep.planning.work_queue import TUNED, Pending, Tuning
from linksweep.sweep.running.code import records_of
from linksweep.sweep.running.failures import failures_by_place
from linksweep.sweep.running.results import Labelled, assemble, assemble_samples, code_variable, covariances, masked
from linksweep.sweep.stores import store as stores
from linksweep.sweep.stores.location import Where
from linksweep.sweep.stores.store import RESCUED, OpenStore, Store, free_beside
from linksweep.sweep.studies.record import RECORD, provenance, recorded
from linksweep.sweep.studies.study import PART, Study
from linksweep.sweep.tables.file import content_digest

# Most failed points that a dataset names in its attributes; its status counts all.
MAX_FAILURES_NAMED = 1000

# What the record of a failure says of the block that failed, if one did: its group and its part.
BLOCK = "block"

# Attributes of a store that every later run keeps.
KEPT = ("merged", "started", REFINED)


# The name in a store that is not that of an array.
RESERVED = "blocks"


def find_store(where: Where, study: Study, keep: bool = False) -> OpenStore | None:
    """Return the store at a place, None where the place is free.

    Raises SweepError where something else is there, or results that cannot be mixed with this study's; with ``keep``
    other values of its constants can be.
    """
    outputs = (output.name for output in (*study.experiment.outputs, *study.experiment.sample_outputs))
    if RESERVED in {*study.axes, *study.experiment.coordinates, *outputs}:
        raise SweepError(f"no axis or result can be named {RESERVED}: a store has a group of that name")
    opened = stores.find_store(where)
    if opened is None:
        return None
    different = study_differences(opened.attributes, study, keep)
    before, asked = opened.attributes.get(PART, "the whole"), str(study.part or "the whole")
    if before != asked:
        different.append(f"part: {before} in the store, {asked} in the study")
    elif study.part and opened.attributes["study_digest"] != study.digest():
        different.append(f"part: {asked} of other points or realisations in the store than in the study")
    if different:
        ways = "" if keep else ", or --keep (keep=True), with which constants that differ become axes"
        words = f"holds results of a different study, which would be mixed up; give another store with -o{ways}"
        raise SweepError([words, *different], str(opened.location))
    return opened


def open_store(opened: OpenStore, study: Study) -> Store:
    """Return the open store of a study; raises SweepError where files of its ledger are damaged, or where it has rows
    of another version of the experiment.
    """
    store = Store(opened)
    hold(store, study)
    return store


def hold(store: Store, study: Study) -> None:
    """Let the ledger of a store have rows as the experiment makes them, once their type is known."""
    if not study.experiment.undeclared:
        width = study.experiment.samples_width if study.keeps_samples else 0
        store.hold(study.experiment.reducer.dtype, width)


def attributes_of(plan: Plan) -> dict[str, Any]:
    """Return the attributes of a store that say what its numbers mean, how they were made, and of which experiment."""
    study = plan.grid.study
    return provenance(study) | identity(study) | {RECORD: recorded(study, plan.costs())}


def identity(study: Study) -> dict[str, Any]:
    """Return the attributes of a store that say what its numbers mean."""
    return {
        "study_meaning": json.dumps(study.meaning(), default=content_digest),
        "study_axes": json.dumps(list(study.axes)),
    }


def study_differences(attributes: Mapping[str, Any], study: Study, keep: bool = False) -> list[str]:
    """Say how the meaning of stored results differs from a study's; values of parameters that are an axis in either are
    not compared, and with ``keep`` neither are those of other parameters that may be one.
    """
    old, new = json.loads(attributes["study_meaning"]), json.loads(identity(study)["study_meaning"])
    axes = {*json.loads(attributes["study_axes"]), *study.axes}
    axes |= {one.name for one in study.experiment.parameters if keep and one.may_be_axis}
    defaults = json.loads(json.dumps(study.experiment.defaults(), default=content_digest))
    pairs = [(key, old.get(key, "absent"), new.get(key, "absent")) for key in sorted({*old, *new} - {"fixed"})]
    pairs += [
        (f"fixed.{name}", old["fixed"].get(name, defaults.get(name)), new["fixed"].get(name, defaults.get(name)))
        for name in sorted({*old["fixed"], *new["fixed"]} - axes)
    ]
    return _differing({key: (was, now) for key, was, now in pairs})


def _differing(pairs: Mapping[str, tuple[Any, Any]]) -> list[str]:
    return [f"{key}: {was!r} in the store, {now!r} in the study" for key, (was, now) in pairs.items() if was != now]


def check_points(opened: OpenStore, study: Study) -> None:
    """Raise SweepError where rows of a study's table of points differ from those of a store: it may only have more rows
    at its end.
    """
    document = json.loads(opened.attributes.get("study_document", "{}"))
    table = document.get("points") or {}
    old: dict[str, list[Any]] = table.get("columns", {})
    if study.points is None or not old or UNITED in table.get("origin", {}):
        return
    names = [name for name in dict.fromkeys([*old, *study.points.names]) if name not in table.get("labels", ())]
    settings = study.experiment.defaults()
    rows = min(len(next(iter(old.values()))), len(study.axes[study.points.names[0]]))
    was = {name: old.get(name) or rows * [document.get("fixed", {}).get(name, settings[name])] for name in names}
    now = {name: study.axes.get(name) or rows * [study.fixed.get(name, settings[name])] for name in names}
    now = {name: [str(value) if isinstance(value, Named) else value for value in now[name]] for name in names}
    changed = next(((i, n) for i in range(rows) for n in names if was[n][i] != now[n][i]), None)
    if changed is not None:
        row, name = changed
        pairs = {f"points, row {row + 1}, {name}": (was[name][row], now[name][row])}
        for key, before in table.get("origin", {}).items():
            if key in ("design", "n", "seed", "ranges"):
                pairs[f"points.{key}"] = before, study.points.origin.get(key)
        rule = "a table may only grow at its end: give another store with -o, or --fresh replaces this one"
        raise SweepError([f"holds a table of other points; {rule}", *_differing(pairs)], str(opened.location))


@dataclass(frozen=True)
class Taken:
    """What a task did, what more its results call for, which points it ended, and by their index why some failed, and
    which are begun without a failure.
    """

    done: PlanSize
    more: PlanSize
    ended: tuple[GridPoint, ...]
    failed: Mapping[int, Failure]
    begun: Set[int] = frozenset()


class Writer:
    """Takes the results of tasks, in whatever order they arrive, and puts what more they call for into ``pending``.

    ``postponed`` gives contexts in which interruptions wait, so that none leaves the ledger half-changed.  As a context
    manager it makes results durable also while this thread waits for the next ones, or computes them.
    """

    def __init__(
        self,
        accumulator: Accumulator,
        store: Store,
        postponed: Callable[[], AbstractContextManager[None]] = nullcontext,
        further: Mapping[str, Any] = MappingProxyType({}),
        tuning: Tuning = TUNED,
    ) -> None:
        """Start with an open store whose ledger the accumulator holds; ``further`` attributes go into the dataset."""
        plan = accumulator.plan
        self.accumulator, self.store = accumulator, store
        self.pending = Pending(plan, accumulator, tuning)
        self._postponed, self._tuning = postponed, tuning
        kept = {key: store.attributes[key] for key in KEPT if key in store.attributes}
        self._provenance = attributes_of(plan) | kept | dict(further)
        self._begun = self._flushed = self._written = time.monotonic()
        self._writing = 0.0
        self._long_write = False
        done = np.flatnonzero(accumulator.status == Status.DONE)
        for start in range(0, len(done), AT_ONCE):
            self._refuse_results(done[start : start + AT_ONCE].tolist())
        self._lock = RLock()  # of the store
        self._unflushed = False
        self._problem: Exception | None = None
        self._rescued: str | None = None
        self._ended = Event()

    def __enter__(self) -> "Writer":
        Thread(target=self._flush_late, name="flush", daemon=True).start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._ended.set()

    @property
    def plan(self) -> Plan:
        """The plan, with what is known of the experiment from its results."""
        return self.accumulator.plan

    def take(self, works: Sequence[Work], result: TaskResult) -> Taken:
        """Add a task's results."""
        points = [(point, work.block) for work in works for point in work.points]
        keys = [ledger_key(point.digest, block) for point, block in points]
        clock = time.monotonic()
        with self._postponed(), self._lock:
            result, rows = self._as_rows(result)
            good, ended, added = self._add(works, points, result, rows)
            failed = {points[row][0].index: failure for row, failure in result.failures.items()}
            failed |= self._refuse_results([p.index for p in ended if self.accumulator.is_done(p.index)])
            self.pending.add(added)
            samples = [kept for row in good if (kept := result.outcomes[row].kept) is not None]
            self.store.append([keys[row] for row in good], rows, samples, result.seconds[good])
            self.store.clear_failures(point.digest for point in ended if point.index not in failed)
            self._unflushed = True
            if clock - self._flushed > self._tuning.flush_every_s:
                self.flush()
        done = size_of(works, len(ended))
        if result.failures:
            done = replace(done, realisations=sum(points[row][1].realisations for row in good))
        begun = {i for row in good if self.accumulator.is_missing(i := points[row][0].index)}
        return Taken(done, size_of(added, 0), tuple(ended), failed, begun)

    def write_when_due(self) -> None:
        """Write the labelled dataset if the last one is some time ago."""
        # Early values so far are soon out of date.
        clock = time.monotonic()
        tuning, elapsed = self._tuning, clock - self._begun
        every = min(tuning.write_every_s, max(1.0, tuning.early_write * elapsed))
        if clock - self._written > every and self._writing < tuning.early_writes_s + tuning.write_share * elapsed:
            self.write()

    def _as_rows(self, result: TaskResult) -> tuple[TaskResult, Rows]:
        """Return the rows of results that are like those before, in order, and a result in which the others fail."""
        failures = dict(result.failures)
        outcomes = self.store.kept({row: one for row, one in result.outcomes.items() if row not in failures})
        experiment, fields, refused = self.plan.grid.study.experiment.learned(outcomes)
        if experiment is not self.plan.grid.study.experiment:
            self._learn(experiment)
        failures |= {row: Failure("exception", why) for row, why in refused.items()}
        rows = np.array([fields[row] for row in sorted(fields)], dtype=experiment.reducer.dtype)
        return replace(result, failures=failures), rows

    def _learn(self, experiment: Experiment) -> None:
        """Let the store and all rows have the types of results that are known now: those that came were the first, or
        are floats where others had integers.

        The root document says so before the ledger has such rows, so that what is killed in between can go on.
        """
        study = replace(self.plan.grid.study, experiment=experiment)
        dtype = experiment.reducer.dtype
        done = np.flatnonzero(self.accumulator.status == Status.DONE)
        for place, why in lost_integers(self.accumulator.total[done], dtype).items():
            failure = Failure("exception", f"{experiment.name}: {why}")
            self._fail(self.plan.grid.point(int(done[place])), failure)
        self.accumulator.learn(experiment)
        record = {RECORD: recorded(study, self.plan.costs())}
        self._provenance |= record
        self.store.record(record)
        hold(self.store, study)

    def _add(
        self, works: Sequence[Work], points: Sequence[tuple[GridPoint, Block]], result: TaskResult, rows: Rows
    ) -> tuple[list[int], list[GridPoint], list[Work]]:
        """Add rows to their points; return which results are good, the points that have ended, and what these still
        need.
        """
        if not result.failures and self.accumulator.are_whole(works):
            whole = self.accumulator.add_whole(works, rows, result.seconds)
            return list(range(len(whole))), whole, []
        good: list[int] = []
        ended: list[GridPoint] = []
        added: list[Work] = []
        for row, (point, block) in enumerate(points):
            if (failure := result.failures.get(row)) is not None:
                ends = self.accumulator.is_missing(point.index)  # else it was given up already
                if ends:
                    self._fail(point, failure, block)
            else:
                one_row = rows[len(good) : len(good) + 1]
                good.append(row)
                kept, seconds = result.outcomes[row].kept, float(result.seconds[row])
                more = self.accumulator.add(point, block, one_row, kept, seconds)
                added += [self.plan.work((point,), one) for one in more]
                ends = self.accumulator.is_done(point.index)
            if ends:
                ended.append(point)
        return good, ended, added

    def write(self, final: bool = False) -> Labelled:
        """Write the labelled dataset of everything taken so far, unless the store has it already, and return it."""
        begun = time.monotonic()
        with self._postponed():
            self.flush()
        dataset = self.assembled(final)
        tuning = self._tuning
        size = sum(one.nbytes for one in dataset.variables.values())
        self._long_write = size > tuning.long_write_bytes or dataset["status"].size > tuning.long_write_points
        with nullcontext() if self._long_write else self._postponed(), self._lock:
            if not self.store.has(dataset):
                self.store.write(dataset)
            if final:
                self.store.tidy()
        self._written = time.monotonic()
        self._writing += self._written - begun
        return masked(dataset)

    def assembled(self, final: bool = False) -> Labelled:
        """Return the labelled dataset of everything taken so far."""
        study = self.plan.grid.study
        dataset = assemble(self.plan, self.accumulator, self.store.location)
        if study.sampling.keep_samples:
            dataset = dataset.assign(assemble_samples(self.plan, self.accumulator.status, self.store.samples))
        if final and study.sampling.common_random_numbers and study.sampling.precision is None:
            dataset = dataset.assign(covariances(self.plan, self.accumulator, self.store.rows, self.store.read()))
        if len(records := records_of(self.store.attributes)) > 1:
            dataset = dataset.assign({"code": code_variable(self.plan, self.accumulator, self.store.rows, records)})
        return replace(dataset, attrs=self._attributes())

    def _attributes(self) -> dict[str, Any]:
        """Return the attributes of a dataset of everything taken so far."""
        status = self.plan.grid.with_repeats(self.accumulator.status)
        points = int(np.count_nonzero(status != Status.EXCLUDED))
        done = int(np.count_nonzero(status == Status.DONE))
        return self._provenance | {
            "finished": now(),
            "points": points,
            "points_done": done,
            "complete": int(points == done or self._has_its_part()),
            "failures": json.dumps(self.failures(MAX_FAILURES_NAMED)),
            "warnings": json.dumps(self.plan.grid.warnings),
        }

    def _has_its_part(self) -> bool:
        """Return whether a part has nothing left to compute: others finish the points that are missing."""
        missing = self.plan.grid.points(self.accumulator.missing_points())
        blocks = ((point, block) for point in missing for block in self.accumulator.blocks(point))
        is_part = self.plan.grid.study.part is not None
        return is_part and all(ledger_key(point.digest, block) in self.store.rows for point, block in blocks)

    def require_whole(self, problems: Sequence[str] = ()) -> None:
        """Raise SweepError, with what is known already, if files of the store have gone since they were written; the
        results so far are then written beside it.
        """
        place = self.store.location
        if not (lost := self.store.lost()):
            return
        if self._rescued is None:
            attributes = self._attributes() | {RESCUED: str(place)}
            with self._postponed(), self._lock:
                beside = Store(stores.create_store(free_beside(place), attributes))
                # Of arrays that were only in the lost files nothing is left.
                left = assemble(self.plan, self.accumulator, place).drop_vars(self.plan.grid.study.experiment.large())
                beside.write(replace(left, attrs=attributes))
            self._rescued = str(beside.location)
        more = f" and {len(lost) - 1:,} more files" if len(lost) > 1 else ""
        sentence = f"{lost[0]}{more} of it went during the run; the results so far are in {self._rescued}"
        raise SweepError([*problems, sentence], str(place))

    def stop(self) -> None:
        """Make everything durable after an interruption, and write the dataset once more unless that takes long.

        Where it is not written, the dataset is an earlier one, and the next run makes it anew from the ledger.
        """
        with self._postponed():
            self.flush()
        if not self._long_write:
            self.write()

    def flush(self) -> None:
        """Make everything taken so far durable; raises SweepError where that is not possible, or was not before."""
        with self._lock:
            if self._problem is not None:
                raise self._problem
            self.store.flush()
            self._unflushed = False
            self._flushed = time.monotonic()

    def _flush_late(self) -> None:
        while not self._ended.wait(self._tuning.latest_flush_s):
            with self._lock:
                if self._unflushed and not self._ended.is_set():
                    try:
                        self.flush()
                    except Exception as error:  # raised by the next flush, in the thread of the run
                        self._problem = error
                        return

    def failures(self, most: int | None = None) -> dict[str, str]:
        """Return the points of this study that failed, or the first of them, by their place on the axes, and why."""
        return failures_by_place(self.plan.grid, self.accumulator.status, self.store.failures, most)

    def _refuse_results(self, indices: list[int]) -> dict[int, Failure]:
        """Record those finished points as failed whose results are not what the experiment declares; return why."""
        errors = self.accumulator.failing(indices) if indices else {}
        failures = {index: failure_of(error) for index, error in errors.items()}
        for index, failure in failures.items():
            self._fail(self.plan.grid.point(index), failure)
        return failures

    def _fail(self, point: GridPoint, failure: Failure, block: Block | None = None) -> None:
        self.accumulator.fail(point.index)
        place = describe(self.plan.grid.study, point.parameters)
        where = {} if block is None else {BLOCK: f"{block.group} {block.part}"}
        self.store.fail(point.digest, {"place": place, **vars(failure), **where, "host": host(), "when": now()})


def size_of(works: Sequence[Work], points: int) -> PlanSize:
    """Return the counts of works that finish so many points."""
    blocks = sum(len(work.points) for work in works)
    realisations = sum(len(work.points) * work.block.realisations for work in works)
    return PlanSize(points, blocks, realisations, sum(work.cost for work in works))
