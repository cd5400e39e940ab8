"""What is given beside or in place of a study file: options that contradict each other, texts and objects as axes."""

import contextlib
import json
import re
import tomllib
from decimal import Decimal
from itertools import product
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, strategies as st
from jsonschema import Draft202012Validator

from linksweep import SweepError, experiment, load_study, run
from tests.conftest import COINS, run_sweep
from tests.sweep import user
from tests.sweep.mutations import corpus
from tests.tiers import slow

large = st.integers(-(2**62), 2**62)
LINK = "linksweep.core.experiment:link"
FIXED = {"catalogue": "quasar", "omega": [1.0, 2.0], "error_scale": -1.0, "corrections": "yes", "n_obj": 2.5}
AXES = [{"v_mx": [14.0]}, {"v_max": []}, {"v_max": {"start": 1.0, "stop": 2.0}}]
Full = Literal[1, "full"]
DESIGNS = [("sobl", [14, 15]), ("sobol", [14])]
WRONG = [*({"fixed": {name: value}} for name, value in FIXED.items()), *({"axes": axes} for axes in AXES)]
WRONG += [{"axes": {"model": {"start": 1.0, "stop": 2.0, "step": 1.0}}}, {"titel": "x"}, {"exclude": [{"v_mx": 14.0}]}]
WRONG += [{"sampling": {"n_sims": 5}}, {"sampling": {"n_sim": 0}}, {"define": {"catalogue": {"mine": {}}}}]
WRONG += [{"points": {"design": name, "n": 4, "ranges": {"v_max": low_high}}} for name, low_high in DESIGNS]


def load_law(**options):
    return load_study(f"{user.__file__}:law", **options)


def test_options_that_go_together():
    study = load_study("quasars", settings=["n_sim=10", "n_sim=10"], axes=["v_max=14,15", "v_max=14,15"])
    assert (study.sampling.n_sim, study.axes["v_max"]) == (10, (14.0, 15.0))
    assert load_study("quasars", settings=["n_sim=2000000", "precision=0.5"]).sampling.most == 2_000_000
    with pytest.raises(SweepError, match="no headline result X has an error"):
        load_study(COINS, ["precision=0.5"])
    options = {"design": "sobol:8", "ranges": ["error_scale=1:2"]}
    assert load_study("quasars", ["points.seed=4"], **options).points.origin["seed"] == 4
    assert load_study("quasars", axes=["""model="amex",'gaia'"""]).axes["model"] == ("amex", "gaia")
    changes = ({"settings": ["n_sim=10"]}, {"exclude": ["model=gaia"]}, {"settings": ["epsilon=[0,0,0]"]})
    assert [load_study("quasars", **one).conclusion is None for one in changes] == [False, True, True]


@given(st.text(max_size=40))
def test_any_text_is_an_axis_or_a_clear_error(text):
    with contextlib.suppress(SweepError):  # any other exception fails
        load_law(axes=[f"m={text}"])


def axis(text):
    return list(load_law(axes=[text]).axes[text.partition("=")[0]])


@given(large, st.integers(1, 10**6), st.integers(1, 30), st.integers(0, 10), st.sampled_from([1, -1]))
def test_a_range_of_integers_is_exact_and_has_both_ends(start, step, count, beyond, sign):
    """It ends at the last step that is not beyond its stop; so it does where any value is allowed."""
    step, beyond = sign * step, sign * min(beyond, step - 1)
    values = [start + i * step for i in range(count + 1)]
    if abs((stop := values[-1]) + beyond) < 2**63:
        assert repr(axis(f"e={start}:{stop + beyond}:{step}")) == repr(axis(f"n={start}:{stop}:{step}")) == str(values)
        assert axis(f"n={start}:{stop}:lin{count + 1}") == values


@given(st.integers(-(10**6), 10**6), st.integers(1, 10**4), st.integers(1, 30), st.integers(0, 5), st.booleans())
def test_a_range_of_decimal_numbers_has_the_numbers_that_are_written(start, step, count, places, falls):
    step = -step if falls else step
    # exact in any context: other tests set its precision
    written = [str(Decimal(f"{start + i * step}e-{places}")) for i in range(count + 1)]
    spec = f"a={written[0]}:{written[-1]}"
    assert axis(f"{spec}:{Decimal(f'{step}e-{places}')}") == [float(text) for text in written]
    assert axis(f"{spec}:lin{count + 1}") == [float(text) for text in written]


