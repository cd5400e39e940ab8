"""The accumulator of a run: what blocks have left of each point so far, and which blocks it still needs; and the
pending work, given out in tasks of about a second, as measured: the whole grid coarsely at first, and a few
realisations of every point; no result depends on how.
"""

from bisect import bisect_right
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Array, Experiment, Rows, Status, check_finite
from linksweep.sweep.contract.rows import DIGEST_BYTES, Block, BlockRows, converted, ledger_key
from linksweep.sweep.planning.grid import AT_ONCE, GridPoint
from linksweep.sweep.planning.plan import MOST_SHARING, NOTHING, SHARED, TARGET, Plan, PlanSize, Survey, Work

# As integers: NumPy compares arrays with them ten times as fast as with members of an enumeration.
MISSING, DONE = int(Status.MISSING), int(Status.DONE)

# The cost of a realisation and what is left of each of the points that share random numbers, by what they share.
Groups = dict[bytes, list[tuple[float, PlanSize]]]

SoFar = tuple[Rows, int, int]


@dataclass(slots=True)
class _Round:
    """The ``blocks`` of a point that are being added in their order, of which so many are ``added``; those that arrive
    early wait.  ``reached`` says whether the parts before them reach the precision.  ``so_far`` is what was added when
    all catalogues begun had equally many realisations last: a row, (1,), its realisations and its catalogues.
    """

    blocks: Sequence[Block]
    added: int = 0
    early: dict[Block, tuple[Rows, Array | None]] = field(default_factory=dict)
    kept: list[Array] = field(default_factory=list)
    reached: bool = False
    so_far: SoFar | None = None


