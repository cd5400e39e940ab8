"""The one table that everything prints: columns, and its writers for the terminal, CSV, ECSV and JSON.

Text of functions, tables and stores is made harmless here: the terminal and CSV get no control characters, and no cell
of CSV begins a formula.  JSON and ECSV have it exactly.
"""

import csv
import io
import json
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import Any

import numpy as np
from rich.cells import cell_len

from linksweep.sweep.formatting import ESCAPED, WIDTH, harmless, in_ascii, is_missing, plain, to_json

GAP = 2  # blanks between two columns
LONG_NAME = 13  # column names longer than this are broken into two lines at an underscore
FORMULA = tuple("=+-@＝＋－＠")  # how a cell of CSV begins that a spreadsheet would compute

# styles of a terminal: headings, titles, and the end of a style
BOLD, ITALIC, PLAIN = "\x1b[1m", "\x1b[3m", "\x1b[0m"


@dataclass(frozen=True)
class Column:
    """The ``values`` of a column, one for each row, and the ``cells`` that stand for them in tables for reading; by
    default the values as they are.

    A table that is too wide leaves out the columns of the largest ``rank`` first, by the ``quantity`` that they belong
    to, and never those of rank 0.  A column that may ``wrap`` takes several lines where there is no room, and is then
    at least so many characters wide.  ``styles`` are those of cells on a terminal.
    """

    name: str
    values: Sequence[Any]
    cells: Sequence[str] | None = None
    unit: str = ""
    quantity: str = ""
    rank: int = 0
    left: bool = False
    wrap: int = 0
    styles: Mapping[str, str] = field(default_factory=dict)

    @property
    def shown(self) -> Sequence[str]:
        """The cells."""
        return ["" if is_missing(v) else plain(v) for v in self.values] if self.cells is None else self.cells

    @property
    def texts(self) -> list[str]:
        """The cells as a terminal may show them."""
        return [cell.translate(ESCAPED) for cell in self.shown]

    @property
    def heading(self) -> list[str]:
        """The lines above the column: a long name in two, and the unit."""
        return list(map(harmless, [*_two_lines(self.name), *([f"[{in_ascii(self.unit)}]"] if self.unit else [])]))

    def width(self, least: bool = False) -> int:
        """Return how many characters the column takes, or at ``least`` takes where it wraps."""
        texts = self.texts
        whole = max(map(_length, [*self.heading, *texts]))
        if not (least and self.wrap):
            return whole
        words = max((_length(word) for text in texts for word in text.split(" ")), default=0)
        return min(whole, max([self.wrap, words, *map(_length, self.heading)]))


