"""The command that says which parameters matter: sensitivity."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sweep.cli.group import main
from sweep.cli.options import FILE, json_option, naming, part_of, place_option, store_argument
from sweep.cli.output import print_sentences, print_whole
from sweep.cli.plot import drawing_styles

if TYPE_CHECKING:
    from sweep.stores.location import Location

TABLES = (".csv", ".json", ".zarr")


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
    from sweep.analysis import sensitivity as analysis
    from sweep.analysis import sensitivity_tables as tables

    dataset = part_of(store, at)
    with naming(store):
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
    from sweep.contract import SweepError

    if output.suffix.lower() in TABLES:
        if output.suffix.lower() == ".zarr" and output.exists():
            raise SweepError("exists already; take another name", str(output))
        return
    formats = drawing_styles().FORMATS
    if output.suffix.lower() not in formats:
        raise SweepError(f"the name must end with {', '.join((*TABLES, *formats))}", str(output))


def _write(result: Any, output: Path) -> None:
    from sweep.analysis import sensitivity_tables as tables
    from sweep.contract import SweepError

    suffix = output.suffix.lower()
    try:
        if suffix == ".csv":
            output.write_text(tables.as_csv(result), encoding="utf-8")
        elif suffix == ".json":
            output.write_text(tables.as_json(result) + "\n", encoding="utf-8")
        elif suffix == ".zarr":
            result.to_zarr(output, zarr_format=3, consolidated=False)
        else:
            from sweep.plots import style
            from sweep.plots.sensitivity import sensitivity_figure

            with style.settings():
                style.save(sensitivity_figure(result), output)
    except OSError as error:
        raise SweepError(f"cannot be written: {error.strerror or error}", str(output)) from error
