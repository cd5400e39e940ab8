"""Files of a store that were exchanged, mixed or are those of an older format: found, refused or harmless."""

import itertools
import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.planning.grid import Grid
from linksweep.sweep.planning.plan import Plan
from linksweep.sweep.planning.work_queue import Tuning
from linksweep.sweep.running.run import run_study
from linksweep.sweep.stores import ledger
from linksweep.sweep.stores import location as folder
from linksweep.sweep.stores.integrity import sealed, unsealed
from linksweep.sweep.stores.location import Folder, located
from linksweep.sweep.stores.store import check, open_dataset, repair
from linksweep.sweep.studies.reader import study_from_dict
from linksweep.sweep.studies.record import RECORD, provenance, recorded
from tests.sweep.opening import create_or_resume, existing_store, parts_of
from tests.tiers import slow

SERIAL = Resources(pool="serial")


def small_chunks(monkeypatch, size=200):
    monkeypatch.setattr(ledger, "PART_BYTES", size)


@pytest.fixture
def two_writings(tmp_path, coins, monkeypatch):
    """A store of two writings, with several chunks in its ledger: arrays have chunks under both of their names."""
    small_chunks(monkeypatch)
    first = coins | {"axes": {"coins": [1, 5]}, "sampling": {"n_sim": 600, "n_cat": 20, "seed": 7}}
    run_study(study_from_dict(first), tmp_path / "s.zarr", SERIAL)
    study = study_from_dict(first | {"axes": {"coins": [1, 5, 9]}})
    run_study(study, tmp_path / "s.zarr", SERIAL)
    return study, tmp_path / "s.zarr"


@pytest.mark.slow
def test_any_two_files_exchanged_are_found_or_harmless(two_writings):
    _, store = two_writings
    wanted = open_dataset(store)
    files = sorted(path for path in store.rglob("*") if path.is_file())
    assert len([file for file in files if "blocks/rows" in str(file)]) > 1
    used = in_use(store)
    found = exchanged = 0
    for one, other in itertools.combinations(files, 2):
        contents = one.read_bytes(), other.read_bytes()
        if contents[0] == contents[1]:
            continue
        exchanged += 1
        one.write_bytes(contents[1])
        other.write_bytes(contents[0])
        try:
            is_found = bool(check(store))
        except SweepError:
            is_found = True
        try:
            xr.testing.assert_identical(open_dataset(store), wanted)
        except SweepError:
            assert is_found, (one, other)
        named = {path.relative_to(store).as_posix() for path in (one, other)}
        one.write_bytes(contents[0])
        other.write_bytes(contents[1])
        assert is_found or not named & used, (one, other)
        found += is_found
    assert found > 0.9 * exchanged


def in_use(store):
    """The files that the root document means, and those of the ledger; the rest is of the writing before."""
    root = json.loads((store / "zarr.json").read_text())
    arrays, chunks = root["consolidated_metadata"]["metadata"], json.loads(root["attributes"]["chunk_checksums"])
    ledger_files = {p.relative_to(store).as_posix() for p in (store / "blocks").rglob("*") if p.is_file()}
    return {"zarr.json", *(f"{name}/zarr.json" for name in arrays), *chunks, *ledger_files}


def test_exchanged_chunks_of_the_ledger_are_repaired_to_the_same_bits(two_writings):
    study, store = two_writings
    wanted = open_dataset(store)
    names = parts_of(store)[:2]
    one, other = (store / name for name in names)
    contents = one.read_bytes(), other.read_bytes()
    one.write_bytes(contents[1])
    other.write_bytes(contents[0])
    assert set(check(store).ledger) == set(names)
    with pytest.raises(SweepError, match=f"{names[0]} is damaged"):
        existing_store(store, study)
    repair(store)
    again, _ = run_study(study, store, SERIAL)
    xr.testing.assert_identical(again.drop_attrs(deep=False), wanted.drop_attrs(deep=False))
    assert not check(store)


