"""Commands that compute: run, plan and scaling; what they run on, and what the user sees of it."""

import logging
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import click

from linksweep.sweep.cli import options
from linksweep.sweep.cli.group import EXIT_FAILED_POINTS, a_signal_ends_the_command, command, end_stopped
from linksweep.sweep.cli.options import FILE, WORKERS, choice, flag, group, opt, parsed
from linksweep.sweep.cli.output import drawing_styles, print_headlines, print_result, print_sentences, save_figure
from linksweep.sweep.executing.pools import DEFAULT_POOL, POOLS
from linksweep.sweep.formatting import COMMAND, WIDTH, counted, harmless, in_words, to_json, without_secrets

if TYPE_CHECKING:
    from linksweep.sweep.executing.pools import PoolName, Resources
    from linksweep.sweep.running.failures import MaxFailures
    from linksweep.sweep.stores.location import Location
    from linksweep.sweep.studies.study import Study

POSITIVE = click.FloatRange(0, min_open=True)
EXISTING = click.Path(exists=True, dir_okay=False, path_type=Path)

POOL_HELP = (
    f"What to run on here: {', '.join(pool.words for pool in POOLS.values())}.  "
    f"[default: {DEFAULT_POOL}; serial if small]"
)
WITH_WORKERS = [name for name, pool in POOLS.items() if pool.has_workers]

MEMORY_AT_LEAST = 200 * 10**6
"""Bytes that a worker needs for itself."""

DASK = [logging.getLogger(name) for name in ("distributed", "distributed.client")]
"""The second does not pass its messages on to the first."""


@parsed
def _bytes(text: str) -> int:
    from dask.utils import parse_bytes

    try:
        number = int(parse_bytes(text))
    except ValueError as error:
        raise ValueError(f"{text!r} is no number of bytes; write 2GB or 500MiB") from error
    if number < MEMORY_AT_LEAST:
        raise ValueError(f"{text!r} is less than the {MEMORY_AT_LEAST // 10**6} MB that a worker needs itself")
    return number


def resources(
    workers: int | None = opt("Local workers.  [default: one per core]", type=WORKERS),
    pool: "PoolName | None" = choice(POOL_HELP, POOLS),
    scheduler: str | None = opt("Use the Dask scheduler at this address, e.g. tcp://host:8786.", metavar="ADDRESS"),
    tls_ca: Path | None = opt("For a tls:// scheduler: the authority's certificate.", type=EXISTING),
    tls_cert: Path | None = opt("For a tls:// scheduler: our certificate.", type=EXISTING),
    tls_key: Path | None = opt("For a tls:// scheduler: our key.", type=EXISTING),
    cluster: Path | None = opt("Use the Dask cluster that this TOML or YAML file describes.", type=EXISTING),
    time_limit: float | None = opt("A block that takes longer fails.", type=POSITIVE, metavar="SECONDS"),
    memory_limit: int | None = opt(
        "A block whose local worker needs more fails, e.g. 2GB.  [default: an equal share each]",
        metavar="BYTES",
        callback=_bytes,
    ),
    dashboard: bool = flag("Give local workers Dask's dashboard; print its address."),
) -> "Resources":
    """Return what to run on; raises click.UsageError for options that contradict each other."""
    from linksweep.sweep.executing.pools import Limits, Resources

    if scheduler is not None and cluster is not None:
        raise click.UsageError("--scheduler and --cluster are two places; name one")
    local = workers is not None or pool is not None or memory_limit is not None
    if local and (scheduler or cluster):
        elsewhere = "--scheduler" if scheduler else "--cluster"
        raise click.UsageError(
            f"--workers, --pool and --memory-limit are for local workers; they do not go with {elsewhere}"
        )
    if workers is not None and pool is not None and not POOLS[pool].has_workers:
        raise click.UsageError(f"--pool {pool} has no workers")
    tls = (tls_ca, tls_cert, tls_key) if tls_ca and tls_cert and tls_key else None
    any_tls = tls_ca or tls_cert or tls_key
    if any_tls and (tls is None or scheduler is None or not scheduler.startswith("tls://")):
        raise click.UsageError("--tls-ca, --tls-cert and --tls-key go together, and with --scheduler tls://HOST:PORT")
    return Resources(workers, pool, scheduler, tls, cluster, Limits(time_limit, memory_limit), dashboard)


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


def watching(
    quiet: bool = flag("Print only errors, and the table.", "--quiet", "-q"),
    verbose: bool = flag("Print a line for each point, and Dask's warnings.", "--verbose", "-v"),
    log: TextIO | None = opt(
        "Append everything to FILE, with times and tracebacks.", metavar="FILE", callback=_log_file
    ),
) -> Watching:
    """Return what the user wants to see; raises click.UsageError for options that contradict each other."""
    if quiet and verbose:
        raise click.UsageError("--quiet and --verbose contradict each other")
    return Watching(logging.ERROR if quiet else logging.DEBUG if verbose else logging.INFO, log)


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


