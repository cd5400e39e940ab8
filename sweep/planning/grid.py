"""The grid of a study: dimensions, points and their digests; made once its experiment was asked about every point."""

import itertools
import json
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from hashlib import blake2b
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Point, Status, SweepError, Value, shown
from linksweep.sweep.studies.points import MAX_PROBLEMS, remarks
from linksweep.sweep.studies.study import POINT, Study, are_met, is_other
from linksweep.sweep.tables.columns import sorted_json

T = TypeVar("T")

MAX_POINTS = 10_000_000

# In place of a value: the place along an axis of its own of points at which it has no effect.  None is a value.
NO_EFFECT: Value = object()

# The most answers that are kept of a function of a point.
MAX_KEPT = 100_000

# How many points have their places in memory at a time.
AT_ONCE = 2**16


@dataclass(frozen=True, slots=True)
class GridPoint:
    """One point: its place in C order, all its parameters, and the digests that name it in ledgers and streams."""

    index: int
    parameters: dict[str, Any]
    digest: bytes
    stream: bytes


class Grid:
    """The points of a study.  The dimension of a table of points comes first, then the axes in their order; zipped axes
    share one (`Study.dimensions`).  The experiment has ``said`` some warnings, if `make_grid` has asked it.

    ``dimensions`` has the axes along each dimension, ``shape`` its length, ``rows`` the values at each place along it,
    one for each of its axes.
    """

    def __init__(self, study: Study, said: Sequence[str] = ()) -> None:
        """Take the axes of a study; nothing is asked."""
        self.study, self.said, self.dimensions = study, said, study.dimensions
        self._lacking = study.lacking
        self.rows: dict[str, list[tuple[Value, ...]]] = {
            name: [*zip(*(study.axes[axis] for axis in axes), strict=True), *[(NO_EFFECT,)] * (name in self._lacking)]
            for name, axes in self.dimensions.items()
        }
        self.shape = tuple(map(len, self.rows.values()))
        self._fixed = study.experiment.defaults() | dict(study.fixed)
        self._names = [axis for axes in self.dimensions.values() for axis in axes]
        # parameters that do not change a point's random numbers
        self._shared = frozenset(study.experiment.shared if study.sampling.common_random_numbers else ())

    @cached_property
    def warnings(self) -> list[str]:
        """Sentences about conditions that no point meets and about a design, and what the experiment has ``said``."""
        study, asked, warnings = self.study, self.study.sections.get("when", {}), list[str]()
        clauses = [("exclude", clause, False) for clause in study.excluded]
        clauses += [(f"when.{n}", one, n not in asked) for n, one in study.when.items() if n in {**study.axes, **asked}]
        for where, clause, is_declared in clauses:
            unmet = filter(None, (one.unmet(study.values[one.name], is_declared) for one in clause))
            warnings.extend(f"{where}: {sentence}" for sentence in unmet)
        return [*warnings, *remarks({} if study.points is None else study.points.origin), *self.said]

    def with_repeats(self, of_points: NDArray[Any]) -> NDArray[Any]:
        """Return an array over the points, (points, ...), in which a repeated one has what the first has: they are the
        same point, which is computed once.
        """
        return of_points if self._first is None else np.asarray(of_points[self._first])

    @cached_property
    def _first(self) -> NDArray[np.intp] | None:
        """For each point the index of the first that is the same; None where none repeats.  Rows of a table may, and
        those that differ only in parameters without effect.
        """
        rows, together = self.rows.get(POINT, ()), {*self._names} - {*self._lacking}
        if together.isdisjoint(self.study.partial) and len({(row, *map(type, row)) for row in rows}) == len(rows):
            return None
        first: dict[bytes, int] = {}
        points = enumerate(zip(self._raw(everything := np.arange(len(self))), self.digests(everything), strict=True))
        places = [first.setdefault(digest, k) if is_there else k for k, ((*_, is_there), digest) in points]
        return np.array(places) if len(first) < len(places) else None

    def without(self, name: str) -> NDArray[np.float64]:
        """Return which part of the points at each place along its dimension is without a parameter."""
        gone = [name in missing for _, missing, _ in self._raw(np.arange(len(self)))]
        others = tuple(k for k, axes in enumerate(self.dimensions.values()) if name not in axes)
        return np.asarray(np.array(gone).reshape(self.shape).mean(axis=others))

    @property
    def divided(self) -> list[str]:
        """The axes that share a dimension with a place along it that has points with their effect and others without:
        their coordinates could not say so.
        """
        shared = [name for name in self.study.partial if name in self.study.axes and name not in self.study.alone]
        return [name for name in shared if (self.without(name) % 1.0).any()]

    def repeated(self, indices: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the indices of points with those that repeat them."""
        return np.flatnonzero(self.with_repeats(np.isin(np.arange(len(self)), indices)))

    def __len__(self) -> int:
        return math.prod(self.shape)

    def parameters(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield index and parameters of the points that are not excluded, in C order; repeated ones only once."""
        first = self._first
        for start in range(0, len(self), AT_ONCE):
            some = np.arange(start, min(start + AT_ONCE, len(self)))
            for index, (parameters, _, is_there) in zip(some.tolist(), self._raw(some), strict=True):
                if is_there and (first is None or first[index] == index) and index not in self._left_out:
                    yield index, parameters

    def indices(self) -> NDArray[np.intp]:
        """Return the indices of the points that `parameters` yields."""
        if self._first is None and not (self.study.excluded or self._lacking or self._left_out):
            return np.arange(len(self))
        return np.fromiter((index for index, _ in self.parameters()), dtype=np.intp)

    def coarse_first(self, indices: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return indices in a nested order: the first ones cover each axis in large steps, later ones lie between them.

        The bits of the places along all axes are taken in turn, the highest first, as those of a number from its lowest
        on (van der Corput 1935, Verteilungsfunktionen).  Rows of a design cover its ranges in their own order.
        """
        designed = self.study.points is not None and "design" in self.study.points.origin
        order, bit = np.zeros(len(indices), dtype=np.int64), 0
        bits = [(length - 1).bit_length() for length in self.shape]
        along = {dimension: np.array(some, dtype=np.int64) for dimension, some in self.places(indices).items()}
        for level in range(max(bits, default=0)):
            for (dimension, places), most in zip(along.items(), bits, strict=True):
                if level < most:
                    shift = level if designed and dimension == POINT else most - 1 - level
                    order |= ((places >> shift) & 1) << bit
                    bit += 1
        return indices[np.argsort(order, kind="stable")]

    def points(self, indices: NDArray[np.intp] | None = None) -> Iterator[GridPoint]:
        """Yield the points that are not excluded, in C order, or those at ``indices``, excluded or not."""
        indices = self.indices() if indices is None else indices
        for start in range(0, len(indices), AT_ONCE):
            some = indices[start : start + AT_ONCE]
            digests = self.digests(some)
            streams = self.digests(some, self._shared) if self._shared else digests
            for index, (parameters, *_), digest, stream in zip(
                some.tolist(), self._raw(some), digests, streams, strict=True
            ):
                yield GridPoint(index, parameters, digest, stream)

    def _raw(self, indices: NDArray[np.intp]) -> Iterator[tuple[dict[str, Any], list[str], bool]]:
        """Yield the parameters of points, None for those without effect or at the place for these, the names of those
        without effect, and whether the study has the point: neither excludes it nor has it at another place.
        """
        # the values, point by point
        along = [map(self.rows[name].__getitem__, numbers) for name, numbers in self.places(indices).items()]
        for _, *combination in zip(indices.tolist(), *along, strict=True):
            parameters = self._fixed.copy()
            parameters.update(zip(self._names, itertools.chain.from_iterable(combination), strict=True))
            gone: list[str] = []
            is_there = True
            if self.study.when:
                gone = self.study.missing(parameters)
                is_there = all((parameters[name] is NO_EFFECT) == (name in gone) for name in self._lacking)
                parameters.update(dict.fromkeys([*gone, *(n for n in self._lacking if parameters[n] is NO_EFFECT)]))
            yield parameters, gone, is_there and not (self.study.excluded and self.excludes(parameters, gone))

    def idle(self, indices: NDArray[np.intp]) -> set[str]:
        """Return the parameters that have no effect at any of the points at ``indices``."""
        return set[str].intersection(*({*gone} for _, gone, _ in self._raw(indices))) if self.study.when else set()

    @cached_property
    def _left_out(self) -> set[int]:
        """The indices of the points that a study which was refined does not have."""
        without = {bytes.fromhex(name) for name, n in self.study.counts.items() if n == 0}
        digests = self.digests(np.arange(len(self))) if without else ()
        return {index for index, digest in enumerate(digests) if digest in without}

    def point(self, index: int) -> GridPoint:
        """Return the point at an index, excluded or not."""
        return next(self.points(np.array([index])))

    def digests(self, indices: NDArray[np.intp], left_out: Collection[str] = ()) -> list[bytes]:
        """Return the digests of the points at ``indices``: 16 bytes that identify a point by its own parameters, all
        but those ``left_out``.

        Parameters at their default do not count, so that the digests of old points stay the same when a later version
        adds a parameter.
        """
        places = self.places(indices)
        known = [entry for entry in self._texts_along if entry[0] not in left_out]
        gone = [missing for _, missing, _ in self._raw(indices)] if self.study.when else []
        texts = list[Iterable[bytes]]()
        for name, dimension, along in known:
            numbers = itertools.repeat(0, len(indices)) if dimension is None else places[dimension]
            if name in self.study.when:
                numbers = [-1 if name in some else number for number, some in zip(numbers, gone, strict=True)]
            texts.append(map(along.__getitem__, numbers))
        rows: Iterable[Iterable[bytes]] = zip(*texts, strict=True) if texts else itertools.repeat((), len(indices))
        return [blake2b(b"{%b}" % text[:-2], digest_size=16).digest() for text in map(b"".join, rows)]

    @cached_property
    def _texts_along(self) -> list[tuple[str, str | None, list[bytes]]]:
        """Each parameter that may count in a digest, in order: the dimension that it is along, None where it is fixed,
        and its text at each place there, and at last where it is missing; empty where it is at its default.
        """
        dimension_of = {axis: dimension for dimension, axes in self.dimensions.items() for axis in axes}
        defaults, entries = self.study.experiment.defaults(), []
        for name, values in sorted(self.study.values.items()):
            key, default = json.dumps(name), defaults[name]
            different = {(type(v), v) for v in values if is_other(v, default)}
            texts = {one: f"{key}: {sorted_json(one[1])}, ".encode() for one in different}
            if texts or name in self.study.when:
                missing = [f"{key}: null, ".encode() if is_other(None, default) else b""]
                along = [texts.get((type(v), v), b"") for v in values] + missing * (name in self.study.when)
                entries.append((name, dimension_of.get(name), along))
        return entries

    def places(self, indices: NDArray[np.intp]) -> dict[str, list[int]]:
        """Return where along each dimension the points at ``indices`` are."""
        along = np.unravel_index(indices, self.shape) if self.shape else ()
        return {name: numbers.tolist() for name, numbers in zip(self.dimensions, along, strict=True)}

    def excludes(self, parameters: Mapping[str, Any], gone: Collection[str] | None = None) -> bool:
        """Return whether the study leaves out a point with these parameters, of which some have no effect (``gone``) if
        that is known already.
        """
        gone = self.study.missing(parameters) if gone is None else gone
        return any(are_met(clause, parameters, gone) for clause in self.study.excluded)


def all_but(study: Study, points: Collection[bytes]) -> dict[str, int]:
    """Return the counts by which a study leaves out all points but some, by their digests."""
    grid = Grid(replace(study, counts={}))
    return {digest.hex(): 0 for digest in grid.digests(grid.indices()) if digest not in points}


def describe(study: Study, parameters: dict[str, Any]) -> str:
    """Return a point's place on the axes in words: ``model=gaia,v_max=16.0``."""
    return ",".join(f"{name}={str(parameters[name]) or 'none'}" for name in study.axes) or "the only point"


def failures_by_place(
    grid: Grid, status: NDArray[np.int8], records: Mapping[bytes, Mapping[str, str]], most: int | None = None
) -> dict[str, str]:
    """Return the points that failed by a ``status`` that is indexed like the grid, or the first of them, by their place
    on the axes, and why, from the ``records`` of a store.
    """
    failed = np.flatnonzero(status == Status.FAILED)[:most]
    return {describe(grid.study, p.parameters): records[p.digest]["message"] for p in grid.points(failed)}


def make_grid(study: Study) -> Grid:
    """Return the grid of a study after asking the experiment about every point.

    A fixed parameter must matter at one point at least.  An axis must matter wherever it has another value than the
    default: otherwise equal points would have different names.

    Raises SweepError for points that cannot be computed (grouped by reason; the check stops after
    `MAX_PROBLEMS` reasons), and for a grid that is too large or empty.
    """
    grid = Grid(study)
    if len(grid) > MAX_POINTS:
        sizes = " x ".join(f"{name} {length:,}" for name, length in zip(grid.dimensions, grid.shape, strict=True))
        allowed = f"at most {MAX_POINTS:,} are allowed; a design has fewer (--design)"
        raise SweepError(f"the grid has {len(grid):,} points ({sizes}); {allowed}", study.source)
    if divided := grid.divided:
        words = "shares a dimension, at some places of which only some points have its effect: give a table of points"
        raise SweepError([f"when.{name}: {name} {words}" for name in divided], study.source)
    required = [one.name for one in study.experiment.parameters if not one.optional and one.default is not None]
    may_lack = [name for name in required if name in study.when and None in study.values[name]]
    judged = PointCache(partial(_judged, study, may_lack), study.varying, most=1)
    reasons, warnings = Counter[str](), Counter[str]()
    idle: Mapping[str, str] | None = None  # fixed parameters that mattered at no point so far
    for _, parameters in grid.parameters():
        reason, unused, warned = judged(study.arguments(parameters))
        if reason is not None:
            reasons[reason] += 1
            if len(reasons) > MAX_PROBLEMS:
                break
            continue
        known = unused if idle is None else idle
        idle = {name: why for name, why in known.items() if name in unused and name in study.fixed}
        warnings.update(warned)
        if judged.is_constant and not warned:
            break  # the experiment accepts every point: it looks at nothing that differs between them
    if not judged.was_called:
        raise SweepError("every point of the grid is excluded", study.source)
    sentences = _with_points(reasons, "reasons; the rest of the grid was not checked")
    if not reasons and idle:
        sentences += [f"{name} = {shown(study.fixed[name])} changes nothing: {why}" for name, why in idle.items()]
    if sentences:
        raise SweepError(sentences, study.source)
    return Grid(study, _with_points(warnings, "warnings"))


def _judged(
    study: Study, may_lack: Sequence[str], parameters: Point
) -> tuple[str | None, Mapping[str, str], tuple[str, ...]]:
    """Return why a point cannot be computed, which parameters change nothing at it, and warnings of it."""
    defaults = study.experiment.defaults()
    what = "check of a point"
    lacking = [name for name in may_lack if parameters[name] is None and name not in study.missing(parameters)]
    try:
        reason = f"{lacking[0]} has no value where it has an effect" if lacking else study.experiment.check(parameters)
        if reason is not None:
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


def _with_points(counts: Mapping[str, int], what: str) -> list[str]:
    """Return the first sentences, each with the number of points that it is about."""
    texts = [f"{text} ({n} point{'s' if n > 1 else ''})" for text, n in counts.items()]
    return [*texts[:MAX_PROBLEMS], *([f"... and other {what}"] if len(texts) > MAX_PROBLEMS else [])]


class PointCache(Generic[T]):
    """A function of a point, called once for each combination of values of those axes that it looks at.

    In a grid of a million points an experiment's check or cost rarely looks at all axes.  If it does, at most ``most``
    answers are kept: none is needed twice where each point is asked about once.  The function must depend on its point
    alone.
    """

    def __init__(self, function: Callable[[Point], T], axes: Collection[str], most: int = MAX_KEPT) -> None:
        self._function, self._axes, self._most = function, axes, most
        self._read: tuple[str, ...] = ()
        self._known: dict[tuple[Any, ...], T] = {}

    def __call__(self, parameters: dict[str, Any]) -> T:
        """Return the function's value for these parameters."""
        key = tuple([parameters[name] for name in self._read])
        if key in self._known:
            return self._known[key]
        watched = _Watched(parameters)
        answer = self._function(watched)
        if new := watched.read.intersection(self._axes).difference(self._read):
            self._read += tuple(new)
            self._known.clear()  # their keys lack the axes that are new
            key = tuple([parameters[name] for name in self._read])
        if len(self._known) < (MAX_KEPT if len(self._read) < len(self._axes) else self._most):
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
