"""What is said about a point before anything runs: why it cannot be computed, what makes its result less certain than
it looks, and which parameters change nothing at it.
"""

import math

import numpy as np

from linksweep.core.catalogue import SIDES, Catalogue
from linksweep.core.catalogues import CATALOGUES, RANDOM_SKY
from linksweep.core.errors import ERROR_KINDS, error_kind, error_model
from linksweep.core.missions import CurveError, MissionUnavailableError
from linksweep.core.scenario import (
    catalogue_kind,
    catalogue_size,
    errors_at_limit,
    errors_of_objects,
    listed_objects,
    systematics,
    zonal_errors,
)
from linksweep.sweep.contract import Point

SMALLEST_ERROR, LARGEST_ERROR = 1e-9, 1e7
"""Errors in mas and mas/yr between which the link is computed: outside, weights overflow or an error is not a small
angle.
"""

LARGEST_PROJECTED_ERROR = 50_000.0
"""Position error of the reference in mas beyond which `core.fixed_design.neglected` is too large for any isotropic
catalogue.
"""

SMALLEST_GLIDE = 3
"""Objects that are needed to determine nine unknowns: two give only eight observables."""

EPOCH, SAME_EPOCH_YR = "ref_epoch", 0.01
"""The column that gives the epoch of a row, and how much epochs may differ without a warning."""

LARGE_SHARE = 0.1
"""Share of the weight of all objects above which an object is named."""

NEEDED_BY = {"positions": ("proper motions", "orientation"), "proper motions": ("positions", "spin")}
"""For each kind of observable: the other kind, and the unknowns that need the first."""


# The three functions read no parameter that does not matter at a point: the platform asks again only where another one
# differs.
def check(point: Point) -> str | None:
    """Return why this point cannot be computed, or None."""
    if problem := _check_catalogue(point) or _check_systematics(point):
        return problem
    kind, objects = catalogue_kind(point), listed_objects(point)
    try:
        for side in SIDES:
            if problem := error_kind(point, side).problem(point, side, kind):
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
    if problem := kind.why_not(point):
        return problem
    if point["solve_glide"] and catalogue_size(point) < SMALLEST_GLIDE:
        return f"n_obj = {catalogue_size(point)}: solving for a glide too needs at least {SMALLEST_GLIDE} objects"
    if point["aberration"] and not kind.extragalactic:
        stars = point["catalogue"].replace("-", " ")
        return f"aberration: the glide is that of extragalactic objects, not of {stars}"
    return None


def _check_systematics(point: Point) -> str | None:
    try:
        need_magnitudes = systematics(point).need_magnitudes
    except ValueError as error:
        return f"motion_field = {point['motion_field']!r}: {error}"
    if need_magnitudes and any(map(math.isnan, catalogue_kind(point).magnitudes(point))):
        return (
            "omega_slope and magnitude equations need a magnitude column (v_mag, phot_g_mean_mag, vt_mag) in the file"
        )
    return None


def _check_errors(point: Point) -> str | None:
    """Return what is wrong with the errors, or None.  If only one kind of observable has errors, the other is not
    measured; if neither has, the data are error-free.
    """
    position_mas, motion_mas_yr = map(math.hypot, *(errors_at_limit(point, side) for side in SIDES))
    if all(not error or SMALLEST_ERROR <= error <= LARGEST_ERROR for error in (position_mas, motion_mas_yr)):
        return _glide_without_motions(point, bool(position_mas), bool(motion_mas_yr))
    return _out_of_bounds(position_mas, motion_mas_yr)


def _check_errors_of_objects(point: Point, objects: Catalogue) -> str | None:
    errors = np.hypot(*errors_of_objects(point, objects))
    kinds = [kind for kind in (errors[:2], errors[2:]) if kind.any()]
    if not kinds:
        return None
    measured = np.concatenate(kinds)
    if not (measured > 0.0).all():
        row = 1 + int(np.argmax(~(measured > 0.0).all(axis=0)))
        return f"object {row} has an observable without any error, which cannot be weighed"
    for extreme, beyond in ((np.min, measured < SMALLEST_ERROR), (np.max, measured > LARGEST_ERROR)):
        if beyond.any():
            return _out_of_bounds(extreme(errors[:2]), extreme(errors[2:]))
    return _glide_without_motions(point, bool(errors[:2].any()), bool(errors[2:].any()))


def _glide_without_motions(point: Point, positions: bool, motions: bool) -> str | None:
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
    needs = "method = 'projected' needs"
    if zonal_errors(point) is not None:
        return f"{needs} errors that are independent from object to object, and zonal ones are not"
    for side in SIDES:
        if point[f"{side}_error_ratio"] != 1.0:
            return f"{needs} true errors that equal those in the weights: {side}_error_ratio = 1"
    if objects is None:
        position_mas = errors_at_limit(point, "reference").pos_mas
    else:
        if any(error_model(point, side).correlation(objects) is not None for side in SIDES):
            return f"{needs} uncorrelated errors, and those of the file are correlated"
        position_mas = float(np.max(errors_of_objects(point, objects)[0, :2]))
    if position_mas <= LARGEST_PROJECTED_ERROR:
        return None
    return (
        f"method = 'projected' takes the reference's positions as exact in the design matrix: an error of "
        f"{position_mas:.3g} mas is more than {LARGEST_PROJECTED_ERROR:g} mas"
    )


