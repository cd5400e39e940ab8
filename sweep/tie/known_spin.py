"""A spin that is known and taken out before the solution: a vector, or a table by bins of a column."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from core.arrays import Array
from core.blocks import Rotation, SpinByBin
from core.constants import MAS
from core.tie.astrometry import Astrometry
from core.unknowns import Unknowns
from sweep.contract import SweepError
from sweep.tables.reader import read_table


def known_spin(spin: Sequence[float] | str | Path, own: Astrometry, sign: float) -> tuple[Unknowns, Array]:
    """Return the block and the values (rad/yr) of a spin that is known: a vector, or a table by bins of a column.

    A table has columns COLUMN_min and COLUMN_max of the satellite's magnitude (or other) COLUMN, or mag_min and
    mag_max of phot_g_mean_mag, and omega_x, omega_y, omega_z in mas/yr or their unit.  Raises SweepError for anything
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
    vectors = np.stack(
        [
            np.asarray(table[f"omega_{axis}"], dtype=np.float64)
            * (units.Unit(table[f"omega_{axis}"].unit or "mas/yr").to("mas/yr"))
            for axis in "xyz"
        ],
        axis=1,
    )
    edges, used = tuple(low_edges[1:].tolist()), tuple(range(len(low_edges)))
    block = SpinByBin(column=column, edges=edges, used=used)
    return Unknowns((block,)), sign * vectors.ravel() * MAS
