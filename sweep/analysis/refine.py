"""Refinement of a study along an axis, round by round: which points, and which realisations, matter next.

A round is chosen by the results alone, so that it is the same on any workers, and recorded in the store before it runs:
the same call after an interruption goes on with it.
"""

import json
import math
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import islice, pairwise
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from linksweep.sweep.analysis import laws, quantity
from linksweep.sweep.contract import Status, SweepError, Value, is_number, suggest
from linksweep.sweep.formatting import counted
from linksweep.sweep.planning.grid import NO_EFFECT, Grid, make_grid
from linksweep.sweep.planning.union import REFINED, Round, point_at, refined, rounds_of
from linksweep.sweep.running.run import find_store, open_store, with_stored
from linksweep.sweep.stores.location import Where, locked
from linksweep.sweep.stores.store import OpenStore
from linksweep.sweep.studies.points import NEAR
from linksweep.sweep.studies.study import Study

SHARE = 0.2  # of the realisations of the full grid: where so many are spent points get no more, unless the user says so
LARGEST_FACTOR = 16  # a point gets at most so many times its realisations in a round: its error is an estimate, too
FINEST = 1e-3  # the share of an axis of equal steps, or of its shortest ones, below which `until` cuts no interval
ROUNDING = 1.0 + 1e-9
OFF_CENTRE = 0.2  # a midpoint may be off by this share of the way to it, so that it has few digits


# What is to be known: where ``find``, a condition, begins or ceases to be met, to ``within`` in the unit of the axis
# ``along``; or, ``until`` its error is small enough, the ``variable`` between points.  There may be ``most``
# realisations in the end.  What is not said is None.
Goal = Mapping[str, Any]


def read(goal: Goal, study: Study) -> tuple[laws.Limit, str]:
    """Return the condition of a goal and the axis; raises SweepError for a goal that is none for the study."""
    find, until, within, along = (goal[name] for name in ("find", "until", "within", "along"))
    if (find is None) == (until is None):
        raise SweepError("name one of find (--find), a condition, and until (--until), like 'error < 0.002'")
    limit, outputs = laws.parse_limit(find or until), [output.name for output in study.experiment.outputs]
    variable, is_known = limit.variable if find else goal["variable"], not study.experiment.undeclared
    axes = [name for name in study.axes if study.dimensions.get(name) == (name,)]
    numeric = [name for name in axes if len(study.axes[name]) > 1 and all(map(is_number, study.axes[name]))]
    over = along or (numeric[0] if len(numeric) == 1 else "")
    which = f"along = {along}: axes of several numbers are" if along else "name the axis with along (--along):"
    wrong = {
        "name within (--within): find needs a number above 0, in the unit of the axis": find and within is None,
        f"within = {within}: must be above 0 in the unit of the axis": within is not None and not 0 < within < math.inf,
        f"variable = {goal['variable']}: does not go with find": find and goal["variable"] is not None,
        f"{until}: write 'error < 0.002'": until and (limit.variable + limit.sign != "error<" or limit.number <= 0),
        f"{which} {', '.join(numeric) or 'not there'}": over not in numeric,
        f"no output {variable}{suggest(str(variable), outputs)}": is_known and variable not in (None, *outputs),
    }
    if sentences := [sentence for sentence, is_so in wrong.items() if is_so]:
        raise SweepError(sentences)
    return limit, over


