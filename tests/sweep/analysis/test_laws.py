"""Fits, ratios and crossings of results by functions and commands, and their errors (see test_closed_forms)."""

import contextlib
import json
import re

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import linksweep
from linksweep import SweepError, find, fit_levelling, fit_power_law, interpolate, ratio
from tests.sweep.analysis.made import DONE, EXCLUDED, FAILED, MISSING, N, grid
from tests.tiers import examples, few, slow

V = np.arange(14.0, 20.1, 0.5)
MET = ("never", "always", "from", "up to", "several times", "left out")
CONDITIONS = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal}
PLAIN = grid(N)
WORDS = grid(N, words=(("model", "n"), np.full((2, 5), "a", dtype=object)))
LARGE = PLAIN.assign(width=2**62 + PLAIN["width"].astype(int)).assign_attrs(function=1)
OF_LARGE = [lambda: find(LARGE, "width > 9", "n"), lambda: linksweep.sensitivity(LARGE, "width")]
NO_CONDITIONS = "", "width < ", "width = 1", "1 < width", "width < 1 no", "width < 1e999", "width < 1 < 2"
COMMANDS = {
    "fit STORE --over x": lambda ds: fit_power_law(ds, "y", "x"),
    "fit STORE --variable z --at kind=b --expect 0.5": lambda ds: fit_power_law(ds.sel(kind="b"), "z", "x", 0.5),
    "fit STORE --variable y --law levelling": lambda ds: fit_levelling(ds, "y", "x"),
    "fit STORE --variable y --law levelling --fall 20": lambda ds: fit_levelling(ds, "y", "x", fall=0.2),
    "find STORE --where y<1 --at kind=b": lambda ds: find(ds.sel(kind="b"), "y < 1", "x"),
    "sensitivity STORE": linksweep.sensitivity,
    "sensitivity STORE --variable z": lambda ds: linksweep.sensitivity(ds, "z"),
}


def met(actual):
    return [MET[int(code)] for code in actual["met"].values.ravel()]


def test_a_covariance_is_that_of_the_dataset_and_of_the_points_that_are_left():
    error = 0.02 * N**-0.5
    pair = ("n", "n_other"), np.outer(error, error) * (0.8 + 0.2 * np.eye(5))
    shared = grid(N**-0.5, error, width_mc_covariance_n=pair)
    assert fit_power_law(shared, "width", "n").attrs["errors"] == "covariance between points"
    status = np.array([[EXCLUDED] + [DONE] * 4, [EXCLUDED] * 5], dtype=np.int8)
    without = fit_power_law(shared.assign(status=(("model", "n"), status)), "width", "n", expected=-0.5)
    assert without["exponent"].values == pytest.approx([-0.5, np.nan], nan_ok=True)
    few = fit_power_law(grid(N, status=[[DONE] * 5, [DONE] + [EXCLUDED] * 4]), "width", "n")
    assert few["conclusion"].values.tolist() == ["", "too few points"]
    rows = list(zip(without["points"].values, without["conclusion"].values, strict=True))
    assert rows == [(4.0, "as expected"), (0.0, "no point in the study")]
    actual = find(grid(N, status=[[DONE] + [EXCLUDED] * 4, [DONE] * 2 + [EXCLUDED] * 3]), "width > 500", "n")
    never = "never; 20 mas at 20 is nearest to the limit; points go only from 10 to 20"
    assert actual["conclusion"].values.tolist() == ["left out; only 1 of 5 points: 10", never]
    part = fit_power_law(shared.isel(n=slice(1, None), n_other=slice(1, None)), "width", "n")
    assert without["exponent_error"].values[0] == pytest.approx(part["exponent_error"].values[0], rel=1e-12)


