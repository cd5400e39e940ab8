"""Galactic axes, skies and proper motions against astropy."""

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord

from linksweep.core.catalogue import Sky
from linksweep.core.frames import DEGREE, GALACTIC_AXES, MAS, MICROARCSEC, position, triad

FRAME_BIAS = 0.03 / 3600 * DEGREE  # astropy hangs the Galactic axes on FK5, 0.023 arcsec from ICRS


def test_galactic_axes_against_astropy():
    xyz = SkyCoord([0, 90, 0] * units.deg, [0, 0, 90] * units.deg, frame="galactic").icrs.cartesian.xyz.value
    np.testing.assert_allclose(GALACTIC_AXES, xyz.T, rtol=0.0, atol=FRAME_BIAS)
    np.testing.assert_allclose(GALACTIC_AXES @ GALACTIC_AXES.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(GALACTIC_AXES) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("limit_deg", [10.0, 30.0, 80.0])
def test_zone_of_avoidance_in_the_galactic_coordinates_of_astropy(limit_deg):
    ra, dec = Sky(limit_deg * DEGREE).positions(np.random.default_rng(12), 20_000)
    galactic = SkyCoord(ra, dec, unit="rad").galactic
    sin_b = np.sin(galactic.b.rad)
    assert np.abs(galactic.b.deg).min() > limit_deg - FRAME_BIAS / DEGREE
    assert np.abs(galactic.b.deg).min() < limit_deg + 0.1  # filled up to the edge
    assert abs(np.mean(sin_b > 0) - 0.5) < 4 * 0.5 / np.sqrt(20_000)  # binomial
    low = np.sin(limit_deg * DEGREE)  # |sin b| is uniform between it and 1
    assert abs(np.abs(sin_b).mean() - (1 + low) / 2) < 4 * (1 - low) / np.sqrt(12 * 20_000)
    assert abs(np.exp(1j * galactic.l.rad).mean()) < 4 / np.sqrt(20_000)


def test_sky_contrast_in_the_galactic_coordinates_of_astropy():
    ra, dec = Sky(contrast=-0.4).positions(np.random.default_rng(13), 20_000)
    north = np.mean(SkyCoord(ra, dec, unit="rad").galactic.b.rad > 0)
    assert abs(north - 0.3) < 4 * np.sqrt(0.3 * 0.7 / 20_000)  # binomial


def test_space_motion_of_astropy_is_the_velocity_on_the_triad():
    """One year of motion at 10 pc, where the speed is 1e-4 of light's and its square is left out."""
    rng = np.random.default_rng(14)
    ra, dec = Sky().positions(rng, 300)
    pmra, pmdec = rng.normal(0.0, 500.0 * MAS, (2, 300))
    pm = {"pm_ra_cosdec": pmra * units.rad / units.yr, "pm_dec": pmdec * units.rad / units.yr}
    star = SkyCoord(
        ra * units.rad, dec * units.rad, distance=10 * units.pc, radial_velocity=0 * units.km / units.s, **pm
    )
    moved = star.apply_space_motion(dt=1 * units.yr)
    p, q, r = triad(ra, dec)
    step = triad(*position(r + p * pmra + q * pmdec)).r - triad(moved.ra.rad, moved.dec.rad).r
    assert np.abs(step).max() < 0.01 * MICROARCSEC  # (v/c)^2 of a motion is 1e-8 of 2 arcsec
