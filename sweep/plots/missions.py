"""Accuracy curves: the error of one object against its magnitude, by model."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from sweep.plots.style import BAND, COLOURS, finish, label, legend, logarithmic

LINES = ("solid", "dashed", "dashdot", "dotted", (0, (6, 1, 1, 1, 1, 1)), (0, (3, 1)))


def draw_accuracy(axes: Axes, dataset: xr.Dataset, variable: str) -> Axes:
    """Draw a variable of dimensions (model, v) against v on a logarithmic scale, one line a model.

    A NAME_error beside it, the one-sigma error of a curve that was fitted, becomes a band.
    """
    v = dataset["v"].values
    for number, model in enumerate(dataset["model"].values.tolist()):
        one = dataset.sel(model=model)
        curve, colour = one[variable].values, COLOURS[number % len(COLOURS)]
        axes.plot(v, curve, color=colour, linestyle=LINES[number % len(LINES)], linewidth=1.2, label=str(model))
        error = one[f"{variable}_error"].values if f"{variable}_error" in one else np.full(len(v), np.nan)
        if np.isfinite(error).any():
            axes.fill_between(v, curve - error, curve + error, color=colour, **BAND)
    logarithmic(axes, "y", dataset[variable].values)
    axes.set_xlabel(label(dataset["v"], "v"))
    axes.set_ylabel(label(dataset[variable], variable))
    finish(axes)
    legend(axes)
    return axes
