"""What is shown of a run: how far it is, the time left, what failed and why, when a run that only fails ends, and at
the end what it took.
"""

import json
import logging
import re
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any, TextIO

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from linksweep.sweep.contract import SweepError, shown
from linksweep.sweep.executing.task import Failure, TaskResult
from linksweep.sweep.formatting import ESCAPED, counted, harmless, in_words, now, per_second, typed, without_secrets
from linksweep.sweep.interrupt import RunInterruptedError, how_ended
from linksweep.sweep.planning.grid import GridPoint, describe
from linksweep.sweep.planning.plan import PlanSize, Survey, Work
from linksweep.sweep.studies.study import Study

# Most reasons of failed points, and most warnings, that are named.
NAMED = 5

# Characters of a reason in a line.
LONGEST_REASON = 200

# A run ends where so many first points all fail for the same reason; a percentage is that of at least so many.
FIRST = 20

# Columns of a terminal below which there is no bar, only its line.
NARROW = 72

NUMBER = re.compile(r"0x[0-9a-f]+|[-+]?(?:\d[\d_,]*\.?\d*|\.\d+)(?:e[-+]?\d+)?", re.IGNORECASE)
TRUTH = re.compile(r"\b(?:True|False)\b")


@dataclass(frozen=True)
class MaxFailures:
    """The most points of a run that may fail before it is ended: a ``number``, or ``percent`` of those that were tried.

    >>> MaxFailures.parsed("5 %"), MaxFailures.parsed(3)
    (MaxFailures(number=None, percent=5.0), MaxFailures(number=3, percent=None))
    """

    number: int | None = None
    percent: float | None = None

    @classmethod
    def parsed(cls, text: "int | str") -> "MaxFailures":
        """Return the limit that a user gives; raises SweepError for anything else."""
        match = re.fullmatch(r"\s*(\d{1,15})\s*|\s*(\d{1,3}(?:\.\d*)?)\s*%\s*", str(text))
        if isinstance(text, bool) or match is None or (match[2] and float(match[2]) > 100.0):
            rule = "must be a number of points, like 10, or a percentage, like '5%'"
            raise SweepError(f"max_failures = {shown(text)}: {rule}")
        return cls(int(match[1])) if match[1] else cls(percent=float(match[2]))

    def __str__(self) -> str:
        return f"{self.number:,}" if self.percent is None else f"{self.percent:g} %"


class Reasons:
    """Why points failed, or warnings, by what they have in common: of each the first place and message, and how many.

    Messages that differ only in numbers, or in a value of their point, are one reason.
    """

    def __init__(self, failures: Mapping[str, str] | None = None) -> None:
        """Begin with messages by place."""
        self.points = 0
        self.first: dict[str, tuple[str, str]] = {}
        self._numbers = Counter[str]()
        for place, message in (failures or {}).items():
            self.add(place, message)

    def add(self, place: str, message: str, times: int = 1) -> None:
        """Count a point that failed, or a warning."""
        kind = in_common(place, message)
        self.points += times
        self.first.setdefault(kind, (place, message))
        self._numbers[kind] += times

    def most(self) -> list[tuple[int, str, str]]:
        """Return of each reason how many points failed for it, a place and a message, the most frequent first."""
        return [(number, *self.first[kind]) for kind, number in self._numbers.most_common()]

    def __str__(self) -> str:
        return "; ".join(self.in_words())

    def in_words(self) -> list[str]:
        """Return the most frequent reasons, each with how many points it is of and one of them."""
        words = []
        for number, place, message in self.most():
            before, after = ("", "") if number == 1 else (f"{number:,} like ", " for example")
            words.append(f"{before}{short(message)},{after} at {place}")
        return [*words[:NAMED], *([f"{len(words) - NAMED:,} other reasons"] if len(words) > NAMED else [])]


