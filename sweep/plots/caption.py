"""The caption of a figure, and a description for those who cannot see it, from the drawing and the results."""

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from linksweep.sweep.analysis.answer import answers, completeness, conclusion_in_words
from linksweep.sweep.formatting import first_of, with_micro_signs
from linksweep.sweep.plots.kinds import LINK
from linksweep.sweep.plots.labels import plain, with_chosen_component
from linksweep.sweep.plots.signs import PUBLISHED, drawn_variables, entries, signs_in_words

MOST_PANELS = 6
"""The most panels that a description names."""

MOST_RANGES = 3
"""The most quantities or components whose ranges are given."""

COLOUR_BAR = "<colorbar>"


def caption_and_description(figure: Figure, dataset: xr.Dataset) -> str:
    """Return the text of a file beside a picture: its caption, and a description under a heading of its own."""
    return f"{caption(figure, dataset, with_answer=True)}\n\nAlternative text: {description(figure, dataset)}\n"


def caption(figure: Figure, dataset: xr.Dataset, with_answer: bool = False) -> str:
    """Return the caption: the title, what the signs mean, and on request the answer of the study, or else the ranges
    of what is drawn.
    """
    is_study = "status" in dataset and with_answer
    found = (conclusion_in_words(dataset) or _ranges(figure, dataset)) if is_study else []
    source = sorted({str(v.attrs["source"]) for v in dataset.data_vars.values() if "source" in v.attrs})
    published = [f"Published: {'; '.join(source)}."] if source and PUBLISHED in entries(figure) else []
    sentences = [*completeness(dataset), *found] if is_study else []
    parts = [_title(figure, dataset), *signs_in_words(figure, dataset), *published, *map(with_micro_signs, sentences)]
    return " ".join(filter(None, parts))


def description(figure: Figure, dataset: xr.Dataset) -> str:
    """Return what is seen: the panels, what each draws against what, and the range of values."""
    panels = [axes for axes in figure.axes if axes.get_label() != COLOUR_BAR and axes.axison and axes.get_visible()]
    seen = first_of(list(dict.fromkeys(_of_panel(axes) for axes in panels)), MOST_PANELS, "; ")
    titles = [plain(axes.get_title()) for axes in panels if axes.get_title()]
    words = f"{len(panels)} panels, " if len(panels) > 1 else ""
    named = f" ({first_of(titles, MOST_PANELS, '; ')})" if titles else ""
    bars = [plain(axes.get_ylabel()) for axes in figure.axes if axes.get_label() == COLOUR_BAR and axes.get_ylabel()]
    colours = f", coloured by {' and '.join(bars)}" if bars else ""
    signs = [plain(entry) for entry in entries(figure)]
    legend = [f"Legend: {', '.join(signs)}."] if len(signs) > 1 else []
    ranges = map(with_micro_signs, _ranges(figure, dataset))
    whole = " ".join([f"{words}{seen}{named}{colours}.", *legend, *ranges])
    return whole[:1].upper() + whole[1:]


def _title(figure: Figure, dataset: xr.Dataset) -> str:
    """Return the title of results as a sentence, or what the kind of a figure of a link shows, and of which tables."""
    title = str(dataset.attrs.get("title", ""))
    if dataset.attrs.get("result") in LINK:
        shown = LINK[dataset.attrs["result"]].get(str(figure.get_label()))
        tables = figure.get_suptitle().replace("\n", "; ")
        title = ": ".join(filter(None, (shown.caption if shown else title, tables)))
    return title if not title or title.endswith((".", "?", "!")) else f"{title}."


def _ranges(figure: Figure, dataset: xr.Dataset) -> list[str]:
    """Return a sentence about the values of each quantity that a figure draws."""
    if "status" not in dataset:
        return []
    found, variables = [], with_chosen_component(dataset).data_vars.items()
    for name in drawn_variables(figure, dataset):
        alone = dataset.assign({n: variable.assign_attrs(headline=n == name) for n, variable in variables})
        for answer in answers(alone):
            meaning = f" ({answer.meaning})" if answer.meaning not in ("", answer.name) else ""
            found += [f"{answer.name}{meaning}: {sentence}" for sentence in answer.sentences[:1]]
    return found[:MOST_RANGES]


def _of_panel(axes: Axes) -> str:
    what, over = _label(axes, "y"), _label(axes, "x")
    return f"{what} against {over}" if what and over else what or over or "a picture"


def _label(axes: Axes, which: str) -> str:
    """Return the label of an axis, or that of the axes that share it and have one."""
    siblings = getattr(axes, f"get_shared_{which}_axes")().get_siblings(axes)
    labels = (getattr(one, f"get_{which}label")() for one in (axes, *siblings))
    return plain(next(filter(None, labels), ""))
