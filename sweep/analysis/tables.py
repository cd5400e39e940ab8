"""Tables of results: for reading those that matter, in units that read well, and for programs one row for each point.

What is derived from results (fits, crossings, indices and measurements) is one kind of dataset, which says everything
itself: the variables for reading have the attribute ``headline``, their rank (or all are for reading), the one-sigma
error of NAME is NAME_error, ``conclusion`` is in words, and the attribute ``notes`` has sentences as JSON.
"""

from __future__ import annotations  # names of xarray, which is imported only where it computes

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep import formatting
from linksweep.sweep.analysis import quantity
from linksweep.sweep.contract import Status
from linksweep.sweep.table_writer import Column, Table

if TYPE_CHECKING:
    import xarray as xr

MOST_ROWS = 200  # for reading: formatting a hundred thousand would take longer than computing them

# ranks of the columns of the main quantity; those of other quantities are larger by `OTHER`
VALUE, PUBLISHED, PREDICTED, OTHER = range(4)

CONDITION, CORRELATION = "condition_number", "correlation"
BAD_CONDITION = 100.0  # above it unknowns can hardly be told apart: two with a correlation of 0.98 have it
FEWEST = 30  # realisations for a correlation, which is then known to 0.2
WORST_POINTS = 3  # how many points have their components shown
STEP = "step"  # the attribute of places on an axis that have no errors: that of the axis, which says their digits
LEAST_SHARE = 1.0  # of a result, in percent, that a sentence names

# By the names of variables their unit and meaning; those of NAME say what NAME_error is.
Meanings = Mapping[str, tuple[str, str]]


def derived(
    grid: xr.Dataset, dims: Sequence[str], columns: Mapping[str, Any], meanings: Meanings, shown: Sequence[str]
) -> xr.Dataset:
    """Return a dataset over the dimensions of a grid with ``columns`` of values in C order, of which some are
    ``shown`` in tables, in this order.
    """
    shape, variables = [grid.sizes[d] for d in dims], {}
    for name, values in columns.items():
        unit, meaning = meanings[whole := name.removesuffix("_error")]
        meaning = meaning if name == whole else f"one-sigma error of {whole}"
        rank = {"headline": shown.index(name) + 1} if name in shown else {}
        array = np.array(values, dtype=object if name == "conclusion" else float).reshape(shape)
        variables[name] = tuple(dims), array, formatting.described(unit, meaning) | rank
    return grid.assign(variables)


def headline(result: xr.Dataset) -> list[str]:
    """Return in a sentence which parameters decide a result, if these are indices of one number at each point."""
    if "first" not in result or result["first"].dims != ("parameter",) or result.sizes["parameter"] < 2:
        return []
    names, shares, errors = result.parameter.values, *(100.0 * result[n].values for n in ("first", "first_error"))
    known = [k for k in np.argsort(-shares).tolist() if shares[k] >= LEAST_SHARE]
    words = [f"{names[k]} {shares[k]:.0f}{f' ± {errors[k]:.0f}' if errors[k] >= 0.5 else ''} %" for k in known]
    if "total" in result and (rest := 100.0 - shares.sum()) >= LEAST_SHARE:
        words.append(f"several together {rest:.0f} %")
    return [f"What decides it: {', '.join(words)}."] if words else []


# For programs


def records(dataset: xr.Dataset) -> Table:
    """Return one row per point or place: the axes, then every variable without further dimensions; for a plain function
    also those with further dimensions, each value a list.
    """
    columns = _columns(dataset, quantity.array_outputs(dataset))
    if "status" not in dataset:
        units = {str(n): unit for n, v in dataset.variables.items() if (unit := formatting.units_of(v.attrs))}
        return Table(list(columns.values()), about={**dataset.attrs, "notes": notes(dataset), "units": units})
    dims = {name: quantity.own_dimensions(dataset, name) for name in quantity.array_outputs(dataset)}
    along = {dim: quantity.listed(dataset, dim, [dim]) for some in dims.values() for dim in some}
    arrays = {name: {"dims": some, "coordinates": {dim: along[dim] for dim in some}} for name, some in dims.items()}
    units = {column.name: column.unit for column in columns.values()}
    units |= {dim: formatting.units_of(dataset[dim].attrs) for dim in along}
    meta = {name: dataset.attrs.get(name, "") for name in ("title", "study_digest")}
    return Table(list(columns.values()), about={"units": units} | ({"arrays": arrays} if arrays else {}), meta=meta)


