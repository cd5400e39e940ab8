"""Comparisons with published numbers for reading: a block for each published quantity, verdicts first."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

from linksweep.sweep.analysis.compare import Comparison, in_readable_unit
from linksweep.sweep.analysis.compare_tables import POWER, numbers_in_words, power_in_words
from linksweep.sweep.analysis.selection import place_in_words
from linksweep.sweep.formatting import in_ascii

if TYPE_CHECKING:
    from rich.text import Text

COLOURS: Mapping[str, str] = {
    **{"reproduced": "green", "within tolerance": "yellow", "NOT reproduced": "bold red"},
    **{"not comparable": "dim", "incomplete": "yellow"},
}
"""The colours of verdicts on a terminal."""

HEADINGS = ("verdict", "at", "computed", "published", "difference", "power", "allowance")
FIRST_NUMBER, FEWEST_COLUMNS = 2, 5
"""The first column of numbers; how many columns are always kept, even in a table that is too wide."""

INDENT, GAP, NARROWEST = "  ", "  ", 8
"""Blanks before a row and between columns; the least width of the column of places."""

SHORT_PLACE = 16
"""The most characters of a place in a row: part of a longer place moves to the heading above several rows."""


@dataclass(frozen=True)
class _Block:
    """The comparisons of one published quantity: the line above its rows, study and source, rows of cells that begin
    with the verdict, and the reasons for verdicts.
    """

    heading: str
    origin: tuple[str, str]
    rows: list[tuple[str, ...]]
    reasons: list[str]


def as_text(comparisons: Sequence[Comparison], width: int) -> "Text":
    """Return comparisons in lines of at most ``width`` characters: columns that do not fit are left out, the last
    first, and long places take several lines.
    """
    from rich.text import Text

    blocks = list(_blocks(comparisons))
    rows = [HEADINGS, *(row for block in blocks for row in block.rows)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(HEADINGS))]
    longest = max(len(word) for row in rows for word in row[1].split(" "))
    used = len(HEADINGS)
    while _room(widths[:used], width) < longest and used > FEWEST_COLUMNS:
        used -= 1
    widths = [widths[0], max(NARROWEST, min(widths[1], _room(widths[:used], width))), *widths[2:used]]
    text = Text(no_wrap=True)
    text.append_text(_row(HEADINGS, widths, "bold"))
    for before, block, after in zip([None, *blocks], blocks, [*blocks[1:], None], strict=False):
        text.append("\n" + textwrap.fill(block.heading, width) + "\n", "bold")
        if before is None or before.origin != block.origin:
            text.append(textwrap.fill(block.origin[1], width) + "\n", "dim")
        for row in block.rows:
            text.append_text(_row(row, widths, COLOURS[row[0]]))
        for reason in block.reasons if after is None or after.reasons != block.reasons else ():
            text.append(textwrap.fill(reason, width, initial_indent=INDENT, subsequent_indent=INDENT) + "\n")
    left_out = f"left out to fit {width} columns: {', '.join(HEADINGS[used:])}; --format csv has them"
    notes = [*([POWER] if "power" in HEADINGS[:used] else []), *([left_out] if HEADINGS[used:] else [])]
    text.append("".join(f"\n{textwrap.fill(note, width)}" for note in notes))
    return text


def _blocks(comparisons: Sequence[Comparison]) -> Iterator[_Block]:
    """Yield blocks of neighbouring comparisons that are of the same quantity in the same unit."""
    readable = map(in_readable_unit, comparisons)
    for (study, what, unit, source), group in groupby(readable, lambda c: (c.study, c.what, c.unit, c.source)):
        name = f"{study}: {what} [{in_ascii(unit)}]" if unit else f"{study}: {what}"
        for found in _with_short_places(list(group)):
            common = _common([c.where for c in found])
            heading = f"{name}, {place_in_words(common)}" if common else name
            reasons = dict.fromkeys(f"{c.verdict}: {c.reason}" for c in found if c.reason)
            yield _Block(heading, (study, source), list(_rows(found, common)), list(reasons))


def _with_short_places(found: list[Comparison]) -> Iterator[list[Comparison]]:
    """Yield comparisons in groups whose places are short once the values that a group shares are left out."""
    common = _common([c.where for c in found])
    varied = [{k: v for k, v in c.where.items() if k not in common} for c in found]
    if _all_agree(found) or max(len(place_in_words(place)) for place in varied) <= SHORT_PLACE:
        yield found
        return
    longest = max((name for place in varied for name in place), key=len)
    values = dict.fromkeys(place.get(longest) for place in varied)
    for value in values:
        yield from _with_short_places([c for c in found if c.where.get(longest) == value])


def _common(places: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the values that several places share; for a single place, all its values."""
    return {k: v for k, v in places[0].items() if all(k in place and place[k] == v for place in places)}


def _rows(found: Sequence[Comparison], common: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Yield the cells of each comparison, or one row for several that all agree exactly."""
    if _all_agree(found):
        power = power_in_words(found[0])
        yield found[0].verdict, f"all {len(found)} places", "exactly", "", "none", power, "none"
        return
    for c in found:
        where = {name: value for name, value in c.where.items() if name not in common}
        value, published, difference, percent, allowance = numbers_in_words(c)
        numbers = (value, published, percent or difference, power_in_words(c), allowance)
        yield c.verdict, place_in_words(where), *numbers


def _all_agree(found: Sequence[Comparison]) -> bool:
    """Return whether several comparisons have one verdict and no difference."""
    return len(found) > 1 and all(c.difference == 0.0 and c.verdict == found[0].verdict for c in found)


def _room(widths: Sequence[int], width: int) -> int:
    """Return the characters that are left for places."""
    return width - len(INDENT) - sum(widths) + widths[1] - len(GAP) * (len(widths) - 1)


def _row(cells: Sequence[str], widths: Sequence[int], style: str) -> "Text":
    """Return a row with its verdict in a colour; a place that is too long for its column continues below the row, and
    one with a word that is too long stands there as a whole.
    """
    from rich.text import Text

    first, *rest = textwrap.wrap(cells[1], widths[1]) or [""]
    indent = INDENT + " " * widths[0] + GAP
    if max(map(len, cells[1].split(" "))) > widths[1]:
        width = sum(widths) + len(GAP) * (len(widths) - 1) - len(INDENT)
        first, rest, indent = "", textwrap.wrap(cells[1], width, break_on_hyphens=False), INDENT * 2
    numbers = [cell.rjust(width) for cell, width in zip(cells, widths, strict=False)][FIRST_NUMBER:]
    text = Text(INDENT)
    text.append(cells[0].ljust(widths[0]), style)
    text.append(GAP.join(["", first.ljust(widths[1]), *numbers]).rstrip() + "\n")
    for line in rest:
        text.append(f"{indent}{line}\n")
    return text