@dataclass(frozen=True)
class Refinement:
    """Where a refinement is: results of a study with the ``rounds`` so far, and the ``upcoming`` one, None at the end.

    ``known`` says how well the answer is known, by the place of each line.  Of realisations, or of points where there
    are none, so many are ``spent``; the ``full`` grid at the wanted spacing has so many.
    """

    goal: Goal
    dataset: xr.Dataset
    along: str
    rounds: Sequence[Round]
    upcoming: Round | None
    known: dict[str, float]
    spent: int
    full: int

    def crossings(self) -> xr.Dataset:
        """Return where the condition of ``find`` changes, along lines of the points that are done and not NaN."""
        status, variable = self.dataset["status"], laws.parse_limit(self.goal["find"]).variable
        is_used = (status == Status.DONE) & np.isfinite(quantity.numbers(self.dataset, variable))
        used = status.where(is_used | ~is_used.any(), int(Status.EXCLUDED))
        return laws.find(self.dataset.assign(status=used), self.goal["find"], self.along)

    def sentences(self) -> list[str]:
        """Return in words what was reached, and what it took."""
        wanted = laws.parse_limit(self.goal["until"]).number if self.goal["until"] else self.goal["within"]
        what = "realisation" if "n_sim_done" in self.dataset else "point"
        took = f"{counted(len(self.rounds), 'round')}, {counted(self.spent, what)}"
        said = [f"{took}: {100.0 * self.spent / self.full:.3g} % of the {self.full:,} of a full grid that is as fine."]
        most = " (--max-realisations allows more)" if what == "realisation" else ""
        for at, known in self.known.items():
            is_whole = self.dataset[self.along].dtype.kind == "i" and (not most or known <= 1.0)
            why = " (the axis has whole numbers; written as 0.0 they are floats)" if is_whole else most
            enough, is_enough = wanted * ROUNDING, known <= wanted * ROUNDING
            text = next(t for digits in range(2, 18) if (float(t := f"{known:.{digits}g}") <= enough) == is_enough)
            few = f"Not known{at}: there are too few points, or errors are not known{why}."
            if self.goal["find"]:
                few = f"Not decided{at}: values are within {laws.SURE:g} errors of the limit, or errors not known{why}."
            yet = "" if is_enough else f", not yet to {wanted:g}{why}"
            said.append(f"Known{at} to {text}{yet}." if known < math.inf else few)
        if quantity.shares_random_numbers(self.dataset, [self.along]):
            said.append("Besides there is the Monte-Carlo error, which points with common random numbers share.")
        return said


# How well something is known; the first points of intervals that need a point; factors of realisations of points.
Lack = tuple[float, Sequence[int], Mapping[int, float]]


def at_crossings(line: laws.Line, met: NDArray[np.bool_], level: float, within: float) -> Iterator[Lack]:
    """Yield what a line lacks at each place where a condition changes.

    Where both sides are decided, the place is somewhere in between.  A point that is not decided is next to the place:
    as near as its error over the least slope says, to the next points that surely differ from it.  Where the condition
    does not change beside such points, it is not known whether it does: these come after those where it changes.
    """
    x, y, errors = line.x, line.y, line.errors
    decided, are_known = line.decided(level), True
    for i in np.flatnonzero(met[1:] != met[:-1]).tolist():
        near = list[tuple[float, int]]()
        for end in (end for end in (i, i + 1) if not decided[end]):
            apart = abs(y - y[end]) > laws.SURE * np.hypot(errors, errors[end])
            beside = [*np.flatnonzero(apart[:end])[-1:], *(end + 1 + np.flatnonzero(apart[end + 1 :])[:1])]
            slope = min((abs((y[j] - y[end]) / (x[j] - x[end])) for j in beside), default=0.0)
            near.append((2.0 * errors[end] / slope if slope > 0.0 else x[-1] - x[0], end))
        known, end = min(near, default=(float(x[i + 1] - x[i]), i))
        is_enough = known <= within
        are_known &= is_enough or not near
        yield known, [] if near or is_enough else [i], {end: (known / within) ** 2} if near and not is_enough else {}
    for some in (some for some, changes in line.undecided(level, met) if not changes):
        sigmas = np.maximum(abs(y[some] - level) / errors[some], 1e-3)
        factors = zip(some.tolist(), ((laws.SURE / sigmas) ** 2).tolist(), strict=True)
        yield math.inf, [], dict(factors) if are_known else {}


Pairs = Container[tuple[float, float]]


