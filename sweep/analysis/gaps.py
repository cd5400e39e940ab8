"""What results lack: points that are not done, and integers that are missing, which a dataset marks by a number where
one of them is too large for a float.
"""

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from linksweep.sweep.contract import Array
from linksweep.sweep.functions.layout import MISSING_INT
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


def gaps_of(dataset: xr.Dataset, variable: str) -> NDArray[np.bool_] | None:
    """Return where integers are missing as their points are not done; None for other types, and where none is."""
    array = dataset[variable]
    if array.dtype.kind != "i" or variable in dataset.coords or not set(dataset["status"].dims) <= set(array.dims):
        return None
    marked = array.values == MISSING_INT
    if not marked.any():
        return None
    undone = (dataset["status"] != Status.DONE).broadcast_like(array).transpose(*array.dims).values
    return np.asarray(marked & undone)


def numbers_of(dataset: xr.Dataset, variable: str) -> Array:
    """Return a variable as floats, NaN where it is missing."""
    values = dataset[variable].values.astype(float)
    if (gaps := gaps_of(dataset, variable)) is not None:
        values[gaps] = np.nan
    return values


def with_nan(dataset: xr.Dataset) -> xr.Dataset:
    """Return results in which integers with gaps are floats, for what computes or draws with floats anyway."""
    changed = {
        name: dataset[name].copy(data=numbers_of(dataset, name))
        for name in map(str, dataset.data_vars)
        if "status" in dataset and gaps_of(dataset, name) is not None
    }
    return dataset.assign(changed) if changed else dataset


def exact(values: NDArray[Any]) -> NDArray[Any]:
    """Return integers as they are, to be told to the last digit, truth values too, and others as floats."""
    return values if values.dtype.kind in "biu" else values.astype(float)


def ends_of(values: NDArray[np.generic], known: NDArray[np.bool_]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the indices of the smallest and the largest of the ``known`` values, integers compared exactly."""
    places = np.flatnonzero(known)
    found = values.reshape(-1)[places]
    low, high = (np.unravel_index(places[end], values.shape) for end in (np.argmin(found), np.argmax(found)))
    return tuple(map(int, low)), tuple(map(int, high))
