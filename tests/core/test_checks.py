"""What is said about a point before anything runs: why it cannot be computed, what it sets in vain, and warnings."""

import json

import numpy as np
import pytest
from astropy.table import Table

import linksweep
from tests.core import points
from tests.core.points import MISSIONS, OTHER, Function, Named, evaluated, link, mission_from_table, point, table_file

BOTH = {"reference_errors": "catalogue", "satellite_errors": "catalogue"}
OF_VLBI = {"columns": (("reference_pmdec_error", "d"), ("reference_pmra_error", "a"))}
MOTIONS, POSITIONS = ({"satellite_errors": "normal", f"satellite_sigma_{kind}": 0.0} for kind in ("pos", "pm"))
FAINT = {"satellite_errors": "normal", "satellite_sigma_pos": 1e-6, "satellite_sigma_pm": 1e-6}
QUASARS, GALAXIES, RADIO = ({"catalogue": name} for name in ("quasars", "galaxies", "radio-stars"))
PROJECTED, NO_MAGNITUDES = {"method": "projected"}, {"contents": {"phot_g_mean_mag": None}}
WRONG = [({"motion_field": "t_2"}, "motion_field: 't_2' is no harmonic; those are t_L_0")]
WRONG += [*(({"motion_field": "t_51_0"}, "degrees L = 1 to 50"), ({"motion_field": "t_2_0,t_2_0"}, "t_2_0 twice"))]
WRONG += [({"motion_field": "t_2_0=0"}, "no harmonic with a coefficient that is not zero")]
WRONG += [({"epsilon": [0.0, 0.0, 1.0], "directions": "random", "epsilon_size": 1.0}, "1.0) changes nothing")]
WRONG += [({"satellite_errors": "none", "satellite_floor_pm": 1.0}, "satellite_floor_pm = 1.0 changes nothing")]
WRONG += [({"zonal_length": 5.0, "zonal_pm": 1.0}, "zonal_length = 5"), (RADIO | {"v_max": 9.0}, "v_max = 9.0 changes")]
WRONG += [({"omega_slope_size": 0.2}, "omega_slope_size = 0.2: omega_slope = [0.0, 0.0, 0.0] gives it no direction")]
WRONG += [({"epsilon": [0.0, 0.0, 0.0], "epsilon_size": 3.0}, "epsilon_size = 3: epsilon")]
WRONG += [({"method": "projected", "zonal_pm": 1.0}, "method = 'projected' needs errors that are independent")]
WRONG += [({"method": "projected", "satellite_error_ratio": 2.0}, "satellite_error_ratio = 1")]
POSSIBLE = [
    {"contents": {"a": np.full(6, 3.0), "d": np.full(6, 4.0)}} | OF_VLBI | BOTH,
    *({}, PROJECTED | {"contents": {}}, {"satellite_errors": "none"}, PROJECTED | {"satellite_errors": "none"}),
    *(POSITIONS | {"reference_errors": "normal"}, {"model": "gaia-2001", "v_max": 21.0}),
    QUASARS | {"n_obj": None, "v_max": 16.3, "v_min": 14.7, "counts": "completed"},
    *(QUASARS | {"n_obj": 1000, "v_max": 16.5, "counts": "completed"}, {"solve_glide": True, "n_obj": 3}),
    *(GALAXIES | {"v_max": 11.0, "aberration": True}, {"zone_of_avoidance": 89.0, "sky_contrast": -0.99}),
    *(RADIO | {"positions": "own", "reference_errors": "catalogue"}, PROJECTED | {"n_obj": 2, "weighting": "equal"}),
    {"solve_glide": True, "aberration": True, "reference_errors": "normal", "corrections": False},
    {"directions": "random", "epsilon_size": 5.0, "omega_size": 0.0},
    FAINT | {"error_scale": 1e8, "satellite_floor_pos": 1.0, "satellite_floor_pm": 1.0},  # which has no scale
    PROJECTED | {"solve_glide": True, "weighting": "equal", "reference_errors": "normal"},
]
PROBLEMS = [
    (QUASARS | {"v_max": 12.0}, "v_max = 12 mag: must be fainter than"),
    (QUASARS | {"n_obj": 89, "v_max": 15.0}, "n_obj = 89: only 88 quasars are brighter than v_max"),
    (QUASARS | {"n_obj": 6011, "v_min": 17.0, "v_max": 17.5, "counts": "completed"}, "only 6010 quasars"),
    *(({"n_obj": None}, "n_obj: "), ({"v_max": 5.0}, "v_max = 5 mag: ")),
    ({"catalogue": "file"}, "catalogue = 'file' needs a file"),
    (GALAXIES | {"v_max": 10.9}, "v_max = 10.9 mag: "),
    (RADIO | {"aberration": True}, "aberration: "),
    ({"satellite_errors": "catalogue"}, "satellite_errors = 'catalogue': "),
    ({"satellite_errors": "normal", "satellite_sigma_pos": 2e7, "satellite_floor_pm": 2.0}, "mas and 2.24 mas/yr"),
    ({"mission_length": 5e-324}, "errors of inf mas and inf mas/yr: must be from"),
    ({"model": "gaia-2001", "v_max": 21.5}, "v_max = 21.5 mag: the curve of 'gaia-2001' ends at 21 mag"),
    ({"contents": {}, "catalogue": "synthetic"}, "file: catalogue = 'file' needs a file, and other"),
    ({"contents": {}, "n_obj": 7}, "n_obj = 7: only 6 objects of the file are there"),
    ({"contents": {}, "n_obj": 4, "v_max": 12.5}, "only 3 objects of the file are brighter than v_max = 12.5"),
    ({"contents": {}, **BOTH}, "reference_errors and satellite_errors are both 'catalogue'"),
    (PROJECTED | {"contents": {}, "satellite_errors": "catalogue"}, "correlated"),
    (NO_MAGNITUDES, "'magnitude' needs a magnitude column"),
    (NO_MAGNITUDES | {"v_max": 12.0, "satellite_errors": "none"}, "magnitude column"),
    ({"contents": {"phot_g_mean_mag": np.full(6, 22.0)}, "model": "gaia-2001"}, "v_max = 22 mag: the curve"),
    ({"contents": {"pmra_error": np.arange(6.0) % 4.0}, "satellite_errors": "catalogue"}, "object 1 has an"),
    ({"contents": {"pmra_error": np.full(6, 1e-10)}, "satellite_errors": "catalogue"}, "mas and 1e-10 mas/yr"),
]


