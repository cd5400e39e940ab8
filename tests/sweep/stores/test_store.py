"""The ledger of finished blocks, the record of failures, and the dataset, which is read while it is written."""

import json
import shutil
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import xarray as xr

import linksweep
from linksweep import SweepError
from tests.sweep import opening
from tests.sweep.coins import experiment
from tests.sweep.opening import create_or_resume, existing_store, files_of, run, write
from tests.tiers import slow


@pytest.fixture
def path(tmp_path):
    return tmp_path / "s.zarr"


def rows(number, start=0):
    keys = [(start + i + 1).to_bytes(32, "little") for i in range(number)]
    left = np.arange(2.0 * number).reshape(number, 2) + start
    return keys, left.view(experiment.reducer.dtype).reshape(number)


def test_what_was_flushed_is_there_again(path, coins):
    keys, sums = rows(5)
    store = create_or_resume(path, coins)
    store.append(keys[:3], sums[:3])
    store.flush()
    store.append(keys[3:], sums[3:])  # never flushed: a killed process
    again = create_or_resume(path, coins)
    assert set(again.rows) == set(keys[:3])
    again.append(keys[3:], sums[3:])
    again.flush()
    assert np.array_equal(create_or_resume(path, coins).read(), sums)


@pytest.mark.slow
def test_the_ledger_grows_over_parts_in_few_files(path, coins):
    store = create_or_resume(path, coins)
    part = opening.ledger.PART_BYTES // 48
    written = 0
    for size in (part - 1, 1, 5, part, 7):  # to the brim, over it, a whole one, a bit more
        store.append(*rows(size, written))
        store.flush()
        written += size
    again = create_or_resume(path, coins)
    assert len(again.rows) == written
    for start, size in ((0, part - 1), (part + 5, part)):
        keys, sums = rows(size, start)
        assert np.array_equal(again.read()[[again.rows[k] for k in keys]], sums)
    assert len(files_of(path)) < 40


def test_what_a_kill_before_the_first_results_leaves_is_gone_on_with(path, coins):
    path.mkdir()
    (path / "zarr.json.0123abcd.partial").write_text("{")
    create_or_resume(path, coins)
    assert opening.OpenStore(path).attributes["complete"] == 0
    with pytest.raises(SweepError, match=r"is unfinished: .* nothing is damaged"):
        linksweep.open(path)
    shutil.rmtree(path / "blocks", ignore_errors=True)
    assert existing_store(path, coins).rows == {}
    assert run(coins, path).attrs["complete"] == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sampling": {"n_sim": 1000, "n_cat": 20, "seed": 8}}, "seed: 7 in the store, 8 in the study"),
        ({"fixed": {"chance": 0.6}}, "fixed.chance: 0.4 in the store, 0.6 in the study"),
        ({"fixed": {}}, "fixed.chance: 0.4 in the store, 0.5 in the study"),
    ],
)
def test_another_meaning_is_refused_with_the_differences(path, coins, change, words):
    create_or_resume(path, coins)
    with pytest.raises(SweepError) as refused:
        run(coins | change, path)
    assert words in refused.value.problems


def test_a_study_that_grows_and_shrinks_keeps_all_blocks(path, coins):
    first = run(coins, path)
    before = files_of(path)
    for smaller, places in (
        ({"axes": {"metal": ["tin"], "coins": [20, 5]}}, {"metal": ["tin"], "coins": [20, 5]}),
        ({"axes": {"coins": [5]}, "fixed": coins["fixed"] | {"metal": "tin"}}, {"metal": "tin", "coins": [5]}),
    ):
        xr.testing.assert_equal(run(coins | smaller, path)["share"], first["share"].sel(places, drop=True))
    shorter = run(coins | {"sampling": coins["sampling"] | {"n_sim": 10, "n_cat": 2}}, path)
    assert (shorter["n_sim_done"] == 20_000).all()
    assert files_of(path) == before
    wider = run(coins | {"axes": coins["axes"] | {"chance": [0.3, 0.4]}, "fixed": {}}, path)
    xr.testing.assert_equal(wider["share"].sel(chance=0.4, drop=True), first["share"])
    part = run(coins | {"axes": {"metal": ["tin"], "coins": [5, 6]}}, path)  # smaller and larger
    assert part["share"].shape == (1, 2)
    whole = xr.open_zarr(path).load()
    assert whole["share"].shape == (2, 4, 2)
    assert (int((whole["status"] == 1).sum()), int((whole["status"] == 0).sum())) == (13, 3)
    xr.testing.assert_equal(whole["share"].sel(coins=[1, 5, 20]), wider["share"])
    assert len(existing_store(path, coins).rows) == (12 + 1) * 4


