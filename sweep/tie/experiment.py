"""The link of two tables as an experiment: closed form and Monte Carlo from the same normal equations."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from linksweep.core.frames import MAS, Array
from linksweep.core.parameters import choice, with_beside
from linksweep.core.tie import forecast
from linksweep.core.tie.noise import Noise
from linksweep.core.tie.problem import Clip, KeptSources, Problem, Solution, clipped, parse_clip, solve, source_sums
from linksweep.core.unknowns import SpinByBin, Unknowns, parse_unknowns
from linksweep.sweep.contract import Experiment, Output, Parameter, Point, SweepError, small_sample_factor
from linksweep.sweep.tables.columns import TableFile
from linksweep.sweep.tables.options import declared, parameter
from linksweep.sweep.tie import setup
from linksweep.sweep.tie.link import FIELDS, Link, solve_link, spectrum
from linksweep.sweep.tie.options import POSITIONS, STUDY, TABLE, ForecastOptions, Options, listed

# ---- what a study sets, and its results: degree 1 by component, harmonics by degree, spins by bin

_STORED = parse_unknowns("orientation,spin,position_glide,glide,parallax")
# The unknowns of degree 1 and the zero point of parallaxes.
COMPONENTS = _STORED.labels

UNITS = _STORED.units
ORIENTATION, SPIN = slice(0, 3), slice(3, 6)

FIELD_UNITS = tuple("mas2/yr2" if field.startswith("motion") else "mas2" for field in FIELDS)
HIGHEST_STORED = 10
MOST_BINS = 10
POWER_SHAPE, BIN_SHAPE = (len(FIELDS), HIGHEST_STORED), (MOST_BINS, 3)


# Results have the sign of the command's default, and the rows without a reference determine nothing.
OF_TABLES = tuple(parameter(one) for one in declared(STUDY, Options))
PARAMETERS = (
    Parameter("satellite", "file", None, "table of the satellite; required"),
    Parameter("reference", "file", None, "table of the reference; without one the rows are those of n_new"),
    Parameter("zero_motion", "bool", False, "sources are quasars, which do not move; no table of the reference"),
    *(replace(one, default="orientation,spin") if one.name == "unknowns" else one for one in OF_TABLES),
    Parameter("known_spin_table", "file", None, "a spin by magnitude that is subtracted, instead of known_spin"),
    Parameter("correlations", "bool", True, "whether the errors have the correlations of the tables"),
    Parameter("g_max", "float", None, "faintest phot_g_mean_mag; default no limit", "mag"),
    *(parameter(one) for one in declared(STUDY, ForecastOptions)),
    Parameter("n_new", "int", 0, "sources with one new position, those that help most", minimum=0),
    replace(setup.DECLARED["epoch"], name="new_epoch", meaning="of new positions; default that of the source"),
    Parameter("new_error", "float", 0.1, "of each coordinate of a new position", "mas", above=0.0),
    choice("new_positions", POSITIONS, POSITIONS[0], "of new rows: displaced by the parallax, or mean ones"),
    choice("candidates", ("matched", "all"), "matched", "for new positions: sources with rows, or all the satellite's"),
    choice("truth", ("estimate", "zero"), "estimate", "of the draws: the solution of the tables, or zero"),
    Parameter("error_factor", "float", 1.0, "errors of the draws over those of the tables", above=0.0),
    Parameter("outliers", "float", 0.0, "fraction of sources of a draw with larger errors", minimum=0.0, maximum=1.0),
    Parameter("outlier_factor", "float", 10.0, "how much larger they are", minimum=1.0),
)

_UNITS, _SQUARES = ", ".join(UNITS), ", ".join(FIELD_UNITS)
_EACH, _RATIO = ("component",), ("unknown",)  # units differ along the first only
_POWER, _CHANCE = ("field", "power_degree"), ("field_tested", "power_degree")
_BIN = ("bin", "axis")
_DRAWN = {"mc_error": "its Monte-Carlo error"}
_PREDICTED = _DRAWN | {"predicted": "closed form without a clip"}


def _fixed(name: str, unit: str, meaning: str, dims: tuple[str, ...] = (), *errors: str) -> Output:
    """Declare a result of the tables as they are; one with ``errors`` is a headline."""
    return Output(name, unit, meaning, dims, headline=bool(errors), nan=True, errors=errors)


_RMS, _WITHIN, _AS_IS = "RMS of estimate - truth of the draws", "error of the truth", "of the tables as they are"
# Outputs that no draw changes.
OF_TABLES_ALONE = (
    Output("n_sources", "", "matched sources of the tables, not fainter than g_max"),
    _fixed("n_kept", "", f"sources that the clip keeps, {_AS_IS}"),
    _fixed(
        *("estimate", _UNITS, "solution of the tables as they are, reference - satellite", _EACH),
        *("error_scaled", "error_jackknife", "error_formal"),
    ),
    _fixed("error_formal", _UNITS, "its formal error, with that of an estimated jitter", _EACH),
    _fixed("error_scaled", _UNITS, "its formal error times sqrt(chi2/dof)", _EACH),
    _fixed("error_jackknife", _UNITS, "its error from the solutions without each source", _EACH),
    Output("chi2_ratio", "", "chi2 of the tables over its average, 1 if errors are right", (), True, nan=True),
    _fixed("largest_share", "", "largest share of one source in the weight of a block of unknowns"),
    _fixed("power", _SQUARES, f"of harmonics of degree 1 to {HIGHEST_STORED}, {_AS_IS}", _POWER),
    _fixed("power_noise", _SQUARES, "mean power for noise alone, from the formal errors", _POWER),
    _fixed("power_probability", "", "probability that noise gives as significant a power", _CHANCE),
    _fixed("spin_by_bin", "mas/yr", f"spin in each bin, {_AS_IS}", _BIN, "spin_by_bin_error"),
    _fixed("spin_by_bin_error", "mas/yr", "its scaled error", _BIN),
    Output("n_drawn", "", "sources that are simulated"),
)
OUTPUTS = (
    *OF_TABLES_ALONE,
    *with_beside(_PREDICTED, "sigma", _UNITS, _RMS, _EACH),
    *with_beside(_DRAWN, "bias", _UNITS, "mean of estimate - truth of the draws", _EACH),
    *with_beside(_DRAWN, "coverage", "", f"fraction of draws within their formal {_WITHIN}", _RATIO),
    *with_beside(_DRAWN, "coverage_scaled", "", f"fraction of draws within their scaled {_WITHIN}", _RATIO),
    *with_beside(
        *(_PREDICTED, "sigma_orientation", "mas", "RMS error of the orientation, over draws and axes"),
        headline=True,
        symbol=r"$\sigma_\epsilon$",
    ),
    *with_beside(
        *(_PREDICTED, "sigma_spin", "mas/yr", "RMS error of the spin, over draws and axes"),
        headline=True,
        symbol=r"$\sigma_\omega$",
    ),
    *with_beside(_PREDICTED, "power_drawn", _SQUARES, "mean power of estimate - truth of the draws", _POWER),
    *with_beside(_PREDICTED, "sigma_by_bin", "mas/yr", _RMS, _BIN),
    Output("n_kept_drawn", "", "mean number of these that the clip keeps"),
    *with_beside(_DRAWN, "chi2_ratio_drawn", "", "mean of chi2 over its average, of the draws"),
)

SAMPLE_OUTPUTS = (Output("drawn", "", "estimate of a draw, reference - satellite", _EACH, nan=True),)


KINDS = ("formal", "scaled", "jackknife")
COORDINATES: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("component", "unknown"), COMPONENTS),
    **dict.fromkeys(("field", "field_tested"), FIELDS),
    "power_degree": tuple(str(degree) for degree in range(1, HIGHEST_STORED + 1)),
    "bin": tuple(str(number) for number in range(1, MOST_BINS + 1)),
    "axis": ("x", "y", "z"),
}
# Their sums are these outputs times the number of draws.
FIXED = {one.name: tuple(len(COORDINATES[dim]) for dim in one.dims) for one in OF_TABLES_ALONE}

# Outputs that are means over draws of numbers, none of them negative, or (sigma) roots of such means.
MEANS: Mapping[str, tuple[int, ...]] = {
    **{"sigma": (len(COMPONENTS),), "sigma_orientation": (), "sigma_spin": (), "sigma_by_bin": BIN_SHAPE},
    **{"power_drawn": POWER_SHAPE, "chi2_ratio_drawn": ()},
}
SUMS: Mapping[str, tuple[int, ...]] = {
    **FIXED,
    **MEANS,
    **{f"{name}_squares": shape for name, shape in MEANS.items()},
    **dict.fromkeys(("predicted_variance", "bias", "coverage", "coverage_scaled"), (len(COMPONENTS),)),
    **{"power_drawn_predicted": POWER_SHAPE, "bins_variance": BIN_SHAPE, "n_kept_drawn": ()},
}


def components(values: Array, labels: Sequence[str]) -> Array:
    """Return values (..., K) at the places of their labels among `COMPONENTS`, NaN elsewhere."""
    placed = np.full((*values.shape[:-1], len(COMPONENTS)), np.nan)
    for i, label in enumerate(labels):
        if label in COMPONENTS:
            placed[..., COMPONENTS.index(label)] = values[..., i]
    return placed


def powers(unknowns: Unknowns, estimate: Array, covariance: Array) -> Array:
    """Return the power of each field and degree of an estimate in rad, its mean for noise alone, and the
    probability that noise is as significant; shape (3, fields, degrees), in mas2 and mas2/yr2, NaN if not solved for.
    """
    made = spectrum(unknowns, estimate / MAS, covariance / MAS**2)[[0, 1, 3], :, :HIGHEST_STORED]
    return np.pad(made, ((0, 0), (0, 0), (0, HIGHEST_STORED - made.shape[2])), constant_values=np.nan)


def by_bins(unknowns: Unknowns, values: Array) -> Array:
    """Return values (..., K) of the spin in each bin; shape (..., bins, 3), NaN without bins and beyond the last."""
    stored = np.full((*values.shape[:-1], *BIN_SHAPE), np.nan)
    for block in unknowns.blocks:
        if isinstance(block, SpinByBin):
            if max(block.used) >= MOST_BINS:
                raise ValueError(f"bins: results hold {MOST_BINS} bins at most, the edges make {len(block.edges) + 1}")
            spins = values[..., unknowns.part(block.name)]
            stored[..., list(block.used), :] = spins.reshape(*values.shape[:-1], len(block.used), 3)
    return stored


# ---- what a point stands for: tables as they are, their solution, and the tables to simulate

# Parameters that do not decide which rows belong to which sources.
LATER = (
    *("clip", "correlations", "g_max", "release", "from_release", "n_new", "new_epoch", "goal"),
    *("new_error", "new_positions", "accept_misfit", "truth", "error_factor", "outliers", "outlier_factor"),
)
DECIDING = tuple(parameter.name for parameter in PARAMETERS if parameter.name not in LATER)


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
    clip, asked = parse_clip(point["clip"]), Options(clip=point["clip"], errors="scaled,formal,jackknife")
    whole = _within(_set_up(tuple((name, point[name]) for name in DECIDING)), point)
    problem = whole.problem
    if not point["correlations"]:
        ours, rows = (replace(one, correlations=None) for one in (problem.satellite, problem.rows))
        problem = replace(problem, satellite=ours, rows=rows)
        whole = replace(whole, problem=problem)
    matched = np.unique(problem.source)
    solved = solve_link(whole.only(matched), asked) if len(matched) else None
    notes = [] if solved is None else [*solved.notes]
    problem, _, further = forecast.released(problem, point["release"], point["from_release"], point["epoch"] is None)
    notes += further
    problem = _with_chosen(whole, problem, None if solved is None else solved.noise, point)
    if not len(problem.rows):
        raise SweepError("no rows: give a reference, or zero_motion = true, or n_new above 0")
    return Design(clip, solved, len(matched), problem.only(np.unique(problem.source)), tuple(notes))


@lru_cache(maxsize=4)
def _set_up(values: tuple[tuple[str, Any], ...]) -> setup.Setup:
    """Return the tables as they are; points that differ in nothing of `DECIDING` share them."""
    point = dict(values)
    reference, zero_motion = point["reference"], point["zero_motion"]
    if point["satellite"] is None:
        raise SweepError("satellite is required: the table of the satellite")
    if reference is not None and zero_motion:
        raise SweepError("zero_motion = true is for quasars without a table, and there is a reference")
    chosen = {one.name: _plain(point[one.name]) for one in OF_TABLES if one.name in point}
    if point["known_spin_table"] is not None:
        chosen["known_spin"] = _plain(point["known_spin_table"])
    options = Options(**chosen)
    everything = reference is None or point["candidates"] == "all"
    right = _plain(reference) if reference else setup.ZERO_MOTION
    whole = setup.set_up(_plain(point["satellite"]), right, options, everything)
    if reference is None and not zero_motion:
        none = np.zeros(0, dtype=np.int64)
        whole = replace(whole, problem=replace(whole.problem, rows=whole.problem.rows.taken(none), source=none))
    return whole


def _plain(value: Any) -> Any:
    """Return a value of a study with paths in place of its files; raises SweepError for one that was changed."""
    if isinstance(value, tuple):
        return tuple(_plain(part) for part in value)
    return value.unchanged() if isinstance(value, TableFile) else value


def _within(whole: setup.Setup, point: Mapping[str, Any]) -> setup.Setup:
    """Leave out the sources that are fainter than a limit, and with it those without a magnitude."""
    if point["g_max"] is None:
        return whole
    columns = whole.problem.satellite.columns
    if setup.MAGNITUDE not in columns:
        raise SweepError(f"g_max: the satellite has no column of numbers {setup.MAGNITUDE}")
    kept = columns[setup.MAGNITUDE] <= point["g_max"]
    if not np.any(kept):
        raise SweepError(f"g_max = {point['g_max']:g}: no source is that bright")
    return whole.only(np.flatnonzero(kept))


def _with_chosen(whole: setup.Setup, problem: Problem, noise: Noise | None, point: Mapping[str, Any]) -> Problem:
    """Return the problem with a new position of the ``n_new`` sources that help most, chosen one after the other, and
    with noise in the errors of all rows and sources.
    """
    n_sources, number, old = len(problem.satellite), point["n_new"], len(problem.rows)
    if number > n_sources:
        raise SweepError(f"n_new = {number}: there are {n_sources} sources to observe")
    if number:
        problem = whole.with_new_rows(problem, [point["new_epoch"]], point["new_error"], point["new_positions"])
    if noise is not None:
        problem = noise.added_to(problem, whole.jitter)
    if number in (0, n_sources):
        return problem
    now = replace(problem, rows=problem.rows.taken(slice(old)), source=problem.source[:old])
    goal = forecast.Goal(problem.unknowns, tuple(listed(point["goal"])), "A")
    chosen, _ = forecast.choose(source_sums(now), source_sums(problem), number, goal)
    rows = np.concatenate([np.arange(old), old + np.sort(np.array(chosen, dtype=np.int64))])
    return replace(problem, rows=problem.rows.taken(rows), source=problem.source[rows])


# ---- sums over draws, and results


def samples(
    points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
) -> dict[str, Array]:
    """Return what `evaluate` returns and the estimates, shape (points, n_sim, components)."""
    rows = [_simulated(point, n_sim, rng) for point in points]
    return {name: np.array([row[name] for row in rows]) for name in (*SUMS, "drawn")}


def evaluate(
    points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
) -> dict[str, Array]:
    """Return the sums of `SUMS` over ``n_sim`` draws of the errors of each point's tables."""
    return {name: sums for name, sums in samples(points, n_sim, rng, catalogue_rng).items() if name in SUMS}


