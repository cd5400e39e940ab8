"""Surfaces: a quantity over two axes of the grid, as a heat map with contours."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import NDArray

from sweep.analysis.quantity import prediction_name, standard_error
from sweep.plots.style import edges, is_wide, label, logarithmic, quantity_label

LEVELS = 8
DECADES = 30.0


def draw_map(
    axes: Axes, dataset: xr.Dataset, variable: str, x: str, y: str, limits: tuple[float, float] | None = None
) -> Axes:
    """Draw a variable over two axes: colours at the points of the grid, solid contours, dashed ones of the prediction.

    ``limits`` are those of the colours, for several panels of one scale.  Points that are not there are left white.
    """
    dataset = dataset.sortby([x, y])
    part = dataset[variable].transpose(dataset[y].dims[0], dataset[x].dims[0])
    values = part.values
    low, high = limits or (float(np.nanmin(values)), float(np.nanmax(values)))
    norm: Normalize = LogNorm(low, high) if _spans_decades(values) else Normalize(low, high)
    across, up = dataset[x].values.astype(float), dataset[y].values.astype(float)
    wide = {name: is_wide(places, _unit(dataset, name)) for name, places in ((x, across), (y, up))}
    cells = edges(across, wide[x]), edges(up, wide[y])
    mesh = axes.pcolormesh(*cells, values, cmap="cividis", norm=norm, shading="flat", rasterized=True)
    logarithm = isinstance(norm, LogNorm)
    levels = LogLocator(subs=(1.0, 2.0, 5.0)) if logarithm else MaxNLocator(LEVELS, steps=[1, 2, 2.5, 5, 10])
    inside = [level for level in levels.tick_values(low, high) if low < level < high]
    options: dict[str, Any] = {"levels": inside, "linewidths": 0.8}
    if np.isfinite(values).all() and min(values.shape) > 1 and inside:
        lines = axes.contour(across, up, values, colors="white", **options)
        for text in axes.clabel(lines, fmt="%.3g", fontsize=7):
            text.set_path_effects([withStroke(linewidth=1.5, foreground="0.2")])
        if (name := prediction_name(dataset, variable)) in dataset:
            predicted = dataset[name].transpose(*part.dims).values
            axes.contour(across, up, predicted, colors="black", linestyles="dashed", **options | {"linewidths": 0.6})
    for which, name, places in (("x", x, across), ("y", y, up)):
        if wide[name]:
            logarithmic(axes, which, places)
    axes.set_xlabel(label(dataset[x], x))
    axes.set_ylabel(label(dataset[y], y))
    axes.figure.colorbar(mesh, ax=axes, label=quantity_label(dataset, variable))
    return axes


def _unit(dataset: xr.Dataset, axis: str) -> str:
    return str(dataset[axis].attrs.get("units", ""))


def _spans_decades(values: NDArray[np.float64]) -> bool:
    """Return whether most values span more than a linear scale of colours can show; a corner near 0 does not count."""
    if not np.all(values[np.isfinite(values)] > 0.0):
        return False
    low, high = np.nanquantile(values, [0.1, 0.9])
    return bool(high > DECADES * low)


def accuracy_in_words(dataset: xr.Dataset, variable: str) -> str:
    """Return how well the values of a map are known; '' where they have no errors."""
    error = standard_error(dataset, variable)
    if error is None:
        return ""
    value = dataset[variable]
    relative = float((error / abs(value.where(value != 0.0))).max(skipna=True))
    contours = "; dashed contours: predicted" if prediction_name(dataset, variable) in dataset else ""
    return f"errors (1σ) at most {100.0 * relative:.2g} %{contours}" if np.isfinite(relative) else ""
