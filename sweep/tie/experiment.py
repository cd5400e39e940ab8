"""The link of two tables as an experiment: closed form and Monte Carlo from the same normal equations."""

from collections.abc import Mapping, Sequence

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.constants import MAS
from linksweep.core.tie.clips import Clip, clipped
from linksweep.core.tie.draws import Draw, Simulation
from linksweep.core.tie.solution import Solution, solve
from linksweep.core.tie.sources import sources_of
from linksweep.sweep.contract import Experiment, Point, SweepError
from linksweep.sweep.tie.components import (
    BIN_SHAPE,
    COMPONENTS,
    FIELD_UNITS,
    FIELDS,
    HIGHEST_STORED,
    MOST_BINS,
    ORIENTATION,
    POWER_SHAPE,
    SPIN,
    UNITS,
    any_stored,
    by_bins,
    components,
    powers,
)
from linksweep.sweep.tie.design import Design, design_of
from linksweep.sweep.tie.parameters import OUTPUTS, PARAMETERS, SAMPLE_OUTPUTS, TABLE
from linksweep.sweep.tie.summary import FACTS, summarise

N = len(COMPONENTS)
SUMS: Mapping[str, tuple[int, ...]] = {
    "facts": (len(FACTS),),
    "estimate": (N,),
    "error_formal": (N,),
    "error_scaled": (N,),
    "error_jackknife": (N,),
    "predicted_variance": (N,),
    "error": (N,),
    "error_squares": (N,),
    "mean_square": (2,),
    "mean_square_squares": (2,),
    "within": (N,),
    "within_scaled": (N,),
    "power": (3, *POWER_SHAPE),
    "power_predicted": POWER_SHAPE,
    "power_drawn": POWER_SHAPE,
    "power_drawn_squares": POWER_SHAPE,
    "bins": (2, *BIN_SHAPE),
    "bins_variance": BIN_SHAPE,
    "bins_squares": BIN_SHAPE,
    "kept": (),
    "ratio": (),
    "ratio_squares": (),
}


def evaluate(
    points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
) -> dict[str, Array]:
    """Return the sums of `SUMS` over ``n_sim`` draws of the errors of each point's tables."""
    return _stacked([_simulated(point, n_sim, rng)[0] for point in points])


def samples(
    points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
) -> dict[str, Array]:
    """Return what `evaluate` returns and the estimates, shape (points, n_sim, components)."""
    found = [_simulated(point, n_sim, rng) for point in points]
    return _stacked([sums for sums, _ in found]) | {"drawn": np.array([drawn for _, drawn in found])}


