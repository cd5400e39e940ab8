"""Figures of what is no result of a store: the sky of a catalogue, the accuracy of missions."""

import xarray as xr
from matplotlib.figure import Figure

from sweep.plots.missions import draw_accuracy
from sweep.plots.sky import add_sky, draw_sky
from sweep.plots.style import figure_size, wrapped


def sky_figure(dataset: xr.Dataset) -> Figure:
    """Return an all-sky map of ``ra`` and ``dec`` (deg), coloured by the magnitude ``v_mag`` where it is there."""
    figure = Figure(figsize=figure_size(7.6, 4.9), layout="constrained")
    draw_sky(add_sky(figure), dataset, "v_mag" if "v_mag" in dataset else None)
    figure.suptitle(wrapped(str(dataset.attrs.get("title", "")), figure), fontsize="medium")
    return figure


def accuracy_figure(dataset: xr.Dataset) -> Figure:
    """Return the accuracy curves of missions, proper motions beside positions."""
    figure = Figure(figsize=figure_size(8.4, 4.0), layout="constrained")
    for axes, variable in zip(figure.subplots(1, 2, sharex=True), ("sigma_pm", "sigma_pos"), strict=True):
        draw_accuracy(axes, dataset, variable)
    figure.suptitle(wrapped(str(dataset.attrs.get("title", "")), figure), fontsize="medium")
    return figure
