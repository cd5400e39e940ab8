"""The errors that a catalogue lists for its objects."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.catalogue import Catalogue
from core.catalogues.kind import CatalogueKind
from core.errors.model import ErrorKind, ErrorModel, Objects, scale_of
from sweep.contract import Point

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CatalogueErrors:
    """The errors that the catalogue lists for each object, with their correlations if it has any, times ``scale``.

    Raises ValueError for a catalogue without errors of its own.
    """

    scale: float = 1.0

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return the catalogue's own errors; shape (4, N)."""
        if catalogue.sigma is None:
            raise ValueError("the catalogue has no errors of its own")
        return self.scale * catalogue.sigma

    def correlation(self, catalogue: Catalogue) -> Array | None:
        """Return the catalogue's own correlations; shape (N, 4, 4)."""
        return catalogue.correlation


class Own(ErrorKind):
    """`"catalogue"`: those of the objects."""

    def model(self, point: Point, side: str) -> ErrorModel:
        """Return it with the point's scale."""
        return CatalogueErrors(scale_of(point, side))

    def any(self, point: Point, side: str, objects: Objects) -> bool:
        """Return whether the scale and any object's error are above zero."""
        own = objects() if scale_of(point, side) > 0.0 else None
        return own is not None and own.sigma is not None and bool(np.any(own.sigma))

    def problem(self, point: Point, side: str, catalogue: CatalogueKind) -> str | None:
        """The objects must have errors."""
        own = catalogue.objects(point)
        if own is not None and own.sigma is not None:
            return None
        return f"{side}_errors = 'catalogue': the {point['catalogue']} catalogue has no errors of its own"
