"""Conclusions: the words of the study, the numbers of the results."""

import math

import pytest

import linksweep
from linksweep import SweepError
from tests.sweep.analysis.made import FAILED, MISSING, study_from_dict

AT = {"model": "gaia", "v_max": 20.0}
GAIA = {"value": {"variable": "sigma_spin", "at": AT}}


def said(dataset):
    return [one for one in linksweep.answer(dataset).sentences if not one.startswith("Incomplete")]


def concluding(dataset, *sentences, **values):
    study = study_from_dict(
        {
            "title": "t",
            "axes": {"model": ["amex", "gaia"], "v_max": [14.0, 20.0, 21.0]},
            "fixed": {"catalogue": "quasars"},
            "conclusion": {"sentences": list(sentences), "values": values},
        }
    )
    return said(dataset.assign_attrs(conclusion=study.conclusion.model_dump_json()))


def test_values_are_filled_in_with_units(dataset_of):
    dataset = dataset_of("quasars")
    value = float(dataset["sigma_spin"].sel(AT)) * 1000.0
    (sentence,) = concluding(dataset, "GAIA {{20}}: {gaia}, {gaia:error}.", gaia=GAIA)
    assert sentence.startswith(f"GAIA {{20}}: {value:.2g} uas/yr, {value:.2f}")
    assert " ± " in sentence
    ratio = {
        "ratio": {"variable": "sigma_spin", "of": {"model": "gaia"}, "to": {"model": "amex"}},
        "where": {"v_max": 20.0},
    }
    (sentence,) = concluding(dataset, "{share:%} of AMEX", share=ratio)
    assert float(sentence.split()[0]) == pytest.approx(
        100.0 * value / 1000.0 / float(dataset["sigma_spin"].sel(model="amex", v_max=20.0)), rel=0.05
    )


@pytest.mark.parametrize(
    ("bounds", "met"),
    [
        ({"below": 1.0}, True),
        ({"above": 1.0}, False),
        ({"equals": 0.0}, False),
        ({"equals": 5.4e-4}, True),
    ],
)
def test_a_sentence_that_does_not_hold_is_not_said_to(dataset_of, bounds, met):
    (sentence,) = concluding(dataset_of("quasars"), "So it is: {gaia}.", gaia=GAIA | bounds)
    assert sentence.startswith("So it is" if met else "Expected, but not found: “So it is")


@pytest.mark.parametrize("bounds", [{"above": 0.0}, {"equals": 5.4e-4}])
def test_a_number_of_unknown_error_is_not_judged(dataset_of, bounds):
    dataset = dataset_of("quasars")
    unknown = {name: dataset[name] * math.nan for name in dataset.data_vars if name.endswith("_error")}
    (sentence,) = concluding(dataset.assign(unknown), "So it is: {gaia}.", gaia=GAIA | bounds)
    assert sentence.startswith("Not judged: “So it is: 0.5")
    assert sentence.endswith("(the error of sigma_spin is not known).")
    assert concluding(dataset.assign(unknown), "So it is: {gaia}.", gaia=GAIA)[0].startswith("So it is")


def test_what_is_not_there_is_said_or_left_out(dataset_of):
    dataset = dataset_of("quasars")
    status = dataset["status"].copy(deep=True)
    status.loc[AT] = MISSING
    sentences = concluding(dataset.assign(status=status), "It is {gaia}.", gaia=GAIA)
    assert sentences == ["No conclusion yet: numbers that it needs are missing (not done yet)."]
    status.loc[AT] = FAILED
    sentences = concluding(dataset.assign(status=status), "It is {gaia}.", "Few.", gaia=GAIA)
    assert sentences == ["Few.", "No further conclusion: numbers that it needs are missing (failed)."]
    beyond = {"value": {"variable": "sigma_spin", "at": {"model": "gaia", "v_max": 21.0}}}
    assert concluding(dataset, "{beyond}", "{gaia}!", beyond=beyond, gaia=GAIA)[0].endswith("!")


def test_without_a_conclusion_the_range_answers(dataset_of):
    dataset = dataset_of("sqrt-n")
    del dataset.attrs["conclusion"]
    (sentence,) = said(dataset)
    assert sentence.startswith("sigma_spin (RMS error of the spin, over its components): It is between")
    nothing = dataset.assign({n: dataset[n] * math.nan for n in dataset if str(n).startswith("sigma_spin")})
    assert said(nothing)[0].endswith("No point has a value yet.")
    dataset.attrs["conclusion"] = "{"
    with pytest.raises(SweepError, match="the attribute 'conclusion' cannot be read"):
        linksweep.answer(dataset)


def test_words_about_what_the_study_fixes_are_not_said_of_something_else():
    assert linksweep.load_study("quasars", ["catalogue=galaxies"]).conclusion is None
    assert linksweep.load_study("quasars", ["model=gaia"]).conclusion is None
    assert linksweep.load_study("quasars", axes=["error_scale=1,2"]).conclusion is None
    assert linksweep.load_study("quasars", ["n_sim=5"], ["v_max=14,15"]).conclusion is not None


@pytest.mark.parametrize(
    ("sentence", "value", "problem"),
    [
        ("{gaja}", GAIA, "sentences: unknown value 'gaja'; did you mean 'gaia'?"),
        ("{gaia", GAIA, "sentences.0: '{gaia': expected '}' before end of string"),
        ("nothing", GAIA, "values: 'gaia' is in no sentence"),
        ("{gaia}", {"value": {"variable": "sigma_spin", "at": AT | {"v_max": 19.0}}}, "19.0 is not on the axis"),
        ("{gaia}", {"value": {"variable": "sigma_spin"}}, "model has several values; fix it with 'where', or choose"),
        ("{gaia}", {}, "needs exactly one of slope, ratio and value"),
        ("{gaia}", GAIA | {"above": 2.0, "below": 1.0}, "above = 2: is not less than below = 1"),
    ],
)
def test_bad_conclusions_are_refused_when_the_study_is_read(dataset_of, sentence, value, problem):
    with pytest.raises(SweepError) as error:
        concluding(dataset_of("quasars"), sentence, gaia=value)
    assert problem in str(error.value)
    assert "conclusion" in str(error.value)
