"""What points of one block have in common, found by content: arrays over objects that begin with the same objects.

Common random numbers give catalogues that are nested and missions that see the same sky.  What follows for an object
from that object alone, to the last bit, is computed for the largest catalogue, and the others have the beginning of it:
the same memory, by which sums over objects know each other too.
"""

from collections.abc import Callable, Hashable

import numpy as np

from core.arrays import Array

PART = 2048
"""Objects that are prepared at a time, so that intermediate arrays stay in cache."""


def parts(n_obj: int) -> list[slice]:
    """Return the slices of at most `PART` objects that make up a catalogue."""
    return [slice(start, min(start + PART, n_obj)) for start in range(0, n_obj, PART)]


def origin(rows: Array) -> Hashable:
    """Return what tells an array from all that are alive and contiguous and do not begin as it does, in memory."""
    return rows.__array_interface__["data"][0], rows.shape[1:]


def place(rows: Array) -> Hashable:
    """Return what tells an array from all others that are alive and contiguous: where it begins and its shape."""
    return origin(rows), len(rows)


class Prefixes:
    """Arrays over objects that have been computed for a block; ask for those of the largest catalogue first."""

    def __init__(self) -> None:
        self._known: dict[Hashable, list[tuple[tuple[Array, ...], Array]]] = {}
        self._products: dict[Hashable, Array] = {}

    def once(self, settings: Hashable, compute: Callable[..., Array], *objects: Array) -> Array:
        """Return ``compute(*objects)``, arrays whose first axis is that of the objects.

        ``settings`` say which computation it is; what a row of the result is may only depend on them and on that row of
        the arguments.
        """
        known = self._known.setdefault(settings, [])
        for larger, result in known:
            if all(_begins(whole, part) for whole, part in zip(larger, objects, strict=True)):
                return result[: len(objects[0])]
        result = compute(*objects)
        known.append((objects, result))
        return result

    def products(self, columns: Array) -> Array:
        """Return the sum over objects and observables of the products of columns (..., N, 4, C); shape (..., C, C).

        It is added up part by part, and a part is multiplied once for all that have it.
        """
        *stack, n_obj, _, number = columns.shape
        total = np.zeros((*stack, number, number))
        for part in parts(n_obj):
            rows = columns[..., part, :, :]
            if place(rows) not in self._products:
                flat = rows.reshape(*stack, -1, number)
                self._products[place(rows)] = flat.swapaxes(-1, -2) @ flat
            total += self._products[place(rows)]
        return total


def _begins(whole: Array, part: Array) -> bool:
    """Whether one array begins with the bits of the other."""
    if len(part) > len(whole):
        return False
    beginning = whole[: len(part)]
    return place(beginning) == place(part) or np.array_equal(beginning.view(np.uint64), part.view(np.uint64))
