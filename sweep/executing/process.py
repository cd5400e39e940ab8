"""What the code of an experiment may do to the process that runs it: print, warn, change it, fork it, take too long."""

import ctypes
import decimal
import io
import os
import random
import signal
import sys
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

# Characters and different warnings of one block that are kept.
MOST_PRINTED, MOST_WARNINGS = 10_000, 100

# Seconds between the exception and the end of the process: a block in compiled code does not see the exception.
GRACE_S = 2.0


@dataclass
class Captured:
    """What was printed, and how often each warning was raised."""

    printed: str = ""
    warnings: Counter[str] = field(default_factory=Counter)

    def taken(self) -> "Captured | None":
        """Return what was captured since the last call, or None if nothing was."""
        if not self.printed and not self.warnings:
            return None
        taken = Captured(self.printed, self.warnings)
        self.printed, self.warnings = "", Counter()
        return taken


class _Routes(io.TextIOBase):
    """Standard output and warnings of this process while some of its threads are captured, and what is put back of the
    process after each block: the working folder, the environment, the standard streams, the filters of warnings.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._threads: dict[int, Captured] = {}

    def begin(self, captured: Captured) -> None:
        """Capture the calling thread."""
        with self._lock:
            if not self._threads:
                self._before = sys.stdout, warnings.showwarning, list(warnings.filters)
                self._generators = np.random.get_state(), random.getstate()  # noqa: NPY002
                sys.stdout, warnings.showwarning = self, self._warn  # type: ignore[assignment]
                seldom = ("default", "module", "once")  # count all of these; keep "ignore" and "error"
                _set_filters([("always" if f[0] in seldom else f[0], *f[1:]) for f in warnings.filters])
                warnings.simplefilter("always", append=True)
                self._folder, self._environment = _working_folder(), _environment()
                self._variables, self._filters = dict(os.environ), list(warnings.filters)
                self._streams = sys.stdin, sys.stdout, sys.stderr
            self._threads[threading.get_ident()] = captured

    def restore(self) -> None:
        """Undo what a captured thread has changed about the process."""
        with self._lock:
            if not self._threads:
                return
            if self._folder is not None and _working_folder() != self._folder:
                with suppress(OSError):  # it may be gone
                    os.chdir(self._folder)
            if _environment() != self._environment:
                set_environment(self._variables)
            sys.stdin, sys.stdout, sys.stderr = self._streams
            if warnings.filters != self._filters:
                _set_filters(self._filters)

    def end(self) -> None:
        """Stop capturing the calling thread."""
        with self._lock:
            del self._threads[threading.get_ident()]
            if not self._threads:
                sys.stdout, warnings.showwarning, filters = self._before
                _set_filters(filters)
                np.random.set_state(self._generators[0])  # noqa: NPY002
                random.setstate(self._generators[1])

    def write(self, text: str) -> int:
        """Keep what a thread prints; text of a thread that an experiment has started is kept with a block under way."""
        if (captured := self._captured()) is not None:
            captured.printed += text[: MOST_PRINTED - len(captured.printed)]
        else:
            self._before[0].write(text)
        return len(text)

    def writable(self) -> bool:
        return True

    def _captured(self) -> Captured | None:
        with self._lock:
            return self._threads.get(threading.get_ident()) or next(iter(self._threads.values()), None)

    def _warn(self, message: Any, category: type[Warning], filename: str, lineno: int, *rest: Any) -> None:
        if (captured := self._captured()) is None:
            self._before[1](message, category, filename, lineno, *rest)
            return
        text = f"{category.__name__}: {message} ({Path(filename).name}, line {lineno})"
        if text in captured.warnings or len(captured.warnings) < MOST_WARNINGS:
            captured.warnings[text] += 1


_routes = _Routes()


@contextmanager
def captured() -> Iterator[Captured]:
    """Capture what this thread prints in this block, and its warnings."""
    result = Captured()
    _routes.begin(result)
    try:
        yield result
    finally:
        _routes.end()


@contextmanager
def undisturbed(seed: int) -> Iterator[None]:
    """Run code of an experiment in a captured thread so that no point depends on the one before it, as far as that is
    cheap: the generators of NumPy and Python for a process start from a ``seed``, and what is set for the arithmetic of
    NumPy and of decimals ends with this block, as does a process that is forked in it.
    """
    parent = os.getpid()
    np.random.seed(seed)  # noqa: NPY002 (for code that draws from it, although it should not)
    random.seed(seed)
    try:
        with np.errstate(), decimal.localcontext():
            yield
    except BaseException as error:
        if os.getpid() != parent:  # as Python ends: with the code of `sys.exit`, or with 1 and a traceback
            code = error.code if isinstance(error, SystemExit) else 1
            if not isinstance(error, SystemExit):
                traceback.print_exception(error, file=sys.__stderr__)
            os._exit(0 if code is None else code if isinstance(code, int) else 1)
        raise
    finally:
        if os.getpid() != parent:  # it would go on with the run beside its parent
            os._exit(0)
        _routes.restore()


def is_interruption(error: BaseException) -> bool:
    """Return whether an exception stops the run, as the user's interruption does, which Python raises in the main
    thread of a process that answers SIGINT so.  All other exceptions belong to the experiment.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    return isinstance(error, KeyboardInterrupt) and in_main_thread and signal.getsignal(signal.SIGINT) is not ignored


