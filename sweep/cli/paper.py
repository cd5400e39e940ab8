"""Commands about the paper's numbers: compare and calibrate."""

import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sweep.cli.group import EXIT_FAILED_POINTS, main
from sweep.cli.log_options import Watching, watching_options
from sweep.cli.options import FILE, json_option, json_or, stores_argument
from sweep.cli.output import print_comparisons, print_whole
from sweep.cli.resource_options import resource_options
from sweep.cli.running import run_with_progress
from sweep.formatting import to_json

if TYPE_CHECKING:
    from sweep.executing.choose import Resources
    from sweep.stores.location import Location


all_option = click.option(
    "--all", "everything", is_flag=True, help="The whole paper: every built-in study, run if it was not yet."
)
results_option = click.option("--results", type=FILE, help="Folder with the stores of --all.  [default: results]")


@main.command()
@stores_argument
@all_option
@results_option
@resource_options
@watching_options
@click.option("--format", "table_format", type=click.Choice(["text", "csv"]), default="text", show_default=True)
@json_option
def compare(
    stores: "tuple[Location, ...]",
    everything: bool,
    results: Path | None,
    resources: "Resources",
    watching: Watching,
    table_format: str,
    as_json: bool,
) -> None:
    """Compare the results in STORE with the published numbers and claims of its study.

    The exit code is 1 if something is not reproduced or incomplete.

    \b
    sweep compare results/quasars.zarr
    sweep compare --all --workers 4
    """
    table_format = json_or(table_format, as_json)
    from sweep.analysis.compare import all_is_well
    from sweep.paper.published_stores import compare_stores

    require_stores_or_all(stores, everything, results, resources, watching)
    if everything:
        stores = run_what_is_missing(results, resources, watching)
    comparisons, remarks = compare_stores(stores)
    print_comparisons(comparisons, remarks, table_format)
    if not all_is_well(comparisons):
        sys.exit(EXIT_FAILED_POINTS)


def require_stores_or_all(
    stores: "tuple[Location, ...]",
    everything: bool,
    results: Path | None,
    resources: "Resources",
    watching: Watching,
) -> None:
    """Raise click.UsageError unless a command has either stores or --all, and only with --all what belongs to it."""
    from sweep.executing.choose import Resources

    if everything == bool(stores):
        raise click.UsageError("name stores, or give --all")
    if not everything and (results is not None or resources != Resources() or watching != Watching()):
        raise click.UsageError("--results, what to run on and how to watch it go with --all: nothing runs without it")


def run_what_is_missing(results: Path | None, resources: "Resources", watching: Watching) -> "tuple[Location, ...]":
    """Return the stores of all built-in studies with something published, after running those that need it."""
    from sweep.paper.published_stores import published_studies, store_of, unfinished
    from sweep.stores.location import located
    from sweep.stores.named import RESULTS

    results = results or RESULTS
    studies = published_studies()
    for study in unfinished(studies, results):
        store = located(store_of(study, results))
        if watching.level < logging.ERROR:
            click.echo(f"{study.name}:", err=True)
        run_with_progress(study, store, resources, watching, None)
    return tuple(located(store_of(study, results)) for study in studies)


@main.command()
@json_option
def calibrate(as_json: bool) -> None:
    """Refit the mission curves to the paper's tables: constants, uncertainties, residuals, and what equal weights give.

    \b
    sweep calibrate
    sweep calibrate --json > calibration.json
    """
    from sweep.paper.calibrate import as_text, calibration_report

    report = calibration_report()
    if as_json:
        click.echo(to_json(report))
        return
    print_whole(as_text(report))
