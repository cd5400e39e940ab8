"""Reads tables, each known by its content: FITS, VOTable, ECSV, CSV, TSV or other delimited text, Parquet, MRT, or a
table of CDS with its ReadMe beside it, text and XML also packed with gzip, bzip2 or xz; and writes them.
"""

import bz2
import csv
import fnmatch
import gzip
import io
import json
import lzma
import re
import warnings
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from linksweep.sweep.contract import SweepError, needed, refused

READMES = ("ReadMe", "README", "readme", "ReadMe.txt", "README.txt", "readme.txt")

_PACKED = {b"\x1f\x8b": gzip.decompress, b"BZh": bz2.decompress, b"\xfd7zXZ": lzma.decompress}
_DESCRIBED = re.compile(r"^\s*Byte-(?:by|per)-byte Description of file\s*:\s*(.+?)\s*$", re.IGNORECASE | re.MULTILINE)
_IN_PARTS = {"RAdeg": ("", "RAh", "RAm", "RAs", 15.0), "DEdeg": ("DE-", "DEd", "DEm", "DEs", 1.0)}
_ICRF = re.compile(
    r"ICRF (?P<icrf_name>J[0-9.]+[+-][0-9]+)\s+(?P<iers_name>\S+)\s+(?:[A-Z]\s+)?(?P<ra>\d+ \d+ [\d.]+)\s+"
    r"(?P<dec>[+-]?\s*\d+ \d+ [\d.]+)\s+(?P<ra_error>[\d.]+)\s+(?P<dec_error>[\d.]+)\s+(?P<ra_dec_corr>[+-]?[\d.]+)\s"
)


# A row of Hipparcos-2, hip2.dat of CDS I/311, and where the columns begin and end that astrometry needs.
_HIP2 = re.compile(r"(?=.{270})[ \d]{5}\d +\d+ \d \d +\d\.\d{10} [ -]\d\.\d{10} ")
_HIP2_COLUMNS = {
    **{"HIP": (0, 6), "RArad": (15, 28), "DErad": (29, 42), "Plx": (43, 50), "pmRA": (51, 59), "pmDE": (60, 68)},
    **{"e_RArad": (69, 75), "e_DErad": (76, 82), "e_Plx": (83, 89), "e_pmRA": (90, 96), "e_pmDE": (97, 103)},
    **{"Hpmag": (129, 136)} | {f"UW{k}": (164 + 7 * k, 171 + 7 * k) for k in range(1, 16)},
}

DELIMITERS = ("\t", ";", "|", ",")
MISSING = (
    *("", "null", "NULL", "None", "none", "NaN", "nan", "NAN", "N/A", "n/a", "NA", "<NA>"),
    *("--", "---", "...", "\\N"),
)
# The most lines that comments, names, units and rules take.
PREFACE_LINES = 100_000
# The lines below a line of units by which it is told from a row of names.
LINES_BELOW = 1_000

_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eEdD][+-]?\d+)?")
# Of dashes, but a row may be a sign.
_RULE = re.compile(r"(?=.*[-=]{2})[-=+\s]+")
# A number, an angle, a limit such as <0.5, or a mark, but no name or word.
_VALUE = re.compile(r"(\W|\d|_|(?<=[\d.])[eEdDhms]|inf)+")
_WRAPPED = re.compile(r"[\w ]*\[(.*)\]\Z|\A\((.*)\)\Z")  # like [deg], (deg), or Angle[deg] in Gaia's first releases
_CLOCK = re.compile(r'"?([hd])\1?([: ]?)mm?\2ss?"?')  # of text like 12 34 56.7: "h:m:s" at VizieR, or hh:mm:ss
_NO_UNIT = re.compile(r"-*|J\d{4}(\.\d+)?|ICR[SF]\d?")  # the frame or epoch of positions
# Name and description of a column in VizieR's TSV.
_MEANINGS = re.compile(r"^#Column\t(\S+)\t\S+\t([^\t\n]*)", re.MULTILINE)
# How tables spell units out; dates are numbers of days.
_WORDS = {"degrees": "deg", "hours": "h", "radians": "rad", "MJD": "d", "years": "yr"}
# A name between blanks that may have a unit behind it, or stand in quotes.
_SPACED = re.compile(r'"[^"]+"|\S+(?:\s+[\[(][^\])]*[\])])?')
# A name and the unit behind it, in which there may be brackets, as in erg / (s cm2).
BRACKETS = re.compile(r"(.*?)\s*[\[(]((?:[^\[\]()]|\([^()]*\))*)[\])]$")


