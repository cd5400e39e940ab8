"""Refinement of a study along an axis, round by round: which points, and which realisations, matter next.

A round is chosen by the results alone, so that it is the same on any workers, and recorded in the store before it runs:
the same call after an interruption goes on with it.
"""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from linksweep.sweep.analysis import laws, quantity
from linksweep.sweep.contract import SweepError, Value, shown, suggest
from linksweep.sweep.formatting import counted
from linksweep.sweep.planning.grid import Grid, GridPoint, make_grid
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.planning.refined import REFINED, Round, point_at, refined, rounds_of
from linksweep.sweep.running.writer import find_store, open_store
from linksweep.sweep.stores.location import Where, locked
from linksweep.sweep.studies.study import Study

SURE = 3.0  # errors by which a value must be beyond a limit for its side to be decided
SHARE = 0.2  # of the realisations of the full grid are spent at most, unless the user says otherwise
LARGEST_FACTOR = 16  # a point gets at most so many times its realisations in a round: its error is an estimate, too
FINEST = 1e-3  # the share of an axis below which `until` cuts no interval, unless the user says otherwise
ROUNDING = 1.0 + 1e-9
OFF_CENTRE = 0.1  # a midpoint may be off by this share of its interval, so that it has few digits
ERROR = "error"


@dataclass(frozen=True)
class Goal:
    """What is to be known: where ``find``, a condition, begins or ceases to be met, to ``within`` in the unit of the
    axis ``along``; or, ``until`` its error is small enough, the ``variable`` between points.  There may be ``most``
    realisations in the end.
    """

    find: str | None = None
    until: str | None = None
    within: float | None = None
    along: str | None = None
    variable: str | None = None
    most: int | None = None

    def limit(self) -> laws.Limit:
        """Return the condition; raises SweepError for a goal that says too much or too little."""
        if (self.find is None) == (self.until is None):
            raise SweepError("name one of find (--find), a condition, and until (--until), like 'error < 0.002'")
        limit = laws.parse_limit(self.find or self.until or "")
        if self.within is None and self.find is not None:
            raise SweepError("find needs within (--within): how well the place is to be known, in the unit of the axis")
        if self.within is not None and not 0.0 < self.within < math.inf:
            raise SweepError(f"within = {self.within:g}: must be a number above 0, in the unit of the axis")
        if self.most is not None and self.most < 1:
            raise SweepError(f"max_realisations = {self.most}: must be at least 1")
        if self.find is not None and self.variable not in (None, limit.variable):
            raise SweepError(f"variable = {self.variable}: find is about {limit.variable}")
        if self.until is not None and (limit.variable, limit.sign, limit.number > 0.0) != (ERROR, "<", True):
            raise SweepError(f"{shown(self.until)}: until is a limit of the error between points, 'error < 0.002'")
        return limit


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

    def sentences(self) -> list[str]:
        """Return in words what was reached, and what it took."""
        wanted = self.goal.limit().number if self.goal.find is None else self.goal.within or 0.0
        what = "realisation" if "n_sim_done" in self.dataset else "point"
        share = f"{100.0 * self.spent / self.full:.2g} % of the {self.full:,} of a full grid that is as fine"
        said = [f"{counted(len(self.rounds), 'round')}, {counted(self.spent, what)}: {share}."]
        for place, known in self.known.items():
            yet = "" if known <= wanted * ROUNDING else f", not yet to {wanted:g}"
            said.append(f"Known{place} to {known:.2g}{yet}.")
        if quantity.shares_random_numbers(self.dataset, [self.along]):
            said.append("Besides there is the Monte-Carlo error, which points with common random numbers share.")
        return said


