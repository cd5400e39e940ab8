"""Readable units, symbols of unknowns, and names beside points that do not cover one another."""

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from linksweep.core.arrays import Array
from linksweep.sweep.formatting import written
from linksweep.sweep.plots.labels import symbol

MICRO_BELOW = 0.5
"""Numbers in mas that are all smaller than this are shown in micro-arcseconds."""

SHORT = {"glide": "g", "position_glide": "G"}
_VECTOR = re.compile(r"(epsilon|omega|glide|position_glide)_([xyz])")
_HARMONIC = re.compile(r"vsh_(?:position|motion)_([ts])_(\d+)_(\d+)(?:_(re|im))?")

LETTER_WIDTH = 0.62
"""The average width of a letter, as a fraction of its height."""

SIDES = ((1, 0, "left", "center"), (-1, 0, "right", "center"), (0, 1, "center", "bottom"), (0, -1, "center", "top"))
"""Sides of a point for its name, as steps to the right and up, with the alignment there; the best first."""


def readable(values: Array, unit: str) -> tuple[float, str]:
    """Return a factor and a unit, mas or µas (per year) as people write it, in which numbers in mas have few zeros."""
    known = np.abs(values[np.isfinite(values)])
    if known.size and 0.0 < known.max() < MICRO_BELOW:
        return 1000.0, written(unit.replace("mas", "µas"))
    return 1.0, written(unit)


def unknown_symbol(label: str) -> str:
    """Return the symbol of an unknown: of a vector's component, of a harmonic with its degree and order, or a name."""
    if found := _VECTOR.match(label):
        block, axis = found.groups()
        return rf"${SHORT.get(block, chr(92) + block)}_{axis}$" + label[found.end() :]
    if found := _HARMONIC.fullmatch(label):
        kind, degree, order, part = found.groups()
        above = rf"^\mathrm{{{part.capitalize()}}}" if part else ""
        return rf"${kind}_{{{degree},{order}}}{above}$"
    return r"$\varpi_0$" if label == "parallax_zero_point" else symbol(label)


def unknown_symbols(dataset: xr.Dataset) -> list[str]:
    """Return the symbol of each unknown of a solution."""
    return [unknown_symbol(str(name)) for name in dataset["unknown"].values]


def places_by(dataset: xr.Dataset, key: str) -> dict[str, list[int]]:
    """Return the places of the unknowns of each "unit" or "block"."""
    keys = dataset[key].values
    return {str(one): np.flatnonzero(keys == one).tolist() for one in dict.fromkeys(keys.tolist())}


def vectors(dataset: xr.Dataset) -> dict[str, list[int]]:
    """Return the places of the unknowns of each block that is a vector."""
    return {name: places for name, places in places_by(dataset, "block").items() if len(places) == 3}


def kept_sources(dataset: xr.Dataset) -> NDArray[np.bool_]:
    """Return which sources the solution uses."""
    return np.asarray((dataset["weight_factor"].values > 0.0) & (dataset["n_observations"].values > 0.0))


def name_points(axes: Axes, x: Array, y: Array, names: Iterable[str], size: float = 6.5) -> None:
    """Write names beside points, the first ones first; one that would cover another, or leave the axes, is left out.

    To be called when everything else is drawn and has its place (`Figure.draw_without_rendering`).
    """
    figure = axes.get_figure(root=True)
    assert figure is not None, "axes of a figure"
    inside, dots = axes.get_window_extent(), figure.dpi / 72.0
    taken: list[Bbox] = []
    if (legend := axes.get_legend()) is not None:
        taken.append(legend.get_window_extent())
    height, gap = 1.3 * size * dots, 4.0 * dots
    halo = [withStroke(linewidth=2.0, foreground="white")]
    style: dict[str, Any] = {"textcoords": "offset points", "fontsize": size, "zorder": 6, "path_effects": halo}
    for px, py, name in zip(x, y, names, strict=True):
        at = axes.transData.transform((px, py))
        width = LETTER_WIDTH * size * dots * len(name)
        for right, up, ha, va in SIDES:
            x0 = at[0] + (gap if right > 0 else -gap - width if right < 0 else -0.5 * width)
            y0 = at[1] + (gap if up > 0 else -gap - height if up < 0 else -0.5 * height)
            box = Bbox.from_bounds(x0, y0, width, height)
            fits = inside.x0 <= box.x0 and box.x1 <= inside.x1 and inside.y0 <= box.y0 and box.y1 <= inside.y1
            if fits and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                axes.annotate(name, (px, py), xytext=(4.0 * right, 4.0 * up), ha=ha, va=va, **style)
                break
