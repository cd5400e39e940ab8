"""Vector spherical harmonics on the sky: the toroidal and spheroidal fields of Mignard & Klioner 2012."""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Kind = Literal["t", "s"]


class Term(NamedTuple):
    """One coefficient: kind t (toroidal) or s (spheroidal), degree, order, and part ("" for order 0, "re", "im")."""

    kind: Kind
    degree: int
    order: int
    part: str

    @property
    def label(self) -> str:
        """Return for example t_2_0 or s_3_1_re."""
        return "_".join(filter(None, [self.kind, str(self.degree), str(self.order), self.part]))


def terms(kind: Kind, degree: int) -> tuple[Term, ...]:
    """Return the 2 l + 1 coefficients of one kind and degree, by order, real before imaginary."""
    orders = [Term(kind, degree, m, part) for m in range(1, degree + 1) for part in ("re", "im")]
    return (Term(kind, degree, 0, ""), *orders)


def toroidal(degree: int, ra: Array, dec: Array) -> Array:
    """Return the toroidal fields of all degrees from 1 to ``degree``; shape (degree (degree + 2), 2, N).

    The fields are those that multiply the coefficients, with components along east and north: T_l0, then 2 Re T_lm
    and -2 Im T_lm for each order, degree by degree in the order of `terms`.  The spheroidal field of the same term is
    that turned by 90 deg: `turned`.  ``ra`` and ``dec`` are radians of shape (N,); poles are allowed.
    Source: Mignard & Klioner 2012, A&A 547, A59, Eqs. 2-8; fully normalised recurrences in the degree.
    """
    fields = np.empty((degree * (degree + 2), 2, len(ra)))
    sin_dec, cos_dec = np.sin(dec), np.cos(dec)
    turn_cos, turn_sin = np.cos(ra), np.sin(ra)
    first = np.full(len(ra), np.sqrt(3.0 / (8.0 * np.pi)))  # P_11/cos dec, normalised
    cos_m, sin_m = turn_cos, turn_sin
    for m in range(1, degree + 1):
        if m > 1:
            first = np.sqrt((2 * m + 1) / (2 * m)) * cos_dec * first
            cos_m, sin_m = cos_m * turn_cos - sin_m * turn_sin, sin_m * turn_cos + cos_m * turn_sin
        before, here = np.zeros_like(first), first  # P_lm/cos dec of the degrees l - 1 and l
        for degree_here in range(m, degree + 1):
            if degree_here > m:
                before, here = here, _next_degree(degree_here, m, sin_dec, here, before)
            place, norm = degree_here**2 - 1, 1.0 / np.sqrt(degree_here * (degree_here + 1))
            if m == 1:  # dP_l0/d dec = sqrt(l (l + 1)) P_l1
                fields[place, 0], fields[place, 1] = cos_dec * here, 0.0
            slope = np.sqrt((2 * degree_here + 1) / (2 * degree_here - 1) * (degree_here**2 - m**2)) * before
            slope -= degree_here * sin_dec * here
            slope *= 2.0 * (-1) ** m * norm
            along = (2.0 * (-1) ** m * norm * m) * here
            real, imaginary = fields[place + 2 * m - 1], fields[place + 2 * m]
            np.multiply(slope, cos_m, out=real[0])
            np.multiply(along, sin_m, out=real[1])
            np.multiply(-slope, sin_m, out=imaginary[0])
            np.multiply(along, cos_m, out=imaginary[1])
    return fields


def turned(fields: Array, out: Array | None = None) -> Array:
    """Return fields (..., 2, N) turned by 90 deg from east through north: toroidal ones become spheroidal."""
    found = np.empty_like(fields) if out is None else out
    np.negative(fields[..., 1, :], out=found[..., 0, :])
    found[..., 1, :] = fields[..., 0, :]
    return found


def _next_degree(degree: int, order: int, sin_dec: Array, last: Array, before: Array) -> Array:
    """Return the normalised P_lm from those of the two degrees below; any common factor of all three is allowed."""
    factor = np.sqrt((4 * degree**2 - 1) / (degree**2 - order**2))
    below = np.sqrt(((degree - 1) ** 2 - order**2) / (4 * (degree - 1) ** 2 - 1))
    return np.asarray(factor * (sin_dec * last - below * before))
