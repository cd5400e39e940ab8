"""Captures what an experiment prints and the warnings that it raises, thread by thread, and puts back what it changes
about its process.
"""

import io
import sys
import threading
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from linksweep.sweep.executing.own_process import Surroundings, forks_ended, generators_restored, seeded

MOST_PRINTED = 10_000
"""Characters of one block that are kept."""

MOST_WARNINGS = 100
"""Different warnings of one block that are kept."""


@dataclass
class Captured:
    """What was printed, and how often each warning was raised."""

    printed: str = ""
    warnings: Counter[str] = field(default_factory=Counter)

    def taken(self) -> "Captured | None":
        """Return what was captured since the last call, or None if nothing was."""
        if not self.printed and not self.warnings:
            return None
        found = Captured(self.printed, self.warnings)
        self.printed, self.warnings = "", Counter()
        return found


class _Routes(io.TextIOBase):
    """Standard output and warnings of this process while some of its threads are captured."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._threads: dict[int, Captured] = {}
        self._before: TextIO | None = None
        self._restore = ExitStack()
        self._surroundings: Surroundings | None = None

    def begin(self, captured: Captured) -> None:
        """Capture the calling thread."""
        with self._lock:
            if not self._threads:
                self._before, sys.stdout = sys.stdout, self
                self._restore.enter_context(warnings.catch_warnings())
                seldom = ("default", "module", "once")  # count all of these; keep "ignore" and "error"
                warnings.simplefilter("always", append=True)
                warnings.filters[:] = [  # type: ignore[index]
                    ("always", *rest) if action in seldom else (action, *rest) for action, *rest in warnings.filters
                ]
                self._restore.enter_context(generators_restored())
                self._surroundings = Surroundings()
                self._showwarning = warnings.showwarning
                warnings.showwarning = self._warn  # type: ignore[assignment]
            self._threads[threading.get_ident()] = captured

    def restore(self) -> None:
        """Undo what a captured thread has changed about the process."""
        with self._lock:
            if self._surroundings is not None:
                self._surroundings.restore()

    def end(self) -> None:
        """Stop capturing the calling thread."""
        with self._lock:
            del self._threads[threading.get_ident()]
            if not self._threads:
                self._restore.close()
                if sys.stdout is self and self._before is not None:
                    sys.stdout = self._before

    def write(self, text: str) -> int:
        """Keep what a thread prints; text of a thread that an experiment has started is kept with a block under way."""
        if (captured := self._of_this_thread()) is not None:
            captured.printed += text[: MOST_PRINTED - len(captured.printed)]
        elif self._before is not None:
            self._before.write(text)
        return len(text)

    def writable(self) -> bool:
        return True

    def _of_this_thread(self) -> Captured | None:
        with self._lock:
            own = self._threads.get(threading.get_ident())
            return own if own is not None else next(iter(self._threads.values()), None)

    def _warn(self, message: Any, category: type[Warning], filename: str, lineno: int, *rest: Any) -> None:
        if (captured := self._of_this_thread()) is not None:
            text = f"{category.__name__}: {message} ({Path(filename).name}, line {lineno})"
            if text in captured.warnings or len(captured.warnings) < MOST_WARNINGS:
                captured.warnings[text] += 1
        else:
            self._showwarning(message, category, filename, lineno, *rest)


_routes = _Routes()


@contextmanager
def undisturbed(seed: int) -> Iterator[None]:
    """Run code of an experiment in a captured thread so that no point depends on the one before it, as far as that is
    cheap; in particular the global generators start from a ``seed``.  A process that it forks ends with this block.
    """
    try:
        with forks_ended(), seeded(seed):
            yield
    finally:
        _routes.restore()


@contextmanager
def captured() -> Iterator[Captured]:
    """Capture what this thread prints in this block, and its warnings."""
    found = Captured()
    _routes.begin(found)
    try:
        yield found
    finally:
        _routes.end()
