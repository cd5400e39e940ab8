"""What an error model is (steps C and D): the errors of a catalogue's observables, and how a study chooses them."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.catalogue import SIDES, Catalogue
from linksweep.core.catalogues.kind import CatalogueKind
from linksweep.core.constants import MAS
from linksweep.sweep.contract import Point

Objects = Callable[[], Catalogue | None]


class ErrorModel:
    """Every single error is normal around zero; errors of different objects are independent."""

    @property
    def elementwise(self) -> bool:
        """Whether the errors of an object follow from its magnitude alone, to the last bit, so that catalogues which
        begin with the same objects share them.
        """
        return False

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return the errors of (ra*, dec, pmra, pmdec) of each object in rad and rad/yr; shape (4, N)."""
        raise NotImplementedError

    def correlation(self, catalogue: Catalogue) -> Array | None:
        """Return the correlations of each object's four errors, shape (N, 4, 4), or None where there are none."""
        return None


class Errors(NamedTuple):
    """Errors of a position (mas) and a proper motion (mas/yr)."""

    pos_mas: float
    pm_mas_yr: float


class ErrorKind:
    """One value of `reference_errors` and `satellite_errors`: an error model as a study chooses it.

    ``sides`` are those that may have it.  A new one is a module with a subclass and a line in
    `core.errors.ERROR_KINDS`.
    """

    sides: tuple[str, ...] = SIDES

    def uses(self, side: str) -> frozenset[str]:
        """Return the names of the parameters that it reads, for one side."""
        return frozenset(
            {"error_scale", *(f"{side}_{name}" for name in ("error_scale", "error_ratio", "floor_pos", "floor_pm"))}
        )

    def model(self, point: Point, side: str) -> ErrorModel:
        """Return the error model of a point."""
        raise NotImplementedError

    def errors_at(self, point: Point, side: str, v_mag: Callable[[], float]) -> Errors:
        """Return the errors of an object of magnitude ``v_mag()``, which is called only where it matters, with a few
        multiplications; not implemented for errors that a catalogue lists.
        """
        raise NotImplementedError

    def any(self, point: Point, side: str, objects: Objects) -> bool:
        """Return whether there is any error, so that normals are drawn; ``objects`` returns those that are listed."""
        raise NotImplementedError

    def problem(self, point: Point, side: str, catalogue: CatalogueKind) -> str | None:
        """Return why the objects of a catalogue cannot have these errors, or None."""
        return None

    def warning(self, point: Point, catalogue: CatalogueKind) -> str | None:
        """Return why the errors are less certain than they seem, or None."""
        return None


def scale_of(point: Point, side: str) -> float:
    """Return the factor on all errors of one side."""
    return float(point["error_scale"] * point[f"{side}_error_scale"])


def four_rows(sigma_pos_mas: Array, sigma_pm_mas_yr: Array) -> Array:
    """Return errors of (ra*, dec, pmra, pmdec) in rad and rad/yr, shape (4, N), from those of a coordinate (N,)."""
    return MAS * np.stack([sigma_pos_mas, sigma_pos_mas, sigma_pm_mas_yr, sigma_pm_mas_yr])
