"""The figures of a study's results, by kind: whole figures with their panels, without a title."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import xarray as xr
from matplotlib.figure import Figure

from linksweep.sweep.analysis.quantity import main_quantity, numeric_axes, quantities, require_axis, varied_parameters
from linksweep.sweep.analysis.readable_units import in_readable_units
from linksweep.sweep.contract import SweepError, shown, suggest
from linksweep.sweep.plots.law import draw_law
from linksweep.sweep.plots.layout import Layout, arrange
from linksweep.sweep.plots.legends import legend_below
from linksweep.sweep.plots.lines import draw_lines, draw_point
from linksweep.sweep.plots.maps import accuracy_in_words, add_bar, colour_limits, draw_map
from linksweep.sweep.plots.panels import draw_panels
from linksweep.sweep.plots.points import draw_curves, pairs_figure, points_figure
from linksweep.sweep.plots.scatter import component_dimension, draw_scatter, sampled
from linksweep.sweep.plots.style import figure_size, is_narrow, is_stacked, line_inches, wanted_width, wrapped
from linksweep.sweep.studies.study import POINT

BELOW_LINES, BELOW_LINE_INCHES = 12, 0.2
"""Lines of text below a narrow scatter, and the height of each for which the figure has room."""

POINT_LINES = 13
"""The least height of the figure of one point, in lines of text."""


class GridFigure(NamedTuple):
    """A kind of figure: whether a quantity of a dataset can have it, and the function that draws it."""

    possible: Callable[[xr.Dataset, str], bool]
    draw: Callable[[xr.Dataset, list[str], Sequence[str]], Figure]


def _lines(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    if all(dataset[name].size == 1 for name in variables) and not over:
        figure = draw_panels(dataset.squeeze(), variables, Layout(), draw_point, rows_named=True)
        width, height = figure.get_size_inches().tolist()
        figure.set_size_inches(width, max(min(height, 1.0 + 0.3 * width), POINT_LINES * line_inches()))
        return figure
    axis = _one_axis(dataset, variables[0], over)
    layout = arrange(dataset, variables[0], (str(dataset[axis].dims[0]),))
    return draw_panels(dataset, variables, layout, partial(draw_lines, over=axis, numbers={}))


def _law(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    if len(variables) > 1:
        raise SweepError(f"a law is drawn for one variable, not for {', '.join(variables)}")
    axis = require_axis(dataset, variables[0], (list(over) or numeric_axes(dataset, variables[0]))[0])
    layout = arrange(dataset, variables[0], (str(dataset[axis].dims[0]),))
    if layout.rows or (layout.columns and not layout.far):
        raise SweepError("a law is drawn for one further dimension at most; fix others with --at AXIS=VALUE")
    figure = Figure(figsize=figure_size(6.4, 8.0 if is_narrow() else 5.2), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2 if is_narrow() else 3, 1))
    draw_law(upper, lower, in_readable_units(dataset), variables[0], axis)
    if layout.columns or layout.series or is_narrow():
        legend_below(figure)
    return figure


def _map(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    if len(variables) > 1:
        raise SweepError(f"a map is drawn for one variable, not for {', '.join(variables)}")
    numeric = numeric_axes(dataset, variables[0])
    chosen = list(over) or _two_axes(dataset, variables[0])
    for axis in chosen:
        require_axis(dataset, variables[0], axis)
    if len(chosen) != 2 or len({dataset[axis].dims[0] for axis in chosen}) != 2:
        raise SweepError(
            f"a map needs two axes that are crossed, of {', '.join(numeric)}; not {', '.join(chosen) or 'none'}"
        )
    layout = arrange(dataset, variables[0], tuple(str(dataset[axis].dims[0]) for axis in chosen), series=False)
    x, y = chosen
    readable = in_readable_units(dataset)
    limits = colour_limits(readable, variables[0])
    figure = draw_panels(readable, variables, layout, partial(draw_map, x=x, y=y, limits=limits), one_unit=True)
    add_bar(figure, readable, variables[0])
    if words := accuracy_in_words(dataset, variables[0]):
        text = wrapped(words, figure)
        if wanted_width() is not None:  # the panels keep their height
            figure.set_figheight(figure.get_figheight() + (1 + text.count("\n")) * line_inches())
        figure.supxlabel(text, fontsize="medium")
    return figure


def _scatter(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    if variables:
        raise SweepError("a scatter is of kept samples, not of a variable; choose its two components with --over")
    variable = sampled(dataset)
    assert variable is not None, "asked for before"
    if dataset["status"].ndim:
        left = ", ".join(f"{d} ({dataset.sizes[d]})" for d in dataset["status"].dims)
        raise SweepError(f"a scatter is of one point; choose it with --at AXIS=VALUE: {left}")
    dimension = component_dimension(dataset, variable)
    known = dataset[dimension].values.tolist()
    if unknown := [name for name in over if name not in known]:
        raise SweepError(f"{shown(unknown[0])} is no component of {variable}{suggest(unknown[0], known)}")
    if over and len(set(over)) != 2:
        raise SweepError(f"a scatter needs two components, of {', '.join(known)}; not {', '.join(over)}")
    one, other = over or _two_components(dataset, dimension)
    narrow = is_stacked()
    figure = Figure(figsize=figure_size(*((4.4, 6.4) if narrow else (7.4, 4.4))), layout="constrained")
    if narrow:
        figure.set_figheight(figure.get_figheight() + BELOW_LINES * (line_inches() - BELOW_LINE_INCHES))
    draw_scatter(figure.add_subplot(), dataset, variable, (one, other), below=narrow)
    return figure


def _one_axis(dataset: xr.Dataset, variable: str, over: Sequence[str]) -> str:
    """Return the axis to draw along: the one asked for, or the longest numeric one, or the longest."""
    axes = [str(n) for n, c in dataset.coords.items() if c.ndim == 1 and c.dims[0] in _ordered(dataset)]
    axes += [name for name in numeric_axes(dataset, variable) if name not in axes]
    if over:
        if len(over) > 1 or over[0] not in axes:
            raise SweepError(f"{', '.join(over)} is not one axis to draw along; there are {', '.join(axes)}")
        return over[0]
    return (numeric_axes(dataset, variable) or sorted(axes, key=lambda n: -dataset[n].size))[0]


def _two_axes(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return the two longest axes that do not share a dimension, in the order of the variable's dimensions: those of
    the grid, then its own.
    """
    found: dict[str, str] = {}
    for axis in numeric_axes(dataset, variable):
        found.setdefault(str(dataset[axis].dims[0]), axis)
    order = [str(d) for d in dataset[variable].dims]
    return sorted(list(found.values())[:2], key=lambda axis: order.index(str(dataset[axis].dims[0])))


