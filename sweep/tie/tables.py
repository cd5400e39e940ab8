"""Astrometric tables from files: Gaia archive, Hipparcos-2, ICRF text, VLBI rows and others with such columns."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from core.arrays import Array
from core.blocks import PARAMETERS
from core.constants import ARCSEC, MAS
from core.tie.astrometry import PAIRS, Astrometry, kinds, positive_definite
from sweep.contract import SweepError
from sweep.tables import reader
from sweep.tie import hipparcos, icrf
from sweep.tie.column_names import (
    CORRELATIONS,
    EPOCHS,
    NAMES,
    Positions,
    TableOptions,
    column_of,
    error_column_of,
    quantities,
)
from sweep.tie.column_reader import ColumnReader

MJD_FROM = 15000.0
"""Epochs above are modified Julian dates."""


@dataclass(frozen=True)
class AstrometricTable:
    """What a file holds, its path and SHA-256, and the columns with names."""

    path: str
    digest: str
    astrometry: Astrometry
    names: Mapping[str, NDArray[np.str_]]


def read_table(path: Path, options: TableOptions | None = None) -> AstrometricTable:
    """Return the astrometry of a file, or of a built-in table by name (icrf2, icrf3, psrpi ...).

    A table whose metadata say ``extragalactic: true`` needs no epoch: its positions are those of any.  Raises
    SweepError with all that is wrong and the rows (counted from 1).
    """
    options = options or TableOptions()
    path = built_in_table(path) or path
    if not path.is_file():
        raise SweepError("no such file", str(path))
    digest = digest_of(path)
    if path.suffix.lower() in (".txt", ".dat") and icrf.is_icrf(path):
        astrometry, names = icrf.read_icrf(path)
        return AstrometricTable(str(path), digest, astrometry, names)
    astrometry, names = astrometry_of(reader.read_table(path), str(path), options)
    return AstrometricTable(str(path), digest, astrometry, names)


def astrometry_of(table: Any, where: str, options: TableOptions) -> tuple[Astrometry, dict[str, NDArray[np.str_]]]:
    """Return the astrometry in an astropy Table and its columns with names; raises SweepError as `read_table`."""
    return _Reader(table, where, options).astrometry()


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def built_in_table(path: Path) -> Path | None:
    """Return the file of a built-in table, where its name is given and there is no such file."""
    if path.suffix or len(path.parts) != 1 or path.exists():
        return None
    folder = Path(str(resources.files("sweeps") / "data"))
    return next((file for file in sorted(folder.glob("*.ecsv*")) if file.name.split(".")[0] == path.name), None)


class _Reader(ColumnReader):
    """Reads the quantities of one table and collects what is wrong with it."""

    def __init__(self, table: Any, where: str, options: TableOptions) -> None:
        super().__init__(table)
        self.where, self.options = where, options
        for key, column in options.columns.items():
            if key not in quantities():
                self.problems.append(f"columns: {key} is no quantity; known are {', '.join(quantities())}")
            elif column not in table.colnames:
                self.problems.append(f"columns: no column {column!r} for {key}; there are {self.listed()}")
        if not self.problems:
            self._set_units()
        if self.problems:
            raise SweepError(self.problems, self.where)
        if not len(table):
            raise SweepError("has no rows", self.where)

    def astrometry(self) -> tuple[Astrometry, dict[str, NDArray[np.str_]]]:
        n = len(self.table)
        values, errors = np.full((2, 5, n), np.nan)
        for i, name in enumerate(PARAMETERS):
            values[i] = self._values(name)
        for i, name in enumerate(PARAMETERS):
            errors[i] = self._errors(name, values[1])
        for name, row in (("ra", values[0]), ("dec", values[1])):
            if self._column(name) is None and not np.any(np.isfinite(values[2:])):
                self.problems.append(f"no column {name}; there are {self.listed()}")
            self.check(
                np.isfinite(errors[PARAMETERS.index(name)]) & ~np.isfinite(row), f"an error but no value of {name}"
            )
        self.check(np.abs(values[1]) > 0.5 * np.pi * (1.0 + 1e-12), "a dec outside -90..90 deg")
        self.check((values[0] < -np.pi - 1e-9) | (values[0] > 2.0 * np.pi + 1e-9), "an ra outside -180..360 deg")
        if not self.options.pmra_cos_dec:
            values[3] *= np.cos(values[1])
            errors[3] *= np.cos(values[1])
        correlations = self._correlations(np.isfinite(values) & np.isfinite(errors))
        columns = {
            name: self.numbers(name)
            for name in self.table.colnames
            if getattr(self.table[name], "ndim", 2) == 1 and self.kind(name) in "fiu"
        }
        epoch = self._epoch()
        found = Astrometry(
            values=values,
            errors=errors,
            epoch=epoch,
            correlations=correlations,
            radial_velocity=self._radial_velocity(),
            columns=columns,
            apparent=(self._positions() == "single-epoch") & np.isfinite(epoch),
        )
        try:
            kinds(found)
        except ValueError as error:
            self.problems.append(str(error))
        if self.problems:
            raise SweepError(self.problems, self.where)
        return found, self._names()

    def _set_units(self) -> None:
        """Give columns the units that the options say; a column has another only if it says so itself."""
        from astropy import units

        self.table = self.table.copy(copy_data=False)
        for quantity, text in self.options.units.items():
            stem, is_error = quantity.removesuffix("_error"), quantity.endswith("_error")
            name = (error_column_of if is_error else column_of)(stem, self.table.colnames, self.options)
            try:
                unit = units.Unit(text)
            except ValueError:
                self.problems.append(f"units: {quantity} in {text!r}, which is no unit")
                continue
            if quantity not in quantities() or name is None:
                self.problems.append(f"units: no column of {quantity}")
            elif self.table[name].unit not in (None, unit):
                self.problems.append(f"units: {quantity} in {text}, and column {name!r} says {self.table[name].unit}")
            else:
                self.table[name].unit = unit

    def _positions(self) -> str:
        said = self.options.positions or self.table.meta.get("positions", "single-epoch")
        if said not in get_args(Positions):
            self.problems.append(f"positions {said!r}: they are {' or '.join(get_args(Positions))}")
        return str(said)

    def _column(self, quantity: str) -> str | None:
        return column_of(quantity, self.table.colnames, self.options)

    def _values(self, quantity: str) -> Array:
        name = self._column(quantity)
        if name is None:
            return np.full(len(self.table), np.nan)
        if quantity in ("ra", "dec"):
            return self.angle(name, hours=quantity == "ra")
        return self.in_unit(name, "mas/yr" if quantity.startswith("pm") else "mas") * MAS

    def _errors(self, quantity: str, dec: Array) -> Array:
        name = error_column_of(quantity, self.table.colnames, self.options)
        if name is None:
            return np.full(len(self.table), np.nan)
        unit = "mas/yr" if quantity.startswith("pm") else "mas"
        if str(self.table[name].unit) == "s" and quantity == "ra":  # seconds of time
            found = self.numbers(name) * 15.0 * np.cos(dec) * ARCSEC
        else:
            found = self.in_unit(name, unit) * MAS
        self.check(found < 0.0, f"a negative {name}")
        zero = found == 0.0
        if self.options.zero_errors == "error":
            self.check(zero, f"a {name} of 0 (say with zero errors whether the value is missing or exact)")
        elif self.options.zero_errors == "missing":
            found = np.where(zero, np.nan, found)
        return found

    def _epoch(self) -> Array:
        name = self._column("ref_epoch")
        if self.options.epoch is not None:
            return np.full(len(self.table), self.options.epoch)
        if name is None:
            if self.table.meta.get("extragalactic") is True:
                return np.full(len(self.table), np.nan)
            if "RArad" in self.table.colnames:
                return np.full(len(self.table), hipparcos.EPOCH)
            if self._column("ra") is not None:
                self.problems.append("no column ref_epoch; give the epoch of the positions")
            return np.full(len(self.table), np.nan)
        values = self.numbers(name)
        unit = str(self.table[name].unit)
        if unit == "d" or (np.nanmin(values, initial=np.inf) > MJD_FROM and unit not in ("yr", "a")):
            values = 2000.0 + (values - 51544.5) / 365.25
        self.check(
            ~((values >= EPOCHS[0]) & (values <= EPOCHS[1])), f"a {name} that is neither a Julian year nor an MJD"
        )
        return values

    def _radial_velocity(self) -> Array | None:
        name = self._column("radial_velocity")
        return None if name is None else self.in_unit(name, "km/s")

    def _correlations(self, present: NDArray[np.bool_]) -> Array | None:
        if "RArad" in self.table.colnames and (elements := hipparcos.elements(self)) is not None:
            return hipparcos.correlations(elements)
        names = [self._column(name) for name in CORRELATIONS]
        if not any(names):
            return None
        found = np.array([np.zeros(len(self.table)) if name is None else self.numbers(name) for name in names])
        for row, name, (i, j) in zip(found, names, PAIRS, strict=True):
            both = present[i] & present[j]
            if name is not None and np.any(np.isfinite(row)):  # a column of blanks is as none
                self.check(both & ~np.isfinite(row), f"no {name} (write 0 for none)")
            row[~(both & np.isfinite(row))] = 0.0
        self.check(~positive_definite(found), "correlations that are impossible (not positive definite)")
        return found

    def _names(self) -> dict[str, NDArray[np.str_]]:
        wanted = [self.options.columns["name"]] if "name" in self.options.columns else NAMES
        text = [name for name in self.table.colnames if name in wanted or self.kind(name) in "US"]
        text.sort(key=lambda name: wanted.index(name) if name in wanted else len(wanted))
        return {name: self.text(name) for name in text}
