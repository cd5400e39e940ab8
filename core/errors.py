"""Error models (steps C and D): small values with one protocol, the errors of a catalogue's observables."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from core.catalogue import Catalogue, OwnErrors
from core.constants import MAS
from core.missions import Mission

Array = NDArray[np.float64]


class ErrorModel(Protocol):
    """Every single error is normal around zero; errors of different objects are independent."""

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return the errors of (ra*, dec, pmra, pmdec) of each object in rad and rad/yr; shape (4, N)."""
        ...

    def correlation(self, catalogue: Catalogue) -> Array | None:
        """Return the correlations of each object's four errors, shape (N, 4, 4), or None where there are none."""
        ...


class _Uncorrelated:
    def correlation(self, catalogue: Catalogue) -> Array | None:
        """Return None: the errors of an object are independent."""
        return None


@dataclass(frozen=True)
class NoErrors(_Uncorrelated):
    """Error-free data."""

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return zeros; shape (4, N)."""
        return np.zeros((4, len(catalogue)))


@dataclass(frozen=True)
class NormalErrors(_Uncorrelated):
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
class MagnitudeErrors(_Uncorrelated):
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


@dataclass(frozen=True)
class CatalogueErrors:
    """The errors that the catalogue lists for each object of a side, with their correlations if any, times ``scale``.

    Raises ValueError for a catalogue without errors of its own.
    """

    scale: float = 1.0
    side: str = "satellite"

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return the catalogue's own errors; shape (4, N)."""
        return self.scale * self._own(catalogue).sigma

    def correlation(self, catalogue: Catalogue) -> Array | None:
        """Return the catalogue's own correlations; shape (N, 4, 4)."""
        return self._own(catalogue).correlation

    def _own(self, catalogue: Catalogue) -> OwnErrors:
        own = catalogue.own_errors(self.side)
        if own is None:
            raise ValueError("the catalogue has no errors of its own")
        return own


def _four_rows(sigma_pos_mas: Array, sigma_pm_mas_yr: Array) -> Array:
    return MAS * np.stack([sigma_pos_mas, sigma_pos_mas, sigma_pm_mas_yr, sigma_pm_mas_yr])
