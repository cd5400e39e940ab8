"""Names below an axis: in several lines, or turned, where they would cover each other."""

import math
from itertools import pairwise

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FixedLocator

from linksweep.sweep.plots.style import in_lines

ROOM = 0.78
"""The share of the distance between two names that they may take; a report makes some figures smaller, not their
letters.
"""

SLANT = 45.0


def fit_names(figure: Figure) -> None:
    """Break the names below the axes of a whole figure into lines where they would cover each other, or turn them if
    that is not enough.
    """
    named = [axes for axes in figure.axes if isinstance(axes.xaxis.get_major_locator(), FixedLocator)]
    if not named:
        return
    figure.draw_without_rendering()
    whole = {axes: [text.get_text() for text in axes.get_xticklabels()] for axes in named}
    covered = [axes for axes in named if _cover(axes)]
    for axes in covered:
        inches = ROOM * _distance(axes) / figure.dpi
        axes.set_xticks(axes.get_xticks(), [in_lines(name, inches, 1) for name in whole[axes]])
    if not covered:
        return
    figure.draw_without_rendering()
    longest = 0.0
    for axes in filter(_cover, covered):
        axes.set_xticks(axes.get_xticks(), whole[axes])
        line = float(axes.get_xticklabels()[0].get_fontsize()) * figure.dpi / 72.0
        degrees = SLANT if line < ROOM * _distance(axes) * math.sin(math.radians(SLANT)) else 90.0
        for text in axes.get_xticklabels():
            text.set(rotation=degrees, rotation_mode="anchor", ha="right", va="center")
            longest = max(longest, text.get_window_extent().height - line)
    figure.set_figheight(figure.get_figheight() + longest / figure.dpi)  # the panels keep their height


def _cover(axes: Axes) -> bool:
    """Return whether neighbouring names leave too little room between them."""
    boxes = [text.get_window_extent() for text in _shown(axes)]
    pairs = pairwise(boxes)
    return any(left.width + right.width > ROOM * (right.x0 + right.x1 - left.x0 - left.x1) for left, right in pairs)


def _distance(axes: Axes) -> float:
    """Return the distance between two names, which stand at 0, 1, 2, ..., in pixels."""
    (left, _), (right, _) = axes.get_xaxis_transform().transform([(0.0, 0.0), (1.0, 0.0)])
    return float(right - left)


def _shown(axes: Axes) -> list[Text]:
    return [text for text in axes.get_xticklabels() if text.get_visible() and text.get_text()]
