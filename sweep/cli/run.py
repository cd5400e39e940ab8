"""Commands that compute: a study into a store (run, refine, plan, scaling, submit), and the care of stores (status,
check, reproduce, merge), with what they run on and what the user sees of it; what to begin a study with (new, params);
and real tables (tie, forecast and apply for a link, match for the galaxies among stars).
"""

import io
import json
import logging
import re
import shlex
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import click

import linksweep
from linksweep.sweep import cli
from linksweep.sweep.cli import FILE, JSON, POSITIVE, WORKERS, arg, choice, flag, many, opt, parsed, passed
from linksweep.sweep.executing.pools import DEFAULT_POOL, POOLS, PoolName, Resources
from linksweep.sweep.formatting import COMMAND, counted, harmless, in_words, meaning_beside, to_json, typed
from linksweep.sweep.interrupt import RunInterruptedError
from linksweep.sweep.search.options import SearchOptions
from linksweep.sweep.tables.options import Declared, declared
from linksweep.sweep.tie.options import FORECAST, TIE, ApplyOptions, ForecastOptions, Options

if TYPE_CHECKING:
    import xarray as xr

    from linksweep.sweep.running import results, run as runs
    from linksweep.sweep.stores.location import Location

EXISTING = click.Path(exists=True, dir_okay=False, path_type=Path)

POOL_HELP = (
    f"What to run on here: {', '.join(pool.words for pool in POOLS.values())}.  "
    f"[default: {DEFAULT_POOL}; serial if small]"
)
WITH_WORKERS = [name for name, pool in POOLS.items() if pool.has_workers]

# Programs that `sweep status` names in a terminal: numbers may depend on their versions.
DECIDING = ("linksweep", "python", "numpy", "scipy")

# The second does not pass its messages on to the first.
DASK = [logging.getLogger(name) for name in ("distributed", "distributed.client")]

WHOLE = "every file is as it was written"
OTHER_CODE = "computed by other code than the store was: "


@parsed
def _bytes(text: str) -> int:
    # The same words as in Dask's own configuration.
    from dask.utils import parse_bytes

    try:
        return int(parse_bytes(text))
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{text!r} is no number of bytes like 2GB or 500MiB") from error


def resources(
    workers: int | None = opt("Local workers.  [default: one per core]", type=WORKERS),
    pool: PoolName | None = choice(POOL_HELP, POOLS),
    scheduler: str | None = opt("Use the Dask scheduler at this address, e.g. tcp://host:8786.", metavar="ADDRESS"),
    tls_ca: Path | None = opt("For a tls:// scheduler: the authority's certificate.", type=EXISTING),
    tls_cert: Path | None = opt("For a tls:// scheduler: our certificate.", type=EXISTING),
    tls_key: Path | None = opt("For a tls:// scheduler: our key.", type=EXISTING),
    cluster: Path | None = opt("Use the Dask cluster that this TOML or YAML file describes.", type=EXISTING),
    time_limit: float | None = opt("A block that takes longer fails.", type=POSITIVE, metavar="SECONDS"),
    memory_limit: int | None = opt(
        "A block that needs more fails, e.g. 2GB.  [default: an equal share each]", metavar="BYTES", callback=_bytes
    ),
    dashboard: bool = flag("Give local workers Dask's dashboard; print its address."),
) -> Resources:
    """Return what to run on; raises click.UsageError for options that contradict each other."""
    tls = (tls_ca, tls_cert, tls_key) if tls_ca and tls_cert and tls_key else None
    if (tls_ca or tls_cert or tls_key) and (tls is None or not (scheduler or "").startswith("tls://")):
        raise click.UsageError("--tls-ca, --tls-cert and --tls-key go together, and with --scheduler tls://HOST:PORT")
    return Resources(workers, pool, scheduler, tls, cluster, linksweep.Limits(time_limit, memory_limit), dashboard)


def _appended(name: str, begin: bytes) -> Any:
    """Return the callback of an option that opens a file to append to; what is there has to ``begin`` as its own."""

    @parsed
    def opened(text: str) -> TextIO:
        if text == "-":
            raise ValueError("standard output has the results; name a file")
        if store := cli.store_around(path := Path(text)):
            raise ValueError(f"{text!r} lies inside the store {store}")
        with path.open("rb") if path.is_file() else io.BytesIO() as there:
            if re.match(begin, there.read(40)) is None:
                raise ValueError(f"{text!r} exists, and is no file of --{name}")
        # Nothing stays in a buffer: on a full disk it could not be written at the end, either.
        file = io.TextIOWrapper(path.open("ab", 0), "utf-8", "backslashreplace", write_through=True)
        return click.get_current_context().with_resource(file)

    return opened


LOG = _appended("log", rb"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} [A-Z]+ |$)")
EVENTS = _appended("events", rb'(\{"event": |$)')


