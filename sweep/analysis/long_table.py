"""Results with one row per point: for a script (CSV, JSON), for astronomers (ECSV)."""

import io
import json
import math
from textwrap import indent
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from linksweep.sweep.formatting import is_missing, is_truth, to_csv, to_json
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.studies.record import FUNCTION

Long = dict[str, tuple[str, list[Any]]]
"""Unit and values of each column of a table with one row per point."""


def long_table(dataset: xr.Dataset, places: NDArray[np.intp] | None = None) -> Long:
    """Return columns {name: (unit, values)} with one row per point, for all points or those at ``places``, counted in C
    order: the axes, then every variable without further dimensions; for a plain function also those with further
    dimensions, each value a list.
    """
    rows = slice(None) if places is None else places
    dimensions = axes_of(dataset)
    flat = [str(n) for n, v in dataset.data_vars.items() if set(v.dims) <= set(dimensions)]
    columns: Long = {}
    template = xr.zeros_like(dataset["status"], dtype=object) if dimensions else dataset["status"]
    for name in [*axis_coordinates(dataset, dimensions), *flat, *array_outputs(dataset)]:
        variable = dataset[name]
        if is_truth(variable) and variable.dtype.kind == "f":
            known = variable.values.astype(bool).astype(object)
            variable = variable.copy(data=np.where(np.isnan(variable.values), np.nan, known))
        variable = variable.broadcast_like(template).transpose(*dimensions, ...)
        values = variable.values.reshape(-1, *variable.shape[len(dimensions) :])[rows]
        columns[name] = (dataset[name].attrs.get("units", ""), _listed(values))
    status = columns["status"][1]
    words = [code.word for code in Status]
    columns["status"] = ("", [words[code] for code in status])
    return columns


def array_outputs(dataset: xr.Dataset) -> list[str]:
    """Return the outputs of a plain function that have dimensions of their own."""
    return [n for n in map(str, dataset.data_vars) if own_dimensions(dataset, n)] if FUNCTION in dataset.attrs else []


def own_dimensions(dataset: xr.Dataset, name: str) -> list[str]:
    """Return the dimensions of an output that are not axes of the study."""
    return [str(d) for d in dataset[name].dims if d not in dataset["status"].dims]


def _listed(values: Any) -> list[Any]:
    """Return values as Python objects, times as texts."""
    if values.dtype.kind == "M":
        values = np.where(np.isnat(values), "", np.datetime_as_string(values, unit="auto").astype(object))
    listed: list[Any] = values.tolist()
    return listed


def axes_of(dataset: xr.Dataset) -> list[str]:
    """Return the dimensions that are axes of the study."""
    return [str(d) for d in dataset["status"].dims]


def axis_coordinates(dataset: xr.Dataset, dimensions: list[str]) -> list[str]:
    """Return the coordinates along some dimensions in their order, that with the name of the dimension first."""
    names = [str(n) for n, c in dataset.coords.items() if set(c.dims) <= set(dimensions) and c.dims]
    place = {name: dimensions.index(str(dataset[name].dims[0])) for name in names}
    return sorted(names, key=lambda name: (place[name], name not in dimensions, name))  # xarray sorts by name


def as_csv(dataset: xr.Dataset) -> str:
    """Return the long table as CSV; a missing value is an empty cell, units stand in the header as ``name [unit]``."""
    columns = long_table(dataset)
    header = [f"{name} [{unit}]" if unit else name for name, (unit, _) in columns.items()]
    rows = zip(*(values for _, values in columns.values()), strict=True)
    return to_csv(header, ([json.dumps(cell) if isinstance(cell, list) else cell for cell in row] for row in rows))


def as_ecsv(dataset: xr.Dataset) -> str:
    """Return the long table as ECSV, which astropy reads with its units."""
    from astropy.table import MaskedColumn, Table

    table = Table(meta={"title": dataset.attrs.get("title", ""), "study_digest": dataset.attrs.get("study_digest", "")})
    for name, (unit, values) in long_table(dataset).items():
        cells = np.array(values, dtype=object)
        missing = np.array([is_missing(cell) for cell in cells.reshape(-1)], dtype=bool).reshape(cells.shape)
        known = next(iter(cells[~missing]), math.nan)
        masked = missing.any() and (cells.ndim == 1 or isinstance(known, int))  # arrays of floats can hold NaN
        if masked:
            cells[missing] = known  # a NaN would make floats of integers
        table[name] = MaskedColumn(cells.tolist(), mask=missing if masked else False, unit=unit or None)
    out = io.StringIO()
    table.write(out, format="ascii.ecsv")
    return out.getvalue()


def as_json(dataset: xr.Dataset) -> str:
    """Return the long table as JSON: units by column, and one object per point, null for a missing value."""
    columns = long_table(dataset)
    cells = zip(*(values for _, values in columns.values()), strict=True)
    # row by row: dictionaries of all points would take more memory than everything else
    rows = ",\n".join(indent(to_json(dict(zip(columns, row, strict=True))), "  ") for row in cells)
    arrays = {
        name: {"dims": dims, "coordinates": {dim: _listed(dataset[dim].values) for dim in dims}}
        for name in array_outputs(dataset)
        for dims in [own_dimensions(dataset, name)]
    }
    units = {name: unit for name, (unit, _) in columns.items()}
    units |= {dim: dataset[dim].attrs.get("units", "") for told in arrays.values() for dim in told["dims"]}
    frame = to_json({"units": units, **({"arrays": arrays} if arrays else {}), "rows": []})
    return frame.removesuffix("[]\n}") + f"[\n{rows}\n ]\n}}" if rows else frame
