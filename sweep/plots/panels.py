"""Small panels: one picture for every value of one or two dimensions, or for every variable, with one legend."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from linksweep.sweep.analysis.readable_units import in_readable_units
from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots.labels import value_text
from linksweep.sweep.plots.layout import Layout, is_far
from linksweep.sweep.plots.legends import legend_below
from linksweep.sweep.plots.scales import SCALE, scale_of
from linksweep.sweep.plots.style import figure_size, in_lines, is_narrow, least_height, most_columns, wanted_width

MOST_INSIDE = 4
"""A legend with more entries than this stands below the panel, where it covers nothing."""

MOST_ACROSS = 4
"""The most panels of one dimension side by side; more of them continue in further rows."""

BESIDE_INCHES = 0.4
"""Width and height of a panel that labels and ticks take; its titles have the rest."""

Draw = Callable[[Axes, xr.Dataset, str], Any]


@dataclass(frozen=True)
class Panel:
    """One picture: its place in the grid, its part of the dataset in readable units, and what shares its y axis."""

    row: int
    column: int
    part: xr.Dataset
    name: str
    row_title: str
    column_title: str
    shares: tuple[Any, ...]


def draw_panels(
    dataset: xr.Dataset,
    variables: list[str],
    layout: Layout,
    draw: Draw,
    one_unit: bool = False,
    rows_named: bool = False,
) -> Figure:
    """Return a figure of panels: columns and rows as the layout says, variables as columns if there are several.

    Panels that would be empty are left out.  Those whose values differ by orders of magnitude have axes and units of
    their own, unless ``one_unit``.  If the figure is too narrow for the columns, they continue in further rows.
    With ``rows_named`` there is no legend, because ``draw`` writes the names beside what it draws.
    """
    columns, rows = layout.columns, layout.rows
    if len(variables) > 1:
        if columns is not None and rows is not None:
            raise SweepError(
                "several variables leave room for one dimension of panels; fix others with --at AXIS=VALUE"
            )
        columns, rows = None, columns or rows
    panels = list(_panels(dataset, variables, columns, rows, layout.far and not one_unit))
    wanted = len({panel.column for panel in panels})
    across = min(most_columns(wanted), MOST_ACROSS if rows is None else wanted)
    across = -(-wanted // -(-wanted // across))  # the same number in every row
    folded = across < wanted
    places = [(i // across, i % across) for i in range(len(panels))] if folded else _without_gaps(panels)
    n_rows = 1 + max(row for row, _ in places)
    figure = Figure(figsize=_figure_size(len(panels), across, n_rows), layout="constrained")
    room = [each - BESIDE_INCHES for each in _panel_size(across)]
    grid = figure.add_gridspec(n_rows, across)
    first: dict[tuple[Any, ...], Axes] = {}
    lowest = {column: max(row for row, other in places if other == column) for _, column in places}
    drawn: dict[tuple[int, int], tuple[Axes, Panel]] = {}
    for panel, (row, column) in zip(panels, places, strict=True):
        shared = first.get(panel.shares)
        axes = figure.add_subplot(grid[row, column], sharex=next(iter(first.values()), None), sharey=shared)
        first.setdefault(panel.shares, axes)
        draw(axes, panel.part, panel.name)
        axes.set_label(panel.name)  # for the caption
        drawn[row, column] = axes, panel
        left = drawn.get((row, column - 1))
        if left is not None and left[1].shares == panel.shares:
            axes.set_ylabel("")
            axes.tick_params(axis="y", which="both", labelleft=False)
        axes.set_xlabel(in_lines(axes.get_xlabel(), room[0]) if row == lowest[column] else "")
        axes.set_ylabel(in_lines(axes.get_ylabel(), room[1]))
        if row < lowest[column]:
            axes.tick_params(axis="x", which="both", labelbottom=False)
        _entitle(axes, panel, room, folded, row, column == across - 1 or (row, column + 1) not in places)
    many = len(panels) > 1 or len(figure.axes[0].get_legend_handles_labels()[1]) > MOST_INSIDE
    if (many or is_narrow()) and not rows_named:
        legend_below(figure)
    return figure


def _entitle(axes: Axes, panel: Panel, room: list[float], folded: bool, row: int, is_last: bool) -> None:
    """Write the titles of a panel: of its column above, of its row at the right; both above if ``folded``."""
    if folded or not (panel.row_title and panel.column_title):
        title = (",\n" if folded else ", ").join(filter(None, (panel.row_title, panel.column_title)))
        axes.set_title(in_lines(title, room[0]))
        return
    if row == 0:
        axes.set_title(in_lines(panel.column_title, room[0]))
    if is_last:
        title = in_lines(panel.row_title, room[1])
        axes.annotate(title, (1.02, 0.5), xycoords="axes fraction", rotation=270, va="center", ha="left", ma="center")


def _panel_size(across: int) -> tuple[float, float]:
    """Return width and height in inches of a panel with its labels."""
    if wanted_width() is None:
        return 3.1, 2.4
    each = figure_size(1.0, 1.0)[0] / across
    return each, max(0.75 * each, least_height())


def _figure_size(panels: int, across: int, rows: int) -> tuple[float, float]:
    width, height = _panel_size(across)
    if wanted_width() is None:
        return (6.4, 4.4) if panels == 1 else (1.2 + width * across, 1.2 + height * rows)
    return width * across, height * rows + (0.0 if panels == 1 else 0.3)


def _without_gaps(panels: list[Panel]) -> list[tuple[int, int]]:
    """Return the places of panels after empty rows and columns are removed."""
    rows, columns = sorted({panel.row for panel in panels}), sorted({panel.column for panel in panels})
    return [(rows.index(panel.row), columns.index(panel.column)) for panel in panels]


def _panels(
    dataset: xr.Dataset, variables: list[str], columns: str | None, rows: str | None, far: bool
) -> Iterator[Panel]:
    """Yield the panels that have anything to show, row by row."""
    several = len(variables) > 1
    across: list[tuple[str, int | None]] = (
        [(name, None) for name in variables] if several else [(variables[0], i) for i in _indices(dataset, columns)]
    )
    found = []
    for column, (name, index) in enumerate(across):
        far_rows = several and rows is not None and is_far(dataset[name], rows)
        for row in _indices(dataset, rows):
            place = {d: i for d, i in ((rows, row), (columns, index)) if d is not None and i is not None}
            own = {d: i for d, i in place.items() if (far_rows if d == rows else far)}
            whole = in_readable_units(dataset.isel(own))  # of all panels that share an axis
            whole = whole.assign({name: whole[name].assign_attrs({SCALE: scale_of(whole[name])})})
            part = whole.isel({d: i for d, i in place.items() if d not in own})
            if not np.isfinite(part[name].values.astype(float)).any():
                continue
            titles = {d: value_text(dataset, d, dataset[d][i].item()) for d, i in place.items()}
            shares = ((name,) if several else ()) + tuple(own.items())
            of_row, of_column = (titles.get(d or "", "") for d in (rows, columns))
            found.append(Panel(row or 0, column, part, name, of_row, of_column, shares))
    yield from sorted(found, key=lambda panel: (panel.row, panel.column))


def _indices(dataset: xr.Dataset, dimension: str | None) -> list[int | None]:
    return [None] if dimension is None else list(range(dataset.sizes[dimension]))
