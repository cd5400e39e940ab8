"""The table of the headline results for reading: values with their errors, predictions, published values."""

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from linksweep.sweep.analysis.columns import Column, fitting
from linksweep.sweep.analysis.gaps import exact
from linksweep.sweep.analysis.long_table import (
    Long,
    array_outputs,
    axes_of,
    axis_coordinates,
    long_table,
    own_dimensions,
)
from linksweep.sweep.analysis.quantity import (
    PREDICTION_SUFFIXES,
    errors_beside,
    headline_variables,
    prediction_name,
    standard_error,
    where_they_change,
    with_values,
)
from linksweep.sweep.analysis.readable_units import in_readable_units
from linksweep.sweep.formatting import (
    first_of,
    is_missing,
    plain,
    prefixed,
    reading_table,
    rounded,
    units_of,
    with_error,
)
from linksweep.sweep.planning.point_status import Status

if TYPE_CHECKING:
    from rich.table import Table

VISIBLE_BIAS = 1e-3
"""The parts of a prediction are shown if the bias increases it by a larger fraction than this."""


VALUE, PUBLISHED, PREDICTED, PARTS = 0, 1, 2, 4
"""Ranks of the columns of the main quantity; those of other quantities are larger by `OTHER`."""

OTHER = 3


ERROR = "error of {}"
"""The name of the column with the whole one-sigma error of a variable, in tables for reading."""

MOST_ROWS = 200
"""The most rows of a table for reading: formatting a hundred thousand would take longer than computing them."""


def as_text(dataset: xr.Dataset, width: int | None = None) -> tuple["Table", list[Column]]:
    """Return a table of the headline results for reading, and the columns that are left out: value +- one-sigma error,
    prediction, published value and difference of the first `MOST_ROWS` points, as far as they fit into ``width``
    characters.
    """
    columns, left_out = fitting(headline_columns(dataset, MOST_ROWS), width)
    return _as_table(str(dataset.attrs.get("title", "")), columns), left_out


def errors_as_text(dataset: xr.Dataset) -> Iterator["Table"]:
    """Yield the tables of `tables_with_errors` for reading."""
    for title, columns in tables_with_errors(dataset, MOST_ROWS).items():
        yield _as_table(title, columns)


def _as_table(title: str, columns: list[Column]) -> "Table":
    rows = zip(*(column.cells for column in columns), strict=True)
    return reading_table(title, [column.heading for column in columns], rows)


def exactly_published(dataset: xr.Dataset) -> list[str]:
    """Return a sentence for each headline quantity that is equal to all its published values."""
    exact = [name for name in headline_variables(dataset) if _is_exact(dataset, name)]
    counts = {name: int(dataset[f"{name}_published"].count()) for name in exact}
    return [
        f"{name}: {f'all {n} published values are' if n > 1 else 'the published value is'} met exactly"
        for name, n in counts.items()
    ]


def _is_exact(dataset: xr.Dataset, name: str) -> bool:
    if f"{name}_published" not in dataset:
        return False
    published = dataset[f"{name}_published"]
    return bool(published.notnull().any() and ((dataset[name] == published) | published.isnull()).all())


def warnings_of(dataset: xr.Dataset) -> list[str]:
    """Return what the experiment warned of when the run began."""
    return list(json.loads(dataset.attrs.get("warnings", "[]")))


def rows_left_out(dataset: xr.Dataset, most: int = MOST_ROWS) -> int:
    """Return how many points a table of the first ``most``, as `as_text` makes one, leaves out."""
    return max(0, int((dataset["status"] != Status.EXCLUDED).sum()) - most)


def headline_columns(dataset: xr.Dataset, most: int | None = None) -> list[Column]:
    """Return the columns of the headline results in units that read well: axes, values with errors, prediction,
    published and difference; of all points or of the first ``most``.
    """
    dataset = in_readable_units(dataset)
    names = [name for name in headline_variables(dataset) if name not in array_outputs(dataset)]
    known = {name: error for name in names if (error := standard_error(dataset, name)) is not None}
    status = dataset["status"].values.reshape(-1)
    finished = bool(np.all((status == Status.DONE) | (status == Status.EXCLUDED)))
    places = np.flatnonzero(status != Status.EXCLUDED)[:most]
    long = long_table(dataset.assign({ERROR.format(name): e for name, e in known.items()}), places)
    columns = [
        Column(name, long[name][0], [plain(v) for v in long[name][1]], long[name][1])
        for name in axis_coordinates(dataset, axes_of(dataset))
    ]
    names = with_values(dataset, [name for name in headline_variables(dataset) if name in long])
    for number, name in enumerate(names):
        later = OTHER if number else 0
        columns += [replace(one, of=name, rank=later + one.rank) for one in _columns_of(dataset, long, name)]
    words = long["status"][1]
    return columns if finished else [*columns, Column("status", "", words, words)]


