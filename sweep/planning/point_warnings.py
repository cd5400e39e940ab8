"""What an experiment warns of, gathered over the points of a grid."""

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from sweep.planning.point_cache import PointCache
from sweep.studies.study import Study

MOST = 20
"""As many different warnings are told."""


class PointWarnings:
    """Counts the points that each warning of the experiment's `warn` is about."""

    def __init__(self, study: Study) -> None:
        self._warn = PointCache(partial(_sentences, study), study.axes)
        self._counts: Counter[str] = Counter()

    def look(self, parameters: dict[str, Any]) -> None:
        """Ask about a point that can be computed."""
        if sentences := self._warn(parameters):
            self._counts.update(sentences)

    @property
    def is_silent(self) -> bool:
        """Whether no point is warned of, as the first shows."""
        return self._warn.is_constant and not self._counts

    def sentences(self) -> tuple[str, ...]:
        """Return each warning with the number of its points."""
        told = [f"{text} ({n} point{'s' if n > 1 else ''})" for text, n in list(self._counts.items())[:MOST]]
        return (*told, *([f"... and {len(self._counts) - MOST} other warnings"] if len(self._counts) > MOST else []))


def _sentences(study: Study, parameters: Mapping[str, Any]) -> Sequence[str]:
    try:
        return tuple(map(str, study.experiment.warn(parameters)))
    except Exception as error:  # whatever a user's function raises
        return (f"the experiment's `warn` raises {type(error).__name__}: {error}",)