@contextmanager
def _logged(watching: Watching) -> Iterator[None]:
    """Send what a run says, and what Dask logs, to standard error and the log file in this block."""
    from linksweep.sweep.contract import SweepError
    from linksweep.sweep.running.progress import RECORD, SENTENCES, Sentences

    with ExitStack() as stack:

        def handle(handler: logging.Handler, *loggers: logging.Logger) -> None:
            for logger in loggers:
                logger.addHandler(handler)
                stack.callback(logger.removeHandler, handler)

        handle(Sentences(watching.level), SENTENCES)
        SENTENCES.setLevel(logging.DEBUG if watching.log is not None else watching.level)
        handle(logging.NullHandler(), RECORD)
        RECORD.propagate = False
        if watching.level == logging.DEBUG:
            warnings = Sentences(logging.WARNING)
            warnings.setFormatter(logging.Formatter("Dask: %(message)s"))
            handle(warnings, *DASK)
        if watching.log is not None:
            handle(_Lines(watching.log), SENTENCES, RECORD, *DASK)
            RECORD.info("%s", shlex.join(COMMAND))
        try:
            yield
        except SweepError as error:
            RECORD.error("%s: %s", error.where, "; ".join(error.problems))
            raise
        except Exception:
            RECORD.exception("unexpected")
            raise


@parsed
def _max_failures(text: str) -> "MaxFailures":
    from linksweep.sweep.running.failures import MaxFailures

    return MaxFailures.of(text)


@dataclass(frozen=True)
class Running:
    """How a study is run: on what, what the user sees (no results if ``as_json`` is None), and what it may continue."""

    resources: "Resources" = group(resources)
    watching: Watching = group(watching)
    as_json: bool | None = options.JSON
    break_lock: bool = options.BREAK_LOCK
    accept_code: bool = options.ACCEPT_CODE
    max_failures: "MaxFailures | None" = opt(
        "End the run when more points fail; 100% never.  [default: if the first 20 all fail for one reason]",
        metavar="N|P%",
        callback=_max_failures,
    )


def run_with_progress(
    study: "Study", store: "Location", how: Running, *, retry: bool = False, fresh: bool = False
) -> dict[str, str]:
    """Run a study with progress; print its table, then what the run took, and the answer last, or JSON alone.  Return
    why points failed.  An interruption ends the command.
    """
    from linksweep.sweep.analysis.answer import answer_in_short
    from linksweep.sweep.interrupt import RunInterruptedError
    from linksweep.sweep.running.progress import TerminalProgress
    from linksweep.sweep.running.run import run_study
    from linksweep.sweep.stores.location import short_name

    bar = how.watching.level < logging.ERROR
    with a_signal_ends_the_command(), _logged(how.watching), TerminalProgress(study, bar) as progress:
        try:
            dataset, failures = run_study(
                study, store, how.resources, progress, retry, how.break_lock, how.accept_code, fresh, how.max_failures
            )
        except RunInterruptedError as stop:
            progress.stopped(stop.signal.name, store)
            end_stopped(stop.signal)
        if how.as_json is not None:
            print_headlines(dataset, "json" if how.as_json else "text")
        name = short_name(store)
        next_commands = (f"sweep plot {name}", f"sweep report {name}")
        progress.finish(failures, store, () if how.as_json is None else next_commands)
    if how.as_json is False:
        print_sentences(answer_in_short(dataset))
    return failures


def print_verified(study: "Study", store: "Location", points: int, shown: bool = True) -> bool:
    """Compute some points of a store again, and say to standard error which differ; return whether any does.  That none
    does is only said if ``shown``.
    """
    from linksweep.sweep.running.reproduce import verify

    again = verify(study, store, points)
    for sentence in again.differing:
        click.echo(f"differs: {harmless(sentence)}", err=True)
    if shown and not again.differing:
        computed = counted(again.points, "point")
        click.echo(f"{computed} computed again, alone and in two orders: every bit as in {store}", err=True)
    return bool(again.differing)


@command("Run", "Run a study into a store; print table and answer")
def run(
    asked: options.AskedStudy = group(options.AskedStudy),
    how: Running = group(Running),
    retry: bool = flag("STUDY is a store: compute its failed points again, and only those."),
    fresh: bool = flag("Replace an existing store, whatever its study and code."),
    verify: int = opt(
        "At the end compute so many points again.", type=click.IntRange(0), default=0, show_default=False
    ),
) -> None:
    """Run STUDY (a built-in name or a TOML file) into a Zarr store, and print the table.

    After an interruption the same command resumes where it stopped.

    \b
    sweep run quasars
    sweep run quasars --set n_cat=20 -o results/quick.zarr
    sweep run my_study.toml --axis v_max=14:16:0.25 --workers 4 --log run.log
    sweep run sir.py:sir --design sobol:256 --range beta=0.1:0.5
    sweep run sir.py:sir --points runs.csv
    sweep run --retry results/quasars.zarr
    """
    if retry and fresh:
        raise click.UsageError("--retry and --fresh contradict each other")
    study, store = asked.stored() if retry else asked.load()
    failures = run_with_progress(study, store, how, retry=retry, fresh=fresh)
    differing = verify and print_verified(study, store, verify, how.watching.level < logging.ERROR)
    if failures or differing:
        sys.exit(EXIT_FAILED_POINTS)


