"""Progress of a run in a notebook: one line with a bar below the cell, which is replaced as the run goes on."""

import sys
import time
from collections.abc import Sequence
from html import escape
from typing import Any

from sweep.executing.task import TaskResult
from sweep.formatting import harmless
from sweep.planning.plan import Survey, Work
from sweep.running.eta import Eta, in_words
from sweep.running.writer import Taken

EVERY_S = 0.5
"""Seconds between two updates of the line, at least."""


def in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return shell is not None and hasattr(shell, "kernel")


class NotebookProgress:
    """Shows points done and the time left below the cell that runs."""

    def __init__(self) -> None:
        self._handle: Any = None
        self._points = self._all_points = 0
        self._shown = 0.0

    def start(self, survey: Survey, where: str, workers: int | None) -> None:
        """Show that work begins."""
        self._eta = Eta(survey.pending.cost, workers)
        self._all_points = survey.total.points
        self._points = survey.total.points - survey.pending.points
        self._where = where
        self._show()

    def advance(self, works: Sequence[Work], result: TaskResult, taken: Taken) -> None:
        """Count a task's results."""
        now = time.monotonic()
        self._eta.extend(taken.more.cost)
        self._eta.take(now, taken.done.cost, float(result.seconds.sum()))
        self._points += taken.done.points
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
        left = None if ended else self._eta.left(self._shown)
        words = "done" if ended else f"about {in_words(left)} left" if left is not None else f"on {self._where}"
        bar = f'<progress value="{self._points}" max="{max(1, self._all_points)}"></progress>'
        line = HTML(f"{bar} {self._points:,}/{self._all_points:,} points, {escape(words)}")
        if self._handle is None:
            self._handle = display(line, display_id=True)
        else:
            self._handle.update(line)
