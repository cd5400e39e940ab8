"""Points of a table or a design, which have no order: a quantity over each parameter, parameters in pairs, and the
curve of each point.
"""

import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from linksweep.sweep.analysis.quantity import standard_error, varied_parameters
from linksweep.sweep.analysis.selection import places_along
from linksweep.sweep.contract import SweepError, shown, suggest
from linksweep.sweep.plots.labels import label, quantity_label, value_text
from linksweep.sweep.plots.legends import legend
from linksweep.sweep.plots.scales import fit_bar, fit_scale, is_logarithmic
from linksweep.sweep.plots.style import COLOURS, figure_size, finish, in_lines, most_columns, series
from linksweep.sweep.studies.study import POINT

MOST_PARAMETERS = 12
MOST_PAIRED = 8
NAME_INCHES = 1.1
"""The most room for a name at the left of a panel; a longer one is broken into lines."""

MOST_ACROSS = 4

FEW_POINTS = 300
"""More points than this are drawn small and without errors."""

FEW_CURVES = 12
"""Up to this many curves are drawn one by one."""

BANDS = ((0.05, 0.95, 0.15, "90 % of the points"), (0.25, 0.75, 0.3, "50 % of the points"))
"""Two quantiles over the points, the opacity of the band between them, and its name."""

SPREAD, GOLDEN = 0.5, 0.6180339887498949
"""Width over which points of one text are spread, and the step as a share of it, which keeps them apart."""

MOST_VECTORS = 2000
"""More points than this are drawn as one image."""


def points_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure with a row for each variable and a column for each parameter: all, or those in ``over``.  With
    one variable, many parameters take several rows.

    Raises SweepError for a variable whose dimensions give too many series, and for unknown or too many parameters.
    """
    parameters = _parameters(dataset, over, MOST_PARAMETERS)
    across = len(parameters) if len(variables) > 1 else min(len(parameters), most_columns(MOST_ACROSS))
    down = len(variables) if len(variables) > 1 else math.ceil(len(parameters) / across)
    size = (5.2, 4.2) if across * down == 1 else (1.0 + 2.6 * across, 0.8 + 2.4 * down)
    figure = Figure(figsize=figure_size(*size), layout="constrained")
    grid = figure.subplots(down, across, sharey="row" if len(variables) > 1 else True, squeeze=False)
    for number, axes in enumerate(grid.flat):
        if number >= len(variables) * len(parameters):
            axes.set_visible(False)
            continue
        variable, parameter = variables[number // len(parameters)], parameters[number % len(parameters)]
        _draw(axes, dataset, variable, parameter)
        axes.set_ylabel(quantity_label(dataset, variable) if number % across == 0 else "")
    handles, texts = grid.flat[0].get_legend_handles_labels()
    if len(texts) > 1 and grid.size > 1:
        figure.legend(handles, texts, loc="outside lower center", ncols=min(len(texts), 6), frameon=False)
    elif len(texts) > 1:
        legend(grid.flat[0])
    return figure


def pairs_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure of parameters in pairs, coloured by a variable; the diagonal has the variable over each one,
    with its axis at the right.

    Raises SweepError for several variables, for one, unknown or too many parameters, and for a variable with further
    dimensions.
    """
    if len(variables) > 1:
        raise SweepError(f"pairs are coloured by one variable, not by {', '.join(variables)}")
    variable, parameters = variables[0], _parameters(dataset, over, MOST_PAIRED)
    if len(parameters) < 2:
        raise SweepError(f"pairs need two parameters; the points differ in {', '.join(parameters)} alone")
    if further := [str(d) for d in dataset[variable].dims if d != POINT and dataset.sizes[d] > 1]:
        raise SweepError(f"pairs are of one value a point; fix {', '.join(further)} with --at AXIS=VALUE")
    n = len(parameters)
    figure = Figure(figsize=(2.4 + 1.7 * n, 1.2 + 1.6 * n), layout="constrained")
    grid = figure.subplots(n, n, sharex="col", squeeze=False)
    values = dataset[variable].squeeze().values.astype(float)
    known = np.isfinite(values)
    norm = (LogNorm if is_logarithmic(dataset[variable]) else Normalize)(values[known].min(), values[known].max())
    order = np.flatnonzero(known)[np.argsort(np.abs(values[known] - np.median(values[known])))]  # extremes on top
    for row, column in np.ndindex(n, n):
        axes: Any = grid[row, column]
        if column > row:
            axes.set_visible(False)
            continue
        x = _places(axes, dataset, parameters[column], "x", few_ticks=True)
        if row == column:
            y = values
            fit_scale(axes, "y", dataset[variable], few_ticks=True)
        else:
            y = _places(axes, dataset, parameters[row], "y", few_ticks=True)
            if column > 0:
                axes.sharey(grid[row, 0])
        shades: dict[str, Any] = {"c": values[order], "cmap": "cividis", "norm": norm, "linewidths": 0.0}
        size = 10.0 if len(x) <= FEW_POINTS else 4.0
        drawn = axes.scatter(x[order], y[order], s=size, rasterized=len(x) > MOST_VECTORS, **shades)
        axes.set_xlabel(label(dataset[parameters[column]], parameters[column]) if row == n - 1 else "")
        finish(axes)
        axes.tick_params(labelleft=column == 0 < row, labelright=row == column, labelbottom=row == n - 1)
        if row == column:  # the variable, unlike the rest of the row: at the right, where no other panel is
            axes.yaxis.set_label_position("right")
            axes.set_ylabel(quantity_label(dataset, variable))
        elif column == 0:
            axes.set_ylabel(label(dataset[parameters[row]], parameters[row]))
        axes.set_label(variable)  # for the caption
    bar = figure.colorbar(drawn, ax=grid[:, -1], label=quantity_label(dataset, variable), shrink=0.7)
    fit_bar(bar, dataset[variable])
    return figure


