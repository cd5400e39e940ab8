"""Sums of normal equations, kept for each source or for groups of sources."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from linksweep.core.arrays import Array, Flags, Indices


@dataclass(frozen=True)
class NormalSums:
    """Sums of G sources or groups: N (G, K, K), b (G, K), yy (G,), numbers of observations n (G,), the averages of yy
    (G,), and the covariance of b (G, K, K), None where it is N because the weights are the best.
    """

    normal: Array
    right: Array
    squares: Array
    count: Array
    expected: Array
    spread: Array | None = None

    @classmethod
    def zeros(cls, groups: int, k: int, with_spread: bool, **further: Any) -> Self:
        """Return sums that are zero, to be filled in; ``further`` fields are those of a subclass."""
        squares, count, expected = np.zeros((3, groups))
        spread = np.zeros((groups, k, k)) if with_spread else None
        return cls(np.zeros((groups, k, k)), np.zeros((groups, k)), squares, count, expected, spread, **further)

    def __len__(self) -> int:
        return len(self.right)

    def taken(self, part: slice | Flags | Indices) -> Self:
        """Return the sums of some sources."""

        def of(array: Array) -> Array:  # indexing with row numbers takes several times longer than np.take
            return array[part] if isinstance(part, slice) or part.dtype == np.bool_ else np.take(array, part, axis=0)

        return replace(self, **{name: of(array) for name, array in vars(self).items() if isinstance(array, np.ndarray)})

    def scaled(self, factors: Array | Flags) -> Self:
        """Return the same with the weight of each source multiplied by a factor (G,)."""
        each = factors[:, None, None]
        return replace(
            self,
            normal=self.normal * each,
            right=self.right * factors[:, None],
            squares=self.squares * factors,
            expected=self.expected * factors,
            spread=self.right_covariance * each**2,
        )

    def plus(self, other: Self) -> Self:
        """Return the sums of both, group by group."""
        return self._with(other, np.add)

    def followed_by(self, other: Self) -> Self:
        """Return the groups of both, one after the other."""
        return self._with(other, lambda one, two: np.concatenate([one, two]))

    def _with(self, other: Self, together: Callable[[Array, Array], Array]) -> Self:
        mine, others = dict(vars(self)), dict(vars(other))
        if self.spread is not None or other.spread is not None:
            mine["spread"], others["spread"] = self.right_covariance, other.right_covariance
        found = {name: together(one, others[name]) for name, one in mine.items() if isinstance(one, np.ndarray)}
        return replace(self, **found)

    @property
    def right_covariance(self) -> Array:
        """The covariance of b; shape (G, K, K)."""
        return self.normal if self.spread is None else self.spread
