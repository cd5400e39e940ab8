"""Commands that compute: run and plan."""

import logging
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click

from sweep.cli.group import EXIT_FAILED_POINTS, main
from sweep.cli.log_options import Watching, told, watching_options
from sweep.cli.options import (
    accept_code_option,
    break_lock_option,
    json_option,
    load,
    study_argument,
    study_options,
    trust_option,
)
from sweep.cli.output import print_answer, print_plan, print_table
from sweep.cli.resource_options import resource_options
from sweep.cli.signals import a_signal_ends_the_command, end_stopped

if TYPE_CHECKING:
    from sweep.executing.choose import Resources
    from sweep.stores.location import Location
    from sweep.studies.study import Study


@main.command()
@study_argument
@study_options
@resource_options
@break_lock_option
@accept_code_option
@click.option("--fresh", is_flag=True, help="Replace an existing store, whatever its study and code.")
@watching_options
@trust_option
@json_option
def run(
    study: str,
    overrides: Mapping[str, Any],
    store: "Location | None",
    resources: "Resources",
    break_lock: bool,
    accept_code: bool,
    fresh: bool,
    watching: Watching,
    trust: bool,
    as_json: bool,
) -> None:
    """Run STUDY (a built-in name or a TOML file) into a Zarr store, and print the table.

    After an interruption the same command resumes where it stopped.

    \b
    sweep run quasars
    sweep run quasars --set n_cat=20 -o results/quick.zarr
    sweep run my_study.toml --axis v_max=14:16:0.25 --workers 4 --log run.log
    sweep run sir.py:sir --design sobol:256 --range beta=0.1:0.5
    sweep run sir.py:sir --points runs.csv
    """
    loaded, path = load(study, overrides, store, trust)
    failures = run_with_progress(
        loaded, path, resources, watching, as_json, break_lock=break_lock, accept_code=accept_code, fresh=fresh
    )
    if failures:
        sys.exit(EXIT_FAILED_POINTS)


@main.command()
@study_argument
@study_options
@click.option("--workers", type=click.IntRange(1, 4096), help="Of this machine, for the time.  [default: one per core]")
@accept_code_option
@trust_option
@json_option
def plan(
    study: str,
    overrides: Mapping[str, Any],
    store: "Location | None",
    workers: int | None,
    accept_code: bool,
    trust: bool,
    as_json: bool,
) -> None:
    """Say what a run of STUDY would do: points, realisations, tasks, memory, time, what is done already.

    \b
    sweep plan grid --set n_cat=100
    """
    loaded, path = load(study, overrides, store, trust)
    print_plan(loaded, path, workers, as_json, accept_code)


def run_with_progress(
    study: "Study",
    store: "Location",
    resources: "Resources",
    watching: Watching,
    as_json: bool | None,
    *,
    retry: bool = False,
    break_lock: bool = False,
    accept_code: bool = False,
    fresh: bool = False,
) -> dict[str, str]:
    """Run a study with progress; print its table, then what the run took, and the answer last, or JSON alone; with
    ``as_json`` None no results.  Return why points failed.  An interruption ends the command.
    """
    from sweep.interrupt import RunInterruptedError
    from sweep.running.progress import TerminalProgress
    from sweep.running.run import run_study
    from sweep.stores.named import short_name

    bar = watching.level < logging.ERROR
    with a_signal_ends_the_command(), told(watching), TerminalProgress(study, bar) as progress:
        try:
            dataset, failures = run_study(study, store, resources, progress, retry, break_lock, accept_code, fresh)
        except RunInterruptedError as stop:
            progress.stopped(stop.signal.name, store)
            end_stopped(stop.signal)
        if as_json is not None:
            print_table(dataset, "json" if as_json else "text")
        name = short_name(store)
        next_commands = (f"sweep plot {name}", f"sweep report {name}")
        progress.finish(failures, store, () if as_json is None else next_commands)
    if as_json is False:
        print_answer(dataset)
    return failures
