"""The link as the platform sees it: units, checks, cost and the formulas of the results."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
from astropy.table import Table

from linksweep.core.catalogue import Catalogue
from linksweep.core.errors import error_model
from linksweep.core.experiment import SUMS, check, cost, evaluate, link, samples, scenario, summarise
from linksweep.core.frames import GALACTIC_AXES, MAS
from linksweep.core.link import LinkError
from linksweep.core.missions import MISSIONS, mission_from_table
from linksweep.core.scenario import errors_at_limit, has_errors
from linksweep.core.simulate import simulate
from linksweep.sweep.contract import Named
from linksweep.sweep.tables.file import table_file

SIX = ["mas"] * 3 + ["mas / yr"] * 3


def point(**changes):
    assert set(changes) <= set(link.defaults())
    return link.defaults() | {"n_obj": 30} | changes


def gaia_table(folder, magnitudes=True, errors=True, **changes):
    """A file of six objects with Gaia's names, of magnitudes 10 to 15."""
    r = np.array([[1, 2, 3], [-2, 1, 1], [0, -3, 1], [1, -1, -4], [-1, -1, 2], [5, 0, -1.0]]).T
    columns = {"source_id": np.arange(6), "ra": np.degrees(np.arctan2(r[1], r[0])) % 360.0}
    columns["dec"] = np.degrees(np.arctan2(r[2], np.hypot(r[0], r[1])))
    columns |= {"pmra": np.arange(6.0), "pmdec": -np.arange(6.0)}
    if magnitudes:
        columns["phot_g_mean_mag"] = np.arange(10.0, 16.0)
    if errors:
        columns |= {f"{name}_error": np.linspace(0.1, 0.2, 6) for name in ("ra", "dec", "pmra", "pmdec")}
        columns["pmra_pmdec_corr"] = np.full(6, 0.6)
    path = folder / "six.ecsv"
    Table(columns | changes).write(path, overwrite=True)
    return table_file(path)


def from_file(table, **changes):
    return point(**({"catalogue": "file", "file": table, "n_obj": None} | changes))


def evaluated(point, n_sim, seed=1, catalogue_seed=2):
    return evaluate([point], n_sim, np.random.default_rng(seed), np.random.default_rng(catalogue_seed))


def merged(blocks):
    return {name: sum(block[name] for block in blocks) for name in SUMS}


def computes(point):
    assert check(point) is None
    with np.errstate(all="raise"):
        sums = evaluated(point, 2)
    for name, values in sums.items():
        assert np.all(np.isfinite(values) | (name.startswith("glide") and not point["solve_glide"])), name


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
        {"catalogue": "quasars", "n_obj": None, "v_max": 15.0},
        {"catalogue": "quasars", "n_obj": None, "v_max": 16.3, "v_min": 14.7, "counts": "completed"},
        {"catalogue": "galaxies", "v_min": 12.0, "n_obj": None},
        {"catalogue": "quasars", "n_obj": 1000, "v_max": 16.5, "counts": "completed"},
        {"catalogue": "galaxies", "n_obj": None},
        {"catalogue": "galaxies", "v_max": 11.0, "aberration": True},
        {"catalogue": "radio-stars", "n_obj": None},
        {"catalogue": "radio-stars", "positions": "own", "reference_errors": "catalogue"},
        {"zone_of_avoidance": 89.0, "sky_contrast": -0.99},
        {"solve_glide": True, "n_obj": 3},
        {"solve_glide": True, "aberration": True, "reference_errors": "normal", "corrections": False},
        {"directions": "random", "epsilon_size": 5.0, "omega_size": 0.0},
        {"mean_pm": 100.0, "pm_distribution": "rayleigh"},
    ],
)
def test_points_without_a_problem_can_be_computed(changes):
    computes(point(**changes))


