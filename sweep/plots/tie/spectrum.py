"""Power of the vector spherical harmonics by degree, beside that of noise, and how significant it is."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.special import ndtri

from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots.legends import legend_below
from linksweep.sweep.plots.lines import DASH, WIDEST_DASH
from linksweep.sweep.plots.scales import logarithmic
from linksweep.sweep.plots.style import figure_size, finish, series

THRESHOLD = 3.0
MOST_SIGMA = 10.0


def spectrum_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of the root of the power of each field by degree, with the noise, and its significance below."""
    if "power" not in dataset:
        raise SweepError("no spectrum here: no vector spherical harmonics are among the unknowns (--degree)")
    degree = dataset["degree"].values
    names = [str(field) for field in dataset["field"].values]
    parts = [part for part in ("position", "motion") if any(name.startswith(part) for name in names)]
    figure = Figure(figsize=figure_size(1.4 + 4.6 * len(parts), 5.4), layout="constrained")
    grid = figure.subplots(2, len(parts), sharex=True, squeeze=False, height_ratios=(3, 2))
    for column, part in enumerate(parts):
        upper, lower = grid[:, column]
        fields = [name for name in names if name.startswith(part)]
        for number, field in enumerate(fields):
            one = dataset.sel(field=field)
            style = {**series(number), "markersize": 5.0}
            shift = 0.06 * (2 * number - 1)
            kind = field.partition(" ")[2]
            signal, noise = (1000.0 * np.sqrt(one[name].values) for name in ("power", "power_noise"))
            upper.plot(degree + shift, signal, linestyle="none", label=kind, **style)
            upper.plot(degree, noise, color=style["color"], markersize=WIDEST_DASH, label=f"noise, {kind}", **DASH)
            significance = -ndtri(np.clip(one["power_probability"].values, 1e-300, 1.0))
            lower.plot(degree + shift, np.minimum(significance, MOST_SIGMA), linestyle="none", **style)
        shown = dataset[["power", "power_noise"]].sel(field=fields).to_array().values
        logarithmic(upper, "y", 1000.0 * np.sqrt(shown))
        upper.set_ylabel(rf"$\sqrt{{P_l}}$ of the {part}s [µas{'/yr' if part == 'motion' else ''}]")
        lower.axhline(THRESHOLD, color="0.4", linestyle="dashed", linewidth=1.0)
        lower.set_ylim(-2.6, MOST_SIGMA + 0.8)
        lower.set_ylabel(r"significance [$\sigma$]")
        text = f"{MOST_SIGMA:g}: or more"
        lower.text(0.99, 0.93, text, transform=lower.transAxes, ha="right", va="center", fontsize=7)
        lower.set_xlabel("degree $l$")
        lower.xaxis.set_major_locator(MaxNLocator(integer=True))
        lower.set_xlim(degree.min() - 0.5, degree.max() + 0.5)
        for axes in (upper, lower):
            finish(axes)
    legend_below(figure)
    return figure