@dataclass(frozen=True)
class Watching:
    """How much the user wants to see, and the log file; raises click.UsageError for options that contradict."""

    quiet: bool = flag("Print no progress.", "--quiet", "-q")
    verbose: bool = flag("Print a line for each point, and Dask's warnings.", "--verbose", "-v")
    log: TextIO | None = opt("Append everything to FILE, with times.", metavar="FILE", callback=LOG)
    events: TextIO | None = opt("Append events to FILE, for programs: JSON lines.", metavar="FILE", callback=EVENTS)

    def __post_init__(self) -> None:
        if self.quiet and self.verbose:
            raise click.UsageError("--quiet and --verbose contradict each other")


@contextmanager
def _logged(watching: Watching) -> Iterator[None]:
    """Send what a run says, and what Dask logs, to standard error and the log file in this block."""
    from linksweep.sweep.running.progress import RECORD, SENTENCES, Lines

    level = logging.ERROR if watching.quiet else logging.DEBUG if watching.verbose else logging.INFO
    with ExitStack() as stack:

        def handle(handler: logging.Handler, *loggers: logging.Logger) -> None:
            for logger in loggers:
                logger.addHandler(handler)
                stack.callback(logger.removeHandler, handler)

        handle(Lines(level), SENTENCES)
        SENTENCES.setLevel(logging.DEBUG if watching.log is not None else level)
        logging.disable(logging.NOTSET)  # whatever the user's code did while it was imported
        for logger in (SENTENCES, RECORD):
            # Handlers of that code would say it again.
            stack.callback(setattr, logger, "propagate", logger.propagate)
            logger.propagate = logger.disabled = False
        if watching.verbose:
            handle(Lines(logging.WARNING, "Dask: %(message)s"), *DASK)
        if watching.log is not None:
            file = Lines(logging.NOTSET, "%(asctime)s %(levelname)s %(message)s", watching.log)
            handle(file, SENTENCES, RECORD, *DASK)
            RECORD.info("%s", shlex.join(COMMAND))
        try:
            yield
        except Exception as error:
            # The command prints it; the log file has to have it, too.
            RECORD.error("%s: %s", type(error).__name__, error)
            raise


@dataclass(frozen=True)
class Running:
    """How a study is run: on what, what the user sees (no results if ``as_json`` is None), and what it may continue."""

    resources: Resources = cli.group(resources)
    watching: Watching = cli.group(Watching)
    as_json: bool | None = cli.JSON
    break_lock: bool = cli.BREAK_LOCK
    accept_code: bool = cli.ACCEPT_CODE
    max_failures: str | None = opt("Stop when more points fail.  [default: if the first 20 fail alike]", metavar="N|P%")


def run_with_progress(
    study: "linksweep.Study", store: "Location", how: Running, beside: "runs.Beside | None" = None
) -> "tuple[results.Labelled, dict[str, str]]":
    """Run a study with progress; print its table, then what the run took, and the answer last, or JSON alone.  Return
    the results, and why points failed.  An interruption ends the command.
    """
    from linksweep.sweep.analysis.answer import CONCLUSION, answer_in_short
    from linksweep.sweep.running import progress as watching, run as running
    from linksweep.sweep.stores.location import short_name

    shown = watching.TerminalProgress(study, not how.watching.quiet, how.watching.events)
    with cli.a_signal_ends_the_command(), _logged(how.watching), shown as progress:
        try:
            rest = how.accept_code, how.max_failures, beside or running.ALL, how.break_lock
            dataset, failures = running.run_study(study, store, how.resources, progress, *rest)
        except RunInterruptedError as stop:
            progress.stopped(stop, store)
            cli.end_stopped(stop.signal)
        # A part has no results to read, but those of the points that are its own.
        readable = how.as_json is False and study.part is None
        if how.as_json or readable:
            cli.print_headlines(dataset, bool(how.as_json))
        # Nothing to look at next where a caller goes on itself, as `sweep report --all` does.
        looks = () if how.as_json is None or study.part else ("plot", "report")
        progress.finish(failures, store, [f"sweep {look} {typed(short_name(store))}" for look in looks])
    if readable:
        # Slopes are fitted with xarray.
        whole: Any = dataset.to_xarray() if '"slope"' in dataset.attrs.get(CONCLUSION, "") else dataset
        for sentence in answer_in_short(whole):
            cli.print_wrapped(sentence, bold=True)
    return dataset, failures


def print_verified(study: "linksweep.Study", store: "Location", points: int, shown: bool = True) -> bool:
    """Compute some points of a store again, and say to standard error which differ; return whether any does.  That none
    does is only said if ``shown``.
    """
    from linksweep.sweep.running.reproduce import verify

    computed, differing, other_code = verify(study, store, points)
    for sentence in differing:
        click.echo(f"differs: {harmless(sentence)}", err=True)
    for sentence in other_code:
        click.echo(OTHER_CODE + sentence, err=True)
    if shown and not differing:
        again = counted(computed, "point")
        click.echo(f"{again} computed again, alone and in two orders: every bit as in {store}", err=True)
    return bool(differing)


