"""Deals with what the code of an experiment may do to the process that runs it: change it, fork it, or stop it."""

import decimal
import os
import random
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np

from linksweep.sweep.executing.upstream import environment


class Surroundings:
    """What code may change about its process and what is put back cheaply: the working folder, the environment, the
    standard streams, and the warnings that are shown.
    """

    def __init__(self) -> None:
        """Remember them as they are."""
        self._folder = _working_folder()
        self._environment, self._values = environment(), dict(os.environ)
        self._streams = sys.stdin, sys.stdout, sys.stderr
        self._filters = list(warnings.filters)

    def restore(self) -> None:
        """Put back what has been changed."""
        if self._folder is not None and _working_folder() != self._folder:
            with suppress(OSError):  # it may be gone
                os.chdir(self._folder)
        if environment() != self._environment:
            for name in os.environ.keys() - self._values.keys():
                del os.environ[name]
            os.environ.update(self._values)
        sys.stdin, sys.stdout, sys.stderr = self._streams
        if warnings.filters != self._filters:
            warnings.resetwarnings()
            warnings.filters[:] = self._filters  # type: ignore[index]


def _working_folder() -> str | None:
    with suppress(OSError):
        return os.getcwd()
    return None


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Start the generators that NumPy and Python keep for a process from a ``seed`` in this block, and let what the
    block sets for the arithmetic of NumPy and of decimals end with it.
    """
    np.random.seed(seed)  # noqa: NPY002 (for code that draws from it, although it should not)
    random.seed(seed)
    with np.errstate(), decimal.localcontext():
        yield


@contextmanager
def generators_restored() -> Iterator[None]:
    """Give the generators that NumPy and Python keep for a process back as they were before this block."""
    of_numpy, of_python = np.random.get_state(), random.getstate()  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(of_numpy)  # noqa: NPY002
        random.setstate(of_python)


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
