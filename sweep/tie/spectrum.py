"""Power of the vector spherical harmonics by degree, and how significant it is."""

from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from core.arrays import Array
from core.blocks import Harmonics
from core.unknowns import Unknowns

VECTOR_POWER = 8.0 * np.pi / 3.0
"""Power of degree 1 of a rotation or a glide is this times the square of its length (Mignard & Klioner 2012)."""

DEGREE_ONE = {
    "orientation": "position toroidal",
    "position_glide": "position spheroidal",
    "spin": "motion toroidal",
    "glide": "motion spheroidal",
}


class Power(NamedTuple):
    """Power of one degree of a field (mas^2 or mas^2/yr^2), what noise gives on average, c'V^-1 c, a chi2 of 2 l + 1
    degrees of freedom without any signal, and the probability that noise is as significant.
    """

    field: str
    degree: int
    power: float
    noise: float
    chi2: float
    probability: float


def spectrum(unknowns: Unknowns, estimate: Array, covariance: Array) -> list[Power]:
    """Return the power of each degree that is among the unknowns; those of degree 1 may be vectors."""
    if not any(isinstance(block, Harmonics) for block in unknowns.blocks):
        return []
    found = []
    for block in unknowns.blocks:
        part = unknowns.part(block.name)
        x, v = estimate[part], covariance[part, part]
        if isinstance(block, Harmonics):
            start, where = 0, "motion" if block.rate else "position"
            for kind, degree in block.parts:
                weights = np.array([1.0, *[2.0] * (2 * degree)])  # of order 0, and of the parts of the others
                piece = slice(start, start + len(weights))
                field = f"{where} {'toroidal' if kind == 't' else 'spheroidal'}"
                found.append(_power(field, degree, weights, x[piece], v[piece, piece]))
                start = piece.stop
        elif block.name in DEGREE_ONE and len(x) == 3:
            found.append(_power(DEGREE_ONE[block.name], 1, np.full(3, VECTOR_POWER), x, v))
    return found


def _power(field: str, degree: int, weights: Array, x: Array, v: Array) -> Power:
    chi2 = float(x @ np.linalg.solve(v, x))
    probability = float(chdtrc(2 * degree + 1, chi2))
    return Power(field, degree, float(weights @ x**2), float(weights @ np.diag(v)), chi2, probability)
