"""How the solution changes without sources: without each of them in turn, and while a clip drops them."""

from itertools import combinations
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots.scales import logarithmic
from linksweep.sweep.plots.scatter import confidence_ellipse
from linksweep.sweep.plots.style import BAND, COLOURS, figure_size, finish, is_stacked
from linksweep.sweep.plots.tie.names import kept_sources, name_points, readable, unknown_symbols, vectors

CONFIDENCE = 0.683
NAMED = 5
MOST_NAMES = 20
LINES = ("solid", "dashed", "dotted", "dashdot", (0, (5, 1, 1, 1)), (0, (1, 3)))


def jackknife_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of each pair of components of each vector, with the solutions without each source and an ellipse
    for each kind of error.  Distances of solutions from the mean are multiplied by sqrt(N - 1), so that
    their scatter is the jackknife error.
    """
    if "estimate_without" not in dataset:
        raise SweepError("no solutions without each source here: they are not kept for so many sources")
    blocks, symbols = vectors(dataset), unknown_symbols(dataset)
    if not blocks:
        raise SweepError("no jackknife scatter: no block of the unknowns is a vector")
    names, without = dataset["source"].values, dataset["estimate_without"].values
    kept = kept_sources(dataset) & np.isfinite(without).all(axis=1)
    names, without = names[kept], without[kept]
    if len(without) < 2:
        raise SweepError("no jackknife scatter: the unknowns depend on single sources")
    stretched = without.mean(axis=0) + np.sqrt(len(without) - 1.0) * (without - without.mean(axis=0))
    far = np.argsort(-dataset["cook_distance"].values[kept])[:NAMED]
    width, height = figure_size(10.0, 3.4 * len(blocks) + 0.5)
    stacked = is_stacked()
    figure = Figure(figsize=(width, 3.0 * width / len(blocks) + 1.0 if stacked else height), layout="constrained")
    shape = (3, len(blocks)) if stacked else (len(blocks), 3)
    grid = figure.subplots(*shape, squeeze=False)
    grid = grid.T if stacked else grid
    kinds = [str(kind) for kind in dataset["error_kind"].values]
    size = 9.0 if len(without) < 60 else 5.0 if len(without) < 300 else 2.0
    dots: dict[str, Any] = {"color": COLOURS[0], "markersize": size, "markeredgewidth": 0.0, "alpha": 0.6}
    dots["rasterized"] = len(without) > 2000
    drawn: list[tuple[Any, ...]] = []
    for row, places in enumerate(blocks.values()):
        factor, unit = readable(stretched[:, places], str(dataset["unit"].values[places[0]]))
        for axes, (i, j) in zip(grid[row], combinations(places, 2), strict=True):
            x, y = factor * stretched[:, [i, j]].T
            drawn.append((axes, x, y))
            axes.plot(x, y, ".", label="without one source, displacement × √(N − 1)", **dots)
            for number, kind in enumerate(kinds):
                covariance = dataset["covariances"].values[number][np.ix_([i, j], [i, j])]
                if np.all(np.isfinite(covariance)):
                    centre = factor * dataset["estimate"].values[[i, j]]
                    outline = confidence_ellipse(centre, factor**2 * covariance, CONFIDENCE, label=f"{kind}, 68 %")
                    colour, line = COLOURS[(number + 1) % len(COLOURS)], LINES[number % len(LINES)]
                    outline.set(edgecolor=colour, linestyle=line, zorder=4)
                    axes.add_patch(outline)
            axes.set_aspect("equal", adjustable="datalim")
            for which, k in ((axes.set_xlabel, i), (axes.set_ylabel, j)):
                which(f"{symbols[k]} [{unit}]")
            axes.margins(0.12)
            axes.autoscale_view()
            finish(axes)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    columns = 1 if stacked else min(4, len(labels))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
    figure.draw_without_rendering()
    for axes, x, y in drawn:
        name_points(axes, x[far], y[far], names[far].tolist())
    return figure


def trajectory_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of each vector and chi2/dof against the step of the clip; a line marks the chosen step."""
    if "step_estimate" not in dataset or dataset.sizes["step"] < 2:
        raise SweepError("no trajectory here: give --clip discrepancy or median:K, which go step by step")
    blocks, symbols = vectors(dataset), unknown_symbols(dataset)
    steps, chosen = np.arange(dataset.sizes["step"]), int(dataset["step_chosen"])
    dropped = [str(name) for name in dataset["step_dropped"].values]
    figure = Figure(figsize=figure_size(7.4, 1.6 + 2.0 * len(blocks) + 1.4), layout="constrained")
    grid = figure.subplots(len(blocks) + 1, 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, places) in zip(grid, blocks.items(), strict=False):
        values, errors = dataset["step_estimate"].values[:, places], dataset["step_error"].values[:, places]
        factor, unit = readable(values, str(dataset["unit"].values[places[0]]))
        for number, k in enumerate(places):
            line, error = factor * values[:, number], factor * errors[:, number]
            axes.plot(steps, line, ".-", color=COLOURS[number], linewidth=1.0, markersize=3.0, label=symbols[k])
            axes.fill_between(steps, line - error, line + error, color=COLOURS[number], **BAND)
        axes.set_ylabel(f"{name.replace('_', ' ')} [{unit}]")
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
