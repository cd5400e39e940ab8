"""Legends: one in each panel, or one below all panels."""

from typing import Any, Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure

from linksweep.sweep.plots.signs import MOVED, PREDICTED, PUBLISHED
from linksweep.sweep.plots.style import line_inches, shown_letters, wanted_width

LEGEND_INCHES = (0.6, 0.065)
"""Width of an entry of a legend without its text, and of each letter, in inches."""

BEST: Final = "best"
"""Where matplotlib finds the most room.  Given explicitly, as here, it does not warn if it is slow."""

LAST = (PREDICTED, PUBLISHED, MOVED)
"""Entries that are the same for all series come last in a legend."""


def legend(axes: Axes, **options: Any) -> None:
    """Draw a legend if there is more than one thing to tell apart."""
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) > 1:  # points before lines: matplotlib alone would put all error bars last
        order = sorted(range(len(labels)), key=lambda i: not isinstance(handles[i], ErrorbarContainer))
        options.setdefault("loc", BEST)
        axes.legend([handles[i] for i in order], [labels[i] for i in order], frameon=False, **options)


def legend_below(figure: Figure) -> None:
    """Draw one legend below all axes instead of one in each, where there is more than one thing to tell apart."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(text, handle)
        if (own := axes.get_legend()) is not None:
            own.remove()
    if len(entries) > 1:
        order = [text for text in entries if text not in LAST] + [text for text in LAST if text in entries]
        scale = float(mpl.rcParams["font.size"]) / 9.0
        width = scale * (LEGEND_INCHES[0] + LEGEND_INCHES[1] * max(map(shown_letters, order)))
        columns = max(1, min(len(order), int(figure.get_figwidth() / width)))
        handles = [entries[text] for text in order]
        figure.legend(handles, order, loc="outside lower center", ncols=columns, frameon=False)
        if wanted_width() is not None:  # the panels keep their height
            lines = -(-len(order) // columns)
            figure.set_figheight(figure.get_figheight() + lines * line_inches())
