"""The 46-byte table of galaxies in a star catalogue, in the format of the paper's tables at CDS.

====== ====== =====================================
Bytes  Format What
====== ====== =====================================
 1-  4 I4     TYC1 of the Tycho identifier
 6- 10 I5     TYC2
12     I1     TYC3
14- 18 I5     PGC number
20- 31 F12.8  RAdeg, right ascension of the star (deg)
33- 44 F12.8  DEdeg, declination of the star (deg)
46     A1     class: G certain, U uncertain, S supplement
====== ====== =====================================
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from linksweep.core.arrays import Indices
from linksweep.sweep.contract import SweepError

LETTERS = "GUS"
"""The class letters in order of the codes certain, uncertain, supplement."""

LENGTH = 46
FIELDS: Mapping[str, tuple[slice, int, int]] = {
    "TYC1": (slice(0, 4), 1, 9999),
    "TYC2": (slice(5, 10), 1, 99999),
    "TYC3": (slice(11, 12), 1, 9),
    "PGC": (slice(13, 18), 1, 99999),
    "RAdeg": (slice(19, 31), 0, 360),
    "DEdeg": (slice(32, 44), -90, 90),
    "class": (slice(45, 46), 0, len(LETTERS) - 1),
}
"""The bytes of each field in a line, and its smallest and largest number (or code)."""

BLANKS = (4, 10, 12, 18, 31, 44)
INTEGERS = ("TYC1", "TYC2", "TYC3", "PGC")
PROBLEMS_NAMED = 10


@dataclass(frozen=True)
class GalaxyTable:
    """N galaxies: ``tyc`` (N, 3), ``pgc`` (N,), ``ra`` and ``dec`` in deg and the class code (N,) as in `LETTERS`."""

    tyc: Indices
    pgc: Indices
    ra: NDArray[np.float64]
    dec: NDArray[np.float64]
    code: Indices

    def __len__(self) -> int:
        return len(self.pgc)


def format_galaxy_table(table: GalaxyTable) -> str:
    r"""Return one line of 46 bytes and a ``\n`` for each galaxy.

    A right ascension that rounds to 360 is written as 0.  Raises SweepError that names each galaxy without a PGC
    number or with a number that does not fit its field.
    """
    problems: list[str] = []
    lines: list[str] = []
    for tyc, pgc, ra, dec, code in zip(
        table.tyc.tolist(), table.pgc.tolist(), table.ra.tolist(), table.dec.tolist(), table.code.tolist(), strict=True
    ):
        star = f"TYC {tyc[0]}-{tyc[1]}-{tyc[2]}"
        if pgc == 0:
            problems.append(f"{star} has no PGC number")
        for name, number in zip(INTEGERS, (*tyc, pgc), strict=True):
            field, _, largest = FIELDS[name]
            if not 0 <= number <= largest:
                problems.append(
                    f"{star}: {name} = {number} does not fit bytes {field.start + 1}-{field.stop}, at most {largest}"
                )
        wrapped = 0.0 if f"{ra:.8f}" == "360.00000000" else ra
        lines.append(f"{tyc[0]:4d} {tyc[1]:5d} {tyc[2]:1d} {pgc:5d} {wrapped:12.8f} {dec:12.8f} {LETTERS[code]}\n")
    if problems:
        raise SweepError(_shortened(problems))
    return "".join(lines)


def read_galaxy_table(path: Path) -> GalaxyTable:
    """Return the galaxies of a 46-byte table; raises SweepError that names each bad line, byte and value."""
    try:
        lines = path.read_bytes().decode("ascii").split("\n")
    except OSError as error:
        raise SweepError(f"cannot be read: {error.strerror}", str(path)) from error
    except UnicodeDecodeError as error:
        raise SweepError(f"byte {error.start} is not ASCII; this is no 46-byte table", str(path)) from error
    if lines[-1] == "":
        lines.pop()
    problems: list[str] = []
    rows = [_parse(line.removesuffix("\r"), number, problems) for number, line in enumerate(lines, start=1)]
    if problems:
        raise SweepError(_shortened(problems), str(path))
    columns = np.array(rows, dtype=np.float64).reshape(len(rows), 7).T  # integers of five digits are exact
    *tyc, pgc, code = columns[[0, 1, 2, 3, 6]].astype(np.int64)
    return GalaxyTable(np.stack(tyc, axis=1), pgc, columns[4], columns[5], code)


def _parse(line: str, number: int, problems: list[str]) -> tuple[float, ...]:
    """Return the seven numbers of a line, with the class as its code; add what is wrong to ``problems``."""
    if len(line) != LENGTH:
        problems.append(f"line {number} has {len(line)} bytes, not {LENGTH}")
        return (0.0,) * 7
    if stray := [byte for byte in BLANKS if line[byte] != " "]:
        problems.append(f"line {number}: byte {stray[0] + 1} is {line[stray[0]]!r}, not a blank")
        return (0.0,) * 7
    values: list[float] = []
    for name, (field, low, high) in FIELDS.items():
        text = line[field]
        value = LETTERS.find(text) if name == "class" else _number(text, whole=name in INTEGERS)
        if value is None or not low <= value <= high:
            allowed = f"{'an integer' if name in INTEGERS else 'a number'} {low}..{high}"
            if name == "class":
                allowed = f"one of {', '.join(LETTERS)}"
            problems.append(
                f"line {number}: {name} (bytes {field.start + 1}-{field.stop}) is {text!r}, must be {allowed}"
            )
        values.append(0.0 if value is None else float(value))
    return tuple(values)


def _number(text: str, whole: bool) -> float | None:
    form = r" *-?\d+" if whole else r" *-?\d+\.\d+"
    return float(text) if re.fullmatch(form, text) else None


def _shortened(problems: list[str]) -> list[str]:
    more = len(problems) - PROBLEMS_NAMED
    return [*problems[:PROBLEMS_NAMED], f"and {more} more"] if more > 0 else problems
