"""How the solution goes while a clip drops sources."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sweep.contract import SweepError
from sweep.plots.scales import logarithmic
from sweep.plots.style import BAND, COLOURS, figure_size, finish
from sweep.plots.tie.names import readable, unknown_symbol, vectors
from sweep.readable import written

MOST_NAMES = 20


def trajectory_figure(dataset: xr.Dataset) -> Figure:
    """Return each vector and chi2/dof against the step of the clip; the step that was chosen is a line."""
    if "step_estimate" not in dataset or dataset.sizes["step"] < 2:
        raise SweepError("no trajectory here: give --clip discrepancy or median:K, which go step by step")
    blocks = vectors(dataset)
    steps, chosen = np.arange(dataset.sizes["step"]), int(dataset["step_chosen"])
    dropped = [str(name) for name in dataset["step_dropped"].values]
    figure = Figure(figsize=figure_size(7.4, 1.6 + 2.0 * len(blocks) + 1.4), layout="constrained")
    grid = figure.subplots(len(blocks) + 1, 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, places) in zip(grid, blocks.items(), strict=False):
        values, errors = dataset["step_estimate"].values[:, places], dataset["step_error"].values[:, places]
        factor, unit = readable(values, str(dataset["unit"].values[places[0]]))
        for number, k in enumerate(places):
            line, error = factor * values[:, number], factor * errors[:, number]
            label = unknown_symbol(str(dataset["unknown"].values[k]))
            axes.plot(steps, line, ".-", color=COLOURS[number], linewidth=1.0, markersize=3.0, label=label)
            axes.fill_between(steps, line - error, line + error, color=COLOURS[number], **BAND)
        axes.set_ylabel(f"{name.replace('_', ' ')} [{written(unit)}]")
        axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = dataset["step_chi2"].values / dataset["step_dof"].values
    grid[-1].plot(steps, ratio, ".-", color="black", linewidth=1.0, markersize=3.0)
    grid[-1].axhline(1.0, color="0.6", linewidth=0.6, zorder=0)
    if np.all(ratio[np.isfinite(ratio)] > 0.0) and np.nanmax(ratio) > 5.0 * np.nanmin(ratio):
        logarithmic(grid[-1], "y", ratio)
    grid[-1].set_ylabel(r"$\chi^2$/dof")
    for axes in grid:
        axes.axvline(chosen, color="0.4", linestyle="dashed", linewidth=1.0)
        finish(axes)
    one_by_one = any(dropped)
    if one_by_one and len(steps) <= MOST_NAMES:
        grid[-1].set_xticks(steps, ["all", *dropped[1:]], rotation=90, fontsize=7)
        grid[-1].set_xlabel("source dropped, one after the other")
    else:
        grid[-1].set_xlabel("sources dropped, one by one" if one_by_one else "iteration of the clip")
        grid[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    words = f"{chosen} dropped" if one_by_one else f"iteration {chosen}"
    grid[0].set_title(f"clip {dataset.attrs['clip']}; dashed: the solution, {words}; bands: scaled errors")
    return figure