def _columns_of(dataset: xr.Dataset, long: Long, name: str) -> Iterator[Column]:
    """Yield the columns of one result."""
    unit, values = long[name]
    if name in array_outputs(dataset):
        yield Column(name, unit, list(map(_span, values)), list(map(str, values)), rank=VALUE)
        return
    _, errors = long.get(ERROR.format(name), ("", [0.0] * len(values)))
    yield Column(name, unit, list(map(with_error, values, errors)), values, rank=VALUE)
    if (predicted := long.get(prediction_name(long, name))) is not None:
        yield Column("predicted", unit, list(map(rounded, predicted[1], errors)), predicted[1], rank=PREDICTED)
        yield from _parts(long, name, errors)
    _, published = long.get(f"{name}_published", ("", []))
    if not all(map(is_missing, published)) and not _is_exact(dataset, name):
        yield Column("published", unit, list(map(rounded, published)), published, rank=PUBLISHED)
        differences = list(map(_relative, values, published))
        yield Column("difference", "", list(map(_in_percent, differences)), differences, rank=PUBLISHED)


def tables_with_errors(dataset: xr.Dataset, most: int | None = None) -> dict[str, list[Column]]:
    """Return a table of each headline result with errors of several kinds, in each of its units: the axes along which
    it changes, components, the value and every error; of all values or of the first ``most``.
    """
    found, whole = {}, dataset
    for name in headline_variables(whole):
        if not (errors := errors_beside(whole, name)):
            continue
        dataset = where_they_change(whole, [name, *errors])
        own = own_dimensions(dataset, name)
        dims = [*axes_of(dataset), *own]
        places = [*axis_coordinates(dataset, axes_of(dataset)), *(d for d in own if d in dataset.coords)]
        unit = next((dataset[f"{d}_unit"] for d in own if f"{d}_unit" in dataset.coords), None)
        unit = xr.DataArray(units_of(dataset[name].attrs)) if unit is None else unit
        arrays = {"unit": unit} | {n: dataset[n] for n in [*places, name, *errors]}
        values = {n: a.broadcast_like(dataset[name]).transpose(*dims).values.ravel() for n, a in arrays.items()}
        known = np.isfinite(values[name])
        for one in dict.fromkeys(values["unit"][known].tolist()):
            at = np.flatnonzero(known & (values["unit"] == one))[:most]
            where = {n: values[n][at].tolist() for n in places}
            columns = [Column(n, "", list(map(plain, cells)), cells) for n, cells in where.items()]
            chosen = prefixed(values[name][at], one)
            numbers = {n: (values[n][at] * chosen.factor).tolist() for n in [name, *errors]}
            to = np.nan_to_num(np.array([numbers[n] for n in errors]), nan=np.inf).min(axis=0).tolist()
            for n, cells in numbers.items():
                columns.append(Column(n, chosen.unit, list(map(rounded, cells, to if n == name else cells)), cells))
            found[f"{name} [{chosen.unit}]"] = columns
    return found


def arrays_in_words(dataset: xr.Dataset) -> list[str]:
    """Return a sentence for each output of a plain function that the table for reading leaves out or shows in part."""
    sentences = []
    for name in array_outputs(dataset):
        along = " and ".join(f"{dataset.sizes[dim]:,} along {dim}" for dim in own_dimensions(dataset, name))
        sentences.append(f"{name}: values at each point, {along}; `sweep show STORE --json` has them")
    return sentences


def _span(values: Any) -> str:
    """Return the array of one point in short: its smallest and its largest number."""
    flat = np.array(values).reshape(-1)
    if flat.dtype.kind not in "biuf":
        return first_of(flat.tolist(), 1)
    known = flat[np.isfinite(flat)]
    if not known.size:
        return ""
    return f"{rounded(exact(known).min().item())} to {rounded(exact(known).max().item())}"


def _parts(long: Long, name: str, errors: list[float]) -> list[Column]:
    """Return columns of the parts of a prediction, from errors alone and from the bias, if the bias is visible."""
    whole, part = (long.get(f"{name}_{suffix}") for suffix in PREDICTION_SUFFIXES)
    if whole is None or part is None:
        return []
    pairs = list(zip(whole[1], part[1], strict=True))
    if not any(total > (1.0 + VISIBLE_BIAS) * alone for total, alone in pairs):
        return []
    bias = [math.sqrt(max(0.0, total**2 - alone**2)) for total, alone in pairs]
    return [
        Column(heading, whole[0], list(map(rounded, values, errors)), values, rank=PARTS)
        for heading, values in (("of errors", part[1]), ("of bias", bias))
    ]


def _in_percent(difference: float) -> str:
    if is_missing(difference):
        return ""
    return "none" if difference == 0.0 else f"{100.0 * difference:+.1f} %"


def _relative(value: float, published: float) -> float:
    if value == published:
        return 0.0
    return value / published - 1.0 if published else math.nan
