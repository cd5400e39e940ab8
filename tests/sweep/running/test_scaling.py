"""`sweep scaling`, and grids of a million points that are planned, of a hundred thousand that run, in little memory."""

import json
import sys
import tempfile

import numpy as np
import pytest
import xarray as xr

from benchmarks.measured import watch
from tests.conftest import COINS


@pytest.mark.slow
def test_the_command_leaves_the_measurements_and_nothing_else(tmp_path, sweep, monkeypatch):
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "scratch"))
    arguments = ["quasars", "--axis", "v_max=14", "--set", "n_cat=2", "--set", "n_sim=10", "--repetitions", "1"]
    out = sweep("scaling", *arguments, "--pool", "threads", "--json", cwd=tmp_path, code=0)[1]
    pairs = [(row["kind"], row["workers"]) for row in json.loads(out)["rows"]]
    assert pairs == [(kind, workers) for kind in ("strong", "weak") for workers in (1, 2)]
    result = xr.open_zarr(tmp_path / "results" / "quasars-scaling.zarr", consolidated=False).load()
    assert (result["efficiency"].dims, result.attrs["repetitions"]) == (("kind", "workers"), 1)
    assert np.allclose(result["speedup"], result["efficiency"] * result["workers"])
    more = xr.where(result["kind"] == "weak", result["workers"], 1.0)  # of the work
    assert np.allclose(result["speedup"], more * result["seconds"].sel(workers=1) / result["seconds"])
    assert (result.weak_scaling_grows, result.title[:10]) == ("n_cat", "Scaling of")
    assert ((result["seconds"] > 0.0) & (result["start_seconds"] > 0.0)).all()
    assert {"versions", "host", "study_digest", "pool", "cores"} <= set(result.attrs)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["results", "scratch"]
    assert not list((tmp_path / "scratch").glob("linksweep*"))
    assert "exists already" in sweep("scaling", *arguments, cwd=tmp_path, code=2)[2]


def memory_of(tmp_path, points, *command):
    study = (COINS, "--axis", 'metal="gold","tin"', "--axis", f"coins=1:{points // 200}:1", "--set", "n_sim=1")
    command = [*command[:1], *study, "--axis", "chance=0.2:0.794:0.006", *command[1:]]
    watched = watch([sys.executable, "-m", "linksweep", *command], tmp_path)
    return max(ours for _, ours in watched.own_bytes) / 2**20, watched.peak_bytes / 2**20


@pytest.mark.slow
def test_a_million_points_are_planned_and_a_hundred_thousand_run_in_little_memory(tmp_path):
    assert memory_of(tmp_path, 10**6, "plan", "--json")[0] < 1000
    few_mb, _ = memory_of(tmp_path, 10**4, "run", "--workers", "2", "--json", "-o", "few.zarr")
    many_mb, workers_mb = memory_of(tmp_path, 10**5, "run", "--workers", "2", "--json", "-o", "many.zarr")
    status = xr.open_zarr(tmp_path / "many.zarr")["status"]
    assert (status.size, bool((status == 1).all())) == (100_000, True)
    assert sum(path.is_file() for path in (tmp_path / "many.zarr").rglob("*")) < 100
    # Ten times the points: what each leaves (its sums, its key, its row in the table) is below 2 kB in all.
    assert many_mb - few_mb < 90_000 * 2e-3
    assert max(many_mb, workers_mb) < 1000
