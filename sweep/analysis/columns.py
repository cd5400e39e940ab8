"""The columns of tables for reading, and which of them fit into a width."""

from dataclasses import dataclass
from typing import Any

from linksweep.sweep.formatting import in_ascii

GAP = 2
"""Blanks between two columns."""

LONG_NAME = 13
"""Column names longer than this are broken into two lines at an underscore."""


@dataclass(frozen=True)
class Column:
    """A column for reading: ``cells`` as they are printed, and the ``values`` that they stand for and sort by.

    A table that is too wide leaves out the columns of the largest ``rank`` first, and never those of rank 0.
    """

    name: str
    unit: str
    cells: list[str]
    values: list[Any]
    of: str = ""
    rank: int = 0

    @property
    def heading(self) -> str:
        """The lines above the column: a long name in two, and the unit."""
        return "\n".join([*_two_lines(self.name), *([f"[{in_ascii(self.unit)}]"] if self.unit else [])])

    @property
    def width(self) -> int:
        """Characters that the column takes, with the gap before the next one."""
        return max(map(len, [*self.heading.split("\n"), *self.cells])) + GAP


def fitting(columns: list[Column], width: int | None) -> tuple[list[Column], list[Column]]:
    """Return the columns that fit into a width, and those that are left out."""
    kept = list(columns)
    while width is not None and sum(column.width for column in kept) - GAP > width:
        rank = max(column.rank for column in kept)
        if rank == 0:
            break
        last = next(column.of for column in reversed(kept) if column.rank == rank)
        kept = [column for column in kept if (column.rank, column.of) != (rank, last)]
    return kept, [column for column in columns if column not in kept]


def left_out_in_words(columns: list[Column]) -> str:
    """Return which columns a table leaves out, in words."""
    return ", ".join(column.of if column.of == column.name else f"{column.of} {column.name}" for column in columns)


def _two_lines(name: str) -> list[str]:
    places = [i for i, letter in enumerate(name) if letter == "_"]
    if len(name) <= LONG_NAME or not places:
        return [name]
    middle = min(places, key=lambda i: abs(i + 1 - len(name) / 2)) + 1
    return [name[:middle], name[middle:]]