@dataclass
class Needs:
    """What the results along an axis lack: ``gaps``, each a line and the first of two points between which one is
    needed; ``factors``, each a line, a point, and how many times its realisations it needs.
    """

    within: float
    gaps: list[tuple[laws.Line, int]] = field(default_factory=list)
    factors: list[tuple[laws.Line, int, float]] = field(default_factory=list)

    def at_crossings(self, line: laws.Line, met: NDArray[np.bool_], level: float) -> list[float]:
        """Note what a line needs where a condition changes; return how well each of these places is known.

        Where both sides are decided, the place is somewhere in between.  A point that is not decided is next to the
        place: as near as its error over the least slope says, to the next points that surely differ from it.
        """
        x, y, known = line.x, line.y, list[float]()
        decided = ~(abs(y - level) < SURE * line.errors)
        for i in np.flatnonzero(met[1:] != met[:-1]).tolist():
            near = list[tuple[float, int]]()
            for end in (end for end in (i, i + 1) if not decided[end]):
                apart = abs(y - y[end]) > SURE * np.hypot(line.errors, line.errors[end])
                beside = [*np.flatnonzero(apart[:end])[-1:], *(end + 1 + np.flatnonzero(apart[end + 1 :])[:1])]
                slope = min((abs((y[j] - y[end]) / (x[j] - x[end])) for j in beside), default=0.0)
                near.append((2.0 * line.errors[end] / slope if slope > 0.0 else math.inf, end))
            known.append(min(near)[0] if near else x[i + 1] - x[i])
            if near and known[-1] > self.within:
                self.factors.append((line, min(near)[1], (known[-1] / self.within) ** 2))
            elif known[-1] > self.within:
                self.gaps.append((line, i))
        return known

    def between_points(self, line: laws.Line, level: float, unit: str) -> list[float]:
        """Note what a line needs so that its points can be interpolated from their neighbours to a level; return how
        well they are.
        """
        x, y, known = line.x, line.y, list[float]()
        cut = {0} if len(x) == 2 else set[int]()
        for i in range(1, len(x) - 1):
            three, is_log = slice(i - 1, i + 2), bool(np.all(y[i - 1 : i + 2] > 0.0))
            z, u = laws.on_scale(x, unit)[three], np.log(y[three]) if is_log else y[three]
            right = (z[1] - z[0]) / (z[2] - z[0])
            value = (1.0 - right) * u[0] + right * u[2]
            apart = float(abs(y[i] - (np.exp(value) if is_log else value)))
            noise = 2.0 * float(np.linalg.norm(line.errors[three] * np.array([1.0 - right, 1.0, right])))
            known.append(max(apart, noise))
            if apart > max(level, noise):
                cut |= {k for k in (i - 1, i) if x[k + 1] - x[k] > self.within}
            elif noise > level:
                self.factors += [(line, k, (noise / level) ** 2) for k in (i - 1, i, i + 1)]
        self.gaps += [(line, k) for k in sorted(cut)]
        return known


def refinements(study: Study, store: Where, goal: Goal, run: Callable[[Study], xr.Dataset]) -> Iterator[Refinement]:
    """Yield where a refinement is after each round; the next one runs, by ``run``, when the next is asked for.

    Raises SweepError for a goal that does not suit the study or its results, and whatever ``run`` raises.
    """
    variable, limit = goal.variable, goal.limit()
    variable = variable if goal.find is None else limit.variable
    outputs = [] if study.experiment.undeclared else [output.name for output in study.experiment.outputs]
    for name, known in ((goal.along, list(study.axes)), (variable, outputs)):
        if name is not None and known and name not in known:
            raise SweepError(f"{shown(name)} is neither an axis nor an output here{suggest(name, known)}")
    opened = find_store(store, study)
    rounds = [] if opened is None else rounds_of(opened.attributes)
    while True:
        now = refined(study, rounds)
        state = looked_at(study, now, rounds, goal, run(now))
        yield state
        if state.upcoming is None:
            return
        rounds = [*rounds, state.upcoming]
        make_grid(refined(study, rounds))  # what is wrong with a new point is said before it is recorded
        with locked(store):
            opened = find_store(store, now)
            assert opened is not None, "the run has written it"
            open_store(opened, now).record({REFINED: json.dumps([asdict(one) for one in rounds])})


