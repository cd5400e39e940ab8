"""The all-sky map of a galaxy search; matplotlib only, arrays in and a figure out."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from core.arrays import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure


STYLES = {
    "certain": ("o", "#0072B2"),
    "uncertain": ("^", "#D55E00"),
    "supplement": ("s", "#009E73"),
}
"""Marker and colour of each class, from the colour-blind safe palette of Okabe & Ito (2008)."""

BACKGROUND = "#b0b0b0"
MINUS = "\N{MINUS SIGN}"
MAX_BACKGROUND = 30_000
"""More background points than this fill the map; beyond it an even share of them is drawn, and the legend says so."""


def sky_map(classes: Mapping[str, tuple[Array, Array]], background: tuple[Array, Array]) -> "Figure":
    """Return a Mollweide map in Galactic coordinates, longitude growing to the left, the Galactic centre in the middle.

    ``classes`` maps each name in `STYLES` to the (l, b) of its objects in degrees, ``background`` is (l, b) of
    all entries of the galaxy catalogues.  The figure belongs to no window; save it with its ``savefig``.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.9))
    place = (0.1, 0.14, 0.88, 0.86)  # left, bottom, width, height
    axes: Any = figure.add_axes(place, projection="mollweide")  # a GeoAxes, which matplotlib does not declare
    _plot_background(axes, background)
    axes.plot([-np.pi, np.pi], [0.0, 0.0], color="black", linewidth=1.0, zorder=2, label="Galactic plane, $b = 0$")
    for name, (marker, colour) in STYLES.items():
        longitude, latitude = classes.get(name, (np.empty(0), np.empty(0)))
        axes.plot(
            *_on_map(longitude, latitude),
            linestyle="none",
            marker=marker,
            markersize=5.0,
            markerfacecolor=colour,
            markeredgecolor="white",
            markeredgewidth=0.5,
            clip_on=False,  # an object at the edge of the map is shown whole
            zorder=4,
            label=f"{name} ({_count(len(longitude))})",
        )
    _draw_grid(axes)
    figure.legend(loc="lower center", ncols=3, fontsize=8, frameon=False, markerscale=1.3)
    return figure


def _plot_background(axes: Any, background: tuple[Array, Array]) -> None:
    step = -(-len(background[0]) // MAX_BACKGROUND)
    if not step:
        return
    share = f", 1 in {step} drawn" if step > 1 else ""
    # rows of a catalogue often run along the sky, so a random choice and not every step-th
    chosen = np.random.default_rng(0).permutation(len(background[0]))[: len(background[0]) // step]
    axes.plot(
        *_on_map(background[0][chosen], background[1][chosen]),
        linestyle="none",
        marker=".",
        markersize=1.2,
        markeredgewidth=0.0,
        color=BACKGROUND,
        rasterized=True,
        zorder=1,
    )
    # a point of the map is too small to be seen in the legend
    axes.plot(
        [],
        [],
        linestyle="none",
        marker=".",
        markersize=4.0,
        markeredgewidth=0.0,
        color=BACKGROUND,
        label=f"galaxy catalogues ({_count(len(background[0]))}{share})",
    )


def _draw_grid(axes: Any) -> None:
    from matplotlib.patheffects import withStroke

    axes.grid(color="0.75", linewidth=0.4, zorder=0)
    axes.set_axisbelow(True)
    halo = [withStroke(linewidth=2.5, foreground="white")]
    axes.set_longitude_grid_ends(90.0)
    ticks = np.arange(-120.0, 121.0, 60.0)
    axes.set_xticks(np.deg2rad(ticks), [f"{-t % 360:.0f}°" for t in ticks], fontsize=8, path_effects=halo)
    latitudes = np.arange(-60.0, 61.0, 30.0)
    axes.set_yticks(
        np.deg2rad(latitudes), [f"{b:+.0f}°".replace("-", MINUS) if b else "0°" for b in latitudes], fontsize=8
    )
    for label in axes.get_xticklabels():
        label.set_zorder(5)
    axes.set_xlabel("Galactic longitude $l$", fontsize=9)
    axes.set_ylabel("Galactic latitude $b$", fontsize=9)


def _on_map(longitude: Array, latitude: Array) -> tuple[Array, Array]:
    """Return map coordinates in radians: longitude to the left, -180..180 about the Galactic centre."""
    return -np.deg2rad((longitude + 180.0) % 360.0 - 180.0), np.deg2rad(latitude)


def _count(number: int) -> str:
    return f"{number:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
