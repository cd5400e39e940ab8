"""The grid of a study: dimensions, points and their digests."""

import hashlib
import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from sweep.contract import SweepError, Value
from sweep.study import Study

MAX_POINTS = 10_000_000
MAX_PROBLEMS = 20


@dataclass(frozen=True)
class GridPoint:
    """One point: its place in the grid (C order), all its parameters, and the digest that names its random streams."""

    index: int
    parameters: dict[str, Any]
    digest: bytes


@dataclass(frozen=True)
class Grid:
    """The points of a study: dimensions in the order of its axes; axes that are zipped share the dimension of the
    first.
    """

    study: Study

    @cached_property
    def dimensions(self) -> dict[str, tuple[str, ...]]:
        """The axes along each dimension, by the dimension's name."""
        partner = {name: group for group in self.study.zipped for name in group}
        found: dict[str, tuple[str, ...]] = {}
        for name in self.study.axes:
            group = partner.get(name, (name,))
            if not any(name in axes for axes in found.values()):
                found[group[0]] = group
        return found

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Length of each dimension."""
        return tuple(len(self.study.axes[dimension]) for dimension in self.dimensions)

    def __len__(self) -> int:
        return math.prod(self.shape)

    def points(self) -> Iterator[GridPoint]:
        """Yield the points that are not excluded, in C order."""
        study = self.study
        defaults = study.experiment.defaults()
        fixed = defaults | dict(study.fixed)
        names = [axis for axes in self.dimensions.values() for axis in axes]
        columns = [list(zip(*(study.axes[a] for a in axes), strict=True)) for axes in self.dimensions.values()]
        for index, combination in enumerate(itertools.product(*columns)):
            parameters = fixed | dict(zip(names, itertools.chain.from_iterable(combination), strict=True))
            if not self._excluded(parameters):
                yield GridPoint(index, parameters, point_digest(parameters, defaults))

    def _excluded(self, parameters: dict[str, Any]) -> bool:
        return any(all(c.holds(parameters[c.name]) for c in clause) for clause in self.study.excluded)


def make_grid(study: Study) -> Grid:
    """Return the grid of a study after asking the experiment about every point.

    Raises SweepError that lists the points that cannot be computed (grouped by reason), points that are the same point
    twice, or a grid too large or empty.
    """
    grid = Grid(study)
    if len(grid) > MAX_POINTS:
        raise SweepError(f"the grid has {len(grid):,} points; at most {MAX_POINTS:,} are allowed", study.name)
    problems: dict[str, int] = {}
    seen: set[bytes] = set()
    for point in grid.points():
        if (reason := study.experiment.check(point.parameters)) is not None:
            problems[reason] = problems.get(reason, 0) + 1
        if point.digest in seen:
            problems[f"the same point occurs twice: {describe(study, point.parameters)}"] = 1
        seen.add(point.digest)
    if not seen:
        raise SweepError("every point of the grid is excluded", study.name)
    if problems:
        sentences = [f"{reason} ({n} point{'s' if n > 1 else ''})" for reason, n in problems.items()]
        if len(sentences) > MAX_PROBLEMS:
            sentences[MAX_PROBLEMS:] = [f"... and {len(sentences) - MAX_PROBLEMS} more reasons"]
        raise SweepError(sentences, study.name)
    return grid


def describe(study: Study, parameters: dict[str, Any]) -> str:
    """Return a point's place on the axes in words: ``model=gaia,v_max=16.0``."""
    return ",".join(f"{name}={parameters[name]}" for name in study.axes) or "the only point"


def point_digest(parameters: dict[str, Value], defaults: dict[str, Value]) -> bytes:
    """Return 16 bytes that identify a point by its own parameters, whatever grid it is in.

    Parameters at their default do not count, so that a parameter which a later version adds leaves old points what
    they were.
    """
    own = {name: value for name, value in parameters.items() if value != defaults[name]}
    return hashlib.blake2b(json.dumps(own, sort_keys=True).encode(), digest_size=16).digest()
