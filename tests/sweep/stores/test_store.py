"""The ledger of finished blocks, and the labelled dataset made from it."""

import json
import shutil
import warnings
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import linksweep
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.running.run import run_study
from linksweep.sweep.running.study_store import find_store
from linksweep.sweep.stores import integrity
from linksweep.sweep.stores import store as snapshot
from linksweep.sweep.stores.ledger import PART_BYTES
from linksweep.sweep.stores.store import OpenStore, open_dataset
from linksweep.sweep.studies.reader import study_from_dict
from linksweep.sweep.studies.record import provenance
from tests.sweep.coins import experiment
from tests.sweep.opening import create_or_resume, existing_store, parts_of


@pytest.fixture
def study(coins):
    return study_from_dict(coins)


def open_store(path, study):
    return create_or_resume(path, study, provenance(study))


def rows(number, start=0):
    keys = [(start + i + 1).to_bytes(32, "little") for i in range(number)]
    left = np.arange(2.0 * number).reshape(number, 2) + start
    return keys, left.view(experiment.reducer.dtype).reshape(number)


def test_what_was_flushed_is_there_again(tmp_path, study):
    keys, sums = rows(5)
    store = open_store(tmp_path / "s.zarr", study)
    store.append(keys[:3], sums[:3])
    store.flush()
    store.append(keys[3:], sums[3:])  # never flushed: a killed process
    again = open_store(tmp_path / "s.zarr", study)
    assert set(again.rows) == set(keys[:3])
    again.append(keys[3:], sums[3:])
    again.flush()
    assert np.array_equal(open_store(tmp_path / "s.zarr", study).read(), sums)


@pytest.mark.slow
def test_the_ledger_grows_over_chunks_in_few_files(tmp_path, study):
    store = open_store(tmp_path / "s.zarr", study)
    chunk = PART_BYTES // 48
    written = 0
    for size in (chunk - 1, 1, 5, chunk, 7):  # to the brim, over it, a whole one, a bit more
        store.append(*rows(size, written))
        store.flush()
        written += size
    again = open_store(tmp_path / "s.zarr", study)
    assert len(again.rows) == written
    for start, size in ((0, chunk - 1), (chunk + 5, chunk)):
        keys, sums = rows(size, start)
        assert np.array_equal(again.read()[[again.rows[k] for k in keys]], sums)
    assert len([p for p in (tmp_path / "s.zarr").rglob("*") if p.is_file()]) < 40  # of 262,156 blocks


def test_rows_that_the_manifest_does_not_know_do_not_count(tmp_path, study):
    """As a process leaves them that is killed before it writes the manifest."""
    manifest = tmp_path / "s.zarr" / "blocks" / "zarr.json"
    store = open_store(tmp_path / "s.zarr", study)
    keys, sums = rows(6)
    store.append(keys[:2], sums[:2])
    store.flush()
    before = manifest.read_bytes()
    store.append(keys[2:], sums[2:])
    store.flush()
    manifest.write_bytes(before)
    again = open_store(tmp_path / "s.zarr", study)
    assert set(again.rows) == set(keys[:2])
    again.append(keys[4:], sums[4:])
    again.flush()
    assert np.array_equal(open_store(tmp_path / "s.zarr", study).read(), sums[[0, 1, 4, 5]])


def test_a_flipped_bit_is_noticed(tmp_path, study):
    store = open_store(tmp_path / "s.zarr", study)
    store.append(*rows(4))
    store.flush()
    [name] = parts_of(tmp_path / "s.zarr")
    chunk = tmp_path / "s.zarr" / name
    damaged = bytearray(chunk.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    chunk.write_bytes(damaged)
    with pytest.raises(SweepError, match=rf"{name} is damaged .*`sweep check .* --repair"):
        open_store(tmp_path / "s.zarr", study)


def test_a_directory_left_by_a_kill_before_the_first_write_is_free(tmp_path, study):
    (tmp_path / "s.zarr").mkdir()
    (tmp_path / "s.zarr" / "zarr.json.0123abcd.partial").write_text("{")
    find_store(tmp_path / "s.zarr", study)
    open_store(tmp_path / "s.zarr", study)
    assert OpenStore(tmp_path / "s.zarr").attributes["complete"] == 0


def test_a_store_made_up_to_its_root_is_resumed(tmp_path, study):
    open_store(tmp_path / "s.zarr", study)
    shutil.rmtree(tmp_path / "s.zarr" / "blocks", ignore_errors=True)
    assert existing_store(tmp_path / "s.zarr", study).rows == {}
    dataset, _ = run_study(study, tmp_path / "s.zarr", Resources(pool="serial"))
    assert dataset.attrs["complete"] == 1


def test_a_store_without_results_says_so(tmp_path, study):
    open_store(tmp_path / "s.zarr", study)
    with pytest.raises(SweepError, match=r"is unfinished: .* nothing is damaged"):
        open_dataset(tmp_path / "s.zarr")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sampling": {"n_sim": 1000, "n_cat": 20, "seed": 8}}, "seed: 7 in the store, 8 in the study"),
        ({"fixed": {"chance": 0.6}}, "fixed.chance: 0.4 in the store, 0.6 in the study"),
        ({"fixed": {}}, "fixed.chance: 0.4 in the store, 0.5 in the study"),
    ],
)
def test_another_meaning_is_refused_with_the_differences(tmp_path, coins, study, change, words):
    open_store(tmp_path / "s.zarr", study)
    with pytest.raises(SweepError) as refused:
        find_store(tmp_path / "s.zarr", study_from_dict(coins | change))
    assert words in refused.value.problems


