"""The solution of normal equations."""

from dataclasses import dataclass

import numpy as np

from linksweep.core.arrays import Array, Flags
from linksweep.core.link import SMALLEST_EIGENVALUE, LinkError
from linksweep.core.tie.sums import NormalSums


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
    spread = normal
    covariance = inverse
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
