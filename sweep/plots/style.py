"""How figures look: colours, sizes, labels, scales with their ticks, legends, and files that are reproducible; and
their captions, and descriptions for those who cannot see them.
"""

import io
import json
import logging
import re
import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib import collections, colors, lines, patches, patheffects, ticker
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure

from linksweep.sweep import formatting
from linksweep.sweep.analysis import answer, quantity
from linksweep.sweep.contract import Array, SweepError, refused, shown, suggest
from linksweep.sweep.result import write_at_once
from linksweep.sweep.studies.study import FigureForm

# Safe for the colour-blind.  Source: Okabe & Ito 2008.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f7f7f", "#000000")
MARKERS = "osD^vP*X"
LINES: tuple[Any, ...] = ("solid", "dashed", "dashdot", "dotted", (0, (6, 1, 1, 1, 1, 1)), (0, (3, 1)))
BAND: Mapping[str, Any] = {"alpha": 0.22, "linewidth": 0.0}
HALO: Mapping[str, Any] = {"path_effects": [patheffects.withStroke(linewidth=2.0, foreground="white")]}  # of letters
GUIDE: Mapping[str, Any] = {"color": "black", "linewidth": 0.8, "linestyle": (0, (4, 3))}
DASH: Mapping[str, Any] = {"linestyle": "none", "marker": "_", "markeredgewidth": 1.2}

# Endings of pictures, with the metadata to leave out, because they would make two files of one picture differ.
FORMATS = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}

# Style sheets of matplotlib: what all figures have, and sizes of letters for a paper or a talk.
BASE, PAPER, TALK = (
    mpl.rc_params_from_file(str(Path(__file__).parent / "styles" / f"{name}.mplstyle"), use_default_template=False)
    for name in ("base", "paper", "talk")
)
TALK_MM = 250.0  # the default width of a figure in the style of a talk

# Sizes in letters, that is, in units of the font's size: the average width of a letter, the least width of a panel with
# labels and ticks, and that of a wide one.
LETTER_WIDTH, PANEL_WIDTH, WIDE = 0.58, 14.0, 25.0
BESIDE_INCHES = 0.5  # what the labels and ticks of a panel take of its width and height

MASK, BLANK = "\ue000\ue001", "\ue002"  # letters for private use, of which Unicode says that nobody else does
_SYMBOL = re.compile(r"(?<!\\)\$(?:[^$\\]|\\.)*\$")
_width: ContextVar[float | None] = ContextVar("width", default=None)


@contextmanager
def settings(width: float | None = None, style: str | None = None) -> Iterator[None]:
    """Make and save pictures with the settings of this package, except for those that the user has changed.

    ``width`` is that of figures in mm, by default each kind's own; ``style`` is "paper" or "talk".
    """
    if width is None and style == "talk":
        width = TALK_MM
    wanted = BASE | (TALK if style == "talk" else PAPER if style or width else {})
    ours = {key: value for key, value in wanted.items() if mpl.rcParams[key] == mpl.rcParamsDefault[key]}
    token = _width.set(None if width is None else width / 25.4)
    try:
        with mpl.rc_context(ours):
            yield
    finally:
        _width.reset(token)


# Figures, panels and files


class ShownFigure(Figure):
    """A figure that IPython can show as a picture: without pyplot, which this library does not import, a fresh kernel
    would show a figure as text.
    """

    def _repr_png_(self) -> bytes:
        """Return the picture as PNG."""
        out = io.BytesIO()
        self.savefig(out, format="png", dpi=120)
        return out.getvalue()


def in_letters(times: float) -> float:
    """Return so many times the size of letters, in inches."""
    return times * float(mpl.rcParams["font.size"]) / 72.0


