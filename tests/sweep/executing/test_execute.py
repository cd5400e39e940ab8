"""Blocks that end their process, overfill it or never end: their points fail and nothing else does."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.sweep.deadly import FATES
from tests.tiers import slow

DEADLY = str(Path(__file__).parents[1] / "deadly.py") + ":experiment"
LIMITS = ("--time-limit", "4", "--memory-limit", "400MB")

SAID = {
    3: "ended its process with SIGSEGV",
    5: "ended its process with exit code 3",
    7: "needs more than the memory limit of 0.4 GB",
    11: "a block took longer than the time limit of 4 s",
    13: "a block took longer than the time limit of 4 s",
    15: "a block took longer than the time limit of 4 s",
    17: "ValueError: no such coin",
}


def written(path, places):
    path.write_text(
        f'title = "Deadly"\nexperiment = "{DEADLY}"\naxes = {{ place = {list(places)} }}\n'
        "sampling = { n_sim = 600, n_cat = 20, seed = 5 }\n"
    )
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    "resources",
    [("--workers", "2"), ("--pool", "threads", "--workers", "2"), ("--pool", "serial")],
    ids=["processes", "threads", "serial"],
)
def test_exactly_the_deadly_points_fail(tmp_path, sweep, resources):
    innocent = [place for place in range(20) if place not in FATES]
    code, _, err = sweep("run", written(tmp_path / "good.toml", innocent), "-o", tmp_path / "good.zarr")
    assert code == 0, err
    assert "this process" in err

    study = written(tmp_path / "deadly.toml", range(20))
    code, _, err = sweep("run", study, "-o", tmp_path / "s.zarr", *resources, *LIMITS, cwd=tmp_path)
    assert code == 1, err
    assert not [line for line in err.splitlines() if "distributed" in line or "Traceback" in line], err
    dataset = xr.open_zarr(tmp_path / "s.zarr").load()
    assert set(dataset["place"].values[dataset["status"] == 2].tolist()) == set(FATES)
    good = xr.open_zarr(tmp_path / "good.zarr").load()
    np.testing.assert_array_equal(dataset["mean"].sel(place=innocent), good["mean"])
    assert json.loads(dataset.attrs["failures"]) == {f"place={place}": text for place, text in SAID.items()}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["deadly.toml", "good.toml", "good.zarr", "s.zarr"]


@pytest.mark.parametrize(
    ("resources", "places"),
    [(("--pool", "serial", *LIMITS), [2, 3]), slow(("--workers", "1"), range(5))],  # workers need no limits for it
    ids=["serial", "processes"],
)
def test_a_crash_fails_its_point_alone(tmp_path, sweep, resources, places):
    code, _, err = sweep("run", written(tmp_path / "deadly.toml", places), "-o", tmp_path / "s.zarr", *resources)
    assert code == 1, err
    assert xr.open_zarr(tmp_path / "s.zarr")["status"].values.tolist() == [1 + (place in FATES) for place in places]
