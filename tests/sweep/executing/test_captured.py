"""What a model prints goes to the log with its point, and never into the output; warnings are counted and told once."""

import json

import pytest

from tests.patience import PATIENCE_S
from tests.sweep.user import write_experiment, write_study
from tests.tiers import slow

TALKS = """
import os, sys, warnings

def total(points, n_sim):
    (p,) = points
    print(f"at {p['kind']}: {'x' * 5}")
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


@pytest.mark.parametrize("pool", [p if p in ("serial", "threads") else slow(p) for p in POOLS])
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
    (told,) = [line for line in err.splitlines() if "mind the gap" in line]
    assert told.startswith("warned 3 times, first at kind=")
    assert "UserWarning: mind the gap (user.py, line " in told
