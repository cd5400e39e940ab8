"""The caption of a figure, and a description for those who cannot see it, from the drawing and the results."""

import re

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sweep.analysis.answer import answer_in_short, answers, completeness
from sweep.formatting import first_of
from sweep.readable import with_micro_signs

MOST_PANELS = 6
"""The most panels whose titles a description names."""

SIGNS = {
    "simulated": "Points are simulated, with one-sigma errors.",
    "predicted": "Lines are predicted in closed form.",
    "published": "Open symbols are published.",
}
"""What entries of a legend mean."""


def caption_and_description(figure: Figure, dataset: xr.Dataset) -> str:
    """Return the text of a file beside a picture: its caption, and a description under a heading of its own."""
    return f"{caption(figure, dataset, with_answer=True)}\n\nAlternative text: {description(figure, dataset)}\n"


def caption(figure: Figure, dataset: xr.Dataset, with_answer: bool = False) -> str:
    """Return the caption: the title, what the signs mean, and on request the answer of the study."""
    title = str(dataset.attrs.get("title", "")).rstrip(".")
    entries = _entries(figure)
    signs = [words for entry, words in SIGNS.items() if entry in entries]
    is_study = "status" in dataset and with_answer
    sentences = [*completeness(dataset), *answer_in_short(dataset)] if is_study else []
    source = sorted({str(v.attrs["source"]) for v in dataset.data_vars.values() if "source" in v.attrs})
    published = [f"Published: {'; '.join(source)}."] if source and "published" in entries else []
    parts = [f"{title}." if title else "", *signs, *published, *map(with_micro_signs, sentences)]
    return " ".join(filter(None, parts))


def description(figure: Figure, dataset: xr.Dataset) -> str:
    """Return what is seen: the panels, what each draws against what, and the range of values."""
    panels = [axes for axes in figure.axes if axes.get_label() != "<colorbar>" and axes.axison]
    seen = list(dict.fromkeys(_of_panel(axes) for axes in panels))
    titles = [plain(axes.get_title()) for axes in panels if axes.get_title()]
    words = f"{len(panels)} panels, " if len(panels) > 1 else ""
    named = f" ({first_of(titles, MOST_PANELS, '; ')})" if titles else ""
    ranges = [answer.sentences[0] for answer in answers(dataset)[:1]] if "status" in dataset else []
    signs = [plain(entry) for entry in _entries(figure)]
    legend = [f"Legend: {', '.join(signs)}."] if len(signs) > 1 else []
    whole = [f"{words}{' and '.join(seen)}{named}.", *legend, *map(with_micro_signs, ranges)]
    return " ".join(whole)[:1].upper() + " ".join(whole)[1:]


def _of_panel(axes: Axes) -> str:
    what, over = _label(axes, "y"), _label(axes, "x")
    return f"{what or 'values'} against {over}" if over else what or "a picture"


def _label(axes: Axes, which: str) -> str:
    """Return the label of an axis, or that of the axes that share it and have one."""
    siblings = getattr(axes, f"get_shared_{which}_axes")().get_siblings(axes)
    labels = (getattr(one, f"get_{which}label")() for one in (axes, *siblings))
    return plain(next(filter(None, labels), ""))


def _entries(figure: Figure) -> list[str]:
    return list(dict.fromkeys(text for axes in figure.axes for text in axes.get_legend_handles_labels()[1]))


def plain(text: str) -> str:
    """Return a text of a figure without mathematical markup.

    Examples:
        >>> plain(r"$\\sigma(\\omega)$ [mas/yr]"), plain(r"$V_\\mathrm{max}$")
        ('sigma(omega) [mas/yr]', 'V_max')
    """
    text = re.sub(r"\\(?:mathrm|overline|bar)\{?([^{}$]*)\}?", r"\1", text)
    text = re.sub(r"\\pm", "±", text)
    return re.sub(r"[${}]|\\", "", text).replace("\n", " ")
