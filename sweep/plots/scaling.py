"""How a run scales with workers: speed-up and efficiency beside what is ideal."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sweep.contract import SweepError
from sweep.plots.legends import legend
from sweep.plots.scales import logarithmic
from sweep.plots.style import BAND, COLOURS, figure_size, finish, series, wrapped

DIMENSIONS = {"kind", "workers"}
VARIABLES = {"seconds", "efficiency"}


def is_scaling(dataset: xr.Dataset) -> bool:
    """Return whether a dataset has measured times and efficiencies over kinds and workers."""
    return set(dataset.dims) >= DIMENSIONS and set(map(str, dataset.data_vars)) >= VARIABLES


def scaling_figure(dataset: xr.Dataset) -> Figure:
    """Return the speed-up beside the efficiency."""
    figure = Figure(figsize=figure_size(8.0, 3.8), layout="constrained")
    for axes, name in zip(figure.subplots(1, 2), ("speed-up", "efficiency"), strict=True):
        draw_scaling(axes, dataset, name)
    figure.suptitle(wrapped(str(dataset.attrs.get("title", "")), figure), fontsize="medium")
    return figure


def draw_scaling(axes: Axes, dataset: xr.Dataset, name: str) -> Axes:
    """Draw the "efficiency" against w workers, or the "speed-up" over one, w times the efficiency, by kind, with the
    ideal line.

    ``dataset`` has dimensions kind ("strong": the same work, "weak": the same work a worker) and workers, variables
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
    return axes
