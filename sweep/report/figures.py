"""Pictures of results as SVG inside a page: text stays text, colours follow the page's theme."""

import io
import re
from dataclasses import dataclass

import matplotlib as mpl
import xarray as xr
from matplotlib.figure import Figure

from sweep.contract import SweepError
from sweep.plots import numeric_axes, plot_lines

POINTS_PER_INCH = 72.0

SHRINK = 0.8
"""Pictures are made for paper: so much smaller, with the same letters, they can be read on a phone."""

_COLOUR = re.compile(r"#[0-9a-f]{6}\b")
_STYLE = re.compile(r'style="[^"]*"')


@dataclass(frozen=True)
class Picture:
    """A figure as SVG of a width in points, or a sentence that says why there is none."""

    name: str
    svg: str = ""
    width: float = 0.0
    problem: str = ""


def picture(dataset: xr.Dataset, variable: str, number: int) -> Picture:
    """Return the figure of a variable that suits it; ``number`` sets its identifiers apart from those of others."""
    settings = {"svg.hashsalt": f"linksweep-{number}", "svg.fonttype": "none", "font.size": 9.0}
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(settings)
        try:
            figure = _figure(dataset, variable)
            figure.set_size_inches(SHRINK * figure.get_size_inches())
            return Picture(variable, _svg(figure, number), POINTS_PER_INCH * figure.get_figwidth())
        except (SweepError, ValueError) as error:  # a ValueError: a name that matplotlib takes for a formula
            return Picture(variable, problem=" ".join(str(error).split()))


def _figure(dataset: xr.Dataset, variable: str) -> Figure:
    axes = numeric_axes(dataset, variable)
    if not axes:
        raise SweepError(f"{variable} has no axis of several numbers to draw along")
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    plot_lines(figure.add_subplot(), dataset, variable, axes[0])
    return figure


def _svg(figure: Figure, number: int) -> str:
    """Return the ``svg`` element of a figure: nothing in it reaches out of it."""
    out = io.StringIO()
    figure.savefig(out, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    whole = out.getvalue()
    svg = whole[whole.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<style[^>]*>.*?</style>", "", svg, flags=re.DOTALL)  # it would apply to the whole page
    svg = re.sub(r' id="(figure|axes|patch|text|line2d|matplotlib\.axis|xtick|ytick|legend)_\d+"', "", svg)
    svg = re.sub(r'<svg ([^>]*?)width="[^"]*"', r"<svg \1", svg, count=1)
    svg = re.sub(r'<svg ([^>]*?)height="[^"]*"', r"<svg \1", svg, count=1)
    return _STYLE.sub(lambda style: _COLOUR.sub(_themed, style[0]), svg)


def _themed(colour: re.Match[str]) -> str:
    """Return a colour for both themes: greys change places, from black to white, others become lighter on dark."""
    red, green, blue = (int(colour[0][i : i + 2], 16) for i in (1, 3, 5))
    if red == green == blue:
        inverse = 255 - red
        return f"light-dark({colour[0]}, #{inverse:02x}{inverse:02x}{inverse:02x})"
    return f"light-dark({colour[0]}, color-mix(in oklab, {colour[0]} 75%, white))"