def draw_curves(axes: Axes, dataset: xr.Dataset, variable: str, over: str) -> None:
    """Draw a variable of points without order along a dimension of its own, one colour for every combination of the
    others: the median and bands of many points, or the curve of each of a few.

    Raises SweepError where the other dimensions leave more combinations than colours.
    """
    along = str(dataset[over].dims[0])
    array = dataset[variable]
    x = dataset[over].values.astype(float)
    many = array.sizes[POINT] > FEW_CURVES
    for number, (place, words) in enumerate(_told_apart(dataset, variable, (POINT, along), f"beside {over}")):
        y = array.isel(place).transpose(POINT, along).values.astype(float)
        y, colour = y[np.isfinite(y).any(axis=1)], COLOURS[number]
        if not many:
            axes.plot(x, y.T, color=colour, linewidth=0.9, alpha=0.8)
            axes.plot([], [], color=colour, label=words or "a point")
            continue
        for low, high, opacity, name in BANDS:
            lower, upper = np.nanquantile(y, (low, high), axis=0)
            axes.fill_between(x, lower, upper, color=colour, alpha=opacity, linewidth=0.0, label="" if words else name)
        middle = words or f"median of {len(y):,} points"
        axes.plot(x, np.nanmedian(y, axis=0), color=colour, linewidth=1.4, label=middle)
    fit_scale(axes, "x", dataset[over])
    fit_scale(axes, "y", array)
    axes.set_xlabel(label(dataset[over], over))
    axes.set_ylabel(quantity_label(dataset, variable))
    finish(axes)
    if many or array.ndim > 2:
        legend(axes)


def _draw(axes: Axes, dataset: xr.Dataset, variable: str, parameter: str) -> None:
    """Draw a variable over a parameter, one colour for every combination of the other dimensions."""
    array = dataset[variable]
    error = standard_error(dataset, variable)
    for number, (place, text) in enumerate(_told_apart(dataset, variable, (POINT,), "at each point")):
        one = dataset.isel(place)
        y = one[variable].values.astype(float)
        x = _places(axes, dataset, parameter, "x")
        size, alpha = (3.0, 0.8) if len(x) <= FEW_POINTS else (2.0, 0.4)
        style = {**series(number), "label": text or variable, "linestyle": "none", "markersize": size, "alpha": alpha}
        style |= {"markeredgewidth": 0.0, "rasterized": len(x) > MOST_VECTORS}
        if error is not None and len(x) <= FEW_POINTS:
            axes.errorbar(x, y, yerr=error.isel(place).values, elinewidth=0.7, **style)
        else:
            axes.plot(x, y, **style)
    fit_scale(axes, "y", array)
    axes.set_label(variable)  # for the caption
    axes.set_xlabel(label(dataset[parameter], parameter))
    finish(axes)


def _told_apart(
    dataset: xr.Dataset, variable: str, along: Collection[str], where: str
) -> list[tuple[dict[str, int], str]]:
    """Return the place of every combination of the dimensions of a variable, except those it is drawn ``along``, each
    with its name; raises SweepError if there are more of them than colours.
    """
    array = dataset[variable]
    others = [str(d) for d in array.dims if d not in along]
    places = list(places_along(array, others))
    if len(places) > len(COLOURS):
        sizes = ", ".join(f"{d} ({array.sizes[d]})" for d in others)
        raise SweepError(f"{variable} has {sizes} {where}, too many to tell apart; fix some with --at AXIS=VALUE")
    named = [d for d in others if d in dataset.coords]
    return [(place, ", ".join(value_text(dataset, d, dataset[d][place[d]].item()) for d in named)) for place in places]


def _places(
    axes: Axes, dataset: xr.Dataset, parameter: str, which: str, few_ticks: bool = False
) -> NDArray[np.float64]:
    """Return the positions of the values of a parameter on an axis, and set its scale and ticks; values that are not
    numbers are spread a little, so that points do not hide each other.
    """
    array = dataset[parameter]
    if array.dtype.kind in "if":
        fit_scale(axes, which, array, few_ticks)
        return np.asarray(array.values.astype(float))
    names = sorted(set(map(str, array.values.tolist())))
    if which == "x":
        axes.set_xticks(range(len(names)), names)
    else:
        axes.set_yticks(range(len(names)), [in_lines(name, NAME_INCHES, 1) for name in names])
    (axes.set_xlim if which == "x" else axes.set_ylim)(-0.5, len(names) - 0.5)
    place = {name: float(k) for k, name in enumerate(names)}
    spread = SPREAD * (np.arange(array.size) * GOLDEN % 1.0 - 0.5)
    return np.asarray(np.array([place[str(value)] for value in array.values.tolist()]) + spread)


def _parameters(dataset: xr.Dataset, over: Sequence[str], most: int) -> list[str]:
    """Return the parameters asked for, or all in which the points differ; raises SweepError for more than ``most``."""
    known = varied_parameters(dataset)
    if unknown := [name for name in over if name not in known]:
        raise SweepError(f"the points do not differ in {shown(unknown[0])}{suggest(unknown[0], known)}")
    chosen = list(over) or known
    if len(chosen) > most:
        raise SweepError(
            f"{len(chosen)} parameters are too many for one picture, at most {most}; choose some with --over: "
            f"{', '.join(chosen)}"
        )
    return chosen
