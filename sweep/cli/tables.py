"""Commands to begin a study, new and params, and about real tables: tie and forecast solve for a link, match finds the
galaxies among stars.
"""

import json
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import linksweep
from linksweep.sweep.cli import group, options
from linksweep.sweep.cli.options import FILE, JSON, POSITIVE, arg, choice, flag, many, opt, passed
from linksweep.sweep.cli.run import resources as run_on
from linksweep.sweep.formatting import split_assignment, to_json

if TYPE_CHECKING:
    import xarray as xr

    from linksweep.sweep.executing.pools import Resources

SIGNS = ["reference-satellite", "satellite-reference"]
POSITIONS = ("single-epoch", "mean")
NOT_NEGATIVE = click.FloatRange(0.0)
EXPERIMENT = arg(default="linksweep.core.experiment:link")

year = partial(opt, type=float, metavar="YEAR")
arcsec = partial(opt, type=click.FloatRange(0.0, 3600.0, min_open=True), metavar="ARCSEC")
table = partial(many, metavar="satellite|reference|NAME")


class Assigned(click.ParamType):  # type: ignore[type-arg]  # generic only in new versions of click
    """The type of an option ``KEY=VALUE``, which the help shows as ``name``; ``value`` converts the second part."""

    def __init__(self, name: str, value: Callable[[str], Any] = str) -> None:
        self.name, self.value = name, value

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the key and the converted value of a text."""
        key, text = split_assignment(value)
        with suppress(ValueError):
            if key:
                return key, self.value(text)
        return self.fail(f"{value!r} is not {self.name}", param, ctx)


@group.command("Your own", "Write a commented study to start from")
def new(name: str = arg(), experiment: str = EXPERIMENT) -> None:
    """Write NAME.toml, a study of EXPERIMENT to start from: it runs as it is, and has every parameter in a comment.

    \b
    sweep new mine
    sweep new mine my_experiment.py:experiment
    """
    from linksweep.sweep.code.load import load_experiment
    from linksweep.sweep.contract import shown
    from linksweep.sweep.stores.location import Folder
    from linksweep.sweep.studies.reader import GOOD_NAME
    from linksweep.sweep.studies.study import new_study

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


@group.command("Your own", "List the parameters of a study or experiment")
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
    from linksweep.sweep.studies.study import study_schema

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
        group.print_wrapped(f"{meaning}{row['allowed']}", "    ", "    ")


def _by_table(items: Sequence[Any], tables: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return what the items say of each quantity of each table; an item that names no table is for all."""
    by_table: dict[str, dict[str, str]] = {table: {} for table in tables}
    for key, value in items:
        table, colon, quantity = key.partition(":")
        for one in [table] if colon else tables:
            by_table.setdefault(one, {})[quantity if colon else key] = value
    return by_table


