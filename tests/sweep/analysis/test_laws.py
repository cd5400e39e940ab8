"""Fits, ratios and crossings of datasets: against closed forms and the plain functions, and the commands."""

import contextlib
import json

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from linksweep.sweep.analysis.fits import power_law
from linksweep.sweep.analysis.laws import (
    ALWAYS,
    FROM,
    LEFT_OUT,
    NEVER,
    SEVERAL,
    UP_TO,
    Limit,
    find,
    fit_levelling,
    fit_power_law,
    interpolate,
    parse_limit,
    parse_range,
    ratio,
)
from linksweep.sweep.analysis.quantity import between, main_quantity, quantities, select, standard_error
from linksweep.sweep.cli import main
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.result import Result
from linksweep.sweep.running.run import run_study
from linksweep.sweep.studies.reader import study_from_dict

N = np.array([10.0, 20.0, 50.0, 100.0, 300.0])
V = np.arange(14.0, 20.1, 0.5)


def grid(value, error=None, x=N, name="n", unit="", status=None, **more):
    """A dataset as a run leaves it: ``width`` in mas over model x one axis of numbers."""
    axes = ("model", name)
    value = np.broadcast_to(value, (2, len(x))).astype(float)
    variables = {
        "width": (axes, value, {"units": "mas", "headline": 1}),
        "status": (axes, np.full(value.shape, Status.DONE, np.int8) if status is None else status),
    }
    if error is not None:
        variables["width_mc_error"] = (axes, np.broadcast_to(error, value.shape).astype(float), {"units": "mas"})
    coordinates = {"model": np.array(["old", "new"], dtype=object), name: (name, x, {"units": unit})}
    return xr.Dataset(variables, coordinates, {"title": "Widths"}).assign(more)


# What is fitted


def test_the_quantities_of_a_link_are_its_results_without_what_stands_beside_them(dataset_of):
    dataset = dataset_of("quasars")
    assert set(quantities(dataset)) >= {"sigma", "sigma_spin", "sigma_orientation", "bias", "chi2", "n_obj"}
    assert not any(name.endswith(("error", "predicted", "published", "rounding")) for name in quantities(dataset))
    assert main_quantity(dataset) == "sigma_spin"


def test_the_error_of_a_quantity_is_the_sum_of_squares(dataset_of):
    one = dataset_of("quasars").isel(model=0, v_max=0)
    expected = np.hypot(one["sigma_spin_mc_error"], one["sigma_spin_catalogue_error"])
    assert standard_error(one, "sigma_spin").item() == pytest.approx(expected.item(), rel=1e-12)
    assert standard_error(one, "chi2") is None


# Power laws


@pytest.mark.slow
def test_the_expected_exponent_of_a_claim_is_that_of_its_lines_only(dataset_of):
    result = fit_power_law(dataset_of("mission-length"), "sigma_spin", "mission_length")
    stated = result["expected"].sel(model="gaia", n_obj=90).item()
    assert stated == -1.5
    assert np.isfinite(result["expected"]).sum() == 1


def test_a_covariance_in_the_dataset_is_honoured():
    error = 0.02 * N**-0.5
    covariance = np.outer(error, error) * (0.8 + 0.2 * np.eye(5))
    shared = grid(N**-0.5, error, width_mc_covariance_n=(("n", "n_other"), covariance))
    law = power_law(N, N**-0.5, covariance)
    for dataset, argument in ((shared, None), (grid(N**-0.5, error), shared["width_mc_covariance_n"])):
        result = fit_power_law(dataset, "width", "n", covariance=argument)
        assert result["exponent_error"].values == pytest.approx(law.exponent_error, rel=1e-12)
        assert result.attrs["errors"] == "covariance between points"
    turned = shared.isel(n=[2, 0, 1, 4, 3], n_other=[2, 0, 1, 4, 3])
    assert fit_power_law(turned, "width", "n")["chi2"].values == pytest.approx(0.0, abs=1e-12)
    assert fit_power_law(turned, "width", "n")["exponent_error"].values == pytest.approx(law.exponent_error, rel=1e-12)


