"""Vector spherical harmonics on the sky: the toroidal and spheroidal fields of Mignard & Klioner 2012."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np

from linksweep.core.frames import Array

Kind = Literal["t", "s"]
KINDS: tuple[Kind, Kind] = ("t", "s")

HIGHEST_DEGREE = 50


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
    and -2 Im T_lm for each order, degree by degree in the order of `terms`.  The spheroidal field of a term is the
    toroidal one turned by 90 deg: `turned`.  ``ra`` and ``dec`` are radians of shape (N,); poles are allowed.
    Source: Mignard & Klioner 2012, A&A 547, A59, Eqs. 2-8; fully normalised recurrences in the degree.
    """
    fields = np.empty((degree * (degree + 2), 2, len(ra)))
    fill_toroidal({d: fields[d**2 - 1 : d * (d + 2)] for d in range(1, degree + 1)}, ra, dec)
    return fields


def fill_toroidal(into: Mapping[int, Array], ra: Array, dec: Array) -> None:
    """Write the toroidal fields of some degrees into arrays of shape (2 degree + 1, 2, N), all orders at once."""
    highest = max(into)
    orders = np.arange(1, highest + 1)
    sin_dec, cos_dec = np.sin(dec), np.cos(dec)
    cosines, sines = _multiples(highest, ra)
    # P_lm/cos dec for the orders m = 1..l, of the degrees l - 1 and l
    before, here = np.zeros((2, highest, len(ra)))
    here[0] = np.sqrt(3.0 / (8.0 * np.pi))
    raised = sin_dec * here
    for degree in range(1, highest + 1):
        if degree > 1:
            low = orders[: degree - 1]  # from the two degrees below; the highest order from the degree before
            factor = np.sqrt((4 * degree**2 - 1) / (degree**2 - low**2))[:, None]
            below = np.sqrt(((degree - 1) ** 2 - low**2) / (4 * (degree - 1) ** 2 - 1))[:, None]
            before[: degree - 1] *= -below
            before[: degree - 1] += raised[: degree - 1]
            before[: degree - 1] *= factor
            np.multiply(here[degree - 2], np.sqrt((2 * degree + 1) / (2 * degree)) * cos_dec, out=before[degree - 1])
            before, here = here, before
            np.multiply(sin_dec, here[:degree], out=raised[:degree])
        if degree not in into:
            continue
        found, m, norm = into[degree], orders[:degree], 1.0 / np.sqrt(degree * (degree + 1))
        np.multiply(cos_dec, here[0], out=found[0, 0])  # dP_l0/d dec = sqrt(l (l + 1)) P_l1
        found[0, 1] = 0.0
        slope = (degree * norm) * raised[:degree]
        slope -= (norm * np.sqrt((2 * degree + 1) / (2 * degree - 1) * (degree**2 - m**2)))[:, None] * before[:degree]
        along = (norm * m)[:, None] * here[:degree]
        np.multiply(slope, -cosines[:degree], out=found[1::2, 0])
        np.multiply(along, sines[:degree], out=found[1::2, 1])
        np.multiply(slope, sines[:degree], out=found[2::2, 0])
        np.multiply(along, cosines[:degree], out=found[2::2, 1])


def _multiples(highest: int, ra: Array) -> tuple[Array, Array]:
    """Return 2 (-1)^m cos(m ra) and 2 (-1)^m sin(m ra) of the orders from 1; shape (highest, N)."""
    cosines, sines = np.empty((2, highest, len(ra)))
    turn_cos, turn_sin = -np.cos(ra), -np.sin(ra)
    cosines[0], sines[0] = 2.0 * turn_cos, 2.0 * turn_sin
    for m in range(1, highest):
        cosines[m] = cosines[m - 1] * turn_cos - sines[m - 1] * turn_sin
        sines[m] = sines[m - 1] * turn_cos + cosines[m - 1] * turn_sin
    return cosines, sines


def turned(fields: Array, out: Array | None = None) -> Array:
    """Return fields (..., 2, N) turned by 90 deg from east through north: toroidal ones become spheroidal.

    ``out`` may be the fields themselves.
    """
    found = np.empty_like(fields) if out is None else out
    east = fields[..., 0, :].copy() if out is fields else fields[..., 0, :]
    np.negative(fields[..., 1, :], out=found[..., 0, :])
    found[..., 1, :] = east
    return found