@cli.command("Run", "Run a study into a store; print table and answer")
def run(
    asked: cli.AskedStudy = cli.group(cli.AskedStudy),
    how: Running = cli.group(Running),
    retry: bool = flag("STUDY is a store: compute its failed points again, and only those."),
    fresh: bool = flag("Replace an existing store, whatever its study and code."),
    only: bool = flag("Leave points that STUDY does not ask for out of the store's dataset."),
    keep: bool = flag("Let constants that differ from the store's become axes."),
    redo: str = opt('Compute points again: "x>2 and y==8", or old, those of other code.', metavar="IF", default=""),
    verify: int = opt("At the end compute N points again.", metavar="N", type=click.IntRange(0), default=0),
    part: str | None = opt(
        "Compute only part K of N, into STORE.part-K-of-N; array: the part of this task of a SLURM job array.",
        metavar="K/N|array",
    ),
) -> None:
    """Run STUDY (a built-in name, a TOML file or FILE.py:FUNCTION) into a Zarr store, and print the table.

    After an interruption the same command resumes where it stopped.  The store keeps and shows the points of earlier
    runs too: values of axes add up.

    \b
    sweep run quasars
    sweep run quasars --set n_cat=20 -o results/quick.zarr
    sweep run my_study.toml --axis v_max=14:16:0.25 --workers 4 --log run.log
    sweep run sir.py:sir --design sobol:256 --range beta=0.1:0.5
    sweep run sir.py:sir --points runs.csv
    sweep run --retry results/quasars.zarr
    sweep run quasars --part 3/100
    """
    from linksweep.sweep.running.run import Beside

    beside = Beside(retry, fresh, only, keep, redo)
    if retry and part:
        raise click.UsageError("--retry and --part do not go together: name the store of the part")
    study, store = asked.stored() if retry else asked.load(part)
    _, failures = run_with_progress(study, store, how, beside)
    differing = verify and print_verified(study, store, verify, not how.watching.quiet)
    if failures or differing:
        sys.exit(cli.EXIT_FAILED_POINTS)


@cli.command("Run", "Add points and realisations where they matter")
def refine(
    asked: cli.AskedStudy = cli.group(cli.AskedStudy),
    goal: Any = cli.passed(
        find=opt('The condition to locate, e.g. "sigma_spin < 0.6 mas/yr".', metavar="CONDITION"),
        until=opt('How exact values between points are to be: "error < 0.002".', metavar="CONDITION"),
        within=opt("How closely to locate it, in the unit of the axis.", type=POSITIVE, metavar="WIDTH"),
        along=opt("The axis that gets points.  [default: the only one with several numbers]"),
        variable=opt("With --until: what to interpolate.  [default: the main result]"),
        most=opt("The most in all.  [default: see docs/refine.md]", "--max-realisations", type=click.IntRange(1)),
    ),
    how: Running = cli.group(Running),
) -> None:
    """Run STUDY, then add the points and realisations that matter next, round by round, into the same store.

    With --find they close in on the place where a condition changes; with --until they make values between points as
    exact as asked for.  Points with large Monte-Carlo errors get more realisations instead of closer neighbours.
    After an interruption the same command goes on.

    \b
    sweep refine quasars --find "sigma_spin < 0.6" --within 0.01
    sweep refine quasars --along v_max --until "error < 0.002"
    """
    from linksweep.sweep.analysis import refine as rounds
    from linksweep.sweep.result import Result

    (study, store), mute = asked.load(), replace(how, as_json=None)

    def run(now: "linksweep.Study") -> Any:
        return run_with_progress(now, store, mute)[0].to_xarray()

    for state in rounds.refinements(study, store, goal, run):
        if state.upcoming is not None and not how.watching.quiet:
            click.echo(f"round {len(state.rounds) + 1}: {state.upcoming}", err=True)
    failures = json.loads(state.dataset.attrs["failures"])
    crossings = Result(state.crossings()) if goal["find"] and state.spent else None
    if how.as_json:
        answer = {"failures": failures, "answer": crossings and json.loads(crossings.written("json"))}
        cli.put(to_json({name: value for name, value in vars(state).items() if name != "dataset"} | answer))
    else:
        cli.print_tables(crossings.tables() if crossings else ())
        for sentence in [*(crossings.notes() if crossings else ()), *state.sentences()]:
            cli.print_wrapped(sentence)
    sys.exit(cli.EXIT_FAILED_POINTS if failures else 0)


@cli.command("Run", "Say what a run would do, and write nothing")
def plan(
    asked: cli.AskedStudy = cli.group(cli.AskedStudy),
    workers: int | None = opt("Local workers, for the estimate of the time.  [default: one per core]", type=WORKERS),
    accept_code: bool = cli.ACCEPT_CODE,
    as_json: bool = cli.JSON,
) -> None:
    """Say what a run of STUDY would do: points, realisations, blocks, memory, time, what is done already.

    \b
    sweep plan grid --set n_cat=100
    """
    from linksweep.sweep.running import progress, run as running

    report = running.plan_report(*asked.load(), workers, accept_code)
    if as_json:
        cli.put(to_json(report))
        return
    points = f"{report['points']:,}, {report['points_done']:,} of them done"
    points += progress.failed_before(report["points_failed"])
    lines = [("study", report["title"]), ("grid", report["grid"]), ("points", points)]
    if "realisations" in report:
        done = report["realisations"] - report["realisations_pending"]
        lines += [("realisations", f"{report['realisations']:,}, {done:,} of them done")]
    lines += [("work", counted(report["blocks_pending"], "block")), ("memory", f"{report['memory_mb']:,.3g} MB")]
    if "seconds" in report:
        cores = counted(report["cores"], "core")
        seconds = f"at least {in_words(report['seconds'])}" if report["seconds"] >= 1.0 else "less than a second"
        lines += [("time", f"{seconds} of computing on {cores} of this machine")]
    for key, text in [*lines, ("store", report["store"]), *(("warning", text) for text in report["warnings"])]:
        cli.print_wrapped(text, f"{key:14}", 14 * " ")


