"""The link of two tables as an experiment: closed form and Monte Carlo from the same normal equations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from linksweep.core.frames import MAS, Array
from linksweep.core.tie.clips import Clip, clipped, parse_clip, sources_of
from linksweep.core.tie.draws import Draw, Simulation
from linksweep.core.tie.forecast import Goal, choose, released, scaled_from, scaling_notes, with_new_rows
from linksweep.core.tie.problem import Problem, source_sums
from linksweep.core.tie.solution import Solution, solve
from linksweep.sweep.contract import Experiment, Point, SweepError
from linksweep.sweep.tie.options import Options, TableOptions, parse_bins
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
from linksweep.sweep.tie.setup import ALL, ZERO_MOTION, Setup, set_up
from linksweep.sweep.tie.solution import Link, solve_link

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


# ---- what a point stands for: tables as they are, their solution, and the tables to simulate

DECIDING = (
    *("satellite", "reference", "zero_motion", "unknowns", "degree", "bins", "by", "epoch", "weights", "known_spin"),
    *("aberration", "positions", "zero_errors", "extragalactic", "satellite_columns", "reference_columns"),
    *("satellite_epoch", "reference_epoch", "position_jitter", "motion_jitter", "candidates"),
)
"""The parameters that decide which rows belong to which sources."""


@dataclass(frozen=True)
class Design:
    """A point: its clip, the solution of the tables as they are (None without rows of a reference), and the problem
    with the release and the new rows, whose sources all have rows; ``notes`` are for the reader.
    """

    clip: Clip
    solved: Link | None
    matched: int
    problem: Problem
    notes: tuple[str, ...]

    @property
    def truth(self) -> Array:
        """The solution of the tables as they are; zero where there is none."""
        return np.zeros(len(self.problem.unknowns)) if self.solved is None else self.solved.solution.estimate


def design_of(point: Point) -> Design:
    """Return the design of a point; raises SweepError or another ValueError that says what is wrong."""
    return _design(tuple((parameter.name, point[parameter.name]) for parameter in PARAMETERS))


@lru_cache(maxsize=16)
def _design(values: tuple[tuple[str, Any], ...]) -> Design:
    point = dict(values)
    clip = parse_clip(point["clip"])
    setup = _within(_set_up(tuple((name, point[name]) for name in DECIDING)), point)
    problem = setup.problem
    if not point["correlations"]:
        own, rows = (replace(one, correlations=None) for one in (problem.satellite, problem.rows))
        problem = replace(problem, satellite=own, rows=rows)
        setup = replace(setup, problem=problem)
    matched = np.unique(problem.source)
    solved = solve_link(setup.only(matched), str(clip), ("scaled", "formal", "jackknife")) if len(matched) else None
    notes = [] if solved is None else [*solved.notes]
    if (release := point["release"]) != TABLE:
        named = None if point["from_release"] == TABLE else point["from_release"]
        old = scaled_from(problem.satellite.epoch, release, named)
        problem = released(problem, old, release, point["epoch"] is None)
        notes += scaling_notes(old, release)
    if point["n_new"]:
        problem = _with_chosen(problem, point)
    if not len(problem.rows):
        raise SweepError("no rows: give a reference, or zero_motion = true, or n_new above 0")
    return Design(clip, solved, len(matched), problem.only(np.unique(problem.source)), tuple(notes))


@lru_cache(maxsize=4)
def _set_up(values: tuple[tuple[str, Any], ...]) -> Setup:
    """Return the tables as they are; points that differ in nothing of `DECIDING` share them."""
    point = dict(values)
    reference, zero_motion = point["reference"], point["zero_motion"]
    if point["satellite"] is None:
        raise SweepError("satellite is required: the table of the satellite")
    if reference is not None and zero_motion:
        raise SweepError("zero_motion = true is for quasars without a table, and there is a reference")
    jitter = point["position_jitter"], point["motion_jitter"]
    satellite_options, reference_options = (
        TableOptions(
            columns=dict(point[f"{side}_columns"]),
            epoch=point[f"{side}_epoch"],
            zero_errors=point["zero_errors"],
            extragalactic=point["extragalactic"] in (side, "both"),
            positions=None if side == "satellite" or point["positions"] == "table" else point["positions"],
        )
        for side in ("satellite", "reference")
    )
    options = Options(
        **{name: point[name] for name in ("unknowns", "degree", "epoch", "weights", "known_spin", "aberration")},
        bins=parse_bins(point["bins"]) if point["bins"] else None,
        by=point["by"] or None,
        jitter={ALL: jitter} if any(jitter) else {},
        satellite_options=satellite_options,
        reference_options=reference_options,
    )
    everything = reference is None or point["candidates"] == "all"
    setup = set_up(point["satellite"].path, reference.path if reference else ZERO_MOTION, options, everything)
    if reference is None and not zero_motion:
        none = np.zeros(0, dtype=np.int64)
        setup = replace(setup, problem=replace(setup.problem, rows=setup.problem.rows.taken(none), source=none))
    return setup


def _within(setup: Setup, point: Mapping[str, Any]) -> Setup:
    """Leave out the sources outside the limits of magnitude; if there is a limit, also those without a magnitude."""
    low, high, column = point["g_min"], point["g_max"], point["magnitude"]
    if low is None and high is None:
        return setup
    columns = setup.problem.satellite.columns
    if column not in columns:
        known = ", ".join(columns) or "none"
        raise SweepError(f"magnitude = {column!r}: the satellite has no such column of numbers; there are {known}")
    magnitude = columns[column]
    kept = (magnitude >= (-np.inf if low is None else low)) & (magnitude <= (np.inf if high is None else high))
    if not np.any(kept):
        raise SweepError(f"no source has a {column} within the limits g_min and g_max")
    return setup.only(np.flatnonzero(kept))


def _with_chosen(problem: Problem, point: Mapping[str, Any]) -> Problem:
    """Return the problem with a new position of the ``n_new`` sources that help most, chosen one after the other."""
    n_sources, number = len(problem.satellite), point["n_new"]
    if number > n_sources:
        raise SweepError(f"n_new = {number}: there are {n_sources} sources to observe")
    epoch = np.nan if point["new_epoch"] is None else point["new_epoch"]
    apparent = point["new_positions"] == "single-epoch"
    planned = with_new_rows(problem, [epoch], point["new_error"] * MAS, apparent)
    if number == n_sources:
        return planned
    blocks = tuple(name.strip() for name in point["goal"].split(",") if name.strip())
    goal = Goal(problem.unknowns, blocks, "A")
    chosen = choose(source_sums(problem), source_sums(planned), number, goal).sources
    old = len(problem.rows)
    rows = np.concatenate([np.arange(old), old + np.sort(np.array(chosen, dtype=np.int64))])
    return replace(planned, rows=planned.rows.taken(rows), source=planned.source[rows])


# ---- sums over draws, and results


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
