"""What is wrong beside normal errors: each kind against its law, and the prediction of what it does to the link."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.special import eval_jacobi, sph_harm_y

from linksweep.core.catalogue import Catalogue
from linksweep.core.errors import CatalogueErrors, Errors, FlooredErrors, MagnitudeErrors
from linksweep.core.experiment import cost, evaluate, link, samples, scenario, summarise
from linksweep.core.fixed_design import fixed_designs
from linksweep.core.frames import GALACTIC_AXES, MAS, triad
from linksweep.core.missions import MISSIONS
from linksweep.core.setup import Draw, Prefixes, prepare
from linksweep.core.simulate import simulate
from linksweep.core.systematics import Field, Systematics, ZonalErrors, parse_pattern, pattern_field, rms
from linksweep.sweep.contract import SweepError
from linksweep.sweep.planning.grid import make_grid
from linksweep.sweep.studies.reader import study_from_dict
from tests.core.reference import design_matrix

NORMAL = {"satellite_errors": "normal"}


def point(**changes):
    return link.defaults() | {"n_obj": 60} | changes


def generators(seed=1):
    return np.random.default_rng(seed), np.random.default_rng(seed + 1)


def results(n_sim, seed=1, **changes):
    found = evaluate([point(**changes)], n_sim, *generators(seed))
    return {name: values[0] for name, values in summarise(found, np.array([float(n_sim)]), np.array([1.0])).items()}


def sky(n, seed=3):
    rng, zero = np.random.default_rng(seed), np.zeros(n)
    ra, dec = rng.uniform(0, 2 * np.pi, n), np.arcsin(rng.uniform(-1, 1, n))
    return Catalogue(ra, dec, zero, zero, rng.uniform(10.0, 20.0, n))


def setup_of(catalogue, **changes):
    physics = scenario(point(**changes))
    return prepare(physics, Draw.of(physics, catalogue, np.random.default_rng(0)), Prefixes())


def gain_of(setup):
    """N^-1 K'W with NumPy alone; shape (6, N, 4)."""
    c = setup.catalogue
    design = np.moveaxis(design_matrix(c.ra, c.dec, c.pmra, c.pmdec), 0, 1)
    rows, weights = design.reshape(-1, 6), setup.sigma.ravel() ** -2.0
    return np.linalg.solve(rows.T @ (weights[:, None] * rows), rows.T * weights).reshape(6, -1, 4)


# noise floors


def test_a_floor_is_added_in_quadrature_and_weighs():
    catalogue, curve = sky(20), MagnitudeErrors(MISSIONS["gaia"])
    found = FlooredErrors(curve, Errors(0.3, 0.4)).standard_errors(catalogue)
    expected = np.sqrt(curve.standard_errors(catalogue) ** 2 + (np.array([[0.3], [0.3], [0.4], [0.4]]) * MAS) ** 2)
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    setup = setup_of(catalogue, model="gaia", satellite_floor_pos=0.3, satellite_floor_pm=0.4, error_scale=2.0)
    scaled = np.sqrt(4.0 * curve.standard_errors(catalogue) ** 2 + (np.array([[0.3, 0.3, 0.4, 0.4]]).T * MAS) ** 2)
    np.testing.assert_allclose(setup.sigma.T, scaled, rtol=1e-14)  # a floor has no scale
    np.testing.assert_array_equal(setup.satellite.sigma, setup.sigma)


def test_a_floor_dilutes_the_correlations_of_an_object():
    """Covariances add: D R D + floor^2."""
    rng = np.random.default_rng(2)
    mixing = np.tril(rng.normal(size=(9, 4, 4))) + 2.0 * np.eye(4)
    covariance = mixing @ np.swapaxes(mixing, 1, 2) * MAS**2
    sigma = np.sqrt(np.einsum("nii->ni", covariance))
    own = replace(sky(9), sigma=sigma.T, correlation=covariance / (sigma[:, :, None] * sigma[:, None, :]))
    floored = FlooredErrors(CatalogueErrors(), Errors(1.0, 2.0))
    total, correlation = floored.standard_errors(own).T, floored.correlation(own)
    expected = covariance + np.diag([1.0, 1.0, 4.0, 4.0]) * MAS**2
    np.testing.assert_allclose(correlation * total[:, :, None] * total[:, None, :], expected, rtol=1e-12)


