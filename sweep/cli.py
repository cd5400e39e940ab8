"""The command line; each command calls one function of the library, imported when it is needed."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from sweep.run import Resources
    from sweep.study import Study

EXIT_FAILED_POINTS = 1
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130

Command = Callable[..., Any]


class _Group(click.Group):
    """Turns a SweepError of any command into one message and exit code 2."""

    def invoke(self, ctx: click.Context) -> Any:
        from sweep.contract import SweepError

        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            click.echo("interrupted", err=True)
            sys.exit(EXIT_INTERRUPTED)
        except SweepError as error:
            where = f"{error.where}: " if error.where else ""
            if len(error.problems) == 1:
                click.echo(f"error: {where}{error.problems[0]}", err=True)
            else:
                click.echo(f"error: {where}{len(error.problems)} problems", err=True)
                for problem in error.problems:
                    click.echo(f"  - {problem}", err=True)
            sys.exit(EXIT_BAD_INPUT)


study_argument = click.argument("study")
store_argument = click.argument("store", type=click.Path(path_type=Path))
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for a script.")


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


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="linksweep", prog_name="linksweep")
def main() -> None:
    """Sweep Monte-Carlo simulations of a satellite's link to the extragalactic frame.

    \b
    sweep run quasars        the paper's Table 1, computed beside the published one
    sweep list               the other built-in studies
    """


@main.command()
@study_argument
@study_options
@resource_options
@click.option("--dry-run", is_flag=True, help="Plan only, like `sweep plan`.")
@json_option
def run(
    study: str,
    settings: tuple[str, ...],
    axes: tuple[str, ...],
    store: Path | None,
    workers: int | None,
    pool: Any,
    scheduler: str | None,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Run STUDY (a built-in name or a TOML file) into a Zarr store, and print the table.

    After an interruption the same command goes on where it stopped.

    \b
    sweep run quasars
    sweep run quasars --set n_cat=20 -o results/quick.zarr
    sweep run my_study.toml --axis v_max=14:16:0.25 --workers 4
    """
    resources = _resources(workers, pool, scheduler)
    loaded, path = _load(study, settings, axes, store)
    if dry_run:
        _print_plan(loaded, path, as_json)
        return
    dataset, failures = _run(loaded, path, resources)
    _print_table(dataset, "json" if as_json else "text")
    click.echo(f"wrote {path}", err=True)
    if failures:
        click.echo(_failures_in_words(failures, path), err=True)
        sys.exit(EXIT_FAILED_POINTS)


@main.command()
@study_argument
@study_options
@json_option
def plan(study: str, settings: tuple[str, ...], axes: tuple[str, ...], store: Path | None, as_json: bool) -> None:
    """Say what a run of STUDY would do: points, realisations, tasks, memory, time, what is done already.

    \b
    sweep plan grid --set n_cat=100
    """
    loaded, path = _load(study, settings, axes, store)
    _print_plan(loaded, path, as_json)


@main.command()
@store_argument
@click.option(
    "--format", "table_format", type=click.Choice(["text", "csv", "ecsv", "json"]), default="text", show_default=True
)
@json_option
def show(store: Path, table_format: str, as_json: bool) -> None:
    """Print the results in STORE as a table.

    \b
    sweep show results/quasars.zarr
    sweep show results/quasars.zarr --format ecsv > quasars.ecsv
    """
    from sweep.store import open_dataset

    _print_table(open_dataset(store), "json" if as_json else table_format)


@main.command()
@store_argument
@json_option
def status(store: Path, as_json: bool) -> None:
    """Say how far the run in STORE is, what failed, and where the results come from.

    \b
    sweep status results/quasars.zarr
    """
    from sweep.status import status_report

    report = status_report(store)
    if as_json:
        click.echo(json.dumps(report, indent=1))
        return
    for key, value in report.items():
        if isinstance(value, dict):
            click.echo(f"{key}:")
            for name, text in value.items():
                click.echo(f"  {name}: {text}")
        else:
            click.echo(f"{key}: {value}")


