"""Errors of a point before any catalogue of it is drawn, at the cost of a few multiplications."""

from functools import partial
from math import hypot

import numpy as np

from core.arrays import Array
from core.catalogue import Catalogue
from core.constants import MAS
from core.errors import SIDES, Errors
from core.errors.floor import floor_of
from core.scenario import catalogue_kind, error_kind, error_model, own_objects, zonal_errors
from sweep.contract import Point


def errors_at_limit(point: Point, side: str) -> Errors:
    """Return the errors of one side, "reference" or "satellite", for an object at the limit of a catalogue that is
    drawn.
    """
    kind = error_kind(point, side)
    errors = kind.errors_at(point, side, lambda: catalogue_kind(point).magnitudes(point)[1])
    floor = floor_of(point, kind, side)
    return errors if floor is None else Errors(*map(hypot, errors, floor))


def errors_of_objects(point: Point, objects: Catalogue) -> tuple[Array, Array]:
    """Return the errors (mas, mas/yr) of the reference and the satellite for objects, shape (4, N) each."""
    with np.errstate(over="ignore"):  # a curve far beyond its range is infinite, and refused for that
        reference, satellite = (error_model(point, side).standard_errors(objects) / MAS for side in SIDES)
    return reference, satellite


def has_errors(point: Point, side: str) -> bool:
    """Return whether one side has any error, so that normals are drawn for it."""
    if side == "satellite" and zonal_errors(point) is not None:
        return True
    kind = error_kind(point, side)
    return floor_of(point, kind, side) is not None or kind.any(point, side, partial(own_objects, point))