def _tables(
    missions: Sequence[Any] = many(
        "A further mission's table of the same sources, in a frame of its own.",
        "--mission",
        type=Assigned("NAME=TABLE"),
    ),
    column: Sequence[Any] = many(
        "The column with a quantity, e.g. ra=RAJ2000 or reference:parallax=plx.", type=Assigned("[TABLE:]KEY=COLUMN")
    ),
    unit: Sequence[Any] = many(
        "The unit of a quantity whose column says none, e.g. pmra=arcsec/yr.", type=Assigned("[TABLE:]KEY=UNIT")
    ),
    satellite_epoch: float | None = year("Epoch of the satellite's table, instead of a column."),
    reference_epoch: float | None = year("Epoch of the reference's rows, instead of a column."),
    mission_epoch: Sequence[Any] = many("Epoch of a mission's table.", type=Assigned("NAME=YEAR", float)),
    positions: Any = choice("Reference positions without parallax: displaced by it, or mean.", POSITIONS),
    zero_errors: Any = choice("What an error of 0 means.", ("error", "missing", "exact"), default="error"),
    without_cos_dec: Sequence[str] = table("The table whose pmra is mu_alpha, without cos(dec)."),
    extragalactic: Sequence[str] = table("The table with mean positions of quasars, which hold at any epoch."),
    where: Sequence[str] = many("Rows of the satellite, or TABLE: 'ruwe < 1.4 & ~flag'.", metavar="[TABLE:]CONDITION"),
    accelerations: Any = choice("Positions and motions of rows with accelerations.", ("at-epoch", "mean")),
    parallax_zero_point: Sequence[str] = table("The table of DR3 whose parallax zero points are subtracted."),
    jitter: Sequence[str] = many(
        "Added in quadrature to rows of a kind, or of all; or estimate: from their scatter.",
        metavar="KIND=MAS[:MAS_YR]|estimate",
    ),
) -> dict[str, Any]:
    """Return the options of the tables as `linksweep.sweep.tie.setup.Options` has them."""
    from linksweep.sweep.tables.where import conditions
    from linksweep.sweep.tie.setup import options_by_table

    further = dict(missions)
    if len(further) < len(missions):
        raise click.BadParameter("a mission is named twice", param_hint="--mission")
    names = ("satellite", "reference", *further)
    epochs = {"satellite": satellite_epoch, "reference": reference_epoch, **dict(mission_epoch)}
    return {"jitter": ",".join(jitter)} | options_by_table(
        further,
        {"zero_errors": zero_errors, "accelerations": accelerations},
        columns=_by_table(column, names),
        units=_by_table(unit, names),
        epoch=epochs,
        extragalactic=dict.fromkeys(extragalactic, True),
        parallax_zero_point=dict.fromkeys(parallax_zero_point, True),
        without_cos_dec=without_cos_dec,
        where=conditions(where, names, ("satellite",)),
        positions={"reference": positions},
    )


MATCHING = passed(
    by=opt("Match by name, COLUMN, position or position:ARCSEC.  [default: name, else position]", metavar="HOW"),
    weights=choice("Weights of the differences.", ("covariance", "variance", "equal"), default="covariance"),
    epoch=year("Epoch of the orientation.  [default: the satellite's]"),
    known_orientation=opt("Subtracted before the fit, in mas.", metavar="X,Y,Z"),
    aberration=opt("Galactic aberration of ICRF3 positions from 2015.0, e.g. 5.8.", default=0.0, metavar="UAS_YR"),
)
LINK = passed(
    unknowns=opt("Like orientation,spin,glide,parallax,vsh_motion:3.  [default: what is determined]", metavar="BLOCKS"),
    degree=opt("Vector spherical harmonics up to this degree.", type=click.IntRange(1)),
    clip=opt("none, rayleigh, median:K, discrepancy[:N] or huber:C.", default="none"),
    errors=opt("Kinds, the main one first: formal, scaled, jackknife, cells, bootstrap, sandwich.", default="scaled"),
    resamples=opt("Number of bootstrap resamples.", type=click.IntRange(2), default=1000),
    seed=opt("Seed of the bootstrap.", type=click.IntRange(0), default=0),
    sign=choice("Sign of everything that is printed and stored.", SIGNS, default=SIGNS[0]),
    accept_misfit=flag("Give the link, and write it, although chi2 is more than 1000 times its expectation."),
)
FORECAST = passed(
    unknowns=opt("Like orientation,spin.", metavar="BLOCKS"),
    error=opt("Error of each new coordinate.", default=0.1, metavar="MAS"),
    release=opt("Scale the satellite's errors to those of dr4 or dr5."),
    from_release=opt("Release of the satellite's errors.  [default: the one that has its epoch]"),
    number=opt("Choose the N best sources.", "--choose", type=click.IntRange(0), metavar="N", default=0),
    criterion=choice("Trace or determinant of the covariance.", ("A", "D"), default="A"),
    all_sources=flag("Sources without any row of the reference are candidates too."),
)
SEARCH = passed(
    radius=many("Match radius, of all or of one catalogue.  [default: 5]", metavar="[NAME=]ARCSEC"),
    error=many(
        "Position error of each coordinate, instead of columns ra_error and dec_error.", metavar="[NAME=]ARCSEC"
    ),
    column=many("The column with a quantity, e.g. ra=RAmdeg or pgc:PGC=pgc.", metavar="[NAME:]KEY=COLUMN"),
    unit=many("The unit of a quantity whose column has none, e.g. ra=hourangle.", metavar="[NAME:]KEY=UNIT"),
    where=many("Only stars, or rows of NAME, that meet this, e.g. 'vt_mag < 9'.", metavar="[NAME:]CONDITION"),
    epoch=opt("Julian year of the galaxy positions.", default=2000.0),
    ref_epoch=many("Epoch of the stars, instead of a column ref_epoch.", metavar="[NAME=]YEAR"),
    missing_pm=choice("What to do with stars that have no proper motion.", ("error", "zero"), default="error"),
    merge_radius_arcsec=arcsec(
        "Entries this close are one galaxy.  [default: the sum of their radii]", "--merge-radius"
    ),
    k_sigma=opt("Uncertain: offset above this many sigma.", type=POSITIVE, default=3.0),
    crowding_radius_arcsec=arcsec("Uncertain: so many stars within this radius.", "--crowding-radius", default=120.0),
    crowding_stars=opt("Uncertain: at least so many other stars in it.", type=click.IntRange(1), default=3),
    epoch_difference_yr=opt(
        "Years to a second epoch.", "--epoch-difference", type=POSITIVE, metavar="YR", default=20.0
    ),
    second_epoch_error_mas=opt(
        "Its position error.", "--second-epoch-error", type=NOT_NEGATIVE, metavar="MAS", default=0.0
    ),
)