def test_a_part_of_points_that_move_together_keeps_their_covariance():
    error = 0.02 * N**-0.5
    covariance = np.outer(error, error) * (0.8 + 0.2 * np.eye(5))
    shared = grid(N**-0.5, error, width_mc_covariance_n=(("n", "n_other"), covariance))
    law = power_law(N[1:], N[1:] ** -0.5, covariance[1:, 1:])
    result = fit_power_law(between(shared, "n", 20.0, 1e9), "width", "n")
    assert result["exponent_error"].values == pytest.approx(law.exponent_error, rel=1e-12)
    assert quantities(select(shared, {"n": 20.0})) == ["width"]


def test_common_random_numbers_without_a_covariance_have_no_error():
    shared = {"common_random_numbers": 1, "shared_axes": '["n"]', "error_convention": 2}
    dataset = grid(N**-0.5, 0.01 * N**-0.5).assign_attrs(shared)
    result = fit_power_law(dataset, "width", "n", expected=-0.5)
    assert result["exponent"].values == pytest.approx(-0.5)
    for name in ("exponent_error", "amplitude_error", "chi2", "p_value", "deviation"):
        assert np.isnan(result[name].values).all(), name
    assert "not known, as points share random numbers" in result.attrs["errors"]
    assert np.isnan(ratio(dataset, "width", "n", 10.0, 20.0)["ratio_error"]).all()
    # Points that differ in what is not shared are independent.
    assert (ratio(dataset, "width", "model", "old", "new")["ratio_error"] > 0.0).all()


def test_a_covariance_that_has_no_inverse_names_the_line():
    dataset = grid(N**-0.5, width_mc_covariance_n=(("model", "n", "n_other"), np.stack([np.eye(5), np.ones((5, 5))])))
    with pytest.raises(SweepError, match="not positive definite: width over n at model=new"):
        fit_power_law(dataset, "width", "n")


def test_excluded_points_do_not_belong_to_a_line():
    status = np.array(
        [[Status.DONE, Status.DONE, Status.DONE, Status.DONE, Status.EXCLUDED], [Status.EXCLUDED] * 5], dtype=np.int8
    )
    value = np.where(status == Status.DONE, N**-0.5, np.nan)
    result = fit_power_law(grid(value, 0.1, status=status), "width", "n", expected=-0.5)
    assert result["points"].values.tolist() == [4.0, 0.0]
    assert result["exponent"].values[0] == pytest.approx(-0.5)
    assert np.isnan(result["exponent"].values[1])
    assert [json.loads(Result(result).written("json"))["rows"][i]["conclusion"] for i in (0, 1)] == [
        "as expected",
        "excluded by the study",
    ]


# Levelling


def test_levelling_needs_a_fraction_and_four_points():
    with pytest.raises(SweepError, match="fall = 5: must be above 0 and below 1"):
        fit_levelling(grid(1.0 / N), "width", "n", fall=5.0)
    with pytest.raises(SweepError, match="at least 4 points are needed along n; there are 3 at model=old"):
        fit_levelling(grid(1.0 / N).isel(n=[0, 1, 2]), "width", "n")


# Ratios and interpolation


def test_interpolation_is_exact_for_exponentials_of_a_magnitude():
    result = interpolate(grid(np.exp(-0.3 * V), x=V, name="v", unit="mag"), "width", "v", 17.2)
    assert result["width"].values == pytest.approx(np.exp(-0.3 * 17.2), rel=1e-12)


def test_interpolation_at_a_point_has_its_error_and_between_two_less():
    dataset = grid(np.ones(5), 0.1)
    assert interpolate(dataset, "width", "n", 50.0)["width_mc_error"].values == pytest.approx(0.1)
    assert interpolate(dataset, "width", "n", np.sqrt(1000.0))["width_mc_error"].values == pytest.approx(
        0.1 / np.sqrt(2)
    )
    with pytest.raises(SweepError, match="n = 301 is beyond the points, which go from 10 to 300"):
        interpolate(dataset, "width", "n", 301.0)
    with pytest.raises(SweepError, match="n = '30': must be a number, in the unit of the axis"):
        interpolate(dataset, "width", "n", "30")


