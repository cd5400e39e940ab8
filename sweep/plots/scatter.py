"""Single estimates of two components: scatter, confidence ellipses, mean and truth."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from scipy.special import chdtri

from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import prefixed, with_error, written
from linksweep.sweep.plots.labels import label, symbol
from linksweep.sweep.plots.legends import legend
from linksweep.sweep.plots.style import COLOURS, finish

CONFIDENCES = (0.683, 0.954)
CROSS_PT = 9.0


def sampled(dataset: xr.Dataset) -> str | None:
    """Return the variable with the kept samples of several components; None if there is none."""
    known = {"sample", *dataset["status"].dims}
    names = [str(n) for n, v in dataset.data_vars.items() if "sample" in v.dims and set(v.dims) - known]
    return names[0] if names else None


def draw_scatter(
    axes: Axes, dataset: xr.Dataset, variable: str, components: tuple[str, str], below: bool = False
) -> Axes:
    """Draw the samples of two components against each other, with ellipses of 68 and 95 % of a normal distribution.

    ``variable`` has the dimensions sample and one of components; where the dataset has a ``bias``, the truth (mean
    estimate - bias) is a cross.  The standard deviations stand in the legend with their errors, sigma/sqrt(2 n),
    beside the picture or ``below`` it.
    """
    dimension = component_dimension(dataset, variable)
    x, y = (dataset[variable].sel({dimension: name}).values.astype(float) for name in components)
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    if len(x) < 3:
        raise SweepError(f"{variable} has {len(x)} samples here; at least 3 are needed")
    own = dataset.get(f"{dimension}_unit")
    stored = ["" if own is None else str(own.sel({dimension: name}).item()) for name in components]
    same = stored[0] == stored[1]
    chosen = prefixed([float(x.std()), float(y.std())], stored[0])
    factor, units = (chosen.factor, [chosen.unit] * 2) if same else (1.0, stored)
    x, y = factor * x, factor * y
    mean, covariance = np.array([x.mean(), y.mean()]), np.cov(x, y)
    size = float(np.clip(100.0 / np.sqrt(len(x)), 2.0, 5.0))
    dots: dict[str, Any] = {"color": COLOURS[0], "markersize": size, "markeredgewidth": 0.0, "alpha": 0.35}
    axes.plot(x, y, ".", rasterized=True, label=f"{len(x)} estimates", **dots)
    for confidence, line in zip(CONFIDENCES, ("solid", "dashed"), strict=True):
        text = f"{100 * confidence:.0f} % of their normal law"
        style = {"edgecolor": COLOURS[1], "linestyle": line}
        axes.add_patch(confidence_ellipse(mean, covariance, confidence, label=text, **style))
    error = np.sqrt(np.diag(covariance) / len(x))
    point: dict[str, Any] = {"color": COLOURS[1], "marker": "o", "markersize": 3.0, "linestyle": "none"}
    axes.errorbar(mean[0], mean[1], xerr=error[0], yerr=error[1], label="mean", **point)
    if "bias" in dataset and dimension in dataset["bias"].dims:
        truth = mean - [factor * dataset["bias"].sel({dimension: name}).item() for name in components]
        axes.plot(*truth, "x", markersize=CROSS_PT, markeredgewidth=1.4, color="black", label="truth")
    axes.set_xlabel(label(dataset[variable], components[0], units[0]))
    axes.set_ylabel(label(dataset[variable], components[1], units[1]))
    if units[0] == units[1]:
        axes.set_aspect("equal", adjustable="datalim")
    finish(axes)
    sigmas = [
        rf"$\sigma$({symbol(name)}) = {with_error(s, s / np.sqrt(2 * len(x)))} {written(unit)}"
        for name, s, unit in zip(components, np.sqrt(np.diag(covariance)), units, strict=True)
    ]
    correlation = rf"correlation ${covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]):+.2f}$"
    title, at = "\n".join([*sigmas, correlation]), (-0.3, -0.2) if below else (1.0, 1.0)
    legend(axes, title=title, loc="upper left", bbox_to_anchor=at, alignment="left", markerscale=1.5)
    for handle in axes.findobj(lambda artist: isinstance(artist, Line2D) and artist.get_label() == "truth"):
        handle.set(markersize=CROSS_PT)  # in the legend too: larger, it would not fit in its line
    return axes


def component_dimension(dataset: xr.Dataset, variable: str) -> str:
    """Return the dimension of the components of samples."""
    axes = set(dataset["status"].dims)
    return next(str(d) for d in dataset[variable].dims if d != "sample" and d not in axes)


def confidence_ellipse(centre: np.ndarray, covariance: np.ndarray, confidence: float, **style: object) -> Ellipse:
    """Return the ellipse that holds a share ``confidence`` of a normal distribution of two numbers."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2.0 * np.sqrt(np.maximum(values, 0.0) * chdtri(2, 1.0 - confidence))
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    return Ellipse((centre[0], centre[1]), width, height, angle=angle, fill=False, linewidth=1.2, **style)
