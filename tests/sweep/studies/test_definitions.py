"""Values of a parameter that a study defines: names, identity, stores, and everything that can be wrong in them."""

import numpy as np
import pytest

import linksweep
from linksweep import Experiment, Output, Parameter, SweepError
from linksweep.sweep.contract import DefinitionError
from tests.sweep.opening import bare
from tests.tiers import slow

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
sampling = { n_sim = 6, n_cat = 2 }
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
"""
WRONG = [('"gaia", "small"', '"gaia", "smal"', "axes.model (line 4): model = 'smal': must be one of 'amex', ")]
WRONG += [("model.small", "modle.small", "define.modle.small (line 6): unknown parameter 'modle'; did you mean 'model")]
WRONG += [("model.small", "model.gaia", "define.model.gaia (line 6): 'gaia' is there already; take another name")]
WRONG += [("nominal_length = 3.0", "length = 3.0", "define.model.small.length (line 7): unknown key")]
WRONG += [("nominal_length = 3.0", "length = 3.0", "define.model.small.nominal_length (line 6): is required")]
WRONG += [("[13.0, 25.0]", "[8.0, 25.0]", "define.model.small.sigma_pm (line 9): row 2: magnitude 8 does not come")]
WRONG += [("25.0", "-25.0", "small.sigma_pm (line 9): row 2, sigma: -25.0: must be a number from 1e-06 to 1e+10")]
WRONG += [("curves.py:motions", "curve.py:motions", "define.model.coded.sigma_pm (line 13): there is no file ")]
WRONG += [("curves.py:motions", "curves.py:number", "'curves.py:number': the module has a int, not a function, at")]
WRONG += [("[15.0, 16.0]", "[15.0, 16.5]", "v_max = 16.5 mag: the curve of 'small' ends at 16 mag (1 point)")]


def dice(points, n_sim, rng, catalogue_rng):
    faces = [range(1, 7) if isinstance(p["die"], str) else p["die"].value for p in points]
    return {"sum": [rng.choice(f, n_sim).sum() for f in faces]}


def define(table, load):
    if set(table) != {"faces"}:
        raise DefinitionError([("faces", "is all that a die has")])
    return tuple(table["faces"]), {"faces": sorted(table["faces"])}


@pytest.fixture
def here(here):
    (here / "curves.py").write_text(CURVES)
    edited(here)
    return here


def edited(here, *changes):
    text = STUDY
    for old, new in changes:
        text = text.replace(old, new, 1)
    (here / "own.toml").write_text(text)


def run(study="own.toml", store="s.zarr", **options):
    return linksweep.run(study, store, **({"pool": "serial"} | options))


@pytest.mark.usefixtures("here")
def test_an_experiment_of_any_kind_can_have_definitions(here):
    die = Parameter("die", "str", "cube", "what is thrown", choices=("cube",), define=define)
    colour = Parameter("colour", "str", "red", "of the die", choices=("red", "green"))
    declared = ("dice", 1, (die, colour), {"sum": ()}, (Output("mean", "", "mean number", headline=True),), dice)
    thrown = Experiment(*declared, summarise=lambda sums, n, n_cat: {"mean": sums["sum"] / n})
    study = {"experiment": thrown, "axes": {"die": ["cube", "low"]}, "sampling": {"n_sim": 2_000}}
    dataset = run(study | {"define": {"die": {"low": {"faces": [1, 1, 2]}}}})
    assert dataset["die"].values.tolist() == ["cube", "low"]
    np.testing.assert_allclose(dataset["mean"], [3.5, 4 / 3], atol=4 * 1.71 / 2_000**0.5)
    run(study | {"axes": {"colour": ["green"]}})  # which defines nothing
    assert "faces" in linksweep.open("s.zarr").attrs["study_document"]
    with pytest.raises(SweepError) as caught:
        run(study | {"define": {"die": {"low": {"side": 1}}, "colour": {"blue": {}}, "dye": {}}})
    blue = "define.colour.blue: colour takes no values that a study defines, but one of 'red', 'green'"
    dye = "define.dye: unknown parameter 'dye'; did you mean 'die'?"
    assert caught.value.problems == ["define.die.low.faces: is all that a die has", blue, dye]


@pytest.mark.parametrize("pool", ["serial", slow("threads"), slow("processes")])
def test_a_file_that_changes_after_the_study_was_read_changes_no_number(here, pool):
    read = linksweep.load_study("own.toml")
    (here / "curves.py").write_text(CURVES.replace("0.02", "0.2"))
    mixed = run(read, "mixed.zarr", pool=pool)
    (here / "curves.py").write_text(CURVES)
    pure = run(store="pure.zarr")
    done = mixed["status"].values == 1
    assert done.all() or not done[mixed["model"].values == "coded"].any()
    for name, values in bare(pure).drop_vars("status").items():
        if values.dims[:2] == ("model", "v_max"):
            np.testing.assert_array_equal(mixed[name].values[done], values.values[done], err_msg=name)


def test_a_store_is_reproduced_from_itself(here, sweep):
    dataset = run()
    assert dataset["model"].values.tolist() == ["gaia", "small", "coded"]
    assert np.all(np.isfinite(dataset["sigma_spin"]))
    (here / "own.toml").unlink()
    (here / "elsewhere").mkdir()
    assert sweep("reproduce", here / "s.zarr", "--at", "model=coded,v_max=16", cwd=here / "elsewhere")[0] == 0
    (here / "curves.py").write_text(CURVES.replace("0.02", "0.03"))
    assert "sigma_spin" in sweep("reproduce", "s.zarr", "--at", "model=coded,v_max=16", cwd=here, code=1)[2]
    (here / "curves.py").unlink()
    code, _, err = sweep("reproduce", "s.zarr", "--at", "model=gaia,v_max=16", cwd=here)
    assert (code, "define.model.coded.sigma_pm" in err, "there is no file " in err) == (2, True, True)


@pytest.mark.parametrize("returned", ["0.1 * v.mean() + 0 * v", "0.1 * v / v.max()", "0.01 * v * next(CALLS)"])
def test_a_curve_of_more_than_the_magnitude_is_refused(here, sweep, returned):
    other = f"from itertools import count\nCALLS = count(1)\ndef motions(v):\n    return {returned}\n"
    (here / "curves.py").write_text(CURVES + other)
    status, _, err = sweep("run", "own.toml", cwd=here)
    said = ("model = 'coded': the error of proper motions at V = ", "it must depend on nothing but the magnitude")
    assert (status, [words in err for words in said], (here / "results").exists()) == (2, [True, True], False)


def test_points_are_known_by_the_curve_and_not_by_its_name(here):
    whole = run()
    (here / "curves.py").write_text(CURVES.replace("0.02", "0.03"))
    with pytest.raises(SweepError, match="model: 'coded' is another value than in the store"):
        run()
    (here / "curves.py").write_text(CURVES)
    edited(here, ('"gaia", "small", "coded"', '"tiny"'), ("model.small", "model.tiny"))
    np.testing.assert_array_equal(run()["sigma_spin"], whole["sigma_spin"].sel(model=["small"]))
    assert linksweep.open("s.zarr").equals(whole)
    edited(here, ('"gaia", "small", "coded"', '"small"'), ("150.0", "151.0"))
    with pytest.raises(SweepError, match="model: 'small' is another value than in the store"):
        run()
    new, now = run(only=True), linksweep.open("s.zarr")  # the other curve has the name now
    assert now["model"].values.tolist() == ["small"]
    np.testing.assert_array_equal(now["sigma_spin"].sel(model=["small"]), new["sigma_spin"])
    assert not np.array_equal(whole["sigma_spin"].sel(model=["small"]), new["sigma_spin"])
    # as fixed value it is another study
    fixed = (("model = [", "# "), ("[15.0, 16.0]", "[15.0]"), ("[fixed]", '[fixed]\nmodel = "small"'))
    edited(here, *fixed)
    run(store="t.zarr")
    edited(here, *fixed, ("150.0", "151.0"))
    with pytest.raises(SweepError, match=r"fixed\.model: 'sha256:"):
        run(store="t.zarr")


@pytest.mark.parametrize(("old", "new", "message"), WRONG)
def test_what_is_wrong_is_refused_with_its_place(here, sweep, old, new, message):
    edited(here, (old, new))
    status, out, err = sweep("run", "own.toml", cwd=here)
    assert (status, out, message in err) == (2, "", True), err
    assert not (here / "results").exists()
