"""Whether a vectorised function gives each of many points what it gives that point alone."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.contract import Point
from sweep.functions.adapter import FunctionExperiment
from sweep.functions.layout import Layout
from sweep.functions.results import Flat

APART = 0.01
"""Relative difference of two numbers that are not the same result: solvers of many equations together stop where all
are as good as asked for, so that their last digits are not those of one.
"""

ROUNDING = 1e-9
"""Difference, relative to the largest number of all points, that is rounding."""


def dependence(experiment: FunctionExperiment, points: Sequence[Point], values: Sequence[Flat]) -> str:
    """Return how the first or the last of many points differs from the result of that point alone, in words; '' where
    neither does.

    Raises whatever the function raises.
    """
    among = _columns(values[0].layout, values)
    for place in (0, len(points) - 1):
        (own,) = experiment.many([points[place]])
        alone = _columns(own.layout, [own])
        for name in among.keys() & alone.keys():
            there, here = among[name][place], alone[name][0]
            if there.shape != here.shape or np.any(_differ(there, here, among[name])):
                return (
                    f"{experiment.name}: {name!r} is {_shown(there, here)} in a call for {len(points)} points, but "
                    f"{_shown(here, there)} for the same point alone; a vectorised function returns for each point "
                    "what does not depend on the others"
                )
    return ""


def _columns(layout: Layout, values: Sequence[Flat]) -> dict[str, NDArray[Any]]:
    rows = np.frombuffer(b"".join(value.row for value in values), dtype="<f8").reshape(len(values), -1)
    return layout.values(rows)


def _differ(one: NDArray[Any], other: NDArray[Any], everything: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which numbers are more than rounding apart, and which other values differ."""
    if one.dtype.kind not in "fi" or other.dtype.kind not in "fi":
        return np.asarray(one != other)
    finite = np.isfinite(one) & np.isfinite(other)
    size = np.max(np.abs(everything), where=np.isfinite(everything), initial=0.0)
    apart = np.abs(np.where(finite, one, 0.0) - np.where(finite, other, 0.0))
    far = (apart > APART * np.maximum(np.abs(one), np.abs(other))) & (apart > ROUNDING * size)
    same = (one == other) | (np.isnan(one) & np.isnan(other))
    return np.asarray(np.where(finite, far, ~same))


def _shown(one: NDArray[Any], other: NDArray[Any]) -> str:
    """Return the first value in which two results differ, or a shape where these do."""
    if one.shape != other.shape:
        return f"of the shape {one.shape}"
    differ = np.atleast_1d(_differ(one, other, one))
    first = np.atleast_1d(one).reshape(-1)[int(np.argmax(differ.reshape(-1)))]
    return "another text" if one.dtype.kind == "V" else str(first)
