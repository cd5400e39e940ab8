"""What a model prints goes to the log with its point, and never into the output; warnings are counted and told once."""

import json
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest

from linksweep.sweep.executing.process import captured, undisturbed
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


@pytest.mark.parametrize("pool", [p if p == "serial" else slow(p) for p in POOLS])
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


@pytest.mark.filterwarnings("default")
def test_threads_do_not_get_what_others_print():
    barrier = Barrier(4)

    def talk(number):
        with captured() as found:
            barrier.wait()
            for _ in range(100):
                print(number)
                warnings.warn(f"of {number}", stacklevel=1)
            barrier.wait()
        return found

    before = sys.stdout
    with ThreadPoolExecutor(4) as pool:
        for number, found in enumerate(pool.map(talk, range(4))):
            assert found.printed == f"{number}\n" * 100
            (text,) = found.warnings
            assert f"of {number} " in text
            assert found.warnings[text] == 100
    assert sys.stdout is before


def test_no_more_is_kept_than_a_log_should_hold():
    with captured() as found:
        print("x" * 1_000_000)
    assert len(found.printed) == 10_000


@pytest.mark.filterwarnings("default")
def test_each_point_is_told_of_by_itself_whatever_the_one_before_did_to_warnings():
    with captured() as found:
        assert found.taken() is None
        with undisturbed(0):
            print("first")
            warnings.simplefilter("error")
        first = found.taken()
        warnings.warn("of the second", stacklevel=1)
        second = found.taken()
        assert found.taken() is None
    assert (first.printed, dict(first.warnings)) == ("first\n", {})
    assert second.printed == ""
    assert [text.split(" (")[0] for text in second.warnings] == ["UserWarning: of the second"]