@dataclass(frozen=True)
class Target:
    """Where a result goes: to the terminal, as JSON or text, into a store, and into figures."""

    output: Path | None = cli.output("Write .zarr, or draw .png, .svg, .pdf.")
    figures: Path | None = opt(
        "Draw every figure that `sweep plot STORE.zarr --kind KIND` has, as KIND.png.",
        type=click.Path(path_type=Path, file_okay=False),
        metavar="FOLDER",
    )
    as_json: bool = JSON

    def __post_init__(self) -> None:
        """Raise an error unless a store can be written and figures be drawn, before anything is computed."""
        if (output := self.output) is not None and output.suffix.lower() == ".zarr":
            from linksweep.sweep.result import require_free

            require_free(output)
        elif output is not None:
            cli.drawing_styles().require_format(output, ".zarr")
        if self.figures is not None:
            cli.drawing_styles()

    def put(self, result: "xr.Dataset") -> None:
        """Write a result, draw its figures, and print it, also where it cannot be written."""
        from linksweep.sweep.result import Result

        output = self.output
        try:
            if output is not None and output.suffix.lower() == ".zarr":
                Result(result).save(output)
                cli.wrote(output)
                output = None
            if output is not None or self.figures is not None:
                from linksweep.sweep.plots import figure as drawing, style

                with style.settings():
                    figures = {} if output is None else {output: drawing.draw_figure(result)}
                    if self.figures is not None:
                        kinds = drawing.all_figures(Result(result))
                        figures |= {self.figures / f"{kind}.png": figure for kind, figure in kinds.items()}
                    for path, figure in figures.items():
                        style.save(figure, path)
                        cli.wrote(path)
        finally:
            cli.print_result(result, "json" if self.as_json else "text")


@parsed
def _counts(text: str) -> tuple[int, ...]:
    words = text.split(",")
    if not all(word.strip().isdecimal() and len(word) < 6 for word in words):
        raise ValueError(f"{text!r} is no list of numbers of workers; write 1,2,4")
    return tuple(map(int, words))


@cli.command("Run", "Measure how a study scales with workers")
def scaling(
    study: str = cli.STUDY,
    workers: tuple[int, ...] = opt("Numbers of workers, from 1 up.", default="1,2", callback=_counts),
    pool: Any = choice("Workers are processes, or threads of this one.", WITH_WORKERS, default=DEFAULT_POOL),
    repetitions: int = opt("How often to repeat runs; 5 or more give errors.", type=click.IntRange(1, 1000), default=3),
    settings: Sequence[str] = cli.SETTINGS,
    axes: Sequence[str] = cli.AXES,
    output: Path | None = cli.output("The measurements, as Zarr.  [default: results/NAME-scaling.zarr]"),
    trust: bool = cli.TRUST,
    as_json: bool = cli.JSON,
) -> None:
    """Measure how STUDY scales with local workers: the same work on more of them (strong), and as much for each (weak).

    The results of the runs are thrown away; the time to start workers is measured separately.

    \b
    sweep scaling quasars --workers 1,2
    sweep plot results/quasars-scaling.zarr
    """
    from linksweep.sweep.running.scaling import measure_scaling
    from linksweep.sweep.stores.location import default_store

    loaded = cli.load_trusted(study, trust, settings=settings, axes=axes)
    # Before minutes of measuring: it may be no place to write to.
    target = Target(output or default_store(f"{loaded.name}-scaling"), None, as_json)
    with cli.a_signal_ends_the_command():
        dataset = measure_scaling(loaded, workers, pool, repetitions, lambda text: click.echo(text, err=True))
    target.put(dataset)


