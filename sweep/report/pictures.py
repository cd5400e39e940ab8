"""What a page shows of results: pictures as SVG whose text stays text and whose colours follow the page's
theme, and the numbers of the interactive view.
"""

import io
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal
from matplotlib.text import Text

from linksweep.sweep.analysis import quantity
from linksweep.sweep.analysis.answer import ERRORS_ALLOWED
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import is_truth, meaning_beside, prefixed, units_of, written
from linksweep.sweep.plots import KINDS, style
from linksweep.sweep.plots.figure import all_figures, caption, description, draw_figure
from linksweep.sweep.plots.points import sampled
from linksweep.sweep.result import Result
from linksweep.sweep.studies.study import POINT

# Pictures are made for paper.  Those of one panel, at most so many inches wide, are scaled with letters of the same
# size, to be read on a phone; others are scrolled sideways there.
ONE_PANEL, SHRINK = 6.4, 0.8
MOST_MARKS = 2000  # more points than this are drawn as one image: in SVG each of them takes some 100 bytes

# The name of the figure of single estimates, which is also its caption.
SAMPLES = "kept samples of two components; the ellipses hold 68 and 95 % of a normal distribution"
SUFFIX = "from_prediction"

DIGITS = 7  # of a number in the interactive view: more than any Monte-Carlo result needs
MOST_NUMBERS = 200_000  # in a page for all its interactive views together, some 2 MB


class Picture(NamedTuple):
    """A figure as SVG of a width in points, or a sentence that says why there is none."""

    name: str
    svg: str = ""
    width: float = 0.0
    problem: str = ""
    caption: str = ""
    description: str = ""


# Pictures


def pictures(dataset: xr.Dataset, variables: Sequence[str], number: int) -> list[Picture]:
    """Return the figures of variables that vary, each of the kind that suits it, and of their differences from a
    prediction; those of variables with errors of several kinds are of each component.

    That of the kept samples of a single point comes first.  Of a single point without samples those are drawn that have
    a prediction or a published number.  ``number`` makes the identifiers in them differ from those of other datasets.
    """
    dataset, status = dataset.assign_attrs(title=""), dataset["status"]
    alone, ordered = status.size == 1, POINT not in status.dims
    found = [drawn(dataset, SAMPLES, f"{number}-samples")] if alone and sampled(dataset) is not None else []
    varying = [name for name in variables if _varies(dataset[name])]
    if alone and not found and not varying:
        varying = [name for name in variables if {"predicted", "published"} & _parts(dataset, name).keys()]
    for i, name in enumerate(varying):
        if errors := quantity.errors_beside(dataset, name):
            part = quantity.where_they_change(dataset, [name, *errors])
            components = quantity.own_dimensions(dataset, name)
            for k, place in enumerate(quantity.places_along(part, components)):
                one = part.isel(place)
                if _varies(one[name]):
                    words = ", ".join(str(one[d].item()) for d in components if d in one.coords)
                    found.append(drawn(one, f"{name} ({words})", f"{number}-{i}-{k}", (name,)))
        else:
            found.append(drawn(dataset, name, f"{number}-{i}", (name,)))
        residual = differences(dataset, name) if ordered and _varies(dataset[name]) else None
        if residual is not None:
            words = f"{name} minus its prediction, in units of its one-sigma errors; the band is three of them"
            found.append(drawn(residual, words, f"{number}-{i}-residual", (f"{name}_{SUFFIX}",), "lines", _add_band))
    return found


def link_pictures(result: Result, number: int) -> list[Picture]:
    """Return all figures that a link or a forecast can have; ``number`` as for `pictures`."""
    found = []
    with _inside_a_page(str(number)):
        for i, (kind, figure) in enumerate(all_figures(result, titled=False).items()):
            mpl.rcParams["svg.hashsalt"] = f"linksweep-{number}-{i}"
            name = KINDS[result.kind][kind].caption
            found.append(Picture(name, _svg(figure), 72.0 * figure.get_figwidth()))
    return found


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
            if figure.get_figwidth() <= ONE_PANEL:
                figure.set_size_inches(*(SHRINK * figure.get_size_inches()))
            words = f"{name}. {caption(figure, dataset)}".strip()
            return Picture(name, _svg(figure), 72.0 * figure.get_figwidth(), "", words, description(figure, dataset))
        except (SweepError, ValueError) as error:  # a ValueError: a name that matplotlib takes for a formula
            return Picture(name, problem=" ".join(str(error).split()))


