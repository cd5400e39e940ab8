"""Catalogues that are computed together: to the last bit what each gives by itself."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import linksweep.core.experiment
from linksweep.core.catalogue import Catalogue, NestedDraw, OwnErrors
from linksweep.core.errors import CatalogueErrors, NormalErrors
from linksweep.core.experiment import evaluate, evaluate_catalogues, link
from linksweep.core.frames import DEGREE, MAS
from linksweep.core.link import LinkError, UnlikeError
from linksweep.core.scenario import scenario
from linksweep.core.simulate import can_stack, simulate, simulate_stack
from tests.tiers import examples

CATALOGUES = ("synthetic", "quasars", "galaxies", "radio-stars")

POINTS = st.fixed_dictionaries(
    {
        "catalogue": st.sampled_from(CATALOGUES),
        "n_obj": st.integers(9, 100),
        "weighting": st.sampled_from(["inverse-variance", "equal"]),
        "solve_glide": st.booleans(),
        "corrections": st.booleans(),
        "aberration": st.booleans(),
        "arithmetic": st.sampled_from(["exact", "stored"]),
        "reference_errors": st.sampled_from(["none", "normal"]),
        "satellite_errors": st.sampled_from(["none", "normal", "magnitude"]),
        "omega": st.sampled_from([(0.0, 0.0, 0.0), (-0.5, 0.9, 1.2)]),
        "zone_of_avoidance": st.sampled_from([0.0, 15.0]),
        "sky_contrast": st.sampled_from([0.0, 0.4]),
    }
)


def streams(n_cat, seed=1):
    return [(np.random.default_rng([seed, k, 1]), np.random.default_rng([seed, k, 0])) for k in range(n_cat)]


def one_by_one(point, n_sim, n_cat):
    return [evaluate([point], n_sim, *pair) for pair in streams(n_cat)]


def assert_same_bits(found, expected):
    for k, sums in enumerate(expected):
        for name, values in sums.items():
            assert found[name][k].tobytes() == values.tobytes(), name


@settings(max_examples=examples(60))
@given(changes=POINTS, n_sim=st.sampled_from([2, 3, 20, 100]), n_cat=st.integers(2, 5))
def test_each_catalogue_has_the_bits_that_it_has_by_itself(changes, n_sim, n_cat):
    point = link.defaults() | changes
    assert can_stack(scenario(point), n_sim)
    assert_same_bits(evaluate_catalogues([point], n_sim, streams(n_cat)), one_by_one(point, n_sim, n_cat))


@pytest.mark.parametrize("reference_errors", ["none", "normal"])
def test_so_it_is_where_objects_come_in_several_tiles_and_catalogues_in_several_stacks(reference_errors, monkeypatch):
    point = link.defaults() | {"n_obj": 700, "reference_errors": reference_errors}
    monkeypatch.setattr(linksweep.core.experiment, "STACK", 2 * 700 * 100)
    assert_same_bits(evaluate_catalogues([point], 100, streams(5)), one_by_one(point, 100, 5))


@pytest.mark.parametrize(
    "changes",
    [
        {"directions": "random", "epsilon": (1.0, 2.0, 3.0)},
        {"method": "projected"},
        {"zonal_pm": 0.1},
        {"satellite_error_ratio": 2.0, "satellite_errors": "normal"},
    ],
)
def test_what_cannot_be_stacked_is_computed_one_by_one(changes):
    point = link.defaults() | {"n_obj": 30} | changes
    assert not can_stack(scenario(point), 10)
    assert_same_bits(evaluate_catalogues([point], 10, streams(3)), one_by_one(point, 10, 3))


def test_points_that_share_their_draws_are_computed_together_catalogue_by_catalogue():
    points = [link.defaults() | {"n_obj": 30, "satellite_error_scale": scale} for scale in (1.0, 2.0)]
    found = evaluate_catalogues(points, 10, streams(3))
    assert_same_bits(found, [evaluate(points, 10, *pair) for pair in streams(3)])


def of_file(draw, **changes):
    """A scenario of a catalogue that draws several at once."""
    return replace(
        scenario(link.defaults() | {"n_obj": 12}), draw_catalogue=NestedDraw("own", 12, draw, True), **changes
    )


def objects(rng, n_obj=12):
    dec = np.arcsin(rng.uniform(-1.0, 1.0, n_obj))
    ra = rng.uniform(0.0, 2.0 * np.pi, n_obj)
    return Catalogue(ra, dec, np.zeros_like(ra), np.zeros_like(ra), np.zeros_like(ra))


def test_catalogues_of_which_some_have_no_errors_are_not_computed_together():
    """They would be linked in another way by themselves."""

    def draw(rng):
        found = objects(rng)
        sigma = np.where(rng.random(1)[..., :1] < 0.5, 0.0, MAS) * np.ones((4, *found.ra.shape))
        return replace(found, sigma=np.full((4, *found.ra.shape), MAS), reference=OwnErrors(sigma))

    physics = of_file(draw, reference_errors=CatalogueErrors(side="reference"), satellite_errors=CatalogueErrors())
    with pytest.raises(UnlikeError, match="no errors"):
        simulate_stack(physics, 5, streams(8))


def test_nor_are_those_with_correlated_errors():
    def draw(rng):
        found = objects(rng)
        sigma = np.full((4, *found.ra.shape), MAS)
        return replace(found, sigma=sigma, correlation=np.broadcast_to(np.eye(4), (*found.ra.shape, 4, 4)))

    physics = of_file(draw, satellite_errors=CatalogueErrors())
    with pytest.raises(UnlikeError, match="correlated"):
        simulate_stack(physics, 5, streams(12))


def test_nor_are_those_of_which_some_have_objects_near_a_pole():
    """Where sines and cosines of noisy positions are computed in another way."""

    def draw(rng):
        found = objects(rng)
        near = rng.random(1)[..., :1] < 0.5
        dec = np.where(near & (np.arange(12) == 3), 89.99 * DEGREE, found.dec)
        return replace(found, dec=dec)

    physics = of_file(draw, reference_errors=NormalErrors(10.0, 1.0), satellite_errors=NormalErrors(1.0, 1.0))
    with pytest.raises(UnlikeError, match="small angles"):
        simulate_stack(physics, 5, streams(8))


def test_a_catalogue_that_does_not_determine_the_link_says_so():
    physics = of_file(same_place)
    with pytest.raises(LinkError, match="rank deficient"):
        simulate_stack(physics, 5, streams(3))
    with pytest.raises(LinkError, match="rank deficient"):
        simulate([physics], 5, *streams(1)[0])


def same_place(rng):
    found = objects(rng)
    return replace(found, ra=found.ra * 0.0 + 1.0, dec=found.dec * 0.0 + 0.5)