@cli.command("Store care", "Say how far a run is, and what failed")
def status(store: "Location" = cli.STORE, as_json: bool = cli.JSON) -> None:
    """Say how far the run in STORE is, what failed, where the results come from, and what to do next.

    \b
    sweep status results/quasars.zarr
    """
    from linksweep.sweep.contract import progress_in_words
    from linksweep.sweep.running import progress, status as states

    report, name = states.status_report(store), typed(store)
    if as_json:
        cli.put(to_json(report))
        return
    if "parts" in report:
        cli.put(report["title"])
        for total, some in report["parts"].items():
            cli.print_wrapped(f"of {total} parts: {'; '.join(f'{state}: {ones}' for state, ones in some.items())}")
        return
    points, made, part = report["points"], report["provenance"], f" of part {report['part']}" if report["part"] else ""
    total = sum(points.values()) - points["excluded"]
    state = f"running, {report['running']}" if report["running"] else report["state"]
    cli.print_styled(report["title"], bold=True)
    share = ""
    if points["missing"] and "realisations" in report:
        share = f", {100 * report['realisations_done'] // report['realisations']} % of the realisations"
    cli.print_wrapped(f"{state}: {progress_in_words(points['done'], points['failed'], total, part)}{share}")
    remarks = [f"{key.replace('_', ' ')}: {report[key]}" for key in ("note", "lost_parts") if key in report]
    remarks += [f"round {number} of sweep refine: {one}" for number, one in enumerate(report["rounds"], 1)]
    for remark in [*remarks, *(f"warning: {sentence}" for sentence in report["warnings"])]:
        cli.print_wrapped(remark, later="   ")
    if failures := report["failures"]:
        cli.put(f"\n{counted(len(failures), 'point')} failed:")
        for reason in progress.Reasons(failures).in_words():
            cli.print_wrapped(reason, "  ", "    ")
        if len(failures) > 1:
            cli.put(f"sweep status --json {name} has all of them")
    programs = ", ".join(f"{name} {made['versions'][name]}" for name in DECIDING if name in made["versions"])
    commit = f" at commit {made['git_commit'][:12]}" if "git_commit" in made else ""
    since = made.get("started", "an unknown time").replace("T", " ").replace("+00:00", " UTC")
    cli.put()
    cli.print_wrapped(f"made on {made.get('host', 'an unknown host')}, begun {since}, with {programs}{commit}")
    if report["command"]:
        cli.print_wrapped(f"by {report['command']}", later="   ")
    nexts = {
        f"sweep watch {name}": report["running"],
        "the lost parts, and the merge again": "lost_parts" in report,
        "the command that was stopped goes on": state == "stopped" and "lost_parts" not in report,
        f"sweep run --retry {name}": points["failed"] and not report["running"],
        f"sweep show {name}": report["complete"],
    }
    cli.put(f"next: {', '.join(words for words, fits in nexts.items() if fits)}")


@cli.command("Store care", "Compare files with checksums; set damaged aside")
def check(
    store: "Location" = cli.STORE,
    repair: bool = flag("Move damaged files to STORE.damaged; the next run computes what was in them."),
    break_lock: bool = cli.BREAK_LOCK,
    as_json: bool = cli.JSON,
) -> None:
    """Read every file in STORE and compare it with its checksum; the exit code is 1 if any is damaged.

    \b
    sweep check results/quasars.zarr
    sweep check results/quasars.zarr --repair
    """
    from linksweep.sweep.stores import store as files

    if repair and as_json:
        raise click.UsageError("--json is for a check without --repair")
    if break_lock and not repair:
        raise click.UsageError("--break-lock goes with --repair: a check writes nothing")
    if repair:
        cli.put("\n".join(files.repair(store, break_lock=break_lock) or [WHOLE]))
        return
    report = files.check(store)
    if as_json:
        cli.put(to_json(report))
    else:
        damaged = (report.identity | report.ledger | report.results).items()
        lines = [f"{file}: {problem}" for file, problem in damaged] or [WHOLE]
        cli.put("\n".join([*lines, *(f"{store} {remark}" for remark in report.remarks)]))
    if report:
        click.echo(f"`sweep check {typed(store)} --repair` repairs what can be repaired", err=True)
        sys.exit(cli.EXIT_FAILED_POINTS)


@cli.command("Store care", "Compute points again, to the bit")
def reproduce(
    store: "Location" = cli.STORE,
    at: str | None = opt("The point, e.g. model=gaia,v_max=16.", metavar="AXIS=VALUE[,AXIS=VALUE]"),
    points: int = opt("Without --at: how many points to compute, in two orders.", type=click.IntRange(1), default=10),
    debug: bool = flag("Open the debugger where the point raises.", "--pdb"),
    trust: bool = cli.TRUST,
    as_json: bool = cli.JSON,
) -> None:
    """Compute points of STORE again and compare every bit with what is stored: one point in this process, or some,
    one by one in new processes, in two orders.

    The exit code is 1 if a point raises, or if anything differs.

    \b
    sweep reproduce results/quasars.zarr --at model=gaia,v_max=16
    sweep reproduce results/quasars.zarr --points 20
    """
    from linksweep.sweep.analysis.quantity import point_in
    from linksweep.sweep.running import reproduce as computing
    from linksweep.sweep.stores.store import OpenStore
    from linksweep.sweep.studies.reader import parse_places

    if at is None:
        if debug or as_json:
            raise click.UsageError(f"{'--pdb' if debug else '--json'} is for one point; name it with --at")
        sys.exit(cli.EXIT_FAILED_POINTS if print_verified(computing.study_of(store, trust=trust), store, points) else 0)
    try:
        opened = OpenStore(store)
        study, dataset = computing.study_of(opened, trust=trust), opened.dataset()
        point = point_in(dataset, study, parse_places([at] if at.strip() else []), str(store))
        again = computing.reproduce(study, dataset, point)
    except linksweep.SweepError:
        raise
    except Exception as error:
        # Of the experiment: the traceback is what was asked for.
        traceback.print_exception(error)
        if debug:
            import pdb

            with redirect_stdout(cli.RESULTS[0]):
                pdb.post_mortem(error.__traceback__)
        sys.exit(cli.EXIT_FAILED_POINTS)
    cli.print_headlines(again.dataset.assign_attrs(title=again.place, complete=1), as_json)
    for sentence in again.other_code:
        click.echo(OTHER_CODE + sentence, err=True)
    if again.differences is None:
        click.echo(f"{again.place} is {again.stored} in {store}; there is nothing to compare with", err=True)
    elif not again.differences:
        click.echo(f"every bit as in {store}", err=True)
    else:
        click.echo(f"differs from {store} in {', '.join(again.differences)}", err=True)
        for name, (stored, computed) in again.differences.items():
            click.echo(f"  {name}: {json.dumps(stored.tolist())} stored, {json.dumps(computed.tolist())} now", err=True)
        sys.exit(cli.EXIT_FAILED_POINTS)