def test_truth_values_and_integers_have_crossings_and_values_between():
    dataset = grid(N)
    dataset["flag"] = dataset["width"] > 60.0
    dataset["count"] = dataset["width"].astype(np.int64)
    dataset.attrs["function"] = 1
    for condition, crossing in [("flag > 0.5", np.sqrt(50.0 * 100.0)), ("count > 60", 60.0)]:
        found = find(dataset, condition, over="n")
        assert found["first"].values == pytest.approx(crossing)
        assert np.isnan(found["first_error"].values).all()  # there is none, and none is made of the type
    between = interpolate(dataset, "count", "n", 100.0)
    assert between["count"].values == pytest.approx(100.0)
    assert np.isnan(between["count_mc_error"].values).all()
    assert ratio(dataset, "flag", "n", of=100.0, to=300.0)["ratio"].values == pytest.approx(1.0)


def test_what_has_no_numbers_says_what_it_has():
    dataset = grid(N).drop_vars("width").assign(name=(("model", "n"), np.full((2, 5), "a", dtype=object)))
    dataset["when"] = (("model", "n"), np.full((2, 5), np.datetime64("2020-01-01", "ns")))
    for variable in ("name", "when"):
        with pytest.raises(SweepError, match=f"{variable} has no numbers to draw or to fit"):
            find(dataset, f"{variable} < 3", over="n")
    with pytest.raises(SweepError, match="no quantity 'heads'; there are none"):
        find(dataset, "heads < 3", over="n")


# Crossings


@pytest.mark.parametrize(
    ("sign", "threshold", "met", "nearest"),
    [
        ("<", 0.05, NEVER, 300.0**-0.5),
        ("<", 0.5, ALWAYS, 10.0**-0.5),
        (">", 0.5, NEVER, 10.0**-0.5),
        (">=", 0.05, ALWAYS, 300.0**-0.5),
        ("<", -1.0, NEVER, 300.0**-0.5),
    ],
)
def test_what_is_never_or_always_met_names_the_nearest(sign, threshold, met, nearest):
    result = find(grid(N**-0.5, 0.01), Limit("width", sign, threshold), "n")
    assert result["met"].values.tolist() == [met, met]
    assert result["nearest"].values == pytest.approx(nearest)
    assert np.all(np.isnan(result["first"]))


def test_up_to_several_times_and_a_value_on_the_limit():
    assert find(grid(N**-0.5), Limit("width", ">", 0.1), "n")["met"].values.tolist() == [UP_TO, UP_TO]
    assert find(grid(N**-0.5), Limit("width", ">", 0.1), "n")["first"].values == pytest.approx(100.0)
    waves = find(grid([1.0, 3.0, 1.0, 3.0, 1.0]), Limit("width", "<", 2.0), "n")
    assert waves["met"].values.tolist() == [SEVERAL, SEVERAL]
    assert waves["crossings"].values.tolist() == [4.0, 4.0]
    assert np.all(waves["first"] < waves["last"])
    through_zero = find(grid([-2.0, -1.0, 1.0, 2.0, 3.0], x=np.arange(5.0)), Limit("width", ">", 0.0), "n")
    assert through_zero["first"].values == pytest.approx(1.5)


def test_units_are_converted_and_lines_of_another_kind_left_out(dataset_of):
    dataset = dataset_of("quasars")
    in_uas = find(dataset, parse_limit("sigma_spin < 0.9 uas/yr"), "v_max")
    in_mas = find(dataset, parse_limit("sigma_spin < 0.0009"), "v_max")
    assert in_uas["first"].values == pytest.approx(in_mas["first"].values, rel=1e-12, nan_ok=True)
    assert in_uas["met"].values.tolist() == [NEVER, FROM]
    assert 15.0 < in_uas["first"].sel(model="gaia").item() < 17.0
    each = find(dataset, parse_limit("sigma < 1 uas/yr"), "v_max")
    assert np.all(each["met"].sel(component=["epsilon_x", "epsilon_y"]) == LEFT_OUT)
    with pytest.raises(SweepError, match="sigma_spin is in mas / yr, not convertible to mag"):
        find(dataset, parse_limit("sigma_spin < 1 mag"), "v_max")


