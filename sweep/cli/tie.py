"""The commands of the link of real tables: tie and forecast."""

import sys
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from linksweep.sweep.cli.group import EXIT_FAILED_POINTS, main
from linksweep.sweep.cli.options import FILE, json_option, option_with_default
from linksweep.sweep.cli.resource_options import resource_options
from linksweep.sweep.cli.tie_options import numbers, table_options

if TYPE_CHECKING:
    import xarray as xr

output_option = click.option("-o", "--output", type=FILE, metavar="STORE.zarr", help="Write the labelled result.")
figures_option = click.option(
    "--figures",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Draw every figure that `sweep plot STORE.zarr --kind KIND` has, as KIND.png.",
)


@main.command()
@click.argument("satellite", type=FILE)
@click.argument("reference")
@click.option(
    "--unknowns",
    metavar="BLOCKS",
    help="Like orientation,spin,glide,parallax,vsh_motion:3.  [default: what the tables determine of orientation,spin]",
)
@click.option("--degree", type=click.IntRange(1), help="Vector spherical harmonics up to this degree.")
@click.option("--bins", metavar="COLUMN=EDGES", help="A spin for each bin, e.g. phot_g_mean_mag=6,8,10.")
@click.option(
    "--known-spin",
    metavar="X,Y,Z|TABLE",
    help="Subtracted before the fit: mas/yr with the sign of --sign, or a table by magnitude.",
)
@option_with_default("--clip", default="none", help="none, rayleigh, median:K, discrepancy[:N] or huber:C.")
@option_with_default(
    "--errors",
    default="scaled",
    help="Kinds of errors, the main one first: formal, scaled, jackknife, cells, bootstrap, sandwich.",
)
@option_with_default("--resamples", type=click.IntRange(2), default=1000, help="Number of bootstrap resamples.")
@option_with_default("--seed", type=click.IntRange(0), default=0, help="Seed of the bootstrap.")
@option_with_default(
    "--sign",
    type=click.Choice(["reference-satellite", "satellite-reference"]),
    default="reference-satellite",
    help="Sign of everything that is printed and stored.",
)
@resource_options
@click.option(
    "--no-sources",
    is_flag=True,
    help="Leave what belongs to single sources and rows out of STORE.zarr and of JSON: for millions of them.",
)
@click.option(
    "--accept-misfit",
    is_flag=True,
    help="Give the link, and write it, although chi2 is more than 1000 times its expectation.",
)
@table_options
@output_option
@figures_option
@json_option
def tie(
    satellite: Path,
    reference: str,
    bins: str | None,
    known_spin: str | None,
    no_sources: bool,
    tables: dict[str, Any],
    output: Path | None,
    figures: Path | None,
    as_json: bool,
    **given: Any,
) -> None:
    """Solve for the link of two real tables, REFERENCE - SATELLITE.

    SATELLITE has positions, parallaxes and proper motions (Gaia archive, Hipparcos-2, ICRF text, or any table with such
    columns), REFERENCE measurements of the same objects, or zero-motion for quasars.

    \b
    sweep tie gaia.fits vlbi.ecsv --unknowns orientation,spin -o tie.zarr

    With chi2 above 1000 times its expectation the exit code is 1, and nothing is written.
    """
    from linksweep.sweep.tie.link import MisfitError
    from linksweep.sweep.tie.link import tie as solve
    from linksweep.sweep.tie.options import parse_bins

    _check_targets(output, figures)
    try:
        result = solve(
            satellite,
            reference,
            per_source=not no_sources and (as_json or output is not None or figures is not None),
            bins=None if bins is None else parse_bins(bins),
            known_spin=None if known_spin is None else _spin(known_spin),
            **given,
            **tables,
        )
    except MisfitError as error:
        _put(error.link, None, None, as_json)
        click.echo(f"error: {error.said('--accept-misfit')}", err=True)
        sys.exit(EXIT_FAILED_POINTS)
    _put(result, output, figures, as_json)


@main.command()
@click.argument("satellite", type=FILE)
@click.argument("reference")
@click.option("--unknowns", metavar="BLOCKS", help="Like orientation,spin.")
@click.option("--add", metavar="YEARS", default="", help="Epochs of new positions, e.g. 2026,2030.")
@option_with_default("--error", type=float, default=0.1, metavar="MAS", help="Error of each new coordinate.")
@click.option("--release", help="Scale the satellite's errors to those of dr4 or dr5.")
@click.option("--from-release", help="Release of the satellite's errors.  [default: the one that has its epoch]")
@click.option("--choose", "number", type=click.IntRange(0), default=0, metavar="N", help="Choose the N best sources.")
@click.option("--for", "goal", default="", metavar="BLOCKS", help="What to choose them for.  [default: all unknowns]")
@option_with_default(
    "--criterion", type=click.Choice(["A", "D"]), default="A", help="Trace or determinant of the covariance."
)
@click.option("--all-sources", is_flag=True, help="Sources without any row of the reference are candidates too.")
@table_options
@output_option
@figures_option
@json_option
def forecast(
    satellite: Path,
    reference: str,
    add: str,
    goal: str,
    tables: dict[str, Any],
    output: Path | None,
    figures: Path | None,
    as_json: bool,
    **given: Any,
) -> None:
    """Forecast the errors of a link with new observations, and choose what to observe.

    \b
    sweep forecast gaia.fits vlbi.ecsv --add 2026,2030 --choose 5 --for spin
    """
    from linksweep.sweep.tie.forecast import forecast as plan

    _check_targets(output, figures)
    result = plan(
        satellite,
        reference,
        add=numbers("--add", add),
        goal=[name.strip() for name in goal.split(",") if name.strip()],
        **given,
        **tables,
    )
    _put(result, output, figures, as_json)


def _spin(text: str) -> list[float] | str:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return text


def _check_targets(output: Path | None, figures: Path | None) -> None:
    """Raise an error unless a store can be written and figures be drawn, before anything is computed."""
    from linksweep.sweep.contract import SweepError

    if output is not None and output.suffix != ".zarr":
        raise SweepError("a result is written to a store whose name ends in .zarr", str(output))
    if output is not None and output.exists():
        raise SweepError("is there already; nothing is overwritten", str(output))
    if figures is not None and find_spec("matplotlib") is None:
        raise click.UsageError("drawing needs matplotlib: pip install 'linksweep[plot]'")


def _put(result: "xr.Dataset", output: Path | None, figures: Path | None, as_json: bool) -> None:
    from linksweep.sweep.tie.text import as_format

    text = as_format(result, "json" if as_json else "text")
    if output is not None:
        with warnings.catch_warnings():  # text has no final specification in Zarr 3
            warnings.simplefilter("ignore")
            result.to_zarr(output, mode="w-")
    if figures is not None:
        _draw(result, figures)
    click.echo(text)


def _draw(result: "xr.Dataset", folder: Path) -> None:
    from linksweep.sweep.contract import SweepError
    from linksweep.sweep.plots import style
    from linksweep.sweep.plots.figure import link_figures

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SweepError(f"cannot draw there: {error.strerror or error}", str(folder)) from error
    with style.settings():
        for kind, figure in link_figures(result).items():
            style.save(figure, folder / f"{kind}.png")
            click.echo(f"wrote {folder / f'{kind}.png'}", err=True)
