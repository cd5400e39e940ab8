"""Error models (steps C and D): small values with one method, the standard errors of a catalogue's observables."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from core.catalogue import Catalogue
from core.constants import MAS
from core.missions import Mission

Array = NDArray[np.float64]


class ErrorModel(Protocol):
    """Every single error is normal around zero with these standard errors."""

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return the errors of (ra*, dec, pmra, pmdec) of each object in rad and rad/yr; shape (4, N)."""
        ...


@dataclass(frozen=True)
class NoErrors:
    """Error-free data."""

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return zeros; shape (4, N)."""
        return np.zeros((4, len(catalogue)))


@dataclass(frozen=True)
class NormalErrors:
    """The same errors for every object: ``sigma_pos_mas`` per coordinate and ``sigma_pm_mas_yr``, times ``scale``."""

    sigma_pos_mas: float
    sigma_pm_mas_yr: float
    scale: float = 1.0

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return constants; shape (4, N)."""
        return _four_rows(
            self.scale * self.sigma_pos_mas * np.ones(len(catalogue)),
            self.scale * self.sigma_pm_mas_yr * np.ones(len(catalogue)),
        )


@dataclass(frozen=True)
class MagnitudeErrors:
    """A mission's accuracy curve at a mission length (None: its nominal one), times ``scale``."""

    mission: Mission
    mission_length_yr: float | None = None
    scale: float = 1.0

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return the curve at each object's magnitude; shape (4, N)."""
        return _four_rows(
            self.scale * self.mission.sigma_pos_mas(catalogue.v_mag, self.mission_length_yr),
            self.scale * self.mission.sigma_pm_mas_yr(catalogue.v_mag, self.mission_length_yr),
        )


def _four_rows(sigma_pos_mas: Array, sigma_pm_mas_yr: Array) -> Array:
    return MAS * np.stack([sigma_pos_mas, sigma_pos_mas, sigma_pm_mas_yr, sigma_pm_mas_yr])