@cli.command("Store care", "Make one store of parts, or of several stores")
def merge(
    stores: "tuple[Location, ...]" = cli.STORES,
    output: str = cli.output("The new store.", type=str, required=True),
    accept_code: bool = cli.ACCEPT_CODE,
    trust: bool = cli.TRUST,
    as_json: bool = cli.JSON,
) -> None:
    """Join the parts of a study into the store that a single run makes, or several stores of one experiment into one
    with the points of all.

    Points that several stores have are kept once, and must be the same to the last bit.  The exit code is 1 if
    points are missing or failed.  If a part is missing, give the same command again when it is there.

    \b
    sweep merge results/quasars.zarr.part-* -o results/quasars.zarr
    sweep merge 'results/quasars.zarr.part-*-of-20000' -o results/quasars.zarr
    sweep merge results/low.zarr results/high.zarr -o results/all.zarr
    """
    from linksweep.sweep.running.merge import merge as merge_stores

    dataset = merge_stores(stores, output, accept_code=accept_code, trust=trust)
    cli.print_headlines(dataset, as_json)
    cli.wrote(output)
    if not dataset.attrs["complete"]:
        sys.exit(cli.EXIT_FAILED_POINTS)


# `afterany`: a part in which points fail ends with exit code 1.  A lock that is left over on another host is that of
# an earlier try: SLURM runs a task once at a time.  The last of several options counts for sbatch: --array,
# --dependency, --output and --error of the user are for the parts.
SCRIPT = """\
#!/bin/sh
# Submits {name} as a job array of {total} parts, and a job that merges them when all have ended.
set -e
array=$(sbatch --parsable --array=1-{total} --output={logs}/%A_%a.log {options} <<'END_OF_JOB'
#!/bin/bash
exec {run} --part "$SLURM_ARRAY_TASK_ID/{total}" --workers "${{SLURM_CPUS_PER_TASK:-1}}" --break-lock
END_OF_JOB
)
log={logs}/merge-%j.log
sbatch {options} --output="$log" --error="$log" --array=1 --dependency="afterany:${{array%%;*}}" <<'END_OF_JOB'
#!/bin/bash
exec {merge} -o {store} {parts}
END_OF_JOB
"""


@cli.command("Run", "Run a study as a job array of SLURM")
def submit(
    asked: cli.AskedStudy = cli.group(cli.AskedStudy),
    tasks: int = opt("Tasks of the array, a part in each.", "--slurm", type=click.IntRange(1, 100_000), required=True),
    more: Sequence[str] = many("An option of sbatch: --time=2:00:00, --array=1-99%9.", "--sbatch", metavar="OPTION"),
    go: bool = flag("Also run the script."),
) -> None:
    """Write STORE.slurm/submit.sh, which submits STUDY as a job array of SLURM, with a part of it in each task, and a
    job that merges the parts; logs go beside it.  No task needs a connection to another.

    \b
    sweep submit quasars --slurm 100 --sbatch --time=1:00:00
    sweep submit quasars --slurm 100 --go
    """
    import subprocess

    from linksweep.sweep.contract import refused
    from linksweep.sweep.planning.grid import make_grid
    from linksweep.sweep.running.merge import require_free
    from linksweep.sweep.stores.location import Folder, file_named

    study, store = asked.load()
    make_grid(study)  # its mistakes are named here, not in a hundred logs
    require_free(store, study, [{"parts": tasks}])
    overrides = [written.replace(" ", "=", 1) for written in study.overrides]
    trust = ["--trust"] if asked.trust else []
    sweep = shlex.join([sys.executable, "-P", "-m", "linksweep"])
    folder = (store.path.parent if isinstance(store, Folder) else Path.cwd()) / file_named(f"{store.name}.slurm")
    script = SCRIPT.format(
        name=typed(study.name),
        total=tasks,
        logs=shlex.quote(str(folder).replace("%", "%%")),
        options=shlex.join([f"--job-name={study.name}", f"--chdir={Path.cwd()}", *more]),
        run=f"{sweep} run {typed(asked.study)} {shlex.join([*overrides, *trust])} -o {typed(store)}",
        # Who submits a study trusts its code; parts are written on other hosts than the one that merges them.
        merge=f"{sweep} merge {shlex.join(trust if study.is_ours else ['--trust'])}",
        store=typed(store),
        parts=typed(f"{store}.part-*-of-{tasks}"),
    ).encode(errors="surrogateescape")  # names of files need not be UTF-8
    file = folder / "submit.sh"
    with refused(OSError, subprocess.CalledProcessError, said="cannot be written or submitted: ", where=file):
        if file.exists() and file.read_bytes() != script:
            raise linksweep.SweepError("is there already, and another one; submit it with sh, or remove it", str(file))
        Folder(folder).put(file.name, script)
        cli.wrote(file, "" if go else f"; submit it with: sh {typed(file)}")
        if go:
            subprocess.run(["sh", str(file)], check=True)


