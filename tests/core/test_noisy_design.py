"""The link with errors of the reference: normal equations added up for all realisations, against the SVD of each."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from linksweep.core.catalogue import Catalogue
from linksweep.core.errors import CatalogueErrors
from linksweep.core.experiment import link, scenario
from linksweep.core.frames import DEGREE, MAS
from linksweep.core.link import POLE_LIMIT, LinkError
from linksweep.core.noise import Tile, tile_objects
from linksweep.core.noisy_design import ELEMENTS, NoisyDesign, NoisySums
from linksweep.core.setup import Draw, Prefixes, prepare
from tests.core.reference import design_matrix, solve
from tests.tiers import examples

ARCSEC = 1000.0 * MAS
WELL_POSED = 1e3
"""Condition number of the design: its square, that of the normal matrix, times 2^-52 is 2e-10."""


def catalogue(rng, n_obj, motion_mas, sigma_mas, spread, polar, correlated):
    """Objects anywhere, some of them near a pole, with errors of their own that differ by a factor ``spread``."""
    sin_dec = rng.uniform(-1.0, 1.0, n_obj)
    dec = np.where(
        rng.random(n_obj) < polar, np.sign(sin_dec) * rng.uniform(85.0, 89.5, n_obj), np.arcsin(sin_dec) / DEGREE
    )
    factor = rng.standard_normal((n_obj, 4, 6))
    covariance = factor @ np.swapaxes(factor, 1, 2)
    deviation = np.sqrt(np.einsum("nii->ni", covariance))
    return Catalogue(
        ra=rng.uniform(-np.pi, 2.0 * np.pi, n_obj),
        dec=dec * DEGREE,
        pmra=motion_mas * MAS * rng.standard_normal(n_obj),
        pmdec=motion_mas * MAS * rng.standard_normal(n_obj),
        v_mag=np.zeros(n_obj),
        sigma=sigma_mas * MAS * spread ** rng.uniform(-0.5, 0.5, (4, n_obj)),
        correlation=covariance / (deviation[:, :, None] * deviation[:, None, :]) if correlated else None,
    )


def set_up(objects, reference_scale=1.0, satellite_scale=0.7, **changes):
    point = link.defaults() | {"n_obj": len(objects), "epsilon": (1.0, -0.7, 0.4), "omega": (-0.5, 0.9, 1.2)} | changes
    physics = replace(
        scenario(point),
        draw_catalogue=lambda _: objects,
        reference_errors=CatalogueErrors(reference_scale),
        satellite_errors=CatalogueErrors(satellite_scale),
    )
    draw = Draw.of(physics, objects, np.random.default_rng(2))
    return prepare(physics, draw, Prefixes())


def all_at_once(setup, normals):
    """The estimates - truth (K, rows) and sum of chi2 that the full path makes of normals (2, N, 4, rows)."""
    rows = normals.shape[-1]
    sums, size = NoisySums(NoisyDesign(setup), rows), tile_objects(rows)
    for start in range(0, normals.shape[1], size):
        sums.add(*(Tile(start, side[start : start + size]) for side in normals))
    return sums.solved()


def one_by_one(setup, normals):
    """The same by singular value decomposition of each realisation's design matrix."""
    objects, options = setup.catalogue, setup.scenario
    true = np.stack([objects.ra, objects.dec, objects.pmra, objects.pmdec])
    found = []
    for row in range(normals.shape[-1]):
        satellite, shift = (
            drawn(side, unit[..., row]) for side, unit in zip((setup.satellite, setup.reference), normals, strict=True)
        )
        seen = true + shift / np.stack([np.cos(objects.dec), *np.ones((3, len(objects)))])
        design = design_matrix(*seen, corrections=options.corrections, glide=options.solve_glide)
        y = setup.differences.T + shift - satellite - design @ setup.truth
        found.append(solve(design, y, setup.sigma.T, options.weighting))
    return found


def drawn(side, normals):
    unit = normals if side.factor is None else np.stack([f @ n for f, n in zip(side.factor, normals, strict=True)])
    return (unit * side.sigma).T


