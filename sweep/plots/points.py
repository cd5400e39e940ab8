"""Points without an order: those of a table or a design over each parameter, in pairs and as curves, and the kept
samples of a single point.
"""

from collections.abc import Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from scipy.special import chdtri

from linksweep.sweep import formatting
from linksweep.sweep.analysis import quantity
from linksweep.sweep.contract import Array, SweepError, shown, suggest
from linksweep.sweep.plots import GridFigure, grid, style
from linksweep.sweep.studies.study import POINT

MOST_PARAMETERS, MOST_PAIRED, MOST_ACROSS = 12, 8, 4
FEW_CURVES = 12  # up to this many curves are drawn one by one

# Two quantiles over the points, the opacity of the band between them, and its name.
BANDS = ((0.05, 0.95, 0.15, "90 % of the points"), (0.25, 0.75, 0.3, "50 % of the points"))


# A table or a design


def _points_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure with a row for each variable and a column for each parameter: all, or those in ``over``.  With
    one variable, many parameters take several rows.
    """
    parameters = _parameters(dataset, over, MOST_PARAMETERS)
    several = len(variables) > 1
    across = len(parameters) if several else min(len(parameters), MOST_ACROSS)
    down = len(variables) if several else -(-len(parameters) // across)
    size = (5.2, 4.2) if across * down == 1 else (1.0 + 2.6 * across, 0.8 + 2.4 * down)
    least, share = (1.0, "row") if several else (style.PANEL_WIDTH, True)
    figure, panels = style.new_figure(*size, down, across, least, sharey=share)
    pairs = list(product(variables, parameters))
    for axes, (variable, parameter) in zip(panels, pairs, strict=False):
        grid.draw_lines(axes, dataset, variable, parameter, {})
        axes.set_label(variable)  # for the caption
        axes.set_ylabel(style.quantity_label(dataset, variable) if axes.get_subplotspec().is_first_col() else "")
    for axes in panels[len(pairs) :]:
        axes.remove()
    style.legend(figure)
    return figure


def _pairs_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure of parameters in pairs, coloured by a variable."""
    variable, parameters = variables[0], _parameters(dataset, over, MOST_PAIRED)
    further = [str(d) for d in dataset[variable].dims if d != POINT and dataset.sizes[d] > 1]
    if further or len(parameters) < 2:
        raise SweepError(
            f"pairs need two parameters and one value a point; fix {', '.join(further)} with --at AXIS=VALUE"
        )
    across, up = parameters[:-1], parameters[1:]
    figure, panels = style.new_figure(
        2.4 + 1.7 * len(across), 1.2 + 1.6 * len(up), len(up), len(across), least=1.0, sharex="col", sharey="row"
    )
    values = dataset[variable].squeeze().values.astype(float)
    known = np.flatnonzero(np.isfinite(values))
    order = known[np.argsort(np.abs(values[known] - np.median(values[known])))]  # extremes on top
    dots: dict[str, Any] = {"c": values[order], "cmap": "cividis", "norm": grid.colour_limits(dataset[variable])}
    dots |= {"s": 10.0 if len(values) <= grid.FEW_POINTS else 4.0, "linewidths": 0.0}
    for axes, (row, column) in zip(panels, np.ndindex(len(up), len(across)), strict=True):
        if column > row:
            axes.set_visible(False)
            continue
        x, y = (grid.positions(axes, dataset, name, which) for name, which in ((across[column], "x"), (up[row], "y")))
        drawn = axes.scatter(x[order], y[order], rasterized=len(values) > grid.MOST_VECTORS, **dots)
        axes.set_xlabel(style.label(dataset[across[column]], across[column]) if row == len(up) - 1 else "")
        axes.set_ylabel(style.label(dataset[up[row]], up[row]) if column == 0 else "")
        axes.set_label(variable)  # for the caption
    text = style.quantity_label(dataset, variable)
    style.add_bar(figure, drawn, dataset[variable], text, ax=panels[len(across) - 1 :: len(across)], shrink=0.7)
    return figure


