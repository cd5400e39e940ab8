"""Units and fixed directions, each with its source."""

import numpy as np
from numpy.typing import NDArray

MAS = np.pi / (180.0 * 3600.0 * 1000.0)
"""One milliarcsecond in radians."""

MICROARCSEC = MAS / 1000.0
"""One microarcsecond in radians."""

DEGREE = np.pi / 180.0
"""One degree in radians."""

ARCSEC = DEGREE / 3600.0
"""One arcsecond in radians."""


def _galactic_axes() -> NDArray[np.float64]:
    """Return the Galactic x, y and z axes in ICRS coordinates as rows; shape (3, 3).

    Source: ESA 1997, The Hipparcos and Tycho Catalogues, vol. 1, sect. 1.5.3: pole at (192.85948, 27.12825) deg,
    longitude of the ascending node of the Galactic plane on the equator 32.93192 deg.
    """
    pole_ra, pole_dec, node = 192.85948 * DEGREE, 27.12825 * DEGREE, 32.93192 * DEGREE
    ascending = np.array([-np.sin(pole_ra), np.cos(pole_ra), 0.0])
    pole = np.array([np.cos(pole_dec) * np.cos(pole_ra), np.cos(pole_dec) * np.sin(pole_ra), np.sin(pole_dec)])
    in_plane = np.cross(pole, ascending)
    x = np.cos(node) * ascending - np.sin(node) * in_plane
    return np.stack([x, np.cross(pole, x), pole])


GALACTIC_AXES = _galactic_axes()
"""Matrix that rotates an ICRS vector to Galactic axes; shape (3, 3)."""
