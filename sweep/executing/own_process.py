"""Deals with what the code of an experiment may do to the process that runs it: fork it, or stop it."""

import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def forks_ended() -> Iterator[None]:
    """End a child process that was forked in this block as it leaves it: it would go on with the run beside its parent.

    The child ends as a Python process does: with the code of `sys.exit`, with 1 and a traceback, or with 0.
    """
    parent = os.getpid()
    try:
        yield
    except BaseException as error:
        if os.getpid() != parent:
            _end(error)
        raise
    if os.getpid() != parent:
        os._exit(0)


def _end(error: BaseException) -> None:
    code = error.code if isinstance(error, SystemExit) else 1
    if not isinstance(error, SystemExit):
        traceback.print_exception(error, file=sys.__stderr__)
    os._exit(0 if code is None else code if isinstance(code, int) else 1)


def is_interruption(error: BaseException) -> bool:
    """Return whether an exception stops the run, as the user's interruption does, which Python raises in the main
    thread of a process that answers SIGINT so.  All other exceptions belong to the experiment.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    return isinstance(error, KeyboardInterrupt) and in_main_thread and signal.getsignal(signal.SIGINT) is not ignored


def ignored(*_signal: object) -> None:
    """Ignore a signal in this process, but not in the programs that it starts, as SIG_IGN would."""
