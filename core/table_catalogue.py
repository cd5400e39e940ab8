"""A reference catalogue from the columns of a table, with the Gaia archive's names by default."""

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from core.catalogue import Catalogue
from core.constants import DEGREE, MAS

Array = NDArray[np.float64]

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
"""The quantities that are read and the units they have where the table does not say."""

OBSERVABLES = ("ra", "dec", "pmra", "pmdec")
CORRELATIONS = {f"{a}_{b}_corr": (i, j) for i, a in enumerate(OBSERVABLES) for j, b in enumerate(OBSERVABLES) if i < j}
QUANTITIES = (*UNITS, *CORRELATIONS)
DEFAULT_COLUMNS: Mapping[str, tuple[str, ...]] = {"v_mag": ("v_mag", "phot_g_mean_mag", "vt_mag")}
GAIA_MARKS = ("source_id", "designation", "solution_id")
"""A table with one of these columns is Gaia's, so its pmra is known to include cos(dec)."""


class Table(Protocol):
    """Columns by name; equal tables have equal columns."""

    def __hash__(self) -> int: ...

    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        ...

    def numbers(self, name: str, unit: str) -> Array:
        """Return a column of finite numbers in a unit."""
        ...

    def label(self, row: int) -> str:
        """Return what the table calls a row, counted from 0; empty where it has no column of names."""
        ...


def catalogue_from_table(table: Table, columns: Mapping[str, str], pmra_cos_dec: bool | None) -> Catalogue:
    """Return the objects of a table; ``columns`` maps a quantity of `QUANTITIES` to the table's name for it.

    Positions are required; proper motions are zero where the table has none, magnitudes NaN.  Errors are taken if
    there are those of both proper motions; a position without error columns counts as exact.  ``pmra_cos_dec`` says
    whether pmra includes cos(dec); None is good only for a table of Gaia's or a column pm_ra_cosdec.  Raises
    ValueError that says what is ambiguous, impossible or missing, with rows counted from 1.
    """
    unknown = sorted(set(columns) - set(QUANTITIES))
    if unknown:
        raise ValueError(f"columns: {', '.join(unknown)} is no quantity; known are {', '.join(QUANTITIES)}")
    names = {quantity: _name(table, columns, quantity) for quantity in QUANTITIES}

    def read(quantity: str) -> Array:
        return table.numbers(names[quantity] or quantity, UNITS.get(quantity, ""))

    ra, dec = read("ra"), read("dec")
    _check_rows(np.abs(dec) < 90.0, "dec is not between -90 and 90 deg, poles excluded,")
    _check_rows((ra >= -180.0) & (ra <= 360.0), "ra is not between -180 and 360 deg")
    n_obj = len(ra)
    moving = names["pmra"] is not None or names["pmdec"] is not None
    pmra, pmdec = (read("pmra"), read("pmdec")) if moving else (np.zeros(n_obj), np.zeros(n_obj))
    if moving and not _includes_cos_dec(table, str(names["pmra"]), pmra_cos_dec):
        pmra = pmra * np.cos(dec * DEGREE)
    return Catalogue(
        ra=ra * DEGREE,
        dec=dec * DEGREE,
        pmra=pmra * MAS,
        pmdec=pmdec * MAS,
        v_mag=read("v_mag") if names["v_mag"] else np.full(n_obj, np.nan),
        sigma=_errors(read, names, n_obj),
        correlation=_correlation(read, names, n_obj),
    )


def _name(table: Table, columns: Mapping[str, str], quantity: str) -> str | None:
    if quantity in columns:
        return columns[quantity]
    candidates = DEFAULT_COLUMNS.get(quantity, (quantity,))
    return next((name for name in candidates if name in table.names()), None)


def _includes_cos_dec(table: Table, name: str, declared: bool | None) -> bool:
    if declared is not None:
        return declared
    if name == "pm_ra_cosdec" or any(mark in table.names() for mark in GAIA_MARKS):
        return True
    raise ValueError(f"column {name!r} may or may not include cos(dec): say pmra_cos_dec = true or false")


def _errors(read: "_Read", names: Mapping[str, str | None], n_obj: int) -> Array | None:
    if names["pmra_error"] is None or names["pmdec_error"] is None:
        return None
    rows = [read(f"{o}_error") if names[f"{o}_error"] else np.zeros(n_obj) for o in OBSERVABLES]
    for observable, row in zip(OBSERVABLES, rows, strict=True):
        _check_rows(row >= 0.0, f"{observable}_error is negative")
    return np.stack(rows) * MAS


def _correlation(read: "_Read", names: Mapping[str, str | None], n_obj: int) -> Array | None:
    present = {quantity: place for quantity, place in CORRELATIONS.items() if names[quantity] is not None}
    if not present:
        return None
    matrices = np.tile(np.eye(4), (n_obj, 1, 1))
    for quantity, (i, j) in present.items():
        matrices[:, i, j] = matrices[:, j, i] = read(quantity)
    _check_rows(np.linalg.eigvalsh(matrices)[:, 0] > 1e-9, "correlations are impossible (not positive definite)")
    return matrices


def _check_rows(good: NDArray[np.bool_], what: str) -> None:
    if not np.all(good):
        bad = np.flatnonzero(~good) + 1
        raise ValueError(f"{what} in row {', '.join(map(str, bad[:5]))}{' and more' if len(bad) > 5 else ''}")


class _Read(Protocol):
    def __call__(self, quantity: str) -> Array: ...