def looked_at(own: Study, now: Study, rounds: Sequence[Round], goal: Goal, dataset: xr.Dataset) -> Refinement:
    """Return what the results of a study say that has grown by some rounds, and which round is to be next."""
    limit, is_find = goal.limit(), goal.find is not None
    variable = limit.variable if is_find else goal.variable or quantity.main_quantity(dataset)
    over = quantity.require_axis(dataset, variable, goal.along)
    if now.dimensions.get(over) != (over,):
        raise SweepError(f"{over} is no axis of its own, along which there could be points in between")
    values = np.array([value for value in own.axes[over] if value is not None], dtype=float)
    finest = goal.within or FINEST * float(np.ptp(values))
    made, needs, known = laws.lines_of(dataset, variable, over), Needs(finest * ROUNDING), dict[str, float]()
    for line in made.lines:
        good = np.flatnonzero((line.status == Status.DONE) & np.isfinite(line.y) & np.isfinite(line.x))
        # Points with common random numbers have most of their errors in common, too.
        common = quantity.shares_random_numbers(dataset, [over])
        errors = np.zeros(len(good)) if common else np.nan_to_num(line.errors[good])
        part = replace(line, x=line.x[good], y=line.y[good], errors=errors)
        try:
            level = limit.number_in(line.unit)
        except SweepError:
            if len({one.unit for one in made.lines}) == 1:
                raise
            continue  # a component of another kind
        if is_find:
            places = needs.at_crossings(part, limit.is_met(part.y, level), level)
        else:
            places = needs.between_points(part, level, made.over_unit)
        known |= {made.at(line): max(places)} if places else {}
    status, numbers = dataset["status"], own.numbers()
    spent = int(dataset["n_sim_done"].sum() if numbers else (status == Status.DONE).sum())
    if not is_find:
        finest = float(np.diff(np.unique([x for line in made.lines for x in line.x])).min())
    per_line = math.floor(float(np.ptp(values)) / finest * ROUNDING) + 1
    full = per_line * (status.size // dataset[over].size) * math.prod(numbers.values())
    points = {} if goal.most and spent >= goal.most else _midpoints(own, now, over, needs)
    left = (goal.most or int(SHARE * full)) - spent - len(points) * math.prod(numbers.values())
    n_sim = _realisations(now, over, needs, left) if needs.factors and now.may_differ else {}
    words = f"{limit} along {over}, within {finest:g}" if is_find else f"{limit} of {variable} along {over}"
    upcoming = Round(words, over, list(points.values()), n_sim) if points or n_sim else None
    return Refinement(goal, dataset, over, rounds, upcoming, known, spent, full)


def _midpoints(own: Study, now: Study, over: str, needs: Needs) -> dict[bytes, dict[str, Any]]:
    """Return the points of a round, by their values on all axes; without those that are there, failed ones too, and
    those that the study excludes or its experiment does not allow.
    """
    grid, there, parameter = Grid(own), Grid(now), now.experiment.parameter(over)
    axis = sorted(value for value in own.axes[over] if value is not None)
    tried, points = set(there.digests(there.indices())), dict[bytes, dict[str, Any]]()
    for line, i in needs.gaps:
        try:
            middle = parameter.parse(_middle(axis, *line.x[i : i + 2].tolist()))
        except ValueError:
            continue
        values, point = _point_at(there, line, over, middle)
        if point.digest not in tried and not grid.excludes(point.parameters):
            points[point.digest] = {name: now.experiment.parameter(name).written(v) for name, v in values.items()}
    return points


def _realisations(now: Study, over: str, needs: Needs, left: int) -> dict[str, int]:
    """Return the larger n_sim of points, by their digests: doubled as often as needed, with half of what is left."""
    grid, larger, share = Grid(now), dict[str, int](), left // 2 // len(needs.factors) // now.sampling.n_cat
    for line, i, factor in needs.factors:
        value = next(value for value in now.axes[over] if value == line.x[i])
        name = _point_at(grid, line, over, value)[1].digest.hex()
        n = now.counts.get(name, now.sampling.n_sim)
        doublings = min(math.ceil(math.log2(min(factor, LARGEST_FACTOR))), int(math.log2(max(1.0 + share / n, 1.0))))
        if doublings > 0:
            larger[name] = max(larger.get(name, 0), n << doublings)
    return larger


def _point_at(grid: Grid, line: laws.Line, over: str, value: Value) -> tuple[dict[str, Value], GridPoint]:
    """Return the values on the axes of a point along a line, and the point."""
    values: dict[str, Value] = {over: value}
    for dimension, axes in grid.dimensions.items():
        if dimension != over:
            values |= zip(axes, grid.rows[dimension][line.index[dimension]], strict=True)
    return values, point_at(grid.study, values)


def _middle(axis: Sequence[Any], low: float, high: float) -> float:
    """Return a number about half-way between two, of few digits, as an axis is spaced: in equal steps or ratios.

    It is one of the two where there is none in between.
    """
    is_log = len(axis) > 2 and axis[0] > 0 and np.std(np.diff(np.log(axis))) < np.std(np.diff(axis)) / np.mean(axis)
    scale: Callable[[float], float] = math.log if is_log else float
    half = math.sqrt(low * high) if is_log else low + 0.5 * (high - low)
    if all(type(value) is int for value in axis):
        return int(min(max(round(half), low + 1), high - 1)) if high - low >= 2 else int(low)
    rounded = (float(f"{half:.{digits}g}") for digits in range(1, 18))
    near = OFF_CENTRE * (scale(high) - scale(low))
    return next((x for x in rounded if low < x < high and abs(scale(x) - scale(half)) <= near), low)
