"""Values of a parameter that a study defines: names, identity, stores, and everything that can be wrong in them."""

import json
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from linksweep.sweep.code.load import Code
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.planning.grid import Grid
from linksweep.sweep.running.reproduce import reproduce
from linksweep.sweep.running.run import run_study
from linksweep.sweep.stores.store import OpenStore, open_dataset
from linksweep.sweep.studies.reader import load_study, study_from_dict, study_of_attributes

CURVES = """\
import numpy as np


def motions(v):
    return 0.02 + 0.01 * np.exp(0.4 * (v - 15.0))


def positions(v):
    return np.full(len(v), 0.05)


number = 3
"""

STUDY = """\
title = "Missions of our own"

[axes]
model = ["gaia", "small", "coded"]
v_max = [15.0, 16.0]

[define.model.small]
nominal_length = 3.0
unit = "uas"
sigma_pm = [[9.0, 20.0], [13.0, 25.0], [17.0, 150.0]]
sigma_pos = [[9.0, 15.0], [16.0, 90.0]]

[define.model.coded]
nominal_length = 5.0
sigma_pm = "curves.py:motions"
sigma_pos = "curves.py:positions"

[fixed]
catalogue = "quasars"

[sampling]
n_sim = 6
n_cat = 2
"""

DICE = """\
from linksweep.sweep.contract import DefinitionError, Experiment, Output, Parameter


def dice(points, n_sim, rng, catalogue_rng):
    sides = {"cube": (1, 2, 3, 4, 5, 6)}
    faces = [sides[p["die"]] if isinstance(p["die"], str) else p["die"].value for p in points]
    return {"sum": [rng.choice(f, n_sim).sum() for f in faces]}


def define(table, load):
    if set(table) != {"faces"}:
        raise DefinitionError([("faces", "is all that a die has")])
    faces = tuple(table["faces"])
    return faces, {"faces": sorted(faces)}


experiment = Experiment(
    name="dice",
    version=1,
    parameters=(
        Parameter("die", "str", "cube", "what is thrown", choices=("cube",), define=define),
        Parameter("colour", "str", "red", "of the die", choices=("red", "green")),
    ),
    sums={"sum": ()},
    outputs=(Output("mean", "", "mean number", headline=True),),
    evaluate=dice,
    summarise=lambda sums, n, n_cat: {"mean": sums["sum"] / n},
)
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "curves.py").write_text(CURVES)
    (tmp_path / "own.toml").write_text(STUDY)
    (tmp_path / "dice.py").write_text(DICE)
    return tmp_path


def edited(here, *changes):
    text = STUDY
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (here / "own.toml").write_text(text)
    return load_study("own.toml")


def digests(study):
    return {tuple(str(p.parameters[axis]) for axis in study.axes): p.digest for p in Grid(study).points()}


def run(study, store="s.zarr"):
    return run_study(study, store, Resources(pool="serial"))


def test_an_experiment_of_any_kind_can_have_definitions(here):
    dice = {"title": "Dice", "experiment": "dice.py:experiment", "axes": {"die": ["cube", "low"]}}
    dice |= {"define": {"die": {"low": {"faces": [1, 1, 2]}}}, "sampling": {"n_sim": 20_000}}
    dataset, failures = run(study_from_dict(dice))
    assert not failures
    assert dataset["die"].values.tolist() == ["cube", "low"]
    np.testing.assert_allclose(dataset["mean"], [3.5, 4 / 3], atol=4 * 1.71 / 20_000**0.5)
    with pytest.raises(SweepError) as caught:
        study_from_dict(dice | {"define": {"die": {"low": {"side": 1}}, "colour": {"blue": {}}, "dye": {}}})
    assert caught.value.problems == [
        "define.die.low.faces: is all that a die has",
        "define.colour.blue: colour takes no values that a study defines, but one of 'red', 'green'",
        "define.dye: unknown parameter 'dye'; did you mean 'die'?",
    ]


def test_points_are_known_by_the_curve_and_not_by_its_name(here):
    first = digests(edited(here))
    assert len(set(first.values())) == 6
    axes = {"model": ["gaia"], "v_max": [15, 16]}
    built_in = digests(study_from_dict({"title": "", "axes": axes, "fixed": {"catalogue": "quasars"}}))
    assert built_in.items() <= first.items()
    renamed = digests(edited(here, ("small", "tiny")))
    assert {(name.replace("tiny", "small"), v): digest for (name, v), digest in renamed.items()} == first
    another = digests(edited(here, ("150.0", "151.0")))
    assert {place for place in first if another[place] != first[place]} == {("small", "15.0"), ("small", "16.0")}
    (here / "curves.py").write_text(CURVES.replace("0.02", "0.03"))
    coded = digests(edited(here))
    assert {place for place in first if coded[place] != first[place]} == {("coded", "15.0"), ("coded", "16.0")}


def test_one_curve_under_two_names_is_one_value(here):
    copy = STUDY[STUDY.index("[define.model.small]") : STUDY.index("[define.model.coded]")].replace("small", "copy")
    with pytest.raises(SweepError, match="duplicate values 'small'"):
        edited(here, ("[fixed]", f"{copy}[fixed]"), ('"small", "coded"', '"small", "copy"'))


def test_a_store_is_reproduced_from_itself_and_continued(here, monkeypatch):
    dataset, failures = run(load_study("own.toml"))
    assert not failures
    assert dataset["model"].values.tolist() == ["gaia", "small", "coded"]
    assert np.all(np.isfinite(dataset["sigma_spin"]))
    known = digests(load_study("own.toml"))
    (here / "own.toml").unlink()
    (here / "elsewhere").mkdir()
    monkeypatch.chdir(here / "elsewhere")
    for place in ("model=small,v_max=15", "model=coded,v_max=16", "model=gaia,v_max=16"):
        assert reproduce(here / "s.zarr", place).differences == {}
    again = study_of_attributes(OpenStore(here / "s.zarr").attributes, "s.zarr", Code())
    assert digests(again) == known


def test_a_store_whose_function_is_gone_or_another_cannot_be_reproduced(here):
    run(load_study("own.toml"))
    (here / "curves.py").write_text(CURVES.replace("0.02", "0.03"))
    changed = reproduce(here / "s.zarr", "model=coded,v_max=16")
    assert "sigma_spin" in changed.differences
    (here / "curves.py").unlink()
    with pytest.raises(SweepError, match=r"define.model.coded.sigma_pm.*: there is no file .*curves.py"):
        reproduce(here / "s.zarr", "model=gaia,v_max=16")


def test_workers_compute_what_this_process_does(here):
    alone, _ = run(load_study("own.toml"), "alone.zarr")
    together, failures = run_study(load_study("own.toml"), "together.zarr", Resources(workers=2, pool="processes"))
    assert not failures
    assert alone.equals(together)


def test_a_function_is_that_with_which_the_study_was_read_or_fails(here):
    reference = f"{here / 'curves.py'}:motions"
    (here / "curves.py").write_text(CURVES.replace("0.02", "0.07"))  # no other test has loaded this one
    known = Code().function(reference, Path())
    as_read = known(np.array([15.0]))
    (here / "curves.py").write_text(CURVES.replace("0.02", "0.03"))
    assert known(np.array([15.0])) == as_read
    there = f"import pickle; pickle.loads({pickle.dumps(known)!r})([15.0])"
    done = subprocess.run([sys.executable, "-c", there], capture_output=True, text=True, check=False)
    assert "its code is not that with which the study was read" in done.stderr
    assert Code().function(reference, Path())(np.array([15.0])) == pytest.approx([0.04])


@pytest.mark.parametrize("returned", ["0.1 * v.mean() + 0 * v", "0.1 * v / v.max()", "0.01 * v * next(CALLS)"])
def test_a_curve_of_more_than_the_magnitude_is_refused(here, sweep, returned):
    other = f"from itertools import count\n\nCALLS = count(1)\n\n\ndef motions(v):\n    return {returned}\n"
    (here / "curves.py").write_text(CURVES.replace("def motions(v)", "def unused(v)") + other)
    status, _, err = sweep("run", "own.toml", cwd=here)
    assert status == 2
    assert "model = 'coded': the error of proper motions at V = " in err
    assert "it must depend on nothing but the magnitude" in err
    assert not (here / "results").exists()


def test_a_smaller_study_leaves_a_larger_store_as_it_is(here):
    whole, _ = run(load_study("own.toml"))
    part, _ = run(edited(here, ('"gaia", "small", "coded"', '"tiny"'), ("model.small", "model.tiny")))
    np.testing.assert_array_equal(part["sigma_spin"], whole["sigma_spin"].sel(model=["small"]))
    assert open_dataset("s.zarr").equals(whole)
    run(edited(here, ('"gaia", "small", "coded"', '"small"'), ("150.0", "151.0")))
    assert open_dataset("s.zarr")["model"].values.tolist() == ["small"]


def test_another_curve_as_fixed_value_is_another_study(here, sweep):
    fixed = (("model = [", "# "), ("[fixed]", '[fixed]\nmodel = "small"'))
    run(edited(here, *fixed))
    edited(here, *fixed, ("150.0", "151.0"))
    status, _, err = sweep("run", "own.toml", "-o", "s.zarr", cwd=here)
    assert status == 2
    assert "fixed.model: 'sha256:" in err


def test_claims_exclusions_and_published_numbers_speak_of_names(here, sweep):
    (here / "p.csv").write_text("model,v_max,sigma_spin\nsmall,16,0.004\n")
    more = """
