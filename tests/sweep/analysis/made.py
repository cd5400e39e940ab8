"""Results as a run leaves them, of numbers that a test chooses."""

import numpy as np
import xarray as xr

from linksweep.sweep.planning.point_status import Status

N = np.array([10.0, 20.0, 50.0, 100.0, 300.0])


def grid(value, error=None, x=N, name="n", unit="", status=None, **more):
    """A dataset as a run leaves it: ``width`` in mas over model x one axis of numbers."""
    axes, value = ("model", name), np.atleast_2d(np.asarray(value, dtype=float))
    models = max(2, len(value))
    value = np.broadcast_to(value, (models, len(x)))
    variables = {
        "width": (axes, value, {"units": "mas", "headline": 1}),
        "status": (axes, np.full(value.shape, Status.DONE, np.int8) if status is None else status),
    }
    if error is not None:
        variables["width_mc_error"] = (axes, np.broadcast_to(error, value.shape).astype(float), {"units": "mas"})
    labels = np.array(["old", "new", *map(str, range(2, models))], dtype=object)
    return xr.Dataset(variables, {"model": labels, name: (name, x, {"units": unit})}, {"title": "Widths"}).assign(more)