def warn(point: Point) -> list[str]:
    """Return sentences about magnitudes outside of a curve's range, about what is not measured, about positions of
    different epochs, and about objects that decide nearly alone.
    """
    kind = catalogue_kind(point)
    sentences = [error_kind(point, side).warning(point, kind) for side in SIDES]
    sentences += [_not_measured(point), _epochs(point), _heaviest(point)]
    return [sentence for sentence in sentences if sentence is not None]


def _not_measured(point: Point) -> str | None:
    """Say which observables have no errors on either side while others have."""
    if (objects := listed_objects(point)) is None:
        errors = np.sum([errors_at_limit(point, side) for side in SIDES], axis=0)
    else:
        errors = errors_of_objects(point, objects).sum(axis=0).reshape(2, -1).max(axis=1)
    if errors.all() or not errors.any():
        return None
    missing, (present, unknowns) = list(NEEDED_BY.items())[int(np.argmin(errors))]
    return (
        f"{missing} have no errors on either side while {present} have: they are taken as not measured, and the "
        f"{unknowns} is not determined (NaN)"
    )


def _epochs(point: Point) -> str | None:
    """Say that the rows of a file are of different epochs, which the simulation ignores."""
    table = point["file"]
    if table is None or not (read := table.columns({}, {}, ())).has(EPOCH):
        return None
    epochs = read.epochs()
    if read.problems:  # not all rows have one
        return None
    if np.ptp(epochs) <= SAME_EPOCH_YR:
        return None
    return (
        f"file: {read.label(EPOCH)} is between {epochs.min():.10g} and {epochs.max():.10g}, and the simulation takes "
        "all rows as of one epoch; `sweep tie` links rows of different epochs"
    )


def _heaviest(point: Point) -> str | None:
    """Name the listed object with the largest share of the weight of positions or proper motions."""
    listed = catalogue_kind(point).listed(point)
    if listed is None or point["weighting"] == "equal":
        return None
    objects, name = listed
    variance = np.square(errors_of_objects(point, objects)).sum(axis=0).reshape(2, 2, -1)
    measured = variance.any(axis=(1, 2))
    if not measured.any():
        return None
    variance[~measured] = 1.0
    weight = (1.0 / variance).sum(axis=1) * measured[:, None]  # of positions and of proper motions
    share = weight / np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    heaviest = int(np.argmax(share.max(axis=0)))
    position, motion = share[:, heaviest]
    if max(position, motion) <= LARGE_SHARE:
        return None
    return (
        f"file: {name(heaviest)} holds {100 * motion:.0f} % of the weight of all proper motions and "
        f"{100 * position:.0f} % of that of all positions, of {len(objects)} objects; is its magnitude right?  v_min "
        "leaves out the bright ones"
    )


def unused(point: Point) -> dict[str, str]:
    """Return the names of the parameters that change nothing at a point, each with a clause that says why: the platform
    refuses a study that sets one in vain.
    """
    clauses = _unused_by_catalogue(point) | _unused_by_errors(point)
    for vector in ("epsilon", "omega"):
        if point["directions"] == "random" and point[f"{vector}_size"] is not None:
            clauses[vector] = f"its direction is random (directions) and its length is {vector}_size"
    if not point["aberration"]:
        clauses["glide"] = "it is for aberration = true"
    if zonal_errors(point) is None:
        clauses["zonal_length"] = "it is for zonal errors, zonal_pos or zonal_pm above 0"
    if point["motion_field"] is None:
        clauses["motion_field_size"] = "it is for a motion_field"
    slope, size = any(point["omega_slope"]), point["omega_slope_size"]
    equation = point["magnitude_equation_pmra"] or point["magnitude_equation_pmdec"]
    if not (equation or (slope if size is None else size)):
        clauses["v_zero"] = "it is for an omega_slope or a magnitude equation"
    return clauses


def _unused_by_catalogue(point: Point) -> dict[str, str]:
    kind, name = catalogue_kind(point), point["catalogue"]
    uses, clauses = kind.uses(point), {}
    for parameter in sorted(frozenset().union(*(other.parameters for other in CATALOGUES.values())) - uses):
        users = [other for other, value in CATALOGUES.items() if parameter in value.parameters]
        if parameter in RANDOM_SKY and name in users:
            clauses[parameter] = "it is for random positions (positions = 'isotropic')"
        else:
            clauses[parameter] = f"it is for catalogue = {_either(users)}, and here that is {name!r}"
    if "pm_distribution" in uses and not point["mean_pm"] > 0.0:
        clauses["pm_distribution"] = "it is for objects with proper motions, mean_pm above 0"
    return clauses


def _unused_by_errors(point: Point) -> dict[str, str]:
    users: dict[str, dict[str, list[str]]] = {}
    for side in SIDES:
        for name, kind in ERROR_KINDS.items():
            for parameter in kind.uses(side) if side in kind.sides else ():
                users.setdefault(parameter, {}).setdefault(side, []).append(name)
    used = frozenset().union(*(error_kind(point, side).uses(side) for side in SIDES))
    clauses = {
        parameter: "it is for " + " or ".join(f"{side}_errors = {_either(names)}" for side, names in sides.items())
        for parameter, sides in sorted(users.items())
        if parameter not in used
    }
    return clauses if used else clauses | {"weighting": "without errors all weights are equal"}


def _either(names: list[str]) -> str:
    return " or ".join(map(repr, names))
