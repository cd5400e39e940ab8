"""How figures look: colours, letters and sizes, labels, scales with their ticks, legends, and files that are
reproducible.
"""

import io
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

from linksweep.sweep.analysis.quantity import COVARIANCE_SUFFIX
from linksweep.sweep.contract import Array, SweepError, shown, suggest
from linksweep.sweep.formatting import LOGARITHMIC_UNITS, TRUTH, is_truth, units_of, written
from linksweep.sweep.formatting import plain as number_in_words
from linksweep.sweep.studies.study import FigureForm

# Safe for the colour-blind.  Source: Okabe & Ito 2008.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f7f7f", "#000000")
MARKERS = "osD^vP*X"
BAND: Mapping[str, Any] = {"alpha": 0.22, "linewidth": 0.0}

# Endings of pictures, with the metadata to leave out, because they would make two files of one picture differ.
FORMATS = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}

# Style sheets of matplotlib: what all figures have, and sizes of letters for a paper or a talk.
BASE, PAPER, TALK = (
    mpl.rc_params_from_file(str(Path(__file__).parent / "styles" / f"{name}.mplstyle"), use_default_template=False)
    for name in ("base", "paper", "talk")
)
TALK_MM = 250.0  # the default width of a figure in the style of a talk

# Sizes in letters, that is, in units of the font's size: the average width of a letter, the least width of a panel with
# labels and ticks, that of a figure with a legend inside its panel, and the height of a line of a legend.
LETTER_WIDTH, PANEL_WIDTH, INSIDE_WIDTH, LINE_HEIGHT = 0.58, 14.0, 25.0, 1.6

_width: ContextVar[float | None] = ContextVar("width", default=None)


@contextmanager
def settings(width: float | None = None, style: str | None = None) -> Iterator[None]:
    """Make and save pictures with the settings of this package, except for those that the user has changed.

    ``width`` is that of figures in mm, by default each kind's own; ``style`` is "paper" or "talk".
    """
    if width is None and style == "talk":
        width = TALK_MM
    wanted = BASE | (TALK if style == "talk" else PAPER if style or width else {})
    ours = (mpl.rcParamsDefault, BASE, PAPER, TALK)
    unchanged = [k for k in wanted if any(k in one and mpl.rcParams[k] == one[k] for one in ours)]
    token = _width.set(None if width is None else width / 25.4)
    try:
        with mpl.rc_context({key: wanted[key] for key in unchanged}):
            yield
    finally:
        _width.reset(token)


# Sizes


def wanted_width() -> float | None:
    """Return the width asked for in inches; None if each figure has its own."""
    return _width.get()


def in_letters(times: float) -> float:
    """Return so many times the size of letters, in inches."""
    return times * float(mpl.rcParams["font.size"]) / 72.0


def most_columns(columns: int, least: float = PANEL_WIDTH) -> int:
    """Return how many of the wanted columns of panels fit side by side, each at least so many letters wide."""
    wanted = _width.get()
    return columns if wanted is None else max(1, min(columns, int(wanted / in_letters(least))))


def least_height() -> float:
    """Return the least height of a panel in inches, for figures with a width that was asked for."""
    return max(1.7, in_letters(PANEL_WIDTH))


