"""The all-sky map of a galaxy search."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from linksweep.core.frames import DEGREE, Array, galactic
from linksweep.sweep.plots.sky import GALACTIC, on_map, prepare_sky

STYLES = {"certain": ("o", "#0072B2"), "uncertain": ("^", "#D55E00"), "supplement": ("s", "#009E73")}
"""Marker and colour of each class, from the colour-blind safe palette of Okabe & Ito (2008)."""

BACKGROUND = "#b0b0b0"
MAX_BACKGROUND = 30_000
"""More background points would fill the map: of a larger number a random share is drawn, and the legend gives it."""


def sky_map(classes: Mapping[str, tuple[Array, Array]], background: tuple[Array, Array]) -> Figure:
    """Return a Mollweide map in Galactic coordinates, longitude growing to the left, the Galactic centre in the middle.

    ``classes`` maps each name in `STYLES` to the (ra, dec) of its objects in degrees, ``background`` is (ra, dec) of
    all entries of the galaxy catalogues.  The figure belongs to no window; save it with its ``savefig``.
    """
    figure = Figure(figsize=(8.0, 4.9))
    axes: Any = figure.add_subplot(projection="mollweide")
    prepare_sky(axes, GALACTIC)
    axes.set_position((0.1, 0.14, 0.88, 0.86))  # left, bottom, width, height
    _plot_background(axes, background)
    axes.plot([-np.pi, np.pi], [0.0, 0.0], color="black", linewidth=1.0, zorder=2, label="Galactic plane, $b = 0$")
    for name, (marker, colour) in STYLES.items():
        ra, dec = classes.get(name, (np.empty(0), np.empty(0)))
        style = {"linestyle": "none", "marker": marker, "markersize": 5.0, "markerfacecolor": colour}
        style |= {"markeredgecolor": "white", "markeredgewidth": 0.5, "zorder": 4}
        # an object at the edge of the map is shown whole
        axes.plot(*_on_map(ra, dec), **style, clip_on=False, label=f"{name} ({_count(len(ra))})")
    figure.legend(loc="lower center", ncols=3, fontsize=8, frameon=False, markerscale=1.3)
    return figure


def _plot_background(axes: Any, background: tuple[Array, Array]) -> None:
    step = -(-len(background[0]) // MAX_BACKGROUND)
    if not step:
        return
    share = f", 1 in {step} drawn" if step > 1 else ""
    # rows of a catalogue are often sorted by position, so a random choice instead of every step-th row
    chosen = np.random.default_rng(0).permutation(len(background[0]))[: len(background[0]) // step]
    style = {"linestyle": "none", "marker": ".", "markeredgewidth": 0.0, "color": BACKGROUND}
    places = _on_map(*(coordinate[chosen] for coordinate in background))
    axes.plot(*places, **style, markersize=1.2, rasterized=True, zorder=1)
    # a point of the map is too small to be seen in the legend
    label = f"galaxy catalogues ({_count(len(background[0]))}{share})"
    axes.plot([], [], **style, markersize=4.0, label=label)


def _on_map(ra: Array, dec: Array) -> tuple[Array, Array]:
    longitude, latitude = galactic(ra * DEGREE, dec * DEGREE)
    return on_map(longitude / DEGREE, GALACTIC), latitude


def _count(number: int) -> str:
    return f"{number:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
