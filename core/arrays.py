"""The types of arrays in this package, and sums over the objects of a catalogue.

Catalogues of one size may be computed together, as a stack: then arrays have a leading axis of catalogues.  What
belongs to one of them does not depend, to the last bit, on the others: sums go over the objects of each by itself.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

Stack = tuple[int, ...]
"""The leading axis of arrays: none for one catalogue, the number of catalogues for a stack."""


def product_sum(a: Array, b: Array) -> Array:
    """Return the sum of a b over objects, observables and realisations, the last three axes; shape (...)."""
    stack = a.shape[:-3]
    return np.asarray(np.vecdot(a.reshape(*stack, -1), b.reshape(*stack, -1)))


def transposed_product(a: Array, b: Array) -> Array:
    """Return a^T b, summed over objects and observables, of shapes (..., n, 4, A) and (..., n, 4, B); (..., A, B)."""
    stack = a.shape[:-3]
    return np.asarray(a.reshape(*stack, -1, a.shape[-1]).swapaxes(-1, -2) @ b.reshape(*stack, -1, b.shape[-1]))
