"""Results as tables: for reading, for a script (CSV, JSON), for astronomers (ECSV)."""

import io
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from textwrap import indent
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.quantity import (
    PREDICTION_SUFFIXES,
    headline_variables,
    prediction_name,
    standard_error,
    with_values,
)
from sweep.analysis.readable_units import in_readable_units
from sweep.formatting import first_of, is_missing, plain, reading_table, rounded, to_csv, to_json, with_error
from sweep.planning.point_status import Status
from sweep.readable import in_ascii
from sweep.studies.provenance import FUNCTION

if TYPE_CHECKING:
    from rich.table import Table

VISIBLE_BIAS = 1e-3
"""The parts of a prediction are shown where its bias adds a larger share to what the errors make."""


GAP = 2
"""Blanks between two columns."""

LONG_NAME = 13
"""A longer name of a column is broken into two lines at an underscore."""

VALUE, PUBLISHED, PREDICTED, PARTS = 0, 1, 2, 4
"""Ranks of the columns of the main quantity; those of others come later by `OTHER`."""

OTHER = 3


@dataclass(frozen=True)
class Column:
    """A column for reading: ``cells`` as they are printed, and the ``values`` that they stand for and sort by.

    A table that is too wide leaves out the columns of the largest ``rank`` first, and never those of rank 0.
    """

    name: str
    unit: str
    cells: list[str]
    values: list[Any]
    of: str = ""
    rank: int = 0

    @property
    def heading(self) -> str:
        """The lines above the column: a long name in two, and the unit."""
        return "\n".join([*_two_lines(self.name), *([f"[{in_ascii(self.unit)}]"] if self.unit else [])])

    @property
    def width(self) -> int:
        """Characters that the column takes, with the gap before the next one."""
        return max(map(len, [*self.heading.split("\n"), *self.cells])) + GAP


Long = dict[str, tuple[str, list[Any]]]
"""Unit and values of each column of a table with one row a point."""

ERROR = "error of {}"
"""The column, in tables that are made for reading, of the whole one-sigma error of a variable."""

MOST_ROWS = 200
"""Of a table for reading: of a hundred thousand the formatting alone would take longer than their computation."""


def long_table(dataset: xr.Dataset, places: NDArray[np.intp] | None = None) -> Long:
    """Return columns {name: (unit, values)} with one row a point, of all or of those at ``places``, counted in C order:
    the axes, then every variable without further dimensions; of a plain function also those with some, each value a
    list.
    """
    rows = slice(None) if places is None else places
    dimensions = axes_of(dataset)
    flat = dataset[[str(n) for n, v in dataset.data_vars.items() if set(v.dims) <= set(dimensions)]]
    columns: Long = {}
    template = xr.zeros_like(dataset["status"], dtype=object) if dimensions else dataset["status"]
    for name in [*axis_coordinates(dataset, dimensions), *flat.data_vars]:
        variable = dataset[name]
        values = variable.broadcast_like(template).transpose(*dimensions).values.reshape(-1)[rows]
        columns[str(name)] = (variable.attrs.get("units", ""), _listed(values))
    for name in array_outputs(dataset):
        variable = dataset[name].transpose(*dimensions, ...)
        values = variable.values.reshape(-1, *variable.shape[len(dimensions) :])[rows]
        columns[name] = (variable.attrs.get("units", ""), _listed(values))
    status = columns["status"][1]
    words = [code.word for code in Status]
    columns["status"] = ("", [words[code] for code in status])
    return columns


def array_outputs(dataset: xr.Dataset) -> list[str]:
    """Return the outputs of a plain function that have dimensions of their own."""
    axes = set(axes_of(dataset))
    return [str(n) for n, v in dataset.data_vars.items() if set(v.dims) - axes] if FUNCTION in dataset.attrs else []


def own_dimensions(dataset: xr.Dataset, name: str) -> list[str]:
    """Return the dimensions of an output that are no axes of the study."""
    return [str(d) for d in dataset[name].dims if d not in axes_of(dataset)]


def _listed(values: Any) -> list[Any]:
    """Return values as Python has them, times as texts."""
    if values.dtype.kind == "M":
        values = np.where(np.isnat(values), "", np.datetime_as_string(values, unit="auto").astype(object))
    listed: list[Any] = values.tolist()
    return listed


def axes_of(dataset: xr.Dataset) -> list[str]:
    """Return the dimensions that are axes of the study."""
    return [str(d) for d in dataset["status"].dims]


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
        mask = [is_missing(v) for v in values]
        table[name] = MaskedColumn(values, mask=mask if any(mask) else False, unit=unit or None)
    out = io.StringIO()
    table.write(out, format="ascii.ecsv")
    return out.getvalue()


def as_json(dataset: xr.Dataset) -> str:
    """Return the long table as JSON: units by column, and one object a point, null for a missing value."""
    columns = long_table(dataset)
    cells = zip(*(values for _, values in columns.values()), strict=True)
    # row by row: dictionaries of all points would take more memory than all else
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