def read_table(path: Path, texts: Collection[str] = ()) -> Any:
    """Return the table in a file as an astropy Table, its columns with units where the file gives them.

    Missing values are masked, or NaN.  The format follows from the content, not from the name.  RAdeg and DEdeg (deg)
    are added to a table with the columns RAh, RAm, RAs and DE-, DEd, DEm, DEs of CDS.  Columns of delimited text that
    ``texts`` names are texts as they are written, missing where there is none.  Raises SweepError that names the file,
    and the row where there is one, for what cannot be read.
    """
    # a ValueError is of delimited text
    with refused(SweepError, ValueError, where=path), refused(OSError, MemoryError, said="cannot be read: "):
        if path.is_char_device() or not path.exists():  # a device may have no end
            raise SweepError("is a device" if path.exists() else "no such file")
        content = path.read_bytes()
        # about units and headers that do not matter for the columns that are used
        with warnings.catch_warnings(action="ignore"):
            table = _read(path, content, texts)
            for column in table.columns.values():  # each of astropy's readers knows one way to write units
                if str(unit := getattr(column, "unit", None) or "") and not has_unit(column):
                    column.unit = _unit(str(unit))
            _add_degrees(table)
        if not len(table):
            raise SweepError("has no rows")
        return table


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


def _read(path: Path, content: bytes, texts: Collection[str]) -> Any:
    packed = next((unpack for mark, unpack in _PACKED.items() if content.startswith(mark)), None)
    if packed is not None:
        with refused(EOFError, ValueError, OSError, lzma.LZMAError, said="is compressed, but incomplete: "):
            content = packed(content)
    content = content.removeprefix(b"\xef\xbb\xbf")
    start = content[:4096].lstrip().lower()
    if start.startswith(b"simple  ="):
        return _fits(content)
    if start.startswith(b"par1"):
        with _parquet(io.BytesIO(content)) as file:
            return _from_arrow(file.read())
    if b"<html" in start or b"<!doctype html" in start:
        raise SweepError("is a web page, not a table")
    if start.startswith(b"<"):
        return _votable(content)
    if start.startswith(b"# %ecsv"):
        return _ecsv(content)
    return _text(path, content, texts)


def _text(path: Path, content: bytes, texts: Collection[str]) -> Any:
    if b"\0" in content[:4096]:
        raise SweepError("is neither a table format that is known nor text")
    try:
        text = content.decode()
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    if "byte-by-byte description" in text[:100_000].lower():
        return _by_astropy("ascii.mrt", text.splitlines())
    if re.search(r"^ICRF J", text[:20_000], re.MULTILINE):
        return _icrf(text)
    if _HIP2.match(text):  # astropy cannot read the fifteen numbers that are one column in its ReadMe
        return _hipparcos(text)
    readme = readme_of(path)
    return _delimited(text, texts) if readme is None else _cds(path, text, readme)


def _require_one(tables: Sequence[str]) -> None:
    if len(tables) > 1:
        raise SweepError(f"has {len(tables)} tables in it: {', '.join(tables)}; leave one")


def _fits(content: bytes) -> Any:
    from astropy.io import fits

    with _readable_as("as fits"), fits.open(io.BytesIO(content)) as units:
        kinds = (fits.BinTableHDU, fits.TableHDU)
        _require_one([f"{unit.name or 'HDU'} ({k})" for k, unit in enumerate(units) if type(unit) in kinds])
    return _by_astropy("fits", io.BytesIO(content), astropy_native=True)  # with columns of times


