"""Reads tables of every format, each known by its content: see `FORMATS`."""

import bz2
import fnmatch
import gzip
import io
import lzma
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from linksweep.sweep.contract import SweepError
from linksweep.sweep.tables.delimited import read_delimited, read_rows

FORMATS = (
    "FITS, VOTable, ECSV, CSV, TSV or other delimited text, Parquet, MRT, or a CDS table with its ReadMe beside it"
)
"""The formats of a table, each known by its content; text and XML may be packed with gzip, bzip2 or xz."""

READMES = ("ReadMe", "README", "readme", "ReadMe.txt", "README.txt", "readme.txt")

_PACKED = {b"\x1f\x8b": gzip.decompress, b"BZh": bz2.decompress, b"\xfd7zXZ": lzma.decompress}
_DESCRIBED = re.compile(r"^\s*Byte-(?:by|per)-byte Description of file\s*:\s*(.+?)\s*$", re.IGNORECASE | re.MULTILINE)
_IN_PARTS = {"RAdeg": ("", "RAh", "RAm", "RAs", 15.0), "DEdeg": ("DE-", "DEd", "DEm", "DEs", 1.0)}
_ICRF = re.compile(
    r"ICRF (?P<icrf_name>J[0-9.]+[+-][0-9]+)\s+(?P<iers_name>\S+)\s+(?:[A-Z]\s+)?(?P<ra>\d+ \d+ [\d.]+)\s+"
    r"(?P<dec>[+-]?\s*\d+ \d+ [\d.]+)\s+(?P<ra_error>[\d.]+)\s+(?P<dec_error>[\d.]+)\s+(?P<ra_dec_corr>[+-]?[\d.]+)\s"
)


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
            _add_degrees(table)
        return table
    except OSError as error:
        if not path.exists():
            raise SweepError("no such file", str(path)) from error
        raise SweepError(f"cannot be read: {error.strerror or error}", str(path)) from error
    except SweepError as error:
        raise SweepError(error.problems, str(path)) from error
    except ValueError as error:  # of delimited text
        raise SweepError(str(error), str(path)) from error


@contextmanager
def _readable_as(form: str) -> Iterator[None]:
    """Raise SweepError for any error: each reader of a library raises others for damaged files."""
    try:
        yield
    except SweepError:
        raise
    except Exception as error:
        said = " ".join(str(error).split())[:300]
        raise SweepError(f"cannot be read {form}: {type(error).__name__}: {said}") from error


def _by_astropy(form: str, source: Any, **options: Any) -> Any:
    from astropy.table import Table

    with _readable_as(f"as {form}"):
        return Table.read(source, format=form, **options)


def _read(path: Path, content: bytes) -> Any:
    packed = next((unpack for mark, unpack in _PACKED.items() if content.startswith(mark)), None)
    if packed is not None:
        try:
            content = packed(content)
        except (EOFError, ValueError, OSError, lzma.LZMAError) as error:
            raise SweepError(f"is compressed, but incomplete: {error}") from error
    start = content[:4096].removeprefix(b"\xef\xbb\xbf").lstrip()
    if start.startswith(b"SIMPLE  ="):
        return _fits(content, io.BytesIO(content) if packed else path)
    for mark, read in ((b"PK\3\4", _zip), (b"PAR1", _whole_parquet), (b"<", _votable), (b"# %ECSV", _ecsv)):
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
    if re.search(r"^ICRF J", text[:20_000], re.MULTILINE):
        return _icrf(text)
    if (readme := readme_of(path)) is not None:
        return _cds(path, text, readme)
    return read_delimited(content)


def _zip(content: bytes) -> Any:
    raise SweepError("is a zip archive (or a spreadsheet): unpack or export the table in it")


def _require_one(tables: Sequence[str]) -> None:
    if len(tables) > 1:
        raise SweepError(f"has {len(tables)} tables in it: {', '.join(tables)}; leave one")


def _fits(content: bytes, source: Any) -> Any:
    from astropy.io import fits

    with _readable_as("as fits"), fits.open(io.BytesIO(content)) as units:
        kinds = (fits.BinTableHDU, fits.TableHDU)
        _require_one([f"{unit.name or 'HDU'} ({k})" for k, unit in enumerate(units) if type(unit) in kinds])
    return _by_astropy("fits", source)