# underestimated errors


@pytest.mark.parametrize("reference_errors", ["none", "normal"])
@pytest.mark.parametrize("weighting", ["inverse-variance", "equal"])
def test_underestimated_errors_scatter_more_with_the_same_weights(weighting, reference_errors):
    """Of both sides: the same normals give three times the deviation, and chi2 is nine times its expectation."""
    sides = NORMAL | {"reference_errors": reference_errors, "weighting": weighting, "epsilon_size": 0.0}
    ratios = {"satellite_error_ratio": 3.0} | ({"reference_error_ratio": 3.0} if reference_errors == "normal" else {})
    honest, found = results(300, **sides), results(300, **sides, **ratios)
    np.testing.assert_allclose(found["sigma"], 3.0 * honest["sigma"], rtol=1e-5)
    np.testing.assert_allclose(found["sigma_predicted"], 3.0 * honest["sigma_predicted"], rtol=1e-9)
    assert found["chi2"] == pytest.approx(9.0 * honest["chi2"], rel=1e-5)


def test_chi2_over_the_squared_ratio_has_the_chi_square_law():
    """One realisation a block: its chi2 is its own."""
    physics = scenario(point(n_obj=8, **NORMAL, satellite_error_ratio=0.5))
    chi2 = [simulate([physics], 1, np.random.default_rng(k), np.random.default_rng(7))[0]["chi2"] for k in range(250)]
    assert stats.kstest(np.array(chi2) / 0.25, stats.chi2(4 * 8 - 6).cdf).pvalue > 1e-3


def test_one_side_underestimated_is_predicted():
    """The sandwich G Sigma G' with the true Sigma, and its Monte Carlo."""
    found = results(3000, **NORMAL, reference_errors="normal", satellite_error_ratio=3.0)
    expected = found["sigma_predicted"] / results(1, **NORMAL, reference_errors="normal")["sigma_predicted"]
    np.testing.assert_allclose(expected, np.sqrt(5.0), rtol=1e-9)  # (9 + 1)/(1 + 1)
    assert stats.chi2(3000).sf(3000 * (found["sigma"] / found["sigma_predicted"]) ** 2).min() > 1e-4
    assert stats.chi2(3000).cdf(3000 * (found["sigma"] / found["sigma_predicted"]) ** 2).min() > 1e-4


# zonal errors


def kernel(errors, distance):
    """Correlation of either component along the great circle: d^l_11 as a Jacobi polynomial, from SciPy."""
    x, found = np.cos(distance), 0.0
    for degree, power in enumerate(errors.power, start=1):
        wigner = 0.5 * (1.0 + x) * eval_jacobi(degree - 1, 0, 2, x)
        found = found + (2 * degree + 1) / (4.0 * np.pi) * power * wigner
    return found


def field_covariance(errors, catalogue):
    """Covariance of the position errors of all objects for an RMS of 1, from the sums of harmonics; (2N, 2N)."""
    field = Field(replace(errors, sigma_pos=1.0), catalogue.ra, catalogue.dec)
    basis = np.concatenate([part for _, part in field.bases(slice(None))], axis=2).reshape(-1, 2 * len(catalogue))
    return basis.T @ (np.repeat(errors.scatter, 2)[:, None] ** 2 * basis)


