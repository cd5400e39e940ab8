"""The errors that a catalogue lists for its objects."""

from dataclasses import dataclass

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.catalogue import Catalogue, OwnErrors
from linksweep.core.catalogues.kind import CatalogueKind
from linksweep.core.errors.model import ErrorKind, ErrorModel, Objects, scale_of
from linksweep.sweep.contract import Point


@dataclass(frozen=True)
class CatalogueErrors(ErrorModel):
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


class Own(ErrorKind):
    """`"catalogue"`: the errors that the catalogue lists."""

    def model(self, point: Point, side: str) -> ErrorModel:
        """Return the model with the point's scale."""
        return CatalogueErrors(scale_of(point, side), side)

    def any(self, point: Point, side: str, objects: Objects) -> bool:
        """Return whether the scale and any object's error are above zero."""
        listed = objects() if scale_of(point, side) > 0.0 else None
        own = None if listed is None else listed.own_errors(side)
        return own is not None and bool(np.any(own.sigma))

    def problem(self, point: Point, side: str, catalogue: CatalogueKind) -> str | None:
        """Return a problem unless the objects have errors, and of both sides where both are to have their own."""
        objects = catalogue.objects(point)
        if objects is None or objects.own_errors(side) is None:
            return f"{side}_errors = 'catalogue': the {point['catalogue']} catalogue has no errors of its own"
        if point["reference_errors"] != point["satellite_errors"] or objects.reference is not None:
            return None
        both = "reference_errors and satellite_errors are both 'catalogue'"
        hint = "; name those of the other: columns = { reference_pmra_error = ... }"
        return f"{both}, but the objects have errors of one side only{hint if 'file' in catalogue.parameters else ''}"
