"""Power of vector spherical harmonics, and where unknowns stand in the results of studies: degree 1 by component,
harmonics by degree, spins by bin.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from linksweep.core.arrays import Array
from linksweep.core.constants import MAS
from linksweep.core.unknowns import Harmonics, SpinByBin, Unknowns, parse_unknowns

VECTOR_POWER = 8.0 * np.pi / 3.0
"""Power of degree 1 of a rotation or a glide is this times the square of its length (Mignard & Klioner 2012)."""

FIELD_OF = {
    "orientation": "position toroidal",
    "position_glide": "position spheroidal",
    "spin": "motion toroidal",
    "glide": "motion spheroidal",
}
"""The field whose degree 1 a block is."""

_STORED = parse_unknowns("orientation,spin,position_glide,glide,parallax")
COMPONENTS = _STORED.labels
"""The unknowns of degree 1 and the zero point of parallaxes."""

UNITS = _STORED.units
ORIENTATION, SPIN = slice(0, 3), slice(3, 6)

FIELDS = tuple(FIELD_OF.values())
FIELD_UNITS = tuple("mas2/yr2" if field.startswith("motion") else "mas2" for field in FIELDS)
HIGHEST_STORED = 10
MOST_BINS = 10
POWER_SHAPE, BIN_SHAPE = (len(FIELDS), HIGHEST_STORED), (MOST_BINS, 3)


def components(values: Array, labels: Sequence[str]) -> Array:
    """Return values (..., K) at the places of their labels among `COMPONENTS`, NaN elsewhere."""
    placed = np.full((*values.shape[:-1], len(COMPONENTS)), np.nan)
    for i, label in enumerate(labels):
        if label in COMPONENTS:
            placed[..., COMPONENTS.index(label)] = values[..., i]
    return placed


class Power(NamedTuple):
    """Power of one degree l of a field (mas^2 or mas^2/yr^2), its mean for noise alone, c'V^-1 c, which
    for noise alone is a chi2 of 2 l + 1 degrees of freedom, and the probability that noise is as significant.
    """

    field: str
    degree: int
    power: float
    noise: float
    chi2: float
    probability: float


def spectrum(unknowns: Unknowns, estimate: Array, covariance: Array) -> list[Power]:
    """Return the power of each degree among the unknowns (rotations, glides: degree 1); none without harmonics."""
    if not any(isinstance(block, Harmonics) for block in unknowns.blocks):
        return []
    found = []
    for block in unknowns.blocks:
        part = unknowns.part(block.name)
        x, v = estimate[part], covariance[part, part]
        if isinstance(block, Harmonics):
            start, where = 0, "motion" if block.rate else "position"
            for kind, degree in block.parts:
                weights = np.array([1.0, *[2.0] * (2 * degree)])  # order 0, then both parts of each other order
                piece = slice(start, start + len(weights))
                field = f"{where} {'toroidal' if kind == 't' else 'spheroidal'}"
                found.append(_power(field, degree, weights, x[piece], v[piece, piece]))
                start = piece.stop
        elif block.name in FIELD_OF and len(x) == 3:
            found.append(_power(FIELD_OF[block.name], 1, np.full(3, VECTOR_POWER), x, v))
    return found


def _power(field: str, degree: int, weights: Array, x: Array, v: Array) -> Power:
    chi2 = float(x @ np.linalg.solve(v, x)) if np.any(v) else np.nan  # a table linked to itself has errors of 0
    probability = float(chdtrc(2 * degree + 1, chi2))
    return Power(field, degree, float(weights @ x**2), float(weights @ np.diag(v)), chi2, probability)


def powers(unknowns: Unknowns, estimate: Array, covariance: Array) -> Array:
    """Return the power of each field and degree of an estimate in rad, its mean for noise alone, and the
    probability that noise is as significant; shape (3, fields, degrees), in mas2 and mas2/yr2, NaN if not solved for.
    """
    found = np.full((3, *POWER_SHAPE), np.nan)
    for one in spectrum(unknowns, estimate / MAS, covariance / MAS**2):
        if one.degree <= HIGHEST_STORED:
            found[:, FIELDS.index(one.field), one.degree - 1] = one.power, one.noise, one.probability
    return found


def by_bins(unknowns: Unknowns, values: Array) -> Array:
    """Return values (..., K) of the spin in each bin; shape (..., bins, 3), NaN without bins and beyond the last."""
    found = np.full((*values.shape[:-1], *BIN_SHAPE), np.nan)
    for block in unknowns.blocks:
        if isinstance(block, SpinByBin):
            if max(block.used) >= MOST_BINS:
                raise ValueError(f"bins: results hold {MOST_BINS} bins at most, the edges make {len(block.edges) + 1}")
            own = values[..., unknowns.part(block.name)]
            found[..., list(block.used), :] = own.reshape(*values.shape[:-1], len(block.used), 3)
    return found


def any_stored(unknowns: Unknowns) -> bool:
    """Return whether results have a place for any of the unknowns."""
    parts = components(np.zeros(len(unknowns)), unknowns.labels), by_bins(unknowns, np.zeros(len(unknowns)))
    stored = powers(unknowns, np.zeros(len(unknowns)), np.eye(len(unknowns)))[0]
    return any(np.any(np.isfinite(part)) for part in (*parts, stored))