def _columns(dataset: xr.Dataset, arrays: Sequence[str], rows: Any = slice(None)) -> dict[str, Column]:
    """Return the columns of `records` by name, with those of some ``arrays``, for all points or those at ``rows``,
    counted in C order.
    """
    dims = quantity.axes_of(dataset)
    flat = [str(n) for n, v in dataset.data_vars.items() if set(v.dims) <= set(dims)]
    fixed = [] if "status" in dataset else [str(n) for n, c in dataset.coords.items() if not c.dims]
    columns = {
        name: Column(name, quantity.listed(dataset, name, dims, rows), unit=formatting.units_of(dataset[name].attrs))
        for name in [*fixed, *quantity.axis_coordinates(dataset, dims), *flat, *arrays]
    }
    if "status" in columns:
        columns["status"] = Column("status", [Status(code).word for code in columns["status"].values])
    return columns


# For reading


def headline_table(dataset: xr.Dataset, most: int | None = MOST_ROWS) -> Table:
    """Return the headline results, or the first if there are none, in units that read well: axes, values with errors,
    prediction, published value and difference, of the first ``most`` points or of all.
    """
    names = quantity.headline_variables(dataset) or quantity.headlines(dataset)
    # Only what is shown is read: a store may have more large arrays than fit into memory.
    dataset = quantity.in_readable_units(dataset.drop_vars(set(quantity.array_outputs(dataset)).difference(names)))
    status = dataset["status"].values.reshape(-1)
    rows = np.flatnonzero(status != Status.EXCLUDED)[:most]
    columns = _columns(dataset, quantity.array_outputs(dataset), rows)
    names = [name for name in names if name in columns]
    shown = [columns[name] for name in quantity.axis_coordinates(dataset, quantity.axes_of(dataset))]
    for number, name in enumerate(quantity.with_values(dataset, names)):
        later = OTHER if number else 0
        some = _columns_of(dataset, columns, name, rows)
        shown += [replace(one, quantity=name, rank=later + one.rank) for one in some]
    finished = bool(np.all((status == Status.DONE) | (status == Status.EXCLUDED)))
    if (status[rows] == Status.RUNNING).any():
        shown.append(replace(columns["n_sim_done"], name="realisations"))
    return Table(shown if finished else [*shown, columns["status"]], str(dataset.attrs.get("title", "")))


def _columns_of(dataset: xr.Dataset, columns: dict[str, Column], name: str, rows: NDArray[np.intp]) -> Iterator[Column]:
    """Yield the columns of one result."""
    main = columns[name]
    if name in quantity.array_outputs(dataset):
        yield replace(main, cells=list(map(_span, main.values)))
        return
    errors = quantity.sigmas(dataset, name, quantity.axes_of(dataset)).reshape(-1)[rows].tolist()

    def beside(heading: str, values: Sequence[Any], rank: int, to: Sequence[float]) -> Column:
        return Column(heading, values, list(map(formatting.rounded, values, to)), main.unit, rank=rank)

    with_error = partial(formatting.with_error, digits=formatting.digits_of(main.values))
    yield replace(main, cells=list(map(with_error, main.values, errors)), rank=VALUE)
    if (predicted := columns.get(quantity.prediction_name(columns, name))) is not None:
        yield beside("predicted", predicted.values, PREDICTED, errors)
    published = columns[f"{name}_published"].values if f"{name}_published" in columns else []
    if not all(map(formatting.is_missing, published)) and not _is_exact(dataset, name):
        yield beside("published", published, PUBLISHED, [0.0] * len(published))
        differences = [v / p - 1.0 if p else np.nan for v, p in zip(main.values, published, strict=True)]
        cells = ["" if formatting.is_missing(one) else f"{100.0 * one:+.1f} %" for one in differences]
        yield Column("difference", differences, cells, rank=PUBLISHED)


def _is_exact(dataset: xr.Dataset, name: str) -> bool:
    """Return whether a result is equal to all its published values, of which there are some."""
    if f"{name}_published" not in dataset:
        return False
    published = dataset[f"{name}_published"].transpose(*dataset[name].dims).values
    ours, known = dataset[name].values, quantity.is_known(published)
    return bool(known.any() and np.array_equal(ours[known], published[known]))


