"""Scales of axes: which are logarithmic, their ticks, the borders of cells."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator
from numpy.typing import NDArray

from sweep.attributes import LOGARITHMIC_UNITS

FEW_TICKS = 8.0
"""On axes that span less than this factor, ticks at 1, 2 and 5 of each decade are too few."""

WIDE_RATIO = 5.0
"""Positive numbers that span more than this factor are drawn on a logarithmic axis."""


def is_wide(values: Any, unit: str = "") -> bool:
    """Return whether numbers need a logarithmic axis."""
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known)]
    if unit in LOGARITHMIC_UNITS or not known.size or known.min() <= 0.0:
        return False
    return bool(known.max() > WIDE_RATIO * known.min())


def fit_scale(axes: Axes, which: str, values: Any, unit: str = "", few_ticks: bool = False) -> None:
    """Make an axis logarithmic where its numbers need it; ``few_ticks`` is for small panels."""
    if not is_wide(values, unit):
        return
    logarithmic(axes, which, values, few_ticks)


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
