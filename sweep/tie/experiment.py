"""The link of two tables as an experiment: closed form and Monte Carlo from the same normal equations."""

from collections.abc import Mapping, Sequence

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.constants import MAS
from linksweep.core.tie.clips import Clip, clipped, sources_of
from linksweep.core.tie.draws import Draw, Simulation
from linksweep.core.tie.solution import Solution, solve
from linksweep.sweep.contract import Experiment, Point, SweepError
from linksweep.sweep.tie.design import Design, design_of
from linksweep.sweep.tie.parameters import (
    BIN_SHAPE,
    COMPONENTS,
    FIELD_UNITS,
    FIELDS,
    HIGHEST_STORED,
    MOST_BINS,
    ORIENTATION,
    OUTPUTS,
    PARAMETERS,
    POWER_SHAPE,
    SAMPLE_OUTPUTS,
    SPIN,
    TABLE,
    UNITS,
    by_bins,
    components,
    is_stored,
    powers,
)

FACTS = ("n_sources", "n_kept", "chi2_ratio", "largest_share", "n_drawn")
"""Numbers of the tables that no draw changes."""

KINDS = ("formal", "scaled", "jackknife")
N = len(COMPONENTS)
SUMS: Mapping[str, tuple[int, ...]] = {
    "facts": (len(FACTS),),
    **dict.fromkeys(("estimate", *(f"error_{kind}" for kind in KINDS), "predicted_variance"), (N,)),
    **dict.fromkeys(("error", "error_squares", "within", "within_scaled"), (N,)),
    **dict.fromkeys(("mean_square", "mean_square_squares"), (2,)),
    "power": (3, *POWER_SHAPE),
    **dict.fromkeys(("power_predicted", "power_drawn", "power_drawn_squares"), POWER_SHAPE),
    "bins": (2, *BIN_SHAPE),
    **dict.fromkeys(("bins_variance", "bins_squares"), BIN_SHAPE),
    **dict.fromkeys(("kept", "ratio", "ratio_squares"), ()),
}


def evaluate(
    points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
) -> dict[str, Array]:
    """Return the sums of `SUMS` over ``n_sim`` draws of the errors of each point's tables."""
    rows = [_simulated(point, n_sim, rng)[0] for point in points]
    return {name: np.array([row[name] for row in rows]) for name in SUMS}


def samples(
    points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
) -> dict[str, Array]:
    """Return what `evaluate` returns and the estimates, shape (points, n_sim, components)."""
    rows = [_simulated(point, n_sim, rng) for point in points]
    sums = {name: np.array([row[name] for row, _ in rows]) for name in SUMS}
    return sums | {"drawn": np.array([drawn for _, drawn in rows])}


def _simulated(point: Point, n_sim: int, rng: np.random.Generator) -> tuple[dict[str, Array], Array]:
    """Return the sums of one point, and its estimates in mas and mas/yr (n_sim, components)."""
    design = design_of(point)
    unknowns, labels = design.problem.unknowns, design.problem.unknowns.labels
    truth = design.truth if point["truth"] == "estimate" else np.zeros_like(design.truth)
    simulation = Simulation(design.problem, truth, point["error_factor"], point["outliers"], point["outlier_factor"])
    solution = solve(simulation.normals, labels)
    covariance = solution.covariance
    drawn = [_drawn(draw, design.clip, truth, solution, labels) for draw in simulation.draws(n_sim, rng)]
    error, formal, ratio, kept = (np.array(part) for part in zip(*drawn, strict=True))
    power = np.array([powers(unknowns, one * MAS, covariance)[0] for one in error])
    in_bins = by_bins(unknowns, error)
    error, formal = components(error, labels), components(formal, labels)
    missing = np.where(np.isnan(error[0]), np.nan, 0.0)  # unknowns that are not solved for
    within = {"within": formal, "within_scaled": formal * np.sqrt(ratio)[:, None]}
    moments = {
        "error": error,
        "mean_square": np.stack([np.mean(error[:, part] ** 2, axis=1) for part in (ORIENTATION, SPIN)], axis=1),
        "power_drawn": power,
        "ratio": ratio,
    }
    fixed = _fixed(design) | {
        "predicted_variance": components(np.diag(covariance) / MAS**2, labels),
        "power_predicted": powers(unknowns, solution.estimate, covariance)[1],
        "bins_variance": by_bins(unknowns, np.diag(covariance) / MAS**2),
    }
    sums = {name: n_sim * values for name, values in fixed.items()}
    sums |= {name: np.asarray(values.sum(axis=0)) for name, values in (moments | {"kept": kept}).items()}
    sums |= {f"{name}_squares": np.asarray(np.sum(values**2, axis=0)) for name, values in moments.items()}
    sums |= {name: np.sum(np.abs(error) <= size, axis=0) + missing for name, size in within.items()}
    if np.isnan(ratio).any():
        sums["within_scaled"] = np.full(N, np.nan)
    return sums | {"bins_squares": np.sum(in_bins**2, axis=0)}, error + components(truth / MAS, labels)


