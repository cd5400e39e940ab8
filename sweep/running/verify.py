"""Computes a few points of a store again, each by itself in new processes, in two orders: results must not depend on
what a process has computed before.
"""

import heapq
from collections.abc import Container, Sequence
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from linksweep.sweep.contract import Rows
from linksweep.sweep.contract.block import ledger_key
from linksweep.sweep.contract.reducer import converted, same_rows
from linksweep.sweep.executing.children import Children
from linksweep.sweep.executing.task import Batch
from linksweep.sweep.executing.versions import identity
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import Grid, GridPoint, describe
from linksweep.sweep.planning.plan import Plan, Work
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.running.study_store import open_store
from linksweep.sweep.stores.location import Where
from linksweep.sweep.stores.store import OpenStore
from linksweep.sweep.studies.record import as_recorded
from linksweep.sweep.studies.study import Study

MOST_EXPLAINED = 3
"""Points that differ and are computed twice more, each time in a process of their own, to find the cause."""

RANDOM = (
    "another result each time it is computed: it draws random numbers that are not those of its argument rng, or reads "
    "a clock or something that changes"
)
STATE = (
    "a result that depends on the points computed before it in the same process: the function keeps state between "
    "calls, for instance in a global variable, a mutable default or a cache"
)
STORED = (
    "always the same result now, but another one than in the store: state of the process that computed it, or what the "
    "function reads has changed since"
)


@dataclass(frozen=True)
class Verified:
    """How many points were computed again, and a sentence for each that differs."""

    points: int
    differing: list[str]


def verify(study: Study, where: Where, number: int) -> Verified:
    """Compute ``number`` finished points of a store again, chosen by their digests: alone in new processes, in their
    order and in the reverse order, and compare every bit with what is stored.

    Results of a vectorised function are compared within its tolerance.  Raises SweepError as `OpenStore`, and for a
    function that cannot be sent to another process.
    """
    found = OpenStore(where)
    study = as_recorded(study, found.attributes)
    store, plan = open_store(found, study), Plan(Grid(study))
    ledger = store.read()
    accumulator = Accumulator(plan, store.rows, ledger, store.failures, None, store.samples)
    done = (point for point in plan.grid.points() if accumulator.status[point.index] == Status.DONE)
    chosen = heapq.nsmallest(number, done, key=lambda point: point.digest)
    works = {point.index: _works(plan, point, store.rows) for point in chosen}

    def stored(point: GridPoint) -> Rows:
        return ledger[[store.rows[ledger_key(point.digest, work.block)] for work in works[point.index]]]

    def computed(points: Sequence[GridPoint]) -> dict[int, Rows | str]:
        with Children(identity(study.experiment_reference)) as children:
            return {point.index: _computed(study, works[point.index], children) for point in points}

    differing: list[str] = []
    with threadpool_limits(1):
        forward, backward = computed(chosen), computed(chosen[::-1])
        for point in chosen:
            seen = [stored(point), forward[point.index], backward[point.index]]
            if all(_same(study, seen[0], other) for other in seen[1:]):
                continue
            cause = "other results than in the store"
            if len(differing) < MOST_EXPLAINED:
                first, second = (computed([point])[point.index] for _ in range(2))
                if not _same(study, first, second):
                    cause = RANDOM
                else:
                    cause = STORED if all(_same(study, first, other) for other in seen[1:]) else STATE
            failed = next((f"; computed again it fails: {one}" for one in seen[1:] if isinstance(one, str)), "")
            differing.append(f"{describe(study, point.parameters)} has {cause}{failed}")
    return Verified(len(chosen), differing)


def _works(plan: Plan, point: GridPoint, rows: Container[bytes]) -> list[Work]:
    """Return the work of the blocks that a ledger has of a point, without those that a precision added."""
    blocks = plan.blocks(plan.cost(point.parameters))
    return [plan.work((point,), block) for block in blocks if ledger_key(point.digest, block) in rows]


def _computed(study: Study, works: Sequence[Work], children: Children) -> Rows | str:
    """Return the rows of a point's blocks, or why it fails."""
    experiment, dtype = study.experiment, study.experiment.reducer.dtype
    rows: list[Rows] = []
    while len(rows) < len(works):
        result = children.run(Batch(study, list(works[len(rows) :])).task())
        known, fields, refused = experiment.learned(result.outcomes)
        if result.failures or refused or result.refused:
            reasons = [*(failure.message for failure in result.failures.values()), *refused.values()]
            return result.refused or reasons[0]
        for row in sorted(fields):  # integers beside which the store has floats are floats
            rows.append(converted(np.array([fields[row]], dtype=known.reducer.dtype), dtype))
    return np.concatenate(rows)


def _same(study: Study, one: Rows | str, other: Rows | str) -> bool:
    """Return whether two results of a point are the same to the last bit."""
    if isinstance(one, str) or isinstance(other, str):
        return bool(one is other or (isinstance(one, str) and isinstance(other, str) and one == other))
    experiment, count = study.experiment, np.ones(len(one))
    if same_rows(one, other) or not experiment.vectorised or one.shape != other.shape:
        return same_rows(one, other)
    pairs = zip(*(experiment.reducer.finish(rows, count, count).values() for rows in (one, other)), strict=True)
    return all(
        np.allclose(a, b, rtol=experiment.tolerance, atol=0.0, equal_nan=True)
        if a.dtype.kind == "f"
        else np.array_equal(a, b)
        for a, b in pairs
    )