def differences(dataset: xr.Dataset, variable: str) -> xr.Dataset | None:
    """Return a variable minus its prediction, in units of its one-sigma errors, as a dataset to draw; None where the
    variable has no errors or no prediction.
    """
    parts, error = _parts(dataset, variable), quantity.standard_error(dataset, variable)
    if error is None or "predicted" not in parts:
        return None
    apart = ((dataset[variable] - parts["predicted"]) / error.where(error > 0.0)).transpose(*dataset[variable].dims)
    attributes = {"symbol": "(simulated − predicted)/error", "long_name": f"{variable}, minus predicted"}
    apart = apart.drop_attrs(deep=False).assign_attrs(attributes)
    kept = dataset[["status"]].assign_attrs(title=dataset.attrs.get("title", ""))
    return kept.assign({f"{variable}_{SUFFIX}": apart})


def _add_band(figure: Figure) -> None:
    """Mark zero, and the band in which a difference may be due to chance."""
    for axes in figure.axes:
        axes.axhline(0.0, color="black", linewidth=0.6)
        axes.axhspan(-ERRORS_ALLOWED, ERRORS_ALLOWED, color=style.COLOURS[6], **style.BAND)


def _varies(array: xr.DataArray) -> bool:
    finite = array.values[np.isfinite(array.values)]
    return bool(finite.size and finite.min() < finite.max())


def _is_known(array: xr.DataArray | None) -> bool:
    """Return whether there are numbers: without errors of observation a prediction is 0."""
    return array is not None and bool(np.nan_to_num(array.values).any())


@contextmanager
def _inside_a_page(salt: str) -> Iterator[None]:
    with style.settings(), warnings.catch_warnings():
        mpl.rcParams.update({"svg.hashsalt": f"linksweep-{salt}", "svg.fonttype": "none"})
        warnings.filterwarnings("ignore", message="Glyph")  # text stays text: the reader's fonts show it
        yield


def _svg(figure: Figure) -> str:
    """Return the ``svg`` element of a figure; nothing in it affects the rest of the page."""
    for artist in figure.findobj():
        points = artist.get_xdata() if isinstance(artist, Line2D) else ()
        places = artist.get_offsets() if isinstance(artist, PathCollection) else ()
        if np.size(points) > MOST_MARKS or np.size(places) > 2 * MOST_MARKS:
            artist.set_rasterized(True)
        # the sign of a square root fits its bar in matplotlib's fonts only; a text with any effect is saved as paths
        if isinstance(artist, Text) and r"\sqrt" in artist.get_text():
            artist.set_path_effects([*artist.get_path_effects(), Normal()])
    out = io.StringIO()
    figure.savefig(out, format="svg", dpi=200, transparent=True, metadata={"Date": None, "Creator": None})
    svg = out.getvalue()
    svg = svg[svg.index("<svg") :]
    # a style element would apply to the whole page
    svg = re.sub(r"<metadata>.*?</metadata>|<style[^>]*>.*?</style>", "", svg, flags=re.DOTALL)
    used = set(re.findall(r"#([\w.-]+)", svg))
    svg = re.sub(r' id="([^"]*)"', lambda name: name[0] if name[1] in used else "", svg)
    head, rest = svg.split(">", 1)
    head = re.sub(r' (?:width|height)="[^"]*"', "", head)
    return re.sub(r'style="[^"]*"', lambda style: re.sub(r"#[0-9a-f]{6}\b", _themed, style[0]), f"{head}>{rest}")


def _themed(colour: re.Match[str]) -> str:
    """Return a colour for both themes: greys are inverted on dark, others become lighter."""
    red, green, blue = (int(colour[0][i : i + 2], 16) for i in (1, 3, 5))
    dark = f"#{255 - red:02x}{255 - green:02x}{255 - blue:02x}"
    if not red == green == blue:
        dark = f"color-mix(in oklab, {colour[0]} 75%, white)"
    return f"light-dark({colour[0]}, {dark})"


# The interactive view


