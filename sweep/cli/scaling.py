"""The command that measures how a study scales with workers: scaling."""

from pathlib import Path
from typing import Any

import click

from sweep.cli.group import main
from sweep.cli.options import FILE, json_option, trust_option
from sweep.cli.plot import drawing_styles
from sweep.cli.signals import a_signal_ends_the_command, end_stopped
from sweep.executing.pools import DEFAULT_POOL, POOLS
from sweep.formatting import to_json


def _counts(_context: click.Context, _parameter: click.Parameter, value: str) -> tuple[int, ...]:
    words = value.split(",")
    if not all(word.strip().isdecimal() and len(word) < 6 for word in words):
        raise click.BadParameter(f"{value!r} is no list of numbers of workers; write 1,2,4")
    return tuple(map(int, words))


@main.command()
@click.argument("study")
@click.option("--workers", default="1,2", show_default=True, callback=_counts, help="Numbers of workers, from 1 up.")
@click.option(
    "--pool",
    type=click.Choice([name for name, pool in POOLS.items() if pool.has_workers]),
    default=DEFAULT_POOL,
    show_default=True,
    help="Workers are processes, or threads of this one.",
)
@click.option(
    "--repetitions",
    type=click.IntRange(1, 1000),
    default=3,
    show_default=True,
    help="Of every run; 5 or more give errors.",
)
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="Override a value of the study.")
@click.option("--axis", "axes", multiple=True, metavar="NAME=SPEC", help="Override or add an axis.")
@click.option(
    "-o",
    "--output",
    type=FILE,
    help="The measurements, as Zarr.  [default: results/NAME-scaling.zarr]",
)
@click.option("--figure", type=FILE, help="Also draw them with the ideal lines: .png, .svg, .pdf.")
@trust_option
@json_option
def scaling(
    study: str,
    workers: tuple[int, ...],
    pool: Any,
    repetitions: int,
    settings: tuple[str, ...],
    axes: tuple[str, ...],
    output: Path | None,
    figure: Path | None,
    trust: bool,
    as_json: bool,
) -> None:
    """Measure how STUDY scales with local workers: the same work on more of them (strong), and as much for each (weak).

    The results of the runs are thrown away; the time to start workers is measured apart.

    \b
    sweep scaling quasars --workers 1,2 --figure scaling.svg
    """
    if figure is not None:
        drawing_styles().require_format(figure)
    from sweep.interrupt import RunInterruptedError
    from sweep.running.scaling import check_free, measure_scaling, write_scaling
    from sweep.running.trust import require_trust_of_study
    from sweep.stores.named import default_store
    from sweep.studies.reader import load_study
    from sweep.studies.source import find_study

    require_trust_of_study(find_study(study), trust)
    loaded = load_study(study, settings, axes)
    path = output or default_store(f"{loaded.name}-scaling")
    check_free(path)
    with a_signal_ends_the_command():
        try:
            dataset = measure_scaling(loaded, workers, pool, repetitions, lambda text: click.echo(text, err=True))
        except RunInterruptedError as stop:
            end_stopped(stop.signal)
    _print(dataset, as_json)
    write_scaling(dataset, path)
    if figure is not None:
        from sweep.plots import style
        from sweep.plots.figure import draw_figure

        with style.settings():
            style.save(draw_figure(dataset), figure)
    click.echo(f"wrote {path}" + (f" and {figure}" if figure is not None else ""), err=True)


def _print(dataset: Any, as_json: bool) -> None:
    frame = dataset[["seconds", "start_seconds", "speedup", "efficiency"]].to_dataframe().reset_index()
    if as_json:
        click.echo(to_json(frame.to_dict(orient="records")))
    else:
        click.echo(frame.to_string(index=False, float_format=lambda value: f"{value:.3g}"))
