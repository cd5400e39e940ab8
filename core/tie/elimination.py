"""The five parameters of each source eliminated from its rows: weight matrices of what is left for the unknowns.

With f the differences of a source's rows, M their derivatives by its five parameters, V the rows' covariance and C that
of the satellite, the covariance of f is D = V + M C M'.  The elimination leaves W = M' D^-1 M, w = M' D^-1 f and
yy = f' D^-1 f, which with J = M' V^-1 M and g = M' V^-1 f are (I + J C)^-1 J, (I + J C)^-1 g and
sum f' V^-1 f - g' C w.  This form needs neither C nor V nor J to be invertible: only a difference must have an error.
A parameter that the satellite lacks is free: it is eliminated from W as an unknown of its source.  Millions of sources
have one row each, of their own epoch; for these there is a closed form.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from linksweep.core.arrays import Array, Flags, Indices
from linksweep.core.constants import MAS
from linksweep.core.link import LinkError
from linksweep.core.tie.astrometry import PAIRS, Astrometry
from linksweep.core.tie.differences import Differences
from linksweep.core.tie.motion import offsets
from linksweep.core.tie.sums import NormalSums

Weights = Literal["covariance", "variance", "equal"]

UNDETERMINED = 1e-12
"""Eigenvalue of a scaled 5 x 5 matrix below which a free parameter is not determined by the rows."""


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
        both = [(i, self.parameters.index(row)) for i, row in enumerate(rows) if row in self.parameters]
        into, at = [i for i, _ in both], [k for _, k in both]
        sources, size = range(len(self.right)), len(rows)
        weight, spread = np.zeros((2, len(sources), size, size))
        for found, known in ((weight, self.normal), (spread, self.right_covariance)):
            found[np.ix_(sources, into, into)] = known[np.ix_(sources, at, at)]
        right = np.zeros((len(sources), size))
        right[:, into] = self.right[:, at]
        return weight, right, spread


def eliminate(
    found: Differences, source: Indices, covariance: Array, free: Flags, weights: Weights = "covariance"
) -> Eliminated:
    """Return what is left of S sources.

    P is five for each frame.  ``source`` (R,) is that of each row; ``covariance`` C (S, 5, 5) and ``free`` (S, 5), true
    for parameters without an error, whose rows and columns in C are zero.  Weights are those of the covariance D, of
    its diagonal, or equal (an error of 1 mas and 1 mas/yr in each difference).  Raises LinkError where differences of a
    source have no error.
    """
    n_sources, size = len(covariance), found.by_frames.shape[-1]
    result = Eliminated.zeros(n_sources, size, weights != "covariance", parameters=tuple(range(size)))
    for sources, rows in _alike(found.present, source, n_sources):
        _observed(result, found, covariance, sources, rows, weights)
    which = free @ (1 << np.arange(5))
    for one in np.unique(which[which > 0]):
        sources = np.flatnonzero(which == one)
        _free(result, sources, np.flatnonzero(free[sources[0]]))
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
    result: Eliminated, found: Differences, covariance: Array, sources: Indices, rows: Indices, weights: Weights
) -> None:
    """Fill in W, w, yy of sources that are alike; parameters that a row lacks have zero derivatives and differences."""
    n, n_rows = rows.shape
    size = 5 * n_rows
    present = found.present[rows].reshape(n, size)
    used = np.flatnonzero(present.any(axis=0))
    if not len(used):
        return
    own = covariance[sources]
    partials = found.partials[rows].reshape(n, size, 5)[:, used]
    values = found.values[rows].reshape(n, size)[:, used]
    present = present[:, used]
    whole = partials @ own @ partials.swapaxes(1, 2)
    for row in range(n_rows):
        here = np.flatnonzero(used // 5 == row)
        inside = used[here] % 5
        whole[:, here[:, None], here] += found.covariance[rows[:, row]][:, inside[:, None], inside]
    diagonal = range(len(used))
    whole[:, diagonal, diagonal] += np.where(present, 0.0, MAS**2)
    variance = whole[:, diagonal, diagonal]
    if np.any(variance <= 0.0):
        raise LinkError(f"source {sources[np.argwhere(variance <= 0.0)[0][0]]} has a difference without any error")

    design = found.by_frames[rows].reshape(n, size, -1)[:, used]
    both = np.concatenate([design, values[..., None]], axis=2)
    if weights == "covariance":
        weighted = _solved(whole, variance, both, sources)
        trace = np.sum(present, axis=1)
    else:
        own_variance = variance if weights == "variance" else np.full_like(variance, MAS**2)
        weighted = both / own_variance[..., None]
        trace = np.sum(np.where(present, variance / own_variance, 0.0), axis=1)
        result.right_covariance[sources] = weighted[..., :-1].swapaxes(1, 2) @ whole @ weighted[..., :-1]
    products = both.swapaxes(1, 2) @ weighted
    weight = products[:, :-1, :-1]
    result.normal[sources] = 0.5 * (weight + weight.swapaxes(1, 2))
    result.right[sources] = products[:, :-1, -1]
    result.squares[sources] = products[:, -1, -1]
    result.count[sources] = np.sum(present, axis=1)
    result.expected[sources] = trace


def _solved(whole: Array, variance: Array, right: Array, sources: Indices) -> Array:
    """Return D^-1 times the right-hand sides, D scaled to a diagonal of 1."""
    scale = 1.0 / np.sqrt(variance)
    scaled = whole * scale[:, :, None] * scale[:, None, :]
    right = right * scale[..., None]
    if scaled.shape[1] <= 2:  # in closed form, for millions of sources
        cross = scaled[:, 0, -1] if scaled.shape[1] == 2 else np.zeros(len(scaled))
        determinant = (1.0 - cross) * (1.0 + cross)
        _require_regular(determinant > UNDETERMINED, sources)
        found = (right - cross[:, None, None] * right[:, ::-1]) / determinant[:, None, None]
    else:
        _require_regular(np.linalg.eigvalsh(scaled)[:, 0] > UNDETERMINED / 1e3, sources)
        found = np.asarray(np.linalg.solve(scaled, right), dtype=np.float64)
    return np.asarray(found * scale[..., None])


def _require_regular(good: Flags, sources: Indices) -> None:
    if not np.all(good):
        raise LinkError(
            f"the differences of source {sources[np.flatnonzero(~good)[0]]} have a combination without any error"
        )


def _free(result: Eliminated, sources: Indices, columns: Indices) -> None:
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
    if rows.frame is not None:
        return None
    motion, position = np.isfinite(rows.errors[3]), np.isfinite(rows.errors[0])
    if np.all(motion) and not np.any(position):
        pair = (3, 4)
    elif np.all(position) and not np.any(motion) and _same_epoch(satellite, rows):
        pair = (0, 1)
    else:
        return None
    inside = list(pair)
    absent = [row for row in range(5) if row not in pair]
    if np.any(np.isfinite(rows.errors[absent])) or not (
        np.all(rows.present[inside]) and np.all(satellite.present[inside])
    ):
        return None
    if pair == (0, 1):
        found = offsets(*rows.values[:2], *satellite.values[:2])
    else:
        found = rows.values[inside] - satellite.values[inside]
    if taken_out is not None:
        found = found - taken_out[inside]
    first, second, cross = (
        _covariance(satellite, i, j) + _covariance(rows, i, j) for i, j in (pair[:1] * 2, pair[1:] * 2, pair)
    )
    determinant = first * second - cross**2
    if not np.all((first > 0.0) & (second > 0.0) & (determinant > UNDETERMINED * first * second)):
        return None  # the general form names the source
    weight = np.empty((len(rows), 2, 2))
    weight[:, 0, 0], weight[:, 1, 1] = second / determinant, first / determinant
    weight[:, 0, 1] = weight[:, 1, 0] = -cross / determinant
    right = np.stack([weight[:, k, 0] * found[0] + weight[:, k, 1] * found[1] for k in range(2)], axis=1)
    two = np.full(len(rows), 2.0)
    squares = right[:, 0] * found[0] + right[:, 1] * found[1]
    return Eliminated(weight, right, squares, two, two, parameters=pair)


def _same_epoch(satellite: Astrometry, rows: Astrometry) -> bool:
    mean = rows.apparent is None or not np.any(rows.apparent)
    return mean and bool(np.all(np.isnan(rows.epoch) | np.isnan(satellite.epoch) | (rows.epoch == satellite.epoch)))


def _covariance(table: Astrometry, i: int, j: int) -> Array:
    product = table.errors[i] * table.errors[j]
    if i == j:
        return np.asarray(product)
    if table.correlations is None:
        return np.zeros(len(table))
    return np.asarray(np.nan_to_num(table.correlations[PAIRS.index((i, j))]) * product)
