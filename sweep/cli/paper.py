"""Commands about stores or the whole paper: compare and report."""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linksweep.sweep.cli.group import EXIT_FAILED_POINTS, main
from linksweep.sweep.cli.log_options import Watching, watching_options
from linksweep.sweep.cli.options import FILE, gathered, json_option, json_or, option_with_default, stores_argument
from linksweep.sweep.cli.output import print_comparisons
from linksweep.sweep.cli.resource_options import resource_options
from linksweep.sweep.cli.running import Running, run_with_progress

if TYPE_CHECKING:
    from linksweep.sweep.executing.pools import Resources
    from linksweep.sweep.stores.location import Location

all_option = click.option(
    "--all",
    "everything",
    is_flag=True,
    help="The whole paper: every built-in study (that has something published), run if it has not been yet.",
)
results_option = click.option("--results", type=FILE, help="Folder with the stores of --all.  [default: results]")


@dataclass(frozen=True)
class AskedStores:
    """The stores that a command is about: those that it names, or with --all those of the whole paper."""

    stores: "tuple[Location, ...]"
    everything: bool
    results: Path | None
    resources: "Resources"
    watching: Watching

    def require_either(self) -> None:
        """Raise click.UsageError unless there are either stores or --all, and for options of --all without it."""
        from linksweep.sweep.executing.pools import Resources

        if self.everything == bool(self.stores):
            raise click.UsageError("name stores, or give --all")
        of_runs = self.results is not None or self.resources != Resources() or self.watching != Watching()
        if of_runs and not self.everything:
            raise click.UsageError(
                "--results, what to run on and how to watch it go with --all: nothing runs without it"
            )

    def found(self, published: bool = False) -> "tuple[Location, ...]":
        """Return the stores; with --all, first run the unfinished studies: all, or those with something published."""
        if not self.everything:
            return self.stores
        from linksweep.sweep.cli.published_stores import lacks_packages, paper_studies, store_of, unfinished
        from linksweep.sweep.stores.location import located
        from linksweep.sweep.stores.named import RESULTS

        results = self.results or RESULTS
        studies = paper_studies(published)
        lacking = {study.name: words for study in studies if (words := lacks_packages(study, results))}
        for name, words in lacking.items():
            click.echo(f"left out: {name}: {words}", err=True)
        studies = [study for study in studies if study.name not in lacking]
        for study in unfinished(studies, results):
            if self.watching.level < logging.ERROR:
                click.echo(f"{study.name}:", err=True)
            run_with_progress(study, located(store_of(study, results)), Running(self.resources, self.watching, None))
        return tuple(located(store_of(study, results)) for study in studies)


@main.command()
@stores_argument
@all_option
@results_option
@resource_options
@watching_options
@option_with_default("--format", "table_format", type=click.Choice(["text", "csv"]), default="text")
@json_option
@gathered("asked", AskedStores)
def compare(asked: AskedStores, table_format: str, as_json: bool) -> None:
    """Compare the results in STORE with the published numbers and claims of its study.

    The exit code is 1 if something is not reproduced or incomplete.

    \b
    sweep compare results/quasars.zarr
    sweep compare --all --workers 4
    """
    table_format = json_or(table_format, as_json)
    from linksweep.sweep.analysis.compare import all_is_well
    from linksweep.sweep.cli.published_stores import compare_stores

    asked.require_either()
    comparisons, remarks = compare_stores(asked.found(published=True))
    print_comparisons(comparisons, remarks, table_format)
    if not all_is_well(comparisons):
        sys.exit(EXIT_FAILED_POINTS)


@main.command()
@stores_argument
@all_option
@results_option
@click.option(
    "-o",
    "--output",
    type=FILE,
    help="The page; an earlier report there is replaced, nothing else is.  [default: NAME-report.html]",
)
@resource_options
@watching_options
@gathered("asked", AskedStores)
def report(asked: AskedStores, output: Path | None) -> None:
    """Write one HTML page about the results in STORE: the answer, figures, tables, an interactive view, a comparison
    with published numbers, and where everything comes from.

    The page needs no network and no server.

    \b
    sweep report results/quasars.zarr
    sweep report --all -o paper.html
    """
    try:
        from linksweep.sweep.report.page import check_output, default_path, report_of, write_report
    except ImportError as error:
        raise click.UsageError(f"a report needs more packages: pip install 'linksweep[report]' ({error})") from error
    asked.require_either()
    path = output or (Path("paper-report.html") if asked.everything else default_path(asked.stores))
    check_output(path)
    write_report(report_of(asked.found()), path)
    click.echo(f"wrote {path}", err=True)
