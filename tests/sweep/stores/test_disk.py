"""Disks that are full, and stores that can only be read.  Small file systems are mounted for that, which needs root."""

import os
import shutil
import subprocess

import pytest

import linksweep
from linksweep import SweepError
from tests.sweep.opening import OFTEN, Folder, check, existing_store, run, same


@pytest.fixture
def mount(tmp_path):
    """A function that mounts a file system on a new folder, and returns that."""
    mounted = []

    def make(*options):
        folder = tmp_path / f"disk{len(mounted)}"
        folder.mkdir()
        done = subprocess.run(["mount", *options, str(folder)], capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"a file system cannot be mounted here: {done.stderr.strip()}")
        mounted.append(folder)
        return folder

    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("mounting a file system needs root")
    yield make
    for folder in reversed(mounted):
        subprocess.run(["umount", "-l", str(folder)], check=True)


def remount(folder, options):
    subprocess.run(["mount", "-o", f"remount,{options}", str(folder)], check=True)


def test_a_full_disk_keeps_what_was_finished(mount, tmp_path, coins, monkeypatch):
    document = coins | {"sampling": {"n_sim": 8_000, "n_cat": 20, "seed": 7}}
    wanted = run(document, tmp_path / "wanted.zarr")
    disk = mount("-t", "tmpfs", "-o", "size=1m", "tmpfs")
    store = disk / "s.zarr"
    free = 300_000  # for the first writing of the dataset and some flushes of the ledger
    (disk / "ballast").write_bytes(bytes(2**20 - free))
    flushes, put = [], Folder.put

    def fill(folder, key, content):
        flushes.append(key)
        if len(flushes) == 30:
            (disk / "more").write_bytes(bytes(shutil.disk_usage(disk).free))
        put(folder, key, content)

    full = "cannot be written: No space left on device; what was finished before is kept"
    monkeypatch.setattr(Folder, "put", fill)
    with pytest.raises(SweepError, match=full):
        run(document, store, OFTEN)
    monkeypatch.setattr(Folder, "put", put)
    assert not list(disk.rglob("*.partial"))
    rows = len(existing_store(store, document).rows)
    assert 0 < rows < len(existing_store(tmp_path / "wanted.zarr", document).rows)
    assert int((linksweep.open(store)["status"] == 1).sum()) < 6  # readable, and says that it is incomplete
    with pytest.raises(SweepError, match=full):
        run(document, store)
    (disk / "more").unlink()
    (disk / "ballast").unlink()
    same(run(document, store), wanted)
    assert not check(store)


@pytest.mark.slow
def test_a_store_that_can_only_be_read(mount, link_study, sweep, tmp_path):
    disk = mount("-t", "tmpfs", "-o", "size=8m", "tmpfs")
    store = disk / "s.zarr"
    assert sweep("run", link_study, "-o", store, "--set", "n_sim=20")[0] == 0
    remount(disk, "ro")
    looks = [(command, store) for command in ("show", "status", "check")]
    for command in (*looks, ("plan", link_study, "-o", store), ("plot", store, "-o", tmp_path / "p.png")):
        code, _, err = sweep(*command)
        assert code == 0, (command, err)
    runs = [("run", link_study, "-o", place) for place in (store, disk / "new.zarr")]
    for command in (*runs, ("check", store, "--repair")):
        code, out, err = sweep(*command)
        assert (code, out) == (2, ""), command
        assert "Read-only file system" in err or "is not a directory that can be written" in err
        assert "Traceback" not in err
    remount(disk, "rw")
    assert sweep("run", link_study, "-o", store)[0] == 0
