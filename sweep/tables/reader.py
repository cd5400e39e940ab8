"""Reads tables: FITS, VOTable, ECSV, delimited text, Parquet, and CDS tables with their ReadMe."""

import bz2
import gzip
import io
import lzma
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from linksweep.sweep.contract import SweepError
from linksweep.sweep.tables.cds import add_degrees, read_with_readme, readme_of
from linksweep.sweep.tables.delimited import read_delimited
from linksweep.sweep.tables.parquet import parquet_table
from linksweep.sweep.tables.rows import read_rows

FORMATS = (
    "FITS, VOTable, ECSV, CSV, TSV or other delimited text, Parquet, MRT, or a CDS table with its ReadMe beside it"
)
"""The formats of a table, each known by its content; text and XML may be packed with gzip, bzip2 or xz."""

_PACKED = {b"\x1f\x8b": gzip.decompress, b"BZh": bz2.decompress, b"\xfd7zXZ": lzma.decompress}


def read_table(path: Path) -> Any:
    """Return the table in a file as an astropy Table, its columns with units where the file gives them.

    Missing values are masked, or NaN.  The format follows from the content, not from the name.  RAdeg and DEdeg (deg)
    are added to a table with the columns RAh, RAm, RAs and DE-, DEd, DEm, DEs of CDS.  Raises SweepError that names
    the file, and the row where there is one, for what cannot be read.
    """
    try:
        content = path.read_bytes()
        with warnings.catch_warnings():  # about units and headers that do not matter for the columns that are used
            warnings.simplefilter("ignore")
            table = _read(path, content)
            add_degrees(table)
        return table
    except OSError as error:
        if not path.exists():
            raise SweepError("no such file", str(path)) from error
        raise SweepError(f"cannot be read: {error.strerror or error}", str(path)) from error
    except SweepError as error:
        raise SweepError(error.problems, str(path)) from error


def _read(path: Path, content: bytes) -> Any:
    packed = next((unpack for mark, unpack in _PACKED.items() if content.startswith(mark)), None)
    if packed is not None:
        try:
            content = packed(content)
        except (EOFError, ValueError, OSError, lzma.LZMAError) as error:
            raise SweepError(f"is compressed, but incomplete: {error}") from error
    start = content[:4096].removeprefix(b"\xef\xbb\xbf").lstrip()
    if start.startswith(b"SIMPLE  ="):
        _require_one_table(content)
        return _by_astropy("fits", io.BytesIO(content) if packed else path)
    if start.startswith(b"PK\3\4"):
        raise SweepError("is a zip archive (or a spreadsheet): unpack or export the table in it")
    for mark, read in ((b"PAR1", parquet_table), (b"<", _votable), (b"# %ECSV", _ecsv)):
        if start.startswith(mark):
            return read(content)
    return _text(path, content)


def _text(path: Path, content: bytes) -> Any:
    text = content.decode("utf-8", "replace")
    if not text.strip():
        raise SweepError("has no rows")
    if text.startswith("\\"):
        return _by_astropy("ascii.ipac", text)
    if "byte-by-byte description" in text[:100_000].lower():
        return _by_astropy("ascii.mrt", text.splitlines())
    if (readme := readme_of(path)) is not None:
        return read_with_readme(path, text, readme)
    try:
        return read_delimited(content)
    except ValueError as error:
        raise SweepError(str(error)) from error


def _by_astropy(form: str, source: Any, **options: Any) -> Any:
    from astropy.table import Table

    try:
        return Table.read(source, format=form, **options)
    except Exception as error:  # each of astropy's readers raises errors of its own
        text = " ".join(str(error).split())[:300]
        raise SweepError(f"cannot be read as {form}: {type(error).__name__}: {text}") from error


def _require_one_table(content: bytes) -> None:
    """Raise SweepError for a FITS file with several tables, of which astropy reads the first."""
    from astropy.io import fits

    kinds = (fits.BinTableHDU, fits.TableHDU)
    try:
        with fits.open(io.BytesIO(content)) as units:
            tables = [f"{unit.name or 'HDU'} ({k})" for k, unit in enumerate(units) if type(unit) in kinds]
    except Exception:  # astropy's reader of tables says what is wrong
        return
    _require_one(tables)


def _require_one(tables: Sequence[str]) -> None:
    if len(tables) > 1:
        raise SweepError(f"has {len(tables)} tables in it: {', '.join(tables)}; leave one")


def _votable(content: bytes) -> Any:
    from astropy.io.votable import parse

    head = content[:4096].lower()
    if b"<html" in head or b"<!doctype html" in head:
        raise SweepError("is a web page, not a table")
    try:
        document = parse(io.BytesIO(content), verify="ignore")
        tables = [table for table in document.iter_tables() if len(table.fields)]
    except Exception as error:  # from the parsers of XML, base64 or VOTable
        raise SweepError(f"cannot be read as a VOTable: {' '.join(str(error).split())[:300]}") from error
    if not tables:
        infos = [info for resource in document.resources for info in resource.infos if info.name == "QUERY_STATUS"]
        said = "".join(f": {info.value}: {' '.join((info.content or '').split())[:200]}" for info in infos)
        raise SweepError(f"has no table in it{said}")
    _require_one([f"{table.name or table.ID or 'table'} ({k})" for k, table in enumerate(tables, 1)])
    return tables[0].to_table(use_names_over_ids=True)


def _ecsv(content: bytes) -> Any:
    """Read the header with astropy and the rows with pandas, which takes a twentieth of the time."""
    text = content.removeprefix(b"\xef\xbb\xbf")
    end = 0
    while text[end : end + 1] == b"#":
        end = text.find(b"\n", end) + 1 or len(text)
    names_end = text.find(b"\n", end) + 1 or len(text)
    table = _by_astropy("ascii.ecsv", text[:names_end].decode("utf-8", "replace").rstrip() + "\n")
    plain = "__serialized_columns__" not in table.meta and all(
        type(column).__name__ == "Column" and column.ndim == 1 and column.dtype.kind in "fiubU"
        for column in table.columns.values()
    )
    if not plain:
        return _by_astropy("ascii.ecsv", text.decode("utf-8", "replace"))
    delimiter = "," if re.search(rb"^# delimiter: *','", text[:end], re.MULTILINE) else " "
    if delimiter == " " and b'"' in text[names_end:]:
        return _by_astropy("ascii.ecsv", text.decode("utf-8", "replace"), fill_values=[("", "0"), ("null", "0")])
    kinds = [str(column.dtype) if column.dtype.kind != "U" else "str" for column in table.columns.values()]
    try:
        rows = read_rows(text[names_end:], table.colnames, delimiter, kinds)
    except ValueError as error:
        raise SweepError(f"cannot be read as ECSV: {error}") from error
    for name, column in table.columns.items():
        for attribute in ("unit", "description", "format"):
            setattr(rows[name], attribute, getattr(column, attribute))
    rows.meta = table.meta
    return rows
