"""Twenty seeded kills of real runs at random instants, each followed by a resume and a comparison of every bit."""

import os
import random
import signal
import subprocess
import sys

import pytest

from tests.sweep.opening import existing_store, load_study, same
from tests.tiers import PATIENCE_S

pytestmark = pytest.mark.slow  # 20 kills of real runs

KILLS = 20
LONGEST_S = 4.0
"""Of starting and work together, before the run is killed: a whole run takes a little longer on an idle machine."""

WAYS = {  # how often each is drawn, of the signal and of the resources
    signal.SIGKILL: 3,
    signal.SIGINT: 1,
    signal.SIGTERM: 1,
}
POOLS = {("--pool", "serial"): 3, ("--workers", "2"): 1, ("--pool", "threads", "--workers", "2"): 1}

READY = (sys.executable, "-c", "import linksweep.sweep.__main__ as command; print('ready', flush=True); command.main()")
"""Python has a traceback of its own for an interrupt while it starts; from here on there is none."""

LONG = ("--set", "n_sim=12000", "--set", "n_cat=8")


def ledger_of(path, study):
    store = existing_store(path, study)
    if store is None:
        return {}
    rows = store.read()
    return {key: rows[row].tobytes() for key, row in store.rows.items()}


def test_killed_at_any_instant_nothing_is_lost_and_no_bit_differs(link_study, tmp_path, start_sweep, sweep):
    """A chain of runs on one store, each killed, until one comes to its end; then the next store, until there were
    enough kills.  After each kill every block in the ledger has the bits of the reference, and none has gone.
    """
    results, study = tmp_path / "whole.zarr", load_study(str(link_study), LONG[1::2])
    assert sweep("run", link_study, "-o", results, "--pool", "serial", *LONG)[0] == 0
    expected = ledger_of(results, study)
    rng = random.Random(2004)
    kills, chain = 0, 0
    before: dict[bytes, bytes] = {}
    while kills < KILLS:
        store = tmp_path / f"{chain}.zarr"
        pool = rng.choices(list(POOLS), list(POOLS.values()))[0]
        process = start_sweep("run", link_study, "-o", store, *LONG, *pool, command=READY, start_new_session=True)
        assert process.stdout.readline() == "ready\n"
        try:
            process.wait(timeout=rng.uniform(0.0, LONGEST_S))
        except subprocess.TimeoutExpired:
            end = rng.choices(list(WAYS), list(WAYS.values()))[0]
            (os.kill if end == signal.SIGTERM else os.killpg)(process.pid, end)  # Ctrl-C reaches workers too
            _, err = process.communicate(timeout=PATIENCE_S)
            kills += 1
            assert process.returncode in (0, -end, 128 + end), err  # 0: it was in its last moment
            assert "Traceback" not in err, err
            after = ledger_of(store, study) if (store / "zarr.json").exists() else {}
            assert before.keys() <= after.keys()
            assert all(expected[key] == row for key, row in after.items())
            before = after
        if process.returncode == 0:
            assert ledger_of(store, study) == expected
            same(store, results)
            chain, before = chain + 1, {}
    code, _, err = sweep("run", link_study, "-o", store, *LONG)
    assert code == 0, err
    same(store, results)
