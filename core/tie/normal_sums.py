"""Normal equations of the unknowns, kept for each source or for groups of sources."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.core.arrays import Array, Flags, Indices
from linksweep.core.constants import MAS
from linksweep.core.tie.problem import NormalSums, Problem

BLOCK = 4096
"""Sources whose derivatives are made at a time: a few hundred numbers each, which stay in the cache."""

GATHERED = 64 * BLOCK
"""Sources that are taken out of the tables at a time, which bounds the memory beyond that of the tables."""

REGULAR = 1e-6
"""The smallest determinant of a scaled 2 x 2 matrix at which its root is taken."""


def source_sums(problem: Problem) -> NormalSums:
    """Return the sums of each source."""
    n, k = len(problem.satellite), len(problem.unknowns)
    sums = NormalSums.zeros(n, k, problem.weights != "covariance")
    for part in _blocks(n, BLOCK):
        objects, years, left = problem.sources(part)
        rows, derivatives = problem.unknowns.derivatives(objects, years)
        weight, right, spread = left.onto(rows)
        matrix = np.moveaxis(derivatives, -1, 0)  # (n, K, rows)
        sums.normal[part] = matrix @ weight @ matrix.swapaxes(1, 2)
        if sums.spread is not None:
            sums.spread[part] = matrix @ spread @ matrix.swapaxes(1, 2)
        sums.right[part] = np.einsum("nkr,nr->nk", matrix, right)
        sums.squares[part], sums.count[part], sums.expected[part] = left.squares, left.count, left.expected
    return sums


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
            add_products(sums.spread[one], derivatives.copy(), spread)
        add_products(sums.normal[one], derivatives, weight)
        sums.squares[one] += some.squares.sum()
        sums.count[one] += some.count.sum()
        sums.expected[one] += some.expected.sum()


def source_counts(problem: Problem) -> Array:
    """Return the number of observations of each source less that of its free parameters; shape (S,)."""
    n = len(problem.satellite)
    return np.concatenate([problem.sources(part)[2].count for part in _blocks(n, GATHERED)]) if n else np.zeros(0)


def weight_sizes(problem: Problem) -> Array:
    """Return the sum of the diagonal of each source's W, in mas^-2 and (mas/yr)^-2; shape (S,)."""
    found = np.zeros(len(problem.satellite))
    for part in _blocks(len(found), GATHERED):
        weight = problem.sources(part)[2].normal
        found[part] = np.einsum("nkk->n", weight) * MAS**2
    return found


def source_discrepancies(problem: Problem, estimate: Array) -> Array:
    """Return Q_i of each source at a solution, without keeping its sums; shape (S,)."""
    squares = np.zeros(len(problem.satellite))
    for part in _blocks(len(squares), BLOCK):
        objects, years, left = problem.sources(part)
        rows, derivatives = problem.unknowns.derivatives(objects, years)
        shift = np.tensordot(estimate, derivatives, axes=1)
        weight, right, _ = left.onto(rows)
        squares[part] = left.squares - 2.0 * np.einsum("nr,rn->n", right, shift)
        squares[part] += np.einsum("rn,nrs,sn->n", shift, weight, shift)
    return np.maximum(squares, 0.0)


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
    """Add the sum over n sources of K' W K to ``total`` (K, K).

    Where W has a root this is one product of a matrix with itself, half the work of a general product.
    ``matrix`` (K, r, n) and ``weight`` (n, r, r), symmetric.  ``matrix`` is overwritten.
    """
    if _apply_root(matrix, weight):
        flat = matrix.reshape(len(total), -1)
        total += flat @ flat.T  # NumPy computes only one half of it
        return
    weighted = np.empty_like(matrix)
    for i in range(matrix.shape[1]):
        np.multiply(weight[:, i, i], matrix[:, i], out=weighted[:, i])
        for j in range(matrix.shape[1]):
            if i != j and np.any(element := weight[:, i, j]):
                weighted[:, i] += element * matrix[:, j]
    total += matrix.reshape(len(total), -1) @ weighted.reshape(len(total), -1).T


def _apply_root(matrix: Array, weight: Array) -> bool:
    """Replace K by L' K with W = L L'; return False and change nothing unless W is regular of one or two parameters."""
    size = matrix.shape[1]
    first = weight[:, 0, 0]
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
