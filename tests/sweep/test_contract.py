"""What is declared wrongly, or returned otherwise than declared, is told by name in one message; nothing is guessed."""

import json
import math
import sys

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import linksweep
from linksweep.sweep.contract import Experiment, Output, Parameter, SweepError
from tests.sweep.user import write_experiment, write_study
from tests.tiers import examples

GOOD = {
    **{"name": "good", "version": 1, "parameters": (Parameter("rate", "float", 1.0, "rate"),), "sums": {"total": ()}},
    "outputs": (Output("mean", "", "mean"),),
    "evaluate": lambda points, n_sim, rng, catalogue_rng: {"total": [n_sim * p["rate"] for p in points]},
    "summarise": lambda sums, n, n_cat: {"mean": sums["total"] / n},
}
few, bound = st.integers(-3, 3), st.none() | st.integers(-2, 2)


def mean(*more, **others):
    return (Output("mean", "", "mean", **others), *more)


TIME = {"time": ("a",)}
WRONG = [  # what is declared, and what is said of it
    ({"outputs": mean()[0]}, "must be a tuple of Output"),
    ({"outputs": mean(dims=("tme",)), "coordinates": TIME}, "'tme' is no dimension with labels in coordinates; did"),
    ({"coordinates": {"rate": ("x",)}}, "dimension 'rate': is the name of another parameter"),
    ({"parameters": GOOD["parameters"] * 2}, "parameter 'rate': is the name of another parameter"),
    ({"outputs": mean(Output("mean_published"))}, "'mean_published': this name is for what is published of mean"),
    ({"evaluate": lambda points, rng: {}}, "takes (points, rng), but is called with (points, n_sim, rng, catalogue_"),
    ({"outputs": mean(Output("error"), errors=("eror",))}, "'eror' is no output with its dimensions and unit; did you"),
    ({"evaluate": None}, "evaluate = None: must be a function"),
    ({"packages": ("nunpy",)}, "packages: 'nunpy' is not installed"),
]


@pytest.mark.parametrize(("changed", "sentence"), WRONG, ids=[sentence[:40] for _, sentence in WRONG])
def test_a_wrong_declaration_is_one_sentence(changed, sentence):
    with pytest.raises(SweepError) as error:
        Experiment(**GOOD | changed)
    (only,) = error.value.problems
    assert sentence in only


@settings(max_examples=examples(1000))
@given(st.sampled_from(["float", "int"]), few | few.map(float) | st.booleans() | st.just(0.5), bound, bound, bound)
def test_a_number_is_allowed_within_its_bounds_and_nowhere_else(kind, raw, minimum, above, maximum):
    parameter = Parameter("x", kind, minimum=minimum, above=above, maximum=maximum)
    inside = (minimum is None or raw >= minimum) and (above is None or raw > above)
    inside = inside and (maximum is None or raw <= maximum) and not isinstance(raw, bool)
    if inside and (kind == "float" or raw == int(raw)):
        value = parameter.parse(raw)
        assert (value, type(value).__name__, math.copysign(1.0, value)) == (raw, kind, -1.0 if raw < 0 else 1.0)
    else:
        with pytest.raises(ValueError, match="x = "):
            parameter.parse(raw)
    assert math.copysign(1.0, Parameter("x", "float").parse(-0.0)) == 1.0  # else zero would be two points


def test_all_mistakes_of_a_file_are_told_at_once_and_shortly(tmp_path, sweep):
    wrong = {"parameters": 'Parameter("rate", "float", -1.0, "x", minimum=0.0),', "rest": "shared=('kind',),"}
    write_experiment(tmp_path, **wrong, outputs='Output("rate", "metre", "x", ("time",)),')
    write_study(tmp_path)
    code, out, err = sweep("run", "s.toml", "-o", "s.zarr", cwd=tmp_path)
    assert (code, out) == (2, "")
    said = ("user.py", "its own default", "'metre'", "'time' is no", "is the name of another", "'kind' is no parameter")
    assert all(words in err for words in said)
    assert len(err.splitlines()) < 12
    assert not (tmp_path / "s.zarr").exists()