EXPERIMENT = arg(default="linksweep.core.experiment:link")

MORE_EPOCHS = arg(nargs=-1, type=FILE, metavar="[--epochs FILE...]")


@cli.command("Your own", "Write a commented study to start from")
def new(name: str = arg(), experiment: str = EXPERIMENT) -> None:
    """Write NAME.toml, a study of EXPERIMENT to start from: it runs as it is, and has every parameter in a comment.

    \b
    sweep new mine
    sweep new mine my_experiment.py:experiment
    """
    from linksweep.sweep import code, contract
    from linksweep.sweep.stores.location import Folder, reading
    from linksweep.sweep.studies import new as made, reader

    if not reader.GOOD_NAME.fullmatch(name):
        rule = "a letter, then letters, digits and _ . + -, at most 60"
        raise linksweep.SweepError(f"{contract.shown(name)} is no name for a study: {rule}")
    path = Path(f"{name.removesuffix('.toml')}.toml")
    text = made.new_study(path.stem, experiment, code.load_experiment(experiment)).encode(errors="replace")
    with reading(path, "cannot be written"):
        if not Folder(Path()).create(path.name, text):
            raise linksweep.SweepError("exists already; take another name", str(path))
    cli.wrote(path, f"; edit it, then: sweep plan {typed(path)}")


@cli.command("Your own", "List the parameters of a study or experiment")
def params(
    experiment: str = EXPERIMENT,
    schema: bool = flag("Print the JSON Schema of studies, by which editors complete them."),
    as_json: bool = JSON,
) -> None:
    """List the parameters of EXPERIMENT (module:attribute, file.py:attribute, or a study of it) with unit,
    default, allowed values and meaning.

    \b
    sweep params
    sweep params quasars
    sweep params my_experiment.py:experiment
    sweep params --schema > study.schema.json
    """
    from linksweep.sweep.code import load_experiment
    from linksweep.sweep.studies import built_in_studies, new as made

    is_study = experiment.endswith(".toml") or experiment in built_in_studies()
    declared = linksweep.load_study(experiment).experiment if is_study else load_experiment(experiment)
    if schema:
        cli.put(to_json(made.study_schema(declared)))
        return
    rows = [
        {name: getattr(p, name) for name in ("name", "unit", "default", "required", "meaning")}
        | {"allowed": p.allowed()}
        for p in declared.parameters
    ]
    if as_json:
        cli.put(to_json(rows))
        return
    for row in rows:
        default = f"default: {row['default']}" if row["default"] is not None else "required" if row["required"] else ""
        unit = f" [{row['unit']}]" if row["unit"] else ""
        cli.put(f"{row['name']}{unit}  {default}".rstrip())
        meaning = meaning_beside(row["name"], {"long_name": row["meaning"]})
        cli.print_wrapped("; ".join(filter(None, [meaning, row["allowed"]])), "    ", "    ")


# How the command calls options whose names do not say what it does with them.
FLAGS = {"goal": "--for", "number": "--choose", "radius": "--radius"}


def _declared(entry: str, *groups: type[Declared]) -> Any:
    """Declare the options of a command as they are declared once for all; these check the values."""
    made = {}
    for one in declared(entry, *groups):
        metavar, meaning = one.metadata["metavar"], one.metadata["about"]["meaning"]
        is_map = one.metadata["about"]["kind"] in ("map", "files")
        several = is_map or bool(one.metadata["joined"])
        name = one.name.removesuffix("s") if is_map and "=" in metavar else one.name
        more: dict[str, Any] = {"type": FILE if metavar == "FILE" else str} if metavar else {"is_flag": True}
        if metavar and one.default not in (None, (), ""):
            more["default"] = [one.default] if several else one.default
        names = FLAGS.get(one.name, "--" + name.replace("_", "-"))
        words = f"{meaning[:1].upper()}{meaning[1:]}."
        made[one.name] = opt(words, names, multiple=several, metavar=metavar or None, **more)
    return passed(**made)