def _curves_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    axis = grid.one_axis(dataset, variables[0], over)
    figure = grid.draw_panels(dataset, variables, grid.Layout(), partial(_draw_curves, over=axis))
    style.legend(figure)
    return figure


def _draw_curves(axes: Axes, dataset: xr.Dataset, variable: str, over: str) -> None:
    """Draw a variable of points along a dimension of its own, one colour for every combination of the others: the
    median and bands of many points, or the curve of each of a few.
    """
    along, array, x = str(dataset[over].dims[0]), dataset[variable], dataset[over].values.astype(float)
    for number, (words, one) in enumerate(grid.series_of(dataset, variable, POINT, along)):
        y = one[variable].transpose(POINT, along).values.astype(float)
        y, colour = y[np.isfinite(y).any(axis=1)], style.COLOURS[number]
        if array.sizes[POINT] <= FEW_CURVES:
            labels = [words, *[""] * (len(y) - 1)]  # alone, the curves are what the axis says
            axes.plot(x, y.T, color=colour, linewidth=0.9, alpha=0.8, label=labels)
            continue
        for low, high, opacity, name in BANDS:
            band: dict[str, Any] = {"color": colour, "alpha": opacity, "linewidth": 0.0, "label": "" if words else name}
            axes.fill_between(x, *np.nanquantile(y, (low, high), axis=0), **band)
        middle = words or f"median of {len(y):,} points"
        axes.plot(x, np.nanmedian(y, axis=0), color=colour, linewidth=1.4, label=middle)
    style.fit_scale(axes, "x", dataset[over])
    style.fit_scale(axes, "y", array)
    axes.set(xlabel=style.label(dataset[over], over), ylabel=style.quantity_label(dataset, variable))


def _parameters(dataset: xr.Dataset, over: Sequence[str], most: int) -> list[str]:
    """Return the parameters asked for, or all in which the points differ; raises SweepError for more than ``most``."""
    known = quantity.varied_parameters(dataset)
    if unknown := [name for name in over if name not in known]:
        raise SweepError(f"the points do not differ in {shown(unknown[0])}{suggest(unknown[0], known)}")
    chosen = list(over) or known
    if len(chosen) > most:
        raise SweepError(
            f"{len(chosen)} parameters are too many for one picture, at most {most}; choose some with --over: "
            f"{', '.join(chosen)}"
        )
    return chosen


# Kept samples


def sampled(dataset: xr.Dataset) -> str | None:
    """Return the variable with the kept samples of several components; None if there is none."""
    known = {"sample", *dataset["status"].dims}
    names = [str(n) for n, v in dataset.data_vars.items() if "sample" in v.dims and set(v.dims) - known]
    return names[0] if names else None


