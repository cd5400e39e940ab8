"""`sweep new` writes a study that is true to the experiment, and `sweep params --schema` says what a study may be."""

import json
import re
import tomllib

import pytest
from hypothesis import HealthCheck, assume, given, settings
from jsonschema import Draft202012Validator

from linksweep.sweep.code.load import load_experiment
from linksweep.sweep.contract import SweepError
from linksweep.sweep.planning.grid import make_grid
from linksweep.sweep.studies.reader import study_from_dict
from linksweep.sweep.studies.study import new_study, study_schema
from tests.conftest import COINS
from tests.sweep.mutations import corpus
from tests.sweep.studies.test_study_fuzz import GOOD, documents

LINK = "linksweep.core.experiment:link"


def validator(reference=LINK):
    schema = study_schema(load_experiment(reference))
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(json.loads(json.dumps(schema)))


LINK_VALIDATOR = validator()


def digests(document):
    return [point.digest for point in make_grid(study_from_dict(document)).points()]


@pytest.mark.parametrize("reference", [LINK, COINS])
def test_a_new_study_runs_as_it_is(reference, tmp_path, sweep):
    code, out, err = sweep("new", "mine", reference, cwd=tmp_path)
    assert (code, out) == (0, ""), err
    assert "sweep plan mine.toml" in err
    store = tmp_path / "s.zarr"
    code, out, err = sweep(
        "run", tmp_path / "mine.toml", "--set", "n_sim=5", "-o", store, "--pool", "serial", cwd=tmp_path
    )
    assert code == 0, err
    assert "mine" not in out.splitlines()[1]
    assert len(out.splitlines()) >= 4  # a heading and two points at least
    validator(reference).validate(tomllib.loads((tmp_path / "mine.toml").read_text()))


@pytest.mark.parametrize("reference", [LINK, COINS])
def test_what_it_says_in_comments_are_the_defaults(reference):
    text = new_study("mine", reference, load_experiment(reference))
    without = tomllib.loads(text)
    [axis] = without["axes"]
    begun, fixed = text.split("[fixed]")
    lines = re.findall(r"^# (\w+ = .*)$", fixed, flags=re.MULTILINE)
    assert len(lines) > 1
    for line in lines:
        try:
            has_changed = digests(tomllib.loads(begun + "[fixed]\n" + line)) != digests(without)
        except SweepError as error:
            has_changed = "changes nothing" not in str(error)  # with the values of the others
        assert not has_changed, line
    sampled = re.sub(r"^# (precision|max_n_sim) =", r"\1 =", begun, flags=re.MULTILINE)
    assert ("precision =" in sampled) == (reference == LINK)  # coins have no error to judge by
    study_from_dict(tomllib.loads(sampled))
    names = re.findall(r"^# (\w+) =", fixed, flags=re.MULTILINE)
    assert names == [p.name for p in load_experiment(reference).parameters if p.name != axis]


ODD = """
import math
import numpy as np
from linksweep.sweep.contract import Experiment, Output, Parameter

def check(point):
    if point["kind"] != "a":
        raise ZeroDivisionError

experiment = Experiment(
    "odd", 1,
    (
        Parameter("x", "vector", (0.0, 1.5, 2.0), "a\\nvector\\x1b[31m", "mas"),
        Parameter("m", "map", (("a b", "\\x7f"),), "a map"),
        Parameter("f", "file", None, "a file"),
        Parameter("n", "int", np.int64(3), "a number", maximum=math.inf, minimum=1),
        Parameter("kind", "str", "a", "kind", choices=("a", "b")),
        Parameter("word", "str", "\\x7f\\"", "any word"),
    ),
    {"a": ()},
    (Output("a", "", "it", headline=True),),
    evaluate=lambda points, n_sim, rng, catalogue_rng: {"a": [1.0] * len(points)},
    summarise=lambda sums, n, n_cat: sums,
    check=check,
)
""".replace("\\\\", "\\")