class FailureCount:
    """Counts the points of a run that have ended, with the ``reasons`` of those that failed in it, and says when too
    many have.

    Without a limit that is when the first points all fail for the same reason, as where a package is missing.
    """

    def __init__(
        self, study: Study, points: int, before: int = 0, failed_before: int = 0, most: MaxFailures | None = None
    ) -> None:
        """Begin with all ``points`` of a study; ``before`` of them have ended in earlier runs, some of them failed."""
        self._study, self.points, self._before, self._most = study, points, before, most
        self._failed_before = failed_before
        self._begun: set[int] = set()
        self.reasons = Reasons()
        self.ended = 0

    def __str__(self) -> str:
        """How many points are done, and how many failed, in this run and in earlier ones."""
        if self.failed:
            return f"{self.done:,} done, {self.failed:,} failed of {self.points:,} points"
        return f"{self.done:,}/{self.points:,} points"

    @property
    def done(self) -> int:
        """How many points are done."""
        return self._before + self.ended - self.failed

    @property
    def failed(self) -> int:
        """How many points have failed."""
        return self._failed_before + self.reasons.points

    @property
    def most_at_once(self) -> int | None:
        """How many blocks a task may have, so that a run that is to be ended has not done more; None is no limit."""
        if self._most is not None:
            left = FIRST if self._most.number is None else self._most.number + 1 - self.reasons.points
            return max(1, min(FIRST, left))
        return FIRST - self.ended if self._only_fails and self.ended < FIRST else None

    @property
    def _only_fails(self) -> bool:
        """Whether nothing has succeeded in this run."""
        return self.ended == self.reasons.points and not self._begun

    def take(self, ended: Iterable[GridPoint], failed: Mapping[int, Failure], begun: Iterable[int] = ()) -> list[str]:
        """Count points that have ended, and by their indices those that have ``begun`` well; return a sentence for each
        of the first reasons.
        """
        new = []
        self._begun.update(begun)
        for point in ended:
            self.ended += 1
            self._begun.discard(point.index)
            if (failure := failed.get(point.index)) is not None:
                known = len(self.reasons.first)
                place = describe(self._study, point.parameters)
                self.reasons.add(place, failure.message)
                if known < len(self.reasons.first) <= NAMED:
                    new.append(f"failed at {place}: {short(failure.message)}")
        return new

    def too_many(self) -> str:
        """Return why the run is to be ended, in words; '' where it goes on, or where nothing is left to do anyway."""
        here, most, tried = self.reasons.points, self._most, self.ended + len(self._begun)
        if self._before + self.ended >= self.points or not here:
            return ""
        said = f"{here:,} of the {counted(tried, 'point')} that were tried failed, more than {most}"
        if most is None:
            said = f"the first {FIRST} points all failed for the same reason"
            exceeded = self._only_fails and here >= FIRST and len(self.reasons.first) == 1
        elif most.percent is None:
            exceeded = here > (most.number or 0)
        else:
            exceeded = tried >= FIRST and 100.0 * here > most.percent * tried
        return f"{said}: {self.reasons}" if exceeded else ""


def failed_points(failures: Mapping[str, str]) -> str:
    """Return how many points failed and why, from messages by place: '3 points failed: 2 like KeyError: 'y', for
    example at sky=clear; ValueError: no sun, at sky=dark'.
    """
    return f"{counted(len(failures), 'point')} failed: {Reasons(failures)}"


def in_common(place: str, message: str) -> str:
    """Return what a reason has in common with that of other points: its line without numbers, truth values and its
    point's values.

    >>> in_common("sky=dark,x=1", "no root in dark for x = 0.25")
    'no root in ... for x = ...'
    >>> in_common("b=False", "nan=True") == in_common("b=True", "nan=True")
    True
    """
    line = TRUTH.sub("...", short(message))
    for value in {pair.partition("=")[2] for pair in place.split(",")}:
        if value and not NUMBER.fullmatch(value):
            line = re.sub(rf"(?<!\w){re.escape(value)}(?!\w)", "...", line)
    return NUMBER.sub("...", line)


def failed_before(points: int) -> str:
    """Return how many points an earlier run could not compute, to follow how many are done; '' for none."""
    return f", {points:,} failed (`sweep run --retry` tries them again)" if points else ""


def short(message: str) -> str:
    """Return the first line of a message, cut where it is long."""
    line = message.strip().partition("\n")[0]
    return line if len(line) <= LONGEST_REASON else f"{line[:LONGEST_REASON]} [...]"


# Messages to the user and to the log file, with a debug message for each point.
SENTENCES = logging.getLogger("linksweep")

# Messages to the log file alone, such as the traceback of each point that fails.
RECORD = logging.getLogger("linksweep.record")
RECORD.addHandler(logging.NullHandler())  # else Python prints what nobody handles to standard error

# The time between two lines grows with the time that the run has taken, between these bounds.
LINE_FIRST_S, LINE_LAST_S, LINE_SHARE = 5.0, 600.0, 0.1

# The least time between two updates of the line in a notebook.
NOTEBOOK_S = 0.5


