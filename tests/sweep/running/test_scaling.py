"""`sweep scaling`, and grids of a million points that are planned, of a hundred thousand that run, in little memory."""

import json
import subprocess
import sys
import tempfile

import numpy as np
import pytest
import xarray as xr

from tests.conftest import COINS
from tests.sweep.opening import measure_scaling, study_from_dict


@pytest.fixture
def slow_clock(monkeypatch):
    """Runs whose seconds are known: the realisations over the workers, and 10 s a start; a list of what was run."""
    asked = []

    def timed(study, workers, pool):
        work = study.sampling.n_cat * study.sampling.n_sim
        asked.append((work, workers, pool))
        overhead = 1.0 if workers == 1 else 1.25
        return work / workers * overhead, 10.0

    monkeypatch.setattr("linksweep.sweep.running.scaling._timed", timed)
    return asked


def test_speed_up_and_efficiency_are_those_of_the_seconds(coins, slow_clock):
    study = study_from_dict(coins | {"sampling": {"n_sim": 100, "n_cat": 4, "seed": 1}})
    found = measure_scaling(study, [1, 2, 4], repetitions=5)
    assert found["seconds"].sel(kind="strong").values.tolist() == [400.0, 250.0, 125.0]
    assert found["seconds"].sel(kind="weak").values.tolist() == [400.0, 500.0, 500.0]
    for kind in ("strong", "weak"):  # every pair of workers loses a fifth
        assert found["efficiency"].sel(kind=kind).values == pytest.approx([1.0, 0.8, 0.8])
        assert found["speedup"].sel(kind=kind).values == pytest.approx([1.0, 1.6, 3.2])
    assert (found["start_seconds"] == 10.0).all()
    assert (found["efficiency_error"] == 0.0).all()
    assert found.attrs["weak_scaling_grows"] == "n_cat"
    assert found.attrs["title"] == "Scaling of “Coins”"
    assert max(work for work, _, _ in slow_clock) == 1600


def test_a_function_without_random_numbers_has_no_weak_scaling(tmp_path, sweep):
    """There is nothing to multiply; its command takes a function as `sweep run` does."""
    (tmp_path / "area.py").write_text("def area(width: float):\n    return width * 2.0\n")
    status, out, err = sweep(
        "scaling", f"{tmp_path}/area.py:area", "--axis", "width=1:9:1", "--pool", "threads", "--repetitions", "1",
        "--json", "-o", tmp_path / "s.zarr",
    )  # fmt: skip
    assert status == 0, err
    assert {(row["kind"], row["workers"]) for row in json.loads(out)["rows"]} == {("strong", 1), ("strong", 2)}


@pytest.mark.slow
def test_the_command_leaves_the_measurements_and_nothing_else(coins, tmp_path, sweep, monkeypatch):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setenv("TMPDIR", str(scratch))
    monkeypatch.setattr(tempfile, "tempdir", None)
    arguments = ["quasars", "--axis", "v_max=14", "--set", "n_cat=2", "--set", "n_sim=10", "--repetitions", "1"]
    status, out, err = sweep(
        "scaling", *arguments, "--pool", "threads", "--figure", "scaling.png", "--json", cwd=tmp_path
    )
    assert status == 0, err
    rows = json.loads(out)["rows"]
    assert [(row["kind"], row["workers"]) for row in rows] == [
        (kind, workers) for kind in ("strong", "weak") for workers in (1, 2)
    ]
    found = xr.open_zarr(tmp_path / "results" / "quasars-scaling.zarr", consolidated=False).load()
    assert found["efficiency"].dims == ("kind", "workers")
    assert np.allclose(found["speedup"], found["efficiency"] * found["workers"])
    assert (found["seconds"] > 0.0).all()
    assert (found["start_seconds"] > 0.0).all()
    assert {"versions", "host", "study_digest", "pool", "cores"} <= set(found.attrs)
    assert (tmp_path / "scaling.png").stat().st_size > 10_000
    assert sorted(p.name for p in (tmp_path / "results").iterdir()) == ["quasars-scaling.zarr"]
    assert not list(scratch.glob("linksweep*"))

    status, _, err = sweep("scaling", *arguments, cwd=tmp_path)
    assert status == 2
    assert "exists already" in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--workers", "2,4"], "must increase from 1"),
        (["--workers", "1,2,2"], "must increase from 1"),
        (["--workers", "1,5000"], "4096"),
        (["--workers", "1,two"], "no list of numbers"),
        (["--workers", "-1"], "no list of numbers"),
        (["--repetitions", "0"], "repetitions"),
        (["--set", "precision=0.1"], "decides itself"),
        (["--set", "n_sim=none"], "n_sim"),
        (["--figure", "scaling.txt"], "the name must end"),
    ],
)
def test_bad_input_is_refused_and_writes_nothing(arguments, words, tmp_path, sweep_here):
    status, _, err = sweep_here("scaling", "sqrt-n", *arguments, cwd=tmp_path)
    assert status == 2
    assert words in err
    assert not list(tmp_path.iterdir())


STUDY = """
title = "Many"
experiment = "{coins}"
[axes]
metal = ["gold", "tin"]
coins = {{ start = 1, stop = {coin_values}, step = 1 }}
chance = {{ start = 0.2, stop = 0.8, num = {chances} }}
[sampling]
n_sim = 1
"""

MEASURED = r"""
import re, resource, runpy, sys
sys.argv = ["sweep", *sys.argv[1:]]
try:
    runpy.run_module("linksweep", run_name="__main__")
finally:
    # of the program alone: ru_maxrss is at least that of the process that started it
    peak = re.search(r"VmHWM:\s+(\d+) kB", open("/proc/self/status").read())[1]
    print(peak, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, file=sys.stderr)
"""


def sweep_of(tmp_path, coin_values, chances, *command):
    """Run a command on a study of 2 x coin_values x chances points; return its output, and its own peak memory and that
    of the largest process that it started in MB.
    """
    (tmp_path / "many.toml").write_text(STUDY.format(coins=COINS, coin_values=coin_values, chances=chances))
    done = subprocess.run(
        [sys.executable, "-c", MEASURED, command[0], "many.toml", *command[1:]],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    own, others = (int(kilobytes) / 1024 for kilobytes in done.stderr.split()[-2:])
    return done.stdout, own, others


@pytest.mark.slow
def test_a_million_points_are_planned_in_little_memory(tmp_path):
    out, memory_mb, _ = sweep_of(tmp_path, 500, 1000, "plan", "--json")
    assert '"points": 1000000' in out
    assert memory_mb < 1000
    assert not list(tmp_path.glob("results*"))


@pytest.mark.slow
def test_a_hundred_thousand_points_run_to_the_end(tmp_path):
    _, few_mb, _ = sweep_of(tmp_path, 50, 100, "run", "--workers", "2", "--json", "-o", "few.zarr")
    _, many_mb, workers_mb = sweep_of(tmp_path, 50, 1000, "run", "--workers", "2", "--json", "-o", "many.zarr")
    dataset = xr.open_zarr(tmp_path / "many.zarr")
    assert dataset["status"].size == 100_000
    assert bool((dataset["status"] == 1).all())
    files = sum(path.is_file() for path in (tmp_path / "many.zarr").rglob("*"))
    assert files < 100
    # Ten times the points: what each leaves (its sums, its key, its row in the table) is below 2 kB in all.
    assert many_mb - few_mb < 90_000 * 2e-3
    assert max(many_mb, workers_mb) < 1000
