"""The ten correlations of each row of a table: from columns of their own, or from Hipparcos-2's matrix U."""

import numpy as np
from numpy.typing import NDArray

from core.arrays import Array
from core.tie.astrometry import PAIRS, positive_definite
from sweep.tie import hipparcos
from sweep.tie.column_names import CORRELATIONS, TableOptions, column_of
from sweep.tie.column_reader import ColumnReader


def correlations_of(reader: ColumnReader, options: TableOptions, present: NDArray[np.bool_]) -> Array | None:
    """Return the correlations (10, N) between what is ``present`` (5, N), 0 elsewhere; None for a table without any.

    What is wrong with them is noted by the reader.
    """
    if hipparcos.is_hipparcos(reader) and (elements := hipparcos.elements(reader)) is not None:
        return hipparcos.correlations(elements)
    names = [column_of(name, reader.table.colnames, options) for name in CORRELATIONS]
    if not any(names):
        return None
    found = np.array([np.zeros(len(reader.table)) if name is None else reader.numbers(name) for name in names])
    absent = []
    for row, key, name, (i, j) in zip(found, CORRELATIONS, names, PAIRS, strict=True):
        both = present[i] & present[j]
        if name is None and np.any(both):
            absent.append(key)
        if name is not None and np.any(np.isfinite(row)):  # a column of blanks is as none
            reader.check(both & ~np.isfinite(row), f"no {name} (write 0 for none)")
        row[~(both & np.isfinite(row))] = 0.0
    zero = f"; there is no column {', '.join(absent)}, which counts as 0:" if absent else ""
    reader.check(~positive_definite(found), f"correlations that are impossible (not positive definite){zero}")
    return found