@dataclass(frozen=True)
class Target:
    """Where a link or a forecast goes: to the terminal, as JSON or text, into a store, and into figures."""

    output: Path | None = options.output("Write the labelled result.", metavar="STORE.zarr")
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
            group.require_writable(self.output)
        if self.figures is not None:
            group.drawing_styles()

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
        group.print_result(result, "json" if self.as_json else "text")


@group.command("Your own", "Solve for the link of two real tables")
def tie(
    satellite: Path = arg(type=FILE),
    reference: str = arg(),
    more_epochs: tuple[Path, ...] = arg(nargs=-1, type=FILE, metavar="[--epochs FILE...]"),
    epochs: tuple[Path, ...] = many("Files of Gaia's epoch astrometry, in the place of catalogue rows.", type=FILE),
    star_model: Sequence[Any] = many(
        "The path of a star with epochs, or of all: 5, 7 or 9 parameters, or orbit.", type=Assigned("STAR=MODEL")
    ),
    orbits: Path | None = opt("A table of known orbits: periods, eccentricities, Thiele-Innes elements.", type=FILE),
    link: dict[str, Any] = LINK,
    resources: "Resources" = options.group(run_on),
    bins: str | None = opt("A spin for each bin, e.g. phot_g_mean_mag=6,8,10.", metavar="COLUMN=EDGES"),
    known_spin: Any = opt("Subtracted before the fit, in mas/yr; or a table by magnitude.", metavar="X,Y,Z|TABLE"),
    no_sources: bool = flag("Write no values of single sources and rows: for millions of them."),
    matching: dict[str, Any] = MATCHING,
    tables: dict[str, Any] = options.group(_tables),
    target: Target = options.group(Target),
) -> None:
    """Solve for the link of two real tables, REFERENCE - SATELLITE.

    SATELLITE has positions, parallaxes and proper motions (Gaia archive, Hipparcos-2, ICRF text, or any table with such
    columns), REFERENCE measurements of the same objects, or zero-motion for quasars.

    \b
    sweep tie gaia.fits vlbi.ecsv --unknowns orientation,spin -o tie.zarr

    With chi2 above 1000 times its expectation the exit code is 1, and nothing is written.
    """
    from linksweep.sweep.tie.link import MisfitError
    from linksweep.sweep.tie.setup import parse_bins

    # Before millions of rows are matched.
    target.check()
    with suppress(ValueError, AttributeError):
        # Else it is the name of a table, or None.
        known_spin = [float(part) for part in known_spin.split(",")]
    if more_epochs and not epochs:
        raise click.UsageError(f"unexpected {more_epochs[0]}: two tables, and --epochs before other files")
    shown = target.as_json or target.output is not None or target.figures is not None
    further: dict[str, Any] = {"per_source": shown and not no_sources, "bins": bins and parse_bins(bins)}
    further |= {"known_spin": known_spin, "star_models": dict(star_model), "orbits": orbits}
    try:
        further["epochs"] = epochs + more_epochs
        target.put(linksweep.tie(satellite, reference, resources=resources, **link, **further, **matching, **tables))
    except MisfitError as error:
        target.put(error.link, rejected=True)
        click.echo(f"error: {error.said('--accept-misfit')}", err=True)
        sys.exit(group.EXIT_FAILED_POINTS)


