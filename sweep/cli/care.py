"""Commands about stores as they are, and to begin a study: status, check, reproduce, merge; new and params."""

import json
import sys
import traceback
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linksweep.sweep.cli.group import EXIT_FAILED_POINTS, command
from linksweep.sweep.cli.options import ACCEPT_CODE, BREAK_LOCK, JSON, STORE, TRUST, arg, flag, opt, place
from linksweep.sweep.cli.options import output as output_option
from linksweep.sweep.cli.output import print_headlines, print_tables
from linksweep.sweep.cli.run import print_verified
from linksweep.sweep.formatting import WIDTH, to_json

if TYPE_CHECKING:
    from linksweep.sweep.stores.location import Location

MOST_FAILURES = 20
"""Most failed points that `sweep status` names in a terminal."""

EXPERIMENT = arg(default="linksweep.core.experiment:link")

WHOLE = "every file is as it was written"


def _wrapped(text: str, first: str = "", later: str = "  ") -> None:
    click.echo(click.wrap_text(text, WIDTH, first, later))


@command("Store care", "Say how far a run is, and what failed")
def status(store: "Location" = STORE, as_json: bool = JSON) -> None:
    """Say how far the run in STORE is, what failed, and where the results come from.

    \b
    sweep status results/quasars.zarr
    """
    from linksweep.sweep.running.failures import failed_points
    from linksweep.sweep.running.progress import axis_table
    from linksweep.sweep.running.status import status_report

    report = status_report(store)
    if as_json:
        click.echo(to_json(report))
        return
    for key, value in report.items():
        if key == "axes":
            click.echo(nl=bool(value))
            print_tables(axis_table(dimension, report["units"]) for dimension in value.values())
            click.echo(nl=bool(value))
        elif isinstance(value, dict) and key != "units":
            click.echo(f"{key}:")
            more = len(value) - MOST_FAILURES if key == "failures" else 0
            if more > 0:
                _wrapped(failed_points(value), "  ", "    ")
            for name, text in islice(value.items(), MOST_FAILURES):
                _wrapped(f"{name}: {text}", "  ", "    ")
            if more > 0:
                click.echo(f"  {more:,} more points: `sweep status STORE --json` has all of them")
        elif key != "units":
            _wrapped(f"{key}: {value}")


