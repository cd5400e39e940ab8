"""`sweep run --retry` and `sweep reproduce`."""

import json
from pathlib import Path

import pytest
import xarray as xr

from tests.sweep.opening import OpenStore
from tests.tiers import PATIENCE_S

EXPERIMENT = (Path(__file__).parents[1] / "coins.py").read_text()
FRAGILE = EXPERIMENT.replace(
    "    bias =",
    """    from pathlib import Path
    if points[0]["coins"] == 5 and Path(__file__).with_name("broken").exists():
        raise ZeroDivisionError(f"no {points[0]['metal']} coins left")
    bias =""",
)
STUDY = """
title = "Coins"
experiment = "fragile.py:experiment"
[axes]
metal = ["gold", "tin"]
coins = [1, 5, 20]
[sampling]
n_sim = 1000
n_cat = 20
seed = 7
"""


@pytest.fixture
def broken(tmp_path, sweep):
    """A store in which the points with five coins have failed, and the way to mend the experiment."""
    (tmp_path / "fragile.py").write_text(FRAGILE)
    (tmp_path / "coins.toml").write_text(STUDY)
    (tmp_path / "broken").touch()
    code, _, err = sweep("run", tmp_path / "coins.toml", "-o", tmp_path / "s.zarr", cwd="/")
    assert code == 1
    assert "2 points failed" in err
    return tmp_path / "s.zarr", (tmp_path / "broken").unlink


def test_a_failed_point_is_recorded_with_its_traceback_and_left_alone(broken, tmp_path, sweep):
    store, mend = broken
    report = json.loads(sweep("status", store, "--json")[1])
    assert report["failures"]["metal=tin,coins=5"] == "ZeroDivisionError: no tin coins left"
    records = OpenStore(store).ledger().failures
    assert all("fragile.py" in r["traceback"] and r["kind"] == "exception" for r in records.values())
    mend()
    code, _, err = sweep("run", tmp_path / "coins.toml", "-o", store)
    assert code == 1
    assert "0 realisations to do" in err


def test_retry_computes_the_failed_points_and_only_those(broken, tmp_path, sweep):
    store, mend = broken
    code, _, err = sweep("run", "--retry", store, cwd="/")
    assert code == 1
    mend()
    code, out, err = sweep("run", "--retry", store, cwd="/")
    assert code == 0, err
    assert "40,000 realisations to do" in err
    assert "INCOMPLETE" not in out
    code, _, err = sweep("run", tmp_path / "coins.toml", "-o", tmp_path / "whole.zarr")
    assert code == 0, err
    retried, whole = (
        xr.open_zarr(path).load().drop_vars("wall_time").drop_attrs() for path in (store, tmp_path / "whole.zarr")
    )
    xr.testing.assert_identical(retried, whole)
    code, _, err = sweep("run", "--retry", store)
    assert code == 0
    assert "no point" in err


def test_reproduce_gives_every_bit(broken, sweep):
    store, _ = broken
    code, out, err = sweep("reproduce", store, "--at", "metal=tin,coins=20", cwd="/")
    assert code == 0, err
    assert "every bit" in err
    assert "share" in out


def test_reproduce_shows_what_a_failed_point_raises(broken, sweep):
    store, mend = broken
    code, _, err = sweep("reproduce", store, "--at", "metal=tin,coins=5")
    assert code == 1
    assert "ZeroDivisionError: no tin coins left" in err
    assert "in toss" in err
    mend()
    code, _, err = sweep("reproduce", store, "--at", "metal=tin,coins=5")
    assert code == 0
    assert "is failed in" in err


@pytest.mark.slow
def test_reproduce_opens_the_debugger_where_a_point_raises(broken, start_sweep):
    import subprocess

    store, _ = broken
    process = start_sweep("reproduce", store, "--at", "metal=gold,coins=5", "--pdb", stdin=subprocess.PIPE)
    out, _ = process.communicate("p points[0]['coins']\nq\n", timeout=PATIENCE_S)
    assert "(Pdb) 5" in out
    assert process.returncode == 1


def test_a_place_that_is_none_is_refused(broken, sweep):
    for at, message in (
        ("metal=tin", "--at: coins needs a value, one of 1, 5, 20"),
        ("metal=tun,coins=1", "--at metal = 'tun': must be one of 'gold', 'tin'; did you mean 'tin'?"),
        ("metal=tin,coins=6", "--at coins = 6: not on the axis, which has 1, 5, 20"),
        ("metall=tin,coins=6", "--at metall: is not an axis; did you mean 'metal'?"),
        ("tin", "'tin': a place is AXIS=VALUE"),
    ):
        code, _, err = sweep("reproduce", broken[0], "--at", at)
        assert (code, message in err, "Traceback" in err) == (2, True, False), err
