"""How far a run is, along each axis: counted against plain sums over the dataset."""

import json

import numpy as np
import pytest

from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.interrupt import RunInterruptedError
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.planning.work_queue import Tuning
from linksweep.sweep.running.run import Silent, run_study
from linksweep.sweep.running.status import MOST_LINES, axis_table, by_axis, folded, status_report
from linksweep.sweep.stores.store import open_dataset
from linksweep.sweep.studies.reader import study_from_dict

SERIAL = Resources(pool="serial")


class Impatient(Silent):
    """Interrupts a run after some results."""

    def __init__(self, results):
        self.left = results

    def advance(self, works, result, taken):
        self.left -= 1
        if not self.left:
            raise KeyboardInterrupt


@pytest.fixture
def stopped(coins, tmp_path):
    """A store of 6 points x 4 blocks after 14 blocks: three points and a half."""
    study = study_from_dict(coins | {"exclude": [{"metal": "tin", "coins": 5}]})
    with pytest.raises(RunInterruptedError):
        run_study(study, tmp_path / "s.zarr", SERIAL, Impatient(14), tuning=Tuning(most_blocks=1))
    return tmp_path / "s.zarr"


def test_each_axis_counts_points_and_realisations(stopped):
    report = status_report(stopped)
    dataset = open_dataset(stopped)
    assert report["points"] == {"missing": 2, "done": 3, "failed": 0, "excluded": 1}
    assert not report["complete"]
    for dimension, segments in report["axes"].items():
        other = "coins" if dimension == "metal" else "metal"
        for segment in segments:
            part = dataset.sel(segment["at"])
            assert segment["done"] == int((part["status"] == Status.DONE).sum())
            assert segment["excluded"] == int((part["status"] == Status.EXCLUDED).sum())
            assert segment["points"] == dataset.sizes[other] - segment["excluded"]
            assert segment["realisations_done"] == int(part["n_sim_done"].sum())
            assert segment["realisations"] == 20_000 * segment["points"]
    tin = report["axes"]["metal"][1]
    assert 0 < tin["realisations_done"] < 20_000  # a point that is done in part counts in part
    assert tin["done"] == 0


def test_zipped_axes_are_counted_together(coins, tmp_path):
    document = coins | {
        "axes": {"coins": [1, 5], "chance": [0.3, 0.6]},
        "fixed": {},
        "grid": {"zip": [["coins", "chance"]]},
    }
    run_study(study_from_dict(document), tmp_path / "s.zarr", SERIAL)
    report = status_report(tmp_path / "s.zarr")
    assert list(report["axes"]) == ["coins"]
    assert [segment["at"] for segment in report["axes"]["coins"]] == [
        {"coins": 1, "chance": 0.3},
        {"coins": 5, "chance": 0.6},
    ]


def test_the_command_prints_a_table_and_json_has_every_value(sweep, stopped):
    code, out, err = sweep("status", stopped)
    assert code == 0, err
    lines = [line.rstrip() for line in out.splitlines()]
    start = lines.index("metal  points done  realisations  excluded")
    assert lines[start : start + 8] == [
        "metal  points done  realisations  excluded",
        "gold           3/3         100 %",
        "tin            0/2          40 %         1",
        "",
        "coins  points done  realisations  excluded",
        "1              1/2          90 %",
        "5              1/1         100 %         1",
        "20             1/2          50 %",
    ]
    assert "running: no" in lines
    assert any(line.startswith("last written: 20") for line in lines)
    code, out, _ = sweep("status", stopped, "--json")
    document = json.loads(out)
    assert [row["at"] for row in document["axes"]["coins"]] == [{"coins": 1}, {"coins": 5}, {"coins": 20}]
    assert document["axes"]["metal"][0] == {
        **{"at": {"metal": "gold"}, "points": 3, "done": 3, "failed": 0, "excluded": 0},
        **{"realisations_done": 60_000, "realisations": 60_000},
    }


