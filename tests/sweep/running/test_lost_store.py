"""A store that is moved or removed, whole or in part, during a run: the run says so and keeps its results."""

import shutil
import sys
from contextlib import suppress

import numpy as np
import pytest

import linksweep
from linksweep import SweepError
from tests.sweep.opening import MANIFEST, holder, rows_on_disk
from tests.sweep.outside import wait_until
from tests.tiers import PATIENCE_S, slow

LAST = 9
MODEL = f"""
import time
from pathlib import Path
import numpy as np
def model(x: float = 1.0):
    while x == {LAST} and not Path("go").exists():
        time.sleep(0.02)
    return {{"y": x * x, "name": f"{{x:g}}", "large": np.full(600_000, x)}}
"""


def _has_some(store):
    with suppress(SweepError):
        return bool(rows_on_disk(store)) and (store / "status" / "zarr.json").exists()


def removed(store, part):
    (store / part).rename(store.parent / "gone")  # in one step
    shutil.rmtree(store.parent / "gone", ignore_errors=True)


@pytest.mark.parametrize(
    ("change", "lost"),
    [
        (lambda store: removed(store, ""), "s.zarr"),
        slow(lambda store: removed(store, "blocks"), "blocks/"),
        slow(lambda store: store.rename(store.with_name("moved")), "s.zarr"),
        slow(lambda store: (store / MANIFEST).unlink(), MANIFEST),
        slow(lambda store: (store / "zarr.json").write_text("{}"), ""),
    ],
    ids=["removed", "blocks", "moved", "manifest", "root"],
)
def test_it_is_said_and_what_was_computed_is_kept(tmp_path, start_sweep, sweep, change, lost):
    (tmp_path / "model.py").write_text(MODEL)
    command = [sys.executable, "-m", "linksweep", "run", "model.py:model", "--axis", f"x=1:{LAST}:1", "-o", "s.zarr"]
    process = start_sweep(command=[*command, "--pool", "threads", "--workers", "1"], cwd=tmp_path)
    wait_until(lambda: process.poll() is not None or _has_some(tmp_path / "s.zarr"), "some points")
    assert process.poll() is None, process.communicate()[1]
    change(tmp_path / "s.zarr")
    (tmp_path / "go").touch()
    err = process.communicate(timeout=PATIENCE_S)[1]
    if process.returncode == 0:  # the last write has set it right
        assert sweep("check", tmp_path / "s.zarr")[0] == 0
        assert linksweep.open(tmp_path / "s.zarr").attrs["complete"] == 1
        return
    assert process.returncode == 2, err
    assert "wrote s.zarr" not in err
    assert lost in err
    assert "Traceback" not in err
    assert "s.zarr.rescued" in err
    kept = linksweep.open(tmp_path / "s.zarr.rescued")
    done = kept.isel(x=kept.status.values == 1)
    assert done.sizes["x"] > 0
    assert ("large" in kept) == (lost in ("", MANIFEST))  # its files are there
    assert "large" not in kept or (done.large.values == done.x.values[:, None]).all()
    assert np.array_equal(done.y.values, done.x.values**2)
    assert done.name.values.tolist() == [f"{x:g}" for x in done.x.values]
    assert holder(tmp_path / "s.zarr") is None
    code, _, err = sweep("run", "model.py:model", "--axis", "x=1,2", "-o", "s.zarr.rescued", cwd=tmp_path)
    assert (code, "holds results of a store that was lost" in err) == (2, True)
