"""A mutilated study document gives a valid study or a SweepError, never anything else."""

import copy
import json
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from linksweep.sweep.cli import main
from linksweep.sweep.contract import SweepError
from linksweep.sweep.planning.grid import make_grid
from linksweep.sweep.studies.reader import study_from_dict
from tests.sweep.mutations import ROOT, mutants
from tests.tiers import PATIENCE_S, examples, slow

GOOD: dict[str, Any] = {
    "title": "A good study",
    "experiment": "linksweep.core.experiment:link",
    "axes": {"v_max": {"start": 14.0, "stop": 16.0, "step": 0.5}, "n_obj": [10, 11, 12, 13, 14], "model": ["amex"]},
    "fixed": {"catalogue": "quasars", "omega": [1.0, 2.0, 3.0], "corrections": False, "error_scale": 2.0},
    "sampling": {"n_sim": 10, "n_cat": 2, "seed": 3},
    "grid": {"zip": [["v_max", "n_obj"]]},
    "points": {"design": "random", "n": 3, "ranges": {"mission_length": {"low": 2.0, "high": 6.0, "spacing": "log"}}},
    "exclude": [{"model": "gaia", "v_max": {"above": 15.0}}, {"n_obj": {"in": [10, 11]}}],
    "published": {"file": "table.csv", "source": "A paper", "tolerance": 0.1, "tolerance_reason": "a guess"},
    "claim": [
        {
            **{"text": "A law", "source": "p. 1", "published": "-0.5", "exact": True, "where": {"model": "amex"}},
            "slope": {"variable": "sigma_spin", "over": "n_obj"},
        },
        {
            **{"text": "A ratio", "source": "p. 2", "published": "2", "tolerance": 0.1, "tolerance_reason": "a guess"},
            "ratio": {"variable": "sigma", "component": "omega_x", "of": {"v_max": 14.0}, "to": {"v_max": 15.0}},
        },
        {
            **{"text": "A value", "source": "p. 3", "published": "0.60"},
            "value": {"variable": "sigma_spin", "at": {"v_max": 14.0}},
        },
    ],
}

WORDS = """
    title experiment axes fixed sampling grid exclude published claim v_max n_obj model catalogue omega corrections
    n_sim seed zip file source start stop step num spacing log linear values above below equal in amex gaia
    synthetic quasars points design n ranges columns sobol low high text exact tolerance slope ratio value variable
    over component of to at where sigma covariance omega_x 0.60 nan mission_length satellite_errors normal none
    table.csv linksweep.core.experiment:link math:tau : x.py:y .
""".split()  # noqa: SIM905

keys = st.one_of(st.sampled_from(WORDS), st.sampled_from(["", "a.b", "\x1b[31m", "\0", "\n", "ä", "\u202e", "😀" * 50]))
numbers = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.integers(-3, 30),
    st.integers(),
    st.sampled_from([10**310, 2**64, 1e299, -1e299, 5e-324, -0.0, 14.0, 1e-200]),
)
scalars = st.one_of(numbers, st.booleans(), keys, st.text(max_size=5), st.dates(), st.just([]), st.just({}))
values = st.recursive(
    scalars,
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(keys, inner, max_size=4)),
    max_leaves=8,
)


