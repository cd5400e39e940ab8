"""The projected method: the distribution of the catalogue method, and the bound of what it leaves out."""

import numpy as np
import pytest
from scipy import stats

from tests.core import points
from tests.core.points import LinkError, design_of, link, neglected, scenario, set_up
from tests.core.reference import design_matrix, solve


def point(**changes):
    return link.defaults() | {"n_obj": 12, "mean_pm": 300.0} | changes


def run(here, n_sim, seed=1, catalogue_seed=2):
    return points.run(scenario(here), n_sim, seed, catalogue_seed)


def setup_of(here):
    physics = scenario(here)
    return set_up(physics.draw_catalogue(np.random.default_rng(2)), physics)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"weighting": "equal"},
        {"solve_glide": True, "aberration": True, "sky_contrast": 0.5},
        {"n_obj": 2, "weighting": "equal"},  # 8 observables for 13 columns
        {"reference_errors": "normal", "reference_sigma_pos": 1000.0, "reference_sigma_pm": 500.0},
        {"reference_errors": "normal", "reference_sigma_pos": 0.1, "weighting": "equal", "solve_glide": True},
    ],
)
def test_estimates_have_the_distribution_of_the_catalogue_method(changes):
    n_sim = 8000
    catalogue, projected = (
        run(point(method=m, **changes), n_sim, seed) for seed, m in enumerate(("catalogue", "projected"))
    )
    np.testing.assert_array_equal(catalogue["predicted_variance"], projected["predicted_variance"])
    a, b = catalogue["estimate"], projected["estimate"]
    directions = np.random.default_rng(3).standard_normal((10, len(a.T))) / a.std(axis=0)
    for along in (*np.eye(len(a.T)), *directions):  # of correlated errors, too
        assert stats.ks_2samp(a @ along, b @ along).pvalue > 1e-4
    if changes.get("weighting") != "equal":
        dof = 4 * 12 - len(a.T)
        chi2 = np.array([catalogue["chi2"], projected["chi2"]]) / n_sim
        assert np.all(np.abs(chi2 - dof) < 4.5 * np.sqrt(2 * dof / n_sim))


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"n_obj": 300, "mean_pm": 0.0},
        {"n_obj": 5, "solve_glide": True},
        {"n_obj": 200, "sky_contrast": 0.9, "weighting": "equal"},
        {"epsilon_size": 1e5},
        {"n_obj": 100, "epsilon_size": 1e7, "omega_size": 1e6},
        {"corrections": False, "omega_size": 1e5},
        {"reference_sigma_pos": 20_000.0, "reference_sigma_pm": 3000.0, "mean_pm": 1e5},
    ],
)
def test_what_is_neglected_is_bounded(changes):
    """The same errors of arcseconds, with the design of each realisation and with the one of the true reference."""
    arcsec = {"reference_errors": "normal", "reference_sigma_pos": 1000.0, "reference_sigma_pm": 500.0}
    arcsec |= {"satellite_errors": "normal", "satellite_sigma_pos": 700.0, "satellite_sigma_pm": 200.0}
    setup = setup_of(point(**(arcsec | changes)))
    design, n_sim, rng = design_of(setup), 200, np.random.default_rng(5)
    sigma = np.sqrt(design.predicted_variance())
    whole, fixed = [], []
    for _ in range(n_sim):
        errors = [side.sigma.T * rng.standard_normal(side.sigma.T.shape) for side in (setup.reference, setup.satellite)]
        catalogue = setup.catalogue
        true = np.stack([catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec])
        seen = true + errors[0] / np.stack([np.cos(catalogue.dec), *np.ones((3, len(catalogue)))])
        options = {"corrections": setup.scenario.corrections, "glide": setup.scenario.solve_glide}
        for rows, found in ((seen, whole), (true, fixed)):
            a = design_matrix(*rows, **options)
            y = setup.differences.T + errors[0] - errors[1]
            found.append(solve(a, y, setup.sigma.T, setup.scenario.weighting).estimate)
    rms = np.sqrt(np.mean((np.array(whole) - np.array(fixed)) ** 2, axis=0)) / sigma
    bound = neglected(design)
    assert np.all(rms < bound)
    assert np.all(rms > bound / 500)  # so the bound is about it


def test_errors_of_an_arcsecond_may_be_projected_and_much_larger_ones_not():
    for arcsec, fits in ((1.0, True), (5.0, True), (300.0, False), (9000.0, False)):
        one = point(n_obj=300, mean_pm=0.0, reference_errors="normal", reference_sigma_pos=1000.0 * arcsec)
        one |= {"method": "projected"}
        assert (link.check(one) is None) == fits
        if fits:
            assert np.all(np.isfinite(run(one, 2)["error"]))
        else:
            with pytest.raises(LinkError, match=r"would neglect .* of sigma"):
                run(one, 2)