def at(folder, contents=None, **changes):
    """A point of synthetic objects, or of six in a file with Gaia's names, of magnitudes 10 to 15."""
    if contents is None:
        return point(**changes)
    r = np.array([[1, 2, 3], [-2, 1, 1], [0, -3, 1], [1, -1, -4], [-1, -1, 2], [5, 0, -1.0]]).T
    columns = {"source_id": np.arange(6), "ra": np.degrees(np.arctan2(r[1], r[0])) % 360.0}
    columns |= {"dec": np.degrees(np.arctan2(r[2], np.hypot(r[0], r[1])))}
    columns |= {"pmra": np.arange(6.0), "pmdec": -np.arange(6.0), "phot_g_mean_mag": np.arange(10.0, 16.0)}
    columns |= {f"{name}_error": np.linspace(0.1, 0.2, 6) for name in ("ra", "dec", "pmra", "pmdec")}
    columns |= {"pmra_pmdec_corr": np.full(6, 0.6)} | contents
    Table({k: v for k, v in columns.items() if v is not None}).write(folder / "six.ecsv", overwrite=True)
    return point(**{"catalogue": "file", "file": table_file(folder / "six.ecsv"), "n_obj": None} | changes)


@pytest.mark.parametrize("changes", POSSIBLE)
def test_points_without_a_problem_can_be_computed(changes, tmp_path):
    point, n_sim, normals = at(tmp_path, **changes), 50, []

    class Counting(np.random.Generator):
        def standard_normal(self, size=None, out=None):
            drawn = super().standard_normal(size, out=out)
            normals.append(np.size(drawn))
            return drawn

    assert link.check(point) is None
    with np.errstate(all="raise"):
        sums = link.evaluate([point], n_sim, Counting(np.random.PCG64(1)), np.random.default_rng(2))
    for name, values in sums.items():
        solved = values[:, :6] if name in ("error", "batch_mean_squares") else values
        assert name == "chi2_variance" or np.all(np.isfinite(solved)), name
    assert point["directions"] == "random" or sum(normals) == n_sim * link.cost(point)


@pytest.mark.parametrize(("changes", "problem"), PROBLEMS)
def test_points_with_a_problem(changes, problem, tmp_path):
    assert problem in link.check(at(tmp_path, **changes))


@pytest.mark.parametrize(("changes", "good"), [({}, False), ({"v_min": 8.5}, True), (QUASARS, True), (RADIO, False)])
def test_a_function_is_asked_about_all_magnitudes_that_objects_can_have(changes, good):
    function = Function(lambda v: np.where(v < 8.0, -1.0, 0.1), "counted")
    table = {"nominal_length": 4.0, "sigma_pm": "x.py:f", "position_ratio": 1.0}
    value, identity = mission_from_table(table, lambda reference: function)
    problem = link.check(point(model=Named("mine", json.dumps(identity), value), **changes))
    assert problem is None if good else "'counted' returns -1 at V = " in problem


