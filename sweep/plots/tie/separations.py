"""Normalised separations of sources beside the Rayleigh distribution that right errors give them."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from sweep.contract import SweepError
from sweep.plots.legends import legend
from sweep.plots.style import COLOURS, figure_size, finish

LINEAR_UP_TO = 6.0


def separation_figure(dataset: xr.Dataset) -> Figure:
    """Return histograms of X before the fit and sqrt(2 Q/n) after it, and the Rayleigh distribution."""
    if "normalised_separation" not in dataset:
        raise SweepError("no separations here: they are not kept of tables with so many rows")
    count = dataset["n_observations"].values
    before = dataset["normalised_separation"].values
    used = (count > 0.0) & (before > 0.0)
    if not np.any(used):
        raise SweepError("no source has a separation: no row has a position or motion that the satellite predicts")
    before = before[used]
    after = np.sqrt(2.0 * dataset["discrepancy"].values[used] / count[used])
    limit = np.sqrt(2.0 * np.log(max(int(np.sum(count > 0.0)), 2)))
    far = np.quantile(before, 0.9) > LINEAR_UP_TO
    number = int(np.clip(2.0 * np.sqrt(len(before)), 8, 48))
    top = max(float(before.max()), 10.0) if far else LINEAR_UP_TO
    edges = np.geomspace(0.05, top * 1.0001, number + 1) if far else np.linspace(0.0, LINEAR_UP_TO, number + 1)
    figure = Figure(figsize=figure_size(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    counts, counts_after = (np.histogram(one, edges)[0] for one in (before, after))
    axes.stairs(counts, edges, fill=True, color=COLOURS[4], alpha=0.55, label="before the fit, $X$")
    words = r"after the fit, $\sqrt{2\,Q_i/n_i}$"
    axes.stairs(counts_after, edges, color=COLOURS[1], linewidth=1.4, label=words)
    x = np.geomspace(edges[0], edges[-1], 400) if far else np.linspace(0.0, edges[-1], 400)
    step = x * np.log(edges[1] / edges[0]) if far else edges[1] - edges[0]
    expected = len(before) * step * x * np.exp(-0.5 * x**2)
    axes.plot(x, expected, color="black", linewidth=1.2, label="Rayleigh: the errors are right")
    axes.axvline(limit, color="0.4", linestyle="dashed", linewidth=1.0, label=rf"$\sqrt{{2\ln N}}$ = {limit:.2f}")
    if far:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlim(edges[0], edges[-1])
    axes.set_xlabel("normalised separation")
    axes.set_ylabel(f"sources in a bin, of {len(before)}")
    beyond = int(np.sum(before > edges[-1]))
    if beyond:
        axes.set_title(f"{beyond} beyond {edges[-1]:g} before the fit, {np.sum(after > edges[-1])} after it")
    finish(axes)
    legend(axes)
    return figure