@pytest.mark.parametrize(
    ("contents", "changes"),
    [
        ({}, {}),
        ({}, {"v_max": 11.0}),
        ({}, {"n_obj": 3, "v_max": 14.0, "solve_glide": True}),
        ({}, {"reference_errors": "catalogue"}),
        (
            {f"reference_{name}_error": np.full(6, 0.3) for name in ("ra", "dec", "pmra", "pmdec")},
            {"reference_errors": "catalogue", "satellite_errors": "catalogue", "weighting": "equal"},
        ),
        ({}, {"satellite_errors": "catalogue", "positions": "isotropic"}),
        ({"errors": False}, {"model": "gaia-2001"}),
        ({"magnitudes": False}, {"satellite_errors": "catalogue"}),
        ({"magnitudes": False, "errors": False}, {"satellite_errors": "none"}),
    ],
)
def test_files_without_a_problem_can_be_computed(contents, changes, tmp_path):
    computes(from_file(gaia_table(tmp_path, **contents), **changes))


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"catalogue": "quasars", "v_max": 12.0}, "v_max = 12 mag is outside the quasar counts"),
        (
            {"catalogue": "quasars", "n_obj": 89, "v_max": 15.0},
            "n_obj = 89: only 88 quasars are brighter than v_max = 15 mag",
        ),
        ({"n_obj": None}, "n_obj: a synthetic catalogue needs a number of objects"),
        ({"v_max": 5.0}, "v_max = 5 mag: must be fainter than the brightest object, v_min = 5 mag"),
        ({"catalogue": "file"}, "file: catalogue = 'file' needs a file"),
        ({"catalogue": "galaxies", "v_max": 10.9}, "v_max = 10.9 mag: the galaxies have magnitudes from 11 to 13.5"),
        ({"catalogue": "radio-stars", "v_max": 9.0}, "v_max: the radio stars have no limiting magnitude"),
        ({"catalogue": "radio-stars", "aberration": True}, "aberration: the glide is that of extragalactic objects"),
        ({"satellite_errors": "catalogue"}, "satellite_errors = 'catalogue': the synthetic catalogue has no errors"),
        (
            {"catalogue": "quasars", "reference_errors": "catalogue"},
            "reference_errors = 'catalogue': the quasars catalogue has no errors of its own",
        ),
        ({"satellite_errors": "normal", "satellite_sigma_pm": 1e-10}, "errors of 1 mas and 1e-10 mas/yr: must be from"),
        ({"satellite_errors": "normal", "satellite_sigma_pos": 2e7}, "errors of 2e+07 mas and 1 mas/yr: must be from"),
        ({"model": "gaia-2001", "v_max": 21.5}, "v_max = 21.5 mag: the curve of 'gaia-2001' ends at 21 mag"),
    ],
)
def test_points_with_a_problem(changes, problem):
    assert check(point(**changes)).startswith(problem)


@pytest.mark.parametrize(
    ("contents", "changes", "problem"),
    [
        ({}, {"catalogue": "synthetic"}, "file: catalogue = 'file' needs a file, and other catalogues have none"),
        ({}, {"n_obj": 7}, "n_obj = 7: only 6 objects of the file are there"),
        ({}, {"n_obj": 4, "v_max": 12.5}, "n_obj = 4: only 3 objects of the file are brighter than v_max = 12.5 mag"),
        ({"magnitudes": False}, {}, "satellite_errors = 'magnitude' needs a magnitude column"),
        ({"phot_g_mean_mag": np.full(6, 22.0)}, {"model": "gaia-2001"}, "v_max = 22 mag: the curve of 'gaia-2001'"),
        ({}, {"columns": (("plx", "parallax"),)}, "columns: plx is no quantity"),
        (
            {"dec": np.full(6, 90.0)},
            {},
            "a dec that is not between -90 and 90 deg, poles excluded, in row 1 (90), 2 (90)",
        ),
        (
            {"pmra_error": np.array([0, 1, 1, 1, 1, 1.0])},
            {"satellite_errors": "catalogue"},
            "object 1 has an observable",
        ),
        ({"pmra_error": np.full(6, 1e-10)}, {"satellite_errors": "catalogue"}, "errors of 0.1 mas and 1e-10 mas/yr"),
    ],
)
def test_files_with_a_problem(contents, changes, problem, tmp_path):
    assert check(from_file(gaia_table(tmp_path, **contents), **changes)).startswith(problem)


