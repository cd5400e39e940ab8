"""Errors, systematic effects and the glide: each against its law, and the prediction of what it does to the link."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.special import eval_jacobi

from tests.core import points
from tests.core.points import GALACTIC_AXES, MAS, ZonalErrors, parse_pattern, pattern_field, point, scenario, set_up
from tests.core.reference import design_matrix, solve

GLIDE = 4.0 * points.MICROARCSEC * GALACTIC_AXES[0]
NO_TRUTH = {"epsilon": (0.0, 0.0, 0.0), "omega": (0.0, 0.0, 0.0), "satellite_errors": "none", "aberration": True}
FLAT = {"satellite_errors": "normal", "reference_errors": "normal"}


def sky(n, seed=3):
    return points.Catalogue(*points.sky(n, seed, 0.0), np.random.default_rng(99).uniform(10.0, 20.0, n))


def solved(setup, differences=0.0):
    """The link of differences (2, N) of the motions alone, by NumPy."""
    c, both = setup.catalogue, np.zeros((4, len(setup.catalogue)))
    both[2:] = differences
    return solve(design_matrix(c.ra, c.dec, c.pmra, c.pmdec), both, setup.sigma.T)


def kernel(errors, distance):
    """Correlation of either component along the great circle: d^l_11 as a Jacobi polynomial, from SciPy."""
    x, result = np.cos(distance), 0.0
    for degree, power in enumerate(errors.power, start=1):
        wigner = 0.5 * (1.0 + x) * eval_jacobi(degree - 1, 0, 2, x)
        result = result + (2 * degree + 1) / (4.0 * np.pi) * power * wigner
    return result


def field_covariance(errors, catalogue):
    """Covariance of the position errors of all objects for an RMS of 1, from the sums of harmonics; (2N, 2N)."""
    field = points.Field(replace(errors, sigma_pos=1.0), catalogue.ra, catalogue.dec)
    basis = np.concatenate([part for _, part in field.bases(slice(None))], axis=2).reshape(-1, 2 * len(catalogue))
    return basis.T @ (np.repeat(errors.scatter, 2)[:, None] ** 2 * basis)


@pytest.mark.parametrize("length", [12.0, 40.0, 180.0])
def test_zonal_errors_are_correlated_by_distance_alone(length):
    errors, catalogue = ZonalErrors(1.0, 1.0, np.radians(length)), sky(12)
    degrees = np.arange(2, len(errors.power) + 1)  # the Gaussian on the sphere, C_l ~ exp(-l (l + 1) L^2/2)
    np.testing.assert_allclose(np.diff(np.log(errors.power)), -degrees * np.radians(length) ** 2, rtol=1e-9)
    assert kernel(errors, 0.0) == pytest.approx(1.0)
    covariance = field_covariance(errors, catalogue).reshape(2, 12, 2, 12)
    p, q, r = points.triad(catalogue.ra, catalogue.dec)
    for a, b in [(0, 0), (0, 1), (2, 5), (7, 11), (3, 9)]:
        distance = np.arccos(np.clip(r[:, a] @ r[:, b], -1.0, 1.0)) if a != b else 0.0
        normal = np.cross(r[:, a], r[:, b]) if a != b else p[:, a]
        across = normal / np.linalg.norm(normal)
        here, there = (np.array([np.cross(across, r[:, k]), across]) @ np.array([p[:, k], q[:, k]]).T for k in (a, b))
        result = here @ covariance[:, a, :, b] @ there.T
        np.testing.assert_allclose(result, kernel(errors, distance) * np.eye(2), atol=1e-12)


def test_drawn_zonal_errors_have_that_covariance_and_are_normal():
    errors, catalogue, rows = ZonalErrors(2.0, 5.0, np.radians(40.0)), sky(10), 20_000
    field = points.Field(errors, catalogue.ra, catalogue.dec)
    drawn = field.values(field.draw(rows, np.random.default_rng(4)), slice(2, 10))
    assert drawn.shape == (8, 4, rows)
    expected = field_covariance(errors, catalogue).reshape(2, 10, 2, 10)[:, 2:, :, 2:].reshape(16, 16)
    for part, sigma in ((slice(0, 2), 2.0), (slice(2, 4), 5.0)):
        flat = drawn[:, part].transpose(1, 0, 2).reshape(16, rows) / sigma
        error = np.sqrt((expected**2 + 1.0) / rows)
        assert np.abs((flat @ flat.T / rows - expected) / error).max() < 5.0
        assert stats.kstest(flat[3], "norm").pvalue > 1e-3
        whitened = np.linalg.solve(np.linalg.cholesky(expected), flat)
        assert stats.kstest(np.sum(whitened**2, axis=0), stats.chi2(16).cdf).pvalue > 1e-3
    assert abs(np.corrcoef(drawn[0, 0], drawn[0, 2])[0, 1]) < 5.0 / np.sqrt(rows)  # positions and motions apart


@pytest.mark.parametrize("satellite_errors", ["normal", "none"])
def test_what_zonal_errors_do_to_the_link_is_predicted(satellite_errors):
    """G Sigma G' with the whole 4N x 4N covariance, formed from the kernel's harmonics and NumPy."""
    catalogue, zonal = sky(50), {"zonal_pos": 2.0, "zonal_pm": 0.7, "zonal_length": 25.0}
    setup = set_up(catalogue, scenario(point(satellite_errors=satellite_errors, **zonal)))
    gain, covariance = solved(setup).gain, field_covariance(scenario(point(**zonal)).zonal, catalogue)
    expected = np.einsum("kin,lin,ni->kl", gain, gain, setup.satellite.sigma**2)
    for part, sigma in ((slice(0, 2), 2.0 * MAS), (slice(2, 4), 0.7 * MAS)):
        flat = gain[:, part].reshape(6, -1)
        expected = expected + sigma**2 * flat @ covariance @ flat.T
    result = points.design_of(setup).predicted_covariance()
    assert np.all(np.abs(result - expected) < 1e-9 * np.sqrt(np.outer(np.diag(expected), np.diag(expected))))


def test_the_leak_of_known_fields_is_predicted():
    known = {"omega_slope": (0.3, -0.1, 0.2), "magnitude_equation_pmra": 0.4, "magnitude_equation_pmdec": -0.3}
    known |= {"v_zero": 12.0, "motion_field": "t_2_0=0.5,s_2_1_re=-0.7"}
    catalogue = sky(40)
    setup = set_up(catalogue, scenario(point(satellite_errors="normal", **known)))
    p, q, r = points.triad(catalogue.ra, catalogue.dec)
    v_mag = catalogue.v_mag - 12.0
    turning = np.cross(np.outer(v_mag, known["omega_slope"]), r.T).T
    field = pattern_field(parse_pattern(known["motion_field"]), catalogue.ra, catalogue.dec)
    f = np.array([np.sum(turning * p, axis=0) - 0.4 * v_mag, np.sum(turning * q, axis=0) + 0.3 * v_mag]) - field
    expected, design = solved(setup, f * MAS), points.design_of(setup)
    assert np.abs(expected.estimate[3:]).min() > 0.01 * MAS
    np.testing.assert_allclose(design.bias, expected.estimate, atol=1e-7 * MAS)
    assert design.chi2_variance() == pytest.approx(2.0 * (4 * 40 - 6) + 4.0 * expected.chi2, rel=1e-6)


def leaks(n_cat, **changes):
    """The estimates of many catalogues in units of the glide, without orientation, spin and noise; shape (n_cat, K)."""
    here = scenario(point(**(NO_TRUTH | changes)))
    estimates = [points.run(here, 1, catalogue_seed=seed)["estimate"] for seed in range(n_cat)]
    return np.concatenate(estimates) * MAS / np.linalg.norm(GLIDE)


@pytest.mark.slow
@pytest.mark.parametrize(("zone_deg", "contrast"), [(0.0, 0.4), (0.0, 0.0), (25.0, 0.4), (60.0, -0.5)])
def test_leak_on_an_uneven_sky(zone_deg, contrast):
    """A glide g fakes a spin with (1 - <r r^T>) omega = -<r> x g on an infinite sky; s is sin of the zone's limit."""
    spin = leaks(100, n_obj=4000, zone_of_avoidance=zone_deg, sky_contrast=contrast)[:, 3:]
    error_of_mean, s = spin.std(axis=0) / np.sqrt(len(spin)), np.sin(np.radians(zone_deg))
    mean = GALACTIC_AXES[2] * contrast * (1.0 + s) / 2.0
    expected = -np.cross(mean, GLIDE) / ((1.0 + (1.0 + s + s**2) / 3.0) / 2.0) / np.linalg.norm(GLIDE)
    assert np.all(np.abs(spin.mean(axis=0) - expected) < 4.5 * error_of_mean + 2 / 4000)  # bias of a ratio of means
    assert contrast == 0.0 or np.linalg.norm(expected) > 10 * np.linalg.norm(error_of_mean)


