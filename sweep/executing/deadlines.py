"""Ends a block that takes too long: by an exception where Python can raise one, else by the end of its process."""

import ctypes
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

GRACE_S = 2.0
"""Seconds between the exception and the end of the process: a block in compiled code does not see the exception."""


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
        bell = _Bell(thread)
        timer = threading.Timer(seconds, bell.ring)
        timer.daemon = True
        try:
            self._set(thread, time.monotonic() + seconds + GRACE_S)
            timer.start()
            yield
        finally:
            try:
                timer.cancel()
                bell.silence()
            finally:  # the exception may be raised, once, in the two lines above
                self._set(thread, None)

    def _set(self, thread: int, end: float | None) -> None:
        """Set or drop a thread's end, and set the alarm to the earliest of all ends."""
        with self._lock:
            if end is None:
                self._ends.pop(thread, None)
            else:
                self._ends[thread] = end
            wait = max(1e-3, min(self._ends.values()) - time.monotonic()) if self._ends else 0.0
            if hasattr(signal, "setitimer"):
                signal.setitimer(signal.ITIMER_REAL, wait)


class _Bell:
    """Raises TimeLimitError in a thread unless it is cancelled first."""

    def __init__(self, thread: int) -> None:
        self._thread = ctypes.c_ulong(thread)
        self._lock = threading.Lock()
        self._over = False

    def ring(self) -> None:
        with self._lock:
            if not self._over:
                ctypes.pythonapi.PyThreadState_SetAsyncExc(self._thread, ctypes.py_object(TimeLimitError))

    def silence(self) -> None:
        with self._lock:
            self._over = True
            ctypes.pythonapi.PyThreadState_SetAsyncExc(self._thread, None)  # else a pending one hits the next block
