"""Stores by the names of their studies."""

import os
import subprocess
import sys

from linksweep.sweep.stores.location import short_name, store_named


def test_the_name_of_a_study_is_that_of_its_store(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert str(store_named("quasars")) == "quasars"
    (tmp_path / "results" / "quasars.zarr").mkdir(parents=True)
    assert str(store_named("quasars")) == str(store_named("results/quasars.zarr")) == "results/quasars.zarr"
    assert short_name(store_named("quasars")) == "quasars"
    assert short_name(store_named("elsewhere/quasars.zarr")) == "elsewhere/quasars.zarr"


def test_a_path_that_exists_goes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("results/quasars.zarr", "quasars"):
        (tmp_path / folder).mkdir(parents=True)
    assert str(store_named("quasars")) == "quasars"
    assert short_name(store_named("results/quasars.zarr")) == "results/quasars.zarr"


def test_a_name_that_is_no_utf_8_ends_no_command_in_a_traceback(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.py").write_text("def model(x: float = 1.0):\n    return 2 * x\n")
    store = os.fsdecode(b"s\xff.zarr")
    for command in (
        ["run", "model.py:model", "--axis", "x=1,2", "-o", store, "--pool", "serial"],
        *(
            ["show", store],
            ["status", store],
            ["status", store, "--json"],
            ["check", store],
            ["check", store, "--repair"],
        ),
        *(["report", store], ["report", store, "-o", os.fsdecode(b"r\xff.html")], ["plot", store, "-o", "p.png"]),
        *(
            ["fit", store, "--over", "x"],
            ["reproduce", store, "--at", "x=1"],
            ["run", "--retry", store],
            ["compare", store],
        ),
        *(["merge", store, store, "-o", os.fsdecode(b"m\xff.zarr")], ["show", os.fsdecode(b"none\xff.zarr")]),
    ):
        done = subprocess.run([sys.executable, "-m", "linksweep", *command], capture_output=True, check=False)
        assert done.returncode in (0, 1, 2), command
        assert b"Traceback" not in done.stderr, (command, done.stderr)
        assert done.returncode == 0 or command[-1] != store or command[0] == "compare", (command, done.stderr)
