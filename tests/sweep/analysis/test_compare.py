"""Computed against published: verdicts, allowances, claims and the command."""

import json
from datetime import date
from decimal import Decimal

import numpy as np
import pytest
from scipy.stats import norm

import linksweep
from linksweep.sweep.analysis import compare as verdicts
from tests.conftest import COINS
from tests.sweep.analysis.made import DONE, EXCLUDED, FAILED, MISSING, N, grid

compare = verdicts.compare
LAW = {"variable": "width", "over": "n"}
WIDE = {"tolerance": 0.07, "tolerance_reason": "curves by eye"}
SAID = "the paper does not say of how many"
# 0.605 - 0.6 > 0.005 in binary; 0.6349 is within three errors more
NEAR = [(0.604, 0.0, "0.60"), (0.605, 0.0, "0.60"), (0.606, 0.0, "0.6"), (0.6349, 0.01, "0.60"), (-0.604, 0.0, "-0.60")]
WITHIN = [(0.64, 0.0, "0.60"), (0.56, 0.0, "0.60"), (-0.64, 0.0, "-0.60")]  # allowed are 0.005, and 0.042 more
JUDGED = [  # value, error, published and what else the claim says; the verdict, and words of its reason
    *((*numbers, {}, "reproduced", "") for numbers in NEAR),
    *((x, error, "0.60", {}, "NOT reproduced", "") for x, error in ((0.606, 0.0), (0.6351, 0.01), (0.5649, 0.01))),
    (np.nan, 0.0, "0.60", {}, "NOT reproduced", "not a finite number"),
    (0.6, np.nan, "0.60", {}, "incomplete", "not known"),
    *((*numbers, WIDE, "within tolerance", "7 %: curves by eye") for numbers in WITHIN),
    *((0.648, 0.0, "0.60", WIDE, "NOT reproduced", ""), (0.604, 0.0, "0.60", WIDE, "reproduced", "")),
    (90.6, 0.5, "5e2", WIDE | {"tolerance": 0.9}, "not comparable", "a deviation of 500 mas, more than 167 mas"),
    (5.0, 0.5, "5e2", WIDE | {"tolerance": 0.5}, "NOT reproduced", ""),
    (90.6, 0.5, "5e2", {"not_comparable": SAID}, "not comparable", SAID),
    # an effect must be told from none
    (1.018, 0.011, "1.1", {}, "reproduced", ""),
    (1.018, 0.011, "1.1", {"null": 1.0}, "incomplete", "needed"),  # the tenth is claimed, not the one
    (1.018, 0.005, "1.1", {"null": 1.0}, "NOT reproduced", ""),
    (1.09, 0.005, "1.1", {"null": 1.0}, "reproduced", ""),
    (1.09, 0.005, "1.1", {"null": 1.06}, "not comparable", "more than 40.0 uas"),
]
GOOD = f"""
title = "Coins"
experiment = '{COINS}'
[axes]
metal = ["gold", "tin"]
coins = [1, 5, 20]
[sampling]
n_sim = 1000
n_cat = 20
seed = 7

[[claim]]
text = "Half of them"
source = "p. 3"
published = "0.5"
"""
PLACE = 'value = { variable = "share", at = { coins = 5 } }'
NO_CLAIMS = [
    ("", ["claim.0 (line 12)", "exactly one of slope, ratio and value"]),
    ('slope = { variable = "share", ower = "coins" }', ["claim.0.slope.ower (line 16)", "did you mean 'over'?"]),
    ('slope = { variable = "share", over = "metal" }', ["'metal'", "numbers"]),
    ('slope = { variable = "share", over = "coins" }\nwhere = { coins = 5 }', ["'coins' cannot vary"]),
    ('ratio = { variable = "share", of = { coins = 5 }, to = { coins = 5 } }', ["claim.0.ratio", "'of' and 'to'"]),
    (PLACE.replace("share", "share', component = 'x").replace('"', "'"), ["component"]),
]


