"""A quantity over the axes of a grid: lines with errors, prediction and published values, a fitted law, and a map."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.ticker import LogLocator, MaxNLocator
from matplotlib.transforms import ScaledTranslation

from linksweep.sweep.analysis.fits import power_law
from linksweep.sweep.analysis.laws import fit_power_law, lines
from linksweep.sweep.analysis.quantity import (
    error_bar,
    in_readable_units,
    numeric_axes,
    prediction_name,
    require_axis,
    standard_error,
)
from linksweep.sweep.contract import Array, SweepError
from linksweep.sweep.formatting import is_truth, units_of, with_error, with_micro_signs, with_unit
from linksweep.sweep.plots import GridFigure
from linksweep.sweep.plots.panels import Layout, arrange, draw_panels, series_of
from linksweep.sweep.plots.style import (
    BAND,
    COLOURS,
    COMPUTED,
    MOVED,
    PREDICTED,
    PUBLISHED,
    SCALE,
    SIMULATED,
    add_bar,
    axis_label,
    explained_label,
    finish,
    fit_scale,
    grow,
    in_letters,
    in_lines,
    is_logarithmic,
    is_narrow,
    label,
    legend,
    legend_below,
    logarithmic,
    marks,
    new_figure,
    number_text,
    quantity_label,
    series,
    symbol,
    value_text,
)
from linksweep.sweep.studies.study import POINT

OPEN: Mapping[str, Any] = {
    **{"linestyle": "none", "marker": "o", "markersize": 8.0, "fillstyle": "none", "markeredgewidth": 0.9}
}
DASH: Mapping[str, Any] = {"linestyle": "none", "marker": "_", "markeredgewidth": 1.2}
# Dashes of predictions have one of the first two widths, or together the third, in points of print.
NARROWEST_DASH, WIDEST_DASH, ALL_DASHES = 3.0, 10.0, 150.0
# Points closer than the first share of the axis cover each other; if more than the second share do, they are moved
# aside, so many points of print from their places at most.
COVERED, COVERED_SHARE, ASIDE_PT = 0.015, 0.25, 4.5
GUIDE: dict[str, Any] = {"color": "black", "linewidth": 0.8, "linestyle": (0, (4, 3))}

# Labels of what a caption explains; matplotlib leaves labels that begin with _ out of legends.
ERROR_BAND, PREDICTION_BAND, LAW_BAND, JOINED = "_error band", "_prediction band", "_law band", "_joined"


# Lines


def one_axis(dataset: xr.Dataset, variable: str, over: Sequence[str]) -> str:
    """Return the axis to draw along: the one asked for, or the longest numeric one, or the longest."""
    numeric = numeric_axes(dataset, variable)
    axes = [str(n) for n, c in dataset.coords.items() if c.ndim == 1 and c.dims[0] in _ordered(dataset)]
    axes += [name for name in numeric if name not in axes]
    if over:
        if len(over) > 1 or over[0] not in axes:
            raise SweepError(f"{', '.join(over)} is not one axis to draw along; there are {', '.join(axes)}")
        return over[0]
    return (numeric or sorted(axes, key=lambda n: -dataset[n].size))[0]


def _ordered(dataset: xr.Dataset) -> list[str]:
    """Return the dimensions of the grid, except that of a table of points."""
    return [str(d) for d in dataset["status"].dims if d != POINT]


def _lines_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    if all(dataset[name].size == 1 for name in variables) and not over:
        figure = draw_panels(dataset.squeeze(), variables, Layout(), _draw_point, named=True)
        width, height = figure.get_size_inches().tolist()
        figure.set_figheight(max(min(height, 1.0 + 0.3 * width), in_letters(20.0)))
        return figure
    axis = one_axis(dataset, variables[0], over)
    layout = arrange(dataset, variables[0], (str(dataset[axis].dims[0]),))
    return draw_panels(dataset, variables, layout, partial(draw_lines, over=axis, numbers={}))


def draw_lines(axes: Axes, dataset: xr.Dataset, variable: str, over: str, numbers: dict[str, int]) -> None:
    """Draw a variable against an axis of the grid, one colour for every combination of the other dimensions.

    ``numbers`` holds the number of each series, by its name, for all panels of a figure: each keeps its colour even if
    another series has no values in a panel.

    Points have their one-sigma errors (Monte Carlo and catalogues), and thin lines join them.  Dashes are the
    closed-form prediction, which is known at the points alone, on bars of its catalogue error.  Open symbols are
    published values with half a unit of their last digit.
    """
    named = series_of(dataset, variable, str(dataset[over].dims[0]))
    seen = [one for _, one in named]
    offsets = _offsets(dataset[variable], seen)
    for (name, one), offset in zip(named, offsets, strict=True):
        _draw_series(axes, one, variable, over, name, numbers.setdefault(name, len(numbers)), offset)
    colour = COLOURS[0] if len(numbers) == 1 else "0.35"
    if any(_is_known(one, prediction_name(one, variable)) for one in seen):
        axes.plot([], [], color=colour, label=PREDICTED, markersize=WIDEST_DASH, **DASH)
    if any(_is_known(one, f"{variable}_published") for one in seen):
        axes.plot([], [], color=colour, **OPEN, label=PUBLISHED)
    if any(offsets):
        axes.plot([], [], linestyle="none", label=MOVED)
    if _is_numeric(dataset[over]):
        fit_scale(axes, "x", dataset[over])
    else:
        axes.set_xticks(range(dataset[over].size), list(map(str, dataset[over].values.tolist())))
        axes.set_xlim(-0.5, dataset[over].size - 0.5)
    fit_scale(axes, "y", dataset[variable])
    axes.set(xlabel=axis_label(dataset, over), ylabel=quantity_label(dataset, variable))
    finish(axes)
    legend(axes)


def _is_numeric(axis: xr.DataArray) -> bool:
    return axis.dtype.kind in "if"


def _is_known(one: xr.Dataset, name: str) -> bool:
    """Return whether a variable has anything to draw: without errors of observation a prediction is 0."""
    return name in one and bool(np.any(np.nan_to_num(one[name].values) != 0.0))


def _offsets(array: xr.DataArray, seen: list[xr.Dataset]) -> list[float]:
    """Return by how many points of print the markers of each series are moved aside: 0 unless those of two series cover
    each other in many places.
    """
    if len(seen) > 1:
        values = np.stack([one[array.name].values.astype(float) for one in seen])
        values = np.log(values) if is_logarithmic(array) else values
        gaps = np.diff(np.sort(values, axis=0), axis=0)
        covered = gaps[np.isfinite(gaps)] <= COVERED * (np.nanmax(values) - np.nanmin(values))
        if covered.size and covered.mean() > COVERED_SHARE:
            outermost = min(ASIDE_PT * (len(seen) - 1) / 2.0, ASIDE_PT)
            return list(map(float, np.linspace(-outermost, outermost, len(seen))))
    return [0.0] * len(seen)


def _draw_series(axes: Axes, one: xr.Dataset, variable: str, over: str, name: str, number: int, offset: float) -> None:
    """Draw one series; only its markers, with their error bars, are moved aside."""
    mark = series(number)
    colour = mark["color"]
    x = one[over].values.astype(float) if _is_numeric(one[over]) else np.arange(one[over].size, dtype=float)
    order = np.argsort(x, kind="stable")
    one, x = one.isel({one[over].dims[0]: order}), x[order]
    y, error = one[variable].values.astype(float), error_bar(one, variable)
    sigma = None if error is None else error.values
    words = name or (COMPUTED if standard_error(one, variable) is None else SIMULATED)
    moved = [axes.errorbar(x, y, yerr=sigma, label=words, **marks(number, 3.5, elinewidth=0.8, zorder=3))]
    predicted, published = prediction_name(one, variable), f"{variable}_published"
    if _is_numeric(one[over]) and len(x) > 1 and not is_truth(one[variable]):
        axes.plot(x, y, color=colour, linewidth=0.8, alpha=0.6, zorder=2, label=JOINED)
        if sigma is not None and not _is_known(one, predicted):
            axes.fill_between(x, y - sigma, y + sigma, color=colour, label=ERROR_BAND, **BAND)
    if _is_known(one, predicted):
        curve, spread = one[predicted].values, one.get(f"{variable}_catalogue_error")
        width = float(np.clip(ALL_DASHES / len(x), NARROWEST_DASH, WIDEST_DASH))
        axes.plot(x, curve, color=colour, zorder=2.5, markersize=width, **DASH)
        if spread is not None:
            half, bar = np.nan_to_num(spread.values), {**BAND, "linewidth": 0.6 * width}
            axes.vlines(x, curve - half, curve + half, color=colour, label=PREDICTION_BAND, **bar)
    if _is_known(one, published):
        rounding = one.get(f"{published}_rounding")
        style = {**OPEN, **mark, "elinewidth": 0.6, "zorder": 2, "label": f"_{PUBLISHED}"}
        moved.append(
            axes.errorbar(x, one[published].values, yerr=None if rounding is None else rounding.values, **style)
        )
    aside = ScaledTranslation(offset / 72.0, 0.0, axes.figure.dpi_scale_trans)
    for artist in (one for container in moved for one in container.get_children() if offset):
        artist.set_transform(artist.get_transform() + aside)


def _draw_point(axes: Axes, dataset: xr.Dataset, variable: str) -> None:
    """Draw the value of a variable at the one point of a dataset with its one-sigma error, the prediction and the
    published value with half a unit of its last digit, each in a line of its own with its numbers.
    """
    known, published = standard_error(dataset, variable), f"{variable}_published"
    rounding = dataset.get(f"{published}_rounding", xr.DataArray(0.0))
    rows = {
        COMPUTED if known is None else SIMULATED: (variable, 0.0 if known is None else float(known.item())),
        PREDICTED: (prediction_name(dataset, variable), 0.0),
        PUBLISHED: (published, float(rounding.item())),
    }
    rows = {word: row for word, row in rows.items() if row[0] in dataset and bool(dataset[row[0]].notnull().all())}
    for number, (word, (name, error)) in enumerate(rows.items()):
        value = bool(dataset[name].item()) if is_truth(dataset[variable]) else dataset[name].item()
        style: dict[str, Any] = {"color": COLOURS[number], "marker": "osD"[number], "linestyle": "none"}
        style["fillstyle"] = "none" if word == PUBLISHED else "full"
        axes.errorbar(float(value), -number, xerr=error or None, elinewidth=1.2, markersize=5.0, label=word, **style)
        text = with_unit(value, error if word == SIMULATED else 0.0, units_of(dataset[variable].attrs))
        place: dict[str, Any] = {"xytext": (0, 7), "textcoords": "offset points", "ha": "center"}
        axes.annotate(with_micro_signs(text), (value, -number), **place)
    axes.set_yticks([-number for number in range(len(rows))], list(rows))
    axes.set_ylim(0.6 - len(rows), 0.7)
    axes.margins(x=0.35)
    fit_scale(axes, "x", dataset[variable])
    axes.set_xlabel(quantity_label(dataset, variable))
    finish(axes)
    axes.tick_params(axis="y", left=False, right=False)


# Laws


def _law_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    if len(variables) > 1:
        raise SweepError(f"a law is drawn for one variable, not for {', '.join(variables)}")
    variable = variables[0]
    axis = require_axis(dataset, variable, (list(over) or numeric_axes(dataset, variable))[0])
    layout = arrange(dataset, variable, (str(dataset[axis].dims[0]),))
    if layout.rows or (layout.columns and not layout.far):
        raise SweepError("a law is drawn for one further dimension at most; fix others with --at AXIS=VALUE")
    if chosen := [name for name in (axis, variable) if dataset[name].attrs.get(SCALE) == "linear"]:
        raise SweepError(f"a law is drawn on logarithmic axes, and {chosen[0]} is to have a linear one")
    narrow = is_narrow()
    ratios = (2 if narrow else 3, 1)
    figure, (upper, lower) = new_figure(6.4, 8.0 if narrow else 5.2, 2, sharex=True, height_ratios=ratios)
    _draw_law(upper, lower, in_readable_units(dataset), variable, axis)
    if layout.columns or layout.series or narrow:
        legend_below(figure)
    return figure


def _draw_law(upper: Axes, lower: Axes, dataset: xr.Dataset, variable: str, over: str) -> None:
    """Draw a variable against an axis on logarithmic scales, with the fitted power law and its one-sigma band; and
    below that the residuals from the law in percent, where errors can be seen.

    There is one colour for every combination of the other dimensions that the study does not exclude everywhere.  The
    dashed guide has the exponent that a claim of the study states, and meets the law at its pivot.
    """
    along, result = lines(dataset, variable, over), fit_power_law(dataset, variable, over)
    exponents = result["expected"].values.ravel() if "expected" in result else np.full(len(along.lines), np.nan)
    guides: set[str] = set()
    drawn = [(line, expected) for line, expected in zip(along.lines, exponents, strict=True) if len(line.x)]
    for number, (line, expected) in enumerate(drawn):
        x, y, errors = line.x, line.y, line.errors
        style, place = marks(number, 3.5), along.place(line)
        words = ", ".join(value_text(dataset, d, place[d]) for d in along.dims if along.grid.sizes[d] > 1)
        error = np.nan_to_num(errors if errors.ndim == 1 else np.sqrt(np.diag(errors)))
        law, fine = power_law(x, y, errors, line.samples), np.geomspace(x.min(), x.max(), 100)
        curve, half, band = law(fine), law.relative_error(fine), {"color": style["color"], **BAND}
        fitted = _power(dataset, over, with_error(law.exponent, law.exponent_error).replace(" ± ", r" \pm "))
        text = f"{words}: {fitted}" if words else SIMULATED if error.any() else COMPUTED
        upper.errorbar(x, y, yerr=error if error.any() else None, label=text, **style)
        upper.plot(fine, curve, color=style["color"], linewidth=1.0, label="" if words else f"fit {fitted}")
        upper.fill_between(fine, curve * (1.0 - half), curve * (1.0 + half), label=LAW_BAND, **band)
        lower.fill_between(fine, -100.0 * half, 100.0 * half, **band)
        lower.errorbar(x, 100.0 * (y / law(x) - 1.0), yerr=100.0 * error / law(x), **style)
        if np.isfinite(expected):
            text = f"guide {_power(dataset, over, format(expected, 'g'))}"
            guide = law.amplitude * (fine / law.pivot) ** expected
            upper.plot(fine, guide, label="" if text in guides else text, **GUIDE)
            lower.plot(fine, 100.0 * (guide / curve - 1.0), **GUIDE)
            guides.add(text)
    logarithmic(upper, "x", dataset[over].values)  # also of the lower axes, which share x
    logarithmic(upper, "y", dataset[variable].values)
    upper.set_label(variable)
    upper.set_ylabel(quantity_label(dataset, variable))
    lower.axhline(0.0, color="black", linewidth=0.6)
    lower.set(xlabel=label(dataset[over], over), ylabel="residual [%]")
    finish(upper)
    finish(lower)
    legend(upper)


def _power(dataset: xr.Dataset, over: str, exponent: str) -> str:
    """Return the axis to a power, as mathematics."""
    name = symbol(over, dataset[over].attrs)
    base = name.strip("$") if name.startswith("$") else rf"\mathrm{{{name}}}"
    return f"${base}^{{{exponent}}}$"


# Maps


def _map_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    if len(variables) > 1:
        raise SweepError(f"a map is drawn for one variable, not for {', '.join(variables)}")
    variable, numeric = variables[0], numeric_axes(dataset, variables[0])
    chosen = [require_axis(dataset, variable, axis) for axis in over or _two_axes(dataset, variable)]
    if len(chosen) != 2 or len({dataset[axis].dims[0] for axis in chosen}) != 2:
        raise SweepError(
            f"a map needs two axes that are crossed, of {', '.join(numeric)}; not {', '.join(chosen) or 'none'}"
        )
    layout = arrange(dataset, variable, tuple(str(dataset[axis].dims[0]) for axis in chosen), series=False)
    readable = in_readable_units(dataset)
    draw = partial(draw_map, x=chosen[0], y=chosen[1], limits=colour_limits(readable[variable]))
    figure = draw_panels(readable, variables, layout, draw, one_unit=True)
    mesh = figure.axes[0].collections[0]  # all panels share their colours
    add_bar(figure, mesh, readable[variable], quantity_label(readable, variable), ax=figure.axes)
    if words := _accuracy_in_words(dataset, variable):
        text = in_lines(words, figure.get_figwidth(), 20)
        grow(figure, 1 + text.count("\n"))
        figure.supxlabel(text, fontsize="medium")
    return figure


def _two_axes(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return the two longest axes that do not share a dimension, in the order of the variable's dimensions: those of
    the grid, then its own.
    """
    longest: dict[str, str] = {}
    for axis in numeric_axes(dataset, variable):
        longest.setdefault(str(dataset[axis].dims[0]), axis)
    order = [str(d) for d in dataset[variable].dims]
    return sorted(list(longest.values())[:2], key=lambda axis: order.index(str(dataset[axis].dims[0])))


