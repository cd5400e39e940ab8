"""Runs a study in a session: its grid, its store, whether what is there can go on with it and is shown beside it, and
its pending work, opened once, computed and published; the writer puts results into the ledger as they come, to disk
every second, and as a dataset every few seconds.
"""

import json
import math
import os
import time
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Set
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from threading import Event, RLock, Thread
from timeit import timeit
from typing import Any

import numpy as np

from linksweep.sweep.code import as_recorded_where_unsteady, code_differences, code_of, digest_of, files_read
from linksweep.sweep.contract import Experiment, Named, Rows, Status, SweepError, Unknown, refused, shown
from linksweep.sweep.contract.rows import DIGEST_BYTES, Block, ledger_key, lost_integers
from linksweep.sweep.executing.executor import choose_executor
from linksweep.sweep.executing.pools import ANY_RESOURCES, Resources, available_cores
from linksweep.sweep.executing.task import Batch, Executor, Failure, TaskResult
from linksweep.sweep.executing.worker import one_thread
from linksweep.sweep.formatting import counted, host, now
from linksweep.sweep.interrupt import watched
from linksweep.sweep.planning.accumulator import TUNED, Accumulator, Pending
from linksweep.sweep.planning.grid import Grid, GridPoint, failures_by_place, make_grid
from linksweep.sweep.planning.plan import TARGET, Plan, PlanSize, Survey, Work
from linksweep.sweep.planning.union import REFINED, UNITED, united, with_numbers_of
from linksweep.sweep.running.progress import FIRST, SILENT, FailureCount, MaxFailures, Progress, Taken
from linksweep.sweep.running.results import Labelled, add_covariances, assemble, assemble_samples, code_variable, masked
from linksweep.sweep.stores.ledger import Record
from linksweep.sweep.stores.location import Location, Where, located, locked, writing
from linksweep.sweep.stores.store import BLOCKS, CODE, OpenStore, Store, create_store, replace_store, seen, store_at
from linksweep.sweep.studies.reader import problems_of_results
from linksweep.sweep.studies.record import (
    RECORD,
    as_recorded,
    as_written,
    begun_by,
    made_by,
    provenance,
    recorded,
    recorded_study,
)
from linksweep.sweep.studies.study import CONVENTION, PART, Part, Study
from linksweep.sweep.tables.columns import Flags, content_digest, rows_where
from linksweep.sweep.tables.reader import from_frame

# What a condition calls points that were made by other code than today's.
OLD = "old"


# Which code made the numbers of a store: its attribute `CODE` is a list of records, each with the ``first_row`` of the
# ledger that its ``code`` made, in the order of these.


