"""What is said about a point before anything runs: why it cannot be computed, what makes its result less certain than
it looks, and which parameters change nothing at it.

These functions read no parameter that does not matter at a point: the platform asks again only where another one
differs.
"""

import math
from collections.abc import Sequence

import numpy as np

from linksweep.core import scenario
from linksweep.core.catalogues import CATALOGUES, RANDOM_SKY, SIDES, File
from linksweep.core.errors import ERROR_MODELS, ErrorModel
from linksweep.core.frames import Array
from linksweep.core.missions import CurveError, MissionUnavailableError
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

OF_MOTIONS = (
    *("zonal_pm", "motion_field", "motion_field_size", "omega_slope", "omega_slope_size"),
    *("magnitude_equation_pmra", "magnitude_equation_pmdec", "aberration", "glide"),
)
"""Parameters that act on proper motions alone."""

LARGE_SHARE = 0.1
"""Share of the weight of all objects above which an object is named."""


def check(point: Point) -> str | None:
    """Return why this point cannot be computed, or None."""
    if problem := _catalogue_problem(point) or _systematics_problem(point):
        return problem
    try:
        # before any error is computed: a curve may not reach these magnitudes
        for side, model in zip(SIDES, models := scenario.error_models(point), strict=True):
            if problem := model.problem(point, side, scenario.catalogue_kind(point)):
                return problem
        errors = scenario.expected_errors(point, models)
        return _errors_problem(point, errors) or _projected_problem(point, models, errors)
    except (MissionUnavailableError, CurveError) as error:
        return str(error)


def _catalogue_problem(point: Point) -> str | None:
    kind = scenario.catalogue_kind(point)
    uses = kind.uses(point)
    if point["file"] is not None and "file" not in uses:
        return "file: catalogue = 'file' needs a file, and other catalogues have none"
    if not uses >= RANDOM_SKY and (point["zone_of_avoidance"] > 0.0 or point["sky_contrast"] != 0.0):
        return "zone_of_avoidance and sky_contrast are for random positions (positions = 'isotropic')"
    if problem := kind.why_not(point):
        return problem
    if point["solve_glide"] and scenario.catalogue_size(point) < SMALLEST_GLIDE:
        return (
            f"n_obj = {scenario.catalogue_size(point)}: solving for a glide too needs at least {SMALLEST_GLIDE} objects"
        )
    if point["aberration"] and not kind.extragalactic:
        return f"aberration: the glide is that of extragalactic objects, not of {point['catalogue']}"
    return None


def _systematics_problem(point: Point) -> str | None:
    random = ("epsilon", "omega") if point["directions"] == "random" else ()
    for name in ("epsilon", "omega", "omega_slope"):
        if name not in random and point[f"{name}_size"] and not any(point[name]):
            return f"{name}_size = {point[f'{name}_size']:g}: {name} = {list(point[name])} gives it no direction"
    try:
        need_magnitudes = scenario.systematics(point).need_magnitudes
    except ValueError as error:
        return f"motion_field = {point['motion_field']!r}: {error}"
    if need_magnitudes and any(map(math.isnan, scenario.catalogue_kind(point).magnitudes(point))):
        return (
            "omega_slope and magnitude equations need a magnitude column (v_mag, phot_g_mean_mag, vt_mag) in the file"
        )
    return None


def _errors_problem(point: Point, errors: Array) -> str | None:
    """Return what is wrong with the errors of `expected_errors`, or None.

    If only one kind of observable has errors, the other is not measured; if neither has, the data are error-free.
    """
    each = np.hypot(errors[0], errors[1])
    position, motion = each[:, :2], each[:, 2:]
    if each.min() >= SMALLEST_ERROR and each.max() <= LARGEST_ERROR:
        return None  # nearly always
    # a kind without any error is not measured, so zeros count only beside other errors of their kind
    kinds = [kind for kind in (position, motion) if kind.any()]
    if not kinds:
        return None
    measured = np.concatenate(kinds, axis=1)
    if not (measured > 0.0).all():  # also where an error is NaN
        row = 1 + int(np.argmin((measured > 0.0).all(axis=1)))
        return f"object {row} has an observable without any error, which cannot be weighed"
    for extreme, is_inside in ((np.min, measured.min() >= SMALLEST_ERROR), (np.max, measured.max() <= LARGEST_ERROR)):
        if not is_inside:
            described = f"errors of {extreme(position):.3g} mas and {extreme(motion):.3g} mas/yr"
            return f"{described}: must be from {SMALLEST_ERROR:g} to {LARGEST_ERROR:g}"
    if point["solve_glide"] and not motion.any():
        return "solve_glide: the proper motions have no errors on either side, so they are not measured"
    return None