def is_narrow() -> bool:
    """Return whether figures are too narrow for a legend in a panel."""
    return (_width.get() or math.inf) < in_letters(INSIDE_WIDTH)


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, least: float = PANEL_WIDTH, **options: Any
) -> tuple[Figure, list[Any]]:
    """Return a figure and its panels, row by row.

    It has the size in inches, or about the same shape in the width asked for; panels that would be less than ``least``
    letters wide there continue in further rows.  ``options`` are those of `Figure.subplots`.
    """
    across, wanted = most_columns(columns, least), _width.get()
    if wanted is not None:
        shape = (height / rows) / (width / columns)
        rows = -(-rows * columns // across)
        panel = shape * wanted / across if across == columns else max(shape * wanted / across, least_height())
        width, height = wanted, max(rows * panel, 0.7 * min(wanted, width))
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(figure.subplots(rows, across, squeeze=False, **options).flat)


def grow(figure: Figure, lines: int) -> None:
    """Add the height of lines of text below the panels to a figure whose width was asked for: panels keep theirs."""
    if _width.get() is not None:
        figure.set_figheight(figure.get_figheight() + lines * in_letters(LINE_HEIGHT))


def entitle(figure: Figure, title: str) -> None:
    """Write the title of a figure, in lines that fit it."""
    figure.suptitle(in_lines(title, figure.get_figwidth(), 20), fontsize="medium")


def in_lines(text: str, inches: float, least: int = 12) -> str:
    """Return a text in lines that are as long as a width allows, but of at least ``least`` letters."""
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


def _shown_letters(text: str) -> int:
    """Return about how many letters a text shows, without its mathematical markup."""
    return len(re.sub(r"\\[a-z]+|[${}^_]", "", text)) + 1


# Files


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


class ShownFigure(Figure):
    """A figure that IPython can show as a picture: without pyplot, which this library does not import, a fresh kernel
    would show a figure as text.
    """

    def _repr_png_(self) -> bytes:
        """Return the picture as PNG."""
        out = io.BytesIO()
        self.savefig(out, format="png", dpi=120)
        return out.getvalue()


# Labels

GREEK = (
    *("alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta", "theta", "kappa", "lambda", "mu", "nu", "xi"),
    *("pi", "rho", "sigma", "tau", "phi", "chi", "psi", "omega"),
)
_NAME = re.compile(rf"({'|'.join(GREEK)}|[a-zA-Z])(\d*)(?:_(\w+))?")


def symbol(name: str, attributes: Mapping[str, Any] | None = None) -> str:
    """Return a name for a label: its symbol if it has one, or Greek and single letters as mathematics."""
    if attributes and (declared := attributes.get("symbol")):
        return str(declared)
    match = _NAME.fullmatch(name)
    if match is None:
        return name.replace("_", " ")
    letter, digits, index = match.groups()
    power = digits if letter == "chi" else ""  # for all others the number is an index
    index = "_".join(part for part in (digits.removeprefix(power), index) if part)
    letter = rf"\{letter}" if letter in GREEK else letter
    index = index and (index if len(index) == 1 else rf"\mathrm{{{index.replace('_', ',')}}}")
    return f"${letter}{f'_{{{index}}}' if index else ''}{f'^{power}' if power else ''}$"


def label(array: xr.DataArray, name: str, unit: str | None = None) -> str:
    """Return the label of an axis: symbol and unit."""
    unit = units_of(array.attrs) if unit is None else unit
    return f"{symbol(name, array.attrs)} [{written(unit)}]" if unit else symbol(name, array.attrs)


def axis_label(dataset: xr.Dataset, axis: str) -> str:
    """Return the label of an axis; axes zipped with it that have the same values stand beside it."""
    dimension = dataset[axis].dims
    names = [str(n) for n, c in dataset.coords.items() if c.dims == dimension and n != axis and c.dtype.kind in "if"]
    same = [n for n in names if np.array_equal(dataset[n].values, dataset[axis].values)]
    return " = ".join(label(dataset[n], n) for n in (axis, *same))


def explained_label(array: xr.DataArray, name: str) -> str:
    """Return the label of an axis with its name in words before the symbol that the experiment gives it, unless that
    is the name.
    """
    words, declared = name.replace("_", " "), plain(str(array.attrs.get("symbol", "")))
    return " ".join(
        [*([words] if declared and declared.lower() not in (words.lower(), name.lower()) else []), label(array, name)]
    )


def quantity_label(dataset: xr.Dataset, variable: str) -> str:
    """Return the label of a variable, or of its one component that the dataset holds."""
    return label(with_chosen_component(dataset)[variable], variable)


def with_chosen_component(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset of one component in which what has a unit for each component has the symbol and the unit of
    that one; afterwards it may be brought to another unit without losing its symbol.
    """
    chosen = [n for n in map(str, dataset.coords) if not dataset[n].dims and f"{n}_unit" in dataset.coords]
    if not chosen:
        return dataset
    inside = ", ".join(symbol(str(dataset[n].item())) for n in chosen)
    unit = str(dataset[f"{chosen[0]}_unit"].item()) if len(chosen) == 1 else ""
    changed = {}
    for name, array in dataset.data_vars.items():
        units, is_product = units_of(array.attrs), f"_{COVARIANCE_SUFFIX}_" in str(name)
        if "," in units and "(" not in units and not is_product:  # nor that of a product of two components
            changed[name] = array.assign_attrs(symbol=f"{symbol(str(name), array.attrs)}({inside})", units=unit)
    return dataset.assign(changed)


def value_text(dataset: xr.Dataset, axis: str, value: Any) -> str:
    """Return a value of an axis as a legend names it."""
    if isinstance(value, str):
        return symbol(value) if _NAME.fullmatch(value) and "_" in value else value
    unit = written(units_of(dataset[axis].attrs))
    return f"{symbol(axis, dataset[axis].attrs)} = {number_in_words(value)}" + (f" {unit}" if unit else "")


def plain(text: str) -> str:
    """Return a text of a figure without mathematical markup.

    Examples:
        >>> plain(r"$\\sigma(\\omega)$ [mas/yr]"), plain(r"$V_\\mathrm{max}$")
        ('sigma(omega) [mas/yr]', 'V_max')
    """
    text = re.sub(r"\\(?:mathrm|overline|bar)\{?([^{}$]*)\}?", r"\1", text).replace(r"\pm", "±")
    return re.sub(r"[${}]|\\", "", text).replace("\n", " ")


# Scales

SCALE = "scale"  # the attribute of a variable whose axis was chosen: "log" or "linear"

# Numbers that span less than this factor are drawn on a logarithmic axis only if their ratios are equal: none is
# farther from its place among equal steps of the logarithm than this share of the axis.
WIDE_RATIO, EVEN = 5.0, 0.01


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
        study = FigureForm.model_validate(json.loads(dataset.attrs.get("study_document", "{}")).get("figure", {}))
    except (ValueError, TypeError, AttributeError) as error:
        raise SweepError(f"the table [figure] of the study cannot be read: {error}") from error
    marked = dataset.copy()
    for scale, names in (("log", study.log), ("linear", study.linear), ("log", log), ("linear", linear)):
        for name in filter(known.__contains__, names):
            marked[name].attrs[SCALE] = scale
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


def _unevenness(places: Array) -> float:
    """Return how far ascending places are at most from equal steps, as a share of their range."""
    return float(np.abs((places - places[0]) / (places[-1] - places[0]) - np.linspace(0.0, 1.0, len(places))).max())


def fit_scale(axes: Axes, which: str, array: xr.DataArray, few_ticks: bool = False) -> None:
    """Make an axis logarithmic where its numbers need it, and name truth values; ``few_ticks`` is for small panels."""
    if is_truth(array):
        axes.set(**{f"{which}ticks": [0.0, 1.0], f"{which}ticklabels": TRUTH["flag_meanings"].split()})
    elif is_logarithmic(array):
        logarithmic(axes, which, array.values, few_ticks)


def logarithmic(axes: Axes, which: str, values: Any, few_ticks: bool = False) -> None:
    """Make an axis logarithmic: if it spans less than two decades, all of its ticks, such as 1, 2 and 5, have numbers;
    with ``few_ticks`` there are at most four of these, and no more than five decades.
    """
    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known) & (known > 0.0)]
    span = known.max() / known.min() if known.size else 0.0
    if few_ticks and span >= 100.0:
        axis.set_major_locator(LogLocator(numticks=5))
        axis.set_minor_locator(NullLocator())
    elif 0.0 < span < 100.0:
        # below a factor of eight, ticks at 1, 2 and 5 of each decade are too few
        many: tuple[float, ...] = (1.0, 2.0, 5.0) if span > 8.0 else (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
        few = (1.0, 3.0) if span > 10.0 else (1.0, 2.0, 5.0)
        axis.set_major_locator(LogLocator(subs=few if few_ticks else many))
        axis.set_major_formatter(FuncFormatter(lambda value, _: number_text(value) if value > 0.0 else ""))
        axis.set_minor_formatter(NullFormatter())


def add_bar(figure: Figure, drawn: Any, array: xr.DataArray, text: str, **options: Any) -> None:
    """Add the colour bar of an array to a figure."""
    bar: Colorbar = figure.colorbar(drawn, label=text, **options)
    if isinstance(bar.norm, LogNorm):
        logarithmic(bar.ax, "y", [bar.norm.vmin, bar.norm.vmax])
    elif is_truth(array):
        bar.set_ticks([0.0, 1.0], labels=TRUTH["flag_meanings"].split())


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


# Axes and legends

SIMULATED, COMPUTED, PREDICTED, PUBLISHED = "simulated", "computed", "predicted", "published"  # simulated: with errors
MOVED = "markers moved sideways, lines not"


def series(number: int) -> dict[str, Any]:
    """Return colour and marker of the ``number``-th series of a panel."""
    return {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}


def marks(number: int, size: float, **options: Any) -> dict[str, Any]:
    """Return the style of the marks of the ``number``-th series, which no line joins."""
    return {**series(number), "linestyle": "none", "markersize": size, **options}


def finish(axes: Axes, grid: bool = True) -> None:
    """Give axes the light grid and ticks that all pictures have."""
    axes.tick_params(direction="in", which="both", top=True, right=True)
    if grid:
        axes.grid(alpha=0.25, linewidth=0.4)
        axes.set_axisbelow(True)


def legend(axes: Axes, **options: Any) -> None:
    """Draw a legend if there is more than one thing to tell apart."""
    entries = list(zip(*axes.get_legend_handles_labels(), strict=True))
    if len(entries) > 1:  # points before lines: matplotlib alone would put all error bars last
        entries.sort(key=lambda entry: not isinstance(entry[0], ErrorbarContainer))
        options.setdefault("loc", "best")  # given explicitly, matplotlib does not warn if it is slow
        axes.legend(*zip(*entries, strict=True), frameon=False, **options)


def legend_entries(figure: Figure) -> dict[str, Any]:
    """Return what the legends of a figure explain: the first artist of each label."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(text, handle)
    return entries


def legend_below(figure: Figure) -> None:
    """Draw one legend below all axes instead of one in each, where there is more than one thing to tell apart."""
    entries = legend_entries(figure)
    for axes in figure.axes:
        if (inside := axes.get_legend()) is not None:
            inside.remove()
    if len(entries) > 1:
        last = (PREDICTED, PUBLISHED, MOVED)  # these are the same for all series
        order = sorted(entries, key=lambda text: last.index(text) if text in last else -1)
        # an entry has 0.6 inches without its text, and 0.065 for each letter of 9 points
        width = float(mpl.rcParams["font.size"]) / 9.0 * (0.6 + 0.065 * max(map(_shown_letters, order)))
        columns = max(1, min(len(order), int(figure.get_figwidth() / width)))
        handles = [entries[text] for text in order]
        figure.legend(handles, order, loc="outside lower center", ncols=columns, frameon=False)
        grow(figure, -(-len(order) // columns))


def fit_names(figure: Figure) -> None:
    """Break the names below the axes of a whole figure into lines where they would cover each other, or turn them if
    that is not enough; then the panels keep their height.
    """
    figure.draw_without_rendering()
    longest = 0.0
    for axes in figure.axes:
        if not isinstance(axes.xaxis.get_major_locator(), FixedLocator) or not _names_cover(axes):
            continue
        places, texts = axes.get_xticks(), axes.get_xticklabels()
        names, line = [text.get_text() for text in texts], float(texts[0].get_fontsize()) * figure.dpi / 72.0
        (left, _), (right, _) = axes.get_xaxis_transform().transform([(0.0, 0.0), (1.0, 0.0)])  # names are at 0, 1, 2
        room = NAME_ROOM * (right - left)
        axes.set_xticks(places, [in_lines(name, room / figure.dpi, 1) for name in names])
        if _names_cover(axes):
            degrees = 45.0 if line < room * math.sin(math.radians(45.0)) else 90.0
            axes.set_xticks(places, names, rotation=degrees, rotation_mode="anchor", ha="right", va="center")
            longest = max(longest, *(text.get_window_extent().height - line for text in axes.get_xticklabels()))
    figure.set_figheight(figure.get_figheight() + longest / figure.dpi)


# The share of the distance between two names that they may take: a report makes figures smaller, not their letters.
NAME_ROOM = 0.78


def _names_cover(axes: Axes) -> bool:
    boxes = [text.get_window_extent() for text in axes.get_xticklabels() if text.get_visible() and text.get_text()]
    gaps = ((a.width + b.width, b.x0 + b.x1 - a.x0 - a.x1) for a, b in pairwise(boxes))
    return any(both > NAME_ROOM * apart for both, apart in gaps)
