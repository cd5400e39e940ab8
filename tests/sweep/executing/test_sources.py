"""The sources of an experiment travel to workers that do not share its folder, and what it prints goes to the log."""

import json
import os
import subprocess
from contextlib import closing

import pytest

from tests.sweep.opening import open_dataset
from tests.sweep.outside import Outside
from tests.sweep.user import write_experiment, write_study
from tests.tiers import PATIENCE_S, slow


@pytest.mark.slow
def test_workers_without_the_folder_compute_with_its_helpers(tmp_path, sweep):
    """The worker has an empty file system mounted where the client has the study, and neither sees the other's."""
    study = tmp_path / "mine"
    evaluate = '{"total": [n_sim * helper.FACTOR * p["rate"] for p in points]}'
    write_experiment(study, before="import helper", evaluate=evaluate)
    (study / "helper.py").write_text("FACTOR = 5.0\n")
    write_study(study)
    hide = ["unshare", "--mount", "sh", "-c", f'mount -t tmpfs none "{study}" && test ! -e "{study}/user.py" && "$@"']
    if os.geteuid() != 0 or subprocess.run([*hide, "sh", "true"], check=False).returncode:
        pytest.skip("a file system of its own for a process needs root and unshare")
    (tmp_path / "dask").mkdir()
    with closing(Outside(tmp_path / "dask")) as outside:
        outside.start_worker(before=[*hide, "sh"])
        code, out, err = sweep("run", "s.toml", "-o", "s.zarr", "--scheduler", outside.address, cwd=study)
    assert code == 0, err
    assert open_dataset(study / "s.zarr")["mean"].values.tolist() == [5.0, 10.0], out


TALKS = """
import os, sys, warnings

def total(points, n_sim):
    (p,) = points
    print(f"at {p['kind']}: {'x' * 5}")
    print(f"not well at {p['kind']}", file=sys.stderr)
    PROGRAM
    warnings.warn("mind the gap")
    return {"total": [n_sim * p["kind"]]}
"""
POOLS = {
    "serial": ("--pool", "serial"),
    "threads": ("--pool", "threads", "--workers", "2"),
    "processes": ("--workers", "2"),
    "guarded": ("--pool", "serial", "--time-limit", "60"),
}


@pytest.mark.parametrize("pool", [p if p == "threads" else slow(p) for p in POOLS])
def test_what_a_model_prints_is_in_the_log_and_not_in_the_output(pool, tmp_path, start_sweep):
    program = 'os.system("echo from outside")' if pool in ("processes", "guarded") else "pass"
    write_experiment(tmp_path, before=TALKS.replace("PROGRAM", program), evaluate="total(points, n_sim)")
    write_study(tmp_path, "kind = [1, 2, 3]")
    arguments = ("run", "s.toml", "-o", "s.zarr", "--json", "--log", "run.log", *POOLS[pool])
    process = start_sweep(*arguments, cwd=tmp_path)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, err
    rows = json.loads(out)
    assert rows
    log = (tmp_path / "run.log").read_text()
    for kind in (1, 2, 3):
        assert f"kind={kind}: printed: at {kind}: xxxxx" in log
        assert f"kind={kind}: printed: not well at {kind}" in log
    assert "not well" not in err
    (told,) = [line for line in err.splitlines() if "mind the gap" in line]
    assert told.startswith("warned 3 times, first at kind=")
    assert "UserWarning: mind the gap (user.py, line " in told
