"""Computed against published: verdicts, allowances, claims and the command."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner

from linksweep.sweep.analysis.compare import (
    all_is_well,
    as_json,
    compare,
    notes,
    records,
    remarks,
    summary,
    summary_line,
)
from linksweep.sweep.analysis.quantity import claims_of
from linksweep.sweep.cli import main
from linksweep.sweep.cli.look import is_finished, paper_studies
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.running.run import run_study
from linksweep.sweep.stores.location import located
from linksweep.sweep.studies.document import built_in_studies
from linksweep.sweep.studies.reader import load_study, study_from_dict
from linksweep.sweep.studies.study import printed_rounding
from tests.conftest import COINS

ROOT = Path(__file__).parents[3]
SERIAL = Resources(pool="serial")
N = np.array([10.0, 20.0, 50.0, 100.0, 300.0])


def grid(value, error=None, published=None, status=None, claims=(), catalogue_error=None, **attributes):
    """A dataset as a run leaves it: ``width`` over model x n.  ``published`` is {(model, n): text}."""
    value = np.broadcast_to(value, (2, len(N))).astype(float)
    axes = ("model", "n")
    variables = {
        "width": (axes, value, {"units": "mas"}),
        "status": (axes, np.full(value.shape, Status.DONE, np.int8) if status is None else status),
    }
    for suffix, extra in (("mc_error", error), ("catalogue_error", catalogue_error)):
        if extra is not None:
            variables[f"width_{suffix}"] = (axes, np.broadcast_to(extra, value.shape).astype(float), {"units": "mas"})
    if published is not None:
        numbers, roundings = np.full(value.shape, np.nan), np.full(value.shape, np.nan)
        for place, text in published.items():
            numbers[place], roundings[place] = float(text), printed_rounding(text)
        variables["width_published"] = (axes, numbers, {"units": "mas", "source": "A paper", **attributes})
        variables["width_published_rounding"] = (axes, roundings, {"units": "mas"})
    coordinates = {"model": np.array(["old", "new"], dtype=object), "n": N}
    return xr.Dataset(variables, coordinates, {"study_name": "made-up", "claims": json.dumps(list(claims))})


def claim(**keys):
    return {"text": "A statement", "source": "Sect. 1", "published": "1.0"} | keys


def only(dataset):
    (comparison,) = compare(dataset)
    return comparison


# Rounding


@pytest.mark.parametrize(
    ("text", "half_a_unit"),
    [
        *(("0.60", 0.005), ("0.6", 0.05), ("0.00094", 0.000005), ("28", 0.5), ("1200", 0.5), ("-0.5", 0.05)),
        *(("4e2", 50.0), ("1.50e-3", 0.000005), (" 0.60", 0.005), ("0", 0.5), ("1e-320", 5e-321)),
    ],
)
def test_rounding_is_half_a_unit_of_the_last_printed_digit(text, half_a_unit):
    assert printed_rounding(text) == half_a_unit


# Verdicts of published numbers

VALUES = {  # value, error, published -> verdict
    "within rounding": (0.604, 0.0, "0.60", "reproduced"),
    "at the edge of rounding": (0.605, 0.0, "0.60", "reproduced"),  # 0.605 - 0.6 > 0.005 in binary
    "beyond rounding": (0.606, 0.0, "0.60", "NOT reproduced"),
    "fewer digits allow more": (0.606, 0.0, "0.6", "reproduced"),
    "within three errors more": (0.6349, 0.01, "0.60", "reproduced"),
    "beyond three errors more": (0.6351, 0.01, "0.60", "NOT reproduced"),
    "below": (0.5649, 0.01, "0.60", "NOT reproduced"),
    "negative": (-0.604, 0.0, "-0.60", "reproduced"),
    "not a number": (np.nan, 0.0, "0.60", "NOT reproduced"),
}


@pytest.mark.parametrize("case", VALUES)
def test_verdict(case):
    value, error, text, verdict = VALUES[case]
    comparison = only(grid(value, error, {(1, 2): text}))
    assert comparison.verdict == verdict
    assert (comparison.study, comparison.what, comparison.source, comparison.unit) == (
        *("made-up", "width", "A paper"),
        "mas",
    )
    assert comparison.where == {"model": "new", "n": 50.0}
    assert comparison.published == float(text)
    assert comparison.allowance == pytest.approx(printed_rounding(text) + 3 * error)
    assert comparison.difference == pytest.approx(value - float(text), nan_ok=True)


@pytest.mark.parametrize(
    ("value", "verdict"),
    [(0.604, "reproduced"), (0.64, "within tolerance"), (0.648, "NOT reproduced"), (0.56, "within tolerance")],
)
def test_a_tolerance_comes_on_top_of_the_allowance_and_gives_its_reason(value, verdict):
    dataset = grid(value, None, {(0, 0): "0.60"}, tolerance=0.07, tolerance_reason="curves by eye")
    comparison = only(dataset)
    assert comparison.verdict == verdict  # allowed are 0.005, and 0.042 more
    assert comparison.reason == ("7 %: curves by eye" if verdict == "within tolerance" else "")


@pytest.mark.parametrize(
    ("value", "verdict"), [(28.0, "reproduced"), (28.4, "NOT reproduced"), (29.0, "NOT reproduced")]
)
def test_a_count_must_be_equal_whatever_the_tolerance(value, verdict):
    comparison = only(grid(value, None, {(0, 0): "28"}, tolerance=0.5, tolerance_reason="none for counts"))
    assert (comparison.verdict, comparison.allowance) == (verdict, 0.0)


def test_the_catalogue_error_adds_in_quadrature():
    comparison = only(grid(0.6, 0.003, {(0, 0): "0.60"}, catalogue_error=0.004))
    assert comparison.mc_error == pytest.approx(0.005)
    assert comparison.allowance == pytest.approx(0.02)
    unknown = only(grid(0.6, 0.003, {(0, 0): "0.60"}, catalogue_error=np.nan))  # one catalogue
    assert unknown.mc_error == pytest.approx(0.003)


@pytest.mark.parametrize(
    ("code", "reason"),
    [(Status.MISSING, "not done yet"), (Status.FAILED, "failed"), (Status.EXCLUDED, "excluded by the study")],
)
def test_a_point_that_is_not_done_is_incomplete_and_not_left_out(code, reason):
    status = np.full((2, len(N)), Status.DONE, np.int8)
    status[0, 1] = code
    value = np.where(status == Status.DONE, 0.6, np.nan)
    found = compare(grid(value, 0.001, {(0, 0): "0.60", (0, 1): "0.60", (1, 1): "0.7"}, status))
    assert [c.verdict for c in found] == ["reproduced", "incomplete", "NOT reproduced"]
    assert reason in found[1].reason
    assert np.isnan(found[1].value)
    assert not all_is_well(found[:2])
    counts = {"reproduced": 1, "within tolerance": 0, "NOT reproduced": 1, "not comparable": 0, "incomplete": 1}
    assert summary(found) == counts


# Slopes (the fit itself: test_fits.py)


LAW = {"variable": "width", "over": "n"}


def test_a_claim_of_a_law_for_each_model():
    claims = [claim(published="-0.5", exact=True, slope=LAW)]
    value = np.array([2.0 * N**-0.5, 3.0 * N**-0.7])
    found = compare(grid(value, 0.01 * value, claims=claims))
    assert [dict(c.where) for c in found] == [{"model": "old"}, {"model": "new"}]
    assert [c.verdict for c in found] == ["reproduced", "NOT reproduced"]
    assert [c.value for c in found] == pytest.approx([-0.5, -0.7])
    assert found[0].rounding == 0.0
    assert found[0].mc_error == pytest.approx(0.01 / np.sqrt(np.sum((np.log(N) - np.log(N).mean()) ** 2)))
    assert found[0].allowance == 3 * found[0].mc_error
    assert (found[0].quantity, found[0].unit) == ("slope of width over n", "")


def test_where_chooses_the_line_and_a_tolerance_may_be_needed():
    value = np.array([2.0 * N**-0.5, 3.0 * N**-0.52])
    keys = {"tolerance": 0.05, "tolerance_reason": "not quite normal", "where": {"model": "new"}}
    comparison = only(grid(value, 0.0, claims=[claim(published="-0.50", slope=LAW, **keys)]))
    assert comparison.where == {"model": "new"}
    assert comparison.verdict == "within tolerance"
    assert comparison.reason == "5 %: not quite normal"


def test_a_slope_over_points_that_are_not_all_done_is_incomplete():
    status = np.full((2, len(N)), Status.DONE, np.int8)
    status[1, 3:] = Status.MISSING, Status.FAILED
    value = np.where(status == Status.DONE, N**-0.5, np.nan)
    found = compare(grid(value, claims=[claim(published="-0.5", slope=LAW)], status=status))
    assert [c.verdict for c in found] == ["reproduced", "incomplete"]
    assert found[1].reason == "failed: 2 of 5 points"


def test_excluded_points_do_not_belong_to_a_line():
    status = np.full((2, len(N)), Status.DONE, np.int8)
    status[0, 0], status[1, 1:] = Status.EXCLUDED, Status.EXCLUDED
    value = np.where(status == Status.DONE, N**-0.5, np.nan)
    found = compare(grid(value, claims=[claim(published="-0.5", slope=LAW)], status=status))
    assert [c.verdict for c in found] == ["reproduced", "incomplete"]
    assert "needs two values of n; this grid has 1" in found[1].reason


def test_values_that_have_no_power_law_are_not_reproduced():
    value = np.where(N == 50.0, 0.0, 1.0)
    comparison = compare(grid(value, claims=[claim(slope=LAW)]))[0]
    assert comparison.verdict == "NOT reproduced"
    assert "no power law" in comparison.reason


# Ratios and values


def ratio(top, bottom):
    return {"variable": "width", "of": top, "to": bottom}


def test_a_ratio_for_every_value_of_the_other_axes():
    value = np.array([6.0 * N, 2.0 * N])
    found = compare(grid(value, claims=[claim(published="3", ratio=ratio({"model": "old"}, {"model": "new"}))]))
    assert [c.where for c in found] == [{"n": n} for n in N]
    assert {c.verdict for c in found} == {"reproduced"}


def test_a_ratio_of_points_that_are_not_done_or_not_finite():
    status = np.full((2, len(N)), Status.DONE, np.int8)
    status[1, 0] = Status.MISSING
    value = np.array([[1.0] * 5, [np.nan, 0.0, 1.0, 1.0, 1.0]])
    claims = [claim(published="1.0", ratio=ratio({"model": "old"}, {"model": "new"}))]
    found = compare(grid(value, 0.0, claims=claims, status=status))
    assert [c.verdict for c in found][:3] == ["incomplete", "NOT reproduced", "reproduced"]
    assert found[1].reason == "the ratio is not a finite number"


def test_a_component_of_a_result():
    dataset = grid(1.0, claims=[claim(published="2", value={"variable": "shift", "component": "y", "at": {"n": 50.0}})])
    axes, numbers = (*("model", "n"), "component"), np.broadcast_to([1.0, 2.0], (2, len(N), 2))
    dataset = dataset.assign_coords(component=["x", "y"], component_unit=("component", ["m", "s"]))
    dataset["shift"] = (axes, numbers)
    dataset["shift_mc_error"] = (axes, 0.1 * numbers)
    found = compare(dataset)
    assert [c.where for c in found] == [{"model": "old", "n": 50.0}, {"model": "new", "n": 50.0}]
    assert {(c.value, c.mc_error, c.unit, c.quantity) for c in found} == {(2.0, 0.2, "s", "shift[y]")}


def test_a_ratio_along_zipped_axes():
    dataset = grid(np.array([N, N]), claims=[claim(published="5", ratio=ratio({"size": 3.0}, {"size": 1.0}))])
    dataset = dataset.assign_coords(size=("n", np.arange(1.0, 6.0)))
    found = compare(dataset)
    assert [c.where for c in found] == [{"model": "old"}, {"model": "new"}]
    assert [c.value for c in found] == [5.0, 5.0]


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        ({"slope": LAW | {"over": "m"}}, "m is not an axis of this store"),
        ({"slope": LAW, "where": {"model": "newest"}}, "model = newest is not in the grid, which has old, new"),
        ({"slope": LAW, "where": {"colour": "red"}}, "'colour' is not an axis; known are model, n"),
        ({"slope": LAW | {"variable": "depth"}}, "depth is not a result of this store"),
    ],
)
def test_a_claim_about_another_grid_is_incomplete_and_says_why(keys, reason):
    comparison = only(grid(1.0, claims=[claim(**keys)]))
    assert (comparison.verdict, comparison.reason) == ("incomplete", reason)


@pytest.mark.parametrize("claims", ["[", "3", '[{"text": 3}]', "[3]"])
def test_claims_that_cannot_be_read_are_an_error(claims):
    with pytest.raises(SweepError, match="'claims' cannot be read"):
        claims_of(grid(1.0).assign_attrs(claims=claims))


# Tables


def test_the_tables_hold_the_same_numbers():
    status = np.full((2, len(N)), Status.DONE, np.int8)
    status[0, 1] = Status.MISSING
    value = np.where(status == Status.DONE, 0.6, np.nan)
    keys = {"tolerance": 0.1, "tolerance_reason": "by eye"}
    found = compare(grid(value, 0.001, {(0, 0): "0.60", (0, 1): "0.60", (1, 1): "0.55", (1, 2): "0.4"}, status, **keys))
    rows = list(csv.DictReader(records(found).csv().splitlines()))
    assert [row["verdict"] for row in rows] == ["reproduced", "incomplete", "within tolerance", "NOT reproduced"]
    assert (rows[1]["value"], rows[2]["reason"], rows[2]["where"]) == ("", "10 %: by eye", "model=new, n=20")
    document = json.loads(as_json(found, ["a remark"]))
    assert [c["value"] for c in document["comparisons"]] == [0.6, None, 0.6, 0.6]
    assert document["comparisons"][2]["where"] == {"model": "new", "n": 20.0}
    assert document["summary"]["not_reproduced"] == 1
    assert document["remarks"] == ["a remark"]
    assert summary_line(found) == "1 reproduced, 1 within tolerance, 1 not reproduced, 1 incomplete"
    assert "made-up: width: A paper" in notes(found)


# Power


def about(published, value, error, **keys):
    reading = {"variable": "width", "at": {"model": "old", "n": 50.0}}
    return only(grid(value, error, claims=[claim(published=published, value=reading, **keys)]))


def test_a_tolerance_that_a_wrong_program_passes_gives_no_verdict():
    wide = {"tolerance": 0.9, "tolerance_reason": "not printed"}
    comparison = about("5e2", 90.6, 0.5, **wide)
    assert comparison.verdict == "not comparable"
    assert "let pass a deviation of 500, more than 167" in comparison.reason
    assert comparison.power == pytest.approx((50.0 + 450.0 + 4.6449 * 0.5) / 500.0)
    assert about("5e2", 5.0, 0.5, tolerance=0.5, tolerance_reason="not printed").verdict == "NOT reproduced"


def test_an_effect_must_be_told_from_none():
    assert about("1.1", 1.018, 0.011).verdict == "reproduced"  # what is claimed is the tenth, not the one
    assert about("1.1", 1.018, 0.011, null=1.0).verdict == "incomplete"
    assert about("1.1", 1.018, 0.005, null=1.0).verdict == "NOT reproduced"
    assert about("1.1", 1.09, 0.005, null=1.0).verdict == "reproduced"
    assert about("1.1", 1.09, 0.005, null=1.06).verdict == "not comparable"


def test_too_large_errors_ask_for_more_realisations():
    comparison = about("0.60", 0.6, 0.1)
    assert comparison.verdict == "incomplete"
    assert "more realisations or catalogues are needed" in comparison.reason
    assert about("0.60", 0.6, 0.04).verdict == "reproduced"


def test_a_claim_may_say_why_it_is_not_comparable():
    comparison = about("5e2", 90.6, 0.5, not_comparable="the paper does not say of how many")
    assert (comparison.verdict, comparison.reason) == ("not comparable", "the paper does not say of how many")
    assert np.isnan(comparison.power)
    assert all_is_well([comparison])
    assert summary_line([comparison]) == "0 reproduced, 0 within tolerance, 0 not reproduced, 1 not comparable"


def test_the_power_is_the_deviation_that_is_found_in_nineteen_of_twenty():
    rng, error = np.random.default_rng(3), 0.01
    power = about("0.60", 0.6, error, tolerance=0.05, tolerance_reason="an example").power
    allowed = 0.005 + 0.03 + 3 * error
    found = abs(0.6 * power + error * rng.standard_normal(100_000)) > allowed
    assert found.mean() == pytest.approx(0.95, abs=0.003)


def test_an_error_that_is_not_known_gives_no_verdict():
    comparison = only(grid(0.6, np.nan, {(0, 0): "0.60"}))
    assert comparison.verdict == "incomplete"
    assert "not known" in comparison.reason
    assert json.loads(as_json([comparison]))["comparisons"][0]["power"] is None


def test_an_unknown_part_of_the_error_is_told():
    dataset = grid(0.6, 0.003, {(0, 0): "0.60"}, catalogue_error=np.nan)
    assert remarks(dataset) == [
        "width: the choice of catalogues is not in the error, as 5 catalogues are needed to know it"
    ]


# From a study to its verdicts

HEADER = "metal,coins,share\n"


@pytest.fixture
def published_coins(coins, tmp_path, monkeypatch):
    """The coin study beside a published table and a claim; the paper's chance of heads is ours."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "table.csv").write_text(HEADER + "gold,1,0.4\ngold,5,0.40\ntin,20,0.9\ntin,7,0.4\n")
    same = {"variable": "share", "of": {"coins": 20}, "to": {"coins": 1}}
    return coins | {
        "published": {"file": "table.csv", "source": "Coins (1713)", "tolerance": 0.2, "tolerance_reason": "biased"},
        "claim": [claim(text="The share does not depend on the number", ratio=same, where={"metal": "tin"})],
    }


