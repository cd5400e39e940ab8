"""The one table that everything prints: columns, and its writers for the terminal, CSV, ECSV and JSON.

Text of functions, tables and stores is made harmless here: the terminal and CSV get no control characters, and no cell
of CSV begins a formula.  JSON has it exactly.
"""

import csv
import io
import json
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from rich import cells, console, table, text

from linksweep.sweep.formatting import ESCAPED, WIDTH, harmless, in_ascii, is_missing, plain, to_json

GAP = 2  # blanks between two columns
LONG_NAME = 13  # column names longer than this are broken into two lines at an underscore
FORMULA = tuple("=+-@＝＋－＠")  # how a cell of CSV begins that a spreadsheet would compute
COLOURS = {"reproduced": "green", "within tolerance": "yellow", "NOT reproduced": "red"}  # of cells in terminals
ENDLESS = 10**6  # columns of a terminal that has room for everything


@dataclass(frozen=True)
class Column:
    """The ``values`` of a column, one for each row, and the ``cells`` that stand for them in tables for reading; by
    default the values as they are; ``meaning`` is its description in ECSV.

    A table that is too wide leaves out the columns of the largest ``rank`` first, by the ``quantity`` that they belong
    to, and never those of rank 0.  A column that may ``wrap`` takes several lines where there is no room, and is then
    at least so many characters wide.
    """

    name: str
    values: Sequence[Any]
    cells: Sequence[str] | None = None
    unit: str = ""
    quantity: str = ""
    rank: int = 0
    left: bool = False
    wrap: int = 0
    meaning: str = ""

    @property
    def shown(self) -> Sequence[str]:
        """The cells."""
        return plain(self.values) if self.cells is None else self.cells

    @property
    def texts(self) -> list[str]:
        """The cells as a terminal may show them."""
        return [cell.translate(ESCAPED) for cell in self.shown]

    @property
    def heading(self) -> list[str]:
        """The lines above the column: a long name in two, and the unit."""
        return list(map(harmless, [*_two_lines(self.name), *([f"[{in_ascii(self.unit)}]"] if self.unit else [])]))

    @property
    def width(self) -> int:
        """How many characters the column takes at least."""
        lines = [*self.heading, *self.texts]
        whole = max(map(cells.cell_len, lines))
        return min(whole, max(self.wrap, *map(cells.cell_len, " ".join(lines).split(" ")))) if self.wrap else whole


