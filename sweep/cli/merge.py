"""The command that makes one store of two: merge."""

from typing import TYPE_CHECKING

import click

from sweep.cli.group import main
from sweep.cli.options import accept_code_option, json_option, located_option, store_argument, trust_option
from sweep.cli.output import print_table

if TYPE_CHECKING:
    from sweep.stores.location import Location


@main.command()
@store_argument
@click.argument("other", callback=located_option)
@click.option("-o", "--output", required=True, callback=located_option, help="The new store.")
@accept_code_option
@trust_option
@json_option
def merge(
    store: "Location", other: "Location", output: "Location", accept_code: bool, trust: bool, as_json: bool
) -> None:
    """Make a new store of two, STORE and OTHER, that hold the same experiment: the points of both.

    Points that both have are kept once, and must be the same to the last bit.

    \b
    sweep merge results/low.zarr results/high.zarr -o results/all.zarr
    """
    from sweep.running.merge import merge as merge_stores

    dataset = merge_stores(store, other, output, accept_code=accept_code, trust=trust)
    print_table(dataset, "json" if as_json else "text")
    click.echo(f"wrote {output}", err=True)
