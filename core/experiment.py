"""The link as an experiment: what is said about a point before anything runs (why it cannot be computed, what makes its
result less certain than it looks, which parameters change nothing at it), the sums over realisations, and the results.

The checks read no parameter that does not matter at a point: the platform asks again only where another one differs.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from linksweep.core import setup
from linksweep.core.catalogues import CATALOGUES, NEEDS_MAGNITUDES, RANDOM_SKY, SIDES, File
from linksweep.core.errors import ERROR_MODELS, ErrorModel, error_models
from linksweep.core.frames import Array
from linksweep.core.parameters import OUTPUTS, PARAMETERS, SAMPLE_OUTPUTS, SHARED, UNITS
from linksweep.core.simulate import Streams, can_stack, simulate
from linksweep.core.unknowns import ALWAYS, GLIDE, GLIDE_LABELS, LABELS, ORIENTATION, SPIN, link_unknowns
from linksweep.sweep.contract import Experiment, Point, SweepError, enlarged_error, small_sample_factor

# Errors in mas and mas/yr between which the link is computed: outside, weights overflow or an error is not a small
# angle.
SMALLEST_ERROR, LARGEST_ERROR = 1e-9, 1e7

# Position error of the reference in mas beyond which `core.designs.neglected` is too large for isotropic catalogues.
LARGEST_PROJECTED_ERROR = 50_000.0

# Objects that are needed to determine nine unknowns: two give only eight observables.
SMALLEST_GLIDE = 3

# The column that gives the epoch of a row, and how much epochs may differ without a warning.
EPOCH, SAME_EPOCH_YR = "ref_epoch", 0.01

# Parameters that act on proper motions alone.
OF_MOTIONS = (
    *("zonal_pm", "motion_field", "motion_field_size", "omega_slope", "omega_slope_size"),
    *("magnitude_equation_pmra", "magnitude_equation_pmdec", "aberration", "glide", "solve_glide"),
)

# Share of the weight of all objects above which an object is named.
LARGE_SHARE = 0.1


def check(point: Point) -> str | None:
    """Return why this point cannot be computed, or None."""
    try:
        if problem := _catalogue_problem(point) or _systematics_problem(point):
            return problem
        # before any error is computed: a curve may not reach these magnitudes
        for model in (models := error_models(point)):
            if problem := model.problem(point, setup.catalogue_kind(point)):
                return problem
        errors = setup.expected_errors(point, models)
        return _errors_problem(point, errors) or _projected_problem(point, models, errors)
    except (SweepError, ValueError) as error:  # of tables, counts, curves and patterns
        return str(error)


def _catalogue_problem(point: Point) -> str | None:
    kind = setup.catalogue_kind(point)
    if (point["file"] is not None) != isinstance(kind, File):
        return "file: catalogue = 'file' needs a file, and other catalogues have none"
    if problem := kind.problem(point):
        return problem
    if point["solve_glide"] and (size := kind.size(point)) < SMALLEST_GLIDE:
        return f"n_obj = {size}: solving for a glide too needs at least {SMALLEST_GLIDE} objects"
    if point["aberration"] and not kind.extragalactic:
        return f"aberration: the glide is that of extragalactic objects, not of {point['catalogue']}"
    return None


def _systematics_problem(point: Point) -> str | None:
    random = ("epsilon", "omega") if point["directions"] == "random" else ()
    for name in ("epsilon", "omega", "omega_slope"):
        if name not in random and point[f"{name}_size"] and not any(point[name]):
            return f"{name}_size = {point[f'{name}_size']:g}: {name} = {list(point[name])} gives it no direction"
    if setup.systematics(point).need_magnitudes and any(map(math.isnan, setup.catalogue_kind(point).magnitudes(point))):
        return f"an omega_slope or magnitude equation {NEEDS_MAGNITUDES}"
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
    return None


def _projected_problem(point: Point, models: Sequence[ErrorModel], errors: Array) -> str | None:
    """Return why the errors cannot be projected: that needs a fixed design.  Near the limit only the drawn catalogue
    decides.
    """
    if point["method"] == "catalogue":
        return None
    needs = "method = 'projected' needs"
    if setup.zonal_errors(point) is not None:
        return f"{needs} errors that are independent from object to object, and zonal ones are not"
    objects = setup.catalogue_kind(point).objects(point)
    for model in models:
        if point[f"{model.side}_error_ratio"] != 1.0:
            return f"{needs} true errors that equal those in the weights: {model.side}_error_ratio = 1"
        if objects is not None and model.correlation(objects) is not None:
            return f"{needs} uncorrelated errors, and those of the {model.side} are correlated"
    if (largest := errors[0, :, :2].max()) <= LARGEST_PROJECTED_ERROR:
        return None
    said = "method = 'projected' takes the reference's positions as exact in the design matrix: an error of"
    return f"{said} {largest:.3g} mas is more than {LARGEST_PROJECTED_ERROR:g} mas"


def warn(point: Point) -> list[str]:
    """Return sentences about magnitudes outside of a curve's range, about what is not measured, about positions of
    different epochs, and about objects that decide nearly alone.
    """
    kind, models = setup.catalogue_kind(point), error_models(point)
    errors = setup.expected_errors(point, models)
    sentences = [model.warning(point, kind) for model in models]
    sentences += [_not_measured(errors), _epochs(point), _heaviest(point, errors)]
    return [sentence for sentence in sentences if sentence is not None]


def _not_measured(errors: Array) -> str | None:
    """Say which observables have no errors on either side while others have."""
    position, motion = errors[..., :2].any(), errors[..., 2:].any()
    if position == motion:
        return None
    kinds = ("proper motions", "positions", "spin"), ("positions", "proper motions", "orientation")
    missing, present, unknowns = kinds[0 if position else 1]
    said = f"{missing} have no errors on either side while {present} have: they are taken as not measured, and the"
    return f"{said} {unknowns} is not determined (NaN)"


def _epochs(point: Point) -> str | None:
    """Say that the rows of a file are of different epochs, which the simulation ignores."""
    table = point["file"]
    if table is None or not (read := table.columns({}, {}, ())).has(EPOCH):
        return None
    epochs = read.epochs()
    if read.problems or np.ptp(epochs) <= SAME_EPOCH_YR:  # a problem: not all rows have one
        return None
    said = f"file: {read.label(EPOCH)} is between {epochs.min():.10g} and {epochs.max():.10g}, and the simulation takes"
    return f"{said} all rows as of one epoch; `sweep tie` links rows of different epochs"


def _heaviest(point: Point, errors: Array) -> str | None:
    """Name the object of a file with the largest share of the weight of positions or proper motions."""
    kind = setup.catalogue_kind(point)
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
    said = f"file: {kind.row_name(point, heaviest)} holds {100 * motion:.0f} % of the weight of all proper motions and"
    said += f" {100 * position:.0f} % of that of all positions, of {len(share)} objects; are its errors and magnitude"
    return f"{said} right?  v_min leaves out the bright ones"


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
    if setup.zonal_errors(point) is None:
        clauses["zonal_length"] = "it is for zonal errors, zonal_pos or zonal_pm above 0"
    errors = setup.expected_errors(point, error_models(point))
    position, motion = errors[..., :2].any(), errors[..., 2:].any()
    if position != motion:
        what, names = ("proper motions", OF_MOTIONS) if position else ("positions", ("zonal_pos",))
        clauses |= dict.fromkeys(names, f"{what} have no errors on either side, so that they are not measured")
    if point["motion_field"] is None:
        clauses["motion_field_size"] = "it is for a motion_field"
    if not setup.systematics(point).need_magnitudes:
        clauses["v_zero"] = "it is for an omega_slope or a magnitude equation"
    return clauses


def _unused_by_catalogue(point: Point) -> dict[str, str]:
    kind, clauses = setup.catalogue_kind(point), {}
    uses = kind.uses(point)
    for parameter in sorted({name for other in CATALOGUES.values() for name in other.parameters} - uses):
        if parameter in RANDOM_SKY & kind.parameters:
            clauses[parameter] = "it is for random positions (positions = 'isotropic')"
        else:
            clauses[parameter] = f"it is not for catalogue = {point['catalogue']!r}"
    if "pm_distribution" in uses and not point["mean_pm"] > 0.0:
        clauses["pm_distribution"] = "it is for objects with proper motions, mean_pm above 0"
    return clauses


def _unused_by_errors(point: Point) -> dict[str, str]:
    models = [(side, model) for model in ERROR_MODELS.values() for side in SIDES if side in model.sides]
    known = frozenset().union(*(model.uses(side) for side, model in models))
    used = frozenset().union(*(ERROR_MODELS[point[f"{side}_errors"]].uses(side) for side in SIDES))
    # a parameter of both sides, such as error_scale, is used where either side uses it
    chosen = " and ".join(f"{side}_errors = {point[f'{side}_errors']!r}" for side in SIDES)
    clauses = dict.fromkeys(sorted(known - used), f"it is not for {chosen}")
    return clauses if used else clauses | {"weighting": "without errors all weights are equal"}


# ---- sums over realisations, and results

ALL = (*LABELS, *GLIDE_LABELS)

# The blocks of unknowns whose mean variance is a result.
MEANS = (ORIENTATION, SPIN)

# Where the results stand among the unknowns and these means.
SIGMAS: dict[str, slice | int] = {"sigma": ALWAYS, "glide_sigma": GLIDE}
SIGMAS |= {"sigma_orientation": len(ALL), "sigma_spin": len(ALL) + 1}

SUMS: Mapping[str, tuple[int, ...]] = {
    "error": (len(ALL),),
    "error_products": (len(LABELS), len(LABELS)),
    "glide_squares": (len(GLIDE_LABELS),),
    "chi2": (),
    "predicted_variance": (len(ALL),),
    "predicted_powers": (2, len(ALL) + len(MEANS)),
    "predicted_square_variance": (len(ALL) + len(MEANS),),
    "predicted_bias": (len(ALL),),
    "predicted_bias_squares": (len(ALL),),
    "condition_number": (),
    "n_obj": (),
    "chi2_variance": (),
    "batch_mean_squares": (len(ALL) + 2,),
    "batches": (),
}

HARMONICS = 20.0

# Largest number of objects x realisations in the catalogues that are computed together.
STACK = 2**17


def evaluate(
    points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
) -> dict[str, Array]:
    """Return the sums of `SUMS` for one catalogue of each point and ``n_sim`` realisations of its errors, one row
    per point.
    """
    return _rows(simulate([setup.scenario(point) for point in points], n_sim, [(rng, catalogue_rng)]))


def evaluate_catalogues(points: Sequence[Point], n_sim: int, streams: Sequence[Streams]) -> dict[str, Array]:
    """Return what `evaluate` returns for a catalogue from each pair of generators, one row per catalogue.

    Small catalogues of one point are computed together: one by one they would take many times as long as their random
    numbers.
    """
    physics = [setup.scenario(point) for point in points]
    # how many depends on the point alone, so that a block is the same whatever the machine
    together = max(1, STACK // (setup.catalogue_kind(points[0]).size(points[0]) * n_sim))
    if len(physics) > 1 or together == 1 or not can_stack(physics[0], n_sim):
        return _rows([_rows(simulate(physics, n_sim, [pair])) for pair in streams])
    parts = [streams[first : first + together] for first in range(0, len(streams), together)]
    stacks = [simulate(physics, n_sim, part, (len(part),))[0] for part in parts]
    return {name: np.concatenate([stack[name] for stack in stacks])[:, None] for name in SUMS}


def samples(
    points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
) -> dict[str, Array]:
    """Return what `evaluate` returns and the estimates that it adds up, shape (points, n_sim, K)."""
    scenarios = [setup.scenario(point) for point in points]
    rows = simulate(scenarios, n_sim, [(rng, catalogue_rng)], keep_estimates=True)
    return _rows([row | {"estimate": row["estimate"][:, ALWAYS]} for row in rows])


def summarise(sums: Mapping[str, Array], n: Array, n_cat: Array) -> dict[str, Array]:
    """Return every output of `OUTPUTS` from the sums over n realisations of n_cat catalogues, NaN for what is not
    determined.

    Source: Metz & Geffert 2004, Sect. 4.1 (sigma is the RMS of estimate - truth).
    """
    each = n[:, None]
    bias = sums["error"] / each
    undetermined = np.isnan(bias)  # of what is not measured; its other sums are zero, which would read as perfect
    # RMS about the truth, not about the mean: a bias is part of the error of a link
    second_moment = sums["error_products"] / each[..., None]
    squares = np.concatenate([np.einsum("...ii->...i", second_moment), sums["glide_squares"] / each], axis=1)
    variance = np.where(undetermined, np.nan, squares)
    predicted = np.where(undetermined, np.nan, sums["predicted_variance"] / each)
    total = predicted + sums["predicted_bias_squares"] / each
    covariance = second_moment - bias[:, ALWAYS, None] * bias[:, None, ALWAYS]
    n_obj = sums["n_obj"] / n
    # observables that are measured: positions, proper motions
    kinds = 2.0 - undetermined[:, [ORIENTATION.start, SPIN.start]].sum(axis=1)
    results = {
        "n_obj": n_obj,
        "covariance": covariance,
        "correlation": _correlation(covariance),
        "condition_number": sums["condition_number"] / n,
        "chi2": sums["chi2"] / n,
        "dof": 2.0 * kinds * n_obj - ORIENTATION.stop * kinds - np.where(undetermined[:, GLIDE.start], 0.0, 3.0),
    }
    between = sums["batch_mean_squares"] / each
    # nothing but the choice of catalogues changes the condition number
    whole = np.column_stack([variance, between[:, -2] + sums["chi2_variance"] / n, between[:, -1]])
    means = np.column_stack([bias, results["chi2"], results["condition_number"]])
    errors = _error_of_mean(means, whole, between, sums["batches"][:, None], each, n_cat[:, None])
    # of one catalogue chi2 has a closed form, and the condition number is exact
    of_one = np.sqrt(sums["chi2_variance"]) / n, np.zeros(len(n))
    of_means = zip(("chi2", "condition_number"), of_one, errors.T[-2:], strict=True)
    results |= {f"{name}_mc_error": np.where(n_cat > 1.0, many, one) for name, one, many in of_means}
    predicted_bias = np.where(undetermined, np.nan, sums["predicted_bias"] / each)
    for end, values in {"": bias, "_mc_error": errors, "_predicted": predicted_bias}.items():
        results |= {f"bias{end}": values[:, ALWAYS], f"glide_bias{end}": values[:, GLIDE]}
    sigma, expected = np.sqrt(_with_means(variance)), _with_means(total)
    sigmas = {
        "": sigma,
        # in the closed form: few realisations tell little of their squares and fourth moments
        "_mc_error": _error_of_root(expected, np.sqrt(sums["predicted_square_variance"]) / each),
        "_predicted": np.sqrt(_with_means(predicted)),
        "_rms_predicted": np.sqrt(expected),
        "_catalogue_error": _catalogue_error(expected, sums["predicted_powers"] / each[..., None], n_cat[:, None]),
    }
    for end, values in sigmas.items():
        results |= {f"{name}{end}": values[:, part] for name, part in SIGMAS.items()}
    return results


def cost(point: Point) -> float:
    """Return how many normal deviates one realisation takes; the projected method draws a chi-square per chunk too.

    A zonal error is a sum over harmonics, of which `HARMONICS` cost as much as a normal.
    """
    kind = setup.catalogue_kind(point)
    reference, satellite = (model.has_errors(kind.objects(point)) for model in error_models(point))
    zonal = setup.zonal_errors(point)
    if point["method"] == "projected":
        unknowns = len(link_unknowns(bool(point["solve_glide"])))
        columns = 1 + unknowns * (1 if point["weighting"] == "inverse-variance" else 2)
        return float(min(columns, 4 * kind.size(point)) if reference or satellite else 0)
    per_object = 4 * (reference + (satellite or zonal is not None))
    of_zonal = 0.0 if zonal is None else zonal.coefficients / HARMONICS
    return float((per_object + of_zonal) * kind.size(point))


def _rows(sums: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """Return sums by name as one array each, with a leading axis."""
    return {name: np.array([row[name] for row in sums]) for name in sums[0]}


def _with_means(values: Array) -> Array:
    """Return values of the unknowns with their means over orientation and over spin."""
    return np.column_stack([values, *(values[:, part].mean(axis=1) for part in MEANS)])


def _error_of_root(mean: Array, error: Array) -> Array:
    """Return the error of the root of a mean with this ``error``, 0 where the mean is 0."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(mean > 0.0, error / (2.0 * np.sqrt(mean)), 0.0 * mean)


