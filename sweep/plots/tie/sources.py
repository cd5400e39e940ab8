"""Sources: their separations, their discrepancies against their weights, and the most influential ones."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from scipy.special import chdtrc

from linksweep.core.arrays import Array
from linksweep.core.tie.influence import LARGE_SHARE
from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots.legends import legend, legend_below
from linksweep.sweep.plots.style import COLOURS, figure_size, finish, is_stacked
from linksweep.sweep.plots.tie.names import kept_sources, name_points

LINEAR_UP_TO = 6.0
NAMED = 8
RANKED = 20
MARK = {"color": "0.4", "linestyle": "dotted", "linewidth": 1.0, "label": f"{100.0 * LARGE_SHARE:g} %"}


def separation_figure(dataset: xr.Dataset) -> Figure:
    """Return histograms of the normalised separations, X before the fit and sqrt(2 Q/n) after it, beside the Rayleigh
    distribution that they follow if the errors are right.
    """
    if "normalised_separation" not in dataset:
        raise SweepError("no separations here: they are not kept for tables with so many rows")
    count = dataset["n_observations"].values
    before = dataset["normalised_separation"].values
    used = (count > 0.0) & (before > 0.0)
    if not np.any(used):
        raise SweepError("no source has a separation: no row has a position or motion that the satellite predicts")
    before = before[used]
    after = np.sqrt(2.0 * dataset["discrepancy"].values[used] / count[used])
    limit = np.sqrt(2.0 * np.log(max(int(np.sum(count > 0.0)), 2)))
    far = np.quantile(before, 0.9) > LINEAR_UP_TO
    number = int(np.clip(2.0 * np.sqrt(len(before)), 8, 48))
    top = max(float(before.max()), 10.0) if far else LINEAR_UP_TO
    edges = np.geomspace(0.05, top * 1.0001, number + 1) if far else np.linspace(0.0, LINEAR_UP_TO, number + 1)
    figure = Figure(figsize=figure_size(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    counts, counts_after = (np.histogram(one, edges)[0] for one in (before, after))
    axes.stairs(counts, edges, fill=True, color=COLOURS[4], alpha=0.55, label="before the fit, $X$")
    words = r"after the fit, $\sqrt{2\,Q_i/n_i}$"
    axes.stairs(counts_after, edges, color=COLOURS[1], linewidth=1.4, label=words)
    x = np.geomspace(edges[0], edges[-1], 400) if far else np.linspace(0.0, edges[-1], 400)
    step = x * np.log(edges[1] / edges[0]) if far else edges[1] - edges[0]
    expected = len(before) * step * x * np.exp(-0.5 * x**2)
    axes.plot(x, expected, color="black", linewidth=1.2, label="Rayleigh: the errors are right")
    axes.axvline(limit, color="0.4", linestyle="dashed", linewidth=1.0, label=rf"$\sqrt{{2\ln N}}$ = {limit:.2f}")
    if far:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlim(edges[0], edges[-1])
    axes.set_xlabel("normalised separation")
    axes.set_ylabel(f"sources in a bin, of {len(before)}")
    beyond = int(np.sum(before > edges[-1]))
    if beyond:
        axes.set_title(f"{beyond} beyond {edges[-1]:g} before the fit, {np.sum(after > edges[-1])} after it")
    finish(axes)
    legend(axes)
    return figure


def weight_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of Q/n of each source against its share of the weight of each block that is solved for."""
    share = _shares(dataset)
    used = dataset["n_observations"].values > 0.0
    kept = kept_sources(dataset)
    ratio = np.full(len(used), np.nan)
    ratio[used] = dataset["discrepancy"].values[used] / dataset["n_observations"].values[used]
    names = dataset["source"].values
    smallest = np.nanmin(np.where(ratio > 0.0, ratio, np.nan)) if np.any(ratio > 0.0) else 1e-3
    ratio = np.maximum(ratio, max(smallest, 1e-4))
    blocks = share.shape[1]
    shape = (blocks, 1) if is_stacked() else (1, blocks)
    width, height = figure_size(max(6.4, 0.8 + 3.8 * blocks), 4.2)
    figure = Figure(figsize=(width, 2.6 * blocks if is_stacked() else height), layout="constrained")
    grid = figure.subplots(*shape, sharey=True, squeeze=False).ravel()
    for axes, name, own in zip(grid, dataset["block_name"].values, share.T, strict=True):
        left = 0.5 * own[kept & (own > 0.0)].min()
        gone = used & ~kept
        size = 14.0 if len(names) < 300 else 4.0
        some = kept & (own > 0.0)
        dots = {"s": size, "color": COLOURS[0], "alpha": 0.6, "linewidths": 0.0}
        axes.scatter(own[some], ratio[some], label="kept", **dots)
        if np.any(gone):
            crosses = {"s": 16.0, "color": COLOURS[1], "marker": "x", "linewidths": 0.8}
            axes.scatter(np.full(gone.sum(), left), ratio[gone], label="dropped, of no weight", **crosses)
        axes.axhline(1.0, color="black", linewidth=0.8, zorder=1)
        axes.axvline(LARGE_SHARE, zorder=1, **MARK)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel(f"share of the weight in {str(name).replace('_', ' ')}")
        finish(axes)
        axes.margins(0.08)
        axes.set_title(f"{some.sum()} kept" + (f", {gone.sum()} dropped" if np.any(gone) else ""))
    legend_below(figure)  # each panel is full of points
    grid[0].set_ylabel("$Q_i/n_i$ (1 is expected)")
    surprise = chdtrc(np.maximum(dataset["n_observations"].values, 1.0), dataset["discrepancy"].values)
    figure.draw_without_rendering()
    for axes, own in zip(grid, share.T, strict=True):
        order = [*np.argsort(surprise)[: NAMED // 2], *np.argsort(-own)[: NAMED // 2]]
        chosen = np.array([k for k in dict.fromkeys(order) if kept[k] and own[k] > 0.0], dtype=int)
        name_points(axes, own[chosen], ratio[chosen], names[chosen].tolist())
    return figure


def influence_figure(dataset: xr.Dataset) -> Figure:
    """Return the sources with the largest shares of the weight, and how far the solution moves without each."""
    share = _shares(dataset)
    order = np.argsort(-share.max(axis=1))[:RANKED]
    order = order[share.max(axis=1)[order] > 0.0][::-1]
    height = 1.4 + 0.22 * len(order)  # whatever the width: each name needs its line
    figure = Figure(figsize=(figure_size(8.0, height)[0], height), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    places = np.arange(len(order))
    height = 0.8 / share.shape[1]
    for number, name in enumerate(dataset["block_name"].values):
        offset = 0.4 - (number + 0.5) * height
        colour = COLOURS[number % len(COLOURS)]
        left.barh(places + offset, share[order, number], height, color=colour, label=str(name).replace("_", " "))
    if share.max() > LARGE_SHARE / 3.0:  # else the mark would leave the bars no room
        left.axvline(LARGE_SHARE, **MARK)
    for axes in (left, right):
        axes.xaxis.set_major_locator(MaxNLocator(2 if is_stacked() else 5))
    left.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100.0 * value:g} %"))
    left.set_xlabel("share of the weight")
    left.set_yticks(places, dataset["source"].values[order].tolist(), fontsize=7)
    right.barh(places, np.nan_to_num(dataset["cook_distance"].values[order]), 0.7, color=COLOURS[5])
    right.set_xlabel("Cook's distance")
    for axes in (left, right):
        finish(axes)
        axes.tick_params(axis="y", length=0.0)
        axes.set_ylim(-0.6, len(order) - 0.4)
    legend_below(figure)
    return figure


def _shares(dataset: xr.Dataset) -> Array:
    if "share" not in dataset:
        raise SweepError("no weights of sources here: they are not kept for so many sources")
    return np.asarray(dataset["share"].values, dtype=np.float64)
