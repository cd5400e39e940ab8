"""Refuses what a study sets although the experiment says that it changes nothing."""

from collections.abc import Mapping
from functools import partial
from typing import Any

from sweep.contract import shown
from sweep.planning.point_cache import PointCache
from sweep.studies.study import Study

_Unused = Mapping[str, str]


class UnusedSettings:
    """What a study sets although it changes nothing, by what the experiment's `unused` says of points.

    A fixed parameter must matter at one point at least.  An axis must matter wherever it has another value than the
    default: there it would give equal points under different names.
    """

    def __init__(self, study: Study) -> None:
        self._defaults = study.experiment.defaults()
        self._axes = frozenset(study.axes)
        self._unused = PointCache(partial(_unused, study), study.axes)
        self._nowhere: dict[str, str] | None = None  # fixed parameters that mattered at no point so far
        self._fixed = study.fixed
        self._last: _Unused | None = None

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
        return [
            f"{name} = {shown(self._fixed[name])} changes nothing: {why}" for name, why in (self._nowhere or {}).items()
        ]


def _unused(study: Study, parameters: Mapping[str, Any]) -> _Unused | str:
    """Return what the experiment's `unused` returns, or a sentence where that is not a mapping of names to reasons."""
    try:
        unused = dict(study.experiment.unused(parameters))
    except Exception as error:  # whatever a user's function raises
        return f"the experiment's `unused` raises {type(error).__name__}: {error}"
    if unknown := unused.keys() - study.experiment.defaults().keys():
        return f"the experiment's `unused` names {', '.join(map(shown, sorted(unknown)))}, which is no parameter"
    return unused
