"""K' W K summed over sources: one product of a matrix with itself where W has a root, half the work of another."""

import numpy as np

from core.arrays import Array

REGULAR = 1e-6
"""The determinant of a scaled 2 x 2 matrix from which its root is taken."""


def add_products(total: Array, matrix: Array, weight: Array) -> None:
    """Add the sum over n sources of K' W K to ``total`` (K, K).

    ``matrix`` (K, r, n) and ``weight`` (n, r, r), symmetric.  ``matrix`` is overwritten.
    """
    if _apply_root(matrix, weight):
        flat = matrix.reshape(len(total), -1)
        total += flat @ flat.T  # of which NumPy computes one half
        return
    weighted = np.empty_like(matrix)
    for i in range(matrix.shape[1]):
        np.multiply(weight[:, i, i], matrix[:, i], out=weighted[:, i])
        for j in range(matrix.shape[1]):
            if i != j and np.any(element := weight[:, i, j]):
                weighted[:, i] += element * matrix[:, j]
    total += matrix.reshape(len(total), -1) @ weighted.reshape(len(total), -1).T


def _apply_root(matrix: Array, weight: Array) -> bool:
    """Replace K by L' K with W = L L'; False, and nothing done, where W is not regular of one or two parameters."""
    size = matrix.shape[1]
    first = weight[:, 0, 0]
    if size > 2 or not np.all(first > 0.0):
        return False
    if size == 1:
        matrix[:, 0] *= np.sqrt(first)
        return True
    second, cross = weight[:, 1, 1], weight[:, 0, 1]
    rest = second - cross**2 / first
    if not np.all(rest > REGULAR * second):
        return False
    root = np.sqrt(first)
    matrix[:, 0] *= root
    if np.any(cross):
        matrix[:, 0] += (cross / root) * matrix[:, 1]
    matrix[:, 1] *= np.sqrt(rest)
    return True
