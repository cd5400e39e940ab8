"""Ends a command that computes when it is stopped: soon, whatever its workers are doing, and leaving no process."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

LAST_SECOND = 1.0
"""Seconds that Python's own clean-up may take before the process ends without it."""

_stopped_by: list[int] = []
"""The signal that ended the command, if one did."""

NO_LEAK_WARNING = "ignore:resource_tracker"
"""A filter of warnings for processes that are started: a sudden end leaves semaphores, and the process that removes
them would warn the user.
"""


@contextmanager
def a_signal_ends_the_command() -> Iterator[None]:
    """Let SIGINT, SIGTERM and SIGHUP end the process at once in this block.

    A run inside the block handles the first of them itself and ends in good order; a signal that arrives here is a
    further one, or came before the run.
    """
    from linksweep.sweep.interrupt import SIGNALS

    answered = {number: signal.getsignal(number) for number in SIGNALS}
    before = {number: handler for number, handler in answered.items() if handler not in (signal.SIG_IGN, None)}
    for number in before:
        signal.signal(number, _leave_at_once)
    sys.warnoptions.append(NO_LEAK_WARNING)
    try:
        yield
    finally:
        sys.warnoptions.remove(NO_LEAK_WARNING)
        for number, handler in before.items():
            signal.signal(number, handler)


def end_stopped(number: int) -> NoReturn:
    """End the process with the exit code of a signal; workers that still compute are not waited for."""
    _stopped_by.append(number)
    _kill_children()
    without_clean_up = threading.Timer(LAST_SECOND, os._exit, (128 + number,))
    without_clean_up.daemon = True
    without_clean_up.start()
    sys.exit(128 + number)


def leave_with_exit_code() -> None:
    """End a process, after its clean-up, with the exit code of the signal that stopped its command, if one did.

    Python itself would end it by SIGINT if that interrupted code run by ``exec``, with which dataclasses are made.
    """
    if _stopped_by:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(128 + _stopped_by[-1])


def _leave_at_once(number: int, _frame: FrameType | None) -> NoReturn:
    _kill_children()
    with suppress(OSError):
        show_cursor = "\x1b[?25h" if os.isatty(2) else ""  # a progress bar hides it
        os.write(2, f"{show_cursor}stopped at once\n".encode())
    os._exit(128 + number)


def _kill_children() -> None:
    for child in multiprocessing.active_children():
        child.kill()