def _votable(content: bytes) -> Any:
    from astropy.io.votable import parse

    with _readable_as("as a VOTable"):
        document = parse(io.BytesIO(content), verify="ignore")
        tables = [table for table in document.iter_tables() if len(table.fields)]
    if not tables:
        raise SweepError("has no table in it")
    _require_one([f"{table.name or table.ID or 'table'} ({k})" for k, table in enumerate(tables, 1)])
    return _each_once(tables[0].to_table(use_names_over_ids=True), [field.name for field in tables[0].fields])


def _ecsv(content: bytes) -> Any:
    header = next((line for line in io.StringIO(content.decode("utf-8", "replace")) if line[0] != "#"), "")
    names = next(csv.reader([header.strip()], delimiter="," if b"# delimiter: ','" in content else " "), [])
    if again := [name for k, name in enumerate(names) if name in names[:k]]:
        raise SweepError(f"two columns are called {again[0]!r}")
    with suppress(SweepError):  # without pyarrow, or with what the other reader explains; that takes ten times as long
        return _by_astropy("ecsv", io.BytesIO(content), engine="pyarrow", null_values=["", "null"])
    gaps = [("", "0"), ("null", "0")]
    return _by_astropy("ascii.ecsv", content.decode("utf-8", "replace"), fill_values=gaps)


def _icrf(text: str) -> Any:
    """Return the positions in a text of the ICRF (ICRF2, ICRF3), whose errors of ra are in seconds of time."""
    from astropy.table import Column, Table

    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.startswith("ICRF J")]
    rows = [_ICRF.match(line) for _, line in lines]
    if bad := [str(k) for (k, _), row in zip(lines, rows, strict=True) if row is None]:
        raise SweepError(f"no ICRF entry in line {', '.join(bad[:5])}")
    columns = {name: [row[name] for row in rows if row] for name in ("iers_name", "icrf_name", "ra", "dec")}
    table = Table(columns | {"dec": [dec.replace(" ", "", dec[1:2].count(" ")) for dec in columns["dec"]]})
    for name, unit in (("ra_error", "s"), ("dec_error", "arcsec"), ("ra_dec_corr", None)):
        table[name] = Column([float(row[name]) for row in rows if row], unit=unit)
    table.meta["extragalactic"] = True
    return table


def _hipparcos(text: str) -> Any:
    """Return columns of hip2.dat; their units follow from their names."""
    import pandas as pd

    for k, line in enumerate(text.splitlines(), 1):
        if line.strip() and not (_HIP2.match(line) and len(line) > _HIP2_COLUMNS["UW15"][0]):
            raise SweepError(f"is hip2.dat of CDS I/311, but has no such row in line {k}")
    fields, names = list(_HIP2_COLUMNS.values()), list(_HIP2_COLUMNS)
    frame = pd.read_fwf(io.StringIO(text), colspecs=fields, header=None, names=names, dtype_backend="numpy_nullable")
    return from_frame(frame)


# ---- delimited text (CSV, TSV as VizieR sends it, `;` or blanks): names and units above, then rows with gaps


def _delimited(text: str, texts: Collection[str]) -> Any:
    """Return the table in delimited text; missing values are masked.

    Lines that begin with # are comments; the names of the columns stand in the first other line, or in the last comment
    before lines of numbers.  A line of units and a line of dashes may follow.
    """
    content = text.replace("\r\n", "\n").replace("\r", "\n").encode()
    names, units, delimiter, start = _layout(content)
    table = _rows(content[start:], names, delimiter, texts)
    for name, unit in zip(names, units, strict=True):
        bracketed = BRACKETS.fullmatch(name)
        table[name].unit = _unit(unit or (bracketed[2] if bracketed else ""))
    for name, meaning in _MEANINGS.findall(text):
        if name in table.colnames:
            table[name].description = meaning
    return table


