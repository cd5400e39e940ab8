"""How long a run still takes, from the results that came so far: by cost of work, with start-up excluded."""

import math
from bisect import bisect_right, insort
from dataclasses import dataclass

from linksweep.sweep.executing.task import TaskResult

OVERLAP = 0.25
"""A task may seem to begin this fraction of its length before the last one on its worker ended: results come late."""

SILENT = 5.0
"""A worker without a result for so many times the longest task counts as gone."""


@dataclass(order=True)
class _Lane:
    """One worker as its results show it: tasks that follow one another, ``busy`` seconds of work in all."""

    end: float
    begin: float
    busy: float


class Eta:
    """Estimates the time left, with all times in seconds of one clock.

    Which results can come from one worker is inferred from their times; there are at most ``workers`` workers if that
    is known.  The time since a worker's last result counts as work under way.  A first call in a process may have
    imported modules: it tells nothing of what is left.

    Example: two of ten tasks have come from one worker, which takes 3 s for each.

    >>> eta = Eta(cost=10.0, workers=1)
    >>> eta.take(now=3.0, cost=1.0, seconds=3.0)
    >>> eta.take(now=6.0, cost=1.0, seconds=3.0)
    >>> eta.left(now=6.0)
    24.0
    """

    def __init__(self, cost: float, workers: int | None = None) -> None:
        """Start with the ``cost`` of all work that is known."""
        self._known = cost
        self._workers = math.inf if workers is None else max(1, workers)
        self._done = self._cost = self._busy = self._longest = 0.0
        self._tasks = 0
        self._lanes: list[_Lane] = []

    def extend(self, cost: float) -> None:
        """Add work that was not known before."""
        self._known += cost

    def take_result(self, now: float, cost: float, result: TaskResult) -> None:
        """Count a task's result that came ``now``."""
        cold = float(result.seconds[0]) if result.cold else 0.0
        self.take(now, cost, float(result.seconds.sum()), cold, len(result.seconds))

    def take(self, now: float, cost: float, seconds: float, cold: float = 0.0, rows: int = 1) -> None:
        """Count a task's result that came ``now`` after ``seconds`` on its worker; ``cold`` of them for the first of
        its ``rows``, which may have imported modules.
        """
        seconds = max(seconds, 1e-9)
        self._done += cost
        if not (usual := 1.0 - (1.0 / rows if cold else 0.0)):
            return  # nor is its worker known to go on at once: the first write of a run imports too
        self._cost += usual * cost
        self._busy += max(seconds - cold, 1e-9)
        self._tasks += 1
        self._longest = max(self._longest, seconds - cold)
        begin = now - seconds
        free = bisect_right(self._lanes, begin + OVERLAP * seconds, key=lambda lane: lane.end)
        if free or len(self._lanes) >= self._workers:
            lane = self._lanes.pop(max(0, free - 1))
            lane = _Lane(now, lane.begin, lane.busy + seconds)
        else:
            lane = _Lane(now, begin, seconds)
        insort(self._lanes, lane)

    def left(self, now: float) -> float | None:
        """Return the seconds left, never negative; None while nothing is known but the time of first calls."""
        if not self._tasks:
            return None
        lanes = [lane for lane in self._lanes if now - lane.end <= SILENT * self._longest] or self._lanes[-1:]
        share = sum(lane.busy for lane in lanes) / sum(max(lane.end - lane.begin, lane.busy) for lane in lanes)
        under_way = sum(min(max(now - lane.end, 0.0), self._longest) for lane in lanes) * share
        needed = max(self._known - self._done, 0.0) * self._busy / max(self._cost, 1e-9)
        at_once = min(float(len(lanes)), max(1.0, needed * self._tasks / self._busy))
        return max(needed - under_way, needed / 2) / (at_once * share)


def in_words(seconds: float) -> str:
    """Return a duration with two of its units.

    >>> [in_words(seconds) for seconds in (12.3, 200, 7500, 273600)]
    ['12 s', '3 min 20 s', '2 h 05 min', '3 d 4 h']
    """
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02} s"
    if whole < 86400:
        return f"{whole // 3600} h {whole % 3600 // 60:02} min"
    return f"{whole // 86400} d {whole % 86400 // 3600} h"
