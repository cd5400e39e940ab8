"""Sensitivity indices as tables: for reading, CSV, JSON."""

import json
from typing import TYPE_CHECKING, Any

import xarray as xr

from linksweep.sweep.analysis.columns import Column
from linksweep.sweep.analysis.selection import places_along
from linksweep.sweep.analysis.sensitivity import METHOD
from linksweep.sweep.formatting import plain, reading_table, to_csv, to_json, units_of, with_error

if TYPE_CHECKING:
    from rich.table import Table

ROUNDING = 1e-12
"""Indices below this share of the largest one are rounding errors of a parameter without any effect."""


def rows(result: xr.Dataset) -> list[dict[str, Any]]:
    """Return one mapping for each parameter at each place of the other dimensions: place, parameter and indices."""
    dims = list(map(str, next(iter(result.data_vars.values())).dims))
    names = [*(d for d in dims if d != "parameter"), "parameter", *map(str, result.data_vars)]
    parts = (result.isel(place) for place in places_along(result, dims))
    return [{name: one[name].item() for name in names} for one in parts]


def as_text(result: xr.Dataset) -> "Table":
    """Return a table for reading: each index with its error."""
    columns = columns_of(result)
    title = f"{result.attrs['title']}: sensitivity of {result.attrs['output']}"
    cells = zip(*(column.cells for column in columns), strict=True)
    return reading_table(title, [column.name for column in columns], cells, left="parameter")


def columns_of(result: xr.Dataset) -> list[Column]:
    """Return the columns for reading, their units in their names: places, parameters, and indices with their errors."""
    everything = rows(result)
    columns = []
    scale = max((float(abs(part).max()) for part in result.data_vars.values()), default=0.0)
    for name in everything[0]:
        if name.endswith("_error"):
            continue
        unit = units_of(result[name].attrs) if name in result else ""
        values = [row[name] for row in everything]
        errors = [row.get(f"{name}_error", 0.0) for row in everything]
        if name in result.data_vars:
            cells = [with_error(*_without_rounding(v, e, scale)) for v, e in zip(values, errors, strict=True)]
        else:
            cells = list(map(plain, values))
        columns.append(Column(f"{name} [{unit}]" if unit else name, "", cells, values))
    return columns


def _without_rounding(value: float, error: float, scale: float) -> tuple[float, float]:
    """Return an index and its error, or 0 where both are rounding errors beside the largest index."""
    least = ROUNDING * scale
    return (0.0, 0.0) if abs(value) < least and not error > least else (value, error)


def as_csv(result: xr.Dataset) -> str:
    """Return the table as CSV; an unknown value is an empty cell."""
    everything = rows(result)
    return to_csv(everything[0], (row.values() for row in everything))


def as_json(result: xr.Dataset) -> str:
    """Return the table and its attributes as JSON; an unknown value is null."""
    about = {key: value for key, value in result.attrs.items() if key != "notes"}
    return to_json({**about, "notes": notes(result), "rows": rows(result)})


def notes(result: xr.Dataset) -> list[str]:
    """Return sentences that belong below the table."""
    return [f"by {result.attrs[METHOD]}, from {result.attrs['points']:,} points", *json.loads(result.attrs["notes"])]