def test_an_incomplete_larger_store_is_not_shown_as_whole(path, coins):
    dataset = run(coins, path)
    status = dataset["status"].copy()
    status.loc[{"metal": "tin", "coins": 5}] = 0
    existing_store(path, coins).write(dataset.assign(status=status))
    assert run(coins | {"axes": {"metal": ["tin"], "coins": [5]}}, path)["status"].values.tolist() == [[1]]


@pytest.mark.parametrize(("version", "age"), [(1, "older: run the study into a new store"), (99, "newer: upgrade")])
def test_another_format_is_explained(path, coins, version, age):
    create_or_resume(path, coins)
    document = json.loads((path / "zarr.json").read_text())
    document["attributes"]["linksweep_format"] = version
    shutil.rmtree(path / "blocks", ignore_errors=True)
    (path / "zarr.json").write_text(json.dumps(document))
    for read in (linksweep.open, lambda path: run(coins, path)):
        with pytest.raises(SweepError, match=f"has store format {version}; .* It is {age}"):
            read(path)


def test_results_on_the_same_axes_have_the_same_chunks(path, monkeypatch):
    monkeypatch.setattr("linksweep.sweep.contract.large.MOST_VALUES", 9)

    def f(a: int, b: int):
        return {"x": a / b, "n": a * b, "even": a % 2 == 0, "name": f"{a}-{b}"}

    written = linksweep.run(f, path, axes={"a": range(1, 6), "b": range(1, 5)}, pool="serial")
    found = xr.open_zarr(path)
    assert dict(found.chunks) == {"a": (2, 2, 1), "b": (4,)}
    assert found.load().equals(written)


def record(number, traceback="Traceback ..."):
    texts = {"place": f"coins={number}", "kind": "exception", "message": f"ValueError: {number} is odd"}
    return texts | {"traceback": traceback, "host": "here", "when": "2026-01-01T00:00:00+00:00"}


def digest(number):
    return number.to_bytes(16, "little")


def test_failures_are_durable_after_a_flush_and_can_be_forgiven(path, coins):
    store = create_or_resume(path, coins)
    assert store.failures == {}
    store.fail(digest(1), record(1))
    store.fail(digest(2), record(2))
    assert create_or_resume(path, coins).failures == {}  # not flushed: a killed process
    store.flush()
    again = create_or_resume(path, coins)
    assert again.failures == {digest(1): record(1), digest(2): record(2)}
    again.clear_failures([digest(1), digest(3)])
    again.flush()
    assert create_or_resume(path, coins).failures == {digest(2): record(2)}


