"""The options that say what of a run goes to standard error, and what to a log file."""

import logging
import shlex
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import click

from linksweep.sweep.cli.options import gathered
from linksweep.sweep.formatting import COMMAND, harmless, without_secrets

DASK = [logging.getLogger(name) for name in ("distributed", "distributed.client")]
"""The second does not pass its messages on to the first."""


@dataclass(frozen=True)
class Watching:
    """How much the user wants to see: ``level`` of the logging module, and the log file."""

    level: int = logging.INFO
    log: TextIO | None = None


def _log_file(context: click.Context, _parameter: click.Parameter, value: str | None) -> TextIO | None:
    if value is None or context.resilient_parsing:
        return None
    try:
        return context.with_resource(Path(value).open("a", encoding="utf-8", errors="backslashreplace", buffering=1))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise click.BadParameter(f"{value!r} cannot be written: {reason}") from error


def _watching(quiet: bool, verbose: bool, log: TextIO | None) -> Watching:
    if quiet and verbose:
        raise click.UsageError("--quiet and --verbose contradict each other")
    return Watching(logging.ERROR if quiet else logging.DEBUG if verbose else logging.INFO, log)


watching_options = gathered(
    "watching",
    _watching,
    click.option("--quiet", "-q", is_flag=True, help="Print only errors, and the table."),
    click.option("--verbose", "-v", is_flag=True, help="Print a line for each point, and Dask's warnings."),
    click.option(
        "--log", metavar="FILE", callback=_log_file, help="Append everything to FILE, with times and tracebacks."
    ),
)


@contextmanager
def told(watching: Watching) -> Iterator[None]:
    """Send what a run says, and what Dask logs, to standard error and the log file in this block."""
    from linksweep.sweep.contract import SweepError
    from linksweep.sweep.running.progress import RECORD, SENTENCES, Sentences

    with ExitStack() as stack:
        stack.enter_context(_handled(Sentences(watching.level), SENTENCES))
        SENTENCES.setLevel(logging.DEBUG if watching.log is not None else watching.level)
        stack.enter_context(_handled(logging.NullHandler(), RECORD))
        RECORD.propagate = False
        if watching.level == logging.DEBUG:
            warnings = Sentences(logging.WARNING)
            warnings.setFormatter(logging.Formatter("Dask: %(message)s"))
            stack.enter_context(_handled(warnings, *DASK))
        if watching.log is not None:
            stack.enter_context(_handled(_Lines(watching.log), SENTENCES, RECORD, *DASK))
            RECORD.info("%s", shlex.join(COMMAND))
        try:
            yield
        except SweepError as error:
            RECORD.error("%s: %s", error.where, "; ".join(error.problems))
            raise
        except Exception:
            RECORD.exception("unexpected")
            raise


@contextmanager
def _handled(handler: logging.Handler, *loggers: logging.Logger) -> Iterator[None]:
    for logger in loggers:
        logger.addHandler(handler)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeHandler(handler)


class _Lines(logging.Handler):
    """Writes to an open file; not a StreamHandler, which Dask would silence with its own."""

    def __init__(self, file: TextIO) -> None:
        super().__init__()
        self._file = file
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._file.write(without_secrets(harmless(self.format(record))) + "\n")
        except OSError:
            self.handleError(record)