@pytest.mark.slow
def test_samples_of_another_block_are_found(tmp_path, monkeypatch):
    small_chunks(monkeypatch)
    study = study_from_dict(
        {
            "title": "Samples",
            "axes": {"n_obj": [20, 30]},
            "fixed": {"catalogue": "quasars", "v_max": 15.0},
            "sampling": {"n_sim": 600, "n_cat": 4, "seed": 5, "keep_samples": True},
        }
    )
    run_study(study, tmp_path / "s.zarr", SERIAL)
    first, second = parts_of(tmp_path / "s.zarr", "samples")[:2]
    shutil.copy(tmp_path / "s.zarr" / second, tmp_path / "s.zarr" / first)
    assert first in check(tmp_path / "s.zarr").ledger
    with pytest.raises(SweepError, match=f"{first} is damaged"):
        existing_store(tmp_path / "s.zarr", study).verify()
    (tmp_path / "s.zarr" / first).unlink()
    repair(tmp_path / "s.zarr")  # rows whose samples are lost do not count as done
    held = existing_store(tmp_path / "s.zarr", study).rows
    assert 0 < len(held) < len(json.loads((tmp_path / "s.zarr" / "zarr.json").read_text())) + 10
    assert all(len(existing_store(tmp_path / "s.zarr", study).samples(key)) for key in held)


COPIES = 100
RUN = """
import sys
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.running.run import run_study
from linksweep.sweep.planning.work_queue import Tuning
from linksweep.sweep.studies.reader import study_from_dict
import json
often = Tuning(most_blocks=1, flush_every_s=-1.0, write_every_s=-1.0, write_share=1e9)
print("ready", flush=True)
while True:
    for seed in range(3):
        document = json.loads(sys.argv[2])
        document["sampling"]["seed"] = 7
        run_study(study_from_dict(document), sys.argv[1] + f"/{seed}.zarr", Resources(pool="serial"), tuning=often)
    import shutil
    for seed in range(3):
        shutil.rmtree(sys.argv[1] + f"/{seed}.zarr")
"""


@pytest.mark.slow
def test_a_copy_made_during_a_run_is_whole_or_refused(tmp_path, coins):
    """`cp -r` of a store that is written as often as possible: values are those of a finished run, or there is a
    message; nothing is mixed.
    """
    document = coins | {"sampling": {"n_sim": 600, "n_cat": 20, "seed": 7}}
    wanted, _ = run_study(study_from_dict(document), tmp_path / "whole.zarr", SERIAL)
    whole = existing_store(tmp_path / "whole.zarr", study_from_dict(document))
    expected = {key: whole.read()[row].tobytes() for key, row in whole.rows.items()}
    (tmp_path / "runs").mkdir()
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", RUN, str(tmp_path / "runs"), json.dumps(document)],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout.readline() == "ready\n"
        read = 0
        for number in itertools.count():
            if number >= COPIES and read:  # on a busy machine it takes more until one is whole
                break
            copy = tmp_path / "copy.zarr"
            shutil.rmtree(copy, ignore_errors=True)
            source = tmp_path / "runs" / f"{number % 3}.zarr"
            subprocess.run(["cp", "-r", str(source), str(copy)], check=False, stderr=subprocess.DEVNULL)
            try:
                dataset = open_dataset(copy)
            except SweepError:
                continue
            finally:
                try:
                    held = existing_store(copy, study_from_dict(document))
                except SweepError:
                    held = None
                if held is not None:
                    assert all(expected[key] == held.read()[row].tobytes() for key, row in held.rows.items())
            done = dataset["status"].values == 1
            assert np.array_equal(dataset["share"].values[done], wanted["share"].values[done])
            assert np.isnan(dataset["share"].values[~done]).all()
            read += 1
    finally:
        process.kill()
        process.communicate()


class Killed(BaseException):
    """The end of a process before an operation on a file."""


OPERATIONS = ("put", "create", "swap", "delete")


@pytest.mark.slow
@pytest.mark.parametrize("where", ["folder", "bucket"])
def test_killed_before_any_operation_it_is_unfinished_and_goes_on(where, request, tmp_path, coins, monkeypatch):
    often = Tuning(flush_every_s=-1.0)
    study = study_from_dict(coins | {"axes": {"coins": [1, 5]}, "sampling": {"n_sim": 100, "n_cat": 20, "seed": 7}})
    base = str(tmp_path) if where == "folder" else request.getfixturevalue("bucket")
    kind = type(located(f"{base}/s.zarr"))
    before = {name: getattr(kind, name) for name in (*OPERATIONS, "put_all")}
    done, last = [], [10**9]

    def counted(name):
        def operation(place, key, *arguments):
            if not key.endswith(".lock"):
                done.append(key)
                if len(done) > last[0]:
                    raise Killed
            return before[name](place, key, *arguments)

        return operation

    def one_by_one(place, files):
        for key, content in files.items():
            kind.put(place, key, content)

    for name in OPERATIONS:
        monkeypatch.setattr(kind, name, counted(name))
    monkeypatch.setattr(kind, "put_all", one_by_one)
    wanted, _ = run_study(study, f"{base}/whole.zarr", SERIAL, tuning=often)
    total = len(done)
    assert total > 20
    said = set()
    for number in range(0, total, 1 if where == "folder" else 3):
        store = f"{base}/{number}.zarr"
        done.clear()
        last[0] = number
        with pytest.raises(Killed):
            run_study(study, store, SERIAL, tuning=often)
        last[0] = 10**9
        if located(store).get("zarr.json") is None:
            with pytest.raises(SweepError, match="no store there"):
                check(store)
        else:
            report = check(store)
            assert not report, (number, report)
            said.update(remark.split(":")[0] for remark in report.remarks)
        again, _ = run_study(study, store, SERIAL, tuning=often)
        xr.testing.assert_identical(again.drop_attrs(deep=False), wanted.drop_attrs(deep=False))
        report = check(store)
        assert not report
        assert not report.remarks
    assert {"is unfinished", "is incomplete"} & said