@pytest.mark.parametrize("is_own", [False, True])
def test_values_of_the_same_random_numbers_have_no_error_without_a_covariance(is_own):
    dataset = grid(N**-0.5, 0.01 * N**-0.5)
    if is_own:  # a dimension of the result's own
        dataset["status"] = dataset["status"].isel(n=0, drop=True)
    else:
        dataset.attrs |= {"common_random_numbers": 1, "shared_axes": '["n"]'}
    result = fit_power_law(dataset, "width", "n", expected=-0.5)
    assert result["exponent"].values == pytest.approx(-0.5)
    assert result[["exponent_error", "amplitude_error", "chi2", "p_value", "deviation"]].isnull().all().to_array().all()
    assert result.attrs["errors"].startswith("not known, as ")
    assert fit_power_law(dataset.drop_vars("width_mc_error"), "width", "n")["exponent_error"].notnull().all() == is_own
    for one in (dataset, dataset.assign(width_mc_error=0.0 * dataset["width_mc_error"])):
        assert np.isnan(ratio(one, "width", "n", 10.0, 20.0)["ratio_error"]).all()
    # Points that differ in what is not shared are independent, also where they differ in what is shared, too.
    assert (ratio(dataset, "width", "model", "old", "new")["ratio_error"] > 0.0).all()
    zipped = ratio(dataset.assign_coords(m=("n", N)), "width", "n", 10.0, 20.0)["ratio_error"]
    assert is_own or (zipped > 0.0).all()


@pytest.mark.parametrize("unknown", [np.nan, np.inf, 0.0])
def test_a_law_is_through_the_points_with_known_errors(unknown):
    y, errors = N**-0.5 * [1.0, 1.02, 2.0, 0.97, 1.0], 0.01 * N**-0.5 * [1.0, 1.0, np.nan, 1.0, 1.0]
    few = np.where(np.arange(5) == 1, errors, np.nan)
    errors[2] = unknown
    actual = fit_power_law(grid(np.array([y, y]), np.array([errors, few])), "width", "n", -0.5)
    part = fit_power_law(grid(y, errors).isel(n=[0, 1, 3, 4]), "width", "n", -0.5)
    assert actual.isel(model=0).drop_attrs().equals(part.isel(model=0).drop_attrs())
    assert (actual["points"].values.tolist(), "left out: 1" in actual.attrs["notes"]) == ([4.0, 5.0], True)
    assert (np.isnan(actual["exponent_error"].values[1]), actual["conclusion"].values[1]) == (True, "")


