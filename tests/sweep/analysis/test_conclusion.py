"""Conclusions and answers: the words of the study, the numbers of the results."""

import re

import numpy as np
import pytest

import linksweep
from tests.sweep.analysis.made import DONE, FAILED, MISSING, grid, live_study

AT = {"model": "gaia", "v_max": 20.0}
GAIA = {"value": {"variable": "sigma_spin", "at": AT}}
ZIPPED = {"axes": {"model": ["amex", "gaia"], "v_max": [14.0, 20.0]}, "grid": {"zip": [["model", "v_max"]]}}
RATIO = {"variable": "sigma_spin", "of": {"model": "gaia"}, "to": {"model": "amex"}}
BAD = [("{gaja}", GAIA, "sentences: unknown value 'gaja'; did you mean 'gaia'?")]
BAD += [("{gaia", GAIA, "sentences.0: '{gaia': expected '}' before end of string")]
BAD += [("{gaia}", {"value": {"variable": "sigma_spin", "at": AT | {"v_max": 19.0}}}, "19.0 is not on the axis")]
BAD += [("{gaia}", {"value": {"variable": "sigma_spin"}}, "model has several values; fix it with 'where', or choose")]
BAD += [("{gaia}", {"value": {"variable": "covariance", "at": AT}}, "component_other; at most one is allowed")]
BAD += [("{gaia}", {}, "needs exactly one of slope, ratio and value")]


def made(value=((0.65, 0.57), (0.0017, 0.00054)), error=3e-6, status=DONE):
    status = np.array([[DONE, DONE], [DONE, status]], dtype=np.int8)
    result = grid(value, error, np.array([14.0, 20.0]), "v_max", status=status).assign_coords(model=["amex", "gaia"])
    for name in ("width", "width_mc_error"):
        result[name].attrs |= {"units": "mas / yr", "long_name": "RMS error"}
    return result.rename(width="sigma_spin", width_mc_error="sigma_spin_mc_error")


def said(dataset):
    return [one for one in linksweep.answer(dataset).sentences if not one.startswith("Incomplete")]


def concluding(dataset, *sentences, grid=None, **values):
    study = {"title": "t", "axes": {"model": ["amex", "gaia"], "v_max": [14.0, 20.0, 21.0]}}
    study |= {"conclusion": {"sentences": list(sentences), "values": values}, "fixed": {"catalogue": "quasars"}}
    return said(dataset.assign_attrs(conclusion=live_study(study | (grid or {})).conclusion.model_dump_json()))


ANY = {"value": {"variable": "sigma_spin"}}
FILLED = [("GAIA {{20}}: {gaia}, {gaia:error}.", GAIA, "GAIA {20}: 0.54 uas/yr, 0.5400 ± 0.0030 uas/yr.")]
FILLED += [("{gaia:error} ± {gaia}", GAIA, "0.5400 ± 0.0030 uas/yr ± 0.54 uas/yr")]
FILLED += [("{gaia:%} of AMEX", {"ratio": RATIO, "where": {"v_max": 20.0}}, "0.095 % of AMEX")]
FILLED += [("{gaia}", ANY | {"choose": a}, said) for a, said in (("largest", "0.65 mas/yr"), ("least", "0.54 uas/yr"))]


@pytest.mark.parametrize(("sentence", "value", "text"), FILLED)
def test_values_are_filled_in_with_units(sentence, value, text):
    assert concluding(made(), sentence, gaia=value) == [text]


@pytest.mark.parametrize("bound", ["above", "below", "equals"])
@pytest.mark.parametrize("away", [-3.1, -2.9, 2.9, 3.1])
def test_a_sentence_that_does_not_hold_within_three_errors_is_not_said_to(bound, away):
    met = {"above": away > -3.0, "below": away < 3.0, "equals": abs(away) < 3.0}[bound]
    dataset = made(np.full((2, 2), 2.0 + 0.1 * away), 0.1)
    (sentence,) = concluding(dataset, "So it is: {gaia}.", gaia=GAIA | {bound: 2.0})
    assert sentence.startswith("So it is" if met else "Expected, but not found: “So it is")
    unknown = made(np.full((2, 2), 2.0), np.nan)
    (sentence,) = concluding(unknown, "So it is: {gaia}.", gaia=GAIA | {bound: 2.0})
    assert sentence.startswith("Not judged: “So it is: 2")
    assert sentence.endswith("(the error of sigma_spin is not known).")
    assert concluding(unknown, "So it is: {gaia}.", gaia=GAIA)[0].startswith("So it is")