@main.command()
@store_argument
@click.option("--variable", default="sigma_spin", show_default=True, help="What to draw.")
@click.option("--over", help="The axis to draw along.  [default: the longest with numbers]")
@click.option(
    "--out", type=click.Path(path_type=Path), help="Picture to write: .png, .svg or .pdf.  [default: NAME.png]"
)
def plot(store: Path, variable: str, over: str | None, out: Path | None) -> None:
    """Draw a result in STORE against an axis: points with errors, the prediction as a line, published values open.

    \b
    sweep plot results/quasars.zarr --out quasars.svg
    """
    from sweep.store import open_dataset

    dataset = open_dataset(store)
    try:
        from sweep.plots import numeric_axes, save_lines
    except ImportError as error:
        raise click.UsageError(f"drawing needs matplotlib: pip install 'linksweep[plot]' ({error})") from error
    candidates = numeric_axes(dataset, variable) if variable in dataset else []
    path = out or Path(store.name).with_suffix(".png")
    save_lines(dataset, variable, over or (candidates[0] if candidates else ""), path)
    click.echo(f"wrote {path}", err=True)


@main.command()
@json_option
def calibrate(as_json: bool) -> None:
    """Refit the mission curves to the paper's tables: constants, uncertainties, residuals, and what equal weights give.

    \b
    sweep calibrate
    sweep calibrate --json > calibration.json
    """
    from sweep.calibrate import as_text, calibration_report

    report = calibration_report()
    if as_json:
        click.echo(json.dumps(report, indent=1))
        return
    _print_whole(as_text(report))


@main.command()
@click.argument("stores", nargs=-1, metavar="STORE...", type=click.Path(path_type=Path))
@click.option("--all", "everything", is_flag=True, help="The whole paper: every built-in study, run where it is not.")
@click.option(
    "--results",
    type=click.Path(path_type=Path),
    help="Where --all has the stores.  [default: results]",
)
@resource_options
@click.option("--format", "table_format", type=click.Choice(["text", "csv", "json"]), default="text", show_default=True)
@json_option
def compare(
    stores: tuple[Path, ...],
    everything: bool,
    results: Path | None,
    workers: int | None,
    pool: Any,
    scheduler: str | None,
    table_format: str,
    as_json: bool,
) -> None:
    """Compare the results in STORE with the published numbers and claims of its study.

    The exit code is 1 if something is not reproduced or incomplete.

    \b
    sweep compare results/quasars.zarr
    sweep compare --all --workers 4
    """
    from sweep.compare import all_is_well
    from sweep.reproduce import compare_stores

    if everything == bool(stores):
        raise click.UsageError("name stores, or give --all")
    if not everything and (results is not None or workers is not None or pool is not None or scheduler is not None):
        raise click.UsageError("--results, --workers, --pool and --scheduler go with --all: nothing runs without it")
    if everything:
        stores = _run_what_is_missing(results or Path("results"), _resources(workers, pool, scheduler))
    comparisons, remarks = compare_stores(stores)
    _print_comparisons(comparisons, remarks, "json" if as_json else table_format)
    if not all_is_well(comparisons):
        sys.exit(EXIT_FAILED_POINTS)


@main.command("list")
@json_option
def list_studies(as_json: bool) -> None:
    """List the built-in studies.

    \b
    sweep list
    """
    import tomllib

    from sweep.reader import built_in_studies

    titles = {
        name: tomllib.loads(path.read_text(encoding="utf-8"))["title"] for name, path in built_in_studies().items()
    }
    if as_json:
        click.echo(json.dumps(titles, indent=1))
        return
    width = max(map(len, titles))
    for name, title in titles.items():
        click.echo(f"{name:{width}}  {title}")


@main.command()
@click.argument("experiment", default="core.experiment:link")
@json_option
def params(experiment: str, as_json: bool) -> None:
    """List the parameters of EXPERIMENT (module:attribute or file.py:attribute) with unit, default, allowed values and
    meaning.

    \b
    sweep params
    sweep params my_experiment.py:experiment
    """
    from sweep.load import load_experiment

    parameters = load_experiment(experiment).parameters
    rows = [
        {"name": p.name, "unit": p.unit, "default": p.default, "allowed": p.allowed(), "meaning": p.meaning}
        for p in parameters
    ]
    if as_json:
        click.echo(json.dumps(rows, indent=1))
        return
    for row in rows:
        default = "see below" if row["default"] is None else row["default"]
        unit = f" [{row['unit']}]" if row["unit"] else ""
        click.echo(f"{row['name']}{unit}  default: {default}\n    {row['meaning']}; {row['allowed']}")


