"""The record of failed points in a store."""

import pytest

from linksweep.sweep.contract import SweepError
from linksweep.sweep.stores.ledger import MAX_TRACEBACKS, TRACEBACK_BYTES
from linksweep.sweep.studies.reader import study_from_dict
from linksweep.sweep.studies.record import provenance
from tests.sweep.opening import create_or_resume


@pytest.fixture
def study(coins):
    return study_from_dict(coins)


def open_store(path, study):
    return create_or_resume(path, study, provenance(study))


def record(number, traceback="Traceback ..."):
    return {
        "place": f"coins={number}",
        "kind": "exception",
        "message": f"ValueError: {number} is odd",
        "traceback": traceback,
        "host": "here",
        "when": "2026-01-01T00:00:00+00:00",
    }


def digest(number):
    return number.to_bytes(16, "little")


def test_failures_are_durable_after_a_flush_and_can_be_forgiven(tmp_path, study):
    store = open_store(tmp_path / "s.zarr", study)
    assert store.failures == {}
    store.fail(digest(1), record(1))
    store.fail(digest(2), record(2))
    assert open_store(tmp_path / "s.zarr", study).failures == {}  # not flushed: a killed process
    store.flush()
    again = open_store(tmp_path / "s.zarr", study)
    assert again.failures == {digest(1): record(1), digest(2): record(2)}
    again.clear_failures([digest(1), digest(3)])
    again.flush()
    assert open_store(tmp_path / "s.zarr", study).failures == {digest(2): record(2)}


def test_the_ends_of_so_many_tracebacks_are_kept_and_every_message(tmp_path, study):
    store = open_store(tmp_path / "s.zarr", study)
    long = "é" * TRACEBACK_BYTES + "the end"
    for number in range(MAX_TRACEBACKS + 5):
        store.fail(digest(number), record(number, long))
    store.flush()
    kept = open_store(tmp_path / "s.zarr", study).failures
    assert [r["message"] for r in kept.values()] == [record(n)["message"] for n in range(MAX_TRACEBACKS + 5)]
    texts = [r["traceback"] for r in kept.values()]
    assert sum(map(bool, texts)) == MAX_TRACEBACKS
    assert texts[0].endswith("éthe end")
    assert TRACEBACK_BYTES - 2 < len(texts[0].encode()) <= TRACEBACK_BYTES


@pytest.mark.parametrize("failures", [{"xy": {}}, {"00": {}}, {digest(1).hex(): "text"}, ["list"]])
def test_a_forged_record_is_named(tmp_path, study, failures, monkeypatch):
    store = open_store(tmp_path / "s.zarr", study)
    store.fail(digest(1), record(1))
    monkeypatch.setattr("linksweep.sweep.stores.ledger._recorded", lambda known: failures)
    store.flush()
    with pytest.raises(SweepError, match=r"blocks/failures\.\d+\.0 is damaged \(failures"):
        open_store(tmp_path / "s.zarr", study)