def test_the_store_carries_the_printed_digits_the_tolerance_and_the_claims(published_coins, tmp_path):
    study = study_from_dict(published_coins)
    run_study(study, tmp_path / "s.zarr", SERIAL)
    dataset = xr.open_zarr(tmp_path / "s.zarr").load()
    rounding = dataset["share_published_rounding"]
    assert rounding.sel(metal="gold", coins=1) == 0.05
    assert rounding.sel(metal="gold", coins=5) == 0.005
    assert np.isnan(rounding.sel(metal="tin", coins=1))
    assert rounding.attrs["long_name"] == "half a unit of the last printed digit of share_published"
    attributes = dataset["share_published"].attrs
    assert (attributes["tolerance"], attributes["tolerance_reason"]) == (0.2, "biased")
    assert claims_of(dataset) == list(study.claims)
    found = {tuple(c.where.values()): c.verdict for c in compare(dataset)}
    # The bias of a batch of coins, uniform in +-0.1, scatters the mean of 20 batches by 0.013.
    assert found[("gold", 1)] == "reproduced"
    assert found[("gold", 5)] in ("reproduced", "within tolerance")
    assert found[("tin", 20)] == "NOT reproduced"
    assert ("tin",) in found
    assert remarks(dataset) == ["share: published numbers that are not in this grid and not compared: 1"]