class Accumulator:
    """Joins blocks by the reducer of an experiment.

    The blocks of a point are added in their own order, not in order of arrival, so that the result is bitwise the same
    however they were computed; only blocks that arrive early are kept.  ``total``, ``realisations``, ``status``,
    ``seconds``, of all blocks of a point together, and ``is_coarse``, whether it has ended without the precision that
    is asked for, (points,) are indexed like the grid.
    """

    def __init__(
        self,
        plan: Plan,
        rows: BlockRows | None = None,
        values: Rows | None = None,
        failed: Collection[bytes] = (),
        only: Collection[bytes] | None = None,
        samples: Callable[[bytes], Array] | None = None,
        seconds: Array | None = None,
    ) -> None:
        """Start with the ``rows`` of a ledger and their ``values``, and with the points (by digest) that ``failed``.

        With ``only``, no other points than these are computed, and of the others those that are there count.
        ``samples`` returns the kept realisations of the block with a key, and ``seconds`` are those of the rows.
        Raises SweepError for a plan of too many blocks.
        """
        grid = plan.grid
        self.plan, self._failed, self._only = plan, failed, only
        self._rows = BlockRows() if rows is None else rows
        self.reducer = grid.study.experiment.reducer
        self._samples = samples if self.reducer.samples_width else None
        self.total = np.zeros(len(grid), dtype=self.reducer.dtype)
        self.realisations = np.zeros(len(grid), dtype=np.int64)
        self.status = np.full(len(grid), Status.EXCLUDED, dtype=np.int8)
        self.seconds = np.zeros(len(grid))
        self.is_coarse = np.zeros(len(grid), dtype=bool)
        self._seconds = np.full(self._rows.end, np.nan) if seconds is None else seconds
        self._rounds: dict[int, _Round] = {}
        self._share = plan.share()
        self._whole = plan.only_block() if self._share is None and self._samples is None else None
        values = values if values is not None and self._rows else self.total[:0]
        self.survey = replace(self._survey(values), failed=int(np.count_nonzero(self.status == int(Status.FAILED))))

    def _survey(self, rows: Rows) -> Survey:
        # Two ways for the sake of time: a million points take seconds, one after the other minutes.
        if self._whole is not None:
            return self._survey_of_whole_points(self._whole, rows)
        grid = self.plan.grid
        total = stored = pending = NOTHING
        groups: Groups = defaultdict(list)
        there = {key[:DIGEST_BYTES] for key in self._rows}
        for point in grid.points(None if self._share is None else np.array([*self._share], dtype=np.intp)):
            self.status[point.index] = Status.FAILED if point.digest in self._failed else Status.MISSING
            done, left, cost = NOTHING, NOTHING, self.plan.cost(point.parameters)
            if point.digest in there or self._share is not None or grid.study.counts:
                done, left = self._resume(point, rows)
            elif self._only is None or point.digest in self._only:  # else it perhaps cannot be computed
                left = self.plan.size(cost)
            total, stored = total + done + left, stored + done
            self.plan.check_size(total.blocks)
            if self._is_wanted(point):
                pending += left
                groups[point.stream].append((cost, left))
        if grid.study.draws_together:
            pending = replace(pending, cost=_cost_together(groups))
        return Survey(total, stored, pending)

    def _survey_of_whole_points(self, block: Block, ledger: Rows) -> Survey:
        """Add what the ledger holds of points that have one block each, many at a time: a million take seconds."""
        indices = self.plan.grid.indices()
        self.plan.check_size(len(indices))
        if not self._rows and not self._failed and self._only is None:
            self.status[indices] = MISSING
            new = self.plan.size(1.0, len(indices))
            return Survey(new, NOTHING, new)
        total = stored = pending = 0
        of_block = ledger_key(b"", block)
        for start in range(0, len(indices), AT_ONCE):
            some = indices[start : start + AT_ONCE]
            digests = self.plan.grid.digests(some)
            rows = np.array([self._rows.get(digest + of_block, -1) for digest in digests], dtype=np.intp)
            there, failed = rows >= 0, _among(digests, self._failed)
            done, missing = there & ~failed, ~there & ~failed & (self._only is None or _among(digests, self._only))
            self.status[some] = np.select([failed, done], [int(Status.FAILED), DONE], MISSING)
            self.realisations[some] = np.where(there, block.realisations, 0)
            self.seconds[some[there]] = self._seconds[rows[there]]
            self._put(some[done], ledger[rows[done]])
            stored, pending = stored + int(there.sum()), pending + int(missing.sum())
            total += int((missing | failed | there).sum())
        whole = self.plan.size
        return Survey(whole(1.0, total), whole(1.0, stored), whole(1.0, pending))

    def _resume(self, point: GridPoint, rows: Rows) -> tuple[PlanSize, PlanSize]:
        """Add what the ledger holds of a point; return how much that is, and how much is missing."""
        stored = left = NOTHING
        blocks = list(self.blocks(point))
        # Adding the last block of a round may show that a precision needs more: the list grows meanwhile.
        for block in blocks:
            key = ledger_key(point.digest, block)
            row = self._rows.get(key)
            size = PlanSize(0, 1, block.realisations, self.plan.work((point,), block).cost)
            if row is None:
                left += size
            else:
                stored += size
                kept = None if self._samples is None else self._samples(key)
                blocks += self.add(point, block, rows[row : row + 1], kept, float(self._seconds[row]))
        whole = PlanSize(1, 0, 0, 0.0)
        return (stored, left + whole) if left.blocks else (stored + whole, left)

    def missing(self, point: GridPoint) -> Sequence[Block]:
        """Return the blocks of a point, as far as they are known now, that the ledger did not hold at the start."""
        if not self._is_wanted(point):
            return ()
        if self._whole is not None:  # what the ledger holds is done
            return (self._whole,)
        return [b for b in self.blocks(point) if ledger_key(point.digest, b) not in self._rows]

    def missing_points(self) -> NDArray[np.intp]:
        """Return the indices of the points that are neither done nor given up now."""
        return np.flatnonzero(self.status == MISSING)

    def is_missing(self, index: int) -> bool:
        """Return whether a point is neither done nor given up."""
        return bool(self.status[index] == MISSING)

    def is_done(self, index: int) -> bool:
        """Return whether a point has all its blocks."""
        return bool(self.status[index] == DONE)

    def _is_wanted(self, point: GridPoint) -> bool:
        return self.is_missing(point.index) and (self._only is None or point.digest in self._only)

    def learn(self, experiment: Experiment) -> None:
        """Take what is known of an experiment from its first results, or from results of other types."""
        self.plan = self.plan.for_study(replace(self.plan.grid.study, experiment=experiment))
        self.reducer = experiment.reducer
        dtype = self.reducer.dtype
        self.total = converted(self.total, dtype)
        for round_ in self._rounds.values():
            round_.early = {place: (converted(row, dtype), kept) for place, (row, kept) in round_.early.items()}
            if round_.so_far is not None:
                round_.so_far = (converted(round_.so_far[0], dtype), *round_.so_far[1:])

    def add(
        self, point: GridPoint, block: Block, row: Rows, kept: Array | None = None, seconds: float = np.nan
    ) -> list[Block]:
        """Add a block's row, (1,), and realisations that are ``kept``; return blocks that are needed beyond those
        known.
        """
        index = point.index
        self.seconds[index] += seconds
        self.realisations[index] += block.realisations
        # where other parts of the study have blocks of a point, it is added up when they are merged
        if not self.is_missing(index) or (self._share is not None and self._share[index] is not None):
            return []
        cost, round_ = self.plan.cost(point.parameters), self._rounds.get(index)
        if round_ is None:
            round_ = self._rounds[index] = _Round(self.blocks(point))
        round_.early[block] = row, kept
        while round_.added < len(round_.blocks) and (next_one := round_.blocks[round_.added]) in round_.early:
            row, kept = round_.early.pop(next_one)
            self.total[index : index + 1] = self.reducer.add(self.total[index : index + 1], row)
            if kept is not None and self.reducer.samples_width:
                round_.kept.append(kept)
            round_.added += 1
            self._note_so_far(index, cost, round_, next_one)
        return self._finish_round(point, cost, round_) if round_.added == len(round_.blocks) else []

    def _note_so_far(self, index: int, cost: float, round_: _Round, block: Block) -> None:
        """Keep what was added up to a block if all catalogues begun have equally many realisations: their errors need
        that.
        """
        first, last = round_.blocks[0].part, round_.blocks[-1]
        if (block.group and block.part != last.part) or (first and last.group and round_.added < len(round_.blocks)):
            return
        n_sim, n_cat = self.plan.realisations(cost, block.part + 1), block.first_catalogue + block.n_cat
        round_.so_far = self.total[index : index + 1].copy(), n_sim * n_cat, n_cat

    def so_far(self) -> dict[int, SoFar]:
        """Return what points that are begun and not done have so far, by their index: a row, realisations, catalogues.

        Which of their blocks these are does not depend on what is in them: the first ones in order.
        """
        so_far = {}
        for index, round_ in sorted(self._rounds.items()):
            if round_.so_far is not None:
                row, n, n_cat = round_.so_far
                closed = self.reducer.close(row, np.concatenate(round_.kept)) if round_.kept else row
                so_far[index] = closed, n, n_cat
        return so_far

    def takes_whole(self) -> bool:
        """Return whether each point consists of one block, and needs its row alone."""
        return self._whole is not None and not self.reducer.samples_width

    def add_whole(self, points: Collection[int], rows: Rows, seconds: Array) -> None:
        """Add the only block of each of some points, by their indices, many at once."""
        indices = np.array([*points], dtype=np.intp)
        self.realisations[indices] += self.plan.grid.study.sampling.n_cat * self.plan.grid.study.sampling.n_sim
        self._put(indices, rows)
        self.seconds[indices] = seconds
        self.status[indices] = DONE

    def _put(self, indices: NDArray[np.intp], rows: Rows) -> None:
        """Set points that have one block each."""
        self.total[indices] = self.reducer.add(np.zeros(len(rows), dtype=rows.dtype), rows)

    def failing(self, indices: Sequence[int]) -> dict[int, Exception]:
        """Return those of the points whose results cannot be computed or are not finite, and why."""
        study = self.plan.grid.study
        n, n_cat = self.realisations[list(indices)].astype(float), np.full(len(indices), float(study.sampling.n_cat))
        try:
            results = study.experiment.reducer.finish(self.total[list(indices)], n, n_cat)
            check_finite(results, study.experiment.nan_outputs())
        except Exception as error:  # whatever a user's function raises
            # All points are finished in one call; halves find those that are to blame with few calls.
            if len(indices) == 1:
                return {indices[0]: error}
            half = len(indices) // 2
            return self.failing(indices[:half]) | self.failing(indices[half:])
        return {}

    def fail(self, index: int) -> None:
        """Mark a point as failed; none of its blocks is given out any more."""
        self.status[index] = Status.FAILED
        self._rounds.pop(index, None)

    def blocks(self, point: GridPoint) -> Sequence[Block]:
        """Return the blocks of a point's current round."""
        if self._share is not None and (share := self._share[point.index]) is not None:
            return share
        if (round_ := self._rounds.get(point.index)) is not None:
            return round_.blocks
        return self.plan.blocks(self.plan.cost(point.parameters), self.plan.parts_of(point))

    def _finish_round(self, point: GridPoint, cost: float, round_: _Round) -> list[Block]:
        """Mark a point as done, or begin another round if its precision needs one."""
        parts, kept = round_.blocks[-1].part + 1, round_.kept
        total = self.total[point.index : point.index + 1]
        if kept:
            total[:] = self.reducer.close(total, np.concatenate(kept))
        wanted, reached = self.plan.wanted_parts(cost, parts, total, round_.reached)
        if wanted > parts:
            round_.blocks, round_.added, round_.reached = self.plan.blocks(cost, range(parts, wanted)), 0, reached
            return list(round_.blocks)
        del self._rounds[point.index]
        self.status[point.index], self.is_coarse[point.index] = Status.DONE, not reached
        return []


