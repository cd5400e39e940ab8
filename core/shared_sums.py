"""Sums over objects that the points of a block have in common.

Where one catalogue is the beginning of another, with the same errors, the normals of its objects give the same terms.
These are added up once, tile by tile, and each catalogue takes the sum as it stands where its objects end.
"""

from collections.abc import Callable, Hashable

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.noise import Tile

Term = Callable[[Array, slice], Array]
"""A function that returns what unit normals (..., m, 4, rows) of the objects at a place add to a sum."""


class RunningSum:
    """The sum of a ``term`` over the objects, kept for each of the numbers of objects that are asked for."""

    def __init__(self, term: Term) -> None:
        self._term = term
        self._asked: list[int] = []
        self._total: Array | float = 0.0
        self._found: dict[int, Array | float] = {}

    def ask(self, n_obj: int, term: Term) -> None:
        """Ask, before the first tile, for the sum over ``n_obj`` objects; the term of the largest serves all."""
        self._asked = sorted({*self._asked, n_obj})
        if n_obj == self._asked[-1]:
            self._term = term

    def add(self, tile: Tile) -> None:
        """Add the objects of the next tile."""
        end = tile.start + tile.normals.shape[-3]
        while self._asked and self._asked[0] < end:
            n_obj = self._asked.pop(0)
            self._found[n_obj] = self._with(tile, n_obj)
        if self._asked:
            self._total = self._with(tile, end)
        if self._asked and self._asked[0] == end:
            self._found[self._asked.pop(0)] = self._total

    def over(self, n_obj: int) -> Array:
        """Return the sum over ``n_obj`` objects, after the last tile."""
        return np.asarray(self._found[n_obj])

    def _with(self, tile: Tile, n_obj: int) -> Array:
        """Return the total plus the terms of those of the first ``n_obj`` objects that are in a tile."""
        return self._total + self._term(tile.head(n_obj), slice(tile.start, n_obj))


class SharedSums:
    """The sums of one chunk of realisations over the satellite's normals."""

    def __init__(self) -> None:
        self._sums: dict[Hashable, RunningSum] = {}

    def ask(self, what: Hashable, n_obj: int, term: Term) -> Callable[[], Array]:
        """Ask for the sum of a term over ``n_obj`` objects, and return a function that gives it after the last tile.

        ``what`` identifies the term among those that compute something else from the same objects.
        """
        running = self._sums.setdefault(what, RunningSum(term))
        running.ask(n_obj, term)
        return lambda: running.over(n_obj)

    def add(self, tile: Tile) -> None:
        """Add the objects of the next tile to all."""
        for running in self._sums.values():
            running.add(tile)
