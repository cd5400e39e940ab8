"""Damage of every kind to every file of a store: it is named, and set right to the same bits; never wrong numbers."""

import json
import shutil

import numpy as np
import pytest
import xarray as xr

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.planning.work_queue import Tuning
from linksweep.sweep.running.run import run_study
from linksweep.sweep.stores import ledger
from linksweep.sweep.stores.location import Folder, located, locked
from linksweep.sweep.stores.store import check, open_dataset, repair
from linksweep.sweep.studies.reader import study_from_dict
from tests.sweep.opening import create_or_resume, existing_store, parts_of
from tests.sweep.stores.test_integrity import in_use
from tests.tiers import slow

ROW = 48
"""Bytes of a row of coins with its key."""

SERIAL = Resources(pool="serial")
SAMPLES = {
    "title": "Samples",
    "axes": {"n_obj": [20, 30]},
    "fixed": {"catalogue": "quasars", "v_max": 15.0},
    "sampling": {"n_sim": 600, "n_cat": 20, "seed": 5, "keep_samples": True},
}


def small_parts(monkeypatch, size):
    monkeypatch.setattr(ledger, "PART_BYTES", size)


def flip(content):
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :]


def cut(content):
    return content[: len(content) // 2]


DAMAGE = {"a bit flipped": flip, "cut": cut, "lost": None}


@pytest.fixture(params=["coins", slow("samples")])
def whole(request, tmp_path, coins, monkeypatch):
    """A study and a store of it, with several chunks of each array of the ledger, and a failure."""
    small_parts(monkeypatch, 8 * ROW if request.param == "coins" else 2**19)
    study = study_from_dict(coins if request.param == "coins" else SAMPLES)
    run_study(study, tmp_path / "whole.zarr", SERIAL)
    store = existing_store(tmp_path / "whole.zarr", study)
    store.fail(b"another point ..", {"message": "it failed"})
    store.flush()
    return study, tmp_path / "whole.zarr"


def files_of(store):
    return sorted(p.relative_to(store).as_posix() for p in store.rglob("*") if p.is_file())


def damaged(place, change):
    if change is None:
        place.unlink()
    else:
        place.write_bytes(change(place.read_bytes()))


@pytest.mark.parametrize("change", DAMAGE.values(), ids=DAMAGE)
@pytest.mark.parametrize(
    "step",
    [47, slow(7), slow(1)],
    ids=["one file of 47", "one of seven", "every file"],
)
def test_every_file_may_be_damaged(whole, tmp_path, change, step):
    study, store = whole
    wanted, used = open_dataset(store), in_use(store)
    assert not check(store)
    files = [file for file in files_of(store) if study.title == "Coins" or file.startswith(("zarr.json", "blocks/"))]
    assert sum(file.startswith("blocks/rows") for file in files) > 2
    files = files[list(DAMAGE.values()).index(change) :: step]
    for file in files:
        copy = tmp_path / "copy.zarr"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.rmtree(tmp_path / "copy.zarr.damaged", ignore_errors=True)
        shutil.copytree(store, copy)
        damaged(copy / file, change)
        report = check(copy)
        found = {**report.identity, **report.ledger, **report.results}
        assert set(found) == {file} & used, file
        refused = False
        try:  # whoever reads it gets what was written or a message
            xr.testing.assert_identical(open_dataset(copy), wanted)
        except SweepError:
            refused = True
        assert found or not refused, file
        if report.identity or report.ledger:
            with pytest.raises(SweepError, match=r"damaged .*`sweep check .* --repair") as told:
                run_study(study, copy, SERIAL)
            assert any(file in problem for problem in told.value.problems), file
            assert repair(copy)
            if change is not None:
                assert (tmp_path / "copy.zarr.damaged" / file).read_bytes() == change((store / file).read_bytes())
            after = check(copy)
            assert not after.identity, file
            assert not after.ledger, file
        dataset, _ = run_study(study, copy, SERIAL)
        xr.testing.assert_identical(dataset.drop_attrs(deep=False), wanted.drop_attrs(deep=False))
        xr.testing.assert_identical(open_dataset(copy).drop_attrs(deep=False), wanted.drop_attrs(deep=False))
        xr.testing.assert_identical(xr.open_zarr(copy).load().drop_attrs(deep=False), wanted.drop_attrs(deep=False))
        assert not check(copy), file


@pytest.mark.parametrize("turns", [2, pytest.param(12, marks=pytest.mark.slow)])
@pytest.mark.parametrize("document", ["coins", pytest.param("samples", marks=pytest.mark.slow)])
def test_killed_before_any_writing_of_a_file_it_goes_on(document, turns, tmp_path, coins, monkeypatch):
    """A run that writes often ends before its n-th file, for n from the first to the last; what is there is whole."""
    small_parts(monkeypatch, 2 * ROW)
    often = Tuning(most_blocks=1, flush_every_s=-1.0)
    study = study_from_dict(coins if document == "coins" else SAMPLES)
    written = []
    write = Folder._write
    monkeypatch.setattr(Folder, "_write", lambda *a, **k: (written.append(a), write(*a, **k))[1])
    wanted, _ = run_study(study, tmp_path / "whole.zarr", SERIAL, tuning=often)
    total = len(written)
    assert total > 30
    for last in range(1, total, 1 + total // turns):
        store = tmp_path / f"{last}.zarr"

        def killed(*arguments, **options):
            written.append(arguments)
            if len(written) > last:  # noqa: B023 -- used up within the turn
                raise SystemExit("killed")
            return write(*arguments, **options)

        written.clear()
        monkeypatch.setattr(Folder, "_write", killed)
        with pytest.raises(SystemExit):
            run_study(study, store, SERIAL, tuning=often)
        monkeypatch.setattr(Folder, "_write", write)
        assert not check(store).ledger, last
        again, _ = run_study(study, store, SERIAL, tuning=often)
        xr.testing.assert_identical(again.drop_attrs(deep=False), wanted.drop_attrs(deep=False))
        assert not check(store), last


def test_only_what_was_lost_is_computed_again(whole, monkeypatch):
    study, store = whole
    rows = len(existing_store(store, study).rows)
    (store / parts_of(store)[1]).write_bytes(b"")
    repair(store)
    assert len(existing_store(store, study).rows) == rows - 8


def test_a_store_whose_two_documents_are_damaged_says_what_to_do(whole):
    study, store = whole
    for file in ("zarr.json", "blocks/zarr.json"):  # which names the copy of the other
        (store / file).write_bytes(cut((store / file).read_bytes()))
    for action in (check, repair, open_dataset, lambda store: run_study(study, store, SERIAL)):
        with pytest.raises(
            SweepError, match="both damaged, so that nothing tells what the numbers mean; bring one back"
        ):
            action(store)


def test_a_store_that_is_written_to_is_neither_checked_nor_repaired(whole):
    _, store = whole
    with locked(store):
        for action in (check, repair):
            with pytest.raises(SweepError, match="is being written by process"):
                action(store)


@pytest.mark.parametrize("action", [check, repair])
def test_what_is_no_store_is_left_alone(tmp_path, action):
    with pytest.raises(SweepError, match="no store there"):
        action(tmp_path / "none.zarr")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(SweepError, match="is not a store of linksweep"):
        action(tmp_path / "mine")
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["mine", "notes.txt"]


@pytest.mark.slow
def test_a_store_in_a_bucket_is_repaired_too(bucket, coins):
    study = study_from_dict(coins)
    wanted, _ = run_study(study, f"{bucket}/s.zarr", SERIAL)
    place = located(f"{bucket}/s.zarr")
    [name] = parts_of(place)
    place.put(name, flip(place.get(name)))
    assert set(check(place).ledger) == {name}
    repair(place)
    assert not check(place)
    assert existing_store(place, study).rows == {}
    again, _ = run_study(study, place, SERIAL)
    xr.testing.assert_identical(again.drop_attrs(deep=False), wanted.drop_attrs(deep=False))


@pytest.mark.slow
def test_the_commands(tmp_path, link_study, sweep):
    store = tmp_path / "s.zarr"
    quick = ("run", link_study, "-o", store, "--set", "n_sim=20", "--pool", "serial")
    assert sweep(*quick)[0] == 0
    assert sweep("check", store)[:2] == (0, "every file is as it was written\n")
    assert sweep("check", store, "--repair")[:2] == (0, "every file is as it was written\n")
    [name] = parts_of(store)
    chunk = store / name
    chunk.write_bytes(flip(chunk.read_bytes()))
    code, out, err = sweep("check", store)
    assert (code, f"{name}: " in out, "--repair` repairs" in err) == (1, True, True)
    code, out, _ = sweep("check", store, "--json")
    assert (code, set(json.loads(out)["ledger"])) == (1, {name})
    code, _, err = sweep(*quick)
    assert code == 2
    assert f"{name} is damaged" in err
    assert "--repair` repairs" in err
    code, out, err = sweep("check", store, "--repair")
    assert code == 0, err
    assert f"{name}: the next `sweep run` computes again" in out
    assert sweep(*quick)[0] == 0
    assert sweep("check", store)[0] == 0


@pytest.mark.slow
def test_an_unchanged_value_of_samples_survives_a_lost_index(tmp_path, monkeypatch):
    """Rows after a lost chunk of the index still speak of their own samples."""
    small_parts(monkeypatch, 2**17)
    study = study_from_dict(SAMPLES)
    run_study(study, tmp_path / "s.zarr", SERIAL)
    before = existing_store(tmp_path / "s.zarr", study)
    samples = {key: before.samples(key) for key in before.rows}
    (tmp_path / "s.zarr" / parts_of(tmp_path / "s.zarr")[0]).unlink()
    repair(tmp_path / "s.zarr")
    after = create_or_resume(tmp_path / "s.zarr", study, {})
    assert 0 < len(after.rows) < len(samples)
    assert all(np.array_equal(after.samples(key), samples[key]) for key in after.rows)
