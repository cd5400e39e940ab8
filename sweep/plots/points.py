"""Points without an order: those of a table or a design over each parameter, in pairs and as curves, and the kept
samples of a single point.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from scipy.special import chdtri

from linksweep.sweep.analysis.quantity import (
    main_quantity,
    numeric_axes,
    quantities,
    standard_error,
    varied_parameters,
)
from linksweep.sweep.contract import Array, SweepError, shown, suggest
from linksweep.sweep.formatting import prefixed, with_error, written
from linksweep.sweep.plots import GridFigure
from linksweep.sweep.plots.grid import colour_limits, one_axis
from linksweep.sweep.plots.panels import Layout, draw_panels, series_of
from linksweep.sweep.plots.style import (
    COLOURS,
    add_bar,
    finish,
    fit_scale,
    in_lines,
    label,
    legend,
    legend_below,
    marks,
    new_figure,
    quantity_label,
    symbol,
    wanted_width,
)
from linksweep.sweep.studies.study import POINT

MOST_PARAMETERS, MOST_PAIRED, MOST_ACROSS = 12, 8, 4
FEW_POINTS = 300  # more points than this are drawn small and without errors
MOST_VECTORS = 2000  # more points than this are drawn as one image
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
    options: dict[str, Any] = {"least": 1.0, "sharey": "row"} if several else {"sharey": True}
    figure, grid = new_figure(*size, down, across, **options)
    pairs = [(variable, parameter) for variable in variables for parameter in parameters]
    for axes, (variable, parameter) in zip(grid, pairs, strict=False):
        _draw_points(axes, dataset, variable, parameter)
        axes.set_ylabel(quantity_label(dataset, variable) if axes.get_subplotspec().is_first_col() else "")
    for axes in grid[len(pairs) :]:
        axes.set_visible(False)
    (legend_below(figure) if len(grid) > 1 else legend(grid[0]))
    return figure


def _draw_points(axes: Axes, dataset: xr.Dataset, variable: str, parameter: str) -> None:
    """Draw a variable over a parameter, one colour for every combination of the other dimensions."""
    x, few = _positions(axes, dataset, parameter, "x"), dataset.sizes[POINT] <= FEW_POINTS
    for number, (name, one) in enumerate(series_of(dataset, variable, POINT)):
        y, error = one[variable].values.astype(float), standard_error(one, variable) if few else None
        size, alpha = (3.0, 0.8) if few else (2.0, 0.4)
        style = marks(number, size, alpha=alpha, markeredgewidth=0.0, rasterized=len(x) > MOST_VECTORS)
        style["label"] = name or variable
        if error is None:
            axes.plot(x, y, **style)
        else:
            axes.errorbar(x, y, yerr=error.values, elinewidth=0.7, **style)
    fit_scale(axes, "y", dataset[variable])
    axes.set_label(variable)  # for the caption
    axes.set_xlabel(label(dataset[parameter], parameter))
    finish(axes)


def _pairs_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure of parameters in pairs, coloured by a variable; the diagonal has the variable over each one,
    with its axis at the right.
    """
    if len(variables) > 1:
        raise SweepError(f"pairs are coloured by one variable, not by {', '.join(variables)}")
    variable, parameters = variables[0], _parameters(dataset, over, MOST_PAIRED)
    if len(parameters) < 2:
        raise SweepError(f"pairs need two parameters; the points differ in {', '.join(parameters)} alone")
    if further := [str(d) for d in dataset[variable].dims if d != POINT and dataset.sizes[d] > 1]:
        raise SweepError(f"pairs are of one value a point; fix {', '.join(further)} with --at AXIS=VALUE")
    n, text = len(parameters), quantity_label(dataset, variable)
    figure = Figure(figsize=(2.4 + 1.7 * n, 1.2 + 1.6 * n), layout="constrained")
    grid = figure.subplots(n, n, sharex="col", squeeze=False)
    values = dataset[variable].squeeze().values.astype(float)
    known = np.flatnonzero(np.isfinite(values))
    order = known[np.argsort(np.abs(values[known] - np.median(values[known])))]  # extremes on top
    dots: dict[str, Any] = {"c": values[order], "cmap": "cividis", "norm": colour_limits(dataset[variable])}
    dots |= {
        "s": 10.0 if len(values) <= FEW_POINTS else 4.0,
        "linewidths": 0.0,
        "rasterized": len(values) > MOST_VECTORS,
    }
    for row, column in np.ndindex(n, n):
        axes: Any = grid[row, column]
        if column > row:
            axes.set_visible(False)
            continue
        x, y = _positions(axes, dataset, parameters[column], "x", few_ticks=True), values
        if row == column:
            fit_scale(axes, "y", dataset[variable], few_ticks=True)
        else:
            y = _positions(axes, dataset, parameters[row], "y", few_ticks=True)
            if column > 0:
                axes.sharey(grid[row, 0])
        drawn = axes.scatter(x[order], y[order], **dots)
        axes.set_xlabel(label(dataset[parameters[column]], parameters[column]) if row == n - 1 else "")
        finish(axes)
        axes.tick_params(labelleft=column == 0 < row, labelright=row == column, labelbottom=row == n - 1)
        if row == column:  # the variable, unlike the rest of the row: at the right, where no other panel is
            axes.yaxis.set_label_position("right")
            axes.set_ylabel(text)
        elif column == 0:
            axes.set_ylabel(label(dataset[parameters[row]], parameters[row]))
        axes.set_label(variable)  # for the caption
    add_bar(figure, drawn, dataset[variable], text, ax=grid[:, -1], shrink=0.7)
    return figure


