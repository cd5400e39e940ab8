"""Figures of a link of real tables, `sweep tie`, and of a forecast of one: each kind is a function of the dataset.

Each raises SweepError, which says how to get it, where the dataset lacks what it shows.
"""

import re
from collections.abc import Iterable
from itertools import combinations
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, MaxNLocator
from matplotlib.transforms import Bbox
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtri

from linksweep.core.frames import DEGREE, Array
from linksweep.core.tie.solution import LARGE_SHARE
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import prefixed, written
from linksweep.sweep.plots.grid import DASH, WIDEST_DASH
from linksweep.sweep.plots.points import confidence_ellipse
from linksweep.sweep.plots.sky import on_map, prepare_sky
from linksweep.sweep.plots.style import (
    BAND,
    COLOURS,
    INSIDE_WIDTH,
    finish,
    in_lines,
    legend,
    legend_below,
    logarithmic,
    marks,
    new_figure,
    series,
    symbol,
)

SKY_WIDTH = 45.0  # letters that a map of the sky, or a panel with names of sources, is wide at least
RANKED = 20  # sources in a ranking
LINES: tuple[Any, ...] = ("solid", "dashed", "dotted", "dashdot", (0, (5, 1, 1, 1)), (0, (1, 3)))

BELOW: dict[str, Any] = {"loc": "outside lower center", "frameon": False}
BESIDE: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5), "frameon": False}
MARK: dict[str, Any] = {"color": "0.4", "linestyle": "dotted", "linewidth": 1.0, "label": f"{100.0 * LARGE_SHARE:g} %"}


# What the figures have in common


def _readable(values: Array, unit: str) -> tuple[float, str]:
    """Return the factor to the unit in which numbers read best, and that unit as people write it."""
    chosen = prefixed(values, unit)
    return chosen.factor, written(chosen.unit)


def _symbol(unknown: str) -> str:
    """Return the symbol of an unknown: of a vector's component, of a harmonic with its degree and order, or a name."""
    if vector := re.match(r"(epsilon|omega|glide|position_glide)_([xyz])", unknown):
        block, axis = vector.groups()
        letter = {"glide": "g", "position_glide": "G"}.get(block, rf"\{block}")
        return rf"${letter}_{axis}$" + unknown[vector.end() :]
    if harmonic := re.fullmatch(r"vsh_(?:position|motion)_([ts])_(\d+)_(\d+)(?:_(re|im))?", unknown):
        kind, degree, order, part = harmonic.groups()
        above = rf"^\mathrm{{{part.capitalize()}}}" if part else ""
        return rf"${kind}_{{{degree},{order}}}{above}$"
    return r"$\varpi_0$" if unknown == "parallax_zero_point" else symbol(unknown)


def _symbols(dataset: xr.Dataset) -> list[str]:
    return [_symbol(str(name)) for name in dataset["unknown"].values]


def _unknowns_by(dataset: xr.Dataset, key: str) -> dict[str, list[int]]:
    """Return the indices of the unknowns of each "unit" or "block"."""
    keys = dataset[key].values
    return {str(one): np.flatnonzero(keys == one).tolist() for one in dict.fromkeys(keys.tolist())}


def _vectors(dataset: xr.Dataset) -> dict[str, list[int]]:
    """Return the indices of the unknowns of each block that is a vector."""
    return {name: indices for name, indices in _unknowns_by(dataset, "block").items() if len(indices) == 3}


def _is_kept(dataset: xr.Dataset) -> NDArray[np.bool_]:
    """Return which sources the solution uses."""
    return np.asarray((dataset["weight_factor"].values > 0.0) & (dataset["n_observations"].values > 0.0))


def _require(dataset: xr.Dataset, name: str, problem: str) -> None:
    if name not in dataset:
        raise SweepError(problem)


def _require_shares(dataset: xr.Dataset) -> Array:
    _require(dataset, "share", "no weights of sources here: they are not kept for so many sources")
    return np.asarray(dataset["share"].values, dtype=np.float64)


