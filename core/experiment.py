"""The link as an experiment: sums over realisations, and the results that follow from them."""

from collections.abc import Mapping, Sequence

import numpy as np

from linksweep.core.checks import check, unused, warn
from linksweep.core.frames import Array
from linksweep.core.parameters import OUTPUTS, PARAMETERS, SAMPLE_OUTPUTS, SHARED, UNITS
from linksweep.core.scenario import catalogue_kind, catalogue_size, error_models, scenario, zonal_errors
from linksweep.core.simulate import Streams, can_stack, simulate, simulate_stack
from linksweep.core.unknowns import ALWAYS, GLIDE, GLIDE_LABELS, LABELS, ORIENTATION, SPIN, link_unknowns
from linksweep.sweep.contract import Experiment, Point, enlarged_error, small_sample_factor

ALL = (*LABELS, *GLIDE_LABELS)

MEANS = (ORIENTATION, SPIN)
"""The blocks of unknowns whose mean variance is a result."""

SIGMAS: Mapping[str, slice | int] = {
    "sigma": ALWAYS,
    "glide_sigma": GLIDE,
    "sigma_orientation": len(ALL),
    "sigma_spin": len(ALL) + 1,
}
"""Where the results stand among the unknowns and these means."""

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

STACK = 2**17
"""Largest number of objects x realisations in the catalogues that are computed together."""


def evaluate(
    points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
) -> dict[str, Array]:
    """Return the sums of `SUMS` for one catalogue of each point and ``n_sim`` realisations of its errors, one row
    per point.
    """
    return _rows(simulate([scenario(point) for point in points], n_sim, rng, catalogue_rng))


def evaluate_catalogues(points: Sequence[Point], n_sim: int, streams: Sequence[Streams]) -> dict[str, Array]:
    """Return what `evaluate` returns for a catalogue from each pair of generators, one row per catalogue.

    Small catalogues of one point are computed together: one by one they would take many times as long as their random
    numbers.
    """
    physics = [scenario(point) for point in points]
    # how many depends on the point alone, so that a block is the same whatever the machine
    together = max(1, STACK // (catalogue_size(points[0]) * n_sim))
    if len(physics) > 1 or together == 1 or not can_stack(physics[0], n_sim):
        return _rows([_rows(simulate(physics, n_sim, *pair)) for pair in streams])
    parts = [streams[first : first + together] for first in range(0, len(streams), together)]
    stacks = [simulate_stack(physics[0], n_sim, part) for part in parts]
    return {name: np.concatenate([stack[name] for stack in stacks])[:, None] for name in SUMS}


def samples(
    points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
) -> dict[str, Array]:
    """Return what `evaluate` returns and the estimates that it adds up, shape (points, n_sim, K)."""
    rows = simulate([scenario(point) for point in points], n_sim, rng, catalogue_rng, keep_estimates=True)
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
    results |= {"chi2_mc_error": errors[:, -2], "condition_number_mc_error": errors[:, -1]}
    predicted_bias = np.where(undetermined, np.nan, sums["predicted_bias"] / each)
    for end, values in {"": bias, "_mc_error": errors, "_predicted": predicted_bias}.items():
        results |= {f"bias{end}": values[:, ALWAYS], f"glide_bias{end}": values[:, GLIDE]}
    sigma, expected = np.sqrt(_with_means(variance)), _with_means(total)
    sigmas = {
        "": sigma,
        "_mc_error": sigma * _relative_error(expected, sums["predicted_square_variance"] / each, each),
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
    objects = catalogue_kind(point).objects(point)
    reference, satellite = (model.has_errors(objects) for model in error_models(point))
    zonal = zonal_errors(point)
    if point["method"] == "projected":
        unknowns = len(link_unknowns(bool(point["solve_glide"])))
        columns = 1 + unknowns * (1 if point["weighting"] == "inverse-variance" else 2)
        return float(min(columns, 4 * catalogue_size(point)) if reference or satellite else 0)
    per_object = 4 * (reference + (satellite or zonal is not None))
    return float((per_object + (0.0 if zonal is None else zonal.coefficients / HARMONICS)) * catalogue_size(point))


def _rows(sums: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """Return sums by name as one array each, with a leading axis."""
    return {name: np.array([row[name] for row in sums]) for name in sums[0]}


def _with_means(values: Array) -> Array:
    """Return values of the unknowns with their means over orientation and over spin."""
    return np.column_stack([values, *(values[:, part].mean(axis=1) for part in MEANS)])


def _relative_error(expected: Array, variance: Array, n: Array) -> Array:
    """Return the relative error of sqrt(mean of n squares) with these expected values and this mean ``variance``.

    In the closed form, not from the realisations: few tell little of their fourth moments.  A single normal error has
    1/sqrt(2 n), and so have components of which one dominates the others; for three that are alike it is 1/sqrt(6 n).
    Biases, and catalogues of different quality, have their part.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(expected > 0.0, np.sqrt(variance / n) / (2.0 * expected), 0.0 * expected)


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
        error = enlarged_error(variance / (n_cat - 1.0), n_cat, skewness)
        return np.where(expected > 0.0, error / (2.0 * np.sqrt(expected)), 0.0 * expected)


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
