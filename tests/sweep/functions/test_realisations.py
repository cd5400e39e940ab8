"""Realisations of plain functions: kept where a study asks for it, of the same random numbers where declared shared."""

import numpy as np
import pytest
import xarray as xr

import linksweep
from linksweep import Output, SweepError, experiment
from tests.sweep.opening import live_study, make_grid, run, same
from tests.tiers import few

KEPT = {"n_sim": 1200, "seed": 3, "keep_samples": True}  # three blocks
OUTPUTS = [Output("wait", "s", statistics=["mean", "std", "q90", "max"]), Output("pair", dims="k")]
A = [1.0, 2.0, 4.0, 7.0]
LAID_OUT = {
    "conditional": ("a", {"axes": {"kind": ["x", "y"], "a": A}, "when": {"a": {"kind": ["x"]}}}),
    "texts": ("kind", {"axes": {"a": A[:2], "kind": ["x", "xy", "xyz", ""]}}),
    "zipped": ("b", {"axes": {"a": A, "b": range(4)}, "grid": {"zip": [["a", "b"]]}}),
    "numbers": ("a", {"axes": {"a": A}}),
    "a table": ("a", {"points": {"a": A, "kind": ["x", "xy", "x", "xy"]}}),
}


@experiment(outputs=OUTPUTS, shared="gain")
def queue(rng, gain: float = 1.0, rate: float = 2.0):
    return {"pair": gain + rng.normal(size=2), "wait": gain * rng.exponential(rate), "late": rng.random() > 0.5}


@experiment(shared=("gain",))
def many(rng, n_sim, gain: float = 1.0, rate: float = 2.0):
    return {"wait": gain * rng.exponential(rate, n_sim)}


def sweep(function, store, sampling=KEPT, **axes):
    return linksweep.run(function, store, axes=axes, sampling=sampling, pool="serial")


@pytest.mark.slow
def test_realisations_are_those_behind_the_statistics_and_may_be_large(tmp_path):
    axes = {"gain": [1.0, 2.0], "rate": [0.5, 2.0, 3.0]}
    ds = sweep(queue, tmp_path / "s", **axes)
    assert ds.pair_samples.dims == ("gain", "rate", "sample", "k")
    assert (ds.wait_samples.attrs["units"], ds.sizes["sample"]) == ("s", 1200)
    for name in ("wait", "pair", "late"):
        kept = ds[f"{name}_samples"].transpose("sample", ...).values
        assert len(np.unique(kept[:, 0, 0])) == (2 if name == "late" else kept[:, 0, 0].size)
        np.testing.assert_allclose(kept.mean(axis=0), ds[f"{name}_mean"], rtol=1e-12)
        np.testing.assert_allclose(kept.std(axis=0, ddof=1), ds[f"{name}_std"], rtol=1e-12)
    np.testing.assert_array_equal(ds.wait_samples.max("sample"), ds.wait_max)
    np.testing.assert_array_equal(ds.wait_q90, np.quantile(ds.wait_samples, 0.9, axis=2, method="hazen"))
    same(linksweep.run(queue, tmp_path / "s", axes=axes, sampling=KEPT, pool="serial", redo="rate == 0.5"), ds)
    assert "wait_samples" not in sweep(queue, tmp_path / "none", {"n_sim": 60}, gain=[1.0])
    with pytest.raises(SweepError, match="keep_samples"):
        sweep(queue, tmp_path / "s", {"n_sim": 1200, "seed": 3}, gain=[1.0])
    images = experiment(outputs=[Output("n", statistics="mean")])(lambda rng: {"n": rng.poisson(1.0, (800, 800))})
    ds = sweep(images, tmp_path / "large", KEPT | {"n_sim": 3})
    np.testing.assert_allclose(ds.n_samples.mean("sample"), ds.n_mean, rtol=1e-12)