def claim(**keys):
    return {"text": "A statement", "source": "Sect. 1", "published": "1.0"} | keys


def only(dataset):
    (comparison,) = compare(dataset)
    return comparison


@pytest.mark.parametrize(("value", "error", "text", "keys", "verdict", "reason"), JUDGED)
def test_verdict(value, error, text, keys, verdict, reason):
    """Of a claim and of a number in a table; the power is the deviation that is found in nineteen of twenty."""
    reading = {"variable": "width", "at": {"model": "new", "n": 50.0}}
    actual = [only(grid(value, error, claims=[claim(published=text, value=reading, **keys)]))]
    if not keys.keys() - WIDE.keys():
        actual.append(only(grid(value, error, published={(1, 2): text}, printed=keys)))
        named = actual[1].study, actual[1].what, actual[1].source, actual[1].unit
        assert named == ("made-up", "width", "A paper", "mas")
    rounding, number = 0.5 * 10.0 ** Decimal(text).as_tuple().exponent, float(text)
    detectable = rounding + keys.get("tolerance", 0.0) * abs(number) + (3.0 + norm.ppf(0.95)) * error
    is_judged = np.isfinite(value) and "not_comparable" not in keys
    for one in actual:
        assert (one.verdict, one.where, one.published) == (verdict, {"model": "new", "n": 50.0}, number)
        assert reason in one.reason if reason else one.reason == ""
        numbers = one.allowance, one.difference, one.power
        wanted = rounding + 3.0 * error, value - number, detectable / abs(number) if is_judged else np.nan
        assert numbers == pytest.approx(wanted, rel=1e-4, nan_ok=True)
        assert verdicts.all_is_well([one]) == (verdict in ("reproduced", "within tolerance", "not comparable"))
        stored = json.loads(verdicts.as_json([one]))["comparisons"][0]["power"]
        assert (stored is None) == np.isnan(one.power)


def test_a_count_must_be_equal_and_the_error_between_catalogues_adds_in_quadrature():
    for value, error, catalogues, text, verdict, allowance in (
        *((28.0, None, None, "28", "reproduced", 0.0), (28.4, None, None, "28", "NOT reproduced", 0.0)),
        (28.9, 0.15, None, "28", "reproduced", 0.95),  # what has an error is no count
        *((28.4, None, "mas", "28", "reproduced", 0.5), (28.0, None, None, "3e1", "reproduced", 5.0)),  # nor a unit
        *((0.6, 0.003, 0.004, "0.60", "reproduced", 0.02), (0.6, 0.003, np.nan, "0.60", "reproduced", 0.014)),
    ):
        dataset = grid(value, error, published={(0, 0): text}, printed=WIDE)
        dataset["width"].attrs["units"] = "mas" if catalogues == "mas" else ""
        if isinstance(catalogues, float):  # NaN is that of one catalogue
            dataset["width_catalogue_error"] = 0.0 * dataset["width"] + catalogues
        comparison = only(dataset)
        assert (comparison.verdict, comparison.allowance) == (verdict, pytest.approx(allowance))


@linksweep.experiment(outputs=[linksweep.Output("y", statistics=["mean", "q99", "max"])])
def drawing(rng, x: float):
    return {"y": rng.random() / x}


def test_what_draws_random_numbers_is_judged_only_by_an_error_that_is_known(tmp_path):
    """300 realisations are too few for that of a quantile of 99 %, and a maximum has none."""
    names, ends = ("y_mean", "y_q99", "y_max"), {"of": {"x": 4.0}, "to": {"x": 1.0}}
    slopes = [claim(published="-1.0", slope={"variable": name, "over": "x"}) for name in names]
    ratios = [claim(published="0.250", ratio={"variable": name, **ends}) for name in names]
    study = {"experiment": drawing, "axes": {"x": [1.0, 2.0, 4.0]}, "sampling": {"n_sim": 300, "seed": 2}}
    values = {n: {"slope": {"variable": n, "over": "x"}, "equals": -0.5} for n in names}
    study["conclusion"] = {"sentences": [f"{n} {{{n}}}" for n in names], "values": values}
    dataset = linksweep.run(study | {"claim": slopes + ratios}, tmp_path / "s", pool="serial")
    assert [one.verdict for one in compare(dataset)] == ["reproduced", "incomplete", "incomplete"] * 2
    assert verdicts.remarks(dataset)[0].startswith("y_q99: its Monte-Carlo error is not")
    said = [sentence.partition(":")[0] for sentence in linksweep.answer(dataset).sentences]
    assert said == ["Expected, but not found", "Not judged", "Not judged"]


