"""How far a run is, along each axis: counted against plain sums over the dataset."""

import json

import pytest

from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.interrupt import RunInterruptedError
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.planning.work_queue import Tuning
from linksweep.sweep.running.status import status_report
from linksweep.sweep.stores.store import open_dataset
from linksweep.sweep.studies.reader import study_from_dict
from tests.sweep.opening import Silent, run_study

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
    """A store of 5 points x 4 blocks after 18 blocks, one of each point by turns: three points and most of two."""
    study = study_from_dict(coins | {"exclude": [{"metal": "tin", "coins": 5}]})
    with pytest.raises(RunInterruptedError):
        run_study(study, tmp_path / "s.zarr", SERIAL, Impatient(18), tuning=Tuning(most_blocks=1))
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
    done, both = (sum(row[key] for row in report["axes"]["metal"]) for key in ("done", "realisations_done"))
    assert 20_000 * done < both < 20_000 * 5  # a point that is done in part counts in part


def test_a_single_point_that_was_stopped(coins, tmp_path, sweep):
    study = study_from_dict(coins | {"axes": {}, "fixed": {"metal": "tin"}})
    with pytest.raises(RunInterruptedError):
        run_study(study, tmp_path / "s.zarr", SERIAL, Impatient(2), tuning=Tuning(most_blocks=1))
    code, out, _ = sweep("status", tmp_path / "s.zarr")
    assert (code, "0 of 1 point done" in out) == (0, True)
    done, wanted = (status_report(tmp_path / "s.zarr")[key] for key in ("realisations_done", "realisations"))
    assert f"{100 * done // wanted} % of the realisations" in out
    assert 0 < done < wanted == 20_000


def test_all_failed_points_are_counted_and_a_terminal_says_why(sweep, tmp_path):
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
    words = " ".join(out.split())
    assert "finished: 1 of 1,501 points done, 1,500 failed" in words
    assert reasons.replace(";", "") in words
    assert "next: sweep run --retry s.zarr" in words
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
