"""Comparisons with published numbers as tables: for reading, and for a script (CSV, JSON)."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from types import MappingProxyType
from typing import TYPE_CHECKING

from sweep.analysis.compare import summary
from sweep.analysis.selection import place_in_words
from sweep.analysis.verdicts import PROBABILITY, Comparison, Verdict, in_readable_unit
from sweep.formatting import finite_or, rounded, to_json, with_error
from sweep.readable import in_ascii

if TYPE_CHECKING:
    from rich.table import Table


COLOURS: Mapping[Verdict, str] = MappingProxyType(
    {
        **{"reproduced": "green", "within tolerance": "yellow", "NOT reproduced": "bold red"},
        **{"not comparable": "dim", "incomplete": "yellow"},
    }
)
"""Of verdicts, on a terminal."""


def as_text(comparisons: Sequence[Comparison]) -> "Table":
    """Return a table for reading, one row a published number; a line sets the studies apart."""
    from rich.markup import escape
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("verdict", no_wrap=True)
    for name in ("study", "what", "where"):
        table.add_column(name)
    for name in ("computed", "published", "difference", "", "allowance", "power"):
        table.add_column(name, justify="right", no_wrap=True)
    previous = comparisons[0].study if comparisons else ""
    for c in map(in_readable_unit, comparisons):
        if c.study != previous:
            table.add_section()
        previous = c.study
        name = f"{c.what} [{in_ascii(c.unit)}]" if c.unit else c.what
        words = (c.study, name, place_in_words(c.where), *numbers_in_words(c), power_in_words(c))
        table.add_row(Text(c.verdict, COLOURS[c.verdict]), *map(escape, words))
    return table


def notes(comparisons: Sequence[Comparison]) -> list[str]:
    """Return lines that belong below the table: where each thing was published, and the reasons of verdicts."""
    sources = dict.fromkeys(f"{c.study}: {c.what}: {c.source}" for c in comparisons)
    reasons = dict.fromkeys(f"{c.study}: {c.what}: {c.verdict}: {c.reason}" for c in comparisons if c.reason)
    probability = f"with a probability of {100 * PROBABILITY:g} %"
    power = f"power: the deviation from the published number that the verdict finds {probability}"
    return [*sources, *reasons, *([power] if comparisons else [])]


def summary_line(comparisons: Sequence[Comparison]) -> str:
    """Return how many there are of each verdict, in words."""
    counts = {verdict.lower(): n for verdict, n in summary(comparisons).items()}
    for verdict in ("not comparable", "incomplete"):
        if not counts[verdict]:
            del counts[verdict]
    return ", ".join(f"{n} {verdict}" for verdict, n in counts.items())


def as_csv(comparisons: Sequence[Comparison]) -> str:
    """Return one row a comparison; a number that is not there is an empty cell."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([field.name for field in fields(Comparison)])
    for c in comparisons:
        writer.writerow([place_in_words(v) if k == "where" else finite_or(v, "") for k, v in asdict(c).items()])
    return out.getvalue()


def as_json(comparisons: Sequence[Comparison], remarks: Sequence[str] = ()) -> str:
    """Return the comparisons, their number by verdict and remarks; a number that is not there is null."""
    counts = {verdict.lower().replace(" ", "_"): n for verdict, n in summary(comparisons).items()}
    return to_json({"comparisons": comparisons, "summary": counts, "remarks": remarks})


def numbers_in_words(c: Comparison) -> tuple[str, str, str, str, str]:
    """Return value, published, difference, that in percent, and allowance, with the digits that count."""
    published = f"{c.published:.{_decimals(2.0 * c.rounding)}f}" if c.rounding > 0.0 else f"{c.published:g}"
    if not math.isfinite(c.value):
        return "", published, "", "", ""
    finest = c.mc_error if c.mc_error > 0.0 else 0.1 * c.rounding
    value = with_error(c.value, finest) if c.mc_error > 0.0 else rounded(c.value, finest)
    if c.difference == 0.0:
        return value, published, "none", "", _allowance(c)
    percent = f"{100.0 * c.difference / abs(c.published):+.1f} %" if c.published else ""
    sign = "+" if c.difference > 0.0 else ""
    return value, published, sign + rounded(c.difference, finest), percent, _allowance(c)


def power_in_words(c: Comparison) -> str:
    """Return the deviation that the verdict finds: relative to the published number, or as it is where that is 0."""
    if not math.isfinite(c.detectable):
        return ""
    if c.detectable == 0.0:
        return "any"
    return f"{100.0 * c.power:.2g} %" if c.published else f"{c.detectable:.2g}"


def _allowance(c: Comparison) -> str:
    return f"{c.allowance:.2g}" if c.allowance > 0.0 else "none"


def _decimals(unit: float) -> int:
    """Return the decimal places that a number with this least significant unit needs."""
    return min(300, max(0, -math.floor(math.log10(unit) + 1e-9)))
