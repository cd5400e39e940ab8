"""Pictures of results as SVG inside a page: text stays text, colours follow the page's theme."""

import io
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal
from matplotlib.text import Text

from linksweep.sweep.analysis.long_table import own_dimensions
from linksweep.sweep.analysis.quantity import errors_beside, prediction_name, standard_error, where_they_change
from linksweep.sweep.analysis.selection import places_along
from linksweep.sweep.analysis.sentences import ERRORS_ALLOWED
from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots import KINDS
from linksweep.sweep.plots.caption import caption, description
from linksweep.sweep.plots.figure import draw_figure, link_figures
from linksweep.sweep.plots.points import sampled
from linksweep.sweep.plots.style import BAND, COLOURS, settings
from linksweep.sweep.studies.study import POINT

POINTS_PER_INCH = 72.0

SUFFIX = "from_prediction"

ONE_PANEL, SHRINK = 6.4, 0.8
"""Pictures are made for paper.  Those of one panel, at most ONE_PANEL inches wide, are scaled by SHRINK with letters of
the same size, to be read on a phone; others are scrolled sideways there.
"""

MOST_MARKS = 2000
"""More points than this are drawn as one image: in SVG each of them takes some 100 bytes."""

SAMPLES = "kept samples of two components; the ellipses hold 68 and 95 % of a normal distribution"
"""The name of the figure of single estimates, which is also its caption."""

_COLOUR = re.compile(r"#[0-9a-f]{6}\b")
_STYLE = re.compile(r'style="[^"]*"')


@dataclass(frozen=True)
class Picture:
    """A figure as SVG of a width in points, or a sentence that says why there is none."""

    name: str
    svg: str = ""
    width: float = 0.0
    problem: str = ""
    caption: str = ""
    description: str = ""


def pictures(dataset: xr.Dataset, variables: Sequence[str], number: int) -> list[Picture]:
    """Return the figures of variables that vary, each of the kind that suits it; those of variables with errors of
    several kinds are of each component.  That of the kept samples of a single point comes first.  Of a single point
    without samples those are drawn that have a prediction or a published number.  ``number`` makes the identifiers in
    them differ from those of other datasets.
    """
    untitled = dataset.assign_attrs(title="")
    wanted: list[tuple[str, tuple[str, ...]]] = [(name, (name,)) for name in variables if _varies(dataset[name])]
    if dataset["status"].size == 1:
        if sampled(dataset) is not None:
            wanted = [(SAMPLES, ()), *wanted]
        else:
            wanted = wanted or [(name, (name,)) for name in variables if _has_another(dataset, name)]
    found = []
    for i, (name, chosen) in enumerate(wanted):
        errors = errors_beside(dataset, chosen[0]) if chosen else []
        part = where_they_change(untitled, [*chosen, *errors]) if errors else untitled
        own = own_dimensions(dataset, chosen[0]) if errors else []
        for k, place in enumerate(places_along(part, own)):
            one = part.isel(place)
            label = ", ".join(str(one[d].item()) for d in own if d in one.coords)
            if not own or _varies(one[chosen[0]]):
                words = f"{name} ({label})" if own else name
                found.append(drawn(one, words, f"{number}-{i}-{k}" if own else f"{number}-{i}", chosen))
        ordered = POINT not in dataset["status"].dims
        if ordered and chosen and _varies(dataset[name]) and (residual := differences(untitled, name)) is not None:
            words = f"{name} minus its prediction, in units of its one-sigma errors; the band is three of them"
            found.append(drawn(residual, words, f"{number}-{i}-residual", (f"{name}_{SUFFIX}",), "lines", _add_band))
    return found


def differences(dataset: xr.Dataset, variable: str) -> xr.Dataset | None:
    """Return a variable minus its prediction, in units of its one-sigma errors, as a dataset to draw; None where the
    variable has no errors or no prediction.
    """
    error, name = standard_error(dataset, variable), prediction_name(dataset, variable)
    if error is None or name not in dataset or not np.nan_to_num(dataset[name].values).any():
        return None
    found = ((dataset[variable] - dataset[name]) / error.where(error > 0.0)).transpose(*dataset[variable].dims)
    attributes = {"symbol": "(simulated − predicted)/error", "long_name": f"{variable}, minus predicted"}
    kept = dataset[["status"]].assign_attrs(title=dataset.attrs.get("title", ""))
    return kept.assign({f"{variable}_{SUFFIX}": found.drop_attrs(deep=False).assign_attrs(attributes)})


def _add_band(figure: Figure) -> None:
    """Mark zero, and the band in which a difference may be due to chance."""
    for axes in figure.axes:
        axes.axhline(0.0, color="black", linewidth=0.6)
        axes.axhspan(-ERRORS_ALLOWED, ERRORS_ALLOWED, color=COLOURS[6], **BAND)


