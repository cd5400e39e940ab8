"""Tables of the results of a study: the headline results for reading, and one row per point for programs."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from linksweep.sweep.analysis.quantity import (
    ERROR_SUFFIXES,
    PREDICTION_SUFFIXES,
    array_outputs,
    axes_of,
    axis_coordinates,
    errors_beside,
    exact,
    headline_variables,
    in_readable_units,
    lacking,
    listed,
    own_dimensions,
    place_at,
    prediction_name,
    standard_error,
    where_they_change,
    with_values,
)
from linksweep.sweep.formatting import (
    counted,
    first_of,
    in_three_digits,
    is_missing,
    plain,
    prefixed,
    rounded,
    units_of,
    with_error,
)
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.table_writer import Column, Table

MOST_ROWS = 200
"""The most rows of a table for reading: formatting a hundred thousand would take longer than computing them."""

VISIBLE_BIAS = 1e-3
"""The parts of a prediction are shown if the bias increases it by a larger fraction than this."""

VALUE, PUBLISHED, PREDICTED, PARTS = 0, 1, 2, 4
"""Ranks of the columns of the main quantity; those of other quantities are larger by `OTHER`."""

OTHER = 3

CONDITION, CORRELATION = "condition_number", "correlation"

BAD_CONDITION = 100.0
"""Above this, unknowns can hardly be told apart; two with a correlation of 0.98 have this condition number."""

FEWEST = 30
"""The fewest realisations for a correlation, which is then known to 0.2."""

WORST_POINTS, PER_LINE = 3, 3
"""How many points have their components shown, and how many components stand in a line."""


# For programs


def records(dataset: xr.Dataset) -> Table:
    """Return one row per point: the axes, then every variable without further dimensions; for a plain function also
    those with further dimensions, each value a list.
    """
    columns = _columns(dataset)
    arrays = {
        name: {"dims": dims, "coordinates": {dim: listed(dataset, dim, [dim]) for dim in dims}}
        for name in array_outputs(dataset)
        for dims in [own_dimensions(dataset, name)]
    }
    units = {column.name: column.unit for column in columns.values()}
    units |= {dim: units_of(dataset[dim].attrs) for array in arrays.values() for dim in array["dims"]}
    meta = {name: dataset.attrs.get(name, "") for name in ("title", "study_digest")}
    about = {"units": units, **({"arrays": arrays} if arrays else {})}
    return Table(list(columns.values()), about=about, meta=meta)


def _columns(dataset: xr.Dataset, rows: Any = slice(None)) -> dict[str, Column]:
    """Return the columns of `records` by name, for all points or those at ``rows``, counted in C order."""
    dimensions = axes_of(dataset)
    flat = [str(n) for n, v in dataset.data_vars.items() if set(v.dims) <= set(dimensions)]
    columns = {
        name: Column(name, listed(dataset, name, dimensions, rows), unit=units_of(dataset[name].attrs))
        for name in [*axis_coordinates(dataset, dimensions), *flat, *array_outputs(dataset)]
    }
    words = [code.word for code in Status]
    return columns | {"status": Column("status", [words[code] for code in columns["status"].values])}


# For reading


def headline_table(dataset: xr.Dataset, most: int | None = MOST_ROWS) -> Table:
    """Return the headline results in units that read well: axes, values with errors, prediction, published value and
    difference, of the first ``most`` points or of all.
    """
    dataset = in_readable_units(dataset)
    status = dataset["status"].values.reshape(-1)
    finished = bool(np.all((status == Status.DONE) | (status == Status.EXCLUDED)))
    columns = _columns(dataset, np.flatnonzero(status != Status.EXCLUDED)[:most])
    names = with_values(dataset, [name for name in headline_variables(dataset) if name in columns])
    shown = [columns[name] for name in axis_coordinates(dataset, axes_of(dataset))]
    for number, name in enumerate(names):
        later = OTHER if number else 0
        shown += [replace(one, quantity=name, rank=later + one.rank) for one in _columns_of(dataset, columns, name)]
    return Table(shown if finished else [*shown, columns["status"]], str(dataset.attrs.get("title", "")))


def tables(dataset: xr.Dataset) -> list[Table]:
    """Return the headline results, those with errors of several kinds, and the components of the points with the worst
    condition.
    """
    return [headline_table(dataset), *tables_with_errors(dataset, MOST_ROWS), *_component_tables(dataset)]


def notes(dataset: xr.Dataset) -> list[str]:
    """Return the sentences below the tables: warnings, what the tables leave out, and what is missing."""
    warnings = filter(None, [*warnings_of(dataset), condition_warning(dataset)])
    arrays = (
        (name, " and ".join(f"{dataset.sizes[dim]:,} along {dim}" for dim in own_dimensions(dataset, name)))
        for name in array_outputs(dataset)
    )
    sentences = [f"{name}: values at each point, {along}; `sweep show STORE --json` has them" for name, along in arrays]
    for name in (name for name in headline_variables(dataset) if _is_exact(dataset, name)):
        n = int(dataset[f"{name}_published"].count())
        sentences.append(
            f"{name}: {f'all {n} published values are' if n > 1 else 'the published value is'} met exactly"
        )
    if left_out := rows_left_out(dataset):
        sentences.append(f"{left_out:,} more points: `sweep show STORE --format csv` has all of them")
    missing = [f"INCOMPLETE: {words}"] if (words := lacking(dataset)) else []
    return [*(f"warning: {sentence}" for sentence in warnings), *sentences, *missing]


def warnings_of(dataset: xr.Dataset) -> list[str]:
    """Return what the experiment warned of when the run began."""
    return list(json.loads(dataset.attrs.get("warnings", "[]")))


def rows_left_out(dataset: xr.Dataset, most: int = MOST_ROWS) -> int:
    """Return how many points a table of the first ``most`` leaves out."""
    return max(0, int((dataset["status"] != Status.EXCLUDED).sum()) - most)


def _columns_of(dataset: xr.Dataset, columns: dict[str, Column], name: str) -> Iterator[Column]:
    """Yield the columns of one result."""
    main = columns[name]
    if name in array_outputs(dataset):
        yield replace(main, cells=list(map(_span, main.values)), values=list(map(str, main.values)))
        return
    error = standard_error(dataset, name)
    rows = dataset["status"].values.reshape(-1) != Status.EXCLUDED
    errors = [0.0] * len(main.values)
    if error is not None:
        errors = error.broadcast_like(dataset["status"]).transpose(*dataset["status"].dims).values.reshape(-1)[rows]
        errors = errors[: len(main.values)].tolist()

    def beside(heading: str, values: Sequence[Any], rank: int, to: Sequence[float]) -> Column:
        return Column(heading, values, list(map(rounded, values, to)), main.unit, rank=rank)

    yield replace(main, cells=list(map(with_error, main.values, errors)), rank=VALUE)
    if (predicted := columns.get(prediction_name(columns, name))) is not None:
        yield beside("predicted", predicted.values, PREDICTED, errors)
        whole, part = (columns.get(f"{name}_{suffix}") for suffix in PREDICTION_SUFFIXES)
        pairs = [] if whole is None or part is None else list(zip(whole.values, part.values, strict=True))
        if any(total > (1.0 + VISIBLE_BIAS) * alone for total, alone in pairs):
            bias = [math.sqrt(max(0.0, total**2 - alone**2)) for total, alone in pairs]
            yield beside("of errors", [alone for _, alone in pairs], PARTS, errors)
            yield beside("of bias", bias, PARTS, errors)
    published = columns[f"{name}_published"].values if f"{name}_published" in columns else []
    if not all(map(is_missing, published)) and not _is_exact(dataset, name):
        yield beside("published", published, PUBLISHED, [0.0] * len(published))
        differences = list(map(_relative, main.values, published))
        yield Column("difference", differences, list(map(_in_percent, differences)), rank=PUBLISHED)


def _is_exact(dataset: xr.Dataset, name: str) -> bool:
    """Return whether a result is equal to all its published values, of which there are some."""
    if f"{name}_published" not in dataset:
        return False
    published = dataset[f"{name}_published"]
    return bool(published.notnull().any() and ((dataset[name] == published) | published.isnull()).all())


def _span(values: Any) -> str:
    """Return the array of one point in short: its smallest and its largest number."""
    flat = np.array(values).reshape(-1)
    if flat.dtype.kind not in "biuf":
        return first_of(flat.tolist(), 1)
    known = exact(flat[np.isfinite(flat)])
    return f"{rounded(known.min().item())} to {rounded(known.max().item())}" if known.size else ""


def _relative(value: float, published: float) -> float:
    if value == published:
        return 0.0
    return value / published - 1.0 if published else math.nan


def _in_percent(difference: float) -> str:
    if is_missing(difference):
        return ""
    return "none" if difference == 0.0 else f"{100.0 * difference:+.1f} %"


def tables_with_errors(dataset: xr.Dataset, most: int | None = None) -> list[Table]:
    """Return a table of each headline result with errors of several kinds, in each of its units: the axes along which
    it changes, components, the value and every error; of all values or of the first ``most``.
    """
    made = []
    for name in (name for name in headline_variables(dataset) if errors_beside(dataset, name)):
        errors = errors_beside(dataset, name)
        part = where_they_change(dataset, [name, *errors])
        own = own_dimensions(part, name)
        dims = [*axes_of(part), *own]
        places = [*axis_coordinates(part, axes_of(part)), *(d for d in own if d in part.coords)]
        unit = next((part[f"{d}_unit"] for d in own if f"{d}_unit" in part.coords), None)
        unit = xr.DataArray(units_of(part[name].attrs)) if unit is None else unit
        columns = {n: listed(part, n, dims) for n in [*places, name, *errors]}
        numbers = {n: np.array(columns[n], dtype=float) for n in [name, *errors]}
        units = unit.broadcast_like(part[name]).transpose(*dims).values.ravel()
        known = np.isfinite(numbers[name])
        for one in dict.fromkeys(units[known].tolist()):
            at = np.flatnonzero(known & (units == one))[:most]
            chosen = prefixed(numbers[name][at], one)
            values = {n: (numbers[n][at] * chosen.factor).tolist() for n in numbers}
            to = np.nan_to_num(np.array([values[n] for n in errors]), nan=np.inf).min(axis=0).tolist()
            cells = {n: list(map(rounded, v, to if n == name else v)) for n, v in values.items()}
            where = [Column(n, [columns[n][i] for i in at]) for n in places]
            made.append(
                Table(
                    [*where, *(Column(n, v, cells[n], chosen.unit, quantity=n) for n, v in values.items())],
                    f"{name} [{chosen.unit}]",
                )
            )
    return made


# Components, which a mean over them hides


def condition_warning(dataset: xr.Dataset) -> str:
    """Return a sentence about points at which some unknowns can hardly be told apart; '' where there are none."""
    conditions = _conditions(dataset)
    bad = conditions[conditions > BAD_CONDITION]
    if not bad.size:
        return ""
    return (
        f"at {counted(bad.size, 'point')} the condition number is up to {bad.max():.3g}: some unknowns can hardly be "
        "told apart, and a mean over components hides how badly (see the components)"
    )


def _conditions(dataset: xr.Dataset) -> NDArray[np.float64]:
    """Return the condition number of each point (n,) in C order, -1 where it is not done or has none."""
    if CONDITION not in dataset:
        return np.full(dataset["status"].size, -1.0)
    done = dataset["status"] == Status.DONE
    known = dataset[CONDITION].where(done).transpose(*done.dims).values.reshape(-1)
    return np.where(np.isnan(known), -1.0, known)


def _component_tables(dataset: xr.Dataset) -> Iterator[Table]:
    """Yield the components of the points with the worst condition, of the first quantity that has errors and one
    dimension beside the axes; nothing for results without a condition number.
    """
    names = (n for n in map(str, dataset.data_vars) if len(own_dimensions(dataset, n)) == 1)
    name = next((n for n in names if any(f"{n}_{suffix}" in dataset for suffix in ERROR_SUFFIXES)), None)
    conditions = _conditions(dataset)
    worst = np.argsort(-conditions, kind="stable")[: np.count_nonzero(conditions >= 0.0)]
    for number, flat in enumerate(worst[:WORST_POINTS] if name else ()):
        index = dict(zip(axes_of(dataset), map(int, np.unravel_index(flat, dataset["status"].shape)), strict=True))
        place = "".join(f", {axis} = {plain(value)}" for axis, value in place_at(dataset, index).items())
        point = dataset[[n for n in (name, CORRELATION, "n_sim_done") if n in dataset]].isel(index)
        (dimension,) = map(str, point[name].dims)
        labels = list(map(str, point[dimension].values))
        units = (
            point[f"{dimension}_unit"].values.tolist() if f"{dimension}_unit" in point.coords else [""] * len(labels)
        )
        values = zip(labels, point[name].values.tolist(), units, strict=True)
        cells = [f"{label} {in_three_digits(value, str(unit))}" for label, value, unit in values]
        cells += [""] * (-len(cells) % PER_LINE)
        facts = [f"condition number {conditions[flat]:.3g}"]
        if CORRELATION in point and int(point["n_sim_done"]) >= FEWEST and point[CORRELATION].notnull().any():
            beside = np.where(np.eye(len(labels), dtype=bool), 0.0, np.nan_to_num(point[CORRELATION].values))
            i, j = sorted(np.unravel_index(np.argmax(np.abs(beside)), beside.shape))
            facts.insert(0, f"largest correlation {beside[i, j]:.3f} ({labels[i]}, {labels[j]})")
        below = [("  " + ", ".join(facts), "")]
        if number == WORST_POINTS - 1 and (left := len(worst) - WORST_POINTS):
            below.append((f"... and {counted(left, 'point')} with a better condition", ""))
        cells[::PER_LINE] = [f"  {cell}" for cell in cells[::PER_LINE]]
        columns = [Column("", cells[k::PER_LINE], left=True) for k in range(PER_LINE)]
        yield Table(columns, f"{name}{place}", between={len(columns[0].values): below})