def _two_components(dataset: xr.Dataset, dimension: str) -> tuple[str, str]:
    """Return the first two components in the unit of the main quantity, or the first two."""
    known = dataset[dimension].values.tolist()
    units = f"{dimension}_unit"
    if units in dataset.coords and quantities(dataset):
        wanted = dataset[main_quantity(dataset)].attrs.get("units")
        same = [name for name, unit in zip(known, dataset[units].values.tolist(), strict=True) if unit == wanted]
        known = same if len(same) > 1 else known
    return str(known[0]), str(known[1])


def _ordered(dataset: xr.Dataset) -> list[str]:
    """Return the dimensions of the grid, except that of a table of points."""
    return [str(d) for d in dataset["status"].dims if d != POINT]


def _curves(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    axis = _one_axis(dataset, variables[0], over)
    return draw_panels(dataset, variables, Layout(), partial(draw_curves, over=axis))


def _has_points(dataset: xr.Dataset, variable: str) -> bool:
    return POINT in dataset[variable].dims and bool(varied_parameters(dataset))


LINES = GridFigure(lambda dataset, variable: bool(_ordered(dataset) or numeric_axes(dataset, variable)), _lines)
POINTS = GridFigure(_has_points, points_figure)
PAIRS = GridFigure(lambda d, name: _has_points(d, name) and len(varied_parameters(d)) > 1, pairs_figure)
CURVES = GridFigure(lambda d, name: _has_points(d, name) and bool(numeric_axes(d, name)), _curves)
LAW = GridFigure(lambda dataset, variable: bool(numeric_axes(dataset, variable)), _law)
MAP = GridFigure(lambda dataset, variable: len({dataset[a].dims[0] for a in numeric_axes(dataset, variable)}) > 1, _map)
SCATTER = GridFigure(lambda dataset, variable: sampled(dataset) is not None, _scatter)
