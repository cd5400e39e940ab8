"""What a run took: realisations, work, time; which points took longest, what they warned of."""

import heapq
from array import array
from collections import Counter
from collections.abc import Mapping, Sequence

from linksweep.sweep.executing.task import TaskResult
from linksweep.sweep.formatting import counted, per_second
from linksweep.sweep.planning.grid import GridPoint, describe
from linksweep.sweep.planning.plan import PlanSize, Work
from linksweep.sweep.running.eta import in_words
from linksweep.sweep.running.failures import short
from linksweep.sweep.studies.study import Study

NAMED = 5
"""Most warnings that are named."""

SLOWEST = 3
"""Most of the slowest points that are named."""

MUCH_SLOWER, WORTH_SAYING_S = 3.0, 1.0
"""A point is slow if it takes more than so many times the median of all points, and more than so many seconds."""


class RunSummary:
    """Adds up what a run took from its results."""

    def __init__(self, study: Study) -> None:
        self.done = PlanSize(0, 0, 0, 0.0)
        self.busy = 0.0
        self._study = study
        self._seconds = array("d")  # by the point's index: a dictionary would be large for a large grid
        self._slowest: dict[int, GridPoint] = {}
        self._warnings: Counter[str] = Counter()
        self._first_warned: dict[str, str] = {}

    def take(self, works: Sequence[Work], result: TaskResult, done: PlanSize) -> None:
        """Count a task's result."""
        self.done += done
        points = [point for work in works for point in work.points]
        self.busy += float(result.seconds.sum())
        for point, seconds in zip(points[result.cold :], result.seconds[result.cold :].tolist(), strict=True):
            if point.index >= len(self._seconds):
                self._seconds.extend([0.0] * (point.index + 1 - len(self._seconds)))
            self._seconds[point.index] += seconds
            self._slowest[point.index] = point
            if len(self._slowest) > 40 * SLOWEST:
                self._slowest = {index: self._slowest[index] for index in self._slowest_indices()}

    def _slowest_indices(self) -> list[int]:
        return heapq.nlargest(SLOWEST, self._slowest, key=self._seconds.__getitem__)

    def summary(self, elapsed: float, failed: int = 0) -> list[str]:
        """Return what there is to say at the end of a run that took ``elapsed`` seconds, in which so many points
        ``failed``; nothing if it did nothing.
        """
        if not self.done.blocks:
            return []
        experiment = self._study.experiment
        once = experiment.deterministic
        points = self.done.points - failed
        number, noun = (self.done.points, "points") if once else (self.done.realisations, "realisations")
        realisations = "" if once else f" and {counted(self.done.realisations, 'realisation')}"
        took = f"{elapsed:.2g} s" if elapsed < 10.0 else in_words(elapsed)
        lines = [
            f"{counted(points, 'point')}{realisations}{f' done, {failed:,} failed,' if failed else ''} in {took}: "
            f"{per_second(number, elapsed, noun)}, {self.busy:,.1f} s of work by all workers together"
        ]
        if slow := self._much_slower():
            lines.append(f"slowest: {'; '.join(slow)}")
        return lines

    def _much_slower(self) -> list[str]:
        """Return which points took much longer than most did, and how long; none where all took about as long."""
        taken = sorted(seconds for seconds in self._seconds if seconds > 0.0)
        if len(taken) < 2:
            return []
        least = max(MUCH_SLOWER * taken[len(taken) // 2], WORTH_SAYING_S)
        return [
            f"{describe(self._study, self._slowest[index].parameters)} {in_words(self._seconds[index])}"
            for index in self._slowest_indices()
            if self._seconds[index] > least
        ]

    def warned(self, place: str, warnings: Mapping[str, int]) -> None:
        """Count warnings that came up at a point."""
        self._warnings.update(warnings)
        for text in warnings:
            self._first_warned.setdefault(text, place)

    def warnings(self) -> list[str]:
        """Return a line for each different warning: how often, and where first."""
        lines = [
            f"warned {'once' if n == 1 else f'{n:,} times, first'} at {self._first_warned[text]}: {short(text)}"
            for text, n in self._warnings.most_common(NAMED)
        ]
        more = len(self._warnings) - NAMED
        return [*lines, f"warned of {more} other things"] if more > 0 else lines
