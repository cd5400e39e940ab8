"""Pictures of results: a function takes a Dataset and draws on Axes."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sweep.contract import SweepError

SERIES_MARKERS = "osD^vP*X"
COLOUR_BLIND_SAFE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")  # Okabe & Ito


def plot_lines(axes: Axes, dataset: xr.Dataset, variable: str, over: str) -> Axes:
    """Draw a variable against a numeric axis of the grid, one series for every combination of the others.

    Points carry their Monte-Carlo error, the line is the closed-form prediction, open symbols are published values.
    Raises SweepError for an unknown variable or axis, or more series than can be told apart.
    """
    _require(dataset, variable, over)
    others = [str(d) for d in dataset[variable].dims if d != over]
    stacked = dataset.stack(series=others) if others else dataset.expand_dims("series")
    if stacked.sizes["series"] > len(COLOUR_BLIND_SAFE):
        raise SweepError(
            f"{stacked.sizes['series']} series over {', '.join(others)} are too many for one picture; at most "
            f"{len(COLOUR_BLIND_SAFE)} can be told apart"
        )
    for number in range(stacked.sizes["series"]):
        one = stacked.isel(series=number)
        label = ", ".join(str(one[name].item()) for name in others) or "simulated"
        _series(axes, one, variable, over, label, number)
    axes.set_xlabel(_label(dataset[over], over))
    axes.set_ylabel(_label(dataset[variable], variable))
    if (dataset[variable].min() > 0) and dataset[variable].max() > 5 * dataset[variable].min():
        axes.set_yscale("log")
    axes.grid(alpha=0.25, linewidth=0.5)
    axes.legend(*_in_drawing_order(axes), frameon=False)
    return axes


def save_lines(dataset: xr.Dataset, variable: str, over: str, path: Path) -> None:
    """Write `plot_lines` as PNG, SVG or PDF, whichever ``path`` ends with."""
    mpl.rcParams["svg.hashsalt"] = "linksweep"  # the same picture, the same file
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    plot_lines(figure.add_subplot(), dataset, variable, over)
    figure.axes[0].set_title(str(dataset.attrs.get("title", "")), fontsize="medium")
    try:
        figure.savefig(path, dpi=160)
    except (OSError, ValueError) as error:
        raise SweepError(f"cannot draw there: {error}", str(path)) from error


def numeric_axes(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return the dimensions of a variable that have numbers to draw along, longest first."""
    numeric = [str(d) for d in dataset[variable].dims if dataset[d].dtype.kind in "if" and dataset.sizes[d] > 1]
    return sorted(numeric, key=lambda d: -dataset.sizes[d])


def _series(axes: Axes, one: xr.Dataset, variable: str, over: str, label: str, number: int) -> None:
    colour = COLOUR_BLIND_SAFE[number]
    x = one[over].values
    predicted, error, published = f"{variable}_predicted", f"{variable}_mc_error", f"{variable}_published"
    if predicted in one:
        axes.plot(x, one[predicted], color=colour, linewidth=1.2, label=f"{label}, predicted")
    axes.errorbar(
        x,
        one[variable],
        yerr=one.get(error),
        color=colour,
        marker=SERIES_MARKERS[number],
        markersize=4,
        linestyle="none",
        label=label,
    )
    if published in one and np.isfinite(one[published]).any():
        marker = SERIES_MARKERS[number]
        axes.plot(x, one[published], marker, color=colour, fillstyle="none", markersize=10, label=f"{label}, published")


def _in_drawing_order(axes: Axes) -> tuple[list[Any], list[str]]:
    """Return legend entries series by series; matplotlib alone would put all error bars last."""
    pairs = zip(*axes.get_legend_handles_labels(), strict=True)
    handles, labels = zip(*sorted(pairs, key=lambda pair: pair[1].partition(", ")[0]), strict=True)
    return list(handles), list(labels)


def _label(array: xr.DataArray, name: str) -> str:
    unit = array.attrs.get("units", "")
    return f"{name} [{unit}]" if unit else name


def _require(dataset: xr.Dataset, variable: str, over: str) -> None:
    known = [str(n) for n, v in dataset.data_vars.items() if v.dtype.kind == "f" and "component" not in v.dims]
    if variable not in known:
        raise SweepError(f"no variable {variable!r} to draw; there are {', '.join(known)}")
    possible = numeric_axes(dataset, variable)
    if over not in possible:
        raise SweepError(
            f"{variable!r} cannot be drawn over {over!r}; its numeric axes are {', '.join(possible) or 'none'}"
        )
