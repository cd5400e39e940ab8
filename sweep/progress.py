"""Progress of a run on standard error: a bar on a terminal, a line now and then elsewhere."""

import sys
import time
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from sweep.plan import PlanSize
from sweep.tally import Survey

LINE_EVERY_S = 5.0


class TerminalProgress:
    """Shows points done, realisations per second and the time left."""

    def __init__(self) -> None:
        """Write to standard error."""
        self._console = Console(stderr=True)
        self._bar: Progress | None = None
        self._started = False
        self._points = self._realisations = 0
        self._cost = 0.0

    def __enter__(self) -> "TerminalProgress":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def start(self, survey: Survey, where: str) -> None:
        """Say what there is to do and where it is done."""
        self._survey, self._started = survey, True
        self._begun = self._said = time.monotonic()
        self._cost_known = survey.pending.cost
        total, pending = survey.total, survey.pending
        self._points = total.points - pending.points
        held = f", {self._points:,} of them in the store already" if self._points else ""
        partly = (
            ", part of the realisations too" if total.points == pending.points and total.blocks > pending.blocks else ""
        )
        self.say(f"{total.points:,} points{held}{partly}; {pending.realisations:,} realisations to do on {where}")
        if self._console.is_terminal and pending.blocks:
            self._bar = Progress(
                BarColumn(),
                TextColumn("{task.description}"),
                TimeRemainingColumn(),
                console=self._console,
                transient=True,
                speed_estimate_period=600.0,
            )
            self._task = self._bar.add_task(self._description(), total=pending.cost)
            self._bar.start()

    def advance(self, done: PlanSize, more: PlanSize) -> None:
        """Count what was done, and what more there is to do."""
        self._cost_known += more.cost
        self._points += done.points
        self._realisations += done.realisations
        self._cost += done.cost
        if self._bar is not None:
            self._bar.update(self._task, advance=done.cost, total=self._cost_known, description=self._description())
        elif time.monotonic() - self._said > LINE_EVERY_S:
            self._said = time.monotonic()
            left = (self._said - self._begun) * (self._cost_known / self._cost - 1.0)
            self.say(f"{self._description()}, {left:.0f} s left")

    def stopped(self, signal: str, store: Path) -> None:
        """Say what an interrupted run leaves, and how to go on."""
        how = "interrupted" if signal == "SIGINT" else f"stopped by {signal}"
        done = (
            f"{self._realisations:,} realisations of this run are kept in {store}"
            if self._started
            else "nothing was begun"
        )
        self.say(f"{how}; {done}; the same command goes on from there")

    def _description(self) -> str:
        elapsed = max(time.monotonic() - self._begun, 1e-9)
        return (
            f"{self._points:,}/{self._survey.total.points:,} points, {self._realisations / elapsed:,.0f} realisations/s"
        )

    def say(self, text: str) -> None:
        """Print one line, after the bar if there is one."""
        if self._bar is not None:
            self._bar.stop()
        print(text, file=sys.stderr, flush=True)
