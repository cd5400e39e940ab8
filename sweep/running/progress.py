"""Progress of a run in sentences, to the log, and as a bar on a terminal."""

import logging
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task
from rich.text import Text

from linksweep.sweep.executing.task import TaskResult
from linksweep.sweep.formatting import counted, harmless, per_second
from linksweep.sweep.interrupt import how_ended
from linksweep.sweep.planning.grid import describe
from linksweep.sweep.planning.plan import Survey, Work
from linksweep.sweep.running.eta import Eta, in_words
from linksweep.sweep.running.failures import FailureCount, failed_before, failed_points
from linksweep.sweep.running.run_summary import RunSummary
from linksweep.sweep.running.writer import Taken
from linksweep.sweep.studies.study import Study

SENTENCES = logging.getLogger("linksweep")
"""Messages to the user and to the log file, with a debug message for each point."""

RECORD = logging.getLogger("linksweep.record")
"""Messages to the log file alone, such as the traceback of each point that fails."""

LINE_FIRST_S, LINE_LAST_S = 5.0, 600.0
LINE_SHARE = 0.1
"""The time between two lines grows with the time that the run has taken, between these bounds."""


class TerminalProgress:
    """Shows points done, speed and time left: in a ``bar`` if there is a terminal, else in a line now and then."""

    def __init__(self, study: Study, bar: bool = True) -> None:
        self._study = study
        self._once = study.experiment.deterministic
        self._console = Console(file=getattr(sys.stderr, "unescaped", sys.stderr))
        self._with_bar = bar and self._console.is_terminal
        self._bar: Progress | None = None
        self._summary = RunSummary(study)
        self._begun: float | None = None

    def __enter__(self) -> "TerminalProgress":
        return self

    def __exit__(self, *_error: object) -> None:
        self.written()

    def start(self, survey: Survey, where: str, workers: int | None = None) -> None:
        """Say what there is to do and where it is done."""
        self._begun = self._said = time.monotonic()
        self._eta = Eta(survey.pending.cost, workers)
        total, pending = survey.total, survey.pending
        self._count = FailureCount(self._study, total.points, total.points - pending.points, survey.failed)
        self._work = pending.cost
        done = self._count.done
        held = f", {done:,} of them in the store already" if done else ""
        held += failed_before(survey.failed)
        begun = total.points == pending.points and total.blocks > pending.blocks
        partly = ", part of the realisations too" if begun else ""
        number, noun = (pending.points, "point") if self._once else (pending.realisations, "realisation")
        self.say(f"{counted(total.points, 'point')}{held}{partly}; {counted(number, noun)} to do on {where}")
        if self._with_bar and pending.blocks:
            self._bar = Progress(BarColumn(24), _Words(self._in_colour), console=self._console, transient=True)
            self._task = self._bar.add_task("", total=pending.cost)
            self._bar.start()

    def advance(self, works: Sequence[Work], result: TaskResult, taken: Taken) -> None:
        """Count what was done, and what more there is to do."""
        assert self._begun is not None, "a run starts before it advances"
        now = time.monotonic()
        self._eta.extend(taken.more.cost)
        self._work += taken.more.cost
        self._eta.take_result(now, taken.done.cost, result)
        self._summary.take(works, result, taken.done)
        for sentence in self._count.take(taken.ended, taken.failed):
            SENTENCES.warning(sentence)
        self._tell_points(taken)
        if result.said:
            self._tell_what_was_said(works, result)
        if self._bar is not None:
            self._bar.update(self._task, advance=taken.done.cost, total=self._work)
        if now - self._said > min(max(LINE_FIRST_S, LINE_SHARE * (now - self._begun)), LINE_LAST_S):
            self._said = now
            (SENTENCES if self._bar is None else RECORD).info(self._line(now))

    def written(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _tell_points(self, taken: Taken) -> None:
        if not taken.failed and not SENTENCES.isEnabledFor(logging.DEBUG):
            return
        for point in taken.ended:
            place = describe(self._study, point.parameters)
            if (failure := taken.failed.get(point.index)) is not None:
                SENTENCES.debug("%s: failed (%s)", place, failure.kind)
                RECORD.error("%s: failed (%s): %s\n%s", place, failure.kind, failure.message, failure.traceback)
            else:
                SENTENCES.debug("%s: done", place)

    def _tell_what_was_said(self, works: Sequence[Work], result: TaskResult) -> None:
        points = [point for work in works for point in work.points]
        for row, said in result.said.items():
            place = describe(self._study, points[row].parameters)
            self._summary.warned(place, said.warnings)
            for line in said.printed.splitlines():
                RECORD.info("%s: printed: %s", place, line)

    def say(self, text: str) -> None:
        """Tell the user a sentence."""
        SENTENCES.info(text)

    def stopped(self, signal: str, store: object) -> None:
        """Say what an interrupted run leaves, and how to go on."""
        self.written()
        done_so_far = self._summary.done
        failed = 0 if self._begun is None else self._count.failed_here
        points = done_so_far.points - failed
        number, noun = (points, "point") if self._once else (done_so_far.realisations, "realisation")
        kept = f"{counted(number, noun)} of this run {'is' if number == 1 else 'are'} kept in {store}"
        kept += f", {counted(failed, 'point')} failed" if failed else ""
        done = "nothing was begun" if self._begun is None else kept
        SENTENCES.error(f"{how_ended(signal)}; {done}; the same command goes on from there")

    def finish(self, failures: Mapping[str, str], store: object, commands: Sequence[str] = ()) -> None:
        """Say what the run took, why points failed (``failures`` by their place), and which ``commands`` come next."""
        self.written()
        if self._begun is not None:
            further = f"; next: {', '.join(commands)}" if commands and not failures else ""
            took = time.monotonic() - self._begun
            for line in (*self._summary.summary(took, self._count.failed_here), f"wrote {store}{further}"):
                self.say(line)
            for line in self._summary.warnings():
                SENTENCES.warning(line)
        if failures:
            SENTENCES.error(
                f"{failed_points(failures)}; "
                f"`sweep status {store}` names them and says why, `sweep run --retry {store}` tries them again, "
                f"`sweep reproduce {store} --at POINT` runs one here"
            )

    def _line(self, now: float) -> str:
        """Return how far the run is: points, speed, time left."""
        assert self._begun is not None, "a run starts before it is described"
        done = self._summary.done
        number, noun = (done.points, "points") if self._once else (done.realisations, "realisations")
        share = f" ({100.0 * done.cost / self._work:.0f} % of the work)" if self._work > 0.0 and not self._once else ""
        left = self._eta.left(now)
        words = [f"{self._count}{share}", per_second(number, now - self._begun, noun)]
        return ", ".join([*words, *([] if left is None else [f"about {in_words(left)} left"])])

    def _in_colour(self) -> Text:
        """Return the line of the bar, with what failed in red and the first reason as far as there is room."""
        words = self._count.failed_in_words
        line = Text(self._line(time.monotonic()), no_wrap=True, overflow="ellipsis")
        line.highlight_words([words] if words else [], style="bold red")
        return line.append(f"; {self._count.reason}" if words and self._count.reason else "", style="red")


class _Words(ProgressColumn):
    """What changes also between two results."""

    def __init__(self, words: Callable[[], Text]) -> None:
        super().__init__()
        self._words = words

    def render(self, _task: Task) -> Text:
        return self._words()


class Sentences(logging.Handler):
    """Writes to the present standard error, which a bar replaces so that it stays below the lines."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line; if the terminal is closed, nobody can read it and the error is ignored."""
        with suppress(OSError, ValueError):
            print(harmless(self.format(record)), file=sys.stderr, flush=True)
