"""A series at each of many points: where the middle of them and nearly all of them are, or a few single curves."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from sweep.attributes import units_of
from sweep.plots.labels import label, quantity_label
from sweep.plots.legends import legend
from sweep.plots.points import told_apart
from sweep.plots.scales import is_wide, logarithmic
from sweep.plots.style import COLOURS, finish
from sweep.studies.study import POINT

FEW_CURVES = 12
"""No more curves than these are drawn one by one."""

BANDS = ((0.05, 0.95, 0.15, "90 % of the points"), (0.25, 0.75, 0.3, "50 % of the points"))
"""Quantiles over the points between which a band lies, its opacity and what it is called."""


def draw_curves(axes: Axes, dataset: xr.Dataset, variable: str, over: str) -> Axes:
    """Draw a variable of points in no order along a dimension of its own, one colour for every combination of the
    others: the median and the bands of many points, each curve of few.

    Raises SweepError where the other dimensions leave more combinations than colours.
    """
    along = str(dataset[over].dims[0])
    array = dataset[variable]
    series = told_apart(dataset, variable, (POINT, along), f"beside {over}")
    x = dataset[over].values.astype(float)
    many = array.sizes[POINT] > FEW_CURVES
    for number, (place, words) in enumerate(series):
        y = array.isel(place).transpose(POINT, along).values.astype(float)
        _draw(axes, x, y[np.isfinite(y).any(axis=1)], COLOURS[number], words, many)
    for which, values in (("x", x), ("y", array.values)):
        if is_wide(values, units_of(dataset[over].attrs) if which == "x" else ""):
            logarithmic(axes, which, values)
    axes.set_xlabel(label(dataset[over], over))
    axes.set_ylabel(quantity_label(dataset, variable))
    finish(axes)
    if many or array.ndim > 2:
        legend(axes)
    return axes


def _draw(axes: Axes, x: np.ndarray, y: np.ndarray, colour: str, words: str, many: bool) -> None:
    """Draw the curves (points, x) of one colour; what they are called stands in the legend, bands once."""
    if not many:
        axes.plot(x, y.T, color=colour, linewidth=0.9, alpha=0.8)
        axes.plot([], [], color=colour, label=words or "a point")
        return
    for low, high, opacity, name in BANDS:
        lower, upper = np.nanquantile(y, (low, high), axis=0)
        axes.fill_between(x, lower, upper, color=colour, alpha=opacity, linewidth=0.0, label="" if words else name)
    axes.plot(x, np.nanmedian(y, axis=0), color=colour, linewidth=1.4, label=words or f"median of {len(y)} points")
