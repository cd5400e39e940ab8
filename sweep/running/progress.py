"""What is shown of a run: how far it is, the time left, what failed, and at the end what it took."""

import logging
import math
import sys
import time
from array import array
from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from html import escape
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from linksweep.sweep import table_writer
from linksweep.sweep.executing.task import TaskResult
from linksweep.sweep.formatting import counted, harmless, in_words, per_second
from linksweep.sweep.interrupt import how_ended
from linksweep.sweep.planning.grid import Grid, describe
from linksweep.sweep.planning.plan import PlanSize, Survey, Work
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.running.failures import FailureCount, failed_before, failed_points, short
from linksweep.sweep.running.writer import Taken
from linksweep.sweep.studies.study import Study

SENTENCES = logging.getLogger("linksweep")
"""Messages to the user and to the log file, with a debug message for each point."""

RECORD = logging.getLogger("linksweep.record")
"""Messages to the log file alone, such as the traceback of each point that fails."""

LINE_FIRST_S, LINE_LAST_S, LINE_SHARE = 5.0, 600.0, 0.1
"""The time between two lines grows with the time that the run has taken, between these bounds."""

NOTEBOOK_S = 0.5
"""The least time between two updates of the line in a notebook."""

SLOWEST = 3
"""Most of the slowest points that are named."""

MUCH_SLOWER, WORTH_SAYING_S = 3.0, 1.0
"""A point is slow if it takes more than so many times the median of all points, and more than so many seconds."""

NAMED = 5
"""Most warnings that are named."""

MOST_LINES = 15
"""Most lines for one axis in a text."""

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
        self._lanes: list[_Lane] = []  # sorted by their end

    def extend(self, cost: float) -> None:
        """Add work that was not known before."""
        self._known += cost

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
        # The task followed the last one that ended before it began; where no lane is free there is a new worker.
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
        at_once = min(float(len(lanes)), max(1.0, needed * self._tasks / self._busy))  # the last tasks leave some idle
        return max(needed - under_way, needed / 2) / (at_once * share)


class _Watch:
    """What every way to show a run knows of it: when it began, its points by outcome, and the time left."""

    def __init__(self, study: Study) -> None:
        self._study = study
        self._begun: float | None = None

    def start(self, survey: Survey, where: str, workers: int | None = None) -> None:
        """Begin: there is so much to do, at the place that ``where`` names."""
        self._begun = self._shown = time.monotonic()
        self._where = where
        self._eta = Eta(survey.pending.cost, workers)
        total = survey.total.points
        self._count = FailureCount(self._study, total, total - survey.pending.points, survey.failed)

    def _take(self, result: TaskResult, taken: Taken) -> list[str]:
        """Count a task's result; return a sentence for each new reason to fail."""
        cold = float(result.seconds[0]) if result.cold else 0.0
        self._eta.extend(taken.more.cost)
        seconds = float(result.seconds.sum())
        self._eta.take(time.monotonic(), taken.done.cost, seconds, cold, len(result.seconds))
        return self._count.take(taken.ended, taken.failed)

    def _left(self) -> list[str]:
        left = self._eta.left(time.monotonic())
        return [] if left is None else [f"about {in_words(left)} left"]


