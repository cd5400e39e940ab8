"""What points of one block have in common, found by content: arrays over objects that begin with the same objects.

Common random numbers give catalogues that are nested and missions that see the same sky.  What depends on an object
alone, to the last bit, is computed for the largest catalogue, and the others use the beginning of that array: the same
memory, by which common sums over objects are recognised too.
"""

from collections.abc import Callable, Hashable

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.blocks import Objects

PART = 2048
"""Objects whose products are added up at a time: it decides how the sums are rounded."""

PREPARED = 16384
"""Objects that are prepared at a time, so that intermediate arrays of 128 KiB stay near the core."""


def parts(n_obj: int, size: int = PART) -> list[slice]:
    """Return the slices of at most ``size`` objects that make up a catalogue."""
    return [slice(start, min(start + size, n_obj)) for start in range(0, n_obj, size)]


def origin(rows: Array) -> Hashable:
    """Return what contiguous arrays in use have in common only if they begin at the same place in memory."""
    return rows.__array_interface__["data"][0], rows.shape[1:]


class Prefixes:
    """Arrays over objects that have been computed for a block; ask for those of the largest catalogue first."""

    def __init__(self) -> None:
        self._known: dict[Hashable, list[tuple[tuple[Array, ...], list[Hashable], Array]]] = {}
        self._products: dict[Hashable, Array] = {}
        self._objects: dict[Hashable, list[tuple[slice, Objects]]] = {}

    def once(self, settings: Hashable, compute: Callable[..., Array], *objects: Array) -> Array:
        """Return ``compute(*objects)``, arrays whose first axis is that of the objects.

        ``settings`` identify the computation; a row of the result may only depend on them and on that row of the
        arguments.
        """
        known, origins = self._known.setdefault(settings, []), [origin(rows) for rows in objects]
        n_obj = len(objects[0])
        for larger, theirs, result in known:
            pairs = zip(origins, theirs, objects, larger, strict=True)
            if n_obj <= len(result) and all(a == b or _begin_alike(part, whole) for a, b, part, whole in pairs):
                return result[:n_obj]
        result = compute(*objects)
        known.append((objects, origins, result))
        return result

    def objects(self, ra: Array, dec: Array, pmra: Array, pmdec: Array) -> list[tuple[slice, Objects]]:
        """Return the parts of a catalogue and the objects in each, made once for all callers."""
        key = tuple((origin(column), len(column)) for column in (ra, dec, pmra, pmdec))
        if key not in self._objects:
            slices = parts(len(ra), PREPARED)
            self._objects[key] = [(part, Objects(ra[part], dec[part], pmra[part], pmdec[part])) for part in slices]
        return self._objects[key]

    def products(self, columns: Array) -> Array:
        """Return the sum over objects and observables of the products of columns (..., N, 4, C); shape (..., C, C).

        It is added up part by part, and a part is multiplied once for all columns that begin there.
        """
        *stack, n_obj, _, number = columns.shape
        total = np.zeros((*stack, number, number))
        for part in parts(n_obj):
            rows = columns[..., part, :, :]
            place = origin(rows), rows.shape
            if (product := self._products.get(place)) is None:
                flat = rows.reshape(*stack, -1, number)
                product = self._products[place] = flat.swapaxes(-1, -2) @ flat
            total += product
        return total


def _begin_alike(part: Array, whole: Array) -> bool:
    """Whether the bits of an array are those that another one begins with."""
    return np.array_equal(part.view(np.uint64), whole[: len(part)].view(np.uint64))