@given(st.floats(1e-6, 1e3), st.floats(1.5, 1e6), st.integers(2, 20))
def test_ranges_are_those_of_numpy_and_begin_and_end_where_it_is_written(low, times, number):
    """Values of 12 digits moved dates by 0.9 s, and both ends of any range."""
    high = low * times
    specs = {f"log{number}": np.geomspace(low, high, number), f"lin{number}": np.linspace(low, high, number)}
    for more, expected in {**specs, repr((high - low) / number): np.linspace(low, high, number + 1)}.items():
        values = axis(f"a={low!r}:{high!r}:{more}")
        assert values == pytest.approx(expected, rel=1e-14)
        assert [values[0], values[-1]] == [low, high]
    assert (axis("n=7:1234567890123:log2"), axis("a=1:1000:log4")) == ([7, 1234567890123], [1.0, 10.0, 100.0, 1000.0])
    assert axis("a=0:1:0.3333333333")[-1] == 1.0


def test_objects_without_order_or_that_give_their_values_once_and_steps_beyond_a_range_are_refused(tmp_path):
    far = {"start": 1, "stop": 2, "step": 3}
    for values in ({1, 2}, map(float, (1, 2)), 3.0, far, far | {"spacing": "log"}):
        with pytest.raises(SweepError, match=r"axes\.e: .*(write a list|does not lead)"):
            run(user.law, tmp_path / "s.zarr", axes={"e": values})


def validator(reference=LINK, cwd=None):
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
    names = [parameter.name for parameter in load_study(tmp_path / "mine.toml").experiment.parameters]
    assert re.findall(r"(?m)^# (\w+) =", fixed) == [name for name in names if name != axis]
    for line in re.findall(r"(?m)^# (\w+ = .*)$", fixed):
        report, err = plan(f"{begun}[fixed]\n{line}")  # a default has no effect with the values of some others
        assert report["points_done"] == report["points"] if report else "changes nothing" in err, line
    sampled = re.sub(r"^# (precision|max_n_sim) =", r"\1 =", begun, flags=re.MULTILINE)
    assert ("precision =" in sampled) == (reference == LINK)  # coins have no error to judge by
    assert plan(sampled)[0]
    (tmp_path / "f.py").write_text("def f(ä=1.0):\n    return ä\n")
    assert sweep("new", "ours", "f.py:f", cwd=tmp_path)[0] == sweep("run", "ours.toml", cwd=tmp_path)[0] == 0


def test_every_study_of_ours_conforms_to_the_schema_which_has_the_parameters_of_its_experiment(link_validator):
    for text in corpus().values():
        if (document := tomllib.loads(text)).get("experiment", LINK) == LINK:  # others are only in a document
            link_validator.validate(document)
    assert validator(COINS).schema["properties"]["fixed"]["properties"]["metal"]["enum"] == ["gold", "tin"]
    assert run_sweep("params", "--schema", "no.such:thing")[:2] == (2, "")
    assert run_sweep("params", COINS)[1].splitlines()[3] == "    a finite number >= 0.2 and <= 0.8"


@pytest.mark.parametrize("wrong", WRONG, ids=json.dumps)
def test_the_schema_refuses_what_a_run_refuses(wrong, link_validator, tmp_path):
    document = {"title": "t"} | wrong
    assert not link_validator.is_valid(document)
    with pytest.raises(SweepError):
        run(document, tmp_path / "s.zarr")


@experiment(when={"o": {"c": [1]}})
def kinds(cut: float | None = 1.0, free=None, m: list = [], c: Full | None = 1, o: Full = 1, f: Full | float = 1):  # noqa: B006
    return 1.0


def test_the_schema_takes_what_a_function_takes():
    schema = validator(f"{__file__}:kinds")
    values = ["'None'", "3", "1", "1.0", "[1, 2]", "{ a = 1 }", "2026-01-01", "'a'", "true"]
    for name, value in product(("cut", "free", "m", "c", "o", "f"), values):
        document = {"title": "t", "fixed": {name: tomllib.loads(f"v = {value}")["v"]}}
        with contextlib.nullcontext() if schema.is_valid(document) else pytest.raises(SweepError, match=name):
            load_study(f"{__file__}:kinds", [f"{name}={value}"])