def _simulated(point: Point, n_sim: int, rng: np.random.Generator) -> dict[str, Array]:
    """Return the sums of one point, and its estimates in mas and mas/yr, (n_sim, components)."""
    design = design_of(point)
    unknowns, labels = design.problem.unknowns, design.problem.unknowns.labels
    truth = design.truth if point["truth"] == "estimate" else np.zeros_like(design.truth)
    factors = point["error_factor"], point["outliers"], point["outlier_factor"]
    simulation = forecast.Simulation(design.problem, truth, *factors)
    solution = solve(simulation.normals, labels)
    variance = np.diag(solution.covariance) / MAS**2
    drawn = [_solved(draw, design.clip, truth, solution) for draw in simulation.draws(n_sim, rng)]
    error, formal, ratio, kept = (np.array(part) for part in zip(*drawn, strict=True))
    power = np.array([powers(unknowns, one * MAS, solution.covariance)[0] for one in error])
    in_bins, error, formal = by_bins(unknowns, error), components(error, labels), components(formal, labels)
    means = {
        "sigma": error**2,
        "sigma_orientation": np.mean(error[:, ORIENTATION] ** 2, axis=1),
        "sigma_spin": np.mean(error[:, SPIN] ** 2, axis=1),
        "sigma_by_bin": in_bins**2,
        "power_drawn": power,
        "chi2_ratio_drawn": ratio,
    }
    fixed = _as_they_are(design) | {
        "predicted_variance": components(variance, labels),
        "power_drawn_predicted": powers(unknowns, solution.estimate, solution.covariance)[1],
        "bins_variance": by_bins(unknowns, variance),
    }
    sums = {name: n_sim * values for name, values in fixed.items()}
    totals = means | {"bias": error, "n_kept_drawn": kept}
    sums |= {name: np.asarray(values.sum(axis=0)) for name, values in totals.items()}
    sums |= {f"{name}_squares": np.asarray(np.sum(values**2, axis=0)) for name, values in means.items()}
    for name, size in (("coverage", formal), ("coverage_scaled", formal * np.sqrt(ratio)[:, None])):
        sums[name] = np.where(np.isnan(error) | np.isnan(size), np.nan, np.abs(error) <= size).sum(axis=0)
    return sums | {"drawn": error + components(truth / MAS, labels)}