@command("Run", "Say what a run would do, and write nothing")
def plan(
    asked: options.AskedStudy = group(options.AskedStudy),
    workers: int | None = opt("Local workers, for the estimate of the time.  [default: one per core]", type=WORKERS),
    accept_code: bool = options.ACCEPT_CODE,
    as_json: bool = options.JSON,
) -> None:
    """Say what a run of STUDY would do: points, realisations, tasks, memory, time, what is done already.

    \b
    sweep plan grid --set n_cat=100
    """
    from linksweep.sweep.running.failures import failed_before
    from linksweep.sweep.running.status import plan_report

    report = plan_report(*asked.load(), workers, accept_code)
    if as_json:
        click.echo(to_json(report))
        return
    failed = failed_before(report["points_failed"])
    lines = [
        ("study", report["title"]),
        ("grid", report["grid"]),
        ("points", f"{report['points']:,}, {report['points_done']:,} of them done{failed}"),
    ]
    if "realisations" in report:
        done = report["realisations"] - report["realisations_pending"]
        lines += [("realisations", f"{report['realisations']:,}, {done:,} of them done")]
    tasks = f" in about {counted(report['tasks_about'], 'task')}" if report["tasks_about"] else ""
    megabytes = [f"{report[f'{what}_mb']:,.3g} MB" for what in ("memory", "result", "ledger")]
    lines += [("work", f"{counted(report['blocks_pending'], 'block')}{tasks}")]
    lines += [("memory", "{}: {} of results, {} of ledger".format(*megabytes))]
    if "seconds" in report:
        cores = counted(report["cores"], "core")
        lines += [("time", f"at least {in_words(report['seconds'])} of computing on {cores} of this machine")]
    for key, text in [*lines, ("store", report["store"]), *(("warning", text) for text in report["warnings"])]:
        click.echo(click.wrap_text(text, WIDTH, f"{key:14}", 14 * " "))


@parsed
def _counts(text: str) -> tuple[int, ...]:
    words = text.split(",")
    if not all(word.strip().isdecimal() and len(word) < 6 for word in words):
        raise ValueError(f"{text!r} is no list of numbers of workers; write 1,2,4")
    return tuple(map(int, words))


@command("Run", "Measure how a study scales with workers")
def scaling(
    study: str = options.STUDY,
    workers: tuple[int, ...] = opt("Numbers of workers, from 1 up.", default="1,2", callback=_counts),
    pool: Any = choice("Workers are processes, or threads of this one.", WITH_WORKERS, default=DEFAULT_POOL),
    repetitions: int = opt(
        "How often to time every run; 5 or more give errors.", type=click.IntRange(1, 1000), default=3
    ),
    settings: Sequence[str] = options.SETTINGS,
    axes: Sequence[str] = options.AXES,
    output: Path | None = options.output("The measurements, as Zarr.  [default: results/NAME-scaling.zarr]"),
    figure: Path | None = opt("Also draw them with the ideal lines: .png, .svg, .pdf.", type=FILE),
    trust: bool = options.TRUST,
    as_json: bool = options.JSON,
) -> None:
    """Measure how STUDY scales with local workers: the same work on more of them (strong), and as much for each (weak).

    The results of the runs are thrown away; the time to start workers is measured separately.

    \b
    sweep scaling quasars --workers 1,2 --figure scaling.svg
    """
    if figure is not None:
        drawing_styles().require_format(figure)
    from linksweep.sweep.interrupt import RunInterruptedError
    from linksweep.sweep.result import Result, require_free
    from linksweep.sweep.running.scaling import measure_scaling
    from linksweep.sweep.stores.location import default_store

    loaded = options.load_trusted(study, trust, settings, axes)
    path = output or default_store(f"{loaded.name}-scaling")
    require_free(path)
    with a_signal_ends_the_command():
        try:
            dataset = measure_scaling(loaded, workers, pool, repetitions, lambda text: click.echo(text, err=True))
        except RunInterruptedError as stop:
            end_stopped(stop.signal)
    if as_json:
        records = Result(dataset).records()
        click.echo(to_json([dict(zip((c.name for c in records.columns), row, strict=True)) for row in records.rows]))
    else:
        print_result(dataset, "text")
    Result(dataset).save(path)
    if figure is not None:
        save_figure(dataset, figure)
    click.echo(f"wrote {path}" + (f" and {figure}" if figure is not None else ""), err=True)
