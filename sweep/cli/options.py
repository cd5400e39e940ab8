"""Arguments and options that several commands share, and what they turn into."""

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from linksweep.sweep.cli import shell_completion

if TYPE_CHECKING:
    from linksweep.sweep.stores.location import Location
    from linksweep.sweep.studies.study import Study

Command = Callable[..., Any]
Decorator = Callable[[Command], Command]

option_with_default = functools.partial(click.option, show_default=True)

FILE = click.Path(path_type=Path)
"""The type of the path of a file or folder, which need not exist."""

place_option = click.option(
    "--at", multiple=True, metavar="AXIS=VALUE", help="Only this part of the grid, e.g. model=gaia,v_max=16."
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for a script.")

break_lock_option = click.option(
    "--break-lock",
    is_flag=True,
    help="Continue although another host seems to write to the store; make sure that it does not.",
)

accept_code_option = click.option(
    "--accept-code",
    is_flag=True,
    help="Continue a store that other code made; each point then records which code made it.",
)


def located_option(context: click.Context, _parameter: click.Parameter, value: str | None) -> "Location | None":
    """Turn what names a store into its place; nothing while a shell completes."""
    if value is None or context.resilient_parsing:
        return None
    from linksweep.sweep.stores.location import located

    if value == "":
        raise click.BadParameter("is empty; give the path of a store, or s3://BUCKET/NAME")
    return located(value)


def _named(context: click.Context, parameter: click.Parameter, value: Any) -> Any:
    """Turn what names an existing store, or the study whose store it is, or several of these, into places."""
    if isinstance(value, tuple):
        return tuple(_named(context, parameter, one) for one in value)
    if not value or context.resilient_parsing:
        return located_option(context, parameter, value)
    from linksweep.sweep.stores.named import store_named

    return store_named(value)


store_argument = click.argument("store", callback=_named, shell_complete=shell_completion.stores)
stores_argument = click.argument(
    "stores", nargs=-1, metavar="STORE...", callback=_named, shell_complete=shell_completion.stores
)


trust_option = click.option(
    "--trust", is_flag=True, help="Run the code that the store names, even if it is inside it or came from elsewhere."
)


def json_or(table_format: str, as_json: bool) -> str:
    """Return the format of a table that two options name together; raises click.UsageError if they name two."""
    if as_json and table_format != "text":
        raise click.UsageError(f"--json and --format {table_format} are two formats; name one")
    return "json" if as_json else table_format


def gathered(name: str, make: Callable[..., Any], *options: Decorator) -> Decorator:
    """Return a decorator that adds options to a command, which gets as one argument what ``make`` makes of them.

    Options that ``make`` has no parameter for are left as they are.
    """
    parameters = signature(make).parameters

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def with_one(*arguments: Any, **named: Any) -> Any:
            made = make(**{option: named.pop(option) for option in parameters})
            return command(*arguments, **{name: made}, **named)

        decorated: Command = with_one
        for option in reversed(options):
            decorated = option(decorated)
        return decorated

    return decorate


@dataclass(frozen=True)
class AskedStudy:
    """A study as the command line names it: its overrides, which are those of `load_study`, where its store is to be,
    and whether code inside a store is trusted.
    """

    study: str
    settings: Sequence[str]
    axes: Sequence[str]
    points: str | None
    design: str | None
    ranges: Sequence[str]
    store: "Location | None"
    trust: bool

    def load(self) -> "tuple[Study, Location]":
        """Return the study, and where its store is; raises SweepError for one inside a store that is not trusted."""
        from linksweep.sweep.stores.location import located
        from linksweep.sweep.stores.named import default_store

        given = self.settings, self.axes, self.points, self.design, self.ranges
        study = load_trusted(self.study, self.trust, *given)
        return study, self.store or located(default_store(study.name))

    def stored(self) -> "tuple[Study, Location]":
        """Return the study of an existing store, named in its place, and the store; raises SweepError as `load`."""
        from linksweep.sweep.running.reproduce import study_of
        from linksweep.sweep.stores.named import store_named

        if any((self.settings, self.axes, self.points, self.design, self.ranges, self.store)):
            raise click.UsageError("--retry computes points of a store as it is: name the store, without other changes")
        store = store_named(self.study)
        return study_of(store, trust=self.trust), store


def load_trusted(study: str, trust: bool, *overrides: Any) -> "Study":
    """Return a study with the overrides of `load_study`; raises SweepError for one in a store that is not trusted."""
    from linksweep.sweep.running.trust import require_trust_of_study
    from linksweep.sweep.studies.document import find_study, reference_in
    from linksweep.sweep.studies.reader import load_study

    if (function := reference_in(study)) is None:
        require_trust_of_study(find_study(study), trust)
    elif (file := function.rpartition(":")[0]).endswith(".py"):
        require_trust_of_study(Path(file), trust)
    return load_study(study, *overrides)


study_options = gathered(
    "asked",
    AskedStudy,
    click.argument("study", shell_complete=shell_completion.studies),
    click.option(
        "--set",
        "settings",
        multiple=True,
        metavar="KEY=VALUE",
        shell_complete=shell_completion.settings,
        help="Override a value of the study, e.g. n_sim=500 or weighting=equal.",
    ),
    click.option(
        "--axis",
        "axes",
        multiple=True,
        metavar="NAME=SPEC",
        shell_complete=shell_completion.axes,
        help="Override or add an axis: 14:20:0.5, 10:1000:log5 or amex,gaia.",
    ),
    click.option("--points", metavar="FILE", help="Compute the points in this table: a column for each parameter."),
    click.option(
        "--design",
        metavar="NAME:N",
        help="Compute a design of points, e.g. sobol:256 or sobol:256:SEED; latin-hypercube, halton, random, "
        "saltelli, morris.",
    ),
    click.option(
        "--range",
        "ranges",
        multiple=True,
        metavar="NAME=SPEC",
        help="The range of a parameter in the design: 0.1:0.5, 1:100:log or amex,gaia.",
    ),
    click.option(
        "-o",
        "--output",
        "store",
        callback=located_option,
        help="The store: a path or s3://BUCKET/NAME.  [default: results/NAME.zarr]",
    ),
)
"""STUDY, what of it is overridden, and its store; with `trust_option` below it the command gets ``asked``."""


def link_in(store: "Location", at: tuple[str, ...]) -> Any:
    """Return the link or forecast that a store holds, None if it holds a grid; ``--at`` is only for a grid."""
    from linksweep.sweep.tie.stored import result_at

    result = result_at(store)
    if result is not None and at:
        raise click.UsageError("--at chooses a part of a grid; this is one link or forecast")
    return result


@contextmanager
def part_of(store: "Location", at: tuple[str, ...], excluded_too: bool = False) -> Iterator[Any]:
    """Give the part of a store's dataset that ``--at`` names; errors in the block name the store unless they say what
    they are about.

    Raises SweepError where the study excludes all of that part, unless ``excluded_too``.
    """
    from linksweep.sweep.analysis.long_table import array_outputs
    from linksweep.sweep.analysis.quantity import ERROR_SUFFIXES
    from linksweep.sweep.analysis.selection import select
    from linksweep.sweep.contract import SweepError
    from linksweep.sweep.planning.point_status import Status
    from linksweep.sweep.stores.store import open_dataset
    from linksweep.sweep.studies.document import parse_places

    places = parse_places(at)
    dataset = open_dataset(store)
    try:
        part = select(dataset, places)
        for name in set(array_outputs(dataset)) - set(array_outputs(part)):
            if not name.endswith(ERROR_SUFFIXES):  # a place along an output's own dimension is for that output
                part[name].attrs["headline"] = 1
        if at and not excluded_too and (part["status"].values == Status.EXCLUDED).all():
            points = "this point" if part["status"].size == 1 else "all of these points"
            raise SweepError(f"--at {','.join(at)}: the study excludes {points}")
        yield part
    except SweepError as error:
        if error.where:
            raise
        raise SweepError(error.problems, str(store)) from error