def explorer(dataset: xr.Dataset, first: Sequence[str], room: int) -> tuple[dict[str, Any], int, list[str]]:
    """Return the contents of a grid in at most ``room`` numbers, how many these are, and the quantities left out.

    ``first`` are the quantities that come first; each has flat lists in C order of its own dimensions, None where a
    value is missing.
    """
    dataset = style.with_scales(dataset)
    views: list[dict[str, Any]] = []
    left_out, used = [], 0
    for name in dict.fromkeys([*first, *quantity.quantities(dataset)]):
        if not np.isfinite(dataset[name].values).any():
            continue
        parts = _parts(dataset, name)
        size = sum(part.size for part in parts.values())
        if used + size > room:
            left_out.append(name)
            continue
        used += size
        views.append(_quantity(dataset, name, parts))
    dims = list(dict.fromkeys(d for view in views for d in view["dims"]))
    return {"quantities": views, "axes": list(_axes(dataset, dims))}, used, left_out


def _parts(dataset: xr.Dataset, name: str) -> dict[str, xr.DataArray]:
    """Return a quantity and what belongs to it and is known, all with its own dimensions."""
    value = dataset[name]
    others = {"error": quantity.error_bar(dataset, name)}
    others["predicted"] = dataset.get(quantity.prediction_name(dataset, name))
    others |= {suffix: dataset.get(f"{name}_{suffix}") for suffix in ("published", "published_rounding")}
    known = {n: part for n, part in others.items() if part is not None and set(part.dims) <= set(value.dims)}
    parts = {n: part.broadcast_like(value).transpose(*value.dims) for n, part in known.items() if _is_known(part)}
    return {"value": value, **parts}


def _quantity(dataset: xr.Dataset, name: str, parts: dict[str, xr.DataArray]) -> dict[str, Any]:
    array = dataset[name]
    unit, factors, components = units_of(array.attrs), xr.DataArray(1.0), {}
    with_units = [str(d) for d in array.dims if f"{d}_unit" in dataset.coords]  # a unit for each component
    if "," in unit and len(with_units) == 1:
        (dim,) = with_units
        units = map(str, dataset[f"{dim}_unit"].values.tolist())
        chosen = [prefixed(array.isel({dim: i}).values, unit) for i, unit in enumerate(units)]
        factors = xr.DataArray([one.factor for one in chosen], dims=dim)
        unit, components = "", {"unit_dim": dim, "units": [written(one.unit) for one in chosen]}
    elif "," in unit:  # of each element of a matrix
        unit = ", ".join(dict.fromkeys(part.strip(" ()") for part in unit.split(",")))
    return {
        "name": name,
        "unit": written(unit),
        **components,
        "meaning": meaning_beside(name, array.attrs),
        "dims": list(map(str, array.dims)),
        "scale": str(array.attrs.get(style.SCALE, "")),
        "truth": is_truth(array),
        **{suffix: _numbers((part * factors).transpose(*part.dims)) for suffix, part in parts.items()},
    }


def _axes(dataset: xr.Dataset, dims: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the coordinates along dimensions, and the dimensions without one; those along points without order come
    last, and only if they are numeric.
    """
    names = [str(n) for n, c in dataset.coords.items() if c.ndim == 1 and not str(n).endswith("_unit")]
    along = [n for d in dims for n in dict.fromkeys([d, *(m for m in names if dataset[m].dims == (d,))])]
    for name in sorted(along, key=lambda n: (dataset[n].dims == (POINT,), n == POINT)):
        array = dataset[name]  # a dimension without a coordinate gives 0, 1, 2, ...
        numeric, ordered = array.dtype.kind in "iuf", array.dims[0] != POINT
        if numeric or ordered or name == POINT:
            yield {
                "name": name,
                "dim": str(array.dims[0]),
                "unit": written(units_of(array.attrs)),
                "numeric": numeric,
                "ordered": ordered,
                "logarithmic": numeric and style.is_logarithmic(array),
                "values": _numbers(array) if numeric else list(map(str, array.values.tolist())),
            }


def _numbers(array: xr.DataArray) -> list[float | int | None]:
    """Return the numbers of an array in C order with `DIGITS` digits, None for those that are not finite."""
    shorts = (float(f"{value:.{DIGITS}g}") for value in array.values.reshape(-1).tolist())
    return [int(n) if n.is_integer() and abs(n) < 1e15 else n if np.isfinite(n) else None for n in shorts]
