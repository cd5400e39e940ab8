"""What the signs of a figure mean, in words: from the entries of its legend, and from labels that no legend shows."""

from typing import Any

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from linksweep.sweep.analysis.quantity import errors_beside, standard_error

SIMULATED, COMPUTED, PREDICTED, PUBLISHED = "simulated", "computed", "predicted", "published"
MOVED = "markers moved sideways, lines not"
"""Entries of legends.  Values are simulated if they have errors."""

HIDDEN = {
    "_error band": "Bands join the errors of the points.",
    "_prediction band": "Bands are the one-sigma errors of the predictions.",
    "_law band": "Bands are the one-sigma errors of the fitted laws.",
    "_joined": "Thin lines join the points.",
}
"""Labels of what a caption explains; matplotlib leaves labels that begin with _ out of legends."""

ERROR_BAND, PREDICTION_BAND, LAW_BAND, JOINED = HIDDEN


def signs_in_words(figure: Figure, dataset: xr.Dataset) -> list[str]:
    """Return a sentence for each kind of sign in a figure that its labels do not explain."""
    handles = _handles(figure)
    labels = {artist.get_label() for axes in figure.axes for artist in axes.get_children()}
    found = []
    with_bars = [str(axes.get_label()) for axes in figure.axes if axes.get_label() in dataset and _has_error_bars(axes)]
    if any(standard_error(dataset, name) is not None for name in with_bars):
        found.append("Points are simulated, with one-sigma errors.")
    declared = dict.fromkeys(bars[0] for name in with_bars if (bars := errors_beside(dataset, name)))
    found += [f"Error bars are {name}." for name in declared]
    if PREDICTED in handles:
        dashes = isinstance(handles[PREDICTED], Line2D)
        found.append(f"{'Dashes are predicted' if dashes else 'The prediction is'} in closed form.")
    if PUBLISHED in handles:
        found.append("Open symbols are published.")
    found += [words for label, words in HIDDEN.items() if label in labels]
    if MOVED in handles:
        found.append(
            "Markers that cover each other are drawn a little to the left or right of their places; lines are not."
        )
    return found


def entries(figure: Figure) -> list[str]:
    """Return the entries of the legends of a figure."""
    return list(_handles(figure))


def drawn_variables(figure: Figure, dataset: xr.Dataset) -> list[str]:
    """Return the variables of a dataset that a figure shows: the labels of its axes."""
    return list(dict.fromkeys(str(axes.get_label()) for axes in figure.axes if axes.get_label() in dataset))


def _handles(figure: Figure) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(text, handle)
    return found


def _has_error_bars(axes: Axes) -> bool:
    bars = [one for one in axes.containers if isinstance(one, ErrorbarContainer) and (one.has_xerr or one.has_yerr)]
    return any(str(one.get_label()).lstrip("_") != PUBLISHED for one in bars)
