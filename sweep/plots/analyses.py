"""Figures of analyses: sensitivity indices of parameters, and how a run scales with workers."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from linksweep.sweep import formatting
from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots import style

WORDS = {"first": "first order", "total": "total", "mu_star": r"mean absolute effect $\mu^*$", "sigma": r"$\sigma$"}


def sensitivity_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of indices; raises SweepError where they have more than one further dimension."""
    kinds = [name for name in WORDS if name in dataset]
    further = [str(d) for d in dataset[kinds[0]].dims if d != "parameter" and dataset.sizes[d] > 1]
    dataset = dataset.squeeze([d for d in dataset.dims if d not in ("parameter", *further)])
    if len(further) > 1 or (further and dataset[further[0]].dtype.kind not in "iuf"):
        raise SweepError(f"indices of {' and '.join(further)} do not fit one picture; fix some with --at AXIS=VALUE")
    size = (7.0, 4.4) if further else (6.4, 1.4 + 0.45 * dataset.sizes["parameter"])
    figure, (axes,) = style.new_figure(*size)
    unit = formatting.written(formatting.units_of(dataset[kinds[0]].attrs))
    effect = "share of the variance" if "first" in kinds else "effect over the range" + (f" [{unit}]" if unit else "")
    if further:
        _curves(axes, dataset, kinds, further[0])
        axes.set(xlabel=style.label(dataset[further[0]], further[0]), ylabel=effect)
    else:
        _marks(axes, dataset, kinds)
        axes.set_xlabel(effect)
    return figure


def _marks(axes: Axes, dataset: xr.Dataset, kinds: list[str]) -> None:
    one = dataset.sortby(dataset[kinds[-1] if "total" in kinds else kinds[0]].fillna(0.0))
    places, names = np.arange(one.sizes["parameter"]), map(str, one["parameter"].values)
    for number, kind in enumerate(kinds):
        error = one[f"{kind}_error"].values if f"{kind}_error" in one else None
        aside = 0.14 * (0.5 * (len(kinds) - 1) - number)
        look = style.marks(number, 4.5, elinewidth=1.0, label=WORDS[kind])
        axes.errorbar(one[kind].values, places + aside, xerr=error, **look)
    style.name_ticks(axes, "y", ["+".join(map(style.symbol, name.split("+"))) for name in names])
    if "first" in kinds:
        low, high = axes.get_xlim()  # which include the errors of all marks
        axes.set_xlim(min(-0.02, low), max(1.02, high))
    axes.axvline(0.0, color="0.6", linewidth=0.6)


def _curves(axes: Axes, dataset: xr.Dataset, kinds: list[str], over: str) -> None:
    x, lines = dataset[over].values.astype(float), dict(zip(kinds, ("solid", "dashed"), strict=False))
    for number, name in enumerate(map(str, dataset["parameter"].values)):
        one = dataset.isel(parameter=number)
        look: dict[str, Any] = {"color": style.COLOURS[number % len(style.COLOURS)]}
        for kind, line in lines.items():
            y, text = one[kind].values, style.symbol(name) if line == "solid" else None
            axes.plot(x, y, linestyle=line, linewidth=1.2, label=text, **look)
            if f"{kind}_error" in one:
                half = np.nan_to_num(one[f"{kind}_error"].values)
                axes.fill_between(x, y - half, y + half, **look, **style.BAND)
    for kind, line in lines.items() if len(lines) > 1 else ():
        axes.plot([], [], color="0.35", linestyle=line, linewidth=1.2, label=WORDS[kind])


def scaling_figure(dataset: xr.Dataset) -> Figure:
    """Return the speed-up over one worker, w times the efficiency, beside the efficiency against w workers, by kind,
    with the ideal line.

    ``dataset`` has dimensions kind ("strong": the same work, "weak": the same work per worker) and workers, variables
    seconds and efficiency (1 is ideal), each with a one-sigma NAME_error where it is known.
    """
    figure, grid = style.new_figure(8.0, 3.8, 1, 2, least=1.0)
    workers = dataset["workers"].values.astype(float)
    words = ("speed-up over one worker", "efficiency")
    for axes, name, ideal in zip(grid, words, (workers, np.ones(len(workers))), strict=True):
        axes.plot(workers, ideal, label="ideal", **style.GUIDE)
        for number, kind in enumerate(dataset["kind"].values.tolist()):
            one = dataset.sel(kind=kind)
            value = one["efficiency"].transpose("workers", ...).values * ideal
            error = one["efficiency_error"].values * ideal if "efficiency_error" in one else None
            look = {**style.series(number), "markersize": 4.0, "linewidth": 1.0, "elinewidth": 0.8}
            axes.errorbar(workers, value, yerr=error, label=f"{kind} scaling", **look)
        style.logarithmic(axes, "x", workers)
        axes.set_xticks(workers, [f"{w:g}" for w in workers])
        axes.set_xticks([], minor=True)
        axes.set(xlabel="workers", ylabel=name)
    style.logarithmic(grid[0], "y", workers)
    grid[1].set_ylim(0.0, max(1.1, 1.05 * float(np.nanmax(dataset["efficiency"].values))))
    return figure