[[exclude]]
model = "coded"
v_max = 15.0

[published]
file = "p.csv"
source = "nobody"

[[claim]]
text = "brighter is worse"
source = "nobody"
published = "0.8"
ratio = { variable = "sigma_spin", of = { v_max = 16.0 }, to = { v_max = 15.0 } }
where = { model = "small" }
"""
    study = edited(here, ("n_cat = 2", f"n_cat = 2{more}"))
    dataset, failures = run(study)
    assert not failures
    assert dataset["sigma_spin_published"].sel(model="small", v_max=16.0) == 0.004
    assert np.isnan(dataset["sigma_spin"].sel(model="coded", v_max=15.0))
    _, out, _ = sweep("compare", "s.zarr", "--json", cwd=here)
    claim = next(c for c in json.loads(out)["comparisons"] if c["what"] == "brighter is worse")
    spin = dataset["sigma_spin"].sel(model="small")
    assert claim["where"] == {"model": "small"}
    assert claim["value"] == pytest.approx(spin.sel(v_max=16.0).item() / spin.sel(v_max=15.0).item(), rel=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"gaia", "small"', '"gaia", "smal"', "axes.model (line 4): model = 'smal': must be one of 'amex', "),
        ('"gaia", "small"', '"gaia", "smal"', "; did you mean 'small'?"),
        ("model.small", "modle.small", "define.modle.small (line 7): unknown parameter 'modle'; did you mean 'model'?"),
        (
            "model.small",
            "catalogue.small",
            "define.catalogue.small (line 7): catalogue takes no values that a study defines",
        ),
        ("model.small", "model.gaia", "define.model.gaia (line 7): 'gaia' is there already; take another name"),
        ("model.small", 'model."a=b"', "define.model.'a=b': a name begins with a letter"),
        (
            "[define.model.small]",
            "[define.model]",
            "define.model.nominal_length (line 8): input should be a valid dict",
        ),
        ("nominal_length = 3.0", "length = 3.0", "define.model.small.length (line 8): unknown key"),
        ("nominal_length = 3.0", "length = 3.0", "define.model.small.nominal_length (line 7): is required"),
        ("[13.0, 25.0]", "[8.0, 25.0]", "define.model.small.sigma_pm (line 10): row 2: magnitude 8 does not come"),
        ("25.0", "-25.0", "small.sigma_pm (line 10): row 2, sigma: -25.0: must be a number from 1e-06 to 1e+10"),
        ("curves.py:motions", "curve.py:motions", "define.model.coded.sigma_pm (line 15): there is no file "),
        ("curves.py:motions", "curves.py:motion", "'curves.py:motion': the module has no attribute 'motion'"),
        (
            "curves.py:motions",
            "curves.py:number",
            "'curves.py:number': the module has a int, not a function, at 'number'",
        ),
        ("curves.py:motions", "curves", "'curves': write module:attribute or file.py:attribute"),
        ("[15.0, 16.0]", "[15.0, 16.5]", "v_max = 16.5 mag: the curve of 'small' ends at 16 mag (1 point)"),
    ],
)
def test_what_is_wrong_is_refused_with_its_place(here, sweep, old, new, message):
    (here / "own.toml").write_text(STUDY.replace(old, new, 1))
    for command in ("plan", "run"):
        status, out, err = sweep(command, "own.toml", cwd=here)
        assert (status, out) == (2, "")
        assert message in err
        assert "Traceback" not in err
    assert not (here / "results").exists()


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("    raise RuntimeError('no coffee')", "the function 'motions' raises RuntimeError: no coffee (2 points)"),
        ("    return v - 14.0", "the function 'motions' returns -1.2 at V = 12.8 mag: must be positive and finite"),
        ("    return 3.0", "the function 'motions' returns float64 of shape (), not numbers of shape (1"),
        ("    syntax error", "cannot be imported: SyntaxError"),
    ],
)
def test_errors_in_a_function_are_told_before_anything_runs(here, sweep, body, message):
    (here / "curves.py").write_text(CURVES.replace("    return 0.02 + 0.01 * np.exp(0.4 * (v - 15.0))", body))
    status, out, err = sweep("run", "own.toml", cwd=here)
    assert (status, out) == (2, "")
    assert message in err
    assert not (here / "results").exists()
