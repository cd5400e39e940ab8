"""`sweep new` writes a study that is true to the experiment, and `sweep params --schema` says what a study may be."""

import json
import re
import tomllib

import pytest
from jsonschema import Draft202012Validator

from linksweep import SweepError, load_study, run
from tests.conftest import COINS, run_sweep
from tests.sweep.mutations import corpus
from tests.tiers import slow

LINK = "linksweep.core.experiment:link"


def validator(reference=LINK, cwd=None):
    """The validator of the schema that `sweep params` prints."""
    code, out, err = run_sweep("params", "--schema", reference, cwd=cwd)
    assert (code, err) == (0, "")
    schema = json.loads(out, parse_constant=pytest.fail)
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


@pytest.fixture(scope="module")
def link_validator():
    return validator()


@pytest.mark.parametrize("reference", [COINS, slow(LINK)])
def test_a_new_study_runs_as_it_is_and_says_the_defaults_in_comments(reference, tmp_path, sweep):
    def plan(text):
        (tmp_path / "other.toml").write_text(text)
        code, out, err = sweep("plan", "other.toml", "-o", "s.zarr", "--set", "n_sim=5", "--json", cwd=tmp_path)
        return (json.loads(out) if code == 0 else {}), err

    code, out, err = sweep("new", "mine", reference, cwd=tmp_path)
    assert (code, out, "sweep plan mine.toml" in err) == (0, "", True), err
    code, out, err = sweep("run", "mine.toml", "--set", "n_sim=5", "-o", "s.zarr", cwd=tmp_path)
    assert (code, len(out.splitlines()) >= 4) == (0, True), err  # a heading and two points at least
    text = (tmp_path / "mine.toml").read_text()
    validator(reference).validate(tomllib.loads(text))
    begun, fixed = text.split("[fixed]")
    [axis] = tomllib.loads(text)["axes"]
    names = [parameter.name for parameter in load_study(str(tmp_path / "mine.toml")).experiment.parameters]
    assert re.findall(r"(?m)^# (\w+) =", fixed) == [name for name in names if name != axis]
    for line in re.findall(r"(?m)^# (\w+ = .*)$", fixed):
        report, err = plan(f"{begun}[fixed]\n{line}")  # a default has no effect with the values of some others
        assert report["points_done"] == report["points"] if report else "changes nothing" in err, line
    sampled = re.sub(r"^# (precision|max_n_sim) =", r"\1 =", begun, flags=re.MULTILINE)
    assert ("precision =" in sampled) == (reference == LINK)  # coins have no error to judge by
    assert plan(sampled)[0]


def test_every_study_of_ours_conforms_to_the_schema(link_validator):
    for text in corpus().values():
        if (document := tomllib.loads(text)).get("experiment", LINK) == LINK:  # others are only in a document
            link_validator.validate(document)


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
        {"points": {"design": "sobl", "n": 4, "ranges": {"v_max": [14, 15]}}},
        {"points": {"design": "sobol", "n": 4, "ranges": {"v_max": [14]}}},
        {"titel": "x"},
    ],
    ids=json.dumps,
)
def test_the_schema_refuses_what_a_run_refuses(wrong, link_validator, tmp_path):
    document = {"title": "t"} | wrong
    assert not link_validator.is_valid(document)
    with pytest.raises(SweepError):
        run(document, tmp_path / "s.zarr")


def test_the_schema_has_the_parameters_of_its_experiment(sweep):
    assert validator(COINS).schema["properties"]["fixed"]["properties"]["metal"]["enum"] == ["gold", "tin"]
    assert sweep("params", "--schema", "no.such:thing")[:2] == (2, "")