def _cost_together(groups: Groups) -> float:
    """Return the cost of what is left to compute, for groups of points that share random numbers.  Each point has the
    cost of one realisation; the costliest draws the numbers, the others only use them (see `Plan.cost_of`).
    """
    total = 0.0
    for members in groups.values():
        for start in range(0, len(members), MOST_SHARING):
            (_, first), *others = sorted(members[start : start + MOST_SHARING], key=lambda one: -one[0])
            total += first.cost + sum(left.cost - (1.0 - SHARED) * cost * left.realisations for cost, left in others)
    return total


def _among(digests: Sequence[bytes], some: Collection[bytes]) -> NDArray[np.bool_]:
    """Return which of the digests are among some."""
    return np.array([digest in some for digest in digests], dtype=bool)


# Seconds of work that a task aims at.
TASK_S = 1.0

# Tasks that may end in a second: each takes schedulers and clients milliseconds, so more threads get longer tasks.
TASKS_PER_S = 200.0

# Shorter tasks would cost more to hand over than they gain by spreading the work.
SHORTEST_TASK_S = 0.05

# Weight of all earlier results in the measured speed when one more comes in: later points may be slower, and first
# calls in a process may have imported for seconds.
KEPT = 0.7


# Bytes of realisations that may be kept in memory of points that are begun and not done.
MOST_KEPT = 2**28