def ignored(*_signal: object) -> None:
    """Ignore a signal in this process, but not in the programs that it starts, as SIG_IGN would."""


def _set_filters(filters: list[Any]) -> None:
    """Let these be the filters of warnings, from their entries in `warnings.filters`."""
    warnings.resetwarnings()
    for action, message, category, module, line in filters:
        texts = [getattr(pattern, "pattern", pattern) or "" for pattern in (message, module)]
        warnings.filterwarnings(action, texts[0], category, texts[1], line, append=True)


def set_environment(variables: Mapping[str, str]) -> None:
    """Let these, and no others, be the variables of the environment of this process."""
    for name in os.environ.keys() - variables.keys():
        del os.environ[name]
    os.environ.update(variables)


def _environment() -> dict[Any, Any]:
    # Private: what os.environ keeps, in a hundredth of the time of dict(os.environ), which decodes all of it (1 us
    # against 60 us of about 300 us that a point of a plain function takes in all).
    return dict(getattr(os.environ, "_data", os.environ))


def _working_folder() -> str | None:
    with suppress(OSError):
        return os.getcwd()
    return None


class TimeLimitError(BaseException):
    """Raised inside a block at its time limit; not an Exception, because a block may catch those."""


class Deadlines:
    """The times by which the blocks under way in this process must have ended, one for each thread.

    A process has one alarm clock, so all its blocks share one instance.  The process must be one that may be ended:
    a worker of a cluster or a child of one.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ends: dict[int, float] = {}

    @contextmanager
    def within(self, seconds: float | None) -> Iterator[None]:
        """Raise TimeLimitError in this block after ``seconds``; `GRACE_S` later the system ends the process with
        SIGALRM, even if the code never releases the interpreter's lock.
        """
        if seconds is None:
            yield
            return
        thread = threading.get_ident()
        lock, over = threading.Lock(), threading.Event()

        def raised(kind: type[BaseException] | None) -> None:
            argument = None if kind is None else ctypes.py_object(kind)
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), argument)

        def ring() -> None:
            with lock:
                if not over.is_set():
                    raised(TimeLimitError)

        timer = threading.Timer(seconds, ring)
        timer.daemon = True
        try:
            self._set(thread, time.monotonic() + seconds + GRACE_S)
            timer.start()
            yield
        finally:
            try:
                timer.cancel()
                with lock:
                    over.set()
                    raised(None)  # else one that is pending hits the next block
            finally:  # the exception may be raised, once, in the lines above
                self._set(thread, None)

    def _set(self, thread: int, end: float | None) -> None:
        """Set or drop a thread's end, and set the alarm to the earliest of all ends."""
        with self._lock:
            self._ends.pop(thread, None)
            if end is not None:
                self._ends[thread] = end
            wait = max(1e-3, min(self._ends.values()) - time.monotonic()) if self._ends else 0.0
            signal.setitimer(signal.ITIMER_REAL, wait)
