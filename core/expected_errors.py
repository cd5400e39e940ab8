"""Errors of a point before any catalogue of it is drawn, at the cost of a few multiplications."""

from functools import partial

import numpy as np

from core.catalogue import Catalogue
from core.constants import MAS
from core.errors import SIDES, Errors
from core.scenario import Array, catalogue_kind, error_kind, error_model, own_objects
from sweep.contract import Point


def errors_at_limit(point: Point, side: str) -> Errors:
    """Return the errors of one side, "reference" or "satellite", for an object at the limit of a catalogue that is
    drawn.
    """
    return error_kind(point, side).errors_at(point, side, partial(_limit, point))


def _limit(point: Point) -> float:
    return catalogue_kind(point).magnitudes(point)[1]


def errors_of_objects(point: Point, objects: Catalogue) -> tuple[Array, Array]:
    """Return the errors (mas, mas/yr) of the reference and the satellite for objects, shape (4, N) each."""
    with np.errstate(over="ignore"):  # a curve far beyond its range is infinite, and refused for that
        reference, satellite = (error_model(point, side).standard_errors(objects) / MAS for side in SIDES)
    return reference, satellite


def has_errors(point: Point, side: str) -> bool:
    """Return whether one side has any error, so that normals are drawn for it."""
    return error_kind(point, side).any(point, side, partial(own_objects, point))
