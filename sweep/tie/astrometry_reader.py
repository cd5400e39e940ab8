"""The quantities of an astrometric table: values, errors, correlations, epochs and names, in rad and rad/yr."""

from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from linksweep.core.arrays import Array, Flags
from linksweep.core.blocks import PARAMETERS
from linksweep.core.constants import MAS
from linksweep.core.tie.astrometry import PAIRS, Astrometry, kinds, named_rows, positive_definite
from linksweep.core.tie.mistakes import LARGER, LARGEST, PLAUSIBLE, SMALLER
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tables.names import first_found
from linksweep.sweep.tie import hipparcos
from linksweep.sweep.tie.column_names import (
    CORRELATIONS,
    EPOCHS,
    NAMES,
    QUANTITIES,
    Positions,
    TableOptions,
    column_of,
    error_column_of,
    unit_of,
)
from linksweep.sweep.tie.column_reader import ColumnReader

FASTEST_KM_S = 5000.0
"""No star is faster: larger radial velocities are redshifts, or stand for missing ones."""

COARSE = 0.1
"""Positions that are rounded by more than this fraction of their errors are too coarse."""

TYPICAL = (0.005, 300.0)
"""Errors after a mistake in their unit is corrected, mas or mas/yr."""

EARLIEST, LATEST = 1970.0, 2060.0
"""Epochs of positions with errors below 10 mas."""


