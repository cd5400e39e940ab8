"""Numbers with their errors, counts, NAME=VALUE, tables and JSON as text, and what text of others may not hold."""

import csv
import io
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, is_dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table

MOST_DECIMALS = 9

WIDTH = 80
"""Sentences are broken into lines of at most this many characters."""


ESCAPED = {
    code: f"\\u{code:04x}"
    for codes in (range(0x20), range(0x7F, 0xA0), (0x61C, 0x200E, 0x200F), range(0x2028, 0x202F), range(0x2066, 0x206A))
    for code in codes
}
"""What changes a terminal instead of being shown by it, or the order in which text is shown: the control characters of
ASCII and Latin-1, separators of lines and paragraphs, marks of the direction of writing."""

LINES_ESCAPED = {code: escaped for code, escaped in ESCAPED.items() if chr(code) not in "\t\n"}

FORMULA = tuple("=+-@＝＋－＠")
"""How a cell of CSV begins that a spreadsheet would compute."""


COMMAND: list[str] = []
"""The words of the `sweep` command that this process runs; a script of the user's runs none, whatever its own are."""

_ADDRESS = re.compile(r"([a-z][a-z0-9+.-]*://)(?:[^\s?#'\"]*@)?([^\s/?#'\"]*)([^\s?#'\"]*)(?:[?#][^\s'\"]*)?", re.I)


def without_secrets(text: str) -> str:
    """Return text whose addresses have no passwords, keys and tokens: of a bucket's its name and the path are left, of
    others the host and the port.

    Examples:
        >>> without_secrets("sweep run x --scheduler=tls://me:secret@host:8786/?token=1 -o s3://key:secret@b/s.zarr")
        'sweep run x --scheduler=tls://host:8786 -o s3://b/s.zarr'
    """
    return _ADDRESS.sub(lambda found: found[1] + found[2] + (found[3] if found[1].lower() == "s3://" else ""), text)


def harmless(text: str) -> str:
    """Return text with its control characters escaped as in JSON, but for tabs and line ends.

    Examples:
        >>> print(harmless("red \x1b[31m"))
        red \\u001b[31m
    """
    return text.translate(LINES_ESCAPED)


def with_error(value: Any, error: float) -> str:
    """Return a number and its error with two digits of the error.

    Args:
        value: Any number; NaN gives an empty string.  Texts, truth values and integers are not rounded.
        error: One standard error; it is left out where it is not positive and finite.

    Examples:
        >>> with_error(0.66, 0.0027)
        '0.6600 ± 0.0027'
        >>> with_error(0.66, 0.0)
        '0.66'
    """
    if not 0.0 < error < math.inf:
        return rounded(value)
    return f"{rounded(value, error)} ± {rounded(error, error) if error > 1e-8 else format(error, '.1g')}"


def rounded(value: Any, error: float = 0.0) -> str:
    """Return a number to two digits of its error, or to four digits of its own where it has none; '' for NaN.

    Examples:
        >>> rounded(1234.5678, 3.0), rounded(1234.5678), rounded(28.0)
        ('1234.6', '1235', '28')
    """
    if is_missing(value):
        return ""
    if isinstance(value, str | int):
        return str(value)
    if error > 0.0:
        decimals = max(0, 1 - math.floor(math.log10(error)))
        return f"{value:.{decimals}f}" if decimals <= MOST_DECIMALS else f"{value:.3g}"
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.4g}"


def fixed(value: float, digits: str, unit: str = "") -> str:
    """Return a number with its unit, in a format of Python such as '.2f'; '' where it is not finite."""
    return f"{value:{digits}}{unit}" if math.isfinite(value) else ""


def plain(value: Any) -> str:
    """Return a value of an axis as tables show it: numbers without trailing zeros."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def is_missing(value: Any) -> bool:
    """Return whether a value is a NaN."""
    return isinstance(value, float) and math.isnan(value)


def finite_or(value: Any, missing: Any) -> Any:
    """Return a value, or ``missing`` in place of a float that is not finite."""
    return missing if isinstance(value, float) and not math.isfinite(value) else value


def counted(n: int, noun: str) -> str:
    """Return a count with its noun.

    Examples:
        >>> counted(1, "point"), counted(12345, "point")
        ('1 point', '12,345 points')
    """
    return f"{n:,} {noun}{'' if n == 1 else 's'}"


def per_second(number: int, seconds: float, noun: str) -> str:
    """Return a speed, such as '1,200 points/s'; with two digits below ten a second."""
    speed = number / max(seconds, 1e-9)
    return f"{speed:.2g} {noun}/s" if speed < 9.95 else f"{speed:,.0f} {noun}/s"


def first_of(words: Sequence[Any], most: int, separator: str = ", ") -> str:
    """Return the first of several words, and how many more there are.

    Examples:
        >>> first_of(["a", "b"], 2), first_of(range(9), 3)
        ('a, b', '0, 1, 2 and 6 more')
    """
    listed = separator.join(str(word) for word in words[:most])
    return f"{listed} and {len(words) - most:,} more" if len(words) > most else listed


def split_assignment(text: str) -> tuple[str, str]:
    """Return name and value of ``NAME=VALUE`` without the blanks around them; both are empty for any other text.

    Examples:
        >>> split_assignment("v_max = 16"), split_assignment("v_max=")
        (('v_max', '16'), ('', ''))
    """
    name, _, value = (piece.strip() for piece in text.partition("="))
    return (name, value) if name and value else ("", "")


def reading_table(title: str, headings: Sequence[str], rows: Iterable[Iterable[str]], left: str = "") -> "Table":
    """Return a table for a terminal; columns are right-aligned, but for the one with the heading ``left``."""
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title=Text(title) if title else None, title_justify="left", box=None, pad_edge=False, header_style="bold"
    )
    for heading in headings:
        table.add_column(Text(harmless(heading)), justify="left" if heading == left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(Text(cell.translate(ESCAPED)) for cell in row))
    return table


def to_csv(header: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """Return CSV; a cell that is a NaN is empty, and a quote stands before text that a spreadsheet would compute."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerows(map(_cell, row) for row in chain([header], rows))
    return out.getvalue()


def _cell(value: Any) -> Any:
    if not isinstance(value, str):
        return "" if is_missing(value) else value
    with suppress(ValueError):
        float(value)
        return value
    return ("'" if value.lstrip().startswith(FORMULA) else "") + harmless(value)


def to_json(value: Any) -> str:
    """Return JSON for programs: numbers that are not finite are null; arrays, dataclasses and paths are allowed.

    Examples:
        >>> print(to_json({"sigma": float("nan"), "n": 3}))
        {
         "sigma": null,
         "n": 3
        }
    """
    return json.dumps(_jsonable(value), indent=1, allow_nan=False)


def _jsonable(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {str(key): _jsonable(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # of NumPy, whose import would take longer than all other code for printing
        value = value.tolist()
    if isinstance(value, list | tuple | set):
        return [_jsonable(item) for item in value]
    value = finite_or(value, None)
    return value if isinstance(value, str | int | float | bool | None) else str(value)
