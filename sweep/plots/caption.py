"""The caption of a figure, and a description for those who cannot see it, from the drawing and the results."""

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from linksweep.sweep.analysis.answer import answers, completeness, conclusion_in_words
from linksweep.sweep.analysis.quantity import errors_beside, standard_error
from linksweep.sweep.formatting import first_of, with_micro_signs
from linksweep.sweep.plots import KINDS
from linksweep.sweep.plots.grid import ERROR_BAND, JOINED, LAW_BAND, PREDICTION_BAND
from linksweep.sweep.plots.style import MOVED, PREDICTED, PUBLISHED, legend_entries, plain, with_chosen_component

MOST_PANELS = 6  # that a description names
MOST_RANGES = 3  # quantities or components whose ranges are given
COLOUR_BAR = "<colorbar>"

UNLABELLED = {
    ERROR_BAND: "Bands join the errors of the points.",
    PREDICTION_BAND: "Bands are the one-sigma errors of the predictions.",
    LAW_BAND: "Bands are the one-sigma errors of the fitted laws.",
    JOINED: "Thin lines join the points.",
}
ASIDE = "Markers that cover each other are drawn a little to the left or right of their places; lines are not."


def caption_and_description(figure: Figure, dataset: xr.Dataset) -> str:
    """Return the text of a file beside a picture: its caption, and a description under a heading of its own."""
    return f"{caption(figure, dataset, with_answer=True)}\n\nAlternative text: {description(figure, dataset)}\n"


def caption(figure: Figure, dataset: xr.Dataset, with_answer: bool = False) -> str:
    """Return the caption: the title, what the signs mean, and on request the answer of the study, or else the ranges
    of what is drawn.
    """
    sentences = []
    if with_answer and "status" in dataset:
        sentences = [*completeness(dataset), *(conclusion_in_words(dataset) or _ranges(figure, dataset))]
    source = sorted({str(v.attrs["source"]) for v in dataset.data_vars.values() if "source" in v.attrs})
    published = [f"Published: {'; '.join(source)}."] if source and PUBLISHED in legend_entries(figure) else []
    parts = [_title(figure, dataset), *_signs(figure, dataset), *published, *map(with_micro_signs, sentences)]
    return " ".join(filter(None, parts))


def description(figure: Figure, dataset: xr.Dataset) -> str:
    """Return what is seen: the panels, what each draws against what, and the range of values."""
    panels = [axes for axes in figure.axes if axes.get_label() != COLOUR_BAR and axes.axison and axes.get_visible()]
    bars = [plain(axes.get_ylabel()) for axes in figure.axes if axes.get_label() == COLOUR_BAR and axes.get_ylabel()]
    titles = [plain(axes.get_title()) for axes in panels if axes.get_title()]
    signs = [plain(entry) for entry in legend_entries(figure)]
    parts = [
        f"{len(panels)} panels, " if len(panels) > 1 else "",
        first_of(list(dict.fromkeys(map(_panel_in_words, panels))), MOST_PANELS, "; "),
        f" ({first_of(titles, MOST_PANELS, '; ')})" if titles else "",
        f", coloured by {' and '.join(bars)}" if bars else "",
    ]
    legend = [f"Legend: {', '.join(signs)}."] if len(signs) > 1 else []
    whole = " ".join([f"{''.join(parts)}.", *legend, *map(with_micro_signs, _ranges(figure, dataset))])
    return whole[:1].upper() + whole[1:]


def _title(figure: Figure, dataset: xr.Dataset) -> str:
    """Return the title of results as a sentence, or what the kind of a figure of a link shows, and of which tables."""
    title = str(dataset.attrs.get("title", ""))
    if dataset.attrs.get("result") in KINDS:
        kind = KINDS[dataset.attrs["result"]].get(str(figure.get_label()))
        tables = figure.get_suptitle().replace("\n", "; ")
        title = ": ".join(filter(None, (kind.caption if kind else title, tables)))
    return title if not title or title.endswith((".", "?", "!")) else f"{title}."


def _signs(figure: Figure, dataset: xr.Dataset) -> list[str]:
    """Return a sentence for each kind of sign in a figure that its labels do not explain."""
    entries = legend_entries(figure)
    labels = {artist.get_label() for axes in figure.axes for artist in axes.get_children()}
    with_bars = [str(axes.get_label()) for axes in figure.axes if axes.get_label() in dataset and _has_error_bars(axes)]
    sentences = []
    if any(standard_error(dataset, name) is not None for name in with_bars):
        sentences.append("Points are simulated, with one-sigma errors.")
    declared = dict.fromkeys(bars[0] for name in with_bars if (bars := errors_beside(dataset, name)))
    sentences += [f"Error bars are {name}." for name in declared]
    if PREDICTED in entries:
        dashes = isinstance(entries[PREDICTED], Line2D)
        sentences.append(f"{'Dashes are predicted' if dashes else 'The prediction is'} in closed form.")
    if PUBLISHED in entries:
        sentences.append("Open symbols are published.")
    sentences += [words for label, words in UNLABELLED.items() if label in labels]
    return [*sentences, ASIDE] if MOVED in entries else sentences


def _has_error_bars(axes: Axes) -> bool:
    bars = [one for one in axes.containers if isinstance(one, ErrorbarContainer) and (one.has_xerr or one.has_yerr)]
    return any(str(one.get_label()).lstrip("_") != PUBLISHED for one in bars)


def _ranges(figure: Figure, dataset: xr.Dataset) -> list[str]:
    """Return a sentence about the values of each quantity that a figure draws: the labels of its axes."""
    if "status" not in dataset:
        return []
    sentences, variables = [], with_chosen_component(dataset).data_vars.items()
    for drawn in dict.fromkeys(str(axes.get_label()) for axes in figure.axes if axes.get_label() in dataset):
        alone = dataset.assign({name: array.assign_attrs(headline=name == drawn) for name, array in variables})
        for answer in answers(alone):
            meaning = f" ({answer.meaning})" if answer.meaning not in ("", answer.name) else ""
            sentences += [f"{answer.name}{meaning}: {sentence}" for sentence in answer.sentences[:1]]
    return sentences[:MOST_RANGES]


def _panel_in_words(axes: Axes) -> str:
    what, over = _label(axes, "y"), _label(axes, "x")
    return f"{what} against {over}" if what and over else what or over or "a picture"


def _label(axes: Axes, which: str) -> str:
    """Return the label of an axis, or that of the axes that share it and have one."""
    siblings = getattr(axes, f"get_shared_{which}_axes")().get_siblings(axes)
    labels = (getattr(one, f"get_{which}label")() for one in (axes, *siblings))
    return plain(next(filter(None, labels), ""))