def test_truth_values_and_integers_have_crossings_and_values_between():
    dataset = grid(N)
    dataset["flag"] = dataset["width"] > 60.0
    dataset["count"] = dataset["width"].astype(np.int64)
    dataset.attrs["function"] = 1
    for condition, crossing in [("flag > 0.5", np.sqrt(50.0 * 100.0)), ("count > 60", 60.0)]:
        actual = find(dataset, condition, over="n")
        assert actual["first"].values == pytest.approx(crossing)
        assert np.isnan(actual["first_error"].values).all()  # there is none, and none is made of the type
    assert interpolate(dataset, "count", "n", 300.0)["count"].values == pytest.approx(300.0)  # the last point
    assert ratio(dataset, "flag", "n", of=100.0, to=300.0)["ratio"].values == pytest.approx(1.0)
    exact = dataset.assign(count=2**58 * (dataset["count"] // 10))  # beyond 2**53, and floats
    assert fit_power_law(exact, "count", "n")["exponent"].values == pytest.approx(1.0)
    assert not fit_power_law(grid(np.full(5, 3.0)), "width", "n")["exponent"].values.any()


@settings(max_examples=examples(100))
@given(st.lists(st.sampled_from([1.0, 2.0, 3.0]), min_size=5, max_size=5), st.sampled_from([*CONDITIONS]))
def test_where_a_condition_is_met(value, sign):
    stored = grid(value, 0.01).isel(n=[3, 0, 4, 1, 2])  # rows of a store are in any order
    result, holds = find(stored, f"width {sign} 2", "n"), CONDITIONS[sign](value, 2.0)
    far = find(grid(2.0**900 * np.array(value), 0.01 * 2.0**900), f"width {sign} {2.0**901!r}", "n")
    assert far[["met", "first", "last_error"]].equals(result[["met", "first", "last_error"]])
    flips, there = np.flatnonzero(np.diff(holds)).tolist(), holds[-1]
    some = ("from" if there else "up to") if len(flips) == 1 else "several times"
    assert met(result) == [some if flips else "always" if there else "never"] * 2
    assert result["crossings"].values.tolist() == [len(flips)] * 2
    if flips:
        for name, i in (("first", flips[0]), ("last", flips[-1])):
            share = np.log(2.0 / value[i]) / np.log(value[i + 1] / value[i])
            assert result[name].values == pytest.approx(N[i] * (N[i + 1] / N[i]) ** share)
    else:
        assert result["nearest"].values == pytest.approx(min(value, key=lambda one: abs(one - 2.0)))
        assert result["nearest_error"].values == pytest.approx(0.01)
        assert ["not decided" in words for words in result["conclusion"].values] == [2.0 in value] * 2
        assert np.all(np.isnan(result["first"]))


@pytest.mark.slow
def test_units_are_converted_lines_of_another_kind_left_out_and_places_printed(dataset_of, store_of, sweep_here):
    dataset = dataset_of("quasars")
    in_uas, in_mas = (find(dataset, f"sigma_spin < {limit}", "v_max") for limit in ("0.9 uas/yr", "0.0009"))
    assert in_uas["first"].values == pytest.approx(in_mas["first"].values, rel=1e-12, nan_ok=True)
    assert 15.0 < in_uas["first"].sel(model="gaia").item() < 17.0
    each = find(dataset, "sigma < 1 uas/yr", "v_max").sel(component=["epsilon_x", "epsilon_y"])
    assert (met(in_uas), set(met(each))) == (["never", "from"], {"left out"})
    with pytest.raises(SweepError, match="sigma_spin is in mas / yr, not convertible to mag"):
        find(dataset, "sigma_spin < 1 mag", "v_max")
    out = sweep_here("find", store_of("quasars"), "--where", "sigma_spin < 1 uas/yr", "--over", "v_max")[1]
    assert re.search(r"(?s)amex   never; 0\.5.*gaia   from 1[56]\.", out)
    assert "as expected" in sweep_here("fit", store_of("sqrt-n"))[1]


@settings(max_examples=examples(25))
@given(st.text(max_size=40))
def test_any_text_is_a_condition_or_a_clear_error(text):
    with contextlib.suppress(SweepError):  # any other exception fails
        find(PLAIN, text, "n")


def without_inverse(number):
    covariance = np.stack([np.eye(5), np.full((5, 5), number)])
    return grid(N**-0.5, width_mc_covariance_n=(("model", "n", "n_other"), covariance))


def law_of(dataset, variable="width", over="n"):
    return lambda: fit_power_law(dataset, variable, over)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (law_of(grid(N), "widht"), "no quantity 'widht'; did you mean 'width'"),
        (law_of(grid(N), "status"), "no quantity 'status'"),
        (law_of(WORDS, "words"), "no numbers"),
        (law_of(grid(N)[["width"]]), "no variable status"),
        (law_of(grid(N), "width", "model"), "'model' is no axis with several numbers of width; there are n"),
        (law_of(grid(-N)), "width must be above 0; it is -10 at model=old, n=10"),
        (law_of(grid(N, x=N - 10.0)), "a power law needs n above 0; there is 0"),
        (law_of(grid([1.0, np.nan, 1.0, 1.0, 1.0])), "width is not a finite number at model=old, n=20"),
        (law_of(grid(N, status=[[MISSING, FAILED, FAILED, DONE, DONE], [DONE] * 5])), "1 missing and 2 failed of"),
        (law_of(grid(N, status=np.full((2, 5), EXCLUDED))), "the study has no point there"),
        *((law_of(without_inverse(x)), "positive definite: width over n at model=new") for x in (1.0, np.nan, np.inf)),
        (lambda: fit_levelling(grid(1.0 / N), "width", "n", fall=5.0), "fall = 5: must be above 0 and below 1"),
        (lambda: fit_levelling(grid(N).isel(n=[0, 1, 2]), "width", "n"), "4 points are .* n; there are 3 at model=old"),
        (lambda: interpolate(grid(N), "width", "n", 301.0), "n = 301 is beyond the points, which go from 10 to 300"),
        *((lambda at=at: interpolate(PLAIN, "width", "n", at), f"n = {at!r}: must be") for at in ("30", np.nan)),
        *((call, "width is 4611686018427387914, beyond") for call in OF_LARGE),
        *((lambda c=c: find(PLAIN, c, "n"), "condition is VARIABLE|none that astropy knows") for c in NO_CONDITIONS),
    ],
)
def test_what_cannot_be_fitted(call, message):
    with pytest.raises(SweepError, match=message):
        call()


def decaying(x: float, kind: str = "a"):
    return {"y": (2.0 if kind == "a" else 3.0) * np.sqrt(0.04 + np.exp(-x)), "z": x + 10.0 * (kind == "b")}


