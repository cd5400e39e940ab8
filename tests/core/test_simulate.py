"""A block of realisations: what it recovers, how large its errors are, and that it is the plain loop made fast."""

import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from scipy import stats

from tests.core import points
from tests.core.points import MAS, CatalogueErrors, LinkError, OwnErrors, of_objects, random_covariances, run, set_up
from tests.core.reference import design_matrix, solve
from tests.tiers import examples, few, slow

SIZES = st.tuples(st.sampled_from([1e-3, 1.0, 1e3, 1e5, 1e6]), st.sampled_from([0.0, 1.0, 1e4]))  # errors and motions
OPTIONS = {"weighting": st.sampled_from(["inverse-variance", "equal"]), "corrections": st.booleans()}
OPTIONS = st.fixed_dictionaries(OPTIONS | {"solve_glide": st.booleans()})
GLIDE_UAS = (300.0, -200.0, 500.0)
NORMAL = {"satellite_errors": "normal"}
NOISY = {"reference_errors": "normal", "reference_sigma_pos": 0.4, "reference_sigma_pm": 0.7}
WITH_GLIDE = {"solve_glide": True, "aberration": True, "sky_contrast": 0.5}
EXACT = {"reference_errors": "normal", "reference_sigma_pos": 0.1, "weighting": "equal", "solve_glide": True}
ARCSEC = {"reference_errors": "normal", "reference_sigma_pos": 1000.0, "reference_sigma_pm": 500.0}
TWELVE = {"n_obj": 12, "mean_pm": 300.0}
FEW = {"n_obj": 2, "weighting": "equal"}  # 8 observables for 13 columns
NEGLECTED = [*({}, {"n_obj": 300, "mean_pm": 0.0}, {"n_obj": 5, "solve_glide": True}, {"epsilon_size": 1e5})]
NEGLECTED += [*({"n_obj": 200, "sky_contrast": 0.9, "weighting": "equal"}, {"corrections": False, "omega_size": 1e5})]
NEGLECTED += [{"n_obj": 100, "epsilon_size": 1e7, "omega_size": 1e6}]
NEGLECTED += [{"reference_sigma_pos": 20_000.0, "reference_sigma_pm": 3000.0, "mean_pm": 1e5}]


def physics_of(**changes):
    return points.scenario(points.point(**({"epsilon": (1.0, -0.7, 0.4), "omega": (-0.5, 0.9, 1.2)} | changes)))


def one_by_one(physics, n_sim, seed=1, catalogue_seed=2, fixed=False):
    """Yield the solution of each realisation by the SVD of its design matrix, and estimates - truth; same normals.
    The matrix is that of the positions and motions with their errors, unless it is ``fixed``.
    """
    catalogue = physics.draw_catalogue.draw(np.random.default_rng(catalogue_seed))
    setup = set_up(catalogue, physics)
    true = np.stack([catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec])
    y = points.exact_differences(*true, *np.array([physics.epsilon, physics.omega]))
    p, q, _ = points.triad(catalogue.ra, catalogue.dec)
    y[2:] -= np.stack([p.T @ physics.aberration, q.T @ physics.aberration])
    truth = np.concatenate([physics.epsilon, physics.omega, -np.array(physics.aberration)[: 3 * physics.solve_glide]])
    rng, models = np.random.default_rng(seed), (physics.satellite_errors, physics.reference_errors)
    ratios = physics.satellite_error_ratio, physics.reference_error_ratio
    for start in range(0, n_sim, points.ROWS):  # of each chunk a stream for each side, object by object
        shape = len(catalogue), 4, min(points.ROWS, n_sim - start)
        streams = [stream.standard_normal(shape) for stream in rng.spawn(2)]
        for k in range(shape[2]):
            both = zip(ratios, models, streams, strict=True)
            satellite, shift = (ratio * errors(model, each[..., k], catalogue).T for ratio, model, each in both)
            seen = true + shift / np.stack([np.cos(catalogue.dec), *np.ones((3, len(catalogue)))])
            rows = true if fixed else seen
            design = design_matrix(*rows, corrections=physics.corrections, glide=physics.solve_glide)
            solution = solve(design, y + shift - satellite, setup.sigma.T, physics.weighting)
            yield solution, solution.estimate - truth


def covariances(model, catalogue):
    sigma, correlation = model.standard_errors(catalogue), model.correlation(catalogue)
    return sigma[:, :, None] * (np.eye(4) if correlation is None else correlation) * sigma[:, None, :]


def errors(model, normals, catalogue):
    if not np.any(model.standard_errors(catalogue)):
        return 0.0 * normals
    return np.einsum("nij,nj->ni", np.linalg.cholesky(covariances(model, catalogue)), normals)


