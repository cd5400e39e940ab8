"""Fits and crossings as tables: for reading, and for a script (JSON)."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from sweep.analysis.crossings import ALWAYS, FROM, LEFT_OUT, MET_WORDS, NEVER, UP_TO
from sweep.formatting import fixed, plain, to_json, with_error
from sweep.readable import in_ascii, prefixed, with_unit

if TYPE_CHECKING:
    from rich.table import Table

Row = Mapping[str, Any]

DEVIATION_ALLOWED = 3.0
"""An exponent may deviate from the expected one by so many of its errors."""

P_VALUE_ALLOWED = 1e-3
"""A law is said not to hold where chi2 is so improbable."""

RATE_WANTED = 2.0
"""A levelling off is seen where its rate is so many errors above 0."""


def rows(result: xr.Dataset) -> list[dict[str, Any]]:
    """Return one mapping a line, its place on the axes and the variables of the result, of any function of analysis."""
    return [place | {str(n): one[n].item() for n in result.data_vars} for place, one in _lines(result)]


def as_json(result: xr.Dataset) -> str:
    """Return the result with its attributes, units and conclusions; a number that is not finite is null."""
    described = [row | {"conclusion": conclusion(result, row)} for row in rows(result)]
    units = {str(n): v.attrs["units"] for n, v in result.variables.items() if v.attrs.get("units")}
    return to_json({**result.attrs, "units": units, "rows": described})


def as_text(result: xr.Dataset) -> "Table":
    """Return a table for reading, one row a line of the grid."""
    from rich.markup import escape
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title=Text(str(result.attrs["title"])), title_justify="left", box=None, pad_edge=False, header_style="bold"
    )
    everything = rows(result)
    places = [str(n) for n, c in result.coords.items() if c.dims]
    dims = _dims(result)
    places.sort(key=lambda name: (dims.index(str(result[name].dims[0])), name not in dims, name))
    columns = {_heading(name, result): [plain(row[name]) for row in everything] for name in places}
    columns |= _columns(result, everything)
    for heading in columns:
        table.add_column(Text(heading), justify="left" if heading == "conclusion" else "right", no_wrap=True)
    for cells in zip(*columns.values(), strict=True):
        table.add_row(*map(escape, cells))
    return table


def notes(result: xr.Dataset) -> list[str]:
    """Return sentences that belong below the table: the law, where errors come from, and what does not fit."""
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
    """Return in words what follows from one line of a result."""
    if "met" in result:
        return _met(row, *(str(result[name].attrs.get("units", "")) for name in ("first", "nearest")))
    if row["points"] == 0.0:
        return "excluded by the study"
    if result.attrs["law"] == "levelling":
        return _levelling(row, result.attrs["last"], str(result["limit"].attrs.get("units", "")))
    if not math.isfinite(row.get("deviation", math.nan)):
        return ""
    return "as expected" if abs(row["deviation"]) <= DEVIATION_ALLOWED else "NOT as expected"


def _columns(result: xr.Dataset, everything: Sequence[Row]) -> dict[str, list[str]]:
    columns: dict[str, list[str]] = {}
    if "met" not in result:
        columns["points"] = [f"{row['points']:.0f}" for row in everything]
        shown = ["exponent"] if result.attrs["law"] == "power" else ["plateau"]
        for name in shown:
            columns |= _in_readable_unit(name, result, everything)
    if "expected" in result:
        columns["expected"] = [fixed(row["expected"], "g") for row in everything]
        columns["deviation"] = [fixed(row["deviation"], "+.1f", " errors") for row in everything]
    if "amplitude" in result:
        columns |= _in_readable_unit("amplitude", result, everything)
        columns[_heading("pivot", result)] = [fixed(row["pivot"], ".4g") for row in everything]
    if "end_fall" in result:
        unit = str(result["limit"].attrs.get("units", "")) or "unit"
        falls = [with_error(100.0 * row["end_fall"], 100.0 * row["end_fall_error"]) for row in everything]
        columns[f"fall at the end\n[% / {unit}]"] = falls
    if "chi2" in result:
        columns["chi2 / dof"] = [
            f"{fixed(row['chi2'], '.3g') or '-'} / {fixed(row['dof'], '.0f')}" for row in everything
        ]
        columns["p"] = [fixed(row["p_value"], ".2g") for row in everything]
    words = [conclusion(result, row) for row in everything]
    return columns | ({"conclusion": words} if any(words) else {})


def _in_readable_unit(name: str, result: xr.Dataset, everything: Sequence[Row]) -> dict[str, list[str]]:
    """Return a column of numbers with errors, in the unit in which they read best."""
    unit, factor = prefixed([row[name] for row in everything], str(result[name].attrs.get("units", "")))
    cells = [with_error(factor * row[name], factor * row[f"{name}_error"]) for row in everything]
    return {f"{name}\n[{in_ascii(unit)}]" if unit else name: cells}


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


def _lines(result: xr.Dataset) -> Iterator[tuple[dict[str, Any], xr.Dataset]]:
    """Yield the place and the part of each line, in the order of the dimensions of the variables."""
    dims = _dims(result)
    for index in np.ndindex(*(result.sizes[d] for d in dims)):
        one = result.isel(dict(zip(dims, index, strict=True)))
        yield {str(n): one[n].item() for n in one.coords}, one


def _dims(result: xr.Dataset) -> list[str]:
    return [str(d) for d in next(iter(result.data_vars.values())).dims]


def _heading(name: str, result: xr.Dataset) -> str:
    unit = result[name].attrs.get("units", "")
    return f"{name}\n[{in_ascii(unit)}]" if unit else name
