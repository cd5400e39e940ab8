"""Differences and residuals as arrows on the sky."""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from numpy.typing import NDArray

from linksweep.core.arrays import Array
from linksweep.core.constants import DEGREE
from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots.sky import add_sky, on_map
from linksweep.sweep.plots.style import COLOURS, figure_size, in_lines, is_stacked
from linksweep.sweep.plots.tie.names import readable

MOST_ARROWS = 150
"""More rows than this are averaged in cells of equal area."""
BANDS = 9
LONGEST, TYPICAL = 1.5, 0.08
"""Arrows of the length that 90 % of them do not exceed take the share TYPICAL of the width of the map; longer ones are
cut at LONGEST times that length.
"""
COMMON_SCALE = 5.0
"""Differences and residuals have the same scale unless they differ by more than this factor."""


class _Arrows(NamedTuple):
    """Places (deg), components towards east and north, and which are of sources that the clip dropped."""

    ra: Array
    dec: Array
    east: Array
    north: Array
    dropped: NDArray[np.bool_]


def residual_figure(dataset: xr.Dataset) -> Figure:
    """Return maps of the differences before and the residuals after the fit, of positions and of motions."""
    if "difference" not in dataset:
        raise SweepError("no residuals here: they are not kept for tables with so many rows")
    pairs = [(name, pair) for name, pair in (("positions", [0, 1]), ("motions", [3, 4])) if _n_rows(dataset, pair)]
    if not pairs:
        raise SweepError("no residuals on the sky: no row has a position or a motion")
    width, height = figure_size(11.0, 3.3 * len(pairs) + 0.3)
    stacked = is_stacked()
    figure = Figure(figsize=(width, 1.3 * width * len(pairs) if stacked else height), layout="constrained")
    shape = (2 * len(pairs), 1) if stacked else (len(pairs), 2)
    places = figure.add_gridspec(*shape)
    for row, (what, pair) in enumerate(pairs):
        unit = str(dataset["observable_unit"].values[pair[0]])
        both = [_arrows(dataset, name, pair) for name in ("difference", "residual")]
        scales = [_typical(arrows) for arrows in both]
        if scales[0] < COMMON_SCALE * scales[1] or scales[1] == 0.0:
            scales = [max(scales)] * 2
        for column, (arrows, scale) in enumerate(zip(both, scales, strict=True)):
            axes = add_sky(figure, places[2 * row + column])
            words = _draw(axes, arrows, scale, unit)
            averages = f", means of {len(arrows.ra)} cells" if _n_rows(dataset, pair) > MOST_ARROWS else ""
            title = f"{what} {('before', 'after')[column]} the fit{averages}{words}"
            axes.set_title(in_lines(title, width if stacked else 0.5 * width), pad=10.0)
            if row < len(pairs) - 1 or (stacked and not column):
                axes.set_xlabel("")
            if column and not stacked:
                axes.set_ylabel("")
    return figure


def _n_rows(dataset: xr.Dataset, pair: list[int]) -> int:
    return int(np.sum(np.isfinite(dataset["difference"].values[:, pair]).all(axis=1)))


def _arrows(dataset: xr.Dataset, name: str, pair: list[int]) -> _Arrows:
    values, errors = dataset[name].values[:, pair], dataset["difference_error"].values[:, pair]
    rows = np.isfinite(values).all(axis=1)
    source = dataset["row_source_index"].values[rows]
    ra, dec = dataset["ra"].values[source], dataset["dec"].values[source]
    dropped = dataset["weight_factor"].values[source] == 0.0
    values, errors = values[rows], errors[rows]
    if len(values) <= MOST_ARROWS:
        return _Arrows(ra, dec, values[:, 0], values[:, 1], dropped)
    kept = ~dropped
    return _averaged(ra[kept], dec[kept], values[kept], errors[kept])


