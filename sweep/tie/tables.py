"""Astrometric tables from files: Gaia archive, Hipparcos-2, ICRF text, VLBI rows and others with such columns."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.core.tie.astrometry import Astrometry
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tables import reader
from linksweep.sweep.tie import icrf
from linksweep.sweep.tie.astrometry_reader import AstrometryReader
from linksweep.sweep.tie.column_names import TableOptions

_OWN = Path(str(resources.files("linksweep") / "sweeps" / "data")).resolve()


@dataclass(frozen=True)
class AstrometricTable:
    """The astrometry in a file, the file's path and SHA-256, the columns with names, and notes for the user."""

    path: str
    digest: str
    astrometry: Astrometry
    names: Mapping[str, NDArray[np.str_]]
    notes: Sequence[str] = ()

    def named_notes(self) -> list[str]:
        """Return the notes with the name of the file."""
        return [f"{Path(self.path).name}: {note}" for note in self.notes]


def read_table(path: Path, options: TableOptions | None = None) -> AstrometricTable:
    """Return the astrometry of a file, or of a built-in table by name (icrf2, icrf3, psrpi ...).

    A table whose metadata say ``extragalactic: true`` needs no epoch: its positions hold at any.  Raises
    SweepError with all that is wrong and the rows (counted from 1).
    """
    options = options or TableOptions()
    path = _built_in(path) or path
    if not path.is_file():
        raise SweepError("is a folder, not a table" if path.is_dir() else "no such file", str(path))
    digest = digest_of(path)
    if path.suffix.lower() in (".txt", ".dat") and icrf.is_icrf(path):
        astrometry, names = icrf.read_icrf(path)
        return AstrometricTable(str(path), digest, astrometry, names)
    found = astrometric_table(reader.read_table(path), str(path), digest, options)
    return replace(found, notes=()) if path.resolve().parent == _OWN else found  # ours are as they were published


def astrometric_table(table: Any, where: str, digest: str, options: TableOptions) -> AstrometricTable:
    """Return what an astropy Table holds; raises SweepError as `read_table`."""
    found = AstrometryReader(table, where, options)
    astrometry, names = found.astrometry()
    return AstrometricTable(where, digest, astrometry, names, found.notes)


def _built_in(path: Path) -> Path | None:
    """Return the file of a built-in table, if ``path`` is its name and no such file exists."""
    if path.suffix or len(path.parts) != 1 or path.exists():
        return None
    return next((file for file in sorted(_OWN.glob("*.ecsv*")) if file.name.split(".")[0] == path.name), None)


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
