"""Parquet tables as astropy Tables, whole or one row group at a time."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from linksweep.sweep.contract import SweepError


def parquet_table(content: bytes) -> Any:
    """Return the table in the bytes of a Parquet file; raises SweepError for one that cannot be read."""
    file = _opened(io.BytesIO(content))
    return _table(file.read, _units(io.BytesIO(content), file))


def is_parquet(path: Path) -> bool:
    """Return whether a file is a Parquet table, by its content."""
    with path.open("rb") as file:
        return file.read(4) == b"PAR1"


def row_groups(path: Path) -> tuple[list[int], list[str]]:
    """Return the number of rows of each row group of a Parquet file, and the names of its columns."""
    with path.open("rb") as file:
        found = _opened(file)
        sizes = [found.metadata.row_group(group).num_rows for group in range(found.num_row_groups)]
        return sizes, list(found.schema_arrow.names)


def read_row_group(path: Path, group: int, columns: Sequence[str]) -> Any:
    """Return some columns of one row group as an astropy Table; the rest of the file is not read."""
    with path.open("rb") as file:
        found = _opened(file)
        units = _units(path, found)
        return _table(lambda: found.read_row_group(group, columns=list(columns), use_threads=False), units)


def _opened(source: Any) -> Any:
    try:
        import pyarrow as pa
        from pyarrow.parquet import ParquetFile
    except ImportError as error:
        raise SweepError("is a Parquet file, which needs pyarrow: install linksweep[parquet]") from error
    try:
        return ParquetFile(source)
    except (pa.ArrowException, OSError) as error:
        raise SweepError(f"cannot be read as Parquet: {' '.join(str(error).split())[:300]}") from error


def _units(source: Any, file: Any) -> dict[str, Any]:
    """Return the units that astropy wrote into a file."""
    if b"table_meta_yaml" not in (file.schema_arrow.metadata or {}):
        return {}
    from astropy.table import Table

    columns = Table.read(source, format="parquet", schema_only=True).columns
    return {name: column.unit for name, column in columns.items()}


def _table(read: Any, units: dict[str, Any]) -> Any:
    import pyarrow as pa
    from astropy.table import MaskedColumn, Table

    try:
        found = read()
    except (pa.ArrowException, OSError) as error:
        raise SweepError(f"cannot be read as Parquet: {' '.join(str(error).split())[:300]}") from error
    table, kind = Table(), pa.types
    for name, field in zip(found.column_names, found.schema, strict=True):
        column, missing = found[name], found[name].is_null().to_numpy()
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