@dataclass(frozen=True)
class Table:
    """Columns of one length under a title; ``about`` is said beside them in JSON, ``meta`` in the head of ECSV.

    ``between`` has sentences for reading, each with its style, above the row of that number.
    """

    columns: Sequence[Column]
    title: str = ""
    about: Mapping[str, Any] = field(default_factory=dict)
    meta: Mapping[str, Any] = field(default_factory=dict)
    between: Mapping[int, Sequence[tuple[str, str]]] = field(default_factory=dict)

    @property
    def rows(self) -> Iterable[tuple[Any, ...]]:
        """The values of each row."""
        return zip(*(column.values for column in self.columns), strict=True)

    def fitting(self, width: int | None) -> "tuple[Table, str]":
        """Return the table of the columns that fit into a width, and the names of those that are left out."""
        kept = list(self.columns)
        while width is not None and sum(column.width(least=True) + GAP for column in kept) - GAP > width:
            rank = max(column.rank for column in kept)
            if rank == 0:
                break
            last = next(column.quantity for column in reversed(kept) if column.rank == rank)
            kept = [column for column in kept if (column.rank, column.quantity) != (rank, last)]
        missing = [column for column in self.columns if column not in kept]
        names = [c.name if c.quantity in ("", c.name) else f"{c.quantity} {c.name}" for c in missing]
        return replace(self, columns=kept), ", ".join(names)

    def text(self, width: int | None = None, styled: bool = False) -> str:
        """Return the table for reading: numbers are aligned at the right, and no cell is cut.

        Columns that may wrap do so to fit into ``width`` characters.  ``styled`` is for terminals.
        """
        widths = [column.width() for column in self.columns]
        for i, column in enumerate(self.columns):
            if column.wrap and width is not None:
                room = width - sum(widths) - GAP * (len(widths) - 1) + widths[i]
                widths[i] = max(column.width(least=True), min(widths[i], room))

        def sentence(text: str, style: str) -> str:
            indent = " " * (len(text) - len(text.lstrip()))
            filled = textwrap.fill(harmless(text), width or WIDTH, subsequent_indent=indent)
            return f"{style}{filled}{PLAIN}" if styled and style else filled

        lines = [sentence(line, ITALIC) for line in self.title.split("\n") if self.title]
        depth = max(len(column.heading) for column in self.columns)
        for heading in zip(*([""] * (depth - len(c.heading)) + c.heading for c in self.columns), strict=True):
            line = self._line(heading, widths)
            lines += [f"{BOLD}{line}{PLAIN}" if styled else line] if line else []
        rows = list(zip(*(column.texts for column in self.columns), strict=True))
        for number, row in enumerate(rows):
            lines += [sentence(*words) for words in self.between.get(number, ())]
            parts = [
                _wrapped(cell, w) if c.wrap else [cell] for cell, w, c in zip(row, widths, self.columns, strict=True)
            ]
            lines += [self._line(line, widths, styled) for line in zip_longest(*parts, fillvalue="")]
        return "\n".join([*lines, *(sentence(*words) for words in self.between.get(len(rows), ()))])

    def _line(self, cells: Sequence[str], widths: Sequence[int], styled: bool = False) -> str:
        parts = []
        for cell, width, column in zip(cells, widths, self.columns, strict=True):
            blanks = " " * (width - _length(cell))
            style = column.styles.get(cell, "") if styled else ""
            text = f"{style}{cell}{PLAIN}" if style else cell
            parts.append(text + blanks if column.left or column.wrap else blanks + text)
        return (" " * GAP).join(parts).rstrip()

    def csv(self) -> str:
        """Return CSV; a missing value is an empty cell, units stand in the header as ``name [unit]``."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(_safe(f"{c.name} [{c.unit}]" if c.unit else c.name) for c in self.columns)
        writer.writerows(map(_safe, row) for row in self.rows)
        return out.getvalue()

    def ecsv(self) -> str:
        """Return ECSV, which astropy reads with units; missing values are masked."""
        from astropy.table import MaskedColumn
        from astropy.table import Table as AstropyTable

        table = AstropyTable(meta=dict(self.meta))
        for column in self.columns:
            cells = np.array(column.values, dtype=object)
            missing = np.array([is_missing(cell) for cell in cells.reshape(-1)], dtype=bool).reshape(cells.shape)
            known = next(iter(cells[~missing]), math.nan)
            masked = missing.any() and (cells.ndim == 1 or isinstance(known, int))  # arrays of floats can hold NaN
            if masked:
                cells[missing] = known  # a NaN would make floats of integers
            mask = missing if masked else False
            table[column.name] = MaskedColumn(cells.tolist(), mask=mask, unit=column.unit or None)
        out = io.StringIO()
        table.write(out, format="ascii.ecsv")
        return out.getvalue()

    def json(self) -> str:
        """Return JSON with what the table is about and one object per row; a number that is not finite is null."""
        names = [column.name for column in self.columns]
        # row by row: dictionaries of all points would take more memory than everything else
        rows = ",\n".join(textwrap.indent(to_json(dict(zip(names, row, strict=True))), "  ") for row in self.rows)
        frame = to_json({**self.about, "rows": []})
        return frame.removesuffix("[]\n}") + f"[\n{rows}\n ]\n}}" if rows else frame


def _length(text: str) -> int:
    """Return how many columns of a terminal a text takes, of which a Chinese letter needs two."""
    return len(text) if text.isascii() else cell_len(text)


def _wrapped(text: str, width: int) -> list[str]:
    return (
        textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False) if _length(text) > width else [text]
    )


def _safe(value: Any) -> Any:
    """Return a value as a cell of CSV: no NaN, no control character, and a quote before what would be computed."""
    if isinstance(value, list | np.ndarray):
        return json.dumps(np.asarray(value).tolist())
    if not isinstance(value, str):
        return "" if is_missing(value) else value
    with suppress(ValueError):
        float(value)
        return value
    return ("'" if value.lstrip().startswith(FORMULA) else "") + harmless(value)


def _two_lines(name: str) -> list[str]:
    places = [i for i, letter in enumerate(name) if letter == "_"]
    if len(name) <= LONG_NAME or not places or "\n" in name:
        return name.split("\n")
    middle = min(places, key=lambda i: abs(i + 1 - len(name) / 2)) + 1
    return [name[:middle], name[middle:]]
