"""The command line: the group of commands, the arguments and options that several of them share, and the process around
them: whatever ends a command becomes a message and an exit code, no text of others controls the terminal, and results
are printed in the width that there is.

Each command calls one function of the library, imported when it is needed; a shell asks for options at each press of a
key, so that nothing heavy is imported here.
"""

import atexit
import codecs
import errno
import gc
import inspect
import io
import multiprocessing
import os
import select
import shutil
import signal
import sys
import textwrap
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import chdir, contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click
from click.shell_completion import CompletionItem

import linksweep
from linksweep.sweep.executing.pools import MOST_WORKERS
from linksweep.sweep.formatting import COMMAND, ESCAPED, WIDTH, harmless
from linksweep.sweep.interrupt import RunInterruptedError, answered, how_ended, watched
from linksweep.sweep.studies import built_in_studies

if TYPE_CHECKING:
    from linksweep.sweep.stores.location import Location
    from linksweep.sweep.table_writer import Table

# The type of the path of a file or folder, which need not exist.
FILE = click.Path(path_type=Path)

WORKERS = click.IntRange(1, MOST_WORKERS)
POSITIVE = click.FloatRange(0.0, min_open=True)

At = tuple[str, ...]


def opt(help: str, *names: str, **more: Any) -> Any:  # noqa: A002 (as click has it)
    """Declare an option as the default of a parameter, by which it is called if it has no ``names``."""
    # Else only the pages would say what happens without an option.
    more = {"show_default": more.get("default") != ""} | more
    return lambda name: click.Option([name, *(names or ["--" + name.replace("_", "-")])], help=help, **more)


def arg(**more: Any) -> Any:
    """Declare an argument as the default of a parameter."""
    return lambda name: click.Argument([name], **more)


class _Choice(click.Choice[str]):
    def get_invalid_choice_message(self, value: Any, ctx: click.Context | None) -> str:
        from linksweep.sweep.contract.experiment import nearest

        return super().get_invalid_choice_message(value, ctx).removesuffix(".") + nearest(str(value), self.choices)


def choice(help: str, choices: Iterable[str], *names: str, **more: Any) -> Any:  # noqa: A002
    """Declare an option with one of some words as its value."""
    return opt(help, *names, type=_Choice(list(choices)), **more)


def output(help: str, **more: Any) -> Any:  # noqa: A002
    """Declare ``-o``, a file to be written if ``more`` does not say otherwise."""
    return opt(help, "-o", "--output", **{"type": FILE} | more)


def parsed(parse: Callable[[str], Any]) -> Any:
    """Return a callback of an option that parses its value, or opens what it names; errors of that are usage errors."""

    def callback(context: click.Context, _parameter: click.Parameter, value: str | None) -> Any:
        if value is None or context.resilient_parsing:
            return None
        try:
            return parse(value)
        except (ValueError, OSError) as error:
            raise click.BadParameter(str(error)) from error

    return callback


many = partial(opt, multiple=True)
flag = partial(opt, is_flag=True)


@dataclass(frozen=True)
class Group:
    """A parameter that gets what ``make``, a function or class, makes of the options that it declares itself, or that
    ``options`` has.
    """

    make: Callable[..., Any]
    options: Mapping[str, Any]

    def parameters(self) -> dict[str, click.Parameter]:
        """Return the options and arguments of this group and of the groups in it, each once."""
        parameters: dict[str, click.Parameter] = {}
        for name, one in self.options.items():
            parameters.update(one.parameters() if isinstance(one, Group) else {name: one(name)})
        return parameters

    def call(self, values: Mapping[str, Any]) -> Any:
        """Return what this group makes of the values of its options."""
        options = self.options.items()
        return self.make(**{n: one.call(values) if isinstance(one, Group) else values[n] for n, one in options})


def group(make: Callable[..., Any]) -> Any:
    """Declare a parameter that gets what a function or class makes of the options that it declares."""
    return Group(make, {name: one.default for name, one in inspect.signature(make).parameters.items()})


def passed(**declared: Any) -> Any:
    """Declare a parameter that gets a dictionary with the values of these options, to be passed on."""
    return Group(dict, declared)