@pytest.mark.parametrize("length", [12.0, 40.0, 180.0])
def test_zonal_errors_are_correlated_by_distance_alone(length):
    """Two components at two places, turned to the arc between them: the kernel on the diagonal, nothing beside it."""
    errors, catalogue = ZonalErrors(1.0, 1.0, np.radians(length)), sky(12)
    covariance = field_covariance(errors, catalogue).reshape(2, 12, 2, 12)
    p, q, r = triad(catalogue.ra, catalogue.dec)
    for a, b in [(0, 0), (0, 1), (2, 5), (7, 11), (3, 9)]:
        distance = np.arccos(np.clip(r[:, a] @ r[:, b], -1.0, 1.0)) if a != b else 0.0
        normal = np.cross(r[:, a], r[:, b]) if a != b else p[:, a]
        across = normal / np.linalg.norm(normal)
        turns = []
        for k in (a, b):
            along_arc = np.cross(across, r[:, k])
            turns.append([[along_arc @ p[:, k], along_arc @ q[:, k]], [across @ p[:, k], across @ q[:, k]]])
        found = np.array(turns[0]) @ covariance[:, a, :, b] @ np.array(turns[1]).T
        np.testing.assert_allclose(found, kernel(errors, distance) * np.eye(2), atol=1e-12)


def test_the_kernel_is_a_gaussian_where_it_is_narrow():
    errors, distance = ZonalErrors(1.0, 1.0, np.radians(8.0)), np.radians([0.0, 4.0, 8.0, 16.0])
    np.testing.assert_allclose(kernel(errors, distance), np.exp(-0.5 * (distance / errors.length) ** 2), atol=0.01)
    assert kernel(errors, 0.0) == pytest.approx(1.0, rel=1e-12)


def test_drawn_zonal_errors_have_that_covariance_and_are_normal():
    errors, catalogue, rows = ZonalErrors(2.0, 5.0, np.radians(40.0)), sky(10), 20_000
    drawn = Field(errors, catalogue.ra, catalogue.dec).draw(rows, np.random.default_rng(4)).values(slice(2, 10))
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


def test_a_wider_kernel_uses_the_beginning_of_the_draws_of_a_narrower():
    wide, narrow = (
        Field(ZonalErrors(1.0, 1.0, np.radians(length)), *np.zeros((2, 1))).draw(3, np.random.default_rng(1))
        for length in (100.0, 50.0)
    )
    shared = wide.coefficients.shape[1]
    scatter = [np.repeat(d.field.errors.scatter, 2)[:shared, None] for d in (wide, narrow)]
    np.testing.assert_allclose(wide.coefficients / scatter[0], narrow.coefficients[:, :shared] / scatter[1], rtol=1e-12)


@pytest.mark.parametrize("satellite_errors", ["normal", "none"])
def test_what_zonal_errors_do_to_the_link_is_predicted(satellite_errors):
    """G Sigma G' with the whole 4N x 4N covariance, formed from the kernel's harmonics and NumPy."""
    catalogue = sky(50)
    setup = setup_of(catalogue, satellite_errors=satellite_errors, zonal_pos=2.0, zonal_pm=0.7, zonal_length=25.0)
    gain = gain_of(setup)
    errors = scenario(point(zonal_pm=1.0, zonal_length=25.0)).zonal
    covariance = field_covariance(errors, catalogue)
    expected = np.einsum("kni,ni->k", gain**2, setup.satellite.sigma**2)
    for part, sigma in ((slice(0, 2), 2.0 * MAS), (slice(2, 4), 0.7 * MAS)):
        flat = np.moveaxis(gain[:, :, part], 1, 2).reshape(6, -1)
        expected = expected + sigma**2 * np.einsum("ka,ab,kb->k", flat, covariance, flat)
    np.testing.assert_allclose(fixed_designs([setup], Prefixes())[0].predicted_variance(), expected, rtol=1e-9)