def test_a_claim_does_not_change_what_the_numbers_mean(published_coins, coins, tmp_path):
    with_claims, without = study_from_dict(published_coins), study_from_dict(coins)
    assert with_claims.digest() == without.digest()
    first, _ = run_study(without, tmp_path / "s.zarr", SERIAL)
    assert "claims" not in first.attrs
    run_study(with_claims, tmp_path / "s.zarr", SERIAL)  # the same store, which now carries them
    assert len(claims_of(xr.open_zarr(tmp_path / "s.zarr"))) == 1


def test_an_edited_source_reaches_a_store_that_is_there(published_coins, tmp_path):
    run_study(study_from_dict(published_coins), tmp_path / "s.zarr", SERIAL)
    published_coins["published"] = {"file": "table.csv", "source": "Coins (1714)"}
    run_study(study_from_dict(published_coins), tmp_path / "s.zarr", SERIAL)
    attributes = xr.open_zarr(tmp_path / "s.zarr")["share_published"].attrs
    assert attributes["source"] == "Coins (1714)"
    assert "tolerance" not in attributes


STUDY = f"""
title = "Coins"
experiment = '{COINS}'
[axes]
metal = ["gold", "tin"]
coins = [1, 5, 20]
[sampling]
n_sim = 1000
n_cat = 20
seed = 7
"""

