"""Errors of the satellite that neighbours on the sky share: isotropic Gaussian random fields, drawn exactly.

A field is a sum of vector spherical harmonics, toroidal and spheroidal of equal power C_l ~ exp(-l (l + 1) L^2/2), the
Gaussian of width L on the sphere.  So the covariance of two objects' errors depends on their distance alone, with the
correlation sum (2 l + 1)/(4 pi) C_l d^l_11 in either direction (along the arc between them and across), close to
exp(-distance^2/(2 L^2)) where L is small.  Cost and memory grow with the number of objects, not with its square.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from math import ceil

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.harmonics import toroidal, turned
from linksweep.core.link import KINDS

REACH = 5.0
"""Degrees go up to this over the width: those beyond have exp(-12.5) of the power, which goes to those below."""

BASIS = 2**20
"""Numbers in the fields of the objects that are prepared at a time: 8 MiB."""


@dataclass(frozen=True)
class ZonalErrors:
    """RMS of a coordinate of position (rad) and proper motion (rad/yr), and the width of the kernel (rad)."""

    sigma_pos: float
    sigma_pm: float
    length: float

    @property
    def degree(self) -> int:
        """The highest degree."""
        return max(1, ceil(REACH / self.length))

    @property
    def coefficients(self) -> int:
        """The number of coefficients of position and proper motion together."""
        return 4 * self.degree * (self.degree + 2)

    @cached_property
    def power(self) -> Array:
        """C_l of the degrees from 1 on for a variance of 1 in a coordinate: sum of (2 l + 1)/(4 pi) C_l is 1."""
        degrees = np.arange(1, self.degree + 1)
        # relative to the first degree, so that very wide kernels do not underflow
        power = np.exp(-0.5 * (degrees * (degrees + 1) - 2) * self.length**2)
        return np.asarray(power / np.sum((2 * degrees + 1) / (4.0 * np.pi) * power))

    @cached_property
    def scatter(self) -> Array:
        """The standard deviation of each coefficient of one kind, in the order of `toroidal`; order 0 has the variance
        of both parts.
        """
        found = []
        for degree, power in enumerate(self.power, start=1):
            found += [np.sqrt(power), *[np.sqrt(0.5 * power)] * (2 * degree)]
        return np.array(found)


@dataclass(frozen=True)
class Field:
    """The zonal errors of the objects of one catalogue."""

    errors: ZonalErrors
    ra: Array
    dec: Array

    def draw(self, rows: int, rng: np.random.Generator) -> "DrawnField":
        """Return ``rows`` realisations; those of a wider kernel use the first normals of a narrower one."""
        scatter = self.errors.scatter
        normals = rng.standard_normal((len(scatter), 2, 2, rows))  # degree by degree: toroidal, spheroidal
        scaled = (scatter[:, None, None, None] * normals).transpose(2, 0, 1, 3)
        return DrawnField(self, np.ascontiguousarray(scaled).reshape(2, -1, rows))

    def bases(self, part: slice) -> Iterator[tuple[slice, Array]]:
        """Yield the harmonics of a part, a few objects at a time: their place in the part, and (2 D, 2, n)."""
        ra, dec = self.ra[part], self.dec[part]
        step = max(1, BASIS // self.errors.coefficients)
        for start in range(0, len(ra), step):
            few = slice(start, min(start + step, len(ra)))
            fields = toroidal(self.errors.degree, ra[few], dec[few])
            yield few, np.stack([fields, turned(fields)], axis=1).reshape(-1, 2, fields.shape[2])

    def sizes(self) -> Iterator[tuple[int, slice, float]]:
        """Yield the number, rows and RMS of the pairs of observables that have zonal errors."""
        for k, (observables, sigma) in enumerate(
            zip(KINDS, (self.errors.sigma_pos, self.errors.sigma_pm), strict=True)
        ):
            if sigma > 0.0:
                yield k, observables, sigma

    def variance_through(self, gain: Array) -> Array:
        """Return the variance of each unknown from these errors; ``gain`` (N, 4, K), result (K,)."""
        scatter = np.repeat(self.errors.scatter, 2)
        leaks = np.zeros((2, len(scatter), gain.shape[2]))
        for few, basis in self.bases(slice(None)):
            for k, observables, sigma in self.sizes():
                leaks[k] += sigma * np.tensordot(basis, gain[few, observables], axes=((2, 1), (0, 1)))
        return np.asarray(np.square(scatter[:, None] * leaks).sum(axis=(0, 1)))


@dataclass(frozen=True)
class DrawnField:
    """Realisations of a field: ``coefficients`` (2, 2 D, rows) of position and proper motion, for an RMS of 1."""

    field: Field
    coefficients: Array

    def values(self, part: slice) -> Array:
        """Return the errors of the objects of a part; shape (n, 4, rows)."""
        n_obj, rows = len(self.field.ra[part]), self.coefficients.shape[2]
        found = np.zeros((n_obj, 4, rows))
        for few, basis in self.field.bases(part):
            flat = basis.reshape(len(basis), -1).T
            for k, observables, sigma in self.field.sizes():
                drawn = (flat @ self.coefficients[k]).reshape(2, -1, rows)
                found[few, observables] = sigma * drawn.transpose(1, 0, 2)
        return found