def places(node: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place of a document, its containers included."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [here, *(place for key, child in items for place in places(child, (*here, key)))]


@st.composite
def documents(draw: st.DrawFn) -> dict[str, Any]:
    """The good study after one to four mutations: a value replaced, deleted or added somewhere."""
    document = copy.deepcopy(GOOD)
    for _ in range(draw(st.integers(1, 4))):
        *inner, last = draw(st.sampled_from(places(document)[1:] or [("title",)]))
        parent: Any = document
        for key in inner:
            parent = parent[key]
        what = draw(st.sampled_from(["replace", "replace", "delete", "add"]))
        if what == "replace":
            parent[last] = draw(values)
        elif what == "delete":
            del parent[last]
        elif isinstance(parent, dict):
            parent[draw(keys)] = draw(values)
        else:
            parent.insert(draw(st.integers(0, len(parent))), draw(values))
    return document


def outcome(document: dict[str, Any]) -> list[str]:
    """Return the problems of a document, none if it gives a study with a grid."""
    try:
        grid = make_grid(study_from_dict(document))
    except SweepError as error:
        problems = error.problems
    else:
        assert len(grid) > 0
        assert len(grid.study.digest()) == 64
        return []
    assert problems
    assert all(isinstance(p, str) and 0 < len(p) < 2000 and "\x1b" not in p for p in problems)
    return problems


@settings(max_examples=examples(60), derandomize=True, suppress_health_check=list(HealthCheck), database=None)
@given(document=documents())
def test_mutilated_documents(document: dict[str, Any]) -> None:
    untouched = copy.deepcopy(document)
    outcome(document)
    assert repr(document) == repr(untouched)


@pytest.mark.parametrize("number", [10**5000, -(10**5000)], ids=["large", "negative"])  # which Python does not print
@pytest.mark.parametrize("place", ["v_max", "n_obj", "model"])
def test_integers_that_cannot_be_printed(number: int, place: str) -> None:
    assert outcome(GOOD | {"axes": GOOD["axes"] | {place: [number]}})
    assert outcome(GOOD | {"sampling": {"n_sim": number}})
    assert outcome({key: value for key, value in GOOD.items() if key != "published"}) == []


class HangError(BaseException):
    """Not an Exception, which the code under test might catch."""


@contextmanager
def within(seconds: int) -> Iterator[None]:
    """Raise HangError in this block if it takes longer."""

    def hang(number: int, frame: object) -> None:
        raise HangError

    before = signal.signal(signal.SIGALRM, hang)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory with what the studies need beside them."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "sweeps" / "published", tmp_path / "published")
    walk = re.search(r"```python walk.py\n(.*?)```", (ROOT / "docs" / "experiments.md").read_text(), flags=re.DOTALL)
    assert walk is not None
    (tmp_path / "walk.py").write_text(walk[1])
    return tmp_path


def check_answer(result: Result, what: str) -> None:
    """Success, or one message for a terminal and exit code 2."""
    assert result.exception is None or isinstance(result.exception, SystemExit), (what, result.exception)
    assert result.exit_code in (0, 2), what
    if result.exit_code == 2:
        assert result.stderr.startswith("error: study.toml: "), (what, result.stderr)
        assert len(result.stderr) < 20_000, what
        assert all(c.isprintable() for line in result.stderr.splitlines() for c in line), (what, result.stderr)


@pytest.mark.parametrize("count", [100, slow(2000)])
def test_mutants_of_every_study_are_planned_or_refused(folder: Path, count: int) -> None:
    codes: Counter[int] = Counter()
    for what, text in mutants(20031, count):
        (folder / "study.toml").write_text(text, encoding="utf-8")
        with within(1200):
            result = CliRunner().invoke(main, ["plan", "study.toml"])
        check_answer(result, what)
        codes[result.exit_code] += 1
    assert min(codes[0], codes[2]) > count // 20  # the mutations are neither too gentle nor too wild


@pytest.mark.parametrize("count", [1, slow(100)])
def test_mutants_that_are_planned_can_be_run(folder: Path, count: int) -> None:
    small = ["study.toml", "--set", "n_sim=2", "--set", "n_cat=1"]
    ran = 0
    for what, text in mutants(7, 5000):
        (folder / "study.toml").write_text(text, encoding="utf-8")
        planned = CliRunner().invoke(main, ["plan", *small, "--json"])
        check_answer(planned, what)
        if planned.exit_code or json.loads(planned.stdout)["points"] > 40 or "completeness" in what:
            continue  # the latter works seconds on each point
        with within(1200):
            result = CliRunner().invoke(main, ["run", *small, "--pool", "serial", "--quiet"])
        if result.exit_code == 1:  # a walk of 1e18 steps is a good study, but no array holds it
            assert "failed: " in result.stderr, what
        else:
            check_answer(result, what)
            assert result.exit_code == 0, (what, result.stderr)
        shutil.rmtree(folder / "results")
        ran += 1
        if ran == count:
            return
    pytest.fail(f"only {ran} studies could be run")


START = """title = "x"
[axes]
v_max = [16.0]
[fixed]
catalogue = "quasars"
"""

LARGE = {
    "a file of 50 MB": START + "#" * 50_000_000,
    "a string of 50 MB": f'x = "{"a" * 50_000_000}"',
    "an axis of 1e9 values by step": START.replace("[16.0]", "{ start = 14, stop = 16, step = 2e-9 }"),
    "an axis of 1e9 values by number": START.replace("[16.0]", "{ start = 14, stop = 16, num = 1000000000 }"),
    "brackets without end": f"{START}omega = {'[' * 400_000}",
    "braces without end": f"{START}omega = {'{a=' * 200_000}",
    "a key of 300 000 parts": f"{START}a{'.a' * 300_000} = 1",
    "a table of 300 000 parts": f"{START}[a{'.a' * 300_000}]",
    "90 000 tables": START + "".join(f"[t{i}]\n" for i in range(90_000)),
    "20 000 claims": START + "[[claim]]\ntext = 'a'\nsource = 'b'\npublished = '1'\n" * 20_000,
    "150 000 equal values": START.replace("[16.0]", f"[{'16.0,' * 150_000}]"),
    "80 000 zipped names": START + "[grid]\nzip = [[" + "'v_max'," * 80_000 + "]]",
    "10^18 realisations": f"{START}[sampling]\nn_cat = 1000000000\nn_sim = 1000000000",
}
ADDRESSES_KB = 2**20
"""A gigabyte of addresses, of which the interpreter with NumPy, SciPy, Dask and xarray takes half."""


QUICK = {"an axis of 1e9 values by step"}


@pytest.mark.parametrize("case", [c if c in QUICK else pytest.param(c, marks=pytest.mark.slow) for c in LARGE])
def test_what_is_too_large_is_refused_soon_and_in_little_memory(tmp_path: Path, case: str) -> None:
    (tmp_path / "study.toml").write_text(LARGE[case])
    command = ["sh", "-c", f"ulimit -v {ADDRESSES_KB}; exec {sys.executable} -m linksweep plan study.toml"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("error: study.toml: ")
    assert "Traceback" not in done.stderr
