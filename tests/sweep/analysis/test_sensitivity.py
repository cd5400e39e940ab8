"""Sobol indices beside closed forms and independent quadrature, within the errors that they state."""

import json

import numpy as np
import pytest
import xarray as xr

import linksweep
from linksweep import SweepError, experiment, sensitivity
from linksweep.sweep.analysis.sensitivity import first_order, indices_of_grid, morris_effects, saltelli_indices
from linksweep.sweep.studies.points import DESIGNS
from tests.tiers import few, slow

PI = np.pi
A, B = 7.0, 0.1
VARIANCE = 0.5 + A**2 / 8 + B * PI**4 / 5 + B**2 * PI**8 / 18
ALONE = np.array([0.5 * (1 + B * PI**4 / 5) ** 2, A**2 / 8, 0.0]) / VARIANCE
TOTAL = ALONE + np.array([1.0, 0.0, 1.0]) * B**2 * PI**8 * (1 / 18 - 1 / 50) / VARIANCE
"""Indices of the Ishigami function: Saltelli, Chan & Scott 2000, Sensitivity Analysis, eq. 2.46 ff."""

BOX = {name: [-PI, PI] for name in ("x1", "x2", "x3")}
# Ranges of Morris, Mitchell & Ylvisaker 1993, Technometrics 35, 243, all uniform
BOREHOLE = {"rw": [0.05, 0.15], "r": [100.0, 50_000.0], "tu": [63_070.0, 115_600.0], "hu": [990.0, 1110.0]}
BOREHOLE |= {"tl": [63.1, 116.0], "hl": [700.0, 820.0], "length": [1120.0, 1680.0], "kw": [9855.0, 12_045.0]}
A_TIMES_B = np.arange(10.0)[:, None] + np.arange(10.0) + 0.2 * np.outer(np.arange(10.0), np.arange(10.0))
WITHOUT_NOISE = indices_of_grid(A_TIMES_B, 0.0, [False, False])[::2]


def ishigami(x1: float, x2: float, x3: float):
    return np.sin(x1) + A * np.sin(x2) ** 2 + B * x3**4 * np.sin(x1)


def flow(rw: float, r: float, tu: float, hu: float, tl: float, hl: float, length: float, kw: float):
    ratio = np.log(r / rw)
    return 2 * PI * tu * (hu - hl) / (ratio * (1 + 2 * length * tu / (ratio * rw**2 * kw) + tu / tl))


def by_quadrature(function, ranges, nodes):
    x, w = np.polynomial.legendre.leggauss(nodes)
    axes = [low + (high - low) * 0.5 * (x + 1.0) for low, high in ranges]
    values, every = function(*np.meshgrid(*axes, indexing="ij", sparse=True)), set(range(len(axes)))

    def mean(array, over):
        for k in over:
            array = np.average(array, axis=k, weights=w, keepdims=True)
        return array

    def variance(kept):
        return mean((mean(values, every - kept) - mean(values, every)) ** 2, kept).item()

    first = np.array([variance({k}) for k in every]) / variance(every)
    return first, 1.0 - np.array([variance(every - {k}) for k in every]) / variance(every)


OF_BOREHOLE = by_quadrature(flow, BOREHOLE.values(), 4)


def run(function, store, **options):
    vectorised = experiment(vectorised=True)(function) if function in (ishigami, flow) else function
    return linksweep.run(vectorised, store=store, pool="serial", **options)


def agrees(result, name, truth, most=4.0):
    return bool(np.all(np.abs(result[name].values - truth) < most * result[f"{name}_error"].values))


@pytest.mark.parametrize("n", [12, slow(15)])
def test_a_grid_of_the_ishigami_function(n, tmp_path):
    middle = (np.arange(n) + 0.5) / n * 2 * PI - PI
    ds = run(ishigami, tmp_path / "s.zarr", axes=dict.fromkeys(BOX, middle))
    result = sensitivity(ds)
    assert result.parameter.values.tolist() == list(BOX)
    for name, truth in (("first", ALONE[:2]), ("total", TOTAL)):
        part = result.isel(parameter=slice(len(truth)))
        assert agrees(part, name, truth, most=2.0)
        assert float(part[f"{name}_error"].max()) < 0.5 / n
    assert abs(result["first"].values[2]) < 1e-12
    assert result.equals(sensitivity(ds.assign(ishigami=2.0**600 * ds["ishigami"])))
    assert "with fewer than 8 values" in sensitivity(ds.isel({name: slice(0, 6) for name in BOX})).attrs["notes"]