def _rows(body: bytes, names: Sequence[str], delimiter: str, texts: Collection[str]) -> Any:
    """Return rows of text as an astropy Table with these columns, of types that fit the text.

    Raises SweepError for a row with more or fewer columns.
    """
    import pandas as pd

    body = re.sub(rb"(?m)^#.*\n?", b"", body)
    first = _fields(body[:4096].partition(b"\n")[0].decode(errors="replace"), delimiter)
    decimal_commas = delimiter in (";", "\t") and any(re.fullmatch(r"[+-]?\d+,\d+", field) for field in first)
    _check_widths(body, len(names), delimiter)
    try:
        frame = pd.read_csv(
            io.BytesIO(body),
            sep=r"\s+" if delimiter == " " else delimiter,
            header=None,
            names=list(range(len(names))),
            index_col=False,
            skipinitialspace=True,
            na_values={k: [""] if name in texts else list(MISSING) for k, name in enumerate(names)},
            keep_default_na=False,
            float_precision="round_trip",
            decimal="," if decimal_commas else ".",
            low_memory=False,
            dtype={k: "string" for k, name in enumerate(names) if name in texts},
            dtype_backend="numpy_nullable",  # integers beside gaps keep all digits, such as those of Gaia's source_id
        )
    except pd.errors.EmptyDataError:
        frame = pd.DataFrame({k: pd.array([], dtype="Float64") for k in range(len(names))})
    except (ValueError, OverflowError) as error:
        raise SweepError(f"cannot be read as delimited text: {' '.join(str(error).split())}") from error
    return from_frame(frame.set_axis(list(names), axis=1))


def from_frame(frame: Any) -> Any:
    """Return a frame of columns that allow gaps as an astropy Table, masked there; text is fixed-width."""
    from astropy.table import Column, MaskedColumn, Table

    table, names = Table(), list(frame.columns)
    for k, (name, column) in enumerate(frame.items()):
        missing = column.isna().to_numpy(dtype=bool)
        kind = np.dtype(getattr(column.dtype, "numpy_dtype", "U"))
        if kind.kind in "fiub":
            values: Any = column.to_numpy(dtype=kind, na_value=np.nan if kind.kind == "f" else kind.type(0).item())
        else:
            texts = ("" if gone else text for text, gone in zip(column, missing, strict=True))
            decoded = [
                text.decode("utf-8", "backslashreplace") if isinstance(text, bytes) else str(text) for text in texts
            ]
            values = np.array(decoded, dtype=np.str_)
        if len(values) and missing.all():
            values = np.full(len(values), np.nan)
        label = f"{name} {k}" if name in names[:k] else name
        table[label] = MaskedColumn(values, mask=missing) if missing.any() else Column(values)
    return _each_once(table, names)


def _each_once(table: Any, names: Sequence[str]) -> Any:
    """Return a table whose columns have these names in the file, without repeated ones, as Gaia's epochs have them;
    raises SweepError where two of a name differ.
    """
    again = [k for k, name in enumerate(names) if name in names[:k]]
    for k in again:
        if list(map(str, table.columns[names.index(names[k])])) != list(map(str, table.columns[k])):
            raise SweepError(f"two columns are called {names[k]!r}")
    table.remove_columns([table.colnames[k] for k in again])
    return table


def _check_widths(body: bytes, n_columns: int, delimiter: str) -> None:
    """Raise SweepError for the first row that has another number of columns than there are names."""
    rows: Iterable[Sequence[str] | Sequence[bytes]]
    if delimiter == " ":  # of bytes, as a no-break space does not part columns
        rows = (line.split() for line in body.split(b"\n") if line.strip())
    else:
        lines = (line for line in io.TextIOWrapper(io.BytesIO(body), "utf-8") if line.strip())
        rows = csv.reader(lines, delimiter=delimiter)
    for number, row in enumerate(rows, start=1):
        if len(row) != n_columns:  # pandas would fill a short row with gaps
            raise SweepError(f"row {number} has {len(row)} columns, not {n_columns} as the line of names")


def _fields(line: str, delimiter: str) -> list[str]:
    """Return the fields of one line without the blanks around them."""
    if delimiter == " ":
        return line.split()
    return [field.strip() for field in next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter), [])]


