"""The unknowns with their errors of every kind side by side."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from sweep.plots.style import figure_size, finish, series
from sweep.plots.tie.names import by_unit, readable, unknown_symbol
from sweep.readable import written


def solution_figure(dataset: xr.Dataset) -> Figure:
    """Return the estimates with each kind of error, one panel for each unit."""
    panels = by_unit(dataset)
    widths = [len(panel) + 1 for panel in panels.values()]
    kinds = [str(kind) for kind in dataset["error_kind"].values]
    width = float(np.clip(1.6 * len(panels) + 0.16 * len(kinds) * sum(widths), 6.4, 16.0))
    figure = Figure(figsize=figure_size(width, 4.2), layout="constrained")
    grid = figure.subplots(1, len(panels), width_ratios=widths, squeeze=False)[0]
    for axes, (stored, panel) in zip(grid, panels.items(), strict=True):
        values, errors = dataset["estimate"].values[panel], dataset["errors"].values[:, panel]
        factor, unit = readable(values, stored)
        for number, kind in enumerate(kinds):
            shift = 0.6 * ((number + 0.5) / len(kinds) - 0.5)
            axes.errorbar(
                np.arange(len(panel)) + shift,
                factor * values,
                yerr=factor * np.nan_to_num(errors[number]),
                linestyle="none",
                markersize=3.5,
                elinewidth=1.0,
                label=kind,
                **series(number),
            )
        axes.axhline(0.0, color="0.6", linewidth=0.6, zorder=0)
        names = [unknown_symbol(str(dataset["unknown"].values[k])) for k in panel]
        upright = len(panel) > 12 or any("[" in name for name in names)
        axes.set_xticks(range(len(panel)), names, rotation=90 if upright else 0)
        axes.set_xlim(-0.7, len(panel) - 0.3)
        axes.set_ylabel(f"estimate [{written(unit)}]")
        finish(axes)
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, title="errors", loc="outside lower center", ncols=min(len(labels), 6), frameon=False)
    return figure
