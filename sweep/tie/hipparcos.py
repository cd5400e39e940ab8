"""Correlations of Hipparcos-2 from its matrix U; its errors are those of its columns."""

import numpy as np

from core.arrays import Array
from core.tie.astrometry import PAIRS

EPOCH = 1991.25

_PLACES = [(i, j) for j in range(5) for i in range(j + 1)]
"""Row and column of U1 to U15, column by column.  Source: Michalik et al. 2014, A&A 571, A85, appendix B."""


def correlations(elements: Array) -> Array:
    """Return the ten correlations (10, N) from the elements U1..U15 (15, N): C is (U'U)^-1 up to a factor."""
    upper = np.zeros((elements.shape[1], 5, 5))
    for (i, j), element in zip(_PLACES, elements, strict=True):
        upper[:, i, j] = element
    half = np.linalg.inv(upper)
    covariance = half @ half.swapaxes(1, 2)
    sigma = np.sqrt(np.einsum("nii->ni", covariance))
    return np.array([covariance[:, i, j] / (sigma[:, i] * sigma[:, j]) for i, j in PAIRS])
