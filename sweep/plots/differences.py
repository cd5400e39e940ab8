"""Differences between simulation and prediction, in units of their errors."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from sweep.analysis.quantity import prediction_name, standard_error
from sweep.plots.style import BAND, COLOURS

SUFFIX = "from_prediction"
ERRORS_ALLOWED = 3.0


def differences(dataset: xr.Dataset, variable: str) -> xr.Dataset | None:
    """Return a variable minus its prediction, in units of its one-sigma errors, as a dataset to draw; None where the
    variable has no errors or no prediction.
    """
    error, name = standard_error(dataset, variable), prediction_name(dataset, variable)
    if error is None or name not in dataset or not np.nan_to_num(dataset[name].values).any():
        return None
    found = ((dataset[variable] - dataset[name]) / error.where(error > 0.0)).transpose(*dataset[variable].dims)
    attributes = {"symbol": "(simulated − predicted)/error", "long_name": f"{variable}, minus predicted"}
    kept = dataset[["status"]].assign_attrs(title=dataset.attrs.get("title", ""))
    return kept.assign(
        {
            f"{variable}_{SUFFIX}": found.transpose(*dataset[variable].dims)
            .drop_attrs(deep=False)
            .assign_attrs(attributes)
        }
    )


def add_band(figure: Figure) -> None:
    """Mark zero, and the band in which a difference is no more than chance."""
    for axes in figure.axes:
        axes.axhline(0.0, color="black", linewidth=0.6)
        axes.axhspan(-ERRORS_ALLOWED, ERRORS_ALLOWED, color=COLOURS[6], **BAND)