@settings(max_examples=examples(150))
@given(
    seed=st.integers(0, 2**32 - 1),
    n_obj=st.integers(4, 60),
    rows=st.sampled_from([1, 3, 512]),
    sigma_mas=st.sampled_from([1e-3, 1.0, 1e3, 1e5, 1e6]),
    spread=st.sampled_from([1.0, 10.0]),
    motion_mas=st.sampled_from([0.0, 1.0, 1e4]),
    polar=st.sampled_from([0.0, 0.3]),
    correlated=st.booleans(),
    weighting=st.sampled_from(["inverse-variance", "equal"]),
    corrections=st.booleans(),
    solve_glide=st.booleans(),
)
def test_equals_the_svd_of_each_realisation(
    seed, n_obj, rows, sigma_mas, spread, motion_mas, polar, correlated, weighting, corrections, solve_glide
):
    rng = np.random.default_rng(seed)
    objects = catalogue(rng, n_obj, motion_mas, sigma_mas, spread, polar, correlated)
    options = {
        "weighting": weighting,
        "corrections": corrections,
        "solve_glide": solve_glide,
        "aberration": solve_glide,
    }
    setup = set_up(objects, **options)
    normals = rng.standard_normal((2, n_obj, 4, rows))
    looked_at = [0, rows // 2, rows - 1]
    shift = np.stack([drawn(setup.reference, normals[1][..., row])[1] for row in range(rows)])
    if np.any(np.cos(objects.dec + shift) < POLE_LIMIT):
        with pytest.raises(LinkError, match="at a celestial pole or, with its error, beyond"):
            all_at_once(setup, normals)
        return
    solutions = one_by_one(setup, normals[..., looked_at])
    assume(all(s.condition_number < WELL_POSED for s in solutions))
    error, _ = all_at_once(setup, normals)
    for row, solution in zip(looked_at, solutions, strict=True):
        assert np.all(np.abs(error[:, row] - solution.estimate) < 1e-9 * solution.formal_error)
    chi2 = [all_at_once(setup, normals[..., [row]])[1] for row in looked_at]
    np.testing.assert_allclose(chi2, [s.chi2 for s in solutions], rtol=1e-9)


@pytest.mark.parametrize("sigma_mas", [1e-3, 8000.0])
def test_both_ways_to_sin_and_cos_agree(sigma_mas):
    """Errors of which ten sigma are still a small angle, by series and by sin and cos themselves."""
    rng = np.random.default_rng(4)
    objects = catalogue(rng, 60, 10.0, sigma_mas, 1.0, 0.0, False)
    objects = objects.take(np.flatnonzero(NoisyDesign(set_up(objects)).small))
    assert len(objects) > 30
    path, normals, errors = NoisyDesign(set_up(objects)), rng.standard_normal((2, len(objects), 4, 100)), []
    for small in (True, False):
        path.small[:] = small
        sums = NoisySums(path, 100)
        sums.add(*(Tile(0, side) for side in normals))
        errors.append(sums.solved()[0])
    sigma = np.std(errors[0], axis=1, keepdims=True)
    assert np.all(np.abs(errors[0] - errors[1]) < 1e-11 * sigma)


def test_an_object_that_its_error_carries_over_the_pole_is_named_as_by_the_design_matrix():
    rng = np.random.default_rng(5)
    objects = catalogue(rng, 40, 0.0, 1.0, 1.0, 0.0, False)
    objects.dec[17] = 90.0 * DEGREE - 3.0 * MAS
    setup = set_up(objects)
    normals = rng.standard_normal((2, 40, 4, 20))
    normals[1, 17, 1, 11] = 4.0
    with pytest.raises(LinkError, match="object 17 is at a celestial pole") as by_design:
        one_by_one(setup, normals)
    with pytest.raises(LinkError) as by_sums:
        all_at_once(setup, normals)
    assert str(by_sums.value)[:60] == str(by_design.value)[:60]


def test_the_object_at_the_pole_is_named_where_it_is_not_in_the_first_part():
    rng = np.random.default_rng(5)
    rows = 512
    objects = catalogue(rng, 40, 0.0, 1.0, 1.0, 0.0, False)
    assert ELEMENTS // rows < 35
    objects.dec[35] = 90.0 * DEGREE - 3.0 * MAS
    normals = 0.01 * rng.standard_normal((2, 40, 4, rows))
    normals[1, 35, 1, 11] = 4.0
    with pytest.raises(LinkError, match=r"object 35 is at a celestial pole.*\(dec = (90\.0|89\.99)"):
        all_at_once(set_up(objects), normals)


def test_objects_of_one_place_do_not_determine_the_link():
    objects = catalogue(np.random.default_rng(6), 20, 0.0, 1e-6, 1.0, 0.0, False).take(np.zeros(20, dtype=np.intp))
    with pytest.raises(LinkError, match="rank deficient"):
        all_at_once(set_up(objects), np.zeros((2, 20, 4, 3)))


def summed(setup, satellite, reference):
    sums = NoisySums(NoisyDesign(setup), reference.normals.shape[-1])
    sums.add(satellite, reference)
    return sums.solved()


def test_errors_of_arcseconds_do_not_bias_the_estimate():
    rng = np.random.default_rng(8)
    setup = set_up(catalogue(rng, 50, 1e4, ARCSEC / MAS, 1.0, 0.0, False))
    error, _ = all_at_once(setup, rng.standard_normal((2, 50, 4, 4000)))
    mean = error.mean(axis=1) / error.std(axis=1)
    assert np.all(np.abs(mean) < 4.5 / np.sqrt(4000))