def predicted(physics, catalogue):
    """The covariance of the estimates, G Sigma G^T with the whole covariance of both sides."""
    objects = catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec
    design = design_matrix(*objects, physics.corrections, physics.solve_glide)
    gain = solve(design, np.zeros(design.shape[:2]), set_up(catalogue, physics).sigma.T, physics.weighting).gain
    both = physics.reference_error_ratio**2 * covariances(physics.reference_errors, catalogue)
    both += physics.satellite_error_ratio**2 * covariances(physics.satellite_errors, catalogue)
    return np.einsum("kin,nij,ljn->kl", gain, both, gain) / MAS**2


@pytest.mark.parametrize("weighting", few(1, ["equal", "inverse-variance"]))
@pytest.mark.parametrize(("reference", "corrections"), [(NOISY, True), ({"satellite_error_ratio": 2.0}, False)])
@pytest.mark.parametrize("solve_glide", [True, slow(False)])
@pytest.mark.parametrize(("n_obj", "n_sim"), [(20, 520), slow(1500, 20), slow(20, 1000)])
def test_equals_the_plain_loop(weighting, reference, n_obj, n_sim, corrections, solve_glide):
    assert n_sim > points.ROWS or 4 * n_obj * n_sim > points.TILE  # several chunks or several tiles
    options = {"weighting": weighting, "corrections": corrections, "solve_glide": solve_glide}
    physics = physics_of(n_obj=n_obj, mean_pm=100.0, aberration=True, glide=GLIDE_UAS, **options, **reference)
    sums = run(physics, n_sim)
    solutions, result = zip(*one_by_one(physics, n_sim), strict=True)
    error, sigma = np.array(result) / MAS, solutions[0].formal_error / MAS
    near, products = 1e-9 * n_sim * sigma, error.T @ error
    kept = slice(0, error.shape[1])
    assert np.all(np.abs(sums["error"][kept] - error.sum(axis=0)) < near)
    assert np.all(np.abs(sums["error_products"] - products[:6, :6]) < np.outer(near, sigma)[:6, :6])
    assert np.all(np.isnan(sums["error"][kept.stop :]))
    if solve_glide:
        assert np.all(np.abs(sums["glide_squares"] - np.diag(products)[6:]) < (near * sigma)[6:])
    assert sums["chi2"] == pytest.approx(sum(s.chi2 for s in solutions), rel=1e-9)
    covariance = predicted(physics, physics.draw_catalogue.draw(np.random.default_rng(2)))
    bias = sums["predicted_bias"][kept] / n_sim
    np.testing.assert_allclose(sums["predicted_variance"][kept], n_sim * np.diag(covariance), rtol=1e-9)
    orientation, spin = np.eye(9)[:3].mean(axis=0), np.eye(9)[3:6].mean(axis=0)
    for k, weights in enumerate([*np.eye(9), orientation, spin]):  # moments of x^T W x, x normal
        w = np.diag(weights[kept])
        mean, of_squares = np.trace(w @ covariance) + bias @ w @ bias, w @ covariance @ w
        variance = 2.0 * np.trace(of_squares @ covariance) + 4.0 * bias @ of_squares @ bias
        np.testing.assert_allclose(sums["predicted_square_variance"][k], n_sim * variance, rtol=1e-9)
        np.testing.assert_allclose(sums["predicted_powers"][:, k], n_sim * mean ** np.array([2, 3]), rtol=1e-9)
    assert sums["n_obj"] == n_sim * n_obj


@settings(max_examples=examples(150))
@given(st.integers(0, 2**32 - 1), st.integers(4, 60), SIZES, st.sampled_from([0.0, 0.3]), st.booleans(), OPTIONS)
def test_equals_the_svd_of_each_realisation(seed, n_obj, sizes, polar, correlated, options):
    """Objects anywhere, some near a pole, with errors of their own from microarcseconds to a quarter of a degree."""
    rng, (sigma_mas, motion_mas) = np.random.default_rng(seed), sizes
    sin_dec = rng.uniform(-1.0, 1.0, n_obj)
    near = np.sign(sin_dec) * rng.uniform(85.0, 89.5, n_obj) * points.DEGREE
    sigma, correlation = random_covariances(n_obj, seed)
    motions = motion_mas * MAS * rng.standard_normal((2, n_obj))
    place = rng.uniform(-np.pi, 2.0 * np.pi, n_obj), np.where(rng.random(n_obj) < polar, near, np.arcsin(sin_dec))
    ours = OwnErrors(sigma_mas * MAS * sigma / 2.5, correlation if correlated else None)
    objects = points.Catalogue(*place, *motions, np.zeros(n_obj), ours)
    plain = physics_of(**options, aberration=options["solve_glide"])
    ours = {"reference_errors": CatalogueErrors(), "satellite_errors": CatalogueErrors(scale=0.7)}
    ratios = {"reference_error_ratio": 0.5, "satellite_error_ratio": 3.0} if seed % 2 else {}
    physics = of_objects(objects, plain, **ours, **ratios)
    try:
        solutions, expected = zip(*one_by_one(physics, 3), strict=True)
    except LinkError as error:
        with pytest.raises(LinkError, match=re.sub(r"\d+", r"\\d+", str(error)[:40])):  # of several it may name another
            run(physics, 3)
        return
    assume(all(s.condition_number < 1e3 for s in solutions))  # its square, of the normal matrix, times 2^-52 is 2e-10
    sums, each = run(physics, 3), np.array(expected)
    truth = np.concatenate([set_up(objects, physics).truth])
    error, formal = sums["estimate"] * MAS - truth, np.array([s.formal_error for s in solutions])
    size = np.abs(truth) * 1e-15  # what the sum with the truth rounds away
    assert np.all(np.abs(error - each) < 1e-9 * formal + size)
    assert sums["chi2"] == pytest.approx(sum(s.chi2 for s in solutions), rel=1e-9)
    variance = np.diag(predicted(physics, objects))
    np.testing.assert_allclose(sums["predicted_variance"][: len(variance)], 3.0 * variance, rtol=1e-7)