def _span(values: Any) -> str:
    """Return the array of one point in short: its smallest and its largest number."""
    flat = np.ravel(values)
    if flat.dtype.kind not in "biuf":
        return formatting.first_of(flat.tolist(), 1)
    known = quantity.exact(flat[np.isfinite(flat)])
    return f"{formatting.rounded(known.min().item())} to {formatting.rounded(known.max().item())}" if known.size else ""


def tables(dataset: xr.Dataset) -> list[Table]:
    """Return the headline results, those with errors of several kinds, and the components of the points with the worst
    condition; or the one table of what is derived from results.
    """
    if "status" not in dataset:
        return [_derived_table(dataset)]
    final = quantity.without_running(dataset)
    return [headline_table(dataset), *tables_with_errors(final, MOST_ROWS), *_component_tables(final)]


def notes(dataset: xr.Dataset) -> list[str]:
    """Return the sentences below the tables: warnings, what the tables leave out, and what is missing."""
    if "status" not in dataset:
        return list(json.loads(dataset.attrs.get("notes", "[]")))
    sentences = [f"warning: {words}" for words in warnings_of(dataset)]
    for name in quantity.array_outputs(dataset):
        along = " and ".join(f"{dataset.sizes[dim]:,} along {dim}" for dim in quantity.own_dimensions(dataset, name))
        most = "at most " if formatting.RAGGED in dataset[name].attrs else ""
        sentences.append(f"{name}: values at each point, {most}{along}; `sweep show STORE --json` has them")
    final = quantity.without_running(dataset)
    exact = [name for name in quantity.headline_variables(dataset) if _is_exact(final, name)]
    sentences += [f"{name}: all published values are met exactly" for name in exact]
    for name in quantity.headline_variables(dataset):
        sentences += [f"running, {words}" for words in quantity.unknown_parts(dataset, name, Status.RUNNING)]
    if left_out := rows_left_out(dataset):
        sentences.append(f"{left_out:,} more points: `sweep show STORE --format csv` has all of them")
    return [*sentences, *([f"INCOMPLETE: {words}"] if (words := quantity.lacking(dataset)) else [])]


def rows_left_out(dataset: xr.Dataset, most: int = MOST_ROWS) -> int:
    """Return how many points a table of the first ``most`` leaves out."""
    return max(0, int(np.count_nonzero(dataset["status"].values != Status.EXCLUDED)) - most)


def tables_with_errors(dataset: xr.Dataset, most: int | None = None) -> list[Table]:
    """Return a table of each headline result with errors of several kinds, in each of its units: the axes along which
    it changes, components, the value and every error; of all values or of the first ``most``.
    """
    made = []
    for name in quantity.headline_variables(dataset):
        if not (errors := quantity.errors_beside(dataset, name)):
            continue
        part = quantity.where_they_change(dataset, [name, *errors])
        dims = [*quantity.axes_of(part), *quantity.own_dimensions(part, name)]
        places = [n for n in quantity.axis_coordinates(part, dims) if not n.endswith("_unit")]
        columns = {n: quantity.listed(part, n, dims) for n in [*places, name, *errors]}
        units = quantity.units_along(part, name, dims)
        known = [i for i, value in enumerate(columns[name]) if np.isfinite(value)]
        for unit in dict.fromkeys(units[i] for i in known):
            at = [i for i in known if units[i] == unit][:most]
            chosen = formatting.prefixed([columns[name][i] for i in at], unit)
            values = {n: [columns[n][i] * chosen.factor for i in at] for n in [name, *errors]}
            rows = zip(*map(values.get, errors), strict=True)
            least = [min((e for e in row if e > 0.0), default=0.0) for row in rows]
            where = [Column(n, [columns[n][i] for i in at]) for n in places]
            cells = {n: list(map(formatting.rounded, v, least if n == name else v)) for n, v in values.items()}
            numbers = (Column(n, v, cells[n], chosen.unit, quantity=n) for n, v in values.items())
            made.append(Table([*where, *numbers], f"{name} [{chosen.unit}]"))
    return made


# Components, which a mean over them hides