def test_a_fixed_value_may_become_an_axis_and_keeps_its_numbers(tmp_path, coins, study):
    first, _ = run_study(study, tmp_path / "s.zarr", Resources(pool="serial"))
    wider = study_from_dict(coins | {"axes": coins["axes"] | {"chance": [0.3, 0.4]}, "fixed": {}})
    second, _ = run_study(wider, tmp_path / "s.zarr", Resources(pool="serial"))
    xr.testing.assert_equal(second["share"].sel(chance=0.4, drop=True), first["share"])
    assert xr.open_zarr(tmp_path / "s.zarr")["share"].shape == (2, 3, 2)


def test_a_smaller_study_leaves_the_larger_store_as_it_is(tmp_path, coins, study):
    whole, _ = run_study(study, tmp_path / "s.zarr", Resources(pool="serial"))
    before = contents(tmp_path / "s.zarr")
    smaller = study_from_dict(coins | {"axes": {"metal": ["tin"], "coins": [20, 5]}})
    part, _ = run_study(smaller, tmp_path / "s.zarr", Resources(pool="serial"))
    xr.testing.assert_equal(part["share"], whole["share"].sel(metal=["tin"], coins=[20, 5]))
    axis_less = {"axes": {"coins": [5]}, "fixed": coins["fixed"] | {"metal": "tin"}}
    part, _ = run_study(study_from_dict(coins | axis_less), tmp_path / "s.zarr", Resources(pool="serial"))
    xr.testing.assert_equal(part["share"], whole["share"].sel(metal="tin", coins=[5], drop=True))
    shorter = study_from_dict(coins | {"sampling": coins["sampling"] | {"n_sim": 10, "n_cat": 2}})
    part, _ = run_study(shorter, tmp_path / "s.zarr", Resources(pool="serial"))
    assert (part["n_sim_done"] == 20_000).all()
    assert contents(tmp_path / "s.zarr") == before


def contents(store):
    return {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}


def test_a_study_that_is_smaller_and_larger_keeps_the_blocks_that_it_does_not_use(tmp_path, coins, study):
    run_study(study, tmp_path / "s.zarr", Resources(pool="serial"))
    other = study_from_dict(coins | {"axes": {"metal": ["tin"], "coins": [5, 6]}})
    run_study(other, tmp_path / "s.zarr", Resources(pool="serial"))
    assert xr.open_zarr(tmp_path / "s.zarr")["share"].shape == (1, 2)
    assert len(open_store(tmp_path / "s.zarr", study).rows) == 7 * 4


def test_a_newer_format_is_refused_politely(tmp_path, study):
    open_store(tmp_path / "s.zarr", study)
    root = tmp_path / "s.zarr" / "zarr.json"
    document = json.loads(root.read_text())
    document["attributes"]["linksweep_format"] = 99
    root.write_text(json.dumps(document))
    with pytest.raises(SweepError, match=r"format 99; this version of linksweep reads format 6. It is newer: upgrade"):
        open_store(tmp_path / "s.zarr", study)


def test_plain_xarray_opens_a_store_without_a_warning(tmp_path, study):
    run_study(study, tmp_path / "s.zarr", Resources(pool="serial"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert xr.open_zarr(tmp_path / "s.zarr")["metal"].values.tolist() == ["gold", "tin"]


def test_results_on_the_same_axes_have_the_same_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr(integrity, "MOST_VALUES", 9)

    def f(a: int, b: int):
        return {"x": a / b, "n": a * b, "even": a % 2 == 0, "name": f"{a}-{b}"}

    written = linksweep.run(f, tmp_path / "s.zarr", axes={"a": range(1, 6), "b": range(1, 5)}, pool="serial")
    found = xr.open_zarr(tmp_path / "s.zarr")
    assert dict(found.chunks) == {"a": (2, 2, 1), "b": (4,)}
    assert found.load().equals(written)


def test_a_million_points_are_one_chunk_of_each_result():
    shapes = {snapshot.chunk_shape(xr.Variable(("a", "b"), np.empty((1000, 1000), kind))) for kind in ("f8", "i1")}
    assert shapes == {(1000, 1000)}


@pytest.mark.parametrize("name", ["blocks", "failures"])
def test_a_result_that_is_named_as_a_group_of_the_store_is_refused(study, name):
    output = replace(study.experiment.outputs[0], name=name)
    with pytest.raises(SweepError, match=f"output '{name}': the platform gives this name in every dataset"):
        replace(study.experiment, outputs=(output,))


def test_an_older_format_is_explained(tmp_path, study):
    """As the last checkout before format 2 left it."""
    (tmp_path / "s.zarr").mkdir()
    attributes = {"linksweep_format": 1, "study_meaning": "{}", "study_axes": "[]", "complete": 1}
    root = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
    (tmp_path / "s.zarr" / "zarr.json").write_text(json.dumps(root))
    for read in (open_dataset, OpenStore, lambda path: find_store(path, study)):
        with pytest.raises(
            SweepError, match=r"has store format 1; .* It is older.*run the study into a new store with -o"
        ):
            read(tmp_path / "s.zarr")
