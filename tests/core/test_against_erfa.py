"""FK5 against Hipparcos in ERFA: an orientation and a spin that somebody else published and coded.

ERFA rotates the frame where the link rotates the vector, so seen from Hipparcos (the satellite) to FK5 (the reference)
the signs are ERFA's own: r_FK5 = R^T r_Hip with R = exp(-[epsilon x]).
"""

import erfa
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from linksweep.core.frames import MAS, MICROARCSEC, rotation_matrix, satellite_catalogue, triad
from tests.core.reference import design_matrix, solve

EPSILON = np.array([-19.9, -9.1, 22.9]) * MAS  # Mignard & Froeschle 2000, A&A 354, 732
OMEGA = np.array([-0.30, 0.60, 0.70]) * MAS  # per Julian year; both catalogues at J2000.0
SECOND_ORDER = 0.01 * MICROARCSEC  # epsilon^2 is 0.005 microarcsec, and partly averages out


def fk5_and_hipparcos(n_obj=400):
    """Return the same stars in both catalogues, each as (ra, dec, pmra, pmdec), pmra with cos dec."""
    rng = np.random.default_rng(52)
    ra, dec = rng.uniform(0.0, 2.0 * np.pi, n_obj), np.arcsin(rng.uniform(-0.95, 0.95, n_obj))
    pmra, pmdec = rng.normal(0.0, 100.0 * MAS, (2, n_obj))
    parallax = np.full(n_obj, 1.0)  # arcsec: ERFA needs a distance, and near stars have motions far below light's
    fk5 = erfa.fk52h(ra, dec, pmra / np.cos(dec), pmdec, parallax, np.zeros(n_obj))  # d(ra)/dt, without cos dec
    return (ra, dec, pmra, pmdec), (fk5[0], fk5[1], fk5[2] * np.cos(fk5[1]), fk5[3])


def differences(reference, satellite):
    d_ra = (reference[0] - satellite[0] + np.pi) % (2.0 * np.pi) - np.pi
    return np.stack([d_ra * np.cos(reference[1]), *(a - b for a, b in zip(reference[1:], satellite[1:], strict=True))])


def link(reference, satellite):
    y = differences(reference, satellite)
    return solve(design_matrix(*reference), y, np.full_like(y, MAS))


def test_rotation_matrix_of_erfa_turns_the_frame():
    matrix, spin = erfa.fk5hip()
    np.testing.assert_allclose(rotation_matrix(-EPSILON), matrix, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(spin, OMEGA, rtol=1e-12)
    np.testing.assert_allclose(rotation_matrix(np.array([0.3, -2.0, 0.9])), erfa.rv2m([-0.3, 2.0, -0.9]), atol=1e-15)


def test_step_b_reproduces_the_hipparcos_catalogue_star_by_star():
    fk5, hipparcos = fk5_and_hipparcos()
    ours = satellite_catalogue(*fk5, EPSILON, OMEGA)
    assert np.abs(differences(ours, hipparcos)).max() < 0.01 * MICROARCSEC


def test_link_of_fk5_and_hipparcos_recovers_the_published_vectors():
    fk5, hipparcos = fk5_and_hipparcos()
    solution = link(fk5, hipparcos)
    np.testing.assert_allclose(solution.estimate, np.concatenate([EPSILON, OMEGA]), rtol=0.0, atol=SECOND_ORDER)
    assert np.sqrt(np.mean(solution.residuals**2)) < 2 * SECOND_ORDER


def test_exchanging_the_two_catalogues_flips_the_sign():
    fk5, hipparcos = fk5_and_hipparcos()
    np.testing.assert_allclose(
        link(hipparcos, fk5).estimate, -np.concatenate([EPSILON, OMEGA]), rtol=0.0, atol=SECOND_ORDER
    )


def test_corrections_are_needed_for_moving_stars():
    fk5, hipparcos = fk5_and_hipparcos()
    y = differences(fk5, hipparcos)
    without = solve(design_matrix(*fk5, corrections=False), y, np.full_like(y, MAS)).residuals
    assert np.abs(without[2:]).max() > 100 * np.abs(link(fk5, hipparcos).residuals[2:]).max()


def test_reading_d_ra_dt_as_pmra_would_be_noticed():
    (ra, dec, pmra, pmdec), hipparcos = fk5_and_hipparcos()
    mistaken = link((ra, dec, pmra / np.cos(dec), pmdec), hipparcos)
    assert np.abs(mistaken.estimate[3:] - OMEGA).max() > MAS


@pytest.mark.parametrize("ra", [0.1, 2.5, 6.2])
@pytest.mark.parametrize("dec", [-1.2, 0.0, 0.8])
def test_triad_from_erfa_position_and_velocity(ra, dec):
    """The derivative of the direction by time, for unit motions in ra* and dec."""
    _, q, r = triad(np.array(ra), np.array(dec))
    pv = erfa.s2pv(ra, dec, 1.0, 1.0 / np.cos(dec), 1.0, 0.0)
    np.testing.assert_allclose(pv["p"], r, atol=1e-15)
    np.testing.assert_allclose(pv["v"] - q, Rotation.from_rotvec([0, 0, ra]).apply([0, 1, 0]), atol=1e-15)