def _name_points(axes: Axes, x: Array, y: Array, names: Iterable[str]) -> None:
    """Write names beside points, the first ones first; one that would cover another, or leave the axes, is left out.

    To be called when everything else is drawn and has its place (`Figure.draw_without_rendering`).
    """
    inside, taken = axes.get_window_extent(), list[Bbox]()
    style: dict[str, Any] = {"textcoords": "offset points", "fontsize": 6.5, "zorder": 6, "in_layout": False}
    style["path_effects"] = [withStroke(linewidth=2.0, foreground="white")]
    sides = ((1, 0, "left", "center"), (-1, 0, "right", "center"), (0, 1, "center", "bottom"), (0, -1, "center", "top"))
    for px, py, name in zip(x, y, names, strict=True):
        for right, up, ha, va in sides:  # the best first
            text = axes.annotate(name, (px, py), xytext=(4.0 * right, 4.0 * up), ha=ha, va=va, **style)
            box = text.get_window_extent()
            fits = inside.x0 <= box.x0 and box.x1 <= inside.x1 and inside.y0 <= box.y0 and box.y1 <= inside.y1
            if fits and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            text.remove()


# The solution


def solution_figure(dataset: xr.Dataset) -> Figure:
    """Return the estimates with each kind of error, one panel for each unit."""
    panels, symbols = _unknowns_by(dataset, "unit"), _symbols(dataset)
    widths, kinds = [len(panel) + 1 for panel in panels.values()], dataset["error_kind"].values.tolist()
    width = float(np.clip(1.6 * len(panels) + 0.16 * len(kinds) * sum(widths), 6.4, 16.0))
    figure, grid = new_figure(width, 4.2, 1, len(panels), least=1.0, width_ratios=widths)
    for axes, (stored, panel) in zip(grid, panels.items(), strict=True):
        values, errors = dataset["estimate"].values[panel], dataset["errors"].values[:, panel]
        factor, unit = _readable(values, stored)
        for number, kind in enumerate(kinds):
            x = np.arange(len(panel)) + 0.6 * ((number + 0.5) / len(kinds) - 0.5)
            style = marks(number, 3.5, elinewidth=1.0, label=kind)
            axes.errorbar(x, factor * values, yerr=factor * np.nan_to_num(errors[number]), **style)
        axes.axhline(0.0, color="0.6", linewidth=0.6, zorder=0)
        names = [symbols[k] for k in panel]
        upright = len(panel) > 12 or any("[" in name for name in names)
        axes.set_xticks(range(len(panel)), names, rotation=90 if upright else 0)
        axes.set_xlim(-0.7, len(panel) - 0.3)
        axes.set_ylabel(f"estimate [{unit}]")
        finish(axes)
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, title="errors", ncols=min(len(labels), 6), **BELOW)  # even of a single kind
    return figure


def bin_figure(dataset: xr.Dataset) -> Figure:
    """Return the three components of the spin against the column of the bins; the outermost bins are open."""
    _require(dataset, "spin_by_bin", "no bins here: give --bins COLUMN=EDGES")
    values, errors = dataset["spin_by_bin"].values, dataset["spin_by_bin_error"].values
    factor, unit = _readable(values, "mas/yr")
    low, high = dataset["bin_low"].values.astype(float), dataset["bin_high"].values.astype(float)
    closed = np.isfinite(high - low)
    width = float(np.median((high - low)[closed])) if closed.any() else 1.0
    left, right = np.where(np.isfinite(low), low, high - width), np.where(np.isfinite(high), high, low + width)
    figure, (axes,) = new_figure(6.8, 4.2)
    middle = 0.5 * (left + right)
    for number, component in enumerate("xyz"):
        x = middle + 0.08 * (number - 1) * (right - left)
        style = marks(number, 4.5, label=rf"$\omega_{component}$")
        axes.errorbar(x, factor * values[:, number], yerr=factor * errors[:, number], **style)
    for edge in {*left.tolist(), *right.tolist()}:
        is_open = edge not in low and edge not in high
        axes.axvline(edge, color="0.75", linewidth=0.6, linestyle="dotted" if is_open else "solid", zorder=0)
    axes.axhline(0.0, color="0.5", linewidth=0.8, zorder=0)
    words = [
        f"below {b:g}" if np.isinf(a) else f"{a:g} and more" if np.isinf(b) else f"{a:g} to {b:g}"
        for a, b in zip(low, high, strict=True)
    ]
    axes.set_xticks(middle, words)
    axes.set(xlabel=str(dataset.attrs.get("bin_column", "bin")), ylabel=f"spin [{unit}]")
    finish(axes, grid=False)
    axes.legend(**BESIDE)
    return figure


