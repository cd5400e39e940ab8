"""Solutions of normal equations: with and without outliers, what each source does to them, and errors that do not rely
on those of the tables.

A solution is asked of `KeptSources`, which have the sums of each source, or of `StreamedSources`, which make them again
in each pass over the tables because they do not fit into memory.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial, reduce
from itertools import pairwise, starmap
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from linksweep.core.frames import MAS, Array, Flags, Indices
from linksweep.core.link import SMALLEST_EIGENVALUE, LinkError
from linksweep.core.tie import problem as elimination
from linksweep.core.tie.astrometry import Differences, differences, positive_definite
from linksweep.core.tie.problem import NormalSums, Problem
from linksweep.core.unknowns import Unknowns

# A source that holds a larger share of the weight of a block of unknowns is named.
LARGE_SHARE = 0.1

# Divisions of the grid of cells of the sky, which has 72 cells.
DIVISIONS = 6

# Largest size of the sums of single sources, in numbers (240 MB).
KEPT_NUMBERS = 30_000_000

# Separation below which a source is a radio-optical counterpart. Source: Mignard et al. 2018, A&A 616, A14.
SEPARATION_LIMIT = 10.0 * MAS

MEDIAN_RAYLEIGH = np.sqrt(2.0 * np.log(2.0))
ITERATIONS = 200
# Steps of the clip `discrepancy` that are computed, or more if more sources are to be dropped.
TRAJECTORY = 300

# Chance that the clip `discrepancy` drops any source of good data at its first step.
SIGNIFICANCE = 0.01


@dataclass(frozen=True)
class Solution:
    """The unknowns x (K,), N (K, K) and its inverse, the covariance of x (K, K), Q, its average and the degrees of
    freedom.  Where the weights are the best the covariance is the inverse, and the average of Q is dof.
    """

    estimate: Array
    normal: Array
    inverse: Array
    covariance: Array
    squares: float
    expected: float
    dof: float

    @property
    def scale(self) -> float:
        """Factor by which errors are scaled, sqrt(Q/E[Q]); NaN without degrees of freedom."""
        return float(np.sqrt(self.squares / self.expected)) if self.expected > 0.0 and self.dof > 0 else np.nan


def solve(sums: NormalSums, labels: tuple[str, ...] = (), factors: Array | Flags | None = None) -> Solution:
    """Return the solution of all sources, each with a factor of its weight if given.

    Raises LinkError where the sources do not determine the unknowns, and names those.
    """
    weights = np.ones(len(sums)) if factors is None else factors
    normal, right = np.tensordot(weights, sums.normal, axes=1), weights @ sums.right
    inverse = inverted(normal, labels)
    estimate = inverse @ right
    spread, covariance = normal, inverse  # if the weights are the best
    if factors is not None or sums.spread is not None:
        spread = np.tensordot(weights**2, sums.right_covariance, axes=1)
        covariance = inverse @ spread @ inverse
    return Solution(
        estimate=estimate,
        normal=normal,
        inverse=inverse,
        covariance=0.5 * (covariance + covariance.T),
        squares=max(0.0, float(weights @ sums.squares - right @ estimate)),
        expected=float(weights @ sums.expected - np.sum(inverse * spread)),
        dof=float(sums.count.sum() - len(right)),
    )


def inverted(normal: Array, labels: tuple[str, ...] = ()) -> Array:
    """Return the inverse of a normal matrix (K, K); raises LinkError that names the unknowns without a solution."""
    diagonal = np.diag(normal)
    named = labels or tuple(str(k) for k in range(len(normal)))
    if np.any(none := ~(diagonal > 0.0)):
        raise LinkError(f"nothing in the tables determines {', '.join(np.array(named)[none])}")
    scale = 1.0 / np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(normal * scale[:, None] * scale)
    if values[0] <= SMALLEST_EIGENVALUE:
        involved = np.abs(vectors[:, 0]) > 0.1
        raise LinkError(f"the tables do not tell these unknowns apart: {', '.join(np.array(named)[involved])}")
    half = scale[:, None] * vectors / np.sqrt(values)
    return np.asarray(half @ half.T)


def discrepancies(sums: NormalSums, estimate: Array) -> Array:
    """Return Q_i = yy_i - 2 b_i' x + x' N_i x of each source, chi2 of its residuals; shape (S,)."""
    quadratic = np.einsum("k,skl,l->s", estimate, sums.normal, estimate)
    return np.asarray(np.maximum(sums.squares - 2.0 * sums.right @ estimate + quadratic, 0.0))


def expected_discrepancies(sums: NormalSums, solution: Solution, factors: Array | Flags | None = None) -> Array:
    """Return what Q_i is on average: n_i - tr(N^-1 N_i), where the weights are the best; shape (S,).

    ``factors`` (S,) are those of the weights in the solution: a source that is left out has no part in it.
    """
    part = np.einsum("kl,slk->s", solution.inverse, sums.right_covariance) * (1.0 if factors is None else factors)
    shift = np.einsum("kl,slk->s", solution.covariance, sums.normal)
    return np.asarray(sums.expected - 2.0 * part + shift)


def shares(sums: NormalSums, solution: Solution, unknowns: Unknowns) -> Array:
    """Return the share of each source in the weight of each block; shape (S, blocks).  They add up to 1 over all."""
    share = np.zeros((len(sums), len(unknowns.blocks)))
    for i, name in enumerate(unknowns.names):
        part = unknowns.part(name)
        block = sums.normal[:, part, part]
        share[:, i] = np.einsum("kl,slk->s", np.linalg.inv(solution.normal[part, part]), block) / block.shape[1]
    return share


class Influence(NamedTuple):
    """Of S sources: the average of Q_i, the solution without each (S, K), Cook's distance, and shares of the weight of
    each block (S, blocks), which add up to 1 over the sources.
    """

    expected: Array
    without: Array
    cook: Array
    share: Array


def influence(sums: NormalSums, solution: Solution, unknowns: Unknowns, factors: Array | Flags) -> Influence:
    """Return the influence of each source on the solution with ``factors`` (S,) of their weights.

    For a source that was left out, "without" and Cook's distance are NaN and its shares are 0.
    """
    n, k = len(sums), len(unknowns)
    without, share = np.full((n, k), np.nan), np.zeros((n, len(unknowns.blocks)))
    kept = (factors > 0.0) & (sums.count > 0)
    used = sums.taken(kept).scaled(factors[kept])
    without[kept] = leave_one_out(used, solution.normal, solution.normal @ solution.estimate)
    share[kept] = shares(used, solution, unknowns)
    step = without - solution.estimate
    cook = np.einsum("sk,kl,sl->s", step, solution.normal, step) / k
    return Influence(expected_discrepancies(sums, solution, factors), without, cook, share)


def leave_one_out(sums: NormalSums, normal: Array, right: Array) -> Array:
    """Return (N - N_i)^-1 (b - b_i), the solution without each source; shape (G, K).

    NaN where the others do not determine all unknowns.  ``normal`` (K, K) and ``right`` (K,) are the totals.
    """
    return _solutions(normal - sums.normal, right - sums.right)


def jackknife(sums: NormalSums, normal: Array, right: Array) -> Array:
    """Return the covariance (K, K) from the solutions without each of G sources (or groups, for cells of the sky).

    (G - 1)/G times the sum of squares about their mean, G those that have any observations; NaN where the unknowns
    depend on a single one.
    """
    without = leave_one_out(sums.taken(sums.count > 0), normal, right)
    step = without - without.mean(axis=0)
    return np.asarray((len(without) - 1) / len(without) * step.T @ step)


def sandwich(sums: NormalSums, solution: Solution) -> Array:
    """Return N^-1 sum(u u') N^-1 with u_i = b_i - N_i x, times G/(G - 1); shape (K, K)."""
    scores = sums.right - sums.normal @ solution.estimate
    n = int(np.sum(sums.count > 0))
    spread = scores.T @ scores * (n / max(n - 1, 1))
    return np.asarray(solution.inverse @ spread @ solution.inverse)


def bootstrap(sums: NormalSums, resamples: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the covariance (K, K) of solutions of sources drawn with replacement, and the solutions (resamples, K),
    NaN for those that do not determine the unknowns.
    """
    used = sums.taken(sums.count > 0)
    n, k = len(used), used.right.shape[1]
    times = rng.multinomial(n, np.full(n, 1.0 / n), size=resamples).astype(np.float64)
    estimates = _solutions((times @ used.normal.reshape(n, -1)).reshape(resamples, k, k), times @ used.right)
    good = np.isfinite(estimates[:, 0])
    return np.cov(estimates[good].T).reshape(k, k) if good.sum() > 1 else np.full((k, k), np.nan), estimates


def _solutions(normal: Array, right: Array) -> Array:
    """Solve many (G, K, K) systems; NaN for those that are singular."""
    diagonal = np.einsum("gkk->gk", normal)
    good = np.all(diagonal > 0.0, axis=1)
    scale = 1.0 / np.sqrt(np.where(good[:, None], diagonal, 1.0))
    scaled = np.where(good[:, None, None], normal * scale[:, :, None] * scale[:, None, :], np.eye(normal.shape[-1]))
    good &= positive_definite(scaled, SMALLEST_EIGENVALUE)
    scaled[~good] = np.eye(normal.shape[-1])
    solutions = np.linalg.solve(scaled, (right * scale)[..., None])[..., 0] * scale
    return np.where(good[:, None], solutions, np.nan)


# ---- sources: with their sums, or in passes over the tables


@dataclass(frozen=True)
class KeptSources:
    """The sources of a problem whose sums are kept one by one; ``separations`` returns what `separation` does."""

    problem: Problem
    sums: NormalSums
    separations: Callable[[], Array]

    @property
    def count(self) -> Array:
        """The number of observations of each source, zero for one without any; shape (S,)."""
        return self.sums.count

    def solve(self, factors: Array | Flags) -> Solution:
        """Return the solution with a factor (S,) of the weight of each source, zero (False) for one left out."""
        kept = factors > 0.0
        equal = np.all(factors[kept] == 1.0)
        return solve(self.sums.taken(kept), self.problem.unknowns.labels, None if equal else factors[kept])

    def discrepancies(self, estimate: Array) -> Array:
        """Return Q_i of a solution; shape (S,)."""
        return discrepancies(self.sums, estimate)

    def cell_sums(self, factors: Array | Flags) -> NormalSums:
        """Return the sums of cells of the sky, with the weight of each source times its factor."""
        return _cell_sums(self.problem, factors)


def computed(problem: Callable[[], Problem], function: Callable[..., Any], *arguments: Any) -> Any:
    """Apply a function to the problem of a group of sources."""
    return function(problem(), *arguments)


@dataclass(frozen=True)
class StreamedSources:
    """The sources of a table whose sums are made in passes over groups of them.

    ``problems`` make the problem of each group, whose first source has the number ``firsts``.  Memory holds sums over
    cells of the sky, added in the order of the groups, so that the bits do not depend on where ``run`` (a `starmap`)
    computes; and for each source whether it is kept, and one number while a clip looks at all.
    """

    labels: tuple[str, ...]
    problems: Sequence[Callable[[], Problem]]
    firsts: Sequence[int]
    n_sources: int
    run: Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[Any]]
    _last: list[tuple[Array | Flags, NormalSums]] = field(default_factory=list, repr=False, compare=False)

    sums = None
    """The sums of single sources are not kept."""

    @cached_property
    def count(self) -> Array:
        """The number of observations of each source."""
        return self._of_each(elimination.source_counts, kind=np.float32)  # whole numbers, exact as float32

    def solve(self, factors: Array | Flags) -> Solution:
        """Return the solution with a factor of the weight of each source."""
        return solve(self.cell_sums(factors), self.labels)

    def discrepancies(self, estimate: Array) -> Array:
        """Return Q_i of a solution; shape (S,)."""
        return self._of_each(elimination.source_discrepancies, estimate)

    def separations(self) -> Array:
        """Return what `separation` does."""
        return self._of_each(separation)

    def cell_sums(self, factors: Array | Flags) -> NormalSums:
        """Return the sums of cells of the sky, with the weight of each source times its factor."""
        # remembered, because the solution and several kinds of errors ask for the same, each a pass over the table
        if not self._last or not np.array_equal(self._last[0][0], factors):
            parts = (factors[low:high] for low, high in pairwise([*self.firsts, self.n_sources]))
            each = [None if np.all(part == 1.0) else part for part in parts]
            pieces = ((problem, _cell_sums, part) for problem, part in zip(self.problems, each, strict=True))
            sums = reduce(NormalSums.plus, self.run(computed, pieces))
            self._last[:] = [(factors.copy(), sums.taken(sums.count > 0))]
        return self._last[0][1]

    def heaviest(self, number: int) -> tuple[Indices, NormalSums]:
        """Return the ``number`` sources with the largest weights, of equal ones the first, and their sums."""
        sizes, places, sums = np.zeros(0), np.zeros(0, dtype=np.int64), None
        for first, (size, place, one) in self._each(_heaviest, number):
            sizes, places = np.concatenate([sizes, size]), np.concatenate([places, first + place])
            order = np.argsort(-sizes, kind="stable")[:number]
            sizes, places = sizes[order], places[order]
            sums = one if sums is None else sums.followed_by(one).taken(order)
        assert sums is not None, "a table has rows"
        return places, sums

    def _of_each(self, function: Callable[..., Array], *arguments: Any, kind: Any = np.float64) -> Array:
        """Return the values of a function of a problem for each source, collected in one array."""
        values = np.zeros(0)
        for first, part in self._each(function, *arguments):
            if not len(values):
                values = np.empty((*part.shape[:-1], self.n_sources), dtype=kind)
            values[..., first : first + part.shape[-1]] = part
        return values

    def _each(self, function: Callable[..., Any], *arguments: Any) -> Iterator[tuple[int, Any]]:
        """Yield the first source of each group, and a function of its problem."""
        pieces = ((problem, function, *arguments) for problem in self.problems)
        return zip(self.firsts, self.run(computed, pieces), strict=True)


Sources = KeptSources | StreamedSources


def sources_of(problem: Problem) -> Sources:
    """Return the sources of a problem, with the sums of each if these fit into memory."""
    n = len(problem.satellite)
    if n * len(problem.unknowns) ** 2 <= KEPT_NUMBERS:
        return KeptSources(problem, elimination.source_sums(problem), partial(separation, problem))
    return StreamedSources(problem.unknowns.labels, (lambda: problem,), (0,), n, starmap)


def _cell_sums(problem: Problem, factors: Array | Flags | None) -> NormalSums:
    ra, dec = problem.satellite.values[:2]
    return elimination.group_sums(problem, sky_cells(ra, dec, DIVISIONS), 2 * DIVISIONS**2, factors)


def _heaviest(problem: Problem, number: int) -> tuple[Array, Indices, NormalSums]:
    sizes = elimination.weight_sizes(problem)
    places = np.argsort(-sizes, kind="stable")[:number]
    return sizes[places], places, elimination.source_sums(problem.only(places))


def sky_cells(ra: Array, dec: Array, divisions: int) -> NDArray[np.int16]:
    """Return the cell of each position on a grid of cells of equal area; shape (N,).

    2 d^2 cells for ``divisions`` d: d bands of equal height in sin dec, each of 2 d equal steps in ra.
    """
    band = np.minimum(divisions * 0.5 * (1.0 + np.sin(dec)), divisions - 1).astype(np.int16)
    step = ((ra % (2.0 * np.pi)) * (divisions / np.pi)).astype(np.int16) % (2 * divisions)
    return np.asarray(2 * divisions * band + step)


# ---- outliers: sources left out before or during the solution, or given less weight


class Clip(NamedTuple):
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
        value = (int if kind == "discrepancy" else float)(number) if colon else None
    except ValueError:
        value = np.nan
    if needs.get(kind) != bool(colon) or (value is not None and not 0.0 < value < np.inf):
        known = "none, rayleigh, median:K, discrepancy, discrepancy:N (a whole number), huber:C"
        raise ValueError(f"clip {text!r} is not known; known are {known}, with numbers above 0")
    return Clip(kind, value)


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


def clipped(clip: Clip, sources: Sources) -> Clipped:
    """Solve with a clip."""
    if clip.kind == "none":
        everything = np.ones(len(sources.count), dtype=bool)
        return Clipped(everything, sources.solve(everything))
    ways = {"rayleigh": _rayleigh, "median": _median, "huber": _huber, "discrepancy": _one_by_one}
    return ways[clip.kind](sources, clip.number)


def separation(problem: Problem) -> Array:
    """Return the normalised separation X of each source and its separation (rad); shape (2, S).

    X^2 = d' D^-1 d of the two differences d of position, or of motion where a row has no position (the separation is
    0 then); the largest of a source's rows.  X follows a Rayleigh distribution where the errors are right.  A row
    whose difference depends on a parameter that the satellite lacks counts as 0.
    """
    largest = np.zeros((2, len(problem.satellite)))
    for start in range(0, len(problem.rows), elimination.BLOCK):
        rows = slice(start, start + elimination.BLOCK)
        source = problem.source[rows]
        star = problem.satellite.taken(source)
        values = differences(star, problem.rows.taken(rows), np.arange(len(source)), problem.taken_out(star))
        add_separations(largest, source, values, star.covariance(), ~star.present.T)
    return largest


def add_separations(largest: Array, source: Indices, rows: Differences, covariance: Array, free: Flags) -> None:
    """Raise ``largest`` (2, S) to X and the separation (rad) of rows of sources ``source`` (R,), as `separation` says.

    ``covariance`` (R, 5, 5) is that of the satellite's parameters, ``free`` (R, 5) says which of them it lacks.
    """
    whole = rows.whole(covariance)
    depends = np.einsum("rij,rj->ri", np.abs(rows.partials[..., :5]), free.astype(np.float64)) > 0.0
    for pair, chosen in (((0, 1), rows.present[:, 0]), ((3, 4), ~rows.present[:, 0])):
        at = np.flatnonzero(chosen & rows.present[:, pair].all(axis=1) & ~depends[:, pair].any(axis=1))
        d = rows.values[at][:, pair]
        square = np.einsum("ri,ri->r", d, np.linalg.solve(whole[at][:, pair][:, :, pair], d[..., None])[..., 0])
        np.maximum.at(largest[0], source[at], np.sqrt(square))
        if pair == (0, 1):
            np.maximum.at(largest[1], source[at], np.hypot(*d.T))


def _rayleigh(sources: Sources, _: float | None) -> Clipped:
    normalised, plain = sources.separations()
    used = sources.count > 0
    limit = np.sqrt(2.0 * np.log(max(int(np.sum(used)), 2)))
    factors = used & (normalised <= limit) & (plain < SEPARATION_LIMIT)
    notes = []
    median = float(np.median(normalised[used]))
    robust = _median(sources, 5.0)
    kept = robust.factors > 0.0
    after = np.sqrt(2.0 * sources.discrepancies(robust.solution.estimate)[kept] / sources.count[kept])
    if median > 1.5 * MEDIAN_RAYLEIGH and np.median(after) < 0.75 * median:
        said = (
            f"the frames differ by more than the errors (median X {median:.3g}, and {np.median(after):.3g} after a fit)"
        )
        notes.append(f"{said}, so a clip before the fit drops good sources: use median or discrepancy")
    try:
        solution = sources.solve(factors)
    except LinkError as error:
        raise LinkError("; ".join([f"after the clip rayleigh {error}", *notes])) from None
    return Clipped(factors, solution, notes=notes)


def _median(sources: Sources, k: Any) -> Clipped:
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
    residual = sources.discrepancies(solution.estimate)
    np.divide(residual, sources.count, out=residual, where=used)
    np.sqrt(residual, out=residual)
    residual[~used] = 0.0
    return residual


def _huber(sources: Sources, c: Any) -> Clipped:
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


def _one_by_one(sources: Sources, number: Any) -> Clipped:
    """Drop the source with the largest Q_i/n_i, solve again, and so on.

    The trajectory goes on beyond the step that is chosen: after ``number`` sources, or the first at which the largest
    Q_i is not significant among so many.
    """
    used = sources.count > 0
    factors = used.astype(np.float64)
    dropped, trajectory = [-1], [sources.solve(factors)]
    chosen: int | None = number
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
