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
from core.constants import ARCSEC, DEGREE, MAS
from core.tie.astrometry import PAIRS, Astrometry, kinds, named_rows, positive_definite
from sweep import table_reader
from sweep.contract import SweepError
from sweep.formatting import first_of
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

SEPARATORS = str.maketrans(dict.fromkeys(":hdms", " "))
"""What stands between hours, minutes and seconds, made blank."""

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
    astrometry, names = astrometry_of(table_reader.read_table(path), str(path), options)
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


def _like_hours(ra: Array) -> bool:
    """Return whether numbers without a unit may be hours: ten or more within 0 to 24, over more than half of it."""
    known = ra[np.isfinite(ra)]
    return len(known) >= 10 and known.min() >= 0.0 and known.max() <= 24.0 and bool(np.ptp(known) > 12.0)


class _Reader:
    """Reads the quantities of one table and collects what is wrong with it."""

    def __init__(self, table: Any, where: str, options: TableOptions) -> None:
        self.table, self.where, self.options = table, where, options
        self.problems: list[str] = []
        for key, column in options.columns.items():
            if key not in quantities():
                self.problems.append(f"columns: {key} is no quantity; known are {', '.join(quantities())}")
            elif column not in table.colnames:
                self.problems.append(f"columns: no column {column!r} for {key}; there are {self._listed()}")
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
                self.problems.append(f"no column {name}; there are {self._listed()}")
            self._check(
                np.isfinite(errors[PARAMETERS.index(name)]) & ~np.isfinite(row), f"an error but no value of {name}"
            )
        self._check(np.abs(values[1]) > 0.5 * np.pi * (1.0 + 1e-12), "a dec outside -90..90 deg")
        self._check((values[0] < -np.pi - 1e-9) | (values[0] > 2.0 * np.pi + 1e-9), "an ra outside -180..360 deg")
        if not self.options.pmra_cos_dec:
            values[3] *= np.cos(values[1])
            errors[3] *= np.cos(values[1])
        correlations = self._correlations(np.isfinite(values) & np.isfinite(errors))
        columns = {
            name: self._numbers(name)
            for name in self.table.colnames
            if getattr(self.table[name], "ndim", 2) == 1 and self._kind(name) in "fiu"
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

    def _kind(self, name: str) -> str:
        """Return what NumPy calls the kind of a column's values, "O" for those of no array."""
        return str(getattr(getattr(self.table[name], "dtype", None), "kind", "O"))

    def _column(self, quantity: str) -> str | None:
        return column_of(quantity, self.table.colnames, self.options)

    def _values(self, quantity: str) -> Array:
        name = self._column(quantity)
        if name is None:
            return np.full(len(self.table), np.nan)
        if quantity in ("ra", "dec"):
            return self._angle(name, hours=quantity == "ra")
        return self._in_unit(name, "mas/yr" if quantity.startswith("pm") else "mas") * MAS

    def _errors(self, quantity: str, dec: Array) -> Array:
        name = error_column_of(quantity, self.table.colnames, self.options)
        if name is None:
            return np.full(len(self.table), np.nan)
        unit = "mas/yr" if quantity.startswith("pm") else "mas"
        if str(self.table[name].unit) == "s" and quantity == "ra":  # seconds of time
            found = self._numbers(name) * 15.0 * np.cos(dec) * ARCSEC
        else:
            found = self._in_unit(name, unit) * MAS
        self._check(found < 0.0, f"a negative {name}")
        zero = found == 0.0
        if self.options.zero_errors == "error":
            self._check(zero, f"a {name} of 0 (say with zero errors whether the value is missing or exact)")
        elif self.options.zero_errors == "missing":
            found = np.where(zero, np.nan, found)
        return found

    def _angle(self, name: str, hours: bool) -> Array:
        from astropy import units

        column = self.table[name]
        if self._kind(name) in "USO":
            return self._sexagesimal(name, hours)
        unit = column.unit or (units.rad if name.endswith("rad") else units.deg)
        if hours and column.unit is None and not name.endswith(("deg", "rad")) and _like_hours(self._numbers(name)):
            self.problems.append(
                f"column {name!r} has no unit and runs over 0..24, as hours do; say --unit ra=hourangle (or ra=deg)"
            )
        try:
            return np.asarray(self._numbers(name) * units.Unit(unit).to("rad"))
        except (units.UnitsError, ValueError, TypeError):
            self.problems.append(f"column {name!r} is in {unit}, which is no angle")
            return np.full(len(self.table), np.nan)

    def _sexagesimal(self, name: str, hours: bool) -> Array:
        found, bad = np.full(len(self.table), np.nan), []
        for i, text in enumerate(np.ma.filled(np.ma.asarray(self.table[name]).astype(str), "")):
            parts = text.translate(SEPARATORS).split()
            if not parts:
                continue
            try:
                size = sum(abs(float(part)) / 60.0**k for k, part in enumerate(parts))
            except ValueError:
                size = np.nan
            if len(parts) != 3 or not np.isfinite(size):
                bad.append(i)
            else:
                found[i] = (-size if parts[0].startswith("-") else size) * DEGREE * (15.0 if hours else 1.0)
        if bad:
            what = "hours, minutes and seconds" if hours else "degrees, minutes and seconds"
            self.problems.append(f"column {name!r} does not hold {what} in {named_rows(np.array(bad))}")
        return found

    def _in_unit(self, name: str, unit: str) -> Array:
        from astropy import units

        values, own = self._numbers(name), self.table[name].unit
        if own is None:
            return values
        try:
            return np.asarray(values * units.Unit(own).to(unit))
        except (units.UnitsError, ValueError, TypeError):
            self.problems.append(f"column {name!r} is in {own}, not convertible to {unit}")
            return values

    def _numbers(self, name: str) -> Array:
        column = self.table[name]
        if self._kind(name) not in "fiu" or column.ndim != 1:
            self.problems.append(f"column {name!r} does not hold numbers")
            return np.full(len(self.table), np.nan)
        return np.asarray(np.ma.filled(np.ma.asarray(getattr(column, "value", column)).astype(np.float64), np.nan))

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
        values = self._numbers(name)
        unit = str(self.table[name].unit)
        if unit == "d" or (np.nanmin(values, initial=np.inf) > MJD_FROM and unit not in ("yr", "a")):
            values = 2000.0 + (values - 51544.5) / 365.25
        self._check(
            ~((values >= EPOCHS[0]) & (values <= EPOCHS[1])), f"a {name} that is neither a Julian year nor an MJD"
        )
        return values

    def _radial_velocity(self) -> Array | None:
        name = self._column("radial_velocity")
        return None if name is None else self._in_unit(name, "km/s")

    def _correlations(self, present: NDArray[np.bool_]) -> Array | None:
        if "RArad" in self.table.colnames and (elements := self._upper()) is not None:
            return hipparcos.correlations(elements)
        names = [self._column(name) for name in CORRELATIONS]
        if not any(names):
            return None
        found = np.array([np.zeros(len(self.table)) if name is None else self._numbers(name) for name in names])
        for row, name, (i, j) in zip(found, names, PAIRS, strict=True):
            both = present[i] & present[j]
            if name is not None and np.any(np.isfinite(row)):  # a column of blanks is as none
                self._check(both & ~np.isfinite(row), f"no {name} (write 0 for none)")
            row[~(both & np.isfinite(row))] = 0.0
        self._check(~positive_definite(found), "correlations that are impossible (not positive definite)")
        return found

    def _upper(self) -> Array | None:
        """Return U1..U15 of Hipparcos-2 from fifteen columns, one column of arrays or one of text; or None."""
        for stem in ("UW", "U"):
            if all(f"{stem}{k}" in self.table.colnames for k in range(1, 16)):
                return np.asarray([self._numbers(f"{stem}{k}") for k in range(1, 16)], dtype=np.float64)
        if "UW" not in self.table.colnames:
            return None
        column = np.asarray(self.table["UW"])
        if column.ndim == 2:
            return np.asarray(np.asarray(column, dtype=np.float64).T)
        texts = [str(text) for text in column]
        try:  # fifteen numbers of six characters, which may touch
            rows = [
                [float(p) for p in (t.split() if len(t.split()) == 15 else [t[i : i + 6] for i in range(0, 90, 6)])]
                for t in texts
            ]
        except ValueError:
            self.problems.append("column 'UW' does not hold fifteen numbers")
            return None
        return np.asarray(np.array(rows, dtype=np.float64).T)

    def _names(self) -> dict[str, NDArray[np.str_]]:
        wanted = [self.options.columns["name"]] if "name" in self.options.columns else NAMES
        text = [name for name in self.table.colnames if name in wanted or self._kind(name) in "US"]
        text.sort(key=lambda name: wanted.index(name) if name in wanted else len(wanted))
        return {name: self._text(name) for name in text}

    def _text(self, name: str) -> NDArray[np.str_]:
        column = self.table[name]
        if self._kind(name) in "iu" and not np.any(np.ma.getmaskarray(column)):
            return np.asarray(column).astype(np.str_)  # millions of source_id
        return np.array([" ".join(str(v).split()) for v in column])

    def _check(self, bad: NDArray[np.bool_], what: str) -> None:
        rows = np.flatnonzero(bad)
        if len(rows):
            self.problems.append(f"{what} in {named_rows(rows)}")

    def _listed(self) -> str:
        return first_of(list(self.table.colnames), 20)