def _curves_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    axis = one_axis(dataset, variables[0], over)
    return draw_panels(dataset, variables, Layout(), partial(_draw_curves, over=axis))


def _draw_curves(axes: Axes, dataset: xr.Dataset, variable: str, over: str) -> None:
    """Draw a variable of points along a dimension of its own, one colour for every combination of the others: the
    median and bands of many points, or the curve of each of a few.
    """
    along, array, x = str(dataset[over].dims[0]), dataset[variable], dataset[over].values.astype(float)
    many = array.sizes[POINT] > FEW_CURVES
    for number, (words, one) in enumerate(series_of(dataset, variable, POINT, along)):
        y = one[variable].transpose(POINT, along).values.astype(float)
        y, colour = y[np.isfinite(y).any(axis=1)], COLOURS[number]
        if not many:
            axes.plot(x, y.T, color=colour, linewidth=0.9, alpha=0.8)
            axes.plot([], [], color=colour, label=words or "a point")
            continue
        for low, high, opacity, name in BANDS:
            band: dict[str, Any] = {"color": colour, "alpha": opacity, "linewidth": 0.0, "label": "" if words else name}
            axes.fill_between(x, *np.nanquantile(y, (low, high), axis=0), **band)
        middle = words or f"median of {len(y):,} points"
        axes.plot(x, np.nanmedian(y, axis=0), color=colour, linewidth=1.4, label=middle)
    fit_scale(axes, "x", dataset[over])
    fit_scale(axes, "y", array)
    axes.set(xlabel=label(dataset[over], over), ylabel=quantity_label(dataset, variable))
    finish(axes)
    if many or array.ndim > 2:
        legend(axes)


def _positions(axes: Axes, dataset: xr.Dataset, parameter: str, which: str, few_ticks: bool = False) -> Array:
    """Return the positions of the values of a parameter on an axis, and set its scale and ticks; values that are not
    numbers are spread a little, so that points do not hide each other.
    """
    array = dataset[parameter]
    if array.dtype.kind in "if":
        fit_scale(axes, which, array, few_ticks)
        return np.asarray(array.values.astype(float))
    names, index = np.unique([str(value) for value in array.values.tolist()], return_inverse=True)
    short = [in_lines(str(name), 1.1, 1) if which == "y" else str(name) for name in names]  # in inches
    axes.set(
        **{f"{which}ticks": range(len(names)), f"{which}ticklabels": short, f"{which}lim": (-0.5, len(names) - 0.5)}
    )
    golden = 0.6180339887498949  # steps of this share of the width keep neighbours apart
    return np.asarray(index + 0.5 * (np.arange(array.size) * golden % 1.0 - 0.5))


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
    if variables:
        raise SweepError("a scatter is of kept samples, not of a variable; choose its two components with --over")
    variable = sampled(dataset)
    assert variable is not None, "asked for before"
    if dataset["status"].ndim:
        left = ", ".join(f"{d} ({dataset.sizes[d]})" for d in dataset["status"].dims)
        raise SweepError(f"a scatter is of one point; choose it with --at AXIS=VALUE: {left}")
    dimension = next(str(d) for d in dataset[variable].dims if d != "sample")
    known = dataset[dimension].values.tolist()
    if unknown := [name for name in over if name not in known]:
        raise SweepError(f"{shown(unknown[0])} is no component of {variable}{suggest(unknown[0], known)}")
    if over and len(set(over)) != 2:
        raise SweepError(f"a scatter needs two components, of {', '.join(known)}; not {', '.join(over)}")
    units = (
        dict(zip(known, dataset[f"{dimension}_unit"].values.tolist(), strict=True))
        if f"{dimension}_unit" in dataset.coords
        else {}
    )
    wanted = dataset[main_quantity(dataset)].attrs.get("units") if quantities(dataset) else None
    alike = [name for name in known if units.get(name) == wanted]
    one, other = over or (alike if len(alike) > 1 else known)[:2]
    narrow = (wanted_width() or 6.0) < 6.0  # the numbers stand below the picture, not beside it
    figure, (axes,) = new_figure(*((4.4, 6.4) if narrow else (7.4, 4.4)))
    _draw_samples(axes, dataset, variable, {name: units.get(name, "") for name in (one, other)}, dimension, narrow)
    return figure


