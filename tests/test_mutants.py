"""The mutation run: its mutants are programs, and the tests notice what they should."""

import ast
import subprocess
import sys

import pytest

from benchmarks.mutants import copy_of_checkout, mutants, nearest_tests
from tests.documents import ROOT

FRAMES = "core/frames.py"


def run(*options):
    command = [sys.executable, "benchmarks/mutants.py", *options]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


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
        assert nearest_tests(str(path.relative_to(ROOT))) != "."


@pytest.mark.slow
def test_a_copy_may_be_changed(tmp_path):
    copy = copy_of_checkout(tmp_path)
    assert (copy / FRAMES).read_bytes() == (ROOT / FRAMES).read_bytes()
    assert (copy / "linksweep" / FRAMES).resolve() == copy / FRAMES


@pytest.mark.slow
def test_a_sample_of_mutants_is_killed():
    done = run(FRAMES, "--function", "triad", "--tests", "tests/core/test_frames.py", "--sample", "5")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "5 of 5 killed" in done.stdout


@pytest.mark.slow
def test_what_no_test_notices_is_named():
    done = run(FRAMES, "--function", "triad", "--tests", "tests/test_guarantees.py", "--sample", "1")
    assert done.returncode == 1, done.stdout + done.stderr
    assert done.stdout.startswith("SURVIVED")
    assert f"{FRAMES}: triad: " in done.stdout
    assert "0 of 1 killed" in done.stdout
