"""Readers during a run: processes that read in a loop while the store is written as often as possible."""

import json
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import xarray as xr

from linksweep.sweep.contract import SweepError
from linksweep.sweep.stores.store import open_dataset
from linksweep.sweep.studies.reader import study_from_dict
from linksweep.sweep.studies.record import provenance
from tests.sweep.opening import create_or_resume, existing_store
from tests.tiers import slow

READ = """
import json, sys, time
import numpy as np
import xarray as xr
from linksweep.sweep.contract import SweepError
from linksweep.sweep.stores.store import open_dataset

def ours(path):
    return open_dataset(path)

def plain(path):
    return xr.open_zarr(path).load()

read = {"open_dataset": ours, "xr.open_zarr": plain}[sys.argv[2]]
print("reading", flush=True)
reads, generations, wrong, mixed = 0, set(), 0, 0
while True:
    begun = time.monotonic()
    try:
        dataset = read(sys.argv[1])
    except SweepError as error:  # faster than it can be read: a message, not wrong numbers
        wrong += "faster than" not in str(error)
        continue
    slow = time.monotonic() - begun > dataset.attrs["pause"] / 2  # half: the pause before may have been shorter
    if slow and read is plain and not dataset.attrs["last"]:
        continue
    reads += 1
    values, status, generation = dataset["value"].values, dataset["status"].values, dataset.attrs["generation"]
    generations.add(generation)
    print(generation, flush=True)
    wrong += int(np.isnan(values[status == 1]).any())
    seen = {*np.unique(values[~np.isnan(values)]), *dataset["again"].values.ravel(), dataset.attrs["turn"]}
    mixed += len(seen) > 1
    if dataset.attrs["last"]:
        break
print(json.dumps({"reads": reads, "generations": len(generations), "wrong": wrong, "mixed": mixed}))
"""


def turn(number, last, shape=(50, 40)):
    """The dataset of a moment: every number in it says which; part of the points are done."""
    status = np.random.default_rng(number).integers(0, 2, shape, dtype=np.int8)
    return xr.Dataset(
        {
            "value": (("x", "y"), np.where(status == 1, float(number), np.nan)),
            "again": (("x", "y"), np.full(shape, float(number))),
            "status": (("x", "y"), status),
            "constant": (("x",), np.arange(shape[0])),
        },
        attrs={"study_digest": "", "turn": number, "last": int(last)},
    )


@pytest.mark.parametrize(("reader", "turns", "pause"), [slow("open_dataset", 100, 0.0), ("xr.open_zarr", 10, 0.2)])
def test_a_reader_sees_one_writing_or_another(tmp_path, coins, reader, turns, pause):
    """Ours whatever its haste and the writer's; plain xarray where it reads in less time than lies between two writings
    (a run leaves at least 5 s), and slower readings do not count.  There are writings, with ever longer pauses, until
    enough readings have come between them.
    """
    study = study_from_dict(coins)
    path = tmp_path / "s.zarr"
    store = create_or_resume(path, study, provenance(study))
    store.write(turn(0, last=False).assign_attrs(pause=pause))
    command = [sys.executable, "-W", "ignore", "-c", READ, str(path), reader]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "reading\n"
    lines = []
    listening = threading.Thread(target=lambda: lines.extend(process.stdout))
    listening.start()
    number = 0
    while number < turns or len(lines) <= 10 or len(set(lines)) <= 5:
        assert process.poll() is None
        number += 1
        store.write(turn(number, last=False).assign_attrs(pause=pause))
        time.sleep(pause)
        if number > turns and number % 20 == 0:
            pause = max(2.0 * pause, 0.01)
    store.write(turn(number + 1, last=True).assign_attrs(pause=pause))
    listening.join()
    process.communicate()
    found = json.loads(lines[-1])
    assert found["reads"] > 10
    assert found["generations"] > 5
    assert (found["wrong"], found["mixed"]) == (0, 0)


def test_who_opened_a_writing_reads_on_until_the_next_but_one(tmp_path, coins):
    """A plain reader that is slow: opened lazily, its values fetched after the next writing."""
    study = study_from_dict(coins)
    path = tmp_path / "s.zarr"
    store = create_or_resume(path, study, provenance(study))
    store.write(turn(1, last=False))
    for number in range(2, 9):
        slow = xr.open_zarr(path)
        store.write(turn(number, last=False))
        xr.testing.assert_identical(slow.load().drop_attrs(), turn(number - 1, last=False).drop_attrs())