def run(place, rates=(1.0, 2.0), sampling=None, **changed):
    study = {"title": "t", "axes": {"rate": list(rates)}, "sampling": {"n_sim": 4} | (sampling or {})}
    experiment = Experiment(**GOOD | changed)
    return linksweep.run(study | {"experiment": experiment}, place, pool="serial", max_failures="100%")


def gives(*values):
    return lambda points, n_sim, rng, catalogue_rng: {"total": [list(values) if len(values) > 1 else values[0]]}


def summary(make):
    return {"summarise": lambda sums, n, n_cat: {"mean": make(sums["total"])}}


def called(function):
    return {"evaluate": lambda points, n_sim, rng, catalogue_rng: function()}


THREE = {"sums": {"total": (3,)}, "evaluate": gives(1.0, math.nan, math.inf)} | summary(lambda total: total[:, 0])
RESULTS = [
    ({"sums": {"total": (5,)}, "evaluate": gives(1.0, 1.0)}, "the sum 'total' has the shape (1, 2), expected (1, 5)"),
    ({"evaluate": gives(1j)}, "of type complex128, expected real numbers"),
    (called(lambda: {"totl": [1.0]}), "'totl', which is no declared sum; did you mean 'total'?; evaluate does not"),
    ({"summarise": lambda sums, n, n_cat: {"maen": n}}, "'maen', which is no declared output; did you mean 'mean'?"),
    (summary(lambda total: np.ones((3, len(total)))), "summarise: the output 'mean' has the shape (3, "),
    *((THREE, "total has 1 NaN and 1 infinite of 3 values"), (summary(lambda total: total * math.nan), "mean is NaN")),
    (called(lambda: sys.exit(3)), "SystemExit: 3"),
]


@pytest.mark.parametrize(("changed", "sentence"), RESULTS, ids=[sentence[:40] for _, sentence in RESULTS])
def test_a_result_that_is_not_what_is_declared_fails_its_point_by_name(changed, sentence, tmp_path):
    dataset = run(tmp_path / "s.zarr", **changed)
    assert dataset["status"].values.tolist() == [2, 2]
    assert np.isnan(dataset["mean"]).all()
    assert all(sentence in message for message in json.loads(dataset.attrs["failures"]).values())


def test_only_points_with_wrong_results_fail_among_many_and_again(tmp_path, sweep):
    summarise = '{"mean": 1.0 / (sums["total"] - 3.0 * n) + 0.0 * n}'
    write_experiment(tmp_path, summarise=summarise, outputs='Output("mean", "", "mean"),')  # no headline
    write_study(tmp_path, "rate = [1.0, 2.0, 3.0, 4.0]")
    for command in (("run", "s.toml", "-o", "s.zarr"), ("run", "--retry", "s.zarr")):  # its blocks are in the ledger
        code, out, err = sweep(*command, cwd=tmp_path)
        assert (code, out.splitlines()[1].split()) == (1, ["rate", "mean", "status"])
        assert "1 point failed: mean is infinite, at rate=3.0" in err
    assert linksweep.open(tmp_path / "s.zarr")["mean"].values[[0, 1, 3]].tolist() == [-0.125, -0.25, 0.25]


def test_nan_is_a_value_where_it_is_declared_warnings_count_points_and_samples_are_held_to_what_is_declared(tmp_path):
    declared = {"outputs": (Output("mean", "", "mean", nan=True),), "nan_sums": ("total",)}
    dataset = run(tmp_path / "s.zarr", evaluate=gives(math.nan), warn=lambda point: ["careful"], **declared)
    assert (dataset["status"].values.tolist(), dataset.attrs["warnings"]) == ([1, 1], '["careful (2 points)"]')
    with pytest.raises(SweepError, match="has no samples to keep"):
        run(tmp_path / "t.zarr", sampling={"keep_samples": True})

    def draw(points, n_sim, rng, catalogue_rng):
        kept = [rng.normal(size=n_sim + 1) for p in points]
        return {"total": [k.sum() for k in kept], "each": kept}

    declared = {"samples": draw, "sample_outputs": (Output("each", "", "each"),)}
    failures = run(tmp_path / "t.zarr", sampling={"keep_samples": True}, **declared).attrs["failures"]
    assert "'each' has the shape (1, 5), expected (1, 4)" in failures