BOTH = {"reference_errors": "catalogue", "satellite_errors": "catalogue"}


def test_one_set_of_errors_is_not_that_of_both_sides(tmp_path):
    problem = check(from_file(gaia_table(tmp_path), **BOTH))
    assert problem.startswith("reference_errors and satellite_errors are both 'catalogue', but the objects have errors")
    assert check(point(catalogue="radio-stars", n_obj=None, **BOTH)).startswith("reference_errors and satellite_errors")
    table = gaia_table(tmp_path, vlbi_a=np.full(6, 3.0), vlbi_d=np.full(6, 4.0))
    columns = (("reference_pmdec_error", "vlbi_d"), ("reference_pmra_error", "vlbi_a"))
    two = from_file(table, columns=columns, **BOTH)
    computes(two)
    reference, satellite = (error_model(two, side) for side in ("reference", "satellite"))
    objects = scenario(two).draw_catalogue(np.random.default_rng(1))
    np.testing.assert_allclose(reference.standard_errors(objects)[2:, 0] / MAS, [3.0, 4.0], rtol=1e-14)
    np.testing.assert_allclose(satellite.standard_errors(objects)[2:, 0] / MAS, [0.1, 0.1], rtol=1e-14)


def test_correlated_errors_of_a_file_cannot_be_projected(tmp_path):
    projected = from_file(gaia_table(tmp_path), method="projected")
    assert "correlated" in check(projected | {"satellite_errors": "catalogue"})
    computes(projected)


def test_an_object_without_any_error_beside_others_with_errors_is_a_problem(tmp_path):
    sigma = np.array([0.1, 0.1, 0.0, 0.1, 0.1, 0.1])
    table = gaia_table(tmp_path, **{f"{name}_error": sigma for name in ("ra", "dec", "pmra", "pmdec")})
    exact = from_file(table, satellite_errors="catalogue")
    with pytest.raises(LinkError, match="zero standard error beside non-zero ones"):
        evaluated(exact, 1)
    assert check(exact) is not None


@pytest.mark.parametrize(
    ("contents", "columns", "problem"),
    [
        ({}, (("ra", "alpha"),), "no column 'alpha'"),
        ({"pmra": np.array([1, 2, np.nan, 4, 5, 6])}, (), "no pmra in row 3"),
    ],
)
def test_what_is_wrong_in_a_table_is_a_problem_of_the_point(contents, columns, problem, tmp_path):
    assert problem in check(from_file(gaia_table(tmp_path, **contents), columns=columns))


def test_a_limit_for_objects_without_magnitudes_is_a_problem_of_the_magnitudes(tmp_path):
    table = gaia_table(tmp_path, magnitudes=False)
    assert "magnitude column" in check(from_file(table, v_max=12.0, satellite_errors="none"))


def test_check_of_a_magnitude_where_the_curve_overflows():
    assert check(point(v_max=1000.0)) is not None


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"n_obj": 2000},
        {"satellite_errors": "normal", "reference_errors": "normal"},
        {"satellite_errors": "none", "reference_errors": "normal"},
        {"catalogue": "quasars", "n_obj": None, "v_max": 15.0},
        {"catalogue": "quasars", "n_obj": 50, "v_max": 17.3},
        {"catalogue": "quasars", "n_obj": None, "v_max": 16.5, "counts": "completed", "reference_errors": "normal"},
        {"catalogue": "galaxies", "n_obj": None},
        {"catalogue": "radio-stars", "n_obj": None},
        {"catalogue": "radio-stars", "reference_errors": "catalogue"},
        {"solve_glide": True, "aberration": True, "directions": "random"},
        {"reference_errors": "normal", "solve_glide": True},
        {"satellite_errors": "none"},
        {"reference_errors": "normal", "reference_error_scale": 0.0},
        {"method": "projected"},
        {"method": "projected", "solve_glide": True, "weighting": "equal", "reference_errors": "normal"},
        {"method": "projected", "n_obj": 2, "weighting": "equal"},
        {"method": "projected", "satellite_errors": "none"},
    ],
)
def test_cost_is_the_number_of_normals_drawn(changes):
    assert cost_is_right(point(**changes))


