"""The tables of a link, what is asked of them, the five parameters of each source eliminated from its
rows, and the sums of normal equations, of each source or of groups of sources.

With f the differences of a source's rows, M their derivatives by its five parameters, V the rows' covariance and C that
of the satellite, the covariance of f is D = V + M C M'.  The elimination leaves W = M' D^-1 M, w = M' D^-1 f and
yy = f' D^-1 f, which with J = M' V^-1 M and g = M' V^-1 f are (I + J C)^-1 J, (I + J C)^-1 g and
sum f' V^-1 f - g' C w.  This form needs neither C nor V nor J to be invertible: only a difference must have an error.
A parameter that the satellite lacks is free: it is eliminated from W as an unknown of its source.  Millions of sources
have one row each, of their own epoch; for these there is a closed form.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from linksweep.core.frames import MAS, Array, Flags, Indices
from linksweep.core.link import LinkError
from linksweep.core.tie.astrometry import PAIRS, Astrometry, Differences, differences, offsets
from linksweep.core.unknowns import Objects, Unknowns

# Eigenvalue of a scaled 5 x 5 matrix below which a free parameter is not determined by the rows.
UNDETERMINED = 1e-12

# Sources whose derivatives are made at a time: a few hundred numbers each, which stay in the cache.
BLOCK = 4096

# Sources that are taken out of the tables at a time, which bounds the memory beyond that of the tables.
GATHERED = 64 * BLOCK


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
            return self._mapped(lambda array: array[part])
        return self._mapped(lambda array: np.take(array, part, axis=0))

    def scaled(self, factors: Array | Flags) -> Self:
        """Return the same with the weight of each source multiplied by a factor (G,)."""
        weighted = self._mapped(lambda array: array * factors.reshape(-1, *[1] * (array.ndim - 1)))
        return replace(weighted, count=self.count, spread=self.right_covariance * factors[:, None, None] ** 2)

    def plus(self, other: Self) -> Self:
        """Return the sums of both, group by group."""
        return self._mapped(np.add, other)

    def followed_by(self, other: Self) -> Self:
        """Return the groups of both, one after the other."""
        return self._mapped(lambda one, two: np.concatenate([one, two]), other)

    def _mapped(self, each: Callable[..., Array], *others: Self) -> Self:
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
    """Return what `eliminate` returns for the best weights, if row i is the only one of source i, all rows are
    positions at the sources' epochs or all are motions, and the satellite has both coordinates; None otherwise.

    All rows are in the reference's frame.  The row is then the difference itself: W is the inverse of V + C, and
    nothing is eliminated.
    """
    pair, absent = ((3, 4), (0, 1, 2)) if np.all(np.isfinite(rows.errors[3])) else ((0, 1), (2, 3, 4))
    inside, not_inside = list(pair), list(absent)
    complete = np.all(rows.present[inside]) and np.all(satellite.present[inside]) and satellite.further is None
    if not complete or np.any(np.isfinite(rows.errors[not_inside])) or np.any(rows.frame):
        return None
    if pair == (0, 1):
        same_epoch = np.isnan(rows.epoch) | np.isnan(satellite.epoch) | (rows.epoch == satellite.epoch)
        if np.any(rows.apparent) or not np.all(same_epoch):
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
    unknowns.  ``known`` holds unknowns with known values, whose effect is taken out before the solution.
    """

    satellite: Astrometry
    rows: Astrometry
    source: Indices
    unknowns: Unknowns
    epoch: float
    weights: str = "covariance"
    known: tuple[Unknowns, Array] | None = None

    def sources(self, part: Indices) -> tuple[Objects, Array, Eliminated]:
        """Return the objects, years and eliminated rows of some sources."""
        consecutive = len(part) and part[-1] - part[0] == len(part) - 1 and np.all(np.diff(part) == 1)
        # a slice needs no copy
        chosen = slice(int(part[0]), int(part[-1]) + 1) if consecutive else part
        star, source = self._needed.taken(chosen), np.arange(len(part))
        if self._one_each:
            rows = self.rows.taken(chosen)
        else:
            order, first = self._order
            counts = first[part + 1] - first[part]
            source = np.repeat(source, counts)
            inside = np.arange(len(source)) - np.repeat(np.cumsum(counts) - counts, counts)
            rows = self.rows.taken(order[np.repeat(first[part], counts) + inside])
        taken_out, left = self.taken_out(star), None
        if self.weights == "covariance" and np.array_equal(source, np.arange(len(part))):
            left = eliminate_simple(star, rows, taken_out)
        if left is None:
            offset = differences(star, rows, source, taken_out, self.unknowns.frames)
            try:
                left = eliminate(offset, source, star.covariance(), ~star.present.T, self.weights)
            except LinkError as error:
                number = int(str(error).partition("source ")[2].split()[0])
                names = self.satellite.names
                name = str(part[number] + 1) if names is None else repr(str(names[part[number]]))
                raise LinkError(str(error).replace(f"source {number}", f"source {name}")) from None
        return *self.objects(star), left

    def only(self, sources: Indices) -> "Problem":
        """Return the problem of some sources, in any order, and their rows."""
        place = np.full(len(self.satellite), -1)
        place[sources] = np.arange(len(sources))
        rows = np.flatnonzero(place[self.source] >= 0)
        return replace(
            self, satellite=self.satellite.taken(sources), rows=self.rows.taken(rows), source=place[self.source[rows]]
        )

    def differences(self) -> Differences:
        """Return the differences of all rows, without the effect of the known unknowns."""
        star = self.satellite
        return differences(star, self.rows, self.source, self.taken_out(star), self.unknowns.frames)

    def objects(self, star: Astrometry) -> tuple[Objects, Array]:
        """Return the data for derivatives, and the epoch of each source minus that of the unknowns."""
        ra, dec = star.values[:2]
        pmra, pmdec = np.nan_to_num(star.values[3:])
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
    def _one_each(self) -> bool:
        """True if row i is the only one of source i."""
        return len(self.source) == len(self.satellite) and np.array_equal(self.source, np.arange(len(self.source)))

    @cached_property
    def _order(self) -> tuple[Indices, Indices]:
        """Rows sorted by source, and where those of each source begin."""
        n_rows = np.bincount(self.source, minlength=len(self.satellite))
        return np.argsort(self.source, kind="stable"), np.concatenate([[0], np.cumsum(n_rows)])


