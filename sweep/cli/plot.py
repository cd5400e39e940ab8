"""The command that draws: plot."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from linksweep.sweep.cli.group import main
from linksweep.sweep.cli.options import FILE, gathered, link_in, part_of, place_option
from linksweep.sweep.plots import ALL_KINDS, KINDS

NARROWEST_MM, WIDEST_MM = 40.0, 1000.0


def _millimetres(_context: click.Context, _parameter: click.Parameter, value: str | None) -> float | None:
    if value is None:
        return None
    try:
        width = float(value.strip().removesuffix("mm"))
    except ValueError:
        width = 0.0
    if not NARROWEST_MM <= width <= WIDEST_MM:
        raise click.BadParameter(f"{value!r}: must be from {NARROWEST_MM:g}mm to {WIDEST_MM:g}mm, like 88mm or 180mm")
    return width


def drawing_styles() -> Any:
    """Return `sweep.plots.style`; raises click.UsageError where matplotlib, which it needs, is not installed."""
    try:
        from linksweep.sweep.plots import style
    except ImportError as error:
        raise click.UsageError(f"drawing needs matplotlib: pip install 'linksweep[plot]' ({error})") from error
    return style


def save_figure(dataset: Any, path: Path) -> None:
    """Draw a dataset into a file, in the way that suits it."""
    from linksweep.sweep.plots import style
    from linksweep.sweep.plots.figure import draw_figure

    with style.settings():
        style.save(draw_figure(dataset), path)


@dataclass(frozen=True)
class Drawing:
    """What is drawn, as the command line names it."""

    source: str | None
    kind: str | None
    variables: tuple[str, ...]
    over: tuple[str, ...]
    log: tuple[str, ...]
    linear: tuple[str, ...]
    models: tuple[str, ...]
    at: tuple[str, ...]

    def require_choices(self) -> None:
        """Raise click.UsageError for options that do not go with the kind."""
        if self.source is None and self.kind != "accuracy":
            raise click.UsageError("name the store to draw; only --kind accuracy is drawn without one")
        if self.models and self.kind != "accuracy":
            raise click.UsageError("--model goes with --kind accuracy; choose a part of a store with --at model=NAME")
        if self.kind in KINDS["catalogue"] and self.chosen != ((),) * 4:
            raise click.UsageError(
                f"--variable and --over do not go with --kind {self.kind}, nor do --log and --linear"
            )

    @property
    def chosen(self) -> tuple[tuple[str, ...], ...]:
        """Quantities, axes and scales."""
        return self.variables, self.over, self.log, self.linear

    def figure(self) -> tuple[Any, Any]:
        """Return a figure, and the dataset that it shows."""
        from linksweep.sweep.plots.figure import draw_figure
        from linksweep.sweep.stores.named import store_named

        if self.kind == "accuracy":
            from linksweep.sweep.plots.sky import accuracy_curves, accuracy_figure, models_of

            models: Any = self.models
            if self.source is not None:
                from linksweep.sweep.running.reproduce import study_to_look_at
                from linksweep.sweep.studies.reader import load_study

                is_file = self.source.endswith(".toml")
                study = load_study(self.source) if is_file else study_to_look_at(store_named(self.source))
                models = models_of(study, models)
            curves = accuracy_curves(models)
            return accuracy_figure(curves), curves
        assert self.source is not None, "asked for before"
        if self.kind == "sky":
            from linksweep.sweep.plots.sky import catalogue_of_point, catalogue_of_table, sky_figure

            if Path(self.source).is_file():
                sky = catalogue_of_table(Path(self.source))
            else:
                sky = catalogue_of_point(store_named(self.source), self.at)
            return sky_figure(sky), sky
        store = store_named(self.source)
        if (link := link_in(store, self.at)) is not None:
            return draw_figure(link, self.kind, *self.chosen), link
        with part_of(store, self.at) as dataset:
            return draw_figure(dataset, self.kind, *self.chosen), dataset


@main.command()
@click.argument("source", required=False)
@click.option(
    "--kind",
    type=click.Choice(ALL_KINDS),
    metavar="KIND",
    help=f"What to draw: {', '.join(ALL_KINDS)}.  [default: what suits the results]",
)
@click.option(
    "--variable", "variables", multiple=True, help="The quantity; several become panels.  [default: the main result]"
)
@click.option(
    "--over", multiple=True, help="The axis to draw along; give both for a map, or two components of a scatter."
)
@click.option("--log", metavar="NAME", multiple=True, help="Give this axis or quantity a logarithmic axis.")
@click.option(
    "--linear",
    metavar="NAME",
    multiple=True,
    help="Give it a linear one.  [default: what the spacing of values suggests]",
)
@click.option("--model", "models", multiple=True, help="Accuracy: only this mission; may be given several times.")
@place_option
@click.option(
    "--width",
    metavar="MM",
    callback=_millimetres,
    help="How wide it will be printed, 88mm or 180mm; letters have the same size at any.  [default: each kind's own]",
)
@click.option("--style", type=click.Choice(["paper", "talk"]), help="Sizes of letters and lines.  [default: paper]")
@click.option("--caption", is_flag=True, help="Write NAME.txt beside the picture: caption and alternative text.")
@click.option("-o", "--output", type=FILE, help="Picture to write: .png, .svg or .pdf.  [default: NAME.png]")
@gathered("drawn", Drawing)
def plot(drawn: Drawing, width: float | None, style: str | None, caption: bool, output: Path | None) -> None:
    """Draw the results in SOURCE, a store, in the way that suits them: curves with errors, prediction and published
    values, small panels, a map, a fitted law, a scatter of kept samples.  For a link or a forecast of real tables there
    are the kinds from solution on in the list below.

    \b
    sweep plot quasars --width 88mm --caption -o quasars.pdf
    sweep plot results/grid.zarr --over n_obj --at error_scale=1
    sweep plot grid --kind map --over n_obj --over v_max --at model=gaia
    sweep plot results/quasars.zarr --kind sky --at model=gaia,v_max=16
    sweep plot --kind accuracy --model amex --model gaia
    sweep plot mission.toml --kind accuracy
    sweep plot tie.zarr --kind residuals -o residuals.png
    """
    styles = drawing_styles()
    drawn.require_choices()
    path = output or Path(Path(drawn.source or "accuracy").stem + ".png")
    styles.require_format(path)
    with styles.settings(width, style):
        figure, dataset = drawn.figure()
        styles.save(figure, path)
    click.echo(f"wrote {path}", err=True)
    if caption:
        from linksweep.sweep.plots.caption import caption_and_description

        beside = path.with_suffix(".txt")
        styles.save_text(caption_and_description(figure, dataset), beside)
        click.echo(f"wrote {beside}", err=True)