def trajectory_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of each vector and chi2/dof against the step of the clip; a line marks the chosen step."""
    if "step_estimate" not in dataset or dataset.sizes["step"] < 2:
        raise SweepError("no trajectory here: give --clip discrepancy or median:K, which go step by step")
    vectors, symbols = _vectors(dataset), _symbols(dataset)
    steps, chosen = np.arange(dataset.sizes["step"]), int(dataset["step_chosen"])
    dropped = [str(name) for name in dataset["step_dropped"].values]
    figure, grid = new_figure(7.4, 3.0 + 2.0 * len(vectors), len(vectors) + 1, sharex=True)
    dots = {"marker": ".", "linewidth": 1.0, "markersize": 3.0}
    for axes, (name, block) in zip(grid, vectors.items(), strict=False):
        values, errors = dataset["step_estimate"].values[:, block], dataset["step_error"].values[:, block]
        factor, unit = _readable(values, str(dataset["unit"].values[block[0]]))
        for number, k in enumerate(block):
            line, error = factor * values[:, number], factor * errors[:, number]
            axes.plot(steps, line, color=COLOURS[number], label=symbols[k], **dots)
            axes.fill_between(steps, line - error, line + error, color=COLOURS[number], **BAND)
        axes.set_ylabel(f"{name.replace('_', ' ')} [{unit}]")
        axes.legend(**BESIDE)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = dataset["step_chi2"].values / dataset["step_dof"].values
    last = grid[-1]
    last.plot(steps, ratio, color="black", **dots)
    last.axhline(1.0, color="0.6", linewidth=0.6, zorder=0)
    if np.all(ratio[np.isfinite(ratio)] > 0.0) and np.nanmax(ratio) > 5.0 * np.nanmin(ratio):
        logarithmic(last, "y", ratio)
    last.set_ylabel(r"$\chi^2$/dof")
    for axes in grid:
        axes.axvline(chosen, color="0.4", linestyle="dashed", linewidth=1.0)
        finish(axes)
    one_by_one = any(dropped)
    if one_by_one and len(steps) <= RANKED:
        last.set_xticks(steps, ["all", *dropped[1:]], rotation=90, fontsize=7)
        last.set_xlabel("source dropped, one after the other")
    else:
        last.set_xlabel("sources dropped, one by one" if one_by_one else "iteration of the clip")
        last.xaxis.set_major_locator(MaxNLocator(integer=True))
    words = f"{chosen} dropped" if one_by_one else f"iteration {chosen}"
    title = f"clip {dataset.attrs['clip']}; dashed: the solution, {words}; bands: scaled errors"
    grid[0].set_title(in_lines(title, figure.get_figwidth()))
    return figure


def jackknife_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of each pair of components of each vector, with the solutions without each source and an ellipse
    for each kind of error.  Distances of solutions from the mean are multiplied by sqrt(N - 1), so that
    their scatter is the jackknife error.
    """
    problem = "no solutions without each source here: they are not kept for so many sources"
    _require(dataset, "estimate_without", problem)
    vectors, symbols = _vectors(dataset), _symbols(dataset)
    if not vectors:
        raise SweepError("no jackknife scatter: no block of the unknowns is a vector")
    names, without = dataset["source"].values, dataset["estimate_without"].values
    kept = _is_kept(dataset) & np.isfinite(without).all(axis=1)
    names, without = names[kept], without[kept]
    if len(without) < 2:
        raise SweepError("no jackknife scatter: the unknowns depend on single sources")
    stretched = without.mean(axis=0) + np.sqrt(len(without) - 1.0) * (without - without.mean(axis=0))
    far = np.argsort(-dataset["cook_distance"].values[kept])[:5]
    size = 9.0 if len(without) < 60 else 5.0 if len(without) < 300 else 2.0
    dots: dict[str, Any] = {"color": COLOURS[0], "markersize": size, "markeredgewidth": 0.0, "alpha": 0.6}
    dots["rasterized"] = len(without) > 2000
    figure, grid = new_figure(10.0, 3.4 * len(vectors) + 0.5, len(vectors), 3, INSIDE_WIDTH)
    pairs = [pair for block in vectors.values() for pair in combinations(block, 2)]
    drawn = []
    for axes, (i, j) in zip(grid, pairs, strict=False):  # axes that are left over stay empty
        factor, unit = _readable(stretched[:, [i, j]], str(dataset["unit"].values[i]))
        x, y = factor * stretched[:, [i, j]].T
        drawn.append((axes, x, y))
        axes.plot(x, y, ".", label="without one source, displacement × √(N − 1)", **dots)
        for number, kind in enumerate(dataset["error_kind"].values):
            covariance = dataset["covariances"].values[number][np.ix_([i, j], [i, j])]
            if np.all(np.isfinite(covariance)):
                style = {"edgecolor": COLOURS[(number + 1) % len(COLOURS)], "linestyle": LINES[number % len(LINES)]}
                centre, scaled = factor * dataset["estimate"].values[[i, j]], factor**2 * covariance
                axes.add_patch(confidence_ellipse(centre, scaled, 0.683, label=f"{kind}, 68 %", zorder=4, **style))
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel=f"{symbols[i]} [{unit}]", ylabel=f"{symbols[j]} [{unit}]")
        axes.margins(0.12)
        axes.autoscale_view()
        finish(axes)
    for axes in grid[len(pairs) :]:
        axes.set_visible(False)
    legend_below(figure)
    figure.draw_without_rendering()
    for axes, x, y in drawn:
        _name_points(axes, x[far], y[far], names[far].tolist())
    return figure


