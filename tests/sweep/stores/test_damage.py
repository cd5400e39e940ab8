"""Damaged, forged or old files of a store, and runs that end at any moment: all is named, and none read as a value."""

import itertools
import json
import os
import random
import shutil
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from numcodecs import zstd

import linksweep
from tests.sweep import opening
from tests.sweep.opening import check, files_of, in_use, located, parts_of, repair, run, same
from tests.tiers import slow

MODEL = """
import numpy as np
def model(x: float = 1.0, k: int = 1):
    if k == 3:
        raise ValueError("three")
    return {"y": x * k / 3, "name": f"{x:g}"}
def picture(k: int = 1):
    return {"image": np.random.default_rng(k).normal(size=(5, 16)), "y": model(1.0, k)["y"]}
"""


def small_chunks(monkeypatch, folder):
    monkeypatch.setattr("linksweep.sweep.contract.rows.MOST_VALUES", 64)
    (folder / "model.py").write_text(MODEL)
    return {"title": "Images", "experiment": f"{folder}/model.py:picture", "axes": {"k": [1, 2, 3, 4]}}


def flip(content, at=None, bit=2):
    at = len(content) // 2 if at is None else at
    return content[:at] + bytes([content[at] ^ (1 << bit)]) + content[at + 1 :]


def cut(content):
    return content[: len(content) // 2]


def named(report):
    return {*report.identity, *report.ledger, *report.results}


@pytest.mark.parametrize("what", ["coins", slow("images")])
@pytest.mark.parametrize(("where", "step"), [("folder", 8), slow("folder", 1), slow("bucket", 3)])
def test_killed_before_any_operation_it_goes_on(what, where, step, request, tmp_path, coins, monkeypatch):
    document = coins | {"axes": {"coins": [1, 5]}, "sampling": {"n_sim": 100, "n_cat": 20, "seed": 7}}
    if what == "images":
        document = small_chunks(monkeypatch, tmp_path) | {"axes": {"k": [1, 2]}}
    base = str(tmp_path) if where == "folder" else request.getfixturevalue("bucket")
    wanted = run(document, f"{base}/whole.zarr")
    left, said = opening.dying(monkeypatch, type(located(f"{base}/s.zarr"))), set()

    def between():
        before = files_of(store)
        with opening.locked(store), pytest.raises(linksweep.SweepError, match="is being written by process"):
            run(document, store)
        assert files_of(store) == before  # without the lock nothing is written
        if located(store).get("zarr.json") is None:
            with pytest.raises(linksweep.SweepError, match="no store there"):
                check(store)
        else:
            report = check(store)
            assert not report, (number, report)
            said.update(remark.split(":")[0] for remark in report.remarks)
            if (what, where) == ("coins", "folder"):  # who reads without the root has no point before its values
                with warnings.catch_warnings(action="ignore"):  # of what is no array yet
                    plain = xr.open_zarr(store, consolidated=False)
                assert "status" not in plain or (plain.status != 1).where(plain.share.isnull(), True).all()
            assert opening.status_report(store)["state"] != "finished" or (linksweep.open(store).status == 1).all()

    for number in itertools.count(1, step):
        store = f"{base}/{number}.zarr"
        often = {"flush_every_s": -1.0}
        actual, killed = opening.until_done(left, number, lambda: run(document, store, tuning=often), between)  # noqa: B023
        same(actual, wanted)
        assert not check(store).remarks + sorted(named(check(store)))
        assert not {file for file in files_of(store) if file.startswith("blocks/")} - in_use(store)
        if not killed:
            break
    assert number > 20
    assert {"is unfinished", "is incomplete"} & said


@pytest.fixture(params=["function", slow("images"), slow("samples")])
def history(request, place, tmp_path, monkeypatch):
    """A study, its store, the files of that during and after each of three runs, and the results."""
    for name in ("PART_BYTES", "MOST_UNWRITTEN"):
        monkeypatch.setattr(opening.ledger, name, 200)
    (tmp_path / "model.py").write_text(MODEL)
    document = {"title": "Model", "experiment": f"{tmp_path}/model.py:model"}
    axes, writings = [{"k": [1, 2, 3], "x": [float(x) for x in range(1, n)]} for n in (3, 5, 6)], []
    if request.param == "samples":
        sampling = {"n_sim": 200, "n_cat": 3, "seed": 5, "keep_samples": True}
        document = {"title": "Samples", "fixed": {"catalogue": "quasars", "v_max": 15.0}, "sampling": sampling}
        axes = [{"n_obj": [20, 30, 40][:n]} for n in (1, 2, 3)]
    if request.param == "images":
        document, axes = small_chunks(monkeypatch, tmp_path), [{"k": [1, 2, 3, 4, 5, 6][:n]} for n in (3, 5, 6)]

    class Keeping(opening.Progress):
        def advance(self, works, result, taken):
            writings.append(files_of(place))

    for options in axes:
        document = document | {"axes": options}
        run(document, place, {"most_blocks": 2, "flush_every_s": -1.0}, progress=Keeping())
        writings.append(files_of(place))
    return document, place, writings, linksweep.open(place)


def restored(store, files):
    location = located(store)
    for key in set(location.keys()) - set(files):
        location.delete(key)
    for key, content in files.items():
        location.put(key, content)


def damage(rng, files, earlier):
    changed = dict(files)
    for key in rng.sample(sorted(files), rng.choice([1, 1, 2, 3, len(files) // 2])):
        other, content = rng.choice(sorted(changed)), changed[key]
        kind = rng.choice(["lost", "cut", "flipped", "exchanged", "earlier", "earlier"]) if content else "lost"
        if kind == "cut":
            changed[key] = content[: rng.randrange(len(content))]
        elif kind == "flipped":
            changed[key] = flip(content, rng.randrange(len(content)), rng.randrange(8))
        elif kind == "exchanged":
            changed[key], changed[other] = changed[other], content
        elif kind == "lost" or (old := rng.choice(earlier).get(key)) is None:
            del changed[key]
        else:
            changed[key] = old
    return changed


def means_the_same(key, one, other):
    """Whether files are equal, or describe the same array of results: that description is written again by each run."""
    if one is None or one == other or not key.endswith("/zarr.json") or key.startswith("blocks/"):
        return one == other
    try:
        documents = [opening.unsealed(content, key) for content in (one, other)]
    except ValueError:
        return False
    for document in documents:
        document["attributes"] = {k: v for k, v in document["attributes"].items() if k not in ("checksum", "revision")}
    return documents[0] == documents[1]


def damages(files, earlier, step, trials):
    for (file, content), change in list(itertools.product(files.items(), (flip, cut, None)))[::step]:
        yield True, {k: c for k, c in files.items() if k != file} | ({file: change(content)} if change else {})
    rng = random.Random(20)
    for _ in range(trials):
        yield False, damage(rng, files, earlier)


@pytest.mark.parametrize(("step", "trials"), [(17, 3), slow(1, 40)])
def test_whatever_happens_to_its_files_is_named_and_mended(history, step, trials, sweep):
    document, store, writings, wanted = history
    files, used = writings[-1], in_use(store)
    assert not check(store)
    assert sum(file.startswith(("blocks/rows", "blocks/large")) for file in files) > 2
    for is_one, changed in damages(files, writings[:-1], step, trials):
        restored(store, changed)
        differing = {key for key in files if not means_the_same(key, changed.get(key), files[key])}
        copies = {key for key in differing if key == "blocks/zarr.json" or key.startswith("blocks/study")}
        if "zarr.json" in differing and copies:  # nothing may say what the numbers mean
            with suppress(linksweep.SweepError):
                check(store)
            continue
        report = check(store)
        large = {key for key in differing & used if key.startswith("blocks/large")}
        if not is_one and any(key.startswith("blocks/rows") for key in differing):
            differing -= large - named(report)  # nobody knows to which chunks they refer
        if is_one or "zarr.json" not in differing:
            assert named(report) == differing & used
        elif changed.get("zarr.json") not in [writing["zarr.json"] for writing in writings]:
            assert "zarr.json" in report.identity
        is_told(store, differing & used, wanted, sweep)
        if is_one and (report.identity or report.ledger):
            [file] = differing
            with pytest.raises(linksweep.SweepError, match=r"damaged .*`sweep check .* --repair") as raised:
                run(document, store)
            assert any(file in problem for problem in raised.value.problems), file
            assert repair(store)
            assert file not in changed or located(f"{store}.damaged").get(file) == changed[file]
            after = check(store)
            assert not after.identity | after.ledger, file
        elif not is_one:
            repair(store)
        for dataset in (run(document, store), linksweep.open(store)):
            same(dataset, wanted)
        assert not check(store)


def is_told(store, differing, wanted, sweep):
    problems = []
    try:
        actual = linksweep.open(store)
        done, there = actual.status.values == 1, wanted.sel({axis: actual[axis] for axis in actual.status.dims})
        assert (there.status.values[done] == 1).all()
        for name in actual.data_vars.keys() & wanted.keys() - {"status"}:
            np.testing.assert_array_equal(actual[name].values[done], there[name].values[done])
            assert actual[name].attrs == wanted[name].attrs
    except linksweep.SweepError as error:
        problems = error.problems
    code, out, err = sweep("status", store, "--json")
    if code:
        problems.append(err)
    else:
        assert json.loads(out)["blocks"] == len(opening.OpenStore(store).ledger().rows)
        kept = {file for file in differing if file.startswith("blocks/")}
        read = {file for file in kept if not file.startswith(("blocks/samples", "blocks/large"))}
        assert "zarr.json" in differing or not read | {file for file in kept if located(store).get(file) is None}
    assert "zarr.json" in differing or all(any(file in raised for file in differing) for raised in problems)


def test_files_of_a_store_that_was_begun_anew_or_has_another_history_do_not_count(tmp_path, monkeypatch):
    def anew():
        linksweep.run(model, store, axes={"k": [2, 3]}, pool="serial", fresh=True)

    (tmp_path / "model.py").write_text(MODEL)
    model, store = f"{tmp_path}/model.py:model", tmp_path / "s.zarr"
    for last in (1, 2, 4):
        linksweep.run(model, store, axes={"k": list(range(1, last + 1))}, pool="serial")
    old = files_of(store)
    left = opening.dying(monkeypatch)
    for number in (10, 6, 3):  # killed, it is the old one without its results or its blocks
        restored(store, old)
        opening.until_done(left, number, anew, lambda: check(store) and pytest.fail("it is damaged"))
    new, used = files_of(store), in_use(store)
    for key in used - {"zarr.json"}:
        if old.get(key) not in (None, new[key]):
            restored(store, new | {key: old[key]})
            assert named(check(store)) == {key}
    restored(store, new)
    other = shutil.copytree(store, tmp_path / "other")
    for place, k in ((store, 4), (other, 5)):
        linksweep.run(model, place, axes={"k": [2, 3, k]}, pool="serial")
    shutil.rmtree(store / "blocks")
    shutil.copytree(other / "blocks", store / "blocks")
    assert "of another writing" in check(store).ledger["blocks/zarr.json"]


@pytest.mark.parametrize("step", [137, slow(37)])
def test_a_flipped_root_is_damaged_wherever_the_bit(place, coins, step):
    opening.create_or_resume(place, coins).flush()
    location = located(place)
    root = location.get("zarr.json")
    for copy in (True, False):
        if not copy:
            location.delete("blocks/zarr.json")
        for at in range(0, len(root), step):
            location.put("zarr.json", flip(root, at))
            with pytest.raises(linksweep.SweepError, match=r"(?s)\A(?!.*nothing is damaged).*damaged"):
                linksweep.open(place)


def test_what_is_no_store_or_is_written_to_is_left_alone(tmp_path, coins):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    opening.create_or_resume(tmp_path / "s.zarr", coins).flush()
    shutil.copytree(tmp_path / "s.zarr", tmp_path / "cut")
    for file in ("zarr.json", "blocks/zarr.json"):
        (tmp_path / "cut" / file).write_bytes(cut((tmp_path / "cut" / file).read_bytes()))
    before = files_of(tmp_path)
    words = {"none": "no store there", "mine": "is not a store of linksweep", "s.zarr": "is being written by process"}
    words["cut"] = "are damaged: bring one of these back"
    for (name, message), action in itertools.product(words.items(), (check, repair)):
        with opening.locked(tmp_path / "s.zarr"), pytest.raises(linksweep.SweepError, match=message):
            action(tmp_path / name)
    assert files_of(tmp_path) == before


def test_the_commands(tmp_path, sweep):
    (tmp_path / "model.py").write_text(MODEL)
    model, store = f"{tmp_path}/model.py:model", tmp_path / "s.zarr"
    for x in ([1, 2], [4]):
        linksweep.run(model, store, axes={"x": x}, pool="serial")
    assert sweep("check", store)[:2] == (0, "every file is as it was written\n")
    (store / "blocks" / "rows.9.0").touch()  # as from a run that was killed then
    assert "is unfinished: its results are older" in sweep("check", store, code=0)[1]
    (store / "zarr.json").unlink()  # the copy of it is of the last study
    sweep("check", store, "--repair", code=0)
    assert linksweep.run(model, store, axes={"x": [1]}, pool="serial").attrs["complete"]
    assert linksweep.open(store).x.values.tolist() == [1, 2, 4]
    [name] = parts_of(store)
    (store / name).write_bytes(flip((store / name).read_bytes()))
    assert set(json.loads(sweep("check", store, "--json", code=1)[1])["ledger"]) == {name}
    assert f"{name}: " in sweep("check", store, code=1)[1]
    assert f"{name}: the next `sweep run` computes again" in sweep("check", store, "--repair", code=0)[1]
    linksweep.run(model, store, axes={"x": [4]}, pool="serial")
    (store / "y" / "zarr.json").unlink()
    linksweep.run(model, store, axes={"x": [4]}, pool="serial")
    assert not check(store)
    assert linksweep.open(store).y.values.tolist() == [1 / 3, 2 / 3, 4 / 3]
    [copy] = store.glob("blocks/study.*")
    copy.write_bytes(flip(copy.read_bytes()))
    sentence = f"blocks/{copy.name}: the copy of zarr.json was made anew\n"  # its results are as they were
    assert sweep("check", store, "--repair", code=0)[1] == sentence


NESTED = json.loads("[" * 500 + "]" * 500)
VALUES = [10**30, 2**62, 0, -1, 1e308, NESTED, "x", "[" * 5000, None, True, [], {}, [10**12], {"x": 1}]
COMMANDS = [
    *(["status", "S"], ["show", "S"], ["check", "S"], ["find", "S", "--where", "y > 1", "--over", "x"]),
    *(["merge", "S", "other.zarr", "-o", "m.zarr"], ["plan", "model.py:model", "--axis", "x=1,2,5", "-o", "S"]),
    *(["run", "model.py:model", "--axis", "x=1,2,3", "-o", "S", "--pool", "serial"], ["check", "S", "--repair"]),
]


@pytest.mark.parametrize("trials", [2, slow(200)])
def test_every_command_gives_a_sentence_about_a_forged_document(here, sweep_here, trials):
    Path("model.py").write_text(MODEL)
    linksweep.run("model.py:model", "s.zarr", axes={"x": [1.0, 2.0], "k": [1, 2]}, pool="serial")
    linksweep.run("model.py:model", "other.zarr", axes={"x": [7.0], "k": [1, 2]}, pool="serial")
    store = Path("s.zarr")
    files = [path.relative_to(store).as_posix() for path in store.rglob("zarr.json")]
    rng = random.Random(4)
    for trial in range(trials):
        file = rng.choice(["zarr.json", rng.choice(files)])
        document = json.loads((store / file).read_text())
        at, value = rng.choice(list(opening.places_in(document))), rng.choice(VALUES)
        forged = opening.replaced(document, at, value)
        is_sealed = isinstance(forged.get("attributes"), dict)
        content = opening.sealed(forged, file) if is_sealed else json.dumps(forged).encode()
        for command in COMMANDS:
            for old in ("S", "m.zarr"):
                shutil.rmtree(old, ignore_errors=True)
            shutil.copytree(store, "S")
            (Path("S") / file).write_bytes(content)
            code, _, _ = sweep_here(*command)  # raises what is no message
            assert code in (0, 1, 2), (trial, command, file, at, repr(value)[:50])


ARRAYS = "consolidated_metadata", "metadata"
FORGED = [(("attributes", name), [1], name) for name in ("title", "generation", "study_meaning", "manifest")]
FORGED += [((*ARRAYS, "share", "dimension_names", 0), "z", "share has other axes")]
FORGED += [
    ((*ARRAYS, "metal", "attributes", "symbols"), '{"tin": 5}', "metal.attributes.symbols.tin: "),
    ((*ARRAYS, "share", "attributes"), 5, "share.attributes: "),
]
FORGED += [(("attributes", "manifest", opening.IN_TEXT, "parts", 0, "records"), 2**28 - 1, "more records than")]
FORGED += [((*ARRAYS, "share", "codecs", 2, "name"), "zstd", "such chunks")]
FORGED += [((*ARRAYS, "share", "codecs", 1, "name"), "numcodecs.pickle", "share.codecs.1.name: Input should be")]


@pytest.mark.parametrize(("at", "value", "said"), FORGED)
def test_the_field_is_named(coin_store, tmp_path, at, value, said):
    shutil.copytree(coin_store, store := tmp_path / "s.zarr")
    document = opening.replaced(json.loads((store / "zarr.json").read_text()), at, value)
    (store / "zarr.json").write_bytes(opening.sealed(document, "zarr.json"))
    with pytest.raises(linksweep.SweepError, match=rf"zarr\.json is damaged \(.*{said}"):
        linksweep.open(store)


def test_what_would_fill_the_memory_is_not_read(coin_store, tmp_path):
    shutil.copytree(coin_store, store := tmp_path / "s.zarr")
    chunks = opening.chunk_checksums(opening.OpenStore(store).root)
    chunk = next(file for file in chunks if file.startswith("share/"))
    (store / chunk).write_bytes(content := zstd.compress(bytes(2**28)))
    changed = json.dumps(chunks | {chunk: opening.checksum(content)})
    opening.forge(store, lambda attributes: attributes.update(chunk_checksums=changed))
    for said in (f"{chunk}: more would be unpacked", "zarr.json is larger"):
        with pytest.raises(linksweep.SweepError, match=said):
            linksweep.open(store)
        os.truncate(store / "zarr.json", 2**32)
