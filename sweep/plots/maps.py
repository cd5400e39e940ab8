"""Surfaces: a quantity over two axes of the grid, as a heat map with contours."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.ticker import LogLocator, MaxNLocator

from linksweep.sweep.analysis.quantity import prediction_name, standard_error
from linksweep.sweep.formatting import is_truth
from linksweep.sweep.plots.labels import explained_label, quantity_label
from linksweep.sweep.plots.scales import edges, fit_bar, fit_scale, is_logarithmic, number_text

LEVELS = 8


def draw_map(axes: Axes, dataset: xr.Dataset, variable: str, x: str, y: str, limits: Normalize) -> Axes:
    """Draw a variable over two axes: colours at the points of the grid, and contours, but none of truth values.

    ``limits`` are those of the colours, which all panels of a figure share.  Points without a value are left white.
    """
    dataset = dataset.sortby([x, y])
    part = dataset[variable].transpose(dataset[y].dims[0], dataset[x].dims[0])
    values = part.values
    low, high = float(limits.vmin or 0.0), float(limits.vmax or 0.0)
    across, up = dataset[x].values.astype(float), dataset[y].values.astype(float)
    cells = [edges(dataset[name].values.astype(float), is_logarithmic(dataset[name])) for name in (x, y)]
    axes.pcolormesh(*cells, values, cmap="cividis", norm=limits, shading="flat", rasterized=True)
    logarithm = isinstance(limits, LogNorm)
    levels = LogLocator(subs=(1.0, 2.0, 5.0)) if logarithm else MaxNLocator(LEVELS, steps=[1, 2, 2.5, 5, 10])
    inside = [level for level in levels.tick_values(low, high) if low < level < high]
    options: dict[str, Any] = {"levels": inside, "linewidths": 0.8, "linestyles": "solid"}  # also of negative numbers
    if np.isfinite(values).all() and min(values.shape) > 1 and inside and not is_truth(dataset[variable]):
        dark: list[AbstractPathEffect] = [withStroke(linewidth=2.2, foreground="0.15")]
        lines = axes.contour(across, up, values, colors="white", **options)
        lines.set_path_effects(dark)
        for text in axes.clabel(lines, fmt=number_text, fontsize="small"):
            text.set_path_effects(dark)
    for which, name in (("x", x), ("y", y)):
        fit_scale(axes, which, dataset[name])
        if dataset[name].dtype.kind == "i" and not is_logarithmic(dataset[name]):
            (axes.xaxis if which == "x" else axes.yaxis).set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(explained_label(dataset[x], x))
    axes.set_ylabel(explained_label(dataset[y], y))
    return axes


def colour_limits(dataset: xr.Dataset, variable: str) -> Normalize:
    """Return the scale of colours for all values of a variable, logarithmic as an axis of it would be."""
    values = dataset[variable].values.astype(float)
    finite = values[np.isfinite(values)]
    return (LogNorm if is_logarithmic(dataset[variable]) else Normalize)(float(finite.min()), float(finite.max()))


def add_bar(figure: Figure, dataset: xr.Dataset, variable: str) -> None:
    """Add the one colour bar that all maps of a figure share."""
    meshes = [mesh for axes in figure.axes for mesh in axes.collections if isinstance(mesh, QuadMesh)]
    bar = figure.colorbar(meshes[0], ax=figure.axes, label=quantity_label(dataset, variable))
    fit_bar(bar, dataset[variable])


def accuracy_in_words(dataset: xr.Dataset, variable: str) -> str:
    """Return how well the values of a map are known and agree with their prediction; '' where they have no errors."""
    error = standard_error(dataset, variable)
    if error is None:
        return ""
    value = dataset[variable]
    relative = float((error / abs(value.where(value != 0.0))).max(skipna=True))
    predicted = dataset.get(prediction_name(dataset, variable))
    apart = np.nan if predicted is None else float((abs(value - predicted) / error.where(error > 0.0)).max())
    words = f"; at most {apart:.1f}σ from the prediction" if np.isfinite(apart) else ""
    return f"errors (1σ) at most {100.0 * relative:.2g} %{words}" if np.isfinite(relative) else ""