@pytest.mark.parametrize("n_obj", [None, 4])
@pytest.mark.parametrize("positions", ["own", "isotropic"])
@pytest.mark.parametrize("satellite_errors", ["none", "normal", "magnitude", "catalogue"])
@pytest.mark.parametrize("reference_errors", ["none", "normal", "catalogue"])
def test_cost_of_a_file_is_the_number_of_normals_drawn(n_obj, positions, satellite_errors, reference_errors, tmp_path):
    changes = {"satellite_errors": satellite_errors, "reference_errors": reference_errors}
    assert cost_is_right(from_file(gaia_table(tmp_path), n_obj=n_obj, positions=positions, v_max=14.5, **changes))


def cost_is_right(point):
    """Count what `evaluate` draws from the errors' generator and its children."""
    n_sim, drawn = 50, []

    class Counting(np.random.Generator):
        def standard_normal(self, size=None, out=None):
            normals = super().standard_normal(size, out=out)
            drawn.append(np.size(normals))
            return normals

    evaluate([point], n_sim, Counting(np.random.PCG64(1)), np.random.default_rng(2))
    return sum(drawn) == n_sim * cost(point)


def test_evaluate_returns_one_row_a_point_as_if_alone():
    points = [point(), point(model="gaia", solve_glide=True), point(reference_errors="normal")]
    together = evaluate(points, 5, np.random.default_rng(1), np.random.default_rng(2))
    assert {name: values.shape for name, values in together.items()} == {n: (3, *shape) for n, shape in SUMS.items()}
    for k, one in enumerate(points):
        (block,) = simulate([scenario(one)], 5, np.random.default_rng(1), np.random.default_rng(2))
        assert set(block) == set(SUMS)
        assert np.isnan(block["glide_error"]).all() != one["solve_glide"]
        np.testing.assert_allclose(block["batch_mean_squares"], block["error"] ** 2 / 5, rtol=1e-15)
        for name, values in block.items():
            np.testing.assert_array_equal(together[name][k], values)


@pytest.mark.parametrize("changes", [{}, {"reference_errors": "normal"}, {"solve_glide": True}])
def test_samples_are_the_estimates_that_evaluate_adds_up(changes):
    points, n_sim = [point(**changes), point(n_obj=7, omega=(4.0, 0.0, -2.0), **changes)], 3000
    sums = evaluate(points, n_sim, np.random.default_rng(1), np.random.default_rng(2))
    kept = samples(points, n_sim, np.random.default_rng(1), np.random.default_rng(2))
    estimates = kept.pop("estimate")
    assert set(kept) == set(sums)
    for name, values in sums.items():
        np.testing.assert_array_equal(kept[name], values)
    assert estimates.shape == (2, n_sim, 6)
    error = estimates - np.array([[*p["epsilon"], *p["omega"]] for p in points])[:, None]
    products = np.einsum("pni,pnj->pij", error, error)
    tolerance = {"rtol": 0, "atol": 1e-12 * n_sim * np.max(np.abs(error)) ** 2}
    np.testing.assert_allclose(error.sum(axis=1), sums["error"], **tolerance)
    np.testing.assert_allclose(products, sums["error_products"], **tolerance)


def test_a_size_sets_the_length_and_keeps_the_direction():
    physics = scenario(point(epsilon=(0.0, 3.0, -4.0), epsilon_size=10.0, omega=(0.0, 0.0, 0.0), omega_size=2.0))
    np.testing.assert_allclose(physics.epsilon.vector, np.array([0.0, 6.0, -8.0]) * MAS, rtol=1e-14, atol=1e-30)
    np.testing.assert_allclose(physics.omega.vector, np.array([2.0, 0.0, 0.0]) * MAS, rtol=1e-14)
    assert not physics.epsilon.random_direction