class TerminalProgress(_Watch):
    """Shows points done, time left and speed: in a ``bar`` if there is a terminal, else in a line now and then."""

    def __init__(self, study: Study, bar: bool = True) -> None:
        super().__init__(study)
        self._once = study.experiment.deterministic
        self._console = Console(file=getattr(sys.stderr, "unescaped", sys.stderr))
        self._with_bar = bar and self._console.is_terminal
        self._bar: Live | None = None
        self._done = PlanSize(0, 0, 0, 0.0)
        self._seconds = array("d")  # by the point's index: a dictionary would be large for a large grid
        self._busy = 0.0
        self._warned: Counter[str] = Counter()
        self._first_warned: dict[str, str] = {}

    def __enter__(self) -> "TerminalProgress":
        return self

    def __exit__(self, *_error: object) -> None:
        self.written()

    def start(self, survey: Survey, where: str, workers: int | None = None) -> None:
        """Say what there is to do and where it is done."""
        super().start(survey, where, workers)
        total, pending = survey.total, survey.pending
        self._work = pending.cost
        done = self._count.done
        kept = f", {done:,} of them in the store already" if done else ""
        begun = total.points == pending.points and total.blocks > pending.blocks
        kept += failed_before(survey.failed) + (", part of the realisations too" if begun else "")
        self.say(f"{counted(total.points, 'point')}{kept}; {self._counted(pending)} to do on {where}")
        if self._with_bar and pending.blocks:
            self._bar = Live(get_renderable=self._drawn, console=self._console, transient=True)
            self._bar.start()

    def advance(self, works: Sequence[Work], result: TaskResult, taken: Taken) -> None:
        """Count what was done, and what more there is to do."""
        assert self._begun is not None, "a run starts before it advances"
        for sentence in self._take(result, taken):
            SENTENCES.warning(sentence)
        self._work += taken.more.cost
        self._done += taken.done
        self._busy += float(result.seconds.sum())
        points = [point for work in works for point in work.points]
        for point, seconds in zip(points[result.cold :], result.seconds[result.cold :].tolist(), strict=True):
            self._seconds.extend([0.0] * (point.index + 1 - len(self._seconds)))
            self._seconds[point.index] += seconds
        for row, said in result.said.items():
            place = describe(self._study, points[row].parameters)
            self._warned.update(said.warnings)
            self._first_warned = dict.fromkeys(said.warnings, place) | self._first_warned
            for line in said.printed.splitlines():
                RECORD.info("%s: printed: %s", place, line)
        if taken.failed or SENTENCES.isEnabledFor(logging.DEBUG):
            self._say_points(taken)
        now = time.monotonic()
        if now - self._shown > min(max(LINE_FIRST_S, LINE_SHARE * (now - self._begun)), LINE_LAST_S):
            self._shown = now
            (SENTENCES if self._bar is None else RECORD).info(self._line())

    def written(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _say_points(self, taken: Taken) -> None:
        for point in taken.ended:
            place = describe(self._study, point.parameters)
            if (failure := taken.failed.get(point.index)) is not None:
                SENTENCES.debug("%s: failed (%s)", place, failure.kind)
                RECORD.error("%s: failed (%s): %s\n%s", place, failure.kind, failure.message, failure.traceback)
            else:
                SENTENCES.debug("%s: done", place)

    def say(self, text: str) -> None:
        """Tell the user a sentence."""
        SENTENCES.info(text)

    def stopped(self, signal: str, store: object) -> None:
        """Say what an interrupted run leaves, and how to go on."""
        self.written()
        done = "nothing was begun"
        if self._begun is not None:
            failed = self._count.failed_here
            kept = self._counted(self._done, failed)
            done = f"{kept} of this run {'is' if kept.startswith('1 ') else 'are'} kept in {store}"
            done += f", {counted(failed, 'point')} failed" if failed else ""
        SENTENCES.error(f"{how_ended(signal)}; {done}; the same command goes on from there")

    def finish(self, failures: Mapping[str, str], store: object, commands: Sequence[str] = ()) -> None:
        """Say what the run took, why points failed (``failures`` by their place), and which ``commands`` come next."""
        self.written()
        if self._begun is not None:
            further = f"; next: {', '.join(commands)}" if commands and not failures else ""
            for line in (*self.summary(time.monotonic() - self._begun), f"wrote {store}{further}"):
                self.say(line)
            for text, n in self._warned.most_common(NAMED):
                often = "once" if n == 1 else f"{n:,} times, first"
                SENTENCES.warning(f"warned {often} at {self._first_warned[text]}: {short(text)}")
            if (more := len(self._warned) - NAMED) > 0:
                SENTENCES.warning(f"warned of {more} other things")
        if failures:
            SENTENCES.error(
                f"{failed_points(failures)}; "
                f"`sweep status {store}` names them and says why, `sweep run --retry {store}` tries them again, "
                f"`sweep reproduce {store} --at POINT` runs one here"
            )

    def summary(self, elapsed: float) -> list[str]:
        """Return what there is to say at the end of a run that took ``elapsed`` seconds; nothing if it did nothing."""
        if not self._done.blocks:
            return []
        failed = self._count.failed_here
        realisations = "" if self._once else f" and {counted(self._done.realisations, 'realisation')}"
        took = f"{elapsed:.2g} s" if elapsed < 10.0 else in_words(elapsed)
        lines = [
            f"{counted(self._done.points - failed, 'point')}{realisations}"
            f"{f' done, {failed:,} failed,' if failed else ''} in {took}: "
            f"{self._speed(elapsed)}, {self._busy:,.1f} s of work by all workers together"
        ]
        taken = np.array(self._seconds)
        if np.count_nonzero(taken) > 1:
            least = max(MUCH_SLOWER * float(np.median(taken[taken > 0.0])), WORTH_SAYING_S)
            slowest = [i for i in np.argsort(-taken, kind="stable")[:SLOWEST].tolist() if taken[i] > least]
            points = Grid(self._study).points(np.array(slowest, dtype=np.intp))
            slow = [f"{describe(self._study, p.parameters)} {in_words(taken[p.index])}" for p in points]
            lines += [f"slowest: {'; '.join(slow)}"] if slow else []
        return lines

    def _counted(self, size: PlanSize, failed: int = 0) -> str:
        return counted(size.points - failed, "point") if self._once else counted(size.realisations, "realisation")

    def _speed(self, elapsed: float) -> str:
        number, noun = (self._done.points, "points") if self._once else (self._done.realisations, "realisations")
        return per_second(number, elapsed, noun)

    def _line(self) -> str:
        """Return how far the run is: points, time left, speed.  What matters most comes first: a terminal cuts it."""
        assert self._begun is not None, "a run starts before it is described"
        percent = 100.0 * self._done.cost / self._work if self._work > 0.0 and not self._once else None
        share = "" if percent is None else f" ({percent:.0f} % of the work)"
        return ", ".join([f"{self._count}{share}", *self._left(), self._speed(time.monotonic() - self._begun)])

    def _drawn(self) -> Table:
        """Return the bar and its line, with what failed in red and the first reason as far as there is room."""
        words = self._count.failed_in_words
        line = Text(self._line(), no_wrap=True, overflow="ellipsis")
        line.highlight_words([words] if words else [], style="bold red")
        line.append(f"; {self._count.reason}" if words and self._count.reason else "", style="red")
        grid = Table.grid(padding=(0, 1))
        grid.add_row(ProgressBar(max(self._work, 1e-9), self._done.cost, width=24), line)
        return grid


class Sentences(logging.Handler):
    """Writes to the present standard error, which a bar replaces so that it stays below the lines."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line; if the terminal is closed, nobody can read it and the error is ignored."""
        with suppress(OSError, ValueError):
            print(harmless(self.format(record)), file=sys.stderr, flush=True)


def in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return shell is not None and hasattr(shell, "kernel")


class NotebookProgress(_Watch):
    """Shows a bar, points done and failed, and the time left, in a line below the cell that runs."""

    _handle: Any = None

    def start(self, survey: Survey, where: str, workers: int | None = None) -> None:
        """Show that work begins."""
        super().start(survey, where, workers)
        self._show()

    def advance(self, works: Sequence[Work], result: TaskResult, taken: Taken) -> None:
        """Count a task's results."""
        self._take(result, taken)
        if time.monotonic() - self._shown > NOTEBOOK_S:
            self._show()

    def written(self) -> None:
        """Show the end."""
        self._show(["done" if self._count.done == self._count.points else "ended"])

    def say(self, text: str) -> None:
        """Show a warning; other sentences are for terminals."""
        if text.startswith("warning"):
            print(harmless(text), file=sys.stderr)

    def _show(self, state: Sequence[str] = ()) -> None:
        from IPython.display import HTML, display

        self._shown = time.monotonic()
        count, points = self._count, str(self._count)
        words = [escape(word) for word in state or self._left() or [f"on {self._where}"]]
        if failed := count.failed_in_words:
            words = [*([escape(count.reason)] if count.reason else []), *words]
            points = points.replace(failed, f'<span style="color: #d03030">{failed}</span>')
        bar = f'<progress value="{count.done}" max="{max(1, count.points)}"></progress>'
        line = HTML(f"{bar} {', '.join([points, *words])}")
        if self._handle is None:
            self._handle = display(line, display_id=True)
        else:
            self._handle.update(line)


AxisRows = list[dict[str, Any]]
"""How far a study is at each value along a dimension: ``at`` has the values by axis, the others are counts."""


def by_axis(
    axes: Mapping[str, Sequence[Mapping[str, Any]]],
    status: NDArray[np.int8],
    realisations: NDArray[np.int64],
    wanted: int,
) -> dict[str, AxisRows]:
    """Return how far a study is at each value along each dimension: points done, failed and excluded, realisations.

    ``axes`` has the values along each dimension, by axis; ``status`` and ``realisations`` done are shaped as the grid,
    and ``wanted`` are the realisations of a point that is not done.
    """
    excluded, done = status == Status.EXCLUDED, status == Status.DONE
    of_point = np.where(done, realisations, np.maximum(realisations, wanted))
    counts = {
        "points": ~excluded,
        "done": done,
        "failed": status == Status.FAILED,
        "excluded": excluded,
        "realisations_done": np.where(excluded, 0, realisations),
        "realisations": np.where(excluded, 0, of_point),
    }
    rows = {}
    for number, (dimension, places) in enumerate(axes.items()):
        others = tuple(d for d in range(status.ndim) if d != number)
        sums = {name: count.sum(axis=others).tolist() for name, count in counts.items()}
        rows[dimension] = [{"at": at} | {name: sums[name][i] for name in counts} for i, at in enumerate(places)]
    return rows


def folded(rows: AxisRows, most: int = MOST_LINES) -> list[AxisRows]:
    """Join neighbours, down to ``most`` groups: first those all finished or all untouched, then the shortest."""
    groups = [[row] for row in rows]
    if len(rows) > most:
        groups = []
        states = groupby(rows, key=lambda r: (r["done"] == r["points"], not (r["realisations_done"] or r["failed"])))
        for state, alike in states:
            groups += [list(alike)] if any(state) else [[row] for row in alike]
    while len(groups) > most:
        sizes = [len(a) + len(b) for a, b in pairwise(groups)]
        at = sizes.index(min(sizes))
        groups[at : at + 2] = [groups[at] + groups[at + 1]]
    return groups


def axis_table(dimension: AxisRows, units: Mapping[str, str]) -> table_writer.Table:
    """Return how far a study is along a dimension as a table; columns that would be empty are left out."""
    name = ", ".join(f"{axis} [{unit}]" if (unit := units.get(axis, "")) else axis for axis in dimension[0]["at"])
    columns: dict[str, list[str]] = {name: [], "points done": [], "realisations": [], "failed": [], "excluded": []}
    for group in folded(dimension):
        total = {key: sum(row[key] for row in group) for key in group[0] if key != "at"}
        first, last = (", ".join(map(str, row["at"].values())) for row in (group[0], group[-1]))
        percent = 100 * total["realisations_done"] // total["realisations"] if total["realisations"] else 100
        cells = (
            first if len(group) == 1 else f"{first} ... {last} ({len(group):,} values)",
            f"{total['done']:,}/{total['points']:,}",
            f"{percent} %" if any(row["realisations"] != row["points"] for row in dimension) else "",
            *(f"{total[key]:,}" if total[key] else "" for key in ("failed", "excluded")),
        )
        for column, cell in zip(columns.values(), cells, strict=True):
            column.append(cell)
    return table_writer.Table(
        [table_writer.Column(heading, cells, left=heading == name) for heading, cells in columns.items() if any(cells)]
    )