def _draw_samples(
    axes: Axes, dataset: xr.Dataset, variable: str, components: dict[str, str], dimension: str, below: bool
) -> None:
    """Draw the samples of two components, given with their units, against each other, with ellipses of 68 and 95 % of a
    normal distribution.

    Where the dataset has a ``bias``, the truth (mean estimate - bias) is a cross.  The standard deviations stand in the
    legend with their errors, sigma/sqrt(2 n), beside the picture or ``below`` it.
    """
    names, units = list(components), list(components.values())
    both = np.stack([dataset[variable].sel({dimension: name}).values.astype(float) for name in names])
    both = both[:, np.isfinite(both).all(axis=0)]
    n = both.shape[1]
    if n < 3:
        raise SweepError(f"{variable} has {n} samples here; at least 3 are needed")
    factor = 1.0
    if units[0] == units[1]:
        chosen = prefixed(both.std(axis=1), units[0])
        factor, units = chosen.factor, [chosen.unit] * 2
        axes.set_aspect("equal", adjustable="datalim")
    both *= factor
    mean, covariance = both.mean(axis=1), np.cov(both)
    sigma = np.sqrt(np.diag(covariance))
    size = float(np.clip(100.0 / np.sqrt(n), 2.0, 5.0))
    dots: dict[str, Any] = {"color": COLOURS[0], "markersize": size, "markeredgewidth": 0.0, "alpha": 0.35}
    axes.plot(*both, ".", rasterized=True, label=f"{n} estimates", **dots)
    for confidence, line in ((0.683, "solid"), (0.954, "dashed")):
        text = f"{100 * confidence:.0f} % of their normal law"
        style = {"edgecolor": COLOURS[1], "linestyle": line, "label": text}
        axes.add_patch(confidence_ellipse(mean, covariance, confidence, **style))
    point: dict[str, Any] = {"color": COLOURS[1], "marker": "o", "markersize": 3.0, "linestyle": "none"}
    error = sigma / np.sqrt(n)
    axes.errorbar(mean[0], mean[1], xerr=error[0], yerr=error[1], label="mean", **point)
    cross = 9.0  # points
    if "bias" in dataset and dimension in dataset["bias"].dims:
        truth = mean - [factor * dataset["bias"].sel({dimension: name}).item() for name in names]
        axes.plot(*truth, "x", markersize=cross, markeredgewidth=1.4, color="black", label="truth")
    axes.set_xlabel(label(dataset[variable], names[0], units[0]))
    axes.set_ylabel(label(dataset[variable], names[1], units[1]))
    finish(axes)
    words = [
        rf"$\sigma$({symbol(name)}) = {with_error(s, s / np.sqrt(2 * n))} {written(unit)}"
        for name, s, unit in zip(names, sigma, units, strict=True)
    ]
    words.append(rf"correlation ${covariance[0, 1] / np.prod(sigma):+.2f}$")
    place = {"loc": "upper left", "bbox_to_anchor": (-0.3, -0.2) if below else (1.0, 1.0), "alignment": "left"}
    legend(axes, title="\n".join(words), markerscale=1.5, **place)
    for handle in axes.findobj(lambda artist: isinstance(artist, Line2D) and artist.get_label() == "truth"):
        handle.set(markersize=cross)  # in the legend too: larger, it would not fit in its line


def confidence_ellipse(centre: Array, covariance: Array, confidence: float, **style: Any) -> Ellipse:
    """Return the ellipse that holds a share ``confidence`` of a normal distribution of two numbers."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2.0 * np.sqrt(np.maximum(values, 0.0) * chdtri(2, 1.0 - confidence))
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    return Ellipse((centre[0], centre[1]), width, height, angle=angle, fill=False, linewidth=1.2, **style)


def _has_points(dataset: xr.Dataset, variable: str) -> bool:
    return POINT in dataset[variable].dims and bool(varied_parameters(dataset))


POINTS = GridFigure(_has_points, _points_figure)
PAIRS = GridFigure(lambda d, name: _has_points(d, name) and len(varied_parameters(d)) > 1, _pairs_figure)
CURVES = GridFigure(lambda d, name: _has_points(d, name) and bool(numeric_axes(d, name)), _curves_figure)
SCATTER = GridFigure(lambda dataset, variable: sampled(dataset) is not None, _scatter_figure)
