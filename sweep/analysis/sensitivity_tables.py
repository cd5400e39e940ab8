"""Sensitivity indices as tables: for reading, CSV, JSON."""

import csv
import io
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from sweep.analysis.sensitivity import METHOD
from sweep.formatting import is_missing, plain, rounded, to_json, with_error

if TYPE_CHECKING:
    from rich.table import Table


def rows(result: xr.Dataset) -> list[dict[str, Any]]:
    """Return one mapping for each parameter at each place of the other dimensions: place, parameter and indices."""
    return [dict(_row(result, place)) for place in _places(result)]


def as_text(result: xr.Dataset) -> "Table":
    """Return a table for reading: each index with its error."""
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title=Text(f"{result.attrs['title']}: sensitivity of {result.attrs['output']}"),
        title_justify="left",
        box=None,
        pad_edge=False,
        header_style="bold",
    )
    columns = columns_of(result)
    for heading in columns:
        table.add_column(Text(heading), justify="left" if heading == "parameter" else "right", no_wrap=True)
    for cells in zip(*columns.values(), strict=True):
        table.add_row(*(Text(cell) for cell in cells))
    return table


def columns_of(result: xr.Dataset) -> dict[str, list[str]]:
    """Return the cells of each column by its heading."""
    everything = rows(result)
    names = [name for name in everything[0] if not name.endswith("_error")]
    columns = {}
    for name in names:
        unit = str(result[name].attrs.get("units", "")) if name in result else ""
        columns[f"{name} [{unit}]" if unit else name] = [
            _cell(row, name, name in result.data_vars) for row in everything
        ]
    return columns


def as_csv(result: xr.Dataset) -> str:
    """Return the table as CSV; what is not known is an empty cell."""
    everything = rows(result)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(everything[0])
    writer.writerows([["" if is_missing(cell) else cell for cell in row.values()] for row in everything])
    return out.getvalue()


def as_json(result: xr.Dataset) -> str:
    """Return the table with what is known of it; what is not known is null."""
    about = {key: value for key, value in result.attrs.items() if key != "notes"}
    return to_json({**about, "notes": notes(result), "rows": rows(result)})


def notes(result: xr.Dataset) -> list[str]:
    """Return sentences that belong below the table."""
    return [f"by {result.attrs[METHOD]}, from {result.attrs['points']:,} points", *json.loads(result.attrs["notes"])]


def _cell(row: dict[str, Any], name: str, index: bool) -> str:
    if not index:
        return plain(row[name])
    error = row.get(f"{name}_error")
    return rounded(row[name]) if error is None else with_error(row[name], error)


def _places(result: xr.Dataset) -> Iterator[dict[str, int]]:
    dims = [str(d) for d in next(iter(result.data_vars.values())).dims]
    for index in np.ndindex(*(result.sizes[d] for d in dims)):
        yield dict(zip(dims, map(int, index), strict=True))


def _row(result: xr.Dataset, place: dict[str, int]) -> Iterator[tuple[str, Any]]:
    one = result.isel(place)
    for name in [*(d for d in place if d != "parameter"), "parameter", *map(str, result.data_vars)]:
        yield name, one[name].item()