def _spaced(line: str) -> list[str]:
    """Return names between blanks, of which some are in quotes, or have a blank in front of their unit."""
    return [name.strip('"') for name in _SPACED.findall(line)]


def _layout(content: bytes) -> tuple[list[str], list[str], str, int]:
    """Return names and units of the columns, their delimiter, and the byte at which the first row begins."""
    lines = [line.decode() for line in islice(io.BytesIO(content), PREFACE_LINES)]
    at = next((k for k, line in enumerate(lines) if line.strip() and not line.startswith("#")), None)
    if at is None:
        raise SweepError("has no rows")
    header = lines[at]
    unquoted = re.sub(r'"[^"]*"', "", header)
    best = max(DELIMITERS, key=unquoted.count)
    delimiter = best if best in unquoted or len(_spaced(header)) == 1 else " "  # of one column, cells may have blanks
    row = next((_fields(line, delimiter) for line in lines[at + 1 :] if line.strip() and line[0] != "#"), [])
    names, units, first = _fields(header, delimiter), None, at
    if delimiter == " " and len(names) != len(row):
        names = _spaced(header)
    if any(map(_NUMBER.fullmatch, names)):  # this line is a row already
        comments = [line.lstrip("#") for line in reversed(lines[:at]) if line[:1] == "#"]
        above = [_fields(line, d) for line in comments for d in dict.fromkeys((delimiter, " "))]
        fitting = [fields for fields in above if len(fields) == len(names)]  # rather than words with a remark behind
        fitting = fitting or [fields for fields in map(_spaced, comments) if len(fields) == len(names)] or [names]
        units = fitting.pop(0) if len(fitting) > 1 and _are_units(fitting[0], lines[at:], delimiter) else None
        names = fitting[0]
        if any(map(_NUMBER.fullmatch, names)):
            said = f"its first line, {header.strip()[:60]!r}, is not one of column names"
            raise SweepError(f"{said} (a table of CDS needs its ReadMe beside it)")
    else:
        units, rows = _units_and_rules(lines[at + 1 :], delimiter, len(names))
        first = at + 1 + rows
        names = [name or f"column {k}" for k, name in enumerate(names, start=1)]
    return names, units or [""] * len(names), delimiter, len("".join(lines[:first]).encode())


def _units_and_rules(lines: Sequence[str], delimiter: str, n_columns: int) -> tuple[list[str] | None, int]:
    """Return the units in the lines after the names, if there are any, and which line is the first row."""
    units, above, first = None, None, 0
    for k, line in enumerate(lines, 1):
        fields = _fields(line.lstrip("#"), delimiter)
        if _RULE.fullmatch(line):
            units, above, first = above or units, None, k  # VizieR has them above the line of dashes
        elif above:
            break
        elif units is None and len(fields) == n_columns and _are_units(fields, lines[k:], delimiter):
            units, first = fields, k
        elif line.startswith("#") or not line.strip():
            first = k
        elif len(fields) != n_columns or any(map(_NUMBER.fullmatch, fields)):
            break
        else:
            above = fields
    return units, first


def _are_units(fields: Sequence[str], lines: Sequence[str], delimiter: str) -> bool:
    """Return whether fields are units, with values and no texts below them: names such as V look like units, too."""
    stated = [k for k, field in enumerate(fields) if field.strip("-")]
    if not all(_unit(fields[k], "raise") is not None for k in stated):
        return False
    below = (_fields(line, delimiter) for line in lines[:LINES_BELOW] if line[0] != "#")
    rows = [row for row in below if len(row) == len(fields)]
    cells = {row[k] for row in rows for k in stated}.difference(MISSING)
    return any(re.search(r"\d", cell) for cell in cells) and all(map(_VALUE.fullmatch, cells))


def has_unit(column: Any) -> bool:
    """Return whether a column of an astropy Table has a unit that astropy knows, and no logarithm, as CDS has [mas]."""
    from astropy.units import DexUnit, UnrecognizedUnit

    return str(column.unit or "") != "" and not isinstance(column.unit, (DexUnit, UnrecognizedUnit))


