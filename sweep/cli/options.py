"""Arguments and options that several commands share, what they turn into, and what a shell completes them with.

A shell asks at each press of a key, so that nothing heavy is imported here.
"""

import inspect
import os
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click import Context, Parameter
from click.shell_completion import CompletionItem

import linksweep
from linksweep.sweep.executing.pools import MOST_WORKERS
from linksweep.sweep.studies import built_in_studies

if TYPE_CHECKING:
    from linksweep.sweep.stores.location import Location
    from linksweep.sweep.studies.study import Part

FILE = click.Path(path_type=Path)
"""The type of the path of a file or folder, which need not exist."""

WORKERS = click.IntRange(1, MOST_WORKERS)
POSITIVE = click.FloatRange(0.0, min_open=True)

SAMPLING = ("n_sim", "n_cat", "seed", "precision", "max_n_sim", "keep_samples", "common_random_numbers")

At = tuple[str, ...]


def opt(help: str, *names: str, **more: Any) -> Any:  # noqa: A002 (as click has it)
    """Declare an option as the default of a parameter, by which it is called if it has no ``names``."""
    # Else only the pages would say what happens without an option.
    more = {"show_default": True} | more
    return lambda name: click.Option([name, *(names or ["--" + name.replace("_", "-")])], help=help, **more)


def arg(**more: Any) -> Any:
    """Declare an argument as the default of a parameter."""
    return lambda name: click.Argument([name], **more)


def choice(help: str, choices: Iterable[str], *names: str, **more: Any) -> Any:  # noqa: A002
    """Declare an option with one of some words as its value."""
    return opt(help, *names, type=click.Choice(list(choices)), **more)


def output(help: str, **more: Any) -> Any:  # noqa: A002
    """Declare ``-o``, a file to be written if ``more`` does not say otherwise."""
    return opt(help, "-o", "--output", **{"type": FILE} | more)


def parsed(parse: Callable[[str], Any]) -> Any:
    """Return a callback of an option that parses its value; its ValueError is a usage error."""

    def callback(context: Context, _parameter: Parameter, value: str | None) -> Any:
        if value is None or context.resilient_parsing:
            return None
        try:
            return parse(value)
        except ValueError as error:
            raise click.BadParameter(str(error)) from error

    return callback


many = partial(opt, multiple=True)
flag = partial(opt, is_flag=True)


@dataclass(frozen=True)
class Group:
    """A parameter that gets what ``make``, a function or class, makes of the options that it declares itself, or that
    ``options`` has.
    """

    make: Callable[..., Any]
    options: Mapping[str, Any]

    def parameters(self) -> dict[str, Parameter]:
        """Return the options and arguments of this group and of the groups in it, each once."""
        parameters: dict[str, Parameter] = {}
        for name, one in self.options.items():
            parameters.update(one.parameters() if isinstance(one, Group) else {name: one(name)})
        return parameters

    def call(self, values: Mapping[str, Any]) -> Any:
        """Return what this group makes of the values of its options."""
        options = self.options.items()
        return self.make(**{n: one.call(values) if isinstance(one, Group) else values[n] for n, one in options})


def group(make: Callable[..., Any]) -> Any:
    """Declare a parameter that gets what a function or class makes of the options that it declares."""
    return Group(make, {name: one.default for name, one in inspect.signature(make).parameters.items()})


def passed(**declared: Any) -> Any:
    """Declare a parameter that gets a dictionary with the values of these options, to be passed on."""
    return Group(dict, declared)


def _not_empty(text: str) -> str:
    if not text:
        raise ValueError("is empty; give the path of a store, or s3://BUCKET/NAME")
    return text


@parsed
def place(text: str) -> "Location":
    """Return the place of a store."""
    from linksweep.sweep.stores.location import located

    return located(_not_empty(text))


@parsed
def _named(text: Any) -> Any:
    """Return the place of what names an existing store, or the study whose store it is, or of several of these."""
    from linksweep.sweep.stores.location import store_named

    named = [store_named(_not_empty(one)) for one in (text if isinstance(text, tuple) else (text,))]
    return tuple(named) if isinstance(text, tuple) else named[0]


