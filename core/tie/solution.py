"""Solutions of normal equations, what each source does to them, and errors that do not rely on those of the tables."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from linksweep.core.frames import Array, Flags
from linksweep.core.link import SMALLEST_EIGENVALUE, LinkError
from linksweep.core.tie.problem import NormalSums
from linksweep.core.unknowns import Unknowns

LARGE_SHARE = 0.1
"""A source that holds a larger share of the weight of a block of unknowns is named."""


@dataclass(frozen=True)
class Solution:
    """The unknowns x (K,), N (K, K) and its inverse, the covariance of x (K, K), Q, its average and the degrees of
    freedom.  Where the weights are the best the covariance is the inverse, and the average of Q is dof.
    """

    estimate: Array
    normal: Array
    inverse: Array
    covariance: Array
    squares: float
    expected: float
    dof: float

    @property
    def scale(self) -> float:
        """Factor by which errors are scaled, sqrt(Q/E[Q]); NaN without degrees of freedom."""
        return float(np.sqrt(self.squares / self.expected)) if self.expected > 0.0 and self.dof > 0 else np.nan


def solve(sums: NormalSums, labels: tuple[str, ...] = (), factors: Array | Flags | None = None) -> Solution:
    """Return the solution of all sources, each with a factor of its weight if given.

    Raises LinkError where the sources do not determine the unknowns, and names those.
    """
    weights = np.ones(len(sums)) if factors is None else factors
    normal, right = np.tensordot(weights, sums.normal, axes=1), weights @ sums.right
    inverse = inverted(normal, labels)
    estimate = inverse @ right
    spread, covariance = normal, inverse  # if the weights are the best
    if factors is not None or sums.spread is not None:
        spread = np.tensordot(weights**2, sums.right_covariance, axes=1)
        covariance = inverse @ spread @ inverse
    return Solution(
        estimate=estimate,
        normal=normal,
        inverse=inverse,
        covariance=0.5 * (covariance + covariance.T),
        squares=max(0.0, float(weights @ sums.squares - right @ estimate)),
        expected=float(weights @ sums.expected - np.sum(inverse * spread)),
        dof=float(sums.count.sum() - len(right)),
    )


def inverted(normal: Array, labels: tuple[str, ...] = ()) -> Array:
    """Return the inverse of a normal matrix (K, K); raises LinkError that names the unknowns without a solution."""
    diagonal = np.diag(normal)
    named = labels or tuple(str(k) for k in range(len(normal)))
    if np.any(none := ~(diagonal > 0.0)):
        raise LinkError(f"nothing in the tables determines {', '.join(np.array(named)[none])}")
    scale = 1.0 / np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(normal * scale[:, None] * scale)
    if values[0] <= SMALLEST_EIGENVALUE:
        involved = np.abs(vectors[:, 0]) > 0.1
        raise LinkError(f"the tables do not tell these unknowns apart: {', '.join(np.array(named)[involved])}")
    half = scale[:, None] * vectors / np.sqrt(values)
    return np.asarray(half @ half.T)


def discrepancies(sums: NormalSums, estimate: Array) -> Array:
    """Return Q_i = yy_i - 2 b_i' x + x' N_i x of each source, chi2 of its residuals; shape (S,)."""
    quadratic = np.einsum("k,skl,l->s", estimate, sums.normal, estimate)
    return np.asarray(np.maximum(sums.squares - 2.0 * sums.right @ estimate + quadratic, 0.0))


def expected_discrepancies(sums: NormalSums, solution: Solution, factors: Array | Flags | None = None) -> Array:
    """Return what Q_i is on average: n_i - tr(N^-1 N_i), where the weights are the best; shape (S,).

    ``factors`` (S,) are those of the weights in the solution: a source that is left out has no part in it.
    """
    part = np.einsum("kl,slk->s", solution.inverse, sums.right_covariance) * (1.0 if factors is None else factors)
    shift = np.einsum("kl,slk->s", solution.covariance, sums.normal)
    return np.asarray(sums.expected - 2.0 * part + shift)


def shares(sums: NormalSums, solution: Solution, unknowns: Unknowns) -> Array:
    """Return the share of each source in the weight of each block; shape (S, blocks).  They add up to 1 over all."""
    share = np.zeros((len(sums), len(unknowns.blocks)))
    for i, name in enumerate(unknowns.names):
        part = unknowns.part(name)
        block = sums.normal[:, part, part]
        share[:, i] = np.einsum("kl,slk->s", np.linalg.inv(solution.normal[part, part]), block) / block.shape[1]
    return share


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
    without = leave_one_out(sums.taken(sums.count > 0), normal, right)
    step = without - without.mean(axis=0)
    return np.asarray((len(without) - 1) / len(without) * step.T @ step)


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
    try:  # Cholesky factors take a sixth of the time of eigenvalues, but say nothing about single matrices
        np.linalg.cholesky(scaled - SMALLEST_EIGENVALUE * np.eye(scaled.shape[-1]))
    except np.linalg.LinAlgError:
        good &= np.linalg.eigvalsh(scaled)[:, 0] > SMALLEST_EIGENVALUE
        scaled[~good] = np.eye(normal.shape[-1])
    solutions = np.linalg.solve(scaled, (right * scale)[..., None])[..., 0] * scale
    return np.where(good[:, None], solutions, np.nan)
