"""Reasons why a point cannot be computed, found before anything runs."""

import math

import numpy as np

from linksweep.core.catalogue import Catalogue
from linksweep.core.catalogues.kind import RANDOM_SKY
from linksweep.core.errors import SIDES
from linksweep.core.function_curve import CurveError
from linksweep.core.missions import MissionUnavailableError
from linksweep.core.scenario import (
    catalogue_kind,
    catalogue_size,
    error_kind,
    error_model,
    errors_at_limit,
    errors_of_objects,
    own_objects,
    systematics,
    zonal_errors,
)
from linksweep.sweep.contract import Point

SMALLEST_ERROR, LARGEST_ERROR = 1e-9, 1e7
"""Errors in mas and mas/yr between which the link is computed: outside, weights overflow or an error is not a small
angle.
"""

LARGEST_PROJECTED_ERROR = 50_000.0
"""Position error of the reference in mas beyond which `core.projected.neglected` is too large for any isotropic
catalogue.
"""

SMALLEST_GLIDE = 3
"""Objects that are needed to determine nine unknowns: two give only eight observables."""


def check(point: Point) -> str | None:
    """Return why this point cannot be computed, or None.

    It reads no parameter that does not matter at the point: the platform asks again only where another one differs.
    """
    if problem := _check_catalogue(point) or _check_glide(point) or _check_systematics(point):
        return problem
    objects = own_objects(point)
    try:
        if problem := _check_error_models(point):
            return problem
        problem = _check_errors(point) if objects is None else _check_errors_of_objects(point, objects)
        return problem or _check_method(point, objects)
    except (MissionUnavailableError, CurveError) as error:
        return str(error)


def _check_catalogue(point: Point) -> str | None:
    kind = catalogue_kind(point)
    uses = kind.uses(point)
    if point["file"] is not None and "file" not in uses:
        return "file: catalogue = 'file' needs a file, and other catalogues have none"
    if not uses >= RANDOM_SKY and (point["zone_of_avoidance"] > 0.0 or point["sky_contrast"] != 0.0):
        return "zone_of_avoidance and sky_contrast are for random positions (positions = 'isotropic')"
    return kind.why_not(point)


def _check_glide(point: Point) -> str | None:
    if point["solve_glide"] and catalogue_size(point) < SMALLEST_GLIDE:
        return f"n_obj = {catalogue_size(point)}: solving for a glide too needs at least {SMALLEST_GLIDE} objects"
    if point["aberration"] and not catalogue_kind(point).extragalactic:
        stars = point["catalogue"].replace("-", " ")
        return f"aberration: the glide is that of extragalactic objects, not of {stars}"
    return None


def _check_systematics(point: Point) -> str | None:
    try:
        found = systematics(point)
    except ValueError as error:
        return f"motion_field = {point['motion_field']!r}: {error}"
    if found.of_magnitude and any(map(math.isnan, catalogue_kind(point).magnitudes(point))):
        return (
            "omega_slope and magnitude equations need a magnitude column (v_mag, phot_g_mean_mag, vt_mag) in the file"
        )
    return None


def _check_error_models(point: Point) -> str | None:
    kind = catalogue_kind(point)
    problems = (error_kind(point, side).problem(point, side, kind) for side in SIDES)
    return next((problem for problem in problems if problem is not None), None)


def _check_errors(point: Point) -> str | None:
    """Return what is wrong with the errors, or None.  If only one kind of observable has errors, the other is not
    measured; if neither has, the data are error-free.
    """
    reference, satellite = errors_at_limit(point, "reference"), errors_at_limit(point, "satellite")
    position_mas = math.hypot(reference.pos_mas, satellite.pos_mas)
    motion_mas_yr = math.hypot(reference.pm_mas_yr, satellite.pm_mas_yr)
    if all(not error or SMALLEST_ERROR <= error <= LARGEST_ERROR for error in (position_mas, motion_mas_yr)):
        return _glide_without_motions(point, motions=bool(motion_mas_yr), positions=bool(position_mas))
    return _out_of_bounds(position_mas, motion_mas_yr)


def _check_errors_of_objects(point: Point, objects: Catalogue) -> str | None:
    errors = np.hypot(*errors_of_objects(point, objects))
    kinds = [kind for kind in (errors[:2], errors[2:]) if kind.any()]
    if not kinds:
        return None
    given = np.concatenate(kinds)
    if not (given > 0.0).all():
        row = 1 + int(np.argmax(~(given > 0.0).all(axis=0)))
        return f"object {row} has an observable without any error, which cannot be weighed"
    if given.min() < SMALLEST_ERROR or given.max() > LARGEST_ERROR:
        extreme = np.min if given.min() < SMALLEST_ERROR else np.max
        return _out_of_bounds(extreme(errors[:2]), extreme(errors[2:]))
    return _glide_without_motions(point, motions=bool(errors[2:].any()), positions=bool(errors[:2].any()))


def _glide_without_motions(point: Point, motions: bool, positions: bool) -> str | None:
    if not point["solve_glide"] or motions or not positions:
        return None
    return "solve_glide: the proper motions have no errors on either side, so they are not measured"


def _out_of_bounds(position_mas: float, motion_mas_yr: float) -> str:
    return (
        f"errors of {position_mas:.3g} mas and {motion_mas_yr:.3g} mas/yr: must be from {SMALLEST_ERROR:g} to "
        f"{LARGEST_ERROR:g}"
    )


def _check_method(point: Point, objects: Catalogue | None) -> str | None:
    """Return why the method cannot be used: projected errors need a fixed design.  Near the limit only the drawn
    catalogue decides.
    """
    if point["method"] == "catalogue":
        return None
    if zonal_errors(point) is not None:
        return "method = 'projected' needs errors that are independent from object to object, and zonal ones are not"
    for side in SIDES:
        if point[f"{side}_error_ratio"] != 1.0:
            return f"method = 'projected' needs true errors that equal those in the weights: {side}_error_ratio = 1"
    if objects is not None and any(error_model(point, side).correlation(objects) is not None for side in SIDES):
        return "method = 'projected' needs uncorrelated errors, and those of the file are correlated"
    if objects is None:
        position_mas = errors_at_limit(point, "reference").pos_mas
    else:
        position_mas = float(np.max(errors_of_objects(point, objects)[0][:2]))
    if position_mas <= LARGEST_PROJECTED_ERROR:
        return None
    return (
        f"method = 'projected' takes the reference's positions as exact in the design matrix: an error of "
        f"{position_mas:.3g} mas is more than {LARGEST_PROJECTED_ERROR:g} mas"
    )