def spectrum_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of the root of the power of each field by degree, with the noise, and its significance below."""
    problem = "no spectrum here: no vector spherical harmonics are among the unknowns (--degree)"
    _require(dataset, "power", problem)
    degree, most = dataset["degree"].values, 10.0
    fields = [str(field) for field in dataset["field"].values]
    parts = [part for part in ("position", "motion") if any(name.startswith(part) for name in fields)]
    figure, grid = new_figure(1.4 + 4.6 * len(parts), 5.4, 2, len(parts), least=1.0, sharex=True, height_ratios=(3, 2))
    for part, upper, lower in zip(parts, grid, grid[len(parts) :], strict=False):
        chosen = [name for name in fields if name.startswith(part)]
        for number, field in enumerate(chosen):
            one, kind, x = dataset.sel(field=field), field.partition(" ")[2], degree + 0.06 * (2 * number - 1)
            style = marks(number, 5.0)
            signal, noise = (1000.0 * np.sqrt(one[name].values) for name in ("power", "power_noise"))
            upper.plot(x, signal, label=kind, **style)
            upper.plot(degree, noise, color=style["color"], markersize=WIDEST_DASH, label=f"noise, {kind}", **DASH)
            significance = -ndtri(np.clip(one["power_probability"].values, 1e-300, 1.0))
            lower.plot(x, np.minimum(significance, most), **style)
        shown = dataset[["power", "power_noise"]].sel(field=chosen).to_array().values
        logarithmic(upper, "y", 1000.0 * np.sqrt(shown))
        upper.set_ylabel(rf"$\sqrt{{P_l}}$ of the {part}s [µas{'/yr' if part == 'motion' else ''}]")
        lower.axhline(3.0, color="0.4", linestyle="dashed", linewidth=1.0)
        lower.set(ylim=(-2.6, most + 0.8), ylabel=r"significance [$\sigma$]", xlabel="degree $l$")
        lower.text(0.99, 0.93, f"{most:g}: or more", transform=lower.transAxes, ha="right", va="center", fontsize=7)
        lower.xaxis.set_major_locator(MaxNLocator(integer=True))
        lower.set_xlim(degree.min() - 0.5, degree.max() + 0.5)
    for axes in grid:
        finish(axes)
    legend_below(figure)
    return figure


# The sources


def separation_figure(dataset: xr.Dataset) -> Figure:
    """Return histograms of the normalised separations, X before the fit and sqrt(2 Q/n) after it, beside the Rayleigh
    distribution that they follow if the errors are right.
    """
    problem = "no separations here: they are not kept for tables with so many rows"
    _require(dataset, "normalised_separation", problem)
    count, before = dataset["n_observations"].values, dataset["normalised_separation"].values
    used = (count > 0.0) & (before > 0.0)
    if not np.any(used):
        raise SweepError("no source has a separation: no row has a position or motion that the satellite predicts")
    before, after = before[used], np.sqrt(2.0 * dataset["discrepancy"].values[used] / count[used])
    linear = 6.0  # the axis is linear up to here, unless more than a tenth of the sources is beyond
    far = np.quantile(before, 0.9) > linear
    number = int(np.clip(2.0 * np.sqrt(len(before)), 8, 48))
    top = max(float(before.max()), 10.0) if far else linear
    edges = np.geomspace(0.05, top * 1.0001, number + 1) if far else np.linspace(0.0, linear, number + 1)
    x = np.geomspace(edges[0], edges[-1], 400) if far else np.linspace(0.0, edges[-1], 400)
    step = x * np.log(edges[1] / edges[0]) if far else edges[1] - edges[0]
    figure, (axes,) = new_figure(6.4, 4.2)
    counts, counts_after = (np.histogram(one, edges)[0] for one in (before, after))
    axes.stairs(counts, edges, fill=True, color=COLOURS[4], alpha=0.55, label="before the fit, $X$")
    words = r"after the fit, $\sqrt{2\,Q_i/n_i}$"
    axes.stairs(counts_after, edges, color=COLOURS[1], linewidth=1.4, label=words)
    expected = len(before) * step * x * np.exp(-0.5 * x**2)
    axes.plot(x, expected, color="black", linewidth=1.2, label="Rayleigh: the errors are right")
    limit = np.sqrt(2.0 * np.log(max(int(np.sum(count > 0.0)), 2)))
    axes.axvline(limit, color="0.4", linestyle="dashed", linewidth=1.0, label=rf"$\sqrt{{2\ln N}}$ = {limit:.2f}")
    if far:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set(xlim=(edges[0], edges[-1]), xlabel="normalised separation", ylabel=f"sources in a bin, of {len(before)}")
    if beyond := int(np.sum(before > edges[-1])):
        axes.set_title(f"{beyond} beyond {edges[-1]:g} before the fit, {np.sum(after > edges[-1])} after it")
    finish(axes)
    legend(axes)
    return figure


def weight_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of Q/n of each source against its share of the weight of each block that is solved for."""
    share, kept, names = _require_shares(dataset), _is_kept(dataset), dataset["source"].values
    count, discrepancy = dataset["n_observations"].values, dataset["discrepancy"].values
    ratio = np.divide(discrepancy, count, out=np.full(len(names), np.nan), where=count > 0.0)
    positive = ratio[ratio > 0.0]
    ratio = np.maximum(ratio, max(positive.min() if positive.size else 1e-3, 1e-4))  # 0 has no place on a log axis
    gone = (count > 0.0) & ~kept
    blocks = dataset["block_name"].values
    figure, grid = new_figure(max(6.4, 0.8 + 3.8 * len(blocks)), 4.2, 1, len(blocks), INSIDE_WIDTH, sharey=True)
    for axes, name, weight in zip(grid, blocks, share.T, strict=True):
        some = kept & (weight > 0.0)
        dots = {"s": 14.0 if len(names) < 300 else 4.0, "color": COLOURS[0], "alpha": 0.6, "linewidths": 0.0}
        axes.scatter(weight[some], ratio[some], label="kept", **dots)
        if np.any(gone):
            crosses = {"s": 16.0, "color": COLOURS[1], "marker": "x", "linewidths": 0.8}
            left = np.full(gone.sum(), 0.5 * weight[some].min())
            axes.scatter(left, ratio[gone], label="dropped, of no weight", **crosses)
        axes.axhline(1.0, color="black", linewidth=0.8, zorder=1)
        axes.axvline(LARGE_SHARE, zorder=1, **MARK)
        axes.set(xscale="log", yscale="log", xlabel=f"share of the weight in {str(name).replace('_', ' ')}")
        finish(axes)
        axes.margins(0.08)
        axes.set_title(f"{some.sum()} kept" + (f", {gone.sum()} dropped" if np.any(gone) else ""))
    grid[0].set_ylabel("$Q_i/n_i$ (1 is expected)")
    legend_below(figure)  # each panel is full of points
    surprise = chdtrc(np.maximum(count, 1.0), discrepancy)
    figure.draw_without_rendering()
    for axes, weight in zip(grid, share.T, strict=True):
        order = dict.fromkeys([*np.argsort(surprise)[:4], *np.argsort(-weight)[:4]])
        chosen = np.array([k for k in order if kept[k] and weight[k] > 0.0], dtype=int)
        _name_points(axes, weight[chosen], ratio[chosen], names[chosen].tolist())
    return figure


