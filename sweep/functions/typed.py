"""Results of points as an array of their own type, also where some points have none."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.functions.layout import EXACT_INT

MISSING_INT = np.iinfo(np.int64).min
"""Stands for a missing integer where some integer of the array is too large to be a float."""


def typed_array(
    results: NDArray[Any] | None, done: NDArray[np.bool_], shape: tuple[int, ...], texts: Mapping[bytes, str]
) -> NDArray[Any]:
    """Return an array (points, *shape) with the results (done points, *shape) at the points that are done.

    Floats and times are NaN and NaT elsewhere, texts empty.  Integers and truth values keep their type where all points
    are done; else they become floats with NaN, or stay integers with `MISSING_INT` where one is beyond 2**53.
    ``texts`` are those that digests in the results stand for.
    """
    whole = (len(done), *shape)
    if results is None:
        return np.full(whole, np.nan)
    if results.dtype.kind == "V":
        found = np.full(whole, "", dtype=object)
        known = [texts[digest.tobytes()] for digest in results.reshape(-1)]
        found[done] = np.array(known, dtype=object).reshape(results.shape)
        return found
    if results.dtype.kind == "M":
        times = np.full(whole, np.datetime64("NaT", "ns"))
        times[done] = results
        return times
    if done.all():
        return np.array(results.reshape(whole))
    if results.dtype.kind == "i" and np.any((results > EXACT_INT) | (results < -EXACT_INT)):
        integers = np.full(whole, MISSING_INT)
        integers[done] = results
        return integers
    values = np.full(whole, np.nan)
    values[done] = results
    return values