class Eta:
    """Estimates the time left, with all times in seconds of one clock: the seconds that the work which is left takes if
    a unit of cost takes as long as so far, divided by how much was done at once in the last half of the run, or more.

    There are at most ``workers`` workers if that is known.  A first call in a process may have imported modules: it
    tells nothing of what is left.

    Example: two of ten tasks have come from one worker, which takes 3 s for each.

    >>> eta = Eta(workers=1)
    >>> eta.take(now=3.0, cost=1.0, seconds=3.0)
    >>> eta.take(now=6.0, cost=1.0, seconds=3.0)
    >>> eta.left(now=6.0, cost=8.0)
    24.0
    """

    def __init__(self, workers: int | None = None) -> None:
        """Know nothing yet."""
        self._workers = float("inf") if workers is None else max(1, workers)
        self._cost = self._busy = self._longest = self._begun = self._last = 0.0
        # Two spans up to now: since when, the seconds of the tasks that have ended in it, and how many these are.
        self._recent = self._next = (0.0, 0.0, 0)

    def take(self, now: float, cost: float, seconds: float, cold: float = 0.0, rows: int = 1) -> None:
        """Count a task's result that came ``now`` after ``seconds`` on its worker; ``cold`` of them for the first of
        its ``rows``, which may have imported modules.
        """
        if not (usual := 1.0 - (1.0 / rows if cold else 0.0)):
            return
        seconds = max(seconds - cold, 1e-9)
        if not self._recent[2]:
            self._begun = now - seconds
            self._recent = self._next = (self._begun, 0.0, 0)
        self._cost += usual * cost
        self._busy += seconds
        self._longest = max(self._longest, seconds)
        self._last = now
        self._recent, self._next = ((t, s + seconds, n + 1) for t, s, n in (self._recent, self._next))
        # Workers come and go, so what is long past does not count; but tasks that end together must not look like more.
        if now - self._next[0] > max(self._next[0] - self._begun, 3.0 * self._longest):
            self._recent, self._next = self._next, (now, 0.0, 0)

    def left(self, now: float, cost: float) -> float | None:
        """Return the seconds left for work of a cost, never negative; None while nothing is known but the time of first
        calls.
        """
        since, busy, tasks = self._recent
        if not tasks:
            return None
        elapsed = max(self._last - since, 1e-9)
        half = 0.5 * min(busy / tasks, elapsed)  # of a task, which all others are at on average
        at_once = min((busy - half) / (elapsed - half), self._workers)
        needed = max(cost, 0.0) * self._busy / max(self._cost, 1e-9) / max(at_once, 1e-9)
        return max(needed - max(now - self._last, 0.0), 0.5 * needed)


@dataclass(frozen=True)
class Taken:
    """What a task did, the cost of what more its results call for, which points it ended, and by their index why some
    failed, and which are begun without a failure.
    """

    done: PlanSize
    more: float
    ended: tuple[GridPoint, ...]
    failed: Mapping[int, Failure]
    begun: Set[int] = frozenset()


class Progress:
    """What watches a run: in itself nothing, and it tells only what a study is warned of."""

    def start(self, survey: Survey, where: str, workers: int | None) -> None:
        """Work begins, at the place that ``where`` names, with so many workers if that is known."""

    def advance(self, works: Sequence[Work], result: TaskResult, taken: Taken) -> None:
        """A task's result is in the ledger."""

    def written(self) -> None:
        """All results are on disk; the workers are about to end."""

    def say(self, text: str) -> None:
        """Tell something in a sentence; log a warning."""
        if text.startswith("warning: "):
            SENTENCES.warning(text)


SILENT = Progress()