def influence_figure(dataset: xr.Dataset) -> Figure:
    """Return the sources with the largest shares of the weight, and how far the solution moves without each."""
    share = _require_shares(dataset)
    order = np.argsort(-share.max(axis=1))[:RANKED]
    order = order[share.max(axis=1)[order] > 0.0][::-1]
    figure, (left, right) = new_figure(8.0, 1.4, 1, 2, least=1.0, sharey=True)
    y, height = np.arange(len(order)), 0.8 / share.shape[1]
    for number, name in enumerate(dataset["block_name"].values):
        style = {"color": COLOURS[number % len(COLOURS)], "label": str(name).replace("_", " ")}
        left.barh(y + 0.4 - (number + 0.5) * height, share[order, number], height, **style)
    if share.max() > LARGE_SHARE / 3.0:  # else the mark would leave the bars no room
        left.axvline(LARGE_SHARE, **MARK)
    left.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100.0 * value:g} %"))
    right.barh(y, np.nan_to_num(dataset["cook_distance"].values[order]), 0.7, color=COLOURS[5])
    for axes, words in ((left, "share of the weight"), (right, "Cook's distance")):
        axes.xaxis.set_major_locator(MaxNLocator(5 if figure.get_figwidth() > 6.0 else 2))
        axes.set_xlabel(words)
        finish(axes)
    _name_bars(left, dataset["source"].values[order].tolist())
    figure.set_figheight(1.4 + 0.22 * len(order))  # whatever the width: each name needs its line
    legend_below(figure)
    return figure