@cli.command("Your own", "Solve for the link of two real tables")
def tie(
    satellite: Path = arg(type=FILE),
    reference: str = arg(),
    more_epochs: tuple[Path, ...] = MORE_EPOCHS,
    asked: dict[str, Any] = _declared(TIE, Options),
    resources: Resources = cli.group(resources),
    no_sources: bool = flag("Write no values of single sources and rows: for millions of them."),
    target: Target = cli.group(Target),
) -> None:
    """Solve for the link of two real tables, REFERENCE - SATELLITE.

    SATELLITE has positions, parallaxes and proper motions (Gaia archive, Hipparcos-2, ICRF text, or any table with such
    columns), REFERENCE measurements of the same objects, or zero-motion for quasars.

    \b
    sweep tie gaia.fits vlbi.ecsv --unknowns orientation,spin -o tie.zarr

    With chi2 above 1000 times its expectation the exit code is 1, and nothing is written.
    """
    from linksweep.sweep.tie.link import MisfitError

    shown = target.as_json or target.output is not None or target.figures is not None
    asked = _with_more(asked, more_epochs) | {"per_source": shown and not no_sources}
    try:
        target.put(linksweep.tie(satellite, reference, resources=resources, **asked))
    except MisfitError as error:
        Target(None, None, target.as_json).put(error.link)
        click.echo(f"error: {error.said('--accept-misfit')}", err=True)
        sys.exit(cli.EXIT_FAILED_POINTS)


@cli.command("Your own", "Forecast a link with new observations")
def forecast(
    satellite: Path = arg(type=FILE),
    reference: str = arg(),
    more_epochs: tuple[Path, ...] = MORE_EPOCHS,
    asked: dict[str, Any] = _declared(FORECAST, ForecastOptions, Options),
    target: Target = cli.group(Target),
) -> None:
    """Forecast the errors of a link with new observations, and choose what to observe.

    \b
    sweep forecast gaia.fits vlbi.ecsv --add 2026,2030 --choose 5 --for spin
    """
    target.put(linksweep.forecast(satellite, reference, **_with_more(asked, more_epochs)))


def _with_more(asked: dict[str, Any], more_epochs: tuple[Path, ...]) -> dict[str, Any]:
    """Return options with the files that follow ``--epochs``."""
    if more_epochs and not asked["epochs"]:
        raise click.UsageError(f"unexpected {more_epochs[0]}: two tables, and --epochs before other files")
    return asked | {"epochs": asked["epochs"] + more_epochs}


@cli.command("Your own", "Carry a table into the frame of a link's reference")
def apply(
    link: Path = arg(type=FILE),
    table: Path = arg(type=FILE),
    output: Path = cli.output("The table in the other frame: .csv, .ecsv, .fits or .parquet.", required=True),
    inverse: bool = flag("TABLE is in the reference's frame, and goes into the satellite's."),
    asked: dict[str, Any] = _declared("apply", ApplyOptions),
) -> None:
    """Carry TABLE from the satellite's frame into that of the reference, by the LINK that `sweep tie -o` wrote.

    Positions, motions, errors and correlations change, with the covariance of the link added; other columns do not.

    \b
    sweep apply tie.zarr gaia.fits -o gaia-in-vlbi.fits
    """
    from linksweep.sweep.tie.link import apply as carry

    for note in carry(link, table, output, inverse=inverse, **asked).meta["comments"]:
        click.echo(f"note: {note}", err=True)
    cli.wrote(output)


@cli.command("Your own", "Find the galaxies in a star catalogue")
def match(
    stars: Path = arg(type=FILE),
    galaxies: tuple[Path, ...] = arg(nargs=-1, required=True, type=FILE),
    supplement: Path | None = opt("More stars, whose matches are a class of their own.", type=FILE),
    search: dict[str, Any] = _declared("match", SearchOptions),
    output: Path = cli.output("The matches: .ecsv, or a store .zarr.", default=Path("results/matches.ecsv")),
    table: Path | None = opt("Also the paper's 46-byte table.", type=FILE),
    figure: Path | None = opt("Also draw an all-sky map: .png, .svg or .pdf.", type=FILE),
    overwrite: bool = flag("Replace files that exist."),
    as_json: bool = JSON,
) -> None:
    """Find the galaxies in a star catalogue: cross-match STARS with one or more GALAXIES tables.

    Tables are FITS, VOTable, ECSV, CSV, TSV, MRT or Parquet with the column names of the Gaia archive; options refer
    to a table by its file name up to the first dot.

    \b
    sweep match tycho2.fits pgc.fits uzc.csv --supplement tycho2_suppl1.fits \\
        --radius pgc=15 --radius uzc=3 --error pgc=5 --error uzc=1 \\
        -o galaxies.ecsv --table galaxies.dat --figure galaxies.png
    """
    from linksweep.sweep.search.search import find_galaxies, plan_search

    if figure is not None:
        cli.drawing_styles().require_format(figure)
    matches = find_galaxies(plan_search(stars, galaxies, supplement, **search), output, table, figure, overwrite)
    cli.print_result(matches, "json" if as_json else "text")
    for path in filter(None, (output, table, figure)):
        cli.wrote(path)
