"""Fits and crossings as tables: for reading, and for a script (JSON)."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import xarray as xr

from linksweep.sweep.analysis.columns import GAP, Column, fitting
from linksweep.sweep.analysis.crossings import ALWAYS, FROM, LEFT_OUT, MET_WORDS, NEVER, UP_TO
from linksweep.sweep.analysis.long_table import axis_coordinates
from linksweep.sweep.analysis.selection import places_along
from linksweep.sweep.formatting import fixed, plain, prefixed, reading_table, to_json, units_of, with_error, with_unit

if TYPE_CHECKING:
    from rich.table import Table

Row = Mapping[str, Any]

CONCLUSION = "conclusion"
"""The last column, in words."""

FEWEST_LETTERS = 24
"""The least width of the column of conclusions, in characters."""

DEVIATION_ALLOWED = 3.0
"""An exponent may deviate from the expected one by this many of its errors."""

P_VALUE_ALLOWED = 1e-3
"""A law is said not to hold if the probability of its chi2 is lower than this."""

RATE_WANTED = 2.0
"""A levelling off is significant if its rate is more than this many errors above 0."""


def rows(result: xr.Dataset) -> list[dict[str, Any]]:
    """Return one mapping per line of the result of an analysis: its place on the axes, and the variables."""
    parts = (result.isel(place) for place in places_along(result, _dims(result)))
    return [{str(n): one[n].item() for n in (*one.coords, *one.data_vars)} for one in parts]


def as_json(result: xr.Dataset) -> str:
    """Return the result with its attributes, units and conclusions; a number that is not finite is null."""
    described = [row | {"conclusion": conclusion(result, row)} for row in rows(result)]
    units = {str(n): v.attrs["units"] for n, v in result.variables.items() if v.attrs.get("units")}
    return to_json({**result.attrs, "units": units, "rows": described})


def as_text(result: xr.Dataset, width: int | None = None) -> "Table":
    """Return a table for reading with one row per line of the grid: the columns that fit into ``width`` characters,
    and the conclusions, in several lines where they are long.
    """
    columns, _ = fitting_columns(result, width)
    rows = zip(*(column.cells for column in columns), strict=True)
    table = reading_table(str(result.attrs["title"]), [column.heading for column in columns], rows, left=CONCLUSION)
    if columns[-1].name == CONCLUSION:
        table.columns[-1].no_wrap = False
        if width is not None:
            room = width - sum(column.width for column in columns[:-1]) - GAP
            table.columns[-1].max_width = max(room, FEWEST_LETTERS)
    return table


def fitting_columns(result: xr.Dataset, width: int | None = None) -> tuple[list[Column], list[Column]]:
    """Return the columns that fit into a width (places on the axes, the law, and the conclusion, which may take several
    lines), and those that are left out.
    """
    everything = rows(result)
    places = axis_coordinates(result, _dims(result))
    own = [_column(name, _unit(result, name), [plain(row[name]) for row in everything]) for name in places]
    conclusions = [conclusion(result, row) for row in everything]
    words = [_column(CONCLUSION, "", conclusions)] if any(conclusions) else []
    room = None if width is None else width - sum(min(column.width, FEWEST_LETTERS + GAP) for column in words)
    kept, left_out = fitting([*own, *_columns(result, everything)], room)
    return [*kept, *words], left_out


def notes(result: xr.Dataset) -> list[str]:
    """Return the sentences below the table: the law, the origin of errors, and how many lines do not follow the law."""
    about, everything = result.attrs, rows(result)
    if "condition" in about:
        return [f"{about['condition']} along {about['over']}; errors: {about['errors']}"]
    variable, over = about["variable"], about["over"]
    laws = {
        "power": f"{variable} = amplitude x ({over} / pivot)^exponent",
        "levelling": f"{variable}^2 = plateau^2 + c exp(-rate x {over}); errors are scaled where chi2 > dof",
    }
    sentences = [f"{laws[about['law']]}; errors: {about['errors']}"]
    if bad := sum(row["p_value"] < P_VALUE_ALLOWED for row in everything):
        sentences.append(f"{bad} of {len(everything)} lines: the law does not hold within the errors, p < 0.001")
    return sentences


def conclusion(result: xr.Dataset, row: Row) -> str:
    """Return the conclusion from one line of a result, in words."""
    if "met" in result:
        return _met(row, *(_unit(result, name) for name in ("first", "nearest")))
    if row["points"] == 0.0:
        return "excluded by the study"
    if result.attrs["law"] == "levelling":
        return _levelling(row, result.attrs["last"], _unit(result, "limit"))
    if not math.isfinite(row.get("deviation", math.nan)):
        return ""
    return "as expected" if abs(row["deviation"]) <= DEVIATION_ALLOWED else "NOT as expected"


def _columns(result: xr.Dataset, everything: Sequence[Row]) -> Iterator[Column]:
    """Yield the columns of numbers; those of a larger rank are left out first where there is no room."""
    if "met" not in result:
        yield _column("points", "", [f"{row['points']:.0f}" for row in everything], 2)
        yield _in_readable_unit("exponent" if result.attrs["law"] == "power" else "plateau", result, everything, 0)
    if "expected" in result:
        yield _column("expected", "", [fixed(row["expected"], "g") for row in everything], 1)
        yield _column("deviation", "", [fixed(row["deviation"], "+.1f", " errors") for row in everything], 1)
    if "amplitude" in result:
        yield _in_readable_unit("amplitude", result, everything, 4)
        yield _column("pivot", _unit(result, "pivot"), [fixed(row["pivot"], ".4g") for row in everything], 4)
    if "end_fall" in result:
        unit = _unit(result, "limit") or "unit"
        falls = [with_error(100.0 * row["end_fall"], 100.0 * row["end_fall_error"]) for row in everything]
        yield _column("fall at the end", f"% / {unit}", falls, 2)
    if "chi2" in result:
        cells = [f"{fixed(row['chi2'], '.3g') or '-'} / {fixed(row['dof'], '.0f')}" for row in everything]
        yield _column("chi2 / dof", "", cells, 3)
        yield _column("p", "", [fixed(row["p_value"], ".2g") for row in everything], 3)


def _column(name: str, unit: str, cells: list[str], rank: int = 0) -> Column:
    return Column(name, unit, cells, list(cells), name, rank)


def _in_readable_unit(name: str, result: xr.Dataset, everything: Sequence[Row], rank: int) -> Column:
    """Return a column of numbers with errors, in the unit in which they read best."""
    unit, factor = prefixed([row[name] for row in everything], _unit(result, name))
    cells = [with_error(factor * row[name], factor * row[f"{name}_error"]) for row in everything]
    return _column(name, unit, cells, rank)


def _unit(result: xr.Dataset, name: str) -> str:
    return units_of(result[name].attrs)


def _met(row: Row, unit: str, value_unit: str) -> str:
    met, unit = row["met"], unit and f" {unit}"
    first, last = (with_error(row[end], row[f"{end}_error"]) + unit for end in ("first", "last"))
    if met in (FROM, UP_TO):
        return f"{MET_WORDS[met]} {first}"
    if met in (NEVER, ALWAYS):
        nearest = with_unit(row["nearest"], 0.0, value_unit)
        return f"{MET_WORDS[met]}; {nearest} at {row['nearest_at']:g}{unit} is nearest to the limit"
    return MET_WORDS[met] + ("" if met == LEFT_OUT else f", first at {first}, last at {last}")


def _levelling(row: Row, last: float, unit: str) -> str:
    limit, unit = row["limit"], unit and f" {unit}"
    if limit == -math.inf:
        return "falls by less everywhere"
    if not math.isfinite(limit):
        return "no plateau: falls by more everywhere"
    seen = "" if row["rate"] > RATE_WANTED * row["rate_error"] else "; the levelling off is not significant"
    place = with_error(limit, row["limit_error"]) + unit
    return (
        f"falls by less from {place}" if limit <= last else f"no plateau yet: not before {place}, by the law"
    ) + seen


def _dims(result: xr.Dataset) -> list[str]:
    return [str(d) for d in next(iter(result.data_vars.values())).dims]
