"""Folders and buckets keep the same promises; one run at a time writes to a store; no links or pipes are in it."""

import errno
import fcntl
import json
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, replace
from unittest.mock import Mock

import pytest

import linksweep
from linksweep import SweepError
from tests.sweep import opening
from tests.sweep.opening import Folder, Holder, holder, located, locked, short_name, store_named
from tests.tiers import slow

MODEL = "def model(x: float = 1.0, k: int = 1):\n    return {'y': x * k, 'σ': f'{x:g}'}\n"
COMMANDS = (  # without the store, which stands behind the first word
    *("show", "status", "status --json", "check", "check --repair", "report", "plot -o p.png", "compare"),
    *("run --retry", "reproduce --at k=1", "find --where y>0 --over k", "fit --over k"),
)
ODD, PAGE, MERGED = (os.fsdecode(name) for name in (b"s\xff.zarr", b"r\xff.html", b"m\xff.zarr"))
HOLD = "import sys, time\nfrom linksweep.sweep.stores.location import locked\nwith locked(sys.argv[1]):\n"
HOLD += '    print("held", flush=True)\n    time.sleep(3600)\n'


@pytest.mark.parametrize("links", [True, False])
def test_only_one_of_many_creates_or_swaps_a_file(place, links, monkeypatch):
    location = located(place)
    monkeypatch.setattr(os, "link", os.link if links else Mock(side_effect=OSError(errno.EPERM, "no links")))
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda i: location.create("lock", bytes([i])), range(24)))
        assert (sum(made), location.get("lock")) == (1, bytes([made.index(True)]))
        for turn in range(5):
            location.put("lock", b"stale")
            swapped = list(pool.map(lambda i: location.swap("lock", b"stale", bytes([i])), range(24)))
            assert sum(swapped) == 1, turn
            assert location.get("lock") == bytes([swapped.index(True)])
    assert not location.swap("none", b"", b"new")
    assert location.get("none") is None


def test_a_file_that_was_replaced_by_an_equal_one_is_not_swapped(tmp_path, monkeypatch):
    """Who waited for the system's lock on a file that has gone since does not hold that of the new one."""
    place, flock = Folder(tmp_path), fcntl.flock
    place.put("lock", b"old")

    def late(descriptor, operation):
        (tmp_path / "other").write_bytes(b"old")
        (tmp_path / "other").replace(tmp_path / "lock")
        flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    assert (place.swap("lock", b"old", b"new"), place.get("lock")) == (False, b"old")


