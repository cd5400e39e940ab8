"""Why a point cannot be computed, told before anything runs."""

import math
from functools import lru_cache

import numpy as np

from core.catalogue import GALAXY_FAINT_LIMIT_MAG, Catalogue
from core.expected_errors import SIDES, errors_at_limit, errors_of_objects
from core.function_curve import CurveError
from core.missions import MissionUnavailableError
from core.quasars import BRIGHTEST_MAG
from core.scenario import (
    available_objects,
    catalogue_size,
    limiting_magnitude,
    mission_of,
    own_objects,
    whole_table,
)
from sweep.contract import Named, Point, SweepError

SMALLEST_ERROR, LARGEST_ERROR = 1e-9, 1e7
"""Errors in mas and mas/yr for which the link is computed: beyond, weights overflow or an error is no small angle."""

LARGEST_PROJECTED_ERROR = 50_000.0
"""Position error of the reference in mas beyond which no isotropic catalogue keeps within the bound that
`core.projected.neglected` sets.
"""

SMALLEST_GLIDE = 3
"""Objects that determine nine unknowns: two give twelve observables, but of rank eight."""


PROBES = 100
"""Magnitudes at which a user's function is asked before anything runs."""

GALAXY_BRIGHTEST_MAG = 9.0
"""No galaxy is as bright: seven times the scatter above the mean."""


def check(point: Point) -> str | None:
    """Return why this point cannot be computed, or None.

    It looks at no parameter that does not matter for a point: the platform asks again only where another is different.
    """
    problem = _check_catalogue(point)
    if problem is None and point["solve_glide"] and catalogue_size(point) < SMALLEST_GLIDE:
        problem = f"n_obj = {catalogue_size(point)}: solving for a glide too needs at least {SMALLEST_GLIDE} objects"
    if problem is None and point["aberration"] and point["catalogue"] == "radio-stars":
        problem = "aberration: the glide is that of extragalactic objects, not of radio stars"
    if problem is not None:
        return problem
    objects = own_objects(point)
    try:
        problem = _check_error_models(point, objects)
        if problem is None:
            problem = _check_errors(point) if objects is None else _check_errors_of_objects(point, objects)
        return _check_method(point, objects) if problem is None else problem
    except (MissionUnavailableError, CurveError) as error:
        return str(error)


def _check_catalogue(point: Point) -> str | None:
    catalogue = point["catalogue"]
    if (catalogue == "file") != (point["file"] is not None):
        return "file: catalogue = 'file' needs a file, and other catalogues have none"
    own = (point["positions"] or ("own" if catalogue == "file" else "isotropic")) == "own"
    if own and (point["zone_of_avoidance"] > 0.0 or point["sky_contrast"] != 0.0):
        return "zone_of_avoidance and sky_contrast are for random positions (positions = 'isotropic')"
    if catalogue == "synthetic":
        return _check_synthetic(point)
    if catalogue == "galaxies":
        return _check_galaxies(point)
    return _check_radio_stars(point) if catalogue == "radio-stars" else _check_available(point)


def _check_synthetic(point: Point) -> str | None:
    if point["n_obj"] is None:
        return "n_obj: a synthetic catalogue needs a number of objects"
    limit, brightest = limiting_magnitude(point), point["v_min"]
    if limit <= brightest:
        return f"v_max = {limit:g} mag: must be fainter than the brightest object, v_min = {brightest:g} mag"
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
        available = available_objects(point)
    except ValueError as error:
        path = getattr(point["file"], "path", None)
        return str(error) if path is None else f"{error} ({path})"
    except SweepError as error:
        return f"{error} ({error.where})"
    wanted = max(2, point["n_obj"] or 0)
    if available >= wanted:
        return None
    limit = "" if point["v_max"] is None else f" brighter than v_max = {point['v_max']:g} mag"
    what = "quasars" if point["catalogue"] == "quasars" else "objects of the file"
    return f"n_obj = {wanted}: only {available} {what} are{limit or ' there'}"


def _has_magnitudes(point: Point) -> bool:
    return not np.any(np.isnan(whole_table(point).v_mag))


def _check_error_models(point: Point, objects: Catalogue | None) -> str | None:
    kind, catalogue = point["satellite_errors"], point["catalogue"]
    if kind == "magnitude":
        if catalogue == "file" and not _has_magnitudes(point):
            return "satellite_errors = 'magnitude' needs a magnitude column (v_mag, phot_g_mean_mag) in the file"
        model = point["model"]
        end = mission_of(model).faint_limit_mag
        faintest = limiting_magnitude(point) if objects is None else float(np.max(objects.v_mag))
        if faintest > end:
            return f"v_max = {faintest:g} mag: the curve of {str(model)!r} ends at {end:g} mag"
        if not isinstance(model, str):
            _probe(model, _brightest(point) if objects is None else float(np.min(objects.v_mag)), faintest)
    for side, errors in (("reference", point["reference_errors"]), ("satellite", kind)):
        if errors == "catalogue" and (objects is None or objects.own_errors(side) is None):
            return f"{side}_errors = 'catalogue': the {catalogue} catalogue has no errors of its own"
    if objects is not None and kind == point["reference_errors"] == "catalogue" and objects.reference is None:
        return (
            "reference_errors and satellite_errors are both 'catalogue', but the objects have errors of one side only"
            + ("; name those of the other: columns = { reference_pmra_error = ... }" if catalogue == "file" else "")
        )
    return None


