"""Which parameters change nothing at a point, and why: the platform refuses a study that sets one in vain."""

from linksweep.core.catalogues import CATALOGUES
from linksweep.core.catalogues.kind import RANDOM_SKY
from linksweep.core.errors import ERROR_KINDS, SIDES
from linksweep.core.scenario import catalogue_kind, error_kind, zonal_errors
from linksweep.sweep.contract import Point

CATALOGUE_PARAMETERS = (
    *("v_min", "v_max", "counts", "mean_pm", "pm_distribution", "positions", "zone_of_avoidance", "sky_contrast"),
    *("file", "columns", "units", "pmra_cos_dec"),
)
"""Parameters of catalogues (step A) that not every kind uses."""

ERROR_PARAMETERS = (
    *("model", "mission_length", "error_scale", "satellite_error_scale", "reference_error_scale"),
    *("satellite_sigma_pos", "satellite_sigma_pm", "reference_sigma_pos", "reference_sigma_pm"),
    *("satellite_floor_pos", "satellite_floor_pm", "reference_floor_pos", "reference_floor_pm"),
    *("satellite_error_ratio", "reference_error_ratio"),
)
"""Parameters of error models (steps C and D)."""


def unused(point: Point) -> dict[str, str]:
    """Return the names of the parameters that change nothing at a point, each with a clause that says why."""
    return _of_catalogue(point) | _of_errors(point) | _of_truth(point) | _of_systematics(point)


def _of_catalogue(point: Point) -> dict[str, str]:
    kind, name = catalogue_kind(point), point["catalogue"]
    uses = kind.uses(point)
    found: dict[str, str] = {}
    for parameter in CATALOGUE_PARAMETERS:
        if parameter in uses:
            continue
        users = [other for other, value in CATALOGUES.items() if parameter in value.parameters]
        if parameter in RANDOM_SKY and name in users:
            found[parameter] = "it is for random positions (positions = 'isotropic')"
        else:
            found[parameter] = f"it is for catalogue = {_either(users)}, and here that is {name!r}"
    if "pm_distribution" in uses and not point["mean_pm"] > 0.0:
        found["pm_distribution"] = "it is for objects with proper motions, mean_pm above 0"
    return found


def _of_errors(point: Point) -> dict[str, str]:
    kinds = {side: error_kind(point, side) for side in SIDES}
    used = frozenset().union(*(kind.uses(side) for side, kind in kinds.items()))
    found: dict[str, str] = {}
    for parameter in ERROR_PARAMETERS:
        if parameter in used:
            continue
        choices = {
            side: [name for name, kind in ERROR_KINDS.items() if side in kind.sides and parameter in kind.uses(side)]
            for side in SIDES
        }
        words = [f"{side}_errors = {_either(names)}" for side, names in choices.items() if names]
        found[parameter] = f"it is for {' or '.join(words)}"
    if not used:
        found["weighting"] = "without errors all weights are equal"
    return found


def _of_truth(point: Point) -> dict[str, str]:
    found: dict[str, str] = {}
    for vector in ("epsilon", "omega"):
        if point["directions"] == "random" and point[f"{vector}_size"] is not None:
            found[vector] = f"its direction is random (directions) and its length is {vector}_size"
    if not point["aberration"]:
        found["glide"] = "it is for aberration = true"
    return found


def _of_systematics(point: Point) -> dict[str, str]:
    found: dict[str, str] = {}
    if zonal_errors(point) is None:
        found["zonal_length"] = "it is for zonal errors, zonal_pos or zonal_pm above 0"
    if point["motion_field"] is None:
        found["motion_field_size"] = "it is for a motion_field"
    slope, size = any(point["omega_slope"]), point["omega_slope_size"]
    equation = point["magnitude_equation_pmra"] or point["magnitude_equation_pmdec"]
    if not (equation or (slope if size is None else size)):
        found["v_zero"] = "it is for an omega_slope or a magnitude equation"
    return found


def _either(names: list[str]) -> str:
    return " or ".join(map(repr, names))
