"""Commands that derive numbers from a store: fit and find."""

from typing import TYPE_CHECKING, Any

import click

from sweep.cli.group import main
from sweep.cli.options import json_option, naming, part_of, place_option, store_argument
from sweep.cli.output import print_sentences, print_table, print_whole, table_width

if TYPE_CHECKING:
    from sweep.stores.location import Location


@main.command()
@store_argument
@click.option("--over", help="The axis to fit along.  [default: the only one with several numbers]")
@click.option("--variable", help="What to fit.  [default: the main result]")
@click.option(
    "--law",
    type=click.Choice(["power", "levelling"]),
    default="power",
    show_default=True,
    help="power: variable ~ over^p; levelling: variable^2 = plateau^2 + c exp(-rate x over).",
)
@click.option("--expect", type=float, help="Exponent to test.  [default: that of a claim of the study]")
@click.option(
    "--fall",
    type=click.FloatRange(0.0, 100.0, min_open=True, max_open=True),
    metavar="PERCENT",
    help="Levelling: find where the variable falls by less than this a unit of the axis.  [default: 5]",
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
    from sweep.analysis.conditions import parse_range
    from sweep.analysis.laws import fit_levelling, fit_power_law
    from sweep.analysis.quantity import main_quantity, require_axis
    from sweep.analysis.selection import between

    if law == "levelling" and expect is not None:
        raise click.UsageError("--expect is an exponent and goes with --law power")
    if law == "power" and fall is not None:
        raise click.UsageError("--fall goes with --law levelling")
    dataset = part_of(store, at)
    with naming(store):
        variable = variable or main_quantity(dataset)
        over = require_axis(dataset, variable, over)
        if span is not None:
            dataset = between(dataset, over, *parse_range(span))
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
    from sweep.analysis.conditions import parse_limit
    from sweep.analysis.crossings import find as find_crossings
    from sweep.analysis.crossings import points_where
    from sweep.analysis.quantity import require_axis, varied_parameters

    limit = parse_limit(where)
    dataset = part_of(store, at)
    with naming(store):
        if over is None and len(varied_parameters(dataset)) > 1:
            print_table(points_where(dataset, limit), "json" if as_json else "text")
            return
        result = find_crossings(dataset, limit, require_axis(dataset, limit.variable, over))
    _print(result, as_json)


def _print(result: Any, as_json: bool) -> None:
    from sweep.analysis import law_tables as analysis_tables
    from sweep.analysis.columns import left_out_in_words

    if as_json:
        click.echo(analysis_tables.as_json(result))
        return
    width = table_width()
    print_whole(analysis_tables.as_text(result, width))
    click.echo()
    print_sentences(analysis_tables.notes(result))
    if folded := analysis_tables.fitting_columns(result, width)[1]:
        print_sentences([f"left out to fit {width} columns: {left_out_in_words(folded)}; --json has them"])