def _unit(text: str, strict: str = "silent") -> Any:
    """Return a text as an astropy unit: an unrecognised one, or None with "raise", where astropy does not know it."""
    from astropy.units import Unit

    text = _WRAPPED.sub(r"\1\2", text.strip()).strip()
    text = _WORDS.get(text, text)
    if _NO_UNIT.fullmatch(text):
        return None
    if clock := _CLOCK.fullmatch(text):
        return Unit(f"{clock[1]}:m:s", parse_strict="silent")
    if strict == "raise" and not text[0].isalpha():
        return None
    for form in ("cds", "generic", "vounit"):
        try:
            return Unit(text, format=form)
        except (ValueError, TypeError):
            continue
    return Unit(text, parse_strict="silent") if strict == "silent" else None


# ---- CDS: a ReadMe beside the table describes it byte by byte


def readme_of(path: Path) -> Path | None:
    """Return the ReadMe beside a table that describes it byte by byte; None otherwise."""
    readme = next((beside for name in READMES if (beside := path.parent / name).is_file()), None)
    if readme is None:
        return None
    text = readme.read_text(encoding="utf-8", errors="replace")
    described = [name for match in _DESCRIBED.findall(text) for name in re.split("[, ]+", match)]
    return readme if any(fnmatch.fnmatch(_unpacked(path), name) for name in described) else None


def _unpacked(path: Path) -> str:
    return re.sub(r"\.(gz|bz2|xz)$", "", path.name, flags=re.IGNORECASE)


def _cds(path: Path, text: str, readme: Path) -> Any:
    from astropy.io.ascii import Cds

    reader = Cds(readme=str(readme))
    reader.guessing = False
    with _readable_as(f"with the {readme.name} beside it"):
        reader.data.table_name = reader.inputter.table_name = _unpacked(path)  # which of the tables in the ReadMe
        return reader.read([line for line in text.splitlines() if line.strip()])


def _add_degrees(table: Any) -> None:
    """Put ra and dec (ICRS) in the place of a column of SkyCoord, and add RAdeg and DEdeg to a table that has hours,
    minutes and seconds in columns of their own.
    """
    place = next((name for name in table.colnames if hasattr(table[name], "icrs")), None)
    if place and not {"ra", "dec"} & set(table.colnames):
        table["ra"], table["dec"] = table[place].icrs.ra, table[place].icrs.dec
        table.remove_column(place)
    if "DEd" in table.colnames and not {"DE-", "DEdeg"} & set(table.colnames):
        raise SweepError("column DEd has no column DE- of signs, without which -0 is 0")
    for name, (sign, *parts, factor) in _IN_PARTS.items():
        if name in table.colnames or not {*parts, sign or parts[0]} <= set(table.colnames):
            continue
        first, minutes, seconds = (np.ma.asarray(table[part]).astype(np.float64) for part in parts)
        values = factor * (first + minutes / 60.0 + seconds / 3600.0)
        if sign:
            negative = [str(text).strip() == "-" for text in np.ma.filled(np.ma.asarray(table[sign]), "+")]
            values = values * np.where(negative, -1.0, 1.0)
        table[name] = np.ma.masked_array(values, mask=np.ma.getmaskarray(values))
        table[name].unit = "deg"
        error = f"e_{parts[-1]}"
        if error in table.colnames and f"e_{name}" not in table.colnames:
            table[f"e_{name}"] = table[error]
            table[f"e_{name}"].unit = table[error].unit or ("arcsec" if sign else "s")


# ---- Parquet: whole, or one row group at a time


def is_parquet(path: Path) -> bool:
    """Return whether a file is a Parquet table, by its content."""
    with path.open("rb") as file:
        return file.read(4) == b"PAR1"