def _brightest(point: Point) -> float:
    """Return the magnitude that no object of a catalogue that is drawn is brighter than."""
    if point["catalogue"] == "synthetic":
        return float(point["v_min"])
    return BRIGHTEST_MAG if point["catalogue"] == "quasars" else GALAXY_BRIGHTEST_MAG


@lru_cache(maxsize=256)
def _probe(model: Named, brightest: float, faintest: float) -> None:
    """Raise CurveError where the functions of a user's mission have no good values between two magnitudes."""
    mission, v_mag = mission_of(model), np.linspace(brightest, faintest, PROBES)
    mission.sigma_pos_mas(v_mag)
    mission.sigma_pm_mas_yr(v_mag)


def _check_errors(point: Point) -> str | None:
    """Inverse-variance weights need both a position and a proper-motion error, or neither (error-free data)."""
    reference, satellite = errors_at_limit(point, "reference"), errors_at_limit(point, "satellite")
    position_mas = math.hypot(reference.pos_mas, satellite.pos_mas)
    motion_mas_yr = math.hypot(reference.pm_mas_yr, satellite.pm_mas_yr)
    if not position_mas and not motion_mas_yr:
        return None
    if not position_mas > 0.0 or not motion_mas_yr > 0.0:
        return _one_without_error(point, exact_positions=not position_mas > 0.0)
    if SMALLEST_ERROR <= position_mas <= LARGEST_ERROR and SMALLEST_ERROR <= motion_mas_yr <= LARGEST_ERROR:
        return None
    return _out_of_bounds(position_mas, motion_mas_yr)


def _check_errors_of_objects(point: Point, objects: Catalogue) -> str | None:
    errors = np.hypot(*errors_of_objects(point, objects))
    if not errors.any():
        return None
    without = ~(errors > 0.0)
    position, motion = without[:2].all(), without[2:].all()
    if position or motion:
        return _one_without_error(point, exact_positions=bool(position))
    if without.any():
        row = 1 + int(np.argmax(without.any(axis=0)))
        return f"object {row} has an observable without any error, which cannot be weighed"
    if errors.min() < SMALLEST_ERROR or errors.max() > LARGEST_ERROR:
        extreme = np.min if errors.min() < SMALLEST_ERROR else np.max
        return _out_of_bounds(extreme(errors[:2]), extreme(errors[2:]))
    return None


def _one_without_error(point: Point, exact_positions: bool) -> str:
    exact, noisy = ("positions", "proper motions") if exact_positions else ("proper motions", "positions")
    problem = f"{exact} without any error beside {noisy} with errors cannot be weighed; give an error to both"
    side = next((side for side in SIDES if point[f"{side}_errors"] == "none"), None)
    if side is None:
        return problem
    # the unknowns separate but for A21, so any error of the others leaves sigma as it is
    alone, zero = ("spin", "pm") if exact_positions else ("orientation", "pos")
    return f"{problem} (for the {alone} alone: {side}_errors = 'normal' with {side}_sigma_{zero} = 0)"


def _out_of_bounds(position_mas: float, motion_mas_yr: float) -> str:
    return (
        f"errors of {position_mas:.3g} mas and {motion_mas_yr:.3g} mas/yr: must be from {SMALLEST_ERROR:g} to "
        f"{LARGEST_ERROR:g}"
    )


def _check_method(point: Point, objects: Catalogue | None) -> str | None:
    """Projected errors need a fixed design; what is near the limit is told by the catalogue when it is drawn."""
    if point["method"] == "catalogue":
        return None
    own = [objects.own_errors(s) for s in SIDES if objects is not None and point[f"{s}_errors"] == "catalogue"]
    if any(errors is not None and errors.correlation is not None for errors in own):
        return "method = 'projected' needs uncorrelated errors, and those of the file are correlated"
    position_mas = (
        errors_at_limit(point, "reference").pos_mas
        if objects is None
        else float(np.max(errors_of_objects(point, objects)[0][:2]))
    )
    if position_mas <= LARGEST_PROJECTED_ERROR:
        return None
    return (
        f"method = 'projected' takes the reference's positions as exact in the design matrix: an error of "
        f"{position_mas:.3g} mas is more than {LARGEST_PROJECTED_ERROR:g} mas"
    )
