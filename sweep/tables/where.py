"""Rows of a table by a condition on its columns, like ``ruwe < 1.4 & phot_g_mean_mag < 13``."""

import ast
import operator
import re
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial, reduce
from typing import Any, NamedTuple

import numpy as np

from linksweep.sweep.contract import SweepError, suggest
from linksweep.sweep.tables.columns import Columns, Flags, first_found, gaps

# `&` binds more tightly than comparisons in Python, and `and` does not.
_WORDS = {"&": " and ", "|": " or ", "~": " not "}
_PIECES = re.compile(r"`[^`]*`|'[^']*'|\"[^\"]*\"|\s|.", re.DOTALL)

_COMPARISONS: Mapping[type, Callable[[Any, Any], Any]] = {
    **{ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge},
    **{ast.Eq: operator.eq, ast.NotEq: operator.ne},
    **{ast.In: np.isin, ast.NotIn: partial(np.isin, invert=True)},
}
_ALLOWED = "allowed are columns, numbers, text, comparisons, in, not in, &, |, ~ and parentheses"


class _Operand(NamedTuple):
    """Values (N,), or one, or a list of them, and where they are missing."""

    values: Any
    missing: Any = False

    @property
    def kind(self) -> str:
        return {"U": "text", "b": "true or false"}.get(self.values.dtype.kind, "numbers")


def rows_where(table: Any, condition: str, where: str = "", may_be_none: bool = False) -> Flags:
    """Return which rows of an astropy Table meet a condition; shape (N,).

    It compares columns with numbers, text and each other: ``<``, ``<=``, ``>``, ``>=``, ``==``, ``!=``, ``in`` and
    ``not in`` a list, joined by ``&``, ``|`` and ``~`` or ``and``, ``or`` and ``not``, with parentheses.  Backticks
    enclose a name that is no word.  Numbers are those in the file, without its units.  Every comparison with a missing
    value is false.  Nothing of it is run as Python.  Raises SweepError, with the place, for what it does not
    understand, and unless there ``may_be_none`` for a condition that no row meets.
    """
    return _Condition(Columns(table, where), condition).rows(may_be_none)


def conditions(texts: Iterable[str], tables: Collection[str], common: Sequence[str]) -> dict[str, str]:
    """Return the condition of each table from texts like ``ruwe < 1.4``, for all ``common`` ones, and ``TABLE: ruwe <
    1.4``; a row must meet all of a table.
    """
    by_table: dict[str, str] = {}
    for text in filter(str.strip, texts):
        table, colon, condition = text.partition(":")
        named = bool(colon) and table.strip() in tables
        for one in [table.strip()] if named else common:
            new = (condition if named else text).strip()
            by_table[one] = f"({by_table[one]}) & ({new})" if one in by_table else new
    return by_table


class _Condition:
    def __init__(self, read: Columns, text: str) -> None:
        self.read, self.text, self.used = read, text, dict[str, _Operand]()
        self.python, self.quoted = "", dict[str, str]()
        self.origin: list[int] = []  # the place in the text of each letter of what Python parses
        for piece in _PIECES.finditer(text.rstrip()):
            words = _WORDS.get(piece[0], " " if piece[0].isspace() else piece[0])
            words = words if self.python else words.lstrip()
            if piece[0][0] == "`" and len(piece[0]) > 2:
                words = f"_quoted_{len(self.quoted)}"
                self.quoted[words] = piece[0][1:-1]
            self.python += words
            self.origin += [piece.start()] * len(words)

    def rows(self, may_be_none: bool) -> Flags:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of the compiler, about what is refused below
                flags = self._flags(ast.parse(self.python, mode="eval").body)
        except SyntaxError as error:
            at = (error.offset or len(self.python) + 1) - 1  # it has no offset at the end
            raise self._refused(at, error.msg) from None
        except (ValueError, RecursionError, MemoryError, OverflowError) as error:
            raise self._refused(0, str(error)) from None
        if not flags.any() and not may_be_none:
            spans = ", ".join(f"{name} is {_span(column)}" for name, column in self.used.items())
            raise SweepError(f"where {self.text!r} keeps none of {len(self.read)} rows; {spans}", self.read.where)
        return flags

    def _refused(self, at: ast.expr | int, what: str) -> SweepError:
        if isinstance(at, ast.expr):
            at = len(self.python.encode()[: at.col_offset].decode(errors="ignore"))
        place = self.origin[at] if at < len(self.origin) else len(self.text)
        rest = self.text[place : place + 20].strip()
        shown = f"at character {place + 1}, {rest!r}" if rest else "at the end"
        return SweepError(f"where {self.text!r}: {what}, {shown}; {_ALLOWED}", self.read.where)

    def _flags(self, node: ast.expr) -> Flags:
        if isinstance(node, ast.BoolOp):
            join = np.logical_and if isinstance(node.op, ast.And) else np.logical_or
            return np.asarray(reduce(join, map(self._flags, node.values)))
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            return np.logical_not(self._flags(node.operand))
        if not isinstance(node, ast.Compare):
            one = self._operand(node)
            if one.kind == "text" or not np.all(np.isin(one.values, (0, 1)) | one.missing):
                raise self._refused(node, f"{one.kind} without a comparison")
            return np.asarray(np.ones(len(self.read), dtype=bool) & (one.values == 1) & np.logical_not(one.missing))
        flags, left = np.ones(len(self.read), dtype=bool), self._operand(node.left)
        for comparison, other in zip(node.ops, node.comparators, strict=True):
            is_in = isinstance(comparison, (ast.In, ast.NotIn))
            right, compare = self._operand(other, is_in), _COMPARISONS.get(type(comparison))
            if compare is None or (left.kind != right.kind and "text" in (left.kind, right.kind)):
                raise self._refused(other, f"{left.kind} cannot be compared with {right.kind} in this way")
            flags &= compare(left.values, right.values) & np.logical_not(left.missing | right.missing)
            left = right
        return flags

    def _operand(self, node: ast.expr, is_list: bool = False) -> _Operand:
        if isinstance(node, ast.Name) and not is_list:
            return self._column(node)
        with suppress(ValueError):  # of what is no literal, or no list of one length
            literal = np.asarray(ast.literal_eval(node))
            if literal.ndim == is_list and literal.dtype.kind in "biufU":
                return _Operand(literal)
        raise self._refused(node, f"not {'a list of numbers or of text like [1, 2]' if is_list else 'allowed'}")

    def _column(self, node: ast.Name) -> _Operand:
        asked = self.quoted.get(node.id, node.id)
        if (name := first_found([asked], self.read.names)) is None:
            raise self._refused(node, f"no column {asked!r}{suggest(asked, self.read.names)}")
        kind, column = self.read.kind(name), self.read.table[name]
        if kind not in "biufUSO":
            raise self._refused(node, f"column {name!r} holds neither numbers nor text")
        missing, values = gaps(column), np.ma.getdata(getattr(column, "value", column))
        if kind in "USO":
            values = self.read.text(name, missing="")
            missing = missing | (values == "")
        return self.used.setdefault(name, _Operand(values, missing))


def _span(column: _Operand) -> str:
    there = np.sort(column.values[~column.missing]).tolist()
    return f"{there[0]} to {there[-1]}" if there else "missing in all"