def test_a_point_that_is_not_done_is_incomplete_and_not_left_out():
    for code, reason in ((MISSING, "not done yet"), (FAILED, "failed"), (EXCLUDED, "no point in the study")):
        status = np.full((2, len(N)), DONE, np.int8)
        status[0, 1] = code
        value = np.where(status == DONE, 0.6, np.nan)
        actual = compare(grid(value, 0.001, status=status, published={(0, 0): "0.60", (0, 1): "0.60", (1, 1): "0.7"}))
        assert [c.verdict for c in actual] == ["reproduced", "incomplete", "NOT reproduced"]
        assert (reason in actual[1].reason, verdicts.all_is_well(actual[:2])) == (True, False)
        assert np.isnan(actual[1].value)
        assert verdicts.summary_line(actual).startswith("1 reproduced, 0 within tolerance, 1 not reproduced, 1 inc")


def test_a_claim_of_a_law_for_each_model_and_claims_about_points_that_are_not_done_not_finite_or_not_there(tmp_path):
    claims = [claim(published="-0.5", exact=True, slope=LAW)]
    value = np.array([2.0 * N**-0.5, 3.0 * N**-0.7])
    actual = compare(grid(value, 0.01 * value, claims=claims))
    assert [(c.where["model"], c.verdict) for c in actual] == [("old", "reproduced"), ("new", "NOT reproduced")]
    assert [c.value for c in actual] == pytest.approx([-0.5, -0.7])
    assert actual[0].mc_error == pytest.approx(0.01 / np.sqrt(np.sum((np.log(N) - np.log(N).mean()) ** 2)))
    wanted = 0.0, 3 * actual[0].mc_error, "slope of width over n", ""
    assert (actual[0].rounding, actual[0].allowance, actual[0].quantity, actual[0].unit) == wanted
    two = [claims[0] | {"where": {"model": "old"}}, claims[0] | {"published": "-0.7"}]
    laws = [linksweep.fit_power_law(grid(value, 0.01 * value, claims=two), "width", "n", e) for e in (None, -0.5, -0.7)]
    assert laws[0]["expected"].values.tolist() == [-0.5, -0.7]  # the first claim is about one model
    holds = [[("NOT as expected", "as expected").index(law) for law in one["conclusion"].values] for one in laws]
    assert holds == [[1, 1], [1, 0], [0, 1]]
    axes, when = {"model": ["flat", "steep"], "n": [2.0, 8.0]}, {"n": {"model": ["steep"]}}
    study = {"experiment": lambda model, n=2.0: 4.0 if model == "flat" else n**-0.5, "axes": axes, "when": when}
    study["claim"] = [claims[0] | {"slope": {"variable": "result", "over": "n"}}]
    [comparison] = compare(linksweep.run(study, tmp_path / "s.zarr", pool="serial"))  # of no line without points
    assert (comparison.where, comparison.verdict) == ({"model": "steep"}, "reproduced")
    status = np.full((2, len(N)), DONE, np.int8)
    status[1, 0] = MISSING
    value = np.array([[1.0] * 5, [np.nan, 0.0, 1.0, 1.0, 1.0]])
    claims = [claim(published="1.0", ratio={"variable": "width", "of": {"model": "old"}, "to": {"model": "new"}})]
    actual = compare(grid(value, 0.0, claims=claims, status=status))
    assert [c.verdict for c in actual][:3] == ["incomplete", "NOT reproduced", "reproduced"]
    assert actual[1].reason == "the result is not a finite number"
    for keys, reason in (
        ({"slope": LAW | {"over": "m"}}, "m is not an axis of this store"),
        ({"slope": LAW, "where": {"colour": "red"}}, "'colour' is not an axis; known are model, n"),
    ):
        comparison = only(grid(1.0, claims=[claim(**keys)]))
        assert (comparison.verdict, comparison.reason) == ("incomplete", reason)
    assert only(grid(1.0, claims=[claim(slope=LAW)]).isel(n=0)).reason == "n is not an axis of this store"
    # a table has no lines, and several points at one place
    values = [{"variable": "result", "at": at} for at in ({"a": 2}, {"a": 2, "b": 2})]
    claims = [claim(slope={"variable": "result", "over": "a"}), *(claim(value=one, published="4.0") for one in values)]
    study = {"experiment": lambda a, b: a * b, "points": {"a": [1, 2, 2], "b": [1, 1, 2]}, "claim": claims}
    actual = compare(linksweep.run(study, tmp_path / "t", pool="serial"))
    assert [c.reason for c in actual] == ["a is not an axis of this store", "several points of the store have a=2", ""]