CLAIM = """
[[claim]]
text = "Half of them"
source = "p. 3"
"""

GOOD = f'{STUDY}{CLAIM}published = "0.5"\n'
PLACE = 'value = { variable = "share", at = { coins = 5 } }'

BAD_CLAIMS = {  # the rest of the claim -> what is said
    "no quantity": ("", "claim.0 (line 12): needs exactly one of slope, ratio and value"),
    "unknown key": (
        f"{PLACE}\nnote = 3",
        "claim.0.note (line 17): unknown key; known are exact, not_comparable, null, published",
    ),
    "misspelt key inside": (
        'slope = { variable = "share", ower = "coins" }',
        "claim.0.slope.ower (line 16): unknown key; did you mean 'over'?",
        "claim.0.slope.over (line 16): is required",
    ),
    "unknown output": (
        'value = { variable = "shares" }',
        "claim.0.value.variable (line 16): 'shares' is no output; did you mean 'share'?",
    ),
    "axis fixed": (
        'slope = { variable = "share", over = "coins" }\nwhere = { coins = 5 }',
        "claim.0 (line 12): 'coins' cannot vary, because 'where' fixes coins",
    ),
    "value not on the axis": (
        'value = { variable = "share", at = { coins = 6 } }',
        "claim.0.value.at.coins (line 16): 6 is not on the axis, which has 1, 5, 20",
    ),
    "ratio of one place": (
        'ratio = { variable = "share", of = { coins = 5 }, to = { coins = 5 } }',
        "claim.0.ratio (line 16): 'of' and 'to' must give different values of the same axes",
    ),
    "place given twice": (
        f"{PLACE}\nwhere = {{ coins = 1 }}",
        "claim.0 (line 12): coins: is given by 'where' too; leave out one of the two",
    ),
    "tolerance without a reason": (
        f"{PLACE}\ntolerance = 0.1",
        "claim.0 (line 12): a tolerance needs a tolerance_reason, and the other way round",
    ),
}


