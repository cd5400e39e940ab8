"""Normal equations of the unknowns, kept for each source or for groups of sources, and their solution."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from core.blocks import Objects
from core.link import SMALLEST_EIGENVALUE, LinkError
from core.tie.astrometry import Astrometry, Indices
from core.tie.differences import differences
from core.tie.elimination import Eliminated, Weights, eliminate
from core.tie.products import add_products
from core.tie.simple_rows import eliminate_simple
from core.unknowns import Unknowns

Array = NDArray[np.float64]

BLOCK = 4096
"""Sources whose derivatives are made at a time: a few hundred numbers each, which stay in the cache."""

GATHERED = 64 * BLOCK
"""Sources that are taken out of the tables at a time: bounds the memory beyond these."""


@dataclass(frozen=True)
class NormalSums:
    """Sums of G sources or groups: N (G, K, K), b (G, K), yy (G,), numbers of observations n (G,), the averages of yy
    (G,), and the covariance of b (G, K, K), None where it is N because the weights are the best.
    """

    normal: Array
    right: Array
    squares: Array
    count: Array
    expected: Array
    spread: Array | None = None

    def __len__(self) -> int:
        return len(self.right)

    def taken(self, part: NDArray[np.bool_] | Indices) -> "NormalSums":
        """Return the sums of some sources."""
        spread = None if self.spread is None else self.spread[part]
        return NormalSums(
            self.normal[part], self.right[part], self.squares[part], self.count[part], self.expected[part], spread
        )

    def weighted(self, factors: Array) -> "NormalSums":
        """Return the sums with the weight of each source multiplied by a factor (G,), those with 0 left out."""
        used = factors > 0.0
        one, f = self.taken(used), factors[used]
        each = f[:, None, None]
        return NormalSums(
            one.normal * each,
            one.right * f[:, None],
            one.squares * f,
            one.count,
            one.expected * f,
            one.right_covariance * each**2,
        )

    @property
    def right_covariance(self) -> Array:
        """The covariance of b; shape (G, K, K)."""
        return self.normal if self.spread is None else self.spread


@dataclass(frozen=True)
class Problem:
    """The tables of a link and what is asked of them.

    ``source`` (R,) is the satellite's source of each row of the reference.  ``epoch`` (Julian years) is that of the
    unknowns.  ``known`` holds values of a block's unknowns to be taken out before, with the block.
    """

    satellite: Astrometry
    rows: Astrometry
    source: Indices
    unknowns: Unknowns
    epoch: float
    weights: Weights = "covariance"
    known: tuple[Unknowns, Array] | None = None

    def sources(self, part: Indices) -> tuple[Unknowns, Objects, Array, Eliminated]:
        """Return the objects, years and eliminated rows of some sources."""
        chosen = _as_slice(part)
        own = self._needed.taken(chosen)
        if self._one_each:
            rows, source = self.rows.taken(chosen), np.arange(len(part))
        else:
            rows_of, counts = self._rows_of(part)
            rows, source = self.rows.taken(rows_of), np.repeat(np.arange(len(part)), counts)
        objects, years = self.objects(own)
        taken_out = self.taken_out(own)
        if self.weights == "covariance" and len(rows) == len(part) and np.array_equal(source, np.arange(len(part))):
            simple = eliminate_simple(own, rows, taken_out)
            if simple is not None:
                return self.unknowns, objects, years, simple
        found = differences(own, rows, source, taken_out, self.unknowns.frames)
        try:
            left = eliminate(found, source, own.covariance(), ~own.present.T, self.weights)
        except LinkError as error:
            raise LinkError(_named(str(error), self.satellite, part)) from None
        return self.unknowns, objects, years, left

    def objects(self, own: Astrometry) -> tuple[Objects, Array]:
        """Return what derivatives depend on, and the epoch of each source minus that of the unknowns."""
        ra, dec = own.values[:2]
        pmra, pmdec = np.nan_to_num(own.values[3:])
        objects = Objects(ra, dec, pmra, pmdec, own.columns)
        return objects, np.where(np.isfinite(own.epoch), own.epoch - self.epoch, 0.0)

    def taken_out(self, own: Astrometry) -> Array | None:
        """Return what the known unknowns do to the parameters of sources; shape (5, S)."""
        if self.known is None:
            return None
        known, values = self.known
        return np.asarray(np.einsum("nik,k->in", known.matrix(*self.objects(own)), values))

    @cached_property
    def _needed(self) -> Astrometry:
        """The satellite without names and without columns that nothing depends on."""
        wanted = self.unknowns.columns | (self.known[0].columns if self.known is not None else frozenset())
        columns = {name: column for name, column in self.satellite.columns.items() if name in wanted}
        return replace(self.satellite, names=None, columns=columns)

    @cached_property
    def _one_each(self) -> bool:
        """True if row i is the only one of source i."""
        return len(self.source) == len(self.satellite) and np.array_equal(self.source, np.arange(len(self.source)))

    @cached_property
    def _order(self) -> tuple[Indices, Indices]:
        """Rows sorted by source, and where those of each source begin."""
        n_rows = np.bincount(self.source, minlength=len(self.satellite))
        return np.argsort(self.source, kind="stable"), np.concatenate([[0], np.cumsum(n_rows)])

    def _rows_of(self, part: Indices) -> tuple[Indices, Indices]:
        """Return the rows of some sources, source by source, and how many each has."""
        order, first = self._order
        counts = first[part + 1] - first[part]
        ends = np.cumsum(counts)
        inside = np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts)
        return order[np.repeat(first[part], counts) + inside], counts


def source_sums(problem: Problem) -> NormalSums:
    """Return the sums of each source."""
    n, k = len(problem.satellite), len(problem.unknowns)
    sums = _empty(n, k, problem.weights != "covariance")
    for part in _blocks(n, BLOCK):
        unknowns, objects, years, left = problem.sources(part)
        rows, derivatives = unknowns.derivatives(objects, years)
        weight, right, spread = left.onto(rows)
        matrix = np.moveaxis(derivatives, -1, 0)  # (n, K, rows)
        sums.normal[part] = matrix @ weight @ matrix.swapaxes(1, 2)
        if sums.spread is not None:
            sums.spread[part] = matrix @ spread @ matrix.swapaxes(1, 2)
        sums.right[part] = np.einsum("nkr,nr->nk", matrix, right)
        sums.squares[part], sums.count[part], sums.expected[part] = left.squares, left.count, left.expected
    return sums


def group_sums(problem: Problem, group: Indices, n_groups: int, factors: Array | None = None) -> NormalSums:
    """Return the sums of each group of sources; ``group`` (S,) counts from 0.  Memory is that of a block.

    ``factors`` (S,) multiply the weights; a source with 0 is not read.
    """
    equal = factors is None or bool(np.all((factors == 0.0) | (factors == 1.0)))
    sums = _empty(n_groups, len(problem.unknowns), problem.weights != "covariance" or not equal)
    short = np.int16 if n_groups < 2**15 else np.int64  # short numbers sort in no time
    for part in _blocks(len(group), GATHERED):
        chosen = part if factors is None else part[factors[part] > 0.0]
        chosen = chosen[np.argsort(group[chosen].astype(short), kind="stable")]
        unknowns, objects, years, left = problem.sources(chosen)
        if factors is not None and not equal:
            left = left.scaled(factors[chosen])
        here = group[chosen]
        for piece in _pieces(here):
            _add_piece(sums, int(here[piece.start]), unknowns, objects.taken(piece), years[piece], left.taken(piece))
    return sums


def _add_piece(
    sums: NormalSums, one: int, unknowns: Unknowns, objects: Objects, years: Array, left: Eliminated
) -> None:
    """Add sources to the sums of one group."""
    rows, derivatives = unknowns.derivatives(objects, years)
    weight, right, spread = left.onto(rows)
    sums.right[one] += derivatives.reshape(len(derivatives), -1) @ right.T.ravel()
    if sums.spread is not None:
        add_products(sums.spread[one], derivatives.copy(), spread)
    add_products(sums.normal[one], derivatives, weight)
    sums.squares[one] += left.squares.sum()
    sums.count[one] += left.count.sum()
    sums.expected[one] += left.expected.sum()


def source_counts(problem: Problem) -> Array:
    """Return the number of observations of each source less that of its free parameters; shape (S,)."""
    n = len(problem.satellite)
    return np.concatenate([problem.sources(part)[3].count for part in _blocks(n, GATHERED)]) if n else np.zeros(0)


def source_discrepancies(problem: Problem, estimate: Array) -> Array:
    """Return Q_i of each source at a solution, without keeping its sums; shape (S,)."""
    squares = np.zeros(len(problem.satellite))
    for part in _blocks(len(squares), BLOCK):
        unknowns, objects, years, left = problem.sources(part)
        rows, derivatives = unknowns.derivatives(objects, years)
        shift = np.tensordot(estimate, derivatives, axes=1)
        weight, right, _ = left.onto(rows)
        squares[part] = left.squares - 2.0 * np.einsum("nr,rn->n", right, shift)
        squares[part] += np.einsum("rn,nrs,sn->n", shift, weight, shift)
    return np.maximum(squares, 0.0)


def _blocks(n: int, size: int) -> Iterator[Indices]:
    for start in range(0, n, size):
        yield np.arange(start, min(start + size, n))


def _pieces(group: Indices) -> Iterator[slice]:
    """Yield runs of equal numbers, each at most a block long."""
    limits = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), len(group)]
    for first, last in pairwise(limits):
        for start in range(first, last, BLOCK):
            yield slice(start, min(start + BLOCK, last))


def _as_slice(part: Indices) -> Indices | slice:
    """Return rising neighbours as a slice, which takes without a copy."""
    if len(part) and part[-1] - part[0] == len(part) - 1 and np.all(np.diff(part) == 1):
        return slice(int(part[0]), int(part[-1]) + 1)
    return part


def _empty(groups: int, k: int, with_spread: bool) -> NormalSums:
    return NormalSums(
        normal=np.zeros((groups, k, k)),
        right=np.zeros((groups, k)),
        squares=np.zeros(groups),
        count=np.zeros(groups),
        expected=np.zeros(groups),
        spread=np.zeros((groups, k, k)) if with_spread else None,
    )


def _named(message: str, own: Astrometry, part: Indices) -> str:
    """Replace the number of a source within a block by its name, or its number in the table."""
    words = message.split()
    at = words.index("source") + 1
    number = int(words[at])
    words[at] = repr(str(own.names[part[number]])) if own.names is not None else str(part[number] + 1)
    return " ".join(words)


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


def solve(sums: NormalSums, labels: tuple[str, ...] = (), factors: Array | None = None) -> Solution:
    """Return the solution of all sources, each with a factor of its weight if given.

    Raises LinkError where the sources do not determine the unknowns, and names those.
    """
    weights = np.ones(len(sums)) if factors is None else factors
    normal, right = np.tensordot(weights, sums.normal, axes=1), weights @ sums.right
    inverse = inverted(normal, labels)
    estimate = inverse @ right
    spread = normal
    covariance = inverse
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
