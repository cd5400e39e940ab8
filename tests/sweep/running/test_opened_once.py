"""A run reads a store's root document once and builds its grid once, and starts no workers where nothing is left."""

import json
from collections import Counter

import pytest

from sweep.executing import choose
from sweep.executing.choose import Resources
from sweep.planning.grid import Grid
from sweep.running.reproduce import reproduce
from sweep.running.run import Silent, plan_study, run_study
from sweep.running.status import status_report
from sweep.stores.folder import Folder
from sweep.studies.reader import study_from_dict

SERIAL = Resources(pool="serial")


class Says(Silent):
    """Remembers what a run says."""

    def __init__(self):
        self.said = []

    def say(self, text):
        self.said.append(text)


@pytest.fixture
def study(coins):
    return study_from_dict(coins)


@pytest.fixture
def counts(monkeypatch):
    """How often the root document of a store is read, and a grid built."""
    found = Counter()
    get, built = Folder.get, Grid.__init__

    def counted(place, key):
        found["root"] += key == "zarr.json"
        return get(place, key)

    def build(grid, study, warnings=None):
        found["grid"] += warnings is None  # a copy of a grid has them
        built(grid, study, *([] if warnings is None else [warnings]))

    monkeypatch.setattr(Folder, "get", counted)
    monkeypatch.setattr(Grid, "__init__", build)
    return found


def smaller(coins):
    name, values = next(iter(coins["axes"].items()))
    return study_from_dict(coins | {"axes": coins["axes"] | {name: values[:1]}})


@pytest.mark.parametrize("before", ["nothing", "part", "all", "more"])
def test_a_run_reads_the_root_document_once_and_builds_one_grid(tmp_path, coins, study, counts, before):
    store = tmp_path / "s.zarr"
    if before != "nothing":
        run_study(smaller(coins) if before == "part" else study, store, SERIAL)
    counts.clear()
    run_study(smaller(coins) if before == "more" else study, store, SERIAL)
    assert counts == {"root": 1, "grid": 1}


@pytest.mark.parametrize("before", ["nothing", "part", "all"])
def test_so_does_one_of_a_plain_function(tmp_path, counts, before):
    (tmp_path / "f.py").write_text("def f(x: float = 1.0):\n    return 2 * x\n")
    document = {"title": "f", "experiment": f"{tmp_path}/f.py:f", "axes": {"x": [1.0, 2.0]}}
    store = tmp_path / "s.zarr"
    if before != "nothing":
        axes = {"x": [1.0]} if before == "part" else document["axes"]
        run_study(study_from_dict(document | {"axes": axes}), store, SERIAL)
    counts.clear()
    dataset, _ = run_study(study_from_dict(document), store, SERIAL)
    assert counts == {"root": 1, "grid": 1}
    assert dataset["f"].values.tolist() == [2.0, 4.0]


@pytest.mark.parametrize(
    "look", [lambda store, study: status_report(store), lambda store, study: plan_study(study, store)]
)
def test_so_do_status_and_plan(tmp_path, study, counts, look):
    run_study(study, tmp_path / "s.zarr", SERIAL)
    counts.clear()
    look(tmp_path / "s.zarr", study)
    assert counts == {"root": 1, "grid": 1}


def test_a_point_that_is_reproduced_comes_from_one_opening(tmp_path, study, counts):
    run_study(study, tmp_path / "s.zarr", SERIAL)
    counts.clear()
    place = ",".join(f"{name}={values[0]}" for name, values in study.axes.items())
    assert reproduce(tmp_path / "s.zarr", place).differences == {}
    assert counts["root"] == 1


def test_where_nothing_is_left_no_workers_start(tmp_path, study, monkeypatch):
    whole, _ = run_study(study, tmp_path / "s.zarr", SERIAL)
    none = {name: pool._replace(open=None) for name, pool in choose.POOLS.items()}
    monkeypatch.setattr(choose, "POOLS", none)
    for resources in (Resources(workers=2), Resources(scheduler="tcp://nowhere:1")):
        again, failures = run_study(study, tmp_path / "s.zarr", resources)
        assert not failures
        assert again.drop_attrs().identical(whole.drop_attrs())


def test_a_smaller_study_is_answered_while_another_process_holds_the_lock(tmp_path, coins, study):
    store, says = tmp_path / "s.zarr", Says()
    whole, _ = run_study(study, store, SERIAL)
    lock = {"host": "elsewhere", "boot": "", "pid": 1, "started": "", "since": "then", "command": "x", "token": "t"}
    (tmp_path / "s.zarr.lock").write_text(json.dumps(lock))
    part, _ = run_study(smaller(coins), store, SERIAL, says)
    assert part["status"].size < whole["status"].size
    assert any("holds more than this study asks for" in text for text in says.said)
