"""All-sky maps in the Mollweide projection, with longitude increasing to the left, and the Galactic plane."""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from linksweep.core.arrays import Array
from linksweep.core.constants import DEGREE, GALACTIC_AXES
from linksweep.core.frames import position
from linksweep.sweep.plots.labels import label
from linksweep.sweep.plots.style import COLOURS

MINUS = "\N{MINUS SIGN}"


class SkyFrame(NamedTuple):
    """What a map shows: the names of longitude and latitude, and the longitude (deg) in the middle."""

    longitude: str
    latitude: str
    centre_deg: float


ICRS = SkyFrame(r"right ascension $\alpha$ (ICRS)", r"declination $\delta$", 180.0)
"""On this map the Galactic plane is a single arch."""
GALACTIC = SkyFrame("Galactic longitude $l$", "Galactic latitude $b$", 0.0)


def add_sky(figure: Figure, place: Any = 111, frame: SkyFrame = ICRS) -> Any:
    """Return new axes for an all-sky map, with a grid labelled in degrees; ``place`` as for add_subplot."""
    axes: Any = figure.add_subplot(place, projection="mollweide")
    axes.grid(color="0.8", linewidth=0.4)
    axes.set_axisbelow(True)
    axes.set_longitude_grid_ends(90.0)
    halo = [withStroke(linewidth=2.0, foreground="white")]
    ticks = np.arange(-120.0, 121.0, 60.0)
    axes.set_xticks(ticks * DEGREE, [""] * len(ticks))
    for tick in ticks:  # text of its own, because labels of an axis lie below all that is drawn
        text = f"{(frame.centre_deg - tick) % 360:.0f}°"
        style = {"fontsize": "x-small", "ha": "center", "va": "center", "zorder": 6, "path_effects": halo}
        axes.text(tick * DEGREE, 0.04, text, **style)
    latitudes = np.arange(-60.0, 61.0, 30.0)
    names = [f"{b:+.0f}°".replace("-", MINUS) if b else "0°" for b in latitudes]
    axes.set_yticks(latitudes * DEGREE, names, fontsize="x-small")
    axes.set_xlabel(frame.longitude)
    axes.set_ylabel(frame.latitude)
    return axes


def draw_sky(axes: Any, dataset: xr.Dataset) -> Any:
    """Draw positions ``ra`` and ``dec`` (deg) on axes of `add_sky`, coloured by ``v_mag`` if there is one, and the
    Galactic plane with its centre.
    """
    ra, dec = (dataset[name].values.astype(float) for name in ("ra", "dec"))
    x, y = on_map(ra), dec * DEGREE
    size = float(np.clip(4000.0 / max(len(ra), 1), 1.5, 18.0))
    style: dict[str, Any] = {"s": size, "linewidths": 0.0, "zorder": 3, "rasterized": len(ra) > 2000}
    if "v_mag" not in dataset:
        axes.scatter(x, y, color=COLOURS[0], **style)
    else:
        values = dataset["v_mag"].values.astype(float)
        order = np.argsort(-values, kind="stable")  # bright objects, of small magnitude, on top and dark
        points = axes.scatter(x[order], y[order], c=values[order], cmap="viridis", **style)
        text = label(dataset["v_mag"], "v_mag")
        axes.figure.colorbar(points, ax=axes, orientation="horizontal", shrink=0.5, pad=0.02, aspect=30, label=text)
    _plane(axes)
    axes.legend(loc="lower right", bbox_to_anchor=(1.06, -0.06), frameon=False)
    return axes


def _plane(axes: Any) -> None:
    """Draw the Galactic plane in pieces that do not jump from one edge of the map to the other."""
    longitude = np.linspace(0.0, 2.0 * np.pi, 721)
    galactic = np.stack([np.cos(longitude), np.sin(longitude), np.zeros_like(longitude)])
    ra, dec = position(GALACTIC_AXES.T @ galactic)
    x = on_map(ra / DEGREE)
    broken = np.where(np.abs(np.diff(x, append=x[-1])) > 1.0, np.nan, dec)
    axes.plot(x, broken, color="black", linewidth=0.9, zorder=2, label="Galactic plane")
    style = {"color": "black", "markersize": 9.0, "markeredgewidth": 1.2, "zorder": 4}
    axes.plot(x[:1], dec[:1], "+", label="Galactic centre", **style)


def on_map(longitude_deg: Array, frame: SkyFrame = ICRS) -> Array:
    """Return the map's coordinate of a longitude, in radians: it increases to the left, with 0 in the middle."""
    return np.asarray(-((longitude_deg - frame.centre_deg + 180.0) % 360.0 - 180.0) * DEGREE)
