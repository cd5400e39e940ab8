"""What is declared wrongly, or returned otherwise than declared, is told by name in one message; nothing is guessed."""

import json

import numpy as np
import pytest

import linksweep
from linksweep.sweep.contract import Experiment, Output, Parameter, SweepError
from tests.sweep.user import write_experiment, write_study

GOOD = {
    "name": "good",
    "version": 1,
    "parameters": (Parameter("rate", "float", 1.0, "rate"),),
    "sums": {"total": ()},
    "outputs": (Output("mean", "", "mean"),),
    "evaluate": lambda points, n_sim, rng, catalogue_rng: {},
    "summarise": lambda sums, n, n_cat: {},
}

WRONG = {
    "a missing comma": ({"outputs": Output("mean", "", "mean")}, "must be a tuple of Output"),
    "no tuple": ({"parameters": "rate"}, "parameters = 'rate': must be a tuple of Parameter"),
    "unknown dimension": (
        {"outputs": (Output("mean", "", "mean", ("tme",)),), "coordinates": {"time": ("a",)}},
        "dims: 'tme' is no dimension with labels in coordinates; did you mean 'time'?",
    ),
    "dims without a comma": (
        {"outputs": (Output("mean", "", "mean", "time"),), "coordinates": {"time": ("a",)}},
        "dims = 'time': must be a tuple",
    ),
    "labels that repeat": ({"coordinates": {"axis": ("x", "x")}}, "coordinates['axis']: 'x' is listed twice"),
    "labels as one text": ({"coordinates": {"axis": "xyz"}}, "coordinates['axis'] = 'xyz': must be a tuple of str"),
    "a dimension like a parameter": ({"coordinates": {"rate": ("x",)}}, "dimension 'rate': is the name of another par"),
    "an output like a dimension": ({"coordinates": {"mean": ("x",)}}, "dimension 'mean': is the name of another outpu"),
    "an output twice": ({"outputs": (Output("mean", "", "x"),) * 2}, "output 'mean': is the name of another output"),
    "a parameter twice": ({"parameters": (Parameter("rate", "float", 1.0, "x"),) * 2}, "parameter 'rate': is the name"),
    "an output named status": ({"outputs": (Output("status", "", "x"),)}, "'status': the platform gives this name"),
    "a name for what is published": (
        {"outputs": (Output("mean", "", "x"), Output("mean_published", "", "x"))},
        "output 'mean_published': this name is for what is published of mean",
    ),
    "a name that is none": ({"outputs": (Output("a/b", "", "x"),)}, "output 'a/b': a name begins with a letter"),
    "no unit": ({"outputs": (Output("mean", "metre", "x"),)}, "the unit 'metre' is none that astropy knows"),
    "half a unit": ({"outputs": (Output("mean", "m /", "x"),)}, "the unit 'm /' is none that astropy knows"),
    "a default out of bounds": (
        {"parameters": (Parameter("rate", "float", -1.0, "x", minimum=0.0),)},
        "parameter 'rate': its own default is not allowed: rate = -1.0: must be a finite number >= 0",
    ),
    "a default that is no choice": (
        {"parameters": (Parameter("rate", "str", "a", "x", choices=("b", "c")),)},
        "rate = 'a': must be one of 'b', 'c'",
    ),
    "a kind that is none": ({"parameters": (Parameter("rate", "flaot", 1.0, "x"),)}, "did you mean 'float'?"),
    "no function": ({"evaluate": 3}, "evaluate = 3: must be a function"),
    "another signature": (
        {"evaluate": lambda points, rng: {}},
        "evaluate: takes (points, rng), but is called with (points, n_sim, rng, catalogue_rng)",
    ),
    "sums that are no shapes": ({"sums": {"total": 3}}, "sums['total'] = 3: must be a tuple of int"),
    "no sums": ({"sums": {}}, "must give the shape of each sum"),
    "errors that are no output": (
        {"outputs": (Output("mean", "m", "x", errors=("eror",)), Output("error", "m", "x"))},
        "output 'mean': errors: 'eror' is no output with its dimensions and unit; did you mean 'error'?",
    ),
    "unknown shared": ({"shared": ("rat",)}, "shared: 'rat' is no parameter; did you mean 'rate'?"),
    "samples alone": ({"samples": lambda p, n, r, c: {}}, "samples: needs sample_outputs"),
    "a package that is not there": ({"packages": ("nunpy",)}, "packages: 'nunpy' is not installed"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_declaration_is_one_sentence(case):
    changed, sentence = WRONG[case]
    with pytest.raises(SweepError) as error:
        Experiment(**GOOD | changed)
    (only,) = error.value.problems
    assert sentence in only


def test_a_right_declaration_is_taken():
    Experiment(**GOOD)
    Experiment(**GOOD | {"outputs": (Output("mean", "kg m2 / s", "x"), Output("b", "%", "x"), Output("c", "1/d", "x"))})
    decided = (Parameter("rate", "float", None, "the experiment decides"),)
    Experiment(**GOOD | {"parameters": decided, "outputs": (Output("rate", "", "what it decided"),)})


def test_all_mistakes_of_a_file_are_told_at_once_and_shortly(tmp_path, sweep):
    write_experiment(
        tmp_path,
        parameters='Parameter("rate", "float", -1.0, "x", minimum=0.0),',
        outputs='Output("rate", "metre", "x", ("time",)),',
        rest="shared=('kind',),",
    )
    write_study(tmp_path)
    code, out, err = sweep("run", "s.toml", "-o", "s.zarr", cwd=tmp_path)
    assert (code, out) == (2, "")
    for words in (
        "its own default",
        "'metre'",
        "'time' is no dimension",
        "is the name of another parameter",
        "'kind' is no parameter",
    ):
        assert words in err
    assert "user.py" in err
    assert "Traceback" not in err
    assert len(err.splitlines()) < 12
    assert not (tmp_path / "s.zarr").exists()


RESULTS = {
    "sums of another length": (
        {"sums": '{"total": (5,)}', "evaluate": '{"total": [[1.0] * 4 for p in points]}'},
        "evaluate: the sum 'total' has the shape (1, 4), expected (1, 5)",
    ),
    "text": ({"evaluate": '{"total": ["many" for p in points]}'}, "the sum 'total' is of type <U4, expected real numb"),
    "complex": ({"evaluate": '{"total": [1j for p in points]}'}, "of type complex128, expected real numbers"),
    "nothing": ({"evaluate": "None"}, "evaluate returns a NoneType, not a mapping of sums by name"),
    "a misspelt sum": (
        {"evaluate": '{"totl": [1.0 for p in points]}'},
        "evaluate returns 'totl', which is no declared sum; did you mean 'total'?; evaluate does not return the sum",
    ),
    "a misspelt output": (
        {"summarise": '{"maen": sums["total"] / n}'},
        "summarise returns 'maen', which is no declared output; did you mean 'mean'?",
    ),
    "an output of another shape": (
        {"summarise": '{"mean": (sums["total"] / n)[:, None] * [1, 2]}'},
        "summarise: the output 'mean' has the shape (1, 2), expected (1,)",
    ),
    "a summarise that raises": ({"summarise": '{"mean": sums["x"]}'}, "KeyError: 'x'"),
    "NaN in a scalar": ({"evaluate": '{"total": [float("nan") for p in points]}'}, "total is NaN"),
    "NaN in an array": (
        {
            "sums": '{"total": (3,)}',
            "evaluate": '{"total": [[1.0, float("nan"), float("inf")] for p in points]}',
            "summarise": '{"mean": sums["total"][:, 0]}',
        },
        "total has 1 NaN and 1 infinite of 3 values",
    ),
    "NaN in a result": ({"summarise": '{"mean": sums["total"] * float("nan")}'}, "mean is NaN"),
    "sys.exit": ({"before": "import sys\n", "evaluate": "sys.exit(3)"}, "SystemExit: 3"),
    "an exception of its own": (
        {
            "before": "class Stop(BaseException):\n    pass\n\n\ndef stop():\n    raise Stop('enough')\n",
            "evaluate": "stop()",
        },
        "Stop: enough",
    ),
}


@pytest.mark.parametrize("case", RESULTS)
def test_a_result_that_is_not_what_is_declared_fails_its_point_by_name(case, tmp_path, sweep):
    parts, sentence = RESULTS[case]
    write_experiment(tmp_path, **parts)
    write_study(tmp_path, "kind = [1, 2, 3]")
    code, out, err = sweep("run", "s.toml", "-o", "s.zarr", "--json", cwd=tmp_path)
    assert code == 1
    assert "Traceback" not in err
    assert json.loads(out)
    dataset = linksweep.open(tmp_path / "s.zarr")
    assert dataset["status"].values.tolist() == [2, 2, 2]
    assert np.isnan(dataset["mean"]).all()
    failures = json.loads(dataset.attrs["failures"])
    assert all(sentence in message for message in failures.values())
    assert "3 points failed" in err
    assert ", for example at kind=1" in err
    code, _, _ = sweep("run", "--retry", "s.zarr", cwd=tmp_path)
    assert code == 1  # and is not taken for done because its blocks are in the ledger


def test_only_points_with_wrong_results_fail_among_many(tmp_path, sweep):
    write_experiment(tmp_path, summarise='{"mean": 1.0 / (sums["total"] - 3.0 * n) + 0.0 * n}')
    write_study(tmp_path, "rate = [1.0, 2.0, 3.0, 4.0]")
    code, _, err = sweep("run", "s.toml", "-o", "s.zarr", cwd=tmp_path)
    assert code == 1
    assert "1 point failed: mean is infinite, at rate=3.0" in err
    assert linksweep.open(tmp_path / "s.zarr")["mean"].values[[0, 1, 3]].tolist() == [-0.125, -0.25, 0.25]


def test_nan_is_a_value_where_it_is_declared(tmp_path, sweep):
    write_experiment(
        tmp_path,
        evaluate='{"total": [float("nan") for p in points]}',
        outputs='Output("mean", "", "mean", headline=True, nan=True),',
        rest='nan_sums=("total",),',
    )
    write_study(tmp_path)
    code, _, _ = sweep("run", "s.toml", "-o", "s.zarr", cwd=tmp_path)
    assert code == 0
    assert linksweep.open(tmp_path / "s.zarr")["status"].values.tolist() == [1, 1]


def test_samples_are_held_to_what_is_declared(tmp_path, sweep):
    rest = 'samples=draw, sample_outputs=(Output("each", "", "each"),),'
    before = """
        def draw(points, n_sim, rng, outer):
            kept = [rng.normal(size=n_sim + WRONG) for p in points]
            return {"total": [k.sum() for k in kept], "each": kept}
    """
    write_study(tmp_path, sampling="n_sim = 4\nkeep_samples = true")
    for wrong, expected in ((0, 0), (1, 1)):
        write_experiment(tmp_path, before=before.replace("WRONG", str(wrong)), rest=rest)
        code, _, err = sweep("run", "s.toml", "-o", f"{wrong}.zarr", cwd=tmp_path)
        assert code == expected
    assert "samples: the sample output 'each' has the shape (1, 5), expected (1, 4)" in err