@pytest.mark.parametrize("design", few(0, ["saltelli", "sobol", "halton", "latin-hypercube", "random"]))
def test_indices_of_designs_of_both_functions(design, tmp_path):
    points, has_total = {"design": design, "n": 256 if design == "saltelli" else 512, "seed": 4}, design == "saltelli"
    for function, ranges, truths in ((ishigami, BOX, (ALONE, TOTAL)), (flow, BOREHOLE, OF_BOREHOLE)):
        store = tmp_path / f"{function.__name__}.zarr"
        result = sensitivity(run(function, store, points=points | {"ranges": ranges}))
        assert agrees(result, "first", truths[0])
        assert not has_total or agrees(result, "total", truths[1])
        assert ("total" in result) == has_total
        notes = result.attrs["notes"]
        assert ("total indices need a full grid or a saltelli design" in notes) != has_total
        assert "Monte-Carlo" not in notes  # the functions draw no random numbers
        (name, y), *_ = (again := linksweep.open(store)).items()  # the same errors every time, in any unit
        assert all(result.equals(sensitivity(again.assign({name: 2.0**power * y}), name)) for power in (0, -600, 600))
        low, high = linksweep.plot(result).axes[0].get_xlim()
        assert low < float((result["first"] - result.first_error).min()) < float(result["first"].max()) < high
    assert result.parameter.values[np.argmax(result["first"].values)] == "rw"
    assert float(result.first_error.max()) < 0.12


def test_morris_effects_of_a_linear_function_are_its_slopes(tmp_path):
    def plane(a: float, b: float, c: float, k: int, n: float):
        return {"z": 3.0 * a - 2.0 * b + 0.0 * c + 10.0 * k - n, "product": a * b * c}

    ranges = {"a": [0, 1], "b": [0, 10], "c": [1, 2], "k": [0, 5], "n": {"values": [9, 1, 2, 4, 8]}}
    ds = run(plane, tmp_path / "s.zarr", points={"design": "morris", "n": 6, "ranges": ranges})
    far = sensitivity(ds.assign(product=2.0**600 * ds["product"]), "product")
    assert far.equals(2.0**600 * sensitivity(ds, "product"))
    result = sensitivity(ds, "z")
    effects = np.array([[3.0, 20.0, 0.0, 50.0, 8.0], [3.0, -20.0, 0.0, 50.0, -8.0], [0.0] * 5])
    assert result[["mu_star", "mu", "sigma"]].to_array().values == pytest.approx(effects, abs=1e-9)


@pytest.mark.slow
def test_crossed_axes_and_dimensions_of_an_output_have_indices_each(tmp_path):
    t = np.linspace(0.0, 1.0, 3)

    def course(a: float, b: float, scale: float = 1.0):
        return xr.DataArray(scale * (a * (1.0 - t) + b * t), {"time": t}, name="y")

    points = {"design": "sobol", "n": 128, "ranges": {"a": [0, 1], "b": [0, 1]}}
    result = sensitivity(run(course, tmp_path / "s.zarr", points=points, axes={"scale": [1.0, 2.0]}))
    assert result["first"].dims == ("scale", "time", "parameter")
    assert np.allclose(result["first"].values, [[1, 0], [0.5, 0.5], [0, 1]], atol=0.04)


@pytest.mark.parametrize(("name", "shared"), few(2, [("y_mean", ["z"]), ("y_std", []), ("y_mean", ["x"])]))
def test_unknown_errors_of_points_are_unknown_errors_of_indices(name, shared, tmp_path):
    @experiment(outputs=[linksweep.Output("y", statistics=["mean", "std", "max"])], shared=shared)
    def noisy(rng, x: float, z: float):
        return {"y": x + z + rng.normal()}

    axes = dict.fromkeys("xz", np.linspace(0.05, 0.95, 10))
    result = sensitivity(run(noisy, tmp_path / "s", axes=axes, sampling={"n_sim": 20}), name)
    assert np.isnan(result[["first_error", "total_error"]].to_array()).all()
    assert "noise counts as variation" in result.attrs["notes"]
    assert (result.total >= result["first"] - 1e-12).all()


def test_what_has_no_indices_says_why(tmp_path):
    def f(a: float, b: float = 1.0):
        if a > 0.9:
            raise ValueError("no")
        return {"y": a * b, "text": "t", "flat": 7.3}

    points = {"design": "sobol", "n": 32, "ranges": {"a": [0, 1], "b": [0, 1]}}
    with pytest.raises(SweepError, match="incomplete"):
        sensitivity(run(f, tmp_path / "s.zarr", points=points))
    points["ranges"]["a"] = [0, 0.5]
    good = run(f, tmp_path / "g.zarr", points=points)
    flat = sensitivity(good, "flat")
    assert ("flat does not vary" in flat.attrs["notes"], np.isnan(flat["first"]).all()) == (True, True)
    with pytest.raises(SweepError, match="flat does not vary: there are no indices to draw"):
        linksweep.plot(flat)
    for noise in np.random.default_rng(0).standard_normal((20, 3, 3)):
        assert np.isnan(indices_of_grid(noise, 1.0, [False, False])).all()
    excluding = {"experiment": f, "axes": {"a": [0.1, 0.2], "b": [1.0, 2.0, 3.0]}, "exclude": [{"a": 0.1, "b": 1.0}]}
    ds = run(excluding, tmp_path / "e.zarr")
    sometimes = points | {"ranges": {"a": {"values": [0.1, 0.2]}, "b": [0, 1]}}
    sometimes = run(f, tmp_path / "w.zarr", points=sometimes, when={"b": {"a": [0.1]}})
    for dataset, name, words in (
        (ds, "y", r"the study excludes points.*--at AXIS=VALUE"),
        (sometimes, "y", "b is missing at points"),
        (good, "text", "text has no numbers to draw or to fit"),
        (good.isel(point=slice(8)), "y", "8 points are too few for indices: at least 18"),
        (run(f, tmp_path / "q.zarr", points=points | {"design": "saltelli"}).isel(point=slice(8)), "y", "all of its"),
    ):
        with pytest.raises(SweepError, match=words):
            sensitivity(dataset, name)
    assert sensitivity(ds.sel(a=[0.1])).attrs["points"] == 2


