"""Commands that compute points of a store again: retry and reproduce."""

import json
import sys
import traceback
from typing import TYPE_CHECKING

import click

from sweep.cli.group import EXIT_FAILED_POINTS, main
from sweep.cli.log_options import Watching, watching_options
from sweep.cli.options import (
    accept_code_option,
    break_lock_option,
    json_option,
    store_argument,
    trust_option,
)
from sweep.cli.output import print_table
from sweep.cli.resource_options import resource_options
from sweep.cli.running import run_with_progress

if TYPE_CHECKING:
    from sweep.executing.choose import Resources
    from sweep.stores.location import Location


@main.command()
@store_argument
@resource_options
@break_lock_option
@accept_code_option
@watching_options
@trust_option
@json_option
def retry(
    store: "Location",
    resources: "Resources",
    break_lock: bool,
    accept_code: bool,
    watching: Watching,
    trust: bool,
    as_json: bool,
) -> None:
    """Compute the failed points in STORE again, and only those.

    \b
    sweep retry results/quasars.zarr
    """
    from sweep.running.reproduce import study_of

    study = study_of(store, trust=trust)
    failures = run_with_progress(
        study, store, resources, watching, as_json, retry=True, break_lock=break_lock, accept_code=accept_code
    )
    if failures:
        sys.exit(EXIT_FAILED_POINTS)


@main.command()
@store_argument
@click.option("--at", required=True, metavar="AXIS=VALUE[,AXIS=VALUE]", help="The point, e.g. model=gaia,v_max=16.")
@click.option("--pdb", "debug", is_flag=True, help="Open the debugger where the point raises.")
@trust_option
@json_option
def reproduce(store: "Location", at: str, debug: bool, trust: bool, as_json: bool) -> None:
    """Compute one point of STORE again, in this process, and compare every bit with what is stored.

    The exit code is 1 if it raises, or if anything differs.

    \b
    sweep reproduce results/quasars.zarr --at model=gaia,v_max=16
    """
    from sweep.contract import SweepError
    from sweep.running.reproduce import reproduce as compute_again

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
