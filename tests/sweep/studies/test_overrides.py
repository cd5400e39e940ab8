"""Options that contradict each other; what else they do to a study is tested where studies are read."""

import pytest

from linksweep.sweep.contract import SweepError
from linksweep.sweep.studies.reader import load_study


@pytest.mark.parametrize(
    ("options", "told"),
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
def test_no_option_is_dropped_for_another(options, told):
    with pytest.raises(SweepError) as refused:
        load_study("quasars", **options)
    assert f"{told} is given twice; leave out one of the two" in str(refused.value)


def test_an_option_may_be_repeated():
    study = load_study("quasars", settings=["n_sim=10", "n_sim=10"], axes=["v_max=14,15", "v_max=14,15"])
    assert study.sampling.n_sim == 10
    assert study.axes["v_max"] == (14.0, 15.0)


def test_a_wrong_range_is_blamed_on_its_own_option():
    with pytest.raises(SweepError) as refused:
        load_study("quasars", design="sobol:8", ranges=["v_max=14:15", "v_mxa=14:15", "error_scale=2:1e305"])
    told = str(refused.value)
    assert "points.ranges.v_mxa (--range v_mxa=14:15): unknown parameter" in told
    assert "(--range error_scale=2:1e305): high = 1e+305: must be a finite number, below 1e+300 in size" in told
    with pytest.raises(SweepError, match=r"points.design \(--design sobl:8\): no design"):
        load_study("quasars", design="sobl:8", ranges=["v_max=14:15"])


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"design": "sobol:8:3", "settings": ["points.seed=4"]}, "--set points.seed=4 has no effect beside --design"),
        (
            {"design": "sobol:8", "settings": ["points.n=16"]},
            "--set points.n=16 has no effect beside --design sobol:8;",
        ),
        (
            {"points": "t.csv", "settings": ["points.seed=4"]},
            "--set points.seed=4 has no effect beside --points t.csv;",
        ),
    ],
)
def test_a_setting_of_points_that_another_option_replaces_is_refused(options, told):
    with pytest.raises(SweepError) as refused:
        load_study("quasars", ranges=["v_max=14:15"], **options)
    assert told in str(refused.value)


def test_a_setting_of_points_goes_with_a_design_that_leaves_it_open():
    study = load_study("quasars", ["points.seed=4"], design="sobol:8", ranges=["error_scale=1:2"])
    assert study.points.origin["seed"] == 4


def test_a_parameter_called_seed_is_set_in_a_study_with_another_mistake(tmp_path):
    (tmp_path / "law.py").write_text("def law(x=1.0, seed=2):\n    return x * seed\n")
    study = 'title = "t"\nexperiment = "law.py:law"\n[axes]\nx = [1.0]\n'
    (tmp_path / "good.toml").write_text(study)
    assert load_study(str(tmp_path / "good.toml"), settings=["seed=3"]).fixed["seed"] == 3
    (tmp_path / "wrong.toml").write_text(f"nonsense = 3\n{study}")
    with pytest.raises(SweepError, match=r"nonsense \(line 1\): unknown key"):
        load_study(str(tmp_path / "wrong.toml"), settings=["seed=3"])