def test_many_objects_do_not_beat_zonal_errors():
    """The rotation in a field of RMS s: 3 C_1/(8 pi) s^2 of variance in each component, however many objects."""
    errors = scenario(point(zonal_pm=1.0, zonal_length=60.0)).zonal
    floor = np.sqrt(3.0 * errors.power[0] / (8.0 * np.pi))
    found = results(1, n_obj=20_000, **NORMAL, zonal_pm=1.0, zonal_length=60.0)
    np.testing.assert_allclose(found["sigma_predicted"][3:], floor, rtol=0.02)
    assert found["sigma_predicted"][0] == pytest.approx(np.sqrt(1.5 / 20_000), rel=0.05)  # positions have none


# known fields in the proper motions


def plain_differences(catalogue, slope, equation, v_zero, field):
    """What they add, object by object."""
    found = []
    for ra, dec, v_mag, along in zip(catalogue.ra, catalogue.dec, catalogue.v_mag, field.T, strict=True):
        east = np.array([-np.sin(ra), np.cos(ra), 0.0])
        north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
        place = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
        turning = np.cross(np.array(slope) * (v_mag - v_zero), place)
        satellite = np.array(equation) * (v_mag - v_zero) + along
        found.append([turning @ east - satellite[0], turning @ north - satellite[1]])
    return np.array(found).T


def test_the_differences_are_those_of_a_plain_loop():
    catalogue, slope, equation = sky(30), (0.1, -0.2, 0.3), (0.4, -0.5)
    pattern = parse_pattern("t_2_0=0.3, s_3_2_im=-0.2")
    field = pattern_field(pattern, catalogue.ra, catalogue.dec)
    found = Systematics(slope, equation, 14.0, pattern).differences(catalogue.ra, catalogue.dec, catalogue.v_mag)
    np.testing.assert_allclose(found, plain_differences(catalogue, slope, equation, 14.0, field), rtol=1e-12)


def test_a_pattern_is_the_gradient_of_scipys_harmonics():
    """s_2_1_re as the tangential gradient of 2 Re Y_21/sqrt(6), by differences; t_2_1_re as that turned."""
    catalogue, step = sky(8), 1e-6

    def potential(ra, dec):
        return 2.0 * np.real(sph_harm_y(2, 1, np.pi / 2 - dec, ra)) / np.sqrt(6.0)

    ra, dec = catalogue.ra, catalogue.dec
    east = (potential(ra + step, dec) - potential(ra - step, dec)) / (2 * step * np.cos(dec))
    north = (potential(ra, dec + step) - potential(ra, dec - step)) / (2 * step)
    np.testing.assert_allclose(pattern_field(parse_pattern("s_2_1_re"), ra, dec), [east, north], atol=1e-8)
    np.testing.assert_allclose(pattern_field(parse_pattern("t_2_1_re"), ra, dec), [north, -east], atol=1e-8)


def test_the_size_of_a_pattern_is_its_rms_over_the_sky():
    catalogue = sky(100_000)
    pattern = scenario(point(motion_field="t_2_0=2,s_3_1_im=-1", motion_field_size=0.25)).systematics.pattern
    lengths = np.sum(pattern_field(pattern, catalogue.ra, catalogue.dec) ** 2, axis=0)
    assert np.sqrt(lengths.mean()) / MAS == pytest.approx(0.25, rel=0.01)
    assert rms(pattern) / MAS == pytest.approx(0.25, rel=1e-12)


ALL_OF_THEM = {
    "omega_slope": (0.3, -0.1, 0.2),
    "magnitude_equation_pmra": 0.4,
    "magnitude_equation_pmdec": -0.3,
    "v_zero": 12.0,
    "motion_field": "t_2_0=0.5,s_2_1_re=-0.7",
}


def test_the_leak_of_known_fields_is_predicted():
    """bias = N^-1 K'W f, by NumPy; a study's estimates are biased by as much."""
    catalogue = sky(40)
    setup = setup_of(catalogue, **NORMAL, **ALL_OF_THEM)
    field = pattern_field(parse_pattern(ALL_OF_THEM["motion_field"]), catalogue.ra, catalogue.dec)
    f = plain_differences(catalogue, (0.3, -0.1, 0.2), (0.4, -0.3), 12.0, field) * MAS
    expected = np.einsum("kni,in->k", gain_of(setup)[:, :, 2:], f)
    assert np.abs(expected[3:]).min() > 0.01 * MAS
    np.testing.assert_allclose(fixed_designs([setup], Prefixes())[0].bias, expected, atol=1e-7 * MAS)


