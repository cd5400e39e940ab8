"""Tables of delimited text (CSV, TSV as VizieR sends it, `;` or blanks), with names and units above the rows."""

import io
import re
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any

from linksweep.sweep.tables.rows import fields_of, read_rows

DELIMITERS = ("\t", ";", "|", ",")

PREFACE_LINES = 100_000
"""The most lines that comments, names, units and rules take."""

_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eEdD][+-]?\d+)?")
_RULE = re.compile(r"[-=+]+")
_CLOCK = re.compile(r'"?[hd]:m:s"?')  # VizieR's unit of text like 12 34 56.7
_WORDS = {"degrees": "deg", "hours": "h", "radians": "rad", "MJD": "d", "years": "yr"}
"""How tables spell units out; dates are numbers of days."""
_BRACKETS = re.compile(r".*[\[(]([^\])]+)[\])]")


def read_delimited(content: bytes) -> Any:
    """Return the astropy Table in delimited text; missing values are masked.

    Lines that begin with # are comments; the names of the columns stand in the first other line, or in the last comment
    before lines of numbers.  A line of units and a line of dashes may follow.  Raises ValueError that says what is
    wrong, with rows counted from 1.
    """
    content = _utf8(content)
    names, units, delimiter, start = _layout(content)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"two columns are called {', '.join(map(repr, twice))}")
    table = read_rows(content[start:], names, delimiter)
    for name, unit in zip(names, units, strict=True):
        if unit:
            table[name].unit = _unit(unit)
    return table


def _layout(content: bytes) -> tuple[list[str], list[str], str, int]:
    """Return names and units of the columns, their delimiter, and the byte at which the first row begins."""
    lines = _lines(content)
    comments: list[str] = []
    header, start, end = "", 0, 0
    for line, after in lines:
        start, end = end, after
        if line.startswith("#"):
            comments.append(line.lstrip("#"))
        elif line.strip():
            header = line
            break
    if not header.strip():
        raise ValueError("has no rows")
    delimiter = _delimiter(header)
    names = fields_of(header, delimiter)
    if any(_NUMBER.fullmatch(name) for name in names):  # this line is a row already
        last = comments[-1] if comments else ""
        commented = next((f for d in (delimiter, " ") if len(f := fields_of(last, d)) == len(names)), None)
        if commented is None or any(_NUMBER.fullmatch(name) for name in commented):
            raise ValueError(
                f"its first line, {header.strip()[:60]!r}, is not one of column names (a table of CDS needs its ReadMe "
                "beside it)"
            )
        return commented, [_bracketed(name) for name in commented], delimiter, start
    units, start = _units_and_rules(lines, end, delimiter, len(names))
    names = [name or f"column {k}" for k, name in enumerate(names, start=1)]
    return names, units or [_bracketed(name) for name in names], delimiter, start


def _units_and_rules(
    lines: Iterator[tuple[str, int]], start: int, delimiter: str, n_columns: int
) -> tuple[list[str] | None, int]:
    """Return the units in the lines after the names, if there are any, and the byte at which the first row begins."""
    units = None
    after: list[list[str]] = []
    for line, end in lines:
        fields = fields_of(line.lstrip("#"), delimiter)
        commented = line.startswith("#")
        if not line.strip() or (not commented and all(_RULE.fullmatch(f) for f in line.split())):
            if line.strip() and after:
                units = after[-1]  # VizieR has them above the line of dashes
            start = end
        elif units is None and len(fields) == n_columns and _are_units(fields):
            units, start = fields, end
        elif commented:
            start = end
        elif after or len(fields) != n_columns or any(_NUMBER.fullmatch(f) for f in fields):
            break
        else:
            after.append(fields)
    return units, start


def _are_units(fields: Sequence[str]) -> bool:
    given = [field for field in fields if field.strip("-")]
    return bool(given) and all(_unit(field, "raise") is not None for field in given)


def _unit(text: str, strict: str = "silent") -> Any:
    """Return a text as an astropy unit: an unrecognised one, or None with "raise", where astropy does not know it."""
    from astropy.units import Unit

    text = text.strip().strip("[]()").strip()
    text = _WORDS.get(text, text)
    if text in ("", "-", "--", "---"):
        return None
    if _CLOCK.fullmatch(text):
        return Unit(text.strip('"'), parse_strict="silent")
    if strict == "raise" and not text[0].isalpha():
        return None
    for form in ("cds", "generic", "vounit"):
        try:
            return Unit(text, format=form)
        except (ValueError, TypeError):
            continue
    return Unit(text, parse_strict="silent") if strict == "silent" else None


def _bracketed(name: str) -> str:
    """Return the unit in a name like 'ra [deg]', '' if there is none."""
    match = _BRACKETS.fullmatch(name)
    return match[1] if match and _unit(match[1], "raise") is not None else ""


def _delimiter(line: str) -> str:
    unquoted = re.sub(r'"[^"]*"', "", line)
    best = max(DELIMITERS, key=unquoted.count)
    return best if best in unquoted else " "


def _utf8(content: bytes) -> bytes:
    content = content.removeprefix(b"\xef\xbb\xbf")
    if b"\0" in content[:4096]:
        raise ValueError("is neither a table format that is known nor text")
    try:
        content.decode("utf-8")
    except UnicodeDecodeError:
        return content.decode("latin-1").encode("utf-8")
    return content.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in content else content


def _lines(content: bytes) -> Iterator[tuple[str, int]]:
    """Yield the first lines of a text, and where each ends."""
    end = 0
    for line in islice(io.BytesIO(content), PREFACE_LINES):
        end += len(line)
        yield line.decode("utf-8"), end