@pytest.mark.parametrize("case", BAD_CLAIMS)
def test_bad_claim(tmp_path, case):
    text, *phrases = BAD_CLAIMS[case]
    (tmp_path / "study.toml").write_text(GOOD + text)
    with pytest.raises(SweepError) as refused:
        load_study(str(tmp_path / "study.toml"))
    assert sorted(refused.value.problems) == sorted(p for p in refused.value.problems if p.startswith(tuple(phrases)))
    assert len(refused.value.problems) == len(phrases)


@pytest.mark.parametrize("published", ['"about half"', '"nan"', '"inf"', '""', "0.5"])
def test_a_bad_published_number_of_a_claim(tmp_path, published):
    (tmp_path / "study.toml").write_text(f"{STUDY}{CLAIM}{PLACE}\npublished = {published}")
    with pytest.raises(SweepError, match=r"claim\.0\.published \(line 16\): .*(as printed|valid string)"):
        load_study(str(tmp_path / "study.toml"))


def test_all_problems_of_all_claims_at_once(tmp_path):
    other = 'published = "x"\nvalue = { variable = "shares", at = { coins = 6, metl = "tin" } }'
    (tmp_path / "study.toml").write_text(f"{GOOD}{CLAIM}{other}\n[published]\nfile = 'no.csv'\nsource = ''\n")
    with pytest.raises(SweepError) as refused:
        load_study(str(tmp_path / "study.toml"))
    assert {p.partition(" (")[0] for p in refused.value.problems} == {
        *("published.file", "claim.0", "claim.1.published", "claim.1.value.variable"),
        *("claim.1.value.at.coins", "claim.1.value.at.metl"),
    }


