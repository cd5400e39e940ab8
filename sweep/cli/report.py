"""The command that writes a page: report."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from sweep.cli.group import main
from sweep.cli.log_options import Watching, watching_options
from sweep.cli.options import resource_options, stores_argument
from sweep.cli.paper import run_what_is_missing

if TYPE_CHECKING:
    from sweep.executing.choose import Resources
    from sweep.stores.location import Location


@main.command()
@stores_argument
@click.option("--all", "everything", is_flag=True, help="The whole paper: every built-in study, run if it was not yet.")
@click.option(
    "--results",
    type=click.Path(path_type=Path),
    help="Folder with the stores of --all.  [default: results]",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="The page; an earlier report there is replaced, nothing else is.  [default: NAME-report.html]",
)
@resource_options
@watching_options
def report(
    stores: "tuple[Location, ...]",
    everything: bool,
    results: Path | None,
    output: Path | None,
    resources: "Resources",
    watching: Watching,
) -> None:
    """Write one HTML page about the results in STORE: the answer, figures, tables, an interactive view, a comparison
    with published numbers, and where everything comes from.

    The page needs no network and no server.

    \b
    sweep report results/quasars.zarr
    sweep report --all -o paper.html
    """
    try:
        from sweep.report.page import check_output, default_path, report_of, write_report
    except ImportError as error:
        raise click.UsageError(f"a report needs more packages: pip install 'linksweep[report]' ({error})") from error
    from sweep.executing.choose import Resources
    from sweep.stores.named import RESULTS

    if everything == bool(stores):
        raise click.UsageError("name stores, or give --all")
    if not everything and (results is not None or resources != Resources() or watching != Watching()):
        raise click.UsageError("--results, what to run on and how to watch it go with --all: nothing runs without it")
    path = output or (Path("paper-report.html") if everything else default_path(stores))
    check_output(path)
    if everything:
        stores = run_what_is_missing(results or RESULTS, resources, watching)
    write_report(report_of(stores), path)
    click.echo(f"wrote {path}", err=True)