@pytest.mark.parametrize("catalogue", ["synthetic", "quasars", "galaxies", "radio-stars"])
def test_what_is_unused_really_changes_nothing_and_the_rest_of_a_catalogue_something(catalogue):
    base = link.defaults() | {"catalogue": catalogue, "n_obj": 8}
    unused, reference = link.unused(base), evaluated(4, base)
    for name, value in OTHER.items():
        changed = base | {name: value} | ({"omega_slope": OTHER["omega_slope"]} if name == "omega_slope_size" else {})
        if link.check(changed) is not None:
            assert catalogue == "radio-stars", name  # which has no limits, and says so
            continue
        result = evaluated(4, changed)
        same = all(np.array_equal(result[k], reference[k], equal_nan=True) for k in reference)
        assert same == (name in unused) or name == "corrections", name  # which need motions to change something


@pytest.mark.parametrize("fixed", [MOTIONS, POSITIONS])
def test_what_acts_on_what_is_not_measured_is_unused(fixed):
    base = points.point(**fixed, mean_pm=100.0)
    names = [name for name, why in link.unused(base).items() if "not measured" in why]
    assert "zonal_pos" in names or {"zonal_pm", "omega_slope_size", "aberration"} <= set(names)
    reference = evaluated(4, base)
    for name in names:
        assert name in link.unused(base | {name: OTHER[name]})
        result = evaluated(4, base | {one: OTHER[one] for one in {name, name.removesuffix("_size")}})
        for key in reference.keys() - {"chi2_variance"}:
            np.testing.assert_allclose(result[key], reference[key], rtol=1e-9, err_msg=f"{name}: {key}")


@pytest.mark.parametrize(("fixed", "sentence"), WRONG)
def test_a_study_is_told_what_is_wrong_and_nothing_is_written(fixed, sentence, tmp_path):
    with pytest.raises(linksweep.SweepError) as error:
        linksweep.run({"title": "", "fixed": {"n_obj": 9} | fixed}, tmp_path / "never.zarr", pool="serial")
    assert sentence in " ".join(error.value.problems)
    assert not list(tmp_path.iterdir())


def test_an_object_with_most_of_the_weight_and_magnitudes_outside_of_a_curves_range_are_warned_of(tmp_path):
    v_mag, (ra, dec, *_) = np.array([9.37, *np.full(40, 15.0)]), points.sky(41)
    columns = {"Name": ["Mrk 421", *(f"q{k}" for k in range(40))], "ra": np.degrees(ra), "dec": np.degrees(dec)}
    Table(columns | {"v_mag": v_mag}).write(tmp_path / "sky.ecsv")
    both = {"model": "amex", "reference_errors": "normal", "reference_sigma_pm": 0.5}  # variances add up
    one = point(catalogue="file", file=table_file(tmp_path / "sky.ecsv"), n_obj=None, **both)
    (result,) = link.warn(one)
    weight = 1.0 / (MISSIONS["amex"].sigma_pm_mas_yr(v_mag) ** 2 + 0.5**2)
    assert f"row 1 (Mrk 421, V = 9.37) holds {100 * weight[0] / weight.sum():.0f} % of the weight" in result
    assert link.warn(one | {"v_min": 10.0}) == []
    alike = {"reference_errors": "normal", "reference_sigma_pos": 1e3, "reference_sigma_pm": 1e3}
    assert (link.warn(one | alike), link.warn(one | {"weighting": "equal"})) == ([], [])
    assert [len(link.warn(one | alike | {f"reference_sigma_{kind}": 0.0})) for kind in ("pos", "pm")] == [1, 1]
    (result,) = link.warn(point(model="gaia-dr3"))
    assert "known from V = 8 to 21, and the catalogue has or may have objects beyond" in result
    (result,) = link.warn(point(model="gaia", v_min=13.0, v_max=20.5))
    assert "objects beyond, where it is extrapolated" in result
    for changes in ({"v_min": 13.0}, QUASARS | {"n_obj": None}):
        assert link.warn(point(model="gaia", **changes)) == []


def test_a_run_says_and_stores_its_warnings_and_show_repeats_them(tmp_path, sweep):
    text = 'title = "t"\nfixed = { n_obj = 12, model = "gaia" }\nsampling = { n_sim = 3 }'
    (tmp_path / "bright.toml").write_text(text)
    commands = "plan bright.toml", "run bright.toml -o s.zarr", "show s.zarr"
    both = (sweep(*command.split(), cwd=tmp_path)[1:] for command in commands)
    planned, ran, shown = (" ".join(" ".join(streams).split()) for streams in both)
    (stored,) = json.loads(linksweep.open(tmp_path / "s.zarr").attrs["warnings"])
    assert stored.endswith("held at its floor (1 point)")
    assert "its accuracy curve is known from V = 12.8 to 20" in planned
    assert all(f"warning: {stored}" in said for said in (ran, shown))


@pytest.mark.parametrize(("last", "warned"), [(2016.5, True), (2016.0, False), (np.nan, False)])
def test_rows_of_different_epochs_are_told(tmp_path, last, warned):
    result = [s for s in link.warn(at(tmp_path, {"ref_epoch": [2016.0] * 5 + [last]})) if "ref_epoch" in s]
    assert [s.partition(", and")[0] for s in result] == warned * ["file: ref_epoch is between 2016 and 2016.5"]
