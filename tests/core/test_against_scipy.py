"""Orientation against scipy's exact rotation."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from linksweep.core.catalogue import Sky
from linksweep.core.frames import MAS, MICROARCSEC, exact_differences, satellite_catalogue, triad
from tests.core.reference import design_matrix, solve


def noisy_link(epsilon, sigma, n_obj=200):
    """Return the link of a noisy satellite with equal weights, and the vectors of both catalogues."""
    rng = np.random.default_rng(11)
    ra, dec = Sky().positions(rng, n_obj)
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
