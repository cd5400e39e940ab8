"""Commands to begin a study, new and params, and about real tables: tie and forecast solve for a link, match finds the
galaxies among stars.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import linksweep
from linksweep.sweep import cli
from linksweep.sweep.cli import FILE, JSON, arg, flag, opt, passed
from linksweep.sweep.cli.run import resources as run_on
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.formatting import to_json
from linksweep.sweep.search.options import SearchOptions
from linksweep.sweep.tables.options import Declared, declared
from linksweep.sweep.tie.options import FORECAST, TIE, ForecastOptions, Options

if TYPE_CHECKING:
    import xarray as xr


EXPERIMENT = arg(default="linksweep.core.experiment:link")

year = partial(opt, type=float, metavar="YEAR")
MORE_EPOCHS = arg(nargs=-1, type=FILE, metavar="[--epochs FILE...]")


@cli.command("Your own", "Write a commented study to start from")
def new(name: str = arg(), experiment: str = EXPERIMENT) -> None:
    """Write NAME.toml, a study of EXPERIMENT to start from: it runs as it is, and has every parameter in a comment.

    \b
    sweep new mine
    sweep new mine my_experiment.py:experiment
    """
    from linksweep.sweep.code.load import load_experiment
    from linksweep.sweep.contract import shown
    from linksweep.sweep.stores.location import Folder
    from linksweep.sweep.studies.new import new_study
    from linksweep.sweep.studies.reader import GOOD_NAME

    if not GOOD_NAME.fullmatch(name):
        raise linksweep.SweepError(
            f"{shown(name)} is no name for a study: letters, digits and _ . + -, at most 60; a letter first"
        )
    path = Path(f"{name}.toml")
    text = new_study(name, experiment, load_experiment(experiment)).encode(errors="replace")
    try:
        is_made = Folder(Path()).create(path.name, text)
    except OSError as error:
        raise linksweep.SweepError(f"cannot be written: {error.strerror or error}", str(path)) from error
    if not is_made:
        raise linksweep.SweepError("exists already; take another name", str(path))
    click.echo(f"wrote {path}; edit it, then: sweep plan {path}", err=True)


@cli.command("Your own", "List the parameters of a study or experiment")
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
    from linksweep.sweep.studies import built_in_studies
    from linksweep.sweep.studies.new import study_schema

    is_study = experiment.endswith(".toml") or experiment in built_in_studies()
    declared = linksweep.load_study(experiment).experiment if is_study else load_experiment(experiment)
    if schema:
        click.echo(json.dumps(study_schema(declared), indent=1, ensure_ascii=False))
        return
    rows = [
        {name: getattr(p, name) for name in ("name", "unit", "default", "required", "meaning")}
        | {"allowed": p.allowed()}
        for p in declared.parameters
    ]
    if as_json:
        click.echo(to_json(rows))
        return
    for row in rows:
        default = f"default: {row['default']}" if row["default"] is not None else "required" if row["required"] else ""
        unit = f" [{row['unit']}]" if row["unit"] else ""
        click.echo(f"{row['name']}{unit}  {default}".rstrip())
        meaning = "" if row["meaning"] == row["name"] else f"{row['meaning']}; "
        cli.print_wrapped(f"{meaning}{row['allowed']}", "    ", "    ")


# How the command calls options whose names do not say what it does with them.
FLAGS = {"goal": "--for", "number": "--choose", "radius": "--radius"}


def _declared(entry: str, *groups: type[Declared]) -> Any:
    """Declare the options of a command as they are declared once for all; these check the values."""
    made = {}
    for one in declared(entry, *groups):
        limits, metavar, kind = one.metadata["about"], one.metadata["metavar"], one.metadata["about"]["kind"]
        more: dict[str, Any] = {"metavar": metavar, "type": str} if metavar else {"is_flag": True}
        if metavar == "FILE":
            more["type"] = FILE
        if choices := limits.get("choices"):
            more["shell_complete"] = partial(_words, choices)
        name = one.name.removesuffix("s") if "=" in metavar and kind in ("map", "files") else one.name
        several = kind in ("map", "files") or bool(one.metadata["joined"])
        flag_name = FLAGS.get(one.name, "--" + name.replace("_", "-"))
        if one.default not in (None, (), "") and metavar:
            more["default"] = [one.default] if several else one.default
        text = limits["meaning"]
        made[one.name] = opt(f"{text[:1].upper()}{text[1:]}.", flag_name, multiple=several, **more)
    return passed(**made)


def _words(words: Sequence[str], _context: Any, _parameter: Any, incomplete: str) -> list[str]:
    return [word for word in words if word.startswith(incomplete)]


@dataclass(frozen=True)
class Target:
    """Where a link or a forecast goes: to the terminal, as JSON or text, into a store, and into figures."""

    output: Path | None = cli.output("Write the labelled result.", metavar="STORE.zarr")
    figures: Path | None = opt(
        "Draw every figure that `sweep plot STORE.zarr --kind KIND` has, as KIND.png.",
        type=click.Path(path_type=Path, file_okay=False),
        metavar="FOLDER",
    )
    as_json: bool = JSON

    def check(self) -> None:
        """Raise an error unless a store can be written and figures be drawn, before anything is computed."""
        if self.output is not None and self.output.suffix != ".zarr":
            raise linksweep.SweepError("a result is written to a store whose name ends in .zarr", str(self.output))
        if self.output is not None:
            cli.require_writable(self.output)
        if self.figures is not None:
            cli.drawing_styles()

    def put(self, result: "xr.Dataset", rejected: bool = False) -> None:
        """Print a result; write it and draw its figures unless it is ``rejected``."""
        from linksweep.sweep.result import Result

        if self.output is not None and not rejected:
            Result(result).save(self.output)
        if self.figures is not None and not rejected:
            from linksweep.sweep.plots import style
            from linksweep.sweep.plots.figure import all_figures

            try:
                self.figures.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise linksweep.SweepError(
                    f"cannot draw there: {error.strerror or error}", str(self.figures)
                ) from error
            with style.settings():
                for kind, figure in all_figures(Result(result)).items():
                    style.save(figure, self.figures / f"{kind}.png")
                    click.echo(f"wrote {self.figures / f'{kind}.png'}", err=True)
        cli.print_result(result, "json" if self.as_json else "text")


@cli.command("Your own", "Solve for the link of two real tables")
def tie(
    satellite: Path = arg(type=FILE),
    reference: str = arg(),
    more_epochs: tuple[Path, ...] = MORE_EPOCHS,
    asked: dict[str, Any] = _declared(TIE, Options),
    resources: Resources = cli.group(run_on),
    no_sources: bool = flag("Write no values of single sources and rows: for millions of them."),
    target: Target = cli.group(Target),
) -> None:
    """Solve for the link of two real tables, REFERENCE - SATELLITE.

    SATELLITE has positions, parallaxes and proper motions (Gaia archive, Hipparcos-2, ICRF text, or any table with such
    columns), REFERENCE measurements of the same objects, or zero-motion for quasars.

    \b
    sweep tie gaia.fits vlbi.ecsv --unknowns orientation,spin -o tie.zarr

    With chi2 above 1000 times its expectation the exit code is 1, and nothing is written.
    """
    from linksweep.sweep.tie.link import MisfitError

    # Before millions of rows are matched.
    target.check()
    shown = target.as_json or target.output is not None or target.figures is not None
    asked = _with_more(asked, more_epochs) | {"per_source": shown and not no_sources}
    try:
        target.put(linksweep.tie(satellite, reference, resources=resources, **asked))
    except MisfitError as error:
        target.put(error.link, rejected=True)
        click.echo(f"error: {error.said('--accept-misfit')}", err=True)
        sys.exit(cli.EXIT_FAILED_POINTS)


@cli.command("Your own", "Forecast a link with new observations")
def forecast(
    satellite: Path = arg(type=FILE),
    reference: str = arg(),
    more_epochs: tuple[Path, ...] = MORE_EPOCHS,
    asked: dict[str, Any] = _declared(FORECAST, ForecastOptions, Options),
    target: Target = cli.group(Target),
) -> None:
    """Forecast the errors of a link with new observations, and choose what to observe.

    \b
    sweep forecast gaia.fits vlbi.ecsv --add 2026,2030 --choose 5 --for spin
    """
    target.check()
    target.put(linksweep.forecast(satellite, reference, **_with_more(asked, more_epochs)))


def _with_more(asked: dict[str, Any], more_epochs: tuple[Path, ...]) -> dict[str, Any]:
    """Return options with the files that follow ``--epochs``."""
    if more_epochs and not asked["epochs"]:
        raise click.UsageError(f"unexpected {more_epochs[0]}: two tables, and --epochs before other files")
    return asked | {"epochs": asked["epochs"] + more_epochs}


@cli.command("Your own", "Carry a table into the frame of a link's reference")
def apply(
    link: Path = arg(type=FILE),
    table: Path = arg(type=FILE),
    output: Path = cli.output("The table in the other frame: .csv, .ecsv, .fits or .parquet.", required=True),
    inverse: bool = flag("TABLE is in the reference's frame, and goes into the satellite's."),
    epoch: float | None = year("Epoch of a table without a column of epochs."),
) -> None:
    """Carry TABLE from the satellite's frame into that of the reference, by the LINK that `sweep tie -o` wrote.

    Positions, motions, errors and correlations change, with the covariance of the link added; other columns do not.

    \b
    sweep apply tie.zarr gaia.fits -o gaia-in-vlbi.fits
    """
    from linksweep.sweep.tie.link import apply as carry

    for note in carry(link, table, output, inverse=inverse, epoch=epoch).meta["comments"]:
        click.echo(f"note: {note}", err=True)
    click.echo(f"wrote {output}", err=True)


@cli.command("Your own", "Find the galaxies in a star catalogue")
def match(
    stars: Path = arg(type=FILE),
    galaxies: tuple[Path, ...] = arg(nargs=-1, required=True, type=FILE),
    supplement: Path | None = opt("More stars, whose matches are a class of their own.", type=FILE),
    search: dict[str, Any] = _declared("match", SearchOptions),
    output: Path = cli.output("The matches as ECSV.", default=Path("results/matches.ecsv")),
    table: Path | None = opt("Also the paper's 46-byte table.", type=FILE),
    figure: Path | None = opt("Also draw an all-sky map: .png, .svg or .pdf.", type=FILE),
    overwrite: bool = flag("Replace files that exist."),
    as_json: bool = JSON,
) -> None:
    """Find the galaxies in a star catalogue: cross-match STARS with one or more GALAXIES tables.

    Tables are FITS, VOTable, ECSV, CSV, TSV, MRT or Parquet with the column names of the Gaia archive; options refer
    to a table by its file name up to the first dot.

    \b
    sweep match tycho2.fits pgc.fits uzc.csv --supplement tycho2_suppl1.fits \\
        --radius pgc=15 --radius uzc=3 --error pgc=5 --error uzc=1 \\
        -o galaxies.ecsv --table galaxies.dat --figure galaxies.png
    """
    from linksweep.sweep.search import search as galaxy_search

    outputs = galaxy_search.Outputs(output, table, figure)
    plan = galaxy_search.plan_search(stars, galaxies, supplement, **search)
    summary = galaxy_search.summarise(galaxy_search.find_galaxies(plan, outputs, overwrite))
    if as_json:
        click.echo(to_json(summary))
    else:
        cli.print_tables(galaxy_search.summary_tables(summary), ["", *galaxy_search.summary_lines(summary)])
    for path in outputs.paths():
        click.echo(f"wrote {path}", err=True)