def test_a_slope_needs_two_positive_values_that_are_free_to_vary(coins):
    slope = claim(slope={"variable": "share", "over": "coins"})
    with pytest.raises(SweepError, match="'coins' needs at least two numbers"):
        study_from_dict(coins | {"axes": {"coins": [5]}, "claim": [slope]})
    zipped = {"axes": {"coins": [1, 5], "chance": [0.3, 0.6]}, "fixed": {}, "grid": {"zip": [["coins", "chance"]]}}
    with pytest.raises(SweepError, match="'coins' cannot vary, because 'where' fixes chance"):
        study_from_dict(coins | zipped | {"claim": [slope | {"where": {"chance": 0.3}}]})


def test_results_with_dimensions_need_a_component(link_study):
    def read(quantity):
        link_study.write_text(text + f"{CLAIM}published = '1'\nvalue = {{ {quantity} }}\n")
        return load_study(str(link_study))

    text = link_study.read_text()
    assert read('variable = "sigma", component = "omega_x"').claims[0].quantity().component == "omega_x"
    with pytest.raises(SweepError, match=r"component = None: must be one of epsilon_x, .*omega_z"):
        read('variable = "sigma"')
    with pytest.raises(SweepError, match=r"component = 'omega_q': must be one of epsilon_x, .*"):
        read('variable = "sigma", component = "omega_q"')
    with pytest.raises(SweepError, match="covariance has the dimensions component, component_other; at most one"):
        read('variable = "covariance", component = "omega_x"')


