"""How many realisations a point needs for the precision that its study asks for."""

import math

import numpy as np

from sweep.contract import Array
from sweep.planning.plan import Plan

LARGEST_STEP = 16
"""A point that is not precise enough gets at most this many times its realisations before it is checked again."""


def wanted_parts(plan: Plan, cost: float, parts: int, sums: Array) -> int:
    """Return how many parts a point with ``parts`` needs: only its ``sums`` (1, width) decide, so all runs agree."""
    study = plan.grid.study
    sampling, precision = study.sampling, study.sampling.precision
    if precision is None:
        return parts
    n_sim = plan.realisations(cost, parts)
    n_cat = float(sampling.n_cat)
    try:
        results = study.experiment.results(sums, np.array([n_cat * n_sim]), np.array([n_cat]))
    except Exception:  # raised by a user's function: the point ends here, and `sweep.planning.failing` says why
        return parts
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = [np.abs(results[e] / results[value]) for value, e in study.experiment.errors_of_headline()]
    worst = max(float(np.max(error)) for error in errors)
    if study.experiment.further_width and math.isnan(worst):
        return min(2 * parts, plan.parts(cost, sampling.most))  # too few for the error of a quantile
    if math.isnan(worst) or worst <= precision:
        return parts
    needed = math.ceil(n_sim * min((worst / precision) ** 2, LARGEST_STEP))
    return min(max(parts + 1, plan.parts(cost, needed)), plan.parts(cost, sampling.most))