def test_the_size_of_a_pattern_is_its_rms_over_the_sky():
    catalogue = sky(100_000)
    pattern = scenario(point(motion_field="t_2_0=2,s_3_1_im=-1", motion_field_size=0.25)).systematics.pattern
    lengths = np.sum(pattern_field(pattern, catalogue.ra, catalogue.dec) ** 2, axis=0)
    assert np.sqrt(lengths.mean()) / MAS == pytest.approx(0.25, rel=0.01)
    assert points.rms(pattern) / MAS == pytest.approx(0.25, rel=1e-12)


# ----- errors of each object


def with_own_errors(n_obj=50):
    """Synthetic objects with different errors for each observable and random correlations for each object."""
    sigma, correlation = points.random_covariances(n_obj)
    return replace(points.drawn(1, n_obj=n_obj), errors=points.OwnErrors(sigma * MAS, correlation))


@pytest.mark.parametrize("model", ["amex", "gaia", "gaia-2001"])
@pytest.mark.parametrize("length", [None, 7.0])
def test_errors_follow_the_curve_of_the_mission_with_scale_and_floor(model, length):
    mission, objects = points.MISSIONS[model], points.drawn(1, n_obj=50)
    physics = scenario(point(model=model, mission_length=length, error_scale=1.5, satellite_error_scale=2.0))
    pos, pm = mission.sigma_pos_mas(objects.v_mag, length), mission.sigma_pm_mas_yr(objects.v_mag, length)
    plain = 3.0 * MAS * np.stack([pos, pos, pm, pm], axis=1)
    np.testing.assert_allclose(physics.satellite_errors.standard_errors(objects), plain, rtol=1e-14)
    floored = replace(physics, satellite_errors=replace(physics.satellite_errors, floor=(0.3, 0.4)))
    setup, expected = set_up(objects, floored), np.hypot(plain, np.array([0.3, 0.3, 0.4, 0.4]) * MAS)
    np.testing.assert_allclose(setup.sigma, expected, rtol=1e-14)  # a floor has no scale, and weighs
    np.testing.assert_array_equal(setup.satellite.sigma, setup.sigma)


