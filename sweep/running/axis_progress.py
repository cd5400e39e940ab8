"""How far a study is along each of its axes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.planning.point_status import Status

MOST_LINES = 15
"""Most lines for one axis in a text."""


@dataclass(frozen=True)
class AxisSegment:
    """Values that follow one another along a dimension, the first and the last by axis, and counts of their points."""

    first: Mapping[str, Any]
    last: Mapping[str, Any]
    values: int
    points: int
    done: int
    failed: int
    excluded: int
    realisations_done: int
    realisations: int

    @property
    def percent(self) -> int:
        """Share of the realisations that is done; 100 only if all are."""
        return 100 * self.realisations_done // self.realisations if self.realisations else 100

    @property
    def untouched(self) -> bool:
        """Whether nothing has happened here."""
        return not (self.realisations_done or self.failed)

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do here."""
        return self.done == self.points

    def joined(self, after: "AxisSegment") -> "AxisSegment":
        """Return this segment and the one after it as one."""
        counts = {
            name: getattr(self, name) + getattr(after, name)
            for name in ("values", "points", "done", "failed", "excluded", "realisations_done", "realisations")
        }
        return AxisSegment(self.first, after.last, **counts)


def by_axis(
    axes: Mapping[str, Sequence[Mapping[str, Any]]],
    status: NDArray[np.int8],
    realisations: NDArray[np.int64],
    wanted: int,
) -> dict[str, list[AxisSegment]]:
    """Return for each dimension one segment for each value.

    ``axes`` has the values along each dimension, by axis; ``status`` and ``realisations`` done are shaped as the grid,
    and ``wanted`` are the realisations of a point that is not done.
    """
    of_point = np.where(status == Status.DONE, realisations, np.maximum(realisations, wanted))
    counts = {
        "points": status != Status.EXCLUDED,
        "done": status == Status.DONE,
        "failed": status == Status.FAILED,
        "excluded": status == Status.EXCLUDED,
        "realisations_done": np.where(status == Status.EXCLUDED, 0, realisations),
        "realisations": np.where(status == Status.EXCLUDED, 0, of_point),
    }
    found: dict[str, list[AxisSegment]] = {}
    for number, (dimension, values) in enumerate(axes.items()):
        others = tuple(d for d in range(status.ndim) if d != number)
        sums = {name: count.sum(axis=others) for name, count in counts.items()}
        found[dimension] = [
            AxisSegment(value, value, 1, **{name: int(along[i]) for name, along in sums.items()})
            for i, value in enumerate(values)
        ]
    return found


def folded(segments: Sequence[AxisSegment], most: int = MOST_LINES) -> list[AxisSegment]:
    """Join neighbours, down to ``most`` segments: first those all finished or all untouched, then the shortest."""
    left = list(segments)
    if len(left) > most:
        left = []
        for state, group in groupby(segments, key=lambda segment: (segment.finished, segment.untouched)):
            alike = list(group)
            left += [reduce(AxisSegment.joined, alike)] if any(state) else alike
    while len(left) > most:
        sizes = [a.values + b.values for a, b in pairwise(left)]
        at = sizes.index(min(sizes))
        left[at : at + 2] = [left[at].joined(left[at + 1])]
    return left


def as_lines(completion: Mapping[str, Sequence[AxisSegment]], units: Mapping[str, str]) -> list[str]:
    """Return the completion as aligned text; columns that would be empty are left out."""
    headers = ["", "points done", "realisations", "failed", "excluded"]
    partly = any(s.realisations != s.points for segments in completion.values() for s in segments)
    shown = [True, True, partly, *(any(getattr(s, n) for ss in completion.values() for s in ss) for n in headers[3:])]
    rows: list[list[str]] = []
    for segments in completion.values():
        names = [f"{name} [{unit}]" if (unit := units.get(name, "")) else name for name in segments[0].first]
        rows.append([", ".join(names), *headers[1:]])
        for segment in folded(segments):
            counts = [f"{segment.done:,}/{segment.points:,}", f"{segment.percent} %"]
            few = [f"{n:,}" if n else "" for n in (segment.failed, segment.excluded)]
            rows.append([f"  {_label(segment)}", *counts, *few])
    rows = [[cell for cell, show in zip(row, shown, strict=True) if show] for row in rows]
    widths = [max(len(row[i]) for row in rows) for i in range(sum(shown))] if rows else []
    return [
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))]).rstrip()
        for row in rows
    ]


def _label(segment: AxisSegment) -> str:
    first, last = (", ".join(map(str, place.values())) for place in (segment.first, segment.last))
    return first if segment.values == 1 else f"{first} ... {last} ({segment.values:,} values)"
