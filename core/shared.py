"""What points of one block have in common: arrays over objects that begin with the same objects, and sums over them.

Common random numbers give catalogues that are nested and missions that see the same sky.  What depends on an object
alone, to the last bit, is computed for the largest catalogue, and the others use the beginning of that array: the same
memory, by which common sums are recognised.  These are added up once, tile by tile, and each catalogue takes the sum as
it stands where its objects end.
"""

from bisect import insort
from collections.abc import Callable, Hashable

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.noise import Tile
from linksweep.core.unknowns import Objects

PART = 2048
"""Objects whose products are added up at a time: it decides how the sums are rounded."""

PREPARED = 16384
"""Objects that are prepared at a time, so that intermediate arrays of 128 KiB stay near the core."""

Term = Callable[[Array, slice], Array]
"""A function that returns what unit normals (..., m, 4, rows) of the objects at a place add to a sum."""


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


class SharedSums:
    """The sums of one chunk of realisations over the satellite's normals."""

    def __init__(self) -> None:
        self._terms: dict[Hashable, Term] = {}
        self._sizes: dict[Hashable, list[int]] = {}
        self._totals: dict[Hashable, Array | float] = {}
        self._sums: dict[tuple[Hashable, int], Array | float] = {}

    def ask(self, what: Hashable, n_obj: int, term: Term) -> Callable[[], Array]:
        """Ask, before the first tile, for the sum of a term over ``n_obj`` objects, and return a function that gives
        it after the last one.

        ``what`` identifies the term among those that compute something else from the same objects; the term of the
        largest catalogue serves all.
        """
        sizes = self._sizes.setdefault(what, [])
        if n_obj not in sizes:
            insort(sizes, n_obj)
        if n_obj == sizes[-1]:
            self._terms[what] = term
        return lambda: np.asarray(self._sums[what, n_obj])

    def add(self, tile: Tile) -> None:
        """Add the objects of the next tile to all."""
        end = tile.start + tile.normals.shape[-3]
        for what, sizes in self._sizes.items():
            total, term = self._totals.get(what, 0.0), self._terms[what]
            while sizes and sizes[0] < end:
                n_obj = sizes.pop(0)
                self._sums[what, n_obj] = total + term(tile.head(n_obj), slice(tile.start, n_obj))
            if sizes:
                self._totals[what] = total + term(tile.normals, slice(tile.start, end))
            if sizes and sizes[0] == end:
                self._sums[what, sizes.pop(0)] = self._totals[what]