def test_a_file_and_its_folder_are_on_the_disk_or_the_old_one_is(tmp_path, monkeypatch):
    synchronised, fsync = [], os.fsync
    monkeypatch.setattr(os, "fsync", lambda number: (synchronised.append(os.fstat(number).st_ino), fsync(number))[1])
    Folder(tmp_path).put("a/b", b"old")
    assert synchronised == [(tmp_path / "a" / "b").stat().st_ino, (tmp_path / "a").stat().st_ino]
    monkeypatch.setattr(os, "fsync", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space left"):
        Folder(tmp_path).put("a/b", b"new")
    assert (Folder(tmp_path).get("a/b"), os.listdir(tmp_path / "a")) == (b"old", ["b"])
    Folder(tmp_path).delete("a/b", "none")
    assert not [*tmp_path.iterdir()]  # no folder of an array that is gone


def test_an_address_that_is_none_or_needs_a_package_is_refused(monkeypatch):
    for rest in ("", "abc", "abc/", "a/x", "ABC/x", "abc/a//b", "abc/../b", "abc/a\nb", "/abc/x"):
        with pytest.raises(SweepError, match=r"s3://BUCKET/NAME, .* and no //, /\./, /\.\./ or line break"):
            located(f"s3://{rest}")
    for address in ("gs://abc/x", "gs:/x", 5):
        with pytest.raises(SweepError, match=r"(gs:// is not known; a store is|must be) a path,? or .*s3://BUCKET"):
            located(address)
    monkeypatch.setitem(sys.modules, "obstore", None)
    with pytest.raises(SweepError, match=r"pip install 'linksweep\[s3\]'"):
        located("s3://abc/x")


def test_a_store_has_the_name_of_its_study_unless_a_path_exists(here, monkeypatch):
    assert [*map(str, map(store_named, ("quasars", "~/a.zarr")))] == ["quasars", f"{os.environ['HOME']}/a.zarr"]
    (here / "results" / "quasars.zarr").mkdir(parents=True)
    assert str(store_named("quasars")) == str(store_named("results/quasars.zarr")) == "results/quasars.zarr"
    assert short_name(store_named("quasars")) == "quasars"
    assert short_name(store_named("elsewhere/quasars.zarr")) == "elsewhere/quasars.zarr"
    (here / "quasars").mkdir()
    assert str(store_named("quasars")) == "quasars"
    assert short_name(store_named("results/quasars.zarr")) == "results/quasars.zarr"
    goal = {"find": "f > 2.5", "within": 2.0}
    calls = (linksweep.run, "mine.zarr", {}), (linksweep.run, None, {}), (linksweep.refine, "finer.zarr", goal)
    for number, (call, store, how) in enumerate(calls):
        monkeypatch.chdir(here)
        (here / f"{number}.py").write_text(f"import os\nos.chdir('{here.parent}')\ndef f(x: float):\n    return x\n")
        call(f"{number}.py:f", store, axes={"x": [1.0, 3.0]}, pool="serial", **how)
    assert len([*here.glob("*.zarr"), *here.glob("results/f-*.zarr")]) == 3


def line(command, store):
    first, *more = command.split(" ")
    return [first, store, *more]


@pytest.fixture
def store(tmp_path):
    (tmp_path / "model.py").write_text(MODEL)
    linksweep.run(f"{tmp_path}/model.py:model", tmp_path / "s.zarr", axes={"k": [1, 2]}, pool="serial")
    return tmp_path / "s.zarr"


@pytest.mark.slow
@pytest.mark.parametrize("command", [*COMMANDS, f"report -o {PAGE}", f"merge {ODD} -o {MERGED}"], ids=ascii)
def test_a_name_that_the_encoding_does_not_have_ends_no_command_in_a_traceback(store, tmp_path, command):
    linksweep.run(f"{tmp_path}/model.py:model", tmp_path / ODD, axes={"k": [1, 2]}, pool="serial")
    words = [sys.executable, "-m", "linksweep", *line(command, ODD)]
    ascii_only = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0"}
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, check=False, env=ascii_only)
    assert done.returncode == 0 or command == "compare", done.stderr
    assert b"Traceback" not in done.stderr, done.stderr


def contents(folder):
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def moved_out(store, name):
    outside = store.parent / "outside"
    (store / name).rename(outside)
    (store / name).symlink_to(outside)


def pipe(store, name):
    (store / name).unlink(missing_ok=True)
    os.mkfifo(store / name)


PLACES = [
    (moved_out, "blocks"),
    (lambda store, name: (store / name).symlink_to(store.parent / "new"), "y/9.9"),
    (pipe, "zarr.json"),
    slow(pipe, "blocks/zarr.json"),
]
PLACES += [slow(moved_out, name) for name in ("y", "zarr.json", "blocks/rows.3.0")]


@pytest.mark.parametrize(("make", "name"), PLACES)
def test_every_command_refuses_what_is_no_file_and_writes_nothing_through_it(store, tmp_path, sweep, make, name):
    make(store, name)
    before = contents(tmp_path)
    lines = [line(command, store) for command in COMMANDS]
    lines += [["run", "model.py:model", "-o", store, *more] for more in (["--axis", "k=1"], ["--fresh"])]
    for words in lines:
        code, out, err = sweep(*words, cwd=tmp_path)
        assert (code, out, f"{name} is a " in err, "Traceback" in err) == (2, "", True, False), (words, out, err)
    assert contents(tmp_path) == before


def test_a_store_may_itself_be_a_link_and_its_lock_may_not(store, tmp_path, sweep):
    def enlarge():
        return linksweep.run(f"{tmp_path}/model.py:model", store, axes={"k": [1, 2, 4]}, pool="serial")

    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "elsewhere" / "link.zarr"
    link.symlink_to(store)
    assert (Folder(link).name, Folder(link).parent) == ("s.zarr", Folder(tmp_path))  # one lock
    assert (enlarge().attrs["complete"], linksweep.open(link).sizes["k"]) == (1, 3)
    (tmp_path / "s.zarr.lock").symlink_to(tmp_path / "nowhere")
    assert "s.zarr.lock is a symbolic link" in sweep("status", store, code=2)[2]
    with pytest.raises(SweepError, match=r"s\.zarr\.lock is a symbolic link"):
        enlarge()