# Tasks at the executor for each thread: enough that none waits, few enough that no grid makes a large graph.
TASKS_IN_FLIGHT = 4


@dataclass
class Tuning:
    """The size of tasks, and how often a run writes.

    Args:
        most_blocks: the most blocks in one task, which bounds the size of its messages.
        flush_every_s: seconds after which new results are made durable, when others arrive.
        latest_flush_s: seconds after which they are made durable even if no others arrive.
        write_every_s: seconds after which the dataset is written again during a run.
        write_share: the share of a run's time that these writes may take, besides the first ``early_writes_s``.
        long_write_bytes: size of a dataset that takes a second or more to write: an interruption does not wait for it.
        long_write_points: the same, in points.
    """

    most_blocks: int = 1000
    flush_every_s: float = 1.0
    latest_flush_s: float = 2.0
    write_every_s: float = 5.0
    write_share: float = 0.05
    early_writes_s: float = 0.5
    long_write_bytes: int = 2**26
    long_write_points: int = 100_000


# What runs use.
TUNED = Tuning()


def task_seconds(threads: float) -> float:
    """Return the seconds of work that a task aims at when this many threads compute.

    >>> task_seconds(2), task_seconds(40_000)
    (1.0, 200.0)
    """
    return max(TASK_S, threads / TASKS_PER_S)


# Blocks that some points need, and the points: of each block, or all of them.
Team = tuple[Sequence[Block], tuple[GridPoint, ...] | Mapping[Block, Sequence[GridPoint]]]