def _votable(content: bytes) -> Any:
    from astropy.io.votable import parse

    head = content[:4096].lower()
    if b"<html" in head or b"<!doctype html" in head:
        raise SweepError("is a web page, not a table")
    with _readable_as("as a VOTable"):
        document = parse(io.BytesIO(content), verify="ignore")
        tables = [table for table in document.iter_tables() if len(table.fields)]
    if not tables:
        infos = [info for resource in document.resources for info in resource.infos if info.name == "QUERY_STATUS"]
        said = "".join(f": {info.value}: {' '.join((info.content or '').split())[:200]}" for info in infos)
        raise SweepError(f"has no table in it{said}")
    _require_one([f"{table.name or table.ID or 'table'} ({k})" for k, table in enumerate(tables, 1)])
    return tables[0].to_table(use_names_over_ids=True)


def _ecsv(content: bytes) -> Any:
    """Read the header with astropy and the rows with pandas, which takes a twentieth of the time."""
    content, end = content.removeprefix(b"\xef\xbb\xbf"), 0
    while content[end : end + 1] == b"#":
        end = content.find(b"\n", end) + 1 or len(content)
    names_end = content.find(b"\n", end) + 1 or len(content)
    table = _by_astropy("ascii.ecsv", content[:names_end].decode("utf-8", "replace").rstrip() + "\n")
    plain = "__serialized_columns__" not in table.meta and all(
        type(column).__name__ == "Column" and column.ndim == 1 and column.dtype.kind in "fiubU"
        for column in table.columns.values()
    )
    delimiter = "," if re.search(rb"^# delimiter: *','", content[:end], re.MULTILINE) else " "
    if not plain or (delimiter == " " and b'"' in content[names_end:]):
        gaps = {"fill_values": [("", "0"), ("null", "0")]} if plain else {}
        return _by_astropy("ascii.ecsv", content.decode("utf-8", "replace"), **gaps)
    try:
        rows = read_rows(
            content[names_end:], table.colnames, delimiter, [column.dtype for column in table.columns.values()]
        )
    except ValueError as error:
        raise SweepError(f"cannot be read as ECSV: {error}") from error
    for name, column in table.columns.items():
        for attribute in ("unit", "description", "format"):
            setattr(rows[name], attribute, getattr(column, attribute))
    rows.meta = table.meta
    return rows


def _icrf(text: str) -> Any:
    """Return the positions in a text of the ICRF (ICRF2, ICRF3), whose errors of ra are in seconds of time."""
    from astropy.table import Table

    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.startswith("ICRF J")]
    rows = [_ICRF.match(line) for _, line in lines]
    if bad := [str(k) for (k, _), row in zip(lines, rows, strict=True) if row is None]:
        raise SweepError(f"no ICRF entry in line {', '.join(bad[:5])}")
    columns = {name: [row[name] for row in rows if row] for name in ("iers_name", "icrf_name", "ra", "dec")}
    table = Table(columns | {"dec": [dec.replace(" ", "", dec[1:2].count(" ")) for dec in columns["dec"]]})
    for name, unit in (("ra_error", "s"), ("dec_error", "arcsec"), ("ra_dec_corr", None)):
        table[name] = [float(row[name]) for row in rows if row]
        table[name].unit = unit
    table.meta["extragalactic"] = True
    return table


# ---- CDS: a ReadMe beside the table describes it byte by byte


def readme_of(path: Path) -> Path | None:
    """Return the ReadMe beside a table that it describes, or should as the table ends in .dat; None otherwise."""
    readme = next((found for name in READMES if (found := path.parent / name).is_file()), None)
    if readme is None or not (_unpacked(path).lower().endswith(".dat") or _is_in(_described(readme), path)):
        return None
    return readme


def _described(readme: Path) -> list[str]:
    text = readme.read_text(encoding="utf-8", errors="replace")
    return [name for match in _DESCRIBED.findall(text) for name in re.split("[, ]+", match) if name]


def _is_in(described: Sequence[str], path: Path) -> bool:
    return any(fnmatch.fnmatch(_unpacked(path), name) for name in described)


def _unpacked(path: Path) -> str:
    return re.sub(r"\.(gz|bz2|xz)$", "", path.name, flags=re.IGNORECASE)