def test_options_of_commands_say_what_arguments_of_functions_do(tmp_path, sweep_here):
    decays = tmp_path / "s.zarr"
    linksweep.run(decaying, decays, axes={"x": np.arange(1.0, 9.0), "kind": ["a", "b"]}, pool="serial")
    for command, function in COMMANDS.items():
        out = sweep_here(*command.replace("STORE", str(decays)).split(), "--json", code=0)[1]
        rows = json.loads(out)["rows"]
        for name, values in function(linksweep.open(decays)).items():
            if values.dtype.kind == "f":
                actual = [np.nan if row[name] is None else row[name] for row in rows]
                finite = np.where(np.isfinite(values), values, np.nan)
                np.testing.assert_array_equal(actual, finite.reshape(-1), err_msg=f"{command}: {name}")


@pytest.mark.slow
def test_what_has_no_place_and_no_errors_is_printed_without(tmp_path, sweep_here, start_sweep):
    def kernel(name: str = "flat", width: float = 1.0):
        return {"z": 7.0 if name == "flat" else 3.0 * width}

    study = {"experiment": kernel, "axes": {"name": ["flat", "rbf"], "width": [1.0, 2.0, 4.0]}}
    ds = linksweep.run(study | {"when": {"width": {"name": ["rbf"]}}}, tmp_path / "s.zarr", pool="serial")
    out = sweep_here("find", tmp_path / "s.zarr", "--where", "z > 5", "--over", "width")[1]
    assert ("always; 7 is nearest to the limit" in out, "nan" in out, "scatter" in out) == (True, False, False)
    law = fit_power_law(ds, "z", "width").sel(name="rbf")
    assert (law["points"].item(), law["exponent"].item()) == (3.0, pytest.approx(1.0))
    both = {"grid": {"zip": [["name", "width"]]}, "axes": {"name": ["flat", "rbf", "poly"], "width": [8.0, 1.0, 4.0]}}
    both |= {"experiment": kernel, "when": {"width": {"name": ["rbf", "poly"]}}}
    words = find(linksweep.run(both, tmp_path / "z.zarr", pool="serial"), "z < 15", "width")["conclusion"].item()
    assert words == "always; 12 at 4 is nearest to the limit"
    twice = linksweep.run(lambda x: x, tmp_path / "u.zarr", points={"x": [1.0, 2.0, 2.0, 3.0]}, pool="serial")
    assert fit_power_law(twice, "result", "x")["points"].item() == 3.0
    linksweep.run(kernel, tmp_path / "t.zarr", points={"name": ["flat", "rbf"], "width": [1.0, 2.0]}, pool="serial")
    answers = {"z>50": "no point meets z > 50\n", "z>1": "rbf", "z>9 --over width": "none, as points"}
    for asked, words in answers.items():
        assert words in "".join(sweep_here("find", tmp_path / "t.zarr", "--where", *asked.split())[1:])
    noise = {"points": {"x": [0.0, 9.0], "y": [1.0, 2.0]}, "sampling": {"n_sim": 50}, "pool": "serial"}
    linksweep.run(lambda rng, x, y: x + rng.normal(), tmp_path / "r.zarr", **noise)
    out = sweep_here("find", tmp_path / "r.zarr", "--where", "result_mean > 9.1")[1]
    assert "no point meets result_mean > 9.1; not decided: 1 of 2 points are" in out
    err = start_sweep("find", tmp_path / "s.zarr", "--where", "z > 5 erg/s/cm2", "--over", "width").communicate()[1]
    assert ("not convertible" in err, "Warning" in err) == (True, False)


@pytest.mark.parametrize("noise", [slow(0.03), 0.1, slow(0.3), 0.5])
@pytest.mark.parametrize("truth", few(1, [2.0, 1.75, 1.5]))
def test_crossings_of_points_with_errors_of_any_size(noise, truth):
    x = np.arange(5.0)
    y = x - truth + noise * np.random.default_rng(5).standard_normal((400, 5))
    for axis, at, unit in ((x, truth, 2.0**-900), (20.0**x, 20.0**truth, 2.0**900)):  # the second is logarithmic
        actual = find(grid(unit * y, unit * noise, x=axis), "width > 0", "n")
        error = actual["first_error"].values
        known = np.isfinite(error)
        assert known.mean() > 0.85  # else the line may cross nowhere
        within = np.mean(abs(actual["first"].values - at)[known] < 2.0 * error[known])
        assert 0.955 - 4.0 * np.sqrt(0.955 * 0.045 / 400) < within < 0.999
    x = np.linspace(0.0, 4.0, 801)  # so close that noise makes a line cross many times
    y = x - truth + noise * np.random.default_rng(5).standard_normal((100, 801))
    actual = find(grid(y, noise, x=x), "width > 0", "n")
    inside = [abs(actual[name] - truth) < 2.0 * actual[f"{name}_error"] for name in ("first", "last")]
    assert np.mean(inside, axis=1).min() > 0.93
    assert all("not decided" in words for words in actual["conclusion"].values[actual["crossings"] > 1])


