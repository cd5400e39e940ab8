"""Caches a function of a point by those of its parameters that the function reads."""

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, Generic, TypeVar

from linksweep.sweep.contract import Point

T = TypeVar("T")

MAX_KEPT = 100_000


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
        if len(self._read) == len(self._axes):
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
    def is_constant(self) -> bool:
        """Whether the function was called and reads no axis, so that it has one value for all points."""
        return bool(self._known) and not self._read

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