def test_a_magnitude_equation_turns_the_sky_by_three_eighths_pi():
    """Uniform sky, a (V - v_zero) in pmra: omega_z = -(3 pi/8) a <V - v_zero>; in pmdec it makes no spin."""
    many = {"n_obj": 100_000, "satellite_errors": "none", "omega": (0.0, 0.0, 0.0), "v_zero": 12.0}
    pmra, pmdec = (
        results(1, **many, **{f"magnitude_equation_{name}": 0.2})["bias_predicted"][3:] for name in ("pmra", "pmdec")
    )
    np.testing.assert_allclose(pmra, [0.0, 0.0, -3 * np.pi / 8 * 0.2 * (10.0 - 12.0)], atol=0.01)
    np.testing.assert_allclose(pmdec, 0.0, atol=0.01)
    slope = results(1, **many, omega_slope=(0.0, 0.1, 0.0))["bias_predicted"][3:]
    np.testing.assert_allclose(slope, [0.0, 0.1 * (10.0 - 12.0), 0.0], atol=0.004)


def test_a_field_of_degree_two_leaks_where_the_sky_is_uneven():
    """Density 1 + c sign(sin b): spin = -(3/(8 pi)) c (integral of sign(sin b) K f), by quadrature."""
    x, weight = np.polynomial.legendre.leggauss(40)
    sin_b = np.concatenate([(x - 1.0) / 2.0, (x + 1.0) / 2.0])
    longitude = 2.0 * np.pi * np.arange(80) / 80
    b, lon = (grid.ravel() for grid in np.meshgrid(np.arcsin(sin_b), longitude, indexing="ij"))
    area = np.repeat(np.tile(weight / 2.0, 2), 80) * 2.0 * np.pi / 80
    place = GALACTIC_AXES.T @ np.array([np.cos(b) * np.cos(lon), np.cos(b) * np.sin(lon), np.sin(b)])
    ra, dec = np.arctan2(place[1], place[0]), np.arcsin(place[2])
    f = pattern_field(parse_pattern("t_2_0"), ra, dec)
    p, q, _ = triad(ra, dec)
    density = np.where(b > 0.0, 1.5, 0.5)
    expected = -3.0 / (8.0 * np.pi) * ((q * f[0] - p * f[1]) @ (area * density))
    settings = {"n_obj": 200_000, "satellite_errors": "none", "motion_field": "t_2_0"}
    found = results(1, **settings, sky_contrast=0.5)["bias_predicted"][3:]
    assert np.linalg.norm(expected) > 0.05
    np.testing.assert_allclose(found, expected, atol=0.005)
    np.testing.assert_allclose(results(1, **settings)["bias_predicted"][3:], 0.0, atol=0.005)


# what points share


OTHERS = [
    {"omega_slope": (0.0, 0.0, 0.2)},
    {"omega_slope": (0.0, 0.0, 0.2), "v_zero": 9.0},
    {"omega_slope": (0.0, 0.0, 0.2), "v_min": 9.0},  # other magnitudes of the same places
    {"omega_slope_size": 0.2},
    {"magnitude_equation_pmra": 0.2},
    {"magnitude_equation_pmdec": 0.2},
    {"motion_field": "t_2_0"},
    {"motion_field": "s_2_0"},
    {"motion_field": "t_2_0", "motion_field_size": 3.0},
    {"zonal_pm": 1.0},
    {"zonal_pm": 1.0, "zonal_length": 90.0},
    {"zonal_pos": 1.0},
    {"satellite_error_ratio": 2.0},
    {"satellite_floor_pm": 2.0},
    {"reference_error_ratio": 2.0, "reference_errors": "normal"},
    {"reference_floor_pos": 2.0, "reference_errors": "normal"},
]


