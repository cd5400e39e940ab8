"""Realisations until a point is as precise as the study asks, the same number in every run."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import linksweep
from linksweep import Output, experiment
from linksweep.sweep.analysis.quantity import standard_error
from tests.sweep.opening import OpenStore, Progress, Stopping, files_of, same, status_report
from tests.tiers import few, slow

PRECISE, MANY, WIDE = {"n_sim": 64, "precision": 0.05}, {"n_sim": 700}, ("q95", "std", "median")
COARSE = {"n_sim": 500, "precision": 0.2}
OTHERS = few(1, [(MANY, PRECISE), *((PRECISE, one) for one in (COARSE, {"n_sim": 100}, MANY))])


@experiment(outputs=[Output("level", statistics=["mean"])])
def levels(scatter: float, *, rng, n_sim):
    return {"level": rng.normal(10.0, scatter, n_sim)}


def run(store, progress=None, **sampling):
    how = {"axes": {"scatter": [0.01, 1.0, 10.0]}, "pool": "serial", "progress": progress}
    return linksweep.run(levels, store, sampling={"n_sim": 100, "seed": 3, "precision": 0.01} | sampling, **how)


def test_every_point_gets_what_it_needs_and_stopped_anywhere_it_goes_on_to_the_same_numbers(tmp_path, sweep_here):
    dataset = run(tmp_path / "s.zarr")
    assert np.all(dataset["level_mean_mc_error"] <= 0.01 * dataset["level_mean"])
    needed, done = (np.array([0.01, 1.0, 10.0]) / 10.0 / 0.01) ** 2, dataset["n_sim_done"].values  # the law of the mean
    assert done.tolist()[:2] == [256, 256]  # the least is 100, in parts of 64, 64, 128, 256, 512, ..., and one more
    assert needed[2] / 1.1 <= done[2] <= 1.25 * 1.2 * needed[2] + 512
    assert (dataset.attrs["precision"], dataset.attrs["warnings"]) == (0.01, "[]")
    bounded = run(tmp_path / "most.zarr", max_n_sim=3000)
    assert (bounded["n_sim_done"].values.tolist()[2], bounded.attrs["complete"]) == (3072, 1)
    assert (bounded["level_mean_mc_error"] > 0.01 * bounded["level_mean"]).sum() == 1
    before = files_of(tmp_path / "most.zarr")
    run(tmp_path / "most.zarr", max_n_sim=500)  # which is there already
    assert files_of(tmp_path / "most.zarr") == before
    for words in ("show", "status"):
        assert "warning: 1 of 3 points did not reach precision = 0.01" in sweep_here(words, tmp_path / "most.zarr")[1]
    run(tmp_path / "t.zarr", precision=0.05)
    for error in (KeyboardInterrupt, RuntimeError):
        before = len(OpenStore(tmp_path / "t.zarr").ledger().rows)
        with pytest.raises(error):
            run(tmp_path / "t.zarr", Stopping(2, error))
        assert len(OpenStore(tmp_path / "t.zarr").ledger().rows) > before
    same(run(tmp_path / "t.zarr"), dataset)
    assert run(tmp_path / "t.zarr", precision=0.05)["n_sim_done"].equals(dataset["n_sim_done"])
    assert linksweep.open(tmp_path / "t.zarr").attrs["precision"] == 0.01


@pytest.mark.parametrize(("first", "then"), OTHERS)
def test_a_run_with_other_sampling_takes_nothing_from_the_points_of_a_store(tmp_path, first, then):
    def run(sampling, scatter, store="s.zarr"):
        return linksweep.run(levels, tmp_path / store, axes={"scatter": scatter}, sampling=sampling, pool="serial")

    fresh = {name: run(one, [1.0, 10.0, 12.0], name) for name, one in (("first", first), ("then", then))}
    run(first, [1.0, 10.0])
    part = run(then, [10.0, 12.0])
    whole = linksweep.open(tmp_path / "s.zarr")
    for name, ds, scatter in (("first", whole, [1.0, 10.0]), ("then", part, [10.0, 12.0])):
        assert np.all(ds.n_sim_done.sel(scatter=scatter) >= fresh[name].n_sim_done.sel(scatter=scatter))
    if "precision" in first:
        assert np.all(whole.level_mean_mc_error <= 0.05 * whole.level_mean)
    assert status_report(tmp_path / "s.zarr")["realisations_done"] == whole.n_sim_done.sum()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "precision"), [(n, 0.05) for n in ("mean", "q95")] + [(n, 0.15) for n in WIDE])
def test_errors_at_the_stop_hold_the_truth_as_often_as_others(tmp_path, name, precision):
    law, truth = "lognormal" if name == "median" else "exponential", -np.log(0.05) if name == "q95" else 1.0

    w = Output("w", statistics=[name])
    waits = experiment(outputs=[w])(lambda rng, n_sim, copy=0: {"w": getattr(rng, law)(size=n_sim)})
    sampling = {"n_sim": 100, "precision": precision, "seed": 6}
    dataset = linksweep.run(waits, tmp_path / "s", axes={"copy": range(2000)}, sampling=sampling, pool="serial")
    value, error = dataset[f"w_{name}"].values, dataset[f"w_{name}_mc_error"].values
    assert np.all(error <= precision * value)
    inside = np.abs(value - truth) <= 2.0 * error
    assert 0.935 <= inside.mean() <= 0.965 + 0.005
    assert np.sqrt(np.mean(((value - truth) / error) ** 2)) < 1.1


def test_a_link_of_positions_alone_is_as_precise_as_its_orientation(tmp_path):
    fixed = {"n_obj": 20, "satellite_errors": "normal", "satellite_sigma_pm": 0.0, "method": "projected"}
    study = {"fixed": fixed, "axes": {"error_scale": [1.0]}, "title": "p"}
    dataset = linksweep.run(study | {"sampling": {"n_sim": 64, "precision": 0.05}}, tmp_path / "s", pool="serial")
    assert dataset["sigma_orientation_mc_error"].item() < 0.05 * dataset["sigma_orientation"].item()
    assert dataset["n_sim_done"].item() < 512  # 1/(6 0.05^2) = 67, or up to three times as many
    timing = linksweep.load_study("pulsar-timing", ["n_sim=64", "precision=0.1"], ["clip=none", "weights=equal"])
    assert linksweep.run(timing, tmp_path / "t", pool="serial")["n_sim_done"].item() < 512


def test_what_is_alike_has_no_error_and_does_not_hold_up_a_precision_as_an_unknown_error_does(tmp_path):
    def walk(*, rng, n_sim):
        steps = rng.normal(3.0, 1.0, (n_sim, 2))
        return {"path": np.cumsum(np.concatenate([np.zeros((n_sim, 1)), steps], axis=1), axis=1)}

    dataset = linksweep.run(walk, tmp_path / "s", sampling={"n_sim": 100, "precision": 0.1}, pool="serial")
    assert dataset["n_sim_done"].item() == 5120  # 4096, where what is not known counts no more, and a quarter
    error = dataset["path_mean_mc_error"]
    assert (np.isnan(error).values.tolist(), "all are alike" in error.description) == ([True, False, False], True)
    w = Output("w", statistics=["q99.9"])
    waits = experiment(outputs=[w])(lambda rng, n_sim: {"w": rng.exponential(size=n_sim)})
    sampling = {"n_sim": 64, "precision": 0.5}
    whole = linksweep.run(waits, tmp_path / "whole", sampling=sampling, pool="serial")
    cut = linksweep.run(waits, tmp_path / "cut", sampling={**sampling, "max_n_sim": 1000}, pool="serial")
    assert whole["w_q99.9_mc_error"].item() <= 0.5 * whole["w_q99.9"].item()
    assert (whole["n_sim_done"].item() >= 3782, cut["n_sim_done"].item()) == (True, 1024)
    error = cut["w_q99.9_mc_error"]
    assert ("below 3782 realisations" in error.description, np.isnan(error.item())) == (True, True)
    largest = experiment(outputs=[Output("w", statistics="max")])(lambda rng: {"w": rng.exponential()})
    with pytest.raises(linksweep.SweepError, match="precision: no result has an error to judge by"):
        linksweep.run(largest, tmp_path / "largest", sampling=sampling, pool="serial")


class StopAt(Progress):
    def __init__(self, share):
        self.share, self.done = share, 0.0

    def start(self, survey, where, workers):
        self.cost = survey.pending.cost

    def advance(self, works, result, taken):
        self.done += taken.done.cost
        if self.done >= self.share * self.cost:
            raise KeyboardInterrupt


def stopped(study, store, share, **options):
    with pytest.raises(KeyboardInterrupt):  # with no failure allowed each task is one block
        linksweep.run(study, store, progress=StopAt(share), pool="serial", max_failures=0, **options)
    return linksweep.open(store, running=True)


def quasars():
    whole = linksweep.load_study("quasars")
    return replace(whole, axes={**whole.axes, "v_max": (14.0,)})


@pytest.mark.slow
def test_quasars_at_a_tenth(tmp_path, sweep_here):
    built_in, store = quasars(), tmp_path / "q.zarr"
    ds = stopped(built_in, store, 0.1)
    assert ds.attrs["running"] == 2
    assert ((ds.status == 4) & (ds.n_sim_done >= 500) & (ds.n_sim_done < 5000)).all()
    relative = ds.sigma_spin_mc_error / ds.sigma_spin * np.sqrt(6.0 * ds.n_sim_done)
    assert ((relative > 1.0) & (relative < 1.05)).all()  # 1 for components that are alike, in catalogues that are
    assert (ds.sigma_spin_catalogue_error > 0.0).all()
    # who opens the store has no values of points that are not done
    plain = linksweep.open(store)
    is_empty = (plain.sigma_spin.isnull() & (plain.status == 0)).all()
    assert (bool(is_empty), "(" in "".join(map(str, plain.variables))) == (True, False)
    code, shown, _ = sweep_here("show", store)
    said = f"values so far are of {int(ds.n_sim_done.max()):,} of 10,000 realisations"
    assert (code, shown.count("running"), said in shown.replace("\n", " ")) == (0, 3, True)
    assert {row["status"] for row in json.loads(sweep_here("show", store, "--json")[1])["rows"]} == {"running"}
    # no error before its fewest catalogues: one that leaves out their choice would be too small
    few = stopped(built_in, tmp_path / "few.zarr", 0.025)
    assert (few.sigma_spin.notnull() & few.sigma_spin_mc_error.isnull()).all()
    assert "5 catalogues are needed to know it" in sweep_here("show", tmp_path / "few.zarr")[1].replace("\n", " ")
    # verdicts and conclusions wait
    code, compared, _ = sweep_here("compare", store, "--json")
    assert (code, {one["verdict"] for one in json.loads(compared)["comparisons"]}) == (1, {"incomplete"})
    assert "yet" in " ".join(linksweep.answer(ds).sentences)
    # the same command goes on; whole results have nothing of it
    assert linksweep.run(built_in, store, pool="serial").attrs["complete"] == 1
    assert linksweep.open(store, running=True).identical(linksweep.open(store))
    assert not [path.name for path in store.iterdir() if "(" in path.name]


@experiment(outputs=[Output("y", statistics=("mean", "std", "q90")), Output("late", statistics=("mean", "std"))])
def moments(x: float, rng: np.random.Generator, n_sim: int):
    return {"y": rng.normal(x, 2.0, n_sim), "late": rng.exponential(size=n_sim)}


@pytest.mark.parametrize("sampling", [slow({"n_sim": 5120}), {"n_sim": 64, "precision": 0.05}], ids=str)
def test_values_so_far_are_those_of_the_first_realisations(tmp_path, sampling):
    study = {"axes": {"x": [1.0, 2.0, 3.0]}, "sampling": {"seed": 3, **sampling}}
    ds = stopped(moments, tmp_path / "s.zarr", 2.0 if "precision" in sampling else 0.4, **study)
    assert ds.attrs["running"] > 0
    for x, n in ((x, int(ds.n_sim_done.sel(x=x))) for x in ds.x.values[ds.status == 4]):
        fewer = {"n_sim": n, "seed": 3} | ({"precision": 0.999, "max_n_sim": n} if "precision" in sampling else {})
        alone = linksweep.run(moments, tmp_path / f"{x}", axes={"x": [float(x)]}, sampling=fewer, pool="serial")
        for name in alone.data_vars.keys() - {"status", "n_sim_done", "wall_time"}:
            np.testing.assert_array_equal(ds[name].sel(x=x), alone[name].sel(x=x), name)


@pytest.mark.parametrize(("copies", "blocks", "share"), [(100, 4, 0.3), slow(1500, 16, 0.1), slow(1500, 8, 0.5)])
def test_errors_of_values_so_far_of_a_function_cover(tmp_path, copies, blocks, share):
    x = np.arange(1.0, copies + 1.0)
    ds = stopped(moments, tmp_path / "s.zarr", share, axes={"x": x}, sampling={"n_sim": blocks * 512, "seed": 5})
    assert ds.attrs["running"] == copies
    truths = {"y_mean": x, "y_std": 2.0, "y_q90": stats.norm(x, 2.0).ppf(0.9), "late_mean": 1.0, "late_std": 1.0}
    for name, truth in truths.items():
        error = ds[f"{name}_mc_error"].values
        assert np.isfinite(error).all()
        actual = np.mean(np.abs(ds[name].values - truth) <= 2.0 * error)
        assert abs(actual - 0.95) < 0.015 + 4.0 * np.sqrt(0.05 * 0.95 / copies), (name, actual)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.1, 0.4])
def test_errors_of_values_so_far_of_the_link_cover(tmp_path, share):
    """Over seeds, with the choice of catalogues: sigma of 28 quasars differs by 7 % from one to the next."""
    small = replace(quasars(), axes={"model": ("amex",)}, fixed={**quasars().fixed, "v_max": 14.0})
    many = replace(small, sampling=small.sampling.model_copy(update={"n_cat": 20_000, "n_sim": 5, "seed": 1}))
    truth = linksweep.run(many, tmp_path / "many.zarr").sigma_spin_rms_predicted.item()
    pulls = []
    for seed in range(100):
        sampling = small.sampling.model_copy(update={"seed": seed})
        ds = stopped(replace(small, sampling=sampling), tmp_path / f"{seed}.zarr", share)
        pulls.append(((ds.sigma_spin - truth) / standard_error(ds, "sigma_spin")).item())
    assert abs(np.mean(np.abs(pulls) <= 2.0) - 0.95) < 4.0 * np.sqrt(0.05 * 0.95 / 100)
    assert 0.75 < np.sqrt(np.mean(np.square(pulls))) < 1.25


@pytest.mark.parametrize("shape", [(64,), (100,), (2, 50), (7, 5, 3)])
def test_half_a_run_covers_all_axes(tmp_path, shape):
    axes = {name: range(length) for name, length in zip("abc", shape, strict=False)}
    ds = stopped(lambda a, b=0, c=0: float(a + b + c), tmp_path / "s.zarr", 0.5, axes=axes)
    done = np.argwhere((ds.status == 1).transpose(*axes).values)
    assert len(done) < 0.6 * np.prod(shape)
    for length, places in zip(shape, done.T, strict=True):
        gaps = np.diff([-1, *np.unique(places), length])
        assert gaps.max() <= 3, gaps
    ds = stopped(lambda a: a, tmp_path / "d.zarr", 0.5, points={"design": "sobol", "n": 64, "ranges": {"a": [0, 1]}})
    assert not np.diff((ds.status == 1).astype(int)).max() > 0


@pytest.mark.slow
def test_memory_bounds_how_many_points_keep_their_realisations(tmp_path, monkeypatch):
    study = {"axes": {"x": np.arange(1.0, 9.0)}, "sampling": {"n_sim": 2048, "seed": 3}}
    whole = linksweep.run(moments, tmp_path / "a.zarr", pool="serial", **study)
    monkeypatch.setattr("linksweep.sweep.planning.accumulator.MOST_KEPT", 8 * 2048 * 2)
    assert stopped(moments, tmp_path / "s.zarr", 0.4, **study).attrs["running"] <= 2
    again = linksweep.run(moments, tmp_path / "s.zarr", pool="serial", **study)
    assert again.drop_vars("wall_time").equals(whole.drop_vars("wall_time"))
