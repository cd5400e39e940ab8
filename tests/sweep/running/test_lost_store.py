"""A store that is moved or removed, whole or in part, during a run: the run says so and keeps its results."""

import shutil
import subprocess
import sys
import time

import numpy as np
import pytest

import linksweep
from linksweep.sweep.stores.integrity import MANIFEST
from linksweep.sweep.stores.location import holder
from tests.tiers import PATIENCE_S

MODEL = """
import time
from pathlib import Path
def model(x: float = 1.0):
    while x == {last} and not Path({go!r}).exists():
        time.sleep(0.02)
    return {{"y": x * x, "name": f"{{x:g}}"}}
"""
LAST = 9
SLOW = pytest.mark.slow


@pytest.fixture
def started(tmp_path):
    """A run some points of which are in its store, and a function that lets it end."""
    go = tmp_path / "go"
    (tmp_path / "model.py").write_text(MODEL.format(last=LAST, go=str(go)))
    command = [sys.executable, "-m", "linksweep", "run", "model.py:model", "--axis", f"x=1:{LAST}:1", "-o", "s.zarr"]
    process = subprocess.Popen(
        [*command, "--pool", "threads", "--workers", "1"], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    until = time.monotonic() + PATIENCE_S
    while not _has_some(tmp_path / "s.zarr"):
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < until
        time.sleep(0.05)

    def end():
        go.touch()
        return process.communicate(timeout=PATIENCE_S)[1]

    yield process, end
    process.kill()
    process.communicate()


def _has_some(store):
    from linksweep.sweep.contract import SweepError
    from linksweep.sweep.stores.store import OpenStore

    try:
        return len(OpenStore(store).ledger().rows) > 0 and (store / "status" / "zarr.json").exists()
    except SweepError:
        return False


def removed(store, part):
    (store / part).rename(store.parent / "gone")  # in one step
    shutil.rmtree(store.parent / "gone", ignore_errors=True)


@pytest.mark.parametrize(
    ("change", "lost"),
    [
        pytest.param(lambda store: removed(store, ""), "s.zarr", id="removed"),
        pytest.param(lambda store: removed(store, "blocks"), "blocks/", id="blocks", marks=SLOW),
        pytest.param(lambda store: store.rename(store.with_name("moved")), "s.zarr", id="moved", marks=SLOW),
        pytest.param(lambda store: (store / MANIFEST).unlink(), MANIFEST, id="manifest", marks=SLOW),
        pytest.param(lambda store: (store / "zarr.json").write_text("{}"), "", id="root", marks=SLOW),
    ],
)
def test_it_is_said_and_what_was_computed_is_kept(started, tmp_path, change, lost):
    process, end = started
    change(tmp_path / "s.zarr")
    err = end()
    if process.returncode == 0:  # the last write has set it right
        check = [sys.executable, "-m", "linksweep", "check", "s.zarr"]
        assert subprocess.run(check, cwd=tmp_path, capture_output=True, check=False).returncode == 0
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
    assert np.array_equal(done.y.values, done.x.values**2)
    assert done.name.values.tolist() == [f"{x:g}" for x in done.x.values]
    assert holder(tmp_path / "s.zarr") is None


@pytest.mark.slow
def test_what_was_kept_is_not_taken_for_a_store_to_go_on_with(started, tmp_path, sweep):
    _, end = started
    removed(tmp_path / "s.zarr", "")
    end()
    code, _, err = sweep("run", "model.py:model", "--axis", "x=1,2", "-o", "s.zarr.rescued", cwd=tmp_path)
    assert code == 2
    assert "holds results of a store that was lost" in err
    code, out, err = sweep("show", "s.zarr.rescued", cwd=tmp_path)
    assert code == 0, err
    assert " done\n" in out
