"""The physics of a point, from its parameters: catalogue, errors, truth and solution; and the errors to be expected
before any catalogue is drawn, at the cost of a few multiplications.
"""

from functools import partial
from math import hypot

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.catalogue import Catalogue
from linksweep.core.catalogues import CATALOGUES, CatalogueKind
from linksweep.core.constants import DEGREE, GALACTIC_AXES, MAS, MICROARCSEC
from linksweep.core.errors import ERROR_KINDS, SIDES, ErrorKind, ErrorModel, Errors
from linksweep.core.errors.floor import FlooredErrors, floor_of
from linksweep.core.prepared import Scenario, TrueVector
from linksweep.core.systematics import Pattern, Systematics, Vector, parse_pattern, rms
from linksweep.core.zonal import ZonalErrors
from linksweep.sweep.contract import Point

GALACTIC_GLIDE_UAS_YR = 4.0
"""Glide towards the Galactic centre.  Source: Kovalevsky 2003, as quoted by Metz & Geffert 2004, Sect. 5.1; Gaia EDR3
has since measured 5.05.
"""


def scenario(point: Point) -> Scenario:
    """Return the physics of a point (its parameters by name, in the units of `PARAMETERS`)."""
    random = point["directions"] == "random"
    return Scenario(
        draw_catalogue=catalogue_kind(point).nested_draw(point),
        reference_errors=error_model(point, "reference"),
        satellite_errors=error_model(point, "satellite"),
        epsilon=TrueVector(_radians(point["epsilon"], point["epsilon_size"]), random),
        omega=TrueVector(_radians(point["omega"], point["omega_size"]), random),
        aberration=_glide(point) if point["aberration"] else (0.0, 0.0, 0.0),
        solve_glide=point["solve_glide"],
        corrections=point["corrections"],
        weighting=point["weighting"],
        arithmetic=point["arithmetic"],
        method=point["method"],
        reference_error_ratio=point["reference_error_ratio"],
        satellite_error_ratio=point["satellite_error_ratio"],
        zonal=zonal_errors(point),
        systematics=systematics(point),
    )


def zonal_errors(point: Point) -> ZonalErrors | None:
    """Return the zonal errors of the satellite at a point, or None."""
    position, motion = point["zonal_pos"], point["zonal_pm"]
    if not position and not motion:
        return None
    return ZonalErrors(position * MAS, motion * MAS, point["zonal_length"] * DEGREE)


def systematics(point: Point) -> Systematics:
    """Return the systematic errors of the proper motions at a point; raises ValueError for an invalid motion_field."""
    return Systematics(
        omega_slope=_radians(point["omega_slope"], point["omega_slope_size"]),
        magnitude_equation=(point["magnitude_equation_pmra"] * MAS, point["magnitude_equation_pmdec"] * MAS),
        v_zero=point["v_zero"],
        pattern=_pattern(point["motion_field"], point["motion_field_size"]),
    )


def catalogue_kind(point: Point) -> CatalogueKind:
    """Return the kind of a point's catalogue."""
    return CATALOGUES[point["catalogue"]]


def error_kind(point: Point, side: str) -> ErrorKind:
    """Return the kind of errors of one side, "reference" or "satellite"."""
    return ERROR_KINDS[point["reference_errors" if side == "reference" else "satellite_errors"]]


def error_model(point: Point, side: str) -> ErrorModel:
    """Return the error model of one side, "reference" or "satellite"."""
    kind = error_kind(point, side)
    model, floor = kind.model(point, side), floor_of(point, kind, side)
    return model if floor is None else FlooredErrors(model, floor)


def catalogue_size(point: Point) -> int:
    """Return the number of objects of a point's catalogue."""
    n_obj = point["n_obj"]  # first: where it is given, the kind does not matter
    return catalogue_kind(point).size(point) if n_obj is None else int(n_obj)


def own_objects(point: Point) -> Catalogue | None:
    """Return the objects of a catalogue that lists them, None for one that is drawn from a law."""
    return catalogue_kind(point).objects(point)


def errors_at_limit(point: Point, side: str) -> Errors:
    """Return the errors of one side, "reference" or "satellite", for an object at the faint limit of a catalogue
    that is drawn.
    """
    kind = error_kind(point, side)
    errors = kind.errors_at(point, side, lambda: catalogue_kind(point).magnitudes(point)[1])
    floor = floor_of(point, kind, side)
    return errors if floor is None else Errors(*map(hypot, errors, floor))


def errors_of_objects(point: Point, objects: Catalogue) -> tuple[Array, Array]:
    """Return the errors (mas, mas/yr) of the reference and the satellite for objects, shape (4, N) each."""
    with np.errstate(over="ignore"):  # far beyond its range a curve is infinite, which is refused later
        reference, satellite = (error_model(point, side).standard_errors(objects) / MAS for side in SIDES)
    return reference, satellite


def has_errors(point: Point, side: str) -> bool:
    """Return whether one side has any error, so that normals are drawn for it."""
    if side == "satellite" and zonal_errors(point) is not None:
        return True
    kind = error_kind(point, side)
    return floor_of(point, kind, side) is not None or kind.any(point, side, partial(own_objects, point))


def _radians(vector_mas: Vector, size_mas: float | None) -> Vector:
    x, y, z = vector_mas
    if size_mas is not None:
        vector = np.array(vector_mas) * MAS
        length = np.linalg.norm(vector)
        vector = vector / length * size_mas if length > 0.0 else np.array([size_mas, 0.0, 0.0])
        x, y, z = vector
    return (float(x * MAS), float(y * MAS), float(z * MAS))


def _pattern(text: str | None, size_mas_yr: float | None) -> Pattern:
    if text is None:
        return ()
    pattern = parse_pattern(text)
    scale = MAS if size_mas_yr is None else MAS * size_mas_yr / rms(pattern)
    return tuple((term, coefficient * scale) for term, coefficient in pattern)


def _glide(point: Point) -> Vector:
    given = point["glide"]
    x, y, z = MICROARCSEC * (GALACTIC_GLIDE_UAS_YR * GALACTIC_AXES[0] if given is None else np.array(given))
    return (float(x), float(y), float(z))