class AstrometryReader(ColumnReader):
    """Reads the quantities of one table and collects what is wrong with it."""

    def __init__(self, table: Any, where: str, options: TableOptions) -> None:
        super().__init__(table)
        self.where, self.options = where, options
        self.notes: list[str] = []
        for key, column in options.columns.items():
            if key not in QUANTITIES:
                self.problems.append(f"columns: {key} is no quantity; known are {', '.join(QUANTITIES)}")
            elif column not in table.colnames:
                self.problems.append(f"columns: no column {column!r} for {key}; there are {self.listed()}")
        if not self.problems:
            self._set_units()
        if self.problems:
            raise SweepError(self.problems, self.where)
        if not len(table):
            raise SweepError("has no rows", self.where)

    def astrometry(self) -> tuple[Astrometry, dict[str, NDArray[np.str_]]]:
        """Return the astrometry and the columns with names; raises SweepError with all that is wrong and its rows."""
        n = len(self.table)
        values, errors = np.full((2, 5, n), np.nan)
        for i, name in enumerate(PARAMETERS):
            values[i] = self._values(name, values[1])
            self.check(np.isinf(values[i]), f"an infinite {name}")
        for i, name in enumerate(PARAMETERS):
            errors[i] = self._errors(name, values[i], values[1])
        if self.problems:
            raise SweepError(self.problems, self.where)
        self._lost(np.isfinite(values) & ~np.isfinite(errors))
        self._unlikely(values, errors)
        for name, row, error in zip(PARAMETERS[:2], values, errors, strict=False):
            if (column := self._column(name)) is None:
                if not np.any(np.isfinite(values[2:])):
                    self.problems.append(f"no column {name}; there are {self.listed()}")
            elif rounding := self.rounding(column):
                size = np.abs(row) * (np.cos(values[1]) if name == "ra" else 1.0)
                what = f"positions in single precision (column {column!r}), too coarse for their errors,"
                self.check(size * rounding > COARSE * error, what)
            self.check(np.isfinite(error) & ~np.isfinite(row), f"an error but no value of {name}")
        self.check(np.abs(values[1]) > 0.5 * np.pi * (1.0 + 1e-12), "a dec outside -90..90 deg")
        self.check((values[0] < -np.pi - 1e-9) | (values[0] > 2.0 * np.pi + 1e-9), "an ra outside -180..360 deg")
        correlations = self._correlations(np.isfinite(values) & np.isfinite(errors))
        columns = {
            name: self.numbers(name)
            for name in self.table.colnames
            if getattr(self.table[name], "ndim", 2) == 1 and self.kind(name) in "fiu"
        }
        if correlations is None and np.any(np.all(np.isfinite(values) & np.isfinite(errors), axis=0)):
            self.notes.append("no correlations of the five parameters: they count as 0")
        epoch = self._epoch()
        exact = errors[0] < 10.0 * MAS
        if np.any(exact & ((epoch < EARLIEST) | (epoch > LATEST))):
            span = f"{np.nanmin(epoch[exact]):g} to {np.nanmax(epoch[exact]):g}"
            self.notes.append(f"epochs from {span}, when no position had errors below 10 mas: are they right?")
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

    def _lost(self, lost: Flags) -> None:
        """Note values (5, N) that have no error, and so decide the kind of their rows."""
        of: dict[bytes, list[int]] = {}
        for i in np.flatnonzero(lost.any(axis=1)).tolist():
            of.setdefault(lost[i].tobytes(), []).append(i)
        for places in of.values():
            rows, names = np.flatnonzero(lost[places[0]]), ", ".join(PARAMETERS[i] for i in places)
            if error_column_of(PARAMETERS[places[0]], self.table.colnames, self.options) is not None:
                self.notes.append(f"{len(rows)} rows have no error of {names}, which is not used: {named_rows(rows)}")

    def _unlikely(self, values: Array, errors: Array) -> None:
        """Note numbers of a size that no star and no instrument has, with the likely mistake in their unit."""
        for name, value, error in zip(PARAMETERS, values, errors, strict=True):
            unit = unit_of(name)
            most = np.inf if name in ("ra", "dec") else LARGEST[unit]
            if len(beyond := np.flatnonzero((np.abs(value) > most * MAS) & (np.abs(value) > 5.0 * error))):
                what = f"{name} beyond {most:g} {unit}, which no star has"
                self.notes.append(f"{what}: is its unit right? {named_rows(beyond)}")
            known = error[np.isfinite(error) & (error > 0.0)] / MAS
            if len(known) and not PLAUSIBLE[0] <= (median := float(np.median(known))) <= PLAUSIBLE[1]:
                units = (SMALLER if median < PLAUSIBLE[0] else LARGER).items()
                likely = [said for factor, said in units if TYPICAL[0] <= median * factor <= TYPICAL[1]]
                cause = f" The likely cause: {', or '.join(likely)}." if likely else ""
                what = f"errors of {name} of {median:.2g} {unit}, which no instrument has."
                self.notes.append(f"{what}{cause} Say --unit {name}_error=UNIT")

    def _set_units(self) -> None:
        """Give columns the units of the options; record a problem if a column has another one."""
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
            if quantity not in QUANTITIES or name is None:
                self.problems.append(f"units: no column of {quantity}")
            elif self.table[name].unit not in (None, unit):
                self.problems.append(f"units: {quantity} in {text}, and column {name!r} says {self.table[name].unit}")
            else:
                self.table[name].unit = unit

    def _positions(self) -> str:
        said = self.options.positions or self.table.meta.get("positions", "single-epoch")
        if said not in get_args(Positions):
            self.problems.append(f"positions {said!r}: must be {' or '.join(get_args(Positions))}")
        return str(said)

    def _column(self, quantity: str) -> str | None:
        return column_of(quantity, self.table.colnames, self.options)

    def _values(self, quantity: str, dec: Array) -> Array:
        name = self._column(quantity)
        if name is None:
            return np.full(len(self.table), np.nan)
        if quantity in ("ra", "dec"):
            return self.angle(name, hours=quantity == "ra")
        return self.in_unit(name, unit_of(quantity)) * MAS * self._cos_dec(quantity, name, dec)

    def _cos_dec(self, quantity: str, name: str, dec: Array) -> Array | float:
        """Return cos(dec) for columns along right ascension that lack this factor, as in units of time; else 1."""
        without = quantity == "pmra" and not self.options.pmra_cos_dec
        return np.cos(dec) if without or (quantity in ("ra", "pmra") and self.in_time(name)) else 1.0

    def _errors(self, quantity: str, values: Array, dec: Array) -> Array:
        name, of = error_column_of(quantity, self.table.colnames, self.options), self._column(quantity)
        if name is None:
            if np.any(np.isfinite(values)):
                self.notes.append(f"no errors of {quantity}, which counts as not measured")
            return np.full(len(self.table), np.nan)
        unit = unit_of(quantity)
        if of is not None and self.table[name].unit is None:
            self._doubtful_unit(quantity, of, name)
        found = self.in_unit(name, unit) * MAS * self._cos_dec(quantity, name, dec)
        self.check(found < 0.0, f"a negative {name}")
        zero = found == 0.0
        if self.options.zero_errors == "error":
            self.check(zero, f"a {name} of 0 (say --zero-errors missing, or exact)")
        elif self.options.zero_errors == "missing":
            found = np.where(zero, np.nan, found)
        return found

    def _doubtful_unit(self, quantity: str, of: str, name: str) -> None:
        """Note what unit an error without one is taken to have, or refuse it, if the unit of its value is unusual."""
        unit, own = unit_of(quantity), self.table[of].unit
        if quantity in ("ra", "dec"):
            if self.kind(of) in "USO":
                taken = f"{name!r} has no unit and is taken as {unit}; else say --unit {quantity}_error="
                self.notes.append(f"{of!r} is sexagesimal; {taken}{'s' if quantity == 'ra' else 'arcsec'}")
        elif own is not None and own.is_equivalent(unit) and not np.isclose(own.to(unit), 1.0):
            say = f"say --unit {quantity}_error={own} (or {unit})"
            self.problems.append(f"column {of!r} is in {own}, and {name!r} has no unit; {say}")

    def _correlations(self, present: Flags) -> Array | None:
        """Return the correlations (10, N), 0 unless both parameters are ``present`` (5, N); None without columns."""
        if hipparcos.is_hipparcos(self) and (elements := hipparcos.elements(self)) is not None:
            return hipparcos.correlations(elements)
        names = [self._column(name) for name in CORRELATIONS]
        if not any(names):
            return None
        found = np.array([np.zeros(len(self.table)) if name is None else self.numbers(name) for name in names])
        absent = []
        for row, key, name, (i, j) in zip(found, CORRELATIONS, names, PAIRS, strict=True):
            both = present[i] & present[j]
            if name is None and np.any(both):
                absent.append(key)
            if name is not None and np.any(np.isfinite(row)):  # a blank column counts as none
                self.check(both & ~np.isfinite(row), f"no {name} (write 0 for none)")
            row[~(both & np.isfinite(row))] = 0.0
        zero = f"; there is no column {', '.join(absent)}, which counts as 0:" if absent else ""
        self.check(~positive_definite(found), f"correlations that are impossible (not positive definite){zero}")
        return found

    def _epoch(self) -> Array:
        name = self._column("ref_epoch")
        if self.options.extragalactic:
            if self.options.epoch is not None:
                self.problems.append("positions of quasars hold at any epoch: give no epoch, or not --extragalactic")
            return np.full(len(self.table), np.nan)
        if self.options.epoch is not None:
            return np.full(len(self.table), self.options.epoch)
        if name is None:
            if self.table.meta.get("extragalactic") is True:
                return np.full(len(self.table), np.nan)
            if hipparcos.is_hipparcos(self):
                return np.full(len(self.table), hipparcos.EPOCH)
            if self._column("ra") is not None:
                self.problems.append(
                    "no column ref_epoch; give the epochs of the positions in one, or one epoch for all with "
                    "--satellite-epoch or --reference-epoch; positions of quasars hold at any epoch: say "
                    "--extragalactic satellite or --extragalactic reference"
                )
            return np.full(len(self.table), np.nan)
        known = len(self.problems)
        values = self.julian_years(name)
        if len(self.problems) == known:
            self.check(np.isnan(values), f"no epoch (column {name!r})")
            wrong = f"an epoch (column {name!r}) that is no Julian year, MJD or JD from {EPOCHS[0]:g} to {EPOCHS[1]:g}"
            self.check((values < EPOCHS[0]) | (values > EPOCHS[1]), wrong)
        return values

    def _radial_velocity(self) -> Array | None:
        if (name := self._column("radial_velocity")) is None:
            return None
        found = self.in_unit(name, "km/s")
        if len(beyond := np.flatnonzero(np.abs(found) > FASTEST_KM_S)):
            what = f"{name} beyond {FASTEST_KM_S:g} km/s, which no star has, is not used"
            self.notes.append(f"{what}: {named_rows(beyond)}")
        return np.where(np.abs(found) > FASTEST_KM_S, np.nan, found)

    def _names(self) -> dict[str, NDArray[np.str_]]:
        wanted = [self.options.columns["name"]] if "name" in self.options.columns else NAMES
        place = {name: len(wanted) for name in self.table.colnames if self.kind(name) in "US"}
        for k, key in reversed(list(enumerate(wanted))):
            if (name := first_found([key], self.table.colnames)) is not None:
                place[name] = k
        return {name: self.text(name) for name in sorted(place, key=lambda name: place[name])}