class TerminalProgress(Progress):
    """Shows points done, time left and speed: in a ``bar`` if there is a terminal, else in a line now and then.

    To a file of ``events`` it appends a line of JSON for each: started, points, failed, written and, at the end of the
    block, ended.
    """

    def __init__(self, study: Study, bar: bool = True, events: TextIO | None = None) -> None:
        self._study, self._events, self._failures = study, events, 0
        self._begun: float | None = None
        self._once = study.experiment.deterministic
        self._console = Console(file=getattr(sys.stderr, "unescaped", sys.stderr))
        self._with_bar = bar and self._console.is_terminal
        self._bar = Live(self, console=self._console, transient=True)
        self._done = PlanSize(0, 0, 0, 0.0)
        self._busy = 0.0
        self._warned = Reasons()

    def __enter__(self) -> "TerminalProgress":
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        self._bar.stop()
        # The exit by a signal has its reason as context.
        reason = error.__context__ if isinstance(error, SystemExit) else error
        code = int(self._failures > 0) if error is None else getattr(error, "exit_code", getattr(error, "code", 1))
        self._write("ended", exit_code=code, reason=str(reason or "finished"), failed=self._failures)

    def start(self, survey: Survey, where: str, workers: int | None = None) -> None:
        """Say what there is to do and where it is done."""
        total, pending = survey.total, survey.pending
        self._begun = self._shown = time.monotonic()
        self._eta = Eta(workers)
        self._count = FailureCount(self._study, total.points, total.points - pending.points, survey.failed)
        self._failures = self._count.failed
        self._write("started", points=total.points, done=self._count.done, failed=survey.failed, where=where)
        self._work, self._stored = pending.cost, survey.stored.cost / max(total.cost, 1e-9)
        kept = f", {self._count.done:,} of them in the store already" if self._count.done else ""
        whole = f"{counted(total.points, 'point')}{kept}{failed_before(survey.failed)}"
        to_do = f"{self._counted(pending)} to do {where}" if pending.blocks else ""
        self.say(to_do if to_do.startswith(f"{whole} ") else "; ".join(filter(None, [whole, to_do])))
        if self._with_bar and pending.blocks:
            self._bar.start()

    def advance(self, works: Sequence[Work], result: TaskResult, taken: Taken) -> None:
        """Count what was done, and what more there is to do."""
        for sentence in self._count.take(taken.ended, taken.failed):
            SENTENCES.warning(sentence)
        seconds, cold = float(result.seconds.sum()), float(result.seconds[0]) if result.cold else 0.0
        self._eta.take(time.monotonic(), taken.done.cost, seconds, cold, len(result.seconds))
        self._work += taken.more
        self._done += taken.done
        self._busy += seconds
        points = [point for work in works for point in work.points]
        for row, said in result.said.items():
            place = describe(self._study, points[row].parameters)
            for text, times in said.warnings.items():
                self._warned.add(place, text, times)
            for line in said.printed.splitlines():
                RECORD.info("%s: printed: %s", place, line)
        failed = sum(point.index in taken.failed for point in taken.ended)
        self._failures = self._count.failed
        self._write("points", done=len(taken.ended) - failed, failed=failed, realisations=taken.done.realisations)
        for point in taken.ended if taken.failed or SENTENCES.isEnabledFor(logging.DEBUG) else ():
            place = describe(self._study, point.parameters)
            if (failure := taken.failed.get(point.index)) is None:
                SENTENCES.debug("%s: done", place)
                continue
            self._write("failed", point=place, **vars(failure))
            SENTENCES.debug("%s: failed (%s)", place, failure.kind)
            RECORD.error("%s: failed (%s): %s\n%s", place, failure.kind, failure.message, failure.traceback)
        now = time.monotonic()
        if now - self._shown > self._pause():
            self._shown = now
            self._show(self._line())

    def _pause(self) -> float:
        return min(max(LINE_FIRST_S, LINE_SHARE * self._elapsed()), LINE_LAST_S)

    def _show(self, line: str) -> None:
        (RECORD if self._bar.is_started else SENTENCES).info(line)

    def written(self) -> None:
        """Remove the bar: all results are on disk."""
        self._bar.stop()
        self._write("written")

    def _write(self, event: str, **about: Any) -> None:
        try:
            if self._events is not None:
                self._events.write(json.dumps({"event": event, "time": now(), **about}) + "\n")
        except OSError as error:
            self._events = None
            self.say(f"warning: no more events can be written: {error.strerror}")

    def say(self, text: str) -> None:
        """Tell the user a sentence."""
        SENTENCES.info(text)

    def stopped(self, stop: RunInterruptedError, store: object) -> None:
        """Say what an interrupted run leaves, how to go on, and what else was wrong."""
        self._bar.stop()
        done = "nothing was begun"
        if self._begun is not None:
            failed = f", {counted(self._count.reasons.points, 'point')} failed" if self._count.reasons.points else ""
            done = f"kept in {store}: {self._counted(self._done, self._count.reasons.points)} of this run{failed}"
        words = [how_ended(stop.signal.name), done, "the same command goes on from there"]
        SENTENCES.error("; ".join([*words, *getattr(stop.__cause__, "problems", ())]))

    def finish(self, failures: Mapping[str, str], store: object, commands: Sequence[str] = ()) -> None:
        """Say what the run took, why points failed (``failures`` by their place), and which ``commands`` come next."""
        self._failures = len(failures)
        if self._begun is not None:
            further = f"; next: {', '.join(commands)}" if commands and not failures else ""
            if self._done.blocks:
                self.say(self._summary(self._elapsed()))
            self.say(f"wrote {str(store).translate(ESCAPED)}{further}")
            warned = self._warned.most()
            for times, place, text in warned[:NAMED]:
                often = "once" if times == 1 else f"{times:,} times, first"
                SENTENCES.warning(f"warned {often} at {place}: {short(text)}")
            if (more := len(warned) - NAMED) > 0:
                SENTENCES.warning(f"warned of {more} other things")
        if failures:
            name = typed(store)
            SENTENCES.error(
                f"{failed_points(failures)}; "
                f"`sweep status {name}` says why, `sweep run --retry {name}` tries them again, "
                f"`sweep reproduce {name} --at POINT` runs one here"
            )

    def _summary(self, elapsed: float) -> str:
        """Return what there is to say at the end of a run that took ``elapsed`` seconds."""
        failed = self._count.reasons.points
        realisations = "" if self._once else f" and {counted(self._done.realisations, 'realisation')}"
        took = f"{elapsed:.2g} s" if elapsed < 10.0 else in_words(elapsed)
        return (
            f"{counted(self._done.points - failed, 'point')}{realisations}"
            f"{f' done, {failed:,} failed,' if failed else ''} in {took}: "
            f"{self._speed(elapsed)}, {self._busy:,.1f} s of work by all workers together"
        )

    def _elapsed(self) -> float:
        assert self._begun is not None, "a run starts before it is described"
        return time.monotonic() - self._begun

    def _counted(self, size: PlanSize, failed: int = 0) -> str:
        return counted(size.points - failed, "point") if self._once else counted(size.realisations, "realisation")

    def _speed(self, elapsed: float) -> str:
        number, noun = (self._done.points, "points") if self._once else (self._done.realisations, "realisations")
        return per_second(number, elapsed, noun)

    def _share(self) -> float:
        """Return which share of the work is done, in this run and in earlier ones, as points are counted."""
        return self._stored + (1.0 - self._stored) * self._done.cost / max(self._work, 1e-9)

    def _line(self) -> str:
        """Return how far the run is: points, time left, speed.  What matters most comes first: a terminal cuts it."""
        share = f" ({100.0 * self._share():.0f} % of the work)" if self._work > 0.0 and not self._once else ""
        left = self._eta.left(time.monotonic(), self._work - self._done.cost)
        time_left = [] if left is None else [f"about {in_words(left)} left"]
        speed = [self._speed(self._elapsed())] if self._done.blocks else []
        return ", ".join([f"{self._count}{share}", *time_left, *speed])

    def __rich__(self) -> Table:
        """Return the bar and its line, with what failed in red and the first reason as far as there is room."""
        is_wide = self._console.width >= NARROW  # else what does not fit goes on in the next line
        line = Text(self._line(), no_wrap=is_wide, overflow="ellipsis")
        line.highlight_regex(r"[\d,]+ failed", "bold red")
        if first := next(iter(self._count.reasons.first.values()), None):
            line.append(harmless(f"; {short(first[1])}"), style="red")
        grid = Table.grid(padding=(0, 1))
        bar = ProgressBar(1.0, self._share(), width=24)
        grid.add_row(*([bar] if is_wide else []), line)
        return grid