@main.command()
@click.argument("stars", type=click.Path(path_type=Path))
@click.argument("galaxies", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--supplement", type=click.Path(path_type=Path), help="More stars, whose matches are a class of their own."
)
@click.option(
    "--radius", multiple=True, metavar="[NAME=]ARCSEC", help="Match radius, of all or of one catalogue.  [default: 5]"
)
@click.option(
    "--error",
    multiple=True,
    metavar="[NAME=]ARCSEC",
    help="Position error of each coordinate, instead of columns ra_error and dec_error.",
)
@click.option(
    "--column",
    multiple=True,
    metavar="[NAME:]KEY=COLUMN",
    help="The column with a quantity, of the stars or of the table NAME, e.g. ra=RAmdeg or pgc:PGC=pgc.",
)
@click.option("--epoch", type=float, default=2000.0, show_default=True, help="Julian year of the galaxy positions.")
@click.option(
    "--ref-epoch", multiple=True, metavar="[NAME=]YEAR", help="Epoch of the stars, instead of a column ref_epoch."
)
@click.option(
    "--missing-pm",
    type=click.Choice(["error", "zero"]),
    default="error",
    show_default=True,
    help="What to do with stars that have no proper motion.",
)
@click.option(
    "--merge-radius",
    type=click.FloatRange(0.0, 3600.0, min_open=True),
    metavar="ARCSEC",
    help="Entries of two catalogues this close are one galaxy.  [default: the sum of their match radii]",
)
@click.option(
    "--k-sigma",
    type=click.FloatRange(0.0, min_open=True),
    default=3.0,
    show_default=True,
    help="Uncertain: offset above this many sigma.",
)
@click.option(
    "--crowding-radius",
    type=click.FloatRange(0.0, 3600.0, min_open=True),
    metavar="ARCSEC",
    default=120.0,
    show_default=True,
    help="Uncertain: so many stars within this radius.",
)
@click.option(
    "--crowding-stars",
    type=click.IntRange(1),
    default=3,
    show_default=True,
    help="Uncertain: at least this many other stars within the crowding radius.",
)
@click.option(
    "--epoch-difference",
    type=click.FloatRange(0.0, min_open=True),
    metavar="YR",
    default=20.0,
    show_default=True,
    help="Years to a second epoch, for the proper-motion error.",
)
@click.option(
    "--second-epoch-error",
    type=click.FloatRange(0.0),
    metavar="MAS",
    default=0.0,
    show_default=True,
    help="Position error of the second epoch.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=Path("results/matches.ecsv"),
    show_default=True,
    help="The matches as ECSV.",
)
@click.option("--table", type=click.Path(path_type=Path), help="Also the paper's 46-byte table.")
@click.option("--map", "sky_map", type=click.Path(path_type=Path), help="Also an all-sky map (.png, .svg or .pdf).")
@click.option("--overwrite", is_flag=True, help="Replace files that exist.")
@json_option
def match(
    stars: Path,
    galaxies: tuple[Path, ...],
    supplement: Path | None,
    radius: tuple[str, ...],
    error: tuple[str, ...],
    column: tuple[str, ...],
    epoch: float,
    ref_epoch: tuple[str, ...],
    missing_pm: Any,
    merge_radius: float | None,
    k_sigma: float,
    crowding_radius: float,
    crowding_stars: int,
    epoch_difference: float,
    second_epoch_error: float,
    output: Path,
    table: Path | None,
    sky_map: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Find the galaxies in a star catalogue: cross-match STARS with one or more GALAXIES tables.

    Tables are ECSV, FITS, VOTable, CSV, MRT or Parquet with the column names of the Gaia archive; options call a
    table by its file name up to the first dot.

    \b
    sweep match tycho2.fits pgc.fits uzc.csv --supplement tycho2_suppl1.fits \\
        --radius pgc=15 --radius uzc=3 --error pgc=5 --error uzc=1 \\
        -o galaxies.ecsv --table galaxies.dat --map galaxies.png
    """
    from sweep.search.match import find_galaxies
    from sweep.search.options import plan_search
    from sweep.search.outputs import Outputs
    from sweep.search.summary import summarise, summary_text

    search = plan_search(
        stars,
        galaxies,
        supplement,
        radius=radius,
        error=error,
        ref_epoch=ref_epoch,
        column=column,
        missing_pm=missing_pm,
        epoch=epoch,
        k_sigma=k_sigma,
        crowding_radius_arcsec=crowding_radius,
        crowding_stars=crowding_stars,
        merge_radius_arcsec=merge_radius,
        epoch_difference_yr=epoch_difference,
        second_epoch_error_mas=second_epoch_error,
    )
    outputs = Outputs(output, table, sky_map)
    summary = summarise(find_galaxies(search, outputs, overwrite))
    if as_json:
        click.echo(json.dumps(summary, indent=1))
    else:
        for part in summary_text(summary):
            _print_whole(part)
    for path in outputs.paths():
        click.echo(f"wrote {path}", err=True)


def _load(study: str, settings: tuple[str, ...], axes: tuple[str, ...], store: Path | None) -> "tuple[Study, Path]":
    from sweep.reader import load_study

    loaded = load_study(study, settings, axes)
    return loaded, store or Path("results") / f"{loaded.name}.zarr"


def _resources(workers: int | None, pool: Any, scheduler: str | None) -> "Resources":
    from sweep.run import Resources

    if scheduler is not None and (workers is not None or pool is not None):
        raise click.UsageError("--workers and --pool are for local workers; they do not go with --scheduler")
    if pool == "serial" and workers is not None:
        raise click.UsageError("--pool serial has no workers")
    return Resources(workers, pool, scheduler)


def _run(study: "Study", store: Path, resources: "Resources") -> tuple[Any, dict[int, str]]:
    """Run a study with progress shown; an interruption ends the command."""
    from sweep.progress import TerminalProgress
    from sweep.run import RunInterruptedError, run_study

    with TerminalProgress() as progress:
        try:
            return run_study(study, store, resources, progress)
        except RunInterruptedError:
            progress.say(f"interrupted; what was finished is kept in {store}, the same command goes on from there")
            sys.exit(EXIT_INTERRUPTED)


def _failures_in_words(failures: dict[int, str], store: Path) -> str:
    return f"{len(failures)} point{'s' if len(failures) > 1 else ''} failed; `sweep status {store}` names them"


def _run_what_is_missing(results: Path, resources: "Resources") -> tuple[Path, ...]:
    """Return the stores of all built-in studies with something published, after running those that need it."""
    from sweep.reproduce import published_studies, store_of, unfinished

    studies = published_studies()
    for study in unfinished(studies, results):
        store = store_of(study, results)
        click.echo(f"{study.name}:", err=True)
        _, failures = _run(study, store, resources)
        if failures:
            click.echo(_failures_in_words(failures, store), err=True)
    return tuple(store_of(study, results) for study in studies)


def _print_comparisons(comparisons: Any, remarks: list[str], table_format: str) -> None:
    from sweep import compare_tables

    if table_format == "json":
        click.echo(compare_tables.as_json(comparisons, remarks))
        return
    if table_format == "csv":
        click.echo(compare_tables.as_csv(comparisons).rstrip("\n"))
        for sentence in remarks:
            click.echo(sentence, err=True)
        return
    _print_whole(compare_tables.as_text(comparisons))
    for sentence in ("", *compare_tables.notes(comparisons), *remarks, compare_tables.summary_line(comparisons)):
        click.echo(sentence)


def _print_whole(renderable: Any) -> None:
    """Print a table or text as wide as it is: a terminal may wrap it, but no number is cut."""
    from rich.console import Console
    from rich.measure import Measurement

    terminal = Console(highlight=False)
    endless = terminal.options.update(width=10_000)
    needed = Measurement.get(terminal, endless, renderable).maximum
    width = max(needed, terminal.width if sys.stdout.isatty() else 1)
    Console(width=width, highlight=False).print(renderable, soft_wrap=False)


def _print_plan(study: "Study", store: Path, as_json: bool) -> None:
    from sweep.status import plan_report

    report = plan_report(study, store)
    if as_json:
        click.echo(json.dumps(report, indent=1))
    else:
        for key, value in report.items():
            click.echo(f"{key:14} {value:,}" if isinstance(value, (int, float)) else f"{key:14} {value}")


def _print_table(dataset: Any, table_format: str) -> None:
    from sweep import tables

    if table_format == "text":
        _print_whole(tables.as_text(dataset))
        if not dataset.attrs.get("complete"):
            click.echo(
                f"INCOMPLETE: {dataset.attrs.get('points_done')} of {dataset.attrs.get('points')} points are done"
            )
    else:
        write = {"csv": tables.as_csv, "ecsv": tables.as_ecsv, "json": tables.as_json}[table_format]
        click.echo(write(dataset).rstrip("\n"))
