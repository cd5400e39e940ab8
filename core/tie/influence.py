"""What each source does to a solution: its discrepancy, its share of the weight, and the solution without it.

Errors of the unknowns that do not rely on those of the tables follow from the same sums, of sources or of groups.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from linksweep.core.arrays import Array, Flags
from linksweep.core.link import SMALLEST_EIGENVALUE
from linksweep.core.tie.solution import Solution
from linksweep.core.tie.sums import NormalSums
from linksweep.core.unknowns import Unknowns

LARGE_SHARE = 0.1
"""A source that holds a larger share of the weight of a block of unknowns is named."""


def discrepancies(sums: NormalSums, estimate: Array) -> Array:
    """Return Q_i = yy_i - 2 b_i' x + x' N_i x of each source, chi2 of its residuals; shape (S,)."""
    quadratic = np.einsum("k,skl,l->s", estimate, sums.normal, estimate)
    return np.asarray(np.maximum(sums.squares - 2.0 * sums.right @ estimate + quadratic, 0.0))


def expected_discrepancies(sums: NormalSums, solution: Solution, factors: Array | Flags | None = None) -> Array:
    """Return what Q_i is on average: n_i - tr(N^-1 N_i), where the weights are the best; shape (S,).

    ``factors`` (S,) are those of the weights in the solution: a source that is left out has no part in it.
    """
    own = np.einsum("kl,slk->s", solution.inverse, sums.right_covariance)
    own = own if factors is None else own * factors
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


def influence(sums: NormalSums, solution: Solution, unknowns: Unknowns, factors: Array | Flags) -> Influence:
    """Return the influence of each source on the solution with ``factors`` (S,) of their weights.

    For a source that was left out, "without" and Cook's distance are NaN and its shares are 0.
    """
    n, k = len(sums), len(unknowns)
    without = np.full((n, k), np.nan)
    right = solution.normal @ solution.estimate
    kept = (factors > 0.0) & (sums.count > 0)
    used = sums.taken(kept).scaled(factors[kept])
    without[kept] = leave_one_out(used, solution.normal, right)
    step = without - solution.estimate
    share = np.zeros((n, len(unknowns.blocks)))
    share[kept] = shares(used, solution, unknowns)
    return Influence(
        discrepancy=discrepancies(sums, solution.estimate),
        expected=expected_discrepancies(sums, solution, factors),
        without=without,
        cook=np.einsum("sk,kl,sl->s", step, solution.normal, step) / k,
        share=share,
    )


def leave_one_out(sums: NormalSums, normal: Array, right: Array) -> Array:
    """Return (N - N_i)^-1 (b - b_i), the solution without each source; shape (G, K).

    NaN where the others do not determine all unknowns.  ``normal`` (K, K) and ``right`` (K,) are the totals.
    """
    return _solutions(normal - sums.normal, right - sums.right)


def jackknife(sums: NormalSums, normal: Array, right: Array) -> Array:
    """Return the covariance (K, K) from the solutions without each of G sources (or groups, for cells of the sky).

    (G - 1)/G times the sum of squares about their mean, G those that have any observations; NaN where the unknowns
    depend on a single one.
    """
    found = leave_one_out(sums.taken(sums.count > 0), normal, right)
    step = found - found.mean(axis=0)
    return np.asarray((len(found) - 1) / len(found) * step.T @ step)


def sandwich(sums: NormalSums, solution: Solution) -> Array:
    """Return N^-1 sum(u u') N^-1 with u_i = b_i - N_i x, times G/(G - 1); shape (K, K)."""
    scores = sums.right - sums.normal @ solution.estimate
    n = int(np.sum(sums.count > 0))
    spread = scores.T @ scores * (n / max(n - 1, 1))
    return np.asarray(solution.inverse @ spread @ solution.inverse)


class Bootstrap(NamedTuple):
    """Covariance (K, K), the solutions (B, K), and how many resamples failed to determine the unknowns (NaN)."""

    covariance: Array
    estimates: Array
    failed: int


def bootstrap(sums: NormalSums, resamples: int, rng: np.random.Generator) -> Bootstrap:
    """Return the scatter of solutions of sources drawn with replacement."""
    used = sums.taken(sums.count > 0)
    n, k = len(used), used.right.shape[1]
    times = rng.multinomial(n, np.full(n, 1.0 / n), size=resamples).astype(np.float64)
    estimates = _solutions((times @ used.normal.reshape(n, -1)).reshape(resamples, k, k), times @ used.right)
    good = np.isfinite(estimates[:, 0])
    covariance = np.cov(estimates[good].T).reshape(k, k) if good.sum() > 1 else np.full((k, k), np.nan)
    return Bootstrap(covariance, estimates, int(np.sum(~good)))


def _solutions(normal: Array, right: Array) -> Array:
    """Solve many (G, K, K) systems; NaN for those that are singular."""
    diagonal = np.einsum("gkk->gk", normal)
    good = np.all(diagonal > 0.0, axis=1)
    scale = 1.0 / np.sqrt(np.where(good[:, None], diagonal, 1.0))
    scaled = np.where(good[:, None, None], normal * scale[:, :, None] * scale[:, None, :], np.eye(normal.shape[-1]))
    good &= _regular(scaled)
    scaled[~good] = np.eye(normal.shape[-1])
    found = np.linalg.solve(scaled, (right * scale)[..., None])[..., 0] * scale
    return np.where(good[:, None], found, np.nan)


def _regular(scaled: Array) -> Flags:
    """Return whether the smallest eigenvalue of each matrix (G, K, K) is large enough."""
    try:  # Cholesky factors take a sixth of the time of eigenvalues, but say nothing about single matrices
        np.linalg.cholesky(scaled - SMALLEST_EIGENVALUE * np.eye(scaled.shape[-1]))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.eigvalsh(scaled)[:, 0] > SMALLEST_EIGENVALUE)
    return np.ones(len(scaled), dtype=bool)
