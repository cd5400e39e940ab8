"""What is done to the rows of a reference before the solution: jitter, Galactic aberration, and a known spin."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.blocks import Rotation, SpinByBin
from linksweep.core.constants import GALACTIC_AXES, MAS
from linksweep.core.frames import triad
from linksweep.core.tie.astrometry import KINDS, PAIRS, Astrometry, kinds
from linksweep.core.unknowns import Unknowns
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tables.reader import read_table

ICRF3_EPOCH = 2015.0

ALL = "all"
"""Stands for every kind of row that has no jitter of its own."""


def with_jitter(rows: Astrometry, jitter: Mapping[str, tuple[float, float]]) -> Astrometry:
    """Return rows with (mas, mas/yr) added in quadrature to the errors of each kind, or of "all"; covariances do not
    change.

    Raises SweepError for sizes that are negative or not finite, unknown kinds, and kinds of which there is no row.
    """
    if not jitter:
        return rows
    known = [*KINDS.values(), "single epoch", ALL]
    if unknown := sorted(set(jitter) - set(known)):
        raise SweepError(f"jitter: no kind of row {', '.join(unknown)}; kinds are {', '.join(known)}")
    of = kinds(rows)
    if absent := sorted(set(jitter) - {ALL, *of.tolist()}):
        raise SweepError(f"jitter: no row is of the kind {', '.join(absent)}; there are {', '.join(np.unique(of))}")
    added = np.zeros_like(rows.errors)
    for kind, (position, motion) in jitter.items():
        if not (0.0 <= position < np.inf and 0.0 <= motion < np.inf):
            raise SweepError(f"jitter of {kind}: {position:g}, {motion:g}: must be finite and not negative")
        at = of == kind if kind != ALL else ~np.isin(of, list(jitter))  # a kind that is named has its own
        added[:, at] = MAS * np.array([position, position, position, motion, motion])[:, None]
    errors = np.hypot(rows.errors, added)
    correlations = rows.correlations
    if correlations is not None:
        with np.errstate(invalid="ignore", divide="ignore"):
            shrunk = np.where(errors > 0.0, rows.errors / errors, 1.0)
        correlations = np.array([c * shrunk[i] * shrunk[j] for c, (i, j) in zip(correlations, PAIRS, strict=True)])
    return replace(rows, errors=errors, correlations=correlations)


def aberrated(rows: Astrometry, to_epoch: Array, aberration: float) -> Astrometry:
    """Return positions without an epoch carried from 2015.0 to another by the Galactic aberration (uas/yr).

    Sources appear to move towards the Galactic centre.  Source: Charlot et al. 2020, A&A 644, A159.  Raises SweepError
    if there are no such positions.
    """
    if not np.any(rows.present[0] & np.isnan(rows.epoch) & np.isfinite(to_epoch)):
        raise SweepError(
            "aberration carries positions without an epoch from 2015.0 to that of their source, and no row of the "
            "reference is such a position"
        )
    p, q, _ = triad(rows.values[0], rows.values[1])
    years = np.where(np.isfinite(rows.epoch) | ~np.isfinite(to_epoch), 0.0, to_epoch - ICRF3_EPOCH)
    glide = GALACTIC_AXES[0] * aberration * MAS / 1000.0
    values = rows.values.copy()
    values[0] += years * (glide @ p) / np.cos(rows.values[1])
    values[1] += years * (glide @ q)
    return replace(rows, values=values)


def known_spin(spin: Sequence[float] | str | Path, own: Astrometry, sign: float) -> tuple[Unknowns, Array]:
    """Return the block and the values (rad/yr) of a spin that is known: a vector, or a table by bins of a column.

    A table has columns COLUMN_min and COLUMN_max of the satellite's magnitude (or other) COLUMN, or mag_min and
    mag_max for phot_g_mean_mag, and omega_x, omega_y, omega_z in mas/yr or their unit.  Raises SweepError for anything
    else, and for sources outside its bins.
    """
    if not isinstance(spin, (str, Path)):
        vector = np.asarray(spin, dtype=np.float64)
        if vector.shape != (3,) or not np.all(np.isfinite(vector)):
            raise SweepError(f"known spin {spin!r}: give three numbers in mas/yr, or the path of a table")
        return Unknowns((Rotation(),)), sign * vector * MAS
    from astropy import units

    table = read_table(Path(spin))
    lows = [name for name in table.colnames if name.endswith("_min")]
    if len(lows) != 1 or (high := lows[0][:-4] + "_max") not in table.colnames:
        raise SweepError("a table of spins has one column COLUMN_min and one COLUMN_max", str(spin))
    if missing := [f"omega_{axis}" for axis in "xyz" if f"omega_{axis}" not in table.colnames]:
        raise SweepError(f"no column {', '.join(missing)}", str(spin))
    table.sort(lows[0])
    low_edges, high_edges = (np.asarray(table[name], dtype=np.float64) for name in (lows[0], high))
    column = {"mag": "phot_g_mean_mag", "G": "phot_g_mean_mag"}.get(lows[0][:-4], lows[0][:-4])
    if column not in own.columns:
        raise SweepError(f"the satellite has no column {column!r} of numbers for the known spin", str(spin))
    if np.any(low_edges[1:] != high_edges[:-1]) or np.any(high_edges <= low_edges):
        raise SweepError(f"the bins of {lows[0]} and {high} do not follow one another", str(spin))
    values = own.columns[column]
    outside = ~((values >= low_edges[0]) & (values < high_edges[-1]))
    if np.any(outside):
        raise SweepError(f"{np.count_nonzero(outside)} matched sources have a {column} outside its bins", str(spin))
    components = (table[f"omega_{axis}"] for axis in "xyz")
    in_unit = [np.asarray(c, dtype=np.float64) * units.Unit(c.unit or "mas/yr").to("mas/yr") for c in components]
    vectors = np.stack(in_unit, axis=1)
    edges, used = tuple(low_edges[1:].tolist()), tuple(range(len(low_edges)))
    block = SpinByBin(column=column, edges=edges, used=used)
    return Unknowns((block,)), sign * vectors.ravel() * MAS
