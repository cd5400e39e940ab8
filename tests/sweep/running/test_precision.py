"""Realisations until a point is as precise as the study asks, the same number in every run."""

import numpy as np
import pytest
import xarray as xr

import linksweep
from linksweep.sweep.contract import Experiment, Output, Parameter, SweepError
from tests.sweep.opening import Resources, RunInterruptedError, run_study, study_from_dict

SERIAL = Resources(pool="serial")


def walk(points, n_sim, rng, catalogue_rng):
    """Normal deviates about ``mean`` with ``scatter``: the relative error of their mean is known in closed form."""
    draws = [rng.normal(p["mean"], p["scatter"], n_sim) for p in points]
    return {"sum": [d.sum() for d in draws], "squares": [(d**2).sum() for d in draws]}


def summary(sums, n, n_cat):
    mean = sums["sum"] / n
    return {"level": mean, "level_mc_error": np.sqrt((sums["squares"] / n - mean**2) / n)}


experiment = Experiment(
    name="level",
    version=1,
    parameters=(Parameter("mean", "float", 10.0, "mean"), Parameter("scatter", "float", 1.0, "scatter", above=0.0)),
    sums={"sum": (), "squares": ()},
    outputs=(Output("level", "m", "mean", headline=True), Output("level_mc_error", "m", "its error")),
    evaluate=walk,
    summarise=summary,
)


def study(tmp_path=None, **sampling):
    return study_from_dict(
        {
            "title": "Levels",
            "experiment": f"{__file__}:experiment",
            "axes": {"scatter": [0.01, 1.0, 10.0]},
            "sampling": {"n_sim": 100, "seed": 3, "precision": 0.01} | sampling,
        }
    )


def test_every_point_gets_what_it_needs_and_not_much_more(tmp_path):
    dataset, _ = run_study(study(), tmp_path / "s.zarr", SERIAL)
    reached = (dataset["level_mc_error"] / dataset["level"]).values
    assert np.all(reached <= 0.01)
    needed = (np.array([0.01, 1.0, 10.0]) / 10.0 / 0.01) ** 2  # realisations, from the law of the mean
    done = dataset["n_sim_done"].values
    assert done.tolist()[:2] == [
        256,
        256,
    ]  # the least is 100, in parts of 64, 64, 128, 256, 512, 512, ..., and one more
    assert needed[2] <= done[2] * 1.1
    assert done[2] <= 1.25 * 1.2 * needed[2] + 512
    assert dataset.attrs["precision"] == 0.01


def test_there_is_a_most(tmp_path):
    dataset, _ = run_study(study(max_n_sim=3000), tmp_path / "s.zarr", SERIAL)
    assert dataset["n_sim_done"].values.tolist()[2] == 3072
    assert dataset.attrs["complete"] == 1


def test_a_run_stopped_between_rounds_goes_on_to_the_same_numbers(tmp_path, monkeypatch):
    whole, _ = run_study(study(), tmp_path / "whole.zarr", SERIAL)
    compute = Experiment.compute
    for stop_at in (1, 4, 5, 9, 13):
        blocks = []

        def stopped(*arguments, blocks=blocks, stop_at=stop_at):
            blocks.append(1)
            if len(blocks) > stop_at:
                raise KeyboardInterrupt
            return compute(*arguments)

        monkeypatch.setattr(Experiment, "compute", stopped)
        with pytest.raises(RunInterruptedError):
            run_study(study(), tmp_path / "s.zarr", SERIAL)
        monkeypatch.undo()
    resumed, _ = run_study(study(), tmp_path / "s.zarr", SERIAL)
    xr.testing.assert_identical(whole.drop_vars("wall_time").drop_attrs(), resumed.drop_vars("wall_time").drop_attrs())


