"""Hipparcos-2: correlations from its matrix U; the errors are in columns of their own."""

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.tie.astrometry import PAIRS
from linksweep.sweep.tie.column_reader import ColumnReader

EPOCH = 1991.25

_PLACES = [(i, j) for j in range(5) for i in range(j + 1)]
"""Row and column of U1 to U15, column by column.  Source: Michalik et al. 2014, A&A 571, A85, appendix B."""


def is_hipparcos(reader: ColumnReader) -> bool:
    """Return whether a table has the column RArad, by which Hipparcos-2 is recognised."""
    return any(name.casefold() == "rarad" for name in reader.table.colnames)


def elements(reader: ColumnReader) -> Array | None:
    """Return U1..U15 of Hipparcos-2 from fifteen columns, one column of arrays or one of text; None without them."""
    for stem in ("UW", "U"):
        if all(f"{stem}{k}" in reader.table.colnames for k in range(1, 16)):
            return np.asarray([reader.numbers(f"{stem}{k}") for k in range(1, 16)], dtype=np.float64)
    if "UW" not in reader.table.colnames:
        return None
    column = np.asarray(reader.table["UW"])
    if column.ndim == 2:
        return np.asarray(np.asarray(column, dtype=np.float64).T)
    texts = [str(text) for text in column]
    try:  # fifteen numbers of six characters, which may touch
        rows = [
            [float(p) for p in (t.split() if len(t.split()) == 15 else [t[i : i + 6] for i in range(0, 90, 6)])]
            for t in texts
        ]
    except ValueError:
        reader.problems.append("column 'UW' does not hold fifteen numbers")
        return None
    return np.asarray(np.array(rows, dtype=np.float64).T)


def correlations(elements: Array) -> Array:
    """Return the ten correlations (10, N) from the elements U1..U15 (15, N): C is (U'U)^-1 up to a factor."""
    upper = np.zeros((elements.shape[1], 5, 5))
    for (i, j), element in zip(_PLACES, elements, strict=True):
        upper[:, i, j] = element
    half = np.linalg.inv(upper)
    covariance = half @ half.swapaxes(1, 2)
    sigma = np.sqrt(np.einsum("nii->ni", covariance))
    return np.array([covariance[:, i, j] / (sigma[:, i] * sigma[:, j]) for i, j in PAIRS])
