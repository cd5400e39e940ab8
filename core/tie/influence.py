"""What each source does to a solution: its discrepancy, its share of the weight, and the solution without it."""

from dataclasses import dataclass

import numpy as np

from core.arrays import Array, Flags
from core.tie.solution import Solution
from core.tie.sums import NormalSums
from core.tie.uncertainty import leave_one_out
from core.unknowns import Unknowns

LARGE_SHARE = 0.1
"""A source that holds more of the weight of a block of unknowns is named."""


def discrepancies(sums: NormalSums, estimate: Array) -> Array:
    """Return Q_i = yy_i - 2 b_i' x + x' N_i x of each source, chi2 of its residuals; shape (S,)."""
    quadratic = np.einsum("k,skl,l->s", estimate, sums.normal, estimate)
    return np.asarray(np.maximum(sums.squares - 2.0 * sums.right @ estimate + quadratic, 0.0))


def expected_discrepancies(sums: NormalSums, solution: Solution) -> Array:
    """Return what Q_i is on average: n_i - tr(N^-1 N_i), where the weights are the best; shape (S,)."""
    own = np.einsum("kl,slk->s", solution.inverse, sums.right_covariance)
    own_shift = np.einsum("kl,slk->s", solution.covariance, sums.normal)
    return np.asarray(sums.expected - 2.0 * own + own_shift)


def shares(sums: NormalSums, solution: Solution, unknowns: Unknowns) -> Array:
    """Return the share of each source in the weight of each block; shape (S, blocks).  They add up to 1 over all."""
    found = np.zeros((len(sums), len(unknowns.blocks)))
    for i, name in enumerate(unknowns.names):
        part = unknowns.part(name)
        own = sums.normal[:, part, part]
        found[:, i] = np.einsum("kl,slk->s", np.linalg.inv(solution.normal[part, part]), own) / own.shape[1]
    return found


@dataclass(frozen=True)
class Influence:
    """Of S sources: Q_i and its average, the solution without each (S, K), Cook's distance, and shares of the weight of
    each block (S, blocks), which add up to 1 over the sources.
    """

    discrepancy: Array
    expected: Array
    without: Array
    cook: Array
    share: Array


def influence(sums: NormalSums, solution: Solution, unknowns: Unknowns, kept: Flags) -> Influence:
    """Return the influence of each source on the solution of those ``kept`` (S,).

    For a source that was left out, "without" and Cook's distance are NaN and its shares are 0.
    """
    n, k = len(sums), len(unknowns)
    without = np.full((n, k), np.nan)
    right = solution.normal @ solution.estimate
    without[kept] = leave_one_out(sums.taken(kept), solution.normal, right)
    step = without - solution.estimate
    share = np.zeros((n, len(unknowns.blocks)))
    share[kept] = shares(sums.taken(kept), solution, unknowns)
    return Influence(
        discrepancy=discrepancies(sums, solution.estimate),
        expected=expected_discrepancies(sums, solution),
        without=without,
        cook=np.einsum("sk,kl,sl->s", step, solution.normal, step) / k,
        share=share,
    )
