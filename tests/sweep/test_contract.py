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
    "unknown dimension": (
        {"outputs": (Output("mean", "", "mean", ("tme",)),), "coordinates": {"time": ("a",)}},
        "dims: 'tme' is no dimension with labels in coordinates; did you mean 'time'?",
    ),
    "dims without a comma": (
        {"outputs": (Output("mean", "", "mean", "time"),), "coordinates": {"time": ("a",)}},
        "dims = 'time': must be a tuple",
    ),
    "a dimension like a parameter": ({"coordinates": {"rate": ("x",)}}, "dimension 'rate': is the name of another par"),
    "a parameter twice": ({"parameters": (Parameter("rate", "float", 1.0, "x"),) * 2}, "parameter 'rate': is the name"),
    "an output named status": ({"outputs": (Output("status", "", "x"),)}, "'status': the platform gives this name"),
    "a name for what is published": (
        {"outputs": (Output("mean", "", "x"), Output("mean_published", "", "x"))},
        "output 'mean_published': this name is for what is published of mean",
    ),
    "no unit": ({"outputs": (Output("mean", "metre", "x"),)}, "the unit 'metre' is none that astropy knows"),
    "a default out of bounds": (
        {"parameters": (Parameter("rate", "float", -1.0, "x", minimum=0.0),)},
        "parameter 'rate': its own default is not allowed: rate = -1.0: must be a finite number >= 0",
    ),
    "another signature": (
        {"evaluate": lambda points, rng: {}},
        "evaluate: takes (points, rng), but is called with (points, n_sim, rng, catalogue_rng)",
    ),
    "errors that are no output": (
        {"outputs": (Output("mean", "m", "x", errors=("eror",)), Output("error", "m", "x"))},
        "output 'mean': errors: 'eror' is no output with its dimensions and unit; did you mean 'error'?",
    ),
    "unknown shared": ({"shared": ("rat",)}, "shared: 'rat' is no parameter; did you mean 'rate'?"),
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
    said = ("user.py", "its own default", "'metre'", "'time' is no", "is the name of another", "'kind' is no parameter")
    assert all(words in err for words in said)
    assert len(err.splitlines()) < 12
    assert not (tmp_path / "s.zarr").exists()


RESULTS = {
    "sums of another length": (
        {"sums": '{"total": (5,)}', "evaluate": '{"total": [[1.0] * 4 for p in points]}'},
        "evaluate: the sum 'total' has the shape (1, 4), expected (1, 5)",
    ),
    "complex": ({"evaluate": '{"total": [1j for p in points]}'}, "of type complex128, expected real numbers"),
    "a misspelt sum": (
        {"evaluate": '{"totl": [1.0 for p in points]}'},
        "evaluate returns 'totl', which is no declared sum; did you mean 'total'?; evaluate does not return the sum",
    ),
    "a misspelt output": (
        {"summarise": '{"maen": sums["total"] / n}'},
        "summarise returns 'maen', which is no declared output; did you mean 'mean'?",
    ),
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
    before = """
        def draw(points, n_sim, rng, outer):
            kept = [rng.normal(size=n_sim + 1) for p in points]
            return {"total": [k.sum() for k in kept], "each": kept}
    """
    write_experiment(tmp_path, before=before, rest='samples=draw, sample_outputs=(Output("each", "", "each"),),')
    write_study(tmp_path, sampling="n_sim = 4\nkeep_samples = true")
    code, _, err = sweep("run", "s.toml", "-o", "s.zarr", cwd=tmp_path)
    assert (code, "'each' has the shape (1, 5), expected (1, 4)" in err) == (1, True)
