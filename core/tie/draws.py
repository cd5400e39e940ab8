"""Errors of the tables of a link drawn again and again, and the normal equations of each draw."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from linksweep.core.frames import Array
from linksweep.core.tie.astrometry import Differences, differences
from linksweep.core.tie.clips import add_separations
from linksweep.core.tie.problem import Eliminated, NormalSums, Problem, eliminate

BLOCK = 8192
"""Sources, counted over all draws that are made together: the random numbers depend on it."""


class Draw(NamedTuple):
    """The sums of each source of one draw, and the function that gives `core.tie.clips.clipped` the separations."""

    sums: NormalSums
    separations: Callable[[], tuple[Array, Array]]


@dataclass(frozen=True)
class Simulation:
    """The tables of a problem as they might have been, had the unknowns the values ``truth`` (K,).

    The errors of the satellite's parameters and of the rows are normal with the covariances of the tables, times
    ``error_factor``; those of a fraction ``outliers`` of the sources are ``outlier_factor`` times larger still.
    """

    problem: Problem
    truth: Array
    error_factor: float = 1.0
    outliers: float = 0.0
    outlier_factor: float = 1.0

    def draws(self, number: int, rng: np.random.Generator) -> Iterator[Draw]:
        """Yield ``number`` draws; memory is that of a block of sources, or of one draw."""
        at_once = max(1, BLOCK // len(self.problem.satellite))
        for start in range(0, number, at_once):
            values = self._values(min(at_once, number - start), rng)
            for one, sums in zip(values, self._sums(self._eliminated(values), len(values)), strict=True):
                yield Draw(sums, partial(self._separations, one))

    @cached_property
    def normals(self) -> NormalSums:
        """The sums of each source for differences of zero: N, counts and averages are the same in every draw."""
        return self._sums(self._eliminated(np.zeros((1, *self._found.values.shape))), 1)[0]

    @cached_property
    def _found(self) -> Differences:
        return differences(
            self.problem.satellite, self.problem.rows, self.problem.source, frames=self.problem.unknowns.frames
        )

    @cached_property
    def _covariance(self) -> Array:
        return self.problem.satellite.covariance()

    @cached_property
    def _matrix(self) -> Array:
        return self.problem.unknowns.matrix(*self.problem.objects(self.problem.satellite))

    @cached_property
    def _halves(self) -> tuple[Array, Array]:
        return _half(self._covariance), _half(self._found.covariance)

    def _values(self, number: int, rng: np.random.Generator) -> Array:
        """Return differences, (number, R, 5): M (K x - satellite's errors) + the rows' errors, zero where absent."""
        source, found = self.problem.source, self._found
        own_half, row_half = self._halves
        scale = np.full((number, len(self.problem.satellite), 1), self.error_factor)
        if self.outliers > 0.0:
            scale[rng.random(scale.shape) < self.outliers] *= self.outlier_factor
        own = scale * np.einsum("sij,nsj->nsi", own_half, rng.standard_normal((number, *own_half.shape[:2])))
        rows = np.einsum("rij,nrj->nri", row_half, rng.standard_normal((number, *row_half.shape[:2])))
        inside = np.tile(self._matrix @ self.truth, (number, 1, 1))
        inside[..., :5] -= own
        values = np.einsum("rij,nrj->nri", found.by_frames, inside[:, source]) + scale[:, source] * rows
        return np.where(found.present, values, 0.0)

    def _eliminated(self, values: Array) -> Eliminated:
        """Eliminate many draws (n, R, 5) at once, as sources of one large table."""
        n, problem, found = len(values), self.problem, self._found
        tiled = {name: np.concatenate([array] * n) for name, array in vars(found).items() if name != "values"}
        n_sources = len(problem.satellite)
        source = (problem.source + n_sources * np.arange(n)[:, None]).ravel()
        covariance, free = np.tile(self._covariance, (n, 1, 1)), np.tile(~problem.satellite.present.T, (n, 1))
        return eliminate(Differences(values.reshape(-1, 5), **tiled), source, covariance, free, problem.weights)

    def _sums(self, left: Eliminated, number: int) -> list[NormalSums]:
        n_sources, matrix = len(self.problem.satellite), self._matrix
        across = matrix.swapaxes(1, 2)
        normal = across @ left.normal[:n_sources] @ matrix
        spread = None if left.spread is None else across @ left.spread[:n_sources] @ matrix
        right = np.einsum("ski,nsi->nsk", across, left.right.reshape(number, n_sources, -1))
        squares = left.squares.reshape(number, n_sources)
        count, expected = left.count[:n_sources], left.expected[:n_sources]
        return [NormalSums(normal, right[i], squares[i], count, expected, spread) for i in range(number)]

    def _separations(self, values: Array) -> tuple[Array, Array]:
        source, free = self.problem.source, ~self.problem.satellite.present.T
        largest = np.zeros((2, len(free)))
        rows = replace(self._found, values=values)
        add_separations(largest, source, rows, self._covariance[source], free[source])
        return largest[0], largest[1]


def _half(covariance: Array) -> Array:
    """Return a square root L of each covariance (N, 5, 5), L L' = C, which may be singular."""
    scale = np.sqrt(np.einsum("nii->ni", covariance))
    safe = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / (safe[:, :, None] * safe[:, None, :]))
    return np.asarray(scale[:, :, None] * vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])
