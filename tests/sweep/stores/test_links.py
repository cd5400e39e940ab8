"""Links, pipes and devices inside a store are refused by whoever opens it, and never written through."""

import os
import shutil

import pytest

import linksweep
from linksweep.sweep.contract import SweepError
from linksweep.sweep.stores.location import Folder
from tests.sweep.stores.test_integrity import MODEL, files_of

COMMANDS = (
    *(("show",), ("status",), ("check",), ("check", "--repair"), ("report",), ("plot", "-o", "p.png"), ("compare",)),
    *(
        ("run", "--retry"),
        ("reproduce", "--at", "k=1"),
        ("find", "--where", "y > 0", "--over", "k"),
        ("fit", "--over", "k"),
    ),
)


@pytest.fixture
def store(tmp_path):
    (tmp_path / "model.py").write_text(MODEL)
    linksweep.run(f"{tmp_path}/model.py:model", tmp_path / "s.zarr", axes={"k": [1, 2]}, pool="serial")
    return tmp_path / "s.zarr"


def moved_out(store, name):
    """Replace a file or a folder of a store by a link to it outside."""
    outside = store.parent / "outside"
    (store / name).rename(outside)
    (store / name).symlink_to(outside)


def dangling(store, name):
    (store / name).symlink_to(store.parent / "new")


def pipe(store, name):
    (store / name).unlink(missing_ok=True)
    os.mkfifo(store / name)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (moved_out, "blocks"),
        (moved_out, "y"),
        (moved_out, "zarr.json"),
        (moved_out, "blocks/rows.3.0"),
        (dangling, "anything"),
        (dangling, "y/9.9"),
        (pipe, "zarr.json"),
        (pipe, "blocks/zarr.json"),
    ],
)
def test_every_command_refuses_it_and_writes_nothing_through_it(store, tmp_path, sweep, make, name):
    make(store, name)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    for command, *more in (*COMMANDS, ("run", "-o", store, "--axis", "k=1,2,4"), ("run", "-o", store, "--fresh")):
        what = f"{tmp_path}/model.py:model" if command == "run" and "--retry" not in more else store
        code, out, err = sweep(command, what, *more, cwd=tmp_path)
        assert (code, out) == (2, ""), (command, out, err)
        assert f"{name} is a " in err, command
        assert "Traceback" not in err
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def test_a_store_may_itself_be_a_link(store, tmp_path):
    (tmp_path / "link.zarr").symlink_to(store)
    more = linksweep.run(f"{tmp_path}/model.py:model", tmp_path / "link.zarr", axes={"k": [1, 2, 4]}, pool="serial")
    assert more.attrs["complete"] == 1
    assert linksweep.open(store).sizes["k"] == 3


def test_a_file_with_a_second_name_is_replaced_not_written_through(store, tmp_path):
    for number, key in enumerate(files_of(store)):
        os.link(store / key, tmp_path / f"{number}")
    before = {p: p.read_bytes() for p in tmp_path.glob("*") if p.is_file()}
    linksweep.run(f"{tmp_path}/model.py:model", store, axes={"k": [1, 2, 4]}, pool="serial")
    assert {p: p.read_bytes() for p in tmp_path.glob("*") if p.is_file()} == before


def test_a_link_that_comes_during_a_run_is_not_followed(tmp_path):
    place = Folder(tmp_path / "s.zarr")
    place.put("blocks/a", b"1")
    shutil.rmtree(tmp_path / "s.zarr" / "blocks")
    (tmp_path / "outside").mkdir()
    (tmp_path / "s.zarr" / "blocks").symlink_to(tmp_path / "outside")
    for change in (
        lambda: place.put("blocks/a", b"2"),
        lambda: place.delete("blocks/a"),
        lambda: place.get("blocks/a"),
    ):
        with pytest.raises(OSError, match="blocks is a symbolic link"):
            change()
    assert list((tmp_path / "outside").iterdir()) == []


@pytest.mark.parametrize("command", ["status", "run"])
def test_a_lock_that_is_a_link_is_named(store, tmp_path, sweep, command):
    (tmp_path / "s.zarr.lock").symlink_to(tmp_path / "nowhere")
    what = [f"{tmp_path}/model.py:model", "-o", store, "--axis", "k=1,2,4"] if command == "run" else [store]
    code, _, err = sweep(command, *what)
    assert code == 2
    assert "s.zarr.lock is a symbolic link" in err
    with pytest.raises(SweepError, match=r"s\.zarr\.lock is a symbolic link"):
        linksweep.run(f"{tmp_path}/model.py:model", store, axes={"k": [1, 2, 4]}, pool="serial")