def _solved(draw: KeptSources, clip: Clip, truth: Array, solution: Solution) -> tuple[Array, Array, float, float]:
    """Return the error of the estimate and its formal error (mas, mas/yr), chi2 over its average, and sources kept."""
    if clip.kind == "none":
        right, one = draw.sums.right.sum(axis=0), solution  # its matrices are the same for every draw
        estimate, expected, kept = one.inverse @ right, one.expected, len(draw.sums)
        squares = max(0.0, float(draw.sums.squares.sum() - right @ estimate))
    else:
        result = clipped(clip, draw)
        one, kept = result.solution, int(np.sum(result.factors > 0.0))
        estimate, expected, squares = one.estimate, one.expected, one.squares
    ratio = squares / expected if one.dof > 0 and expected > 0.0 else np.nan
    return (estimate - truth) / MAS, np.sqrt(np.diag(one.covariance)) / MAS, ratio, kept


def _as_they_are(design: Design) -> dict[str, Any]:
    """Return what no draw changes: the solution of the tables as they are, in mas and mas/yr."""
    unknowns, link = design.problem.unknowns, design.solved
    fixed: dict[str, Any] = {name: np.full(shape, np.nan) for name, shape in FIXED.items()}
    fixed |= {"n_sources": design.matched, "n_drawn": len(design.problem.satellite)}
    if link is None:
        return fixed
    estimate = link.solution.estimate / MAS
    errors = {kind: np.sqrt(np.diag(link.covariances[kind])) / MAS for kind in KINDS}
    if link.noise is not None:
        errors["formal"] = np.sqrt(np.diag(link.covariances["estimated"])) / MAS
    power = powers(unknowns, link.solution.estimate, link.solution.covariance)
    return fixed | {
        "n_kept": np.sum((link.clipped.factors > 0.0) & (link.count > 0)),
        "chi2_ratio": link.solution.scale**2,
        "largest_share": np.nan if link.influence is None else link.influence.share.max(),
        "estimate": components(estimate, unknowns.labels),
        **{f"error_{kind}": components(error, unknowns.labels) for kind, error in errors.items()},
        **dict(zip(("power", "power_noise", "power_probability"), power, strict=True)),
        "spin_by_bin": by_bins(unknowns, estimate),
        "spin_by_bin_error": by_bins(unknowns, errors["scaled"]),
    }


