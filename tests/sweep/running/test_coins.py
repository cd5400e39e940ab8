"""The platform with a small experiment that is not astronomical."""

from dataclasses import replace

import numpy as np
import xarray as xr

from linksweep.sweep.contract import Experiment
from tests.sweep.opening import Resources, generators, make_grid, plan_study, run_study, study_from_dict

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
    xr.testing.assert_identical(
        dataset.drop_vars("wall_time").drop_attrs(), returned.drop_vars("wall_time").drop_attrs()
    )
    assert dataset.attrs["complete"] == 1
    assert dataset.attrs["seed"] == 7


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


def test_a_larger_study_keeps_the_numbers_of_the_smaller_one(coins, tmp_path):
    small = coins | {"axes": {"coins": [1, 5]}, "sampling": coins["sampling"] | {"n_cat": 16, "n_sim": 512}}
    run(small, tmp_path / "s.zarr")
    _, survey = plan_study(study_from_dict(coins), tmp_path / "s.zarr")
    assert survey.pending.blocks < survey.total.blocks
    grown, _ = run(coins, tmp_path / "s.zarr")
    fresh, _ = run(coins, tmp_path / "fresh.zarr")
    xr.testing.assert_identical(grown.drop_vars("wall_time").drop_attrs(), fresh.drop_vars("wall_time").drop_attrs())


def test_a_finished_study_is_not_computed_again(coins, tmp_path, monkeypatch):
    first, _ = run(coins, tmp_path / "s.zarr")
    monkeypatch.setattr(Experiment, "compute", None)  # would raise
    again, failures = run(coins, tmp_path / "s.zarr")
    assert not failures
    xr.testing.assert_identical(first.drop_vars("wall_time").drop_attrs(), again.drop_vars("wall_time").drop_attrs())
