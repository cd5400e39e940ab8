"""Indices of Saltelli and Morris designs by SALib, with bootstrap errors from a fixed seed."""

import warnings
from typing import Any

import numpy as np

from sweep.contract import Array
from sweep.studies.designs import MORRIS_LEVELS, salib, unit_cube

EFFECTS: tuple[str, ...] = ("mu_star", "mu_star_error", "mu", "sigma")
"""What `morris_effects` returns."""

RESAMPLES = 200
ONE_SIGMA = 0.6826894921370859
"""Probability within one sigma, for which SALib gives half the width of its intervals."""


def saltelli_indices(values: Array, parameters: int, seed: int = 0) -> tuple[Array, Array, Array, Array]:
    """Return first-order and total indices with one-sigma errors, each (parameters,), of values (points,) in the order
    of the design; NaN where these do not vary.  Raises SweepError without SALib.

    Source: Saltelli et al. 2010, Computer Physics Communications 181, 259.
    """
    if not np.ptp(values) > 0.0:
        return (np.full(parameters, np.nan),) * 4
    salib()
    from SALib.analyze import sobol

    options = {"calc_second_order": False, "num_resamples": RESAMPLES, "conf_level": ONE_SIGMA}
    found = sobol.analyze(unit_cube(parameters), values, seed=seed + 1, **options)  # SALib takes 0 for no seed
    first, first_error, total, total_error = (np.asarray(found[key]) for key in ("S1", "S1_conf", "ST", "ST_conf"))
    return first, first_error, total, total_error


def morris_effects(values: Array, places: Array, seed: int = 0) -> list[Array]:
    """Return the mean of absolute elementary effects with its error, the mean effect, and their standard deviation,
    each (parameters,), of values (points,) at ``places`` (points, parameters) of the unit cube.

    An effect is the change of the value over the whole range of a parameter.  Raises SweepError without SALib.
    Source: Campolongo et al. 2007, Environmental Modelling & Software 22, 1509.
    """
    salib()
    from SALib.analyze import morris

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of groups that there are none
        options: dict[str, Any] = {"num_levels": MORRIS_LEVELS, "num_resamples": RESAMPLES, "conf_level": ONE_SIGMA}
        found = morris.analyze(unit_cube(places.shape[1]), places, values, seed=seed + 1, **options)
    return [np.ma.getdata(found[key]).astype(float) for key in ("mu_star", "mu_star_conf", "mu", "sigma")]
