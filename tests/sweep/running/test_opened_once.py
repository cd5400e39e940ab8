"""A run reads a store's root document once and builds its grid once, and starts no workers where nothing is left."""

import json
import subprocess
import sys
from collections import Counter

import pytest

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing import executor
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import Grid
from linksweep.sweep.running import status
from linksweep.sweep.running.reproduce import reproduce
from linksweep.sweep.running.run import Silent, plan_study, run_study
from linksweep.sweep.running.status import status_report
from linksweep.sweep.stores.location import Folder
from linksweep.sweep.stores.store import repair
from linksweep.sweep.studies.reader import load_study, study_from_dict
from tests.conftest import COINS
from tests.sweep.opening import parts_of

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
        found["root"] += key == "zarr.json" and place.path.name != "point.zarr"  # where a point is computed again
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
    assert counts == {"root": 1 if before == "more" else 2, "grid": 1}  # again at the end: is the store still there?


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
    assert counts == {"root": 2, "grid": 1}
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
    none = {name: pool._replace(opener=None) for name, pool in executor.POOLS.items()}
    monkeypatch.setattr(executor, "POOLS", none)
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


WATCHED = """
import json, sys
started = []
sys.addaudithook(lambda event, arguments: started.append(str(arguments[0])) if event in EVENTS else None)
EVENTS = {"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn"}
sys.argv = ["sweep", *sys.argv[1:]]
try:
    import runpy
    runpy.run_module("linksweep", run_name="__main__")
finally:
    print(json.dumps([started, [name for name in NAMES if name in sys.modules]]), file=sys.stderr)
"""


TOML = """
title = "Coins"
experiment = "{}"
[axes]
coins = [1, 5, 20]
[sampling]
n_sim = 10
"""


def test_a_finished_store_starts_no_process_and_imports_no_executor(tmp_path):
    (tmp_path / "s.toml").write_text(TOML.format(COINS))
    run_study(load_study(str(tmp_path / "s.toml")), tmp_path / "s.zarr", SERIAL)
    script = WATCHED.replace("NAMES", repr(("distributed", "dask.array", "bokeh", "matplotlib", "scipy")))
    command = [sys.executable, "-c", script, "run", "s.toml", "-o", "s.zarr", "--workers", "2", "--quiet"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    started, imported = json.loads(done.stderr.splitlines()[-1])
    assert set(started) <= {"git"}  # which a checkout of linksweep is asked for its commit by
    assert imported == []


def test_a_resumed_run_reads_each_file_of_the_ledger_once_and_each_point_that_is_done_never(
    tmp_path, coins, monkeypatch
):
    read, asked = Counter(), Counter()
    get_all, points = Folder.get_all, Grid.points

    def counted(place, keys):
        keys = list(keys)
        read.update(key for key in keys if key.startswith("blocks/"))
        return get_all(place, keys)

    def given(grid, indices=None):
        for point in points(grid, indices):
            asked[point.digest] += 1
            yield point

    monkeypatch.setattr(Folder, "get_all", counted)
    monkeypatch.setattr(Grid, "points", given)
    one_block = {"sampling": {"n_sim": 10, "n_cat": 1, "seed": 7}}
    for document in (
        coins | one_block,
        coins | one_block | {"axes": {"metal": ["gold", "tin"], "coins": [1, 5, 20, 7]}},
    ):
        whole, half = study_from_dict(document), smaller(document)
        store = tmp_path / f"{len(whole.axes['coins'])}.zarr"
        run_study(half, store, SERIAL)
        read.clear()
        asked.clear()
        dataset, _ = run_study(whole, store, SERIAL)
        assert dataset.attrs["complete"] == 1
        assert {key: n for key, n in read.items() if n > 1} == {}
        assert any(key.startswith("blocks/rows") for key in read)
        assert set(asked.values()) == {1}
        assert len(asked) == len(dataset["status"].values.reshape(-1)) // 2


def test_the_status_of_a_complete_store_asks_no_point_unless_its_ledger_has_lost_some(tmp_path, study, monkeypatch):
    run_study(study, tmp_path / "s.zarr", SERIAL)
    asked = Counter()
    monkeypatch.setattr(status, "Accumulator", lambda *given: asked.update(all=1) or Accumulator(*given))
    whole = status_report(tmp_path / "s.zarr")
    assert whole["complete"]
    assert not asked
    monkeypatch.setattr(status, "BLOCKS", "no attribute")  # as stores of before have none
    assert status_report(tmp_path / "s.zarr") == whole
    assert asked
    monkeypatch.undo()
    [name] = parts_of(tmp_path / "s.zarr")
    (tmp_path / "s.zarr" / name).unlink()
    with pytest.raises(SweepError, match=f"{name} is damaged"):
        status_report(tmp_path / "s.zarr")
    repair(tmp_path / "s.zarr")
    lost = status_report(tmp_path / "s.zarr")
    assert not lost["complete"]
    assert lost["points"]["done"] == 0