def colour_limits(array: xr.DataArray) -> Normalize:
    """Return the scale of colours for all values of a variable, logarithmic as an axis of it would be."""
    values = array.values.astype(float)
    values = values[np.isfinite(values)]
    return (LogNorm if is_logarithmic(array) else Normalize)(float(values.min()), float(values.max()))


def draw_map(axes: Axes, dataset: xr.Dataset, variable: str, x: str, y: str, limits: Normalize) -> None:
    """Draw a variable over two axes: colours at the points of the grid, and contours, but none of truth values.

    ``limits`` are those of the colours, which all panels of a figure share.  Points without a value are left white.
    """
    dataset = dataset.sortby([x, y])
    values = dataset[variable].transpose(dataset[y].dims[0], dataset[x].dims[0]).values
    low, high = float(limits.vmin or 0.0), float(limits.vmax or 0.0)
    across, up = dataset[x].values.astype(float), dataset[y].values.astype(float)
    cells = [_edges(places, is_logarithmic(dataset[name])) for name, places in ((x, across), (y, up))]
    axes.pcolormesh(*cells, values, cmap="cividis", norm=limits, shading="flat", rasterized=True)
    is_log = isinstance(limits, LogNorm)
    levels = LogLocator(subs=(1.0, 2.0, 5.0)) if is_log else MaxNLocator(8, steps=[1, 2, 2.5, 5, 10])
    inside = [level for level in levels.tick_values(low, high) if low < level < high]
    options: dict[str, Any] = {"levels": inside, "linewidths": 0.8, "linestyles": "solid"}  # also of negative numbers
    if np.isfinite(values).all() and min(values.shape) > 1 and inside and not is_truth(dataset[variable]):
        dark: list[AbstractPathEffect] = [withStroke(linewidth=2.2, foreground="0.15")]
        contours = axes.contour(across, up, values, colors="white", **options)
        for artist in (contours, *axes.clabel(contours, fmt=number_text, fontsize="small")):
            artist.set_path_effects(dark)
    for axis, which, name in ((axes.xaxis, "x", x), (axes.yaxis, "y", y)):
        fit_scale(axes, which, dataset[name])
        if dataset[name].dtype.kind == "i" and not is_logarithmic(dataset[name]):
            axis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel=explained_label(dataset[x], x), ylabel=explained_label(dataset[y], y))


