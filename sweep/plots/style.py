"""How pictures look: colours that everyone can tell apart, sizes, scales, legends, files that do not change."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from sweep.attributes import LOGARITHMIC_UNITS
from sweep.contract import SweepError

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f7f7f", "#000000")
"""Safe for the colour-blind.  Source: Okabe & Ito 2008."""

LEGEND_INCHES = (0.6, 0.065)
"""Width of an entry of a legend, and of each of its letters."""

MARKERS = "osD^vP*X"
BAND: Mapping[str, Any] = {"alpha": 0.22, "linewidth": 0.0}
FORMATS = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
"""Endings of pictures, and what would make two files of one picture differ."""

RC: Mapping[Any, Any] = {
    "svg.hashsalt": "linksweep",  # the same picture, the same file
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "legend.fontsize": 8.0,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "axes.formatter.use_mathtext": True,
    "mathtext.fontset": "dejavusans",
}
"""What differs from the defaults of matplotlib."""

STYLES: Mapping[str, Mapping[Any, Any]] = {
    "paper": {
        **dict.fromkeys(("font.size", "axes.titlesize", "axes.labelsize"), 8.0),
        **dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), 7.0),
        "figure.titlesize": 8.5,
    },
    "talk": {
        **dict.fromkeys(("font.size", "axes.titlesize", "axes.labelsize"), 14.0),
        **dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), 12.0),
        **{"figure.titlesize": 15.0, "axes.linewidth": 1.0, "lines.markersize": 8.0},
    },
}
"""Sizes of letters in points, as they are printed or shown: a figure is made as wide as it will be."""

MM_PER_INCH = 25.4
TALK_MM = 250.0
"""The width of a figure in the style of a talk unless another is asked for."""

LETTER_WIDTH = 0.58
"""The width of a letter over its size, on average."""

PANEL_PT = 14.0
"""A panel is at least so many times the size of its letters wide, of labels and ticks too."""

INSIDE_PT = 25.0
"""A figure is at least so many times the size of its letters wide if a legend stands in its panel."""

STACKED_INCHES = 6.0
"""A narrower figure has one part below the other."""

LAST = ("predicted", "published")
"""What is the same for all series stands at the end of a legend."""

LEGEND_LINE = 1.6
"""Height of a line of a legend over the size of its letters."""

_width: ContextVar[float | None] = ContextVar("width", default=None)

FEW_TICKS = 8.0
"""Over less than this factor ticks at 1, 2 and 5 of each decade are too few."""

WIDE_RATIO = 5.0
"""Positive numbers whose largest is more than so many times the smallest are drawn on a logarithmic axis."""


@contextmanager
def settings(width: float | None = None, style: str | None = None) -> Iterator[None]:
    """Make and save pictures with the settings of this package, except for those that the user has changed.

    ``width`` is that of figures in mm, each kind's own unless given; ``style`` is "paper" or "talk".
    """
    if style is None and width is not None:
        style = "paper"
    wanted = {**RC, **(STYLES[style] if style else {})}
    ours = (mpl.rcParamsDefault, RC, *STYLES.values())
    unchanged = {
        key: value
        for key, value in wanted.items()
        if any(key in settings and mpl.rcParams[key] == settings[key] for settings in ours)
    }
    if width is None and style == "talk":
        width = TALK_MM
    token = _width.set(None if width is None else width / MM_PER_INCH)
    try:
        with mpl.rc_context():
            mpl.rcParams.update(unchanged)
            yield
    finally:
        _width.reset(token)


def figure_size(width: float, height: float) -> tuple[float, float]:
    """Return the size of a figure in inches: its own, or of the same shape and as wide as is asked for."""
    wanted = _width.get()
    return (width, height) if wanted is None else (wanted, max(height * wanted / width, 0.7 * min(wanted, width)))


def wanted_width() -> float | None:
    """Return the width in inches that is asked for, None where each figure has its own."""
    return _width.get()


def in_letters(times: float) -> float:
    """Return so many times the size of letters, in inches."""
    return times * float(mpl.rcParams["font.size"]) / 72.0


def line_inches() -> float:
    """Return the height of a line below the panels."""
    return in_letters(LEGEND_LINE)


def most_columns(columns: int) -> int:
    """Return how many panels go side by side, of those that are wanted."""
    wanted = _width.get()
    return columns if wanted is None else max(1, min(columns, int(wanted / in_letters(PANEL_PT))))


def least_height() -> float:
    """Return how high a panel is at least, in inches, where a width is asked for."""
    return max(1.7, in_letters(PANEL_PT))


def is_narrow() -> bool:
    """Return whether figures are too narrow for a legend in a panel."""
    wanted = _width.get()
    return wanted is not None and wanted < in_letters(INSIDE_PT)


def is_stacked() -> bool:
    """Return whether figures are too narrow for parts beside one another, so that these stand below one another."""
    return (wanted_width() or STACKED_INCHES) < STACKED_INCHES


def wrapped(text: str, figure: Figure) -> str:
    """Return a title in lines that fit a figure."""
    return in_lines(text, figure.get_figwidth(), 20)


def in_lines(text: str, inches: float, least: int = 12) -> str:
    """Return a text in lines that are as long as a width allows, but at least so many letters."""
    letters = max(int(inches / in_letters(LETTER_WIDTH)), least)
    lines = []
    for part in text.split("\n"):
        line, *words = part.split(" ")
        for word in words:
            if _shown_letters(f"{line} {word}") > letters:
                lines.append(line)
                line = word
            else:
                line = f"{line} {word}"
        lines.append(line)
    return "\n".join(lines)


def require_format(path: Path) -> None:
    """Raise SweepError unless a path ends like one of `FORMATS`."""
    if path.suffix.lower() not in FORMATS:
        raise SweepError(f"cannot draw there: the name must end with {', '.join(FORMATS)}", str(path))


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, SVG or PDF, whichever ``path`` ends with, without a date; raises SweepError."""
    require_format(path)
    try:
        figure.savefig(path, dpi=160, metadata=FORMATS[path.suffix.lower()])
    except OSError as error:
        raise SweepError(f"cannot draw there: {error.strerror or error}", str(path)) from error


