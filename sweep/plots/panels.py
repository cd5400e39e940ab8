"""Small panels: which dimensions of a quantity become colours, and which become columns and rows of panels."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from linksweep.sweep.analysis.quantity import in_readable_units, places_along
from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots.style import (
    COLOURS,
    SCALE,
    in_lines,
    is_logarithmic,
    is_narrow,
    least_height,
    legend_below,
    most_columns,
    value_text,
    wanted_width,
)

MOST_PANELS = 24
MOST_ACROSS = 4  # panels of one dimension side by side; more of them continue in further rows
MOST_INSIDE = 4  # a legend with more entries than this stands below the panel, where it covers nothing
FAR = 30.0  # series whose medians differ by more than this factor need panels with axes of their own
BESIDE_INCHES = 0.4  # what labels and ticks take of a panel's width and height; its titles have the rest

Draw = Callable[[Axes, xr.Dataset, str], Any]


@dataclass(frozen=True)
class Layout:
    """Dimensions of a picture: ``series`` become colours of one panel, ``columns`` and ``rows`` panels.

    ``far`` is true if columns differ so much that each needs a scale of its own.
    """

    series: tuple[str, ...] = ()
    columns: str | None = None
    rows: str | None = None
    far: bool = False


class _Panel(NamedTuple):
    """A picture: its part of the dataset in readable units, its place, its title, and what shares its y axis."""

    row: int
    column: int
    part: xr.Dataset
    name: str
    title: str
    shares: tuple[Any, ...]


def arrange(dataset: xr.Dataset, variable: str, along: tuple[str, ...], series: bool = True) -> Layout:
    """Return the layout of the dimensions of a variable other than those it is drawn ``along``.

    The dimension along which values differ most becomes columns, if there are several or values differ by more than
    `FAR`.  The others become colours, and one of them rows if there are three or more.  With ``series = False`` none
    becomes colours.  Raises SweepError where there are more colours or panels than can be told apart.
    """
    array = dataset[variable]
    others = [str(d) for d in array.dims if d not in along and array.sizes[d] > 1]
    widest, *rest = sorted(others, key=lambda d: -_separation(array, d)) or [""]
    far = bool(widest) and _separation(array, widest) > FAR and array.sizes[widest] <= len(COLOURS)
    if not series:
        if len(others) > 2:
            names = ", ".join([widest, *rest])
            raise SweepError(f"{len(others)} dimensions are left for panels, {names}; fix some with --at AXIS=VALUE")
        layout = Layout((), widest or None, rest[0] if rest else None)
    elif len(others) <= 1:
        layout = Layout(columns=widest, far=True) if far else Layout(tuple(others))
    else:
        rows = min(rest, key=lambda d: (array[d].dtype.kind not in "if", array.sizes[d])) if len(rest) > 1 else None
        layout = Layout(tuple(d for d in others if d not in (widest, rows)), widest, rows, far)
    panels = [d for d in (layout.columns, layout.rows) if d is not None]
    n_series, n_panels = (int(np.prod([array.sizes[d] for d in ds], dtype=int)) for ds in (layout.series, panels))
    if n_series > len(COLOURS) or n_panels > MOST_PANELS:
        sizes = ", ".join(f"{d} ({array.sizes[d]})" for d in (*layout.series, *panels))
        raise SweepError(
            f"{sizes}: {n_panels} panels of {n_series} series are too many for one picture, at most {MOST_PANELS} of "
            f"{len(COLOURS)}; fix some with --at AXIS=VALUE"
        )
    return layout


def _separation(array: xr.DataArray, dimension: str) -> float:
    """Return the ratio between the largest and the smallest of the medians along a dimension."""
    medians = np.abs(array.median([d for d in array.dims if d != dimension], skipna=True).values)
    medians = medians[np.isfinite(medians) & (medians > 0.0)]
    return float(medians.max() / medians.min()) if medians.size else 1.0


def series_of(dataset: xr.Dataset, variable: str, *along: str) -> list[tuple[str, xr.Dataset]]:
    """Return what has a colour of its own: the part of a dataset for every combination of the dimensions of a variable,
    except those it is drawn ``along``, that has a value, with its name; raises SweepError for more parts than colours.
    """
    others = [str(d) for d in dataset[variable].dims if d not in along]
    everything = [dataset.isel(place) for place in places_along(dataset, others)]
    parts = [one for one in everything if np.isfinite(one[variable].values).any()]  # a study may exclude the others
    if len(parts) > len(COLOURS):
        sizes = ", ".join(f"{d} ({dataset.sizes[d]})" for d in others)
        raise SweepError(f"{variable} has {sizes}, too many to tell apart; fix some with --at AXIS=VALUE")
    named = [d for d in others if d in dataset.coords and dataset.sizes[d] > 1]
    return [(", ".join(value_text(dataset, d, one[d].item()) for d in named), one) for one in parts]


def draw_panels(
    dataset: xr.Dataset, variables: list[str], layout: Layout, draw: Draw, one_unit: bool = False, named: bool = False
) -> Figure:
    """Return a figure of panels: columns and rows as the layout says, variables as columns if there are several.

    Panels that would be empty are left out.  Those whose values differ by orders of magnitude have axes and units of
    their own, unless ``one_unit``.  If the figure is too narrow for the columns, they continue in further rows.
    With ``named`` there is no legend, because ``draw`` writes the names beside what it draws.
    """
    columns, rows = layout.columns, layout.rows
    if len(variables) > 1:
        if columns is not None and rows is not None:
            problem = "several variables leave room for one dimension of panels; fix others with --at AXIS=VALUE"
            raise SweepError(problem)
        columns, rows = None, columns or rows
    panels = _panels(dataset, variables, columns, rows, layout.far and not one_unit)
    seen = [sorted({panel[i] for panel in panels}) for i in (0, 1)]  # rows and columns that are not empty
    wanted = len(seen[1])
    across = min(most_columns(wanted), MOST_ACROSS if rows is None else wanted)
    across = -(-wanted // -(-wanted // across))  # the same number in every row
    places = [(seen[0].index(panel.row), seen[1].index(panel.column)) for panel in panels]
    if across < wanted:
        places = [divmod(i, across) for i in range(len(panels))]
    down = 1 + max(row for row, _ in places)
    if (width := wanted_width()) is None:
        each, high = 3.1, 2.4
        size = (6.4, 4.4) if len(panels) == 1 else (1.2 + each * across, 1.2 + high * down)
    else:
        each, high = width / across, max(0.75 * width / across, least_height())
        size = width, high * down + (0.0 if len(panels) == 1 else 0.3)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.add_gridspec(down, across)
    drawn: dict[tuple[int, int], _Panel] = {}
    firsts: dict[tuple[Any, ...], Axes] = {}
    for panel, (row, column) in zip(panels, places, strict=True):
        shared = {"sharex": next(iter(firsts.values()), None), "sharey": firsts.get(panel.shares)}
        axes = figure.add_subplot(grid[row, column], **shared)
        firsts.setdefault(panel.shares, axes)
        draw(axes, panel.part, panel.name)
        axes.set_label(panel.name)  # for the caption
        axes.set_title(in_lines(panel.title, each - BESIDE_INCHES))
        drawn[row, column] = panel
        left = drawn.get((row, column - 1))
        if left is not None and left.shares == panel.shares:
            axes.set_ylabel("")
            axes.tick_params(axis="y", which="both", labelleft=False)
        axes.set_ylabel(in_lines(axes.get_ylabel(), high - BESIDE_INCHES))
        if any(other > row for other, here in places if here == column):
            axes.set_xlabel("")
            axes.tick_params(axis="x", which="both", labelbottom=False)
        axes.set_xlabel(in_lines(axes.get_xlabel(), each - BESIDE_INCHES))
    many = len(panels) > 1 or len(figure.axes[0].get_legend_handles_labels()[1]) > MOST_INSIDE
    if (many or is_narrow()) and not named:
        legend_below(figure)
    return figure


def _panels(
    dataset: xr.Dataset, variables: list[str], columns: str | None, rows: str | None, far: bool
) -> list[_Panel]:
    """Return the panels that have anything to show, row by row."""
    several = len(variables) > 1
    across: list[tuple[str, int | None]] = [(name, i) for name in variables for i in _indices(dataset, columns)]
    panels = []
    for column, (name, index) in enumerate(across):
        far_rows = several and rows is not None and _separation(dataset[name], rows) > FAR
        for row in _indices(dataset, rows):
            place = {d: i for d, i in ((rows, row), (columns, index)) if d is not None and i is not None}
            alone = {d: i for d, i in place.items() if (far_rows if d == rows else far)}
            whole = in_readable_units(dataset.isel(alone))  # of all panels that share an axis
            scale = "log" if is_logarithmic(whole[name]) else "linear"
            whole = whole.assign({name: whole[name].assign_attrs({SCALE: scale})})
            part = whole.isel({d: i for d, i in place.items() if d not in alone})
            if np.isfinite(part[name].values.astype(float)).any():
                title = ", ".join(value_text(dataset, d, dataset[d][i].item()) for d, i in place.items())
                panels.append(_Panel(row or 0, column, part, name, title, (name, *alone.items())))
    return sorted(panels, key=lambda panel: panel[:2])


def _indices(dataset: xr.Dataset, dimension: str | None) -> list[int | None]:
    return [None] if dimension is None else list(range(dataset.sizes[dimension]))
