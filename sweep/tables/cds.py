"""Tables in the format of CDS: described byte by byte in a ReadMe beside them, angles in several columns."""

import fnmatch
import re
from pathlib import Path
from typing import Any

import numpy as np

from linksweep.sweep.contract import SweepError

READMES = ("ReadMe", "README", "readme", "ReadMe.txt", "README.txt", "readme.txt")

_DESCRIBED = re.compile(r"^\s*Byte-(?:by|per)-byte Description of file\s*:\s*(.+?)\s*$", re.IGNORECASE | re.MULTILINE)
_SEXAGESIMAL = {"RAdeg": ("", "RAh", "RAm", "RAs", 15.0), "DEdeg": ("DE-", "DEd", "DEm", "DEs", 1.0)}


def readme_of(path: Path) -> Path | None:
    """Return the ReadMe beside a table that it describes, or should as the table ends in .dat; None otherwise."""
    readme = next((found for name in READMES if (found := path.parent / name).is_file()), None)
    if readme is None or not (_unpacked(path).lower().endswith(".dat") or _describes(readme, path)):
        return None
    return readme


def _described(readme: Path) -> list[str]:
    text = readme.read_text(encoding="utf-8", errors="replace")
    return [name for match in _DESCRIBED.findall(text) for name in re.split("[, ]+", match) if name]


def _describes(readme: Path, path: Path) -> bool:
    return any(fnmatch.fnmatch(_unpacked(path), name) for name in _described(readme))


def _unpacked(path: Path) -> str:
    return re.sub(r"\.(gz|bz2|xz)$", "", path.name, flags=re.IGNORECASE)


def read_with_readme(path: Path, text: str, readme: Path) -> Any:
    """Return the table in a text, as the ReadMe beside its file describes it; raises SweepError where it does not."""
    described = _described(readme)
    if not described:
        raise SweepError(
            f"the {readme.name} beside it describes no table byte by byte, so it is not that of a CDS table"
        )
    if not _describes(readme, path):
        raise SweepError(f"the {readme.name} beside it describes {', '.join(described)}, not {_unpacked(path)}")
    from astropy.io.ascii import Cds

    reader = Cds(readme=str(readme))
    reader.guessing = False
    lines = [line for line in text.splitlines() if line.strip()]
    try:
        reader.data.table_name = _unpacked(path)
        reader.inputter.table_name = _unpacked(path)
        return reader.read(lines)
    except Exception as error:  # astropy raises errors of many types for a ReadMe that it does not understand
        said = " ".join(str(error).split())[:300]
        raise SweepError(f"cannot be read with the {readme.name} beside it: {type(error).__name__}: {said}") from error


def add_degrees(table: Any) -> None:
    """Add RAdeg and DEdeg to a table that has hours, minutes and seconds in columns of their own."""
    from astropy.table import MaskedColumn

    for name, (sign, *parts, factor) in _SEXAGESIMAL.items():
        if name in table.colnames or not {*parts, *([sign] if sign else [])} <= set(table.colnames):
            continue
        columns = [np.ma.asarray(table[part]) for part in parts]
        if any(column.dtype.kind not in "iuf" for column in columns):
            continue
        first, minutes, seconds = (column.astype(np.float64) for column in columns)
        values = factor * (first + minutes / 60.0 + seconds / 3600.0)
        if sign:
            negative = np.array([str(text).strip() == "-" for text in np.ma.filled(np.ma.asarray(table[sign]), "+")])
            values = values * np.where(negative, -1.0, 1.0)
        table[name] = MaskedColumn(np.ma.getdata(values), mask=np.ma.getmaskarray(values), unit="deg")
