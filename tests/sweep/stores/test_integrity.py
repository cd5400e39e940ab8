"""A store after several writings, some files of which are lost, cut, flipped, exchanged or of an earlier writing: all
of these are named, none is read as a value, and all are computed again.
"""

import random
from contextlib import suppress

import pytest
import xarray as xr

import linksweep
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.running.run import run_study
from linksweep.sweep.running.status import status_report
from linksweep.sweep.stores import store as snapshot
from linksweep.sweep.stores.integrity import unsealed
from linksweep.sweep.stores.location import located
from linksweep.sweep.stores.store import OpenStore, check, repair
from linksweep.sweep.studies.reader import study_from_dict
from tests.sweep.stores.test_binding import small_chunks
from tests.tiers import slow

SERIAL = Resources(pool="serial")
MODEL = (
    "def model(x: float = 1.0, k: int = 1):\n"
    "    if k == 3:\n        raise ValueError('three')\n"
    "    return {'y': x * k / 3, 'name': f'{x:g}'}\n"
)
LINK = {
    "title": "Samples",
    "fixed": {"catalogue": "quasars", "v_max": 15.0},
    "sampling": {"n_sim": 200, "n_cat": 3, "seed": 5, "keep_samples": True},
}


def files_of(store):
    location = located(store)
    return location.get_all(location.keys())


def restored(store, files):
    location = located(store)
    for key in set(location.keys()) - set(files):
        location.delete(key)
    for key, content in files.items():
        location.put(key, content)


def in_use(store):
    """The files that the root document means, and those of the ledger; the rest is of the writing before."""
    opened = OpenStore(store)
    arrays = snapshot.arrays_of(opened.root)
    described = {f"{name}/zarr.json" for name in arrays}
    return {"zarr.json", *described, *snapshot.chunk_checksums(opened.root), *opened.ledger().files}


def named(report):
    return {*report.identity, *report.ledger, *report.results}


@pytest.fixture(params=["function", slow("samples")])
def history(request, place, tmp_path, monkeypatch):
    """A study, its store, the files of that after each of three writings, and the results."""
    small_chunks(monkeypatch)
    if request.param == "function":
        (tmp_path / "model.py").write_text(MODEL)
        document = {"title": "Model", "experiment": f"{tmp_path}/model.py:model"}
        axes = [{"k": [1, 2, 3], "x": [float(x) for x in range(1, n)]} for n in (3, 5, 6)]
    else:
        document, axes = LINK, [{"n_obj": [20, 30, 40][:n]} for n in (1, 2, 3)]
    writings = []
    for given in axes:
        study = study_from_dict(document | {"axes": given})
        run_study(study, place, SERIAL)
        writings.append(files_of(place))
    return study, place, writings, linksweep.open(place)


def damage(rng, files, earlier):
    """Return files of which some are lost, cut, flipped, exchanged or of an earlier writing."""
    changed = dict(files)
    for key in rng.sample(sorted(files), rng.choice([1, 1, 2, 3, len(files) // 2])):
        kind = rng.choice(["lost", "cut", "flipped", "exchanged", "earlier", "earlier"])
        content = changed.get(key)
        if kind == "lost" or content is None:
            changed.pop(key, None)
        elif kind == "cut":
            changed[key] = content[: rng.randrange(len(content))]
        elif kind == "flipped":
            at = rng.randrange(len(content))
            changed[key] = content[:at] + bytes([content[at] ^ (1 << rng.randrange(8))]) + content[at + 1 :]
        elif kind == "exchanged":
            other = rng.choice(sorted(changed))
            changed[key], changed[other] = changed[other], content
        elif (old := rng.choice(earlier).get(key)) is not None:
            changed[key] = old
        else:
            del changed[key]
    return changed


def means_the_same(key, one, other):
    """Whether files are equal, or describe the same array of results: that description is written again by each run."""
    if one is None or one == other or not key.endswith("/zarr.json") or key.startswith("blocks/"):
        return one == other
    try:
        documents = [unsealed(content, key) for content in (one, other)]
    except ValueError:
        return False
    for document in documents:
        document["attributes"] = {k: v for k, v in document["attributes"].items() if k not in ("checksum", "revision")}
    return documents[0] == documents[1]


def same(one, other):
    xr.testing.assert_identical(one.drop_attrs(deep=False), other.drop_attrs(deep=False))


@pytest.mark.parametrize("trials", [12, slow(40)])
def test_whatever_happens_to_its_files_is_named_and_mended(history, trials):
    study, store, writings, wanted = history
    files, used = writings[-1], in_use(store)
    assert not check(store)
    rng = random.Random(20)
    for trial in range(trials):
        changed = damage(rng, files, writings[:-1])
        restored(store, changed)
        differing = {key for key in files if not means_the_same(key, changed.get(key), files[key])}
        copies = {key for key in differing if key == "blocks/zarr.json" or key.startswith("blocks/study")}
        if "zarr.json" in differing and copies:  # nothing may say what the numbers mean
            with suppress(SweepError):
                check(store)
            continue
        report = check(store)
        if "zarr.json" not in differing:
            assert named(report) == differing & used, trial
        elif changed.get("zarr.json") not in [writing["zarr.json"] for writing in writings]:
            assert "zarr.json" in report.identity, trial
        _is_told(store, differing & used, wanted, trial)
        repair(store)
        dataset, _ = run_study(study, store, SERIAL)
        same(dataset, wanted)
        same(linksweep.open(store), wanted)
        assert not check(store), trial


def _is_told(store, differing, wanted, trial):
    """Those who read get what was written, of this or an earlier writing, or a message."""
    problems = []
    try:
        found = linksweep.open(store)
        for name in ("y", "name", "sigma_spin"):
            if name in wanted:
                own = wanted[name].sel({axis: found[axis] for axis in found[name].dims})
                assert own.identical(found[name]), trial
    except SweepError as error:
        problems += error.problems
    try:
        report = status_report(store)
    except SweepError as error:
        problems += error.problems
    else:
        assert report["blocks in the ledger"] == len(OpenStore(store).ledger().rows), trial
        read = {f for f in differing if f.startswith("blocks/") and not f.startswith("blocks/samples")}
        missing = {f for f in differing if located(store).get(f) is None and f.startswith("blocks/")}
        assert "zarr.json" in differing or not read | missing, trial
    assert "zarr.json" in differing or all(any(file in told for file in differing) for told in problems), trial


def test_an_earlier_writing_as_a_whole_is_that_writing(history):
    study, store, writings, wanted = history
    for files in writings[:-1]:
        restored(store, files)
        assert not check(store)
        blocks = status_report(store)["blocks in the ledger"]
        assert 0 < blocks < len(wanted.status.values.reshape(-1)) * 3
        dataset, _ = run_study(study, store, SERIAL)
        same(dataset, wanted)


def test_files_of_a_store_that_was_begun_anew_do_not_count(tmp_path):
    """Also those with a higher number of writings than the present ones have."""
    (tmp_path / "model.py").write_text(MODEL)
    store = tmp_path / "s.zarr"
    for last in (1, 2, 4):
        linksweep.run(f"{tmp_path}/model.py:model", store, axes={"k": list(range(1, last + 1))}, pool="serial")
    old = files_of(store)
    linksweep.run(f"{tmp_path}/model.py:model", store, axes={"k": [2, 3]}, pool="serial", fresh=True)
    new, used = files_of(store), in_use(store)
    for key in used - {"zarr.json"}:
        if old.get(key) not in (None, new[key]):
            restored(store, new | {key: old[key]})
            assert named(check(store)) == {key}