def _projected_problem(point: Point, models: Sequence[ErrorModel], errors: Array) -> str | None:
    """Return why the errors cannot be projected: that needs a fixed design.  Near the limit only the drawn catalogue
    decides.
    """
    if point["method"] == "catalogue":
        return None
    needs = "method = 'projected' needs"
    if scenario.zonal_errors(point) is not None:
        return f"{needs} errors that are independent from object to object, and zonal ones are not"
    objects = scenario.catalogue_kind(point).objects(point)
    for side, model in zip(SIDES, models, strict=True):
        if point[f"{side}_error_ratio"] != 1.0:
            return f"{needs} true errors that equal those in the weights: {side}_error_ratio = 1"
        if objects is not None and model.correlation(objects) is not None:
            return f"{needs} uncorrelated errors, and those of the {side} are correlated"
    if (largest := errors[0, :, :2].max()) <= LARGEST_PROJECTED_ERROR:
        return None
    return (
        f"method = 'projected' takes the reference's positions as exact in the design matrix: an error of "
        f"{largest:.3g} mas is more than {LARGEST_PROJECTED_ERROR:g} mas"
    )


def warn(point: Point) -> list[str]:
    """Return sentences about magnitudes outside of a curve's range, about what is not measured, about positions of
    different epochs, and about objects that decide nearly alone.
    """
    kind, models = scenario.catalogue_kind(point), scenario.error_models(point)
    errors = scenario.expected_errors(point, models)
    sentences = [model.warning(point, kind) for model in models]
    sentences += [_not_measured(errors), _epochs(point), _heaviest(point, errors)]
    return [sentence for sentence in sentences if sentence is not None]


def _not_measured(errors: Array) -> str | None:
    """Say which observables have no errors on either side while others have."""
    position, motion = errors[..., :2].any(), errors[..., 2:].any()
    if position == motion:
        return None
    missing, present, unknowns = (
        ("proper motions", "positions", "spin") if position else ("positions", "proper motions", "orientation")
    )
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
    if read.problems or np.ptp(epochs) <= SAME_EPOCH_YR:  # a problem: not all rows have one
        return None
    return (
        f"file: {read.label(EPOCH)} is between {epochs.min():.10g} and {epochs.max():.10g}, and the simulation takes "
        "all rows as of one epoch; `sweep tie` links rows of different epochs"
    )


def _heaviest(point: Point, errors: Array) -> str | None:
    """Name the object of a file with the largest share of the weight of positions or proper motions."""
    kind = scenario.catalogue_kind(point)
    if not isinstance(kind, File) or point["weighting"] == "equal":
        return None
    variance = np.square(errors).sum(axis=0).reshape(-1, 2, 2)  # (N, kinds, coordinates)
    measured = variance.any(axis=(0, 2))
    weight = np.divide(1.0, variance, out=np.zeros_like(variance), where=measured[:, None]).sum(axis=2)
    # a kind that is not measured has no weight at all, and 0/tiny is a share of 0
    share = weight / np.maximum(weight.sum(axis=0), np.finfo(float).tiny)
    heaviest = int(np.argmax(share.max(axis=1)))
    position, motion = share[heaviest]
    if max(position, motion) <= LARGE_SHARE:
        return None
    return (
        f"file: {kind.row_name(point, heaviest)} holds {100 * motion:.0f} % of the weight of all proper motions and "
        f"{100 * position:.0f} % of that of all positions, of {len(share)} objects; is its magnitude right?  v_min "
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
    if scenario.zonal_errors(point) is None:
        clauses["zonal_length"] = "it is for zonal errors, zonal_pos or zonal_pm above 0"
    errors = scenario.expected_errors(point, scenario.error_models(point))
    position, motion = errors[..., :2].any(), errors[..., 2:].any()
    if position != motion:
        what, names = ("proper motions", OF_MOTIONS) if position else ("positions", ("zonal_pos",))
        clauses |= dict.fromkeys(names, f"{what} have no errors on either side, so that they are not measured")
    if point["motion_field"] is None:
        clauses["motion_field_size"] = "it is for a motion_field"
    if not scenario.systematics(point).need_magnitudes:
        clauses["v_zero"] = "it is for an omega_slope or a magnitude equation"
    return clauses


def _unused_by_catalogue(point: Point) -> dict[str, str]:
    kind, clauses = scenario.catalogue_kind(point), {}
    uses = kind.uses(point)
    for parameter in sorted({name for other in CATALOGUES.values() for name in other.parameters} - uses):
        if parameter in RANDOM_SKY & kind.parameters:
            clauses[parameter] = "it is for random positions (positions = 'isotropic')"
        else:
            users = " or ".join(repr(name) for name, other in CATALOGUES.items() if parameter in other.parameters)
            clauses[parameter] = f"it is for catalogue = {users}, and here that is {point['catalogue']!r}"
    if "pm_distribution" in uses and not point["mean_pm"] > 0.0:
        clauses["pm_distribution"] = "it is for objects with proper motions, mean_pm above 0"
    return clauses


def _unused_by_errors(point: Point) -> dict[str, str]:
    users: dict[str, list[str]] = {}
    for side in SIDES:
        for name, model in ERROR_MODELS.items():
            for parameter in model.uses(side) if side in model.sides else ():
                users.setdefault(parameter, []).append(f"{side}_errors = {name!r}")
    used = frozenset().union(*(ERROR_MODELS[point[f"{side}_errors"]].uses(side) for side in SIDES))
    # a parameter of both sides, such as error_scale, is used where either side uses it
    clauses = {name: f"it is for {' or '.join(users[name])}" for name in sorted(users.keys() - used)}
    return clauses if used else clauses | {"weighting": "without errors all weights are equal"}