@parsed
def _named(text: Any) -> Any:
    """Return the place of what names an existing store, or the study whose store it is, or of several of these."""
    from linksweep.sweep.stores.location import store_named

    return tuple(map(store_named, text)) if isinstance(text, tuple) else store_named(text)


def _studies(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer the built-in studies and the TOML files here; where neither fits, whatever file the shell knows."""
    names = [*built_in_studies(), *sorted(path.name for path in Path().glob("*.toml"))]
    fitting = [CompletionItem(name) for name in names if name.startswith(incomplete)]
    # A shell takes one kind or the other.
    return fitting or [CompletionItem(incomplete, type="file")]


def _folders(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(incomplete, type="dir")]


STORE = arg(callback=_named, shell_complete=_folders)
STORES = arg(nargs=-1, metavar="STORE...", callback=_named, shell_complete=_folders)
STUDY = arg(shell_complete=_studies)
AT = many("Only this part of the grid, e.g. model=gaia,v_max=16.", metavar="AXIS=VALUE")
JSON = flag("Print JSON for a script.", "--json")
BREAK_LOCK = flag("Continue although another host seems to write to the store; make sure that it does not.")
ACCEPT_CODE = flag("Continue with points that other code made; each records which code made it.")
TRUST = flag("Allow code that is inside a store, or that a store from elsewhere names.")
AXES = many("Override or add an axis: 14:20:0.5, 0:1:lin5, 1:9:log3.", "--axis", metavar="NAME=SPEC")
SETTINGS = many("Set a parameter or key of sampling: n_sim=500.", "--set", metavar="KEY=VALUE")
DESIGNS = "e.g. sobol:256 or sobol:256:SEED; latin-hypercube, halton, random, saltelli, morris."


@dataclass(frozen=True)
class AskedStudy:
    """A study as the command line names it: its overrides, which are those of `load_study`, where its store is to be,
    and whether code inside a store is trusted.
    """

    study: str = STUDY
    overrides: Mapping[str, Any] = passed(
        settings=SETTINGS,
        axes=AXES,
        points=opt("Compute the points in this table: a column for each parameter.", metavar="FILE"),
        design=opt(f"Compute a design of points, {DESIGNS}", metavar="NAME:N"),
        ranges=many("A range of the design: 0.1:0.5, 1:100:log or a,b.", "--range", metavar="NAME=SPEC"),
        exclude=many("Leave points out: kernel=linear,gamma>1.", "--exclude", metavar="CONDITIONS"),
    )
    output: str | None = output("The store: a path or s3://BUCKET/NAME.  [default: results/NAME.zarr]", type=str)
    trust: bool = TRUST

    def load(self, part: str | None = None) -> "tuple[linksweep.Study, Location]":
        """Return the study, or a part of it, and where its store is; raises SweepError for one inside a store that is
        not trusted.
        """
        from linksweep.sweep.running.run import with_part
        from linksweep.sweep.stores.location import default_store

        here = os.getcwd()
        study = load_trusted(self.study, self.trust, **self.overrides)
        with chdir(here):  # code that was imported may have changed it
            return with_part(study, default_store(study.name) if self.output is None else self.output, part)

    def stored(self) -> "tuple[linksweep.Study, Location]":
        """Return the study of an existing store, named in its place, and the store; raises SweepError as `load`."""
        from linksweep.sweep.running.reproduce import study_of
        from linksweep.sweep.stores.location import store_named

        if self.output or any(self.overrides.values()):
            raise click.UsageError("--retry computes points of a store as it is: name the store, without other changes")
        store = store_named(self.study)
        return study_of(store, trust=self.trust), store


def load_trusted(study: str, trust: bool, **overrides: Any) -> "linksweep.Study":
    """Return a study with the overrides of `load_study`; raises SweepError for one in a store that is not trusted."""
    from linksweep.sweep.studies.reader import find_study, reference_in

    # Before anything is read: a study or a function inside a store came with the store, from whoever sent that.
    place = find_study(study) if (function := reference_in(study)) is None else Path(function.rpartition(":")[0])
    if (store := store_around(place)) is not None and not trust and (function is None or place.suffix == ".py"):
        reason = f"lies inside the store {store}, and would run what it names"
        raise linksweep.SweepError(f"{reason}; inspect it, and give --trust if it may run", str(place))
    return linksweep.load_study(study, **overrides)


def store_around(path: Path) -> Path | None:
    """Return the store in which a path lies, None if it lies in none."""
    from linksweep.sweep.stores.integrity import ROOT

    return next((folder for folder in path.resolve().parents if (folder / ROOT).is_file()), None)


def link_in(store: "Location | str", at: At) -> Any:
    """Return the link, forecast or other table that a store holds, None for a grid; ``--at`` is only for a grid."""
    from linksweep.sweep.result import stored_table

    result = stored_table(store)
    if result is not None and at:
        raise click.UsageError(f"--at chooses a part of a grid; this is a {result.kind}")
    return None if result is None else result.dataset


@contextmanager
def part_of(store: "Location", at: At, excluded_too: bool = False, to_show: bool = False) -> Iterator[Any]:
    """Give the part of a store's dataset that ``--at`` names; ``to_show`` with values so far, or what else than a grid
    the store holds.  Errors in the block name the store unless they say what they are about.

    Raises SweepError where the study has no point in that part, unless ``excluded_too``.
    """
    from linksweep.sweep.analysis.quantity import ERROR_SUFFIXES, array_outputs, select, with_running
    from linksweep.sweep.contract import Status, refused
    from linksweep.sweep.stores.store import OpenStore
    from linksweep.sweep.studies.reader import parse_places

    places = parse_places(at)
    if to_show and (link := link_in(store, at)) is not None:
        yield link
        return
    dataset = with_running(OpenStore(store).dataset(to_show))
    with refused(linksweep.SweepError, where=store):  # what knows only datasets cannot name the store
        part = select(dataset, places)
        for name in set(array_outputs(dataset)) - set(array_outputs(part)):
            if not name.endswith(ERROR_SUFFIXES):
                # A place along an output's own dimension is for that output.
                part[name].attrs["headline"] = 1
        if at and not excluded_too and (part["status"].values == Status.EXCLUDED).all():
            raise linksweep.SweepError(f"--at {','.join(at)}: the study has no point there")
        yield part


EXIT_FAILED_POINTS = 1
EXIT_BAD_INPUT = 2

# The least columns of a terminal that tables and sentences are made to fit.
NARROWEST = 40

# Seconds that Python's own clean-up may take after a signal before the process ends without it.
LAST_SECOND = 1.0

# A filter of warnings for processes that are started: a sudden end leaves semaphores, and the process that removes
# them would warn the user.
NO_LEAK_WARNING = "ignore:resource_tracker"

# The commands as the help lists them.
SECTIONS: dict[str, dict[str, str]] = {name: {} for name in ("Run", "Look", "Compare", "Store care", "Your own")}

# The standard output of the command: while it works, `sys.stdout` is standard error, for what others print.
RESULTS: list[Any] = [None]

# What tables and tiles are made of, for streams whose encoding lacks it.
PLAIN = {"±": "+-", "█": "#", "×": "x", "·": ".", "…": ".", **dict(zip("▁▂▃▄▅▆▇", "1234567", strict=True))}

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
        for module in ("run", "look"):  # as the help lists them; the second only for commands that the first lacks
            if cmd_name not in self.commands:
                import_module(f"{__name__}.{module}")
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
                if (problem := _Unfailing.problem) is None:
                    raise
                if problem.errno == errno.EPIPE:
                    sys.exit(128 + signal.SIGPIPE)
                click.echo(f"error: standard output cannot be written: {problem.strerror}", err=True)
                sys.exit(end.code or EXIT_BAD_INPUT)
            finally:
                COMMAND[:] = before

    def invoke(self, ctx: click.Context) -> Any:
        try:
            with watched():
                # Click itself would end with 1 at Ctrl-C, which means that points failed.
                return super().invoke(ctx)
        except RunInterruptedError as stop:
            click.echo(how_ended(stop.signal.name), err=True)
            end_stopped(stop.signal)
        except click.UsageError as error:
            click.echo(f"error: {error.format_message().replace(' range.', '.')}", err=True)  # of Click's types
            command = error.ctx.command_path if error.ctx else ctx.command_path
            is_set_wrong = isinstance(error, click.NoSuchOption) or "unexpected extra" in error.message
            hint = HOW_TO_SET if command == "sweep run" and is_set_wrong else ""
            click.echo(f"{hint}see {command} --help", err=True)
            sys.exit(error.exit_code)
        except linksweep.SweepError as error:
            where, problems = f"{error.where.translate(ESCAPED)}: " if error.where else "", error.problems
            click.echo(f"error: {where}{problems[0] if len(problems) == 1 else f'{len(problems)} problems'}", err=True)
            for problem in problems if len(problems) > 1 else ():
                click.echo(f"  - {problem}", err=True)
            sys.exit(error.exit_code)


# Click would drop terminal sequences where there is no terminal: they are escaped, as all control characters are.
@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"], "color": True})
@click.version_option(package_name="linksweep", prog_name="linksweep")
def main() -> None:
    """Sweep Python functions, or Monte-Carlo simulations of a satellite's link, over grids of parameters.

    \b
    sweep run quasars        the paper's Table 1, beside the published one
    sweep list               the other built-in studies
    sweep new mine           a study of your own to start from
    sweep run FILE.py:FUNCTION --axis x=0:1:0.1    a function of your own
    """
    try:
        os.getcwd()
    except FileNotFoundError as error:
        raise linksweep.SweepError("the present folder was removed; change to another one") from error


def command(section: str, summary: str, name: str | None = None) -> Callable[[Callable[..., Any]], click.Command]:
    """Return a decorator that makes a function, whose parameters declare its options, a command of a section."""

    def decorate(function: Callable[..., Any]) -> click.Command:
        declared = group(function)

        def call(**values: Any) -> None:
            if not gc.isenabled():
                gc.freeze()  # what is imported is not garbage, nor is it searched again later
                gc.enable()
            RESULTS[0] = sys.stdout
            with redirect_stdout(sys.stderr):
                declared.call(values)

        made = click.Command(
            name or function.__name__,
            params=list(declared.parameters().values()),
            callback=call,
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
    with answered(_leave_at_once):
        # In `sys.warnoptions`, because only what stands there is passed on to processes that Python starts.
        sys.warnoptions.append(NO_LEAK_WARNING)
        try:
            yield
        finally:
            sys.warnoptions.remove(NO_LEAK_WARNING)


def end_stopped(number: int) -> NoReturn:
    """End the process with the exit code of a signal; workers that still compute are not waited for."""
    _kill_children()
    # Threads of Dask and of C code may never come back; Python would join them first.
    without_clean_up = threading.Timer(LAST_SECOND, os._exit, (128 + number,))
    without_clean_up.daemon = True
    without_clean_up.start()
    sys.exit(128 + number)


def _leave_at_once(number: int, _frame: object) -> NoReturn:
    _kill_children()
    with suppress(OSError):
        # A progress bar hides the cursor.
        show_cursor = "\x1b[?25h" if os.isatty(2) else ""
        os.write(2, f"{show_cursor}stopped immediately\n".encode())
    os._exit(128 + number)


def _kill_children() -> None:
    for child in multiprocessing.active_children():
        child.kill()


class _Unfailing(io.FileIO):
    """A stream that loses what cannot be written instead of failing; ``problem`` is the first one with results.

    That the reader of results has gone, as `head` does, is raised once: click then ends the command quietly.
    """

    problem: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            while (written := super().write(data)) is None:
                select.select((), (self,), ())  # the pipe is full, and does not block
            return written
        except OSError as error:
            if self.fileno() != 2 and _Unfailing.problem is None:
                _Unfailing.problem = error
                if error.errno == errno.EPIPE:
                    raise
            return len(data)


class _Harmless:
    """A stream for text of anybody: names, titles, results and messages of functions, tables and stores.

    What brings a style of our own writes to ``unescaped``.
    """

    # Whatever it is: click writes to the bytes below a stream of ASCII.
    encoding = "utf-8"

    def __init__(self, stream: Any) -> None:
        self.unescaped = stream

    def write(self, text: str) -> int:
        shown = harmless(text)
        if self.isatty() and self.fileno() == 2:  # sentences; tables fit, or have no more room
            width = columns(self)
            shown = "\n".join(in_lines(one, width) if len(one) > width else one for one in shown.split("\n"))
        self.unescaped.write(shown)
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


def _plainly(error: UnicodeError) -> tuple[str | bytes, int]:
    if isinstance(error, UnicodeEncodeError) and (plain := PLAIN.get(error.object[error.start])):
        return plain, error.start + 1
    return codecs.backslashreplace_errors(error)


codecs.register_error("plainly", _plainly)


def prepare_streams() -> None:
    """Make the standard streams usable whatever this process was started with.

    A closed one is connected to the null device, because the next file to be opened would take its place and be written
    to.  Characters that the encoding of a stream does not have are escaped.  Standard output has results alone.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # becomes the first that is free
    out = 1
    if not os.path.samestat(os.fstat(1), os.fstat(2)):
        # What C code prints, and programs that code of the user's starts, is no result.
        out = os.dup(1)
        os.dup2(2, 1)
    sys.stdin = sys.stdin or open(0, encoding="utf-8", closefd=False)  # noqa: SIM115 (to the end)
    for descriptor, name in ((out, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is None or isinstance(stream, io.TextIOWrapper):
            # Without a buffer, what does not go out in one write would be lost.
            lines = any(getattr(stream, kind, False) for kind in ("line_buffering", "write_through"))
            file = io.BufferedWriter(_Unfailing(descriptor, "wb", closefd=False))
            encoding = getattr(stream, "encoding", "utf-8")
            setattr(sys, name, io.TextIOWrapper(file, encoding, "plainly", None, lines))


def put(text: str = "") -> None:
    """Print a result."""
    click.echo(text, file=RESULTS[0])


def wrote(path: object, more: str = "") -> None:
    """Say that a file or a store was written."""
    click.echo(f"wrote {str(path).translate(ESCAPED)}{more}", err=True)


def columns(stream: Any = None) -> int:
    """Return the width of the terminal of a stream, by default of results, that of sentences where it has none or there
    is no terminal: a file has the same bytes whatever terminal the command was typed in.
    """
    stream = stream or RESULTS[0]
    if not stream.isatty():
        return WIDTH
    return max(NARROWEST, shutil.get_terminal_size(os.get_terminal_size(stream.fileno())).columns or WIDTH)


def in_lines(text: str, width: int, first: str = "", later: str = "") -> str:
    """Return a sentence in lines of a width, the first and the later ones behind a prefix; no word is broken, since it
    may be a name.
    """
    wrapper = textwrap.TextWrapper(width, first, later, replace_whitespace=False)
    wrapper.break_long_words = wrapper.break_on_hyphens = False
    return wrapper.fill(text)


def print_wrapped(text: str, first: str = "", later: str = "", **style: bool) -> None:
    """Print a sentence in a style and in lines of the width of a terminal, as `in_lines` has them."""
    print_styled(in_lines(text, min(WIDTH, columns()), first, later), **style)


def _has_styles() -> bool:
    return RESULTS[0].isatty() and os.environ.get("TERM") != "dumb"


def print_styled(text: str, **style: bool) -> None:
    """Print text in a style of ours, which it cannot change."""
    click.secho(harmless(text), file=RESULTS[0].unescaped, color=_has_styles(), reset=bool(style), **style)


def print_tables(tables: "Iterable[Table]", notes: Iterable[str] = ()) -> None:
    """Print tables with the columns for which there is room, and sentences below them; no number is cut."""
    width = columns()
    for number, table in enumerate(tables):
        kept, left_out = table.fitting(width)
        text = kept.text(width, styled=_has_styles())
        click.echo(f"\n{text}" if number else text, file=RESULTS[0].unescaped)
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
        put(result.written(table_format).rstrip("\n"))


def print_headlines(dataset: Any, as_json: bool) -> None:
    """Print the headline results of a study and what is to be said about them, or all results for programs."""
    from linksweep.sweep.analysis.tables import headline_table, notes

    if as_json:
        print_result(dataset, "json")
    else:
        print_tables([headline_table(dataset)], notes(dataset))


def with_extra(extra: str, package: str, module: str) -> Any:
    """Return a module of ours; raises SweepError where a package of the extra, which it needs, is missing."""
    from linksweep.sweep.contract import needed

    with needed(package, extra):
        return import_module(f"linksweep.sweep.{module}")


drawing_styles = partial(with_extra, "plot", "matplotlib", "plots.style")