def _drawn(
    draw: Draw, clip: Clip, truth: Array, solution: Solution, labels: tuple[str, ...]
) -> tuple[Array, Array, float, float]:
    """Return the error of the estimate and its formal error (mas, mas/yr), chi2 over its average, and sources kept."""
    if clip.kind == "none":
        right, one = draw.sums.right.sum(axis=0), solution  # its matrices are the same for every draw
        estimate, expected, kept = one.inverse @ right, one.expected, len(draw.sums)
        squares = max(0.0, float(draw.sums.squares.sum() - right @ estimate))
    else:
        result = clipped(clip, sources_of(draw.sums, labels), draw.separations)
        one, kept = result.solution, int(np.sum(result.factors > 0.0))
        estimate, expected, squares = one.estimate, one.expected, one.squares
    ratio = squares / expected if one.dof > 0 and expected > 0.0 else np.nan
    return (estimate - truth) / MAS, np.sqrt(np.diag(one.covariance)) / MAS, ratio, kept


def _fixed(design: Design) -> dict[str, Array]:
    """Return what no draw changes: the solution of the tables as they are, in mas and mas/yr."""
    unknowns, solved = design.problem.unknowns, design.solved
    facts = [float(design.matched), np.nan, np.nan, np.nan, float(len(design.problem.satellite))]
    if solved is None:
        fixed = {
            name: np.full(SUMS[name], np.nan) for name in ("estimate", *(f"error_{k}" for k in KINDS), "power", "bins")
        }
        return fixed | {"facts": np.array(facts)}
    estimate = solved.solution.estimate / MAS
    errors = {kind: np.sqrt(np.diag(solved.covariances[kind])) / MAS for kind in KINDS}
    facts[1:3] = float(np.sum((solved.clipped.factors > 0.0) & (solved.count > 0))), solved.solution.scale**2
    facts[3] = np.nan if solved.influence is None else float(solved.influence.share.max())
    return {
        "facts": np.array(facts),
        "estimate": components(estimate, unknowns.labels),
        **{f"error_{kind}": components(error, unknowns.labels) for kind, error in errors.items()},
        "power": powers(unknowns, solved.solution.estimate, solved.solution.covariance),
        "bins": np.array([by_bins(unknowns, one) for one in (estimate, errors["scaled"])]),
    }


def summarise(sums: Mapping[str, Array], n: Array, n_cat: Array) -> dict[str, Array]:
    """Return every output from the sums over n draws."""
    each = {name: n.reshape(-1, *[1] * (total.ndim - 1)) for name, total in sums.items()}
    mean = {name: total / each[name] for name, total in sums.items()}

    def error_of_mean(name: str) -> Array:
        """Return the standard error of a mean from the scatter of the n numbers; NaN for one."""
        with np.errstate(invalid="ignore", divide="ignore"):
            size = np.where(each[name] > 1, each[name] - 1.0, np.nan)
            return np.sqrt(np.maximum(mean[f"{name}_squares"] - mean[name] ** 2, 0.0) / size)

    results = dict(zip(FACTS, mean["facts"].T, strict=True))
    for name in ("n_sources", "n_kept", "n_drawn"):
        results[name] = np.round(results[name])  # a whole number times n, over n
    results |= {name: mean[name] for name in ("estimate", *(f"error_{kind}" for kind in KINDS))}
    for name, squares, variance in (
        ("sigma", "error_squares", "predicted_variance"),
        ("sigma_by_bin", "bins_squares", "bins_variance"),
    ):
        results[name] = np.sqrt(mean[squares])
        results[f"{name}_mc_error"] = results[name] / np.sqrt(2.0 * each[squares])
        results[f"{name}_predicted"] = np.sqrt(mean[variance])
    for name, key in (("bias", "error"), ("chi2_ratio_drawn", "ratio"), ("power_drawn", "power_drawn")):
        results[name], results[f"{name}_mc_error"] = mean[key], error_of_mean(key)
    for name, key in (("coverage", "within"), ("coverage_scaled", "within_scaled")):
        between = (sums[key] + 1.0) / (each[key] + 2.0)  # never 0 or 1, where the error would be 0
        results[name], results[f"{name}_mc_error"] = mean[key], np.sqrt(between * (1.0 - between) / each[key])
    for which, (name, part) in enumerate((("sigma_orientation", ORIENTATION), ("sigma_spin", SPIN))):
        rms = results[name] = np.sqrt(mean["mean_square"][:, which])
        with np.errstate(invalid="ignore", divide="ignore"):
            scatter = error_of_mean("mean_square")[:, which] / (2.0 * rms)
        results[f"{name}_mc_error"] = np.where(rms > 0.0, scatter, rms)
        results[f"{name}_predicted"] = np.sqrt(mean["predicted_variance"][:, part].mean(axis=1))
    power = ("power", "power_noise", "power_probability")
    results |= dict(zip(power, np.moveaxis(mean["power"], 1, 0), strict=True))
    results |= dict(zip(("spin_by_bin", "spin_by_bin_error"), np.moveaxis(mean["bins"], 1, 0), strict=True))
    return results | {"n_kept_drawn": mean["kept"], "power_drawn_predicted": mean["power_predicted"]}


