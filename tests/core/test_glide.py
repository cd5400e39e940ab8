"""The glide: its columns in the design, its leak into the spin, and its solution."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from linksweep.core.catalogue import Sky
from linksweep.core.catalogues import synthetic
from linksweep.core.errors import NO_ERRORS, NormalErrors
from linksweep.core.frames import DEGREE, GALACTIC_AXES, MAS, MICROARCSEC, position, triad
from linksweep.core.link import LinkError
from linksweep.core.scenario import Scenario, TrueVector
from linksweep.core.simulate import simulate
from tests.core.reference import design_matrix, solve

GLIDE = 4.0 * MICROARCSEC * GALACTIC_AXES[0]
NONE = TrueVector((0.0, 0.0, 0.0))
UNIFORM = Sky()


def gliding(n_obj, sky=UNIFORM, **changes):
    """Error-free data whose satellite sees the glide, no orientation and no spin."""
    draw = partial(synthetic, n_obj=n_obj, v_min=5.0, v_max=15.0, sky=sky)
    return replace(Scenario(draw, NO_ERRORS, NO_ERRORS, NONE, NONE, aberration=tuple(GLIDE)), **changes)


def leaks(scenario, n_cat, seed=1):
    """The estimates of many catalogues in units of the glide; shape (n_cat, K)."""
    catalogues = np.random.default_rng(seed)
    blocks = [simulate([scenario], 1, np.random.default_rng(0), catalogues, keep_estimates=True) for _ in range(n_cat)]
    estimates = np.concatenate([block["estimate"] for (block,) in blocks])
    return estimates * MAS / np.linalg.norm(GLIDE)


def expected_leak(sky):
    """The spin omega that a satellite's glide g fakes on an infinite sky.

    The normal equations of d = -(g - r (r.g)) are (1 - <r r^T>) omega = <r x d> = -<r> x g. On a sky that is uniform
    on each side of the Galactic plane, <r> = contrast (1 + s)/2 along the pole with s = sin of the zone's limit, and
    <r r^T> is diagonal there, with <sin^2 b> = (1 + s + s^2)/3. Without a zone: -(3/4) contrast pole x g.
    """
    s = np.sin(sky.zone_of_avoidance)
    polar = (1.0 + s + s**2) / 3.0
    mean = GALACTIC_AXES[2] * sky.contrast * (1.0 + s) / 2.0
    return -np.cross(mean, GLIDE) / ((1.0 + polar) / 2.0) / np.linalg.norm(GLIDE)


def test_a_glide_that_is_solved_for_has_no_error():
    """Estimate and truth are reference - satellite: a glide of the satellite is a negative one."""
    (block,) = simulate(
        [gliding(40, solve_glide=True)], 1, np.random.default_rng(0), np.random.default_rng(1), keep_estimates=True
    )
    np.testing.assert_allclose(block["estimate"][0, 6:] * MAS, -GLIDE, rtol=1e-9)
    both = np.concatenate([block["error"], block["glide_error"]])
    np.testing.assert_allclose(both * MAS, 0.0, atol=1e-9 * np.linalg.norm(GLIDE))


def test_columns_are_the_derivative_of_proper_motions_by_the_glide():
    """A glide moves an object towards its apex: r -> <r + t g>, read off as ra and dec after a short time."""
    rng = np.random.default_rng(2)
    ra, dec = rng.uniform(0.1, 6.1, 100), np.arcsin(rng.uniform(-0.95, 0.95, 100))
    design, r, step = design_matrix(ra, dec, 0 * ra, 0 * ra, glide=True), triad(ra, dec).r, 1e-6
    for k, apex in enumerate(np.eye(3)):
        ahead, behind = (np.array(position(r + sign * step * apex[:, None])) for sign in (1, -1))
        d_ra, d_dec = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(design[2:, :, 6 + k], [d_ra * np.cos(dec), d_dec], atol=1e-8)
    np.testing.assert_array_equal(design[:2, :, 6:], 0.0)  # no position moves


def test_a_glide_is_no_spin_but_both_together_need_three_objects():
    """The tangent fields of the two are orthogonal on the whole sky, and two objects have four motions for six."""
    ra, dec = Sky().positions(np.random.default_rng(4), 3)
    design = design_matrix(ra, dec, 0 * ra, 0 * ra, glide=True)
    assert solve(design, np.zeros((4, 3)), np.full((4, 3), MAS)).dof == 3
    with pytest.raises(LinkError, match="rank deficient"):
        solve(design[:, :2], np.zeros((4, 2)), np.full((4, 2), MAS))


def test_no_leak_on_a_uniform_sky():
    found = leaks(gliding(200), 400)
    np.testing.assert_allclose(found[:, :3], 0.0, atol=1e-9)  # positions know nothing of it
    spin = found[:, 3:]
    error_of_mean = spin.std(axis=0) / np.sqrt(len(spin))
    assert np.all(np.abs(spin.mean(axis=0)) < 4 * error_of_mean)


@pytest.mark.slow
def test_leak_of_one_catalogue_falls_with_the_root_of_the_number_of_objects():
    """To first order it is -(3/2) <r> x g, so each of two components scatters by sqrt(3/(4 N)), the third by none."""
    for n_obj, n_cat in ((100, 400), (1600, 400)):
        galactic = leaks(gliding(n_obj), n_cat)[:, 3:] @ GALACTIC_AXES.T
        expected = np.sqrt(0.75 / n_obj)
        across = np.sqrt(np.mean(galactic[:, 1:] ** 2, axis=0))
        np.testing.assert_allclose(across, expected, rtol=4 / np.sqrt(2 * n_cat) + 5 / n_obj)
        assert np.sqrt(np.mean(galactic[:, 0] ** 2)) < 3 / np.sqrt(n_obj) * expected  # of second order


@pytest.mark.slow
@pytest.mark.parametrize(("zone_deg", "contrast"), [(0.0, 0.4), (0.0, -0.9), (25.0, 0.4), (60.0, -0.5)])
def test_leak_on_an_uneven_sky(zone_deg, contrast):
    sky, n_obj = Sky(zone_deg * DEGREE, contrast), 4000
    spin = leaks(gliding(n_obj, sky), 100)[:, 3:]
    error_of_mean = spin.std(axis=0) / np.sqrt(len(spin))
    expected = expected_leak(sky)
    assert np.all(np.abs(spin.mean(axis=0) - expected) < 4.5 * error_of_mean + 2 / n_obj)  # bias of a ratio of means
    assert np.linalg.norm(expected) > 10 * np.linalg.norm(error_of_mean)


def test_leak_without_a_zone_in_numbers():
    expected = 4.0 * expected_leak(Sky(contrast=0.4)) @ GALACTIC_AXES.T
    np.testing.assert_allclose(expected, [0.0, -1.2, 0.0], atol=1e-14)  # microarcsec/yr for 4 towards the centre


@pytest.mark.parametrize("sky", [UNIFORM, Sky(0.3, 0.8)])
def test_solving_for_the_glide_leaves_no_leak_and_finds_minus_the_satellites(sky):
    found = leaks(gliding(50, sky, solve_glide=True), 10)
    np.testing.assert_allclose(found[:, :6], 0.0, atol=1e-9)
    np.testing.assert_allclose(found[:, 6:] * np.linalg.norm(GLIDE), np.tile(-GLIDE, (10, 1)), rtol=1e-9)


@pytest.mark.parametrize("reference", [NO_ERRORS, NormalErrors(0.1, 0.1)])
def test_noise_does_not_change_the_leak(reference):
    sky, n_sim = Sky(contrast=0.8), 500
    fixed = gliding(400, sky)
    noisy = replace(fixed, reference_errors=reference, satellite_errors=NormalErrors(1.0, 0.002))
    leak, sums = (
        simulate([s], n, np.random.default_rng(5), np.random.default_rng(6))[0] for s, n in ((fixed, 1), (noisy, n_sim))
    )
    mc_error = np.sqrt(sums["predicted_variance"] / n_sim)
    assert np.all(np.abs(sums["error"] / n_sim - leak["error"])[3:] < 4 * mc_error[3:])
