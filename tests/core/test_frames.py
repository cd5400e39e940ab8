"""The triad, the finite rotation of step B and the two ways of differencing catalogues."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from linksweep.core.frames import (
    MAS,
    exact_differences,
    position,
    rotation_matrix,
    rotation_minus_identity,
    satellite_catalogue,
    stored_differences,
    triad,
)

ROUNDING = 1e-15  # a few units in the last place of numbers of order 1
MILLI_ROTATION = (np.array([1.0, -2.0, 0.5]) * MAS, np.array([0.3, 0.7, -1.1]) * MAS)


def sky(n_obj=500, seed=1, mean_pm=300 * MAS):
    rng = np.random.default_rng(seed)
    pmra, pmdec = rng.normal(0.0, mean_pm, (2, n_obj))
    return rng.uniform(0.0, 2.0 * np.pi, n_obj), np.arcsin(rng.uniform(-1.0, 1.0, n_obj)), pmra, pmdec


def reference_differences(ra, dec, pmra, pmdec, epsilon, omega):
    """Step B and the subtraction in 80-bit numbers, whose rounding is 2000 times finer."""
    ra, dec, pmra, pmdec, epsilon, omega = (
        np.asarray(x, np.longdouble) for x in (ra, dec, pmra, pmdec, epsilon, omega)
    )
    angle = np.sqrt(np.sum(epsilon**2))
    x, y, z = -epsilon / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    back = np.eye(3, dtype=np.longdouble) + np.sin(angle) * cross + 2 * np.sin(angle / 2) ** 2 * (cross @ cross)
    reference = triad(ra, dec)
    v = back @ (reference.p * pmra + reference.q * pmdec - np.cross(omega, reference.r, axisb=0, axisc=0))
    r = back @ reference.r
    ra_sat, dec_sat = np.arctan2(r[1], r[0]), np.arctan2(r[2], np.hypot(r[0], r[1]))
    satellite = triad(ra_sat, dec_sat)
    turn = 8 * np.arctan(np.longdouble(1))
    d_ra = ra - ra_sat
    d_ra -= turn * np.round(d_ra / turn)
    d_pm = pmra - np.sum(satellite.p * v, axis=0), pmdec - np.sum(satellite.q * v, axis=0)
    return np.stack([d_ra * np.cos(dec), dec - dec_sat, *d_pm])


extended = pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="needs 80-bit or longer long doubles")


def test_triad_is_orthonormal_and_right_handed():
    p, q, r = triad(*sky()[:2])
    axes = np.stack([p, q, r])
    gram = np.einsum("ixn,jxn->nij", axes, axes)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=ROUNDING)
    np.testing.assert_allclose(np.cross(p, q, axis=0), r, atol=ROUNDING)


def test_position_inverts_triad_for_any_length():
    ra, dec = sky()[:2]
    np.testing.assert_allclose(position(7.0 * triad(ra, dec).r), (ra, dec), atol=1e-12)


def test_position_never_returns_a_full_turn():
    ra, _ = position(np.array([1.0, -1e-20, 0.0]))
    assert 0.0 <= ra < 2.0 * np.pi


@pytest.mark.parametrize("angle", [1e-9, 1e-4, 0.5, 2.0, np.pi, 5.0])
def test_rotation_matrix_is_the_exponential(angle):
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    np.testing.assert_allclose(rotation_matrix(vector), Rotation.from_rotvec(vector).as_matrix(), atol=ROUNDING)


def test_rotation_matrix_without_rotation():
    np.testing.assert_array_equal(rotation_matrix(np.zeros(3)), np.eye(3))


@pytest.mark.parametrize("angle", [1e-9, 1e-14])
def test_rotation_minus_identity_keeps_all_digits_of_a_small_angle(angle):
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    antisymmetric = 0.5 * (rotation_minus_identity(vector) - rotation_minus_identity(vector).T)
    np.testing.assert_allclose(antisymmetric[[2, 0, 1], [1, 2, 0]], vector, rtol=1e-12)


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0])
def test_satellite_catalogue_is_undone_by_the_inverse_rotation(size):
    catalogue = sky()
    epsilon, omega = size * np.array([0.3, -0.8, 0.5]), size * np.array([-0.2, 0.1, 0.4])
    there = satellite_catalogue(*catalogue, epsilon, omega)
    spin_seen_from_satellite = -rotation_matrix(epsilon).T @ omega
    back = satellite_catalogue(*there, -epsilon, spin_seen_from_satellite)
    np.testing.assert_allclose(triad(*back[:2]).r, triad(*catalogue[:2]).r, atol=2 * ROUNDING)
    turn = np.abs(np.tan(catalogue[1])) + np.abs(np.tan(there[1])) + 1.0  # rounding in ra turns the triad
    motion = size + np.hypot(*catalogue[2:])
    assert np.all(np.abs(np.array(back[2:]) - catalogue[2:]) < 4 * ROUNDING * turn * motion)


def test_satellite_catalogue_obeys_the_vector_equations():
    ra, dec, pmra, pmdec = sky()
    epsilon, omega = np.array([0.3, -0.8, 1.1]), np.array([0.1, 0.2, -0.3])
    ra_sat, dec_sat, pmra_sat, pmdec_sat = satellite_catalogue(ra, dec, pmra, pmdec, epsilon, omega)
    reference, satellite = triad(ra, dec), triad(ra_sat, dec_sat)
    turn = Rotation.from_rotvec(epsilon)
    np.testing.assert_allclose(turn.apply(satellite.r.T).T, reference.r, atol=2 * ROUNDING)
    v_ref = reference.p * pmra + reference.q * pmdec
    v_sat = satellite.p * pmra_sat + satellite.q * pmdec_sat
    np.testing.assert_allclose(v_ref, turn.apply(v_sat.T).T + np.cross(omega, reference.r.T).T, atol=2 * ROUNDING)


def test_exact_and_stored_differences_agree_at_finite_angles():
    catalogue, epsilon, omega = sky(), np.array([0.3, -0.8, 1.1]), np.array([0.01, 0.02, -0.03])
    exact, stored = (f(*catalogue, epsilon, omega) for f in (exact_differences, stored_differences))
    dec_sat = satellite_catalogue(*catalogue, epsilon, omega)[1]
    np.testing.assert_array_less(np.abs(exact - stored), np.broadcast_to(5 * ROUNDING / np.cos(dec_sat), exact.shape))


@extended
def test_exact_differences_lie_far_below_the_floor_of_stored_angles():
    catalogue = sky()
    truth = reference_differences(*catalogue, *MILLI_ROTATION)
    error_exact = np.abs(exact_differences(*catalogue, *MILLI_ROTATION) - truth)[:2].max()
    error_stored = np.abs(stored_differences(*catalogue, *MILLI_ROTATION) - truth)[:2].max()
    assert 1e-9 * MAS < error_stored < 1e-6 * MAS  # the last bit of an angle is 4e-7 mas at most
    assert error_exact < 1e-3 * error_stored  # what is left is the rounding of the 80-bit numbers


@extended
@pytest.mark.parametrize("distance", [1e-2, 5e-6])
def test_exact_differences_near_a_pole(distance):
    ra, _, pmra, pmdec = sky(50)
    catalogue = (ra, np.full(50, np.pi / 2 - distance), pmra, pmdec)
    truth = reference_differences(*catalogue, *MILLI_ROTATION)
    size = np.array([MAS, MAS, MAS, MAS]) * (1.0 + 300 * MAS / distance)  # the triad turns by epsilon/distance
    relative = np.abs(exact_differences(*catalogue, *MILLI_ROTATION) - truth) / size[:, None]
    assert relative.max() < 1e-9


@pytest.mark.parametrize("differences", [exact_differences, stored_differences])
@pytest.mark.parametrize("ra", [0.0, 1e-12, 2.0 * np.pi - 1e-12, np.nextafter(2.0 * np.pi, 0.0)])
@pytest.mark.parametrize("turn", [-MAS, MAS])
def test_difference_in_ra_wraps(differences, ra, turn):
    zero = np.zeros(1)
    d_ra = differences(np.array([ra]), zero, zero, zero, np.array([0.0, 0.0, turn]), np.zeros(3))[0, 0]
    assert abs(d_ra - turn) < 1e-6 * MAS  # the last bit of an angle near 2 pi is 2e-7 mas


def test_an_object_at_a_pole_is_carried_without_infinities():
    one, zero = np.ones(1), np.zeros(1)
    ra, dec, pmra, pmdec = satellite_catalogue(one, one * np.pi / 2, one, zero, np.array([0.1, 0.0, 0.0]), np.zeros(3))
    np.testing.assert_allclose(
        triad(ra, dec).r[:, 0], Rotation.from_rotvec([-0.1, 0, 0]).apply([0, 0, 1]), atol=ROUNDING
    )
    np.testing.assert_allclose(np.hypot(pmra, pmdec), 1.0, rtol=ROUNDING)