def row_groups(path: Path) -> tuple[list[int], Any]:
    """Return the number of rows of each row group of a Parquet file, and its table without rows."""
    with path.open("rb") as source, _parquet(source) as file:
        sizes = [file.metadata.row_group(group).num_rows for group in range(file.num_row_groups)]
        return sizes, _from_arrow(file.schema_arrow.empty_table())


def read_row_group(path: Path, group: int, columns: Sequence[str]) -> Any:
    """Return some columns of one row group as an astropy Table; the rest of the file is not read."""
    with path.open("rb") as source, _parquet(source) as file:
        wanted = tuple(f"{column}." for column in columns)  # astropy's mask of NAME is NAME.mask
        names = [name for name in file.schema_arrow.names if f"{name}.".startswith(wanted)]
        return _from_arrow(file.read_row_group(group, columns=names, use_threads=False), columns)


def objects_in(path: Path) -> dict[str, list[Any]]:
    """Return the columns of lists and of times in a Parquet file, which a table has as texts."""
    with path.open("rb") as source, _parquet(source) as file:
        from pyarrow.types import is_nested, is_temporal

        names = [one.name for one in file.schema_arrow if is_nested(one.type) or is_temporal(one.type)]
        return dict(file.read(columns=names).to_pydict())


@contextmanager
def _parquet(source: Any) -> Iterator[Any]:
    """Give an open Parquet file; errors while it is read are SweepErrors."""
    with needed("pyarrow as a Parquet file", "parquet"):
        from pyarrow.parquet import ParquetFile
    with _readable_as("as Parquet"):
        yield ParquetFile(source)


def _from_arrow(arrow: Any, columns: Sequence[str] | None = None) -> Any:
    import pandas as pd
    import pyarrow.parquet

    # astropy writes a mask as a column of its own, and a time as two
    if b"table_meta_yaml" in (arrow.schema.metadata or {}):
        some = [one for one in arrow.schema if not pyarrow.types.is_floating(one.type)]
        if nulls := [one.name for one in some if arrow[one.name].null_count]:
            raise SweepError(f"has nulls in {', '.join(nulls)}, where astropy has masks: write it with astropy")
        pyarrow.parquet.write_table(arrow, source := io.BytesIO())
        return _by_astropy("parquet", source, include_names=columns)
    types = [pyarrow.float64() if pyarrow.types.is_decimal(field.type) else field.type for field in arrow.schema]
    arrow = arrow.cast(pyarrow.schema([field.with_type(kind) for field, kind in zip(arrow.schema, types, strict=True)]))
    table = from_frame(arrow.to_pandas(types_mapper=pd.ArrowDtype))
    for field in arrow.schema:
        table[field.name].unit = _unit((field.metadata or {}).get(b"unit", b"").decode())
    table.meta |= json.loads((arrow.schema.metadata or {}).get(b"linksweep", b"{}"))
    return table


# ---- tables in files: by astropy, but for what is missing


def write_table(table: Any, path: Path) -> None:
    """Write an astropy Table as the suffix says; what is masked is null in Parquet, where astropy adds masks."""
    has_gaps = table.has_masked_values
    truths = [name for name, column in table.columns.items() if np.ma.is_masked(column) and column.dtype.kind == "b"]
    if truths and path.suffix == ".fits":
        raise ValueError(f"no truth value is missing in FITS, and some of {', '.join(truths)} are")
    if path.suffix != ".parquet" or not has_gaps:
        (table if has_gaps else table.filled()).write(path)
        return
    import pyarrow.parquet

    if odd := [name for name, column in table.columns.items() if column.ndim > 1 or not hasattr(column, "dtype")]:
        raise ValueError(f"arrays or times in {', '.join(odd)} beside missing values")
    table.convert_bytestring_to_unicode()  # which FITS has
    arrow = pyarrow.Table.from_pandas(table.to_pandas(), preserve_index=False)
    fields = [one.with_metadata({"unit": str(table[one.name].unit or "")}) for one in arrow.schema]
    schema = pyarrow.schema(fields, {"linksweep": json.dumps(table.meta, default=str)})
    pyarrow.parquet.write_table(arrow.cast(schema), path)
