"""Where unknowns stand in the results of studies: degree 1 by component, harmonics by degree, spins by bin."""

from collections.abc import Sequence

import numpy as np

from core.arrays import Array
from core.blocks import SpinByBin
from core.constants import MAS
from core.unknowns import Unknowns, parse_unknowns
from sweep.tie.spectrum import DEGREE_ONE, spectrum

_DEGREE_ONE = parse_unknowns("orientation,spin,position_glide,glide,parallax")
COMPONENTS = _DEGREE_ONE.labels
"""The unknowns of degree 1 and the zero point of parallaxes."""

UNITS = _DEGREE_ONE.units
ORIENTATION, SPIN = slice(0, 3), slice(3, 6)

FIELDS = tuple(DEGREE_ONE.values())
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


def powers(unknowns: Unknowns, estimate: Array, covariance: Array) -> Array:
    """Return the power of each field and degree of an estimate in rad, what noise gives on average, and the
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
                raise ValueError(f"bins: results have places for {MOST_BINS} bins, edges make {len(block.edges) + 1}")
            own = values[..., unknowns.part(block.name)]
            found[..., list(block.used), :] = own.reshape(*values.shape[:-1], len(block.used), 3)
    return found


def any_stored(unknowns: Unknowns) -> bool:
    """Return whether results have a place for any of some unknowns."""
    parts = components(np.zeros(len(unknowns)), unknowns.labels), by_bins(unknowns, np.zeros(len(unknowns)))
    stored = powers(unknowns, np.zeros(len(unknowns)), np.eye(len(unknowns)))[0]
    return any(np.any(np.isfinite(part)) for part in (*parts, stored))
