"""The command of the galaxy search."""

from pathlib import Path
from typing import Any

import click

from linksweep.sweep.cli.group import main
from linksweep.sweep.cli.options import FILE, json_option, option_with_default
from linksweep.sweep.cli.output import print_whole
from linksweep.sweep.formatting import to_json


@main.command()
@click.argument("stars", type=FILE)
@click.argument("galaxies", nargs=-1, required=True, type=FILE)
@click.option("--supplement", type=FILE, help="More stars, whose matches are a class of their own.")
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
@click.option(
    "--unit",
    multiple=True,
    metavar="[NAME:]KEY=UNIT",
    help="The unit of a quantity whose column has none in the file, e.g. ra=hourangle or pgc:ra=deg.",
)
@option_with_default("--epoch", type=float, default=2000.0, help="Julian year of the galaxy positions.")
@click.option(
    "--ref-epoch", multiple=True, metavar="[NAME=]YEAR", help="Epoch of the stars, instead of a column ref_epoch."
)
@option_with_default(
    "--missing-pm",
    type=click.Choice(["error", "zero"]),
    default="error",
    help="What to do with stars that have no proper motion.",
)
@click.option(
    "--merge-radius",
    "merge_radius_arcsec",
    type=click.FloatRange(0.0, 3600.0, min_open=True),
    metavar="ARCSEC",
    help="Entries of two catalogues this close are one galaxy.  [default: the sum of their match radii]",
)
@option_with_default(
    "--k-sigma", type=click.FloatRange(0.0, min_open=True), default=3.0, help="Uncertain: offset above this many sigma."
)
@option_with_default(
    "--crowding-radius",
    "crowding_radius_arcsec",
    type=click.FloatRange(0.0, 3600.0, min_open=True),
    metavar="ARCSEC",
    default=120.0,
    help="Uncertain: so many stars within this radius.",
)
@option_with_default(
    "--crowding-stars",
    type=click.IntRange(1),
    default=3,
    help="Uncertain: at least this many other stars within the crowding radius.",
)
@option_with_default(
    "--epoch-difference",
    "epoch_difference_yr",
    type=click.FloatRange(0.0, min_open=True),
    metavar="YR",
    default=20.0,
    help="Years to a second epoch, for the proper-motion error.",
)
@option_with_default(
    "--second-epoch-error",
    "second_epoch_error_mas",
    type=click.FloatRange(0.0),
    metavar="MAS",
    default=0.0,
    help="Position error of the second epoch.",
)
@option_with_default("-o", "--output", type=FILE, default=Path("results/matches.ecsv"), help="The matches as ECSV.")
@click.option("--table", type=FILE, help="Also the paper's 46-byte table.")
@click.option("--figure", type=FILE, help="Also draw an all-sky map: .png, .svg or .pdf.")
@click.option("--overwrite", is_flag=True, help="Replace files that exist.")
@json_option
def match(
    stars: Path,
    galaxies: tuple[Path, ...],
    supplement: Path | None,
    output: Path,
    table: Path | None,
    figure: Path | None,
    overwrite: bool,
    as_json: bool,
    **search_options: Any,
) -> None:
    """Find the galaxies in a star catalogue: cross-match STARS with one or more GALAXIES tables.

    Tables are FITS, VOTable, ECSV, CSV, TSV, MRT or Parquet with the column names of the Gaia archive; options refer
    to a table by its file name up to the first dot.

    \b
    sweep match tycho2.fits pgc.fits uzc.csv --supplement tycho2_suppl1.fits \\
        --radius pgc=15 --radius uzc=3 --error pgc=5 --error uzc=1 \\
        -o galaxies.ecsv --table galaxies.dat --figure galaxies.png
    """
    from linksweep.sweep.search.outputs import Outputs, find_galaxies, summarise, summary_text
    from linksweep.sweep.search.search import plan_search

    search = plan_search(stars, galaxies, supplement, **search_options)
    outputs = Outputs(output, table, figure)
    summary = summarise(find_galaxies(search, outputs, overwrite))
    if as_json:
        click.echo(to_json(summary))
    else:
        for part in summary_text(summary):
            print_whole(part)
    for path in outputs.paths():
        click.echo(f"wrote {path}", err=True)
