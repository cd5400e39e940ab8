"""Code is part of what a number is: a store made by other code is refused, continued on request, or replaced."""

import json

import pytest

import linksweep
from tests.sweep.user import write_experiment, write_study
from tests.tiers import slow

HELPED = {
    "before": "import helper\n",
    "evaluate": '{"total": [n_sim * helper.value(p["rate"]) for p in points]}',
}


@pytest.fixture
def folder(tmp_path, sweep):
    """A folder with a store of two points, by an experiment that imports a helper, which imports another."""
    write_experiment(tmp_path, **HELPED)
    (tmp_path / "helper.py").write_text("from deeper import FACTOR\n\n\ndef value(rate):\n    return FACTOR * rate\n")
    (tmp_path / "deeper.py").write_text("FACTOR = 1.0\n")
    write_study(tmp_path)
    code, _, err = sweep("run", "s.toml", "-o", "s.zarr", cwd=tmp_path)
    assert code == 0, err
    return tmp_path


def change(folder, kind):
    """Change the code, and return what should be named."""
    if kind == "body":
        write_experiment(
            folder, **HELPED | {"evaluate": '{"total": [100 * n_sim * helper.value(1.0) for p in points]}'}
        )
        return "function user.evaluate ("
    if kind == "default":
        parameters = 'Parameter("rate", "float", 1.0, "rate"), Parameter("kind", "int", 7, "which")'
        write_experiment(folder, **HELPED | {"parameters": parameters})
        return "default of kind is 0 in the store, 7 now"
    (folder / "deeper.py").write_text("FACTOR = 100.0\n")
    return f"value deeper.FACTOR ({folder}/deeper.py, line 1) is 1.0"


def content(store):
    return {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}


@pytest.mark.parametrize("kind", ["body", "default", "deeper"])
def test_other_code_is_refused_with_what_differs_and_nothing_is_written(kind, folder, sweep):
    named = change(folder, kind)
    write_study(folder, "rate = [1.0, 2.0, 3.0]")
    before = content(folder / "s.zarr")
    for command in (
        ("run", "s.toml", "-o", "s.zarr"),
        ("plan", "s.toml", "-o", "s.zarr"),
        ("run", "--retry", "s.zarr"),
    ):
        code, out, err = sweep(*command, cwd=folder)
        assert (code, out) == (2, "")
        assert all(words in err for words in ("was made by other code", named, "--accept-code"))
    assert before == content(folder / "s.zarr")
    for command in ("show", "status"):  # what there is can be read
        assert sweep(command, "s.zarr", cwd=folder)[0] == 0


def test_accepted_code_is_told_for_each_point(folder, sweep):
    named = change(folder, "deeper")
    write_study(folder, "rate = [1.0, 2.0, 3.0]")
    code, out, err = sweep("plan", "s.toml", "-o", "s.zarr", "--accept-code", cwd=folder)
    assert code == 0, err
    assert "3, 2 of them done" in out
    code, _, err = sweep("run", "s.toml", "-o", "s.zarr", "--accept-code", cwd=folder)
    assert code == 0
    assert named in err
    dataset = linksweep.open(folder / "s.zarr")
    assert dataset["mean"].values.tolist() == [1.0, 2.0, 300.0]
    assert dataset["code"].values.tolist() == [1, 1, 2]
    first, second = json.loads(dataset.attrs["code"])
    assert (first["code"]["value deeper.FACTOR"], second["code"]["value deeper.FACTOR"]) == ("1.0", "100.0")
    assert first["code"]["function user.evaluate"] == second["code"]["function user.evaluate"]
    write_study(folder, "rate = [1.0, 2.0, 3.0, 4.0]")  # and the same code again needs no flag
    assert sweep("run", "s.toml", "-o", "s.zarr", cwd=folder)[0] == 0
    dataset = linksweep.open(folder / "s.zarr")
    assert dataset["code"].values.tolist() == [1, 1, 2, 2]
    assert len(json.loads(dataset.attrs["code"])) == 2
    change(folder, "body")
    write_study(folder, "rate = [1.0]", "n_sim = 600")  # blocks of 512: one is kept, or all are new
    assert sweep("run", "s.toml", "-o", "s.zarr", cwd=folder)[0] == 2


def test_fresh_replaces_a_store_and_nothing_else(folder, sweep):
    change(folder, "deeper")
    write_study(folder, "rate = [2.0, 3.0]")
    (folder / "s.zarr" / "notes.txt").write_text("mine")
    code, _, err = sweep("run", "s.toml", "-o", "s.zarr", "--fresh", cwd=folder)
    assert code == 0, err
    dataset = linksweep.open(folder / "s.zarr")
    assert dataset["mean"].values.tolist() == [200.0, 300.0]
    assert "code" not in dataset
    assert (folder / "s.zarr" / "notes.txt").read_text() == "mine"
    assert sweep("check", "s.zarr", cwd=folder)[0] == 0
    (folder / "other").mkdir()
    (folder / "other" / "thesis.txt").write_text("years of work")
    for place in ("other", "helper.py"):
        assert sweep("run", "s.toml", "-o", place, "--fresh", cwd=folder)[0] == 2
    assert [path.read_text() for path in (folder / "other").iterdir()] == ["years of work"]
    assert sweep("run", "s.toml", "-o", "none.zarr", "--fresh", cwd=folder)[0] == 0


def test_reproduce_says_that_the_code_is_another(folder, sweep):
    named = change(folder, "deeper")
    code, _, err = sweep("reproduce", "s.zarr", "--at", "rate=2.0", cwd=folder)
    assert code == 1
    assert named in err
    assert "differs from s.zarr in mean" in err


@pytest.mark.parametrize("pool", ["serial", slow("threads"), slow("processes")])
def test_helpers_of_the_same_name_in_two_folders_do_not_mix(tmp_path, pool):
    folders = [tmp_path / str(number) for number in (1, 2)]
    for number, folder in enumerate(folders, 1):
        write_experiment(folder, **HELPED | {"evaluate": "total(points, n_sim)", "before": LATE})
        (folder / "helper.py").write_text(f"FACTOR = {number}.0\n")
        (folder / "late.py").write_text(f"import helper\nPLUS = {number}00.0\nassert helper.FACTOR == {number}\n")
        write_study(folder)
    for folder, means in zip(folders, [[101.0, 102.0], [202.0, 204.0]], strict=True):
        dataset = linksweep.run(folder / "s.toml", tmp_path / "x.zarr", pool=pool, fresh=True)
        assert dataset["mean"].values.tolist() == means


LATE = """
import helper

def total(points, n_sim):
    from late import PLUS
    return {"total": [n_sim * (helper.FACTOR * p["rate"] + PLUS) for p in points]}
"""
