"""The radio stars with proper motions from VLBI that tied Hipparcos to the extragalactic frame."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linksweep.core.arrays import Array


class RadioStars(NamedTuple):
    """Stars as arrays of shape (N,): V magnitude; ra, dec in deg; pmra (with cos dec), pmdec and their standard errors
    in mas/yr.
    """

    name: NDArray[np.str_]
    hip: NDArray[np.int64]
    v_mag: Array
    ra_deg: Array
    dec_deg: Array
    pmra: Array
    pmra_error: Array
    pmdec: Array
    pmdec_error: Array


_ROWS = (
    ("LS I +61 303", 12469, 10.75, 40.1319, 61.2293, 0.967, 0.26, -1.21, 0.32),
    ("Algol", 14576, 2.12, 47.0422, 40.9556, 2.70, 0.07, -0.80, 0.09),
    ("UX Ari", 16042, 6.47, 51.6473, 28.7154, 41.617, 0.186, -104.01, 0.20),
    ("HR 1099", 16846, 5.82, 54.1971, 0.5881, -31.588, 0.33, -161.69, 0.31),
    ("HD 283447", 19762, 10.7, 63.5538, 28.2035, 0.423, 0.291, -23.25, 0.28),
    ("HR 5110", 66257, 4.91, 203.6990, 37.1824, 85.496, 0.131, -9.22, 0.16),
    ("sigma2 CrB", 79607, 5.23, 243.6711, 33.8589, -267.048, 0.037, -86.66, 0.05),
    ("Cyg X-1", 98298, 8.84, 299.5903, 35.2016, -3.787, 0.172, -6.25, 0.21),
    ("HD 199178", 103144, 7.2, 313.4735, 44.3864, 26.595, 0.407, -1.24, 0.43),
    ("AR Lac", 109303, 6.1, 332.1702, 45.7422, -52.08, 0.126, 47.03, 0.19),
    ("IM Peg", 112997, 5.9, 343.2595, 16.8412, -20.587, 0.459, -27.53, 0.40),
)

RADIO_STARS = RadioStars(*(np.array(column) for column in zip(*_ROWS, strict=True)))
"""The 11 stars; ICRS positions, VLBI proper motions.

Source: Lestrade et al. 1999, A&A 344, 1014 (VLBI proper motions and errors); V from the Hipparcos Catalogue (ESA 1997),
as Metz & Geffert 2004, Sect. 5.3, say they did.  Algol's row and all V are from compilations of the Hipparcos era
and were not confirmed in print.
"""
