"""The command group and the process around it: whatever ends a command becomes a message and an exit code, no text of
others controls the terminal, and results are printed in the width that there is.
"""

import atexit
import errno
import gc
import inspect
import io
import multiprocessing
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import click

import linksweep
from linksweep.sweep.cli import options
from linksweep.sweep.formatting import COMMAND, WIDTH, harmless

if TYPE_CHECKING:
    from linksweep.sweep.table_writer import Table

EXIT_FAILED_POINTS = 1
EXIT_BAD_INPUT = 2

LAST_SECOND = 1.0
"""Seconds that Python's own clean-up may take after a signal before the process ends without it."""

NO_LEAK_WARNING = "ignore:resource_tracker"
"""A filter of warnings for processes that are started: a sudden end leaves semaphores, and the process that removes
them would warn the user.
"""

MODULES = ("run", "look", "tables")
"""The modules of commands, as the help lists them; each is imported if none before it has the one that is asked for."""

SECTIONS: dict[str, dict[str, str]] = {name: {} for name in ("Run", "Look", "Compare", "Store care", "Your own")}
"""The commands as the help lists them."""

_stopped_by: list[int] = []
"""The signal that ended the command, if one did."""

# Else Python searches all imports for garbage at the end, which takes a fifth of a second.
atexit.register(gc.freeze)


HOW_TO_SET = """a function is FILE.py:NAME; --axis NAME=1,2,3 or --axis NAME=0:1:0.1 gives a parameter values,
--set NAME=VALUE one, also n_sim and seed
"""


class _Group(click.Group):
    """Lists its commands by what they are for; turns a SweepError of any command into one message and exit code 2, and
    a signal into exit code 128 plus its number.
    """

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        for module in MODULES:
            if cmd_name not in self.commands:
                import_module(f"{__package__}.{module}")
        return super().get_command(ctx, cmd_name)

    def list_commands(self, ctx: click.Context) -> list[str]:
        self.get_command(ctx, "")
        return super().list_commands(ctx)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        self.list_commands(ctx)
        for title, commands in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl(list(commands.items()), col_spacing=max(2, 12 - max(map(len, commands))))

    def main(self, args: Sequence[str] | None = None, *further: Any, **named: Any) -> Any:
        before, COMMAND[:] = COMMAND[:], ["sweep", *(sys.argv[1:] if args is None else args)]
        with _harmless_streams():
            try:
                return super().main(args, *further, **named)
            except SystemExit as end:
                # A full disk is noticed only now where the output was short.
                sys.stdout.flush()
                if (problem := getattr(sys.stdout, "problem", None)) is None:
                    raise
                click.echo(f"error: standard output cannot be written: {problem.strerror}", err=True)
                sys.exit(end.code or EXIT_BAD_INPUT)
            finally:
                COMMAND[:] = before

    def invoke(self, ctx: click.Context) -> Any:
        from linksweep.sweep.interrupt import RunInterruptedError, how_ended, watched

        try:
            with watched():
                # Click itself would end with 1 at Ctrl-C, which means that points failed.
                return super().invoke(ctx)
        except RunInterruptedError as stop:
            click.echo(how_ended(stop.signal.name), err=True)
            end_stopped(stop.signal)
        except click.UsageError as error:
            click.echo(f"error: {error.format_message()}", err=True)
            command = error.ctx.command_path if error.ctx else ctx.command_path
            is_set_wrong = isinstance(error, click.NoSuchOption) or "unexpected extra" in error.message
            hint = HOW_TO_SET if command == "sweep run" and is_set_wrong else ""
            click.echo(f"{hint}see {command} --help", err=True)
            sys.exit(error.exit_code)
        except linksweep.SweepError as error:
            where, problems = f"{error.where}: " if error.where else "", error.problems
            click.echo(f"error: {where}{problems[0] if len(problems) == 1 else f'{len(problems)} problems'}", err=True)
            for problem in problems if len(problems) > 1 else ():
                click.echo(f"  - {problem}", err=True)
            sys.exit(error.exit_code)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="linksweep", prog_name="linksweep")
def main() -> None:
    """Sweep Monte-Carlo simulations of a satellite's link to the extragalactic frame.

    \b
    sweep run quasars        the paper's Table 1, beside the published one
    sweep list               the other built-in studies
    sweep new mine           a study of your own to start from
    """


def command(section: str, summary: str, name: str | None = None) -> Callable[[Callable[..., Any]], click.Command]:
    """Return a decorator that makes a function, whose parameters declare its options, a command of a section."""

    def decorate(function: Callable[..., Any]) -> click.Command:
        declared = options.group(function)
        made = click.Command(
            name or function.__name__,
            params=list(declared.parameters().values()),
            callback=lambda **values: declared.call(values),
            help=inspect.getdoc(function),
            short_help=summary,
        )
        SECTIONS[section][str(made.name)] = summary
        main.add_command(made)
        return made

    return decorate


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
    # In `sys.warnoptions`, because only what stands there is passed on to processes that Python starts.
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
    # Threads of Dask and of C code may never come back; Python would join them first.
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
        # A progress bar hides the cursor.
        show_cursor = "\x1b[?25h" if os.isatty(2) else ""
        os.write(2, f"{show_cursor}stopped immediately\n".encode())
    os._exit(128 + number)