def test_differences_along_a_shared_axis_have_small_errors(tmp_path):
    sampling = {"n_sim": 512 * 40, "seed": 1, "keep_samples": True}
    ds = sweep(many, tmp_path / "s", sampling, gain=[1.0, 1.01], rate=[2.0, 3.0])
    assert ds.attrs["common_random_numbers"] == 1
    kept = ds.wait_samples
    assert len(np.unique(kept.sel(gain=1.0))) == 2 * kept.sizes["sample"]  # other rates have other numbers
    covariance = ds.wait_mean_mc_covariance_gain
    for rate in (2.0, 3.0):
        wanted = np.cov(kept.sel(rate=rate)) / kept.sizes["sample"]
        np.testing.assert_allclose(covariance.sel(rate=rate), wanted, rtol=0.7)  # of 40 blocks: 22 %
    ratio = linksweep.ratio(ds, "wait_mean", "gain", 1.01, 1.0)
    np.testing.assert_allclose(ratio["ratio"], 1.01, rtol=1e-12)
    assert float(ratio["ratio_error"].max()) < 1e-9
    alone = sweep(many, tmp_path / "t", {**sampling, "common_random_numbers": False}, gain=[1.0, 1.01], rate=[2.0])
    assert not np.array_equal(alone.wait_samples[1], 1.01 * alone.wait_samples[0])
    assert "wait_mean_mc_covariance_gain" not in alone
    rows = {"gain": [1.0, 1.01, 1.0], "rate": [2.0, 2.0, 3.0], "who": list("abc")}
    table = linksweep.run(many, tmp_path / "u", points=rows, labels="who", sampling={"n_sim": 60}, pool="serial")
    for one, along in ((table, [0, 1, 2]), (table.swap_dims(point="who"), rows["who"])):
        errors = [linksweep.ratio(one, "wait_mean", *one.sizes, along[0], k)["ratio_error"].item() for k in along[1:]]
        assert np.isnan(errors).tolist() == [True, False]  # labels do not matter, and other rates have other numbers


@experiment(shared=("a", "b", "kind"))
def turns(rng, n_sim, a: float = 1.0, b: int = 0, kind: str = "x"):
    common, ours = rng.normal(size=(2, n_sim))
    return {"y": 10.0 + a + np.cos(a + b) * common + np.sin(a + len(kind)) * ours}


@pytest.mark.parametrize("layout", few(2, LAID_OUT))
def test_points_that_are_cut_or_sorted_have_the_errors_that_they_had(tmp_path, layout):
    axis, study = LAID_OUT[layout]
    linksweep.run({"experiment": turns, "sampling": {"n_sim": 512 * 6}, **study}, tmp_path / "s", pool="serial")
    whole = xr.open_zarr(tmp_path / "s").load()
    values = whole[axis].values.tolist()
    place = [values.index(value) for value in dict.fromkeys(study["axes" if "axes" in study else "points"][axis])]

    def error(dataset):
        result = linksweep.ratio(dataset, "y_mean", axis, values[place[3]], values[place[1]])["ratio_error"].values
        assert np.nanmin(result) > 0.0
        return result

    dimension, wanted = whole[axis].dims[0], error(whole)
    for order in ([3, 1], [1, 3], [3, 2, 1, 0], [2, 1, 0, 3]):
        np.testing.assert_array_equal(error(whole.isel({dimension: [place[k] for k in order]})), wanted)
    bare = whole.drop_vars([str(name) for name in whole.coords if str(name).endswith("_other")])
    with pytest.raises(SweepError, match=f"cut or sort {dimension} and {dimension}_other alike"):
        error(bare.isel({dimension: place[::-1]}))


def test_the_covariance_of_a_mean_is_that_of_its_blocks_and_that_of_a_sum_is_of_the_sum(tmp_path):
    drawn = []

    def walk(points, n_sim, rng, catalogue_rng):
        drawn.append(rng.normal(1.0, 1.0, n_sim).sum())
        return {"total": [p["step"] * drawn[-1] for p in points]}

    outputs = [Output(f"{name}{end}") for name in ("mean", "sum", "each", "product") for end in ("", "_mc_error")]

    def summarise(sums, n, n_cat):
        total = sums["total"]
        values = {"mean": total / n, "sum": total, "each": total / n_cat, "product": total**2}
        return values | {f"{name}_mc_error": np.ones_like(n) for name in values}

    declared = "walks", 1, (linksweep.Parameter("step", "float", 1.0, "step"),), {"total": ()}, tuple(outputs)
    walks = linksweep.Experiment(*declared, walk, summarise, shared=("step",))
    study = {"experiment": walks, "axes": {"step": [1.0, 2.0]}, "sampling": {"common_random_numbers": True}}
    for n_sim, n_cat, of_one, whole in ((512 * 6 + 200, 1, 512, 6), (100, 7, 100, 7)):
        drawn.clear()
        study["sampling"] |= {"n_sim": n_sim, "n_cat": n_cat}
        n, ds = n_sim * n_cat, linksweep.run(study, tmp_path / f"{n_cat}", pool="serial")
        wanted = np.var(drawn[:whole], ddof=1) / (n * of_one) * np.outer([1.0, 2.0], [1.0, 2.0])
        for name, factor in (("mean", 1), ("sum", n), ("each", n / n_cat)):
            np.testing.assert_allclose(ds[f"{name}_mc_covariance_step"], factor**2 * wanted, rtol=1e-9)
        squared = ds.sum_mc_covariance_step * 4.0 * np.outer(ds["sum"], ds["sum"])  # to first order
        np.testing.assert_allclose(ds.product_mc_covariance_step, squared, rtol=0.1)


