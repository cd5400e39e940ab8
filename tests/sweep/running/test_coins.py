"""The platform with a small experiment that is not astronomical."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from linksweep.sweep.contract import Experiment, Outcome
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import make_grid
from linksweep.sweep.planning.plan import Plan, generators
from linksweep.sweep.planning.work_queue import Pending, Tuning
from linksweep.sweep.running.run import plan_study, run_study
from linksweep.sweep.studies.reader import study_from_dict
from tests.tiers import slow

SERIAL = Resources(pool="serial")


def run(document, path, resources=SERIAL):
    return run_study(study_from_dict(document), path, resources)


def test_results_are_what_a_plain_loop_over_the_streams_gives(coins, tmp_path):
    dataset, failures = run(coins, tmp_path / "s.zarr")
    study = study_from_dict(coins)
    point = next(p for p in make_grid(study).points() if p.parameters["metal"] == "tin" and p.parameters["coins"] == 5)
    heads = 0
    for catalogue in range(20):
        for part, n_sim in enumerate((512, 488)):
            rng, catalogue_rng = generators(7, point.digest, catalogue, part)
            bias = 0.1 * catalogue_rng.uniform(-1, 1)
            heads += rng.binomial(5, 0.4 + bias, size=n_sim).sum()
    assert dataset["share"].sel(metal="tin", coins=5).item() == heads / (5 * 20_000)
    assert not failures


def test_the_store_opens_with_xarray_alone(coins, tmp_path):
    returned, _ = run(coins, tmp_path / "s.zarr")
    dataset = xr.open_zarr(tmp_path / "s.zarr").load()
    assert dict(dataset.sizes) == {"metal": 2, "coins": 3}
    assert dataset["share"].dims == ("metal", "coins")
    assert dataset["n_sim_done"].values.tolist() == [[20_000] * 3] * 2
    assert dataset["status"].values.tolist() == [[1] * 3] * 2
    xr.testing.assert_identical(dataset.drop_attrs(), returned.drop_attrs())
    assert dataset.attrs["complete"] == 1
    assert dataset.attrs["seed"] == 7


def test_an_experiment_sees_its_parameters_and_nothing_is_lost_in_float64(coins, tmp_path):
    dataset, _ = run(coins, tmp_path / "s.zarr")
    assert dataset["share"].dtype == np.float64
    assert abs(dataset["share"] - 0.4).max() < 0.1 / np.sqrt(3 * 20) * 5  # scatter of 20 biases, uniform in +-0.1


def test_a_point_that_raises_is_recorded_and_the_rest_goes_on(coins, tmp_path, monkeypatch):
    study = study_from_dict(coins)

    def fail(points, n_sim, rng, catalogue_rng):
        if points[0]["coins"] == 5 and points[0]["metal"] == "tin":
            raise ZeroDivisionError("no coins left")
        return toss(points, n_sim, rng, catalogue_rng)

    toss = study.experiment.evaluate
    monkeypatch.setattr("linksweep.sweep.executing.worker.load_experiment", lambda reference, digest: broken)
    broken = replace(study.experiment, evaluate=fail)
    dataset, failures = run(coins, tmp_path / "s.zarr")
    assert failures == {"metal=tin,coins=5": "ZeroDivisionError: no coins left"}
    assert dataset["status"].sel(metal="tin", coins=5).item() == 2
    assert np.isnan(dataset["share"].sel(metal="tin", coins=5))
    assert int((dataset["status"] == 1).sum()) == 5
    assert dataset.attrs["complete"] == 0
    assert "metal=tin,coins=5" in dataset.attrs["failures"]

    monkeypatch.undo()
    _, survey = plan_study(study, tmp_path / "s.zarr")
    assert survey.pending.points == 0
    _, failures = run(coins, tmp_path / "s.zarr")
    assert list(failures) == ["metal=tin,coins=5"]
    dataset, failures = run_study(study, tmp_path / "s.zarr", SERIAL, retry=True)
    assert not failures
    assert dataset.attrs["complete"] == 1


def test_excluded_points_are_labelled_and_not_computed(coins, tmp_path):
    dataset, _ = run(coins | {"exclude": [{"metal": "tin", "coins": {"above": 1}}]}, tmp_path / "s.zarr")
    assert dataset["status"].sel(metal="tin").values.tolist() == [1, 3, 3]
    assert np.isnan(dataset["share"].sel(metal="tin", coins=20))
    assert dataset.attrs["complete"] == 1
    assert dataset.attrs["points"] == 4


def test_zipped_axes_share_a_dimension(coins, tmp_path):
    zipped = coins | {
        "axes": {"coins": [1, 5], "chance": [0.3, 0.6]},
        "fixed": {},
        "grid": {"zip": [["coins", "chance"]]},
    }
    dataset, _ = run(zipped, tmp_path / "s.zarr")
    assert dataset["share"].dims == ("coins",)
    assert dataset["chance"].dims == ("coins",)
    crossed, _ = run(zipped | {"grid": {}}, tmp_path / "crossed.zarr")
    assert dataset["share"].sel(coins=5).item() == crossed["share"].sel(coins=5, chance=0.6).item()


def test_a_study_without_axes_is_one_point(coins, tmp_path):
    dataset, _ = run(coins | {"axes": {}}, tmp_path / "s.zarr")
    assert dataset["share"].dims == ()


def test_a_larger_study_keeps_the_numbers_of_the_smaller_one(coins, tmp_path):
    small = coins | {"axes": {"coins": [1, 5]}, "sampling": coins["sampling"] | {"n_cat": 16, "n_sim": 512}}
    run(small, tmp_path / "s.zarr")
    _, survey = plan_study(study_from_dict(coins), tmp_path / "s.zarr")
    assert survey.pending.blocks < survey.total.blocks
    grown, _ = run(coins, tmp_path / "s.zarr")
    fresh, _ = run(coins, tmp_path / "fresh.zarr")
    xr.testing.assert_identical(grown.drop_attrs(), fresh.drop_attrs())


def test_a_finished_study_is_not_computed_again(coins, tmp_path, monkeypatch):
    first, _ = run(coins, tmp_path / "s.zarr")
    monkeypatch.setattr(Experiment, "compute", None)  # would raise
    again, failures = run(coins, tmp_path / "s.zarr")
    assert not failures
    xr.testing.assert_identical(first.drop_attrs(), again.drop_attrs())


def test_work_in_flight_is_bounded(coins, tmp_path, monkeypatch):
    """A grid of any size makes no large graph: batches are drawn only a few tasks ahead of the results."""
    from linksweep.sweep.executing import dask_driver
    from linksweep.sweep.executing.executor import of_study
    from linksweep.sweep.executing.pools import NO_LIMITS, POOLS

    study = study_from_dict(coins | {"sampling": {"n_sim": 5, "n_cat": 8}})
    monkeypatch.setattr("linksweep.sweep.planning.plan.TARGET", 1.0)  # one catalogue a block
    plan = Plan(make_grid(study))
    pending = Pending(plan, Accumulator(plan), Tuning(most_blocks=1))
    drawn = 0

    def take(count):
        nonlocal drawn
        tasks = pending.take(count)
        drawn += len(tasks)
        return tasks

    with POOLS["threads"].open(study.experiment_reference, 2, print, NO_LIMITS, False) as (_, execute):
        ahead = [drawn - received for received, _ in enumerate(of_study(study, execute)(take))]
    assert len(ahead) == 6 * 8
    assert max(ahead) <= 2 * dask_driver.TASKS_IN_FLIGHT


@pytest.mark.parametrize("pool", ["threads", slow("processes")])
def test_dask_gives_the_bits_of_the_serial_reference(coins, tmp_path, pool):
    serial, _ = run(coins, tmp_path / "serial.zarr")
    parallel, _ = run(coins, tmp_path / "dask.zarr", Resources(workers=2, pool=pool))
    xr.testing.assert_identical(serial.drop_attrs(), parallel.drop_attrs())


def test_a_point_of_nothing_but_nan_has_failed(coins, tmp_path, monkeypatch):
    monkeypatch.setattr(Experiment, "compute", lambda *arguments: [Outcome((np.nan, np.nan))])
    dataset, failures = run(coins, tmp_path / "s.zarr")
    assert set(failures.values()) == {"share is NaN"}
    assert (dataset["status"] == 2).all()


def test_a_title_is_shown_as_it_is_written(coins, tmp_path, capsys):
    """Square brackets are markup to some libraries that draw tables."""
    from linksweep.sweep.cli.group import print_result

    dataset, _ = run(coins | {"title": "Coins [/mas] [bold]x"}, tmp_path / "s.zarr")
    print_result(dataset, "text")
    assert capsys.readouterr().out.splitlines()[0] == "Coins [/mas] [bold]x"


def test_a_table_for_reading_says_what_it_leaves_out(coins, tmp_path, capsys):
    from linksweep.sweep.analysis.results_table import MOST_ROWS
    from linksweep.sweep.cli.group import print_headlines, print_result

    axes = {"coins": {"start": 1, "stop": MOST_ROWS + 7, "step": 1}}
    sampling = {"n_sim": 1, "n_cat": 1, "seed": 1}
    dataset, _ = run(coins | {"axes": axes, "sampling": sampling}, tmp_path / "s.zarr")
    print_headlines(dataset, as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert lines[-2].split()[0] == str(MOST_ROWS)
    assert lines[-1] == "7 more points: `sweep show STORE --format csv` has all of them"
    print_result(dataset, "csv")
    assert len(capsys.readouterr().out.splitlines()) > MOST_ROWS + 7
