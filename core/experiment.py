"""The link as an experiment: from a point's parameters to a scenario, from sums to results."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from core.catalogue import GALAXY_FAINT_LIMIT_MAG, Catalogue, Sky, galaxies, radio_stars, resample, synthetic
from core.constants import DEGREE, GALACTIC_AXES, MAS, MICROARCSEC
from core.errors import CatalogueErrors, ErrorModel, MagnitudeErrors, NoErrors, NormalErrors
from core.link import GLIDE_UNKNOWNS, UNKNOWNS
from core.missions import MISSIONS, MissionUnavailableError
from core.parameters import OUTPUTS, PARAMETERS, SAMPLE_OUTPUTS, UNITS
from core.quasars import V_MAX, quasar_count, quasars
from core.simulate import BlockSums, Scenario, TrueVector, Vector, sample, simulate
from core.table_catalogue import catalogue_from_table
from sweep.contract import Experiment, Point, SweepError

Array = NDArray[np.float64]

SMALLEST_ERROR, LARGEST_ERROR = 1e-9, 1e7
"""Errors in mas and mas/yr for which the link is computed: beyond, weights overflow or an error is no small angle."""

GALACTIC_GLIDE_UAS_YR = 4.0
"""Towards the Galactic centre.  Source: Kovalevsky 2003, as Metz & Geffert 2004, Sect. 5.1; measured since: 5.05
(Gaia EDR3).
"""

SMALLEST_GLIDE = 3
"""Objects that determine nine unknowns: two give twelve observables, but of rank eight."""

N_GALAXIES = 116
"""Certain galaxies in Tycho-2.  Source: Metz & Geffert 2004, Sect. 3.2."""

FAINTEST_MAG = {"synthetic": 15.0, "quasars": float(V_MAX[-1]), "galaxies": GALAXY_FAINT_LIMIT_MAG}
"""Limiting magnitude where a study gives none; a file or the radio stars have none."""

SUMS: Mapping[str, tuple[int, ...]] = {
    "error": (6,),
    "error_products": (6, 6),
    "chi2": (),
    "predicted_variance": (6,),
    "predicted_variance_squared": (8,),
    "glide_error": (3,),
    "glide_squares": (3,),
    "n_obj": (),
    "batch_mean_squares": (6,),
    "batches": (),
}


def scenario(point: Point) -> Scenario:
    """Return the physics of a point (its parameters by name, in the units of `PARAMETERS`)."""
    random = point["directions"] == "random"
    return Scenario(
        draw_catalogue=partial(_draw_catalogue, point),
        reference_errors=_error_model(point, "reference"),
        satellite_errors=_error_model(point, "satellite"),
        epsilon=TrueVector(_radians(point["epsilon"], point["epsilon_size"]), random),
        omega=TrueVector(_radians(point["omega"], point["omega_size"]), random),
        aberration=_glide(point) if point["aberration"] else (0.0, 0.0, 0.0),
        solve_glide=point["solve_glide"],
        corrections=point["corrections"],
        weighting=point["weighting"],
        arithmetic=point["arithmetic"],
    )


def evaluate(
    points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
) -> dict[str, Array]:
    """Return the sums of `SUMS` for one catalogue and ``n_sim`` realisations of its errors, one row a point."""
    rows = [_sums(simulate(scenario(point), n_sim, rng, catalogue_rng), n_sim) for point in points]
    return {name: np.array([row[name] for row in rows]) for name in SUMS}


def samples(
    points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
) -> dict[str, Array]:
    """Return the estimates themselves, shape (points, n_sim, 6), of the realisations that `evaluate` adds up."""
    return {"estimate": np.array([sample(scenario(point), n_sim, rng, catalogue_rng)[:, :6] for point in points])}


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
    means = np.stack([predicted[:, part].mean(axis=1) for part in (slice(0, 3), slice(3, 6))], axis=1)
    catalogue_error = _catalogue_error(
        np.concatenate([predicted, means], axis=1), sums["predicted_variance_squared"] / each, n_cat
    )
    n_obj = sums["n_obj"] / n
    results = {
        "n_obj": n_obj,
        "sigma": np.sqrt(variance),
        "sigma_mc_error": np.sqrt(variance / (2.0 * each)),
        "sigma_predicted": np.sqrt(predicted),
        "sigma_catalogue_error": catalogue_error[:, :6],
        "bias": bias,
        "bias_mc_error": _bias_error(sums, bias, variance, n),
        "covariance": second_moment - bias[..., :, None] * bias[..., None, :],
        "chi2": sums["chi2"] / n,
        "dof": 4.0 * n_obj - np.where(np.isnan(sums["glide_error"][:, 0]), 6.0, 9.0),
        "glide_sigma": np.sqrt(sums["glide_squares"] / each),
        "glide_bias": sums["glide_error"] / each,
    }
    for which, name in enumerate(("sigma_orientation", "sigma_spin")):
        mean_variance = variance[:, 3 * which : 3 * which + 3].mean(axis=1)
        results[name] = np.sqrt(mean_variance)
        results[f"{name}_mc_error"] = np.sqrt(mean_variance / (2.0 * 3.0 * n))
        results[f"{name}_predicted"] = np.sqrt(means[:, which])
        results[f"{name}_catalogue_error"] = catalogue_error[:, 6 + which]
    return results


def check(point: Point) -> str | None:
    """Return why this point cannot be computed, or None."""
    problem = _check_catalogue(point)
    if problem is None and point["solve_glide"] and _size(point) < SMALLEST_GLIDE:
        problem = f"n_obj = {_size(point)}: solving for a glide too needs at least {SMALLEST_GLIDE} objects"
    if problem is None and point["aberration"] and point["catalogue"] == "radio-stars":
        problem = "aberration: the glide is that of extragalactic objects, not of radio stars"
    try:
        return problem or _check_error_models(point) or _check_errors(point)
    except MissionUnavailableError as error:
        return str(error)


def cost(point: Point) -> float:
    """Return how many normal deviates one realisation takes."""
    reference, satellite = (np.any(sigma) for sigma in _errors_at_limit(point))
    sides = 2 * bool(reference and satellite) or bool(reference or satellite)
    return float(4 * sides * _size(point))


def _sums(block: BlockSums, n_sim: int) -> dict[str, Array]:
    """Return the sums of one block in the shapes of `SUMS`, NaN for a glide that was not solved for."""
    glide = block.error[6:] if len(block.error) > 6 else np.full(3, np.nan)
    squares = np.diag(block.error_products)[6:] if len(block.error) > 6 else np.full(3, np.nan)
    squared = block.predicted_variance_squared
    return {
        "error": block.error[:6],
        "error_products": block.error_products[:6, :6],
        "chi2": np.array(block.chi2),
        "predicted_variance": block.predicted_variance[:6],
        "predicted_variance_squared": np.concatenate([squared[:6], squared[-2:]]),
        "glide_error": glide,
        "glide_squares": squares,
        "n_obj": np.array(block.n_obj),
        "batch_mean_squares": np.square(block.error[:6]) / n_sim,
        "batches": np.array(1.0),
    }


def _bias_error(sums: Mapping[str, Array], bias: Array, variance: Array, n: Array) -> Array:
    """Return the error of a bias from the scatter of batch means, which includes that of catalogues with biases of
    their own; from the scatter of realisations where there is one batch only.
    """
    batches, each = sums["batches"][:, None], n[:, None]
    between = np.maximum(sums["batch_mean_squares"] / each - bias**2, 0.0) / np.maximum(batches - 1.0, 1.0)
    within = np.maximum(variance - bias**2, 0.0) / each
    return np.sqrt(np.where(batches > 1.0, between, within))


def _catalogue_error(predicted: Array, squared: Array, n_cat: Array) -> Array:
    """Return how uncertain sqrt(mean variance) is because only n_cat catalogues were drawn; NaN for one catalogue."""
    scatter = np.sqrt(np.maximum(squared - predicted**2, 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        error_of_mean = np.where(n_cat > 1, scatter.T / np.sqrt(n_cat - 1.0), np.nan).T
        return np.where(predicted > 0.0, error_of_mean / (2.0 * np.sqrt(predicted)), 0.0)


def _sky(point: Point) -> Sky:
    return Sky(point["zone_of_avoidance"] * DEGREE, point["sky_contrast"])


def _table(point: Point) -> Catalogue:
    """Return the objects of the file that are brighter than the limit."""
    whole = catalogue_from_table(point["file"], dict(point["columns"]), point["pmra_cos_dec"])
    return whole if point["v_max"] is None else whole.take(np.flatnonzero(whole.v_mag <= point["v_max"]))


def _has_magnitudes(point: Point) -> bool:
    return not np.any(np.isnan(_table({**point, "v_max": None}).v_mag))


def _size(point: Point) -> int:
    """Return the number of objects of a point's catalogue."""
    if point["n_obj"] is not None:
        return int(point["n_obj"])
    return {
        "quasars": lambda: quasar_count(_limit(point), point["counts"] == "completed"),
        "galaxies": lambda: N_GALAXIES,
        "radio-stars": lambda: len(radio_stars()),
        "file": lambda: len(_table(point)),
    }[point["catalogue"]]()


