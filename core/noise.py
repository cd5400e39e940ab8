"""Unit normals in the order that every link draws them, and the errors that one side makes of them.

Realisations come in chunks of `ROWS`, each with a stream of its own for the satellite and one for the reference.  A
stream runs through the objects: 4 observables of object 0 in all realisations of the chunk, then object 1.  So what
object i gets depends neither on how many objects follow nor on what the other side or another point needs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from linksweep.core.arrays import Array, Stack
from linksweep.core.catalogue import Catalogue
from linksweep.core.errors import ErrorModel
from linksweep.core.shared_arrays import Prefixes
from linksweep.core.systematics import DrawnField, Field, ZonalErrors

ROWS = 512
"""Realisations drawn at a time."""

TILE = 65536
"""Normals drawn at a time: 512 KiB stay in a core's own cache."""


def chunks(n_sim: int) -> Iterator[int]:
    """Yield the numbers of realisations of each chunk."""
    for start in range(0, n_sim, ROWS):
        yield min(ROWS, n_sim - start)


def tile_objects(rows: int) -> int:
    """Return how many objects a tile holds; it depends on ``rows`` alone, so other points do not change the tiles."""
    return max(1, TILE // (4 * rows))


@dataclass(frozen=True)
class Tile:
    """Unit normals (..., objects, 4, rows) of one side, for the objects from ``start`` on; for a stack of catalogues
    the first axis is that of the catalogues.
    """

    start: int
    normals: Array

    def head(self, n_obj: int) -> Array:
        """Return the part that belongs to a catalogue of ``n_obj`` objects."""
        return self.normals[..., : max(0, n_obj - self.start), :, :]


def tiles(rngs: Sequence[np.random.Generator], stack: Stack, rows: int, n_obj: int) -> Iterator[Tile]:
    """Yield the unit normals of ``n_obj`` objects of the catalogues of a stack, from a generator of each; a tile is
    valid until the next one.
    """
    objects = tile_objects(rows)
    # full size even for few objects: where an array begins in memory must not depend on the points that share it
    buffer = np.empty((*stack, min(objects, n_obj) if stack else objects, 4, rows))
    for start in range(0, n_obj, objects):
        part = buffer[..., : n_obj - start, :, :]
        for rng, own in zip(rngs, part if stack else [part], strict=True):
            rng.standard_normal(out=own)
        yield Tile(start, part)


@dataclass(frozen=True)
class Noise:
    """True errors of one side: standard errors (N, 4) and, where they are correlated, Cholesky factors (N, 4, 4).

    They are ``inflation`` times the errors in the weights.  A ``field`` has further errors, which objects share.
    """

    sigma: Array
    factor: Array | None
    inflation: float = 1.0
    field: Field | None = None

    @staticmethod
    def of(model: ErrorModel, catalogue: Catalogue, shared: Prefixes) -> "Noise":
        """Return the errors that a model gives the objects of a catalogue."""

        def compute(*_: Array) -> Array:
            return np.ascontiguousarray(model.standard_errors(catalogue).T)

        correlation = model.correlation(catalogue)
        sigma = shared.once(("errors", model), compute, catalogue.v_mag) if model.is_elementwise() else compute()
        return Noise(sigma, None if correlation is None else np.asarray(np.linalg.cholesky(correlation)))

    def inflated(self, factor: float) -> "Noise":
        """Return errors ``factor`` times as large, with the same weights."""
        if factor == 1.0 or not self._any:
            return self
        return replace(self, sigma=factor * self.sigma, inflation=factor * self.inflation)

    def with_zonal(self, errors: ZonalErrors | None, catalogue: Catalogue) -> "Noise":
        """Return these errors with zonal errors of the objects of a catalogue added."""
        return self if errors is None else replace(self, field=Field(errors, catalogue.ra, catalogue.dec))

    def __bool__(self) -> bool:
        return self.field is not None or self._any

    @cached_property
    def _any(self) -> bool:
        return bool(np.any(self.sigma))

    @property
    def as_weighed(self) -> bool:
        """Whether all errors are independent and equal to those in the weights."""
        return self.factor is None and self.field is None and self.inflation == 1.0

    @property
    def ratio(self) -> float:
        """The errors of single objects over those in the weights; 0 where only a field has errors."""
        return self.inflation if self._any else 0.0

    def draw_field(self, rows: int, rng: np.random.Generator) -> DrawnField | None:
        """Return ``rows`` realisations of the errors that objects share, or None."""
        return None if self.field is None else self.field.draw(rows, rng)

    def standardised(self, normals: Array, start: int) -> Array:
        """Return errors in units of their sigma from the unit normals (m, 4, rows) of the objects from ``start`` on."""
        return normals if self.factor is None else self.factor[start : start + len(normals)] @ normals

    def variance_through(self, gain: Array) -> Array:
        """Return the variance of each unknown from these errors; ``gain`` (N, 4, K), result (K,)."""
        scaled = self.sigma[..., None] * gain
        if self.factor is not None:
            scaled = np.swapaxes(self.factor, 1, 2) @ scaled
        variance = np.asarray(np.einsum("nik,nik->k", scaled, scaled))
        return variance if self.field is None else variance + self.field.variance_through(gain)
