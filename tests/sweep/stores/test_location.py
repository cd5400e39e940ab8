"""Folders and buckets: the same promises, kept by both."""

import os
from concurrent.futures import ThreadPoolExecutor

import pytest

from linksweep.sweep.contract import SweepError
from linksweep.sweep.stores.location import Folder, located


def test_files_come_back_as_they_were_put(place):
    location = located(place)
    assert location.is_free()
    assert location.get("a/b") is None
    location.put("a/b", b"one")
    location.put("a/b", b"two")
    location.put_all({f"c/{i}": bytes([i]) for i in range(20)})
    assert location.get("a/b") == b"two"
    assert location.keys() == sorted(["a/b", *(f"c/{i}" for i in range(20))])
    assert location.keys("a/") == ["a/b"]
    assert location.get_all(["c/7", "none"]) == {"c/7": b"\x07", "none": None}
    assert not location.is_free()
    location.delete("a/b")
    location.delete("a/b")
    assert location.get("a/b") is None


def test_the_place_around_a_store_is_beside_it(place):
    location = located(place)
    location.put("zarr.json", b"{}")
    location.parent.put(location.name + ".lock", b"me")
    assert location.keys() == ["zarr.json"]
    assert location.parent.keys() == ["s.zarr.lock", "s.zarr/zarr.json"]
    assert str(located(str(location))) == str(location) == place


def test_only_one_of_many_creates_a_file(place):
    location = located(place)
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda i: location.create("lock", bytes([i])), range(24)))
    assert sum(made) == 1
    assert location.get("lock") == bytes([made.index(True)])


def test_only_one_of_many_swaps_a_file(place):
    location = located(place)
    for turn in range(5):
        location.put("lock", b"stale")
        with ThreadPoolExecutor(8) as pool:
            swapped = list(pool.map(lambda i: location.swap("lock", b"stale", bytes([i])), range(24)))
        assert sum(swapped) == 1, turn
        assert location.get("lock") == bytes([swapped.index(True)])
    assert not location.swap("none", b"", b"new")
    assert location.get("none") is None


def test_a_file_that_could_not_be_finished_leaves_the_old_one(tmp_path, monkeypatch):
    folder = Folder(tmp_path / "s.zarr")
    folder.put("a", b"old")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        folder.put("a", b"new")
    assert folder.get("a") == b"old"
    assert os.listdir(tmp_path / "s.zarr") == ["a"]


def test_a_file_system_without_links_has_exclusive_files_too(tmp_path, monkeypatch):
    def refuse(*names):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    folder = Folder(tmp_path)
    assert folder.create("a", b"one")
    assert not folder.create("a", b"two")
    assert folder.get("a") == b"one"


def test_links_to_a_folder_are_the_same_place(tmp_path):
    Folder(tmp_path / "s.zarr").put("zarr.json", b"{}")
    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "elsewhere" / "other"
    link.symlink_to(tmp_path / "s.zarr")
    assert (Folder(link).name, Folder(link).parent) == ("s.zarr", Folder(tmp_path))


@pytest.mark.parametrize(
    "address",
    ["s3://", "s3://abc", "s3://abc/", "s3://a/x", "s3://ABC/x", "s3://abc/a//b", "s3://abc/../b", "s3:///abc/x"],
)
def test_an_address_that_is_none_is_refused(address):
    with pytest.raises(SweepError, match="s3://BUCKET/NAME"):
        located(address)


def test_an_unknown_scheme_is_refused():
    with pytest.raises(SweepError, match="gs:// is not known; a store is a path or s3://BUCKET/NAME"):
        located("gs://abc/x")
