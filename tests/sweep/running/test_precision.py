"""Realisations until a point is as precise as the study asks, the same number in every run."""

import numpy as np
import pytest

import linksweep
from linksweep import Output, SweepError, experiment
from tests.sweep.opening import OpenStore, Stopping, same


@experiment(outputs=[Output("level", statistics=["mean"])])
def levels(scatter: float, *, rng, n_sim):
    """The relative error of the mean is known in closed form."""
    return {"level": rng.normal(10.0, scatter, n_sim)}


def run(store, progress=None, **sampling):
    sampling = {"n_sim": 100, "seed": 3, "precision": 0.01} | sampling
    axes = {"scatter": [0.01, 1.0, 10.0]}
    return linksweep.run(levels, store, axes=axes, sampling=sampling, pool="serial", progress=progress)


def test_every_point_gets_what_it_needs_and_not_much_more(tmp_path):
    dataset = run(tmp_path / "s.zarr")
    assert np.all(dataset["level_mean_mc_error"] <= 0.01 * dataset["level_mean"])
    needed = (np.array([0.01, 1.0, 10.0]) / 10.0 / 0.01) ** 2  # realisations, from the law of the mean
    done = dataset["n_sim_done"].values
    assert done.tolist()[:2] == [256, 256]  # the least is 100, in parts of 64, 64, 128, 256, 512, ..., and one more
    assert needed[2] <= done[2] * 1.1
    assert done[2] <= 1.25 * 1.2 * needed[2] + 512
    assert dataset.attrs["precision"] == 0.01
    bounded = run(tmp_path / "most.zarr", max_n_sim=3000)
    assert bounded["n_sim_done"].values.tolist()[2] == 3072
    assert bounded.attrs["complete"] == 1


def test_stopped_anywhere_or_of_a_coarser_precision_it_goes_on_to_the_same_numbers(tmp_path):
    whole = run(tmp_path / "whole.zarr")
    run(tmp_path / "s.zarr", precision=0.05)
    for error in (KeyboardInterrupt, RuntimeError):
        before = len(OpenStore(tmp_path / "s.zarr").ledger().rows)
        with pytest.raises(error):
            run(tmp_path / "s.zarr", Stopping(2, error))
        assert len(OpenStore(tmp_path / "s.zarr").ledger().rows) > before
    same(run(tmp_path / "s.zarr"), whole)
    again = run(tmp_path / "s.zarr", precision=0.05)  # a coarser one leaves the store alone
    assert again["n_sim_done"].values.tolist() == whole["n_sim_done"].values.tolist()
    assert linksweep.open(tmp_path / "s.zarr").attrs["precision"] == 0.01


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

    @experiment(outputs=[Output("w", statistics=[name])])
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
    @experiment(outputs=[Output("w", statistics=["q99.9"])])
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


def test_what_cannot_be_is_said(coins, tmp_path):
    for sampling, message in (
        ({"precision": 0.0}, "sampling.precision: input should be greater than 0"),
        ({"max_n_sim": 50}, "max_n_sim = 50: must be at least n_sim = 100"),
    ):
        with pytest.raises(SweepError, match=message):
            run(tmp_path / "s.zarr", **sampling)
