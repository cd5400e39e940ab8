"""How pictures look: colours that everyone can tell apart, sizes, scales, legends, and files that are reproducible."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from linksweep.sweep.contract import SweepError

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f7f7f", "#000000")
"""Safe for the colour-blind.  Source: Okabe & Ito 2008."""

MARKERS = "osD^vP*X"
BAND: Mapping[str, Any] = {"alpha": 0.22, "linewidth": 0.0}
FORMATS = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
"""Endings of pictures, with the metadata to leave out, because they would make two files of one picture differ."""

RC: Mapping[Any, Any] = {
    "svg.hashsalt": "linksweep",  # the same picture gives the same file
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
"""Sizes of letters in points, as printed or shown: a figure is made in its final width."""

MM_PER_INCH = 25.4
TALK_MM = 250.0
"""The default width of a figure in the style of a talk."""

LETTER_WIDTH = 0.58
"""The average width of a letter, as a fraction of its size."""

PANEL_PT = 14.0
"""The least width of a panel with labels and ticks, in sizes of its letters."""

INSIDE_PT = 25.0
"""The least width of a figure with a legend inside its panel, in sizes of its letters."""

STACKED_INCHES = 6.0
"""A narrower figure has one part below the other."""

LEGEND_LINE = 1.6
"""Height of a line of a legend, in sizes of its letters."""

_width: ContextVar[float | None] = ContextVar("width", default=None)


@contextmanager
def settings(width: float | None = None, style: str | None = None) -> Iterator[None]:
    """Make and save pictures with the settings of this package, except for those that the user has changed.

    ``width`` is that of figures in mm, by default each kind's own; ``style`` is "paper" or "talk".
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
    """Return the size of a figure in inches: its own, or about the same shape in the width asked for."""
    wanted = _width.get()
    return (width, height) if wanted is None else (wanted, max(height * wanted / width, 0.7 * min(wanted, width)))


def wanted_width() -> float | None:
    """Return the width asked for in inches; None if each figure has its own."""
    return _width.get()


def in_letters(times: float) -> float:
    """Return so many times the size of letters, in inches."""
    return times * float(mpl.rcParams["font.size"]) / 72.0


def line_inches() -> float:
    """Return the height of a line below the panels."""
    return in_letters(LEGEND_LINE)


def most_columns(columns: int) -> int:
    """Return how many of the wanted columns of panels fit side by side."""
    wanted = _width.get()
    return columns if wanted is None else max(1, min(columns, int(wanted / in_letters(PANEL_PT))))


def least_height() -> float:
    """Return the least height of a panel in inches, for figures with a width that was asked for."""
    return max(1.7, in_letters(PANEL_PT))


def is_narrow() -> bool:
    """Return whether figures are too narrow for a legend in a panel."""
    wanted = _width.get()
    return wanted is not None and wanted < in_letters(INSIDE_PT)


def is_stacked() -> bool:
    """Return whether figures are so narrow that their parts stand below one another."""
    return (wanted_width() or STACKED_INCHES) < STACKED_INCHES


def wrapped(text: str, figure: Figure) -> str:
    """Return a title in lines that fit a figure."""
    return in_lines(text, figure.get_figwidth(), 20)


def in_lines(text: str, inches: float, least: int = 12) -> str:
    """Return a text in lines that are as long as a width allows, but of at least ``least`` letters."""
    letters = max(int(inches / in_letters(LETTER_WIDTH)), least)
    lines = []
    for part in text.split("\n"):
        line, *words = part.split(" ")
        for word in words:
            if shown_letters(f"{line} {word}") > letters:
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


def series(number: int) -> dict[str, Any]:
    """Return colour and marker of the ``number``-th series of a panel."""
    return {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}


def finish(axes: Axes, grid: bool = True) -> None:
    """Give axes the light grid and ticks that all pictures have."""
    axes.tick_params(direction="in", which="both", top=True, right=True)
    if grid:
        axes.grid(alpha=0.25, linewidth=0.4)
        axes.set_axisbelow(True)


def shown_letters(text: str) -> int:
    """Return about how many letters a text shows, without its mathematical markup."""
    return len(re.sub(r"\\[a-z]+|[${}^_]", "", text)) + 1