class Pending:
    """Gives out the blocks that an accumulator misses.

    The cost that an experiment declares says only how tasks compare: how long they take is measured (`settle`).  Until
    the first result is in, each task holds one block.
    """

    def __init__(self, plan: Plan, accumulator: Accumulator) -> None:
        self._plan, self._accumulator = plan, accumulator
        self._known: deque[Work] = deque()  # comes before all other work
        self._added: deque[Work] = deque()
        self._fresh = self._in_turns()
        self._left = accumulator.survey.pending.cost
        self._tasks_out = 0
        self._measured_cost = self._measured_s = 0.0

    def add(self, works: Iterable[Work]) -> None:
        """Add work that results have shown to be needed; it comes when all points have had what they need at first."""
        for work in works:
            self._added.append(work)
            self._left += work.cost

    def take(self, count: int, most_blocks: int | None = None) -> list[list[Work]]:
        """Return up to ``count`` tasks' work, of at most so many blocks each."""
        most = min(most_blocks or TUNED.most_blocks, TUNED.most_blocks)
        tasks: list[list[Work]] = []
        while len(tasks) < count and (task := self._task(most)):
            tasks.append(task)
            self._tasks_out += 1
        return tasks

    def settle(self, works: Sequence[Work], seconds: Array) -> list[Work]:
        """Note the ``seconds``, (rows,), that each point of each block of a task took; return the computed blocks.

        There may be fewer seconds than points: a worker stops where a task takes too long.  The rest is pending again.
        """
        rows = list(accumulate(len(work.points) for work in works))
        done = bisect_right(rows, len(seconds))
        for work in reversed(works[done:]):
            self._known.appendleft(work)
            self._left += work.cost
        self._tasks_out = max(0, self._tasks_out - 1)
        self._measured_cost = KEPT * self._measured_cost + sum(work.cost for work in works[:done])
        self._measured_s = KEPT * self._measured_s + float(seconds.sum())
        return list(works[:done])

    def _task(self, most_blocks: int) -> list[Work]:
        task: list[Work] = []
        cost, most = 0.0, self._task_cost()
        while len(task) < most_blocks and (work := self._next()) is not None:
            if task and cost + work.cost > most:
                self._known.appendleft(work)
                break
            task.append(work)
            cost += work.cost
        self._left = max(0.0, self._left - cost)
        return task

    def _task_cost(self) -> float:
        """Return the cost of the next task: `task_seconds`, or less near the end, when all threads share what is left.

        The executor has as many tasks as keep it busy (four for each worker thread on Dask), so each gets at most an
        equal share of the rest.
        """
        if not self._measured_cost:
            return 0.0
        per_second = self._measured_cost / max(self._measured_s, 1e-9)
        aim = task_seconds(self._tasks_out / TASKS_IN_FLIGHT) * per_second
        cost = max(min(aim, self._left / (self._tasks_out + 1)), SHORTEST_TASK_S * per_second)
        # Samples are as large as the random numbers that make them, and travel in one message.
        return min(cost, TARGET) if self._plan.grid.study.keeps_samples else cost

    def _next(self) -> Work | None:
        known = next(self._wanted(self._known), None) if self._known else None
        return known or next(self._fresh, None) or next(self._wanted(self._added), None)

    def _wanted(self, works: deque[Work]) -> Iterator[Work]:
        """Take works; yield them without the points that have failed meanwhile."""
        while works:
            yield from self._work(*works.popleft()[:2])

    def _in_turns(self) -> Iterator[Work]:
        """Yield the work of all points in turns: one block of each at first, then two more, then four.

        So all points have values early that are about equally good, and the blocks of a point mostly come together.
        Points begin in a nested order, and no more of them than fit into memory; others begin when these are done.
        """
        teams, is_last = self._teams(), False
        while not is_last:
            begun, done, is_last = list[Team](), 1, True
            for team in teams:
                yield from self._works(team, 0, 1)
                if len(team[0]) > 1:
                    begun.append(team)
                    if len(begun) >= self._most_begun():
                        is_last = False
                        break
            while begun:
                for team in begun:
                    yield from self._works(team, done, 2 * done + 1)
                done = 2 * done + 1
                begun = [team for team in begun if len(team[0]) > done]
            yield from self._wanted(self._added)

    def _most_begun(self) -> int:
        sampling, width = self._plan.grid.study.sampling, self._accumulator.reducer.samples_width
        return max(1, min(AT_ONCE, MOST_KEPT // max(1, 8 * width * sampling.n_sim)))

    def _teams(self) -> Iterator[Team]:
        """Yield points that draw the same random numbers together, all others alone."""
        grid, missing = self._plan.grid, self._accumulator.missing
        order = grid.coarse_first(self._accumulator.missing_points())
        if not grid.study.draws_together:
            yield from ((missing(point), (point,)) for point in grid.points(order))
            return
        groups: dict[bytes, list[int]] = {}
        for point in grid.points(order):
            groups.setdefault(point.stream, []).append(point.index)
        for indices in map(sorted, groups.values()):
            for start in range(0, len(indices), MOST_SHARING):
                wanting: dict[Block, list[GridPoint]] = {}
                for point in grid.points(np.array(indices[start : start + MOST_SHARING])):
                    for block in missing(point):
                        wanting.setdefault(block, []).append(point)
                yield sorted(wanting), wanting

    def _works(self, team: Team, first: int, last: int) -> Iterator[Work]:
        """Yield the work of some blocks of a team, without the points that have failed meanwhile."""
        blocks, wanting = team
        for block in blocks[first:last]:
            yield from self._work(wanting if isinstance(wanting, tuple) else wanting[block], block)

    def _work(self, points: Iterable[GridPoint], block: Block) -> Iterator[Work]:
        """Yield the work of a block of points without those that have failed meanwhile; none if all have."""
        if left := tuple([point for point in points if self._accumulator.is_missing(point.index)]):
            yield self._plan.work(left, block)
