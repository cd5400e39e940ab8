"""Reference catalogues (step A): the record, positions on the sky, and catalogues drawn from simple laws."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from linksweep.core.arrays import Array
from linksweep.core.constants import DEGREE, GALACTIC_AXES, MAS
from linksweep.core.frames import position
from linksweep.core.radio_stars import RADIO_STARS

PmDistribution = Literal["uniform", "constant", "rayleigh"]

SIDES = ("reference", "satellite")

N_GALAXIES = 116
"""Certain galaxies in Tycho-2.  Source: Metz & Geffert 2004, Sect. 3.2 and Table 1."""

GALAXY_MEAN_MAG, GALAXY_SCATTER_MAG, GALAXY_FAINT_LIMIT_MAG = 12.5, 0.5, 13.5
"""V_T of the galaxies in Tycho-2.  Source: Metz & Geffert 2004, Sect. 3.2 (mean 12.5); scatter and limit are
estimates.
"""


@dataclass(frozen=True)
class OwnErrors:
    """Errors that a catalogue lists for its objects: ``sigma`` (4, N), ``correlation`` (N, 4, 4) as in `Catalogue`."""

    sigma: Array
    correlation: Array | None = None

    def take(self, index: NDArray[np.intp] | slice) -> "OwnErrors":
        """Return those of the objects at these indices."""
        return OwnErrors(self.sigma[:, index], None if self.correlation is None else self.correlation[index])

    def flattened(self) -> "OwnErrors":
        """Return those of all catalogues that are drawn together, one after the other."""
        correlation = None if self.correlation is None else self.correlation.reshape(-1, 4, 4)
        return OwnErrors(self.sigma.reshape(4, -1), correlation)


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
        return self._made(lambda column: column[index], lambda errors: errors.take(index))

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
        return self._made(lambda column: column.reshape(-1), OwnErrors.flattened)

    def own_errors(self, side: str) -> OwnErrors | None:
        """Return the errors that the catalogue lists for a side, "reference" or "satellite"; None if there are none."""
        if side == "reference" and self.reference is not None:
            return self.reference
        return None if self.sigma is None else OwnErrors(self.sigma, self.correlation)

    def moved_to(self, ra: Array, dec: Array) -> "Catalogue":
        """Return the same objects, with their proper motions along the local triad, at other positions."""
        objects = self if ra.ndim == self.ra.ndim else self.repeated(len(ra))
        return replace(objects, ra=ra, dec=dec)

    def _made(self, column: Callable[[Array], Array], errors: Callable[[OwnErrors], OwnErrors]) -> "Catalogue":
        """Return a catalogue with the functions applied to each column and to the errors of either side."""
        sides = self.own_errors("satellite"), self.reference
        own, reference = (None if side is None else errors(side) for side in sides)
        return Catalogue(
            ra=column(self.ra),
            dec=column(self.dec),
            pmra=column(self.pmra),
            pmdec=column(self.pmdec),
            v_mag=column(self.v_mag),
            sigma=None if own is None else own.sigma,
            correlation=None if own is None else own.correlation,
            reference=reference,
        )


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


def synthetic(
    rng: np.random.Generator,
    n_obj: int,
    v_min: float,
    v_max: float,
    sky: Sky = Sky(),
    mean_pm: float = 0.0,
    pm_distribution: PmDistribution = "uniform",
) -> Catalogue:
    """Return objects with uniform magnitudes and isotropic proper motions of mean modulus ``mean_pm`` (rad/yr).

    The paper has "equally distributed apparent brightnesses and proper motions" (Metz & Geffert 2004, Sect. 4.1); that
    the modulus of a proper motion is uniform between 0 and twice its mean is our reading of it.  "rayleigh" is that of
    two normal components, "constant" the same for all.
    """
    ra, dec = sky.positions(rng, n_obj)
    v_mag = rng.uniform(v_min, v_max, n_obj)
    uniform = rng.random(n_obj)
    modulus = {
        "uniform": 2.0 * uniform,
        "constant": np.ones(n_obj),
        "rayleigh": np.sqrt(-4.0 / np.pi * np.log1p(-uniform)),
    }[pm_distribution] * mean_pm
    direction = rng.uniform(0.0, 2.0 * np.pi, n_obj)
    return Catalogue(ra, dec, modulus * np.sin(direction), modulus * np.cos(direction), v_mag)


def galaxies(
    rng: np.random.Generator,
    n_obj: int,
    faint_limit_mag: float,
    sky: Sky = Sky(),
    bright_limit_mag: float | None = None,
) -> Catalogue:
    """Return galaxies without proper motion, their magnitudes normal about 12.5 +- 0.5 and cut off at the faint limit,
    and at the bright one if there is any.
    """
    from scipy.special import ndtr, ndtri  # here: it takes a tenth of the start of every other study

    ra, dec = sky.positions(rng, n_obj)
    bright = -np.inf if bright_limit_mag is None else bright_limit_mag
    low, high = ndtr((np.array([bright, faint_limit_mag]) - GALAXY_MEAN_MAG) / GALAXY_SCATTER_MAG)
    v_mag = GALAXY_MEAN_MAG + GALAXY_SCATTER_MAG * ndtri(low + (high - low) * (1.0 - rng.random(n_obj)))
    return Catalogue(ra, dec, np.zeros_like(ra), np.zeros_like(ra), v_mag)


def radio_stars() -> Catalogue:
    """Return the 11 radio stars with their proper motions and VLBI errors; no position errors are given for them."""
    stars = RADIO_STARS
    none = np.zeros(len(stars.v_mag))
    return Catalogue(
        ra=stars.ra_deg * DEGREE,
        dec=stars.dec_deg * DEGREE,
        pmra=stars.pmra * MAS,
        pmdec=stars.pmdec * MAS,
        v_mag=stars.v_mag,
        sigma=np.stack([none, none, stars.pmra_error, stars.pmdec_error]) * MAS,
    )


def resample(rng: np.random.Generator, catalogue: Catalogue, n_obj: int, sky: Sky | None) -> Catalogue:
    """Return ``n_obj`` objects drawn with replacement, at their own positions or (with a ``sky``) at random ones.

    Magnitude, proper motion and errors of an object stay together.
    """
    drawn = catalogue.take(rng.integers(0, len(catalogue), n_obj))
    return drawn if sky is None else drawn.moved_to(*sky.positions(rng, n_obj))