@pytest.mark.parametrize("mirrored", [slow(False), True])
@pytest.mark.parametrize("noise", [slow(0.7), 1.4, slow(2.8)])
def test_a_line_that_turns_back_at_the_limit_has_not_crossed_it(noise, mirrored):
    """The truth is near the last point, in steps of the axis, and noise crosses before; for most there is no error."""
    x = np.arange(6.0)
    y = x - 4.8 + noise * np.random.default_rng(6).standard_normal((400, 6))
    actual = find(grid(y[:, ::-1] if mirrored else y, noise, x=x), "width > 0", "n")
    for name in ("first", "last"):
        wrong = abs(actual[name].values - (0.2 if mirrored else 4.8)) > 2.0 * actual[f"{name}_error"].values
        assert wrong.sum() < 400 * 0.045 + 4.0 * np.sqrt(400 * 0.045)
    tops = np.array([[-5.0, 0.5, -5.0, -5.0], [-5.0, 0.5, -5.0, 5.0]])  # with errors of 1: above the limit, or not?
    errors = find(grid(-tops if mirrored else tops, 1.0, x=x[:4]), "width > 0", "n")["first_error"].values
    assert np.isnan(errors[0])
    assert 0.7 < errors[1] < 1.5
    # the difference of the last two is twice its error, or a little less: the square of their line has no s^2
    lines = grid([[20, 2, -1]] * 2, [[0.1, 1.5, 0.0], [0.1, 1.4999, 0.0]], x=x[:3])
    errors = find(lines, "width > 0", "n")["first_error"].values
    assert errors[0] == pytest.approx(errors[1], rel=1e-3)


def level_off(y, errors, fall=0.05):
    return linksweep.fit_levelling(grid(y, errors, x=V, name="v", unit="mag"), "width", "v", fall=fall)


def law(v, floor=0.55, size=0.13, rate=0.8):
    return np.sqrt(floor**2 + size * np.exp(-rate * (v - 14.0)))


@pytest.mark.parametrize(("floor", "rate"), few(1, [(0.0, 0.3), (0.35, 0.05)]))
def test_a_plateau_that_points_do_not_reach_is_within_its_errors(floor, rate):
    y = law(V, floor, 1.1, rate) * (1.0 + 0.02 * np.random.default_rng(25).standard_normal((40, len(V))))
    pulls = ((actual := level_off(y, 0.02 * y))["plateau"] - floor) / actual["plateau_error"]
    assert np.mean(np.abs(pulls.values[np.isfinite(pulls)]) <= 2.0) > 0.85  # binomial error of some 20: 5 %
    assert set(actual["conclusion"].str.contains("no plateau;|everywhere|not significant").values) == {True}


def test_what_does_not_level_off_says_so():
    bent = np.sqrt(2.0 - ((V - 14.0) / 6.0) ** 2), 1e-6, ("no plateau; at the end it falls by 17", np.inf)
    straight = [(np.sqrt(1.0 + slope * (V - 14.0)), 0.05, ("falls by less", -np.inf)) for slope in (0.1, -0.01)]
    for y, fall, expected in (bent, *straight):
        actual = level_off(y, 1e-6 * y, fall).isel(model=0)
        words, limit, error = (actual[name].item() for name in ("conclusion", "limit", "plateau_error"))
        assert (words[: len(expected[0])], limit, np.isnan(error)) == (*expected, True)  # a rise ends at any height
    actual = level_off(law(V), np.where(V < 15.0, 0.004, np.nan)).isel(model=0)  # too few errors
    assert np.isnan(actual[["plateau_error", "limit_error", "rate_error"]].to_array()).all()
    assert actual["conclusion"].item().endswith("whether the levelling off is significant is not known")