def test_scales_multiply_and_a_floor_dilutes_the_correlations_of_an_object():
    here = point(**FLAT, error_scale=2.0, satellite_error_scale=5.0, reference_error_scale=7.0)
    here |= {"satellite_sigma_pm": 0.5, "reference_sigma_pos": 3.0}
    objects = with_own_errors()
    satellite, reference = scenario(here).satellite_errors, scenario(here).reference_errors
    np.testing.assert_allclose(satellite.standard_errors(objects)[0, [0, 2]], np.array([10.0, 5.0]) * MAS, rtol=1e-14)
    np.testing.assert_allclose(reference.standard_errors(objects)[0, [0, 2]], np.array([42.0, 14.0]) * MAS, rtol=1e-14)
    ours = scenario(here | {"reference_errors": "catalogue"}).reference_errors
    np.testing.assert_allclose(ours.standard_errors(objects), 14.0 * objects.errors.sigma, rtol=1e-15)
    assert ours.correlation(objects) is objects.errors.correlation  # a scale does not correlate
    with pytest.raises(ValueError, match="has no errors of its own"):
        ours.standard_errors(points.drawn(1, n_obj=3))
    errors = scenario(point(satellite_errors="catalogue", satellite_floor_pos=1.0, satellite_floor_pm=2.0))
    total = errors.satellite_errors.standard_errors(objects)
    result = errors.satellite_errors.correlation(objects) * total[:, :, None] * total[:, None, :]
    sigma, correlation = objects.errors
    expected = correlation * sigma[:, :, None] * sigma[:, None, :] + np.diag([1.0, 1.0, 4.0, 4.0]) * MAS**2
    np.testing.assert_allclose(result, expected, rtol=1e-12)
