"""The mutation run: its mutants are programs, and the tests notice what they should."""

import ast
import subprocess
import sys

import pytest

from benchmarks.mutants import copy_of_checkout, mutants, nearest_tests
from tests.documents import ROOT

FRAMES = "core/frames.py"


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
@pytest.mark.parametrize(
    ("tests", "code", "words"),
    [
        ("tests/core/test_frames.py", 0, ["2 of 2 killed"]),
        ("tests/test_guarantees.py", 1, ["SURVIVED", f"{FRAMES}: triad: ", "0 of 2 killed"]),
    ],
)
def test_mutants_are_killed_or_named(tests, code, words):
    options = f"{FRAMES} --function triad --tests {tests} --sample 2"
    command = [sys.executable, "benchmarks/mutants.py", *options.split()]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stdout + done.stderr
    assert all(word in done.stdout for word in words)
