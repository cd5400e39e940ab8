"""Figures of data other than results: the sky of a catalogue, the accuracy of missions, how a run scales."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots.labels import label
from linksweep.sweep.plots.legends import legend
from linksweep.sweep.plots.scales import logarithmic
from linksweep.sweep.plots.sky import add_sky, draw_sky
from linksweep.sweep.plots.style import BAND, COLOURS, figure_size, finish, series, wrapped

LINES = ("solid", "dashed", "dashdot", "dotted", (0, (6, 1, 1, 1, 1, 1)), (0, (3, 1)))


def sky_figure(dataset: xr.Dataset) -> Figure:
    """Return an all-sky map of ``ra`` and ``dec`` (deg), coloured by the magnitude ``v_mag`` if there is one."""
    figure = Figure(figsize=figure_size(7.6, 4.9), layout="constrained")
    draw_sky(add_sky(figure), dataset)
    return _entitled(figure, dataset)


def accuracy_figure(dataset: xr.Dataset) -> Figure:
    """Return ``sigma_pm`` beside ``sigma_pos`` (model, v) against the magnitude v, a line for each mission, with a band
    where its error is known.
    """
    figure = Figure(figsize=figure_size(8.4, 4.0), layout="constrained")
    v = dataset["v"].values
    for axes, variable in zip(figure.subplots(1, 2, sharex=True), ("sigma_pm", "sigma_pos"), strict=True):
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
    return _entitled(figure, dataset)


def _entitled(figure: Figure, dataset: xr.Dataset) -> Figure:
    figure.suptitle(wrapped(str(dataset.attrs.get("title", "")), figure), fontsize="medium")
    return figure


def is_scaling(dataset: xr.Dataset) -> bool:
    """Return whether a dataset has measured times and efficiencies over kinds and workers."""
    return {"kind", "workers"} <= set(dataset.dims) and {"seconds", "efficiency"} <= set(dataset.data_vars)


def scaling_figure(dataset: xr.Dataset) -> Figure:
    """Return the speed-up beside the efficiency."""
    figure = Figure(figsize=figure_size(8.0, 3.8), layout="constrained")
    for axes, name in zip(figure.subplots(1, 2), ("speed-up", "efficiency"), strict=True):
        draw_scaling(axes, dataset, name)
    return _entitled(figure, dataset)


def draw_scaling(axes: Axes, dataset: xr.Dataset, name: str) -> None:
    """Draw the "efficiency" against w workers, or the "speed-up" over one, w times the efficiency, by kind, with the
    ideal line.

    ``dataset`` has dimensions kind ("strong": the same work, "weak": the same work per worker) and workers, variables
    seconds and efficiency (1 is ideal), each with a one-sigma NAME_error where it is known.
    """
    if not is_scaling(dataset):
        raise SweepError("scaling needs the dimensions kind and workers, and variables seconds and efficiency")
    workers = dataset["workers"].values.astype(float)
    ideal = workers if name == "speed-up" else np.ones(len(workers))
    axes.plot(workers, ideal, color="black", linewidth=0.8, linestyle=(0, (4, 3)), label="ideal")
    for number, kind in enumerate(dataset["kind"].values.tolist()):
        one = dataset.sel(kind=kind)
        value = one["efficiency"].transpose("workers", ...).values * ideal
        error = one["efficiency_error"].values * ideal if "efficiency_error" in one else None
        style = {**series(number), "markersize": 4.0, "linewidth": 1.0, "elinewidth": 0.8}
        axes.errorbar(workers, value, yerr=error, label=f"{kind} scaling", **style)
        if error is not None:
            axes.fill_between(workers, value - error, value + error, color=COLOURS[number], **BAND)
    logarithmic(axes, "x", workers)
    axes.set_xticks(workers, [f"{w:g}" for w in workers])
    axes.set_xticks([], minor=True)
    if name == "speed-up":
        logarithmic(axes, "y", ideal)
    else:
        axes.set_ylim(0.0, max(1.1, 1.05 * float(np.nanmax(dataset["efficiency"].values))))
    axes.set_xlabel("workers")
    axes.set_ylabel("efficiency" if name == "efficiency" else "speed-up over one worker")
    finish(axes)
    legend(axes)