def link_pictures(dataset: xr.Dataset, number: int) -> list[Picture]:
    """Return all figures that a link or a forecast can have; ``number`` as for `pictures`."""
    found = []
    with _inside_a_page(str(number)):
        captions = KINDS[dataset.attrs["result"]]
        for i, (kind, figure) in enumerate(link_figures(dataset, titled=False).items()):
            mpl.rcParams["svg.hashsalt"] = f"linksweep-{number}-{i}"
            found.append(Picture(captions[kind].caption, _svg(figure), POINTS_PER_INCH * figure.get_figwidth()))
    return found


@contextmanager
def _inside_a_page(salt: str) -> Iterator[None]:
    with settings(), warnings.catch_warnings():
        mpl.rcParams.update({"svg.hashsalt": f"linksweep-{salt}", "svg.fonttype": "none"})
        warnings.filterwarnings("ignore", message="Glyph")  # text stays text: the reader's fonts show it
        yield


def _varies(array: xr.DataArray) -> bool:
    finite = array.values[np.isfinite(array.values)]
    return bool(finite.size and finite.min() < finite.max())


def _has_another(dataset: xr.Dataset, variable: str) -> bool:
    """Return whether a prediction or a published number is known beside a variable."""
    others = (dataset.get(prediction_name(dataset, variable)), dataset.get(f"{variable}_published"))
    return any(bool(np.nan_to_num(other.values).any()) for other in others if other is not None)


def drawn(
    dataset: xr.Dataset,
    name: str,
    salt: str,
    variables: Sequence[str] = (),
    kind: str | None = None,
    add: Callable[[Figure], None] | None = None,
) -> Picture:
    """Return the figure that suits a dataset, or one of a given kind, after ``add`` was called with it; ``salt`` makes
    the identifiers in it differ from those of other figures.
    """
    with _inside_a_page(salt):
        try:
            figure = draw_figure(dataset, kind, variables)
            if add is not None:
                add(figure)
            width, height = figure.get_size_inches().tolist()
            if width <= ONE_PANEL:
                figure.set_size_inches(SHRINK * width, SHRINK * height)
            svg, words = _svg(figure), (caption(figure, dataset), description(figure, dataset))
            wide = POINTS_PER_INCH * figure.get_figwidth()
            return Picture(name, svg, wide, caption=f"{name}. {words[0]}".strip(), description=words[1])
        except (SweepError, ValueError) as error:  # a ValueError: a name that matplotlib takes for a formula
            return Picture(name, problem=" ".join(str(error).split()))


def _svg(figure: Figure) -> str:
    """Return the ``svg`` element of a figure; nothing in it affects the rest of the page."""
    for artist in figure.findobj(_is_cloud):
        artist.set_rasterized(True)
    for artist in figure.findobj(_has_root):
        artist.set_path_effects([*artist.get_path_effects(), Normal()])  # a text with any effect is saved as paths
    out = io.StringIO()
    figure.savefig(out, format="svg", dpi=200, transparent=True, metadata={"Date": None, "Creator": None})
    whole = out.getvalue()
    svg = whole[whole.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<style[^>]*>.*?</style>", "", svg, flags=re.DOTALL)  # it would apply to the whole page
    used = set(re.findall(r"#([\w.-]+)", svg))
    svg = re.sub(r' id="([^"]*)"', lambda name: name[0] if name[1] in used else "", svg)
    svg = re.sub(r'<svg ([^>]*?)width="[^"]*"', r"<svg \1", svg, count=1)
    svg = re.sub(r'<svg ([^>]*?)height="[^"]*"', r"<svg \1", svg, count=1)
    return _STYLE.sub(lambda style: _COLOUR.sub(_themed, style[0]), svg)


def _has_root(artist: Artist) -> bool:
    """Return whether a text has a square root: its sign fits its bar in matplotlib's own fonts only."""
    return isinstance(artist, Text) and r"\sqrt" in artist.get_text()


def _is_cloud(artist: Artist) -> bool:
    if isinstance(artist, Line2D):
        return np.size(artist.get_xdata()) > MOST_MARKS
    return isinstance(artist, PathCollection) and np.size(artist.get_offsets()) > 2 * MOST_MARKS


def _themed(colour: re.Match[str]) -> str:
    """Return a colour for both themes: greys are inverted on dark, others become lighter."""
    red, green, blue = (int(colour[0][i : i + 2], 16) for i in (1, 3, 5))
    if red == green == blue:
        inverse = 255 - red
        return f"light-dark({colour[0]}, #{inverse:02x}{inverse:02x}{inverse:02x})"
    return f"light-dark({colour[0]}, color-mix(in oklab, {colour[0]} 75%, white))"
