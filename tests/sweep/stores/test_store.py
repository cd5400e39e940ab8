"""The ledger of finished blocks, the record of failures, and the dataset, which is read while it is written."""

import itertools
import random
import shutil
import subprocess
from contextlib import nullcontext, suppress
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import linksweep
from linksweep import SweepError
from tests.sweep import opening
from tests.sweep.coins import experiment
from tests.sweep.opening import OFTEN, Folder, check, create_or_resume, existing_store, files_of, run, same, write
from tests.tiers import slow

LOSSES = {  # what is done to a store, and what is lost
    "removed": (lambda store: removed(store, ""), "s.zarr"),
    "blocks": (lambda store: removed(store, "blocks"), "blocks/"),
    "moved": (lambda store: store.rename(store.with_name("moved")), "s.zarr"),
    "with its folder": (lambda store: removed(store.parent, ""), "s.zarr"),
    "manifest": (lambda store: (store / opening.MANIFEST).unlink(), opening.MANIFEST),
    "root": (lambda store: (store / "zarr.json").write_text("{}"), ""),
}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "s.zarr"


def rows(number, start=0):
    keys = [(start + i + 1).to_bytes(32, "little") for i in range(number)]
    left = np.arange(2.0 * number).reshape(number, 2) + start
    return keys, left.view(experiment.reducer.dtype).reshape(number)


