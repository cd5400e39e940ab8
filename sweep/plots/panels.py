"""Small panels: one picture for every value of one or two dimensions, or for every variable, with one legend."""

from collections.abc import Callable, Iterator
from typing import Any

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sweep.analysis.readable_units import in_readable_units
from sweep.contract import SweepError
from sweep.plots.layout import Layout
from sweep.plots.style import value_text

LEGEND_INCHES = (0.6, 0.065)
"""Width of an entry of a legend, and of each of its letters."""

Panel = Callable[[Axes, xr.Dataset, str], Axes]


def draw_panels(dataset: xr.Dataset, variables: list[str], layout: Layout, draw: Panel) -> Figure:
    """Return a figure of panels: columns and rows as the layout says, variables as columns if there are several."""
    columns, rows = layout.columns, layout.rows
    if len(variables) > 1:
        if columns is not None and rows is not None:
            raise SweepError(
                "several variables leave room for one dimension of panels; fix others with --at AXIS=VALUE"
            )
        columns, rows = None, columns or rows
    n_columns = len(variables) if len(variables) > 1 else dataset.sizes[columns] if columns else 1
    n_rows = dataset.sizes[rows] if rows else 1
    size = (6.4, 4.4) if n_columns * n_rows == 1 else (1.2 + 3.1 * n_columns, 1.2 + 2.4 * n_rows)
    figure = Figure(figsize=size, layout="constrained")
    own_units = layout.far and len(variables) == 1
    if not own_units:
        dataset = in_readable_units(dataset)
    share: Any = "col" if layout.far or len(variables) > 1 else True
    grid = figure.subplots(n_rows, n_columns, sharex=True, sharey=share, squeeze=False)
    for row, column, part, name, title in _parts(dataset, variables, columns, rows, own_units):
        axes = grid[row, column]
        draw(axes, part, name)
        axes.set_title(title)
        if row < n_rows - 1:
            axes.set_xlabel("")
        if column and len(variables) == 1 and not own_units:
            axes.set_ylabel("")
    if grid.size > 1:
        _common_legend(figure, grid)
    return figure


def _parts(
    dataset: xr.Dataset, variables: list[str], columns: str | None, rows: str | None, own_units: bool
) -> Iterator[tuple[int, int, xr.Dataset, str, str]]:
    across = (
        [(name, None) for name in variables]
        if len(variables) > 1
        else [(variables[0], i) for i in _indices(dataset, columns)]
    )
    for column, (name, index) in enumerate(across):
        whole = dataset if columns is None or index is None else dataset.isel({columns: index})
        if own_units:
            whole = in_readable_units(whole)
        for row in _indices(dataset, rows):
            part = whole if rows is None or row is None else whole.isel({rows: row})
            chosen = [d for d, i in ((rows, row), (columns, index)) if d is not None and i is not None]
            title = ", ".join(value_text(dataset, d, part[d].item()) for d in chosen)
            yield row or 0, column, part, name, title


def _indices(dataset: xr.Dataset, dimension: str | None) -> list[int | None]:
    return [None] if dimension is None else list(range(dataset.sizes[dimension]))


def _common_legend(figure: Figure, grid: Any) -> None:
    """Draw one legend below all panels instead of one in each."""
    entries: dict[str, Any] = {}
    for axes in grid.flat:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(text, handle)
        if axes.get_legend() is not None:
            axes.get_legend().remove()
    if len(entries) > 1:
        last = [text for text in ("predicted", "published") if text in entries]
        order = [text for text in entries if text not in last] + last
        width = LEGEND_INCHES[0] + LEGEND_INCHES[1] * max(map(len, order))
        columns = max(1, min(len(order), int(figure.get_figwidth() / width)))
        handles = [entries[text] for text in order]
        figure.legend(handles, order, loc="outside lower center", ncols=columns, frameon=False)
