"""What is derived from results: fits, crossings, indices and measurements, which are all one kind of dataset.

Such a dataset says everything itself: the variables for reading have the attribute ``headline``, their rank (or all
are for reading), the one-sigma error of NAME is NAME_error, ``conclusion`` is in words, and the attribute ``notes`` has
sentences as JSON.
"""

import json
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from linksweep.sweep.analysis import quantity
from linksweep.sweep.formatting import described, prefixed, rounded, units_of, with_error
from linksweep.sweep.table_writer import Column, Table

LEAST_SHARE = 1.0  # of a result, in percent, that a sentence names


def derived(
    grid: xr.Dataset,
    dims: Sequence[Hashable],
    columns: Mapping[str, tuple[Any, str, str]],
    shown: Sequence[str],
    notes: Sequence[str],
    **about: Any,
) -> xr.Dataset:
    """Return a dataset over the dimensions of a grid with ``columns`` of values (in C order), unit and meaning, of
    which some are ``shown`` in tables, in this order.
    """
    shape, variables = [grid.sizes[d] for d in dims], {}
    for name, (values, unit, meaning) in columns.items():
        rank = {"headline": shown.index(name) + 1} if name in shown else {}
        attributes = described(unit, meaning) | rank
        array = np.array(values, dtype=object if name == "conclusion" else float)
        variables[name] = tuple(dims), array.reshape(shape), attributes
    return grid.assign(variables).assign_attrs(**about, notes=json.dumps(list(notes)))


def headline(result: xr.Dataset) -> list[str]:
    """Return in a sentence which parameters decide a result, if these are indices of one number at each point."""
    if "first" not in result or result["first"].ndim != 1 or result.sizes["parameter"] < 2:
        return []
    names, shares, errors = result.parameter.values, *(100.0 * result[n].values for n in ("first", "first_error"))
    known = [k for k in np.argsort(-shares).tolist() if shares[k] >= LEAST_SHARE]
    words = [f"{names[k]} {shares[k]:.0f}{f' ± {errors[k]:.0f}' if errors[k] >= 0.5 else ''} %" for k in known]
    if "total" in result and (rest := 100.0 - shares.sum()) >= LEAST_SHARE:
        words.append(f"several together {rest:.0f} %")
    return [f"What decides it: {', '.join(words)}."] if words else []


def tables(result: xr.Dataset) -> list[Table]:
    """Return one table for reading: places on the axes, numbers with their errors, and what is concluded."""
    ranks = {str(n): v.attrs["headline"] for n, v in result.data_vars.items() if "headline" in v.attrs}
    headlines = sorted(ranks, key=lambda name: ranks[name])
    names = headlines or [str(n) for n in result.data_vars if not str(n).endswith("_error")]
    dims = _dims(result)
    columns = []
    for name in quantity.axis_coordinates(result, dims):
        values = quantity.listed(result, name, dims)
        is_text = any(isinstance(value, str) for value in values)
        columns.append(Column(name, values, unit=units_of(result[name].attrs), left=is_text))
    for rank, name in enumerate(names):
        values = quantity.listed(result, name, dims)
        if name == "conclusion":
            columns += [Column(name, values, values, wrap=24)] if any(values) else []
            continue
        unit, factor = prefixed(values, units_of(result[name].attrs))
        cells = [rounded(factor * value) for value in values]
        if f"{name}_error" in result:
            errors = quantity.listed(result, f"{name}_error", dims)
            cells = [with_error(factor * v, factor * e) for v, e in zip(values, errors, strict=True)]
        # the last are left out first where there is no room
        columns += [Column(name, values, cells, unit, name, rank)] if any(cells) else []
    return [Table(columns, str(result.attrs.get("title", "")))]


def records(result: xr.Dataset) -> Table:
    """Return all variables with one row for each place, and the attributes, for programs."""
    dims = _dims(result)
    names = [*quantity.axis_coordinates(result, dims), *map(str, result.data_vars)]
    others = [str(n) for n in result.coords if n not in names]
    columns = [Column(n, quantity.listed(result, n, dims)) for n in (*others, *names)]
    units = {str(n): v.attrs["units"] for n, v in result.variables.items() if v.attrs.get("units")}
    return Table(columns, about={**result.attrs, "notes": notes(result), "units": units})


def notes(result: xr.Dataset) -> list[str]:
    """Return the sentences below the table."""
    return list(json.loads(result.attrs.get("notes", "[]")))


def _dims(result: xr.Dataset) -> list[str]:
    return [str(d) for d in next(iter(result.data_vars.values())).dims]
