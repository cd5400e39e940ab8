"""Progress of a run in a notebook: one line with a bar below the cell, which is replaced as the run goes on."""

import sys
import time
from collections.abc import Sequence
from html import escape
from typing import Any

from linksweep.sweep.executing.task import TaskResult
from linksweep.sweep.formatting import harmless
from linksweep.sweep.planning.plan import Survey, Work
from linksweep.sweep.running.eta import Eta, in_words
from linksweep.sweep.running.failures import FailureCount
from linksweep.sweep.running.writer import Taken
from linksweep.sweep.studies.study import Study

EVERY_S = 0.5
"""Seconds between two updates of the line, at least."""


def in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return shell is not None and hasattr(shell, "kernel")


class NotebookProgress:
    """Shows points done and failed, and the time left, below the cell that runs."""

    def __init__(self, study: Study) -> None:
        self._handle: Any = None
        self._study = study
        self._shown = 0.0

    def start(self, survey: Survey, where: str, workers: int | None) -> None:
        """Show that work begins."""
        self._eta = Eta(survey.pending.cost, workers)
        total = survey.total.points
        self._count = FailureCount(self._study, total, total - survey.pending.points, survey.failed)
        self._where = where
        self._show()

    def advance(self, works: Sequence[Work], result: TaskResult, taken: Taken) -> None:
        """Count a task's results."""
        now = time.monotonic()
        self._eta.extend(taken.more.cost)
        self._eta.take_result(now, taken.done.cost, result)
        self._count.take(taken.ended, taken.failed)
        if now - self._shown > EVERY_S:
            self._show()

    def written(self) -> None:
        """Show the end."""
        self._show(ended=True)

    def say(self, text: str) -> None:
        """Show a warning; other sentences are for terminals."""
        if text.startswith("warning"):
            print(harmless(text), file=sys.stderr)

    def _show(self, ended: bool = False) -> None:
        from IPython.display import HTML, display

        self._shown = time.monotonic()
        count, left = self._count, None if ended else self._eta.left(self._shown)
        state = "done" if count.done == count.points else "ended"
        words = state if ended else f"about {in_words(left)} left" if left is not None else f"on {self._where}"
        points = str(count)
        if failed := count.failed_in_words:
            words = ", ".join([*([escape(count.reason)] if count.reason else []), escape(words)])
            points = points.replace(failed, f'<span style="color: #d03030">{failed}</span>')
        bar = f'<progress value="{count.done}" max="{max(1, count.points)}"></progress>'
        line = HTML(f"{bar} {points}, {words}")
        if self._handle is None:
            self._handle = display(line, display_id=True)
        else:
            self._handle.update(line)
