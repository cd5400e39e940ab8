"""Lets Ctrl-C and the signals of batch systems end a run cleanly: never in the middle of a write to the ledger."""

import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from types import FrameType
from typing import Any

SIGNALS: list[int] = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]

# Seconds after which an interrupt that the main thread is not handling must have been dropped.
LOST_S = 0.2


def how_ended(name: str) -> str:
    """Return what the user is told when the signal of this name has ended a command."""
    return "interrupted" if name == "SIGINT" else f"stopped by {name}"


@contextmanager
def answered(handler: Callable[[int, FrameType | None], None]) -> Iterator[dict[int, Any]]:
    """Let a handler answer the signals in this block, but those that are ignored; give what answered each before."""
    # nohup ignores one on purpose; Python could not restore None
    before = {n: one for n in SIGNALS if (one := signal.getsignal(n)) not in (signal.SIG_IGN, None)}
    try:
        for number in before:
            signal.signal(number, handler)
        yield before
    finally:
        for number, one in before.items():
            signal.signal(number, one)


class RunInterruptedError(KeyboardInterrupt):
    """The user or the system stopped the run with ``signal``; what was done is in the store.

    It is a KeyboardInterrupt, so that an ``except Exception`` of the caller does not go on after Ctrl-C.
    """

    def __init__(self, number: int) -> None:
        self.signal = signal.Signals(number)
        super().__init__(f"{how_ended(self.signal.name)}; what was done is kept, the same call goes on from there")


class Interruptions:
    """The signals that stop a run: the first raises KeyboardInterrupt, the second is handled as before the run.

    Python drops a KeyboardInterrupt that arrives in a finaliser or in a callback of its import system, and libraries
    drop some while they are imported.  So it is raised again until it gets through.  This does not work if the caller
    runs everything inside an ``except`` block: there a dropped interrupt looks like one that is being handled.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._holding = self._owed = self._lost = self._watching = False
        self._deciding = threading.Lock()

    @contextmanager
    def postponed(self) -> Iterator[None]:
        """Delay signals until the end of this block, which must be short, or of the block around it; what was dropped
        before it is raised there, too.
        """
        before, self._holding = self._holding, True
        try:
            yield
        finally:
            self._holding = before
        dropped = self.received is not None and sys.exc_info()[0] is None
        if (self._owed or dropped) and not before:
            self._owed = False
            raise KeyboardInterrupt

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Handle signals in this block."""
        with answered(self._answer) as self.before:
            self._unraisable_before, sys.unraisablehook = sys.unraisablehook, self._unraisable
            self._watching = True
            try:
                yield
            finally:
                with self._deciding:
                    self._watching = False
                if sys.unraisablehook == self._unraisable:
                    sys.unraisablehook = self._unraisable_before

    def _answer(self, number: int, _frame: FrameType | None) -> None:
        if self.received is not None and not self._lost:
            signal.signal(number, self.before.pop(number))
            signal.raise_signal(number)
            return
        if self.received is None:
            threading.Thread(target=self._send_again, args=(number,), daemon=True).start()
        self.received, self._lost, self._owed = number, False, self._holding
        if not self._holding:
            raise KeyboardInterrupt

    def _send_again(self, number: int) -> None:
        """Send a signal again and again, but not while the main thread is handling an exception, in an except, a
        finally or a with, or postpones what it does.
        """
        main = threading.main_thread().ident or 0
        while self._watching:
            time.sleep(LOST_S)
            with self._deciding:
                if self._watching and not (self._holding or self._lost or _is_handling(main)):
                    self._lost = True
                    signal.pthread_kill(main, number)

    def _unraisable(self, what: Any) -> None:
        """Report nothing when Python drops an interrupt."""
        if self.received is None or not issubclass(what.exc_type, KeyboardInterrupt):
            self._unraisable_before(what)


# A fork that a block has made, as a pool of multiprocessing, answers signals as before the run.  Until it does they are
# blocked, since Python drops one that comes while it forks: such a pool would wait for ever for what it has ended.
_forking = threading.local()


def _before_fork() -> None:
    _forking.mask = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)


def _after_fork() -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, _forking.mask)


def _in_fork() -> None:
    for number in SIGNALS:
        if isinstance(mine := getattr(signal.getsignal(number), "__self__", None), Interruptions):
            signal.signal(number, mine.before[number])
    _after_fork()


os.register_at_fork(before=_before_fork, after_in_parent=_after_fork, after_in_child=_in_fork)


def _is_handling(thread: int) -> bool:
    """Return whether a thread is handling an exception at this moment."""
    collects = gc.isenabled()
    gc.disable()  # Python before 3.11.9 may hang if garbage is collected meanwhile (gh-106883)
    try:
        raised = sys._current_exceptions().get(thread)
    finally:
        if collects:
            gc.enable()
    return (raised[0] if isinstance(raised, tuple) else raised) is not None  # a tuple of three in Python 3.11


@contextmanager
def watched() -> Iterator[Interruptions]:
    """Let the first SIGINT, SIGTERM or SIGHUP raise KeyboardInterrupt in this block, and turn that, or an error that
    came first, as of a request that took long, into RunInterruptedError at its end.

    Only the main thread can handle signals: in another thread they are not watched.
    """
    interruptions, is_main = Interruptions(), threading.current_thread() is threading.main_thread()
    try:
        with interruptions.watched() if is_main else nullcontext():
            yield interruptions
    except BaseException as stop:
        first = stop.__cause__ if isinstance(stop, RuntimeError) else stop  # Python makes one of one in a class body
        is_late = interruptions.received is not None and isinstance(stop, Exception)
        if isinstance(stop, RunInterruptedError) or not (is_late or isinstance(first, KeyboardInterrupt)):
            raise
        raise RunInterruptedError(interruptions.received or signal.SIGINT) from stop
