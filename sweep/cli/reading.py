"""Commands that read a store: show, status and plot."""

import json
from pathlib import Path

import click

from sweep.cli.group import main
from sweep.cli.options import json_option, store_argument
from sweep.cli.output import print_table


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

    print_table(open_dataset(store), "json" if as_json else table_format)


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
