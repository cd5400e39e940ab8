"""Arguments and options that several commands share, and what they turn into."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from sweep.run import Resources
    from sweep.study import Study

Command = Callable[..., Any]

study_argument = click.argument("study")
store_argument = click.argument("store", type=click.Path(path_type=Path))
place_option = click.option(
    "--at", multiple=True, metavar="AXIS=VALUE", help="Only this part of the grid, e.g. model=gaia,v_max=16."
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for a script.")

break_lock_option = click.option(
    "--break-lock",
    is_flag=True,
    help="Go on although another host seems to write to the store; make sure that it does not.",
)


def _store_path(_context: click.Context, _parameter: click.Parameter, value: str | None) -> Path | None:
    if value == "":
        raise click.BadParameter("is empty; give the path of a store")
    return None if value is None else Path(value)


def study_options(command: Command) -> Command:
    """Add the options that name a study's overrides and its store."""
    options = (
        click.option(
            "--set",
            "settings",
            multiple=True,
            metavar="KEY=VALUE",
            help="Override a value of the study, e.g. n_sim=500 or weighting=equal.",
        ),
        click.option(
            "--axis",
            "axes",
            multiple=True,
            metavar="NAME=SPEC",
            help="Override or add an axis: 14:20:0.5, 10:1000:log5 or amex,gaia.",
        ),
        click.option("-o", "--output", "store", callback=_store_path, help="The store.  [default: results/NAME.zarr]"),
    )
    for option in reversed(options):
        command = option(command)
    return command


def resource_options(command: Command) -> Command:
    """Add the options that say what to run on."""
    options = (
        click.option("--workers", type=click.IntRange(1, 4096), help="Local workers.  [default: one a core]"),
        click.option(
            "--pool",
            type=click.Choice(["processes", "threads", "serial"]),
            help="Local workers are processes, threads of this process, or none.  "
            "[default: processes; serial if small]",
        ),
        click.option(
            "--scheduler", metavar="ADDRESS", help="Use the Dask scheduler at this address, e.g. tcp://host:8786."
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


def load(study: str, settings: tuple[str, ...], axes: tuple[str, ...], store: Path | None) -> "tuple[Study, Path]":
    """Return the study with its overrides, and where its store is."""
    from sweep.reader import load_study

    loaded = load_study(study, settings, axes)
    return loaded, store or Path("results") / f"{loaded.name}.zarr"


def resources_of(workers: int | None, pool: Any, scheduler: str | None) -> "Resources":
    """Return the resources that the options name; raises click.UsageError for options that contradict each other."""
    from sweep.run import Resources

    if scheduler is not None and (workers is not None or pool is not None):
        raise click.UsageError("--workers and --pool are for local workers; they do not go with --scheduler")
    if pool == "serial" and workers is not None:
        raise click.UsageError("--pool serial has no workers")
    return Resources(workers, pool, scheduler)


def part_of(store: Path, at: tuple[str, ...]) -> Any:
    """Return the dataset of a store, of it the part that ``--at`` names."""
    from sweep.conditions import parse_places
    from sweep.quantity import select
    from sweep.store import open_dataset

    places = parse_places(at)
    dataset = open_dataset(store)
    with naming(store):
        return select(dataset, places)


@contextmanager
def naming(store: Path) -> Iterator[None]:
    """Name the store in errors that do not say what they are about."""
    from sweep.contract import SweepError

    try:
        yield
    except SweepError as error:
        if error.where:
            raise
        raise SweepError(error.problems, str(store)) from error
