"""The points of a table or a design at which a condition is met."""

import numpy as np
import xarray as xr

from sweep.analysis.conditions import Limit
from sweep.analysis.lines import require_done
from sweep.analysis.quantity import require_quantity
from sweep.contract import SweepError
from sweep.studies.study import POINT


def points_where(dataset: xr.Dataset, limit: Limit) -> xr.Dataset:
    """Return the points of a dataset at which a condition is met, all their results included.

    Raises SweepError for an unknown quantity, one with further dimensions, and points that are not done.
    """
    require_quantity(dataset, limit.variable)
    array = dataset[limit.variable]
    if further := ", ".join(str(d) for d in array.dims if d != POINT):
        raise SweepError(f"{limit.variable} has {further} at each point: fix it with --at, or name it with --over")
    require_done(dataset)
    threshold = limit.number_in(str(array.attrs.get("units", "")))
    return dataset.isel({POINT: np.flatnonzero(limit.is_met(array.values, threshold))})
