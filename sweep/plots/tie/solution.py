"""The unknowns with their errors of every kind side by side, and the spin in each bin of a column."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots.style import figure_size, finish, series
from linksweep.sweep.plots.tie.names import places_by, readable, unknown_symbols


def solution_figure(dataset: xr.Dataset) -> Figure:
    """Return the estimates with each kind of error, one panel for each unit."""
    panels, symbols = places_by(dataset, "unit"), unknown_symbols(dataset)
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
            places, error = np.arange(len(panel)) + shift, factor * np.nan_to_num(errors[number])
            style = {**series(number), "linestyle": "none", "markersize": 3.5, "elinewidth": 1.0}
            axes.errorbar(places, factor * values, yerr=error, label=kind, **style)
        axes.axhline(0.0, color="0.6", linewidth=0.6, zorder=0)
        names = [symbols[k] for k in panel]
        upright = len(panel) > 12 or any("[" in name for name in names)
        axes.set_xticks(range(len(panel)), names, rotation=90 if upright else 0)
        axes.set_xlim(-0.7, len(panel) - 0.3)
        axes.set_ylabel(f"estimate [{unit}]")
        finish(axes)
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, title="errors", loc="outside lower center", ncols=min(len(labels), 6), frameon=False)
    return figure


def bin_figure(dataset: xr.Dataset) -> Figure:
    """Return the three components of the spin against the column of the bins; the outermost bins are open."""
    if "spin_by_bin" not in dataset:
        raise SweepError("no bins here: give --bins COLUMN=EDGES")
    values, errors = dataset["spin_by_bin"].values, dataset["spin_by_bin_error"].values
    factor, unit = readable(values, "mas/yr")
    low, high = dataset["bin_low"].values.astype(float), dataset["bin_high"].values.astype(float)
    inner = (high - low)[np.isfinite(high - low)]
    width = float(np.median(inner)) if len(inner) else 1.0
    left = np.where(np.isfinite(low), low, high - width)
    right = np.where(np.isfinite(high), high, low + width)
    figure = Figure(figsize=figure_size(6.8, 4.2), layout="constrained")
    axes = figure.add_subplot()
    middle = 0.5 * (left + right)
    for number, component in enumerate("xyz"):
        shift = 0.08 * (number - 1) * (right - left)
        style = {**series(number), "linestyle": "none", "markersize": 4.5, "label": rf"$\omega_{component}$"}
        axes.errorbar(middle + shift, factor * values[:, number], yerr=factor * errors[:, number], **style)
    for edge in sorted({*left.tolist(), *right.tolist()}):
        is_open = edge not in low and edge not in high
        axes.axvline(edge, color="0.75", linewidth=0.6, linestyle="dotted" if is_open else "solid", zorder=0)
    axes.axhline(0.0, color="0.5", linewidth=0.8, zorder=0)
    axes.set_xticks(middle, [_range(a, b) for a, b in zip(low, high, strict=True)])
    axes.set_xlabel(str(dataset.attrs.get("bin_column", "bin")))
    axes.set_ylabel(f"spin [{unit}]")
    finish(axes, grid=False)
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _range(low: float, high: float) -> str:
    if not np.isfinite(low):
        return f"below {high:g}"
    return f"{low:g} and more" if not np.isfinite(high) else f"{low:g} to {high:g}"