class Lines(logging.Handler):
    """Writes to an open file, or to the present standard error, which a bar replaces so that it stays below the lines;
    not a StreamHandler, which Dask would silence with its own.
    """

    def __init__(self, level: int, form: str = "%(message)s", file: TextIO | None = None) -> None:
        super().__init__(level)
        self._file = file
        self.setFormatter(logging.Formatter(form))

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line; if the terminal is closed, nobody can read it, and of a full disk there is one warning."""
        text = harmless(self.format(record))
        try:
            print(text if self._file is None else without_secrets(text), file=self._file or sys.stderr, flush=True)
        except (OSError, ValueError) as error:
            if self._file is not None:
                self.setLevel(sys.maxsize)
                SENTENCES.warning("warning: the log file cannot be written: %s", error)


class NotebookProgress(TerminalProgress):
    """Shows how far a run is in a line below the cell that runs; of what is told otherwise, only warnings."""

    _handle: Any = None

    def start(self, survey: Survey, where: str, workers: int | None = None) -> None:
        """Show that work begins."""
        super().start(survey, where, workers)
        self._show(f"{self._count}, {where}")

    def written(self) -> None:
        """Show the end."""
        super().written()
        self._show(f"{self._count}, {'done' if self._count.done == self._count.points else 'ended'}")

    def say(self, text: str) -> None:
        """Show a warning; other sentences are for terminals."""
        if text.startswith("warning"):
            print(harmless(text), file=sys.stderr)

    def _pause(self) -> float:
        return NOTEBOOK_S

    def _show(self, line: str) -> None:
        from IPython.display import Pretty, display

        shown = Pretty(harmless(line))
        if self._handle is None:
            self._handle = display(shown, display_id=True)
        else:
            self._handle.update(shown)