def _scatter_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure of the samples of two components at one point: those in ``over``, or the first two in the unit of
    the main quantity, or the first two.
    """
    variable = sampled(dataset)
    if variables or variable is None:
        raise SweepError("a scatter is of kept samples, not of a variable; choose its two components with --over")
    if dataset["status"].ndim:
        left = ", ".join(f"{d} ({dataset.sizes[d]})" for d in dataset["status"].dims)
        raise SweepError(f"a scatter is of one point; choose it with --at AXIS=VALUE: {left}")
    dimension = next(str(d) for d in dataset[variable].dims if d != "sample")
    known = dataset[dimension].values.tolist()
    if unknown := [name for name in over if name not in known]:
        raise SweepError(f"{shown(unknown[0])} is no component of {variable}{suggest(unknown[0], known)}")
    if over and len(set(over)) != 2:
        raise SweepError(f"a scatter needs two components, of {', '.join(known)}; not {', '.join(over)}")
    units = dict.fromkeys(known, "")
    if f"{dimension}_unit" in dataset.coords:
        units = dict(zip(known, dataset[f"{dimension}_unit"].values.tolist(), strict=True))
    main = dataset[quantity.main_quantity(dataset)].attrs if quantity.quantities(dataset) else {}
    alike = [name for name in known if units[name] == main.get("units")]
    chosen = list(over or (alike if len(alike) > 1 else known)[:2])
    figure, (axes,) = style.new_figure(5.2, 4.8)
    _draw_samples(axes, dataset, variable, {name: units[name] for name in chosen}, dimension)
    return figure


def _draw_samples(axes: Axes, dataset: xr.Dataset, variable: str, components: dict[str, str], dimension: str) -> None:
    """Draw the samples of two components, given with their units, against each other, with ellipses of 68 and 95 % of a
    normal distribution.

    Where the dataset has a ``bias``, the truth (mean estimate - bias) is a cross.  The standard deviations stand above
    the legend with their errors, sigma/sqrt(2 n).
    """
    names, units = list(components), list(components.values())
    both = np.stack([dataset[variable].sel({dimension: name}).values.astype(float) for name in names])
    both = both[:, np.isfinite(both).all(axis=0)]
    n = both.shape[1]
    if n < 3:
        raise SweepError(f"{variable} has {n} samples here; at least 3 are needed")
    factor = 1.0
    if units[0] == units[1]:
        unit, factor = formatting.prefixed(both.std(axis=1), units[0])
        units = [unit, unit]
        axes.set_aspect("equal", adjustable="datalim")
    both *= factor
    mean, covariance = both.mean(axis=1), np.cov(both)
    sigma = np.sqrt(np.diag(covariance))
    dots: dict[str, Any] = {"color": style.COLOURS[0], "markeredgewidth": 0.0, "alpha": 0.35, "rasterized": True}
    dots["markersize"] = float(np.clip(100.0 / np.sqrt(n), 2.0, 5.0))
    axes.plot(*both, ".", label=f"{n} estimates", **dots)
    for confidence, line in ((0.683, "solid"), (0.954, "dashed")):
        share = f"{100 * confidence:.0f} % of their normal law"
        ellipse = confidence_ellipse(mean, covariance, confidence, linestyle=line, label=share)
        axes.add_patch(ellipse).set_edgecolor(style.COLOURS[1])
    axes.errorbar(*mean, *(sigma / np.sqrt(n))[::-1], label="mean", **style.marks(1, 3.0))
    if "bias" in dataset and dimension in dataset["bias"].dims:
        truth = mean - [factor * dataset["bias"].sel({dimension: name}).item() for name in names]
        axes.plot(*truth, "x", color="black", label="truth", markersize=9.0, markeredgewidth=1.4)
    axes.set_xlabel(style.label(dataset[variable], names[0], units[0]))
    axes.set_ylabel(style.label(dataset[variable], names[1], units[1]))
    words = [
        rf"$\sigma$({style.symbol(name)}) = {formatting.with_error(s, s / np.sqrt(2 * n))} {formatting.written(unit)}"
        for name, s, unit in zip(names, sigma, units, strict=True)
    ]
    title = "\n".join([*words, rf"correlation ${covariance[0, 1] / np.prod(sigma):+.2f}$"])
    style.legend(axes.figure, below=True, title=title)  # type: ignore[arg-type]


def confidence_ellipse(centre: Array, covariance: Array, confidence: float, **look: Any) -> Ellipse:
    """Return the ellipse that holds a share ``confidence`` of a normal distribution of two numbers."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2.0 * np.sqrt(np.maximum(values, 0.0) * chdtri(2, 1.0 - confidence))
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    return Ellipse((centre[0], centre[1]), width, height, angle=angle, fill=False, linewidth=1.2, **look)


def _has_points(dataset: xr.Dataset, variable: str) -> bool:
    return POINT in dataset[variable].dims and bool(quantity.varied_parameters(dataset))


POINTS = GridFigure(_has_points, _points_figure)
PAIRS = GridFigure(lambda d, name: _has_points(d, name) and len(quantity.varied_parameters(d)) > 1, _pairs_figure)
CURVES = GridFigure(lambda d, name: _has_points(d, name) and bool(quantity.numeric_axes(d, name)), _curves_figure)
SCATTER = GridFigure(lambda dataset, variable: sampled(dataset) is not None, _scatter_figure)