def _limit(point: Point) -> float:
    return float(FAINTEST_MAG[point["catalogue"]] if point["v_max"] is None else point["v_max"])


def _draw_catalogue(point: Point, rng: np.random.Generator) -> Catalogue:
    kind, n_obj, sky = point["catalogue"], _size(point), _sky(point)
    if kind == "synthetic":
        pm = (point["mean_pm"] * MAS, point["pm_distribution"])
        return synthetic(rng, n_obj, point["v_min"], _limit(point), sky, *pm)
    if kind == "galaxies":
        return galaxies(rng, n_obj, _limit(point), sky)
    if kind == "radio-stars":
        return resample(rng, radio_stars(), n_obj, None if point["positions"] == "own" else sky)
    drawn = kind == "quasars"
    whole = quasars(rng, _limit(point), sky, point["counts"] == "completed") if drawn else _table(point)
    if n_obj < len(whole):
        whole = whole.take(np.sort(rng.choice(len(whole), n_obj, replace=False)))
    return whole.moved_to(*sky.positions(rng, n_obj)) if point["positions"] == "isotropic" and kind == "file" else whole


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
    if _limit(point) <= point["v_min"]:
        brightest = f"v_min = {point['v_min']:g} mag"
        return f"v_max = {_limit(point):g} mag: must be fainter than the brightest object, {brightest}"
    return None