def _by_blocks(problem: Problem) -> Iterator[tuple[Indices, Eliminated, Array, tuple[Array, Array, Array]]]:
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


def source_counts(problem: Problem) -> Array:
    """Return the number of observations of each source less that of its free parameters; shape (S,)."""
    return _of_each(problem, lambda left: left.count)


def weight_sizes(problem: Problem) -> Array:
    """Return the sum of the diagonal of each source's W, in mas^-2 and (mas/yr)^-2; shape (S,)."""
    return _of_each(problem, lambda left: np.einsum("nkk->n", left.normal) * MAS**2)


def _of_each(problem: Problem, value: Callable[[Eliminated], Array]) -> Array:
    blocks = _blocks(len(problem.satellite), GATHERED)
    return np.concatenate([np.zeros(0), *(value(problem.sources(part)[2]) for part in blocks)])


def group_sums(
    problem: Problem, group: NDArray[np.integer[Any]], n_groups: int, factors: Array | Flags | None = None
) -> NormalSums:
    """Return the sums of each group of sources; ``group`` (S,) counts from 0.  Memory is that of a block.

    ``factors`` (S,) multiply the weights; a source with 0 is not read.
    """
    if factors is not None and np.all(factors == 1.0):
        factors = None
    equal = factors is None or bool(np.all((factors == 0.0) | (factors == 1.0)))
    sums = NormalSums.zeros(n_groups, len(problem.unknowns), problem.weights != "covariance" or not equal)
    short = np.min_scalar_type(n_groups)  # short integers sort much faster
    for part in _blocks(len(group), GATHERED):
        chosen = part if factors is None else part[factors[part] > 0.0]
        _add_block(sums, problem, chosen, group[chosen].astype(short), None if equal else factors)
    return sums


def _add_block(
    sums: NormalSums, problem: Problem, chosen: Indices, group: NDArray[np.integer[Any]], factors: Array | Flags | None
) -> None:
    """Add sources to the sums of their groups (n,)."""
    objects, years, left = problem.sources(chosen)
    if factors is not None:
        left = left.scaled(factors[chosen])
    if np.any(group[1:] < group[:-1]):  # sorted after the elimination, when there is less to move
        order = np.argsort(group, kind="stable")
        group, objects, left = group[order], objects.taken(order), left.taken(order)
        years = years[order] if np.any(years) else years
    for piece in _pieces(group):
        one, some = int(group[piece.start]), left.taken(piece)
        rows, derivatives = problem.unknowns.derivatives(objects.taken(piece), years[piece])
        weight, right, spread = some.onto(rows)
        sums.right[one] += derivatives.reshape(len(derivatives), -1) @ right.T.ravel()
        if sums.spread is not None:
            add_products(sums.spread[one], derivatives, spread)
        add_products(sums.normal[one], derivatives, weight)
        sums.squares[one] += some.squares.sum()
        sums.count[one] += some.count.sum()
        sums.expected[one] += some.expected.sum()


def _blocks(n: int, size: int) -> Iterator[Indices]:
    for start in range(0, n, size):
        yield np.arange(start, min(start + size, n))


def _pieces(group: NDArray[np.integer[Any]]) -> Iterator[slice]:
    """Yield runs of equal numbers, each at most a block long."""
    limits = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), len(group)]
    for first, last in pairwise(limits):
        for start in range(first, last, BLOCK):
            yield slice(start, min(start + BLOCK, last))


def add_products(total: Array, matrix: Array, weight: Array) -> None:
    """Add the sum over n sources of K' W K to ``total`` (K, K); ``matrix`` (K, r, n) and ``weight`` (n, r, r)."""
    by = range(matrix.shape[1])
    weighted = np.stack([sum(weight[:, i, j] * matrix[:, j] for j in by) for i in by], axis=1)
    total += matrix.reshape(len(total), -1) @ weighted.reshape(len(total), -1).T