def test_a_reader_of_a_grid_that_grows(tmp_path, coins):
    study = study_from_dict(coins)
    path = tmp_path / "s.zarr"
    store = create_or_resume(path, study, provenance(study))
    for number, shape in enumerate([(2, 3), (5, 3), (5, 700), (1, 1), (4, 4)]):
        slow = xr.open_zarr(path) if number else None
        store.write(turn(number, last=False, shape=shape))
        if slow is not None:
            assert set(np.unique(slow["again"].values)) == {number - 1}
        xr.testing.assert_identical(open_dataset(path).drop_attrs(), turn(number, last=False, shape=shape).drop_attrs())
    files = [p for p in path.rglob("*") if p.is_file() and "blocks" not in str(p)]
    assert len(files) < 4 * 3 + 3  # a document and at most two sets of chunks each


def test_an_array_that_is_no_longer_there_leaves_no_files(tmp_path, coins):
    study = study_from_dict(coins)
    path = tmp_path / "s.zarr"
    store = create_or_resume(path, study, provenance(study))
    store.write(turn(1, last=False))
    (path / "mine").mkdir()
    (path / "mine" / "notes.txt").write_text("a file of the user's")
    store.write(turn(2, last=False).drop_vars("again"))
    assert not (path / "again" / "zarr.json").exists()
    again = create_or_resume(path, study, provenance(study))
    again.write(turn(3, last=False).drop_vars("again"))
    assert not [p for p in (path / "again").rglob("*") if p.is_file()]
    assert (path / "mine" / "notes.txt").exists()


def test_a_store_that_changes_all_the_time_is_not_read_for_ever(tmp_path, coins, monkeypatch):
    study = study_from_dict(coins)
    path = tmp_path / "s.zarr"
    store = create_or_resume(path, study, provenance(study))
    store.write(turn(0, last=False))
    get_all = type(store.location).get_all

    def write_and_read(location, keys):
        for _ in range(2):  # the second takes the place of the writing that the reader has found
            store.write(turn(store.attributes["generation"], last=False))
        return get_all(location, keys)

    monkeypatch.setattr(type(store.location), "get_all", write_and_read)
    with pytest.raises(SweepError, match="written faster than it can be read"):
        open_dataset(path)


def test_no_codec_of_a_store_can_run_anything(tmp_path, coins):
    """No pickle in any file: every document names only codecs that hold plain numbers and text."""
    from linksweep.sweep.executing.pools import Resources
    from linksweep.sweep.running.run import run_study

    run_study(study_from_dict(coins), tmp_path / "s.zarr", Resources(pool="serial"))
    documents = list((tmp_path / "s.zarr").rglob("zarr.json"))
    assert len(documents) > 6
    for document in map(json.loads, (path.read_text() for path in documents)):
        if document["node_type"] == "array":
            assert {codec["name"] for codec in document["codecs"]} <= {"bytes", "vlen-utf8", "zstd", "crc32c"}
            assert document["data_type"] in {"float64", "int64", "int8", "uint8", "string"}
    for file in (tmp_path / "s.zarr").rglob("*"):
        assert not file.is_file() or not file.read_bytes().startswith((b"\x80\x03", b"\x80\x04", b"\x80\x05"))


def test_an_array_of_another_codec_is_not_read(tmp_path, coins):
    from linksweep.sweep.stores.integrity import sealed

    study = study_from_dict(coins)
    path = tmp_path / "s.zarr"
    create_or_resume(path, study, provenance(study)).write(turn(1, last=False))
    root = json.loads((path / "zarr.json").read_text())
    root["consolidated_metadata"]["metadata"]["value"]["codecs"].append({"name": "numcodecs.pickle"})
    (path / "zarr.json").write_bytes(sealed(root, "zarr.json"))
    for read in (open_dataset, lambda path: existing_store(path, study)):
        with pytest.raises(SweepError, match=r"value.codecs.*name: Input should be"):
            read(path)