def _cds(path: Path, text: str, readme: Path) -> Any:
    from astropy.io.ascii import Cds

    described = _described(readme)
    if not described:
        raise SweepError(
            f"the {readme.name} beside it describes no table byte by byte, so it is not that of a CDS table"
        )
    if not _is_in(described, path):
        raise SweepError(f"the {readme.name} beside it describes {', '.join(described)}, not {_unpacked(path)}")
    reader = Cds(readme=str(readme))
    reader.guessing = False
    with _readable_as(f"with the {readme.name} beside it"):
        reader.data.table_name = reader.inputter.table_name = _unpacked(path)  # which of the tables in the ReadMe
        return reader.read([line for line in text.splitlines() if line.strip()])


def _add_degrees(table: Any) -> None:
    """Add RAdeg and DEdeg to a table that has hours, minutes and seconds in columns of their own."""
    from astropy.table import MaskedColumn

    for name, (sign, *parts, factor) in _IN_PARTS.items():
        if name in table.colnames or not {*parts, sign or parts[0]} <= set(table.colnames):
            continue
        columns = [np.ma.asarray(table[part]) for part in parts]
        if any(column.dtype.kind not in "iuf" for column in columns):
            continue
        first, minutes, seconds = (column.astype(np.float64) for column in columns)
        values = factor * (first + minutes / 60.0 + seconds / 3600.0)
        if sign:
            negative = [str(text).strip() == "-" for text in np.ma.filled(np.ma.asarray(table[sign]), "+")]
            values = values * np.where(negative, -1.0, 1.0)
        table[name] = MaskedColumn(np.ma.getdata(values), mask=np.ma.getmaskarray(values), unit="deg")


# ---- Parquet: whole, or one row group at a time


def is_parquet(path: Path) -> bool:
    """Return whether a file is a Parquet table, by its content."""
    with path.open("rb") as file:
        return file.read(4) == b"PAR1"


def row_groups(path: Path) -> tuple[list[int], list[str]]:
    """Return the number of rows of each row group of a Parquet file, and the names of its columns."""
    with path.open("rb") as source, _parquet(source) as (file, _):
        sizes = [file.metadata.row_group(group).num_rows for group in range(file.num_row_groups)]
        return sizes, list(file.schema_arrow.names)


def read_row_group(path: Path, group: int, columns: Sequence[str]) -> Any:
    """Return some columns of one row group as an astropy Table; the rest of the file is not read."""
    with path.open("rb") as source, _parquet(source) as (file, units):
        return _from_arrow(file.read_row_group(group, columns=list(columns), use_threads=False), units)


def _whole_parquet(content: bytes) -> Any:
    with _parquet(io.BytesIO(content)) as (file, units):
        return _from_arrow(file.read(), units)


@contextmanager
def _parquet(source: Any) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Give an open Parquet file and the units that astropy wrote into it; errors while it is read are SweepErrors."""
    try:
        from pyarrow.parquet import ParquetFile
    except ImportError as error:
        raise SweepError("is a Parquet file, which needs pyarrow: install linksweep[parquet]") from error
    with _readable_as("as Parquet"):
        file = ParquetFile(source)
        units = {}
        if b"table_meta_yaml" in (file.schema_arrow.metadata or {}):
            from astropy.table import Table

            source.seek(0)
            described = Table.read(source, format="parquet", schema_only=True).columns
            units = {name: column.unit for name, column in described.items()}
        yield file, units


def _from_arrow(arrow: Any, units: dict[str, Any]) -> Any:
    import pyarrow as pa
    from astropy.table import MaskedColumn, Table

    table, kind = Table(), pa.types
    for name, field in zip(arrow.column_names, arrow.schema, strict=True):
        column, missing = arrow[name], arrow[name].is_null().to_numpy()
        if kind.is_decimal(field.type):
            column = column.cast(pa.float64())
        if kind.is_dictionary(field.type):
            column = column.cast(field.type.value_type)
        if kind.is_integer(column.type) or kind.is_floating(column.type) or kind.is_boolean(column.type):
            values = column.fill_null(False if kind.is_boolean(column.type) else 0).to_numpy()
        elif kind.is_string(column.type) or kind.is_large_string(column.type):
            values = np.array(["" if text is None else text for text in column.to_pylist()], dtype=np.str_)
        else:
            values = np.empty(len(column), dtype=object)
            values[:] = column.to_pylist()
        unit = (field.metadata or {}).get(b"unit", b"").decode() or units.get(name) or None
        table[name] = MaskedColumn(values, mask=missing if missing.any() else False, unit=unit)
    return table