READ = """
import json, sys, time
import numpy as np
import xarray as xr
import linksweep

read = {"open_dataset": linksweep.open, "xr.open_zarr": lambda path: xr.open_zarr(path).load()}[sys.argv[2]]
print("reading", flush=True)
reads, generations, wrong, mixed = 0, set(), 0, 0
while True:
    begun = time.monotonic()
    try:
        dataset = read(sys.argv[1])
    except linksweep.SweepError as error:  # faster than it can be read: a message, not wrong numbers
        wrong += "faster than" not in str(error)
        continue
    slow = time.monotonic() - begun > dataset.attrs["pause"] / 2  # half: the pause before may have been shorter
    if slow and sys.argv[2] == "xr.open_zarr" and not dataset.attrs["last"]:
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


def turn(number, last=False, shape=(50, 40)):
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


@pytest.mark.parametrize(("reader", "turns", "pause"), [slow("open_dataset", 100, 0.0), ("xr.open_zarr", 10, 0.05)])
def test_a_reader_sees_one_writing_or_another(path, coins, reader, turns, pause):
    """Ours whatever its haste and the writer's; plain xarray where it reads in less time than lies between two writings
    (a run leaves at least 5 s), and slower readings do not count.  There are writings, with ever longer pauses, until
    enough readings have come between them.
    """
    store = create_or_resume(path, coins)
    write(store, turn(0).assign_attrs(pause=pause))
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
        write(store, turn(number).assign_attrs(pause=pause))
        time.sleep(pause)
        if number > turns and number % 20 == 0:
            pause = max(2.0 * pause, 0.01)
    write(store, turn(number + 1, last=True).assign_attrs(pause=pause))
    listening.join()
    process.communicate()
    found = json.loads(lines[-1])
    assert found["reads"] > 10
    assert found["generations"] > 5
    assert (found["wrong"], found["mixed"]) == (0, 0)


def test_who_opened_a_writing_reads_on_until_the_next_but_one(path, coins):
    """A plain reader that is slow: opened lazily, its values fetched after the next writing, of whatever size."""
    store = create_or_resume(path, coins)
    shapes = [(2, 3), (5, 3), (5, 700), (1, 1), (4, 4), (4, 4)]
    write(store, turn(0, shape=shapes[0]))
    for number, shape in enumerate(shapes[1:], 1):
        slowly = xr.open_zarr(path)
        write(store, turn(number, shape=shape))
        xr.testing.assert_identical(slowly.load().drop_attrs(), turn(number - 1, shape=shapes[number - 1]).drop_attrs())
        xr.testing.assert_identical(opening.open_dataset(path).drop_attrs(), turn(number, shape=shape).drop_attrs())
    files = [file for file in files_of(path) if "blocks" not in file]
    assert len(files) < 4 * 3 + 3  # a document and at most two sets of chunks each


def test_an_array_that_is_no_longer_there_leaves_no_files(path, coins):
    store = create_or_resume(path, coins)
    write(store, turn(1))
    (path / "mine").mkdir()
    (path / "mine" / "notes.txt").write_text("a file of the user's")
    write(store, turn(2).drop_vars("again"))
    assert not (path / "again" / "zarr.json").exists()
    write(create_or_resume(path, coins), turn(3).drop_vars("again"))
    assert not [p for p in (path / "again").rglob("*") if p.is_file()]
    assert (path / "mine" / "notes.txt").exists()


def test_a_store_that_changes_all_the_time_is_not_read_for_ever(path, coins, monkeypatch):
    store = create_or_resume(path, coins)
    write(store, turn(0))
    get_all = opening.Folder.get_all

    def write_and_read(location, keys):
        for _ in range(2):  # the second takes the place of the writing that the reader has found
            write(store, turn(store.attributes["generation"]))
        return get_all(location, keys)

    monkeypatch.setattr(opening.Folder, "get_all", write_and_read)
    with pytest.raises(SweepError, match="written faster than it can be read"):
        linksweep.open(path)


def test_no_codec_of_a_store_can_run_anything(path, coins):
    """No pickle in any file: every document names only codecs that hold plain numbers and text; others are not read."""
    run(coins, path)
    for name, content in files_of(path).items():
        assert not content.startswith((b"\x80\x03", b"\x80\x04", b"\x80\x05"))
        document = json.loads(content) if name.endswith("zarr.json") else {}
        if document.get("node_type") == "array":
            assert {codec["name"] for codec in document["codecs"]} <= {"bytes", "vlen-utf8", "zstd", "crc32c"}
            assert document["data_type"] in {"float64", "int64", "int8", "uint8", "string"}
    root = json.loads((path / "zarr.json").read_text())
    root["consolidated_metadata"]["metadata"]["share"]["codecs"].append({"name": "numcodecs.pickle"})
    (path / "zarr.json").write_bytes(opening.sealed(root, "zarr.json"))
    for read in (linksweep.open, lambda path: run(coins, path)):
        with pytest.raises(SweepError, match=r"share.codecs.*name: Input should be"):
            read(path)
