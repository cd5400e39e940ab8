"""Sources whose sums are kept one by one, or for cells of the sky where they are too many."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linksweep.core.arrays import Array, Flags, Indices
from linksweep.core.tie.clips import Sources, separation
from linksweep.core.tie.influence import discrepancies
from linksweep.core.tie.normal_sums import group_sums, source_counts, source_discrepancies, source_sums, weight_sizes
from linksweep.core.tie.problem import Problem
from linksweep.core.tie.solution import Solution, solve
from linksweep.core.tie.sums import NormalSums

DIVISIONS = 6
"""Divisions of the grid of cells of the sky, which has 72 cells."""

KEPT_NUMBERS = 30_000_000
"""Largest size of the sums of single sources, in numbers (240 MB)."""


def sky_cells(ra: Array, dec: Array, divisions: int) -> NDArray[np.int16]:
    """Return the cell of each position on a grid of cells of equal area; shape (N,).

    2 d^2 cells for ``divisions`` d: d bands of equal height in sin dec, each of 2 d equal steps in ra.
    """
    cells = np.zeros(len(ra), dtype=np.int16)
    for edge in np.arcsin(np.arange(1, divisions) * (2.0 / divisions) - 1.0):
        cells += dec >= edge  # a sine of each source takes longer than all comparisons
    cells *= 2 * divisions
    if np.any((ra < 0.0) | (ra >= 2.0 * np.pi)):
        ra = ra % (2.0 * np.pi)
    step = (ra * (divisions / np.pi)).astype(np.int16)
    step[step == 2 * divisions] = 0
    return np.asarray(cells + step)


def sources_of(sums: NormalSums, labels: tuple[str, ...]) -> Sources:
    """Return what the clips need of sources whose sums are kept one by one."""
    return Sources(
        lambda factors: _solve_kept(sums, labels, factors), lambda estimate: discrepancies(sums, estimate), sums.count
    )


def _solve_kept(sums: NormalSums, labels: tuple[str, ...], factors: Array | Flags) -> Solution:
    kept = factors > 0.0
    equal = np.all(factors[kept] == 1.0)
    return solve(sums.taken(kept), labels, None if equal else factors[kept])


class Heaviest(NamedTuple):
    """The sizes of the largest weights, the sources with them and their sums."""

    sizes: Array
    places: Indices
    sums: NormalSums


def heaviest(problem: Problem, number: int) -> Heaviest:
    """Return the ``number`` sources with the largest weights; of equal ones the first."""
    sizes = weight_sizes(problem)
    found = np.argsort(-sizes, kind="stable")[:number]
    return Heaviest(sizes[found], found, source_sums(problem.only(found)))


@dataclass(frozen=True)
class SourceTable:
    """The sources of a problem, with the sums of each if ``single``, and those of cells of the sky."""

    problem: Problem
    _last: list[tuple[Array | Flags, NormalSums]] = field(default_factory=list, repr=False, compare=False)

    @property
    def single(self) -> bool:
        """True if the sums of single sources fit."""
        return len(self.problem.satellite) * len(self.problem.unknowns) ** 2 <= KEPT_NUMBERS

    @property
    def kept(self) -> NormalSums | None:
        """The sums of each source, None if they do not fit."""
        return self.sums if self.single else None

    @cached_property
    def sums(self) -> NormalSums:
        """The sums of each source."""
        return source_sums(self.problem)

    @cached_property
    def cells(self) -> NDArray[np.int16]:
        """The cell of each source, counted from 0 among those that have any."""
        values = self.problem.satellite.values
        cells = sky_cells(values[0], values[1], DIVISIONS)
        number = np.cumsum(np.bincount(cells) > 0) - 1
        return number.astype(np.int16)[cells]

    def cell_sums(self, factors: Array | Flags) -> NormalSums:
        """Return the sums of cells, each source with a factor of its weight."""
        if not self.single:
            return self._streamed(factors)
        n_cells = int(self.cells.max()) + 1
        member = np.zeros((n_cells, len(factors)))
        member[self.cells, np.arange(len(factors))] = 1.0
        weighted = member * factors
        sums = self.sums
        optimal = sums.spread is None and np.all((factors == 0.0) | (factors == 1.0))
        return NormalSums(
            normal=np.tensordot(weighted, sums.normal, axes=1),
            right=weighted @ sums.right,
            squares=weighted @ sums.squares,
            count=(member * (factors > 0.0)) @ sums.count,
            expected=weighted @ sums.expected,
            spread=None if optimal else np.tensordot(member * factors**2, sums.right_covariance, axes=1),
        )

    def _streamed(self, factors: Array | Flags) -> NormalSums:
        """Return the sums of cells by a pass over the tables, or those of the last pass if ``factors`` are the same."""
        if not self._last or not np.array_equal(self._last[0][0], factors):
            sums = group_sums(self.problem, self.cells, int(self.cells.max()) + 1, factors)
            self._last[:] = [(factors.copy(), sums)]
        return self._last[0][1]

    def solve(self, factors: Array | Flags) -> Solution:
        """Return the solution with a factor of the weight of each source."""
        labels = self.problem.unknowns.labels
        if not self.single:
            return solve(self.cell_sums(factors), labels)
        return _solve_kept(self.sums, labels, factors)

    def separations(self) -> tuple[Array, Array]:
        """Return the normalised separation and the separation (rad) of each source."""
        return separation(self.problem)

    def heaviest(self, number: int) -> Heaviest:
        """Return the sources with the largest weights, and their sums."""
        return heaviest(self.problem, number)

    def as_sources(self) -> Sources:
        """Return what the clips need."""
        if self.single:
            return sources_of(self.sums, self.problem.unknowns.labels)
        return Sources(
            self.solve, lambda estimate: source_discrepancies(self.problem, estimate), source_counts(self.problem)
        )
