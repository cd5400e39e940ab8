"""Common random numbers: points that share a draw get, to the last bit, what each gets alone."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from linksweep.core.errors import NO_ERRORS, MagnitudeErrors, NormalErrors
from linksweep.core.experiment import evaluate, link, samples, scenario
from linksweep.core.frames import transposed_product
from linksweep.core.missions import FunctionCurve, Mission
from linksweep.core.noise import ROWS, tile_objects, tiles
from linksweep.core.parameters import SHARED
from linksweep.core.setup import SharedSums
from linksweep.core.simulate import simulate
from tests.tiers import examples

OTHER = {
    "model": "gaia",
    "mission_length": 7.0,
    "error_scale": 0.5,
    "satellite_error_scale": 3.0,
    "reference_error_scale": 2.0,
    "satellite_sigma_pos": 0.3,
    "satellite_sigma_pm": 0.2,
    "reference_sigma_pos": 0.5,
    "reference_sigma_pm": 0.7,
    "corrections": False,
    "weighting": "equal",
    "solve_glide": True,
    "arithmetic": "stored",
    "satellite_errors": "normal",
    "reference_errors": "normal",
    "epsilon": (3.0, 0.0, -1.0),
    "omega": (0.0, 0.5, 2.0),
    "epsilon_size": 5.0,
    "omega_size": 0.1,
    "directions": "random",
    "aberration": True,
    "glide": (1.0, 2.0, 3.0),
    "v_min": 7.0,
    "v_max": 13.0,
    "mean_pm": 200.0,
    "pm_distribution": "constant",
    "zone_of_avoidance": 20.0,
    "sky_contrast": 0.4,
    "satellite_floor_pos": 0.3,
    "satellite_floor_pm": 0.4,
    "reference_floor_pos": 0.5,
    "reference_floor_pm": 0.6,
    "satellite_error_ratio": 2.0,
    "reference_error_ratio": 0.7,
    "zonal_pos": 1.0,
    "zonal_pm": 2.0,
    "zonal_length": 70.0,
    "omega_slope": (0.1, 0.0, -0.2),
    "omega_slope_size": 0.3,
    "magnitude_equation_pmra": 0.2,
    "magnitude_equation_pmdec": -0.1,
    "v_zero": 9.0,
    "motion_field": "t_2_0,s_3_1_im=-0.5",
    "motion_field_size": 0.5,
}
"""Another value of every parameter that leaves the draw as it is."""


OWN_STREAM = {"satellite_errors", "reference_errors", "zonal_pos", "zonal_pm"}
"""Parameters that decide whether a stream is drawn from at all."""


def point(**changes):
    return link.defaults() | {"n_obj": 40} | changes


def generators(seed=1):
    return np.random.default_rng(seed), np.random.default_rng(seed + 1)


def test_every_shared_parameter_has_another_value_here():
    assert set(OTHER) == set(SHARED) <= {p.name for p in link.parameters}
    assert all(OTHER[name] != link.parameter(name).default for name in SHARED)


@settings(max_examples=examples(40))
@given(
    changes=st.lists(st.sets(st.sampled_from(sorted(SHARED)), max_size=6), min_size=1, max_size=4),
    sizes=st.lists(st.integers(3, 150), min_size=4, max_size=4),
    n_sim=st.sampled_from([1, 7, 200, ROWS, ROWS + 3]),
    data=st.data(),
)
def test_no_bit_depends_on_who_shares_the_draw(changes, sizes, n_sim, data):
    points = [point(n_obj=n, **{name: OTHER[name] for name in c}) for c, n in zip(changes, sizes, strict=False)]
    order = data.draw(st.permutations(range(len(points))))
    together = samples([points[k] for k in order], n_sim, *generators())
    for place, k in enumerate(order):
        alone = samples([points[k]], n_sim, *generators())
        for name, values in alone.items():
            np.testing.assert_array_equal(together[name][place], values[0], err_msg=name)


def test_quasars_of_each_limit_share_the_draw():
    points = [point(catalogue="quasars", n_obj=None, v_max=v) for v in (17.0, 14.0, 15.5)]
    together = evaluate(points, 100, *generators())
    for k, one in enumerate(points):
        for name, values in evaluate([one], 100, *generators()).items():
            np.testing.assert_array_equal(together[name][k], values[0], err_msg=name)


@pytest.mark.parametrize("name", sorted(set(SHARED) - OWN_STREAM))
@pytest.mark.parametrize("reference_errors", ["none", "normal"])
def test_a_shared_parameter_does_not_change_the_generators(name, reference_errors):
    """What is drawn is counted and compared, normal by normal, for the default and the other value."""

    def drawn(point):
        errors, catalogue, seen = np.random.PCG64(1), np.random.PCG64(2), []

        class Recording(np.random.Generator):
            def standard_normal(self, size=None, out=None):
                normals = super().standard_normal(size, out=out)
                seen.append(np.array(normals))
                return normals

        simulate([scenario(point)], 5, Recording(errors), np.random.Generator(catalogue))
        return np.concatenate([part.ravel() for part in seen])

    base = point(reference_errors=reference_errors)
    np.testing.assert_array_equal(drawn(base), drawn(base | {name: OTHER[name]}))


def test_objects_keep_their_errors_when_others_follow():
    """The first 50 of 90 objects, the others so uncertain that they do not count: the same estimates."""
    many = scenario(point(n_obj=90))

    class Uncertain(NormalErrors):
        def standard_errors(self, catalogue):
            return super().standard_errors(catalogue) * np.where(np.arange(len(catalogue)) < 50, 1.0, 1e7)

    whole = replace(many, satellite_errors=Uncertain(1.0, 1.0))
    first = replace(whole, draw_catalogue=lambda rng: many.draw_catalogue(rng).take(np.arange(50)))
    for reference in (NO_ERRORS, Uncertain(0.5, 0.5)):
        few, all_of_them = (
            simulate([replace(s, reference_errors=reference)], 30, *generators(), keep_estimates=True)[0]["estimate"]
            for s in (first, whole)
        )
        assert np.std(few, axis=0).min() > 0.05
        np.testing.assert_allclose(few, all_of_them, atol=1e-6)


def test_a_users_accuracy_curve_is_computed_for_each_catalogue_by_itself():
    """It may round otherwise among other objects: here by 1e-12 for each of them."""

    class Rounding:
        name, digest = "rounding", "0123456789ab"

        def __call__(self, v_mag):
            return np.full(len(v_mag), 0.3 * (1.0 + 1e-12 * len(v_mag)))

    curve = FunctionCurve(Rounding())
    errors = MagnitudeErrors(Mission(curve, curve, 1.0, np.inf, "a test"))
    limits = [scenario(point(catalogue="quasars", n_obj=None, v_max=v)) for v in (14.0, 15.0)]
    both = [replace(one, satellite_errors=errors) for one in limits]
    together, alone = simulate(both, 30, *generators()), simulate(both[:1], 30, *generators())
    np.testing.assert_array_equal(together[0]["error"], alone[0]["error"])
    np.testing.assert_array_equal(together[0]["predicted_variance"], alone[0]["predicted_variance"])


def test_sharing_makes_the_difference_of_two_points_certain():
    """sigma of the same draw scales with the errors exactly; of separate draws it does to Monte-Carlo error."""
    points = [point(satellite_errors="normal"), point(satellite_errors="normal", error_scale=2.0)]
    error = samples(points, 300, *generators())["estimate"] - 1.0
    np.testing.assert_allclose(error[1], 2.0 * error[0], atol=1e-7)  # the bias is of second order, 5e-9 mas
    apart = samples([points[1]], 300, *generators(9))["estimate"] - 1.0
    assert np.abs(np.std(apart) / np.std(error[0]) - 2.0) > 1e-3


def test_random_directions_are_the_same_for_catalogues_of_any_size():
    directions = {"directions": "random", "satellite_errors": "none"}
    points = [point(n_obj=n, **directions) for n in (5, 40)]
    estimates = samples(points, 1, *generators())["estimate"]
    np.testing.assert_allclose(estimates[0], estimates[1], rtol=1e-6)
    assert np.abs(estimates[0] - 1.0).max() > 0.1


@given(
    rows=st.integers(1, ROWS),
    n_obj=st.integers(0, 300),
    fewer=st.integers(0, 300),
    stack=st.sampled_from([(), (1,), (3,)]),
)
def test_tiles_are_the_streams_object_by_object(rows, n_obj, fewer, stack):
    def drawn():
        rngs = [np.random.default_rng(seed) for seed in range(math.prod(stack))]
        return tiles(rngs, stack, rows, n_obj)

    plain = np.array([np.random.default_rng(k).standard_normal((n_obj, 4, rows)) for k in range(math.prod(stack))])
    plain = plain.reshape(*stack, n_obj, 4, rows)
    found = [(tile.start, tile.normals.copy()) for tile in drawn()]
    for start, normals in found:
        np.testing.assert_array_equal(normals, plain[..., start : start + normals.shape[-3], :, :])
    assert sum(normals.shape[-3] for _, normals in found) == n_obj
    few = min(fewer, n_obj)
    assert sum(tile.head(few).shape[-3] for tile in drawn()) == few
    columns = np.random.default_rng(9).standard_normal((*stack, n_obj, 4, 3))
    shared, terms = SharedSums(), []

    def products_of(size):
        def products(normals, place):
            terms.append(normals.shape[-3])
            return transposed_product(columns[..., :size, :, :][..., place, :, :], normals)

        return products

    # of two nested catalogues, the smaller one asked for at either place
    asked = {size: shared.ask("ours", size, products_of(size)) for size in (few, n_obj, few) if size}
    for tile in drawn():
        shared.add(tile)
    for size, total in asked.items():
        expected = np.einsum("...nic,...nir->...cr", columns[..., :size, :, :], plain[..., :size, :, :])
        np.testing.assert_allclose(total(), expected, rtol=1e-9, atol=1e-9 * np.sqrt(size))
    assert len(terms) <= -(-n_obj // tile_objects(rows)) + 1  # of what they share, once
