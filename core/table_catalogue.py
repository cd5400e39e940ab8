"""A reference catalogue from the columns of a table, with the Gaia archive's names by default."""

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from linksweep.core.arrays import Array, Flags
from linksweep.core.catalogue import SIDES, Catalogue, OwnErrors
from linksweep.core.constants import DEGREE, MAS

UNITS: Mapping[str, str] = {
    "ra": "deg",
    "dec": "deg",
    "pmra": "mas / yr",
    "pmdec": "mas / yr",
    "v_mag": "mag",
    "ra_error": "mas",
    "dec_error": "mas",
    "pmra_error": "mas / yr",
    "pmdec_error": "mas / yr",
}
"""The quantities that are read, and their units where the table gives none."""

OBSERVABLES = ("ra", "dec", "pmra", "pmdec")
CORRELATIONS = {f"{a}_{b}_corr": (i, j) for i, a in enumerate(OBSERVABLES) for j, b in enumerate(OBSERVABLES) if i < j}
ERRORS = (*(f"{observable}_error" for observable in OBSERVABLES), *CORRELATIONS)
POSITION_ERRORS, MOTION_ERRORS = {"ra_error", "dec_error"}, {"pmra_error", "pmdec_error"}
QUANTITIES = (*UNITS, *CORRELATIONS, *(f"{side}_{name}" for side in SIDES for name in ERRORS))
"""Errors and correlations may be those of one side: reference_pmra_error beside satellite_pmra_error."""

ALONG_RA = ("ra", "ra_error", "pmra", "pmra_error")
DEFAULT_COLUMNS: Mapping[str, tuple[str, ...]] = {"v_mag": ("v_mag", "phot_g_mean_mag", "vt_mag")}
GAIA_MARKS = ("source_id", "designation", "solution_id")
"""A table with one of these columns is Gaia's, so its pmra is known to include cos(dec)."""

ROWS_NAMED = 5


class Table(Protocol):
    """Columns by name; equal tables have equal columns."""

    def __hash__(self) -> int: ...

    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""

    def numbers(self, name: str, unit: str, stated: str | None = None, right_ascension: bool = False) -> Array:
        """Return a column of finite numbers in a unit; ``stated`` is the unit where the file gives none."""

    def in_time(self, name: str, stated: str | None = None) -> bool:
        """Return whether a column is in units of time, as seconds of right ascension, which lack cos(dec)."""

    def label(self, row: int) -> str:
        """Return what the table calls a row, counted from 0; empty where it has no column of names."""


def catalogue_from_table(
    table: Table, columns: Mapping[str, str], pmra_cos_dec: bool | None, units: Mapping[str, str] | None = None
) -> Catalogue:
    """Return the objects of a table; ``columns`` maps a quantity of `QUANTITIES` to the table's name for it.

    Positions are required; proper motions are zero where the table has none, magnitudes NaN.  Errors are read if
    both proper motions have them, or the position alone; a quantity without an error column counts as exact.  A side
    with columns of its own, like reference_pmra_error, uses only these.  ``units`` are those of quantities for which
    the table has none.  ``pmra_cos_dec`` says whether pmra includes cos(dec); None is allowed only for a table of
    Gaia's, a column pm_ra_cosdec or one in seconds of time.  Raises ValueError that says what is ambiguous, impossible
    or missing, with rows counted from 1.
    """
    reader = _Reader(table, columns, units or {})
    ra, dec = reader.read("ra"), reader.read("dec")
    swapped = "; are ra and dec swapped?" if np.all(np.abs(ra) <= 90.0) else ""
    _check_rows(np.abs(dec) < 90.0, dec, "dec is not between -90 and 90 deg, poles excluded,", swapped)
    _check_rows((ra >= -180.0) & (ra <= 360.0), ra, "ra is not between -180 and 360 deg")
    reader.cos_dec = np.cos(dec * DEGREE)
    n_obj = len(ra)
    moving = reader.has("pmra") or reader.has("pmdec")
    pmra, pmdec = (reader.read("pmra"), reader.read("pmdec")) if moving else (np.zeros(n_obj), np.zeros(n_obj))
    if moving and not reader.includes_cos_dec(pmra_cos_dec):
        pmra = pmra * reader.cos_dec
    both, reference, satellite = (reader.errors(side) for side in ("", *SIDES))
    own = satellite or both
    return Catalogue(
        ra=ra * DEGREE,
        dec=dec * DEGREE,
        pmra=pmra * MAS,
        pmdec=pmdec * MAS,
        v_mag=reader.read("v_mag") if reader.has("v_mag") else np.full(n_obj, np.nan),
        sigma=None if own is None else own.sigma,
        correlation=None if own is None else own.correlation,
        reference=reference or (both if satellite else None),
    )


