"""The link as an experiment: the parameters of a study, and the results with their units."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from core.catalogue import Catalogue, quasar_count, quasars, synthetic
from core.constants import DEGREE, MAS
from core.errors import ErrorModel, MagnitudeErrors, NoErrors, NormalErrors
from core.link import UNKNOWNS
from core.missions import MISSIONS
from core.simulate import Scenario, simulate
from sweep.contract import Experiment, Output, Parameter, Point

Array = NDArray[np.float64]

SMALLEST_ERROR, LARGEST_ERROR = 1e-9, 1e7
"""Errors in mas and mas/yr for which the link is computed: beyond, weights overflow or an error is no small angle."""

PARAMETERS = (
    Parameter("catalogue", "str", "synthetic", "reference catalogue (step A)", choices=("synthetic", "quasars")),
    Parameter(
        "n_obj",
        "int",
        None,
        "number of objects; default for quasars: all brighter than v_max",
        minimum=2,
        maximum=10_000_000,
    ),
    Parameter("v_max", "float", 15.0, "limiting magnitude V", unit="mag", minimum=-5.0, maximum=30.0),
    Parameter(
        "v_min", "float", 5.0, "brightest magnitude V of a synthetic catalogue", unit="mag", minimum=-5.0, maximum=30.0
    ),
    Parameter(
        "mean_pm", "float", 0.0, "mean modulus of the proper motions, synthetic catalogue", unit="mas / yr", minimum=0.0
    ),
    Parameter(
        "zone_of_avoidance",
        "float",
        0.0,
        "no synthetic objects at Galactic latitudes |b| below this",
        unit="deg",
        minimum=0.0,
        maximum=89.0,
    ),
    Parameter(
        "satellite_errors",
        "str",
        "magnitude",
        "error model of the satellite (step D)",
        choices=("none", "normal", "magnitude"),
    ),
    Parameter("reference_errors", "str", "none", "error model of the reference (step C)", choices=("none", "normal")),
    Parameter(
        "model", "str", "amex", "mission whose accuracy curve gives the 'magnitude' errors", choices=tuple(MISSIONS)
    ),
    Parameter(
        "mission_length",
        "float",
        None,
        "mission length; default: the model's own (amex 2, gaia 5)",
        unit="yr",
        above=0.0,
    ),
    Parameter(
        "satellite_sigma_pos",
        "float",
        1.0,
        "satellite position error per coordinate, 'normal' errors",
        unit="mas",
        minimum=0.0,
    ),
    Parameter(
        "satellite_sigma_pm",
        "float",
        1.0,
        "satellite proper-motion error per coordinate, 'normal' errors",
        unit="mas / yr",
        minimum=0.0,
    ),
    Parameter(
        "reference_sigma_pos",
        "float",
        1.0,
        "reference position error per coordinate, 'normal' errors",
        unit="mas",
        minimum=0.0,
    ),
    Parameter(
        "reference_sigma_pm",
        "float",
        1.0,
        "reference proper-motion error per coordinate, 'normal' errors",
        unit="mas / yr",
        minimum=0.0,
    ),
    Parameter("error_scale", "float", 1.0, "factor on all errors", minimum=0.0, maximum=1e6),
    Parameter(
        "satellite_error_scale", "float", 1.0, "further factor on the satellite's errors", minimum=0.0, maximum=1e6
    ),
    Parameter(
        "reference_error_scale", "float", 1.0, "further factor on the reference's errors", minimum=0.0, maximum=1e6
    ),
    Parameter(
        "epsilon",
        "vector",
        (1.0, 1.0, 1.0),
        "true orientation, reference - satellite",
        unit="mas",
        minimum=-1e8,
        maximum=1e8,
    ),
    Parameter(
        "omega",
        "vector",
        (1.0, 1.0, 1.0),
        "true spin, reference - satellite",
        unit="mas / yr",
        minimum=-1e8,
        maximum=1e8,
    ),
    Parameter("corrections", "bool", True, "keep the A21 terms in the design matrix"),
    Parameter(
        "weighting",
        "str",
        "inverse-variance",
        "weights of the solution: 1/(sigma_ref^2 + sigma_sat^2), or all equal",
        choices=("inverse-variance", "equal"),
    ),
    Parameter(
        "arithmetic",
        "str",
        "exact",
        "differences of catalogues: exact, or by subtracting stored angles as in the paper",
        choices=("exact", "stored"),
    ),
)

_UNITS = ("mas",) * 3 + ("mas / yr",) * 3
# Without slashes: astropy warns of several in one string.
_EACH = "mas, mas, mas, mas yr-1, mas yr-1, mas yr-1"
_TOP, _BOTTOM = (
    "(mas2, mas2, mas2, mas2 yr-1, mas2 yr-1, mas2 yr-1)",
    "(mas2 yr-1, mas2 yr-1, mas2 yr-1, mas2 yr-2, mas2 yr-2, mas2 yr-2)",
)
_PRODUCTS = ", ".join([_TOP] * 3 + [_BOTTOM] * 3)

OUTPUTS = (
    Output("n_obj", "", "number of objects in the catalogue (mean over catalogues)", headline=True),
    Output("sigma_spin", "mas / yr", "RMS error of the spin, over its three components", headline=True),
    Output(
        "sigma_spin_mc_error",
        "mas / yr",
        "Monte-Carlo error of sigma_spin, sigma/sqrt(2 n) with n components x realisations",
    ),
    Output("sigma_spin_predicted", "mas / yr", "closed-form prediction of sigma_spin for the same catalogues"),
    Output("sigma_orientation", "mas", "RMS error of the orientation, over its three components"),
    Output("sigma_orientation_mc_error", "mas", "Monte-Carlo error of sigma_orientation"),
    Output("sigma_orientation_predicted", "mas", "closed-form prediction of sigma_orientation for the same catalogues"),
    Output("sigma", _EACH, "RMS of estimate - truth", dims=("component",)),
    Output("sigma_mc_error", _EACH, "Monte-Carlo error of sigma, sigma/sqrt(2 n)", dims=("component",)),
    Output("sigma_predicted", _EACH, "closed-form prediction of sigma for the same catalogues", dims=("component",)),
    Output(
        "sigma_catalogue_error",
        _EACH,
        "error of sigma_predicted as the mean over all possible catalogues (NaN for one catalogue)",
        dims=("component",),
    ),
    Output("bias", _EACH, "mean of estimate - truth", dims=("component",)),
    Output(
        "covariance", _PRODUCTS, "covariance of the estimates about their mean", dims=("component", "component_other")
    ),
    Output("chi2", "", "mean chi2 of the solution; dof is its expectation for inverse-variance weights"),
    Output("dof", "", "degrees of freedom of chi2 (mean over catalogues)"),
)


def scenario(point: Point) -> Scenario:
    """Return the physics of a point (its parameters by name, in the units of `PARAMETERS`)."""
    return Scenario(
        draw_catalogue=partial(_draw_catalogue, point),
        reference_errors=_error_model(point, "reference"),
        satellite_errors=_error_model(point, "satellite"),
        epsilon=_radians(point["epsilon"]),
        omega=_radians(point["omega"]),
        corrections=point["corrections"],
        weighting=point["weighting"],
        arithmetic=point["arithmetic"],
    )


def evaluate(
    points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
) -> dict[str, Array]:
    """Return the sums of `SUMS` for one catalogue and ``n_sim`` realisations of its errors, one row a point."""
    blocks = [simulate(scenario(point), n_sim, rng, catalogue_rng) for point in points]
    return {name: np.array([getattr(block, name) for block in blocks]) for name in SUMS}


def summarise(sums: Mapping[str, Array], n: Array, n_cat: Array) -> dict[str, Array]:
    """Return every output of `OUTPUTS` from the sums over n realisations of n_cat catalogues.

    Source: Metz & Geffert 2004, Sect. 4.1 (sigma is the RMS of estimate - truth); error of an RMS of normal errors
    sigma/sqrt(2 n).
    """
    each = n[:, None]
    bias = sums["error"] / each
    second_moment = sums["error_products"] / each[..., None]
    variance = np.einsum("...ii->...i", second_moment)
    predicted = sums["predicted_variance"] / each
    scatter = np.sqrt(np.maximum(sums["predicted_variance_squared"] / each - predicted**2, 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        error_of_mean = np.where(n_cat > 1, scatter.T / np.sqrt(n_cat - 1.0), np.nan).T
        catalogue_error = np.where(predicted > 0.0, error_of_mean / (2.0 * np.sqrt(predicted)), 0.0)
    n_obj = sums["n_obj"] / n
    results = {
        "n_obj": n_obj,
        "sigma": np.sqrt(variance),
        "sigma_mc_error": np.sqrt(variance / (2.0 * each)),
        "sigma_predicted": np.sqrt(predicted),
        "sigma_catalogue_error": catalogue_error,
        "bias": bias,
        "covariance": second_moment - bias[..., :, None] * bias[..., None, :],
        "chi2": sums["chi2"] / n,
        "dof": 4.0 * n_obj - len(UNKNOWNS),
    }
    for name, part in (("sigma_orientation", slice(0, 3)), ("sigma_spin", slice(3, 6))):
        mean_variance = variance[:, part].mean(axis=1)
        results[name] = np.sqrt(mean_variance)
        results[f"{name}_mc_error"] = np.sqrt(mean_variance / (2.0 * 3.0 * n))
        results[f"{name}_predicted"] = np.sqrt(predicted[:, part].mean(axis=1))
    return results


def check(point: Point) -> str | None:
    """Return why this point cannot be computed, or None."""
    n_obj, v_max = point["n_obj"], point["v_max"]
    if point["catalogue"] == "quasars":
        try:
            available = quasar_count(v_max)
        except ValueError as error:
            return str(error)
        if n_obj is not None and n_obj > available:
            return f"n_obj = {n_obj}: only {available} quasars are brighter than v_max = {v_max:g} mag"
    elif n_obj is None:
        return "n_obj: a synthetic catalogue needs a number of objects"
    elif v_max <= point["v_min"]:
        return f"v_max = {v_max:g} mag: must be fainter than the brightest object, v_min = {point['v_min']:g} mag"
    mission = MISSIONS[point["model"]]
    if point["satellite_errors"] == "magnitude" and v_max > mission.faint_limit_mag:
        return f"v_max = {v_max:g} mag: the curve of {point['model']!r} ends at {mission.faint_limit_mag:g} mag"
    return _check_errors(point)


def _check_errors(point: Point) -> str | None:
    """Inverse-variance weights need both a position and a proper-motion error, or neither (error-free data)."""
    position, _, motion, _ = np.hypot(*_errors_at_limit(point)) / MAS
    if (position > 0.0) != (motion > 0.0):
        exact, noisy = ("proper motions", "positions") if position else ("positions", "proper motions")
        return f"{exact} without any error beside {noisy} with errors cannot be weighed; give an error to both"
    if position > 0.0 and not (min(position, motion) >= SMALLEST_ERROR and max(position, motion) <= LARGEST_ERROR):
        return (
            f"errors of {position:.3g} mas and {motion:.3g} mas/yr at V = {point['v_max']:g}: must be from "
            f"{SMALLEST_ERROR:g} to {LARGEST_ERROR:g}"
        )
    return None


def cost(point: Point) -> float:
    """Return how many normal deviates one realisation takes."""
    n_obj = point["n_obj"] if point["n_obj"] is not None else quasar_count(point["v_max"])
    reference, satellite = (np.any(sigma) for sigma in _errors_at_limit(point))
    return float(n_obj * (8 if reference else 4 if satellite else 0))


def _errors_at_limit(point: Point) -> tuple[Array, Array]:
    """Return the standard errors of the reference and the satellite at the limiting magnitude, each of shape (4,)."""
    zero = np.zeros(1)
    probe = Catalogue(zero, zero, zero, zero, zero + point["v_max"])
    with np.errstate(over="ignore"):  # a curve far beyond its range is infinite, and refused for that
        reference, satellite = (
            _error_model(point, side).standard_errors(probe)[:, 0] for side in ("reference", "satellite")
        )
    return reference, satellite


def _draw_catalogue(point: Point, rng: np.random.Generator) -> Catalogue:
    n_obj = point["n_obj"]
    if point["catalogue"] == "synthetic":
        return synthetic(
            rng, n_obj, point["v_min"], point["v_max"], point["mean_pm"] * MAS, point["zone_of_avoidance"] * DEGREE
        )
    catalogue = quasars(rng, point["v_max"])
    if n_obj is None:
        return catalogue
    return catalogue.take(np.sort(rng.choice(len(catalogue), n_obj, replace=False)))


def _error_model(point: Point, side: str) -> ErrorModel:
    kind = point[f"{side}_errors"]
    scale = point["error_scale"] * point[f"{side}_error_scale"]
    if kind == "normal":
        return NormalErrors(point[f"{side}_sigma_pos"], point[f"{side}_sigma_pm"], scale)
    if kind == "magnitude":
        return MagnitudeErrors(MISSIONS[point["model"]], point["mission_length"], scale)
    return NoErrors()


def _radians(vector_mas: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, z = vector_mas
    return (x * MAS, y * MAS, z * MAS)


SUMS: Mapping[str, tuple[int, ...]] = {
    "error": (6,),
    "error_products": (6, 6),
    "chi2": (),
    "predicted_variance": (6,),
    "predicted_variance_squared": (6,),
    "n_obj": (),
}

link = Experiment(
    name="link",
    version=1,
    parameters=PARAMETERS,
    sums=SUMS,
    outputs=OUTPUTS,
    coordinates={"component": UNKNOWNS, "component_other": UNKNOWNS},
    component_units={"component": _UNITS, "component_other": _UNITS},
    evaluate=evaluate,
    summarise=summarise,
    check=check,
    cost=cost,
)
