"""The link as an experiment: its sums, samples and results; what points share, and catalogues computed together."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from scipy import stats

from linksweep.core import simulate
from tests.core import points
from tests.core.points import CatalogueErrors, NormalErrors, OwnErrors, experiment, generators, link, point, scenario
from tests.tiers import examples, slow

VALUES = {"catalogue": ["synthetic", "quasars", "galaxies", "radio-stars"], "arithmetic": ["exact", "stored"]}
VALUES |= {"satellite_errors": ["none", "normal", "magnitude"], "reference_errors": ["none", "normal"]}
VALUES |= {"weighting": ["inverse-variance", "equal"], "omega": [(0.0, 0.0, 0.0), (-0.5, 0.9, 1.2)]}
VALUES |= {"zone_of_avoidance": [0.0, 15.0], "sky_contrast": [0.0, 0.4], "n_obj": range(9, 101)}
VALUES |= {name: [False, True] for name in ("solve_glide", "corrections", "aberration")}
POINTS = st.fixed_dictionaries({name: st.sampled_from(values) for name, values in VALUES.items()})
SHARED = st.sets(st.sampled_from(sorted(link.shared)), max_size=6)
N_SIM, NESTED = st.sampled_from([1, 7, 200, points.ROWS, points.ROWS + 3]), [14.5, 14.0, 15.0]  # v_max of quasars
SEEDS, NONE = st.integers(0, 2**32 - 1), {"satellite_sigma_pm": 0.0, "satellite_sigma_pos": 0.0}  # not measured
OTHER = points.OTHER | NONE
RANDOM = {"directions": "random", "epsilon": (1.0, 2.0, 3.0)}
RATIO = {"satellite_error_ratio": 2.0, "satellite_errors": "normal"}
NORMAL = {"reference_errors": NormalErrors(10.0, 1.0), "satellite_errors": NormalErrors(1.0, 1.0)}
OWN = {"reference_errors": CatalogueErrors(side="reference"), "satellite_errors": CatalogueErrors()}


@pytest.mark.parametrize("changes", [{}, {"reference_errors": "normal"}, {"solve_glide": True}])
def test_samples_are_the_estimates_that_evaluate_adds_up(changes):
    both, n_sim = [point(**changes), point(n_obj=7, omega=(4.0, 0.0, -2.0), **changes)], points.ROWS + 88
    sums = link.evaluate(both, n_sim, *generators())
    kept = link.samples(both, n_sim, *generators())
    estimates = kept.pop("estimate")
    assert set(kept) == set(sums)
    for name, values in sums.items():
        np.testing.assert_array_equal(kept[name], values)
    assert estimates.shape == (2, n_sim, 6)
    error = estimates - np.array([[*p["epsilon"], *p["omega"]] for p in both])[:, None]
    products = np.einsum("pni,pnj->pij", error, error)
    deviation = error.std(axis=1, ddof=1) * np.sqrt((n_sim - 1) / (n_sim - 3) / n_sim)
    result = link.summarise(sums, np.full(2, float(n_sim)), np.ones(2))["bias_mc_error"]
    np.testing.assert_allclose(result, deviation, rtol=1e-6)
    tolerance = {"rtol": 0, "atol": 1e-12 * n_sim * np.max(np.abs(error)) ** 2}
    np.testing.assert_allclose(error.sum(axis=1), sums["error"][:, :6], **tolerance)
    np.testing.assert_allclose(products, sums["error_products"], **tolerance)


def test_random_directions_of_a_study_keep_the_size_and_change_with_the_catalogue(monkeypatch):
    drawn, prepare = [], simulate.prepare
    monkeypatch.setattr(simulate, "prepare", lambda one, sky, *more: drawn.append(more[0]) or prepare(one, sky, *more))
    none = {"epsilon": (0.0, 0.0, 0.0), "satellite_errors": "none"}
    random = point(directions="random", epsilon_size=5.0, omega_size=0.5, **none)
    for k in range(4):
        kept = link.samples([random], 2, np.random.default_rng(1), np.random.default_rng(k))["estimate"]
        assert np.abs(kept).max() < 1e-6  # estimate - truth, which differs from catalogue to catalogue
    truth = np.array(drawn) / points.MAS
    np.testing.assert_allclose(np.linalg.norm(truth, axis=-1), [[5.0, 0.5]] * 4, rtol=1e-6)
    assert np.abs(np.diff(truth, axis=0)).max(axis=(1, 2)).min() > 0.05


@pytest.mark.parametrize("solve_glide", [False, True])
def test_summarise_against_direct_formulas(solve_glide):
    errors = {"satellite_errors": "normal", "reference_errors": "normal", "reference_sigma_pm": 2.0}
    one, n_cat, n_sim, rng = point(n_obj=12, solve_glide=solve_glide, **errors), 5, 8, np.random.default_rng(4)
    blocks = [link.evaluate([one], 1, rng, np.random.default_rng(k)) for k in range(n_cat) for _ in range(n_sim)]
    sums = {name: sum(block[name] for block in blocks) for name in link.sums}
    results = {k: v[0] for k, v in link.summarise(sums, np.array([40.0]), np.array([5.0])).items()}
    names = ("error", "predicted_variance", "predicted_bias", "chi2", "condition_number", "predicted_square_variance")
    each = (np.array([block[name][0] for block in blocks]) for name in names)
    error, predicted, predicted_bias, chi2, condition, of_squares = each
    assert np.all(np.isnan(error[:, 6:]) == (not solve_glide))
    error, total = np.nan_to_num(error), predicted + predicted_bias**2
    expected = {"n_obj": 12.0, "dof": 4 * 12 - (9 if solve_glide else 6)}
    expected |= {"covariance": np.cov(error[:, :6].T, bias=True), "correlation": np.corrcoef(error[:, :6].T)}
    for name, values in (("chi2", chi2), ("condition_number", condition)):
        expected |= {name: values.mean(), f"{name}_mc_error": np.sqrt(2 * values.var() / 4)}
    single, part = np.eye(9), of_squares.mean(axis=0)
    parts = {"sigma": (single[:6], part[:6]), "glide_sigma": (single[6:], part[6:9])}
    parts["sigma_orientation"] = single[:3].mean(axis=0), part[9]
    parts["sigma_spin"] = single[3:6].mean(axis=0), part[10]
    for name, (weights, of_these) in parts.items():
        if name == "glide_sigma" and not solve_glide:
            expected |= {name: np.full(3, np.nan) for name in results if name.startswith("glide")}
            continue
        sigma, whole = np.sqrt(weights @ np.mean(error**2, axis=0)), np.sqrt(weights @ np.mean(total, axis=0))
        by_catalogue = weights @ total[::n_sim].T
        # (n_cat - 1)/(n_cat - 3) = 2, and more where they are skewed
        widened = 2 * (1 + 6 * stats.skew(by_catalogue, axis=-1) ** 2 / n_cat)
        error_of_mean = np.sqrt(widened / n_cat) * by_catalogue.std(axis=-1, ddof=1)
        expected |= {
            **{name: sigma, f"{name}_mc_error": np.sqrt(of_these / 40) / (2 * whole)},
            **{f"{name}_predicted": np.sqrt(weights @ predicted.mean(axis=0)), f"{name}_rms_predicted": whole},
            f"{name}_catalogue_error": error_of_mean / (2 * whole),
        }
    for name, part in (("bias", slice(0, 6)), ("glide_bias", slice(6, 9)))[: 1 + solve_glide]:
        expected[name] = error.mean(axis=0)[part]
        expected[f"{name}_predicted"] = predicted_bias.mean(axis=0)[part]
        # each realisation is a batch, so that each counts
        expected[f"{name}_mc_error"] = np.sqrt(2 * error.var(axis=0) / 4)[part]
    for name, value in results.items():  # every one has its formula above
        np.testing.assert_allclose(value, expected[name], rtol=1e-7, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("scatter", [2.0, 0.0])
def test_the_error_of_a_bias_is_right_on_the_average_where_catalogues_have_several_blocks(scatter):
    """From the sums expected, against the variance of a mean of numbers whose catalogues have biases of their own."""
    rng, (samples, n_cat, batches, rows) = np.random.default_rng(7), (4000, 9, 4, 5)
    error = 3.0 * rng.standard_normal((samples, n_cat, batches, rows))
    error += scatter * rng.standard_normal((samples, n_cat, 1, 1))
    n = n_cat * batches * rows
    sums = {name: np.zeros((samples, *shape)) for name, shape in link.sums.items()}
    sums["error"] += error.sum(axis=(1, 2, 3))[:, None]
    sums["error_products"] += np.square(error).sum(axis=(1, 2, 3))[:, None, None]
    sums["batch_mean_squares"] += (np.square(error.sum(axis=3)) / rows).sum(axis=(1, 2))[:, None]
    sums["batches"] += n_cat * batches
    expected = scatter**2 / n_cat + 9.0 / n
    sums["error"][0], sums["error_products"][0] = n * np.sqrt(expected), n * (scatter**2 + 9.0)  # the sums expected
    sums["batch_mean_squares"][0] = n * (scatter**2 + 9.0 / rows)
    counts = np.full(samples, float(n)), np.full(samples, float(n_cat))
    result = link.summarise(sums, *counts)["bias_mc_error"][:, 0] ** 2
    inside = np.square(error - error.mean(axis=3, keepdims=True)).sum(axis=(1, 2, 3)) / (n - n_cat * batches) / n
    assert np.all(result[1:] > inside[1:] * (1.0 - 1e-9))  # also where catalogues seem not to differ
    assert result[0] * (n_cat - 3) / (n_cat - 1) == pytest.approx(expected)  # without the factor for few catalogues


def test_catalogue_error_is_unknown_for_one_catalogue_and_zero_without_errors():
    noisy = points.evaluated(10, point())
    one = link.summarise(noisy, np.array([10.0]), np.ones(1))
    assert np.all(np.isnan(one["sigma_catalogue_error"]))
    assert (one["chi2_mc_error"], one["condition_number_mc_error"]) == (pytest.approx(np.sqrt(0.2 * one["dof"])), 0.0)
    for n_cat in (2.0, 3.0, 4.0):
        few = link.summarise(noisy, np.array([10.0]), np.array([n_cat]))
        assert np.all(np.isnan([few["sigma_catalogue_error"], few["bias_mc_error"]]))
    perfect = points.evaluated(10, point(satellite_errors="none"))
    results = link.summarise(perfect, np.array([10.0]), np.array([5.0]))
    assert np.all(results["sigma_catalogue_error"] < 1e-12)
    np.testing.assert_array_equal(results["sigma_spin_predicted"], 0.0)


@settings(max_examples=examples(25))
@example([(set(), 30), *(({name}, 30) for name in sorted(link.shared))], 7, 0)
@example([*(({name, "satellite_errors"}, 30) for name in sorted(link.shared)), ({"omega"}, 40)], 7, 1)
@example([(set(), v_max) for v_max in NESTED], 7, 0)
@given(st.lists(st.tuples(SHARED, st.integers(3, 150) | st.sampled_from(NESTED)), min_size=1, max_size=4), N_SIM, SEEDS)
def test_no_bit_depends_on_who_shares_the_draw(changes, n_sim, seed):
    drawn = []
    for names, size in changes:
        needed = {"omega_slope"} & {name.removesuffix("_size") for name in names}  # a size needs its direction
        sky = {"n_obj": size} if size not in NESTED else {"catalogue": "quasars", "n_obj": None, "v_max": size}
        drawn.append(point(**{"mean_pm": 50.0} | sky | {name: OTHER[name] for name in names | needed}))
    order = np.random.default_rng(seed).permutation(len(drawn)) if seed else range(len(drawn))
    together = link.samples([drawn[k] for k in order], n_sim, *generators())
    for place, k in enumerate(order):
        alone = link.samples([drawn[k]], n_sim, *generators())
        for name, values in alone.items():
            np.testing.assert_array_equal(together[name][place], values[0], err_msg=name)


def test_a_users_accuracy_curve_is_computed_for_each_catalogue_by_itself():
    curve = points.FunctionCurve(points.Function(lambda v_mag: np.full(len(v_mag), 0.3 * (1.0 + 1e-12 * len(v_mag)))))
    mission = points.Named("a test", "", points.Mission(curve, curve, 1.0, np.inf, "a test"))
    limits = [scenario(point(catalogue="quasars", n_obj=None, v_max=v)) for v in (14.0, 15.0)]
    both = [replace(one, satellite_errors=points.MagnitudeErrors(mission)) for one in limits]
    together, alone = (points.simulate(some, 30, [generators()]) for some in (both, both[:1]))
    np.testing.assert_array_equal(together[0]["error"], alone[0]["error"])
    np.testing.assert_array_equal(together[0]["predicted_variance"], alone[0]["predicted_variance"])


def streams(n_cat, seed=1):
    return [(np.random.default_rng([seed, k, 1]), np.random.default_rng([seed, k, 0])) for k in range(n_cat)]


def assert_same_bits(here, n_sim, n_cat):
    result = link.evaluate_catalogues([here], n_sim, streams(n_cat))
    for k, pair in enumerate(streams(n_cat)):
        for name, values in link.evaluate([here], n_sim, *pair).items():
            assert result[name][k].tobytes() == values.tobytes(), name


@settings(max_examples=examples(60))
@given(changes=POINTS, n_sim=st.sampled_from([2, 3, 20, 100]), n_cat=st.integers(2, 5))
def test_each_catalogue_has_the_bits_that_it_has_by_itself(changes, n_sim, n_cat):
    here = link.defaults() | changes
    assert points.can_stack(scenario(here), n_sim)
    assert_same_bits(here, n_sim, n_cat)


@pytest.mark.parametrize("reference_errors", ["none", slow("normal")])
def test_so_it_is_where_objects_come_in_several_tiles_and_catalogues_in_several_stacks(reference_errors, monkeypatch):
    here = link.defaults() | {"n_obj": 700, "reference_errors": reference_errors}
    monkeypatch.setattr(experiment, "STACK", 2 * 700 * 100)
    assert_same_bits(here, 100, 5)


@pytest.mark.parametrize("changes", [RANDOM, RATIO, {"method": "projected"}, {"zonal_pm": 0.1}])
def test_what_cannot_be_stacked_is_computed_one_by_one(changes):
    here = link.defaults() | {"n_obj": 30} | changes
    assert not points.can_stack(scenario(here), 10)
    assert_same_bits(here, 10, 3)


def without_errors(sky, some):
    """By themselves they would be linked in another way."""
    one = np.full((*sky.ra.shape, 4), points.MAS)
    return replace(sky, errors=OwnErrors(one), reference=OwnErrors(np.where(some[..., None], 0.0, one)))


def at_a_pole(sky, some):
    """Where sines of noisy positions are computed in another way."""
    return replace(sky, dec=np.where(some & (np.arange(12) == 3), 89.99 * points.DEGREE, sky.dec))


@pytest.mark.parametrize(
    ("change", "errors", "words"),
    [
        (without_errors, OWN, "no errors"),
        (at_a_pole, NORMAL, "small angles"),
        (lambda one, some: replace(one, ra=0.0 * one.ra + 1.0, dec=0.0 * one.dec + 0.5), {}, "rank deficient"),
    ],
)
def test_catalogues_that_differ_in_kind_or_determine_no_link_are_refused(change, errors, words):
    def draw(rng):
        ra, dec = rng.uniform(0.0, 2.0 * np.pi, 12), np.arcsin(rng.uniform(-1.0, 1.0, 12))
        zero = np.zeros_like(ra + dec)
        return change(points.Catalogue(ra + zero, dec + zero, zero, zero, zero), rng.random(1)[..., :1] < 0.5)

    physics = replace(scenario(point(n_obj=12)), draw_catalogue=points.NestedDraw("own", 12, draw, True), **errors)
    with pytest.raises(points.LinkError, match=words):
        points.simulate([physics], 5, streams(8), (8,))