def test_points_that_share_a_draw_keep_what_is_their_own():
    """All of them in one block: to the last bit what each is alone, and no two alike."""
    points = [point(n_obj=30, **changes) for changes in ({}, *OTHERS)]
    together = samples(points, 3, *generators())
    for k, single in enumerate(points):
        for name, values in samples([single], 3, *generators()).items():
            np.testing.assert_array_equal(together[name][k], values[0], err_msg=f"{name} {k}")
    estimates = together["estimate"]
    for k in range(len(points)):
        assert not any(np.array_equal(estimates[k], other) for other in estimates[:k]), points[k]


def test_zonal_errors_leave_the_normals_as_they_are():
    """Taken from a stream of their own: without them the same estimates, plus what the field alone makes."""
    zonal, alone = {"zonal_pm": 1.0, "zonal_length": 60.0}, {"epsilon_size": 0.0, "omega_size": 0.0}
    plain, both, field = (
        samples([point(**changes, **alone)], 600, *generators())["estimate"][0]
        for changes in (NORMAL, NORMAL | zonal, {"satellite_errors": "none"} | zonal)
    )
    np.testing.assert_allclose(both, plain + field, atol=1e-6)


# what a study may say


def problems(**fixed):
    with pytest.raises(SweepError) as error:
        make_grid(study_from_dict({"title": "", "axes": {}, "fixed": {"n_obj": 9} | fixed}))
    return " ".join(error.value.problems)


@pytest.mark.parametrize(
    ("fixed", "sentence"),
    [
        ({"motion_field": "t_2"}, "motion_field = 't_2': 't_2' is no vector spherical harmonic; those are t_L_0"),
        ({"motion_field": "t_2_3_re"}, "'t_2_3_re' is no vector spherical harmonic"),
        ({"motion_field": "t_51_0"}, "degrees L = 1 to 50"),
        ({"motion_field": "t_2_0=x"}, "t_2_0 = 'x': must be a number"),
        ({"motion_field": "t_2_0=nan"}, "t_2_0 = 'nan': must be a number"),
        ({"motion_field": "t_2_0=0"}, "no harmonic with a coefficient that is not zero"),
        ({"motion_field": ""}, "no harmonic with a coefficient that is not zero"),
        ({"motion_field": "t_2_0,t_2_0"}, "t_2_0 twice"),
        ({"motion_field_size": 1.0}, "motion_field_size = 1.0 changes nothing: it is for a motion_field"),
        ({"zonal_length": 20.0}, "zonal_length = 20.0 changes nothing: it is for zonal errors, zonal_pos or zonal_pm"),
        ({"zonal_length": 5.0, "zonal_pm": 1.0}, "zonal_length = 5"),
        ({"v_zero": 3.0}, "v_zero = 3.0 changes nothing: it is for an omega_slope or a magnitude equation"),
        ({"satellite_errors": "none", "satellite_floor_pm": 1.0}, "satellite_floor_pm = 1.0 changes nothing"),
        ({"reference_error_ratio": 2.0}, "reference_error_ratio = 2.0 changes nothing"),
        ({"method": "projected", "zonal_pm": 1.0}, "method = 'projected' needs errors that are independent"),
        ({"method": "projected", "satellite_error_ratio": 2.0}, "satellite_error_ratio = 1"),
    ],
)
def test_a_study_is_told_what_is_wrong(fixed, sentence):
    assert sentence in problems(**fixed)


def test_zonal_errors_cost_more():
    assert cost(point(zonal_pm=1.0, zonal_length=6.0)) > cost(point(zonal_pm=1.0)) > cost(point())
    assert cost(point(satellite_errors="none", zonal_pm=1.0)) > 0.0
