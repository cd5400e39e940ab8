"""The link as the platform sees it: units, checks, cost and the formulas of the results."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from astropy import units

from core.catalogue import quasar_count
from core.constants import MAS
from core.experiment import OUTPUTS, PARAMETERS, SUMS, check, cost, evaluate, link, scenario, summarise
from core.link import UNKNOWNS
from core.missions import MISSIONS
from core.simulate import simulate

SIX = ["mas"] * 3 + ["mas / yr"] * 3


def point(**changes):
    assert set(changes) <= set(link.defaults())
    return link.defaults() | {"n_obj": 30} | changes


def evaluated(point, n_sim, seed=1, catalogue_seed=2):
    return evaluate([point], n_sim, np.random.default_rng(seed), np.random.default_rng(catalogue_seed))


def merged(blocks):
    return {name: sum(block[name] for block in blocks) for name in SUMS}


def strict_unit(text):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return units.Unit(text)


@pytest.mark.parametrize("declared", [*PARAMETERS, *OUTPUTS], ids=lambda declared: declared.name)
def test_every_unit_is_one_that_astropy_reads(declared):
    unit = strict_unit(declared.unit)
    if declared.unit == "":
        assert unit == units.dimensionless_unscaled


def test_units_of_vectors_and_matrices_are_those_of_their_components():
    six = [strict_unit(u) for u in link.component_units["component"]]
    assert six == [units.Unit(u) for u in SIX]
    for output in OUTPUTS:
        if output.dims == ("component",):
            assert list(strict_unit(output.unit).values()) == six
        elif output.dims == ("component", "component_other"):
            rows = [list(row.values()) for row in strict_unit(output.unit).values()]
            assert rows == [[a * b for b in six] for a in six]
        else:
            assert isinstance(strict_unit(output.unit), units.UnitBase)


def test_the_declaration_is_complete():
    assert link.coordinates == {"component": UNKNOWNS, "component_other": UNKNOWNS}
    assert [len(link.component_units[dim]) for dim in link.coordinates] == [6, 6]
    assert all(set(output.dims) <= set(link.coordinates) for output in OUTPUTS)
    assert len({p.name for p in PARAMETERS}) == len(PARAMETERS)
    assert all(p.default is None or p.parse(p.default) == p.default for p in PARAMETERS)
    assert link.sums_width == 6 + 36 + 1 + 6 + 6 + 1


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"satellite_errors": "none"},
        {"satellite_errors": "none", "reference_errors": "normal"},
        {"satellite_errors": "normal", "reference_errors": "normal", "reference_error_scale": 0.0},
        {"satellite_errors": "normal", "satellite_sigma_pos": 0.0, "satellite_sigma_pm": 0.0},
        {"satellite_errors": "normal", "satellite_sigma_pm": 0.0, "reference_errors": "normal"},
        {"error_scale": 0.0},
        {"model": "gaia-2001", "v_max": 21.0},
        {"model": "gaia-2001", "v_max": 25.0, "satellite_errors": "normal"},
        {"catalogue": "quasars", "n_obj": None},
        {"catalogue": "quasars", "n_obj": 88},
        {"catalogue": "quasars", "n_obj": None, "v_max": 12.8, "v_min": 19.0},
    ],
)
def test_points_without_a_problem_can_be_computed(changes):
    assert check(point(**changes)) is None
    with np.errstate(all="raise"):
        sums = evaluated(point(**changes), 2)
    assert all(np.all(np.isfinite(values)) for values in sums.values())


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"catalogue": "quasars", "v_max": 12.0}, "v_max = 12 mag is outside the quasar counts"),
        ({"catalogue": "quasars", "v_max": 20.5}, "v_max = 20.5 mag is outside the quasar counts"),
        ({"catalogue": "quasars", "n_obj": 89}, "n_obj = 89: only 88 quasars are brighter than v_max = 15 mag"),
        ({"n_obj": None}, "n_obj: a synthetic catalogue needs a number of objects"),
        ({"v_max": 5.0}, "v_max = 5 mag: must be fainter than the brightest object, v_min = 5 mag"),
        ({"model": "gaia-2001", "v_max": 21.5}, "v_max = 21.5 mag: the curve of 'gaia-2001' ends at 21 mag"),
        (
            {"satellite_errors": "normal", "satellite_sigma_pm": 0.0},
            "proper motions without any error beside positions with errors cannot be weighed",
        ),
        (
            {"satellite_errors": "none", "reference_errors": "normal", "reference_sigma_pos": 0.0},
            "positions without any error beside proper motions with errors cannot be weighed",
        ),
    ],
)
def test_points_with_a_problem(changes, problem):
    assert check(point(**changes)).startswith(problem)


def test_check_of_a_magnitude_where_the_curve_overflows():
    assert check(point(v_max=1000.0)) is not None


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"n_obj": 2000},
        {"satellite_errors": "normal", "reference_errors": "normal"},
        {"satellite_errors": "none", "reference_errors": "normal"},
        {"catalogue": "quasars", "n_obj": None},
        {"catalogue": "quasars", "n_obj": 50, "v_max": 17.3},
        {"satellite_errors": "none"},
        {"reference_errors": "normal", "reference_error_scale": 0.0},
    ],
)
def test_cost_is_the_number_of_normals_drawn(changes):
    n_sim, drawn, counted = 50, np.random.default_rng(1), np.random.default_rng(1)
    evaluate([point(**changes)], n_sim, drawn, np.random.default_rng(2))
    counted.standard_normal(int(n_sim * cost(point(**changes))))
    assert drawn.bit_generator.state == counted.bit_generator.state


def test_cost_of_quasars_follows_the_limit():
    for v_max in (14.0, 16.2, 20.0):
        assert cost(point(catalogue="quasars", n_obj=None, v_max=v_max)) == 4 * quasar_count(v_max)


def test_evaluate_returns_one_row_a_point_and_draws_one_after_the_other():
    points = [point(), point(model="gaia"), point(satellite_errors="normal", reference_errors="normal")]
    together = evaluate(points, 5, np.random.default_rng(1), np.random.default_rng(2))
    assert {name: values.shape for name, values in together.items()} == {n: (3, *shape) for n, shape in SUMS.items()}
    rng, catalogue_rng = np.random.default_rng(1), np.random.default_rng(2)
    for k, one in enumerate(points):
        block = simulate(scenario(one), 5, rng, catalogue_rng)
        for name in SUMS:
            np.testing.assert_array_equal(together[name][k], getattr(block, name))


def test_units_of_the_parameters():
    physics = scenario(point(epsilon=(1.0, 2.0, 3.0), omega=(4.0, 5.0, 6.0), mean_pm=500.0, corrections=False))
    np.testing.assert_allclose(physics.epsilon, np.array([1.0, 2.0, 3.0]) * units.mas.to(units.rad), rtol=1e-14)
    np.testing.assert_allclose(physics.omega, np.array([4.0, 5.0, 6.0]) * units.mas.to(units.rad), rtol=1e-14)
    catalogue = physics.draw_catalogue(np.random.default_rng(3))
    assert np.hypot(catalogue.pmra, catalogue.pmdec).max() < 1000.0 * MAS
    assert not physics.corrections


def test_summarise_has_every_output_in_its_shape():
    sums = {name: np.stack([values[0]] * 4) for name, values in evaluated(point(), 10).items()}
    results = summarise(sums, np.full(4, 10.0), np.ones(4))
    assert set(results) == {output.name for output in OUTPUTS}
    for output in OUTPUTS:
        assert results[output.name].shape == (4, *(6 for _ in output.dims)), output.name


def test_summarise_against_direct_formulas():
    """One realisation per block gives the single errors, from which NumPy says the same."""
    one = point(n_obj=12, satellite_errors="normal", reference_errors="normal", reference_sigma_pm=2.0)
    n_cat, n_sim = 5, 8
    rng = np.random.default_rng(4)
    blocks = [evaluate([one], 1, rng, np.random.default_rng(k)) for k in range(n_cat) for _ in range(n_sim)]
    results = {k: v[0] for k, v in summarise(merged(blocks), np.array([40.0]), np.array([5.0])).items()}
    error = np.array([block["error"][0] for block in blocks])
    predicted = np.array([block["predicted_variance"][0] for block in blocks])
    sigma = np.sqrt(np.mean(error**2, axis=0))

    expected = {
        "n_obj": 12.0,
        "dof": 4 * 12 - 6,
        "chi2": np.mean([block["chi2"][0] for block in blocks]),
        "bias": error.mean(axis=0),
        "sigma": sigma,
        "sigma_mc_error": sigma / np.sqrt(2 * 40),
        "sigma_predicted": np.sqrt(predicted.mean(axis=0)),
        "covariance": np.cov(error.T, bias=True),
        "sigma_orientation": np.sqrt(np.mean(error[:, :3] ** 2)),
        "sigma_orientation_mc_error": np.sqrt(np.mean(error[:, :3] ** 2) / (2 * 3 * 40)),
        "sigma_orientation_predicted": np.sqrt(predicted[:, :3].mean()),
        "sigma_spin": np.sqrt(np.mean(error[:, 3:] ** 2)),
        "sigma_spin_mc_error": np.sqrt(np.mean(error[:, 3:] ** 2) / (2 * 3 * 40)),
        "sigma_spin_predicted": np.sqrt(predicted[:, 3:].mean()),
    }
    by_catalogue = predicted[::n_sim]
    error_of_mean = by_catalogue.std(axis=0, ddof=1) / np.sqrt(n_cat)
    expected["sigma_catalogue_error"] = error_of_mean / (2 * expected["sigma_predicted"])
    assert set(expected) == set(results)
    for name, value in expected.items():
        np.testing.assert_allclose(results[name], value, rtol=1e-7, atol=1e-12, err_msg=name)


def test_catalogue_error_is_unknown_for_one_catalogue_and_zero_without_errors():
    noisy = evaluated(point(), 10)
    assert np.all(np.isnan(summarise(noisy, np.array([10.0]), np.ones(1))["sigma_catalogue_error"]))
    perfect = evaluated(point(satellite_errors="none"), 10)
    results = summarise(perfect, np.array([10.0]), np.ones(1))
    np.testing.assert_array_equal(results["sigma_catalogue_error"], 0.0)
    np.testing.assert_array_equal(results["sigma_spin_predicted"], 0.0)


def test_catalogue_error_is_the_scatter_between_samples_of_catalogues():
    n_cat, n_samples = 8, 60

    def sample(k):
        blocks = [evaluated(point(n_obj=10), 1, 5, 100 * k + j) for j in range(n_cat)]
        return summarise(merged(blocks), np.array([float(n_cat)]), np.array([float(n_cat)]))

    samples = [sample(k) for k in range(n_samples)]
    scatter = np.std([s["sigma_predicted"][0] for s in samples], axis=0)
    stated = np.sqrt(np.mean([s["sigma_catalogue_error"][0] ** 2 for s in samples], axis=0))
    # each ratio is known to 1/sqrt(2 x 60) = 9 % from the scatter, and as much from skewed predictions
    np.testing.assert_allclose((stated / scatter).mean(), 1.0, atol=0.25)


def test_the_published_error_of_amex_at_fifteenth_magnitude():
    quasars = point(catalogue="quasars", n_obj=None)
    blocks = [evaluated(quasars, 100, 6 + k, 1000 + k) for k in range(100)]
    results = summarise(merged(blocks), np.array([10_000.0]), np.array([100.0]))
    assert abs(results["sigma_spin"][0] - 0.61) < 0.02  # residual of the fit that made the curve
    difference = results["sigma_spin"][0] - results["sigma_spin_predicted"][0]
    assert abs(difference) < 4 * results["sigma_spin_mc_error"][0]


@pytest.mark.parametrize(("n_obj_factor", "length_factor"), [(1, 1.5), (4, 1)])
def test_scaling_of_the_prediction(n_obj_factor, length_factor):
    """sigma(omega) ~ N^-1/2 T^-3/2 and sigma(epsilon) ~ N^-1/2 T^-1/2: one catalogue, taken several times."""
    nominal = MISSIONS["amex"].nominal_length_yr
    physics = [scenario(point(mission_length=f * nominal)) for f in (1.0, length_factor)]
    few, many = (
        physics[k].draw_catalogue(np.random.default_rng(7)).take(np.tile(np.arange(30), f))
        for k, f in ((0, 1), (1, n_obj_factor))
    )
    before, after = (
        simulate(
            replace(p, draw_catalogue=lambda _, c=c: c), 1, np.random.default_rng(8), np.random.default_rng(9)
        ).predicted_variance
        for p, c in zip(physics, (few, many), strict=True)
    )
    ratio = np.sqrt(after / before)
    np.testing.assert_allclose(ratio[:3], n_obj_factor**-0.5 * length_factor**-0.5, rtol=1e-9)
    np.testing.assert_allclose(ratio[3:], n_obj_factor**-0.5 * length_factor**-1.5, rtol=1e-9)