@pytest.mark.parametrize("part", [5, slow(opening.ledger.PART_BYTES // 48)])
def test_the_ledger_grows_over_parts_and_has_what_was_flushed(path, coins, monkeypatch, part):
    monkeypatch.setattr(opening.ledger, "PART_BYTES", part * 48)
    store = create_or_resume(path, coins)
    written = 0
    for size in (part - 1, 1, 5, part, 7):  # to the brim, over it, a whole one, a bit more
        store.append(*rows(size, written))
        store.fail(bytes([size % 256]) * 16, {"message": str(size)})
        store.flush()
        written += size
    store.append(*rows(3, written))
    store.fail(bytes(16), {})  # never flushed: a killed process
    again = create_or_resume(path, coins)
    assert len(again.rows) == written
    for start, size in ((0, part - 1), (part + 5, part)):
        keys, sums = rows(size, start)
        assert np.array_equal(again.read()[[again.rows[k] for k in keys]], sums)
    assert len(files_of(path)) < 40
    assert set(again.failures) == {bytes([size % 256]) * 16 for size in (part - 1, 1, 5, part, 7)}
    again.clear_failures([bytes([5]) * 16, bytes(16)])
    again.flush()
    assert bytes([5]) * 16 not in create_or_resume(path, coins).failures


def test_many_rows_at_once_are_in_several_files(path, coins, monkeypatch):
    monkeypatch.setattr(opening.ledger, "PART_BYTES", 1)
    monkeypatch.setattr(opening.ledger, "MOST_UNWRITTEN", 100)
    create_or_resume(path, coins).append(*rows(50), seconds=np.arange(50.0))
    again = create_or_resume(path, coins)
    assert (again.read().tolist(), again.seconds().tolist()) == (rows(50)[1].tolist(), list(range(50)))
    assert len(files_of(path)) > 8


def test_of_two_who_write_one_ledger_the_second_is_refused_and_so_is_another_meaning(path, coins):
    one, other = create_or_resume(path, coins), create_or_resume(path, coins)
    for store, start in ((one, 0), (other, 5)):
        store.append(*rows(5, start))
    one.flush()
    with pytest.raises(SweepError, match="changed by others, during this run"):
        other.flush()
    assert len(existing_store(path, coins).rows) == 5
    create_or_resume(path, coins)
    for change, words in (
        ({"sampling": {"n_sim": 1000, "n_cat": 20, "seed": 8}}, "seed: 7 in the store, 8 in the study"),
        ({"fixed": {"chance": 0.6}}, "fixed.chance: 0.4 in the store, 0.6 in the study"),
        ({"fixed": {}}, "fixed.chance: 0.4 in the store, 0.5 in the study"),
    ):
        with pytest.raises(SweepError, match=words):
            run(coins | change, path)
    study = opening.live_study(coins)
    newer = replace(study, experiment=replace(study.experiment, version=2))
    with pytest.raises(SweepError, match="experiment_version: 1 in the store, 2 in the study"):
        opening.run_study(newer, path, opening.SERIAL)


def turn(number, shape=(50, 40)):
    status = np.random.default_rng(number).integers(0, 2, shape, dtype=np.int8)
    values = {"value": np.where(status == 1, float(number), np.nan), "again": np.full(shape, float(number))}
    values["constant"] = np.arange(status.size).reshape(shape)
    variables = {name: (("x", "y"), array) for name, array in (values | {"status": status}).items()}
    return xr.Dataset(variables, attrs={"study_digest": "", "turn": str(number)})


def test_a_reader_sees_one_writing_or_another_or_is_told(path, coins, monkeypatch):
    left, get, rng, number, refused, seen = opening.dying(monkeypatch), Folder.get, random.Random(5), 0, [], set()
    store, often = create_or_resume(path, coins), [0]
    write(store, turn(0))

    def reading(folder, key):
        nonlocal store, number
        asked, often[:] = often[:], [0]  # what the writer reads is not interrupted
        for _ in range(rng.choice(asked)):
            number, left[0] = number + 1, rng.choice([10**9, rng.randrange(40)])
            try:
                write(store, turn(number, shape=(5, 4)))
            except opening.Killed:
                left[0] = 10**9
                store = create_or_resume(path, coins)
        left[0], often[:] = 10**9, asked
        return get(folder, key)

    monkeypatch.setattr(Folder, "get", reading)
    monkeypatch.setattr("linksweep.sweep.stores.store.ATTEMPTS", 3)
    for often[:] in [[0] * 9 + [1]] * 20 + [[0, 0, 1]] * 5 + [[2]]:
        try:
            dataset = linksweep.open(path)
        except SweepError as error:  # not wrong numbers, and not for ever
            refused += error.problems
            continue
        values, done = dataset["value"].values, dataset["status"].values == 1
        actual = {*np.unique(values[done]), *dataset["again"].values.ravel(), int(dataset.attrs["turn"])}
        assert (len(actual), np.isnan(values[~done]).all()) == (1, True)
        seen |= actual
    assert len(seen) > 10
    assert ["written faster than it can be read" in problem for problem in refused] == [True] * max(len(refused), 1)


def test_who_opened_a_writing_reads_on_until_the_next_but_one_and_what_is_no_longer_there_leaves_no_files(path, coins):
    store = create_or_resume(path, coins)
    shapes = [(2, 3), (5, 3), (5, 700), (1, 1), (4, 4), (4, 4)]
    write(store, turn(0, shape=shapes[0]))
    for number, shape in enumerate(shapes[1:], 1):
        slowly = xr.open_zarr(path)
        write(store, turn(number, shape=shape))
        xr.testing.assert_identical(slowly.load().drop_attrs(), turn(number - 1, shape=shapes[number - 1]).drop_attrs())
        there = opening.OpenStore(path).dataset()
        xr.testing.assert_identical(there.drop_attrs(), turn(number, shape=shape).drop_attrs())
    assert sum("blocks" not in file for file in files_of(path)) < 4 * 3 + 3  # documents and at most two sets of chunks
    (path / "mine").mkdir()
    (path / "mine" / "notes.txt").write_text("a file of the user's")
    write(store, turn(7).drop_vars("again"))
    assert not (path / "again" / "zarr.json").exists()
    write(create_or_resume(path, coins), turn(8).drop_vars("again"))
    assert not [p for p in (path / "again").rglob("*") if p.is_file()]
    assert (path / "mine" / "notes.txt").exists()


@pytest.fixture
def disk(tmp_path):
    (folder := tmp_path / "disk").mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(folder)]
    if (done := subprocess.run(command, capture_output=True, text=True, check=False)).returncode:
        pytest.skip(f"a file system cannot be mounted here: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_full_disk_keeps_what_was_finished(disk, tmp_path, coins, monkeypatch, sweep):
    document = coins | {"sampling": {"n_sim": 8_000, "n_cat": 20, "seed": 7}}
    wanted = run(document, tmp_path / "wanted.zarr")
    store, figure, flushes, put = disk / "s.zarr", disk / "p.pdf", [], Folder.put
    figure.touch()

    def fill(folder, key, content):
        flushes.append(key)
        if len(flushes) == 30:  # after the first writing of the dataset and some flushes of the ledger
            (disk / "more").write_bytes(bytes(shutil.disk_usage(disk).free))
        put(folder, key, content)

    full = "cannot be written: No space left on device; what was finished before is kept, and the same command goes on"
    with monkeypatch.context() as patch:
        patch.setattr(Folder, "put", fill)
        with pytest.raises(SweepError, match=full):
            run(document, store, OFTEN)
    assert not list(disk.rglob("*.partial"))
    assert 0 < len(existing_store(store, document).rows) < len(existing_store(tmp_path / "wanted.zarr", document).rows)
    assert int((linksweep.open(store)["status"] == 1).sum()) < 6  # readable, and says that it is incomplete
    with pytest.raises(SweepError, match=full):
        run(document, store)
    with (disk / "more").open("ab") as more:
        more.write(bytes(shutil.disk_usage(disk).free))
    tie = f"tie psrpi-de200 timing-de200 -o {disk}/t.zarr"
    for command in (f"plot {tmp_path}/wanted.zarr -o {figure}", f"submit quasars -o {disk}/q.zarr --slurm 2", tie):
        _, out, error = sweep(*command.split(), code=2)
        assert ("No space left on device" in error, "epsilon_x" in out) == (True, command == tie)
    assert (figure.read_bytes(), [*disk.rglob("submit.sh"), *disk.glob("*t.zarr")]) == (b"", [])  # as it was
    (disk / "more").unlink()
    same(run(document, store), wanted)
    assert not check(store)


@pytest.mark.parametrize("step", [3, slow(1)])
@pytest.mark.parametrize("is_written", [slow(False), True])
def test_where_a_file_cannot_be_written_none_counts_as_lost(tmp_path, coins, monkeypatch, is_written, step):
    document = coins | {"axes": {"coins": [1, 5]}, "sampling": {"n_sim": 100, "n_cat": 5, "seed": 7}}
    wanted, put, left = run(document, tmp_path / "wanted.zarr"), Folder.put, [10**9]

    def failing(folder, key, content):
        left[0] -= 1
        if left[0] != 0 or is_written:  # it may be there although its writing fails
            put(folder, key, content)
        if left[0] == 0:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(Folder, "put", failing)
    for number in itertools.count(2, step):
        store, left[0] = tmp_path / f"{number}.zarr", number
        with suppress(SweepError):
            run(document, store, {"flush_every_s": -1.0})
            break
        assert [one.name for one in tmp_path.glob(f"{number}.zarr*")] == [store.name]
        same(run(document, store), wanted)
        assert not check(store)
    assert number > 5


@pytest.mark.slow
def test_a_store_that_can_only_be_read(disk, link_study, sweep, tmp_path):
    remount = ["mount", "-o", "remount,ro", disk]
    store = disk / "s.zarr"
    assert sweep("run", link_study, "-o", store, "--set", "n_sim=20")[0] == 0
    subprocess.run(remount, check=True)
    looks = [(command, store) for command in ("show", "status", "check")]
    for command in (*looks, ("plan", link_study, "-o", store), ("plot", store, "-o", tmp_path / "p.png")):
        sweep(*command, code=0)
    runs = [("run", link_study, "-o", place) for place in (store, disk / "new.zarr")]
    for command in (*runs, ("check", store, "--repair")):
        assert "Read-only file system" in sweep(*command, code=2)[2]
    subprocess.run([*remount[:2], "remount,rw", disk], check=True)
    assert sweep("run", link_study, "-o", store)[0] == 0


def removed(store, part):
    (store / part).rename(store.parent / "gone")  # in one step
    shutil.rmtree(store.parent / "gone")


def model(x: float):
    return {"y": x * x, "name": f"{x:g}", "large": np.full(100, x)}


@pytest.mark.parametrize(("change", "lost"), LOSSES.values(), ids=LOSSES)
def test_a_run_whose_store_is_lost_says_so_and_keeps_what_was_computed(path, monkeypatch, change, lost):
    class Losing(opening.Progress):
        done = 0

        def advance(self, works, result, taken):
            self.done += len(works)
            if self.done == 3:
                change(path)

    monkeypatch.chdir(path.parent)
    monkeypatch.setattr("linksweep.sweep.contract.rows.MOST_VALUES", 64)
    for name, value in OFTEN.items():
        monkeypatch.setattr(opening.TUNED, name, value)
    how = {"axes": {"x": range(1, 10)}, "pool": "serial"}
    path.with_name("s.zarr.rescued").write_text("mine")
    with pytest.raises(SweepError, match=lost) if lost else nullcontext() as raised:
        linksweep.run(model, path.name, progress=Losing(), **how)
    if raised is None:  # the last write has set it right
        assert (bool(check(path)), linksweep.open(path).attrs["complete"]) == (False, 1)
        return
    place = path.with_name("s.zarr.rescued" + "2" * path.with_name("s.zarr.rescued").is_file())
    assert place.name in str(raised.value)
    kept = linksweep.open(place)
    done = kept.isel(x=kept.status.values == 1)
    assert done.sizes["x"] >= 3
    assert ("large" in kept) == (lost == opening.MANIFEST)  # its files are there
    assert "large" not in kept or (done.large.values == done.x.values[:, None]).all()
    assert np.array_equal(done.y.values, done.x.values**2)
    assert done.name.values.tolist() == [f"{x:g}" for x in done.x.values]
    assert opening.holder(path) is None
    monkeypatch.chdir("/")
    with pytest.raises(SweepError, match="holds results of a store that was lost"):
        linksweep.run(model, place, **how)
