"""Scales of axes: which are logarithmic, their ticks, the borders of cells."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator
from numpy.typing import NDArray

from linksweep.sweep.contract import Array, SweepError, shown, suggest
from linksweep.sweep.formatting import LOGARITHMIC_UNITS, TRUTH, is_truth, units_of
from linksweep.sweep.studies.form import FigureForm

FEW_TICKS = 8.0
"""On axes that span less than this factor, ticks at 1, 2 and 5 of each decade are too few."""

TRUTH_NAMES = TRUTH["flag_meanings"].split()

SCALE = "scale"
"""The attribute of a variable whose axis was chosen: "log" or "linear"."""

WIDE_RATIO, EVEN = 5.0, 0.01
"""Numbers that span less than this factor are drawn on a logarithmic axis only if their ratios are equal: none of them
is farther from its place among equal steps of the logarithm than this share of the axis.
"""


def with_scales(
    dataset: xr.Dataset, drawn: Sequence[str], log: Sequence[str] = (), linear: Sequence[str] = ()
) -> xr.Dataset:
    """Return a dataset in which what is drawn has the scale that its study chose, or that is chosen here.

    Raises SweepError for a name that has no numbers here or is in both, and for a study whose choice cannot be read.
    """
    known = [name for name in drawn if dataset[name].dtype.kind in "if" and not is_truth(dataset[name])]
    if wrong := [name for name in (*log, *linear) if name not in known]:
        raise SweepError(f"{shown(wrong[0])} has no scale to choose{suggest(wrong[0], known) if known else ''}")
    if both := set(log) & set(linear):
        raise SweepError(f"{min(both)} cannot have both a logarithmic and a linear axis")
    try:
        own = FigureForm.model_validate(json.loads(dataset.attrs.get("study_document", "{}")).get("figure", {}))
    except (ValueError, TypeError, AttributeError) as error:
        raise SweepError(f"the table [figure] of the study cannot be read: {error}") from error
    chosen = dict.fromkeys(own.log, "log") | dict.fromkeys(own.linear, "linear")
    chosen |= dict.fromkeys(log, "log") | dict.fromkeys(linear, "linear")
    marked = dataset.copy()
    for name in filter(chosen.__contains__, known):
        marked[name].attrs[SCALE] = chosen[name]
    return marked


def is_logarithmic(array: xr.DataArray) -> bool:
    """Return whether numbers are drawn on a logarithmic axis: as was chosen, or by their spacing.

    Equal steps make it linear, equal ratios logarithmic.  Others, such as results, have the scale on which they are
    nearer to equal steps, the logarithmic one only where they span more than `WIDE_RATIO`.  Numbers that are logarithms
    already have a linear one.  Raises SweepError where a logarithmic axis is wanted for numbers not above zero.
    """
    known = np.unique(array.values.astype(float))
    known = known[np.isfinite(known)]
    if array.attrs.get(SCALE) == "log" and known.size and known[0] <= 0.0:
        raise SweepError(f"{array.name} = {known[0]:g}: a logarithmic axis has only numbers above zero")
    if SCALE in array.attrs:
        return bool(array.attrs[SCALE] == "log")
    if known.size < 3 or known[0] <= 0.0 or units_of(array.attrs) in LOGARITHMIC_UNITS:
        return False
    of_ratios = _unevenness(np.log(known))
    return of_ratios < _unevenness(known) and (of_ratios < EVEN or bool(known[-1] > WIDE_RATIO * known[0]))


def scale_of(array: xr.DataArray) -> str:
    """Return "log" or "linear", whichever the axis of an array has."""
    return "log" if is_logarithmic(array) else "linear"


def _unevenness(places: Array) -> float:
    """Return how far ascending places are at most from equal steps, as a share of their range."""
    return float(np.abs((places - places[0]) / (places[-1] - places[0]) - np.linspace(0.0, 1.0, len(places))).max())


def fit_scale(axes: Axes, which: str, array: xr.DataArray, few_ticks: bool = False) -> None:
    """Make an axis logarithmic where its numbers need it, and name truth values; ``few_ticks`` is for small panels."""
    if is_truth(array):
        (axes.set_xticks if which == "x" else axes.set_yticks)([0.0, 1.0], TRUTH_NAMES)
    elif is_logarithmic(array):
        logarithmic(axes, which, array.values, few_ticks)


def logarithmic(axes: Axes, which: str, values: Any, few_ticks: bool = False) -> None:
    """Make an axis logarithmic, with ticks as `logarithmic_ticks` sets them."""
    (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    logarithmic_ticks(axes.xaxis if which == "x" else axes.yaxis, values, few_ticks)


def logarithmic_ticks(axis: Axis, values: Any, few_ticks: bool = False) -> None:
    """Set the ticks of a logarithmic axis: if it spans less than two decades, all of them, such as 1, 2 and 5, have
    numbers; with ``few_ticks`` there are at most four of these, and no more than five decades.
    """
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known) & (known > 0.0)]
    span = known.max() / known.min() if known.size else 0.0
    if few_ticks and span >= 100.0:
        axis.set_major_locator(LogLocator(numticks=5))
        axis.set_minor_locator(NullLocator())
    elif 0.0 < span < 100.0:
        many: tuple[float, ...] = (1.0, 2.0, 5.0) if span > FEW_TICKS else (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
        few = (1.0, 3.0) if span > 10.0 else (1.0, 2.0, 5.0)
        axis.set_major_locator(LogLocator(subs=few if few_ticks else many))
        axis.set_major_formatter(FuncFormatter(lambda value, _: number_text(value) if value > 0.0 else ""))
        axis.set_minor_formatter(NullFormatter())


def fit_bar(bar: Colorbar, array: xr.DataArray) -> None:
    """Set the ticks of a colour bar of an array."""
    if isinstance(bar.norm, LogNorm):
        logarithmic_ticks(bar.ax.yaxis, [bar.norm.vmin, bar.norm.vmax])
    elif is_truth(array):
        bar.set_ticks([0.0, 1.0], labels=TRUTH_NAMES)


def edges(places: NDArray[np.float64], logarithm: bool) -> NDArray[np.float64]:
    """Return the borders of cells around ascending places on an axis, halfway between them on its scale."""
    scale = np.log(places) if logarithm else places
    if len(scale) == 1:
        whole = np.array([scale[0] - 0.5, scale[0] + 0.5])
    else:
        middle = (scale[1:] + scale[:-1]) / 2.0
        whole = np.concatenate([[2.0 * scale[0] - middle[0]], middle, [2.0 * scale[-1] - middle[-1]]])
    return np.exp(whole) if logarithm else whole


def number_text(value: float) -> str:
    """Return a number of few digits as ticks and contours show it.

    Examples:
        >>> number_text(1000.0), number_text(-0.25), number_text(2e6)
        ('1000', '-0.25', '$2\\\\times10^{6}$')
    """
    rounded = abs(float(f"{value:.3g}"))
    power = int(np.floor(np.log10(rounded) + 1e-9)) if value else 0
    if -4 <= power <= 4:
        return f"{value:g}"
    sign, digits = "-" if value < 0.0 else "", f"{rounded / 10.0**power:.3g}"
    return rf"${sign}10^{{{power}}}$" if digits == "1" else rf"${sign}{digits}\times10^{{{power}}}$"
