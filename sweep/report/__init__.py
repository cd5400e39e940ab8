"""Results to read: one HTML page (`page`), and here the card of an answer, which is question, answer and figure in a
notebook and sentences anywhere else.
"""

import base64
import io
from dataclasses import dataclass
from html import escape

import xarray as xr

from linksweep.sweep.analysis.answer import answer_in_short, completeness
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import harmless, with_micro_signs
from linksweep.sweep.result import Result


@dataclass(frozen=True)
class Card:
    """What results say: ``print`` shows the sentences, a notebook the figure too.

    ``sentences`` are those of the answer, after what is missing if the results are incomplete; a link or a forecast of
    real tables has the ``table`` of its unknowns instead.
    """

    title: str
    question: str
    sentences: list[str]
    dataset: xr.Dataset
    table: str = ""

    def __repr__(self) -> str:
        return harmless("\n".join(filter(None, [self.question or self.title, *self.sentences, self.table])))

    def _repr_html_(self) -> str:
        """Return the card; colours are those of the notebook, in either theme."""
        heading = f"<p><strong>{escape(self.question or self.title)}</strong></p>"
        sentences = "".join(f"<p>{escape(with_micro_signs(sentence))}</p>" for sentence in self.sentences)
        table = f"<pre>{escape(self.table)}</pre>" if self.table else ""
        return f'<div style="max-width: 46rem">{heading}{sentences}{table}{_picture(self.dataset)}</div>'


def card(dataset: xr.Dataset) -> Card:
    """Return the card of a study's results, a link or a forecast; raises SweepError for any other dataset."""
    result = Result(dataset)
    if result.is_stored_table:
        return Card(result.title, "", result.headline(), dataset, result.written("text"))
    question, sentences = str(dataset.attrs.get("question", "")), [*completeness(dataset), *answer_in_short(dataset)]
    return Card(result.title, question, sentences, dataset)


def _picture(dataset: xr.Dataset) -> str:
    """Return the figure as an image that is part of the page; a sentence where there is none."""
    try:
        from linksweep.sweep.plots.figure import description, draw_figure
        from linksweep.sweep.plots.style import settings
    except ImportError:
        return "<p><small>A figure needs Matplotlib: <code>pip install 'linksweep[plot]'</code></small></p>"
    out = io.BytesIO()
    try:
        with settings():
            figure = draw_figure(dataset.assign_attrs(title=""))
            figure.savefig(out, format="png", dpi=150)
    except (SweepError, ValueError) as error:  # a ValueError: a name that matplotlib takes for a formula
        return f"<p><small>{escape(f'No figure: {error}')}</small></p>"
    image, words = base64.b64encode(out.getvalue()).decode(), escape(description(figure, dataset), quote=True)
    return f'<img src="data:image/png;base64,{image}" alt="{words}" style="max-width: 100%; background: #ffffff">'
