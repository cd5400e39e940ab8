"""A mutilated study document gives a valid study or a SweepError, never anything else."""

import json
import shutil
import subprocess
import sys
from collections import Counter

import pytest
from click.testing import CliRunner

import linksweep
from linksweep.sweep.cli import main
from tests.documents import save_files
from tests.sweep.mutations import ROOT, mutants
from tests.tiers import PATIENCE_S, few, slow

START = """title = "x"
[axes]
v_max = [16.0]
[fixed]
catalogue = "quasars"
"""
LARGE = {
    "an axis of 1000001 values by step": START.replace("[16.0]", "{ start = 14, stop = 16, step = 2e-6 }"),
    "a file of 50 MB": START + "#" * 50_000_000,
    "an axis of 1e9 values by number": START.replace("[16.0]", "{ start = 14, stop = 16, num = 1000000000 }"),
    "brackets without end": f"{START}omega = {'[' * 400_000}",
    "a key of 300 000 parts": f"{START}a{'.a' * 300_000} = 1",
    "90 000 tables": START + "".join(f"[t{i}]\n" for i in range(90_000)),
    "20 000 claims": START + "[[claim]]\ntext = 'a'\nsource = 'b'\npublished = '1'\n" * 20_000,
    "150 000 equal values": START.replace("[16.0]", f"[{'16.0,' * 150_000}]"),
    "80 000 zipped names": START + "[grid]\nzip = [[" + "'v_max'," * 80_000 + "]]",
    "10^18 realisations": f"{START}[sampling]\nn_cat = 1000000000\nn_sim = 1000000000",
}
ADDRESSES_KB = 2**20  # a gigabyte of addresses, of which the interpreter with NumPy, SciPy, Dask and xarray takes half


@pytest.mark.parametrize("number", [10**5000, -(10**5000)], ids=["large", "negative"])  # which Python does not print
@pytest.mark.parametrize("place", ["v_max", "n_obj", "model", "n_sim"])
def test_integers_that_cannot_be_printed(number, place, tmp_path):
    where = {"sampling": {place: number}} if place == "n_sim" else {"axes": {place: [number]}}
    with pytest.raises(linksweep.SweepError):
        linksweep.run({"title": "t", **where}, tmp_path / "s.zarr")


@pytest.fixture
def folder(here):
    shutil.copytree(ROOT / "sweeps" / "published", here / "published")
    save_files("experiments.md", here)
    return here


def check_answer(result, what):
    assert result.exit_code in (0, 2), (what, result.exception)  # 1 is any exception
    said = result.stderr if result.exit_code == 2 else "error: study.toml: "
    assert (said.startswith("error: study.toml: "), len(said) < 20_000) == (True, True), (what, said)
    assert all(line.isprintable() for line in said.splitlines()), (what, said)


@pytest.mark.parametrize("count", [60, slow(2000)])
def test_mutants_of_every_study_are_planned_or_refused(folder, count):
    codes = Counter()
    for what, text in mutants(20031, count):
        (folder / "study.toml").write_text(text, encoding="utf-8")
        result = CliRunner().invoke(main, ["plan", "study.toml"])
        check_answer(result, what)
        codes[result.exit_code] += 1
    assert min(codes[0], codes[2]) > count // 20  # the mutations are neither too gentle nor too wild


@pytest.mark.parametrize("count", [1, slow(100)])
def test_mutants_that_are_planned_can_be_run(folder, count):
    small = ["study.toml", "--set", "n_sim=2", "--set", "n_cat=1"]
    ran = 0
    for what, text in mutants(7, 5000):
        (folder / "study.toml").write_text(text, encoding="utf-8")
        planned = CliRunner().invoke(main, ["plan", *small, "--json"])
        check_answer(planned, what)
        if planned.exit_code or json.loads(planned.stdout)["points"] > 40 or "completeness" in what:
            continue  # the latter works seconds on each point
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


@pytest.mark.parametrize("case", few(1, LARGE))
def test_what_is_too_large_is_refused_soon_and_in_little_memory(tmp_path, case):
    (tmp_path / "study.toml").write_text(LARGE[case])
    command = ["sh", "-c", f"ulimit -v {ADDRESSES_KB}; exec {sys.executable} -m linksweep plan study.toml"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stderr[:19], "Traceback" in done.stderr) == (2, "error: study.toml: ", False)