def test_a_finer_precision_goes_on_and_a_coarser_one_leaves_the_store_alone(tmp_path):
    run_study(study(precision=0.05), tmp_path / "s.zarr", SERIAL)
    finer, _ = run_study(study(), tmp_path / "s.zarr", SERIAL)
    fresh, _ = run_study(study(), tmp_path / "fresh.zarr", SERIAL)
    xr.testing.assert_identical(finer.drop_vars("wall_time").drop_attrs(), fresh.drop_vars("wall_time").drop_attrs())
    again, _ = run_study(study(precision=0.05), tmp_path / "s.zarr", SERIAL)
    assert again["n_sim_done"].values.tolist() == finer["n_sim_done"].values.tolist()
    assert xr.open_zarr(tmp_path / "s.zarr").attrs["precision"] == 0.01


QUANTITIES = {
    "mean": (lambda rng, n: rng.exponential(size=n), 1.0),
    "std": (lambda rng, n: rng.exponential(size=n), 1.0),
    "median": (lambda rng, n: rng.lognormal(size=n), 1.0),
    "q95": (lambda rng, n: rng.exponential(size=n), -np.log(0.05)),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "precision"), [("mean", 0.05), ("q95", 0.05), ("q95", 0.15), ("std", 0.15), ("median", 0.15)]
)
def test_errors_at_the_stop_hold_the_truth_as_often_as_others(tmp_path, name, precision):
    draw, truth = QUANTITIES[name]

    @linksweep.experiment(outputs=[linksweep.Output("w", statistics=[name])])
    def waits(copy: int = 0, *, rng, n_sim):
        return {"w": draw(rng, n_sim)}

    sampling = {"n_sim": 100, "precision": precision, "seed": 6}
    dataset = linksweep.run(waits, tmp_path / "s", axes={"copy": range(2000)}, sampling=sampling, pool="serial")
    value, error = dataset[f"w_{name}"].values, dataset[f"w_{name}_mc_error"].values
    assert np.all(error <= precision * value)
    inside = np.abs(value - truth) <= 2.0 * error
    assert 0.935 <= inside.mean() <= 0.965 + 0.005
    assert np.sqrt(np.mean(((value - truth) / error) ** 2)) < 1.1


def test_what_is_alike_at_all_realisations_has_no_error_and_does_not_hold_up_a_precision(tmp_path):
    def walk(*, rng, n_sim):
        steps = rng.normal(3.0, 1.0, (n_sim, 2))
        return {"path": np.cumsum(np.concatenate([np.zeros((n_sim, 1)), steps], axis=1), axis=1)}

    sampling = {"n_sim": 100, "precision": 0.1}
    dataset = linksweep.run(walk, tmp_path / "s", sampling=sampling, pool="serial")
    assert dataset["n_sim_done"].item() == 5120  # 4096, where what is not known counts no more, and a quarter
    assert np.isnan(dataset["path_mean_mc_error"].values).tolist() == [True, False, False]
    assert "all are alike" in dataset["path_mean_mc_error"].attrs["description"]


def test_a_quantile_goes_on_until_its_error_is_known(tmp_path):
    @linksweep.experiment(outputs=[linksweep.Output("w", statistics=["q99.9"])])
    def waits(*, rng, n_sim):
        return {"w": rng.exponential(size=n_sim)}

    dataset = linksweep.run(waits, tmp_path / "s", sampling={"n_sim": 64, "precision": 0.5}, pool="serial")
    assert dataset["w_q99.9_mc_error"].item() <= 0.5 * dataset["w_q99.9"].item()
    assert dataset["n_sim_done"].item() >= 3782
    cut = {"n_sim": 64, "precision": 0.5, "max_n_sim": 1000}
    dataset = linksweep.run(waits, tmp_path / "cut", sampling=cut, pool="serial")
    assert dataset["n_sim_done"].item() == 1024
    assert "below 3782 realisations" in dataset["w_q99.9_mc_error"].attrs["description"]
    assert np.isnan(dataset["w_q99.9_mc_error"].item())


@pytest.mark.parametrize(
    ("sampling", "message"),
    [
        ({"precision": 0.0}, "sampling.precision: input should be greater than 0"),
        ({"max_n_sim": 50}, "max_n_sim = 50: must be at least n_sim = 100"),
        ({"keep_samples": True}, "no samples to keep"),
    ],
)
def test_what_cannot_be_is_said(sampling, message):
    with pytest.raises(SweepError, match=message):
        study(**sampling)