def test_random_directions_of_a_study_keep_the_size_and_change_with_the_catalogue():
    random = point(directions="random", epsilon_size=5.0, omega_size=0.5, satellite_errors="none")
    found = np.array(
        [samples([random], 2, np.random.default_rng(1), np.random.default_rng(k))["estimate"][0] for k in range(4)]
    )
    np.testing.assert_allclose(np.linalg.norm(found[..., :3], axis=-1), 5.0, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found[..., 3:], axis=-1), 0.5, rtol=1e-6)
    np.testing.assert_array_equal(found[:, 0], found[:, 1])  # the same for the realisations of one catalogue
    assert np.abs(np.diff(found[:, 0], axis=0)).max(axis=1).min() > 0.05


def test_aberration_of_a_study_leaks_into_the_spin_of_an_uneven_sky_and_can_be_solved_for():
    uneven = point(n_obj=20_000, sky_contrast=0.8, aberration=True, satellite_errors="none")
    leak = evaluated(uneven, 1)["error"][0, 3:] @ GALACTIC_AXES.T
    np.testing.assert_allclose(leak, [0.0, -2.4e-3, 0.0], atol=1e-4)  # -(3/4) 0.8 x 4e-3 mas/yr; 3 sigma of one sky
    solved = evaluated(uneven | {"solve_glide": True}, 1)
    assert np.all(np.abs(solved["error"][0, 3:]) < 1e-7)
    assert np.all(np.abs(solved["glide_error"]) < 1e-7)


@pytest.mark.parametrize("solve_glide", [False, True])
def test_summarise_against_direct_formulas(solve_glide):
    """One realisation per block gives the single errors, from which NumPy says the same."""
    one = point(n_obj=12, satellite_errors="normal", reference_errors="normal", reference_sigma_pm=2.0)
    one |= {"solve_glide": solve_glide}
    n_cat, n_sim = 5, 8
    rng = np.random.default_rng(4)
    blocks = [evaluate([one], 1, rng, np.random.default_rng(k)) for k in range(n_cat) for _ in range(n_sim)]
    results = {k: v[0] for k, v in summarise(merged(blocks), np.array([40.0]), np.array([5.0])).items()}
    error = np.array([block["error"][0] for block in blocks])
    predicted = np.array([block["predicted_variance"][0] for block in blocks])
    predicted_bias = np.array([block["predicted_bias"][0] for block in blocks])
    total = predicted + predicted_bias**2
    sigma = np.sqrt(np.mean(error**2, axis=0))

    expected = {
        "n_obj": 12.0,
        "dof": 4 * 12 - (9 if solve_glide else 6),
        "chi2": np.mean([block["chi2"][0] for block in blocks]),
        "bias": error.mean(axis=0),
        "bias_mc_error": np.sqrt(2 * error.var(axis=0) / 4),  # each realisation a batch, so that each counts
        "sigma": sigma,
        "sigma_mc_error": sigma / np.sqrt(2 * 40),
        "sigma_predicted": np.sqrt(predicted.mean(axis=0)),
        "covariance": np.cov(error.T, bias=True),
        "correlation": np.corrcoef(error.T),
        "condition_number": np.mean([block["condition_number"][0] for block in blocks]),
        "bias_predicted": predicted_bias.mean(axis=0),
        "sigma_rms_predicted": np.sqrt(total.mean(axis=0)),
        "sigma_orientation_rms_predicted": np.sqrt(total[:, :3].mean()),
        "sigma_spin_rms_predicted": np.sqrt(total[:, 3:].mean()),
        "sigma_orientation": np.sqrt(np.mean(error[:, :3] ** 2)),
        "sigma_orientation_mc_error": np.sqrt(np.mean(error[:, :3] ** 2) / (2 * 3 * 40)),
        "sigma_orientation_predicted": np.sqrt(predicted[:, :3].mean()),
        "sigma_spin": np.sqrt(np.mean(error[:, 3:] ** 2)),
        "sigma_spin_mc_error": np.sqrt(np.mean(error[:, 3:] ** 2) / (2 * 3 * 40)),
        "sigma_spin_predicted": np.sqrt(predicted[:, 3:].mean()),
    }
    by_catalogue = predicted[::n_sim]
    error_of_mean = np.sqrt(2) * by_catalogue.std(axis=0, ddof=1) / np.sqrt(n_cat)  # (n_cat - 1)/(n_cat - 3) = 2
    expected["sigma_catalogue_error"] = error_of_mean / (2 * expected["sigma_predicted"])
    for name, part in (("sigma_orientation", slice(0, 3)), ("sigma_spin", slice(3, 6))):
        error_of_mean = np.sqrt(2) * by_catalogue[:, part].mean(axis=1).std(ddof=1) / np.sqrt(n_cat)
        expected[f"{name}_catalogue_error"] = error_of_mean / (2 * expected[f"{name}_predicted"])
    glide = np.array([block["glide_error"][0] for block in blocks])
    expected |= {"glide_bias": glide.mean(axis=0), "glide_sigma": np.sqrt(np.mean(glide**2, axis=0))}
    assert np.all(np.isnan(glide)) == (not solve_glide)
    for name, value in results.items():  # every one has its formula above
        np.testing.assert_allclose(value, expected[name], rtol=1e-7, atol=1e-12, err_msg=name)