def test_a_component_of_a_result():
    dataset = grid(1.0, claims=[claim(published="2", value={"variable": "shift", "component": "y", "at": {"n": 50.0}})])
    axes, numbers = (*("model", "n"), "component"), np.broadcast_to([1.0, 2.0], (2, len(N), 2))
    dataset = dataset.assign_coords(component=["x", "y"], component_unit=("component", ["m", "s"]))
    dataset["shift"] = (axes, numbers, {"units": "m, s"})
    dataset["shift_mc_error"] = (axes, 0.1 * numbers)
    actual = compare(dataset)
    assert [c.where for c in actual] == [{"model": "old", "n": 50.0}, {"model": "new", "n": 50.0}]
    assert {(c.value, c.mc_error, c.unit, c.quantity) for c in actual} == {(2.0, 0.2, "s", "shift[y]")}


def test_a_store_carries_what_was_published_and_keeps_its_numbers(coins, here):
    (here / "table.csv").write_text("metal,coins,share\ngold,1,0.4\ngold,5,0.40\ntin,20,0.9\ntin,7,0.4\n")
    same = {"variable": "share", "of": {"coins": 20}, "to": {"coins": 1}}
    published_coins = coins | {
        "published": {"file": "table.csv", "source": "Coins (1713)", "tolerance": 0.2, "tolerance_reason": "biased"},
        "claim": [claim(text="The share does not depend on the number", ratio=same, where={"metal": "tin"})],
    }
    before = linksweep.run(coins, "s.zarr", pool="serial")
    dataset = linksweep.run(published_coins, "s.zarr", pool="serial")  # the same store, which now carries them
    assert "claims" not in before.attrs
    assert dataset["share"].equals(before["share"])
    rounding, published = dataset["share_published_rounding"], dataset["share_published"]
    assert rounding.sel(metal="gold").values.tolist()[:2] == [0.05, 0.005]
    assert np.isnan(rounding.sel(metal="tin", coins=1))
    assert (published.attrs["tolerance"], published.attrs["tolerance_reason"]) == (0.2, "biased")
    actual = {tuple(c.where.values()): c.verdict for c in compare(dataset)}
    # The bias of a batch of coins, uniform in +-0.1, scatters the mean of 20 batches by 0.013.
    assert actual["gold", 5] in ("reproduced", "within tolerance")
    assert (actual["gold", 1], actual["tin", 20]) == ("reproduced", "NOT reproduced")
    assert verdicts.remarks(dataset) == ["share: published numbers that are not in this grid and not compared: 1"]
    published_coins["published"] = {"file": "table.csv", "source": "Coins (1714)"}
    published_coins["sampling"] = coins["sampling"] | {"n_sim": 10}  # also by a run of less than the store has
    for printed in 0.4, 0.41:
        (here / "table.csv").write_text(f"metal,coins,share\ngold,1,{printed}\n")
        linksweep.run(published_coins, "s.zarr", pool="serial")
        edited = linksweep.open("s.zarr")["share_published"]
        assert (edited.attrs["source"], "tolerance" in edited.attrs) == ("Coins (1714)", False)
        assert (edited.max(), edited.size) == (printed, published.size)


