"""The sources of a link, with sums of each or of cells of the sky, and outliers among them: sources left out before or
during the solution, or given less weight.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from linksweep.core.frames import MAS, Array, Flags, Indices
from linksweep.core.link import LinkError
from linksweep.core.tie.astrometry import Differences, differences
from linksweep.core.tie.problem import (
    BLOCK,
    NormalSums,
    Problem,
    group_sums,
    source_counts,
    source_discrepancies,
    source_sums,
    weight_sizes,
)
from linksweep.core.tie.solution import Solution, discrepancies, solve

DIVISIONS = 6
"""Divisions of the grid of cells of the sky, which has 72 cells."""

KEPT_NUMBERS = 30_000_000
"""Largest size of the sums of single sources, in numbers (240 MB)."""

SEPARATION_LIMIT = 10.0 * MAS
"""Separation below which a source is a radio-optical counterpart.  Source: Mignard et al. 2018, A&A 616, A14."""

MEDIAN_RAYLEIGH = np.sqrt(2.0 * np.log(2.0))
ITERATIONS = 200
TRAJECTORY = 300
"""Steps of the clip `discrepancy` that are computed, or more if more sources are to be dropped."""

SIGNIFICANCE = 0.01
"""Chance that the clip `discrepancy` drops any source of good data at its first step."""

KNOWN = "none, rayleigh, median:K, discrepancy, discrepancy:N, huber:C"


@dataclass(frozen=True)
class Clip:
    """A treatment of outliers and its number: the factor k or c, the number of sources to drop, or None."""

    kind: str = "none"
    number: float | None = None

    def __str__(self) -> str:
        return self.kind if self.number is None else f"{self.kind}:{self.number:g}"


def parse_clip(text: str) -> Clip:
    """Return the clip of a text like median:5; raises ValueError that says what is known."""
    kind, colon, number = text.strip().partition(":")
    needs = {"none": False, "rayleigh": False, "median": True, "huber": True, "discrepancy": bool(colon)}
    try:
        value = float(number) if colon else None
    except ValueError:
        value = np.nan
    if kind not in needs or needs[kind] != bool(colon) or (value is not None and not 0.0 < value < np.inf):
        raise ValueError(f"clip {text!r} is not known; known are {KNOWN}, with numbers above 0")
    if kind == "discrepancy" and value is not None and value != round(value):
        raise ValueError(f"clip {text!r}: the number of sources to drop is a whole one")
    return Clip(kind, value)


@dataclass(frozen=True)
class Sources:
    """How sources are solved and compared, however their sums are kept.

    ``solve`` returns the solution for factors of the weights (S,), zero (False) for a source left out;
    ``discrepancies`` returns Q_i of a solution (S,); ``count`` is n_i (S,), zero for a source without observations.
    """

    solve: Callable[[Array | Flags], Solution]
    discrepancies: Callable[[Array], Array]
    count: NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Clipped:
    """Factors of the weights (S,), or which sources are kept, the solution with them, and the steps: which source was
    dropped (-1 at the start) and the solution after it.  ``chosen`` is the step of the solution; ``notes`` are
    sentences for the reader.
    """

    factors: Array | Flags
    solution: Solution
    dropped: list[int] = field(default_factory=list)
    trajectory: list[Solution] = field(default_factory=list)
    chosen: int = 0
    notes: list[str] = field(default_factory=list)


def clipped(clip: Clip, sources: Sources, separations: Callable[[], tuple[Array, Array]]) -> Clipped:
    """Solve with a clip.  ``separations`` returns normalised and plain separations of each source, as `separation`."""
    number = clip.number or 0.0
    ways: dict[str, Callable[[], Clipped]] = {
        "rayleigh": lambda: _rayleigh(sources, separations),
        "median": lambda: _median(sources, number),
        "huber": lambda: _huber(sources, number),
        "discrepancy": lambda: _one_by_one(sources, None if clip.number is None else int(number)),
    }
    everything = np.ones(len(sources.count), dtype=bool)
    return ways[clip.kind]() if clip.kind in ways else Clipped(everything, sources.solve(everything))


def separation(problem: Problem) -> tuple[Array, Array]:
    """Return the normalised separation X of each source and its separation (rad); shape (S,).

    X^2 = d' D^-1 d of the two differences d of position, or of motion where a row has no position (the separation is
    0 then); the largest of a source's rows.  X follows a Rayleigh distribution where the errors are right.  A row
    whose difference depends on a parameter that the satellite lacks counts as 0.
    """
    largest = np.zeros((2, len(problem.satellite)))
    for start in range(0, len(problem.rows), BLOCK):
        rows = slice(start, start + BLOCK)
        source = problem.source[rows]
        star = problem.satellite.taken(source)
        values = differences(star, problem.rows.taken(rows), np.arange(len(source)), problem.taken_out(star))
        add_separations(largest, source, values, star.covariance(), ~star.present.T)
    return largest[0], largest[1]


def add_separations(largest: Array, source: Indices, rows: Differences, covariance: Array, free: Flags) -> None:
    """Raise ``largest`` (2, S) to X and the separation (rad) of rows of sources ``source`` (R,), as `separation` says.

    ``covariance`` (R, 5, 5) is that of the satellite's parameters, ``free`` (R, 5) says which of them it lacks.
    """
    whole = rows.covariance + rows.partials @ covariance @ rows.partials.swapaxes(1, 2)
    depends = np.einsum("rij,rj->ri", np.abs(rows.partials), free.astype(np.float64)) > 0.0
    for pair, chosen in (((0, 1), rows.present[:, 0]), ((3, 4), ~rows.present[:, 0])):
        at = np.flatnonzero(chosen & rows.present[:, pair].all(axis=1) & ~depends[:, pair].any(axis=1))
        d = rows.values[at][:, pair]
        square = np.einsum("ri,ri->r", d, np.linalg.solve(whole[at][:, pair][:, :, pair], d[..., None])[..., 0])
        np.maximum.at(largest[0], source[at], np.sqrt(square))
        if pair == (0, 1):
            np.maximum.at(largest[1], source[at], np.hypot(*d.T))


def _rayleigh(sources: Sources, separations: Callable[[], tuple[Array, Array]]) -> Clipped:
    normalised, plain = separations()
    used = sources.count > 0
    limit = np.sqrt(2.0 * np.log(max(int(np.sum(used)), 2)))
    factors = used & (normalised <= limit) & (plain < SEPARATION_LIMIT)
    notes = []
    median = float(np.median(normalised[used]))
    robust = _median(sources, 5.0)
    kept = robust.factors > 0.0
    after = np.sqrt(2.0 * sources.discrepancies(robust.solution.estimate)[kept] / sources.count[kept])
    if median > 1.5 * MEDIAN_RAYLEIGH and np.median(after) < 0.75 * median:
        notes.append(
            f"the frames differ by more than the errors (median X is {median:.3g} before the fit and "
            f"{np.median(after):.3g} after it; it is {MEDIAN_RAYLEIGH:.2f} for errors alone), so a clip before the fit "
            "drops good sources: use median or discrepancy"
        )
    try:
        solution = sources.solve(factors)
    except LinkError as error:
        raise LinkError("; ".join([f"after the clip rayleigh {error}", *notes])) from None
    return Clipped(factors, solution, notes=notes)


def _median(sources: Sources, k: float) -> Clipped:
    used = sources.count > 0
    factors = used
    solution = sources.solve(factors)
    trajectory = [solution]
    seen = {np.packbits(used).tobytes()}
    notes = []
    for _ in range(ITERATIONS):
        residual = _normalised(sources, solution, used)
        new = used & (residual <= k * np.median(residual[used], overwrite_input=True))
        del residual
        if np.array_equal(new, factors):
            break
        factors = new
        solution = sources.solve(factors)
        trajectory.append(solution)
        kept = np.packbits(new).tobytes()
        if kept in seen:
            notes.append("the clip median returned to an earlier selection of sources and was ended there")
            break
        seen.add(kept)
    return Clipped(factors, solution, [-1] * len(trajectory), trajectory, len(trajectory) - 1, notes)


def _normalised(sources: Sources, solution: Solution, used: Flags) -> Array:
    """Return sqrt(Q_i/n_i) of each source, zero without observations; in place, for millions of them."""
    found = sources.discrepancies(solution.estimate)
    np.divide(found, sources.count, out=found, where=used)
    np.sqrt(found, out=found)
    found[~used] = 0.0
    return found


def _huber(sources: Sources, c: float) -> Clipped:
    used = sources.count > 0
    factors = used.astype(np.float64)
    solution = sources.solve(factors)
    notes = []
    for _ in range(ITERATIONS):
        residual = _normalised(sources, solution, used)
        new = np.where(used, np.minimum(1.0, c / np.maximum(residual, 1e-300)), 0.0)
        if np.max(np.abs(new - factors)) < 1e-12:
            break
        factors = new
        solution = sources.solve(factors)
    else:
        notes.append(f"the weights of the clip huber still changed after {ITERATIONS} iterations")
    return Clipped(factors, solution, notes=notes)


def _one_by_one(sources: Sources, number: int | None) -> Clipped:
    """Drop the source with the largest Q_i/n_i, solve again, and so on.

    The trajectory goes on beyond the step that is chosen: after ``number`` sources, or the first at which the largest
    Q_i is not significant among so many.
    """
    used = sources.count > 0
    factors = used.astype(np.float64)
    dropped, trajectory = [-1], [sources.solve(factors)]
    chosen = number
    while len(trajectory) <= max(TRAJECTORY, number or 0) and factors.sum() > 1:
        squares = sources.discrepancies(trajectory[-1].estimate)
        ratio = np.where(factors > 0.0, squares / np.maximum(sources.count, 1.0), -1.0)
        worst = int(np.argmax(ratio))
        if chosen is None and chdtrc(sources.count[worst], squares[worst]) * factors.sum() > SIGNIFICANCE:
            chosen = len(trajectory) - 1
        factors[worst] = 0.0
        try:
            solution = sources.solve(factors)
        except LinkError:
            break
        if solution.dof <= 0:
            break
        dropped.append(worst)
        trajectory.append(solution)
    notes = []
    if chosen is None or chosen >= len(trajectory):
        if number is not None:
            raise LinkError(f"clip discrepancy:{number}: only {len(trajectory) - 1} sources can be dropped")
        chosen = len(trajectory) - 1
        notes.append("the largest discrepancy is significant however many sources are dropped: errors are too small")
    kept = used.astype(np.float64)
    kept[dropped[1 : chosen + 1]] = 0.0
    return Clipped(kept, trajectory[chosen], dropped, trajectory, chosen, notes)


def sky_cells(ra: Array, dec: Array, divisions: int) -> NDArray[np.int16]:
    """Return the cell of each position on a grid of cells of equal area; shape (N,).

    2 d^2 cells for ``divisions`` d: d bands of equal height in sin dec, each of 2 d equal steps in ra.
    """
    cells = np.zeros(len(ra), dtype=np.int16)
    for edge in np.arcsin(np.arange(1, divisions) * (2.0 / divisions) - 1.0):
        cells += dec >= edge  # a sine of each source takes longer than all comparisons
    cells *= 2 * divisions
    if np.any((ra < 0.0) | (ra >= 2.0 * np.pi)):
        ra = ra % (2.0 * np.pi)
    step = (ra * (divisions / np.pi)).astype(np.int16)
    step[step == 2 * divisions] = 0
    return np.asarray(cells + step)


def sources_of(sums: NormalSums, labels: tuple[str, ...]) -> Sources:
    """Return what the clips need of sources whose sums are kept one by one."""
    return Sources(
        lambda factors: _solve_kept(sums, labels, factors), lambda estimate: discrepancies(sums, estimate), sums.count
    )


def _solve_kept(sums: NormalSums, labels: tuple[str, ...], factors: Array | Flags) -> Solution:
    kept = factors > 0.0
    equal = np.all(factors[kept] == 1.0)
    return solve(sums.taken(kept), labels, None if equal else factors[kept])


class Heaviest(NamedTuple):
    """The sizes of the largest weights, the sources with them and their sums."""

    sizes: Array
    places: Indices
    sums: NormalSums


def heaviest(problem: Problem, number: int) -> Heaviest:
    """Return the ``number`` sources with the largest weights; of equal ones the first."""
    sizes = weight_sizes(problem)
    found = np.argsort(-sizes, kind="stable")[:number]
    return Heaviest(sizes[found], found, source_sums(problem.only(found)))


@dataclass(frozen=True)
class SourceTable:
    """The sources of a problem, with the sums of each if ``single``, and those of cells of the sky."""

    problem: Problem
    _last: list[tuple[Array | Flags, NormalSums]] = field(default_factory=list, repr=False, compare=False)

    @property
    def single(self) -> bool:
        """True if the sums of single sources fit."""
        return len(self.problem.satellite) * len(self.problem.unknowns) ** 2 <= KEPT_NUMBERS

    @property
    def kept(self) -> NormalSums | None:
        """The sums of each source, None if they do not fit."""
        return self.sums if self.single else None

    @cached_property
    def sums(self) -> NormalSums:
        """The sums of each source."""
        return source_sums(self.problem)

    @cached_property
    def cells(self) -> NDArray[np.int16]:
        """The cell of each source, counted from 0 among those that have any."""
        values = self.problem.satellite.values
        cells = sky_cells(values[0], values[1], DIVISIONS)
        number = np.cumsum(np.bincount(cells) > 0) - 1
        return number.astype(np.int16)[cells]

    def cell_sums(self, factors: Array | Flags) -> NormalSums:
        """Return the sums of cells, each source with a factor of its weight."""
        if not self.single:
            return self._streamed(factors)
        n_cells = int(self.cells.max()) + 1
        member = np.zeros((n_cells, len(factors)))
        member[self.cells, np.arange(len(factors))] = 1.0
        weighted = member * factors
        sums = self.sums
        optimal = sums.spread is None and np.all((factors == 0.0) | (factors == 1.0))
        return NormalSums(
            normal=np.tensordot(weighted, sums.normal, axes=1),
            right=weighted @ sums.right,
            squares=weighted @ sums.squares,
            count=(member * (factors > 0.0)) @ sums.count,
            expected=weighted @ sums.expected,
            spread=None if optimal else np.tensordot(member * factors**2, sums.right_covariance, axes=1),
        )

    def _streamed(self, factors: Array | Flags) -> NormalSums:
        """Return the sums of cells by a pass over the tables, or those of the last pass if ``factors`` are the same."""
        if not self._last or not np.array_equal(self._last[0][0], factors):
            sums = group_sums(self.problem, self.cells, int(self.cells.max()) + 1, factors)
            self._last[:] = [(factors.copy(), sums)]
        return self._last[0][1]

    def solve(self, factors: Array | Flags) -> Solution:
        """Return the solution with a factor of the weight of each source."""
        labels = self.problem.unknowns.labels
        if not self.single:
            return solve(self.cell_sums(factors), labels)
        return _solve_kept(self.sums, labels, factors)

    def separations(self) -> tuple[Array, Array]:
        """Return the normalised separation and the separation (rad) of each source."""
        return separation(self.problem)

    def heaviest(self, number: int) -> Heaviest:
        """Return the sources with the largest weights, and their sums."""
        return heaviest(self.problem, number)

    def as_sources(self) -> Sources:
        """Return what the clips need."""
        if self.single:
            return sources_of(self.sums, self.problem.unknowns.labels)
        return Sources(
            self.solve, lambda estimate: source_discrepancies(self.problem, estimate), source_counts(self.problem)
        )
