"""Commands that compute: run, plan and scaling."""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from linksweep.sweep.cli import options
from linksweep.sweep.cli.group import EXIT_FAILED_POINTS, main
from linksweep.sweep.cli.log_options import Watching, told, watching_options
from linksweep.sweep.cli.output import print_answer, print_plan, print_table, print_verified
from linksweep.sweep.cli.plot import drawing_styles, save_figure
from linksweep.sweep.cli.resource_options import resource_options
from linksweep.sweep.cli.signals import a_signal_ends_the_command, end_stopped
from linksweep.sweep.executing.pools import DEFAULT_POOL, POOLS
from linksweep.sweep.formatting import to_json

if TYPE_CHECKING:
    from linksweep.sweep.executing.pools import Resources
    from linksweep.sweep.running.failures import MaxFailures
    from linksweep.sweep.stores.location import Location
    from linksweep.sweep.studies.study import Study


@dataclass(frozen=True)
class Running:
    """How a study is run: on what, what the user sees (no results if ``as_json`` is None), and what it may continue."""

    resources: "Resources"
    watching: Watching
    as_json: bool | None
    break_lock: bool = False
    accept_code: bool = False
    max_failures: "MaxFailures | None" = None


def _max_failures(_context: click.Context, _parameter: click.Parameter, value: str | None) -> "MaxFailures | None":
    if value is None:
        return None
    from linksweep.sweep.running.failures import MaxFailures

    try:
        return MaxFailures.of(value)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error


max_failures_option = click.option(
    "--max-failures",
    metavar="N|P%",
    callback=_max_failures,
    help="End the run when more points fail; 100% never.  [default: if the first 20 all fail for one reason]",
)


def run_with_progress(
    study: "Study", store: "Location", how: Running, *, retry: bool = False, fresh: bool = False
) -> dict[str, str]:
    """Run a study with progress; print its table, then what the run took, and the answer last, or JSON alone.  Return
    why points failed.  An interruption ends the command.
    """
    from linksweep.sweep.interrupt import RunInterruptedError
    from linksweep.sweep.running.progress import TerminalProgress
    from linksweep.sweep.running.run import run_study
    from linksweep.sweep.stores.named import short_name

    bar = how.watching.level < logging.ERROR
    with a_signal_ends_the_command(), told(how.watching), TerminalProgress(study, bar) as progress:
        try:
            dataset, failures = run_study(
                study, store, how.resources, progress, retry, how.break_lock, how.accept_code, fresh, how.max_failures
            )
        except RunInterruptedError as stop:
            progress.stopped(stop.signal.name, store)
            end_stopped(stop.signal)
        if how.as_json is not None:
            print_table(dataset, "json" if how.as_json else "text")
        name = short_name(store)
        next_commands = (f"sweep plot {name}", f"sweep report {name}")
        progress.finish(failures, store, () if how.as_json is None else next_commands)
    if how.as_json is False:
        print_answer(dataset)
    return failures


@main.command()
@options.study_options
@resource_options
@options.break_lock_option
@options.accept_code_option
@max_failures_option
@click.option("--retry", is_flag=True, help="STUDY is a store: compute its failed points again, and only those.")
@click.option("--fresh", is_flag=True, help="Replace an existing store, whatever its study and code.")
@click.option("--verify", type=click.IntRange(0), default=0, help="At the end compute so many points again.")
@watching_options
@options.trust_option
@options.json_option
@options.gathered("how", Running)
def run(asked: options.AskedStudy, how: Running, retry: bool, fresh: bool, verify: int) -> None:
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


@main.command()
@options.study_options
@click.option(
    "--workers",
    type=click.IntRange(1, 4096),
    help="Local workers, for the estimate of the time.  [default: one per core]",
)
@options.accept_code_option
@options.trust_option
@options.json_option
def plan(asked: options.AskedStudy, workers: int | None, accept_code: bool, as_json: bool) -> None:
    """Say what a run of STUDY would do: points, realisations, tasks, memory, time, what is done already.

    \b
    sweep plan grid --set n_cat=100
    """
    from linksweep.sweep.running.status import plan_report

    report = plan_report(*asked.load(), workers, accept_code)
    if as_json:
        click.echo(to_json(report))
    else:
        print_plan(report)


def _counts(_context: click.Context, _parameter: click.Parameter, value: str) -> tuple[int, ...]:
    words = value.split(",")
    if not all(word.strip().isdecimal() and len(word) < 6 for word in words):
        raise click.BadParameter(f"{value!r} is no list of numbers of workers; write 1,2,4")
    return tuple(map(int, words))


@main.command()
@click.argument("study")
@options.option_with_default("--workers", default="1,2", callback=_counts, help="Numbers of workers, from 1 up.")
@options.option_with_default(
    "--pool",
    type=click.Choice([name for name, pool in POOLS.items() if pool.has_workers]),
    default=DEFAULT_POOL,
    help="Workers are processes, or threads of this one.",
)
@options.option_with_default(
    "--repetitions", type=click.IntRange(1, 1000), default=3, help="How often to time every run; 5 or more give errors."
)
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="Override a value of the study.")
@click.option("--axis", "axes", multiple=True, metavar="NAME=SPEC", help="Override or add an axis.")
@click.option(
    "-o", "--output", type=options.FILE, help="The measurements, as Zarr.  [default: results/NAME-scaling.zarr]"
)
@click.option("--figure", type=options.FILE, help="Also draw them with the ideal lines: .png, .svg, .pdf.")
@options.trust_option
@options.json_option
def scaling(
    study: str,
    workers: tuple[int, ...],
    pool: Any,
    repetitions: int,
    settings: tuple[str, ...],
    axes: tuple[str, ...],
    output: Path | None,
    figure: Path | None,
    trust: bool,
    as_json: bool,
) -> None:
    """Measure how STUDY scales with local workers: the same work on more of them (strong), and as much for each (weak).

    The results of the runs are thrown away; the time to start workers is measured separately.

    \b
    sweep scaling quasars --workers 1,2 --figure scaling.svg
    """
    if figure is not None:
        drawing_styles().require_format(figure)
    from linksweep.sweep.interrupt import RunInterruptedError
    from linksweep.sweep.running.scaling import check_free, measure_scaling, write_scaling
    from linksweep.sweep.stores.named import default_store

    loaded = options.load_trusted(study, trust, settings, axes)
    path = output or default_store(f"{loaded.name}-scaling")
    check_free(path)
    with a_signal_ends_the_command():
        try:
            dataset = measure_scaling(loaded, workers, pool, repetitions, lambda text: click.echo(text, err=True))
        except RunInterruptedError as stop:
            end_stopped(stop.signal)
    frame = dataset[["seconds", "start_seconds", "speedup", "efficiency"]].to_dataframe().reset_index()
    if as_json:
        click.echo(to_json(frame.to_dict(orient="records")))
    else:
        click.echo(frame.to_string(index=False, float_format=lambda value: f"{value:.3g}"))
    write_scaling(dataset, path)
    if figure is not None:
        save_figure(dataset, figure)
    click.echo(f"wrote {path}" + (f" and {figure}" if figure is not None else ""), err=True)