def coin_study(folder, claim=f"tolerance = 0.2\ntolerance_reason = 'a coin'\n{PLACE}\n"):
    (folder / "study.toml").write_text(GOOD + claim)
    return folder / "study.toml"


@pytest.mark.parametrize(("claim", "phrases"), NO_CLAIMS)
def test_a_claim_that_cannot_be_is_refused(sweep, tmp_path, claim, phrases):
    code, out, err = sweep("plan", coin_study(tmp_path, claim))
    assert (code, out) == (2, "")
    assert all(phrase in " ".join(err.split()) for phrase in phrases), err


def test_the_command_tells_by_its_exit_code_and_the_whole_paper_runs_what_is_missing(sweep, tmp_path, monkeypatch):
    wanted = {"good": "", "poor": "--set chance=0.2", "less": "--axis coins=1,20", "none": "--set coins=7"}
    for name, changes in wanted.items():
        assert sweep("run", coin_study(tmp_path), "-o", f"{name}.zarr", *changes.split(), cwd=tmp_path)[0] == 0
    code, out, err = sweep("compare", "good.zarr", cwd=tmp_path)
    assert (code, err, "Half of them" in out) == (0, "", True)
    for name, verdict in (("poor", "NOT reproduced"), ("less", "incomplete"), ("none", "incomplete")):
        code, out, _ = sweep("compare", "good.zarr", f"{name}.zarr", "--json", cwd=tmp_path)
        document = json.loads(out)
        assert (code, {c["verdict"] for c in document["comparisons"]}) == (1, {"reproduced", verdict})
        assert wanted[name] in document["remarks"][0]
    (tmp_path / "p.csv").write_text("coins,share\n5,0.5\n")
    where = "[published]\nfile = 'p.csv'\nsource = 'p. 1'\nwhere = { metal = 'tin' }\n[fixed]\nchance = 0.5\n"
    study = linksweep.load_study(coin_study(tmp_path, f"{PLACE}\n{where}"), ["chance=0.2"])
    assert study.published.where["chance"] == 0.5  # that of the study, whatever another axis is at
    study = coin_study(tmp_path)
    monkeypatch.setattr("linksweep.sweep.studies.built_in_studies", lambda: {str(study): study})
    arguments = ("compare", "--all", "--results", tmp_path / "all", "--pool", "serial")
    for _ in range(2):
        assert "study:" in sweep(*arguments, code=0)[1]
    assert (tmp_path / "all" / "study.zarr").exists()
    study.write_text(study.read_text().replace("seed = 7", "seed = 8"))
    assert "a different study" in sweep(*arguments, code=2)[2]