def _studies(_context: Context, _parameter: Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer the built-in studies and the TOML files here; where neither fits, whatever file the shell knows."""
    names = [*built_in_studies(), *sorted(path.name for path in Path().glob("*.toml"))]
    fitting = [CompletionItem(name) for name in names if name.startswith(incomplete)]
    # A shell takes one kind or the other.
    return fitting or [CompletionItem(incomplete, type="file")]


def _folders(_context: Context, _parameter: Parameter, incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(incomplete, type="dir")]


def _keys(context: Context, _parameter: Parameter, incomplete: str, more: Sequence[str] = ()) -> list[CompletionItem]:
    """Offer the axes of the study that was given before, what it fixes, and ``more``."""
    # The study is not parsed yet where an option lacks its value.
    study = str(context.params.get("study") or next(iter(context.args), ""))
    document: dict[str, Any] = {}
    with suppress(OSError, ValueError, RecursionError):
        # A shell has no place for an error.
        path = built_in_studies().get(study, Path(study))
        if path.stat().st_size < 100_000:
            # A shell waits for this at each press of a key.
            document = tomllib.loads(path.read_text(encoding="utf-8"))
    tables = [table for key in ("axes", "fixed") if isinstance(table := document.get(key), dict)]
    keys = [f"{key}=" for table in (*tables, more) for key in table]
    return [CompletionItem(key) for key in keys if key.startswith(incomplete)]


_ALSO_SAMPLING = partial(_keys, more=SAMPLING)
STORE = arg(callback=_named, shell_complete=_folders)
STORES = arg(nargs=-1, metavar="STORE...", callback=_named, shell_complete=_folders)
STUDY = arg(shell_complete=_studies)
AT = many("Only this part of the grid, e.g. model=gaia,v_max=16.", metavar="AXIS=VALUE")
JSON = flag("Print JSON for a script.", "--json")
BREAK_LOCK = flag("Continue although another host seems to write to the store; make sure that it does not.")
ACCEPT_CODE = flag("Continue a store that other code made; each point then records which code made it.")
TRUST = flag("Run the code that the store names, even if it is inside it or came from elsewhere.")
AXES = many(
    "Override or add an axis: 14:20:0.5, 0:1:lin5, 10:1000:log5.", "--axis", metavar="NAME=SPEC", shell_complete=_keys
)
SETTINGS = many("Override a value, e.g. n_sim=500.", "--set", metavar="KEY=VALUE", shell_complete=_ALSO_SAMPLING)
DESIGNS = "e.g. sobol:256 or sobol:256:SEED; latin-hypercube, halton, random, saltelli, morris."


def json_or(table_format: str, as_json: bool) -> str:
    """Return the format of a table that two options name together; raises click.UsageError if they name two."""
    if as_json and table_format != "text":
        raise click.UsageError(f"--json and --format {table_format} are two formats; name one")
    return "json" if as_json else table_format


@parsed
def _part(text: str) -> "Part":
    from linksweep.sweep.studies.study import Part

    return Part.of_task(os.environ) if text == "array" else Part.parsed(text)


PART = opt(
    "Compute part K of N alone, into STORE.part-K-of-N; array: that of this task of a SLURM job array.",
    metavar="K/N|array",
    callback=_part,
)


@dataclass(frozen=True)
class AskedStudy:
    """A study as the command line names it: its overrides, which are those of `load_study`, where its store is to be,
    and whether code inside a store is trusted.
    """

    study: str = STUDY
    settings: Sequence[str] = SETTINGS
    axes: Sequence[str] = AXES
    points: str | None = opt("Compute the points in this table: a column for each parameter.", metavar="FILE")
    design: str | None = opt(f"Compute a design of points, {DESIGNS}", metavar="NAME:N")
    ranges: Sequence[str] = many("A range of the design: 0.1:0.5, 1:100:log or a,b.", "--range", metavar="NAME=SPEC")
    exclude: Sequence[str] = many("Leave points out: kernel=linear,gamma>1.", "--exclude", metavar="CONDITIONS")
    output: "Location | None" = output(
        "The store: a path or s3://BUCKET/NAME.  [default: results/NAME.zarr]", type=str, callback=place
    )
    trust: bool = TRUST

    @property
    def overrides(self) -> tuple[Any, ...]:
        """What the command line changes in the study."""
        return self.settings, self.axes, self.points, self.design, self.ranges, self.exclude

    def load(self, part: "Part | None" = None) -> "tuple[linksweep.Study, Location]":
        """Return the study, or a part of it, and where its store is; raises SweepError for one inside a store that is
        not trusted.
        """
        from linksweep.sweep.stores.location import default_store, located

        study = load_trusted(self.study, self.trust, *self.overrides)
        store = self.output or located(default_store(study.name))
        return replace(study, part=part), store if part is None else located(part.place(store))

    def stored(self) -> "tuple[linksweep.Study, Location]":
        """Return the study of an existing store, named in its place, and the store; raises SweepError as `load`."""
        from linksweep.sweep.running.reproduce import study_of
        from linksweep.sweep.stores.location import store_named

        if any((*self.overrides, self.output)):
            raise click.UsageError("--retry computes points of a store as it is: name the store, without other changes")
        store = store_named(self.study)
        return study_of(store, trust=self.trust), store


def load_trusted(study: str, trust: bool, *overrides: Any) -> "linksweep.Study":
    """Return a study with the overrides of `load_study`; raises SweepError for one in a store that is not trusted."""
    from linksweep.sweep.stores.integrity import ROOT
    from linksweep.sweep.studies.reader import find_study, reference_in

    # Before anything is read: a study or a function inside a store came with the store, from whoever sent that.
    place = find_study(study) if (function := reference_in(study)) is None else Path(function.rpartition(":")[0])
    store = next((folder for folder in place.resolve().parents if (folder / ROOT).is_file()), None)
    if store is not None and not trust and (function is None or place.suffix == ".py"):
        reason = f"lies inside the store {store}, and would run what it names"
        raise linksweep.SweepError(f"{reason}; inspect it, and give --trust if it may run", str(place))
    return linksweep.load_study(study, *overrides)


def link_in(store: "Location", at: At) -> Any:
    """Return the link or forecast that a store holds, None if it holds a grid; ``--at`` is only for a grid."""
    from linksweep.sweep.result import stored_table

    result = stored_table(store)
    if result is not None and at:
        raise click.UsageError("--at chooses a part of a grid; this is one link or forecast")
    return None if result is None else result.dataset


@contextmanager
def part_of(store: "Location", at: At, excluded_too: bool = False, running: bool = False) -> Iterator[Any]:
    """Give the part of a store's dataset that ``--at`` names, with values so far if ``running``; errors in the block
    name the store unless they say what they are about.

    Raises SweepError where the study excludes all of that part, unless ``excluded_too``.
    """
    from linksweep.sweep.analysis.quantity import ERROR_SUFFIXES, array_outputs, select, with_running
    from linksweep.sweep.contract import Status
    from linksweep.sweep.stores.store import open_dataset
    from linksweep.sweep.studies.reader import parse_places

    places = parse_places(at)
    dataset = with_running(open_dataset(store, running))
    try:
        part = select(dataset, places)
        for name in set(array_outputs(dataset)) - set(array_outputs(part)):
            if not name.endswith(ERROR_SUFFIXES):
                # A place along an output's own dimension is for that output.
                part[name].attrs["headline"] = 1
        if at and not excluded_too and (part["status"].values == Status.EXCLUDED).all():
            points = "this point" if part["status"].size == 1 else "all of these points"
            raise linksweep.SweepError(f"--at {','.join(at)}: the study excludes {points}")
        yield part
    except linksweep.SweepError as error:
        if error.where:
            raise
        # What knows only datasets cannot name the store.
        raise linksweep.SweepError(error.problems, str(store)) from error
