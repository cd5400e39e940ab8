"""How many realisations a point needs for the precision that its study asks for."""

import math

import numpy as np

from linksweep.sweep.contract import Rows
from linksweep.sweep.planning.plan import Plan

LARGEST_STEP = 16
"""A point that is not precise enough gets at most this many times its realisations before it is checked again."""

CONFIRMED = 1.25
"""A precision counts as reached if it is still reached with this many times the realisations: errors are estimates too,
and the first that is small enough is often one that is too small by chance.
"""

KNOWN_BY = 4096
"""Realisations from which an error that is still not known no longer counts, as where all realisations are alike."""


def wanted_parts(plan: Plan, cost: float, parts: int, total: Rows, reached: bool) -> tuple[int, bool]:
    """Return how many parts a point with ``parts`` needs, and whether these reach the precision; ``reached`` says
    whether those of its last check did.  Only its ``total`` (1,) decides, so all runs agree.
    """
    study = plan.grid.study
    sampling, precision = study.sampling, study.sampling.precision
    if precision is None:
        return parts, True
    n_sim = plan.realisations(cost, parts)
    n_cat = float(sampling.n_cat)
    try:
        results = study.experiment.reducer.finish(total, np.array([n_cat * n_sim]), np.array([n_cat]))
    except Exception:  # raised by a user's function: the point ends here, and `sweep.planning.failing` says why
        return parts, False
    with np.errstate(divide="ignore", invalid="ignore"):
        pairs = study.experiment.errors_of_headline()
        errors = np.concatenate([np.abs(results[error] / results[value]).reshape(-1) for value, error in pairs])
    unknown = n_sim < KNOWN_BY and bool(np.isnan(errors).any())
    worst = float(np.max(errors, where=~np.isnan(errors), initial=0.0))
    enough = worst <= precision and not unknown
    if enough and reached:
        return parts, True
    factor = max((worst / precision) ** 2, 2.0 if unknown else CONFIRMED)
    needed = plan.parts(cost, math.ceil(n_sim * min(factor, LARGEST_STEP)))
    return min(max(parts + 1, needed), plan.parts(cost, sampling.most)), enough