def _two_lines(name: str) -> list[str]:
    places = [i for i, letter in enumerate(name) if letter == "_"]
    if len(name) <= LONG_NAME or not places:
        return [name]
    middle = min(places, key=lambda i: abs(i + 1 - len(name) / 2)) + 1
    return [name[:middle], name[middle:]]


def as_text(dataset: xr.Dataset, width: int | None = None) -> "Table":
    """Return the headline results for reading: value +- one-sigma error, prediction, published value and
    difference; of the first `MOST_ROWS` points, and of the columns those that go into ``width`` characters.
    """
    columns, _ = fitting(headline_columns(dataset, MOST_ROWS), width)
    rows = zip(*(column.cells for column in columns), strict=True)
    return reading_table(str(dataset.attrs.get("title", "")), [column.heading for column in columns], rows)


def fitting(columns: list[Column], width: int | None) -> tuple[list[Column], list[Column]]:
    """Return the columns that a table of a width has, and those that it leaves out."""
    kept = list(columns)
    while width is not None and sum(column.width for column in kept) - GAP > width:
        rank = max(column.rank for column in kept)
        if rank == 0:
            break
        last = next(column.of for column in reversed(kept) if column.rank == rank)
        kept = [column for column in kept if (column.rank, column.of) != (rank, last)]
    return kept, [column for column in columns if column not in kept]


def left_out_in_words(columns: list[Column]) -> str:
    """Return which columns a table leaves out, in words."""
    return ", ".join(column.of if column.of == column.name else f"{column.of} {column.name}" for column in columns)


def exactly_published(dataset: xr.Dataset) -> list[str]:
    """Return a sentence for each headline quantity that is everywhere as it was published."""
    exact = [name for name in headline_variables(dataset) if _is_exact(dataset, name)]
    counts = {name: int(dataset[f"{name}_published"].count()) for name in exact}
    return [
        f"{name}: {f'all {n} published values are' if n > 1 else 'the published value is'} met exactly"
        for name, n in counts.items()
    ]


def _is_exact(dataset: xr.Dataset, name: str) -> bool:
    published = dataset.get(f"{name}_published")
    if published is None:
        return False
    known = published.notnull()
    return bool(known.any() and (dataset[name].where(known) == published).where(known, True).all())


def warnings_of(dataset: xr.Dataset) -> list[str]:
    """Return what the experiment warned of when the run began."""
    return list(json.loads(dataset.attrs.get("warnings", "[]")))


def rows_left_out(dataset: xr.Dataset, most: int = MOST_ROWS) -> int:
    """Return how many points a table of the first ``most``, as `as_text` makes one, leaves out."""
    return max(0, int((dataset["status"] != Status.EXCLUDED).sum()) - most)


def headline_columns(dataset: xr.Dataset, most: int | None = None) -> list[Column]:
    """Return the columns of the headline results in units that read well: axes, values with errors, prediction,
    published and difference; of all points or of the first ones.
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


def arrays_in_words(dataset: xr.Dataset) -> list[str]:
    """Return a sentence for each output of a plain function that the table for reading has not, or only in part."""
    sentences = []
    for name in array_outputs(dataset):
        along = " and ".join(f"{dataset.sizes[dim]:,} along {dim}" for dim in own_dimensions(dataset, name))
        sentences.append(f"{name}: values at each point, {along}; `sweep show STORE --json` has them")
    return sentences


def _span(values: Any) -> str:
    """Return an array of one point in short: its least and its largest number."""
    flat = np.array(values).reshape(-1)
    if flat.dtype.kind not in "biuf":
        return first_of(flat.tolist(), 1)
    known = flat[np.isfinite(flat)]
    return f"{rounded(float(known.min()))} to {rounded(float(known.max()))}" if known.size else ""


def _parts(long: Long, name: str, errors: list[float]) -> list[Column]:
    """Return the parts of a prediction, of errors alone and of the bias, where there is a bias that can be seen."""
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


def axis_coordinates(dataset: xr.Dataset, dimensions: list[str]) -> list[str]:
    """Return the coordinates along some dimensions in the order of these, the own one of each first."""
    names = [str(n) for n, c in dataset.coords.items() if set(c.dims) <= set(dimensions) and c.dims]
    place = {name: dimensions.index(str(dataset[name].dims[0])) for name in names}
    return sorted(names, key=lambda name: (place[name], name not in dimensions, name))  # xarray sorts by name


def _in_percent(difference: float) -> str:
    if is_missing(difference):
        return ""
    return "none" if difference == 0.0 else f"{100.0 * difference:+.1f} %"


def _relative(value: float, published: float) -> float:
    if value == published:
        return 0.0
    return value / published - 1.0 if published else math.nan