def test_a_tolerance_of_a_published_table_needs_its_reason(published_coins):
    del published_coins["published"]["tolerance_reason"]
    with pytest.raises(SweepError, match="a tolerance needs a tolerance_reason"):
        study_from_dict(published_coins)


def test_an_override_that_takes_a_claim_its_place_is_no_mistake_of_the_study(tmp_path):
    (tmp_path / "study.toml").write_text(GOOD + PLACE)
    path = str(tmp_path / "study.toml")
    for number, changes in enumerate(({"axes": ["coins=1,20"]}, {"settings": ["coins=7"]})):
        study = load_study(path, **changes)
        dataset, _ = run_study(study, tmp_path / f"{number}.zarr", SERIAL)
        assert {c.verdict for c in compare(dataset)} == {"incomplete"}


def test_a_row_of_a_fixed_parameter_is_found_however_its_number_is_written(coins, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "table.csv").write_text("chance,coins,share\n0.40,1,0.4\n.4,5,0.4\n0.5,20,0.4\n")
    document = coins | {"axes": {"coins": [1, 5, 20]}, "published": {"file": "table.csv", "source": "Coins"}}
    dataset, _ = run_study(study_from_dict(document), tmp_path / "s.zarr", SERIAL)
    assert dataset["share_published"].notnull().values.tolist() == [True, True, False]


# The command


@pytest.fixture
def coin_study(tmp_path):
    (tmp_path / "study.toml").write_text(f"{GOOD}tolerance = 0.2\ntolerance_reason = 'a coin'\n{PLACE}\n")
    return tmp_path / "study.toml"


