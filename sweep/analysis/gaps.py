"""What results lack, and where numbers are kept to the last digit."""

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from linksweep.sweep.planning.point_status import Status, count_status, unfinished_in_words


def lacking(dataset: xr.Dataset) -> str:
    """Return in words what these results lack; '' if every point of the study, or of the part that was chosen, is done.

    >>> lacking(xr.Dataset({"status": ("x", [1, 1, 2])}))
    '2 of 3 points are done, 1 failed'
    """
    counts = count_status(dataset["status"].values)
    wanted = sum(counts.values()) - counts[Status.EXCLUDED]
    if unfinished := unfinished_in_words(counts):
        return f"{counts[Status.DONE]:,} of {wanted:,} points are done, {unfinished}"
    of_all = wanted == dataset.attrs.get("points", wanted)  # those of a selection may all be done
    return "the store says that its run did not end" if of_all and not dataset.attrs.get("complete") else ""


def exact(values: NDArray[Any]) -> NDArray[Any]:
    """Return integers as they are, to be told to the last digit, truth values too, and others as floats."""
    return values if values.dtype.kind in "biu" else values.astype(float)


def ends_of(values: NDArray[np.generic], known: NDArray[np.bool_]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the indices of the smallest and the largest of the ``known`` values, integers compared exactly."""
    places = np.flatnonzero(known)
    found = values.reshape(-1)[places]
    low, high = (np.unravel_index(places[end], values.shape) for end in (np.argmin(found), np.argmax(found)))
    return tuple(map(int, low)), tuple(map(int, high))
