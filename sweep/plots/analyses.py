"""Figures of analyses: sensitivity indices of parameters, and how a run scales with workers."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from linksweep.sweep.analysis.sensitivity import METHOD
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import units_of, written
from linksweep.sweep.plots.grid import GUIDE
from linksweep.sweep.plots.style import (
    BAND,
    COLOURS,
    entitle,
    finish,
    label,
    legend,
    logarithmic,
    marks,
    new_figure,
    series,
    symbol,
)

WORDS = {"first": "first order", "total": "total", "mu_star": r"mean absolute effect $\mu^*$", "sigma": r"$\sigma$"}


def sensitivity_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of indices; raises SweepError where they have more than one further dimension."""
    kinds = [name for name in WORDS if name in dataset]
    further = [str(d) for d in dataset[kinds[0]].dims if d != "parameter" and dataset.sizes[d] > 1]
    dataset = dataset.squeeze([d for d in dataset.dims if d not in ("parameter", *further)])
    if len(further) > 1 or (further and dataset[further[0]].dtype.kind not in "iuf"):
        raise SweepError(f"indices of {' and '.join(further)} do not fit one picture; fix some with --at AXIS=VALUE")
    size = (7.0, 4.4) if further else (6.4, 1.4 + 0.45 * dataset.sizes["parameter"])
    figure, (axes,) = new_figure(*size)
    if further:
        _curves(axes, dataset, kinds, further[0])
    else:
        _marks(axes, dataset, kinds)
    about = f"sensitivity of {symbol(dataset.attrs['output'])}, by {dataset.attrs[METHOD]}"
    entitle(figure, "\n".join(filter(None, [dataset.attrs["title"], about])))
    return figure


def _marks(axes: Axes, dataset: xr.Dataset, kinds: list[str]) -> None:
    order = np.argsort(np.nan_to_num(dataset[kinds[-1] if "total" in kinds else kinds[0]].values))
    names = [dataset["parameter"].values[k] for k in order]
    for number, kind in enumerate(kinds):
        places = np.arange(len(order)) + 0.14 * (0.5 * (len(kinds) - 1) - number)
        error = dataset[f"{kind}_error"].values[order] if f"{kind}_error" in dataset else None
        style = marks(number, 4.5, elinewidth=1.0, label=WORDS[kind])
        axes.errorbar(dataset[kind].values[order], places, xerr=error, **style)
    axes.set_yticks(range(len(names)), ["+".join(symbol(part) for part in str(name).split("+")) for name in names])
    axes.set_ylim(-0.6, len(names) - 0.4)
    unit = units_of(dataset[kinds[0]].attrs)
    if "first" in kinds:
        low, high = axes.get_xlim()  # which include the errors of all marks
        axes.set_xlim(min(-0.02, low), max(1.02, high))
        axes.set_xlabel("share of the variance")
    else:
        axes.set_xlabel(f"effect over the range [{written(unit)}]" if unit else "effect over the range")
    axes.axvline(0.0, color="0.6", linewidth=0.6)
    finish(axes)
    legend(axes)


def _curves(axes: Axes, dataset: xr.Dataset, kinds: list[str], over: str) -> None:
    x, lines = dataset[over].values.astype(float), dict(zip(kinds, ("solid", "dashed"), strict=False))
    for number, name in enumerate(map(str, dataset["parameter"].values)):
        one = dataset.isel(parameter=number)
        colour = COLOURS[number % len(COLOURS)]
        for kind, line in lines.items():
            y, text = one[kind].values, symbol(name) if line == "solid" else None
            axes.plot(x, y, color=colour, linestyle=line, linewidth=1.2, label=text)
            if f"{kind}_error" in one:
                half = np.nan_to_num(one[f"{kind}_error"].values)
                axes.fill_between(x, y - half, y + half, color=colour, **BAND)
    axes.set_xlabel(label(dataset[over], over))
    axes.set_ylabel("share of the variance" if "first" in kinds else "effect over the range")
    for kind, line in lines.items() if len(lines) > 1 else ():
        axes.plot([], [], color="0.35", linestyle=line, linewidth=1.2, label=WORDS[kind])
    finish(axes)
    legend(axes)


def scaling_figure(dataset: xr.Dataset) -> Figure:
    """Return the speed-up over one worker, w times the efficiency, beside the efficiency against w workers, by kind,
    with the ideal line.

    ``dataset`` has dimensions kind ("strong": the same work, "weak": the same work per worker) and workers, variables
    seconds and efficiency (1 is ideal), each with a one-sigma NAME_error where it is known.
    """
    figure, grid = new_figure(8.0, 3.8, 1, 2, least=1.0)
    workers = dataset["workers"].values.astype(float)
    words = ("speed-up over one worker", "efficiency")
    for axes, name, ideal in zip(grid, words, (workers, np.ones(len(workers))), strict=True):
        axes.plot(workers, ideal, label="ideal", **GUIDE)
        for number, kind in enumerate(dataset["kind"].values.tolist()):
            one = dataset.sel(kind=kind)
            value = one["efficiency"].transpose("workers", ...).values * ideal
            error = one["efficiency_error"].values * ideal if "efficiency_error" in one else None
            style = {**series(number), "markersize": 4.0, "linewidth": 1.0, "elinewidth": 0.8}
            axes.errorbar(workers, value, yerr=error, label=f"{kind} scaling", **style)
            if error is not None:
                axes.fill_between(workers, value - error, value + error, color=COLOURS[number], **BAND)
        logarithmic(axes, "x", workers)
        axes.set_xticks(workers, [f"{w:g}" for w in workers])
        axes.set_xticks([], minor=True)
        axes.set(xlabel="workers", ylabel=name)
        finish(axes)
        legend(axes)
    logarithmic(grid[0], "y", workers)
    grid[1].set_ylim(0.0, max(1.1, 1.05 * float(np.nanmax(dataset["efficiency"].values))))
    entitle(figure, str(dataset.attrs.get("title", "")))
    return figure
