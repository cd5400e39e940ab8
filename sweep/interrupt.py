"""Lets Ctrl-C and the signals of batch systems end a run cleanly: never in the middle of a write to the ledger."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from types import FrameType
from typing import Any

SIGNALS: list[int] = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]

# Seconds after which an interrupt that the main thread is not handling must have been dropped: those of the alarm clock
# from the first signal on.
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
    drop some while they are imported.  So it is raised again, by the alarm clock of the process, until it gets through;
    an alarm that the caller has set is lost.
    This does not work if the caller runs everything inside an ``except`` block: there a dropped interrupt looks like
    one that is being handled.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._holding = self._owed = self._is_over = False

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
            try:
                yield
            finally:
                # No alarm raises anything from here on, and none is set: SIGALRM would end the process.
                self._holding = self._is_over = True
                if self.received is not None:
                    signal.setitimer(signal.ITIMER_REAL, 0.0)
                if sys.unraisablehook == self._unraisable:
                    sys.unraisablehook = self._unraisable_before

    def _answer(self, number: int, _frame: FrameType | None) -> None:
        if self.received is not None or self._is_over:
            signal.signal(number, self.before.pop(number))
            signal.raise_signal(number)
            return
        self.received, self._owed = number, self._holding
        self.before[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._raise_again) or signal.SIG_DFL
        signal.setitimer(signal.ITIMER_REAL, LOST_S, LOST_S)
        if not self._holding:
            raise KeyboardInterrupt

    def _raise_again(self, _number: int, _frame: FrameType | None) -> None:
        """Raise an interrupt again, but not while the main thread is handling an exception, in an except, a finally or
        a with, or postpones what it does.
        """
        if not self._holding and sys.exc_info()[0] is None:
            raise KeyboardInterrupt

    def _unraisable(self, what: Any) -> None:
        """Report nothing when Python drops an interrupt."""
        if self.received is None or not issubclass(what.exc_type, KeyboardInterrupt):
            self._unraisable_before(what)


# A fork that a block has made, as a pool of multiprocessing, answers signals as before the run.  Until it does they are
# blocked, since Python drops one that comes while it forks: such a pool would wait for ever for what it has ended.
_forking = threading.local()


def _before_fork() -> None:
    _forking.mask = signal.pthread_sigmask(signal.SIG_BLOCK, [*SIGNALS, signal.SIGALRM])


def _after_fork() -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, _forking.mask)


def _in_fork() -> None:
    for number in [*SIGNALS, signal.SIGALRM]:
        if isinstance(mine := getattr(signal.getsignal(number), "__self__", None), Interruptions):
            signal.signal(number, mine.before[number])
    _after_fork()


os.register_at_fork(before=_before_fork, after_in_parent=_after_fork, after_in_child=_in_fork)


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
        outer = getattr(signal.getsignal(signal.SIGTERM), "__self__", None)  # a watch that began earlier
        raise RunInterruptedError(interruptions.received or getattr(outer, "received", None) or signal.SIGINT) from stop