@pytest.mark.parametrize(
    ("text", "limit"),
    [
        ("sigma<0.001", Limit("sigma", "<", 0.001)),
        (" sigma_spin  >=  1e-3 mas / yr ", Limit("sigma_spin", ">=", 1e-3, "mas / yr")),
        ("share > -.5", Limit("share", ">", -0.5)),
        ("chi2 <= +2", Limit("chi2", "<=", 2.0)),
    ],
)
def test_conditions(text, limit):
    assert parse_limit(text) == limit


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sigma < inf", "a condition is VARIABLE"),
        ("sigma < 1e999", "a finite number"),
        ("sigma < 1 nonsense", "'nonsense' is not a unit that astropy knows"),
        ("sigma < 1.2.3", "'sigma < 1.2.3': a condition is VARIABLE"),
        ("__import__('os') < 1", "a condition is VARIABLE"),
    ],
)
def test_what_is_wrong_with_a_condition_is_told(text, message):
    with pytest.raises(SweepError, match=message):
        parse_limit(text)


@given(st.text(max_size=40))
def test_any_text_is_a_condition_or_a_clear_error(text):
    for parse in (parse_limit, parse_range):
        with contextlib.suppress(SweepError):  # any other exception fails
            parse(text)


def test_ranges():
    assert parse_range("50:") == (50.0, np.inf)
    assert parse_range(":3e2") == (-np.inf, 300.0)
    assert between(grid(N), "n", 20.0, 100.0)["n"].values.tolist() == [20.0, 50.0, 100.0]
    with pytest.raises(SweepError, match="n has no value from 1 to 2; it goes from 10 to 300"):
        between(grid(N), "n", 1.0, 2.0)


def test_selecting_names_everything_that_is_wrong():
    dataset = grid(N).assign_coords(square=("n", N**2))
    assert select(dataset, {"n": "20", "model": "new"})["square"].item() == 400.0
    with pytest.raises(SweepError) as caught:
        select(dataset, {"model": "gone", "depth": 3, "n": "eleven"})
    assert caught.value.problems == [
        "model = gone is not in the grid, which has old, new",
        "'depth' is not an axis; known are model, n, square",
        "n = eleven is not in the grid, which has 10.0, 20.0, 50.0, 100.0, 300.0",
    ]
    with pytest.raises(SweepError, match="square = 100 is at no point with the other values that are given along n"):
        select(dataset, {"n": "20", "square": "100"})


# What cannot be analysed

BAD_STATUS = np.full((2, 5), Status.DONE, np.int8)
BAD_STATUS[0, :3] = Status.MISSING, Status.FAILED, Status.FAILED


@pytest.mark.parametrize(
    ("dataset", "variable", "over", "message"),
    [
        (grid(N), "height", "n", "no quantity 'height'; known are width"),
        (grid(N), "widht", "n", "no quantity 'widht'; did you mean 'width'"),
        (grid(N), "status", "n", "no quantity 'status'"),
        (grid(N), "width", "model", "'model' is no axis with several numbers of width; there are n"),
        (grid(N), "width", "m", "'m' is no axis with several numbers of width; there are n"),
        (grid(N[:1], x=N[:1]), "width", "n", "'n' is no axis with several numbers of width; there are none"),
        (grid(-N), "width", "n", "width must be above 0; it is -10 at model=old, n=10"),
        (grid(0.0 * N), "width", "n", "width must be above 0; it is 0 at model=old, n=10"),
        (grid(N, x=N - 10.0), "width", "n", "a power law needs n above 0; there is 0"),
        (grid([1.0, np.nan, 1.0, 1.0, 1.0]), "width", "n", "width is not a finite number at model=old, n=20"),
        (grid(N, status=BAD_STATUS), "width", "n", "is incomplete: 1 missing and 2 failed of 10 points here"),
        (grid(N, status=np.full((2, 5), Status.EXCLUDED)), "width", "n", "every point is excluded by the study"),
    ],
)
def test_what_cannot_be_fitted(dataset, variable, over, message):
    with pytest.raises(SweepError, match=message):
        fit_power_law(dataset, variable, over)