def _name_bars(axes: Axes, names: list[str]) -> None:
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.tick_params(axis="y", length=0.0)


# Differences and residuals as arrows on the sky

MOST_ARROWS = 150  # more rows than this are averaged in cells of equal area
BANDS = 9
# Arrows of the length that 90 % of them do not exceed take the share TYPICAL of the width of the map; longer ones are
# cut at LONGEST times that length.  Differences and residuals have one scale unless theirs differ by COMMON_SCALE.
LONGEST, TYPICAL, COMMON_SCALE = 1.5, 0.08, 5.0

Arrows = tuple[Array, Array, Array, Array, NDArray[np.bool_]]
"""Places (deg), components towards east and north, and which are of sources that the clip dropped."""


def residual_figure(dataset: xr.Dataset) -> Figure:
    """Return maps of the differences before and the residuals after the fit, of positions and of motions."""
    _require(dataset, "difference", "no residuals here: they are not kept for tables with so many rows")
    complete = {
        what: (pair, int(np.isfinite(dataset["difference"].values[:, pair]).all(axis=1).sum()))
        for what, pair in (("positions", [0, 1]), ("motions", [3, 4]))
    }
    rows = [(what, pair, number) for what, (pair, number) in complete.items() if number]
    if not rows:
        raise SweepError("no residuals on the sky: no row has a position or a motion")
    sky = {"subplot_kw": {"projection": "mollweide"}}
    figure, grid = new_figure(11.0, 3.3 * len(rows) + 0.3, len(rows), 2, SKY_WIDTH, **sky)
    across = figure.get_figwidth() / (1 if len({axes.get_subplotspec().colspan.start for axes in grid}) == 1 else 2)
    for row, (what, pair, number) in enumerate(rows):
        both = [_arrows(dataset, name, pair) for name in ("difference", "residual")]
        scales = [_typical(arrows) for arrows in both]
        if scales[0] < COMMON_SCALE * scales[1] or scales[1] == 0.0:
            scales = [max(scales)] * 2
        unit = str(dataset["observable_unit"].values[pair[0]])
        for axes, when, arrows, scale in zip(grid[2 * row :], ("before", "after"), both, scales, strict=False):
            prepare_sky(axes)
            words = _draw_arrows(axes, arrows, scale or 1.0, unit)
            averages = f", means of {len(arrows[0])} cells" if number > MOST_ARROWS else ""
            axes.set_title(in_lines(f"{what} {when} the fit{averages}{words}", across), pad=10.0)
            axes.label_outer()
    return figure


