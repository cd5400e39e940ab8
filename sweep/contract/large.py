"""Large arrays of results: how large they are, and in which chunks they are stored."""

import math
from collections.abc import Sequence

import numpy as np

MOST_VALUES = 2**20
"""The most values of a chunk of results, 8 MB of floats.  Values are counted and not bytes, so that results on the same
axes have the same chunks whatever their types, as Dask wants.
"""

REFERENCE = np.dtype("V16")
"""What a row has in place of each chunk of a large array: the checksum of its file; zeros are none."""


def is_large(shape: Sequence[int]) -> bool:
    """Return whether an array of this shape at a point is large: no chunk has two points."""
    return math.prod(shape) > MOST_VALUES // 2


def chunk_shape(shape: Sequence[int]) -> tuple[int, ...]:
    """Return a shape for chunks of at most `MOST_VALUES` that are whole in the last dimensions: a point's values stay
    together, and a coordinate is one chunk.
    """
    chunk = list(shape)
    for axis in range(len(chunk)):
        rest = math.prod(chunk[axis + 1 :])
        chunk[axis] = max(1, min(chunk[axis], MOST_VALUES // max(1, rest)))
        if chunk[axis] > 1:
            break
    return tuple(chunk)


def chunk_grid(shape: Sequence[int]) -> tuple[int, ...]:
    """Return how many chunks an array of this shape has along each dimension."""
    return tuple(-(-n // size) for n, size in zip(shape, chunk_shape(shape), strict=True))
