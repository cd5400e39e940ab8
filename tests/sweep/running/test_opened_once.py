"""A run reads a store's root document once and builds its grid once, and starts no workers where nothing is left."""

import json
import subprocess
import sys

import pytest

import linksweep
from tests.conftest import COINS
from tests.sweep.opening import (
    Resources,
    Silent,
    check,
    run_study,
    study_from_dict,
)
from tests.tiers import slow

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


def smaller(coins):
    name, values = next(iter(coins["axes"].items()))
    return study_from_dict(coins | {"axes": coins["axes"] | {name: values[:1]}})


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


HEAVY = ("distributed", "dask", "bokeh", "matplotlib", "scipy", "pandas", "xarray")


@pytest.mark.slow
def test_a_small_run_imports_little_and_a_finished_one_less_and_writes_nothing(tmp_path):
    (tmp_path / "s.toml").write_text(TOML.format(COINS))
    written = []
    for names in (HEAVY, (*HEAVY, "zarr")):
        script = WATCHED.replace("NAMES", repr(names))
        command = [sys.executable, "-c", script, "run", "s.toml", "-o", "s.zarr", "--pool", "serial", "--quiet"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        started, imported = json.loads(done.stderr.splitlines()[-1])
        assert set(started) <= {"git"}  # which a checkout of linksweep is asked for its commit by
        assert imported == []
        written.append({file: file.read_bytes() for file in (tmp_path / "s.zarr").rglob("*") if file.is_file()})
    assert written[0] == written[1]


@pytest.mark.parametrize("change", ["title", "lost", "damaged", "moved"])
def test_a_finished_run_writes_what_is_not_as_it_would_write_it(tmp_path, coins, change):
    store = tmp_path / "s.zarr"
    whole = linksweep.run(coins, store, pool="serial")
    chunk = next(file for file in (store / "status").iterdir() if file.name != "zarr.json")
    if change == "title":
        coins = coins | {"title": "Another"}
    elif change == "moved":
        store = store.rename(tmp_path / "t.zarr")
    else:
        chunk.unlink() if change == "lost" else chunk.write_bytes(b"")
    linksweep.run(coins, store, pool="serial")
    stored = linksweep.open(store)
    assert stored.equals(whole)
    assert stored.attrs["title"] == coins["title"]
    assert str(store) in (store / "zarr.json").read_text()
    assert not check(store)


MODELS = """
import numpy as np

def many(x, y=1.0):
    if x == 3:
        raise ValueError("no")
    day = np.datetime64("2020-01-01") + int(x)
    return {"f": x * 1.5e-6, "whole": int(x), "truth": x > 1, "day": day, "text": f"q{x}", "array": np.arange(3) * x}

def noisy(x, y=1.0, rng=None):
    return rng.normal(x, y)

def some(x, y=1.0):
    return np.nan if x == 1 else 1.0 / y if y else np.inf
"""


@pytest.mark.parametrize(
    "asked",
    [
        *("many --axis x=0:3", "many --axis x=2,1 --axis y=1.0,2.0", "noisy --axis x=0:2 --set n_sim=5"),
        *("some --axis x=1,2 --axis y=0.0,1.0", "some --axis x=1", "some --design sobol:4 --range x=2:3 --range y=1:2"),
        *(slow("radio-stars --set n_cat=3 --set n_sim=4"), slow("quasars --set n_cat=2 --set n_sim=4")),
    ],
)
def test_a_run_prints_what_the_dataset_in_its_store_says(tmp_path, sweep, asked):
    (tmp_path / "models.py").write_text(MODELS)
    study, *options = asked.split()
    command = ("run", study if "-" in study or study == "quasars" else f"models.py:{study}", *options, "-o", "s.zarr")
    printed = " ".join(sweep(*command, cwd=tmp_path)[1].split())
    for sentence in linksweep.answer(linksweep.open(tmp_path / "s.zarr")).sentences:
        assert " ".join(sentence.split()) in printed or sentence.startswith("Incomplete")
    assert sweep(*command, "--json", cwd=tmp_path)[1] == sweep("show", "s.zarr", "--json", cwd=tmp_path)[1]
    table = sweep("show", "s.zarr", cwd=tmp_path)[1].partition("\n\n")[0]
    assert " ".join(table.split()) in printed
