"""Error-free data."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from core.arrays import Array
from core.catalogue import Catalogue
from core.errors.model import ErrorKind, ErrorModel, Errors, Objects
from sweep.contract import Point


@dataclass(frozen=True)
class NoErrors(ErrorModel):
    """Error-free data."""

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return zeros; shape (4, N)."""
        return np.zeros((4, len(catalogue)))


class ErrorFree(ErrorKind):
    """`"none"`."""

    def uses(self, side: str) -> frozenset[str]:
        """Return none: the scales do not matter either."""
        return frozenset()

    def model(self, point: Point, side: str) -> ErrorModel:
        """Return it."""
        return NoErrors()

    def errors_at(self, point: Point, side: str, v_mag: Callable[[], float]) -> Errors:
        """Return zeros."""
        return Errors(0.0, 0.0)

    def any(self, point: Point, side: str, objects: Objects) -> bool:
        """Return False."""
        return False