def test_a_long_axis_is_folded_where_nothing_happens():
    """A run that is in the middle of a thousand values."""
    status = np.array([Status.DONE] * 400 + [Status.MISSING] * 600, dtype=np.int8)
    realisations = np.array([10] * 400 + [7] + [0] * 599)
    segments = by_axis({"x": [{"x": 0.5 * i} for i in range(1000)]}, status, realisations, 10)
    table = axis_table(segments["x"], {"x": "mag"})
    assert [column.name for column in table.columns] == ["x [mag]", "points done", "realisations"]
    assert [list(column.shown) for column in table.columns] == [
        ["0.0 ... 199.5 (400 values)", "200.0", "200.5 ... 499.5 (599 values)"],
        ["400/400", "0/1", "0/599"],
        ["100 %", "70 %", "0 %"],
    ]
    mixed = by_axis(
        {"x": [{"x": i} for i in range(1000)]},
        np.tile([Status.DONE, Status.MISSING], 500).astype(np.int8),
        realisations,
        1,
    )
    assert len(folded(mixed["x"])) == MOST_LINES


def test_a_plan_is_told_in_words_with_units(sweep, coins, tmp_path):
    text = f"""
title = "Coins"
experiment = "{coins["experiment"]}"
axes.coins = [1, 5]
sampling = {{ n_sim = 1000, n_cat = 20 }}
"""
    (tmp_path / "study.toml").write_text(text)
    sweep("run", "study.toml", "--set", "coins=1", cwd=tmp_path)
    code, out, err = sweep("plan", "study.toml", cwd=tmp_path)
    assert code == 0, err
    lines = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert lines["study"] == "Coins"
    assert lines["grid"] == "coins 2"
    assert lines["points"] == "2, 1 of them done"
    assert lines["realisations"] == "40,000, 20,000 of them done"
    assert lines["work"] == "4 blocks in about 1 task"
    assert lines["time"] == "less than a second of computing on 1 core of this machine"
    assert lines["store"] == "results/study.zarr"


def test_all_failed_points_are_counted_and_a_terminal_names_the_first(sweep, tmp_path):
    (tmp_path / "f.py").write_text(
        "def f(a: int):\n    if a > 1:\n        raise ValueError('even' if a % 2 == 0 else 'odd')\n    return a\n"
    )
    code, _, err = sweep(
        "run", "f.py:f", "--axis", "a=1:1501:1", "-o", "s.zarr", "-q", "--pool", "serial", cwd=tmp_path
    )
    reasons = "1,500 points failed: 750 like ValueError: even, for example at a=2; 750 like ValueError: odd, for"
    assert code == 1
    assert reasons in " ".join(err.split())
    code, out, _ = sweep("status", "s.zarr", "--json", cwd=tmp_path)
    failures = json.loads(out)["failures"]
    assert list(failures) == [f"a={a}" for a in range(2, 1502)]
    code, out, _ = sweep("status", "s.zarr", cwd=tmp_path)
    lines = out.splitlines()
    assert reasons in " ".join(out.split())
    assert lines.index("  a=21: ValueError: odd") - lines.index("  a=2: ValueError: even") == 19
    assert "  1,480 more points: `sweep status STORE --json` has all of them" in lines
    assert len(open_dataset(tmp_path / "s.zarr").attrs["failures"]) < 40_000


def test_points_that_failed_are_not_counted_as_done_in_a_plan(sweep, tmp_path):
    (tmp_path / "f.py").write_text("def f(a: int):\n    return 1 / (a % 2)\n")
    here = ("f.py:f", "-o", "s.zarr")
    study = (*here, "--axis", "a=1:10:1")
    sweep("run", *study, "-q", "--pool", "serial", cwd=tmp_path)
    failed = "5 failed (`sweep run --retry` tries them again)"
    _, out, _ = sweep("plan", *study, cwd=tmp_path)
    assert f"10, 5 of them done, {failed}" in " ".join(out.split())
    _, out, _ = sweep("plan", *here, "--axis", "a=1:12:1", "--json", cwd=tmp_path)
    report = json.loads(out)
    assert [report[key] for key in ("points", "points_done", "points_failed", "blocks_pending")] == [12, 5, 5, 2]
    _, _, err = sweep("run", *study, "--pool", "serial", cwd=tmp_path)
    assert f"10 points, 5 of them in the store already, {failed}; 0 points to do" in " ".join(err.split())
