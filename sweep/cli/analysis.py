"""Commands that derive numbers from a store: fit, find and sensitivity."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from linksweep.sweep.cli.group import main
from linksweep.sweep.cli.options import FILE, json_option, option_with_default, part_of, place_option, store_argument
from linksweep.sweep.cli.output import print_sentences, print_table, print_whole, table_width
from linksweep.sweep.cli.plot import drawing_styles, save_figure

if TYPE_CHECKING:
    from linksweep.sweep.stores.location import Location

TABLES = (".csv", ".json", ".zarr")
"""Files that `sweep sensitivity` writes, beside pictures."""


@main.command()
@store_argument
@click.option("--over", help="The axis to fit along.  [default: the only one with several numbers]")
@click.option("--variable", help="What to fit.  [default: the main result]")
@option_with_default(
    "--law",
    type=click.Choice(["power", "levelling"]),
    default="power",
    help="power: variable ~ over^p; levelling: variable^2 = plateau^2 + c exp(-rate x over).",
)
@click.option("--expect", type=float, help="Exponent to test.  [default: that of a claim of the study]")
@click.option(
    "--fall",
    type=click.FloatRange(0.0, 100.0, min_open=True, max_open=True),
    metavar="PERCENT",
    help="Levelling: find where the variable falls by less than this per unit of the axis.  [default: 5]",
)
@click.option("--range", "span", metavar="LOW:HIGH", help="Only points with the axis in this range, e.g. 50: or 14:17.")
@place_option
@json_option
def fit(
    store: "Location",
    over: str | None,
    variable: str | None,
    law: str,
    expect: float | None,
    fall: float | None,
    span: str | None,
    at: tuple[str, ...],
    as_json: bool,
) -> None:
    """Fit a law to a result in STORE along an axis, for every combination of the other axes.

    Points are weighted by their Monte-Carlo errors, and by their covariance if they share random numbers.

    \b
    sweep fit results/sqrt-n.zarr --over n_obj --expect -0.5
    sweep fit results/mission-length.zarr --over mission_length --at model=gaia
    sweep fit radio-stars --range 50: --at reference_error_scale=1
    sweep fit results/quasars.zarr --over v_max --law levelling
    """
    from linksweep.sweep.analysis.conditions import parse_range
    from linksweep.sweep.analysis.laws import fit_levelling, fit_power_law
    from linksweep.sweep.analysis.quantity import main_quantity, require_axis
    from linksweep.sweep.analysis.selection import between

    if law == "levelling" and expect is not None:
        raise click.UsageError("--expect is an exponent and goes with --law power")
    if law == "power" and fall is not None:
        raise click.UsageError("--fall goes with --law levelling")
    with part_of(store, at) as part:
        variable = variable or main_quantity(part)
        over = require_axis(part, variable, over)
        dataset = part if span is None else between(part, over, *parse_range(span))
        if law == "power":
            result = fit_power_law(dataset, variable, over, expect)
        else:
            result = fit_levelling(dataset, variable, over, (fall or 5.0) / 100.0)
    _print(result, as_json)


@main.command()
@store_argument
@click.option("--where", required=True, metavar="CONDITION", help="VARIABLE, one of < <= > >=, NUMBER and unit.")
@click.option("--over", help="The axis to look along.  [default: the only one with several numbers]")
@place_option
@json_option
def find(store: "Location", where: str, over: str | None, at: tuple[str, ...], as_json: bool) -> None:
    """Find where in STORE a condition is met along an axis, for every combination of the other axes.

    Between the points of the grid the crossing is interpolated, with the error that follows from theirs.  For a table
    or a design, whose points are in no order, the points that meet the condition are listed.

    \b
    sweep find results/quasars.zarr --where "sigma_spin < 1 uas/yr" --over v_max
    sweep find grid --where "sigma_spin <= 0.5" --over n_obj --at model=amex
    """
    from linksweep.sweep.analysis.conditions import parse_limit
    from linksweep.sweep.analysis.crossings import find as find_crossings
    from linksweep.sweep.analysis.crossings import points_where
    from linksweep.sweep.analysis.quantity import require_axis, varied_parameters

    limit = parse_limit(where)
    with part_of(store, at) as dataset:
        if over is None and len(varied_parameters(dataset)) > 1:
            print_table(points_where(dataset, limit), "json" if as_json else "text")
            return
        result = find_crossings(dataset, limit, require_axis(dataset, limit.variable, over))
    _print(result, as_json)


def _print(result: Any, as_json: bool) -> None:
    from linksweep.sweep.analysis import law_tables as analysis_tables
    from linksweep.sweep.analysis.columns import left_out_in_words

    if as_json:
        click.echo(analysis_tables.as_json(result))
        return
    width = table_width()
    print_whole(analysis_tables.as_text(result, width))
    click.echo()
    print_sentences(analysis_tables.notes(result))
    if folded := analysis_tables.fitting_columns(result, width)[1]:
        print_sentences([f"left out to fit {width} columns: {left_out_in_words(folded)}; --json has them"])


@main.command()
@store_argument
@click.option("--variable", help="What varies.  [default: the main result]")
@place_option
@click.option("-o", "--output", type=FILE, help="Write .csv, .json or .zarr, or draw .png, .svg, .pdf.")
@json_option
def sensitivity(
    store: "Location", variable: str | None, at: tuple[str, ...], output: Path | None, as_json: bool
) -> None:
    """Estimate how much of the variance of a result in STORE is due to each parameter, with errors.

    First-order and total Sobol indices of full grids and of saltelli designs, effects of morris designs, first-order
    indices of any other points.

    \b
    sweep sensitivity results/sir.zarr
    sweep sensitivity results/sir.zarr --variable peak -o peak.png
    """
    from linksweep.sweep.analysis import sensitivity as analysis
    from linksweep.sweep.analysis import sensitivity_tables as tables

    with part_of(store, at) as dataset:
        if output is not None:
            _require_known(output)
        result = analysis.sensitivity(dataset, variable)
        if output is not None:
            _write(result, output)
    if as_json:
        click.echo(tables.as_json(result))
    else:
        print_whole(tables.as_text(result))
        click.echo()
        print_sentences(tables.notes(result))
    if output is not None:
        click.echo(f"wrote {output}", err=True)


def _require_known(output: Path) -> None:
    from linksweep.sweep.contract import SweepError

    suffix = output.suffix.lower()
    if suffix == ".zarr" and output.exists():
        raise SweepError("exists already; take another name", str(output))
    if suffix not in TABLES and suffix not in (formats := drawing_styles().FORMATS):
        raise SweepError(f"the name must end with {', '.join((*TABLES, *formats))}", str(output))


def _write(result: Any, output: Path) -> None:
    from linksweep.sweep.analysis import sensitivity_tables as tables
    from linksweep.sweep.contract import SweepError

    suffix = output.suffix.lower()
    try:
        if suffix == ".csv":
            output.write_text(tables.as_csv(result), encoding="utf-8")
        elif suffix == ".json":
            output.write_text(tables.as_json(result) + "\n", encoding="utf-8")
        elif suffix == ".zarr":
            result.to_zarr(output, zarr_format=3, consolidated=False)
        else:
            save_figure(result, output)
    except OSError as error:
        raise SweepError(f"cannot be written: {error.strerror or error}", str(output)) from error
