"""Points that are begun have values so far, with present errors that cover; final results and conclusions wait."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import linksweep
from linksweep import Output, experiment
from linksweep.sweep.analysis.quantity import standard_error
from tests.sweep.opening import Silent
from tests.tiers import slow


class StopAt(Silent):
    """A progress that ends a run, as Ctrl-C does, once this share of its work is done."""

    def __init__(self, share):
        self.share, self.done = share, 0.0

    def start(self, survey, where, workers):
        self.cost = survey.pending.cost

    def advance(self, works, result, taken):
        self.done += taken.done.cost
        if self.done >= self.share * self.cost:
            raise KeyboardInterrupt


def stopped(study, store, share, **options):
    """What a run of a study leaves that was stopped at this share: the dataset with values so far."""
    with pytest.raises(KeyboardInterrupt):  # with no failure allowed each task is one block
        linksweep.run(study, store, progress=StopAt(share), pool="serial", max_failures=0, **options)
    return linksweep.open(store, running=True)


def quasars():
    """The built-in study, at V = 14 only: seconds."""
    whole = linksweep.load_study("quasars")
    return replace(whole, axes={**whole.axes, "v_max": (14.0,)})


def test_quasars_at_a_tenth(tmp_path, sweep_here):
    built_in, store = quasars(), tmp_path / "q.zarr"
    ds = stopped(built_in, store, 0.1)
    assert ds.attrs["running"] == 2
    assert (ds.status == 4).all()
    assert ((ds.n_sim_done >= 500) & (ds.n_sim_done < 5000)).all()
    relative = ds.sigma_spin_mc_error / ds.sigma_spin
    np.testing.assert_allclose(relative, np.sqrt(1.0 / (6.0 * ds.n_sim_done)), rtol=1e-12)
    assert (ds.sigma_spin_catalogue_error > 0.0).all()
    # who opens the store has no values of points that are not done
    plain = linksweep.open(store)
    assert plain.sigma_spin.isnull().all()
    assert (plain.status == 0).all()
    assert not [name for name in plain.variables if "(" in name]
    code, shown, _ = sweep_here("show", store)
    assert code == 0
    assert shown.count("running") == 3
    assert f"values so far are of {int(ds.n_sim_done.max()):,} of 10,000 realisations" in shown.replace("\n", " ")
    assert {row["status"] for row in json.loads(sweep_here("show", store, "--json")[1])["rows"]} == {"running"}
    # no error before its fewest catalogues: one that leaves out their choice would be too small
    few = stopped(built_in, tmp_path / "few.zarr", 0.025)
    assert few.sigma_spin.notnull().all()
    assert few.sigma_spin_mc_error.isnull().all()
    assert "5 catalogues are needed to know it" in sweep_here("show", tmp_path / "few.zarr")[1].replace("\n", " ")
    # verdicts and conclusions wait
    code, compared, _ = sweep_here("compare", store, "--json")
    assert code == 1
    assert {one["verdict"] for one in json.loads(compared)["comparisons"]} == {"incomplete"}
    assert "yet" in " ".join(linksweep.answer(ds).sentences)
    # the same command goes on; whole results have nothing of it
    whole = linksweep.run(built_in, store, pool="serial")
    assert whole.attrs["complete"] == 1
    assert linksweep.open(store, running=True).identical(linksweep.open(store))
    assert not [path.name for path in store.iterdir() if "(" in path.name]


def moments(x: float, rng: np.random.Generator, n_sim: int):
    return {"y": rng.normal(x, 2.0, n_sim), "late": rng.exponential(size=n_sim)}


STATISTICS = [Output("y", statistics=("mean", "std", "q90")), Output("late", statistics=("mean", "std"))]


@pytest.mark.parametrize("precision", [None, 0.05])
def test_values_so_far_are_those_of_the_first_realisations(tmp_path, precision):
    """A run of just these realisations, bitwise: blocks are the same."""
    f = experiment(outputs=STATISTICS)(moments)
    sampling = {"n_sim": 10 * 512, "seed": 3} | ({} if precision is None else {"n_sim": 64, "precision": precision})
    study = {"axes": {"x": [1.0, 2.0, 3.0]}, "sampling": sampling}
    ds = stopped(f, tmp_path / "s.zarr", 0.4 if precision is None else 2.0, **study)
    assert ds.attrs["running"] > 0
    for x, n, status in zip(ds.x.values, ds.n_sim_done.values, ds.status.values, strict=True):
        if status == 4:
            fewer = {"n_sim": int(n), "seed": 3} | (
                {} if precision is None else {"precision": 0.999, "max_n_sim": int(n)}
            )
            alone = linksweep.run(f, tmp_path / f"{x}.zarr", axes={"x": [float(x)]}, sampling=fewer, pool="serial")
            for name in alone.data_vars.keys() - {"status", "n_sim_done", "wall_time"}:
                np.testing.assert_array_equal(ds[name].sel(x=x), alone[name].sel(x=x), name)


def covered(value, error, truth):
    """The share of values within two errors of the truth; all errors must be known."""
    assert np.isfinite(error).all()
    return float((np.abs(value - truth) <= 2.0 * error).mean())


@pytest.mark.parametrize(("copies", "blocks", "share"), [(200, 4, 0.3), slow(1500, 16, 0.1), slow(1500, 8, 0.5)])
def test_errors_of_values_so_far_of_a_function_cover(tmp_path, copies, blocks, share):
    f = experiment(outputs=STATISTICS)(moments)
    x = np.arange(1.0, copies + 1.0)
    ds = stopped(f, tmp_path / "s.zarr", share, axes={"x": x}, sampling={"n_sim": blocks * 512, "seed": 5})
    assert ds.attrs["running"] == copies
    truths = {"y_mean": x, "y_std": 2.0, "y_q90": stats.norm(x, 2.0).ppf(0.9), "late_mean": 1.0, "late_std": 1.0}
    for name, truth in truths.items():
        found = covered(ds[name].values, ds[f"{name}_mc_error"].values, truth)
        assert abs(found - 0.95) < 0.015 + 4.0 * np.sqrt(0.05 * 0.95 / copies), (name, found)


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
    def f(a: int, b: int = 0, c: int = 0):
        return float(a + b + c)

    axes = {name: range(length) for name, length in zip("abc", shape, strict=False)}
    ds = stopped(f, tmp_path / "s.zarr", 0.5, axes=axes)
    done = np.argwhere((ds.status == 1).transpose(*axes).values)
    assert len(done) < 0.6 * np.prod(shape)
    for length, places in zip(shape, done.T, strict=True):
        gaps = np.diff([-1, *np.unique(places), length])
        assert gaps.max() <= 3, gaps


def test_memory_bounds_how_many_points_keep_their_realisations(tmp_path, monkeypatch):
    """Points begin when others are done; the bits are the same."""
    f = experiment(outputs=STATISTICS)(moments)
    study = {"axes": {"x": np.arange(1.0, 9.0)}, "sampling": {"n_sim": 2048, "seed": 3}}
    whole = linksweep.run(f, tmp_path / "a.zarr", pool="serial", **study)
    monkeypatch.setattr("linksweep.sweep.planning.accumulator.MOST_KEPT", 8 * 2048 * 2)
    ds = stopped(f, tmp_path / "s.zarr", 0.4, **study)
    assert ds.attrs["running"] <= 2
    again = linksweep.run(f, tmp_path / "s.zarr", pool="serial", **study)
    assert again.drop_vars("wall_time").equals(whole.drop_vars("wall_time"))
