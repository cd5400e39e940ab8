"""A quantity against an axis, or at one point, with errors, prediction and published values."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.transforms import ScaledTranslation

from linksweep.sweep.analysis.quantity import error_bar, prediction_name, standard_error
from linksweep.sweep.analysis.selection import places_along
from linksweep.sweep.formatting import is_truth, units_of, with_micro_signs, with_unit
from linksweep.sweep.plots.labels import axis_label, quantity_label, value_text
from linksweep.sweep.plots.legends import legend
from linksweep.sweep.plots.scales import fit_scale, is_logarithmic
from linksweep.sweep.plots.signs import COMPUTED, ERROR_BAND, JOINED, MOVED, PREDICTED, PREDICTION_BAND, SIMULATED
from linksweep.sweep.plots.signs import PUBLISHED as PUBLISHED_ENTRY
from linksweep.sweep.plots.style import BAND, COLOURS, finish, series

NO_LINE = {"linestyle": "none"}
PUBLISHED: Mapping[str, Any] = NO_LINE | {"marker": "o", "markersize": 8.0, "fillstyle": "none", "markeredgewidth": 0.9}
DASH: Mapping[str, Any] = NO_LINE | {"marker": "_", "markeredgewidth": 1.2}
NARROWEST_DASH, WIDEST_DASH, ALL_DASHES = 3.0, 10.0, 150.0
"""Dashes of predictions have one of these widths, or together the third, in points of print."""

STEP_PT, MOST_PT = 4.5, 4.5
"""Markers that are moved aside stand so many points apart, but each at most so many from its place."""

COVERED, COVERED_SHARE = 0.015, 0.25
"""Points closer than this share of the axis cover each other; they are moved aside if more than this share do."""


def draw_lines(
    axes: Axes, dataset: xr.Dataset, variable: str, over: str, numbers: dict[str, int] | None = None
) -> Axes:
    """Draw a variable against an axis of the grid, one colour for every combination of the other dimensions.

    ``numbers`` holds the number of each series, by its name, for all panels of a figure: each keeps its colour even if
    another series has no values in a panel.

    Points have their one-sigma errors (Monte Carlo and catalogues), and thin lines join them.  Dashes are the
    closed-form prediction, which is known at the points alone, on bars of its catalogue error.  Open symbols are
    published values with half a unit of their last digit.
    """
    numbers = {} if numbers is None else numbers
    dimension = str(dataset[over].dims[0])
    others = [str(d) for d in dataset[variable].dims if d != dimension]
    everything = [dataset.isel(place) for place in places_along(dataset, others)]
    seen = [one for one in everything if np.isfinite(one[variable].values).any()]  # the others are excluded
    offsets = _dodges(dataset[variable], seen)
    for one, offset in zip(seen, offsets, strict=True):
        words = ", ".join(value_text(dataset, d, one[d].item()) for d in others if dataset.sizes[d] > 1)
        _series(axes, one, variable, over, words, numbers.setdefault(words, len(numbers)), offset)
    colour = COLOURS[0] if len(numbers) == 1 else "0.35"
    if any(_has(one, prediction_name(one, variable)) for one in seen):
        axes.plot([], [], color=colour, label=PREDICTED, markersize=WIDEST_DASH, **DASH)
    if any(_has(one, f"{variable}_published") for one in seen):
        axes.plot([], [], color=colour, **PUBLISHED, label=PUBLISHED_ENTRY)
    if any(offsets):
        axes.plot([], [], linestyle="none", label=MOVED)
    x = _positions(dataset[over])
    if not _is_numeric(dataset[over]):
        axes.set_xticks(x, list(map(str, dataset[over].values.tolist())))
        axes.set_xlim(x.min() - 0.5, x.max() + 0.5)
    else:
        fit_scale(axes, "x", dataset[over])
    fit_scale(axes, "y", dataset[variable])
    axes.set_xlabel(axis_label(dataset, over))
    axes.set_ylabel(quantity_label(dataset, variable))
    finish(axes)
    legend(axes)
    return axes


def _positions(axis: xr.DataArray) -> np.ndarray[Any, Any]:
    """Return the positions of the values of an axis; names stand one after the other."""
    return axis.values.astype(float) if _is_numeric(axis) else np.arange(axis.size, dtype=float)


def _dodges(array: xr.DataArray, seen: list[xr.Dataset]) -> list[float]:
    """Return by how many points of print the markers of each series are moved aside: 0 unless those of two series cover
    each other in many places.
    """
    if len(seen) < 2:
        return [0.0] * len(seen)
    values = np.stack([one[array.name].values.astype(float) for one in seen])
    if is_logarithmic(array):
        values = np.log(values)
    whole = np.nanmax(values) - np.nanmin(values)
    gaps = np.diff(np.sort(values, axis=0), axis=0)
    known = gaps[np.isfinite(gaps)]
    if not known.size or (known <= COVERED * whole).mean() <= COVERED_SHARE:
        return [0.0] * len(seen)
    outermost = min(STEP_PT * (len(seen) - 1) / 2.0, MOST_PT)
    return [outermost * (2.0 * number / (len(seen) - 1) - 1.0) for number in range(len(seen))]


def _series(axes: Axes, one: xr.Dataset, variable: str, over: str, name: str, number: int, offset: float) -> None:
    """Draw one series; only its markers, with their error bars, are moved aside."""
    mark = series(number)
    colour, x = mark["color"], _positions(one[over])
    order = np.argsort(x, kind="stable")
    one, x = one.isel({one[over].dims[0]: order}), x[order]
    y, error = one[variable].values.astype(float), error_bar(one, variable)
    sigma = None if error is None else error.values
    style: dict[str, Any] = {**mark, "markersize": 3.5, "linestyle": "none"}
    label = name or (COMPUTED if standard_error(one, variable) is None else SIMULATED)
    moved = [axes.errorbar(x, y, yerr=sigma, elinewidth=0.8, label=label, zorder=3, **style)]
    predicted, published = prediction_name(one, variable), f"{variable}_published"
    if _is_numeric(one[over]) and len(x) > 1 and not is_truth(one[variable]):
        axes.plot(x, y, color=colour, linewidth=0.8, alpha=0.6, zorder=2, label=JOINED)
        if sigma is not None and not _has(one, predicted):
            axes.fill_between(x, y - sigma, y + sigma, color=colour, label=ERROR_BAND, **BAND)
    if _has(one, predicted):
        curve, spread = one[predicted].values, one.get(f"{variable}_catalogue_error")
        width = float(np.clip(ALL_DASHES / len(x), NARROWEST_DASH, WIDEST_DASH))
        axes.plot(x, curve, color=colour, zorder=2.5, markersize=width, **DASH)
        if spread is not None:
            half, bar = np.nan_to_num(spread.values), {**BAND, "linewidth": 0.6 * width}
            axes.vlines(x, curve - half, curve + half, color=colour, label=PREDICTION_BAND, **bar)
    if _has(one, published):
        rounding = one.get(f"{published}_rounding")
        half = None if rounding is None else rounding.values
        style = {**PUBLISHED, **mark, "elinewidth": 0.6, "zorder": 2, "label": f"_{PUBLISHED_ENTRY}"}
        moved.append(axes.errorbar(x, one[published].values, yerr=half, **style))
    aside = ScaledTranslation(offset / 72.0, 0.0, axes.figure.dpi_scale_trans)
    for artist in (one for container in moved for one in container.get_children() if offset):
        artist.set_transform(artist.get_transform() + aside)


def _has(one: xr.Dataset, name: str) -> bool:
    """Return whether a variable has anything to draw: without errors of observation a prediction is 0."""
    return name in one and bool(np.any(np.nan_to_num(one[name].values) != 0.0))


def _is_numeric(axis: xr.DataArray) -> bool:
    return axis.dtype.kind in "if"


def draw_point(axes: Axes, dataset: xr.Dataset, variable: str) -> None:
    """Draw the value of a variable at the one point of a dataset with its one-sigma error, the prediction and the
    published value with half a unit of its last digit, each in a line of its own with its numbers.
    """
    known = standard_error(dataset, variable)
    rounding = f"{variable}_published_rounding"
    rows = {
        COMPUTED if known is None else SIMULATED: (variable, 0.0 if known is None else float(known.item())),
        PREDICTED: (prediction_name(dataset, variable), 0.0),
        PUBLISHED_ENTRY: (f"{variable}_published", float(dataset[rounding].item()) if rounding in dataset else 0.0),
    }
    shown = {word: row for word, row in rows.items() if row[0] in dataset and bool(dataset[row[0]].notnull().all())}
    unit = units_of(dataset[variable].attrs)
    for number, (word, (name, error)) in enumerate(shown.items()):
        value = dataset[name].item()
        value = bool(value) if is_truth(dataset[variable]) else value
        style: dict[str, Any] = {"color": COLOURS[number], "marker": "osD"[number], "linestyle": "none"}
        if word == PUBLISHED_ENTRY:
            style["fillstyle"] = "none"
        axes.errorbar(float(value), -number, xerr=error or None, elinewidth=1.2, markersize=5.0, label=word, **style)
        text = with_micro_signs(with_unit(value, error if word == SIMULATED else 0.0, unit))
        axes.annotate(text, (value, -number), xytext=(0, 7), textcoords="offset points", ha="center")
    axes.set_yticks([-number for number in range(len(shown))], list(shown))
    axes.set_ylim(0.6 - len(shown), 0.7)
    axes.margins(x=0.35)
    fit_scale(axes, "x", dataset[variable])
    axes.set_xlabel(quantity_label(dataset, variable))
    finish(axes)
    axes.tick_params(axis="y", left=False, right=False)
