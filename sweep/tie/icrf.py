"""Positions from the ICRF's text tables (ICRF2, ICRF3), whose errors of ra are in seconds of time."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from linksweep.core.arrays import Array
from linksweep.core.constants import ARCSEC, DEGREE
from linksweep.core.tie.astrometry import Astrometry
from linksweep.sweep.contract import SweepError

_ROW = re.compile(
    r"ICRF (?P<icrf>J[0-9.]+[+-][0-9]+)\s+(?P<name>\S+)\s+(?P<info>[A-Z]\s+)?"
    r"(?P<h>\d+) (?P<m>\d+) (?P<s>[\d.]+)\s+(?P<sign>[+-]?)\s*(?P<d>\d+) (?P<am>\d+) (?P<as>[\d.]+)\s+"
    r"(?P<e_ra>[\d.]+)\s+(?P<e_dec>[\d.]+)\s+(?P<corr>[+-]?[\d.]+)\s"
)


def is_icrf(path: Path) -> bool:
    """Return whether a text file has rows in the format of the ICRF."""
    with path.open("rb") as file:
        return any(line.startswith(b"ICRF J") for line, _ in zip(file, range(200), strict=False))


def read_icrf(path: Path) -> tuple[Astrometry, dict[str, NDArray[np.str_]]]:
    """Return mean positions without an epoch and the names by column: iers_name, icrf_name.

    Raises SweepError that names the lines that cannot be read.
    """
    rows, bad = [], []
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        if line.startswith("ICRF J"):
            if match := _ROW.match(line):
                rows.append(match.groupdict())
            else:
                bad.append(number)
    if bad:
        raise SweepError(f"no ICRF entry in line {', '.join(map(str, bad[:5]))}", str(path))

    def numbers(key: str) -> Array:
        return np.array([float(row[key]) for row in rows])

    ra = 15.0 * DEGREE * (numbers("h") + numbers("m") / 60.0 + numbers("s") / 3600.0)
    size = DEGREE * (numbers("d") + numbers("am") / 60.0 + numbers("as") / 3600.0)
    dec = np.where([row["sign"] == "-" for row in rows], -size, size)
    values, errors = np.full((2, 5, len(rows)), np.nan)
    values[:2] = ra, dec
    errors[:2] = numbers("e_ra") * 15.0 * np.cos(dec) * ARCSEC, numbers("e_dec") * ARCSEC
    correlations = np.zeros((10, len(rows)))
    correlations[0] = numbers("corr")
    names = {"iers_name": np.array([row["name"] for row in rows]), "icrf_name": np.array([row["icrf"] for row in rows])}
    return Astrometry(values, errors, np.full(len(rows), np.nan), correlations), names