def _averaged(ra: Array, dec: Array, values: Array, errors: Array) -> _Arrows:
    """Return weighted means at the centres of cells: bands of equal area, each in 2 BANDS steps of right ascension."""
    band = np.minimum(((np.sin(dec * DEGREE) + 1.0) * 0.5 * BANDS).astype(int), BANDS - 1)
    step = ((ra % 360.0) * (BANDS / 180.0)).astype(int) % (2 * BANDS)
    cells, index = np.unique(2 * BANDS * band + step, return_inverse=True)
    weights = 1.0 / errors**2
    sums = [np.bincount(index, w * v) / np.bincount(index, w) for w, v in zip(weights.T, values.T, strict=True)]
    middle = np.arcsin((cells // (2 * BANDS) + 0.5) / BANDS * 2.0 - 1.0) / DEGREE
    across = (cells % (2 * BANDS) + 0.5) * 180.0 / BANDS
    return _Arrows(across, middle, sums[0], sums[1], np.zeros(len(cells), dtype=bool))


def _typical(arrows: _Arrows) -> float:
    length = np.hypot(arrows.east, arrows.north)[~arrows.dropped]
    return float(np.quantile(length, 0.9)) if len(length) else 0.0


def _draw(axes: Any, arrows: _Arrows, scale: float, unit: str) -> str:
    """Draw arrows and a key with their scale; return words for the title about arrows that are cut or dropped."""
    x = on_map(arrows.ra)
    y = arrows.dec * DEGREE
    length = np.hypot(arrows.east, arrows.north)
    scale = scale or 1.0
    cut = length > LONGEST * scale
    shown = np.where(cut, LONGEST * scale / np.maximum(length, 1e-300), 1.0)
    angles = _angles(axes, x, y, arrows.east, arrows.north)
    u, v = length * shown * np.cos(np.radians(angles)), length * shown * np.sin(np.radians(angles))
    style = {"scale": scale / TYPICAL, "scale_units": "width", "units": "width", "width": 0.0028, "clip_on": False}
    for chosen, colour in ((~arrows.dropped, COLOURS[0]), (arrows.dropped, COLOURS[1])):
        if not np.any(chosen):
            continue
        at = x[chosen], y[chosen]
        axes.scatter(*at, s=5.0, color=colour, linewidths=0.0, zorder=3)
        drawn = axes.quiver(*at, u[chosen], v[chosen], angles=angles[chosen], color=colour, zorder=4, **style)
        drawn.set_in_layout(False)
        if colour == COLOURS[0] or np.all(arrows.dropped):
            factor, readable_unit = readable(np.array([scale]), unit)
            key = _round(scale)
            text = f"{factor * key:g} {readable_unit}"
            axes.quiverkey(drawn, 0.04, 0.02, key, text, labelpos="E", coordinates="axes", fontproperties={"size": 8})
    words = f"; {np.sum(cut)} arrow{'s' if np.sum(cut) > 1 else ''} cut" if np.any(cut) else ""
    return words + (f"; {np.sum(arrows.dropped)} dropped in red" if np.any(arrows.dropped) else "")


def _angles(axes: Any, x: Array, y: Array, east: Array, north: Array) -> Array:
    """Return the directions of arrows on the map in degrees: those of a small step along each on the sphere."""
    small = 1e-4
    length = np.maximum(np.hypot(east, north), 1e-300)
    inward = np.where(np.abs(x) > 3.1, np.sign(x), 0.0) * 0.01  # not across the edge of the map
    start = np.stack([x - inward, np.clip(y, -1.55, 1.55)], axis=1)
    step = np.stack([-east / length / np.cos(start[:, 1]), north / length], axis=1) * small
    projection = axes.transProjection
    there = projection.transform(start + step) - projection.transform(start)
    return np.asarray(np.degrees(np.arctan2(there[:, 1], there[:, 0])))


def _round(value: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not above a number."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(digit * power for digit in (1.0, 2.0, 5.0) if digit * power <= value * 1.0001))