class _Reader:
    """Reads quantities of a table by their names and units."""

    def __init__(self, table: Table, columns: Mapping[str, str], units: Mapping[str, str]) -> None:
        for what, given in (("columns", columns), ("units", units)):
            unknown = sorted(set(given) - set(QUANTITIES if what == "columns" else set(QUANTITIES) - set(CORRELATIONS)))
            if unknown:
                raise ValueError(f"{what}: {', '.join(unknown)} is no quantity; known are {', '.join(QUANTITIES)}")
        self.table, self.columns, self.units = table, columns, units
        self.cos_dec = np.ones(1)
        for name in ERRORS:
            pair = {self.name(f"{side}_{name}") for side in SIDES}
            if len(pair) == 1 and pair != {None}:
                raise ValueError(f"columns: reference_{name} and satellite_{name} are both column {pair.pop()!r}")

    def name(self, quantity: str) -> str | None:
        """Return the name of a quantity's column, None where the table has none."""
        if quantity in self.columns:
            return self.columns[quantity]
        candidates = DEFAULT_COLUMNS.get(quantity, (quantity,))
        return next((name for name in candidates if name in self.table.names()), None)

    def has(self, quantity: str) -> bool:
        """Return whether the table has a quantity."""
        return self.name(quantity) is not None

    def read(self, quantity: str) -> Array:
        """Return a quantity in its unit of `UNITS`; an error in seconds of time gets its cos(dec)."""
        name, plain = self.name(quantity) or quantity, quantity.removeprefix("reference_").removeprefix("satellite_")
        stated = self.units.get(quantity)
        values = self.table.numbers(name, UNITS.get(plain, ""), stated, plain in ALONG_RA)
        if plain in ALONG_RA[1:] and plain != "pmra" and self.table.in_time(name, stated):
            values = values * self.cos_dec
        return values

    def includes_cos_dec(self, declared: bool | None) -> bool:
        """Return whether pmra includes cos(dec), as declared or as the table shows."""
        name = str(self.name("pmra"))
        if declared is not None:
            return declared
        if self.table.in_time(name, self.units.get("pmra")):
            return False
        if name == "pm_ra_cosdec" or any(mark in self.table.names() for mark in GAIA_MARKS):
            return True
        raise ValueError(f"column {name!r} may or may not include cos(dec): say pmra_cos_dec = true or false")

    def errors(self, side: str) -> OwnErrors | None:
        """Return the errors that are given for a side, or "" for those of no side; None if there are none.

        Raises ValueError for a side with some of its own, but neither those of both motions nor those of the position
        alone.
        """
        prefix = f"{side}_" if side else ""
        given = [name for name in ERRORS if self.has(f"{prefix}{name}")]
        of_motions = MOTION_ERRORS.intersection(given)
        if of_motions != MOTION_ERRORS and (of_motions or not POSITION_ERRORS.issubset(given)):
            if side and given:
                raise ValueError(
                    f"columns: {prefix}{given[0]} needs {prefix}pmra_error and {prefix}pmdec_error beside it"
                )
            return None
        rows = np.zeros((len(OBSERVABLES), len(self.cos_dec)))
        for row, observable in zip(rows, OBSERVABLES, strict=True):
            quantity = f"{prefix}{observable}_error"
            if self.has(quantity):
                row[:] = self.read(quantity)
                _check_rows(row >= 0.0, row, f"{quantity} is negative")
        return OwnErrors(rows * MAS, self._correlation(prefix, rows.shape[1]))

    def _correlation(self, prefix: str, n_obj: int) -> Array | None:
        present = {f"{prefix}{name}": place for name, place in CORRELATIONS.items() if self.has(f"{prefix}{name}")}
        if not present:
            return None
        matrices = np.tile(np.eye(4), (n_obj, 1, 1))
        for quantity, (i, j) in present.items():
            matrices[:, i, j] = matrices[:, j, i] = self.read(quantity)
        smallest = np.linalg.eigvalsh(matrices)[:, 0]
        _check_rows(smallest > 1e-9, None, "correlations are impossible (not positive definite)")
        return matrices


def _check_rows(good: Flags, values: Array | None, what: str, hint: str = "") -> None:
    if np.all(good):
        return
    bad = np.flatnonzero(~good)
    shown = [f"{row + 1}" if values is None else f"{row + 1} ({values[row]:.10g})" for row in bad[:ROWS_NAMED]]
    raise ValueError(f"{what} in row {', '.join(shown)}{' and more' if len(bad) > ROWS_NAMED else ''}{hint}")