def between_points(line: laws.Line, level: float, within: float, unit: str, uncut: Pairs) -> Iterator[Lack]:
    """Yield what a line lacks so that each point can be interpolated from its neighbours to a level; of intervals that
    are ``uncut`` nothing is known, as a curve may be on a line at the points of the first grid by chance.
    """
    x, y, z = line.x, line.y, laws.on_scale(line.x, unit)
    aparts = np.zeros(len(x))
    for i in range(1, len(x) - 1):
        three, is_log = slice(i - 1, i + 2), bool(np.all(y[i - 1 : i + 2] > 0.0))
        u, right = np.log(y[three]) if is_log else y[three], (z[i] - z[i - 1]) / (z[i + 1] - z[i - 1])
        value = (1.0 - right) * u[0] + right * u[2]
        aparts[i] = apart = float(abs(y[i] - (np.exp(value) if is_log else value)))
        noise = 2.0 * float(np.linalg.norm(line.errors[three] * np.array([1.0 - right, 1.0, right])))
        wide = [k for k in (i - 1, i) if x[k + 1] - x[k] > within] if apart > max(level, noise) else []
        is_noisy = noise > level and not apart > noise
        yield max(apart, noise), wide, dict.fromkeys((i - 1, i, i + 1), (noise / level) ** 2) if is_noisy else {}
    some = [k for k in range(len(x) - 1) if len(x) == 2 or (x[k], x[k + 1]) in uncut]
    yield from ((math.inf, [k], {}) for k in sorted(some, key=lambda k: -aparts[k : k + 2].max()))


def refinements(study: Study, store: Where, goal: Goal, run: Callable[[Study], xr.Dataset]) -> Iterator[Refinement]:
    """Yield where a refinement is after each round; the next one runs, by ``run``, when the next is asked for.

    Raises SweepError for a goal that does not suit the study or its results, and whatever ``run`` raises.
    """
    read(goal, study)
    rounds = rounds_of(opened.attributes if (opened := find_store(store, study)) else {})
    while True:
        now = refined(study, rounds)
        state = looked_at(study, now, rounds, goal, run(now))
        yield state
        if state.upcoming is None:
            return
        rounds = [*rounds, state.upcoming]
        make_grid(grown := refined(study, rounds))  # what is wrong with a new point is said before it is recorded
        with locked(store):
            there = open_store(OpenStore(store), now, writes=True)
            with_stored(there, grown)
            there.record({REFINED: json.dumps([*map(asdict, rounds)])})


def looked_at(asked: Study, now: Study, rounds: Sequence[Round], goal: Goal, dataset: xr.Dataset) -> Refinement:
    """Return what the results of a study say that has grown by some rounds, and which round is to be next."""
    (limit, over), is_find, most = read(goal, asked), goal["find"] is not None, goal["most"]
    variable = limit.variable if is_find else goal["variable"] or quantity.main_quantity(dataset)
    quantity.require_quantity(dataset, variable)
    axis = sorted(asked.axes[over])
    finest = goal["within"] or FINEST * (len(axis) - 1) * float(np.diff(axis).min())
    nearest = 1.0 if dataset[over].dtype.kind == "i" else NEAR * max(map(abs, axis))  # that values of the axis can be
    least = max(finest * ROUNDING, nearest)
    uncut = {pair for pair in pairwise(axis) if pair[1] - pair[0] > least}
    made, common = laws.lines_of(dataset, variable, over), quantity.shares_random_numbers(dataset, [over])
    levels, known = made.thresholds(limit), dict[str, float]()
    gaps, factors = list[tuple[float, laws.Line, int]](), list[tuple[laws.Line, int, float]]()
    unknown = 0.0 if common or quantity.standard_error(dataset, variable) is None else np.inf
    if unknown and f"{variable}_mc_error" not in dataset:
        raise SweepError(f"{variable} has no Monte-Carlo error, without which a place in it is not known")
    for whole in made.lines:
        good = np.flatnonzero((whole.status == Status.DONE) & np.isfinite(whole.y) & np.isfinite(whole.x))
        # Points with common random numbers have most of their errors in common, too.
        errors = np.zeros(len(good)) if common else np.nan_to_num(whole.errors[good], nan=unknown)
        line = replace(whole, x=whole.x[good], y=whole.y[good], errors=errors)
        level, within = levels[line.unit], finest * ROUNDING
        at = at_crossings(line, limit.is_met(line.y, level), level, within)
        lacks = list(at if is_find else between_points(line, level, within, made.over_unit, uncut))
        known |= {made.at(line): max(known for known, *_ in lacks)} if lacks else {}
        gaps += [(known, line, i) for known, some, _ in lacks for i in some]
        factors += [(line, i, factor) for *_, some in lacks for i, factor in some.items()]
    status, numbers = dataset["status"], asked.numbers()
    spent = int(dataset["n_sim_done"].sum() if numbers else (status == Status.DONE).sum())
    spacing = max(finest if is_find else float(np.diff(sorted(now.axes[over])).min()), nearest)
    there, each = [line.x for line in made.lines if line.x.size], math.prod(numbers.values())
    of_lines = sum(max(math.floor(np.ptp(x) / spacing * ROUNDING) + 1, int(np.isin(x, axis).sum())) for x in there)
    components = len(made.lines) * dataset[over].size // status.size  # whose lines are of the same points
    full = of_lines // components * each
    gaps.sort(key=lambda gap: -gap[0])  # what is known least comes first, as there may not be points for all
    affordable = None if most is None else max(0, most - spent) // each
    points = dict(islice(_midpoints(asked, now, over, [gap[1:] for gap in gaps]).items(), affordable))
    left = (int(SHARE * full) if most is None else most) - spent - len(points) * each
    are_alike = now.sampling.precision or now.sampling.keep_samples or now.sampling.common_random_numbers
    n_sim = {} if are_alike else _realisations(now, over, factors, left)
    words = f"{limit} along {over}, within {finest:g}" if is_find else f"{limit} of {variable} along {over}"
    upcoming = Round(words, over, list(points.values()), n_sim) if points or n_sim else None
    return Refinement(goal, dataset, over, rounds, upcoming, known, spent, full)


