"""Large arrays: written once, by the process that computed them, and read as they are used."""

import itertools
import os
import subprocess
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import linksweep
from linksweep import Limits, Output, SweepError, experiment
from tests.sweep.opening import same
from tests.sweep.outside import Outside


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr("linksweep.sweep.contract.rows.MOST_VALUES", 64)


@experiment(outputs=[Output("image", nan=True), Output("level"), Output("names")])
def picture(a: int, b: int = 0):
    if b == 2:
        raise ValueError("two")
    drawn = np.random.default_rng([a, b]).normal(size=(9, 40))
    drawn.flat[:: 7 + a] = np.nan
    drawn.flat[1] = np.inf
    return {"image": drawn, "level": a / 3, "names": [f"{a}", "x"]}


def check(dataset):
    for a, b in itertools.product(dataset["a"].values, dataset["b"].values):
        point = dataset.sel(a=a, b=b)
        wanted = picture(a, b)["image"] if point["status"] == 1 else np.full((9, 40), np.nan)
        np.testing.assert_array_equal(point["image"], wanted)


def digests(store):
    files = [file for file in Path(store).glob("*/c*.*") if file.parent.name != "wall_time"]
    return {file.relative_to(store): file.read_bytes() for file in files}


@pytest.mark.parametrize("options", [{"pool": "threads", "workers": 2}, {"workers": 2}, {"limits": Limits(60.0)}])
def test_who_writes_them_changes_no_bit_and_they_are_stored_once(options, tmp_path):
    axes = {"a": range(3), "b": [0, 2]}
    serial = linksweep.run(picture, tmp_path / "serial.zarr", axes=axes, pool="serial", max_failures="100%")
    ds = linksweep.run(picture, tmp_path / "s.zarr", axes=axes, max_failures="100%", **options)
    same(ds, serial)
    check(ds)
    assert digests(tmp_path / "s.zarr") == digests(tmp_path / "serial.zarr")
    # A chunk is one file with two names; missing ones are files of their own.
    linked = [file for file in (tmp_path / "s.zarr" / "image").glob("c*.*") if file.stat().st_nlink == 2]
    assert len(linked) == np.sum(ds["status"].values == 1) * 9
    assert len(list((tmp_path / "s.zarr" / "blocks").glob("large.*"))) == len(linked)


PICTURES = """
import numpy as np
from pathlib import Path
def picture(a: int):
    assert HIDDEN == (not list(Path("FOLDER").glob("*.zarr")))
    return {"image": np.random.default_rng(a).normal(size=(1100, 500))}
"""


@pytest.mark.slow
@pytest.mark.parametrize("hides", [False, True])
def test_workers_of_a_scheduler_write_them_where_they_see_the_store(hides, tmp_path, monkeypatch):
    monkeypatch.setattr("linksweep.sweep.contract.rows.MOST_VALUES", 2**20)
    folder = tmp_path / "stores"
    folder.mkdir()
    hide = ["unshare", "--mount", "sh", "-c", f'mount -t tmpfs none "{folder}" && "$@"', "sh"] if hides else []
    if hides and (os.geteuid() != 0 or subprocess.run([*hide, "true"], check=False).returncode):
        pytest.skip("a file system of its own for a process needs root and unshare")
    (tmp_path / "pictures.py").write_text(PICTURES.replace("HIDDEN", str(hides)).replace("FOLDER", str(folder)))
    study = {"title": "p", "experiment": f"{tmp_path}/pictures.py:picture", "axes": {"a": [1, 2, 3]}}
    with closing(Outside(tmp_path)) as outside:
        outside.start_worker(before=hide)
        ds = linksweep.run(study, folder / "s.zarr", scheduler=outside.address)
    wanted = [np.random.default_rng(a).normal(size=(1100, 500)) for a in (1, 2, 3)]
    np.testing.assert_array_equal(ds["image"].values, wanted)
    np.testing.assert_array_equal(xr.open_zarr(folder / "s.zarr")["image"].values, wanted)


def test_a_store_is_opened_without_its_large_arrays_and_they_are_read_from_it_or_not_at_all(tmp_path):
    store, how = tmp_path / "s.zarr", {"pool": "serial", "max_failures": "100%"}
    ds = linksweep.run(picture, store, axes={"a": [1, 2], "b": [0, 2]}, **how)
    linksweep.run(picture, store, axes={"a": [0, 1, 2], "b": [0, 1, 2]}, **how)
    check(ds)  # a later run leaves what an earlier one has returned
    opened = linksweep.open(store)
    for file in (store / "blocks").glob("large.*"):
        file.unlink()
    np.testing.assert_array_equal(opened["level"].sel(b=0), [0.0, 1 / 3, 2 / 3])
    for lost in (ds, opened):
        with pytest.raises(SweepError, match=r"blocks/large\.[0-9a-f]{32} cannot be read: it is missing"):
            lost["image"].sel(a=1, b=0).load()
