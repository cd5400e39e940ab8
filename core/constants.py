"""Units and fixed directions, each with its source, and the conventions of the core.

Conventions of `linksweep.core`, the same in every module (a test checks each):

* Inside ``core`` angles are radians and proper motions rad/yr; a number in another unit has that unit
  in its name (``sigma_mas``, ``mission_length_yr``).  Vectors are ``(3, ...)`` and objects come last.
* ``pmra`` is mu_alpha* = (d alpha/dt) cos(dec), as in the Gaia archive.
* Differences are **reference - satellite**.  The orientation epsilon and the spin omega rotate the *vector*:
  ``r_ref = R r_sat`` and ``v_ref = R v_sat + omega x r_ref`` with ``R = exp([epsilon x])``.
* The four observables of an object are, in this order, ``(d alpha*, d dec, d pmra, d pmdec)``; the unknowns
  are ``(epsilon_x, epsilon_y, epsilon_z, omega_x, omega_y, omega_z)``.
* Every random number comes from a generator that the caller passes in.

Nothing here prints, logs, reads a clock, touches a file or imports dask, xarray, zarr or click.
"""

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
