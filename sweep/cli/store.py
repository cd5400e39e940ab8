"""Commands about stores as they are: show, status, check, reproduce and merge."""

import json
import sys
import traceback
from typing import TYPE_CHECKING

import click

from linksweep.sweep.cli import options
from linksweep.sweep.cli.group import EXIT_FAILED_POINTS, main
from linksweep.sweep.cli.output import print_status, print_table, print_verified
from linksweep.sweep.formatting import to_json

if TYPE_CHECKING:
    from linksweep.sweep.stores.location import Location


@main.command()
@options.store_argument
@options.option_with_default("--format", "table_format", type=click.Choice(["text", "csv", "ecsv"]), default="text")
@options.place_option
@options.json_option
def show(store: "Location", table_format: str, at: tuple[str, ...], as_json: bool) -> None:
    """Print the results in STORE as a table, and the components of the points with the worst condition; of a stored
    link or forecast, what `sweep tie` or `sweep forecast` printed.

    \b
    sweep show quasars --at model=gaia
    sweep show results/quasars.zarr --format ecsv > quasars.ecsv
    """
    table_format = options.json_or(table_format, as_json)
    if (link := options.link_in(store, at)) is not None:
        from linksweep.sweep.tie.text import as_format

        click.echo(as_format(link, table_format).rstrip("\n"))
        return
    # Formats for programs keep excluded points: a column has the status.
    with options.part_of(store, at, excluded_too=table_format != "text") as part:
        print_table(part, table_format, with_components=True)


@main.command()
@options.store_argument
@options.json_option
def status(store: "Location", as_json: bool) -> None:
    """Say how far the run in STORE is, what failed, and where the results come from.

    \b
    sweep status results/quasars.zarr
    """
    from linksweep.sweep.running.status import status_report

    report = status_report(store)
    if as_json:
        click.echo(to_json(report))
    else:
        print_status(report)


@main.command()
@options.store_argument
@click.option("--repair", is_flag=True, help="Set damaged files aside, in STORE.damaged; the next run computes again.")
@options.break_lock_option
@options.json_option
def check(store: "Location", repair: bool, break_lock: bool, as_json: bool) -> None:
    """Read every file in STORE and compare it with its checksum; the exit code is 1 if any is damaged.

    \b
    sweep check results/quasars.zarr
    sweep check results/quasars.zarr --repair
    """
    from linksweep.sweep.stores.repair import check as check_files
    from linksweep.sweep.stores.repair import repair as repair_files

    if repair and as_json:
        raise click.UsageError("--json is for a check without --repair")
    if break_lock and not repair:
        raise click.UsageError("--break-lock goes with --repair: a check writes nothing")
    if repair:
        for sentence in repair_files(store, break_lock=break_lock) or ["every file is as it was written"]:
            click.echo(sentence)
        return
    report = check_files(store)
    if as_json:
        click.echo(to_json(report))
    else:
        if not report:
            click.echo("every file is as it was written")
        for part in (report.identity, report.ledger, report.results):
            for file, problem in part.items():
                click.echo(f"{file}: {problem}")
        for remark in report.remarks:
            click.echo(f"{store} {remark}")
    if report:
        click.echo(f"`sweep check {store} --repair` repairs what can be repaired", err=True)
        sys.exit(EXIT_FAILED_POINTS)


@main.command()
@options.store_argument
@click.option("--at", metavar="AXIS=VALUE[,AXIS=VALUE]", help="The point, e.g. model=gaia,v_max=16.")
@options.option_with_default(
    "--points", type=click.IntRange(1), default=10, help="Without --at: how many points to compute, in two orders."
)
@click.option("--pdb", "debug", is_flag=True, help="Open the debugger where the point raises.")
@options.trust_option
@options.json_option
def reproduce(store: "Location", at: str | None, points: int, debug: bool, trust: bool, as_json: bool) -> None:
    """Compute points of STORE again and compare every bit with what is stored: one point in this process, or a few,
    each by itself in new processes, in two orders.

    The exit code is 1 if it raises, or if anything differs.

    \b
    sweep reproduce results/quasars.zarr --at model=gaia,v_max=16
    sweep reproduce results/quasars.zarr --points 20
    """
    from linksweep.sweep.contract import SweepError
    from linksweep.sweep.running.reproduce import reproduce as compute_again
    from linksweep.sweep.running.reproduce import study_of

    if at is None:
        if debug or as_json:
            raise click.UsageError(f"{'--pdb' if debug else '--json'} is for one point; name it with --at")
        sys.exit(EXIT_FAILED_POINTS if print_verified(study_of(store, trust=trust), store, points) else 0)
    try:
        again = compute_again(store, at, trust=trust)
    except SweepError:
        raise
    except Exception as error:
        traceback.print_exception(error)
        if debug:
            import pdb

            pdb.post_mortem(error.__traceback__)
        sys.exit(EXIT_FAILED_POINTS)
    print_table(again.dataset.assign_attrs(title=again.place, complete=1), "json" if as_json else "text")
    for sentence in again.other_code:
        click.echo(f"computed by other code than the store was: {sentence}", err=True)
    if again.differences is None:
        click.echo(f"{again.place} is {again.stored} in {store}; there is nothing to compare with", err=True)
    elif not again.differences:
        click.echo(f"every bit as in {store}", err=True)
    else:
        click.echo(f"differs from {store} in {', '.join(again.differences)}", err=True)
        for name, (stored, computed) in again.differences.items():
            click.echo(f"  {name}: {json.dumps(stored.tolist())} stored, {json.dumps(computed.tolist())} now", err=True)
        sys.exit(EXIT_FAILED_POINTS)


@main.command()
@options.store_argument
@click.argument("other", callback=options.located_option)
@click.option("-o", "--output", required=True, callback=options.located_option, help="The new store.")
@options.accept_code_option
@options.trust_option
@options.json_option
def merge(
    store: "Location", other: "Location", output: "Location", accept_code: bool, trust: bool, as_json: bool
) -> None:
    """Make a new store of two, STORE and OTHER, that hold the same experiment: the points of both.

    Points that both have are kept once, and must be the same to the last bit.

    \b
    sweep merge results/low.zarr results/high.zarr -o results/all.zarr
    """
    from linksweep.sweep.running.merge import merge as merge_stores

    dataset = merge_stores(store, other, output, accept_code=accept_code, trust=trust)
    print_table(dataset, "json" if as_json else "text")
    click.echo(f"wrote {output}", err=True)