def test_a_link_that_comes_during_a_run_is_not_followed(tmp_path):
    place, blocks = Folder(tmp_path / "s.zarr"), tmp_path / "s.zarr" / "blocks"
    place.put("blocks/a", b"1")
    shutil.rmtree(blocks)
    (tmp_path / "outside").mkdir()
    blocks.symlink_to(tmp_path / "outside")
    for change in (lambda key: place.put(key, b"2"), place.delete, place.get):
        with pytest.raises(OSError, match="blocks is a symbolic link"):
            change("blocks/a")
    assert list((tmp_path / "outside").iterdir()) == []


# One run at a time writes to a store: holders are real processes; test_interrupt.py has two runs.


def lock_file(place, content=None):
    """Return the content of the lock of a store, or write another one."""
    folder, key = located(place).parent, f"{located(place).name}.lock"
    return folder.get(key) if content is None else folder.put(key, content)


def held_by(place, **changes):
    with locked(place):
        mine = holder(place)
    other = replace(mine, token="other", **{"pid": 2**22 + 1} | changes)  # above any process number of Linux
    lock_file(place, json.dumps(asdict(other)).encode())
    return other


def can_be_taken(place, **options):
    with locked(place, **options):
        assert holder(place).pid == os.getpid()
    return lock_file(place) is None


def without_flock(monkeypatch, number=errno.ENOLCK):
    monkeypatch.setattr(fcntl, "flock", Mock(side_effect=OSError(number, os.strerror(number))))


@pytest.mark.parametrize("number", [None, errno.ENOLCK, slow(errno.EOPNOTSUPP), slow(errno.ENOSYS)])
def test_who_has_it_is_told_until_that_process_is_killed(place, start_sweep, monkeypatch, number):
    if number is not None:
        without_flock(monkeypatch, number)
    process = start_sweep(command=[sys.executable, "-c", HOLD, place])
    assert process.stdout.readline() == "held\n", process.communicate()[1]
    first = holder(place)
    assert first.pid == process.pid
    for break_lock in (False, True):  # never broken while its holder is known to run
        with pytest.raises(SweepError, match=rf"is being written by process {process.pid} on .*, since 20.*") as raised:
            can_be_taken(place, break_lock=break_lock)
        assert raised.value.where == place
    assert process.poll() is None
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    assert process.returncode is None  # still a zombie of ours
    assert lock_file(place) is not None
    assert holder(place) is None
    process.wait()
    assert can_be_taken(place)
    held_by(place, pid=os.getpid(), started=first.started)  # another process has that number
    assert holder(place) is None
    assert can_be_taken(place)
    assert located(place).parent.keys() == []


@pytest.mark.parametrize("left", [{"host": "elsewhere"}, {"boot": "another boot"}, b"", b"{", b"[]", b'{"host": 1}'])
def test_a_lock_that_cannot_be_judged_or_is_damaged_is_broken_only_on_request(place, left):
    if isinstance(left, bytes):
        lock_file(place, left)
    else:
        other = held_by(place, **left)
        assert holder(place) == other
    before = lock_file(place)
    with pytest.raises(SweepError, match=r"(cannot be told from here|damaged).*--break-lock"):
        can_be_taken(place)
    assert lock_file(place) == before
    assert can_be_taken(place, break_lock=True)


def test_a_process_that_was_killed_while_it_took_over_is_named(tmp_path, monkeypatch):
    without_flock(monkeypatch)
    monkeypatch.setattr(opening.location, "PAUSE_S", 0.0)
    held_by(str(tmp_path / "s.zarr"))
    (tmp_path / "s.zarr.lock.taking").touch()
    with pytest.raises(SweepError, match=r"remove s\.zarr\.lock and s\.zarr\.lock\.taking"):
        can_be_taken(tmp_path / "s.zarr")


@pytest.mark.parametrize("flock", [True, False], ids=["flock", "no flock"])
@pytest.mark.parametrize("rounds", [2, slow(10)])
def test_of_many_that_find_a_stale_lock_one_gets_it(place, rounds, flock, monkeypatch):
    if not flock:
        without_flock(monkeypatch)
    inside, most = [], []

    def enter(number):
        with suppress(SweepError), locked(place):
            inside.append(number)
            most.append(len(inside))
            time.sleep(0.05)
            inside.remove(number)

    for turn in range(1, rounds + 1):
        held_by(place)
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(enter, range(8)))
        assert len(most) >= turn
    assert max(most) == 1


def test_a_holder_whose_lock_was_broken_leaves_that_of_the_next(place):
    with locked(place):
        other = Holder("elsewhere", "", 1, "", "2026-01-01", "other")
        lock_file(place, json.dumps(asdict(other)).encode())
    assert holder(place) == other