def test_the_command_tells_by_its_exit_code(sweep, coin_study, tmp_path):
    sweep("run", coin_study, "-o", tmp_path / "good.zarr", cwd=tmp_path)
    sweep("run", coin_study, "-o", tmp_path / "poor.zarr", "--set", "chance=0.2", cwd=tmp_path)
    code, out, err = sweep("compare", tmp_path / "good.zarr")
    assert (code, err) == (0, "")
    assert "Half of them" in out
    assert "not reproduced" in out.splitlines()[-1]
    code, out, _ = sweep("compare", tmp_path / "good.zarr", tmp_path / "poor.zarr", "--json")
    document = json.loads(out)
    assert code == 1
    assert len(document["comparisons"]) == 4
    assert document["summary"]["not_reproduced"] == 2
    assert "--set chance=0.2" in document["remarks"][0]
    code, out, _ = sweep("compare", tmp_path / "good.zarr", "--format", "csv")
    assert len(list(csv.DictReader(out.splitlines()))) == 2


@pytest.mark.parametrize(
    ("arguments", "phrase"),
    [
        (("compare",), "name stores, or give --all"),
        (("compare", "s.zarr", "--all"), "name stores, or give --all"),
        (("compare", "s.zarr", "--workers", "2"), "go with --all"),
        (("compare", "s.zarr", "--results", "elsewhere"), "go with --all"),
        (("compare", "none.zarr"), "no store there"),
        (("compare", "s.zarr"), "neither published numbers nor claims"),
    ],
)
def test_bad_input_is_exit_code_2(coins, tmp_path, monkeypatch, arguments, phrase):
    monkeypatch.chdir(tmp_path)
    run_study(study_from_dict(coins), tmp_path / "s.zarr", SERIAL)
    outcome = CliRunner().invoke(main, arguments)
    assert (outcome.exit_code, outcome.stdout) == (2, "")
    assert phrase in outcome.stderr


def test_all_runs_what_is_missing_and_only_that(tmp_path, monkeypatch, coin_study):
    monkeypatch.setattr("linksweep.sweep.studies.document.built_in_studies", lambda: {str(coin_study): coin_study})
    [study], store = paper_studies(published=True), located(tmp_path / "study.zarr")
    assert not is_finished(study, store)
    run_study(study, store, SERIAL)
    assert is_finished(study, store)
    run_study(load_study(str(coin_study), axes=["coins=1,5,20,30"]), store, SERIAL)
    assert not is_finished(study, store)  # complete, but not what the study asks for
    coin_study.write_text(coin_study.read_text().replace("seed = 7", "seed = 8"))
    outcome = CliRunner().invoke(main, ["compare", "--all", "--results", str(tmp_path), "--pool", "serial"])
    assert outcome.exit_code == 2
    assert "a different study" in outcome.stderr


def test_the_whole_paper_from_one_command(tmp_path, monkeypatch, coin_study):
    monkeypatch.setattr("linksweep.sweep.studies.document.built_in_studies", lambda: {str(coin_study): coin_study})
    for _ in range(2):
        arguments = ["compare", "--all", "--results", str(tmp_path / "all"), "--pool", "serial"]
        outcome = CliRunner().invoke(main, arguments)
        assert outcome.exit_code == 0, outcome.output
        assert "study:" in outcome.output
    assert (tmp_path / "all" / "study.zarr").exists()


def test_the_built_in_studies_that_publish_something():
    studies = {study.name: study for study in paper_studies(published=True)}
    assert "quasars" in studies
    assert not {"grid", "gaia-releases"} & set(studies)  # the second needs a package that may not be there
    assert studies["quasars"].published.tolerance == 0.07
    assert len(studies["quasars"].claims) == 2
    assert {study.name for study in paper_studies(published=False)} == set(built_in_studies())


def test_the_claims_of_the_document_are_valid(tmp_path):
    document = (ROOT / "docs" / "compare.md").read_text()
    (tmp_path / "study.toml").write_text(document.partition("```toml normal.toml\n")[2].partition("```")[0])
    kinds = [type(c.quantity()).__name__ for c in load_study(str(tmp_path / "study.toml")).claims]
    assert kinds == ["Slope", "Ratio", "Reading"]