def _correlation(covariance: Array) -> Array:
    """Return correlations, shape (..., K, K); NaN where an unknown does not scatter."""
    sigma = np.sqrt(np.maximum(np.einsum("...ii->...i", covariance), 0.0))
    scale = np.divide(1.0, sigma, out=np.full_like(sigma, np.nan), where=sigma > 0.0)
    return np.asarray(covariance * scale[..., :, None] * scale[..., None, :])


def _error_of_mean(
    mean: Array, squares: Array, batch_squares: Array, batches: Array, each: Array, catalogues: Array
) -> Array:
    """Return the error of a bias, or another mean, taken over all possible catalogues, each of which may have its own;
    for a single catalogue, the error of its own bias.  NaN where catalogues are too few to show their scatter.

    A batch is the realisations of a catalogue in one block: batches of one catalogue share its bias.  The mean squares
    between and within batches give the variance of both kinds (nested analysis of variance, e.g. Searle, Casella &
    McCulloch 1992, Variance Components, Sect. 3.6).
    """
    between = np.maximum(batch_squares - mean**2, 0.0)  # divided by n, like the next two
    total = np.maximum(squares - mean**2, 0.0)  # rounding may leave it just below zero
    within = np.maximum(total - between, 0.0)
    factor = small_sample_factor(catalogues)
    with np.errstate(invalid="ignore", divide="ignore"):
        one_catalogue = small_sample_factor(each) * total / (each - 1.0)
        one_batch_each = factor * between / (catalogues - 1.0)
        realisations = within / (each - batches)
        catalogue_scatter = (between - (batches - 1.0) * realisations) / (catalogues - 1.0)
        several_batches = np.maximum(factor * (catalogue_scatter + realisations), realisations)
        # Batches of one realisation cannot separate the two: then each counts as a catalogue, which gives too large an
        # error.
        apart = (batches > catalogues) & (each > batches)
        variance_of_mean = np.where(apart, several_batches, one_batch_each)
        return np.sqrt(np.where(catalogues > 1.0, variance_of_mean, one_catalogue))


