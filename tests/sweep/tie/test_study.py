"""Links of tables as studies: the draws against closed forms, the built-in studies against what was published."""

import re
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from click.testing import CliRunner
from scipy import stats

import linksweep
from linksweep.sweep.cli import main
from linksweep.sweep.studies.reader import live_study
from linksweep.sweep.tie import experiment
from linksweep.sweep.tie.experiment import FIELDS, check, design_of, tie
from tests.core.tie.made import MAS, POSITION, SPIN_BLOCK, Objects, gaia, gaia_table, noise, only, parse_unknowns, stars
from tests.tiers import slow

TIE = "linksweep.sweep.tie.experiment:tie"
# Options of the command that say where it runs and what it prints; a study gives these errors, reference - satellite.
ABOUT_OUTPUT = "workers pool scheduler tls_ca tls_cert tls_key cluster time_limit memory_limit dashboard more_epochs "
ABOUT_OUTPUT += "errors resamples seed sign no_sources output figures as_json"
WRONG = [("degree", 0, "degree=0"), ("known_spin", [0.1, 0.2], "known-spin=0.1,0.2"), ("bins", "17", "bins=17")]
WHERE = ["phot_g_mean_mag < 14", "reference: phot_g_mean_mag < 10"]
HIP = {"missions": {"hip": "hip.ecsv"}, "columns": {"hip:parallax": "plx"}, "mission_epochs": {"hip": "1991.25"}}
EVERY = "reference:all=0.3,hip:all=0.3"
CASES = {  # in a study, and in Python
    **{clip: ({"clip": clip}, {"clip": clip}) for clip in ("huber:1.5", "discrepancy:2", "median:1.5")},
    "jitter": ({"jitter": "estimate"}, {"jitter": "estimate"}),
    "without_cos_dec": ({"without_cos_dec": "reference"}, {"without_cos_dec": "reference"}),
    "where there": ({"where": "; ".join(WHERE)}, {"where": WHERE}),
    "missions": (HIP | {"jitter": "all=0.3"}, HIP | {"mission_epochs": {"hip": 1991.25}, "jitter": EVERY}),
    "known_spin_table": ({"known_spin_table": "spin.ecsv"}, {"known_spin": "spin.ecsv"}),
}


def point(study, **changes):
    return tie.defaults() | linksweep.load_study(study).fixed | changes


def copies(at, n_sim, seeds):
    rows = [tie.evaluate([at], n_sim, np.random.default_rng(seed), np.random.default_rng(0)) for seed in seeds]
    sums = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    return tie.summarise(sums, np.full(len(rows), float(n_sim)), np.ones(len(rows)))


def results(at, n_sim=400, seed=1):
    return {name: values[0] for name, values in copies(at, n_sim, [seed]).items()}


@pytest.mark.parametrize(("outliers", "n_sim"), [(0.0, 8), slow(0.0, 40), slow(0.1, 100)])
def test_errors_of_draws_hold_the_truth(outliers, n_sim):
    """Also of errors that rare outliers decide: their squares are far more uncertain."""
    at = point("pulsar-timing", outliers=outliers, outlier_factor=10.0)
    result, factor = copies(at, n_sim, range(300)), np.sqrt(1.0 + 99.0 * outliers)
    truths = {name: factor * result[f"{name}_predicted"] for name in ("sigma", "sigma_orientation")} | {"bias": 0.0}
    for name, truth in (truths | {"chi2_ratio_drawn": factor**2}).items():
        pulls = (result[name] - truth) / result[f"{name}_mc_error"]
        assert np.mean(np.abs(pulls[np.isfinite(pulls)]) <= 2.0) == pytest.approx(0.95, abs=0.04), name
    assert np.isnan([results(at, 4)[f"{name}_mc_error"][0] for name in ("bias", "sigma")]).all()