def test_a_store_of_the_first_moment_is_unfinished(tmp_path, coins, sweep):
    study = study_from_dict(coins)
    create_or_resume(
        tmp_path / "s.zarr", study, provenance(study) | {RECORD: recorded(study, Plan(Grid(study)).costs())}
    )
    code, out, _ = sweep("check", tmp_path / "s.zarr")
    assert code == 0
    assert "is unfinished" in out
    for command in ("show", "status"):
        code, out, err = sweep(command, tmp_path / "s.zarr")
        assert "is unfinished" in out + err
        assert "damaged;" not in err


@pytest.mark.parametrize("step", [137, slow(37)])
def test_a_flipped_root_is_damaged_wherever_the_bit(place, coins, step):
    """Never "not a store of linksweep", in a folder or a bucket, with a copy of the root or before there is one."""
    study = study_from_dict(coins)
    create_or_resume(place, study, provenance(study))
    location = located(place)
    root = location.get("zarr.json")
    existing_store(place, study).flush()
    for copy in (True, False):
        if not copy:
            location.delete("blocks/zarr.json")
        for at in range(0, len(root), step):
            location.put("zarr.json", root[:at] + bytes([root[at] ^ 4]) + root[at + 1 :])
            with pytest.raises(SweepError, match="damaged"):
                open_dataset(place)


def test_every_bit_of_a_document_counts():
    content = sealed({"zarr_format": 3, "node_type": "group", "attributes": {"seed": 7, "axes": "v_max"}}, "zarr.json")
    assert unsealed(content, "zarr.json")["attributes"]["seed"] == 7
    for at, bit in itertools.product(range(len(content)), range(8)):
        flipped = content[:at] + bytes([content[at] ^ (1 << bit)]) + content[at + 1 :]
        with pytest.raises(ValueError, match=r"."):
            unsealed(flipped, "zarr.json")
    with pytest.raises(ValueError, match="does not match"):
        unsealed(content, "blocks/zarr.json")


def test_a_file_that_was_replaced_by_an_equal_one_is_not_swapped(tmp_path, monkeypatch):
    """Who waited for the system's lock on a file that has gone since does not hold that of the new one."""
    place = Folder(tmp_path)
    place.put("lock", b"old")
    flock = folder.fcntl.flock

    def late(descriptor, operation):
        (tmp_path / "other").write_bytes(b"old")
        (tmp_path / "other").replace(tmp_path / "lock")
        flock(descriptor, operation)

    monkeypatch.setattr(folder.fcntl, "flock", late)
    assert not place.swap("lock", b"old", b"new")
    assert place.get("lock") == b"old"
    monkeypatch.undo()
    assert place.swap("lock", b"old", b"new")


def test_a_file_and_its_folder_are_on_the_disk(tmp_path, monkeypatch):
    synchronised = []
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda number: (synchronised.append(os.fstat(number).st_ino), fsync(number))[1])
    Folder(tmp_path).put("a/b", b"content")
    assert synchronised == [(tmp_path / "a" / "b").stat().st_ino, (tmp_path / "a").stat().st_ino]


def test_an_incomplete_larger_store_is_not_shown_as_whole(tmp_path, coins):
    larger = study_from_dict(coins)
    dataset, _ = run_study(larger, tmp_path / "s.zarr", SERIAL)
    store = existing_store(tmp_path / "s.zarr", larger)
    status = dataset["status"].copy()
    status.loc[{"metal": "tin", "coins": 5}] = 0
    store.write(dataset.assign(status=status))
    smaller = study_from_dict(coins | {"axes": {"metal": ["tin"], "coins": [5]}})
    part, _ = run_study(smaller, tmp_path / "s.zarr", SERIAL)
    assert part["status"].values.tolist() == [[1]]
