"""Figures of what is no result of a store: the sky of a catalogue, the accuracy of missions."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sweep.plots.labels import label
from sweep.plots.legends import legend
from sweep.plots.scales import logarithmic
from sweep.plots.sky import add_sky, draw_sky
from sweep.plots.style import BAND, COLOURS, figure_size, finish, wrapped

LINES = ("solid", "dashed", "dashdot", "dotted", (0, (6, 1, 1, 1, 1, 1)), (0, (3, 1)))


def sky_figure(dataset: xr.Dataset) -> Figure:
    """Return an all-sky map of ``ra`` and ``dec`` (deg), coloured by the magnitude ``v_mag`` where it is there."""
    figure = Figure(figsize=figure_size(7.6, 4.9), layout="constrained")
    draw_sky(add_sky(figure), dataset)
    figure.suptitle(wrapped(str(dataset.attrs.get("title", "")), figure), fontsize="medium")
    return figure


def accuracy_figure(dataset: xr.Dataset) -> Figure:
    """Return the accuracy curves of missions, proper motions beside positions."""
    figure = Figure(figsize=figure_size(8.4, 4.0), layout="constrained")
    for axes, variable in zip(figure.subplots(1, 2, sharex=True), ("sigma_pm", "sigma_pos"), strict=True):
        _draw_accuracy(axes, dataset, variable)
    figure.suptitle(wrapped(str(dataset.attrs.get("title", "")), figure), fontsize="medium")
    return figure


def _draw_accuracy(axes: Axes, dataset: xr.Dataset, variable: str) -> None:
    """Draw a variable (model, v) against the magnitude v, one line a model, with a band where its error is known."""
    v = dataset["v"].values
    for number, model in enumerate(dataset["model"].values.tolist()):
        one = dataset.sel(model=model)
        curve, error, colour = one[variable].values, one[f"{variable}_error"].values, COLOURS[number % len(COLOURS)]
        axes.plot(v, curve, color=colour, linestyle=LINES[number % len(LINES)], linewidth=1.2, label=str(model))
        if np.isfinite(error).any():
            axes.fill_between(v, curve - error, curve + error, color=colour, **BAND)
    logarithmic(axes, "y", dataset[variable].values)
    axes.set_xlabel(label(dataset["v"], "v"))
    axes.set_ylabel(label(dataset[variable], variable))
    finish(axes)
    legend(axes)