def most_columns(columns: int, least: float = PANEL_WIDTH) -> int:
    """Return how many of the wanted columns of panels fit side by side, each at least so many letters wide."""
    width = _width.get()
    return columns if width is None else max(1, min(columns, int(width / in_letters(least))))


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, least: float = PANEL_WIDTH, n: int = 0, **more: Any
) -> tuple[Figure, list[Any]]:
    """Return a figure and its panels, row by row.

    It has the size in inches, or panels of about the same shape in the width asked for; panels that would be less than
    ``least`` letters wide there continue in further rows.  ``n`` is how many there are if not all places.
    ``more`` are options of `Figure.subplots`.
    """
    across, wanted, panels = most_columns(columns, least), _width.get(), n or rows * columns
    if wanted is not None:
        shape = (height / rows) / (width / columns)
        rows = -(-panels // across)
        # flat panels would have no room beside their labels, nor a single row beside title and legend
        height = max(rows * max(shape * wanted / across, in_letters(16.0)), in_letters(22.0)) + in_letters(3.0)
        width = wanted
    figure = ShownFigure(figsize=(width, height), layout="constrained")
    grid = list(figure.subplots(rows, across, squeeze=False, **more).flat)
    for axes in grid[panels:]:
        axes.remove()
    return figure, grid[:panels]


def panel_size(axes: Axes) -> tuple[float, float]:
    """Return about the width and height of a panel without its labels, in inches."""
    grid, figure = axes.get_gridspec(), axes.get_figure()
    width, height = figure.get_size_inches().tolist()  # type: ignore[union-attr]
    return width / grid.ncols - BESIDE_INCHES, height / grid.nrows - BESIDE_INCHES  # type: ignore[union-attr]


def in_lines(text: str, inches: float, least: int = 12) -> str:
    """Return a text in lines that are as long as a width allows, but of at least ``least`` letters.

    Examples:
        >>> print(in_lines("floor pm = 0 mas/yr, ratio = 1", 18.0 * in_letters(LETTER_WIDTH)))
        floor pm
        = 0 mas/yr,
        ratio = 1
    """
    letters, symbols = max(int(inches / in_letters(LETTER_WIDTH)), least), iter(_SYMBOL.findall(text))

    def whole(part: re.Match[str]) -> str:
        return part[0].replace(" ", BLANK) if len(part[0]) <= letters else part[0]

    # a symbol counts as the letters that are seen of it, and stays in one piece; so does "NAME = VALUE UNIT", or what
    # follows the name if that is too long, and a unit
    masked = _SYMBOL.sub(lambda symbol: MASK[0] + MASK[1] * (seen(symbol[0]) - 1), text)
    for pieces in (r"[^ ,\n][^,=:\n]*(?: =|:) [^,\n]*", r"= [^,\n]*", r"\[[^]\n]*\]"):
        masked = re.sub(pieces, whole, masked)
    whole_words: Any = {"break_long_words": False, "break_on_hyphens": False}
    wrapped = "\n".join(textwrap.fill(line, letters, **whole_words) for line in masked.split("\n")).replace(BLANK, " ")
    return re.sub(f"{MASK[0]}{MASK[1]}*", lambda _: next(symbols), wrapped)


def seen(text: str) -> int:
    """Return how many letters are seen of a text with mathematical markup.

    Examples:
        >>> seen(r"$\\epsilon_x$"), seen("no clip")
        (2, 7)
    """
    return len(re.sub(r"[_^]", "", plain(re.sub(rf"\\(?:var)?(?:{GREEK})(?![a-z])", "x", text))))


def require_format(path: Path, *others: str) -> None:
    """Raise SweepError unless a path ends like one of `FORMATS`, and name ``others``, which are not drawn."""
    if path.suffix.lower() not in FORMATS:
        raise SweepError(f"cannot draw there: the name must end with {', '.join([*others, *FORMATS])}", str(path))


def save(figure: Figure, path: Path, words: str = "") -> None:
    """Write a figure as PNG, SVG or PDF, whichever ``path`` ends with, without a date, and beside it NAME.txt with
    ``words`` if there are any; each is whole, or as it was.  Raises SweepError.
    """
    require_format(path)
    form, drawn = path.suffix.lower(), io.BytesIO()
    with warnings.catch_warnings(record=True) as caught:
        warnings.filterwarnings("always", message="Glyph")
        figure.savefig(drawn, format=form[1:], dpi=300, metadata=FORMATS[form])
    files = {path: drawn.getvalue()} | ({path.with_suffix(".txt"): words.encode()} if words else {})
    for file, content in files.items():
        write_at_once(file, partial(Path.write_bytes, data=content))
    if letters := dict.fromkeys(n for one in caught for n in re.findall(r"^Glyph (\d+) ", str(one.message))):
        lacking = "".join(chr(int(number)) for number in letters)
        words = f"the font lacks {lacking}, drawn as boxes; choose another as font.family in matplotlibrc"
        logging.getLogger("linksweep").warning("warning: %s: %s", path, words)


# Labels

GREEK = "alpha|beta|gamma|delta|epsilon|zeta|eta|theta|kappa|lambda|mu|nu|xi|pi|rho|sigma|tau|phi|chi|psi|omega"
_NAME = re.compile(rf"({GREEK}|[a-zA-Z])(\d*)(?:_(\w+))?")


def literal(text: Any) -> Any:
    """Return a text of which no dollar begins mathematics in a figure; anything else as it is.

    Examples:
        >>> print(literal("5 $ to 10 $"))
        5 \\$ to 10 \\$
    """
    return re.sub(r"(?<!\\)\$", r"\\$", text) if isinstance(text, str) else text


def with_literal_texts(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset with the texts of users, its title and those among its values, as `literal` has them."""
    texts = {n: array for n, array in dataset.variables.items() if array.dtype.kind in "OUT"}
    marked = {n: array for n, array in texts.items() if any("$" in str(text) for text in array.values.flat)}
    changed = {n: a.copy(data=np.vectorize(literal, otypes="O")(a.values.astype(object))) for n, a in marked.items()}
    return dataset.assign(changed).assign_attrs(title=literal(dataset.attrs.get("title", "")))


def symbol(name: str, attributes: Mapping[str, Any] | None = None) -> str:
    """Return a name for a label: its symbol if it has one, or Greek and single letters as mathematics."""
    if attributes and (declared := attributes.get("symbol")):
        return str(declared)
    if unnamed := re.fullmatch(r"\w+_dim_(\d+)", name):  # xarray's name of a dimension
        return f"index\u00a0{unnamed[1]}"  # in one piece
    match = _NAME.fullmatch(name)
    if match is None:
        return name.replace("_", " ")
    letter, digits, index = match.groups()
    power = digits if letter == "chi" else ""  # for all others the number is an index
    index = ",".join(part for part in (digits.removeprefix(power), *(index or "").split("_")) if part)
    letter = rf"\{letter}" if len(letter) > 1 else letter
    below = "" if not index else f"_{{{index}}}" if len(index) == 1 else rf"_{{\mathrm{{{index}}}}}"
    return f"${letter}{below}{f'^{power}' if power else ''}$"


def component_symbol(name: str) -> str:
    """Return the symbol of a component, an unknown of a link: of a vector's component, of a harmonic with its degree
    and order, or a name.
    """
    if vector := re.match(r"(epsilon|omega|glide|position_glide)_([xyz])", name):
        block, axis = vector.groups()
        letter = {"glide": "g", "position_glide": "G"}.get(block, rf"\{block}")
        return rf"${letter}_{axis}$" + name[vector.end() :]
    if harmonic := re.fullmatch(r"vsh_(?:position|motion)_([ts])_(\d+)_(\d+)(?:_(re|im))?", name):
        kind, degree, order, part = harmonic.groups()
        above = rf"^\mathrm{{{part.capitalize()}}}" if part else ""
        return rf"${kind}_{{{degree},{order}}}{above}$"
    return r"$\varpi_0$" if name == "parallax_zero_point" else symbol(name)


def label(array: xr.DataArray, name: str, unit: str | None = None) -> str:
    """Return the label of an axis: symbol and unit."""
    unit = formatting.units_of(array.attrs) if unit is None else unit
    return symbol(name, array.attrs) + (f" [{formatting.written(unit)}]" if unit else "")


def axis_label(dataset: xr.Dataset, axis: str) -> str:
    """Return the label of an axis; axes zipped with it that have the same values stand beside it."""
    alike = [str(n) for n, c in dataset.coords.items() if c.dims == dataset[axis].dims and c.dtype.kind in "if"]
    same = [n for n in alike if n != axis and np.array_equal(dataset[n].values, dataset[axis].values)]
    return " = ".join(label(dataset[n], n) for n in (axis, *same))


def explained_label(array: xr.DataArray, name: str) -> str:
    """Return the label of an axis after its name in words, unless these are the symbol."""
    words, declared = name.replace("_", " "), plain(str(array.attrs.get("symbol", ""))).lower()
    beside = declared not in ("", words.lower(), name.lower())
    return f"{words} {label(array, name)}" if beside else label(array, name)


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
    inside = ", ".join(component_symbol(str(dataset[n].item())) for n in chosen)
    unit = str(dataset[f"{chosen[0]}_unit"].item()) if len(chosen) == 1 else ""
    changed = {}
    for name, array in dataset.data_vars.items():
        units = formatting.units_of(array.attrs)
        # a product of two components has a unit of its own
        if "," in units and "(" not in units and f"_{quantity.COVARIANCE_SUFFIX}_" not in str(name):
            changed[name] = array.assign_attrs(symbol=f"{symbol(str(name), array.attrs)}({inside})", units=unit)
    return dataset.assign(changed)


def value_text(dataset: xr.Dataset, axis: str, value: Any) -> str:
    """Return a value of an axis as a legend names it."""
    array, name = dataset[axis], symbol(axis, dataset[axis].attrs)
    if array.dtype.kind == "M":
        return str(value).replace("T", " ")
    if formatting.is_missing(value) or str(value).lower() in ("", "none"):  # the parameter has no effect there
        return f"no {name}"
    value = bool(value) if formatting.is_truth(array) else value
    text = formatting.harmless(quantity.value_in_words(dataset, axis, value))
    if known := json.loads(array.attrs.get("symbols", "{}")).get(str(value).replace(r"\$", "$")):
        return str(known)
    if f"{axis}_unit" in dataset.coords or ("_" in text and _NAME.fullmatch(text)):
        return component_symbol(text)
    return f"{name} = {text} {formatting.written(formatting.units_of(array.attrs))}".rstrip()


def values_text(dataset: xr.Dataset, values: Mapping[str, Any]) -> str:
    """Return values of axes as a legend names them."""
    return ", ".join(value_text(dataset, axis, value) for axis, value in values.items())


def plain(text: str) -> str:
    """Return a text of a figure without mathematical markup.

    Examples:
        >>> plain(r"$\\sigma(\\omega)$ [mas/yr]"), plain(r"$V_\\mathrm{max}$")
        ('sigma(omega) [mas/yr]', 'V_max')
    """
    text = re.sub(r"\\(?:mathrm|overline|bar)\{?([^{}$]*)\}?", r"\1", text).replace(r"\pm", "±").replace(r"\,", " ")
    return re.sub(r"\\(\$)|[${}]|\\", r"\1", text).replace("\n", " ")


# Scales

SCALE = "scale"  # the attribute of a variable whose axis was chosen: "log" or "linear"

# Numbers that span less than this factor are drawn on a logarithmic axis only if their ratios are equal: none is
# farther from its place among equal steps of the logarithm than this share of the axis.
WIDE_RATIO, EVEN = 5.0, 0.01
LEAST = 1e-286  # below it matplotlib shows numbers on a linear axis as 0
PLAIN = 1e-3, 1e4  # a logarithmic axis between these has no powers of ten


def with_scales(dataset: xr.Dataset, log: Sequence[str] = (), linear: Sequence[str] = ()) -> xr.Dataset:
    """Return a dataset in which variables have the scale that its study chose, or that is chosen here.

    Raises SweepError for a name that has no numbers here or is in both, and for a study whose choice cannot be read.
    """
    numbers = [str(name) for name, array in dataset.variables.items() if array.dtype.kind in "if"]
    known = [name for name in numbers if not formatting.is_truth(dataset[name])]
    if wrong := [name for name in (*log, *linear) if name not in known]:
        raise SweepError(f"{shown(wrong[0])} has no scale to choose{suggest(wrong[0], known)}")
    if both := set(log) & set(linear):
        raise SweepError(f"{min(both)} cannot have both a logarithmic and a linear axis")
    study = form_of(dataset)
    marked = dataset.copy()
    for scale, names in (("log", study.log), ("linear", study.linear), ("log", log), ("linear", linear)):
        for name in filter(known.__contains__, names):
            marked[name].attrs[SCALE] = scale
    return marked


def form_of(dataset: xr.Dataset) -> FigureForm:
    """Return what the study of a dataset says about its figure; raises SweepError where that cannot be read."""
    with refused(ValueError, TypeError, AttributeError, said="the table [figure] of the study cannot be read: "):
        return FigureForm.model_validate(json.loads(dataset.attrs.get("study_document", "{}")).get("figure", {}))


def is_logarithmic(array: xr.DataArray, *beside: xr.DataArray) -> bool:
    """Return whether numbers are drawn on a logarithmic axis: as was chosen, or by their spacing.

    Equal steps make it linear, equal ratios logarithmic.  Others, such as results, have the scale on which they are
    nearer to equal steps, the logarithmic one only where they span more than `WIDE_RATIO`.  Numbers that are logarithms
    already have a linear one, and so do those with others ``beside`` them that are not above zero.  Raises SweepError
    where a logarithmic axis is wanted for numbers not above zero.
    """
    known = np.unique(array.values.astype(float))
    known = known[np.isfinite(known)]
    if array.attrs.get(SCALE) == "log" and known.size and known[0] <= 0.0:
        raise SweepError(f"{array.name} = {formatting.plain(known)[0]}: a logarithmic axis has only numbers above zero")
    if SCALE in array.attrs:
        return bool(array.attrs[SCALE] == "log")
    is_seen = not any((one <= 0.0).any() for one in (array, *beside))
    if known.size < 3 or not is_seen or formatting.units_of(array.attrs) in formatting.LOGARITHMIC_UNITS:
        return False
    of_steps, of_ratios = unevenness(known), unevenness(np.log(known))
    is_wide = bool(known[-1] > WIDE_RATIO * known[0])
    return of_ratios < of_steps and (is_wide or of_ratios < EVEN < 10.0 * of_steps)  # close numbers have even steps too


def unevenness(places: Array) -> float:
    """Return how far ascending places are at most from equal steps, as a share of their range."""
    return float(np.abs((places - places[0]) / (places[-1] - places[0]) - np.linspace(0.0, 1.0, len(places))).max())


def fit_scale(axes: Axes, which: str, array: xr.DataArray) -> None:
    """Make an axis logarithmic where its numbers need it, name truth values, and put no ticks between integers."""
    if formatting.is_truth(array):
        names = formatting.TRUTH["flag_meanings"].split()
        axes.set(**{f"{which}ticks": [0.0, 1.0], f"{which}ticklabels": names})
    elif is_logarithmic(array):
        logarithmic(axes, which, array.values)
    elif 0.0 < np.fmax.reduce(abs(array.values.astype(float)), axis=None) < LEAST:
        raise SweepError(f"{array.name} has only numbers below {LEAST:g}, which a linear axis cannot show")
    else:
        if array.dtype.kind == "i":
            integers = ticker.MaxNLocator("auto", integer=True, steps=[1, 2, 5, 10])
            (axes.xaxis if which == "x" else axes.yaxis).set_major_locator(integers)
        if array.name in array.coords and SCALE not in array.attrs:
            _spread(axes, which, array.values.astype(float))


def _spread(axes: Axes, which: str, values: Array) -> None:
    """Make the axis of a grid whose values, not all above zero, would fall together logarithmic on both sides of zero,
    with ticks at these, if they are twice as even there.  Zero is as far from the smallest as this is from the next.
    """
    known = np.unique(values[np.isfinite(values)])
    sizes = np.unique(abs(known[known != 0.0]))
    if len(sizes) < 2 or known[0] > 0.0 or sizes[0] < 1e-99 * sizes[-1] or np.diff(known).min() > EVEN * np.ptp(known):
        return  # matplotlib draws no more decades
    step = float(np.log10(sizes[1] / sizes[0]))
    places = np.sign(known) * (step + np.log10(np.fmax(abs(known), sizes[0])) - np.log10(sizes[0]))
    if 2.0 * unevenness(places) < unevenness(known):
        getattr(axes, f"set_{which}scale")("symlog", linthresh=sizes[0], linscale=0.9 * step)
        ticks = known[:: int(np.ceil(in_letters(4.0) * len(known) / panel_size(axes)[which == "y"]))]
        getattr(axes, f"set_{which}ticks")(ticks, list(map(number_text, ticks)))


def logarithmic(axes: Axes, which: str, values: Any) -> None:
    """Make an axis logarithmic.  Numbers within `PLAIN`, and those of less than two decades, are written as people do;
    the latter have ticks such as 1, 2 and 5.
    """
    axis = axes.xaxis if which == "x" else axes.yaxis
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known) & (known > 0.0)]
    if is_far := bool(((known < 1e-250) | (known > 1e250)).any()):
        getattr(axes, f"set_{which}margin")(0.0)  # of another margin, and of the next tick, the end may be no float
    axes.set(**{f"{which}scale": "log"})
    with np.errstate(over="ignore"):
        span = known.max() / known.min() if known.size else 0.0
    whole = PLAIN[0] <= known.min() and known.max() <= PLAIN[1] if known.size else False
    if whole or 0.0 < span < 100.0:
        axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: number_text(value) if value > 0.0 else ""))
        axis.set_minor_formatter(ticker.NullFormatter())
        room = min(panel_size(axes)) / in_letters(1.0) if axes.get_gridspec() is not None else np.inf
        # below a factor of eight, ticks at 1, 2 and 5 of each decade are too few, and below two those of equal ratios
        many = (1.0, 2.0, 5.0) if span > 8.0 else (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
        few = (1.0, 2.0, 5.0) if span <= 10.0 else (1.0, 3.0) if room > 7.0 else (1.0,)
        subs = (1.0,) if span >= 100.0 else many if room > 12.0 else few
        equal = ticker.MaxNLocator(8 if room > 12.0 else 4, steps=[1, 2, 2.5, 5, 10])
        axis.set_major_locator(ticker.LogLocator(subs=subs, numticks=9) if span > 2.0 else equal)
    elif is_far:
        powers = np.array(ticker.MaxNLocator(6, integer=True).tick_values(*np.log10([known.min(), known.max()])))
        axis.set_major_locator(ticker.FixedLocator(10.0 ** powers[np.abs(powers) < 308.0]))
        axis.set_minor_locator(ticker.NullLocator())


def name_ticks(axes: Axes, which: str, names: Sequence[str]) -> None:
    """Put names at 0, 1, 2, ... of an axis: in lines that fit, or below it turned where no lines would; only some of
    more names than lines of text have room.
    """
    # letters have few parts above or below others: lines can be read at 0.8 of their size
    last, step = len(names) - 0.5, int(np.ceil(in_letters(0.8) * len(names) / panel_size(axes)[which == "y"]))
    names = names[::step]
    # a report makes figures smaller, not their letters; beside an axis there is an inch
    room = 0.78 * panel_size(axes)[0] / len(names) if which == "x" else 1.1
    broken, look = [in_lines(name, room, 1) for name in names], dict[str, Any]()
    longest = max(seen(line) for text in broken for line in text.split("\n"))
    if which == "x" and in_letters(LETTER_WIDTH) * longest > room:
        turned = 45.0 if room > in_letters(1.4) else 90.0
        figure: Any = axes.figure
        if axes is figure.axes[0]:  # panels keep their height
            below = in_letters(LETTER_WIDTH) * max(map(seen, names)) * np.sin(np.radians(turned))
            figure.set_figheight(figure.get_figheight() + below)
        broken, look = list(names), {"rotation": turned, "rotation_mode": "anchor", "ha": "right", "va": "center"}
    getattr(axes, f"set_{which}ticks")(range(0, len(names) * step, step), broken, **look)
    axes.set(**{f"{which}lim": (-0.5, last)})


def draw_beside(axes: Axes, which: str, names: Sequence[str], parts: Mapping[str, tuple[Any, Any]]) -> None:
    """Draw several numbers with their errors at each name along an axis, beside each other and with a line at 0;
    ``parts`` are all of a kind by its label.
    """
    places = np.arange(len(names))
    for number, (words, (values, errors)) in enumerate(parts.items()):
        aside = 0.6 * ((number + 0.5) / len(parts) - 0.5)
        look = marks(number, 4.0, elinewidth=1.0, label=words)
        if which == "x":
            axes.errorbar(places + aside, values, yerr=errors, **look)
        else:  # the first is above the others
            axes.errorbar(values, places - aside, xerr=errors, **look)
    (axes.axhline if which == "x" else axes.axvline)(0.0, color="0.6", linewidth=0.6, zorder=0)
    name_ticks(axes, which, names)


def add_bar(figure: Figure, drawn: Any, array: xr.DataArray, text: str, **options: Any) -> None:
    """Add the colour bar of an array to a figure."""
    axes = figure.colorbar(drawn, label=text, **options).ax
    fit_scale(axes, "y", array)
    if isinstance(drawn.norm, colors.LogNorm):
        logarithmic(axes, "y", array.values)


def number_text(value: float) -> str:
    """Return a number of few digits as ticks and contours show it.

    Examples:
        >>> number_text(1000.0), number_text(-0.25), number_text(2e6)
        ('1000', '-0.25', '$2\\\\times10^{6}$')
    """
    digits, _, power = f"{value:.2e}".partition("e")
    if -4 <= int(power) <= 4:
        return f"{value:g}"
    factor = {"1.00": "", "-1.00": "-"}.get(digits, rf"{float(digits):g}\times")
    return f"${factor}10^{{{int(power)}}}$"


# Marks and legends

SIMULATED, COMPUTED, PREDICTED, PUBLISHED = "simulated", "computed", "predicted", "published"  # simulated: with errors
MOVED = "markers moved sideways, lines not"
MOST_VECTORS = 2000  # more points than this are drawn as one image: in SVG each of them takes some 100 bytes
AT_END = "_at its end: "  # how the labels of lines begin that are named at their ends and not in the legend


def series(number: int, steps: int = 0) -> dict[str, Any]:
    """Return colour, marker and line of the ``number``-th series of a panel: of a palette of names, or of a ramp of
    steps, whose lines are solid.
    """
    ramp = colors.to_hex(mpl.colormaps["viridis"](0.85 * number / (steps - 1))) if steps else ""
    colour, line = ramp or COLOURS[number % len(COLOURS)], "solid" if steps else LINES[number % len(LINES)]
    return {"color": colour, "marker": MARKERS[number % len(MARKERS)], "linestyle": line}


def marks(number: int, size: float, **options: Any) -> dict[str, Any]:
    """Return the style of the marks of the ``number``-th series, which no line joins."""
    return {**series(number), "linestyle": "none", "markersize": size, **options}


def draw_cloud(axes: Axes, both: Array, words: str) -> None:
    """Draw pairs of numbers, (2, n), as dots that are the smaller the more there are."""
    size, colour = float(np.clip(100.0 / np.sqrt(both.shape[1]), 2.0, 6.0)), COLOURS[0]
    axes.plot(*both, ".", color=colour, markersize=size, markeredgewidth=0.0, alpha=0.4)
    axes.plot([], [], ".", color=colour, label=words)  # large enough for the legend


def draw_ellipse(axes: Axes, centre: Array, covariance: Array, confidence: float, **look: Any) -> None:
    """Draw the ellipse that holds a share ``confidence`` of a normal distribution of two numbers."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2.0 * np.sqrt(np.maximum(values, 0.0) * -2.0 * np.log1p(-confidence))
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    axes.add_patch(patches.Ellipse(tuple(centre), width, height, angle=angle, fill=False, linewidth=1.2, **look))


def labelled(axes: Axes) -> list[Any]:
    """Return what may have a label in a panel: lines, and points with errors."""
    return [*axes.containers, *axes.lines]


def panels_of(figure: Figure) -> list[Axes]:
    """Return the panels that are shown, without colour bars."""
    return [axes for axes in figure.axes if axes.get_visible() and axes.get_label() != "<colorbar>"]


def complete(figure: Figure, title: str) -> None:
    """Write the title of a figure, in lines that fit it, and the legend if it has none yet, and give its panels the
    light grid and ticks that all pictures have, except for maps, whose colours it would cover.
    """
    for artist in figure.findobj():
        points = artist.get_xdata() if isinstance(artist, lines.Line2D) else ()
        places = artist.get_offsets() if isinstance(artist, collections.PathCollection) else ()
        if max(np.size(points), np.size(places) // 2) > MOST_VECTORS:
            artist.set_rasterized(True)
    for axes in panels_of(figure):
        if axes.name == "rectilinear" and not any(isinstance(one, collections.QuadMesh) for one in axes.collections):
            axes.tick_params(direction="in", which="both", top=True, right=True)
            axes.grid(alpha=0.25, linewidth=0.4)
            axes.set_axisbelow(True)
    figure.suptitle(in_lines(title, figure.get_figwidth(), 20), fontsize="medium")
    if not figure.legends:
        legend(figure)


def legend_entries(figure: Figure) -> dict[str, Any]:
    """Return what the legends of a figure explain: the first artist of each label, points before lines."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(text, handle)
    return dict(sorted(entries.items(), key=lambda entry: not isinstance(entry[1], ErrorbarContainer)))


def legend(figure: Figure, least: int = 2, **options: Any) -> None:
    """Draw the legend of a figure below its panels, which it never covers, if there are ``least`` things to explain
    that are not named beside an axis.
    """
    beside = {text.get_text() for axes in panels_of(figure) for text in axes.get_yticklabels()}
    entries = {text: handle for text, handle in legend_entries(figure).items() if text not in beside}
    if len(entries) < least:
        return
    lines = [in_lines(text, figure.get_figwidth() - in_letters(5.0)) for text in entries]
    longest = max(seen(line) for text in lines for line in text.split("\n"))
    columns = max(1, min(len(lines), int(figure.get_figwidth() / in_letters(4.5 + 0.46 * longest))))  # with their signs
    figure.legend(entries.values(), lines, loc="outside lower center", ncols=columns, frameon=False, **options)
    rows = 1 - (-"\n".join(lines).count("\n") // columns)
    figure.set_figheight(figure.get_figheight() + rows * in_letters(1.5))  # panels keep their height


# Captions

# Labels that a caption has as sentences; matplotlib leaves labels that begin with _ out of legends.
ERROR_BAND = "_Bands join the errors of the points."
PREDICTION_BAND = "_Vertical bars behind dashes are the one-sigma errors of the predictions."
LAW_BAND = "_Bands are the one-sigma errors of the fitted laws."
JOINED = "_Thin lines join the points."
ALONE = "_Markers are points without a neighbour on their line."
RUNNING = "_Markers with a white centre are values so far, of points that are not done."
WITHOUT = "_Dotted lines are points on which the parameter along the axis has no effect."
SENTENCES = (ERROR_BAND, PREDICTION_BAND, LAW_BAND, JOINED, ALONE, RUNNING, WITHOUT)
MOST_DESCRIBED = 6  # that a description names
MOST_RANGES = 3  # quantities or components whose ranges a caption gives


def caption_and_description(figure: Figure, dataset: xr.Dataset) -> str:
    """Return the text of a file beside a picture: its caption, and a description under a heading of its own."""
    return f"{caption(figure, dataset, with_answer=True)}\n\nAlternative text: {description(figure, dataset)}\n"


def caption(figure: Figure, dataset: xr.Dataset, with_answer: bool = False) -> str:
    """Return the caption: the title, what the signs mean, and on request the answer of the study, or else the ranges
    of what is drawn.
    """
    title = str(figure.get_label() or figure.get_suptitle()).replace(r"\$", "$").replace("\n", " ")
    parts = [f"{title}." if title and not title.endswith((".", "?", "!")) else title, *_signs(figure, dataset)]
    if with_answer and "status" in dataset:
        sentences = answer.conclusion_in_words(dataset) or _ranges(figure, dataset)
        parts += map(formatting.with_micro_signs, [*answer.completeness(dataset), *sentences])
    return " ".join(filter(None, parts))


def description(figure: Figure, dataset: xr.Dataset) -> str:
    """Return what is seen: the panels, what each draws against what, and the range of values."""
    panels, signs = panels_of(figure), list(legend_entries(figure))
    labels = (str(artist.get_label()) for axes in panels for artist in labelled(axes))
    signs += [label.removeprefix(AT_END) for label in labels if label.startswith(AT_END)]
    bars = [axes.get_ylabel() or axes.get_xlabel() for axes in figure.axes if axes.get_label() == "<colorbar>"]
    drawn = (" against ".join(filter(None, [_label(axes, "y"), _label(axes, "x")])) or "a picture" for axes in panels)
    titles = formatting.first_of([title for axes in panels if (title := axes.get_title())], MOST_DESCRIBED, "; ")
    parts = [
        f"Drawn: {formatting.first_of(list(dict.fromkeys(drawn)), MOST_DESCRIBED, '; ')}",
        ": ".join(filter(None, [f"{len(panels)} panels", titles])) if len(panels) > 1 else "",
        f"Colours: {' and '.join(bars)}" if bars else "",
        f"Legend: {', '.join(signs)}" if len(signs) > 1 else "",
    ]
    sentences = [f"{text}." for text in map(plain, filter(None, parts))]
    return " ".join([*sentences, *map(formatting.with_micro_signs, _ranges(figure, dataset))])


def _signs(figure: Figure, dataset: xr.Dataset) -> list[str]:
    """Return a sentence for each kind of sign in a figure that its labels do not explain."""
    entries = legend_entries(figure)
    labels = {artist.get_label() for axes in figure.axes for artist in (*axes.get_children(), *labelled(axes))}
    points = [(axes, one) for axes in figure.axes for one in axes.containers if isinstance(one, ErrorbarContainer)]
    ours = [(axes, one) for axes, one in points if str(one.get_label()).lstrip("_") != PUBLISHED]
    with_bars = {axes.get_label() for axes, one in ours if one.has_xerr or one.has_yerr}
    names, sentences = [name for name in _drawn(figure, dataset) if name in with_bars], list[str]()
    if any(quantity.standard_error(dataset, name) is not None for name in names):
        sentences.append("Points are simulated, with one-sigma errors.")
    declared = dict.fromkeys(bars[0] for name in names if (bars := quantity.errors_beside(dataset, name)))
    sentences += [f"Error bars are {name}." for name in declared]
    if PREDICTED in entries:
        sentences.append("Predictions are in closed form.")
    if PUBLISHED in entries:
        sources = sorted({str(v.attrs["source"]) for v in dataset.data_vars.values() if "source" in v.attrs})
        sentences.append(": ".join(filter(None, ["Open symbols are published", "; ".join(sources)])) + ".")
    sentences += [label[1:] for label in SENTENCES if label in labels]
    for name in _drawn(figure, dataset):
        if dataset[name].dtype.kind == "f" and (n := int(np.isinf(dataset[name]).sum())):
            sentences.append(f"Not drawn: {formatting.counted(n, 'infinite value')} of {name}.")
    return sentences


def _drawn(figure: Figure, dataset: xr.Dataset) -> dict[str, None]:
    """Return the quantities that a figure draws: the labels of its axes."""
    return dict.fromkeys(str(axes.get_label()) for axes in figure.axes if axes.get_label() in dataset)


def _ranges(figure: Figure, dataset: xr.Dataset) -> list[str]:
    """Return a sentence about the values of each quantity that a figure draws."""
    some = answer.answers(dataset, variables=_drawn(figure, dataset)) if "status" in dataset else ()
    return [one.in_short for one in some][:MOST_RANGES]


def _label(axes: Axes, which: str) -> str:
    """Return the label of an axis, or that of the axes that share it and have one."""
    siblings = getattr(axes, f"get_shared_{which}_axes")().get_siblings(axes)
    labels = (getattr(one, f"get_{which}label")() for one in (axes, *siblings))
    return next(filter(None, labels), "")
