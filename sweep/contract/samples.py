"""The factor that enlarges a variance from few samples."""

import numpy as np
from numpy.typing import ArrayLike

from linksweep.sweep.contract.checked import Array

FEWEST_SAMPLES = 5
"""Fewest independent samples (catalogues, mostly) whose scatter gives an error: with fewer it is not known."""


def small_sample_factor(samples: ArrayLike) -> Array:
    """Return the factor that enlarges a variance from the scatter of so many independent samples.

    For normal samples, the error of their mean over the root of that variance then has variance one; without the factor
    it is Student's t with n - 1 degrees of freedom, of variance (n - 1)/(n - 3).  NaN below `FEWEST_SAMPLES`, 1 for
    infinitely many.
    """
    count = np.asarray(samples, dtype=float)
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = 1.0 + 2.0 / (count - 3.0)
    return np.where(count >= FEWEST_SAMPLES, factor, np.nan)