def _midpoints(asked: Study, now: Study, over: str, gaps: Sequence[tuple[laws.Line, int]]) -> dict[bytes, Any]:
    """Return the points of a round, by their values on all axes; without those that are there, failed ones too, and
    those that the study excludes or its experiment does not allow.
    """
    grid, there, points = Grid(asked), Grid(now), dict[bytes, dict[str, Any]]()
    parameters, tried = {name: now.experiment.parameter(name) for name in now.axes}, {*there.digests(there.indices())}
    for line, i in gaps:
        with suppress(ValueError):
            middle = parameters[over].parse(_middle(asked.axes[over], *line.x[i : i + 2]))
            values = _place(there, line, over) | {over: middle}
            point = point_at(now, values)
            if point.digest not in tried and not grid.excludes(point.parameters):
                points[point.digest] = {name: parameters[name].written(value) for name, value in values.items()}
    return points


def _realisations(now: Study, over: str, factors: Sequence[tuple[laws.Line, int, float]], left: int) -> dict[str, int]:
    """Return the larger n_sim of points, by their digests: doubled as often as needed, with half of what is left."""
    grid, larger, share = Grid(now), dict[str, int](), left // 2 // max(len(factors), 1) // now.sampling.n_cat
    for line, i, factor in factors:
        value = next(value for value in now.axes[over] if value == line.x[i])
        name = point_at(now, _place(grid, line, over) | {over: value}).digest.hex()
        n = now.counts.get(name, now.sampling.n_sim)
        doublings = min(math.ceil(math.log2(min(factor, LARGEST_FACTOR))), int(math.log2(max(1.0 + share / n, 1.0))))
        larger |= {name: max(larger.get(name, 0), n << doublings)} if doublings > 0 else {}
    return larger


def _place(grid: Grid, line: laws.Line, over: str) -> dict[str, Value]:
    """Return the values of a line on the other axes."""
    rows = ((axes, grid.rows[name][line.index[name]]) for name, axes in grid.dimensions.items() if name != over)
    pairs = (pair for axes, row in rows for pair in zip(axes, row, strict=True))
    return {axis: None if value is NO_EFFECT else value for axis, value in pairs}


def _middle(values: Sequence[Any], low: float, high: float) -> float:
    """Return a number about half-way between two, of few digits, as an axis is spaced: in equal steps or ratios.

    It is the first of the two where there is none in between.
    """
    axis = sorted(values)
    is_log = len(axis) > 2 and axis[0] > 0 and np.std(np.diff(np.log(axis))) < np.std(np.diff(axis)) / np.mean(axis)
    half = math.sqrt(low * high) if is_log else low + 0.5 * (high - low)
    if all(type(value) is int for value in axis):
        return int(min(max(round(half), low + 1), high - 1)) if high - low >= 2 else int(low)
    rounded = (float(f"{half:.{digits}g}") for digits in range(1, 18))
    middle = next(x for x in rounded if abs(x - half) <= OFF_CENTRE * (half - low))
    return low if any(math.isclose(middle, end, rel_tol=NEAR) for end in (low, high)) else middle
