"""The command that draws: plot."""

from pathlib import Path
from typing import Any

import click

from sweep.cli.group import main
from sweep.cli.options import naming, part_of, place_option
from sweep.plots.kinds import STANDALONE, all_kinds


@main.command()
@click.argument("source", required=False)
@click.option("--kind", type=click.Choice(all_kinds()), help="What to draw.  [default: what suits the results]")
@click.option(
    "--variable", "variables", multiple=True, help="The quantity; several become panels.  [default: the main result]"
)
@click.option(
    "--over", multiple=True, help="The axis to draw along; give both for a map, or two components of a scatter."
)
@click.option("--model", "models", multiple=True, help="Accuracy: only this mission; may be given several times.")
@place_option
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), help="Picture to write: .png, .svg or .pdf.  [default: NAME.png]"
)
def plot(
    source: str | None,
    kind: str | None,
    variables: tuple[str, ...],
    over: tuple[str, ...],
    models: tuple[str, ...],
    at: tuple[str, ...],
    out: Path | None,
) -> None:
    """Draw the results in SOURCE, a store, in the way that suits them: curves with errors, prediction and published
    values, small panels, a map, a fitted law, a scatter of kept samples; of a link or a forecast of real tables, the
    kinds from solution on.

    \b
    sweep plot results/quasars.zarr --out quasars.svg
    sweep plot results/grid.zarr --over n_obj --at error_scale=1
    sweep plot results/grid.zarr --kind map --over n_obj --over v_max --at model=gaia
    sweep plot results/quasars.zarr --kind sky --at model=gaia,v_max=16
    sweep plot --kind accuracy --model amex --model gaia
    sweep plot mission.toml --kind accuracy
    sweep plot tie.zarr --kind residuals -o residuals.png
    """
    try:
        from sweep.plots import style
    except ImportError as error:
        raise click.UsageError(f"drawing needs matplotlib: pip install 'linksweep[plot]' ({error})") from error

    if source is None and kind != "accuracy":
        raise click.UsageError("name the store to draw; only --kind accuracy is drawn without one")
    if models and kind != "accuracy":
        raise click.UsageError("--model goes with --kind accuracy; choose a part of a store with --at model=...")
    if kind in STANDALONE and (variables or over):
        raise click.UsageError(f"--variable and --over do not go with --kind {kind}")
    path = out or Path(Path(source or "accuracy").stem + ".png")
    style.require_format(path)
    with style.settings():
        style.save(_figure(source, kind, variables, over, models, at), path)
    click.echo(f"wrote {path}", err=True)


def _figure(
    source: str | None,
    kind: str | None,
    variables: tuple[str, ...],
    over: tuple[str, ...],
    models: tuple[str, ...],
    at: tuple[str, ...],
) -> Any:
    from sweep.plots.figure import draw_figure
    from sweep.plots.standalone import accuracy_figure, sky_figure
    from sweep.stores.named import store_named
    from sweep.tie.stored import result_at

    if kind == "accuracy":
        from sweep.plots.views import accuracy_curves, models_of

        return accuracy_figure(accuracy_curves(models if source is None else models_of(_study(source), models)))
    assert source is not None, "asked for before"
    if kind == "sky":
        from sweep.plots.views import catalogue_of_point, catalogue_of_table

        if Path(source).is_file():
            return sky_figure(catalogue_of_table(Path(source)))
        return sky_figure(catalogue_of_point(store_named(source), at))
    store = store_named(source)
    if (result := result_at(store)) is not None:
        if at:
            raise click.UsageError("--at chooses a part of a grid; this is one link or forecast")
        return draw_figure(result, kind, variables, over)
    dataset = part_of(store, at)
    with naming(store):
        return draw_figure(dataset, kind, variables, over)


def _study(source: str) -> Any:
    """Return the study of a store, or in a file."""
    from sweep.running.reproduce import study_to_look_at
    from sweep.stores.named import store_named
    from sweep.studies.reader import load_study

    return load_study(source) if source.endswith(".toml") else study_to_look_at(store_named(source))
