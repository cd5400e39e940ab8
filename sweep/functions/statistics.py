"""Statistics of the realisations of a plain function, each with its Monte-Carlo error.

Mean, spread and extremes come from moments that merge block by block (Chan et al. 1983, Pebay 2008), quantiles from the
realisations themselves.
"""

import math
import re
from collections.abc import Sequence

import numpy as np

from sweep.contract import Array, shown, small_sample_factor, suggest
from sweep.functions.layout import Field

MOMENTS = 6
"""What a block keeps of each number of an output: mean, sums of 2nd to 4th powers about it, least and largest value."""

NAMES = ("mean", "std", "min", "max", "count", "median")
DEFAULT = ("mean", "std")
"""The statistics of an output that declares none."""

QUANTILE = re.compile(r"q(\d{1,2}(?:\.\d+)?)")

FEWEST_BEYOND = 1.0
"""The fewest realisations beyond each of a quantile's one-sigma limits for which it has an error."""


def statistic_problem(name: object) -> str | None:
    """Return what is wrong with the name of a statistic, None if nothing is."""
    if name in NAMES or (isinstance(name, str) and quantile_of(name) is not None):
        return None
    hint = suggest(name, NAMES) if isinstance(name, str) else ""
    return f"there is no statistic {shown(name)}{hint}; quantiles are written q5, q95, q99.9"


def quantile_of(name: str) -> float | None:
    """Return the level of the quantile of this name, between 0 and 1; None for another statistic."""
    if name == "median":
        return 0.5
    found = QUANTILE.fullmatch(name)
    level = float(found[1]) / 100.0 if found else 0.0
    return level if 0.0 < level < 1.0 else None


def moments_of(values: Array) -> Array:
    """Return the moments of realisations (n, size), shape (MOMENTS, size)."""
    mean = values.mean(axis=0)
    deviation = values - mean
    squares = deviation**2
    powers = [squares.sum(axis=0), (squares * deviation).sum(axis=0), (squares**2).sum(axis=0)]
    return np.stack([mean, *powers, values.min(axis=0), values.max(axis=0)])


def merged(one: Array, n_one: float, other: Array, n_other: float) -> Array:
    """Return the moments of two sets of realisations together, each (MOMENTS, size)."""
    n = n_one + n_other
    (mean_a, m2_a, m3_a, m4_a, low_a, high_a), (mean_b, m2_b, m3_b, m4_b, low_b, high_b) = one, other
    shift = mean_b - mean_a
    a, b = n_one / n, n_other / n
    mean = mean_a + shift * b
    m2 = m2_a + m2_b + shift**2 * n_one * b
    m3 = m3_a + m3_b + shift**3 * n_one * b * (a - b) + 3.0 * shift * (a * m2_b - b * m2_a)
    m4 = m4_a + m4_b + shift**4 * n_one * b * (a * a - a * b + b * b)
    m4 = m4 + 6.0 * shift**2 * (a * a * m2_b + b * b * m2_a) + 4.0 * shift * (a * m3_b - b * m3_a)
    return np.stack([mean, m2, m3, m4, np.minimum(low_a, low_b), np.maximum(high_a, high_b)])


def statistic(name: str, field: Field, moments: Array, n: Array) -> tuple[Array, Array | None]:
    """Return a statistic and its one-sigma Monte-Carlo error, both (points, size), from moments (points, MOMENTS, size)
    of n (points,) realisations; extremes have no error.
    """
    count = n[:, None]
    mean, m2, _, m4 = (moments[:, k] for k in range(4))
    with np.errstate(invalid="ignore", divide="ignore"):
        if name in ("min", "max"):
            return moments[:, 4 if name == "min" else 5], None
        if name == "count" or field.type == "bool":
            likely = (mean * count + 1.0) / (count + 2.0)  # never 0 or 1, even if all realisations agree
            spread = np.sqrt(likely * (1.0 - likely))
        if name == "count":
            return np.round(mean * count), spread * np.sqrt(count)
        if name == "mean":
            if field.type == "bool":
                return mean, spread / np.sqrt(count)
            return mean, np.sqrt(m2 / (count - 1.0) / count * small_sample_factor(count))
        variance = m2 / (count - 1.0)
        of_variance = (m4 / count - variance**2 * (count - 3.0) / (count - 1.0)) / count
        std = np.sqrt(variance)
        error = np.sqrt(np.maximum(of_variance, 0.0) * small_sample_factor(count)) / (2.0 * std)
        return std, np.where(std > 0.0, error, np.where(count > 1.0, 0.0, np.nan))


def quantiles(levels: Sequence[float], realisations: Array) -> Array:
    """Return quantiles of realisations (n, size) and their errors, (levels, 2, size).

    The number of realisations below the true quantile is binomial.  The error is half the distance between the order
    statistics one standard deviation of this number away on both sides, NaN where these are beyond the realisations.
    """
    n = len(realisations)
    found = np.full((len(levels), 2, realisations.shape[1]), np.nan)
    for i, level in enumerate(levels):
        step = math.sqrt(level * (1.0 - level) / n)
        ends = (level - step, level + step)
        inside = ends[0] * n >= FEWEST_BEYOND and (1.0 - ends[1]) * n >= FEWEST_BEYOND
        wanted = [level, *ends] if inside else [level]
        values = np.quantile(realisations, wanted, axis=0, method="hazen")
        found[i, 0] = values[0]
        if inside:
            found[i, 1] = 0.5 * (values[2] - values[1])
    return found
