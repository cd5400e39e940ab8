"""The command that writes a page: report."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from sweep.cli.group import main
from sweep.cli.log_options import Watching, watching_options
from sweep.cli.options import FILE, stores_argument
from sweep.cli.paper import all_option, require_stores_or_all, results_option, run_what_is_missing
from sweep.cli.resource_options import resource_options

if TYPE_CHECKING:
    from sweep.executing.choose import Resources
    from sweep.stores.location import Location


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
    require_stores_or_all(stores, everything, results, resources, watching)
    path = output or (Path("paper-report.html") if everything else default_path(stores))
    check_output(path)
    if everything:
        stores = run_what_is_missing(results, resources, watching)
    write_report(report_of(stores), path)
    click.echo(f"wrote {path}", err=True)