@pytest.mark.parametrize(("name", "n_cat", "n"), [("f_mean", 1, 512 * 6), ("sigma_spin", 7, 512)])
def test_a_point_with_more_realisations_has_the_variance_that_these_give_it(tmp_path, name, n_cat, n):
    code = "def f(rng, error_scale=1.0):\n    return error_scale * rng.normal(1.0)\n"
    (tmp_path / "f.py").write_text(f"import linksweep\n@linksweep.experiment(shared='error_scale')\n{code}")
    study = {"experiment": f"{tmp_path}/f.py:f"} if n_cat == 1 else {"fixed": {"catalogue": "quasars", "v_max": 15.0}}
    sampling = {"n_cat": n_cat, "common_random_numbers": True}
    study |= {"title": name, "axes": {"error_scale": [1.0, 2.0]}, "sampling": sampling | {"n_sim": n}}
    counts = {make_grid(live_study(study)).point(1).digest.hex(): 2 * n}
    runs = {"one": {"counts": counts}, "whole": {"sampling": sampling | {"n_sim": 2 * n}}}
    both = (run(study | more, tmp_path / store) for store, more in runs.items())
    one, whole = (ds[f"{name}_mc_covariance_error_scale"].values for ds in both)
    assert one[1, 1] == whole[1, 1]
    np.testing.assert_allclose(one[0, 1], one[0, 0] * (1.0 if n_cat == 1 else 2.0), rtol=0.3)  # half the draws, or all


@pytest.mark.parametrize("kind", [int, float, bool])
def test_only_truth_values_are_counted(tmp_path, kind):
    counted = experiment(outputs=Output("hit", statistics="count"))(lambda rng, chance: kind(rng.random() < chance))
    ds = sweep(counted, tmp_path / "s", {"n_sim": 60}, chance=[0.3])
    assert (ds.status.item() == 1) == (kind is bool)
    assert kind is bool or f"'hit' is of type {kind.__name__}; the statistic 'count'" in ds.attrs["failures"]


def test_what_is_shared_is_part_of_what_the_numbers_mean(tmp_path):
    def declared(*shared):
        return experiment(shared=shared)(lambda rng, gain=1.0, rate=2.0: gain * rng.exponential(rate))

    sweep(declared("gain"), tmp_path / "s", {"n_sim": 60}, gain=[1.0, 2.0])
    for shared in (["gain", "rate"], ["rate"], []):
        with pytest.raises(SweepError, match=r"common_random_numbers: .'gain'. in the store"):
            sweep(declared(*shared), tmp_path / "s", {"n_sim": 60}, gain=[3.0])


def test_samples_are_the_realisations_behind_the_results(tmp_path):
    study = {"title": "Samples", "axes": {"n_obj": [20, 30]}, "fixed": {"catalogue": "quasars", "v_max": 15.0}}
    study["sampling"] = {"n_sim": 520, "n_cat": 20, "seed": 5, "keep_samples": True}  # two parts, two groups
    kept = linksweep.run(study, tmp_path / "s.zarr", pool="serial")
    assert dict(kept["estimate"].sizes) == {"n_obj": 2, "sample": 10_400, "component": 6}
    error = kept["estimate"] - 1.0  # the truth is 1 in every component
    xr.testing.assert_allclose(np.sqrt((error**2).mean("sample")), kept["sigma"], rtol=1e-9)
    xr.testing.assert_allclose(error.mean("sample"), kept["bias"], rtol=1e-6)
    assert len(np.unique(error.isel(n_obj=0, component=0))) == 10_400
