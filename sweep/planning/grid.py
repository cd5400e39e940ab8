"""The grid of a study: dimensions, points and their digests."""

import itertools
import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Value
from linksweep.sweep.studies.study import POINT, Study
from linksweep.sweep.tables.file import as_json

AT_ONCE = 2**16
"""How many points have their places in memory at a time."""


@dataclass(frozen=True, slots=True)
class GridPoint:
    """One point: its place in C order, all its parameters, and the digests that name it in ledgers and streams."""

    index: int
    parameters: dict[str, Any]
    digest: bytes
    stream: bytes


@dataclass(frozen=True)
class Grid:
    """The points of a study.  The dimension of a table of points comes first, then the axes in their order; zipped axes
    share the dimension of the first of them.  ``warnings`` are those of the experiment, if `make_grid` has asked it.
    """

    study: Study
    warnings: list[str] = field(default_factory=list, compare=False)

    @cached_property
    def dimensions(self) -> dict[str, tuple[str, ...]]:
        """The axes along each dimension, by the dimension's name."""
        return self.study.dimensions

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Length of each dimension."""
        return tuple(len(self.study.axes[axes[0]]) for axes in self.dimensions.values())

    @cached_property
    def first_rows(self) -> NDArray[np.intp] | None:
        """For each row of a table of points the first row that is the same point; None where no row repeats."""
        if self.study.points is None:
            return None
        rows = self.rows[POINT]
        first: dict[tuple[Value, ...], int] = {}
        found = np.array([first.setdefault(values, place) for place, values in enumerate(rows)])
        return found if len(first) < len(rows) else None

    def with_repeats(self, of_points: NDArray[Any]) -> NDArray[Any]:
        """Return an array over the points, (points, ...), in which repeated rows of a table have what the first has:
        they are the same point, which is computed once.
        """
        if self.first_rows is None:
            return of_points
        by_row = of_points.reshape(self.shape[0], -1, *of_points.shape[1:])
        return np.asarray(by_row[self.first_rows].reshape(of_points.shape))

    def __len__(self) -> int:
        return math.prod(self.shape)

    def parameters(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield index and parameters of the points that are not excluded, in C order; repeated ones only once."""
        names, clauses, first = self._names, self.study.excluded, self.first_rows
        row = 1 if first is None else len(self) // len(first)
        for index, combination in enumerate(itertools.product(*self.rows.values())):
            if first is not None and first[index // row] != index // row:
                continue
            parameters = self._fixed.copy()
            parameters.update(zip(names, itertools.chain.from_iterable(combination), strict=True))
            if not (clauses and self.excludes(parameters)):
                yield index, parameters

    def indices(self) -> NDArray[np.intp]:
        """Return the indices of the points that `parameters` yields."""
        if self.first_rows is None and not self.study.excluded:
            return np.arange(len(self))
        return np.fromiter((index for index, _ in self.parameters()), dtype=np.intp)

    def points(self, indices: NDArray[np.intp] | None = None) -> Iterator[GridPoint]:
        """Yield the points that are not excluded, in C order, or those at ``indices``, excluded or not."""
        indices = self.indices() if indices is None else indices
        for start in range(0, len(indices), AT_ONCE):
            some = indices[start : start + AT_ONCE]
            digests = self.digests(some)
            streams = self._digests(some, self._shared) if self._shared else digests
            for index, digest, stream, *combination in zip(
                some.tolist(), digests, streams, *self._along(some), strict=True
            ):
                parameters = self._fixed.copy()
                parameters.update(zip(self._names, itertools.chain.from_iterable(combination), strict=True))
                yield GridPoint(index, parameters, digest, stream)

    def point(self, index: int) -> GridPoint:
        """Return the point at an index, excluded or not."""
        return next(self.points(np.array([index])))

    def digests(self, indices: NDArray[np.intp]) -> list[bytes]:
        """Return the digests of the points at ``indices``: 16 bytes that identify a point by its own parameters.

        Parameters at their default do not count, so that the digests of old points stay the same when a later version
        adds a parameter.
        """
        return self._digests(indices)

    def _digests(self, indices: NDArray[np.intp], left_out: Collection[str] = ()) -> list[bytes]:
        """Return digests of points by all their parameters except those ``left_out``."""
        places = dict(zip(self.dimensions, self._places(indices), strict=True))
        known = [(dimension, own) for name, dimension, own in self._texts_along if name not in left_out]
        texts = [
            itertools.repeat(own[0], len(indices)) if dimension is None else map(own.__getitem__, places[dimension])
            for dimension, own in known
        ]
        rows: Iterable[Iterable[Any]] = zip(*texts, strict=True) if texts else itertools.repeat((), len(indices))
        if any(None in own for _, own in known):  # a parameter at its default
            rows = (filter(None, row) for row in rows)
        return [blake2b(f"{{{', '.join(row)}}}".encode(), digest_size=16).digest() for row in rows]

    @cached_property
    def _texts_along(self) -> list[tuple[str, str | None, list[str | None]]]:
        """Each parameter that may count in a digest, in order: the dimension that it is along, None where it is fixed,
        and its text at each place there; None where it is at its default.
        """
        dimension_of = {axis: dimension for dimension, axes in self.dimensions.items() for axis in axes}
        defaults, axes = self.study.experiment.defaults(), self.study.axes
        values = {name: [value] for name, value in self._fixed.items()} | {n: list(v) for n, v in axes.items()}
        found = []
        for name in sorted(values):
            key, default = json.dumps(name), defaults[name]
            texts = {v: f"{key}: {as_json(v)}" for v in values[name] if v != default}
            if texts:
                found.append((name, dimension_of.get(name), [texts.get(value) for value in values[name]]))
        return found

    def _along(self, indices: NDArray[np.intp]) -> list[Iterator[tuple[Value, ...]]]:
        """Return the values on the axes of each dimension, point by point."""
        places = zip(self.rows.values(), self._places(indices), strict=True)
        return [map(rows.__getitem__, along) for rows, along in places]

    def _places(self, indices: NDArray[np.intp]) -> list[list[int]]:
        """Return where along each dimension the points at ``indices`` are."""
        return [along.tolist() for along in np.unravel_index(indices, self.shape)] if self.shape else []

    @cached_property
    def _fixed(self) -> dict[str, Any]:
        return self.study.experiment.defaults() | dict(self.study.fixed)

    @cached_property
    def _names(self) -> list[str]:
        return [axis for axes in self.dimensions.values() for axis in axes]

    @cached_property
    def rows(self) -> dict[str, list[tuple[Value, ...]]]:
        """The values at each place along each dimension, one for each of its axes."""
        axes = self.study.axes
        return {name: list(zip(*(axes[axis] for axis in own), strict=True)) for name, own in self.dimensions.items()}

    @cached_property
    def _shared(self) -> frozenset[str]:
        """Parameters that do not change a point's random numbers."""
        study = self.study
        return frozenset(study.experiment.shared if study.sampling.common_random_numbers else ())

    def draw(self, parameters: Mapping[str, Any]) -> tuple[Value, ...]:
        """Return a key that is equal for two points of this grid exactly if they share their random numbers."""
        return tuple(parameters[name] for name in self._names if name not in self._shared)

    def excludes(self, parameters: Mapping[str, Any]) -> bool:
        """Return whether the study leaves out a point."""
        return any(all(c.holds(parameters[c.name]) for c in clause) for clause in self.study.excluded)


def describe(study: Study, parameters: dict[str, Any]) -> str:
    """Return a point's place on the axes in words: ``model=gaia,v_max=16.0``."""
    return ",".join(f"{name}={parameters[name]}" for name in study.axes) or "the only point"
