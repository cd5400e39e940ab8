"""The pending work of a run, given out in tasks of about a second, as measured: the whole grid coarsely at first, and a
few realisations of every point; no result depends on how.
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from linksweep.sweep.contract import Array
from linksweep.sweep.contract.rows import Block
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import AT_ONCE, GridPoint
from linksweep.sweep.planning.plan import MOST_SHARING, TARGET, Plan, Work

# Seconds of work that a task aims at.
TASK_S = 1.0

# Tasks that may end in a second: each takes schedulers and clients milliseconds, so more threads get longer tasks.
TASKS_PER_S = 200.0

# Shorter tasks would cost more to hand over than they gain by spreading the work.
SHORTEST_TASK_S = 0.05

# Weight of all earlier results in the measured speed when one more comes in: later points may be slower.
KEPT = 0.7


# Bytes of realisations that may be kept in memory of points that are begun and not done.
MOST_KEPT = 2**28

# Tasks at the executor for each thread: enough that none waits, few enough that no grid makes a large graph.
TASKS_IN_FLIGHT = 4


@dataclass(frozen=True)
class Tuning:
    """The size of tasks, and how often a run writes.

    Args:
        most_blocks: the most blocks in one task, which bounds the size of its messages.
        flush_every_s: seconds after which new results are made durable, when others arrive.
        latest_flush_s: seconds after which they are made durable even if no others arrive.
        write_every_s: seconds after which the dataset is written again during a run.
        early_write: the same as a share of the time since its begin, while that is less, but at least a second.
        write_share: the share of a run's time that these writes may take, besides the first ``early_writes_s``.
        long_write_bytes: size of a dataset that takes a second or more to write: an interruption does not wait for it.
        long_write_points: the same, in points.
    """

    most_blocks: int = 1000
    flush_every_s: float = 1.0
    latest_flush_s: float = 2.0
    write_every_s: float = 5.0
    early_write: float = 0.25
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

    def __init__(self, plan: Plan, accumulator: Accumulator, tuning: Tuning = TUNED) -> None:
        self._plan, self._accumulator, self.most_blocks = plan, accumulator, tuning.most_blocks
        self._known: deque[Work] = deque()  # comes before all other work
        self._added: deque[Work] = deque()
        self._fresh = self._in_turns()
        self._left = accumulator.survey.pending.cost
        self._begun = self._warm = False
        self._tasks_out = 0
        self._measured_cost = self._measured_s = 0.0

    def add(self, works: Iterable[Work]) -> None:
        """Add work that results have shown to be needed; it comes when all points have had what they need at first.

        Before the first `take` only its cost is counted: it is found then with all other work that is missing.
        """
        for work in works:
            if self._begun:
                self._added.append(work)
            self._left += work.cost

    def take(self, count: int) -> list[list[Work]]:
        """Return up to ``count`` tasks' work."""
        self._begun = True
        tasks: list[list[Work]] = []
        while len(tasks) < count and (task := self._task()):
            tasks.append(task)
            self._tasks_out += 1
        return tasks

    def settle(self, works: Sequence[Work], seconds: Array, cold: bool = False) -> list[Work]:
        """Note the ``seconds``, (rows,), that each point of each block of a task took, the first of them perhaps for
        imports if it was ``cold``; return the computed blocks.

        There may be fewer seconds than points: a worker stops where a task takes too long.  The rest is pending again.
        """
        rows = list(accumulate(len(work.points) for work in works))
        done = bisect_right(rows, len(seconds))
        for work in reversed(works[done:]):
            self._known.appendleft(work)
            self._left += work.cost
        self._tasks_out = max(0, self._tasks_out - 1)
        usual = works[int(cold) : done]
        if usual or not self._warm:
            # A first call in a process may have imported for seconds: it tells nothing beside others.
            kept = KEPT if self._warm or not usual else 0.0
            skipped = rows[0] if cold and usual else 0
            self._warm |= bool(usual)
            self._measured_cost = kept * self._measured_cost + sum(work.cost for work in usual or works[:done])
            self._measured_s = kept * self._measured_s + float(seconds[skipped:].sum())
        return list(works[:done])

    def _task(self) -> list[Work]:
        task: list[Work] = []
        cost, most = 0.0, self._task_cost()
        while len(task) < self.most_blocks and (work := self._next()) is not None:
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
        """Take works; yield those of points that have not failed meanwhile."""
        while works:
            work = works.popleft()
            if any(self._accumulator.is_missing(point.index) for point in work.points):
                yield work

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
            points = wanting if isinstance(wanting, tuple) else wanting[block]
            if left := tuple([point for point in points if self._accumulator.is_missing(point.index)]):
                yield self._plan.work(left, block)
