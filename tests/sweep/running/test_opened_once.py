"""A run reads a store's root document once and builds its grid once, and starts no workers where nothing is left."""

import json
import subprocess
import sys

import pytest

from tests.conftest import COINS
from tests.sweep.opening import (
    Resources,
    Silent,
    load_study,
    run_study,
    study_from_dict,
)

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


@pytest.mark.slow
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