# The commands


def invoke(*arguments):
    done = CliRunner().invoke(main, [*map(str, arguments)])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done


@pytest.fixture
def coin_store(coins, tmp_path):
    run_study(study_from_dict(coins), tmp_path / "coins.zarr", Resources(pool="serial"))
    return tmp_path / "coins.zarr"


def test_fit_prints_exponent_expectation_and_law(store_of):
    done = invoke("fit", store_of("sqrt-n"))
    assert done.exit_code == 0
    assert "as expected" in done.stdout
    law = "sigma_spin = amplitude x (n_obj / pivot)^exponent; errors: Monte Carlo, independent points"
    assert law in " ".join(done.stdout.split())
    (row,) = json.loads(invoke("fit", store_of("sqrt-n"), "--json").stdout)["rows"]
    assert row["expected"] == -0.5
    assert row["conclusion"] == "as expected"
    (row,) = json.loads(invoke("fit", store_of("sqrt-n"), "--expect", "-1", "--range", "100:", "--json").stdout)["rows"]
    assert row["conclusion"] == "NOT as expected"
    assert row["points"] == 6.0


def test_fit_levelling_says_where(store_of):
    done = invoke("fit", store_of("quasars"), "--law", "levelling")
    assert "falls by less from 15" in done.stdout
    found = json.loads(invoke("fit", store_of("quasars"), "--law", "levelling", "--fall", "1", "--json").stdout)
    assert found["fall"] == 0.01
    assert [row["model"] for row in found["rows"]] == ["amex", "gaia"]


def test_find_says_from_where(store_of):
    done = invoke("find", store_of("quasars"), "--where", "sigma_spin < 1 uas/yr", "--over", "v_max")
    assert "gaia   from 15." in done.stdout or "gaia   from 16." in done.stdout
    assert "amex   never; 0.5" in done.stdout
    found = json.loads(invoke("find", store_of("quasars"), "--where", "sigma_spin < 0.6", "--json").stdout)
    assert found["condition"] == "sigma_spin < 0.6"
    assert found["rows"][1]["first"] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit", "STORE", "--over", "metal"], "'metal' is no axis with several numbers of share; there are coins"),
        (["fit", "STORE", "--variable", "heads"], "no quantity 'heads'; known are share"),
        (["fit", "STORE", "--law", "levelling"], "at least 4 points are needed along coins; there are 3"),
        (["fit", "STORE", "--law", "levelling", "--expect", "1"], "--expect is an exponent and goes with --law power"),
        (["fit", "STORE", "--fall", "1"], "--fall goes with --law levelling"),
        (["fit", "STORE", "--range", "3"], "--range: '3': a range is LOW:HIGH"),
        (["fit", "STORE", "--at", "coins=1"], "share has no axis with several numbers"),
        (["fit", "STORE", "--at", "coins"], "--at: 'coins': a place is AXIS=VALUE"),
        (["find", "STORE", "--where", "share = 1"], "--where: 'share = 1': a condition is VARIABLE, one of < <= > >="),
        (["find", "STORE", "--where", "heads < 1"], "no quantity 'heads'; known are share"),
        (["find", "STORE", "--where", "share < 1 mas"], "share is in no unit, not convertible to mas"),
        (["find", "nothing.zarr", "--where", "share < 1"], "nothing.zarr: no store there"),
    ],
)
def test_bad_input_is_one_message(coin_store, arguments, message):
    done = invoke(*(coin_store if a == "STORE" else a for a in arguments))
    assert done.exit_code == 2
    assert message in done.stderr
    assert done.stdout == ""