def _arrows(dataset: xr.Dataset, name: str, pair: list[int]) -> Arrows:
    values, errors = dataset[name].values[:, pair], dataset["difference_error"].values[:, pair]
    rows = np.isfinite(values).all(axis=1)
    source, values, errors = dataset["row_source_index"].values[rows], values[rows], errors[rows]
    ra, dec = dataset["ra"].values[source], dataset["dec"].values[source]
    dropped = dataset["weight_factor"].values[source] == 0.0
    if len(values) <= MOST_ARROWS:
        return ra, dec, values[:, 0], values[:, 1], dropped
    ra, dec, values, weights = ra[~dropped], dec[~dropped], values[~dropped], errors[~dropped] ** -2
    # weighted means at the centres of cells: bands of equal area, each in 2 BANDS steps of right ascension
    band = np.minimum(((np.sin(dec * DEGREE) + 1.0) * 0.5 * BANDS).astype(int), BANDS - 1)
    step = ((ra % 360.0) * (BANDS / 180.0)).astype(int) % (2 * BANDS)
    cells, index = np.unique(2 * BANDS * band + step, return_inverse=True)
    east, north = (np.bincount(index, w * v) / np.bincount(index, w) for w, v in zip(weights.T, values.T, strict=True))
    middle = np.arcsin((cells // (2 * BANDS) + 0.5) / BANDS * 2.0 - 1.0) / DEGREE
    return (cells % (2 * BANDS) + 0.5) * 180.0 / BANDS, middle, east, north, np.zeros(len(cells), dtype=bool)


def _typical(arrows: Arrows) -> float:
    _, _, east, north, dropped = arrows
    return float(np.quantile(np.hypot(east, north)[~dropped], 0.9)) if not np.all(dropped) else 0.0


def _draw_arrows(axes: Any, arrows: Arrows, scale: float, unit: str) -> str:
    """Draw arrows and a key with their scale; return words for the title about arrows that are cut or dropped."""
    ra, dec, east, north, dropped = arrows
    x, y, length = on_map(ra), dec * DEGREE, np.hypot(east, north)
    angles = _angles(axes, x, y, east, north)
    u, v = np.minimum(length, LONGEST * scale) * np.array([np.cos(np.radians(angles)), np.sin(np.radians(angles))])
    style = {"scale": scale / TYPICAL, "scale_units": "width", "units": "width", "width": 0.0028, "clip_on": False}
    for chosen, colour in ((dropped, COLOURS[1]), (~dropped, COLOURS[0])):
        if np.any(chosen):
            axes.scatter(x[chosen], y[chosen], s=5.0, color=colour, linewidths=0.0, zorder=3)
            at = x[chosen], y[chosen], u[chosen], v[chosen]
            drawn = axes.quiver(*at, angles=angles[chosen], color=colour, zorder=4, **style)
            drawn.set_in_layout(False)
    factor, readable_unit = _readable(np.array([scale]), unit)
    key = float(f"{factor * scale:.0e}")  # of one digit
    text = f"{key:g} {readable_unit}"
    small: Any = {"size": 8}
    axes.quiverkey(drawn, 0.04, 0.02, key / factor, text, labelpos="E", coordinates="axes", fontproperties=small)
    n_cut = np.sum(length > LONGEST * scale)
    words = f"; {n_cut} arrow{'s' if n_cut > 1 else ''} cut" if n_cut else ""
    return words + (f"; {np.sum(dropped)} dropped in red" if np.any(dropped) else "")


def _angles(axes: Any, x: Array, y: Array, east: Array, north: Array) -> Array:
    """Return the directions of arrows on the map in degrees: those of a small step along each on the sphere."""
    length = np.maximum(np.hypot(east, north), 1e-300)
    inward = np.where(np.abs(x) > 3.1, np.sign(x), 0.0) * 0.01  # not across the edge of the map
    start = np.stack([x - inward, np.clip(y, -1.55, 1.55)], axis=1)
    step = np.stack([-east / length / np.cos(start[:, 1]), north / length], axis=1) * 1e-4
    projection = axes.transProjection
    there = projection.transform(start + step) - projection.transform(start)
    return np.asarray(np.degrees(np.arctan2(there[:, 1], there[:, 0])))


# Forecasts


def epoch_figure(dataset: xr.Dataset) -> Figure:
    """Return the errors of the unknowns against the epoch of one more position of every source."""
    _require(dataset, "error_with_epoch", "no epochs here: give --add with the epochs of new observations")
    panels, symbols = _unknowns_by(dataset, "unit"), _symbols(dataset)
    order = np.argsort(dataset["new_epoch"].values)
    epochs, errors_then = dataset["new_epoch"].values[order], dataset["error_with_epoch"].values[order]
    stages = list(zip(dataset["stage"].values, dataset["error"].values, LINES[1:], strict=False))
    figure, grid = new_figure(1.2 + 4.4 * len(panels), 4.4, 1, len(panels), least=1.0)
    each = figure.get_figwidth() / len(panels) - 0.4
    for axes, (stored, panel) in zip(grid, panels.items(), strict=True):
        factor, unit = _readable(dataset["error"].values[:, panel], stored)
        for number, k in enumerate(panel[: len(COLOURS)]):
            style = marks(number, 4.0, label=symbols[k])  # nothing was computed between the epochs
            axes.plot(epochs, factor * errors_then[:, k], **style)
            for _, errors, line in stages:
                axes.axhline(factor * errors[k], color=COLOURS[number], linestyle=line, linewidth=0.9)
        axes.set_xlabel(in_lines("epoch of the new position of each source [yr]", each))
        axes.set_ylabel(f"formal error [{unit}]")
        axes.ticklabel_format(axis="x", useOffset=False)
        if len(epochs) <= 8:
            axes.set_xticks(epochs, [f"{epoch:g}" for epoch in epochs])
        axes.set_ylim(bottom=0.0)
        finish(axes)
        above = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "columnspacing": 1.0, "frameon": False}
        axes.legend(ncols=4 if each > 2.0 else 2, **above)
    lines = [Line2D([], [], color="0.3", linestyle=line, linewidth=0.9) for _, _, line in stages]
    figure.legend(lines, [str(stage) for stage, _, _ in stages], ncols=len(lines), **BELOW)
    return figure


def ranking_figure(dataset: xr.Dataset) -> Figure:
    """Return the sources whose observation alone helps most, and the error after each one that was chosen."""
    values, symbols = dataset["criterion_alone"].values, _symbols(dataset)
    stage = str(dataset.attrs["release"]) or "now"  # that new observations are added to
    now = float(dataset["criterion"].values[dataset["stage"].values.tolist().index(stage)])
    goal = [name.strip() for name in str(dataset.attrs["goal"]).split(",")]
    wanted = np.flatnonzero(np.isin(dataset["block"].values, goal))
    gain = 1.0 - (values / now if dataset.attrs["criterion"] == "A" else np.exp(0.5 * (values - now) / len(wanted)))
    if not np.any(gain > 0.0):
        raise SweepError("no ranking here: no new observation, so no source helps; give --add with epochs")
    order = np.argsort(-np.nan_to_num(gain, nan=-1.0))[:RANKED][::-1]
    chosen = [str(name) for name in dataset["step_source"].values[1:]] if "step_source" in dataset else []
    height = 1.6 + 0.2 * len(order)
    figure, grid = new_figure(9.6 if chosen else 5.6, height, 1, 2 if chosen else 1, INSIDE_WIDTH)
    names = [str(name) for name in dataset["source"].values[order]]
    colours = [COLOURS[1] if name in chosen else COLOURS[0] for name in names]
    grid[0].barh(range(len(order)), 100.0 * gain[order], 0.75, color=colours)
    _name_bars(grid[0], names)
    grid[0].set_xlabel(f"error of {dataset.attrs['goal']} less by [%]\nif this source alone is observed")
    if chosen:
        grid[0].set_title("orange: chosen")
        steps = dataset["step_error"].values
        for number, k in enumerate(wanted[: len(COLOURS)]):
            grid[1].plot(steps[:, k] / steps[0, k], label=symbols[k], markersize=4.0, linewidth=1.2, **series(number))
        grid[1].set_xticks(range(len(chosen) + 1), ["none", *chosen], rotation=90, fontsize=7)
        grid[1].set(xlabel="observed, one after the other", ylabel="error relative to none")
        grid[1].legend(loc="best", frameon=False)
    rows = 1 + max(axes.get_subplotspec().rowspan.start for axes in grid)
    figure.set_figheight(rows * height)  # whatever the width: each name needs its line
    for axes in grid:
        finish(axes)
    return figure