def test_an_object_carried_over_the_pole_is_named_and_what_does_not_determine_the_link_refused():
    zero = np.zeros(40)
    objects = replace(points.drawn(5, n_obj=40), errors=OwnErrors(np.full((40, 4), MAS)), pmra=zero, pmdec=zero)
    objects.dec[35] = 90.0 * points.DEGREE - 0.5 * MAS
    physics = of_objects(objects, physics_of(**NORMAL, reference_errors="catalogue"))
    with pytest.raises(LinkError, match=r"object 36 is at a celestial pole or, with its error, beyond"):
        run(physics, 512)
    one_place = points.drawn(1, n_obj=2).take(np.zeros(10, dtype=np.intp))
    for reference in ({}, {**NOISY, "reference_sigma_pos": 1e-9, "reference_sigma_pm": 1e-9}):
        with pytest.raises(LinkError, match="rank deficient"):
            run(of_objects(one_place, physics_of(**NORMAL, **reference)), 3)


@pytest.mark.slow
@pytest.mark.parametrize(("reference", "few", "many"), [({}, 2, 8), (NOISY, 2, 4)], ids=["fixed", "noisy"])
def test_memory_does_not_grow_with_the_number_of_realisations(reference, few, many):
    physics = physics_of(n_obj=200, **reference)

    def peak(chunks):
        run(physics, 1, keep=False)
        tracemalloc.start()
        run(physics, chunks * points.ROWS, keep=False)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    assert peak(many) < 1.05 * peak(few)


# ----- the projected method


@pytest.mark.parametrize("changes", few(3, [FEW, ARCSEC, WITH_GLIDE, EXACT, {}, {"weighting": "equal"}]))
def test_estimates_have_the_distribution_of_the_catalogue_method(changes):
    n_sim, methods = 8000, enumerate(("catalogue", "projected"))
    catalogue, projected = (run(physics_of(**TWELVE | changes, method=one), n_sim, seed) for seed, one in methods)
    np.testing.assert_array_equal(catalogue["predicted_variance"], projected["predicted_variance"])
    a, b = catalogue["estimate"], projected["estimate"]
    directions = np.random.default_rng(3).standard_normal((10, len(a.T))) / a.std(axis=0)
    for along in (*np.eye(len(a.T)), *directions):  # of correlated errors, too
        assert stats.ks_2samp(a @ along, b @ along).pvalue > 1e-4
    if changes.get("weighting") != "equal":
        dof = 4 * 12 - len(a.T)
        chi2 = np.array([catalogue["chi2"], projected["chi2"]]) / n_sim
        assert np.all(np.abs(chi2 - dof) < 4.5 * np.sqrt(2 * dof / n_sim))


@pytest.mark.parametrize("changes", few(4, NEGLECTED[::-1]))
def test_how_much_is_neglected(changes):
    both = ARCSEC | {"satellite_errors": "normal", "satellite_sigma_pos": 700.0, "satellite_sigma_pm": 200.0}
    physics = physics_of(**TWELVE | both | changes)
    setup = set_up(physics.draw_catalogue.draw(np.random.default_rng(2)), physics)
    design = points.design_of(setup)
    sigma = np.sqrt(np.diag(design.predicted_covariance()))
    whole, fixed = (np.array([error for _, error in one_by_one(physics, 200, 5, fixed=one)]) for one in (False, True))
    rms = np.sqrt(np.mean((whole - fixed) ** 2, axis=0)) / sigma
    np.testing.assert_allclose(points.neglected(design), rms, rtol=0.8)  # both from few realisations


def test_errors_of_an_arcsecond_may_be_projected_and_much_larger_ones_not():
    for arcsec, fits in ((1.0, True), (5.0, True), (300.0, False), (9000.0, False)):
        errors = {"reference_errors": "normal", "reference_sigma_pos": 1000.0 * arcsec}
        one = points.point(n_obj=300, method="projected", **errors)
        assert (points.link.check(one) is None) == fits
        if fits:
            assert np.all(np.isfinite(run(points.scenario(one), 2)["estimate"]))
        else:
            with pytest.raises(LinkError, match=r"would neglect .* of sigma|celestial pole"):
                run(points.scenario(one), 2)