def test_the_command_prints_writes_and_draws(tmp_path, sweep):
    (tmp_path / "plane.py").write_text("def plane(a: float, b: float):\n    return {'z': a + 2.0 * b}\n")
    run(f"{tmp_path}/plane.py:plane", tmp_path / "s.zarr", axes={"a": [0, 1.0, 2.0, 3.0], "b": [0, 1.0, 2.0, 3.0]})
    assert "by analysis of variance of the grid, from 16 points" in sweep("sensitivity", "s.zarr", cwd=tmp_path)[1]
    zipped = {"experiment": f"{tmp_path}/plane.py:plane", "axes": {"a": [0.0, 1.0, 3.0], "b": [0.0, 1.0, 3.0]}}
    joint = sensitivity(run(zipped | {"grid": {"zip": [["a", "b"]]}}, tmp_path / "z.zarr"))
    assert (joint.parameter.item(), "fewer than" in joint.attrs["notes"]) == ("a+b", False)
    for name in ("s.png", "i.zarr"):
        out = sweep("sensitivity", "s.zarr", "--json", "-o", name, cwd=tmp_path, code=0)[1]
        assert (tmp_path / name).exists()
    assert [row["first"] for row in json.loads(out)["rows"]] == pytest.approx([0.2, 0.8])
    assert xr.open_zarr(tmp_path / "i.zarr", consolidated=False).total.values == pytest.approx([0.2, 0.8])


def random_points(seed, n=128):
    unit = np.random.default_rng(seed).random((n, 3))
    return first_order(ishigami(*(2 * PI * unit.T - PI)), list(unit.T))


def saltelli(seed):
    unit = np.asarray(DESIGNS["saltelli"].draw(256, 3, np.random.default_rng(seed)))
    return saltelli_indices(ishigami(*(2 * PI * unit.T - PI)), 3, seed)


def noisy_grid(seed):
    noise = 5.0 * np.random.default_rng(seed).standard_normal(A_TIMES_B.shape)
    return indices_of_grid(A_TIMES_B + noise, np.full(noise.shape, 5.0), [False, False], seed)


def morris(seed):
    pytest.importorskip("SALib")
    unit = np.asarray(DESIGNS["morris"].draw(6, 3, np.random.default_rng(seed)))
    a, b, c = unit.T
    return morris_effects(2.0 * a + b**3 + 3.0 * a * c, unit)[:2]


def two_values(seed):
    rng = np.random.default_rng(seed)
    return first_order(rng.standard_normal(60) + 0.25 * (one := rng.choice([-1.0, 1.0], 60)), [0.5 + 0.25 * one])


COVERED = [(two_values, 200, (np.array([1 / 17]),), 0.92, 0.5)]
COVERED += [(morris, 200, (np.array([3.5, 17 / 18, 1.5]),), 0.88, 0.6)]  # SALib's intervals of 95 % would be 0.4
COVERED += [slow(saltelli, 60, (ALONE, TOTAL), 0.88, 0.0), slow(noisy_grid, 150, WITHOUT_NOISE, 0.88, 0.0)]
COVERED += [slow(random_points, 200, (ALONE,), 0.9, 0.3)]
COVERED += [slow(lambda seed: random_points(seed, 512), 200, (ALONE,), 0.9, 0.3)]


@pytest.mark.parametrize(("estimate", "copies", "truths", "least", "scatter"), COVERED)
def test_errors_cover_the_truth_and_are_not_merely_large(estimate, copies, truths, least, scatter):
    result = np.moveaxis(np.array([estimate(seed) for seed in range(copies)]), 1, 0)
    for estimates, errors, truth in zip(result[::2], result[1::2], truths, strict=True):
        for value, error, true in zip(estimates.T, errors.T, truth, strict=True):
            assert np.mean(np.abs(value - true) < 2.0 * error) > least
            assert np.std(value) > scatter * np.mean(error)
            if len(truths) == 2:
                assert np.mean(value) == pytest.approx(true, abs=0.02)  # noise is no bias