@command("Store care", "Compare files with checksums; set damaged aside")
def check(
    store: "Location" = STORE,
    repair: bool = flag("Set damaged files aside, in STORE.damaged; the next run computes again."),
    break_lock: bool = BREAK_LOCK,
    as_json: bool = JSON,
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
        click.echo("\n".join(files.repair(store, break_lock=break_lock) or [WHOLE]))
        return
    report = files.check(store)
    if as_json:
        click.echo(to_json(report))
    else:
        damaged = report.identity | report.ledger | report.results
        lines = [] if report else [WHOLE]
        lines += [f"{file}: {problem}" for file, problem in damaged.items()]
        click.echo("\n".join([*lines, *(f"{store} {remark}" for remark in report.remarks)]))
    if report:
        click.echo(f"`sweep check {store} --repair` repairs what can be repaired", err=True)
        sys.exit(EXIT_FAILED_POINTS)


@command("Store care", "Compute points again, to the bit")
def reproduce(
    store: "Location" = STORE,
    at: str | None = opt("The point, e.g. model=gaia,v_max=16.", metavar="AXIS=VALUE[,AXIS=VALUE]"),
    points: int = opt("Without --at: how many points to compute, in two orders.", type=click.IntRange(1), default=10),
    debug: bool = flag("Open the debugger where the point raises.", "--pdb"),
    trust: bool = TRUST,
    as_json: bool = JSON,
) -> None:
    """Compute points of STORE again and compare every bit with what is stored: one point in this process, or a few,
    each by itself in new processes, in two orders.

    The exit code is 1 if it raises, or if anything differs.

    \b
    sweep reproduce results/quasars.zarr --at model=gaia,v_max=16
    sweep reproduce results/quasars.zarr --points 20
    """
    from linksweep.sweep.contract import SweepError
    from linksweep.sweep.running import reproduce as computing

    if at is None:
        if debug or as_json:
            raise click.UsageError(f"{'--pdb' if debug else '--json'} is for one point; name it with --at")
        sys.exit(EXIT_FAILED_POINTS if print_verified(computing.study_of(store, trust=trust), store, points) else 0)
    try:
        again = computing.reproduce(store, at, trust=trust)
    except SweepError:
        raise
    except Exception as error:
        traceback.print_exception(error)
        if debug:
            import pdb

            pdb.post_mortem(error.__traceback__)
        sys.exit(EXIT_FAILED_POINTS)
    print_headlines(again.dataset.assign_attrs(title=again.place, complete=1), "json" if as_json else "text")
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


@command("Store care", "Make one store of two of the same experiment")
def merge(
    store: "Location" = STORE,
    other: "Location" = arg(callback=place),
    output: "Location" = output_option("The new store.", type=str, required=True, callback=place),
    accept_code: bool = ACCEPT_CODE,
    trust: bool = TRUST,
    as_json: bool = JSON,
) -> None:
    """Make a new store of two, STORE and OTHER, that hold the same experiment: the points of both.

    Points that both have are kept once, and must be the same to the last bit.

    \b
    sweep merge results/low.zarr results/high.zarr -o results/all.zarr
    """
    from linksweep.sweep.running.merge import merge as merge_stores

    dataset = merge_stores(store, other, output, accept_code=accept_code, trust=trust)
    print_headlines(dataset, "json" if as_json else "text")
    click.echo(f"wrote {output}", err=True)


@command("Your own", "Write a commented study to start from")
def new(name: str = arg(), experiment: str = EXPERIMENT) -> None:
    """Write NAME.toml, a study of EXPERIMENT to start from: it runs as it is, and has every parameter in a comment.

    \b
    sweep new mine
    sweep new mine my_experiment.py:experiment
    """
    from linksweep.sweep.code.load import load_experiment
    from linksweep.sweep.contract import SweepError, shown
    from linksweep.sweep.studies.reader import GOOD_NAME
    from linksweep.sweep.studies.template import new_study

    if not GOOD_NAME.fullmatch(name):
        raise SweepError(
            f"{shown(name)} is no name for a study: letters, digits and _ . + -, at most 60; a letter first"
        )
    path = Path(f"{name}.toml")
    text = new_study(name, experiment, load_experiment(experiment)).encode(errors="replace")
    try:
        with path.open("xb") as file:
            file.write(text)
    except FileExistsError as error:
        raise SweepError("exists already; take another name", str(path)) from error
    except OSError as error:
        with suppress(OSError):
            path.unlink()
        raise SweepError(f"cannot be written: {error.strerror or error}", str(path)) from error
    click.echo(f"wrote {path}; edit it, then: sweep plan {path}", err=True)


@command("Your own", "List the parameters of a study or experiment")
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
    from linksweep.sweep.code.load import load_experiment
    from linksweep.sweep.studies.document import built_in_studies
    from linksweep.sweep.studies.reader import load_study
    from linksweep.sweep.studies.template import study_schema

    is_study = experiment.endswith(".toml") or experiment in built_in_studies()
    declared = load_study(experiment).experiment if is_study else load_experiment(experiment)
    if schema:
        click.echo(json.dumps(study_schema(declared), indent=1, ensure_ascii=False))
        return
    rows = [
        {"name": p.name, "unit": p.unit, "default": p.default, "allowed": p.allowed(), "meaning": p.meaning}
        for p in declared.parameters
    ]
    if as_json:
        click.echo(to_json(rows))
        return
    for row in rows:
        default = "see below" if row["default"] is None else row["default"]
        unit = f" [{row['unit']}]" if row["unit"] else ""
        click.echo(f"{row['name']}{unit}  default: {default}")
        _wrapped(f"{row['meaning']}; {row['allowed']}", "    ", "    ")
