"""What is given beside or in place of a study file: options that contradict each other, texts and objects as axes."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from linksweep import SweepError, load_study
from linksweep.sweep.studies.document import parse_axis, parse_places, parse_range
from linksweep.sweep.studies.points import axis_values
from linksweep.sweep.studies.reader import study_of_function


def law(a: float = 1.0, m: str = "x", e=1):
    return a


def refusal(*arguments, **options):
    with pytest.raises(SweepError) as refused:
        load_study(*arguments, **options)
    return str(refused.value)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"axes": ["v_max=14,15"], "settings": ["v_max=16"]}, "--set v_max=16 and --axis v_max=14,15: v_max"),
        ({"axes": ["v_max=14,15", "v_max=16"]}, "--axis v_max=14,15 and --axis v_max=16: v_max"),
        ({"settings": ["n_sim=10", "sampling.n_sim=20"]}, "--set n_sim=10 and --set sampling.n_sim=20: n_sim"),
        ({"settings": ["title=a", "title=b"]}, "--set title=a and --set title=b: title"),
        (
            {"design": "random:8", "ranges": ["v_max=14:15", "v_max=14:16"]},
            "--range v_max=14:15 and --range v_max=14:16: v_max",
        ),
    ],
)
def test_no_option_is_dropped_for_another(options, said):
    assert f"{said} is given twice; leave out one of the two" in refusal("quasars", **options)


@pytest.mark.parametrize(
    ("options", "lost"),
    [
        (
            {"design": "sobol:8:3", "settings": ["points.seed=4"]},
            "--set points.seed=4 and --design sobol:8:3: seed is given",
        ),
        (
            {"design": "sobol:8", "settings": ["points.n=16"]},
            "--set points.n=16 and --design sobol:8: n is given twice",
        ),
        (
            {"points": "t.csv", "settings": ["points.seed=4"]},
            "points (--points t.csv): ranges, seed: does not go with file",
        ),
    ],
)
def test_a_setting_of_points_that_another_option_replaces_is_refused(options, lost):
    assert lost in refusal("quasars", ranges=["v_max=14:15"], **options)


def test_options_that_go_together():
    study = load_study("quasars", settings=["n_sim=10", "n_sim=10"], axes=["v_max=14,15", "v_max=14,15"])
    assert (study.sampling.n_sim, study.axes["v_max"]) == (10, (14.0, 15.0))
    study = load_study("quasars", ["points.seed=4"], design="sobol:8", ranges=["error_scale=1:2"])
    assert study.points.origin["seed"] == 4


def test_a_wrong_range_is_blamed_on_its_own_option():
    said = refusal("quasars", design="sobol:8", ranges=["v_max=14:15", "v_mxa=14:15", "error_scale=2:1e305"])
    assert "points.ranges.v_mxa (--range v_mxa=14:15): unknown parameter" in said
    assert "(--range error_scale=2:1e305): high = 1e+305: must be a finite number, below 1e+300 in size" in said
    assert "points.design (--design sobl:8): input should be 'sobol'," in refusal(
        "quasars", design="sobl:8", ranges=["v_max=14:15"]
    )


def test_a_parameter_called_seed_is_set_in_a_study_with_another_mistake(tmp_path):
    (tmp_path / "law.py").write_text("def law(x=1.0, seed=2):\n    return x * seed\n")
    study = 'title = "t"\nexperiment = "law.py:law"\n[axes]\nx = [1.0]\n'
    (tmp_path / "good.toml").write_text(study)
    assert load_study(str(tmp_path / "good.toml"), settings=["seed=3"]).fixed["seed"] == 3
    (tmp_path / "wrong.toml").write_text(f"nonsense = 3\n{study}")
    assert "nonsense (line 1): unknown key" in refusal(str(tmp_path / "wrong.toml"), settings=["seed=3"])


@given(st.text(max_size=40))
def test_any_text_is_a_place_or_a_clear_error(text):
    assert parse_places(["model=gaia,v_max=16", "n=1"]) == {"model": "gaia", "v_max": "16", "n": "1"}
    with contextlib.suppress(SweepError):  # any other exception fails
        parse_places([text])


@pytest.mark.parametrize("parse", [parse_axis, parse_range])
@pytest.mark.parametrize("text", ['a,"c,d"', "'c,d',a", '"'])
def test_a_comma_in_quotes_does_not_cut_a_text(parse, text):
    assert parse_axis("a,'c',\"d\"") == ["a", "c", "d"]
    assert parse_axis('["a", "c,d"]') == ["a", "c,d"]
    with pytest.raises(SweepError, match="commas divide values"):
        parse(text)


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ({"start": 1234567890123, "stop": 1234567890143, "step": 10}, range(1234567890123, 1234567890144, 10)),
        ({"start": 2**62 + 1, "stop": 2**62 + 3, "step": 1}, range(2**62 + 1, 2**62 + 4)),
        ({"start": 2**62 + 9, "stop": 2**62 + 1, "step": -3}, range(2**62 + 9, 2**62 + 1, -3)),
        ({"start": 1234567890123, "stop": 1234567890143, "num": 3}, range(1234567890123, 1234567890144, 10)),
        ({"start": 7, "stop": 1234567890123, "num": 2, "spacing": "log"}, [7, 1234567890123]),
        ({"start": 1234567890123, "stop": 1234567890123, "num": 1}, [1234567890123]),
    ],
)
def test_a_range_of_integers_is_exact(spec, expected):
    assert axis_values(spec, whole=True) == list(expected)


def test_a_step_is_not_rounded_away():
    """Twelve digits of a Julian date are 0.9 s, and made equal steps of 2.5e-5 days unequal without a word."""
    dates = axis_values({"start": 2460000.5, "stop": 2460000.5001, "step": 2.5e-5})
    assert dates == [2460000.5, 2460000.500025, 2460000.50005, 2460000.500075, 2460000.5001]
    assert axis_values({"start": 2460000.5, "stop": 2460000.5001, "num": 5}) == dates
    assert axis_values({"start": 0, "stop": 1, "num": 4})[1] == 0.333333333333  # stored: it must never change


@pytest.mark.parametrize(
    ("axes", "said"),
    [
        ({"e": {1, "a"}}, "axes.e: .*write a list"),
        ({"a": map(float, (1, 2))}, "axes.a: <map .*write a list"),
    ],
)
def test_objects_without_order_or_that_give_their_values_once_are_refused(axes, said):
    with pytest.raises(SweepError, match=said):
        study_of_function(law, axes)


def test_keys_and_values_of_a_mapping_are_axes():
    named = {1.0: "u", 2.0: "v"}
    study = study_of_function(law, {"a": named.keys(), "m": named.values()})
    assert dict(study.axes) == {"a": (1.0, 2.0), "m": ("u", "v")}