def test_catalogue_error_is_unknown_for_one_catalogue_and_zero_without_errors():
    noisy = evaluated(point(), 10)
    assert np.all(np.isnan(summarise(noisy, np.array([10.0]), np.ones(1))["sigma_catalogue_error"]))
    for n_cat in (2.0, 3.0, 4.0):
        few = summarise(noisy, np.array([10.0]), np.array([n_cat]))
        assert np.all(np.isnan(few["sigma_catalogue_error"]))
        assert np.all(np.isnan(few["bias_mc_error"]))
    perfect = evaluated(point(satellite_errors="none"), 10)
    results = summarise(perfect, np.array([10.0]), np.ones(1))
    np.testing.assert_array_equal(results["sigma_catalogue_error"], 0.0)
    np.testing.assert_array_equal(results["sigma_spin_predicted"], 0.0)


@pytest.mark.slow
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
    for name in ("sigma_orientation", "sigma_spin"):
        scatter = np.std([s[f"{name}_predicted"][0] for s in samples])
        stated = np.sqrt(np.mean([s[f"{name}_catalogue_error"][0] ** 2 for s in samples]))
        assert stated / scatter == pytest.approx(1.0, abs=0.4)  # 3 sigma, one ratio instead of six


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
        simulate([replace(p, draw_catalogue=lambda _, c=c: c)], 1, np.random.default_rng(8), np.random.default_rng(9))[
            0
        ]["predicted_variance"]
        for p, c in zip(physics, (few, many), strict=True)
    )
    ratio = np.sqrt(after / before)
    np.testing.assert_allclose(ratio[:3], n_obj_factor**-0.5 * length_factor**-0.5, rtol=1e-9)
    np.testing.assert_allclose(ratio[3:], n_obj_factor**-0.5 * length_factor**-1.5, rtol=1e-9)


class Watched(dict):
    """A point that notes what is looked at, and is never copied."""

    def __init__(self, point):
        super().__init__(point)
        self.read = set()

    def __getitem__(self, name):
        self.read.add(name)
        return super().__getitem__(name)

    def __iter__(self):
        raise AssertionError("copied")

    keys = items = values = copy = __or__ = __iter__


FILE_ONLY = {"columns", "units", "pmra_cos_dec"}
SIGMAS = {f"{side}_sigma_{what}" for side in ("reference", "satellite") for what in ("pos", "pm")}
NEVER = {"mean_pm", "pm_distribution", "epsilon", "omega", "epsilon_size", "omega_size", "directions", "glide"}
NEVER |= {"corrections", "arithmetic"}


