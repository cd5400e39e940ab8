"""One run at a time writes to a store.  Holders are real processes; test_interrupt.py has two runs."""

import errno
import json
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, replace

import pytest

from linksweep import SweepError
from tests.sweep import opening
from tests.sweep.opening import Holder, holder, located, locked
from tests.tiers import slow

HOLD = """
import sys, time
from linksweep.sweep.stores.location import locked
with locked(sys.argv[1]):
    print("held", flush=True)
    time.sleep(3600)
"""


def put_lock(place, content):
    location = located(place)
    location.parent.put(f"{location.name}.lock", content)


def held_by(place, **changes):
    """Leave a lock as a process of this host would that has ended, with changes."""
    with locked(place):
        mine = holder(place)
    other = replace(mine, token="other", **{"pid": 2**22 + 1} | changes)  # above any process number of Linux
    put_lock(place, json.dumps(asdict(other)).encode())
    return other


def lock_file(place):
    location = located(place)
    return location.parent.get(f"{location.name}.lock")


def can_be_taken(place, **options):
    with locked(place, **options):
        assert holder(place).pid == os.getpid()
    return lock_file(place) is None


def without_flock(monkeypatch, number=errno.ENOLCK):
    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(opening.location.fcntl, "flock", refuse)


@pytest.mark.parametrize("number", [None, errno.ENOLCK, slow(errno.EOPNOTSUPP), slow(errno.ENOSYS)])
def test_who_has_it_is_told_until_that_process_is_killed(place, start_sweep, monkeypatch, number):
    if number is not None:
        without_flock(monkeypatch, number)
    process = start_sweep(command=[sys.executable, "-c", HOLD, place])
    assert process.stdout.readline() == "held\n", process.communicate()[1]
    assert holder(place).pid == process.pid
    for break_lock in (False, True):  # never broken while its holder is known to run
        with pytest.raises(SweepError, match=rf"is being written by process {process.pid} on .*, since 20.*") as told:
            can_be_taken(place, break_lock=break_lock)
        assert told.value.where == place
    assert process.poll() is None
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    assert process.returncode is None  # still a zombie of ours
    assert lock_file(place) is not None
    assert holder(place) is None
    process.wait()
    assert can_be_taken(place)
    held_by(place, host="elsewhere")
    assert can_be_taken(place, break_lock=True)
    assert located(place).parent.keys() == []


def test_a_later_process_of_the_same_number_does_not_hold_it(place):
    with locked(place):
        mine = holder(place)
    held_by(place, pid=mine.pid, started=str(int(mine.started) - 1))
    assert holder(place) is None
    assert can_be_taken(place)


@pytest.mark.parametrize("left", [{"host": "elsewhere"}, {"boot": "another boot"}, b"", b"{", b"[]", b'{"host": 1}'])
def test_a_lock_that_cannot_be_judged_or_is_damaged_is_broken_only_on_request(place, left):
    if isinstance(left, bytes):
        put_lock(place, left)
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
        put_lock(place, json.dumps(asdict(other)).encode())
    assert holder(place) == other
