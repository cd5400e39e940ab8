"""Every benchmark runs in its smallest size and says what it should; its numbers are for people, not for a test."""

import ast
import json
import math
import os
import subprocess
import sys

import pytest

from benchmarks.__main__ import BENCHMARKS, line
from benchmarks.measured import Measured, Target
from benchmarks.mutants import mutants, nearest_tests
from tests.documents import ROOT

FRAMES = "core/frames.py"
KILLED = "tests/core/test_frames.py", 0, ["2 of 2 killed"]
NAMED = "tests/test_guarantees.py", 1, ["SURVIVED", f"{FRAMES}: triad: ", "0 of 2 killed"]


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in BENCHMARKS if name != "functions"])  # all of it is about peers
def test_a_benchmark_runs(name, tmp_path):
    options = ("--tiny", "--without-peers", "--json", str(tmp_path / "r.json"))
    command = [sys.executable, "-m", "benchmarks", name, *options]
    other_kernels = os.environ | {"OPENBLAS_CORETYPE": "Prescott"}
    run = subprocess.run(command, cwd=ROOT, env=other_kernels, capture_output=True, text=True, check=False)
    assert run.returncode in (0, 1), run.stderr  # 1: a target is missed, as it may be on a busy machine
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["size"] == "tiny"
    assert "OPENBLAS_CORETYPE=Prescott" in report["without"]
    assert "OPENBLAS_CORETYPE=Prescott" in run.stdout.splitlines()[0]
    measured = report["benchmarks"][name]["measured"]
    assert len(measured) >= 3
    for one in measured:
        assert one["values"], one["name"]
        assert math.isfinite(one["value"]), one["name"]
        assert one["name"].strip() in run.stdout
        assert (one["verdict"] == "") == (one["target"] is None)
    assert any(one["value"] > 0.0 for one in measured)


def test_a_target_that_is_missed_is_said():
    for sign, verdict in ((">=", "MISSED"), ("<=", "holds")):
        said = line(Measured("name", [1.0, 3.0, 9.0], "x", Target(sign, 4.0)))
        assert said.split() == ["name", "3", "x", sign, "4", verdict]


@pytest.mark.slow
def test_the_benchmark_at_a_small_scale():
    command = [sys.executable, str(ROOT / "benchmarks" / "crossmatch.py"), "--scale", "0.01", "--json"]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    report = json.loads(run.stdout)
    assert report["stars"] == {"stars": 25_000, "supplement": 176}
    assert report["completeness_without_blunders"] > 0.9  # 27 of about 28 counterparts; the full size gives 0.998
    assert report["counterparts_found_twice"] == 0
    assert report["classes"]["all"]["false"] <= 3  # 0.02 chance pairs are expected


# ----- the mutation run: its mutants are programs, and the tests notice what they should


@pytest.mark.slow
@pytest.mark.parametrize("file", [FRAMES, "sweep/tables/reader.py"])
def test_a_mutant_is_a_program_that_differs_in_one_place(file):
    whole = (ROOT / file).read_bytes()
    assert len(mutants(file)) > 20
    for mutant in mutants(file):
        assert mutant.old != mutant.new
        changed = whole[: mutant.start] + mutant.new.encode() + whole[mutant.end :]
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(whole)), mutant


def test_every_file_has_tests():
    for path in [*(ROOT / "core").rglob("*.py"), *(ROOT / "sweep").rglob("*.py")]:
        assert "." not in nearest_tests(str(path.relative_to(ROOT)))


@pytest.mark.slow
@pytest.mark.parametrize(("tests", "code", "words"), [KILLED, NAMED])
def test_mutants_are_killed_or_named(tests, code, words):
    options = f"{FRAMES} --function triad --tests {tests} --sample 2"
    command = [sys.executable, "benchmarks/mutants.py", *options.split()]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stdout + done.stderr
    assert all(word in done.stdout for word in words)
