"""The same errors for every object, or none."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.catalogue import Catalogue
from linksweep.core.errors.model import ErrorKind, ErrorModel, Errors, Objects, four_rows, scale_of
from linksweep.sweep.contract import Point


@dataclass(frozen=True)
class NormalErrors(ErrorModel):
    """The same errors for every object: ``sigma_pos_mas`` per coordinate and ``sigma_pm_mas_yr``, times ``scale``."""

    sigma_pos_mas: float
    sigma_pm_mas_yr: float
    scale: float = 1.0

    @property
    def elementwise(self) -> bool:
        """Return True."""
        return True

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return constants; shape (4, N)."""
        return four_rows(
            self.scale * self.sigma_pos_mas * np.ones(len(catalogue)),
            self.scale * self.sigma_pm_mas_yr * np.ones(len(catalogue)),
        )


class Normal(ErrorKind):
    """`"normal"`: the sigmas of the study."""

    def uses(self, side: str) -> frozenset[str]:
        """Return the side's sigmas and the scales."""
        return super().uses(side) | {f"{side}_sigma_pos", f"{side}_sigma_pm"}

    def model(self, point: Point, side: str) -> ErrorModel:
        """Return the model with the point's sigmas."""
        return NormalErrors(point[f"{side}_sigma_pos"], point[f"{side}_sigma_pm"], scale_of(point, side))

    def errors_at(self, point: Point, side: str, v_mag: Callable[[], float]) -> Errors:
        """Return the sigmas, whatever the magnitude."""
        scale = scale_of(point, side)
        return Errors(scale * point[f"{side}_sigma_pos"], scale * point[f"{side}_sigma_pm"])

    def any(self, point: Point, side: str, objects: Objects) -> bool:
        """Return whether the scale and a sigma are above zero."""
        sigmas = (point[f"{side}_sigma_pos"], point[f"{side}_sigma_pm"])
        return scale_of(point, side) > 0.0 and max(sigmas) > 0.0


@dataclass(frozen=True)
class NoErrors(ErrorModel):
    """Error-free data."""

    @property
    def elementwise(self) -> bool:
        """Return True."""
        return True

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return zeros; shape (4, N)."""
        return np.zeros((4, len(catalogue)))


class ErrorFree(ErrorKind):
    """`"none"`: no errors."""

    def uses(self, side: str) -> frozenset[str]:
        """Return no names: the scales do not matter either."""
        return frozenset()

    def model(self, point: Point, side: str) -> ErrorModel:
        """Return the error-free model."""
        return NoErrors()

    def errors_at(self, point: Point, side: str, v_mag: Callable[[], float]) -> Errors:
        """Return zeros."""
        return Errors(0.0, 0.0)

    def any(self, point: Point, side: str, objects: Objects) -> bool:
        """Return False."""
        return False