def test_an_odd_experiment(tmp_path, sweep):
    """With parameters that cannot be axes or hold what TOML cannot, and a check that raises."""
    (tmp_path / "odd.py").write_text(ODD)
    code, _, err = sweep("new", "mine", "odd.py:experiment", cwd=tmp_path)
    assert code == 0, err
    text = (tmp_path / "mine.toml").read_text()
    assert tomllib.loads(text)["axes"] == {"n": [3]}
    code, _, err = sweep("plan", "mine.toml", cwd=tmp_path)
    assert code == 0, err
    lines = re.findall(r"^# (\w+ = .*)$", text.split("[fixed]")[1], flags=re.MULTILINE)
    assert len(lines) == 4
    (tmp_path / "all.toml").write_text("\n".join([text, *lines]))
    code, _, err = sweep("plan", "all.toml", cwd=tmp_path)
    assert code == 0, err
    code, out, err = sweep("params", "--schema", "odd.py:experiment", cwd=tmp_path)
    assert code == 0, err
    schema = json.loads(out, parse_constant=pytest.fail)
    Draft202012Validator(schema).validate(tomllib.loads((tmp_path / "all.toml").read_text()))
    for name, value in schema["properties"]["fixed"]["properties"].items():
        if "default" in value:
            Draft202012Validator(value).validate(value["default"])
        axis = {"title": "t", "experiment": "odd.py:experiment", "axes": {name: [value.get("default")]}}
        assert (name in schema["properties"]["axes"]["properties"]) == (name in ("n", "kind", "word"))
        assert Draft202012Validator(schema).is_valid(axis) == (name in ("n", "kind", "word"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("taken",), "taken.toml: exists already; take another name"),
        (("../up",), "'../up' is no name for a study"),
        (("fine", "no.such:thing"), "no.such"),
        (("fine", "math:tau"), "math:tau"),
    ],
)
def test_what_cannot_be_begun(arguments, said, tmp_path, sweep):
    (tmp_path / "taken.toml").write_text("mine")
    code, out, err = sweep("new", *arguments, cwd=tmp_path)
    assert (code, out) == (2, "")
    assert said in err
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("taken.toml", "mine")]


@pytest.mark.parametrize("name", sorted(corpus()))
def test_every_study_of_ours_conforms_to_the_schema(name):
    document = tomllib.loads(corpus()[name])
    reference = document.get("experiment", LINK)
    if reference != LINK:
        pytest.skip("of another experiment, which only a document shows")
    LINK_VALIDATOR.validate(document)


@pytest.mark.parametrize(
    "wrong",
    [
        {"axes": {"v_mx": [14.0]}},
        {"axes": {"v_max": []}},
        {"axes": {"v_max": {"start": 1.0, "stop": 2.0}}},
        {"axes": {"model": {"start": 1.0, "stop": 2.0, "step": 1.0}}},
        {"fixed": {"catalogue": "quasar"}},
        {"fixed": {"omega": [1.0, 2.0]}},
        {"fixed": {"error_scale": -1.0}},
        {"fixed": {"corrections": "yes"}},
        {"fixed": {"n_obj": 2.5}},
        {"sampling": {"n_sims": 5}},
        {"sampling": {"n_sim": 0}},
        {"define": {"catalogue": {"mine": {}}}},
        {"exclude": [{"v_mx": 14.0}]},
        {"titel": "x"},
    ],
    ids=json.dumps,
)
def test_the_schema_refuses_what_plan_refuses(wrong):
    document = {"title": "t"} | wrong
    assert not LINK_VALIDATOR.is_valid(document)
    with pytest.raises(SweepError):
        make_grid(study_from_dict(document))


@pytest.mark.slow
@given(documents())
@settings(max_examples=30, derandomize=True, suppress_health_check=list(HealthCheck), database=None)
def test_what_plan_accepts_conforms_to_the_schema(document):
    without_files = {key: value for key, value in document.items() if key != "published"}
    try:
        study = study_from_dict(without_files)
    except SweepError:
        assume(False)
    assume(study.experiment_reference == LINK)
    LINK_VALIDATOR.validate(without_files)


def test_the_schema_is_printed(sweep):
    assert LINK_VALIDATOR.is_valid({k: v for k, v in GOOD.items() if k != "published"})
    code, out, err = sweep("params", "--schema", COINS)
    assert (code, err) == (0, "")
    assert json.loads(out)["properties"]["fixed"]["properties"]["metal"]["enum"] == ["gold", "tin"]
    code, out, err = sweep("params", "--schema", "no.such:thing")
    assert (code, out) == (2, "")
