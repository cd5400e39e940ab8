"""Tables of delimited text (CSV, TSV as VizieR sends it, `;` or blanks): names and units above, then rows with gaps."""

import csv
import io
import re
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np

DELIMITERS = ("\t", ";", "|", ",")
MISSING = (
    *("", "null", "NULL", "None", "none", "NaN", "nan", "NAN", "N/A", "n/a", "NA", "<NA>"),
    *("--", "---", "...", "\\N"),
)
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
    if b"\0" in content[:4096]:
        raise ValueError("is neither a table format that is known nor text")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    content = text.replace("\r\n", "\n").replace("\r", "\n").encode()
    names, units, delimiter, start = _layout(content)
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"two columns are called {', '.join(map(repr, twice))}")
    table = read_rows(content[start:], names, delimiter)
    for name, unit in zip(names, units, strict=True):
        if unit:
            table[name].unit = _unit(unit)
    return table


def read_rows(body: bytes, names: Sequence[str], delimiter: str, dtypes: Sequence[Any] | None = None) -> Any:
    """Return rows of text as an astropy Table with these columns, of the given types or of types that fit the text.

    Raises ValueError for a row with more or fewer columns, or with what is not of its type.
    """
    import pandas as pd
    from astropy.table import Column, MaskedColumn, Table

    if body.startswith(b"#") or b"\n#" in body:
        body = b"\n".join(line for line in body.split(b"\n") if not line.startswith(b"#"))
    decimal_commas = delimiter in (";", "\t") and any(
        re.fullmatch(r"[+-]?\d+,\d+", field) for field in _fields(body[:4096].split(b"\n")[0].decode(), delimiter)
    )
    _check_widths(body, len(names), delimiter)
    try:
        frame = pd.read_csv(
            io.BytesIO(body),
            sep=r"\s+" if delimiter == " " else delimiter,
            header=None,
            names=list(range(len(names))),
            index_col=False,
            skipinitialspace=True,
            na_values=list(MISSING),
            keep_default_na=False,
            float_precision="round_trip",
            decimal="," if decimal_commas else ".",
            low_memory=False,
            dtype=None if dtypes is None else dict(enumerate(map(_nullable, dtypes))),
            dtype_backend="numpy_nullable",  # integers beside gaps keep all digits, such as those of Gaia's source_id
        )
    except pd.errors.EmptyDataError:
        frame = pd.DataFrame({k: pd.array([], dtype="Float64") for k in range(len(names))})
    except (pd.errors.ParserError, OverflowError) as error:
        raise ValueError(" ".join(str(error).split())) from error
    columns = []
    for k, name in enumerate(names):
        missing = frame[k].isna().to_numpy(dtype=bool)
        kind = np.dtype(dtypes[k] if dtypes else getattr(frame[k].dtype, "numpy_dtype", "U"))
        if kind.kind in "fiub":
            values: Any = frame[k].to_numpy(dtype=kind, na_value=np.nan if kind.kind == "f" else 0)
        else:
            values = np.array(frame[k].fillna("").astype(str).tolist(), dtype=np.str_)
        if dtypes is None and len(values) and missing.all():
            values = np.full(len(values), np.nan)
        columns.append(MaskedColumn(values, name, mask=missing) if missing.any() else Column(values, name))
    return Table(columns, copy=False)


def _nullable(dtype: Any) -> str:
    """Return the name of the pandas type that stands for a NumPy type and allows missing values."""
    name = np.dtype(dtype).name
    return {"bool": "boolean"}.get(name, "string" if name.startswith("str") else name.replace("u", "U").capitalize())


def _check_widths(body: bytes, n_columns: int, delimiter: str) -> None:
    """Raise ValueError for the first row that has another number of columns than there are names."""
    if delimiter == " ":
        counts = (len(line.split()) for line in body.split(b"\n") if line.strip())
    elif b'"' in body:
        counts = (len(row) for row in csv.reader(io.StringIO(body.decode()), delimiter=delimiter) if row)
    else:
        mark = delimiter.encode()
        counts = (line.count(mark) + 1 for line in body.split(b"\n") if line and not line.isspace())
    for row, count in enumerate(counts, start=1):
        if count != n_columns:  # pandas would fill a short row with gaps
            raise ValueError(f"row {row} has {count} columns, not {n_columns} as the line of names")


def _fields(line: str, delimiter: str) -> list[str]:
    """Return the fields of one line without the blanks around them."""
    if delimiter == " ":
        return line.split()
    return [field.strip() for field in next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter), [])]


def _layout(content: bytes) -> tuple[list[str], list[str], str, int]:
    """Return names and units of the columns, their delimiter, and the byte at which the first row begins."""
    lines = _lines(content)
    last_comment, header, start, end = "", "", 0, 0
    for line, after in lines:
        start, end = end, after
        if line.startswith("#"):
            last_comment = line.lstrip("#")
        elif line.strip():
            header = line
            break
    if not header.strip():
        raise ValueError("has no rows")
    unquoted = re.sub(r'"[^"]*"', "", header)
    best = max(DELIMITERS, key=unquoted.count)
    delimiter = best if best in unquoted else " "
    names = _fields(header, delimiter)
    if any(map(_NUMBER.fullmatch, names)):  # this line is a row already
        commented = next((f for d in (delimiter, " ") if len(f := _fields(last_comment, d)) == len(names)), None)
        if commented is None or any(map(_NUMBER.fullmatch, commented)):
            raise ValueError(
                f"its first line, {header.strip()[:60]!r}, is not one of column names (a table of CDS needs its ReadMe "
                "beside it)"
            )
        return commented, [_bracketed(name) for name in commented], delimiter, start
    units, start = _units_and_rules(lines, end, delimiter, len(names))
    names = [name or f"column {k}" for k, name in enumerate(names, start=1)]
    return names, units or [_bracketed(name) for name in names], delimiter, start


def _lines(content: bytes) -> Iterator[tuple[str, int]]:
    """Yield the first lines of a text, and where each ends."""
    end = 0
    for line in islice(io.BytesIO(content), PREFACE_LINES):
        end += len(line)
        yield line.decode(), end


def _units_and_rules(
    lines: Iterator[tuple[str, int]], start: int, delimiter: str, n_columns: int
) -> tuple[list[str] | None, int]:
    """Return the units in the lines after the names, if there are any, and the byte at which the first row begins."""
    units, above = None, None
    for line, end in lines:
        fields = _fields(line.lstrip("#"), delimiter)
        commented = line.startswith("#")
        if not line.strip() or (not commented and all(map(_RULE.fullmatch, line.split()))):
            if line.strip() and above:
                units = above  # VizieR has them above the line of dashes
            start = end
        elif units is None and len(fields) == n_columns and _are_units(fields):
            units, start = fields, end
        elif commented:
            start = end
        elif above or len(fields) != n_columns or any(map(_NUMBER.fullmatch, fields)):
            break
        else:
            above = fields
    return units, start


def _are_units(fields: Sequence[str]) -> bool:
    stated = [field for field in fields if field.strip("-")]
    return bool(stated) and all(_unit(field, "raise") is not None for field in stated)


def _bracketed(name: str) -> str:
    """Return the unit in a name like 'ra [deg]', '' if there is none."""
    match = _BRACKETS.fullmatch(name)
    return match[1] if match and _unit(match[1], "raise") is not None else ""


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