def records_of(attributes: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the records of a store in their order; none for a store that keeps none yet."""
    return list(json.loads(attributes.get(CODE, "[]")))


def differences_of_code(records: Sequence[Mapping[str, Any]], study: Study) -> list[str]:
    """Say how a study's code differs from that of the last of some records; nothing where there is none."""
    if not records:
        return []
    reference, old = study.experiment_reference, records[-1]["code"]
    now = as_recorded_where_unsteady(code_of(reference, study.experiment), old, reference)
    return code_differences(old, now, "in the store", "now")


def made_by_other_code(store: Store, study: Study) -> set[bytes]:
    """Return the digests of the points in a ledger of which other code than a study's has made a row."""
    records = records_of(store.attributes)
    are_other = [False, *(bool(differences_of_code([record], study)) for record in records)]
    return {key[:DIGEST_BYTES] for key, row in store.rows.items() if are_other[number_of_code(records, row)]}


def number_of_code(records: Sequence[Mapping[str, Any]], row: int) -> int:
    """Return which of some records is of a row, from 1; 0 for a row before all of them."""
    return bisect_right(records, row, key=lambda record: record["first_row"])


def defaults_alone(code: Mapping[str, str], other: Mapping[str, str]) -> dict[str, str]:
    """Return of some code the defaults of parameters that another version of it has, too."""
    return {name: text for name, text in code.items() if name.startswith("default of ") and name in other}


def check_code(store: Store, study: Study, gone: Collection[bytes] = (), accept_code: bool = False) -> None:
    """Raise SweepError for a store whose last blocks other code than a study's has made, but for points that are to
    be computed again, by their digests; for code with other defaults in any case, since points at a default are known
    without it.
    """
    records = records_of(store.attributes)
    if not store.rows or not records:
        return
    ways = "--fresh (fresh=True) starts anew, -o (store=NAME) names another store"
    old, new = records[-1]["code"], code_of(study.experiment_reference, study.experiment)
    was, now = defaults_alone(old, new), defaults_alone(new, old)
    if was != now:
        meaning = f"was made by other code with other defaults, for which points at them would be taken; {ways}"
        raise SweepError([meaning, *code_differences(was, now, "in the store", "now")], str(store.location))
    if gone:
        last = max((row for key, row in store.rows.items() if key[:DIGEST_BYTES] not in gone), default=-1)
        records = [record for record in records if record["first_row"] <= last]
    if not accept_code and (changes := differences_of_code(records, study)):
        meaning = (
            "was made by other code, whose numbers would be mixed up with those of today's; --redo old (in Python "
            'redo="old") computes its points again, --accept-code (accept_code=True) goes on and records for each '
            f"point which code made it, {ways}"
        )
        raise SweepError([meaning, *changes], str(store.location))


def record_code(store: Store, study: Study, say: Callable[[str], None]) -> None:
    """Record which code makes the blocks from now on, and tell the user if it has changed."""
    records = records_with_rows(store)
    changes = differences_of_code(records, study)
    for sentence in changes:
        say(f"other code goes on with {store.location}: {sentence}")
    is_new = changes or not records
    begin_code(store, code_of(study.experiment_reference, study.experiment) if is_new else records[-1]["code"])


def records_with_rows(store: Store) -> list[dict[str, Any]]:
    """Return the records of code that has made rows of an open store."""
    return [record for record in records_of(store.attributes) if record["first_row"] < store.rows.end]


def begin_code(store: Store, code: Mapping[str, str]) -> None:
    """Record which code makes the rows that follow, before there are any."""
    records = records_with_rows(store)
    if not records or records[-1]["code"] != code:
        records.append({"first_row": store.rows.end if records else 0, "code": code})
    if code or CODE in store.attributes:  # linksweep's own experiments are known by their version
        store.record({CODE: json.dumps(records)})


@dataclass(frozen=True)
class Beside:
    """What becomes of the points of a store beside those that are asked for: with ``retry`` those that failed, and no
    others, are computed; with ``fresh`` the store begins anew; ``only`` those that are asked for stay in its dataset;
    with ``keep`` constants that differ become axes; those that meet the condition ``redo`` are computed again.
    """

    retry: bool = False
    fresh: bool = False
    only: bool = False
    keep: bool = False
    redo: str = ""

    def __post_init__(self) -> None:
        chosen = [name for name, value in vars(self).items() if value]
        if (self.retry or self.fresh) and len(chosen) > 1:
            raise SweepError(f"{' and '.join(chosen)} do not go together")


ALL = Beside()


def with_stored(store: Store, study: Study, only: bool = False) -> tuple[Study, Study, Set[bytes] | None]:
    """Return a study with its numbers as a store has them, the study of its points and, unless ``only`` these are
    meant, of those of the store together, and the digests of the points to be computed.

    The study itself, and None, where it has all of them.  Raises SweepError as `united`.
    """
    attributes, where = store.attributes, str(store.location)
    if attributes.get("study_digest") == study.digest() and json.loads(attributes["study_axes"]) == study.varying:
        return study, study, None
    document = json.loads(attributes["study_document"])
    # The same files, as the caller has found; that which the store names may have moved.
    files = {one.name for one in study.experiment.parameters if one.kind in ("file", "files")}
    fixed, here = (one.get("fixed", {}) for one in (document, study.document))
    document["fixed"] = fixed | {name: here[name] for name in files & fixed.keys() & here.keys()}
    stored = recorded_study({**attributes, "study_document": json.dumps(document)}, where)
    study = with_numbers_of(stored, study)
    if only:
        return study, study, None
    check_points(stored, study, where)
    digests = {key[:DIGEST_BYTES] for key in store.rows} | store.failures.keys()
    is_complete = bool(attributes.get("complete")) and attributes.get(BLOCKS) == len(store.rows)
    with refused(SweepError, where=where, more="; --only (only=True) leaves the earlier points out"):
        whole = united(stored, study, digests, is_whole=is_complete or "repaired" in attributes)
    if whole is study or "repaired" in attributes:  # then what was lost is computed again, whoever asked for it
        return study, whole, None
    grid = Grid(study)
    wanted = set(grid.digests(grid.indices()))
    # More realisations are for all points, which are not shown without them.
    return study, whole, wanted if whole.sampling is stored.sampling else wanted | digests


def require_known(study: Study, points: Iterable[GridPoint]) -> None:
    """Raise SweepError for a point that is to be computed with an object that only its script can make again."""
    if all(named.value is not Unknown for parameter in study.experiment.parameters for named in parameter.defined):
        return
    for name, value in (pair for point in points for pair in point.parameters.items()):
        if isinstance(value, Named) and value.value is Unknown:
            why = f"{name} = {shown(value.name)} is the label of an object that only its script can make again"
            raise SweepError(f"{why}; run that, or leave the earlier points out by --only (only=True)")


def where_met(study: Study, points: Sequence[GridPoint], condition: str, old: Collection[bytes] = ()) -> Flags:
    """Return at which points of a study a condition of ``--redo`` is true, with the digests of those that other code
    made; raises SweepError for one that is none.
    """
    import pandas as pd  # takes a quarter of a second

    texts = {name for p in points for name, value in p.parameters.items() if isinstance(value, str | Named)}
    table = list[dict[str, Any]]()
    for p in points:
        labelled = texts.difference(study.missing(p.parameters))
        values = {name: str(value) if name in labelled else value for name, value in p.parameters.items()}
        table.append({OLD: p.digest in old} | values)
    columns = pd.DataFrame(table, index=range(len(points))).convert_dtypes()
    return rows_where(from_frame(columns), condition, "--redo", may_be_none=True)


def again_where(store: Store, study: Study, condition: str) -> dict[bytes, Record | None]:
    """Return the points of a study to be computed again where a condition is true, by their digests, with why.

    Where a run with the same condition was killed, they are those that it has left.  What other code made of points
    that are not in the study any more is to be forgotten: None.  Raises SweepError for a condition that is none.
    """
    message = f"is to be computed again where {condition}"
    left = {digest for digest, record in store.failures.items() if record["message"] == message}
    there = {key[:DIGEST_BYTES] for key in store.rows} | store.failures.keys()
    made = made_by_other_code(store, study)
    old = made | store.failures.keys() if differences_of_code(records_of(store.attributes), study) else made
    points = list(Grid(study).points())  # also those that are not there: they, too, say what is compared as text
    met = where_met(study, points, condition, old)
    record = {"kind": "again", "message": message, "traceback": "", "host": host(), "when": now()}
    again = dict[bytes, Record | None].fromkeys(made.difference(point.digest for point in points))
    for point, is_met in zip(points, met, strict=True):
        if point.digest in left or (is_met and point.digest in there and (point.digest in old or not left)):
            again[point.digest] = record
    return again


# Most failed points that a dataset names in its attributes; its status counts all.
MAX_FAILURES_NAMED = 1000

# What the record of a failure says of the block that failed, if one did: its group and its part.
BLOCK = "block"

# Attributes of a store that every later run keeps.
KEPT = ("merged", "started", REFINED, "repaired")


def find_store(where: Where, study: Study, keep: bool = False) -> OpenStore | None:
    """Return the store at a place, None where the place is free.

    Raises SweepError where something else is there, or results that cannot be mixed with this study's; with ``keep``
    other values of its constants can be.
    """
    opened = store_at(where)
    if opened is None:
        return None
    different = differing(study_differences(opened.attributes, study, keep))
    before, asked = opened.attributes.get(PART, "the whole"), str(study.part or "the whole")
    if before != asked:
        different.append(f"part: {before} in the store, {asked} in the study")
    elif study.part and opened.attributes["study_digest"] != study.digest():
        different.append(f"part: {asked} of other points or realisations in the store than in the study")
    if different:
        no_use = study.part or before != asked or differing(study_differences(opened.attributes, study, keep=True))
        ways = "" if no_use else ", or --keep (keep=True), with which constants that differ become axes"
        words = f"holds results of a different study, which would be mixed up; give another store with -o{ways}"
        raise SweepError([words, *different], str(opened.location))
    return opened


def open_store(opened: OpenStore, study: Study, writes: bool = False) -> Store:
    """Return the open store of a study, to which only who holds its lock ``writes``; raises SweepError where files of
    its ledger are damaged, or where it has rows of another version of the experiment.
    """
    store = Store(opened, writes)
    hold(store, study)
    return store


def hold(store: Store, study: Study) -> None:
    """Let the ledger of a store have rows as the experiment makes them, once their type is known."""
    if not study.experiment.undeclared:
        width = study.experiment.samples_width if study.keeps_samples else 0
        store.hold(study.experiment.reducer.dtype, width)


def attributes_of(plan: Plan) -> dict[str, Any]:
    """Return the attributes of a store that say what its numbers mean, and of which study and experiment they are."""
    study = plan.grid.study
    return provenance(study) | identity(study) | {RECORD: recorded(study, plan.costs())}


def identity(study: Study) -> dict[str, Any]:
    """Return the attributes of a store that say what its numbers mean."""
    return {
        "study_meaning": json.dumps(study.meaning(), default=content_digest),
        "study_axes": json.dumps(study.varying),
    }


def study_differences(attributes: Mapping[str, Any], study: Study, keep: bool = False) -> dict[str, tuple[Any, Any]]:
    """Return what decides the meaning of stored results, and that of a study's; values of parameters that are an axis
    in either, or have another default now (see `check_code`), are left out, and with ``keep`` those that may be axes.
    """
    old, new = json.loads(attributes["study_meaning"]), json.loads(identity(study)["study_meaning"])
    axes = {*json.loads(attributes["study_axes"]), *study.varying}
    code = records[-1]["code"] if (records := records_of(attributes)) else {}
    for one in study.experiment.parameters:
        text = json.dumps(one.written_default(), default=str)
        if (keep and one.may_be_axis) or code.get(f"default of {one.name}", text) != text:
            axes.add(one.name)
    defaults = json.loads(json.dumps(study.experiment.defaults(), default=content_digest))
    names = sorted({*old["fixed"], *new["fixed"]} - axes)
    was, now = defaults | old.pop("fixed"), defaults | new.pop("fixed")
    pairs = {key: (old.get(key, "absent"), new.get(key, "absent")) for key in sorted({*old, *new})}
    return pairs | {f"fixed.{name}": (was.get(name), now.get(name)) for name in names}


def differing(pairs: Mapping[str, tuple[Any, Any]], was: str = "in the store", now: str = "in the study") -> list[str]:
    """Return a phrase for each pair that differs; ``was`` and ``now`` say where its values are."""
    return [f"{key}: {old!r} {was}, {new!r} {now}" for key, (old, new) in pairs.items() if old != new]


def check_points(stored: Study, study: Study, where: str) -> None:
    """Raise SweepError where rows of a study's table of points differ from those of a store: it may only have more rows
    at its end.
    """
    before, points = stored.points, study.points
    if before is None or points is None or UNITED in before.origin:
        return
    names, known = dict.fromkeys([*before.names, *points.names]), {one.name: one for one in study.experiment.parameters}
    crossed = (stored.axes.keys() - {*before.names}) | (study.axes.keys() - {*points.names})
    if not {*names} <= known.keys() - crossed:  # one is an axis, or no parameter any more: points are joined as such
        return
    rows = min(len(stored.axes[before.names[0]]), len(study.axes[points.names[0]]))
    was, now = (
        {n: [*map(known[n].written, one.axes.get(n) or rows * [one.fixed.get(n, known[n].default)])] for n in names}
        for one in (stored, study)
    )
    changed = next(((i, n) for i in range(rows) for n in names if was[n][i] != now[n][i]), None)
    if changed is not None:
        row, name = changed
        pairs = {f"points, row {row + 1}, {name}": (was[name][row], now[name][row])}
        about = [key for key in ("design", "n", "seed", "ranges") if key in before.origin]
        pairs |= {f"points.{key}": (before.origin[key], points.origin.get(key)) for key in about}
        rule = "a table may only grow at its end: give another store with -o, or --fresh replaces this one"
        raise SweepError([f"holds a table of other points; {rule}", *differing(pairs)], where)


class Writer:
    """Takes the results of tasks, in whatever order they arrive, and puts what more they call for into ``pending``.

    ``postponed`` gives contexts in which interruptions wait, so that none leaves the ledger half-changed.  As a context
    manager it makes results durable also while this thread waits for the next ones, or computes them, and, where an
    exception leaves it, writes everything that was taken.
    """

    def __init__(
        self,
        accumulator: Accumulator,
        store: Store,
        postponed: Callable[[], AbstractContextManager[None]] = nullcontext,
        further: Mapping[str, Any] | None = None,
        is_begun: bool = True,
    ) -> None:
        """Start with an open store whose ledger the accumulator holds; ``further`` attributes go into the dataset.  A
        store that is not yet ``is_begun`` goes again where the first results are refused.
        """
        plan = accumulator.plan
        if problems := problems_of_results(plan.grid.study):
            raise _RefusedError(problems, plan.grid.study.source)
        self.accumulator, self.store, self._is_begun = accumulator, store, is_begun
        self.pending = Pending(plan, accumulator)
        self._postponed = postponed
        kept = {key: store.attributes[key] for key in KEPT if key in store.attributes}
        self._provenance = attributes_of(plan) | kept | dict(further or {})
        self._begun = self._flushed = self._written = time.monotonic()
        self._writing = 0.0
        self._long_write = False
        self._refuse_results(np.flatnonzero(accumulator.status == Status.DONE).tolist())
        self.declared_files: Mapping[str, Path] = {}  # that the function reads, by name
        self._stamps: dict[str, float] = {}
        self._steady = store.rows.end
        self._lock = RLock()  # of the store
        self._problem: Exception | None = None
        self._ended = Event()

    def __enter__(self) -> "Writer":
        Thread(target=self._flush_late, name="flush", daemon=True).start()
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        self._ended.set()
        if isinstance(error, _RefusedError) and not self._is_begun and len(self.store.rows) < FIRST:
            with writing(self.store.location):
                self.store.location.clear()  # as if nothing had been begun
        elif error is not None:
            with suppress(SweepError, OSError):  # the latter of Zarr, where no more files can be opened
                self.stop()
            self.require_whole(error.problems if isinstance(error, SweepError) else ())

    @property
    def plan(self) -> Plan:
        """The plan, with what is known of the experiment from its results."""
        return self.accumulator.plan

    def take(self, works: Sequence[Work], result: TaskResult) -> Taken:
        """Add a task's results."""
        accumulator, points = self.accumulator, [(point, work.block) for work in works for point in work.points]
        added, failed = list[Work](), dict[int, Failure]()
        with self._postponed(), self._lock:
            failures, rows = self._as_rows(result)
            good = {row: one for row, one in enumerate(points) if row not in failures}
            there = {point.index: point for point, _ in points if accumulator.is_missing(point.index)}
            for row in sorted(failures):
                point, block = points[row]
                if accumulator.is_missing(point.index):  # else it was given up already
                    failed[point.index] = failures[row]
                    self._fail(point, failures[row], block)
            if not failures and accumulator.takes_whole():
                accumulator.add_whole([point.index for point, _ in points], rows, result.seconds)
            else:
                for place, (row, (point, block)) in enumerate(good.items()):
                    kept = result.outcomes[row].kept
                    more = accumulator.add(point, block, rows[place : place + 1], kept, float(result.seconds[row]))
                    added += [self.plan.work((point,), one) for one in more]
            ended = tuple(point for index, point in there.items() if not accumulator.is_missing(index))
            failed |= self._refuse_results([point.index for point in ended if accumulator.is_done(point.index)])
            self.pending.add(added)
            samples = [kept for row in good if (kept := result.outcomes[row].kept) is not None]
            keys = [ledger_key(point.digest, block) for point, block in good.values()]
            self.store.append(keys, rows, samples, result.seconds[[*good]])
            self.store.clear_failures(point.digest for point in ended if point.index not in failed)
            if time.monotonic() - self._flushed > TUNED.flush_every_s:
                self.flush()
        realisations = sum(block.realisations for _, block in good.values())
        done = PlanSize(len(ended), len(points), realisations, sum(work.cost for work in works))
        begun = {point.index for point, _ in good.values() if accumulator.is_missing(point.index)}
        return Taken(done, sum(work.cost for work in added), ended, failed, begun)

    def write_when_due(self) -> None:
        """Write the labelled dataset if the last one is some time ago."""
        clock = time.monotonic()
        most = TUNED.early_writes_s + TUNED.write_share * (clock - self._begun)
        if clock - self._written > TUNED.write_every_s and self._writing < most:
            self.write()

    def _as_rows(self, result: TaskResult) -> tuple[dict[int, Failure], Rows]:
        """Return which results fail, those too that are not like those before, and the rows of the others in order."""
        failures = dict(result.failures)
        outcomes = self.store.kept({row: one for row, one in result.outcomes.items() if row not in failures})
        experiment, fields, refused = self.plan.grid.study.experiment.learned(outcomes)
        if experiment is not self.plan.grid.study.experiment:
            self._learn(experiment)
        failures |= {row: Failure("exception", why) for row, why in refused.items()}
        rows = np.array([fields[row] for row in sorted(fields)], dtype=experiment.reducer.dtype)
        return failures, rows

    def _learn(self, experiment: Experiment) -> None:
        """Let the store and all rows have the types of results that are known now: those that came were the first, or
        are floats where others had integers.

        The root document says so before the ledger has such rows, so that what is killed in between can go on.
        """
        study = replace(self.plan.grid.study, experiment=experiment)
        if problems := problems_of_results(study):
            raise _RefusedError(problems, study.source)
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

    def write(self, final: bool = False) -> Labelled:
        """Write the labelled dataset of everything taken so far, unless the store has it already, and return it."""
        begun = time.monotonic()
        with self._postponed():
            self.flush()
        dataset = self.assembled(final)
        size = sum(one.nbytes for one in dataset.variables.values())
        self._long_write = size > TUNED.long_write_bytes or dataset["status"].size > TUNED.long_write_points
        with nullcontext() if self._long_write else self._postponed(), self._lock:
            if not self.store.has(dataset):
                self.store.write(replace(dataset, attrs=made_by() | dataset.attrs))
            if final:
                self.store.tidy()
        self._written = time.monotonic()
        self._writing += self._written - begun
        return masked(replace(dataset, attrs=seen(self.store.attributes)))

    def assembled(self, final: bool = False) -> Labelled:
        """Return the labelled dataset of everything taken so far."""
        study = self.plan.grid.study
        dataset = assemble(self.plan, self.accumulator, self.store.location)
        if study.sampling.keep_samples:
            dataset = dataset.assign(assemble_samples(self.plan, self.accumulator.status, self.store.samples))
        if final and study.sampling.common_random_numbers and study.sampling.precision is None:
            dataset = add_covariances(dataset, self.plan, self.accumulator, self.store)
        if len(records := records_of(self.store.attributes)) > 1:
            numbers = {key: number_of_code(records, row) for key, row in self.store.rows.items()}
            dataset = dataset.assign({"code": code_variable(self.plan, self.accumulator, numbers)})
        return replace(dataset, attrs=dataset.attrs | self._attributes())

    def _attributes(self) -> dict[str, Any]:
        """Return the attributes of a dataset of everything taken so far."""
        status = self.plan.grid.with_repeats(self.accumulator.status)
        points = int(np.count_nonzero(status != Status.EXCLUDED))
        done = int(np.count_nonzero(status == Status.DONE))
        if not (status == Status.MISSING).any():
            self._provenance.pop("repaired", None)
        sampling = self.plan.grid.study.sampling
        coarse = np.count_nonzero(self.plan.grid.with_repeats(self.accumulator.is_coarse) & (status == Status.DONE))
        which = f"{coarse:,} of {counted(points, 'point')} did not reach precision = {sampling.precision}"
        warnings = [f"{which} with max_n_sim = {sampling.most}"] if coarse else []
        return self._provenance | {
            "points": points,
            "points_done": done,
            "complete": int(points == done or self._has_its_part()),
            "failures": json.dumps(self.failures(MAX_FAILURES_NAMED)),
            "warnings": json.dumps([*self.plan.grid.warnings, *warnings]),
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
        place, lost = self.store.location, list[str]()
        with suppress(SweepError) if problems else nullcontext():  # else that this cannot be told would hide them
            lost = self.store.lost()
        if not lost:
            return
        left = replace(assemble(self.plan, self.accumulator, place), attrs=made_by() | self._attributes())
        with self._postponed(), self._lock:
            rescued = self.store.rescue(left, lost)
        more = f" and {len(lost) - 1:,} more files" if len(lost) > 1 else ""
        sentence = f"{lost[0]}{more} of it went during the run; the results so far are in {rescued}"
        raise SweepError([*problems, sentence], str(place))

    def stop(self) -> None:
        """Make everything durable where a run ends early, and write the dataset once more unless that takes long.

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
            changed = self._changed_file()
            self.store.flush()
            self._flushed = time.monotonic()
            if changed:
                why = 'has changed during the run: --redo old (redo="old") computes again what was computed meanwhile'
                raise SweepError(f"{changed} {why}", str(self.store.location))

    def _changed_file(self) -> str:
        """Return a data file that the function declares and that is not as it was when the run began; what was taken
        since it was last so counts as made by other code.
        """
        for name, file in self.declared_files.items():
            stamp = file.stat().st_mtime if file.is_file() else None
            if stamp is not None and stamp == self._stamps.get(name):
                continue
            records, part = records_of(self.store.attributes), f"file {name}"
            if stamp is not None and digest_of(file.read_bytes()) == records[-1]["code"][part]:
                self._stamps[name] = stamp
                continue
            code = {**records[-1]["code"], part: "as it was while a run went on"}
            self.store.record({CODE: json.dumps([*records, {"first_row": self._steady, "code": code}])})
            self.declared_files = {}  # it is said once
            return name
        self._steady = self.store.rows.end
        return ""

    def _flush_late(self) -> None:
        while not self._ended.wait(TUNED.latest_flush_s):
            with self._lock:
                if not self._ended.is_set():
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
        failures = {index: Failure.raised(error) for index, error in errors.items()}
        for index, failure in failures.items():
            self._fail(self.plan.grid.point(index), failure)
        return failures

    def _fail(self, point: GridPoint, failure: Failure, block: Block | None = None) -> None:
        self.accumulator.fail(point.index)
        where = {} if block is None else {BLOCK: f"{block.group} {block.part}"}
        self.store.fail(point.digest, {**vars(failure), **where, "host": host(), "when": now()})


# What follows why a run was ended.
GOES_ON = (
    "what was done is kept; the same command goes on from there, and `sweep run --retry` tries failed points again; "
    '--max-failures 100% (in Python max_failures="100%") goes on whatever fails'
)


class TooManyFailuresError(SweepError):
    """A run was ended because too many of its points failed; what was done is in the store."""

    exit_code = 1


class _RefusedError(SweepError):
    """No result of an experiment is to be used, as its first ones show."""


def accumulated(
    plan: Plan, store: Store, again: Set[bytes] = frozenset(), wanted: Set[bytes] | None = None
) -> Accumulator:
    """Return what an open store has of a plan; only points that are ``wanted`` are pending if these are given, of those
    that failed only the ones to compute ``again``.
    """
    failed = store.failures.keys() - again
    return Accumulator(plan, store.rows, store.read(), failed, wanted, store.samples, store.seconds())


class Session:
    """A study, its grid, its store and its pending work.

    `open` reads them, and `compute` lets an executor do what is pending, keeps it as it comes, and writes the labelled
    dataset.  Whoever computes holds the lock of the store; without ``writes`` nothing can be written to it.
    """

    def __init__(self, where: Where, accumulator: Accumulator, store: Store | None = None) -> None:
        """Start with what the open ``store`` has, if there is one."""
        self._where, self.accumulator, self.store = where, accumulator, store
        # How much there is of what was asked for, and how much is pending; of all points if more than these are.
        self.survey = accumulator.survey
        self._asked: Study | None = None
        self.is_left_alone = False

    @classmethod
    def open(
        cls, grid: Grid, where: Where, *, writes: bool = False, accept_code: bool = False, beside: Beside = ALL
    ) -> "Session":
        """Open the study of a grid and its store, if there is one, with the points that this holds ``beside`` it.

        Raises SweepError for a store that cannot go on with this study, and for one that other code made unless
        ``accept_code``.
        """
        study = grid.study
        if beside.fresh:
            opened = replace_store(where, attributes_of(Plan(grid)) | begun_by())
        else:
            opened = find_store(where, study, beside.keep)
        if opened is None:
            if beside.retry:
                raise SweepError("no store is there whose failed points could be computed again", str(where))
            if beside.redo:
                where_met(study, list(grid.points()), beside.redo)
            return cls(where, Accumulator(Plan(grid)))
        store = open_store(opened, study, writes)
        study, whole, wanted = with_stored(store, study, beside.only)
        records = again_where(store, whole, beside.redo) if beside.redo else {}
        check_code(store, study, records, accept_code)
        if records:
            require_known(whole, (point for point in Grid(whole).points() if point.digest in records))
        store.again(records)
        again: Set[bytes] = records.keys()
        if store.rows and study.experiment.undeclared:  # without rows it is open again what results are like
            is_alone, study = whole is study, as_recorded(study, store.attributes)
            whole = study if is_alone else as_recorded(whole, store.attributes)
            hold(store, whole)
        if beside.retry:
            wanted = again = store.failures.keys() & set(grid.digests(grid.indices()))
        wanted = None if wanted is None else wanted | again
        plan = Plan(grid) if whole is grid.study else Plan(Grid(whole, grid.said))
        accumulator = accumulated(plan, store, again, wanted)
        session = cls(where, accumulator, store)
        if whole is not study:
            session._asked = study
            asked = session.asked().survey
            session.survey = asked if asked.pending.blocks == session.survey.pending.blocks else session.survey
            now = {"study_digest": whole.digest(), "error_convention": CONVENTION, BLOCKS: len(store.rows)}
            # What changes no point may be other than in the store, such as a claim, but for the name of a curve.
            now |= {"published_digest": whole.published.digest} if whole.published else {}
            sections = as_written({key: one for key, one in whole.sections.items() if key != "define"})
            is_same = sections.items() <= json.loads(store.attributes["study_document"]).items()
            is_stored = is_same and now.items() <= store.attributes.items()
            failed = wanted is not None and not store.failures.keys().isdisjoint(wanted)
            is_done = is_stored and not failed and not accumulator.survey.pending.blocks
            session.is_left_alone = is_done and store.is_whole()
            missing = accumulator.missing_points()
            require_known(whole, (p for p in plan.grid.points(missing) if not wanted or p.digest in wanted))
        return session

    @property
    def study(self) -> Study:
        """The study, with what is known of its results."""
        return self.accumulator.plan.grid.study

    def asked(self) -> Accumulator:
        """Return what is there now of the points of the study that was asked for alone."""
        if self._asked is None or self.store is None:
            return self.accumulator
        study = self.study
        known = replace(self._asked, experiment=study.experiment, sampling=study.sampling, counts=study.counts)
        return accumulated(self.accumulator.plan.for_study(known), self.store)

    def part(self) -> tuple[Labelled, dict[str, str]]:
        """Return the results of the points of the study that was asked for, and its failures by place."""
        assert self.store is not None, "it has more points"
        writer, whole = Writer(self.asked(), self.store), provenance(self.study)
        dataset = masked(writer.assembled(final=True))
        made = {name: value for name, value in seen(self.store.attributes).items() if name not in whole}
        return replace(dataset, attrs=made | dataset.attrs), writer.failures()

    def compute(
        self,
        execute: Executor,
        progress: Progress = SILENT,
        max_failures: MaxFailures | None = None,
        postponed: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> tuple[Labelled, dict[str, str]]:
        """Compute what is pending, keep it as it comes, and write the dataset of everything; return the results of the
        points of the study that was asked for, and its failures by place.

        ``postponed`` gives contexts in which interruptions wait.  Raises SweepError for results that are refused, and
        whatever the executor raises, with everything that was finished in the store; TooManyFailuresError, at the end,
        where more than ``max_failures`` failed.
        """
        survey, too_many = self.survey, ""
        total, pending = survey.total.points, survey.pending
        failing = FailureCount(self.study, total, total - pending.points, most=max_failures)
        is_begun = self.store is not None
        writer = Writer(self.accumulator, self._begun(progress), postponed, is_begun=is_begun)
        writer.declared_files = files_read(self.study.experiment_reference)
        study, keep = self.study, writer.store.keep

        def take(count: int) -> list[Batch]:
            tasks = writer.pending.take(count, failing.most_at_once)
            return [Batch(study, works, keep) for works in tasks]

        with writer:
            results = execute(take)
            # A labelled dataset from the start; not an empty one, for which the workers would wait, in a short run.
            short = TARGET if survey.stored.blocks else 256 * TARGET
            if pending.blocks and (not study.experiment.says_cost or pending.cost > short):
                writer.write()
            elif pending.cost > TARGET:  # now, while workers begin: the end of the run would wait for it
                with postponed():  # a library that is half imported writes nothing
                    import_module("zarr.storage")
            for batch, result in results:
                if result.refused:
                    raise _RefusedError(f"{result.refused}.")
                works = writer.pending.settle(batch.works, result.seconds)
                with postponed():  # so that an interruption leaves nothing taken that was not told
                    taken = writer.take(works, result)
                    progress.advance(works, result, taken)
                writer.write_when_due()
                failing.take(taken.ended, taken.failed, taken.begun)
                if too_many := failing.too_many():
                    break
            del results  # ends what nobody takes any more
            dataset = writer.write(final=not too_many)
        writer.require_whole()
        published = (dataset, writer.failures()) if self._asked is None else self.part()
        progress.written()
        before = Grid(self._asked or self.study, writer.plan.grid.said).warnings
        for sentence in json.loads(published[0].attrs["warnings"])[len(before) :]:
            progress.say(f"warning: {sentence}")
        if too_many:
            raise TooManyFailuresError(f"stopped: {too_many}; {GOES_ON}", str(writer.store.location))
        return published

    def _begun(self, progress: Progress) -> Store:
        """Return the store, a new one if need be, which is found whole and says which code continues it."""
        study, store = self.study, self.store
        if store is None:
            made = create_store(self._where, attributes_of(self.accumulator.plan) | begun_by())
            store = self.store = open_store(made, study, writes=True)
            store.keep_copy()
        store.verify()
        record_code(store, study, progress.say)
        if unused := len(store.rows) - self.accumulator.survey.stored.blocks:
            progress.say(f"{unused:,} blocks in the store are not part of this study; they are kept")
        return store


def with_part(study: Study, store: Where, part: str | None) -> tuple[Study, Location]:
    """Return a part of a study, as K/N or as that of this task of a job array, and where its store is; without a part
    the study, and the place of its store.  Raises SweepError for text that names no part.
    """
    if part is None:
        return study, located(store)
    with refused(ValueError, said="part = "):
        one = Part.of_task(os.environ) if part == "array" else Part.parsed(part)
    return replace(study, part=one), located(one.place(located(store)))


def plan_study(study: Study, store: Where, accept_code: bool = False) -> tuple[Plan, Survey]:
    """Return the plan of a study and what of it is pending in its store, writing nothing; raises SweepError for bad
    input, and for a store that other code made unless ``accept_code``.
    """
    session = Session.open(make_grid(study), store, accept_code=accept_code)
    return session.asked().plan, session.survey


def plan_report(study: Study, store: Where, workers: int | None = None, accept_code: bool = False) -> dict[str, Any]:
    """Return what a run would do; the time is the least that computing takes with so many ``workers`` (one per core by
    default), from a short timing of random numbers on this machine.
    """
    plan, survey = plan_study(study, store, accept_code)
    grid, experiment, pending = plan.grid, study.experiment, survey.pending
    floats = len(grid) * sum(map(experiment.size_of, experiment.outputs))
    samples = experiment.samples_width * survey.total.realisations if study.keeps_samples else 0
    row = experiment.reducer.dtype.itemsize
    cores = max(1, min(workers or available_cores(), available_cores(), math.ceil(pending.cost / TARGET)))
    realisations = {"realisations": survey.total.realisations, "realisations_pending": pending.realisations}
    time_left = {"seconds": round(pending.cost / (_normals_per_second() * cores), 1), "cores": cores}
    return {
        "title": study.title,
        "grid": " x ".join(f"{name} {n}" for name, n in zip(grid.dimensions, grid.shape, strict=True)) or "one point",
        "points": survey.total.points,
        "points_done": survey.total.points - pending.points - survey.failed,
        "points_failed": survey.failed,
        **({} if experiment.deterministic else realisations),
        "blocks_pending": pending.blocks,
        "memory_mb": round(8e-6 * (floats + 2 * samples) + 1e-6 * row * survey.total.blocks, 3),
        **(time_left if experiment.cost_unit else {}),  # else the time is not known
        "store": str(store),
        "warnings": list(grid.warnings),
    }


def _normals_per_second() -> float:
    """Time a quarter of a million normals: what a realisation costs is nearly all random numbers."""
    rng, buffer = np.random.Generator(np.random.SFC64(0)), np.empty(65536)
    return 4 * buffer.size / timeit(lambda: rng.standard_normal(out=buffer), number=4)


def run_study(
    study: Study,
    store: Where,
    resources: Resources = ANY_RESOURCES,
    progress: Progress = SILENT,
    accept_code: bool = False,
    max_failures: int | str | None = None,
    beside: Beside = ALL,
    break_lock: bool = False,
) -> tuple[Labelled, dict[str, str]]:
    """Compute what the store does not hold yet, write it as it comes, and return the dataset and the failures by place.

    The same call after an interruption goes on where it stopped.  Points that failed before are left as they are, and
    the dataset in the store has its other points too, unless ``beside`` says otherwise; a store that has all that is
    asked for is left as it is.  One that other code made is continued with ``accept_code`` only.  Raises SweepError for
    bad input before anything is written, and for a store that another process writes to (``break_lock`` as `locked`
    says); with everything that was finished in the store TooManyFailuresError where more than ``max_failures`` fail, by
    default where the first points all fail for one reason, and RunInterruptedError on SIGINT, SIGTERM and SIGHUP.
    """
    most = None if max_failures is None else MaxFailures.parsed(max_failures)
    grid = make_grid(study)
    for sentence in grid.warnings:
        progress.say(f"warning: {sentence}")
    with one_thread(), watched() as interruptions, ExitStack() as stack:
        stack.enter_context(locked(store, break_lock=break_lock))
        session = Session.open(grid, store, writes=True, accept_code=accept_code, beside=beside)
        if session.is_left_alone:
            progress.say(f"{store} has all that this study asks for; it is left as it is, and these are its points")
            return session.part()
        pending = session.survey.pending
        if (beside.retry or beside.redo) and not pending.blocks:
            progress.say(f"no point in {store} {'has failed' if beside.retry else f'is there where {beside.redo}'}")
        chosen = resources if pending.blocks else ANY_RESOURCES
        place, execute = stack.enter_context(choose_executor(session.study, pending.cost, chosen, progress.say))
        progress.start(session.survey, place.words, place.workers)
        if place.dashboard:
            progress.say(f"Dask dashboard: {place.dashboard}")
        return session.compute(execute, progress, most, interruptions.postponed)
