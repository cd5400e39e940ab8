"""Comparisons with published numbers for scripts (CSV, JSON), and the words for them that every display uses."""

import math
from collections.abc import Sequence
from dataclasses import asdict, fields

from linksweep.sweep.analysis.compare import PROBABILITY, Comparison, summary
from linksweep.sweep.analysis.selection import place_in_words
from linksweep.sweep.formatting import finite_or, rounded, to_csv, to_json, with_error

CHANCE = f"with a probability of {100 * PROBABILITY:g} %"
POWER = f"power: the deviation from the published number that the verdict finds {CHANCE}"
"""The explanation of the column ``power``, printed below a table."""


def notes(comparisons: Sequence[Comparison]) -> list[str]:
    """Return the lines below a table: where each number was published, and the reasons for verdicts."""
    sources = dict.fromkeys(f"{c.study}: {c.what}: {c.source}" for c in comparisons)
    reasons = dict.fromkeys(f"{c.study}: {c.what}: {c.verdict}: {c.reason}" for c in comparisons if c.reason)
    return [*sources, *reasons]


def summary_line(comparisons: Sequence[Comparison]) -> str:
    """Return in words how many comparisons have each verdict."""
    counts = {verdict.lower(): n for verdict, n in summary(comparisons).items()}
    for verdict in ("not comparable", "incomplete"):
        if not counts[verdict]:
            del counts[verdict]
    return ", ".join(f"{n} {verdict}" for verdict, n in counts.items())


def as_csv(comparisons: Sequence[Comparison]) -> str:
    """Return CSV with one row per comparison; a missing number is an empty cell."""
    rows = (
        [place_in_words(v) if k == "where" else finite_or(v, "") for k, v in asdict(c).items()] for c in comparisons
    )
    return to_csv([field.name for field in fields(Comparison)], rows)


def as_json(comparisons: Sequence[Comparison], remarks: Sequence[str] = ()) -> str:
    """Return JSON with the comparisons, their number by verdict, and remarks; a missing number is null."""
    counts = {verdict.lower().replace(" ", "_"): n for verdict, n in summary(comparisons).items()}
    return to_json({"comparisons": comparisons, "summary": counts, "remarks": remarks})


def numbers_in_words(c: Comparison) -> tuple[str, str, str, str, str]:
    """Return value, published number, difference (also in percent) and allowance, with significant digits only."""
    decimals = 0  # of the published number: its rounding is half a unit of the last digit
    if c.rounding > 0.0:
        decimals = min(300, max(0, -math.floor(math.log10(2.0 * c.rounding) + 1e-9)))
    exact = min(f"{c.published:g}", rounded(c.published, c.mc_error), key=len)  # no more digits than our number has
    published = f"{c.published:.{decimals}f}" if c.rounding > 0.0 else exact
    if not math.isfinite(c.value):
        return "", published, "", "", ""
    if c.mc_error > 0.0:
        value, difference = with_error(c.value, c.mc_error), rounded(c.difference, c.mc_error)
    elif c.rounding > 0.0 and c.value != round(c.value, decimals):
        value, difference = (f"{number:.{decimals + 1}f}" for number in (c.value, c.difference))
    else:
        value, difference = rounded(c.value), rounded(c.difference)
    allowance = f"{c.allowance:.2g}" if c.allowance > 0.0 else "none"
    if c.difference == 0.0:
        return value, published, "none", "", allowance
    percent = f"{100.0 * c.difference / abs(c.published):+.1f} %" if c.published else ""
    sign = "+" if c.difference > 0.0 else ""
    return value, published, sign + difference, percent.replace("-0.0", "0.0").replace("+0.0", "0.0"), allowance


def power_in_words(c: Comparison) -> str:
    """Return the deviation that the verdict finds: relative to the published number, or absolute if that is 0."""
    if not math.isfinite(c.detectable):
        return ""
    if c.detectable == 0.0:
        return "any"
    return f"{100.0 * c.power:.2g} %" if c.published else f"{c.detectable:.2g}"