def test_what_is_not_there_is_said_or_left_out(tmp_path):
    sentences = concluding(made(status=MISSING), "It is {gaia}.", gaia=GAIA)
    assert sentences == ["No conclusion yet: numbers that it needs are missing (not done yet)."]
    for results, why in ((made(status=FAILED), "failed"), (made(np.full((2, 2), np.inf)), "not a finite number")):
        sentences = concluding(results, "It is {gaia}.", "Few.", gaia=GAIA)
        assert sentences == ["Few.", f"No further conclusion: numbers that it needs are missing ({why})."]
    beyond = {"value": {"variable": "sigma_spin", "at": {"model": "gaia", "v_max": 21.0}}}
    assert concluding(made(), "{beyond}", "{gaia}!", beyond=beyond, gaia=GAIA) == ["0.54 uas/yr!"]
    # zipped axes are fixed and vary together
    one = {"value": {"variable": "sigma_spin", "at": {"v_max": 20.0}}}
    assert concluding(made(), "{gaia:%}", grid=ZIPPED, gaia=one | {"where": {"model": "gaia"}}) == ["0.054 %"]
    slope = {"slope": {"variable": "sigma_spin", "over": "v_max"}, "where": {"model": "gaia"}}
    with pytest.raises(linksweep.SweepError, match="'v_max' cannot vary, because 'where' fixes model"):
        concluding(made(), "{gaia}", grid=ZIPPED, gaia=slope)
    table = {"experiment": lambda a, b: {"y": a * b}, "points": {"columns": {"a": [3.0, 2.0], "b": [1.0, 4.0]}}}
    value = {"variable": "y"}, {"variable": "y", "at": {"b": 4.0}}
    two = ({"sentences": ["{y}"], "values": {"y": {"value": one}}} for one in value)
    with pytest.raises(linksweep.SweepError, match="a has several values; fix it"):
        linksweep.run(table | {"conclusion": next(two)}, tmp_path / "s", pool="serial")
    assert linksweep.answer(linksweep.run(table | {"conclusion": next(two)}, tmp_path / "s")).sentences == ["8"]


def test_without_a_conclusion_the_range_answers(tmp_path):
    two = linksweep.run(lambda x=1.0: {"a": x, "b": x}, tmp_path / "s", pool="serial")
    assert [one[:2] for one in said(two)] == ["a:", "b:"]
    flags = linksweep.run(lambda x=1: {"a": [True, x > 1]}, tmp_path / "t", pool="serial")
    assert said(flags) == ["a: It is True at 1 of 2 values."]
    assert said(made())[0].startswith("sigma_spin (RMS error): It is between 0.5")
    assert "not known" in said(made(error=np.nan))[0]
    with pytest.raises(linksweep.SweepError, match="the attribute 'conclusion' cannot be read"):
        linksweep.answer(made().assign_attrs(conclusion="{"))
    # words about what the study fixes are not said of something else
    changes = ({"settings": ["catalogue=galaxies"]}, {"settings": ["model=gaia"]}, {"axes": ["error_scale=1,2"]})
    assert [linksweep.load_study("quasars", **change).conclusion for change in changes] == [None] * 3
    assert linksweep.load_study("quasars", ["n_sim=5"], ["v_max=14,15"]).conclusion is not None


@pytest.mark.parametrize(("sentence", "value", "problem"), BAD)
def test_bad_conclusions_are_refused_when_the_study_is_read(sentence, value, problem):
    with pytest.raises(linksweep.SweepError, match=rf"conclusion.*{re.escape(problem)}"):
        concluding(made(), sentence, gaia=value)