def check(point: Point) -> str | None:
    """Return why a point cannot be computed: its tables, its unknowns, its clip."""
    try:
        design = design_of(point)
        if design.solved is not None and design.solved.misfit.absurd and not point["accept_misfit"]:
            return f"{design.solved.misfit.text}; accept_misfit = true computes it all the same"
        solve(Simulation(design.problem, design.truth).normals, design.problem.unknowns.labels)
        if not is_stored(design.problem.unknowns):
            places = f"results have no place for any of these; harmonics end at degree {HIGHEST_STORED}"
            return f"unknowns = {point['unknowns']!r}: {places}"
    except (SweepError, ValueError) as error:  # LinkError is one
        return str(error)
    return None


def warn(point: Point) -> list[str]:
    """Return what the solution of the tables notes (sources that hold much of the weight, clips that do not fit), and
    from which release errors are scaled.
    """
    return list(design_of(point).notes)


def unused(point: Point) -> dict[str, str]:
    """Return the parameters that change nothing at a point, each with a clause that says why."""
    reference, limits = point["reference"] is not None, point["g_min"] is not None or point["g_max"] is not None
    rows = ("truth", "position_jitter", "motion_jitter", "known_spin", "accept_misfit")
    new = ("new_epoch", "new_error", "new_positions", "goal", "candidates")
    columns = ("reference_columns", "reference_epoch", "positions", "by", "aberration")
    needs = (
        (reference, "there is no reference", columns),
        (reference or point["zero_motion"], "there are no rows of a reference", rows),
        (point["release"] != TABLE, "it is for a release", ("from_release",)),
        (point["n_new"] > 0, "it is for n_new above 0", new),
        (limits, "it is for g_min or g_max", ("magnitude",)),
        (point["outliers"] > 0.0, "it is for outliers above 0", ("outlier_factor",)),
    )
    return {name: why for used, why, names in needs if not used for name in names}


def cost(point: Point) -> float:
    """Return how many normal deviates a draw takes."""
    problem = design_of(point).problem
    return 5.0 * (len(problem.satellite) + len(problem.rows))


tie = Experiment(
    name="tie",
    version=2,
    parameters=PARAMETERS,
    sums=SUMS,
    outputs=OUTPUTS,
    coordinates={
        "component": COMPONENTS,
        "unknown": COMPONENTS,
        "field": FIELDS,
        "field_tested": FIELDS,
        "power_degree": tuple(str(degree) for degree in range(1, HIGHEST_STORED + 1)),
        "bin": tuple(str(number) for number in range(1, MOST_BINS + 1)),
        "axis": ("x", "y", "z"),
    },
    component_units={"component": UNITS, "field": FIELD_UNITS},
    evaluate=evaluate,
    summarise=summarise,
    samples=samples,
    sample_outputs=SAMPLE_OUTPUTS,
    check=check,
    unused=unused,
    warn=warn,
    cost=cost,
    cost_unit="random numbers",
    outer_draw="catalogue",
    nan_sums=tuple(name for name in SUMS if name != "kept"),
)
