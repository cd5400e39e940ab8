"""What is given beside or in place of a study file: options that contradict each other, texts and objects as axes."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from linksweep import SweepError, load_study, run

LAW = """
def law(a: float = 1.0, n: int = 2, m: str = "x", e=None):
    return a


def seeded(x=1.0, seed=2):
    return x * seed
"""


@pytest.fixture
def law(tmp_path, monkeypatch):
    (tmp_path / "law.py").write_text(LAW)
    monkeypatch.chdir(tmp_path)
    return "law.py:law"


def refusal(*arguments, **options):
    with pytest.raises(SweepError) as refused:
        load_study(*arguments, **options)
    return str(refused.value)


V_MAX = {"ranges": ["v_max=14:15"]}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"axes": ["v_max=14,15"], "settings": ["v_max=16"]}, "--set v_max=16 and --axis v_max=14,15: v_max is"),
        ({"axes": ["v_max=14,15", "v_max=16"]}, "--axis v_max=14,15 and --axis v_max=16: v_max is given twice"),
        ({"settings": ["n_sim=10", "sampling.n_sim=20"]}, "--set n_sim=10 and --set sampling.n_sim=20: n_sim is given"),
        ({"settings": ["title=a", "title=b"]}, "--set title=a and --set title=b: title is given twice"),
        ({"design": "random:8", "ranges": ["v_max=14:15", "v_max=14:16"]}, "--range v_max=14:15 and --range v_max=14:"),
        ({"design": "sobol:8:3", "settings": ["points.seed=4"]} | V_MAX, "--set points.seed=4 and --design sobol:8:3:"),
        ({"design": "sobol:8", "settings": ["points.n=16"]} | V_MAX, "--set points.n=16 and --design sobol:8: n is"),
        ({"points": "t.csv", "settings": ["points.seed=4"]} | V_MAX, "points (--points t.csv): ranges, seed: does not"),
        ({"design": "sobol:8", "ranges": ["v_mxa=14:15"]}, "points.ranges.v_mxa (--range v_mxa=14:15): unknown"),
        (
            {"design": "sobol:8", "ranges": ["error_scale=2:1e305"]},
            "(--range error_scale=2:1e305): high = 1e+305: must",
        ),
        ({"design": "sobl:8"} | V_MAX, "points.design (--design sobl:8): input should be 'sobol'"),
        ({"design": "sobol:8:3:1"} | V_MAX, "--design 'sobol:8:3:1': must be written NAME:N or NAME:N:SEED"),
        ({"axes": ['model=amex,"gaia,x"']}, "commas divide values"),
        ({"design": "sobol:8", "ranges": ["model='c,d',a"]}, "commas divide values"),
    ],
)
def test_no_option_is_dropped_for_another_and_a_wrong_one_is_named(options, said):
    assert said in refusal("quasars", **options)


def test_options_that_go_together():
    study = load_study("quasars", settings=["n_sim=10", "n_sim=10"], axes=["v_max=14,15", "v_max=14,15"])
    assert (study.sampling.n_sim, study.axes["v_max"]) == (10, (14.0, 15.0))
    study = load_study("quasars", ["points.seed=4"], design="sobol:8", ranges=["error_scale=1:2"])
    assert study.points.origin["seed"] == 4
    study = load_study("quasars", axes=["""model="amex",'gaia'"""])
    assert study.axes["model"] == ("amex", "gaia")


def named(word: str):
    return 1.0


@given(st.text(max_size=40))
def test_any_text_is_an_axis_or_a_clear_error(text):
    with contextlib.suppress(SweepError):  # any other exception fails
        load_study(f"{__file__}:named", axes=[f"word={text}"])


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
def test_a_range_of_integers_is_exact(spec, expected, law, tmp_path):
    assert run(law, tmp_path / "s.zarr", axes={"n": spec}, pool="serial").n.values.tolist() == list(expected)


def test_a_step_is_not_rounded_away(law, tmp_path):
    """Twelve digits of a Julian date are 0.9 s, and made equal steps of 2.5e-5 days unequal without a word."""
    dates = [2460000.5, 2460000.500025, 2460000.50005, 2460000.500075, 2460000.5001]
    for more in ({"step": 2.5e-5}, {"num": 5}):
        axes = {"a": {"start": 2460000.5, "stop": 2460000.5001, **more}}
        assert run(law, tmp_path / f"{len(more)}.zarr", axes=axes, pool="serial", fresh=True).a.values.tolist() == dates
    thirds = run(law, tmp_path / "s.zarr", axes={"a": {"start": 0, "stop": 1, "num": 4}}, pool="serial")
    assert thirds.a.values[1] == 0.333333333333  # stored: it must never change


@pytest.mark.parametrize(
    "values", [{1, 2}, map(float, (1, 2)), 3.0, {"start": 1}], ids=lambda value: type(value).__name__
)
def test_objects_without_order_or_that_give_their_values_once_are_refused(values, law, tmp_path):
    with pytest.raises(SweepError, match=r"axes\.e: .*write a list"):
        run(law, tmp_path / "s.zarr", axes={"e": values})
