"""How much larger a variance from few samples is given."""

import numpy as np
from numpy.typing import ArrayLike

from sweep.contract.checked import Array

FEWEST_SAMPLES = 5
"""Fewest independent samples (catalogues, mostly) whose scatter gives an error: of fewer it is not known."""


def small_sample_factor(samples: ArrayLike) -> Array:
    """Return by how much a variance from the scatter of so many independent samples is given larger.

    For normal samples their mean, over the root of that variance, then has variance one: Student's t with n - 1 degrees
    of freedom has (n - 1)/(n - 3).  NaN below `FEWEST_SAMPLES`, 1 for infinitely many.
    """
    count = np.asarray(samples, dtype=float)
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = 1.0 + 2.0 / (count - 3.0)
    return np.where(count >= FEWEST_SAMPLES, factor, np.nan)
