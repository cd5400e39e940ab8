"""The pending work of a run, given out in tasks of a good size, in the order of the grid."""

from collections import deque
from collections.abc import Iterable, Iterator

from sweep.planning.accumulator import MISSING, Accumulator
from sweep.planning.grid import GridPoint
from sweep.planning.plan import MOST_SHARING, TARGET, Block, Plan, Work


class Pending:
    """Gives out the blocks that a accumulator misses."""

    def __init__(self, plan: Plan, accumulator: Accumulator) -> None:
        self._plan, self._accumulator = plan, accumulator
        self._known: deque[Work] = deque()
        self._fresh = self._shared() if plan.grid.study.sampling.common_random_numbers else self._alone()

    def add(self, works: Iterable[Work]) -> None:
        """Put work that results made known before all other."""
        self._known.extend(works)

    def take(self, count: int) -> list[list[Work]]:
        """Return up to ``count`` tasks' work of about `TARGET` random numbers each."""
        tasks: list[list[Work]] = []
        while len(tasks) < count and (task := self._task()):
            tasks.append(task)
        return tasks

    def _task(self) -> list[Work]:
        task: list[Work] = []
        cost = 0.0
        while (work := self._next()) is not None:
            if task and cost + work.cost > TARGET:
                self._known.appendleft(work)
                break
            task.append(work)
            cost += work.cost
        return task

    def _next(self) -> Work | None:
        while self._known:
            work = self._known.popleft()
            if any(self._accumulator.status[point.index] == MISSING for point in work.points):
                return work
        return next(self._fresh, None)

    def _alone(self) -> Iterator[Work]:
        """Yield the work of every point by itself; no more of one that has failed meanwhile."""
        for point in self._plan.grid.points():
            for block in self._accumulator.missing(point):
                if self._accumulator.status[point.index] != MISSING:
                    break
                yield self._plan.work((point,), block)

    def _shared(self) -> Iterator[Work]:
        """Yield the work of points that draw the same random numbers together."""
        grid = self._plan.grid
        groups: dict[bytes, list[int]] = {}
        for point in grid.points():
            if self._accumulator.status[point.index] == MISSING:
                groups.setdefault(point.stream, []).append(point.index)
        for indices in groups.values():
            for start in range(0, len(indices), MOST_SHARING):
                points = [grid.point(index) for index in indices[start : start + MOST_SHARING]]
                wanting: dict[Block, list[GridPoint]] = {}
                for point in points:
                    for block in self._accumulator.missing(point):
                        wanting.setdefault(block, []).append(point)
                for block in sorted(wanting):
                    if left := [p for p in wanting[block] if self._accumulator.status[p.index] == MISSING]:
                        yield self._plan.work(tuple(left), block)