def test_a_plain_function_has_claims_a_conclusion_and_published_numbers(tmp_path):
    (tmp_path / "p.csv").write_text("a,w,lost\n1,1.0,3\n2,2.83,4\n", encoding="utf-8")

    def power(a: float = 1.0):
        return {"w": a**1.5, "word": "x", "pair": [a, 2.0 * a], "square": a * np.eye(2)}

    wanted = [claim(slope={"variable": "w", "over": "a"}, published="1.5")]
    wanted += [claim(value={"variable": "pair", "component": 1.0, "at": {"a": 4.0}}, published="8.0")]
    wrong = {"depth": "depth is not", "pair": "one of 0, 1", **dict.fromkeys(("word", "square"), "neither one")}
    lost = [claim(value={"variable": name, "at": {"a": 1.0}}) for name in wrong]
    values = {name: {"value": {"variable": name, "at": {"a": 2.0}}} for name in ("w", "depth")}
    study = {"experiment": power, "axes": {"a": [1.0, 2.0, 4.0]}, "claim": wanted + lost}
    study["conclusion"] = {"sentences": ["It is {w}.", "It is {depth}."], "values": values}
    study["published"] = {"file": str(tmp_path / "p.csv"), "source": "Table 1"}
    dataset = linksweep.run(study, tmp_path / "s", pool="serial")
    actual = compare(dataset)
    assert [one.verdict for one in actual] == [*["reproduced"] * 2, "incomplete"] * 2 + ["incomplete"] * 3
    assert all(words in one.reason for words, one in zip(wrong.values(), actual[5:], strict=True))
    said, words = linksweep.answer(dataset).sentences, ("It is 2.8", "depth is not a result of this store")
    assert all(one in sentence for one, sentence in zip(words, said, strict=True))
    study["claim"] = [claim(value={"variable": "a", "at": {"a": 1.0}})]
    with pytest.raises(linksweep.SweepError, match="'a' is no output"):
        linksweep.run(study, tmp_path / "t", pool="serial")


def test_published_numbers_stand_at_the_point_that_is_meant_also_if_it_is_excluded(tmp_path):
    (tmp_path / "p.csv").write_text("release,k,w\n1.10,1,4\n1.1,2,3\n1.20,1,9\n007,1.0,5\n1.1,1,7\n")
    study = {"experiment": lambda release, k=1: {"w": len(release)}, "exclude": [{"release": "1.1", "k": 1}]}
    study["axes"] = {"release": ["1.1", "1.10", "1.2", "007", "nan"], "k": [1, 2]}
    study["published"] = {"file": str(tmp_path / "p.csv"), "source": "Table 2"}
    dataset = linksweep.run(study, tmp_path / "s", pool="serial")
    assert dataset["w_published"].sel(k=1).fillna(0).values.tolist() == [7, 4, 0, 5, 0]
    assert dataset["w_published"].attrs["outside_grid"] == 1
    judged = {(c.where["release"], c.where["k"]): c.verdict for c in compare(dataset)}
    assert [judged[place] for place in (("1.1", 1), ("1.1", 2), ("1.10", 1))] == ["incomplete", *["reproduced"] * 2]
    # numbers, truth values and dates are found however they are written
    (tmp_path / "p.csv").write_text("x,day,k,w\ntrue,2024-06-01,0.40,1\nFALSE,2024-06-01,.4,0\n")
    flags = {"experiment": lambda x, day, k=0.4: {"w": int(x)}, "published": study["published"]}
    flags["axes"], at = {"x": [False, True], "day": [date(2024, 6, 1)]}, {"x": True, "day": date(2024, 6, 1)}
    flags |= {"claim": [claim(value={"variable": "w", "at": at})], "figure": {"at": at}}
    actual = compare(linksweep.run(flags, tmp_path / "b", pool="serial"))
    assert [(c.where["x"], c.verdict) for c in actual] == [(x, "reproduced") for x in (False, True, True)]
    (tmp_path / "p.csv").write_text("release,w\n1.10,4\n007,5\n")  # at the k of the study, an axis of the store
    axes, two = {"release": ["1.10", "007", "8"]}, {"k": [1, 2]}
    for k, more in (2, {"fixed": {"k": 2}}), (1, {"axes": axes | two}), (None, {"axes": axes | two}):
        where = study["published"] | ({} if k else {"where": {"k": 3}})
        again = {"experiment": study["experiment"], "published": where, "axes": axes} | more
        linksweep.run(again, store := tmp_path / ("s" if k == 2 else f"t{k}"), pool="serial", keep=True)
        wanted = [(k, "reproduced"), (k, "NOT reproduced")] if k else [(None, "incomplete")]
        assert [(c.where.get("k"), c.verdict) for c in compare(linksweep.open(store))] == wanted
