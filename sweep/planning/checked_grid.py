"""The grid of a study, after its experiment was asked about every point."""

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from linksweep.sweep.contract import SweepError, shown
from linksweep.sweep.planning.grid import Grid
from linksweep.sweep.planning.point_cache import PointCache
from linksweep.sweep.studies.designs import remarks
from linksweep.sweep.studies.study import POINT, Study

MAX_POINTS = 10_000_000
MAX_PROBLEMS = 20
"""The most reasons, repeated points and different warnings that are listed."""


def make_grid(study: Study) -> Grid:
    """Return the grid of a study after asking the experiment about every point.

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
    reasons, warnings = Counter[str](), Counter[str]()
    empty = True
    check, warn = PointCache(partial(_reason, study), study.axes), PointCache(partial(_warnings, study), study.axes)
    settings = _UnusedSettings(study)
    for _, parameters in grid.parameters():
        empty = False
        if (reason := check(parameters)) is None and (reason := settings.reason(parameters)) is None:
            if told := warn(parameters):
                warnings.update(told)
            if check.is_constant and settings.is_constant and warn.is_constant and not warnings:
                break  # the experiment accepts every point: it looks at nothing that differs between them
            continue
        if reason not in reasons and len(reasons) == MAX_PROBLEMS:
            reasons["... and other reasons; the rest of the grid was not checked"] = 0
            break
        reasons[reason] += 1
    if empty:
        raise SweepError("every point of the grid is excluded", study.source)
    sentences += _with_points(reasons)
    if not reasons:
        sentences += settings.nowhere()
    if sentences:
        raise SweepError(sentences, study.source)
    told_of = _with_points(warnings)
    if len(told_of) > MAX_PROBLEMS:
        told_of[MAX_PROBLEMS:] = [f"... and {len(told_of) - MAX_PROBLEMS} other warnings"]
    grid.warnings.extend([*remarks({} if study.points is None else study.points.origin), *told_of])
    return grid


def _with_points(counts: Mapping[str, int]) -> list[str]:
    """Return sentences, each with the number of points that it is about unless that is 0."""
    return [f"{text} ({n} point{'s' if n > 1 else ''})" if n else text for text, n in counts.items()]


def _repeated(grid: Grid) -> list[str]:
    """Return which points occur twice: the values of an axis are distinct, so only zipped axes can repeat a point."""
    sentences: list[str] = []
    for dimension, rows in grid.rows.items():
        if dimension == POINT:
            continue  # a table may repeat a point
        counts = Counter(rows)
        repeated = [values for values, n in counts.items() if n > 1]
        for values in repeated[:MAX_PROBLEMS]:
            place = ",".join(f"{name}={value}" for name, value in zip(grid.dimensions[dimension], values, strict=True))
            sentences.append(f"the same point occurs {counts[values]} times: {place}")
        if len(repeated) > MAX_PROBLEMS:
            sentences.append(f"... and {len(repeated) - MAX_PROBLEMS} more points")
    return sentences


class _UnusedSettings:
    """The settings of a study that change nothing, according to the experiment's `unused`.

    A fixed parameter must matter at one point at least.  An axis must matter wherever it has another value than the
    default: otherwise equal points would have different names.
    """

    def __init__(self, study: Study) -> None:
        self._defaults = study.experiment.defaults()
        self._axes = frozenset(study.axes)
        self._fixed = study.fixed
        self._unused = PointCache(partial(_unused, study), study.axes)
        self._nowhere: dict[str, str] | None = None  # fixed parameters that mattered at no point so far
        self._last: Mapping[str, str] | None = None

    def reason(self, parameters: dict[str, Any]) -> str | None:
        """Return why the values on the axes are refused at a point that can be computed, None if they are not."""
        unused = self._unused(parameters)
        if isinstance(unused, str):
            return unused
        if unused is not self._last:  # one object for all points that are alike to the experiment
            self._last = unused
            known = unused if self._nowhere is None else self._nowhere
            self._nowhere = {name: why for name, why in known.items() if name in unused and name in self._fixed}
        for name, why in unused.items() if unused else ():
            if name in self._axes and parameters[name] != self._defaults[name]:
                return f"the axis {name} changes nothing at some points: {why}"
        return None

    @property
    def is_constant(self) -> bool:
        """Whether what changes nothing is the same at all points, and is not on an axis."""
        return self._unused.is_constant and not self._axes.intersection(self._last or ())

    def nowhere(self) -> list[str]:
        """Return a sentence for each fixed parameter that changes nothing at any point."""
        unused = self._nowhere or {}
        return [f"{name} = {shown(self._fixed[name])} changes nothing: {why}" for name, why in unused.items()]


def _reason(study: Study, parameters: Mapping[str, Any]) -> str | None:
    try:
        return study.experiment.check(parameters)
    except Exception as error:  # whatever a user's check raises
        return _raised("check of a point", error)


def _warnings(study: Study, parameters: Mapping[str, Any]) -> Sequence[str]:
    try:
        return tuple(map(str, study.experiment.warn(parameters)))
    except Exception as error:  # whatever a user's function raises
        return (_raised("`warn`", error),)


def _unused(study: Study, parameters: Mapping[str, Any]) -> Mapping[str, str] | str:
    """Return what the experiment's `unused` returns, or a sentence where that is not a mapping of names to reasons."""
    try:
        unused = dict(study.experiment.unused(parameters))
    except Exception as error:  # whatever a user's function raises
        return _raised("`unused`", error)
    if unknown := unused.keys() - study.experiment.defaults().keys():
        return f"the experiment's `unused` names {', '.join(map(shown, sorted(unknown)))}, which is no parameter"
    return unused


def _raised(what: str, error: Exception) -> str:
    return f"the experiment's {what} raises {type(error).__name__}: {error}"