def summarise(sums: Mapping[str, Array], n: Array, n_cat: Array) -> dict[str, Array]:
    """Return every output from the sums over n draws."""
    each = {name: n.reshape(-1, *[1] * (total.ndim - 1)) for name, total in sums.items()}
    mean = {name: total / each[name] for name, total in sums.items()}
    results = {name: mean[name] for name in (*FIXED, "n_kept_drawn", "power_drawn_predicted", "bias")}
    for name in ("n_sources", "n_kept", "n_drawn"):
        results[name] = np.round(results[name])  # a whole number times n, over n
    with np.errstate(invalid="ignore", divide="ignore"):
        scatter = np.maximum(mean["sigma"] - mean["bias"] ** 2, 0.0) / (each["bias"] - 1.0)
        results["bias_mc_error"] = np.sqrt(small_sample_factor(each["bias"]) * scatter)
        for name in MEANS:
            power = 0.5 if name.startswith("sigma") else 1.0
            square = np.maximum(mean[f"{name}_squares"] / mean[name] ** 2 - 1.0, 0.0) / (each[name] - 1.0)
            # by simulation, so that draws without the rare large numbers of a skewed law do not look too precise
            square = small_sample_factor(each[name]) * square * np.exp(np.minimum(8.0 * square, 3.0))
            results[name] = value = mean[name] ** power
            results[f"{name}_mc_error"] = power * value * np.where(value == 0.0, 0.0, np.sqrt(square))
    variance = mean["predicted_variance"]
    orientation, spin = (variance[:, part].mean(axis=1) for part in (ORIENTATION, SPIN))
    predicted = {"sigma": variance, "sigma_orientation": orientation, "sigma_spin": spin}
    predicted["sigma_by_bin"] = mean["bins_variance"]
    results |= {f"{name}_predicted": np.sqrt(values) for name, values in predicted.items()}
    for name in ("coverage", "coverage_scaled"):
        between = (sums[name] + 2.0) / (each[name] + 4.0)  # never 0 or 1, where the error would be 0
        results[name], results[f"{name}_mc_error"] = mean[name], np.sqrt(between * (1.0 - between) / each[name])
    return results


