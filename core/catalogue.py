"""A reference catalogue (step A): its objects, the errors that it lists for them, and where they may stand."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from linksweep.core.frames import GALACTIC_AXES, Array, position

SIDES = ("reference", "satellite")


@dataclass(frozen=True)
class OwnErrors:
    """Errors that a catalogue lists for its objects: ``sigma`` (4, N), ``correlation`` (N, 4, 4) as in `Catalogue`."""

    sigma: Array
    correlation: Array | None = None


@dataclass(frozen=True)
class Catalogue:
    """Objects as arrays of shape (N,): ra, dec (rad), pmra, pmdec (rad/yr, pmra with cos dec) and V magnitude.  While
    several catalogues are drawn together the shape is (catalogues, N).

    ``sigma`` (4, N), where the catalogue has its own errors, are those of (ra*, dec, pmra, pmdec) in rad and rad/yr,
    ``correlation`` (N, 4, 4) the correlations of an object's four errors.  They are those of the satellite where the
    ``reference`` has its own.
    """

    ra: Array
    dec: Array
    pmra: Array
    pmdec: Array
    v_mag: Array
    sigma: Array | None = None
    correlation: Array | None = None
    reference: OwnErrors | None = None

    def __len__(self) -> int:
        return int(self.ra.shape[-1])

    def take(self, index: NDArray[np.intp] | slice) -> "Catalogue":
        """Return the objects at these indices."""
        return self._mapped(lambda array, axis: array[(slice(None),) * axis + (index,)])

    def some(self, rng: np.random.Generator, n_obj: int) -> "Catalogue":
        """Return ``n_obj`` objects at random, in their order; if there are no more, all of them without a draw."""
        if n_obj >= len(self):
            return self
        chosen = np.sort(rng.choice(len(self), n_obj, replace=False))
        if self.ra.ndim == 1:
            return self.take(chosen)
        return self.flattened().take(chosen + len(self) * np.arange(len(self.ra))[:, None])

    def repeated(self, catalogues: int) -> "Catalogue":
        """Return the same objects for each of several catalogues; shape (catalogues, N)."""
        return self.take(np.tile(np.arange(len(self)), (catalogues, 1)))

    def flattened(self) -> "Catalogue":
        """Return the objects of all catalogues that are drawn together, one after the other."""
        ndim = self.ra.ndim
        return self._mapped(lambda array, axis: array.reshape(*array.shape[:axis], -1, *array.shape[axis + ndim :]))

    def own_errors(self, side: str) -> OwnErrors | None:
        """Return the errors that the catalogue lists for a side, "reference" or "satellite"; None if there are none."""
        if side == "reference" and self.reference is not None:
            return self.reference
        return None if self.sigma is None else OwnErrors(self.sigma, self.correlation)

    def moved_to(self, ra: Array, dec: Array) -> "Catalogue":
        """Return the same objects, with their proper motions along the local triad, at other positions."""
        return replace(self if ra.ndim == self.ra.ndim else self.repeated(len(ra)), ra=ra, dec=dec)

    def _mapped(self, each: Callable[[Array, int], Array]) -> "Catalogue":
        """Return a catalogue with a function of an array and its first axis of objects applied to all arrays."""

        def maybe(array: Array | None, axis: int) -> Array | None:
            return None if array is None else each(array, axis)

        ra, dec, pmra, pmdec, v_mag = (each(a, 0) for a in (self.ra, self.dec, self.pmra, self.pmdec, self.v_mag))
        other = self.reference
        reference = None if other is None else OwnErrors(each(other.sigma, 1), maybe(other.correlation, 0))
        return Catalogue(ra, dec, pmra, pmdec, v_mag, maybe(self.sigma, 1), maybe(self.correlation, 0), reference)


@dataclass(frozen=True)
class NestedDraw:
    """Draw a catalogue of ``n_obj`` objects; from equal generators it is the beginning of any larger one of its family.

    With ``takes_several`` it also draws several together, see `CatalogueKind.draws_several`.
    """

    family: Hashable
    n_obj: int
    draw: Callable[[np.random.Generator], Catalogue]
    takes_several: bool = False

    def __call__(self, rng: np.random.Generator) -> Catalogue:
        """Draw it."""
        return self.draw(rng)


@dataclass(frozen=True)
class Sky:
    """Where objects may stand: uniform over the sky with two exceptions.

    There are none at Galactic latitudes |b| < ``zone_of_avoidance`` (rad), and (1 + contrast)/(1 - contrast) times as
    many north of the Galactic plane as south of it (-1 < ``contrast`` < 1).
    """

    zone_of_avoidance: float = 0.0
    contrast: float = 0.0

    def positions(self, rng: np.random.Generator, n_obj: int) -> tuple[Array, Array]:
        """Return ra, dec (rad) of shape (n_obj,), or (catalogues, n_obj) of several that are drawn together."""
        longitude = rng.uniform(0.0, 2.0 * np.pi, n_obj)
        height = rng.uniform(-1.0, 1.0, n_obj) + self.contrast  # uniform on each side of the plane, more on one
        north = height > 0.0
        fraction = height / np.where(north, 1.0 + self.contrast, 1.0 - self.contrast)
        floor = np.sin(self.zone_of_avoidance)
        sin_b = np.where(north, floor, -floor) + (1.0 - floor) * fraction
        cos_b = np.sqrt(1.0 - sin_b**2)
        galactic = np.stack([cos_b * np.cos(longitude), cos_b * np.sin(longitude), sin_b], axis=-2)
        return position(np.moveaxis(GALACTIC_AXES.T @ galactic, -2, 0))


WHOLE_SKY = Sky()