def _check_galaxies(point: Point) -> str | None:
    if 11.0 <= _limit(point) <= GALAXY_FAINT_LIMIT_MAG:
        return None
    return f"v_max = {_limit(point):g} mag: the galaxies have magnitudes from 11 to {GALAXY_FAINT_LIMIT_MAG:g} mag"


def _check_radio_stars(point: Point) -> str | None:
    return (
        None if point["v_max"] is None else "v_max: the radio stars have no limiting magnitude, all 11 are drawn from"
    )


def _check_available(point: Point) -> str | None:
    """The quasars or the objects of a file must be enough."""
    try:
        if point["catalogue"] == "file" and point["v_max"] is not None and not _has_magnitudes(point):
            return "v_max needs a magnitude column (v_mag, phot_g_mean_mag, vt_mag) in the file"
        available = _size({**point, "n_obj": None})
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


def _check_error_models(point: Point) -> str | None:
    mission = MISSIONS[point["model"]]
    by_magnitude = point["satellite_errors"] == "magnitude"
    if point["catalogue"] == "file":
        table = _table(point)
        if by_magnitude and not _has_magnitudes(point):
            return "satellite_errors = 'magnitude' needs a magnitude column (v_mag, phot_g_mean_mag) in the file"
        faintest = float(np.max(table.v_mag))
    else:
        faintest = float(radio_stars().v_mag.max()) if point["catalogue"] == "radio-stars" else _limit(point)
    if by_magnitude and faintest > mission.faint_limit_mag:
        return f"v_max = {faintest:g} mag: the curve of {point['model']!r} ends at {mission.faint_limit_mag:g} mag"
    own = point["catalogue"] == "radio-stars" or (point["catalogue"] == "file" and _table(point).sigma is not None)
    for side in ("reference", "satellite"):
        if point[f"{side}_errors"] == "catalogue" and not own:
            return f"{side}_errors = 'catalogue': the {point['catalogue']} catalogue has no errors of its own"
    return None


def _check_errors(point: Point) -> str | None:
    """Inverse-variance weights need both a position and a proper-motion error, or neither (error-free data)."""
    errors = np.hypot(*_errors_at_limit(point)) / MAS
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


def _errors_at_limit(point: Point) -> tuple[Array, Array]:
    """Return the standard errors of the reference and the satellite for a point's objects, or one at its limit; (4,
    N).
    """
    if point["catalogue"] == "radio-stars":
        probe = radio_stars()
    elif point["catalogue"] == "file":
        probe = _table(point)
    else:
        zero = np.zeros(1)
        probe = Catalogue(zero, zero, zero, zero, zero + _limit(point))
    with np.errstate(over="ignore"):  # a curve far beyond its range is infinite, and refused for that
        reference, satellite = (_error_model(point, side).standard_errors(probe) for side in ("reference", "satellite"))
    return reference, satellite


def _error_model(point: Point, side: str) -> ErrorModel:
    kind = point[f"{side}_errors"]
    scale = point["error_scale"] * point[f"{side}_error_scale"]
    if kind == "normal":
        return NormalErrors(point[f"{side}_sigma_pos"], point[f"{side}_sigma_pm"], scale)
    if kind == "magnitude":
        return MagnitudeErrors(MISSIONS[point["model"]], point["mission_length"], scale)
    return CatalogueErrors(scale) if kind == "catalogue" else NoErrors()


def _radians(vector_mas: Vector, size_mas: float | None) -> Vector:
    vector = np.array(vector_mas) * MAS
    if size_mas is not None:
        length = np.linalg.norm(vector)
        vector = vector / length * size_mas * MAS if length > 0.0 else np.array([size_mas * MAS, 0.0, 0.0])
    return (float(vector[0]), float(vector[1]), float(vector[2]))


def _glide(point: Point) -> Vector:
    given = point["glide"]
    x, y, z = MICROARCSEC * (GALACTIC_GLIDE_UAS_YR * GALACTIC_AXES[0] if given is None else np.array(given))
    return (float(x), float(y), float(z))


link = Experiment(
    name="link",
    version=1,
    parameters=PARAMETERS,
    sums=SUMS,
    outputs=OUTPUTS,
    coordinates={"component": UNKNOWNS, "component_other": UNKNOWNS, "glide_component": GLIDE_UNKNOWNS},
    component_units={"component": UNITS, "component_other": UNITS},
    evaluate=evaluate,
    summarise=summarise,
    samples=samples,
    sample_outputs=SAMPLE_OUTPUTS,
    check=check,
    cost=cost,
)
