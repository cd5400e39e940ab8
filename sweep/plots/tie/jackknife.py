"""The solutions without each source, and the ellipses of errors."""

from itertools import combinations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from sweep.contract import SweepError
from sweep.plots.scatter import confidence_ellipse
from sweep.plots.style import COLOURS, figure_size, finish, is_stacked
from sweep.plots.tie.names import kept_sources, name_points, readable, unknown_symbol, vectors
from sweep.readable import written

CONFIDENCE = 0.683
NAMED = 5
LINES = ("solid", "dashed", "dotted", "dashdot", (0, (5, 1, 1, 1)), (0, (1, 3)))


def jackknife_figure(dataset: xr.Dataset) -> Figure:
    """Return each pair of components of each vector: the solutions without each source, with their distances from the
    mean times sqrt(N - 1), so that their scatter is the jackknife error, and an ellipse for each kind of error.
    """
    if "estimate_without" not in dataset:
        raise SweepError("no solutions without each source here: they are not kept of so many sources")
    blocks = vectors(dataset)
    if not blocks:
        raise SweepError("no jackknife scatter: no block of the unknowns is a vector")
    names, without = dataset["source"].values, dataset["estimate_without"].values
    kept = kept_sources(dataset) & np.isfinite(without).all(axis=1)
    names, without = names[kept], without[kept]
    if len(without) < 2:
        raise SweepError("no jackknife scatter: the unknowns depend on single sources")
    stretched = without.mean(axis=0) + np.sqrt(len(without) - 1.0) * (without - without.mean(axis=0))
    far = np.argsort(-dataset["cook_distance"].values[kept])[:NAMED]
    width, height = figure_size(10.0, 3.4 * len(blocks) + 0.5)
    stacked = is_stacked()
    figure = Figure(figsize=(width, 3.0 * width / len(blocks) + 1.0 if stacked else height), layout="constrained")
    shape = (3, len(blocks)) if stacked else (len(blocks), 3)
    grid = figure.subplots(*shape, squeeze=False)
    grid = grid.T if stacked else grid
    kinds = [str(kind) for kind in dataset["error_kind"].values]
    for row, places in enumerate(blocks.values()):
        factor, unit = readable(stretched[:, places], str(dataset["unit"].values[places[0]]))
        for axes, (i, j) in zip(grid[row], combinations(places, 2), strict=True):
            axes.plot(
                *(factor * stretched[:, [i, j]].T),
                ".",
                color=COLOURS[0],
                markersize=9.0 if len(without) < 60 else 5.0 if len(without) < 300 else 2.0,
                markeredgewidth=0.0,
                alpha=0.6,
                rasterized=len(without) > 2000,
                label="without one source, displacement × √(N − 1)",
            )
            for number, kind in enumerate(kinds):
                covariance = dataset["covariances"].values[number][np.ix_([i, j], [i, j])]
                if np.all(np.isfinite(covariance)):
                    centre = factor * dataset["estimate"].values[[i, j]]
                    outline = confidence_ellipse(centre, factor**2 * covariance, CONFIDENCE, label=f"{kind}, 68 %")
                    colour, line = COLOURS[(number + 1) % len(COLOURS)], LINES[number % len(LINES)]
                    outline.set(edgecolor=colour, linestyle=line, zorder=4)
                    axes.add_patch(outline)
            axes.set_aspect("equal", adjustable="datalim")
            for which, k in ((axes.set_xlabel, i), (axes.set_ylabel, j)):
                which(f"{unknown_symbol(str(dataset['unknown'].values[k]))} [{written(unit)}]")
            axes.margins(0.12)
            axes.autoscale_view()
            finish(axes)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=1 if stacked else min(4, len(labels)), frameon=False
    )
    figure.draw_without_rendering()
    for row, places in enumerate(blocks.values()):
        factor, _ = readable(stretched[:, places], "mas")
        for axes, (i, j) in zip(grid[row], combinations(places, 2), strict=True):
            name_points(axes, factor * stretched[far, i], factor * stretched[far, j], names[far].tolist())
    return figure