@dataclass(frozen=True)
class Table:
    """Columns of one length under a title; ``about`` is said beside them in JSON, ``meta`` in the head of ECSV."""

    columns: Sequence[Column]
    title: str = ""
    about: Mapping[str, Any] = field(default_factory=dict)
    meta: Mapping[str, Any] = field(default_factory=dict)

    @property
    def rows(self) -> Iterable[tuple[Any, ...]]:
        """The values of each row."""
        return zip(*(column.values for column in self.columns), strict=True)

    def fitting(self, width: int | None) -> "tuple[Table, str]":
        """Return the table of the columns that fit into a width, and the names of those that are left out."""
        kept = list(self.columns)
        while width is not None and sum(column.width + GAP for column in kept) - GAP > width:
            rank = max(column.rank for column in kept)
            if rank == 0:
                break
            last = next(column.quantity for column in reversed(kept) if column.rank == rank)
            kept = [column for column in kept if (column.rank, column.quantity) != (rank, last)]
        missing = [column for column in self.columns if column not in kept]
        names = [c.name if c.quantity in ("", c.name) else f"{c.quantity} {c.name}" for c in missing]
        return replace(self, columns=kept), ", ".join(names).replace("\n", " ")

    def text(self, width: int | None = None, styled: bool = False) -> str:
        """Return the table for reading: numbers are aligned at the right, and no cell is cut.

        Columns that may wrap do so to fit into ``width`` characters.  ``styled`` is for terminals.
        """
        grid = table.Table(box=None, padding=(0, GAP, 0, 0), pad_edge=False, header_style="bold")
        headings = [column.heading for column in self.columns]
        depth = max(map(len, headings))
        for column, lines in zip(self.columns, headings, strict=True):
            head, side = text.Text("\n".join([""] * (depth - len(lines)) + lines)), column.left or column.wrap
            options: Any = {"justify": "left" if side else "right", "no_wrap": not column.wrap}
            grid.add_column(head, min_width=column.width, **options)
        for row in zip(*(column.texts for column in self.columns), strict=True):
            grid.add_row(*(text.Text(cell, COLOURS.get(cell, "")) for cell in row))
        # the height, too: a terminal that is "dumb" would else be 80 columns wide
        room = max(width or ENDLESS, sum(column.width + GAP for column in self.columns))
        terminal = console.Console(width=room, height=25, color_system="standard" if styled else None)
        with terminal.capture() as capture:
            if self.title:
                lines = [textwrap.fill(harmless(line), width or WIDTH) for line in self.title.split("\n")]
                terminal.print(text.Text("\n".join(lines), "italic"), soft_wrap=True)
            terminal.print(grid)
        return "\n".join(line.rstrip() for line in capture.get().splitlines())

    def csv(self) -> str:
        """Return CSV; a missing value is an empty cell, units stand in the header as ``name [unit]``."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(_safe(f"{c.name} [{c.unit}]" if c.unit else c.name) for c in self.columns)
        writer.writerows(map(_safe, row) for row in self.rows)
        return out.getvalue()

    def ecsv(self) -> str:
        """Return ECSV, which astropy reads with units; missing values are masked."""
        from astropy import table as astropy_table

        table = astropy_table.Table(meta=dict(self.meta))
        for column in self.columns:
            about: dict[str, Any] = {"unit": column.unit or None, "description": column.meaning or None}
            if len(set(map(np.shape, column.values))) > 1:  # arrays of several lengths
                cells = np.empty(len(column.values), dtype=object)
                cells[:] = column.values
                table[column.name] = astropy_table.Column(cells, **about)
                continue
            cells = np.array(column.values, dtype=object)
            missing = np.array([is_missing(cell) for cell in cells.reshape(-1)], dtype=bool).reshape(cells.shape)
            known = next(iter(cells[~missing]), np.nan)
            masked = missing.any() and (cells.ndim == 1 or isinstance(known, int))  # arrays of floats can hold NaN
            if masked:
                cells[missing] = known  # a NaN would make floats of integers
            table[column.name] = astropy_table.MaskedColumn(cells.tolist(), mask=missing if masked else False, **about)
        out = io.StringIO()
        table.write(out, format="ascii.ecsv")
        return out.getvalue()

    def json(self) -> str:
        """Return JSON with what the table is about and one object per row, as `to_json` has it."""
        names = [column.name for column in self.columns]
        # row by row: dictionaries of all points would take more memory than everything else
        rows = ",\n".join(textwrap.indent(to_json(dict(zip(names, row, strict=True))), "  ") for row in self.rows)
        frame = to_json({**self.about, "rows": []})
        return frame.removesuffix("[]\n}") + f"[\n{rows}\n ]\n}}" if rows else frame


def _safe(value: Any) -> Any:
    """Return a value as a cell of CSV: no NaN, no control character, and a quote before what would be computed."""
    if isinstance(value, list | np.ndarray):
        return json.dumps(np.asarray(value).tolist())
    if not isinstance(value, str):
        return "" if is_missing(value) else value
    with suppress(ValueError):
        float(value)
        return harmless(value)  # a number may have controls around it, as '0\r'
    return ("'" if value.lstrip().startswith(FORMULA) else "") + harmless(value)


def _two_lines(name: str) -> list[str]:
    places = [i for i, letter in enumerate(name) if letter == "_"]
    if len(name) <= LONG_NAME or not places or "\n" in name:
        return name.split("\n")
    middle = min(places, key=lambda i: abs(i + 1 - len(name) / 2)) + 1
    return [name[:middle], name[middle:]]
