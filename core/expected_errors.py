"""Errors of a point before any catalogue of it is drawn, at the cost of a few multiplications."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from core.catalogue import Catalogue
from core.constants import MAS
from core.scenario import Array, error_model, limiting_magnitude, mission_of, own_objects
from sweep.contract import Named, Point

SIDES = ("reference", "satellite")


class Errors(NamedTuple):
    """Errors of a position (mas) and a proper motion (mas/yr)."""

    pos_mas: float
    pm_mas_yr: float


def errors_at_limit(point: Point, side: str) -> Errors:
    """Return the errors of one side, "reference" or "satellite", for an object at the limit of a catalogue that is
    drawn.
    """
    kind = point["reference_errors" if side == "reference" else "satellite_errors"]
    if kind == "none":
        return Errors(0.0, 0.0)
    scale = _scale(point, side)
    if kind == "normal":
        return Errors(scale * point[f"{side}_sigma_pos"], scale * point[f"{side}_sigma_pm"])
    model, length_yr = point["model"], point["mission_length"]
    pos_mas, pm_mas_yr, nominal_yr = _curves(model, limiting_magnitude(point))
    if length_yr is not None:
        ratio = length_yr / nominal_yr
        pos_mas, pm_mas_yr = pos_mas * _power(ratio, -0.5), pm_mas_yr * _power(ratio, -1.5)
    return Errors(scale * pos_mas, scale * pm_mas_yr)


def errors_of_objects(point: Point, objects: Catalogue) -> tuple[Array, Array]:
    """Return the errors (mas, mas/yr) of the reference and the satellite for objects, shape (4, N) each."""
    with np.errstate(over="ignore"):  # a curve far beyond its range is infinite, and refused for that
        reference, satellite = (error_model(point, side).standard_errors(objects) / MAS for side in SIDES)
    return reference, satellite


def has_errors(point: Point, side: str) -> bool:
    """Return whether one side has any error, so that normals are drawn for it."""
    kind = point["reference_errors" if side == "reference" else "satellite_errors"]
    if kind == "none" or _scale(point, side) <= 0.0:
        return False
    if kind == "normal":
        return bool(point[f"{side}_sigma_pos"] > 0.0 or point[f"{side}_sigma_pm"] > 0.0)
    if kind == "magnitude":
        return True  # a curve is positive everywhere
    objects = own_objects(point)
    own = None if objects is None else objects.own_errors(side)
    return own is not None and bool(np.any(own.sigma))


def _scale(point: Point, side: str) -> float:
    factor = point["reference_error_scale" if side == "reference" else "satellite_error_scale"]
    return float(point["error_scale"] * factor)


@lru_cache(maxsize=1024)
def _curves(model: str | Named, v_mag: float) -> tuple[float, float, float]:
    """Return the errors at a magnitude and the nominal length, once for all scales and lengths."""
    mission = mission_of(model)
    with np.errstate(over="ignore"):
        pos_mas, pm_mas_yr = (
            float(curve(np.array(v_mag))) for curve in (mission.curve_pos_mas, mission.curve_pm_mas_yr)
        )
    return pos_mas, pm_mas_yr, mission.nominal_length_yr


def _power(ratio: float, exponent: float) -> float:
    try:
        return float(ratio**exponent)
    except (OverflowError, ZeroDivisionError):
        return math.inf
