"""Grids of a million points are planned, and of a hundred thousand run, within the memory of a small machine."""

import subprocess
import sys

import pytest
import xarray as xr

from tests.conftest import COINS

pytestmark = pytest.mark.slow  # a hundred thousand points and more

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


def test_a_million_points_are_planned_in_little_memory(tmp_path):
    out, memory_mb, _ = sweep_of(tmp_path, 500, 1000, "plan", "--json")
    assert '"points": 1000000' in out
    assert memory_mb < 1000
    assert not list(tmp_path.glob("results*"))


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
