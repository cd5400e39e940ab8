"""What a run took: realisations, work, time; which points took longest, which failed."""

import heapq
from array import array
from collections import Counter
from collections.abc import Sequence

from sweep.executing.worker import TaskResult
from sweep.formatting import counted
from sweep.planning.grid import GridPoint, describe
from sweep.planning.plan import PlanSize, Work
from sweep.running.eta import in_words
from sweep.studies.study import Study

NAMED = 5
"""So many of the slowest points are named."""


class RunSummary:
    """Adds up a run from its results."""

    def __init__(self, study: Study) -> None:
        """Start with nothing done."""
        self.done = PlanSize(0, 0, 0, 0.0)
        self.busy = 0.0
        self._study = study
        self._failed: dict[int, str] = {}
        self._seconds = array("d")  # by the point's index: a dictionary would be large for a large grid
        self._slowest: dict[int, GridPoint] = {}

    def take(self, works: Sequence[Work], result: TaskResult, done: PlanSize) -> None:
        """Count a task's result."""
        self.done += done
        points = [point for work in works for point in work.points]
        self.busy += float(result.seconds.sum())
        for number, (point, seconds) in enumerate(zip(points, result.seconds.tolist(), strict=True)):
            self._count(point, seconds)
            if (failure := result.failures.get(number)) is not None:
                self._failed.setdefault(point.index, failure.kind)

    def _count(self, point: GridPoint, seconds: float) -> None:
        if point.index >= len(self._seconds):
            self._seconds.extend([0.0] * (point.index + 1 - len(self._seconds)))
        self._seconds[point.index] += seconds
        self._slowest[point.index] = point
        if len(self._slowest) > 20 * NAMED:
            self._slowest = {index: self._slowest[index] for index in self._slowest_indices()}

    def _slowest_indices(self) -> list[int]:
        return heapq.nlargest(NAMED, self._slowest, key=self._seconds.__getitem__)

    def summary(self, elapsed: float) -> list[str]:
        """Return what there is to say at the end of a run that took ``elapsed`` seconds; nothing if it did nothing."""
        if not self.done.blocks:
            return []
        rate = self.done.realisations / max(elapsed, 1e-9)
        took = f"{elapsed:.2g} s" if elapsed < 10.0 else in_words(elapsed)
        lines = [
            f"{counted(self.done.points, 'point')} and {counted(self.done.realisations, 'realisation')} in {took}: "
            f"{rate:,.0f} realisations/s, {self.busy:,.1f} s of work by all workers together, "
            f"worth {self.done.cost:.2g} random numbers"
        ]
        if len(self._seconds) > 1:
            slowest = (
                f"{describe(self._study, self._slowest[index].parameters)} {self._seconds[index]:.2g} s"
                for index in self._slowest_indices()
            )
            lines.append(f"slowest: {'; '.join(slowest)}")
        return lines

    def kinds(self) -> str:
        """Return in words how points failed in this run: '2 exception, 1 killed'."""
        return ", ".join(f"{n} {kind}" for kind, n in sorted(Counter(self._failed.values()).items()))