def _edges(places: Array, is_log: bool) -> Array:
    """Return the borders of cells around ascending places on an axis, halfway between them on its scale."""
    scale = np.log(places) if is_log else places
    middle = (scale[1:] + scale[:-1]) / 2.0 if len(scale) > 1 else scale + 0.5
    whole = np.concatenate([[2.0 * scale[0] - middle[0]], middle, [2.0 * scale[-1] - middle[-1]][: len(scale) - 1]])
    return np.exp(whole) if is_log else whole


def _accuracy_in_words(dataset: xr.Dataset, variable: str) -> str:
    """Return how well the values of a map are known and agree with their prediction; '' where they have no errors."""
    if (error := standard_error(dataset, variable)) is None:
        return ""
    value, predicted = dataset[variable], dataset.get(prediction_name(dataset, variable))
    relative = float((error / abs(value.where(value != 0.0))).max(skipna=True))
    apart = np.nan if predicted is None else float((abs(value - predicted) / error.where(error > 0.0)).max())
    words = f"; at most {apart:.1f}σ from the prediction" if np.isfinite(apart) else ""
    return f"errors (1σ) at most {100.0 * relative:.2g} %{words}" if np.isfinite(relative) else ""


LINES = GridFigure(lambda dataset, variable: bool(_ordered(dataset) or numeric_axes(dataset, variable)), _lines_figure)
LAW = GridFigure(lambda dataset, variable: bool(numeric_axes(dataset, variable)), _law_figure)
MAP = GridFigure(lambda d, variable: len({d[a].dims[0] for a in numeric_axes(d, variable)}) > 1, _map_figure)
