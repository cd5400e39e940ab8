"""Two stores become one: the points of both, each once, and nothing that does not belong together."""

import json

import pytest

import linksweep
from linksweep import SweepError
from tests.sweep.opening import MERGED, Killed, OpenStore, dying, merge

MODEL = (
    "def model(x: float = 1.0, k: int = 1):\n"
    "    if k == 9:\n        raise ValueError('nine')\n"
    "    return {'y': x * k, 'name': f'{x:g}'}\n"
)


@pytest.fixture
def run(tmp_path):
    (tmp_path / "model.py").write_text(MODEL)

    def compute(store, study=f"{tmp_path}/model.py:model", **given):
        return linksweep.run(study, store=tmp_path / store, pool="serial", **given)

    return compute


def test_points_beside_a_table_are_a_table(run, tmp_path):
    run("a.zarr", axes={"x": [1.0, 2.0]}, fixed={"k": 3})
    run("b.zarr", points={"x": [1.0, 5.0], "k": [3, 5]})
    ds = merge([tmp_path / "a.zarr", tmp_path / "b.zarr"], tmp_path / "c.zarr")
    rows = zip(ds.x.values.tolist(), ds.k.values.tolist(), ds.y.values.tolist(), strict=True)
    assert set(rows) == {(1.0, 3, 3.0), (2.0, 3, 6.0), (5.0, 5, 25.0)}


def test_failures_are_kept_unless_the_other_store_has_the_point(run, tmp_path):
    run("a.zarr", axes={"k": [1, 9]})
    run("b.zarr", axes={"k": [2]})
    ds = merge([tmp_path / "a.zarr", tmp_path / "b.zarr"], tmp_path / "c.zarr")
    assert json.loads(ds.attrs["failures"]) == {"k=9": "ValueError: nine"}
    assert ds.status.values.tolist() == [1, 1, 2]
    told = json.loads(ds.attrs[MERGED])
    assert [one["store"].rpartition("/")[2] for one in told] == ["a.zarr", "b.zarr"]
    assert told[0]["study_digest"] == OpenStore(tmp_path / "a.zarr").attributes["study_digest"]
    (tmp_path / "model.py").write_text(MODEL.replace("k == 9", "k == 99"))
    run("d.zarr", axes={"k": [9]})
    with pytest.raises(SweepError, match=r"model\.model .* has changed"):
        merge([tmp_path / "c.zarr", tmp_path / "d.zarr"], tmp_path / "e.zarr")
    assert not (tmp_path / "e.zarr").exists()
    healed = merge([tmp_path / "c.zarr", tmp_path / "d.zarr"], tmp_path / "e.zarr", accept_code=True)
    assert healed.status.values.tolist() == [1, 1, 1]
    assert healed.code.values.tolist() == [1, 1, 2]
    assert healed.attrs["failures"] == "{}"
    run("e.zarr", axes={"k": [1, 3]})  # it goes on as any other
    assert len(json.loads(linksweep.open(tmp_path / "e.zarr").attrs[MERGED])) == 2


def test_what_does_not_belong_together_is_refused_and_nothing_is_written(run, tmp_path):
    run("a.zarr", axes={"k": [1]})
    (tmp_path / "other.py").write_text("def model(k: int = 1):\n    return {'y': 1.0, 'name': 'x'}\n")
    run("b.zarr", f"{tmp_path}/other.py:model", axes={"k": [1]})
    with pytest.raises(SweepError, match="these differ"):
        merge([tmp_path / "a.zarr", tmp_path / "b.zarr"], tmp_path / "c.zarr")
    link = {"experiment": "linksweep.core.experiment:link", "fixed": {"n_obj": 20}}
    for store, sampling in (("s.zarr", {"n_sim": 10, "seed": 1}), ("t.zarr", {"n_sim": 20, "seed": 2})):
        linksweep.run(link | {"sampling": sampling}, tmp_path / store, pool="serial")
    with pytest.raises(SweepError) as told:
        merge([tmp_path / "s.zarr", tmp_path / "t.zarr"], tmp_path / "c.zarr")
    assert f"seed: 1 in {tmp_path}/s.zarr, 2 in {tmp_path}/t.zarr" in told.value.problems
    assert f"sampling.n_sim: 10 in {tmp_path}/s.zarr, 20 in {tmp_path}/t.zarr" in told.value.problems
    with pytest.raises(SweepError, match="experiment: "):
        merge([tmp_path / "a.zarr", tmp_path / "s.zarr"], tmp_path / "c.zarr")
    run("d.zarr", axes={"k": [2]})
    with pytest.raises(SweepError, match="holds a store already"):
        merge([tmp_path / "a.zarr", tmp_path / "d.zarr"], tmp_path / "a.zarr")
    assert not (tmp_path / "c.zarr").exists()


def test_other_bits_of_the_same_point_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "m.py").write_text(
        "import pathlib\ndef m(k: int = 1):\n    return float(pathlib.Path('n').read_text())\n"
    )
    for store, number in (("a.zarr", "1.0"), ("b.zarr", "1.0000000000000002")):
        (tmp_path / "n").write_text(number)
        linksweep.run("m.py:m", store, axes={"k": [1, 2]}, pool="serial")
    with pytest.raises(SweepError, match=r"has other numbers than .*b\.zarr at k="):
        merge(["a.zarr", "b.zarr"], "c.zarr")
    assert not (tmp_path / "c.zarr").exists()


def test_what_another_merge_has_left_is_not_replaced(run, tmp_path, monkeypatch):
    for name, k in (("a.zarr", 1), ("b.zarr", 2), ("d.zarr", 3)):
        run(name, axes={"k": [k]})
    one, two, three, into = (tmp_path / f"{name}.zarr" for name in "abdc")
    with monkeypatch.context() as patch:
        dying(patch)[0] = 7
        with pytest.raises(Killed):
            merge([one, two], into)
    with pytest.raises(SweepError, match="holds a store already"):
        merge([one, three], into)
    assert merge([one, two], into).k.values.tolist() == [1, 2]