def save_text(text: str, path: Path) -> None:
    """Write a text beside a picture; raises SweepError."""
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise SweepError(f"cannot be written: {error.strerror or error}", str(path)) from error


def is_wide(values: Any, unit: str = "") -> bool:
    """Return whether numbers need a logarithmic axis."""
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known)]
    if unit in LOGARITHMIC_UNITS or not known.size or known.min() <= 0.0:
        return False
    return bool(known.max() > WIDE_RATIO * known.min())


def series(number: int) -> dict[str, Any]:
    """Return colour and marker of the ``number``-th series of a panel."""
    return {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}


def finish(axes: Axes, grid: bool = True) -> None:
    """Give axes the light grid and ticks that all pictures have."""
    axes.tick_params(direction="in", which="both", top=True, right=True)
    if grid:
        axes.grid(alpha=0.25, linewidth=0.4)
        axes.set_axisbelow(True)


def logarithmic(axes: Axes, which: str, values: Any) -> None:
    """Make an axis logarithmic; over less than two decades it has ticks at 1, 2 and 5 of each, all with numbers."""
    (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known) & (known > 0.0)]
    if known.size and known.max() < 100.0 * known.min():
        axis = axes.xaxis if which == "x" else axes.yaxis
        subs = (1.0, 2.0, 5.0) if known.max() > FEW_TICKS * known.min() else (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
        axis.set_major_locator(LogLocator(subs=subs))
        axis.set_major_formatter(FuncFormatter(lambda value, _: _tick(value)))
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


def _tick(value: float) -> str:
    """Return a number of one digit as a tick shows it."""
    if not value > 0.0:
        return ""
    power = int(np.floor(np.log10(value) + 1e-9))
    if -4 <= power <= 4:
        return f"{value:g}"
    digit = value / 10.0**power
    return rf"$10^{{{power}}}$" if round(digit) == 1 else rf"${digit:.0f}\times10^{{{power}}}$"


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
        width = scale * (LEGEND_INCHES[0] + LEGEND_INCHES[1] * max(map(_shown_letters, order)))
        columns = max(1, min(len(order), int(figure.get_figwidth() / width)))
        handles = [entries[text] for text in order]
        figure.legend(handles, order, loc="outside lower center", ncols=columns, frameon=False)
        if _width.get() is not None:  # the panels keep their height
            lines = -(-len(order) // columns)
            figure.set_figheight(figure.get_figheight() + lines * line_inches())


def _shown_letters(text: str) -> int:
    """Return about how many letters a text shows, without the words of its mathematics."""
    return len(re.sub(r"\\[a-z]+|[${}^_]", "", text)) + 1


def legend(axes: Axes, **options: Any) -> None:
    """Draw a legend if there is more than one thing to tell apart."""
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) > 1:  # points before lines: matplotlib alone would put all error bars last
        order = sorted(range(len(labels)), key=lambda i: not isinstance(handles[i], ErrorbarContainer))
        axes.legend([handles[i] for i in order], [labels[i] for i in order], frameon=False, **options)