def _stacked(rows: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    return {name: np.array([row[name] for row in rows]) for name in SUMS}


def _simulated(point: Point, n_sim: int, rng: np.random.Generator) -> tuple[dict[str, Array], Array]:
    """Return the sums of one point, and its estimates in mas and mas/yr (n_sim, components)."""
    design = design_of(point)
    truth = design.truth if point["truth"] == "estimate" else np.zeros_like(design.truth)
    simulation = Simulation(design.problem, truth, point["error_factor"], point["outliers"], point["outlier_factor"])
    labels = design.problem.unknowns.labels
    solution = solve(simulation.normals, labels)
    drawn = [_drawn(draw, design.clip, truth, solution, labels) for draw in simulation.draws(n_sim, rng)]
    error, formal, ratio, kept = (np.array(part) for part in zip(*drawn, strict=True))
    unknowns, covariance = design.problem.unknowns, solution.covariance
    power = np.array([powers(unknowns, one * MAS, covariance)[0] for one in error])
    in_bins = by_bins(unknowns, error)
    error, formal = components(error, labels), components(formal, labels)
    scaled = formal * np.sqrt(ratio)[:, None]
    size = np.abs(error)
    missing = np.where(np.isnan(error[0]), np.nan, 0.0)  # unknowns that are not solved for
    mean_square = np.stack([np.mean(error[:, part] ** 2, axis=1) for part in (ORIENTATION, SPIN)], axis=1)
    sums = {name: n_sim * value for name, value in _of_tables(design).items()}
    sums |= {
        "predicted_variance": n_sim * components(np.diag(solution.covariance) / MAS**2, labels),
        "error": error.sum(axis=0),
        "error_squares": np.sum(error**2, axis=0),
        "mean_square": mean_square.sum(axis=0),
        "mean_square_squares": np.sum(mean_square**2, axis=0),
        "within": np.sum(size <= formal, axis=0) + missing,
        "within_scaled": np.sum(size <= scaled, axis=0) + np.where(np.isnan(ratio).any(), np.nan, missing),
        "power_predicted": n_sim * powers(unknowns, solution.estimate, covariance)[1],
        "power_drawn": power.sum(axis=0),
        "power_drawn_squares": np.sum(power**2, axis=0),
        "bins_variance": n_sim * by_bins(unknowns, np.diag(covariance) / MAS**2),
        "bins_squares": np.sum(in_bins**2, axis=0),
        "kept": np.array(kept.sum()),
        "ratio": np.array(ratio.sum()),
        "ratio_squares": np.array(np.sum(ratio**2)),
    }
    return sums, error + components(truth / MAS, labels)


def _drawn(
    draw: Draw, clip: Clip, truth: Array, solution: Solution, labels: tuple[str, ...]
) -> tuple[Array, Array, float, float]:
    """Return the error of the estimate and its formal error (mas, mas/yr), chi2 over its average, and sources kept."""
    if clip.kind == "none":
        right, one = draw.sums.right.sum(axis=0), solution  # its matrices are the same for every draw
        estimate, expected, kept = one.inverse @ right, one.expected, len(draw.sums)
        squares = max(0.0, float(draw.sums.squares.sum() - right @ estimate))
    else:
        found = clipped(clip, sources_of(draw.sums, labels), draw.separations)
        one, kept = found.solution, int(np.sum(found.factors > 0.0))
        estimate, expected, squares = one.estimate, one.expected, one.squares
    ratio = squares / expected if one.dof > 0 and expected > 0.0 else np.nan
    return (estimate - truth) / MAS, np.sqrt(np.diag(one.covariance)) / MAS, ratio, kept


def _of_tables(design: Design) -> dict[str, Array]:
    """Return what no draw changes: the solution of the tables as they are, in mas and mas/yr."""
    labels = design.problem.unknowns.labels
    kinds = ("formal", "scaled", "jackknife")
    found = {f"error_{kind}": np.full(N, np.nan) for kind in kinds}
    estimate = np.full(N, np.nan)
    kept = ratio = share = np.nan
    power, in_bins = np.full((3, *POWER_SHAPE), np.nan), np.full((2, *BIN_SHAPE), np.nan)
    if (solved := design.solved) is not None:
        estimate = components(solved.solution.estimate / MAS, labels)
        errors = {kind: np.sqrt(np.diag(solved.covariances[kind])) / MAS for kind in kinds}
        found = {f"error_{kind}": components(error, labels) for kind, error in errors.items()}
        unknowns = design.problem.unknowns
        power = powers(unknowns, solved.solution.estimate, solved.solution.covariance)
        in_bins = np.array([by_bins(unknowns, one) for one in (solved.solution.estimate / MAS, errors["scaled"])])
        kept = float(np.sum((solved.found.factors > 0.0) & (solved.count > 0)))
        ratio = solved.solution.scale**2
        share = np.nan if solved.influence is None else float(solved.influence.share.max())
    facts = np.array([float(design.matched), kept, ratio, share, float(len(design.problem.satellite))])
    return found | {"estimate": estimate, "facts": facts, "power": power, "bins": in_bins}


def check(point: Point) -> str | None:
    """Return why a point cannot be computed: its tables, its unknowns, its clip."""
    try:
        design = design_of(point)
        if design.solved is not None and design.solved.misfit.absurd and not point["accept_misfit"]:
            return f"{design.solved.misfit.text}; accept_misfit = true computes it all the same"
        solve(Simulation(design.problem, design.truth).normals, design.problem.unknowns.labels)
        if not any_stored(design.problem.unknowns):
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
    found: dict[str, str] = {}

    def without(use: bool, why: str, *names: str) -> None:
        found.update({} if use else dict.fromkeys(names, why))

    reference = point["reference"] is not None
    of_reference = ("reference_columns", "reference_epoch", "positions", "by", "aberration")
    without(reference, "there is no reference", *of_reference)
    of_rows = ("truth", "position_jitter", "motion_jitter", "known_spin", "accept_misfit")
    without(reference or point["zero_motion"], "there are no rows of a reference", *of_rows)
    without(point["release"] != TABLE, "it is for a release", "from_release")
    new = ("new_epoch", "new_error", "new_positions", "goal", "candidates")
    without(point["n_new"] > 0, "it is for n_new above 0", *new)
    limits = point["g_min"] is not None or point["g_max"] is not None
    without(limits, "it is for g_min or g_max", "magnitude")
    without(point["outliers"] > 0.0, "it is for outliers above 0", "outlier_factor")
    return found


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