def test_results_of_draws_are_those_of_the_samples():
    at, n = point("pulsar-timing", error_factor=3.0), 300
    result = results(at, n)
    sums = tie.samples([at], n, np.random.default_rng(1), np.random.default_rng(0))
    drawn = sums["drawn"][0, :, :3]
    off = drawn - result["estimate"][:3]
    np.testing.assert_allclose(result["sigma"][:3], np.sqrt(np.mean(off**2, axis=0)))
    np.testing.assert_allclose(result["bias"][:3], off.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(result["sigma_orientation"], np.sqrt(np.mean(off**2)))
    predicted = np.sqrt(np.mean(result["sigma_predicted"][:3] ** 2))
    np.testing.assert_allclose(result["sigma_orientation_predicted"], predicted)
    np.testing.assert_allclose(result["coverage"][:3], np.mean(np.abs(off) <= result["sigma_predicted"][:3], axis=0))
    between = (result["coverage"][:3] * n + 2.0) / (n + 4.0)  # never 0 or 1
    np.testing.assert_allclose(result["coverage_mc_error"][:3], np.sqrt(between * (1.0 - between) / n))
    each = [at | {"error_factor": k, "outliers": 1.0, "outlier_factor": 6.0 / k} for k in (1.0, 3.0)]
    np.testing.assert_allclose(*(results(one, n)["sigma"] for one in each))
    # scaled errors follow from 15 degrees of freedom: estimate - truth over them is of Student
    np.testing.assert_allclose(result["coverage_scaled"][:3], 1.0 - 2.0 * stats.t.sf(1.0, 15), atol=0.08)


@pytest.mark.parametrize("clip", ["median:5", "rayleigh"])
def test_a_clip_takes_outliers_out_of_the_draws(clip):
    at = point("pulsar-forecast", n_new=40, outliers=0.1, outlier_factor=30.0)
    without, clip = results(at, 100), results(at | {"clip": clip}, 100)
    assert clip["sigma_orientation"] < 0.5 * without["sigma_orientation"]
    assert 30 < clip["n_kept_drawn"] < 39.5
    assert clip["n_drawn"] == without["n_kept_drawn"] == 40


def quasar_study(tmp_path, n=400, **changes):
    """A study of quasars with a motion of degree 2 and a spin that changes at G = 17; return it and the spins."""
    made, magnitude = stars(n, parallax=0.0), np.linspace(14.0, 20.0, n)
    spins = {False: np.array([0.05, 0.0, -0.03]), True: np.array([-0.02, 0.06, 0.01])}
    objects = Objects(made.values[0], made.values[1], np.zeros(n), np.zeros(n))
    field = parse_unknowns("vsh_motion:2-2").derivatives(objects)[1][0] * 0.5 * MAS  # t_2_0
    turned = SPIN_BLOCK.derivatives(objects)
    motion = -field - np.array([spins[bool(g > 17.0)] @ turned[:, :, i] for i, g in enumerate(magnitude)]).T * MAS
    values = np.concatenate([made.values[:3], motion])
    path = gaia(tmp_path / "quasars.ecsv", replace(made, values=values), phot_g_mean_mag=magnitude)
    fixed = {"satellite": str(path), "zero_motion": True, "unknowns": "spin"} | changes
    study = live_study({"title": "t", "experiment": TIE, "axes": {"clip": ["none"]}, "fixed": fixed})
    return tie.defaults() | study.fixed, spins


def test_powers_of_higher_degree_with_their_noise_and_a_spin_for_each_bin_are_stored(tmp_path):
    at, _ = quasar_study(tmp_path, degree=3)
    assert check(at) is None
    result = results(at, 300)
    toroidal, spheroidal = FIELDS.index("motion toroidal"), FIELDS.index("motion spheroidal")
    assert result["power"][toroidal, 1] == pytest.approx(0.25, rel=0.02)
    assert result["power_probability"][toroidal, 1] < 1e-6
    assert result["power"][spheroidal, 1] < 0.01
    shown = np.isfinite(result["power"])
    assert {tuple(place) for place in np.argwhere(shown)} == {(f, d) for f in (toroidal, spheroidal) for d in range(3)}
    drawn, predicted = result["power_drawn"][shown], result["power_drawn_predicted"][shown]
    assert np.all(np.abs(drawn - predicted) < 4.5 * result["power_drawn_mc_error"][shown])
    np.testing.assert_allclose(predicted, result["power_noise"][shown])
    at, spins = quasar_study(tmp_path, bins="phot_g_mean_mag=10,17")
    assert check(at) is None
    result = results(at, 300)
    link = linksweep.tie(at["satellite"].path, "zero-motion", "spin", bins=("phot_g_mean_mag", [10.0, 17.0]))
    np.testing.assert_allclose(result["spin_by_bin"][1:3], link.spin_by_bin)
    np.testing.assert_allclose(result["spin_by_bin_error"][1:3], link.spin_by_bin_error)
    np.testing.assert_allclose(link.spin_by_bin_error.values.ravel(), link.error.values)
    assert np.isnan(result["spin_by_bin"][0]).all()  # nobody is brighter than G = 10
    for number, faint in ((1, False), (2, True)):
        np.testing.assert_allclose(result["spin_by_bin"][number], spins[faint], atol=0.12)
        np.testing.assert_allclose(result["sigma_by_bin"][number], result["sigma_by_bin_predicted"][number], rtol=0.2)
    np.testing.assert_allclose(result["sigma_by_bin_mc_error"], result["sigma_by_bin"] / np.sqrt(600.0), rtol=0.2)
    assert "10 bins" in check(at | {"bins": "phot_g_mean_mag=1,2,3,4,5,6,7,8,9,10,11"})


def test_mean_new_positions_are_not_displaced_by_parallaxes_and_give_else_the_published_forecast():
    published = results(point("pulsar-forecast", n_new=62), 2)
    assert published["sigma_predicted"][:3].max() == pytest.approx(0.243, abs=5e-4)
    assert np.isnan(published["estimate"]).all()  # there is no timing yet
    at = point("pulsar-forecast", n_new=62, new_positions="mean", new_error=0.3)
    star = design_of(at).problem.satellite
    design = parse_unknowns("orientation").matrix(Objects(*star.values[:2], *np.zeros((2, 62))))[:, :2]
    weights = np.linalg.inv(star.covariance()[:, :2, :2] / MAS**2 + 0.3**2 * np.eye(2))
    each = np.einsum("nik,nij,njl->nkl", design, weights, design)
    expected = np.sqrt(np.diag(np.linalg.inv(each.sum(axis=0))))
    np.testing.assert_allclose(results(at, 2)["sigma_predicted"][:3], expected, rtol=1e-6)
    few, more = (np.isin(star.names, design_of(at | {"n_new": n}).problem.satellite.names) for n in (5, 6))
    traces = np.trace(np.linalg.inv(each[few].sum(axis=0) + each), axis1=1, axis2=2)
    assert np.flatnonzero(more & ~few).tolist() == [np.argmin(np.where(few, np.inf, traces))]  # the best beside these
    single = results(at | {"new_positions": "single-epoch"}, 2)["sigma_predicted"][:3]
    assert np.all(single > expected)


def test_a_limit_of_magnitude_leaves_sources_out(monkeypatch):
    at = point("pulsar-forecast", n_new=3)
    everything = design_of(at | {"n_new": 62}).problem.satellite.columns["parallax"]
    edge = np.sort(everything)[40]
    monkeypatch.setattr(experiment.setup, "MAGNITUDE", "parallax")
    inside = everything[everything <= edge]  # a limit is within
    some = design_of(at | {"g_max": edge, "n_new": 6, "truth": "zero"})
    taken = design_of(at | {"g_max": edge, "n_new": len(inside)})
    assert set(some.problem.satellite.columns["parallax"]) <= set(inside)
    assert sorted(taken.problem.satellite.columns["parallax"]) == sorted(inside)


def test_what_cannot_be_computed_is_said():
    wrong = {"satellite is required": {"satellite": None}, "there are 62 sources to observe": {"n_new": 63}}
    wrong |= {"no rows": {"n_new": 0}, "do not tell these unknowns apart": {"n_new": 1}}
    wrong |= {"no column of numbers": {"g_max": 12}, "no unknowns 'spin'": {"goal": "spin"}}
    wrong |= {"was changed": {"satellite": replace(point("pulsar-forecast")["satellite"], digest="")}}
    for words, changes in wrong.items():
        assert words in check(point("pulsar-forecast", n_new=5) | changes)


def test_studies_and_forecasts_have_every_option_of_a_link_under_its_name():
    options = {parameter.name for parameter in main.get_command(None, "tie").params} - set(ABOUT_OUTPUT.split())
    forecasts = {parameter.name for parameter in main.get_command(None, "forecast").params}
    assert options <= {parameter.name for parameter in tie.parameters}
    assert options - {"clip", "accept_misfit"} <= forecasts


@pytest.mark.parametrize(("name", "value", "text"), [*WRONG, ("star_models", {"all": "7"}, "star-model=all=7")])
def test_a_wrong_value_has_the_same_sentence_everywhere(tmp_path, name, value, text):
    table = str(gaia(tmp_path / "satellite.ecsv", stars(9, 3)))
    with pytest.raises(linksweep.SweepError) as error:
        linksweep.tie(table, table, **{name: value})
    with pytest.raises(linksweep.SweepError, match=f"^{re.escape(str(error.value))}$"):
        linksweep.forecast(table, table, **{name: value})
    with pytest.raises(linksweep.SweepError, match=re.escape(str(error.value))):
        written(tmp_path, satellite=table, reference=table, **{name: value})
    for command in ("tie", "forecast"):
        done = CliRunner().invoke(main, [command, table, table, f"--{text}"])
        assert (done.exit_code, str(error.value) in " ".join(done.stderr.split())) == (2, True), done.stderr


def written(folder, **changes):
    fixed = {"unknowns": "orientation,spin", "accept_misfit": True} | changes
    study = {"title": "t", "experiment": TIE, "fixed": fixed, "sampling": {"n_sim": 2}}
    return linksweep.run(study, folder / "s.zarr", pool="serial", fresh=True)


@pytest.mark.parametrize("case", [case if case == "discrepancy:2" else slow(case) for case in CASES])
def test_a_study_has_what_the_command_has_with_each_option(here, case):
    silent = np.array(case != "jitter") & (np.arange(20) == 0)  # without a motion the first source says nothing
    says = POSITION[:, None] | ~silent
    gaia("satellite.ecsv", only(stars(20, 3), says))
    reference = only(stars(20, 4), says, epoch=2016.0 + 5.0 * silent)
    values = stars(20, 3).values + 3.0 * noise(np.random.default_rng(1), reference)
    gaia("reference.ecsv", replace(reference, values=values))
    hip = gaia_table(replace(stars(20, 3), epoch=np.full(20, 1991.25)))
    hip.remove_column("ref_epoch")
    hip.rename_column("parallax", "plx")
    hip.write("hip.ecsv")
    spins = {"mag_min": [10.0, 0.0], "mag_max": [30.0, 10.0]} | {f"omega_{axis}": [0.2, 0.1] for axis in "xyz"}
    Table(spins, units=dict.fromkeys(("omega_x", "omega_y", "omega_z"), "mas/yr")).write("spin.ecsv")
    in_study, in_python = CASES[case]
    results = written(here, satellite="satellite.ecsv", reference="reference.ecsv", **in_study)
    unknowns = "orientation,spin" + (",hip:orientation,hip:spin" if case == "missions" else "")
    options = {"accept_misfit": True, "errors": "scaled,jackknife,formal"}
    link = linksweep.tie("satellite.ecsv", "reference.ecsv", unknowns, **options, **in_python)
    np.testing.assert_allclose(results.estimate.values[:6], link.estimate.values[:6], rtol=1e-9)
    for kind in ("scaled", "jackknife", "formal"):
        estimated = "estimated" if (case, kind) == ("jitter", "formal") else kind
        expected = link.errors.sel(error_kind=estimated)[:6]
        np.testing.assert_allclose(results[f"error_{kind}"][:6], expected, rtol=1e-9, err_msg=kind)
    plain = linksweep.tie("satellite.ecsv", "reference.ecsv", "orientation,spin", **options)
    assert not np.allclose(plain.estimate, link.estimate[:6], rtol=1e-6)
    formal = (plain if "clip" in in_study else link).errors.sel(error_kind="formal")[:6]
    np.testing.assert_allclose(results.sigma_predicted.values[:6], formal, rtol=1e-9)
    assert results.chi2_ratio.item() == pytest.approx(float(link.chi2 / link.chi2_expected))
    assert results.largest_share.item() == pytest.approx(float(link.share.max()))
    assert results.n_kept.item() == int(link.n_sources) <= 19 + (case in ("jitter", "missions"))
