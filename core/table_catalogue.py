"""A reference catalogue from the columns of a table: positions, motions, magnitudes, and the errors of either side."""

from collections.abc import Collection, Mapping
from typing import Any, Protocol

import numpy as np

from linksweep.core.catalogue import SIDES, Catalogue, OwnErrors
from linksweep.core.frames import DEGREE, MAS

OBSERVABLES = ("ra", "dec", "pmra", "pmdec")
CORRELATIONS = {f"{a}_{b}_corr": (i, j) for i, a in enumerate(OBSERVABLES) for j, b in enumerate(OBSERVABLES) if i < j}
ERRORS = (*(f"{observable}_error" for observable in OBSERVABLES), *CORRELATIONS)
POSITION_ERRORS, MOTION_ERRORS = {"ra_error", "dec_error"}, {"pmra_error", "pmdec_error"}
QUANTITIES = (*OBSERVABLES, "v_mag", *ERRORS, *(f"{side}_{name}" for side in SIDES for name in ERRORS))
"""What is read.  Errors and correlations may be those of one side: reference_pmra_error beside satellite_pmra_error."""

GAIA_MARKS = ("source_id", "designation", "solution_id")
"""A table with one of these columns is Gaia's, so its pmra is known to include cos(dec)."""


class Table(Protocol):
    """Columns by name; equal tables have equal columns."""

    def __hash__(self) -> int: ...

    def columns(self, columns: Mapping[str, str], units: Mapping[str, str], known: Collection[str]) -> Any:
        """Return a reader of the columns in deg, mas and mas/yr, the platform's `Columns`; names and units are those of
        some of the ``known`` quantities.
        """

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
    Gaia's, a column pm_ra_cosdec or one in seconds of time.  Raises an error that says what is ambiguous, impossible
    or missing, with rows counted from 1.
    """
    read = table.columns(columns, units or {}, QUANTITIES)
    for name in ERRORS:
        pair = {read.name(f"{side}_{name}") for side in SIDES}
        if len(pair) == 1 and pair != {None}:
            read.problems.append(f"columns: reference_{name} and satellite_{name} are both column {pair.pop()!r}")
    moving = read.has("pmra") or read.has("pmdec")
    for quantity in OBSERVABLES if moving else OBSERVABLES[:2]:
        read.require(quantity)
    read.finish()
    ra, dec = read.quantity("ra"), read.quantity("dec")
    hint = "; are ra and dec swapped?" if np.all(np.abs(ra) <= 90.0) else ""
    read.check(np.abs(dec) >= 90.0, "a dec that is not between -90 and 90 deg, poles excluded,", dec, hint)
    read.check((ra < -180.0) | (ra > 360.0), "an ra that is not between -180 and 360 deg", ra)
    pmra, pmdec = np.zeros((2, len(ra)))
    if moving:
        name = read.name("pmra")
        known = read.in_time("pmra") or name == "pm_ra_cosdec" or any(mark in read.names for mark in GAIA_MARKS)
        if pmra_cos_dec is None and not known:
            read.problems.append(f"column {name!r} may or may not include cos(dec): say pmra_cos_dec = true or false")
        pmra, pmdec = read.quantity("pmra", cos_dec=pmra_cos_dec), read.quantity("pmdec")
    both, reference, satellite = (_own_errors(read, side, len(ra)) for side in ("", *SIDES))
    own = satellite or both
    v_mag = read.quantity("v_mag") if read.has("v_mag") else np.full(len(ra), np.nan)
    read.finish()
    return Catalogue(
        ra=ra * DEGREE,
        dec=dec * DEGREE,
        pmra=pmra * MAS,
        pmdec=pmdec * MAS,
        v_mag=v_mag,
        sigma=None if own is None else own.sigma,
        correlation=None if own is None else own.correlation,
        reference=reference or (both if satellite else None),
    )


def _own_errors(read: Any, side: str, n_obj: int) -> OwnErrors | None:
    """Return the errors that a table has for a side, or "" for those of no side; None if there are none.

    A side with some of its own, but neither those of both motions nor those of the position alone, is a problem.
    """
    prefix = f"{side}_" if side else ""
    present = [name for name in ERRORS if read.has(f"{prefix}{name}")]
    of_motions = MOTION_ERRORS.intersection(present)
    if of_motions != MOTION_ERRORS and (of_motions or not POSITION_ERRORS.issubset(present)):
        if side and present:
            read.problems.append(
                f"columns: {prefix}{present[0]} needs {prefix}pmra_error and {prefix}pmdec_error beside it"
            )
        return None
    sigma, correlation = np.zeros((len(OBSERVABLES), n_obj)), np.tile(np.eye(4), (n_obj, 1, 1))
    for row, observable in zip(sigma, OBSERVABLES, strict=True):
        quantity = f"{prefix}{observable}_error"
        if read.has(quantity):
            row[:] = read.quantity(quantity)
            read.check(row < 0.0, f"a negative {quantity}", row)
    pairs = [name for name in CORRELATIONS if name in present]
    for name in pairs:
        i, j = CORRELATIONS[name]
        correlation[:, i, j] = correlation[:, j, i] = np.nan_to_num(read.quantity(f"{prefix}{name}"))
    if not pairs:
        return OwnErrors(sigma * MAS)
    smallest = np.linalg.eigvalsh(correlation)[:, 0]
    read.check(smallest <= 1e-9, "impossible correlations (not positive definite)")
    return OwnErrors(sigma * MAS, correlation)