@group.command("Your own", "Forecast a link with new observations")
def forecast(
    satellite: Path = arg(type=FILE),
    reference: str = arg(),
    add: str = opt("Epochs of new positions, e.g. 2026,2030.", metavar="YEARS", default="", show_default=False),
    goal: str = opt("What to choose them for.  [default: all unknowns]", "--for", metavar="BLOCKS", default=""),
    plan: dict[str, Any] = FORECAST,
    matching: dict[str, Any] = MATCHING,
    tables: dict[str, Any] = options.group(_tables),
    target: Target = options.group(Target),
) -> None:
    """Forecast the errors of a link with new observations, and choose what to observe.

    \b
    sweep forecast gaia.fits vlbi.ecsv --add 2026,2030 --choose 5 --for spin
    """
    target.check()
    blocks = [name.strip() for name in goal.split(",") if name.strip()]
    try:
        epochs = [float(year) for year in add.split(",") if year.strip()]
    except ValueError:
        raise click.BadParameter(f"{add!r} is no list of years", param_hint="--add") from None
    target.put(linksweep.forecast(satellite, reference, add=epochs, goal=blocks, **plan, **matching, **tables))


@group.command("Your own", "Carry a table into the frame of a link's reference")
def apply(
    link: Path = arg(type=FILE),
    table: Path = arg(type=FILE),
    output: Path = options.output("The table in the other frame: .csv, .ecsv, .fits or .parquet.", required=True),
    inverse: bool = flag("TABLE is in the reference's frame, and goes into the satellite's."),
    epoch: float | None = year("Epoch of a table without a column of epochs."),
) -> None:
    """Carry TABLE from the satellite's frame into that of the reference, by the LINK that `sweep tie -o` wrote.

    Positions, motions, errors and correlations change, with the covariance of the link added; other columns do not.

    \b
    sweep apply tie.zarr gaia.fits -o gaia-in-vlbi.fits
    """
    from linksweep.sweep.tie.apply import apply as carry

    for note in carry(link, table, output, inverse=inverse, epoch=epoch).meta["comments"]:
        click.echo(f"note: {note}", err=True)
    click.echo(f"wrote {output}", err=True)


@group.command("Your own", "Find the galaxies in a star catalogue")
def match(
    stars: Path = arg(type=FILE),
    galaxies: tuple[Path, ...] = arg(nargs=-1, required=True, type=FILE),
    supplement: Path | None = opt("More stars, whose matches are a class of their own.", type=FILE),
    search: dict[str, Any] = SEARCH,
    output: Path = options.output("The matches as ECSV.", default=Path("results/matches.ecsv")),
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
    from linksweep.sweep.search.outputs import Outputs, find_galaxies, summarise, summary_lines, summary_tables
    from linksweep.sweep.search.search import plan_search

    outputs = Outputs(output, table, figure)
    summary = summarise(find_galaxies(plan_search(stars, galaxies, supplement, **search), outputs, overwrite))
    if as_json:
        click.echo(to_json(summary))
    else:
        group.print_tables(summary_tables(summary), ["", *summary_lines(summary)])
    for path in outputs.paths():
        click.echo(f"wrote {path}", err=True)
