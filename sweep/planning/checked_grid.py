"""The grid of a study, after its experiment was asked about every point."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from typing import Any, Generic, TypeVar

from linksweep.sweep.contract import Point, SweepError, shown
from linksweep.sweep.planning.grid import Grid
from linksweep.sweep.studies.points import remarks
from linksweep.sweep.studies.study import POINT, Study

T = TypeVar("T")

MAX_POINTS = 10_000_000
MAX_PROBLEMS = 20
"""The most reasons, repeated points and different warnings that are listed."""

MAX_KEPT = 100_000
"""The most answers that are kept of a function of a point."""


def make_grid(study: Study) -> Grid:
    """Return the grid of a study after asking the experiment about every point.

    A fixed parameter must matter at one point at least.  An axis must matter wherever it has another value than the
    default: otherwise equal points would have different names.

    Raises SweepError for points that cannot be computed (grouped by reason; the check stops after
    `MAX_PROBLEMS` reasons), for points that occur twice, and for a grid that is too large or empty.
    """
    grid = Grid(study)
    if len(grid) > MAX_POINTS:
        sizes = " x ".join(f"{name} {length:,}" for name, length in zip(grid.dimensions, grid.shape, strict=True))
        message = (
            f"the grid has {len(grid):,} points ({sizes}); at most {MAX_POINTS:,} are allowed: cut it into studies "
            "with a store each, or take a design of points (--design)"
        )
        raise SweepError(message, study.source)
    sentences = _repeated(grid)
    judged = PointCache(partial(_judged, study), study.axes)
    reasons, warnings = Counter[str](), Counter[str]()
    idle: Mapping[str, str] | None = None  # fixed parameters that mattered at no point so far
    last: object = None
    for _, parameters in grid.parameters():
        reason, unused, warned = judged(parameters)
        if reason is None:
            if unused is not last:  # one object for all points that are alike to the experiment
                last, known = unused, unused if idle is None else idle
                idle = {name: why for name, why in known.items() if name in unused and name in study.fixed}
            warnings.update(warned)
            if judged.is_constant and not warned:
                break  # the experiment accepts every point: it looks at nothing that differs between them
            continue
        if reason not in reasons and len(reasons) == MAX_PROBLEMS:
            reasons["... and other reasons; the rest of the grid was not checked"] = 0
            break
        reasons[reason] += 1
    else:
        if not judged.was_called:
            raise SweepError("every point of the grid is excluded", study.source)
    sentences += _with_points(reasons)
    if not reasons and idle:
        sentences += [f"{name} = {shown(study.fixed[name])} changes nothing: {why}" for name, why in idle.items()]
    if sentences:
        raise SweepError(sentences, study.source)
    told = _with_points(warnings)
    if len(told) > MAX_PROBLEMS:
        told[MAX_PROBLEMS:] = [f"... and {len(told) - MAX_PROBLEMS} other warnings"]
    grid.warnings.extend([*remarks({} if study.points is None else study.points.origin), *told])
    return grid


def _judged(study: Study, parameters: Point) -> tuple[str | None, Mapping[str, str], tuple[str, ...]]:
    """Return why a point cannot be computed, which parameters change nothing at it, and warnings of it."""
    defaults = study.experiment.defaults()
    what = "check of a point"
    try:
        if (reason := study.experiment.check(parameters)) is not None:
            return reason, {}, ()
        what = "`unused`"
        unused = dict(study.experiment.unused(parameters))
    except Exception as error:  # whatever a user's function raises
        return _raised(what, error), {}, ()
    if unknown := unused.keys() - defaults.keys():
        names = ", ".join(map(shown, sorted(unknown)))
        return f"the experiment's `unused` names {names}, which is no parameter", {}, ()
    for name in (name for name in unused if name in study.axes):
        if parameters[name] != defaults[name]:
            return f"the axis {name} changes nothing at some points: {unused[name]}", {}, ()
    try:
        return None, unused, tuple(map(str, study.experiment.warn(parameters)))
    except Exception as error:
        return None, unused, (_raised("`warn`", error),)


def _raised(what: str, error: Exception) -> str:
    return f"the experiment's {what} raises {type(error).__name__}: {error}"


def _with_points(counts: Mapping[str, int]) -> list[str]:
    """Return sentences, each with the number of points that it is about unless that is 0."""
    return [f"{text} ({n} point{'s' if n > 1 else ''})" if n else text for text, n in counts.items()]


def _repeated(grid: Grid) -> list[str]:
    """Return which points occur twice: the values of an axis are distinct, so only zipped axes can repeat a point; a
    table may.
    """
    sentences: list[str] = []
    for dimension, rows in grid.rows.items():
        counts = {} if dimension == POINT else {values: n for values, n in Counter(rows).items() if n > 1}
        for values in list(counts)[:MAX_PROBLEMS]:
            place = ",".join(f"{name}={value}" for name, value in zip(grid.dimensions[dimension], values, strict=True))
            sentences.append(f"the same point occurs {counts[values]} times: {place}")
        if len(counts) > MAX_PROBLEMS:
            sentences.append(f"... and {len(counts) - MAX_PROBLEMS} more points")
    return sentences


class PointCache(Generic[T]):
    """A function of a point, called once for each combination of values of those axes that it looks at.

    In a grid of a million points an experiment's check or cost rarely looks at all axes.  The function must depend on
    its point alone.
    """

    def __init__(self, function: Callable[[Point], T], axes: Collection[str]) -> None:
        self._function, self._axes = function, axes
        self._read: tuple[str, ...] = ()
        self._known: dict[tuple[Any, ...], T] = {}

    def __call__(self, parameters: dict[str, Any]) -> T:
        """Return the function's value for these parameters."""
        if self._read and len(self._read) == len(self._axes):
            return self._function(parameters)  # it reads every axis, so that no result can be used twice
        key = tuple([parameters[name] for name in self._read])
        if key in self._known:
            return self._known[key]
        watched = _Watched(parameters)
        answer = self._function(watched)
        if new := watched.read.intersection(self._axes).difference(self._read):
            self._read += tuple(new)
            self._known.clear()  # their keys lack the axes that are new
            key = tuple([parameters[name] for name in self._read])
        if len(self._known) < MAX_KEPT:
            self._known[key] = answer
        return answer

    @property
    def was_called(self) -> bool:
        """Whether there was a point."""
        return bool(self._known)

    @property
    def is_constant(self) -> bool:
        """Whether the function was called and reads no axis, so that it has one value for all points."""
        return self.was_called and not self._read

    def table(self) -> tuple[tuple[str, ...], dict[tuple[Any, ...], T]] | None:
        """Return the axes that the function reads, and its results by the values of these; None if not all are kept."""
        whole = len(self._read) < max(len(self._axes), 1) and len(self._known) < MAX_KEPT
        return (self._read, dict(self._known)) if whole else None


class _Watched(Mapping[str, Any]):
    """A point that records which of its parameters are read."""

    def __init__(self, parameters: dict[str, Any]) -> None:
        self._parameters = parameters
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Any:
        self.read.add(name)
        return self._parameters[name]

    def __iter__(self) -> Iterator[str]:
        self.read.update(self._parameters)
        return iter(self._parameters)

    def __len__(self) -> int:
        return len(self._parameters)
