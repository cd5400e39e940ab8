"""One point of a study: what is simulated, predicted and published below each other, with numbers."""

from typing import Any

import xarray as xr
from matplotlib.axes import Axes

from sweep.analysis.quantity import prediction_name, standard_error
from sweep.attributes import units_of
from sweep.plots.labels import quantity_label
from sweep.plots.style import COLOURS, finish
from sweep.readable import with_micro_signs, with_unit


def draw_point(axes: Axes, dataset: xr.Dataset, variable: str) -> Axes:
    """Draw the value of a variable at the one point of a dataset with its one-sigma error, the prediction and the
    published value with half a unit of its last digit, each in a line of its own with its numbers.
    """
    known = standard_error(dataset, variable)
    rounding = f"{variable}_published_rounding"
    rows = {
        "simulated": (variable, 0.0 if known is None else float(known.item())),
        "predicted": (prediction_name(dataset, variable), 0.0),
        "published": (f"{variable}_published", float(dataset[rounding].item()) if rounding in dataset else 0.0),
    }
    shown = {word: row for word, row in rows.items() if row[0] in dataset and bool(dataset[row[0]].notnull().all())}
    unit = units_of(dataset[variable].attrs)
    for number, (word, (name, error)) in enumerate(shown.items()):
        value = float(dataset[name].item())
        style: dict[str, Any] = {"color": COLOURS[number], "marker": "osD"[number], "linestyle": "none"}
        if word == "published":
            style["fillstyle"] = "none"
        axes.errorbar(value, -number, xerr=error or None, elinewidth=1.2, markersize=5.0, label=word, **style)
        text = with_micro_signs(with_unit(value, error if word == "simulated" else 0.0, unit))
        axes.annotate(text, (value, -number), xytext=(0, 7), textcoords="offset points", ha="center")
    axes.set_yticks([-number for number in range(len(shown))], list(shown))
    axes.set_ylim(0.6 - len(shown), 0.7)
    axes.margins(x=0.35)
    axes.set_xlabel(quantity_label(dataset, variable))
    finish(axes)
    axes.tick_params(axis="y", left=False, right=False)
    return axes
