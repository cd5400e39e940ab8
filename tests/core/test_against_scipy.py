"""Orientation against scipy's exact rotation, Galactic axes against astropy."""

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from scipy.spatial.transform import Rotation

from core.catalogue import isotropic_positions
from core.constants import DEGREE, GALACTIC_AXES, MAS, MICROARCSEC
from core.frames import exact_differences, satellite_catalogue, triad
from core.link import design_matrix, solve

FRAME_BIAS = 0.03 / 3600 * DEGREE  # astropy hangs the Galactic axes on FK5, 0.023 arcsec from ICRS


def noisy_link(epsilon, sigma, n_obj=200):
    """Return the link of a noisy satellite with equal weights, and the vectors of both catalogues."""
    rng = np.random.default_rng(11)
    ra, dec = isotropic_positions(rng, n_obj)
    still = np.zeros(n_obj)
    ra_sat, dec_sat, _, _ = satellite_catalogue(ra, dec, still, still, epsilon, np.zeros(3))
    noise = np.zeros((4, n_obj))
    noise[:2] = sigma * rng.standard_normal((2, n_obj))
    y = exact_differences(ra, dec, still, still, epsilon, np.zeros(3)) - noise
    sat = triad(ra_sat, dec_sat)
    solution = solve(design_matrix(ra, dec, still, still), y, np.full_like(y, MAS), "equal")
    return solution.estimate[:3], triad(ra, dec).r, sat.r + sat.p * noise[0] + sat.q * noise[1]


@pytest.mark.parametrize("sigma", [0.0, 1.0, 30.0])
def test_orientation_equals_the_best_exact_rotation(sigma):
    epsilon = np.array([1.0, -2.0, 0.5]) * MAS
    estimate, reference, satellite = noisy_link(epsilon, sigma * MAS)
    exact, _ = Rotation.align_vectors(reference.T, satellite.T)
    np.testing.assert_allclose(estimate, exact.as_rotvec(), rtol=0.0, atol=0.01 * MICROARCSEC)
    assert sigma == 0.0 or np.abs(estimate - epsilon).max() > 1.0 * MICROARCSEC  # the noise is really there


@pytest.mark.parametrize("size", [1e-4, 1e-3])
def test_small_angle_link_departs_from_the_exact_rotation_to_second_order(size):
    estimate, reference, satellite = noisy_link(size * np.array([0.6, -0.8, 0.0]), 0.0)
    exact, _ = Rotation.align_vectors(reference.T, satellite.T)
    departure = np.abs(estimate - exact.as_rotvec()).max()
    assert 1e-3 * size**2 < departure < size**2


def test_galactic_axes_against_astropy():
    xyz = SkyCoord([0, 90, 0] * units.deg, [0, 0, 90] * units.deg, frame="galactic").icrs.cartesian.xyz.value
    np.testing.assert_allclose(GALACTIC_AXES, xyz.T, rtol=0.0, atol=FRAME_BIAS)
    np.testing.assert_allclose(GALACTIC_AXES @ GALACTIC_AXES.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(GALACTIC_AXES) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("limit_deg", [10.0, 30.0, 80.0])
def test_zone_of_avoidance_in_the_galactic_coordinates_of_astropy(limit_deg):
    ra, dec = isotropic_positions(np.random.default_rng(12), 20_000, limit_deg * DEGREE)
    galactic = SkyCoord(ra, dec, unit="rad").galactic
    sin_b = np.sin(galactic.b.rad)
    assert np.abs(galactic.b.deg).min() > limit_deg - FRAME_BIAS / DEGREE
    assert np.abs(galactic.b.deg).min() < limit_deg + 0.1  # filled up to the edge
    assert abs(np.mean(sin_b > 0) - 0.5) < 4 * 0.5 / np.sqrt(20_000)  # binomial
    low = np.sin(limit_deg * DEGREE)  # |sin b| is uniform between it and 1
    assert abs(np.abs(sin_b).mean() - (1 + low) / 2) < 4 * (1 - low) / np.sqrt(12 * 20_000)
    assert abs(np.exp(1j * galactic.l.rad).mean()) < 4 / np.sqrt(20_000)
