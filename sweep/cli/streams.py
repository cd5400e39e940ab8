"""Standard streams: what is closed, full or of a narrow encoding ends no command in a traceback, and no text of others
controls the terminal.
"""

import errno
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from linksweep.sweep.formatting import harmless


class _Unfailing(io.TextIOWrapper):
    """A stream that keeps the first ``problem`` of writing to it instead of raising it.

    The error that the reader has gone, as `head` does, is still raised: click then ends the command quietly.
    """

    problem: OSError | None = None

    def write(self, text: str) -> int:
        try:
            return super().write(text)
        except OSError as error:
            self._keep(error)
            return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            self._keep(error)

    def _keep(self, error: OSError) -> None:
        if error.errno == errno.EPIPE:
            raise error
        self.problem = self.problem or error


class _Harmless:
    """A stream for text of anybody: names, titles, results and messages of functions, tables and stores.

    What brings a style of our own writes to ``unescaped``.
    """

    encoding = "utf-8"
    """Whatever it is: click writes to the bytes below a stream of ASCII."""

    def __init__(self, stream: Any) -> None:
        self.unescaped = stream

    def write(self, text: str) -> int:
        self.unescaped.write(harmless(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.unescaped, name)


@contextmanager
def harmless_streams() -> Iterator[None]:
    """Escape control characters in what is printed in this block, and in the traceback of an error that leaves it."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(_Harmless, before)
    try:
        yield
    except SystemExit:
        sys.stdout, sys.stderr = before
        raise


def prepare_streams() -> None:
    """Make the standard streams usable whatever this process was started with.

    A closed one is connected to the null device, because the next file to be opened would take its place and be written
    to.  Characters that the encoding of a stream does not have are escaped.
    """
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(descriptor)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != descriptor:
                os.dup2(opened, descriptor)
                os.close(opened)
        stream = getattr(sys, name)
        if descriptor == 0:
            sys.stdin = stream or open(descriptor, encoding="utf-8", closefd=False)  # noqa: SIM115 (to the end)
        elif stream is None:
            setattr(sys, name, _Unfailing(open(descriptor, "wb", closefd=False), "utf-8"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper):
            lines, through = stream.line_buffering, stream.write_through
            unfailing = _Unfailing(stream.buffer, stream.encoding, "backslashreplace", None, lines, through)
            setattr(sys, name, unfailing)


def output_problem() -> str | None:
    """Return in a sentence why not all of standard output could be written, None where it could."""
    sys.stdout.flush()
    problem = getattr(sys.stdout, "problem", None)
    return None if problem is None else f"standard output cannot be written: {problem.strerror}"