def warnings_of(dataset: xr.Dataset) -> list[str]:
    """Return what the experiment warned of when the run began, how many points did not reach their precision, and a
    sentence about points at which some unknowns can hardly be told apart.
    """
    conditions, warnings = _conditions(dataset), list(json.loads(dataset.attrs.get("warnings", "[]")))
    if (bad := conditions[conditions > BAD_CONDITION]).size:
        words = "some unknowns can hardly be told apart; see the components, as a mean over them hides how badly"
        points = formatting.counted(bad.size, "point")
        warnings.append(f"at {points} the condition number is up to {bad.max():.3g}: {words}")
    return warnings


def _conditions(dataset: xr.Dataset) -> NDArray[np.float64]:
    """Return the condition number of each point (n,) in C order, -1 where it is not done or has none."""
    if CONDITION not in dataset:
        return np.full(dataset["status"].size, -1.0)
    known = dataset[CONDITION].transpose(*dataset["status"].dims).values
    done = quantity.is_known(known) & (dataset["status"].values == Status.DONE)
    return np.where(done, known, -1.0).reshape(-1)


def _component_tables(dataset: xr.Dataset) -> Iterator[Table]:
    """Yield the components of the points with the worst condition, of the first quantity that has errors and one
    dimension beside the axes; nothing for results without a condition number.
    """
    names = (n for n in map(str, dataset.data_vars) if len(quantity.own_dimensions(dataset, n)) == 1)
    with_errors = (n for n in names if quantity.standard_error(dataset, n) is not None)
    name = next((n for n in with_errors if dataset[n].notnull().any()), "")
    conditions, shape = _conditions(dataset), dataset["status"].shape
    worst = np.argsort(-conditions, kind="stable")[: np.count_nonzero(conditions >= 0.0)]
    for flat in worst[:WORST_POINTS] if name else ():
        index = dict(zip(quantity.axes_of(dataset), map(int, np.unravel_index(flat, shape)), strict=True))
        point = dataset.isel(index)
        (dim,) = map(str, point[name].dims)
        labels, facts = point[dim].values.tolist(), f"condition number {conditions[flat]:.3g}"
        pairs = point.get(CORRELATION, point[dim])
        if pairs.dims == (dim, f"{dim}_other") and int(point["n_sim_done"]) >= FEWEST and pairs.notnull().any():
            beside = np.where(np.eye(len(labels), dtype=bool), 0.0, np.nan_to_num(pairs.values))
            i, j = sorted(np.unravel_index(np.argmax(np.abs(beside)), beside.shape))
            facts += f", largest correlation {beside[i, j]:.3f} ({labels[i]}, {labels[j]})"
        units = point[f"{dim}_unit"].values.tolist() if f"{dim}_unit" in point.coords else [""] * len(labels)
        cells = [formatting.in_short(v, 0.0, u) for v, u in zip(point[name].values.tolist(), units, strict=True)]
        place = ", ".join(filter(None, [name, quantity.place_in_words(quantity.place_at(dataset, index), dataset)]))
        yield Table([Column("", labels, left=True), Column("", cells)], f"{place}: {facts}")


# What is derived


def _derived_table(result: xr.Dataset) -> Table:
    """Return places on the axes, numbers with their errors, and what is concluded."""
    ranks = {str(n): v.attrs["headline"] for n, v in result.data_vars.items() if "headline" in v.attrs}
    names = sorted(ranks, key=ranks.__getitem__)
    names = names or [str(n) for n in result.data_vars if not str(n).endswith("_error")]
    columns, its = [], _columns(result, ())
    for name in quantity.axis_coordinates(result, quantity.axes_of(result)):
        columns.append(replace(its[name], left=any(isinstance(value, str) for value in its[name].values)))
    for rank, name in enumerate(names):
        values = its[name].values
        if name == "conclusion":
            columns += [Column(name, values, values, wrap=24)] if any(values) else []
            continue
        unit, factor = formatting.prefixed(values, its[name].unit)
        errors = its[f"{name}_error"].values if f"{name}_error" in its else [0.0] * len(values)
        step = factor * result[name].attrs.get(STEP, 0.0)
        cells = [formatting.with_error(factor * v, factor * e, step) for v, e in zip(values, errors, strict=True)]
        # the last are left out first where there is no room
        columns += [Column(name, values, cells, unit, name, rank)] if any(cells) else []
    return Table(columns, str(result.attrs.get("title", "")))
