"""Rows of delimited text as columns of numbers, truth values and texts, with gaps where something is missing."""

import csv
import io
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_NONE = ("null", "NULL", "None", "none", "NaN", "nan", "NAN", "N/A", "n/a", "NA", "<NA>")
MISSING = ("", *_NONE, "--", "---", "...", "\\N")


def read_rows(body: bytes, names: Sequence[str], delimiter: str, dtypes: Sequence[str] | None = None) -> Any:
    """Return rows of text as an astropy Table with these columns, of the given types or of types that fit the text.

    Raises ValueError for a row with more or fewer columns, or with what is not of its type.
    """
    import pandas as pd
    from astropy.table import Column, MaskedColumn, Table

    if body.startswith(b"#") or b"\n#" in body:
        body = b"\n".join(line for line in body.split(b"\n") if not line.startswith(b"#"))
    options: dict[str, Any] = {
        "sep": r"\s+" if delimiter == " " else delimiter,
        "header": None,
        "names": list(range(len(names))),
        "index_col": False,
        "skipinitialspace": True,
        "na_values": list(MISSING),
        "keep_default_na": False,
        "float_precision": "round_trip",
        "decimal": "," if delimiter in (";", "\t") and _has_decimal_commas(body, delimiter) else ".",
        "low_memory": False,
    }
    kinds = dict(enumerate(dtypes)) if dtypes else {}
    types = {k: _nullable(kind) for k, kind in kinds.items()}
    try:
        _check_widths(body, len(names), delimiter)
        frame = pd.read_csv(io.BytesIO(body), dtype=types or None, **options)
        rounded = [k for k in frame.columns if not kinds and _rounded(frame[k])]
        whole = pd.read_csv(io.BytesIO(body), dtype="Int64", usecols=rounded, **options) if rounded else frame
    except pd.errors.EmptyDataError:
        frame, whole, rounded = pd.DataFrame({k: [] for k in range(len(names))}), None, []
    except (pd.errors.ParserError, OverflowError) as error:
        raise ValueError(" ".join(str(error).split())) from error
    columns = []
    for k, name in enumerate(names):
        column = (whole if k in rounded else frame)[k]
        missing = column.isna().to_numpy(dtype=bool)
        values = _plain(column, missing, kinds.get(k))
        columns.append(MaskedColumn(values, name, mask=missing) if missing.any() else Column(values, name))
    return Table(columns, copy=False)


def fields_of(line: str, delimiter: str) -> list[str]:
    """Return the fields of one line without the blanks around them."""
    if delimiter == " ":
        return line.split()
    return [field.strip() for field in next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter), [])]


def _has_decimal_commas(body: bytes, delimiter: str) -> bool:
    first = body[:4096].split(b"\n")[0].decode("utf-8", "replace")
    return any(re.fullmatch(r"[+-]?\d+,\d+", field) for field in fields_of(first, delimiter))


def _check_widths(body: bytes, n_columns: int, delimiter: str) -> None:
    """Raise ValueError for the first row that has another number of columns than there are names."""
    if delimiter == " ":
        counts = (len(line.split()) for line in body.split(b"\n") if line.strip())
    elif b'"' in body:
        counts = (len(row) for row in csv.reader(io.StringIO(body.decode("utf-8")), delimiter=delimiter) if row)
    else:
        mark = delimiter.encode()
        counts = (line.count(mark) + 1 for line in body.split(b"\n") if line and not line.isspace())
    for row, count in enumerate(counts, start=1):
        if count != n_columns:
            raise ValueError(f"row {row} has {count} columns, not {n_columns} as the line of names")


def _rounded(column: Any) -> bool:
    """Return whether integers with gaps have become floats that cannot hold them, such as Gaia's source_id."""
    if column.dtype.kind != "f":
        return False
    values = column.to_numpy()
    values = values[~np.isnan(values)]
    return len(values) < len(column) and bool(np.any(np.abs(values) >= 2.0**53)) and bool(np.all(values % 1.0 == 0.0))


def _nullable(kind: str) -> str:
    """Return the name of the pandas type that stands for a NumPy type and allows missing values."""
    dtype = np.dtype("U" if kind in ("string", "str") else kind)
    if dtype.kind in "iu":
        return dtype.name.replace("u", "U").replace("int", "Int")
    return {"b": "boolean", "f": dtype.name}.get(dtype.kind, "str")


def _plain(column: Any, missing: NDArray[np.bool_], kind: str | None) -> NDArray[Any]:
    """Return the values of a column, with any value where they are missing."""
    if column.dtype.kind == "f" and str(column.dtype).islower():
        return np.asarray(column.to_numpy())
    if column.dtype.kind in "iub":
        filled = column.fillna(0) if missing.any() else column
        return np.asarray(
            filled.to_numpy(dtype=np.dtype(kind) if kind else str(column.dtype).lower().replace("boolean", "bool"))
        )
    if len(column) and missing.all() and kind is None:
        return np.full(len(column), np.nan)
    return np.array([str(value) for value in column.where(~missing, "")], dtype=np.str_)
