"""What further observations would change: errors against the epoch of new ones, and which sources to observe."""

from typing import Any, Literal

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots.legends import BEST
from linksweep.sweep.plots.style import COLOURS, figure_size, finish, in_lines, is_stacked, series
from linksweep.sweep.plots.tie.names import places_by, readable, unknown_symbols

RANKED = 20
CURVE: dict[str, Any] = {"markersize": 4.0, "linewidth": 1.2}
LINES: tuple[Literal["dashed", "dotted", "dashdot"], ...] = ("dashed", "dotted", "dashdot")


def epoch_figure(dataset: xr.Dataset) -> Figure:
    """Return the errors of the unknowns against the epoch of one more position of every source."""
    if "error_with_epoch" not in dataset:
        raise SweepError("no epochs here: give --add with the epochs of new observations")
    panels = places_by(dataset, "unit")
    epochs, errors_then = dataset["new_epoch"].values, dataset["error_with_epoch"].values
    symbols = unknown_symbols(dataset)
    order = np.argsort(epochs)
    figure = Figure(figsize=figure_size(1.2 + 4.4 * len(panels), 4.4), layout="constrained")
    stages = list(zip(dataset["stage"].values, dataset["error"].values, LINES, strict=False))
    grid = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (stored, panel) in zip(grid, panels.items(), strict=True):
        factor, unit = readable(dataset["error"].values[:, panel], stored)
        for number, k in enumerate(panel[: len(COLOURS)]):
            points = {**series(number), **CURVE, "linestyle": "none"}  # nothing was computed between the epochs
            axes.plot(epochs[order], factor * errors_then[order, k], label=symbols[k], **points)
            for _, errors, line in stages:
                axes.axhline(factor * errors[k], color=COLOURS[number], linestyle=line, linewidth=0.9)
        each = figure.get_figwidth() / len(panels) - 0.4
        axes.set_xlabel(in_lines("epoch of the new position of each source [yr]", each))
        axes.set_ylabel(f"formal error [{unit}]")
        axes.ticklabel_format(axis="x", useOffset=False)
        if len(epochs) <= 8:
            axes.set_xticks(epochs[order], [f"{epoch:g}" for epoch in epochs[order]])
        axes.set_ylim(bottom=0.0)
        finish(axes)
        columns = 4 if each > 2.0 else 2
        axes.legend(frameon=False, ncols=columns, columnspacing=1.0, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    lines = [Line2D([], [], color="0.3", linestyle=line, linewidth=0.9) for _, _, line in stages]
    names = [str(stage) for stage, _, _ in stages]
    figure.legend(lines, names, loc="outside lower center", ncols=len(lines), frameon=False)
    return figure


def ranking_figure(dataset: xr.Dataset) -> Figure:
    """Return the sources whose observation alone helps most, and the error after each one that was chosen."""
    values = dataset["criterion_alone"].values
    base = str(dataset.attrs["release"]) or "now"  # the stage that new observations are added to
    now = float(dataset["criterion"].values[dataset["stage"].values.tolist().index(base)])
    number = len(_places_of_goal(dataset))
    gain = 1.0 - (values / now if dataset.attrs["criterion"] == "A" else np.exp(0.5 * (values - now) / number))
    if not np.any(gain > 0.0):
        raise SweepError("no ranking here: no new observation, so no source helps; give --add with epochs")
    order = np.argsort(-np.nan_to_num(gain, nan=-1.0))[:RANKED][::-1]
    chosen = [str(name) for name in dataset["step_source"].values[1:]] if "step_source" in dataset else []
    height = 1.6 + 0.2 * len(order)
    stacked = bool(chosen) and is_stacked()
    width, _ = figure_size(9.6 if chosen else 5.6, height)
    figure = Figure(figsize=(width, height + (2.6 if stacked else 0.0)), layout="constrained")
    shape = {"nrows": 2, "height_ratios": (height, 2.6)} if stacked else {"ncols": 2 if chosen else 1}
    grid = figure.subplots(**shape, squeeze=False).ravel()
    names = [str(name) for name in dataset["source"].values[order]]
    colours = [COLOURS[1] if name in chosen else COLOURS[0] for name in names]
    grid[0].barh(range(len(order)), 100.0 * gain[order], 0.75, color=colours)
    grid[0].set_yticks(range(len(order)), names, fontsize=7)
    grid[0].set_ylim(-0.6, len(order) - 0.4)
    grid[0].tick_params(axis="y", length=0.0)
    grid[0].set_xlabel(f"error of {dataset.attrs['goal']} less by [%]\nif this source alone is observed")
    if chosen:
        grid[0].set_title("orange: chosen")
        _draw_steps(grid[1], dataset, chosen)
    for axes in grid:
        finish(axes)
    return figure


def _draw_steps(axes: Axes, dataset: xr.Dataset, chosen: list[str]) -> None:
    errors, symbols = dataset["step_error"].values, unknown_symbols(dataset)
    for number, k in enumerate(_places_of_goal(dataset)[: len(COLOURS)]):
        axes.plot(errors[:, k] / errors[0, k], label=symbols[k], **series(number), **CURVE)
    axes.set_xticks(range(len(chosen) + 1), ["none", *chosen], rotation=90, fontsize=7)
    axes.set_xlabel("observed, one after the other")
    axes.set_ylabel("error relative to none")
    axes.legend(loc=BEST, frameon=False)


def _places_of_goal(dataset: xr.Dataset) -> NDArray[np.intp]:
    """Return the places of the unknowns that observations are chosen for."""
    goal = [name.strip() for name in str(dataset.attrs["goal"]).split(",")]
    return np.flatnonzero(np.isin(dataset["block"].values, goal))