def _catalogue_error(expected: Array, powers: Array, n_cat: Array) -> Array:
    """Return how uncertain sqrt(mean square error) is because only n_cat catalogues were drawn; NaN for too few.

    It is enlarged as that of a mean of numbers: few catalogues of a skewed law look too much alike.
    """
    squares, cubes = powers[:, 0], powers[:, 1]
    variance = np.maximum(squares - expected**2, 0.0)
    third = cubes - 3.0 * expected * squares + 2.0 * expected**3
    with np.errstate(invalid="ignore", divide="ignore"):
        # squared, over their number, which is at most 1
        skewness = np.where(variance > 0.0, np.minimum((third / variance**1.5) ** 2 / n_cat, 1.0), 0.0)
        return _error_of_root(expected, enlarged_error(variance / (n_cat - 1.0), n_cat, skewness))


link = Experiment(
    name="link",
    version=3,
    parameters=PARAMETERS,
    sums=SUMS,
    outputs=OUTPUTS,
    coordinates={"component": LABELS, "component_other": LABELS, "glide_component": GLIDE_LABELS},
    component_units={"component": UNITS, "component_other": UNITS},
    evaluate=evaluate,
    evaluate_catalogues=evaluate_catalogues,
    summarise=summarise,
    samples=samples,
    sample_outputs=SAMPLE_OUTPUTS,
    check=check,
    unused=unused,
    warn=warn,
    cost_unit="random numbers",
    outer_draw="catalogue",
    cost=cost,
    shared=SHARED,
    nan_sums=("error", "batch_mean_squares", "chi2_variance"),
)
