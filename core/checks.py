"""Why a point cannot be computed, told before anything runs."""

import numpy as np

from core.catalogue import GALAXY_FAINT_LIMIT_MAG
from core.constants import MAS
from core.missions import MISSIONS, MissionUnavailableError
from core.scenario import catalogue_size, errors_at_limit, limiting_magnitude, own_objects, table_objects
from sweep.contract import Point, SweepError

SMALLEST_ERROR, LARGEST_ERROR = 1e-9, 1e7
"""Errors in mas and mas/yr for which the link is computed: beyond, weights overflow or an error is no small angle."""

LARGEST_PROJECTED_ERROR = 50_000.0
"""Position error of the reference in mas beyond which no isotropic catalogue keeps within the bound that
`core.projected.neglected` sets.
"""

SMALLEST_GLIDE = 3
"""Objects that determine nine unknowns: two give twelve observables, but of rank eight."""


def check(point: Point) -> str | None:
    """Return why this point cannot be computed, or None."""
    problem = _check_catalogue(point)
    if problem is None and point["solve_glide"] and catalogue_size(point) < SMALLEST_GLIDE:
        problem = f"n_obj = {catalogue_size(point)}: solving for a glide too needs at least {SMALLEST_GLIDE} objects"
    if problem is None and point["aberration"] and point["catalogue"] == "radio-stars":
        problem = "aberration: the glide is that of extragalactic objects, not of radio stars"
    try:
        return problem or _check_error_models(point) or _check_errors(point) or _check_method(point)
    except MissionUnavailableError as error:
        return str(error)


def _check_catalogue(point: Point) -> str | None:
    if (point["catalogue"] == "file") != (point["file"] is not None):
        return "file: catalogue = 'file' needs a file, and other catalogues have none"
    own = {"radio-stars": "isotropic", "file": "own"}.get(point["catalogue"], "isotropic")
    if (point["positions"] or own) == "own" and (point["zone_of_avoidance"] > 0.0 or point["sky_contrast"] != 0.0):
        return "zone_of_avoidance and sky_contrast are for random positions (positions = 'isotropic')"
    return {
        "synthetic": _check_synthetic,
        "galaxies": _check_galaxies,
        "radio-stars": _check_radio_stars,
        "quasars": _check_available,
        "file": _check_available,
    }[point["catalogue"]](point)


def _check_synthetic(point: Point) -> str | None:
    if point["n_obj"] is None:
        return "n_obj: a synthetic catalogue needs a number of objects"
    if limiting_magnitude(point) <= point["v_min"]:
        brightest = f"v_min = {point['v_min']:g} mag"
        return f"v_max = {limiting_magnitude(point):g} mag: must be fainter than the brightest object, {brightest}"
    return None


def _check_galaxies(point: Point) -> str | None:
    limit = limiting_magnitude(point)
    if 11.0 <= limit <= GALAXY_FAINT_LIMIT_MAG:
        return None
    return f"v_max = {limit:g} mag: the galaxies have magnitudes from 11 to {GALAXY_FAINT_LIMIT_MAG:g} mag"


def _check_radio_stars(point: Point) -> str | None:
    return (
        None if point["v_max"] is None else "v_max: the radio stars have no limiting magnitude, all 11 are drawn from"
    )


def _check_available(point: Point) -> str | None:
    """The quasars or the objects of a file must be enough."""
    try:
        if point["catalogue"] == "file" and point["v_max"] is not None and not _has_magnitudes(point):
            return "v_max needs a magnitude column (v_mag, phot_g_mean_mag, vt_mag) in the file"
        available = catalogue_size({**point, "n_obj": None})
    except ValueError as error:
        return str(error)
    except SweepError as error:
        return f"{error} ({error.where})"
    wanted = max(2, point["n_obj"] or 0)
    if available >= wanted:
        return None
    limit = "" if point["v_max"] is None else f" brighter than v_max = {point['v_max']:g} mag"
    what = "quasars" if point["catalogue"] == "quasars" else "objects of the file"
    return f"n_obj = {wanted}: only {available} {what} are{limit or ' there'}"


def _has_magnitudes(point: Point) -> bool:
    return not np.any(np.isnan(table_objects({**point, "v_max": None}).v_mag))


def _check_error_models(point: Point) -> str | None:
    mission = MISSIONS[point["model"]]
    by_magnitude = point["satellite_errors"] == "magnitude"
    if by_magnitude and point["catalogue"] == "file" and not _has_magnitudes(point):
        return "satellite_errors = 'magnitude' needs a magnitude column (v_mag, phot_g_mean_mag) in the file"
    objects = own_objects(point)
    faintest = limiting_magnitude(point) if objects is None else float(np.max(objects.v_mag))
    if by_magnitude and faintest > mission.faint_limit_mag:
        return f"v_max = {faintest:g} mag: the curve of {point['model']!r} ends at {mission.faint_limit_mag:g} mag"
    own = objects is not None and objects.sigma is not None
    for side in ("reference", "satellite"):
        if point[f"{side}_errors"] == "catalogue" and not own:
            return f"{side}_errors = 'catalogue': the {point['catalogue']} catalogue has no errors of its own"
    return None


def _check_errors(point: Point) -> str | None:
    """Inverse-variance weights need both a position and a proper-motion error, or neither (error-free data)."""
    errors = np.hypot(*errors_at_limit(point)) / MAS
    if not errors.any():
        return None
    without = ~(errors > 0.0)
    position, motion = without[:2].all(), without[2:].all()
    if position or motion:
        exact, noisy = ("positions", "proper motions") if position else ("proper motions", "positions")
        return f"{exact} without any error beside {noisy} with errors cannot be weighed; give an error to both"
    if without.any():
        row = 1 + int(np.argmax(without.any(axis=0)))
        return f"object {row} has an observable without any error, which cannot be weighed"
    if errors.min() < SMALLEST_ERROR or errors.max() > LARGEST_ERROR:
        extreme = np.min if errors.min() < SMALLEST_ERROR else np.max
        position_mas, motion_mas_yr = extreme(errors[:2]), extreme(errors[2:])
        return (
            f"errors of {position_mas:.3g} mas and {motion_mas_yr:.3g} mas/yr: must be from {SMALLEST_ERROR:g} to "
            f"{LARGEST_ERROR:g}"
        )
    return None


def _check_method(point: Point) -> str | None:
    """Projected errors need a fixed design; what is near the limit is told by the catalogue when it is drawn."""
    if point["method"] == "catalogue":
        return None
    objects = own_objects(point)
    own = "catalogue" in (point["satellite_errors"], point["reference_errors"])
    if own and objects is not None and objects.correlation is not None:
        return "method = 'projected' needs uncorrelated errors, and those of the file are correlated"
    reference, _ = errors_at_limit(point)
    position_mas = float(np.max(reference[:2])) / MAS
    if position_mas <= LARGEST_PROJECTED_ERROR:
        return None
    return (
        f"method = 'projected' takes the reference's positions as exact in the design matrix: an error of "
        f"{position_mas:.3g} mas is more than {LARGEST_PROJECTED_ERROR:g} mas"
    )