@pytest.mark.parametrize(
    ("changes", "not_for_check", "not_for_cost"),
    [
        ({}, FILE_ONLY | SIGMAS | {"counts"}, SIGMAS | {"model", "v_max", "mission_length", "counts", "catalogue"}),
        ({"satellite_errors": "normal"}, {"model", "mission_length"}, {"model", "mission_length", "v_max"}),
        ({"satellite_errors": "none"}, SIGMAS | {"model", "mission_length", "error_scale"}, SIGMAS | {"error_scale"}),
        ({"catalogue": "quasars", "n_obj": None}, SIGMAS, SIGMAS | {"model", "mission_length"}),
        ({"catalogue": "radio-stars"}, SIGMAS | {"counts"}, SIGMAS | {"v_min", "v_max"}),
    ],
)
def test_check_and_cost_look_only_at_what_matters(changes, not_for_check, not_for_cost):
    for function, spared in ((check, not_for_check), (cost, not_for_cost)):
        watched = Watched(point(**changes))
        assert function(watched) == function(point(**changes))
        assert not watched.read & (spared | NEVER | {"weighting"}), function.__name__


@pytest.mark.parametrize("model", sorted(MISSIONS))
@pytest.mark.parametrize("length", [None, 0.7, 6.0])
def test_errors_expected_at_the_limit_are_those_that_objects_there_get(model, length):
    here = point(model=model, mission_length=length, error_scale=0.3, satellite_error_scale=1.7, v_max=16.4)
    here |= {"reference_errors": "normal", "reference_sigma_pos": 0.02, "reference_sigma_pm": 7.0}
    zero = np.zeros(1)
    faintest = Catalogue(zero, zero, zero, zero, zero + 16.4)
    for side in ("reference", "satellite"):
        expected = error_model(here, side).standard_errors(faintest)[1:3, 0] / MAS
        np.testing.assert_allclose(errors_at_limit(here, side), expected, rtol=1e-14)
        assert has_errors(here, side)


def test_a_mission_so_short_that_its_errors_overflow_is_a_problem():
    assert check(point(mission_length=5e-324)).startswith("errors of inf mas and inf mas/yr: must be from")
    assert check(point(mission_length=1e-250)).endswith("mas and inf mas/yr: must be from 1e-09 to 1e+07")


def own(table, function=None):
    value, identity = mission_from_table(table, lambda reference: function)
    return Named("mine", json.dumps(identity), value)


MINE = {"nominal_length": 4.0, "sigma_pm": [[9.0, 0.1], [17.0, 3.2]], "position_ratio": 0.5}


def test_a_mission_of_the_study_has_the_numbers_of_its_table():
    exponential = {"at": 15.0, "sigma": 0.01496, "slope": 0.443}
    mine = own(
        {"nominal_length": 5.0, "sigma_pm": [exponential], "position_ratio": 1.15, "floor_pm": 3e-3, "floor_pos": 3e-3}
    )
    theirs, ours = (evaluated(point(model=model, mission_length=3.0), 20) for model in ("gaia", mine))
    for name in SUMS:
        np.testing.assert_array_equal(ours[name], theirs[name])
    assert cost(point(model=mine)) == cost(point(model="gaia"))


@dataclass(frozen=True)
class Counted:
    """A function of the platform's kind that is wrong for the bright."""

    name: str = "counted"
    digest: str = "0123456789ab"

    def __call__(self, v):
        return np.where(v < 8.0, -1.0, 0.1)


@pytest.mark.parametrize(
    ("changes", "good"),
    [({}, False), ({"v_min": 8.5}, True), ({"catalogue": "quasars"}, True), ({"catalogue": "radio-stars"}, False)],
)
def test_a_function_is_asked_about_all_magnitudes_that_objects_can_have(changes, good):
    mine = own({"nominal_length": 4.0, "sigma_pm": "x.py:f", "position_ratio": 1.0}, Counted())
    problem = check(point(model=mine, **changes))
    assert problem is None if good else "'counted' returns -1 at V = " in problem