def _kill_children() -> None:
    for child in multiprocessing.active_children():
        child.kill()


class _Unfailing(io.TextIOWrapper):
    """A stream that keeps the first ``problem`` of writing to it instead of raising it.

    The error that the reader has gone, as `head` does, is still raised: click then ends the command quietly.
    """

    problem: OSError | None = None

    def write(self, text: str) -> int:
        with self._kept():
            super().write(text)
        return len(text)

    def flush(self) -> None:
        with self._kept():
            super().flush()

    @contextmanager
    def _kept(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if error.errno == errno.EPIPE:
                raise
            self.problem = self.problem or error


class _Harmless:
    """A stream for text of anybody: names, titles, results and messages of functions, tables and stores.

    What brings a style of our own writes to ``unescaped``.
    """

    # Whatever it is: click writes to the bytes below a stream of ASCII.
    encoding = "utf-8"

    def __init__(self, stream: Any) -> None:
        self.unescaped = stream

    def write(self, text: str) -> int:
        self.unescaped.write(harmless(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.unescaped, name)


@contextmanager
def _harmless_streams() -> Iterator[None]:
    """Escape control characters in what is printed in this block, and in the traceback of an error that leaves it."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(_Harmless, before)
    try:
        yield
    except SystemExit:
        # Any other error goes on to Python, which prints its traceback through these streams.
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


def print_wrapped(text: str, first: str = "", later: str = "") -> None:
    """Print a sentence in lines of the width of a terminal, the first and the later ones behind a prefix."""
    click.echo(click.wrap_text(text, WIDTH, first, later))


def print_styled(text: str, **style: bool) -> None:
    """Print text in a style of ours, which it cannot change."""
    click.secho(harmless(text), file=getattr(sys.stdout, "unescaped", None), **style)


def print_tables(tables: "Iterable[Table]", notes: Iterable[str] = ()) -> None:
    """Print tables with the columns for which there is room, and sentences below them; no number is cut."""
    # A file or a pipe has no width: the same bytes whatever terminal the command was typed in.
    is_terminal = sys.stdout.isatty()
    width = max(WIDTH, shutil.get_terminal_size((WIDTH, 0)).columns) if is_terminal else WIDTH
    for number, table in enumerate(tables):
        kept, left_out = table.fitting(width)
        text = kept.text(width, styled=is_terminal)
        click.echo(f"\n{text}" if number else text, file=getattr(sys.stdout, "unescaped", None))
        if left_out:
            print_wrapped(f"left out to fit {width} columns: {left_out}; --json has them")
    for sentence in notes:
        print_wrapped(sentence)


def print_result(dataset: Any, table_format: str) -> None:
    """Print results of any kind: their tables and notes, or their table for programs."""
    from linksweep.sweep.result import Result

    result = Result(dataset)
    if table_format == "text":
        notes = result.notes()
        print_tables(result.tables(), ["", *notes] if notes else ())
    else:
        click.echo(result.written(table_format).rstrip("\n"))


def print_headlines(dataset: Any, as_json: bool) -> None:
    """Print the headline results of a study and what is to be said about them, or all results for programs."""
    from linksweep.sweep.analysis.results_table import headline_table, notes

    if as_json:
        print_result(dataset, "json")
    else:
        print_tables([headline_table(dataset)], notes(dataset))


def drawing_styles() -> Any:
    """Return `linksweep.sweep.plots.style`; raises click.UsageError where matplotlib, which it needs, is missing."""
    try:
        from linksweep.sweep.plots import style
    except ImportError as error:
        raise click.UsageError(f"drawing needs matplotlib: pip install 'linksweep[plot]' ({error})") from error
    return style


def require_writable(path: Path) -> None:
    """Raise an error unless `save_result` can write there, as far as is known before there are results."""
    from linksweep.sweep.result import require_free

    if path.suffix.lower() == ".zarr":
        require_free(path)
    else:
        drawing_styles().require_format(path)


def save_result(dataset: Any, path: Path) -> None:
    """Write results as a Zarr store, or draw them in the way that suits them if the path is that of a picture."""
    from linksweep.sweep.result import Result

    if path.suffix.lower() == ".zarr":
        Result(dataset).save(path)
    else:
        from linksweep.sweep.plots.figure import draw_figure

        with (styles := drawing_styles()).settings():
            styles.save(draw_figure(dataset), path)
    click.echo(f"wrote {path}", err=True)
