"""The tables of a link, what is asked of them, the five parameters of each source eliminated from its rows, the sums of
normal equations, of each source or of groups of sources, and their solutions: with and without outliers, what each
source does to them, and errors that do not rely on those of the tables.

With f the differences of a source's rows, M their derivatives by its five parameters, V the rows' covariance and C that
of the satellite, the covariance of f is D = V + M C M'.  The elimination leaves W = M' D^-1 M, w = M' D^-1 f and
yy = f' D^-1 f, which with J = M' V^-1 M and g = M' V^-1 f are (I + J C)^-1 J, (I + J C)^-1 g and
sum f' V^-1 f - g' C w.  This form needs neither C nor V nor J to be invertible: only a difference must have an error.
A parameter that the satellite lacks is free: it is eliminated from W as an unknown of its source.  Millions of sources
have one row each, of their own epoch; for these there is a closed form.

A solution is asked of `KeptSources`, which have the sums of each source, or of `StreamedSources`, which make them again
in each pass over the tables because they do not fit into memory.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, reduce
from itertools import pairwise, starmap
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from linksweep.core.frames import MAS, SMALLEST_EIGENVALUE, Array, Flags, Indices, LinkError
from linksweep.core.tie.astrometry import PAIRS, Astrometry, Differences, differences, offsets, positive_definite
from linksweep.core.unknowns import Objects, Unknowns

# Eigenvalue of a scaled 5 x 5 matrix below which a free parameter is not determined by the rows.
UNDETERMINED = 1e-12

# Sources whose derivatives are made at a time: a few hundred numbers each, which stay in the cache.
BLOCK = 4096

# Sources that are taken out of the tables at a time, which bounds the memory beyond that of the tables.
GATHERED = 64 * BLOCK

# The smallest determinant of a scaled 2 x 2 matrix at which its root is taken.
REGULAR = 1e-6


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

    @classmethod
    def zeros(cls, groups: int, k: int, with_spread: bool, **further: Any) -> Self:
        """Return sums that are zero, to be filled in; ``further`` fields are those of a subclass."""
        squares, count, expected = np.zeros((3, groups))
        spread = np.zeros((groups, k, k)) if with_spread else None
        return cls(np.zeros((groups, k, k)), np.zeros((groups, k)), squares, count, expected, spread, **further)

    def __len__(self) -> int:
        return len(self.right)

    def taken(self, part: slice | Flags | Indices) -> Self:
        """Return the sums of some sources."""
        # indexing with row numbers takes several times longer than np.take
        if isinstance(part, slice) or part.dtype == np.bool_:
            return self.mapped(lambda array: array[part])
        return self.mapped(lambda array: np.take(array, part, axis=0))

    def scaled(self, factors: Array | Flags) -> Self:
        """Return the same with the weight of each source multiplied by a factor (G,)."""
        weighted = self.mapped(lambda array: array * factors.reshape(-1, *[1] * (array.ndim - 1)))
        return replace(weighted, count=self.count, spread=self.right_covariance * factors[:, None, None] ** 2)

    def mapped(self, each: Callable[..., Array], *others: Self) -> Self:
        """Return a function of every array of these sums and of others."""
        sums = (self, *others)
        names = ("normal", "right", "squares", "count", "expected")
        arrays = {name: each(*(getattr(one, name) for one in sums)) for name in names}
        best = all(one.spread is None for one in sums)
        return replace(self, **arrays, spread=None if best else each(*(one.right_covariance for one in sums)))

    @property
    def right_covariance(self) -> Array:
        """The covariance of b; shape (G, K, K)."""
        return self.normal if self.spread is None else self.spread

    @property
    def matrices(self) -> Array:
        """N, and beside it the covariance of b where that is another; shape (G, 1 or 2, K, K)."""
        return np.stack([self.normal, *([] if self.spread is None else [self.spread])], axis=1)


@dataclass(frozen=True)
class Eliminated(NormalSums):
    """The sums W, w and yy of S sources, numbers of observations less those of free parameters, and M' G D G' M for
    weights G other than the best.  ``parameters`` are the P parameters of the matrices: some of the five of each frame.
    """

    parameters: tuple[int, ...] = ()

    def onto(self, rows: tuple[int, ...]) -> tuple[Array, Array, Array]:
        """Return W (S, r, r), w (S, r) and M' G D G' M (S, r, r) of some parameters, zero for those without weight."""
        if rows == self.parameters:
            return self.normal, self.right, self.right_covariance
        into = [i for i, row in enumerate(rows) if row in self.parameters]
        at = [self.parameters.index(rows[i]) for i in into]
        n, size = len(self), len(rows)
        right, (weight, spread) = np.zeros((n, size)), np.zeros((2, n, size, size))
        right[:, into] = self.right[:, at]
        for whole, known in ((weight, self.normal), (spread, self.right_covariance)):
            whole[np.ix_(range(n), into, into)] = known[np.ix_(range(n), at, at)]
        return weight, right, spread


def eliminate(
    rows: Differences, source: Indices, covariance: Array, free: Flags, weights: str = "covariance"
) -> Eliminated:
    """Return what is left of S sources.

    P is five for each frame.  ``source`` (R,) is that of each row; ``covariance`` C (S, 5, 5) and ``free`` (S, 5), true
    for parameters without an error, whose rows and columns in C are zero.  Weights are those of the covariance D, of
    its diagonal, or equal (an error of 1 mas and 1 mas/yr in each difference).  Raises LinkError where differences of a
    source have no error.
    """
    n_sources, size = len(covariance), rows.by_frames.shape[-1]
    result = Eliminated.zeros(n_sources, size, weights != "covariance", parameters=tuple(range(size)))
    for sources, places in _alike(rows.present, source, n_sources):
        _observed(result, rows, covariance, sources, places, weights)
    which = free @ (1 << np.arange(5))
    for one in np.unique(which[which > 0]):
        sources = np.flatnonzero(which == one)
        _eliminate_free(result, sources, np.flatnonzero(free[sources[0]]))
    return result


def _alike(present: Flags, source: Indices, n_sources: int) -> Iterator[tuple[Indices, Indices]]:
    """Yield sources with equally many rows, single rows also of the same kind; and their rows (sources, rows each)."""
    order = np.argsort(source, kind="stable")
    n_rows = np.bincount(source, minlength=n_sources)
    first = np.cumsum(n_rows) - n_rows
    key = 32 * n_rows.astype(np.int64)
    single = np.flatnonzero(n_rows == 1)
    key[single] += present[order[first[single]]] @ (1 << np.arange(5))
    for one in np.unique(key[n_rows > 0]):
        sources = np.flatnonzero(key == one)
        yield sources, order[first[sources][:, None] + np.arange(n_rows[sources[0]])]


def _observed(
    result: Eliminated, rows: Differences, covariance: Array, sources: Indices, places: Indices, weights: str
) -> None:
    """Fill in W, w, yy of sources that are alike; parameters that a row lacks have zero derivatives and differences."""
    n, n_rows = places.shape
    size = 5 * n_rows
    present = rows.present[places].reshape(n, size)
    used = np.flatnonzero(present.any(axis=0))
    if not len(used):
        return
    partials, present = rows.partials[places].reshape(n, size, -1)[:, used], present[:, used]
    whole = partials @ covariance[sources] @ partials.swapaxes(1, 2)
    for row in range(n_rows):
        here = np.flatnonzero(used // 5 == row)
        inside = used[here] % 5
        whole[:, here[:, None], here] += rows.covariance[places[:, row]][:, inside[:, None], inside]
    if np.any(rows.shared):
        pairs = present[:, :, None] & present[:, None]
        whole += np.where(pairs, rows.across(places).reshape(n, size, size)[:, used[:, None], used], 0.0)
    diagonal = range(len(used))
    whole[:, diagonal, diagonal] += np.where(present, 0.0, MAS**2)
    variance = whole[:, diagonal, diagonal]
    if np.any(variance <= 0.0):
        raise LinkError(f"source {sources[np.argwhere(variance <= 0.0)[0][0]]} has a difference without any error")

    values = rows.values[places].reshape(n, size)[:, used]
    both = np.concatenate([rows.by_frames[places].reshape(n, size, -1)[:, used], values[..., None]], axis=2)
    if weights == "covariance":
        weighted = _solved(whole, variance, both, sources)
        result.expected[sources] = np.sum(present, axis=1)
    else:
        assumed = variance if weights == "variance" else np.full_like(variance, MAS**2)
        weighted = both / assumed[..., None]
        result.expected[sources] = np.sum(np.where(present, variance / assumed, 0.0), axis=1)
        result.right_covariance[sources] = weighted[..., :-1].swapaxes(1, 2) @ whole @ weighted[..., :-1]
    products = both.swapaxes(1, 2) @ weighted
    weight = products[:, :-1, :-1]
    result.normal[sources] = 0.5 * (weight + weight.swapaxes(1, 2))
    result.right[sources] = products[:, :-1, -1]
    result.squares[sources] = products[:, -1, -1]
    result.count[sources] = np.sum(present, axis=1)


def _solved(whole: Array, variance: Array, right: Array, sources: Indices) -> Array:
    """Return D^-1 times the right-hand sides, D scaled to a diagonal of 1."""
    scale = 1.0 / np.sqrt(variance)
    scaled = whole * scale[:, :, None] * scale[:, None, :]
    right = right * scale[..., None]
    if scaled.shape[1] <= 2:  # in closed form, for millions of sources
        cross = scaled[:, 0, -1] if scaled.shape[1] == 2 else np.zeros(len(scaled))
        determinant = (1.0 - cross) * (1.0 + cross)
        regular = determinant > UNDETERMINED
    else:
        regular = np.linalg.eigvalsh(scaled)[:, 0] > UNDETERMINED / 1e3
    if not np.all(regular):
        first = sources[np.flatnonzero(~regular)[0]]
        raise LinkError(f"the differences of source {first} have a combination without any error")
    if scaled.shape[1] <= 2:
        solved = (right - cross[:, None, None] * right[:, ::-1]) / determinant[:, None, None]
    else:
        solved = np.asarray(np.linalg.solve(scaled, right), dtype=np.float64)
    return np.asarray(solved * scale[..., None])


def _eliminate_free(result: Eliminated, sources: Indices, columns: Indices) -> None:
    """Eliminate parameters that the satellite lacks, as far as the rows determine them."""
    weight = result.normal[sources]
    block = weight[:, columns[:, None], columns]
    diagonal = np.einsum("nkk->nk", block)
    scale = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(block * scale[:, :, None] * scale[:, None, :])
    seen = values > UNDETERMINED
    inverse = (vectors * np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)[:, None, :]) @ vectors.swapaxes(1, 2)
    inverse *= scale[:, :, None] * scale[:, None, :]

    keep = np.tile(np.eye(weight.shape[-1]), (len(sources), 1, 1))  # w of the free solution is keep @ w
    keep[:, :, columns] -= weight[:, :, columns] @ inverse
    keep[:, columns, :] = 0.0
    right, spread = result.right[sources], result.right_covariance[sources]
    result.squares[sources] -= np.einsum("nk,nkl,nl->n", right[:, columns], inverse, right[:, columns])
    result.expected[sources] -= np.einsum("nkl,nlk->n", inverse, spread[:, columns[:, None], columns])
    result.count[sources] -= np.sum(seen, axis=1)
    result.normal[sources] = keep @ weight @ keep.swapaxes(1, 2)
    result.right[sources] = np.einsum("nij,nj->ni", keep, right)
    if result.spread is not None:
        result.spread[sources] = keep @ spread @ keep.swapaxes(1, 2)


def eliminate_simple(satellite: Astrometry, rows: Astrometry, taken_out: Array | None) -> Eliminated | None:
    """Return what `eliminate` returns for the best weights, if row i is the only one of source i and of its epoch, all
    rows are mean positions or all are motions, and the satellite has both coordinates; None otherwise.

    All rows are in the reference's frame.  The row is then the difference itself: W is the inverse of V + C, and
    nothing is eliminated.
    """
    pair, absent = ((3, 4), (0, 1, 2)) if np.all(np.isfinite(rows.errors[3])) else ((0, 1), (2, 3, 4))
    inside, not_inside = list(pair), list(absent)
    complete = np.all(rows.present[inside]) and np.all(satellite.present[inside]) and satellite.further is None
    same_epoch = np.isnan(rows.epoch) | (rows.epoch == satellite.epoch)
    if not complete or np.any(np.isfinite(rows.errors[not_inside])) or np.any(rows.frame) or not np.all(same_epoch):
        return None
    if pair == (0, 1):
        if np.any(rows.apparent):
            return None
        values = offsets(*rows.values[:2], *satellite.values[:2])
    else:
        values = rows.values[inside] - satellite.values[inside]
    if taken_out is not None:
        values = values - taken_out[inside]
    first, second = (satellite.errors[k] ** 2 + rows.errors[k] ** 2 for k in pair)
    cross = np.zeros(len(rows))
    for table in (satellite, rows):
        if table.correlations is not None:
            correlation = np.nan_to_num(table.correlations[PAIRS.index(pair)])
            cross = cross + correlation * (table.errors[pair[0]] * table.errors[pair[1]])
    determinant = first * second - cross**2
    if not np.all((first > 0.0) & (second > 0.0) & (determinant > UNDETERMINED * first * second)):
        return None  # the general form names the source
    weight = np.empty((len(rows), 2, 2))
    weight[:, 0, 0], weight[:, 1, 1] = second / determinant, first / determinant
    weight[:, 0, 1] = weight[:, 1, 0] = -cross / determinant
    right = np.stack([weight[:, k, 0] * values[0] + weight[:, k, 1] * values[1] for k in range(2)], axis=1)
    two = np.full(len(rows), 2.0)
    squares = right[:, 0] * values[0] + right[:, 1] * values[1]
    return Eliminated(weight, right, squares, two, two, parameters=pair)


@dataclass(frozen=True)
class Problem:
    """The tables of a link and what is asked of them.

    ``source`` (R,) is the satellite's source of each row of the reference.  ``epoch`` (Julian years) is that of the
    unknowns.  ``known`` holds unknowns with known values, whose effect is taken out before the solution.  ``tables``
    are the names of the tables of rows by frame.
    """

    satellite: Astrometry
    rows: Astrometry
    source: Indices
    unknowns: Unknowns
    epoch: float
    weights: str = "covariance"
    known: tuple[Unknowns, Array] | None = None
    tables: tuple[str, ...] = ("reference",)

    def sources(self, part: slice) -> tuple[Objects, Array, Eliminated]:
        """Return the objects, years and eliminated rows of consecutive sources."""
        star, here = self._needed.taken(part), self._rows_of(part)
        rows, source = self.rows.taken(here), self.source[here] - part.start
        taken_out, left = self.taken_out(star), None
        if self.weights == "covariance" and np.array_equal(source, np.arange(len(star))):
            left = eliminate_simple(star, rows, taken_out)
        if left is None:
            offset = differences(star, rows, source, taken_out, self.unknowns.frames, self.epoch)
            try:
                left = eliminate(offset, source, star.covariance(), ~star.present.T, self.weights)
            except LinkError as error:
                number, names = int(str(error).partition("source ")[2].split()[0]), self.satellite.names
                name = str(part.start + number + 1) if names is None else repr(str(names[part.start + number]))
                raise LinkError(str(error).replace(f"source {number}", f"source {name}")) from None
        return *self.objects(star), left

    def only(self, sources: Indices) -> "Problem":
        """Return the problem of some sources, in any order, and their rows."""
        place = np.full(len(self.satellite), -1)
        place[sources] = np.arange(len(sources))
        rows = np.flatnonzero(place[self.source] >= 0)
        satellite, source = self.satellite.taken(sources), place[self.source[rows]]
        return replace(self, satellite=satellite, rows=self.rows.taken(rows), source=source)

    def differences(self) -> Differences:
        """Return the differences of all rows, without the effect of the known unknowns."""
        star = self.satellite
        return differences(star, self.rows, self.source, self.taken_out(star), self.unknowns.frames, self.epoch)

    def objects(self, star: Astrometry) -> tuple[Objects, Array]:
        """Return the data for derivatives, and the epoch of each source minus that of the unknowns."""
        (ra, dec), (pmra, pmdec) = star.values[:2], np.nan_to_num(star.values[3:])
        objects = Objects(ra, dec, pmra, pmdec, star.columns)
        return objects, np.where(np.isfinite(star.epoch), star.epoch - self.epoch, 0.0)

    def taken_out(self, star: Astrometry) -> Array | None:
        """Return what the known unknowns do to the parameters of sources; shape (5, S)."""
        if self.known is None:
            return None
        known, values = self.known
        return np.asarray(np.einsum("nik,k->in", known.matrix(*self.objects(star)), values))

    @cached_property
    def _needed(self) -> Astrometry:
        """The satellite without names and without columns that nothing depends on."""
        wanted = self.unknowns.columns | (self.known[0].columns if self.known is not None else frozenset())
        columns = {name: column for name, column in self.satellite.columns.items() if name in wanted}
        return replace(self.satellite, names=None, columns=columns)

    @cached_property
    def _order(self) -> Indices | None:
        """The numbers of the rows, sorted by source; None if row i is the only one of source i."""
        one_each = np.array_equal(self.source, np.arange(len(self.satellite)))
        return None if one_each else np.argsort(self.source, kind="stable")

    def _rows_of(self, part: slice) -> Indices | slice:
        """Return the rows of consecutive sources: where it can be a slice, which needs no copy."""
        if self._order is None:
            return part
        first, last = np.searchsorted(self.source, (part.start, part.stop), sorter=self._order)
        return self._order[first:last]


def _by_blocks(problem: Problem) -> Iterator[tuple[slice, Eliminated, Array, tuple[Array, Array, Array]]]:
    """Yield blocks of sources, what is left of them, and the derivatives (K, rows, n) with `Eliminated.onto` these."""
    for part in _blocks(len(problem.satellite), BLOCK):
        objects, years, left = problem.sources(part)
        rows, derivatives = problem.unknowns.derivatives(objects, years)
        yield part, left, derivatives, left.onto(rows)


def source_sums(problem: Problem) -> NormalSums:
    """Return the sums of each source."""
    sums = NormalSums.zeros(len(problem.satellite), len(problem.unknowns), problem.weights != "covariance")
    for part, left, derivatives, (weight, right, spread) in _by_blocks(problem):
        matrix = np.moveaxis(derivatives, -1, 0)  # (n, K, rows)
        sums.normal[part] = matrix @ weight @ matrix.swapaxes(1, 2)
        if sums.spread is not None:
            sums.spread[part] = matrix @ spread @ matrix.swapaxes(1, 2)
        sums.right[part] = np.einsum("nkr,nr->nk", matrix, right)
        sums.squares[part], sums.count[part], sums.expected[part] = left.squares, left.count, left.expected
    return sums


def source_discrepancies(problem: Problem, estimate: Array) -> Array:
    """Return Q_i of each source at a solution, without keeping its sums; shape (S,)."""
    squares = np.zeros(len(problem.satellite))
    for part, left, derivatives, (weight, right, _) in _by_blocks(problem):
        shift = np.tensordot(estimate, derivatives, axes=1)
        squares[part] = left.squares - 2.0 * np.einsum("nr,rn->n", right, shift)
        squares[part] += np.einsum("rn,nrs,sn->n", shift, weight, shift)
    return np.maximum(squares, 0.0)


def source_numbers(problem: Problem, name: str) -> Array:
    """Return one of the numbers of `Eliminated` for each source: its ``count``, or what is ``expected``; shape (S,)."""
    return _of_each(problem, lambda left: np.asarray(getattr(left, name)))


def _of_each(problem: Problem, value: Callable[[Eliminated], Array]) -> Array:
    blocks = _blocks(len(problem.satellite), GATHERED)
    return np.concatenate([np.zeros(0), *(value(problem.sources(part)[2]) for part in blocks)])


def group_sums(
    problem: Problem, group: NDArray[np.integer[Any]], n_groups: int, factors: Array | Flags | None = None
) -> NormalSums:
    """Return the sums of each group of sources; ``group`` (S,) counts from 0.  Memory is that of a block.

    ``factors`` (S,) multiply the weights; a source with 0 has no part in the sums.
    """
    equal = factors is None or bool(np.all((factors == 0.0) | (factors == 1.0)))
    sums = NormalSums.zeros(n_groups, len(problem.unknowns), problem.weights != "covariance" or not equal)
    left_out, short = n_groups, np.min_scalar_type(n_groups)  # short integers sort much faster
    for part in _blocks(len(group), GATHERED):
        here, weights = group[part].astype(short), None
        if factors is not None:  # those left out are a last group, of no sums
            here = np.where(factors[part] > 0.0, here, short.type(left_out))
            weights = None if equal else factors[part]
        _add_block(sums, problem, part, here, weights)
    return sums


def _add_block(
    sums: NormalSums, problem: Problem, part: slice, group: NDArray[np.integer[Any]], factors: Array | Flags | None
) -> None:
    """Add sources to the sums of their groups (n,); those of a group beyond the last have no part in them."""
    objects, years, left = problem.sources(part)
    if factors is not None:
        left = left.scaled(factors)
    if np.any(group[1:] < group[:-1]):  # sorted after the elimination, when there is less to move
        order = np.argsort(group, kind="stable")
        group, objects, left = group[order], objects.taken(order), left.taken(order)
        years = years[order] if np.any(years) else years
    for piece in _pieces(group[: np.searchsorted(group, len(sums))]):
        one, some = int(group[piece.start]), left.taken(piece)
        rows, derivatives = problem.unknowns.derivatives(objects.taken(piece), years[piece])
        weight, right, spread = some.onto(rows)
        sums.right[one] += derivatives.reshape(len(derivatives), -1) @ right.T.ravel()
        if sums.spread is not None:
            add_products(sums.spread[one], derivatives.copy(), spread)
        add_products(sums.normal[one], derivatives, weight)
        sums.squares[one] += some.squares.sum()
        sums.count[one] += some.count.sum()
        sums.expected[one] += some.expected.sum()


def _blocks(n: int, size: int, first: int = 0) -> Iterator[slice]:
    for start in range(first, n, size):
        yield slice(start, min(start + size, n))


def _pieces(group: NDArray[np.integer[Any]]) -> Iterator[slice]:
    """Yield runs of equal numbers, each at most a block long."""
    limits = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), len(group)]
    for first, last in pairwise(limits):
        yield from _blocks(last, BLOCK, first)


def add_products(total: Array, matrix: Array, weight: Array) -> None:
    """Add the sum over n sources of K' W K to ``total`` (K, K); ``matrix`` (K, r, n) is overwritten, and ``weight``
    (n, r, r) is symmetric.

    Where W has a root this is one product of a matrix with itself, of which NumPy computes one half: with l = 5 a pass
    over 1.6 million sources takes 1.5 instead of 2.4 s.
    """
    if _apply_root(matrix, weight):
        flat = matrix.reshape(len(total), -1)
        total += flat @ flat.T
        return
    by = range(matrix.shape[1])
    weighted = np.stack([sum(weight[:, i, j] * matrix[:, j] for j in by) for i in by], axis=1)
    total += matrix.reshape(len(total), -1) @ weighted.reshape(len(total), -1).T


def _apply_root(matrix: Array, weight: Array) -> bool:
    """Replace K by L' K with W = L L'; return False and change nothing unless W is regular, of one or two rows."""
    size, first = matrix.shape[1], weight[:, 0, 0]
    if size > 2 or not np.all(first > 0.0):
        return False
    if size == 1:
        matrix[:, 0] *= np.sqrt(first)
        return True
    second, cross = weight[:, 1, 1], weight[:, 0, 1]
    rest = second - cross**2 / first
    if not np.all(rest > REGULAR * second):
        return False
    root = np.sqrt(first)
    matrix[:, 0] *= root
    if np.any(cross):
        matrix[:, 0] += (cross / root) * matrix[:, 1]
    matrix[:, 1] *= np.sqrt(rest)
    return True


# ---- solutions

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


def covariance_of(matrices: Array) -> Array:
    """Return the covariance (K, K) of a solution with these sums of `NormalSums.matrices`; NaN where there is none."""
    try:
        inverse = inverted(matrices[0])
    except LinkError:
        return np.full(matrices.shape[1:], np.nan)
    return inverse if len(matrices) == 1 else np.asarray(inverse @ matrices[1] @ inverse)


def discrepancies(sums: NormalSums, estimate: Array) -> Array:
    """Return Q_i = yy_i - 2 b_i' x + x' N_i x of each source, chi2 of its residuals; shape (S,)."""
    quadratic = np.einsum("k,skl,l->s", estimate, sums.normal, estimate)
    return np.asarray(np.maximum(sums.squares - 2.0 * sums.right @ estimate + quadratic, 0.0))


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
    # n_i - tr(N^-1 N_i) where the weights are the best; a source that is left out has no part in the solution
    part = np.einsum("kl,slk->s", solution.inverse, sums.right_covariance) * factors
    shift = np.einsum("kl,slk->s", solution.covariance, sums.normal)
    return Influence(sums.expected - 2.0 * part + shift, without, cook, share)


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

    @property
    def expected(self) -> Array:
        """The average of Q_i of each source if the errors are right, its count for the best weights; shape (S,)."""
        return self.sums.expected

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

    # The sums of single sources are not kept.
    sums = None

    @cached_property
    def count(self) -> Array:
        """The number of observations of each source."""
        return self._of_each(source_numbers, "count", kind=np.float32)  # whole numbers, exact as float32

    @cached_property
    def expected(self) -> Array:
        """The average of Q_i of each source."""
        return self._of_each(source_numbers, "expected")

    def solve(self, factors: Array | Flags) -> Solution:
        """Return the solution with a factor of the weight of each source."""
        return solve(self.cell_sums(factors), self.labels)

    def discrepancies(self, estimate: Array) -> Array:
        """Return Q_i of a solution; shape (S,)."""
        return self._of_each(source_discrepancies, estimate)

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
            sums = reduce(lambda one, other: one.mapped(np.add, other), self.run(computed, pieces))
            self._last[:] = [(factors.copy(), sums.taken(sums.count > 0))]
        return self._last[0][1]

    def heaviest(self, number: int) -> tuple[Indices, NormalSums]:
        """Return the ``number`` sources with the largest weights, of equal ones the first, and their sums."""
        sizes, places, sums = np.zeros(0), np.zeros(0, dtype=np.int64), None
        for first, (size, place, one) in self._each(_heaviest, number):
            sizes, places = np.concatenate([sizes, size]), np.concatenate([places, first + place])
            order = np.argsort(-sizes, kind="stable")[:number]
            sizes, places = sizes[order], places[order]
            sums = one if sums is None else sums.mapped(lambda *both: np.concatenate(both), one).taken(order)
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
    """Return the sources of a problem, with the sums of each if these fit into memory.

    Raises LinkError for so many unknowns that they cannot be determined, and take too much memory to find out.
    """
    n, k = len(problem.satellite), len(problem.unknowns)
    if n * k**2 <= KEPT_NUMBERS:
        return KeptSources(problem, source_sums(problem), partial(separation, problem))
    if k > (number := np.count_nonzero(problem.rows.present)):
        raise LinkError(f"the tables do not tell {k} unknowns apart by {number} numbers")
    return StreamedSources(problem.unknowns.labels, (lambda: problem,), (0,), n, starmap)


def _cell_sums(problem: Problem, factors: Array | Flags | None) -> NormalSums:
    ra, dec = problem.satellite.values[:2]
    return group_sums(problem, sky_cells(ra, dec, DIVISIONS), 2 * DIVISIONS**2, factors)


def _heaviest(problem: Problem, number: int) -> tuple[Array, Indices, NormalSums]:
    sizes = _of_each(problem, lambda left: np.einsum("nkk->n", left.normal) * MAS**2)  # in mas and mas/yr
    places = np.argsort(-sizes, kind="stable")[:number]
    return sizes[places], places, source_sums(problem.only(places))


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
    if clip.kind == "rayleigh":
        return _rayleigh(sources)
    if clip.kind == "discrepancy":
        return _one_by_one(sources, clip.number)
    if clip.kind == "median":
        return _reweighted(sources, partial(_median_factors, clip.number))
    # of equal weights these are no sigmas; rounding is all that a source without observations has
    sigma = np.sqrt(np.maximum(sources.expected, 0.0) / np.maximum(sources.count, 1.0))
    return _reweighted(sources, partial(_huber_factors, clip.number * sigma))


def separation(problem: Problem) -> Array:
    """Return the normalised separation X of each source and its separation (rad); shape (2, S).

    X^2 = d' D^-1 d of the two differences d of position, or of motion where a row has no position (the separation is
    0 then); the largest of a source's rows.  X follows a Rayleigh distribution where the errors are right.  A row
    whose difference depends on a parameter that the satellite lacks counts as 0.
    """
    largest = np.zeros((2, len(problem.satellite)))
    for rows in _blocks(len(problem.rows), BLOCK):
        source = problem.source[rows]
        star = problem.satellite.taken(source)
        taken_out, each = problem.taken_out(star), np.arange(len(source))
        values = differences(star, problem.rows.taken(rows), each, taken_out, at_rest=problem.epoch)
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


def _rayleigh(sources: Sources) -> Clipped:
    normalised, plain = sources.separations()
    used = sources.count > 0
    limit = np.sqrt(2.0 * np.log(max(int(np.sum(used)), 2)))
    factors = used & (normalised <= limit) & (plain < SEPARATION_LIMIT)
    notes = []
    median = float(np.median(normalised[used]))
    robust = _reweighted(sources, partial(_median_factors, 5.0))
    kept = robust.factors > 0.0
    after = np.sqrt(2.0 * sources.discrepancies(robust.solution.estimate)[kept] / sources.count[kept])
    if median > 1.5 * MEDIAN_RAYLEIGH and np.median(after) < 0.75 * median:
        said = f"the frames differ by more than the errors (median X {median:.3g}, {np.median(after):.3g} after a fit)"
        notes.append(f"{said}, so a clip before the fit drops good sources: use median or discrepancy")
    try:
        solution = sources.solve(factors)
    except LinkError as error:
        raise LinkError("; ".join([f"after the clip rayleigh {error}", *notes])) from None
    return Clipped(factors, solution, notes=notes)


def _reweighted(sources: Sources, weigh: Callable[[Array, Flags], Array | Flags]) -> Clipped:
    """Solve, weigh the sources by their residuals sqrt(Q_i/n_i), and so on until their factors stay the same."""
    used = sources.count > 0
    factors: Array | Flags = used
    trajectory, notes, seen = [sources.solve(used)], list[str](), {hash(used.tobytes())}
    for _ in range(ITERATIONS):
        new = weigh(_normalised(sources, trajectory[-1], used), used)
        change = np.subtract(new, factors, dtype=np.float64)
        if np.max(np.abs(change, out=change)) < 1e-12:
            break
        del change  # of millions of sources
        factors = new
        trajectory.append(sources.solve(factors))
        if (mark := hash(factors.tobytes())) in seen:
            notes.append("the clip returned to an earlier selection of sources and was ended there")
            break
        seen.add(mark)
    else:
        notes.append(f"the weights of the clip still changed after {ITERATIONS} iterations")
    return Clipped(factors, trajectory[-1], [-1] * len(trajectory), trajectory, len(trajectory) - 1, notes)


def _median_factors(k: Any, residual: Array, used: Flags) -> Flags:
    return np.asarray(used & (residual <= k * np.median(residual[used], overwrite_input=True)))


def _huber_factors(c: Any, residual: Array, used: Flags) -> Array:
    return np.where(used, np.minimum(1.0, c / np.maximum(residual, 1e-300)), 0.0)


def _normalised(sources: Sources, solution: Solution, used: Flags) -> Array:
    """Return sqrt(Q_i/n_i) of each source, zero without observations; in place, for millions of them."""
    residual = sources.discrepancies(solution.estimate)
    np.divide(residual, sources.count, out=residual, where=used)
    np.sqrt(residual, out=residual)
    residual[~used] = 0.0
    return residual


def _one_by_one(sources: Sources, number: Any) -> Clipped:
    """Drop the source with the largest Q_i over its average, solve again, and so on.

    The step that is chosen is that after ``number`` sources, or the first at which the largest Q_i is not significant
    among so many.  The trajectory goes on beyond it where the sums of sources are kept.
    """
    used = sources.count > 0
    factors = used.astype(np.float64)
    dropped, trajectory = [-1], [sources.solve(factors)]
    chosen: int | None = number
    while len(trajectory) <= max(TRAJECTORY, number or 0) and factors.sum() > 1:
        squares = sources.discrepancies(trajectory[-1].estimate)
        ratios = np.divide(squares, sources.expected, out=-np.ones_like(squares), where=factors > 0.0)
        worst = int(np.argmax(ratios))
        n = sources.count[worst]
        if chosen is None and chdtrc(n, n * ratios[worst]) * factors.sum() > SIGNIFICANCE:
            chosen = len(trajectory) - 1
        if sources.sums is None and chosen == len(trajectory) - 1:
            break  # a further step is a pass over the table
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