def check(point: Point) -> str | None:
    """Return why a point cannot be computed: its tables, its unknowns, its clip."""
    try:
        design = design_of(point)
        if design.solved is not None and design.solved.misfit.absurd and not point["accept_misfit"]:
            return f"{design.solved.misfit.text}; accept_misfit = true computes it all the same"
        solve(forecast.Simulation(design.problem, design.truth).normals, design.problem.unknowns.labels)
        by_bins(design.problem.unknowns, np.ones(len(design.problem.unknowns)))  # raises for too many bins
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
    reference = point["reference"] is not None
    at_rest = point["zero_motion"] or "reference" in listed(point["extragalactic"])
    needs = (
        (reference, "there is no reference", "reference_.*|positions|by|aberration"),
        (reference or point["zero_motion"], "there are no rows of a reference", "known_.*|truth|accept_misfit"),
        (point["release"] != TABLE, "it is for a release", "from_release"),
        (not at_rest, "positions of quasars hold at any epoch", "new_epoch|new_positions"),
        (point["n_new"] > 0, "it is for n_new above 0", "new_.*|goal|candidates"),
        (point["outliers"] > 0.0, "it is for outliers above 0", "outlier_factor"),
    )
    without = [(why, names) for used, why, names in needs if not used]
    return {one.name: why for why, names in without for one in PARAMETERS if re.fullmatch(names, one.name)}


def cost(point: Point) -> float:
    """Return how many normal deviates a draw takes."""
    problem = design_of(point).problem
    return 5.0 * (len(problem.satellite) + len(problem.rows))


tie = Experiment(
    name="tie",
    version=3,
    parameters=PARAMETERS,
    sums=SUMS,
    outputs=OUTPUTS,
    coordinates=COORDINATES,
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
    nan_sums=tuple(name for name in SUMS if name != "n_kept_drawn"),
)
