"""The mutation run: its texts stand in the code as it is, and the tests notice what they should."""

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.mutants import copy_of_checkout, misplaced, mutants

ROOT = Path(__file__).parent.parent


def is_a_test(name):
    """Whether a file of tests, or one test of it as pytest writes it, is there."""
    file, _, function = name.partition("::")
    return (ROOT / file).is_file() and f"def {function.partition('[')[0]}" in (ROOT / file).read_text()


@pytest.mark.parametrize("mutant", mutants(), ids=lambda mutant: f"{mutant['file']}: {mutant['new'][:40]}")
def test_the_text_of_a_mutant_stands_once_in_its_file(mutant):
    assert misplaced(mutant) is None
    assert mutant["new"] != mutant["old"]
    assert all(is_a_test(test) for test in mutant["test"].split())


@pytest.mark.slow
def test_a_copy_may_be_changed(tmp_path):
    copy = copy_of_checkout(tmp_path)
    assert (copy / "core" / "link.py").read_bytes() == (ROOT / "core" / "link.py").read_bytes()


@pytest.mark.slow
def test_a_sample_of_mutants_is_killed():
    command = [sys.executable, "benchmarks/mutants.py", "--sample", "5", "--seed", "1"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "5 of 5 killed" in run.stdout


@pytest.mark.slow
def test_it_tells_what_survives_from_what_is_killed_and_what_is_not_there(tmp_path):
    table = tmp_path / "table.toml"
    units = "tests/core/test_prediction.py::test_units_are_astropys"
    parts = "tests/core/test_shared_arrays.py::test_parts_cover_the_objects"
    rows = [("MAS / 1000.0", "MAS / 100.0", test) for test in (units, parts)] + [("no such text", "", units)]
    table.write_text(
        "".join(
            f'[[mutant]]\nfile = "core/constants.py"\nold = "{old}"\nnew = "{new}"\ntest = "{test}"\n'
            for old, new, test in rows
        )
    )
    command = [sys.executable, "benchmarks/mutants.py", "--table", str(table)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 1, run.stdout + run.stderr
    said = [line.split("  ")[0].strip() for line in run.stdout.splitlines()]
    assert said == ["killed", "SURVIVED", "NOT FOUND", "1 of 3 killed"]
