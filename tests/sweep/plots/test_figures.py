"""Pictures of small real stores: which suits, what stands on their axes, and what is refused."""

import json

import numpy as np
import pytest
import xarray as xr
from scipy import stats

import linksweep
from linksweep.sweep.plots import style
from tests.sweep.plots.drawn import assert_shown
from tests.tiers import slow

LIMIT, NUMBER = r"$V_\mathrm{max}$ [mag]", r"$N_\mathrm{obj}$"
# Of a study: how many panels, and along what
PICTURES = {"quasars": (2, LIMIT), "sqrt-n": (2, NUMBER), "mission-length": (2, "$T$ [yr]"), "grid": (4, NUMBER)}
PICTURES |= {"error-surface": (1, r"reference error scale $\Delta_\mathrm{ref}$"), "aberration": (4, LIMIT)}
PICTURES |= {"algorithm": (6, r"$|\epsilon|$ [mas] = $|\omega|$ [mas/yr]"), "radio-stars": (1, NUMBER)}
PICTURES |= {"galaxies": (1, r"$\sigma(\omega)$ [mas/yr]"), "scatter": (1, r"$\omega_{x}$ [mas/yr]")}
PICTURES |= {"pulsar-timing": (2, "component"), "icrf2-icrf3": (1, "component"), "magnitude-equation": (4, LIMIT)}
MAPS = {"product": lambda x, y: x * y, "plateau": lambda x, y: min(x * y, 8.0)}
MAPS["noise"] = lambda x, y: x + y + 7.0 * np.sin(1e4 * y)
STUDY = """
title = "A wave"
experiment = "wave.py:wave"
[axes]
x = [1.0, 2.0, 3.0]
mode = ["a", "b"]
[figure]
"""
WAVE = "def wave(x: float, mode: str):\n    return {'first': x, 'second': x * len(mode), 'third': -x}\n"
FIGURES = [('variable = "second"\nat = { mode = "b" }\nlog = ["second"]', 0, ["second"])]
FIGURES += [('at = { mood = "a" }', 0, ["first"])]  # what a function returns is not known before it runs
FIGURES += [('kind = "curve"', 1, "no kind 'curve' of a grid; did you mean 'curves'")]


def axes_of(figure):
    return [axes for axes in figure.axes if axes.get_label() != "<colorbar>"]


def texts(legend):
    return [text.get_text() for text in legend.get_texts()]


@pytest.mark.parametrize("name", [name if name == "quasars" else slow(name) for name in PICTURES])
def test_every_study_has_a_picture_without_options(dataset_of, name):
    dataset = dataset_of(name)
    figure = linksweep.plot(dataset)
    assert (len(axes_of(figure)), axes_of(figure)[-1].get_xlabel()) == PICTURES[name]
    assert figure.get_suptitle().startswith(dataset.attrs["title"])
    assert len(figure._repr_png_()) > 10_000  # as a notebook shows it


@pytest.mark.parametrize("n", [5, slow(60)])
def test_every_number_is_in_its_place_whatever_the_order_of_the_points(n):
    rng, size = np.random.default_rng(1), np.array([3.0, 1.0, 2.0])
    x = rng.permutation(np.geomspace(1.0, 90.0, n))
    y, order = size[:, None] / np.sqrt(x) * rng.normal(1.0, 0.01, (3, n)), np.argsort(x)
    parts = {"y_mc_error": 0.03 * y, "y": y, "y_catalogue_error": 0.04 * y}  # together 0.05
    if n == 5:  # of few points there is more
        parts |= {"y_predicted": y + 0.1 * y.min(), "y_published": 0.9 * y, "y_published_rounding": 0.01 * y}
    seen, parts = [*parts.values()][1 : 6 if n == 5 else 2], parts | {"status": np.ones((3, n), int)}
    parts = {name: (("size", "x"), values) for name, values in parts.items()}
    ds = xr.Dataset(parts, {"x": x, "size": size}, {"title": "", "function": "f"})
    [axes] = linksweep.plot(ds, "lines", over="x").axes
    of_map = linksweep.plot(ds, "map", over=["x", "size"])
    np.testing.assert_array_equal(of_map.axes[0].collections[0].get_array(), y[np.argsort(size)][:, order])
    assert ("at most 5 % of the largest; at most 2.0σ from the prediction" in of_map.get_supxlabel()) == (n == 5)
    upper, lower = linksweep.plot(ds, "law", over=["x"]).axes
    law, fine = linksweep.fit_power_law(ds, "y", "x"), np.geomspace(1.0, 90.0, 100)
    for k, one in enumerate(y[:, order]):
        assert_shown(axes, [x[order], 0.05 * one, *(values[k, order] for values in seen)])
        its = {name: array[k].item() for name, array in law.data_vars.items()}
        curve, there = (its["amplitude"] * (at / its["pivot"]) ** its["exponent"] for at in (fine, x[order]))
        tilt = its["exponent_error"] * np.log(fine / its["pivot"])  # at the pivot it is independent of the height
        assert_shown(upper, [one, 0.05 * one, curve])
        band = np.hypot(its["amplitude_error"] / its["amplitude"], tilt)
        assert_shown(lower, [100.0 * (one / there - 1.0), 5.0 * one / there, 100.0 * band])


def test_indices_speeds_and_single_values_have_errors_of_their_own():
    x = np.arange(6.0)
    y = np.add.outer(x, 2.0 * x) + np.random.default_rng(1).normal(0.0, 0.3, (6, 6))
    parts = {"y": y, "y_mc_error": 0.3 + 0.0 * y, "y_predicted": y + 1.0, "z": 1e3 * y, "status": 1 + np.int8(0 * y)}
    parts = {name: (("a", "b"), values) for name, values in parts.items()}
    ds = xr.Dataset(parts, {"a": x, "b": x}, {"title": "", "function": "f"})
    indices, (one, other) = linksweep.sensitivity(ds, "y"), linksweep.plot(ds.isel(a=2, b=3), variables=["y", "z"]).axes
    assert_shown(one, [[y[2, 3]], [0.3], [y[2, 3] + 1.0]])
    assert one.get_xlim()[1] < other.get_xlim()[0]
    names = ("first", "first_error", "total", "total_error")
    assert_shown(linksweep.plot(indices).axes[0], [indices[name].sortby(indices.total) for name in names])
    workers, speed = np.array([1.0, 2.0, 4.0]), np.array([[1.0, 1.9, 3.6], [1.0, 1.7, 3.0]])
    parts = {"speedup": speed, "speedup_error": 0.1 * speed, "efficiency": speed / workers}
    parts = {name: (("kind", "workers"), values) for name, values in parts.items()}
    scaling = xr.Dataset(parts, {"kind": ["strong", "weak"], "workers": workers}, {"result": "scaling"})
    left, right = linksweep.plot(scaling).axes
    assert_shown(left, [*speed, *(0.1 * speed), workers])
    assert_shown(right, [*(speed / workers), np.ones(3)])


def test_lines_say_what_they_are_and_what_is_missing(dataset_of):
    one = dataset_of("quasars").sel(model="amex")
    [axes] = linksweep.plot(one, "lines").axes
    assert texts(axes.figure.legends[0]) == ["simulated", "predicted", "published"]
    status = one["status"].where(one["v_max"] > 14.0, 0)
    assert "INCOMPLETE: 12 of 13 points are done, 1 " in linksweep.plot(one.assign(status=status)).get_suptitle()


@pytest.mark.slow
def test_a_law_is_drawn_with_its_guide(dataset_of):
    upper, lower = axes_of(linksweep.plot(dataset_of("sqrt-n")))
    _, guide = (np.log(line.get_xydata().T) for line in upper.lines if len(line.get_xdata()) == 100)
    assert np.polyfit(*guide, 1)[0] == pytest.approx(-0.5, abs=1e-9)
    simulated, _, law, *_ = texts(upper.figure.legends[0])
    assert (simulated, r"$N_\mathrm{obj}^{-0.5}$" in law) == ("simulated", True)
    assert lower.get_ylabel() == "residual [%]"
    with pytest.raises(linksweep.SweepError, match="too many for one picture"):
        linksweep.plot(dataset_of("grid"), "law", over=["n_obj"])


def test_a_scatter_has_all_estimates_ellipses_and_truth(dataset_of):
    dataset = dataset_of("scatter")
    [axes] = linksweep.plot(dataset).axes
    x, y = (dataset["estimate"].squeeze("model").sel(component=name).values for name in ("omega_x", "omega_y"))
    assert (np.array_equal(axes.lines[0].get_xydata().T, [x, y]), axes.get_aspect()) == (True, 1.0)
    truth = next(line for line in axes.lines if line.get_label() == "truth")
    assert (truth.get_xdata()[0], truth.get_ydata()[0]) == pytest.approx((1.0, 1.0), abs=1e-9)  # of the study
    small = dataset.assign(dataset[["estimate", "bias", "bias_mc_error"]].map(lambda part: part / 1e3))
    mean = np.ptp(linksweep.plot(small).axes[0].containers[0].lines[2][0].get_segments()[0][:, 0]) / 2.0
    assert mean == pytest.approx(dataset["bias_mc_error"].sel(component="omega_x").item())  # in µas/yr
    assert f"± {x.std(ddof=1) / np.sqrt(2 * len(x)):.3f} mas/yr" in axes.figure.legends[0].get_title().get_text()
    sigma = np.sqrt(np.diag(np.cov(x, y)))
    assert_shown(axes, [np.sqrt(stats.chi2.ppf(share, 2)) * sigma for share in (0.683, 0.954)])
    assert linksweep.plot(dataset.drop_vars("component"), over=["0", "1"]).axes[0].get_xlabel() == "0 [mas]"
    [axes] = linksweep.plot(dataset, over=["epsilon_x", "omega_z"]).axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == (r"$\epsilon_{x}$ [mas]", r"$\omega_{z}$ [mas/yr]")
    with pytest.raises(linksweep.SweepError, match=r"two components of estimate: .*; not omega, omega_x"):
        linksweep.plot(dataset, over=["omega", "omega_x"])


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["svg", "pdf", "png"])
def test_the_same_picture_is_the_same_file(store_of, tmp_path, sweep, ending):
    for name in ("a", "b"):
        assert sweep("plot", store_of("sqrt-n"), "-o", tmp_path / f"{name}.{ending}")[0] == 0
    assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()


def figure_of(function, tmp_path, axes, kind=None, **options):
    return linksweep.plot(linksweep.run(function, tmp_path / "s.zarr", axes=axes, pool="serial"), kind, **options)


def test_a_list_at_each_point_of_an_axis_is_a_map_over_both(tmp_path):
    def decay(half_life: float):
        return {"rest": [0.5 ** (year / half_life) for year in range(11)], "short": half_life < 10}

    lives = [1.0, 2.0, 3.0, 6.0, 12.0, 20.0]
    axes, bar = figure_of(decay, tmp_path, {"half_life": lives}, variables=["rest"]).axes
    assert (axes.get_xlabel(), axes.get_ylabel(), bar.get_ylabel()) == ("half life", "index\u00a00", "rest")
    assert axes.get_ylim() == pytest.approx((-0.5, 10.5))  # cells surround their points
    shown = np.asarray(axes.collections[0].get_array()).reshape(11, 6)
    assert shown == pytest.approx(0.5 ** np.divide.outer(range(11), lives))


@pytest.mark.parametrize(("figure", "code", "drawn"), [*FIGURES, ('at = { mode = "c" }', 2, "'c' is not on the axis")])
def test_a_study_names_its_figure(here, sweep, figure, code, drawn):
    (here / "wave.py").write_text(WAVE)
    (here / "wave.toml").write_text(STUDY + figure)
    refused = code == 2
    ended, _, err = sweep("run", "wave.toml", "-o", "w.zarr", "--pool", "serial")
    assert (ended, (here / "w.zarr").exists()) == (2 if refused else 0, not refused), err
    if code:
        assert drawn in (err if refused else sweep("plot", "w.zarr")[2])
        return
    for options, labels in (({}, drawn), ({"variables": ["second"]}, ["second"])):  # what is asked for comes first
        figure = linksweep.plot(linksweep.open("w.zarr"), **options)
        assert [axes.get_ylabel() for axes in axes_of(figure)] == labels


@pytest.mark.parametrize("name", ["product", slow("plateau"), slow("noise")])
def test_contours_are_of_smooth_maps_and_wide_ranges_have_logarithmic_colours(tmp_path, name):
    places = [0.5 + 0.5 * i for i in range(16)]
    axes, _ = figure_of(MAPS[name], tmp_path, {"x": places, "y": places}, "map").axes
    assert bool(axes.texts) == (name == "product")
    values = axes.collections[0].get_array()
    assert (type(axes.collections[0].norm).__name__ == "LogNorm") == (0.0 < 20.0 * values.min() < values.max())


def test_values_of_an_axis_have_a_ramp_of_colours_and_stand_at_the_ends_of_lines(tmp_path):
    phases = [3.0, 1.0, 2.0, 4.0]
    places = {"x": [0.1 * i for i in range(5)], "phase": phases}
    [axes] = figure_of(lambda x, phase: np.sin(x + 0.1 * phase) + phase, tmp_path, places).axes
    written = {text.get_text(): text.xy[1] for text in axes.texts}
    assert list(written) == ["3", "1", "2", "4", "phase"]
    assert written["4"] > written["3"] > written["2"] > written["1"]
    lines = [line for line in axes.lines if len(line.get_xdata()) == 5 and line.get_marker() in ("None", "")]
    assert [line.get_ydata()[0] for line in lines] == pytest.approx([np.sin(0.1 * p) + p for p in phases])
    assert len({int(str(line.get_color())[5:7], 16) for line in lines}) == 4
    wide = figure_of(lambda x, k: x * 10.0**k, tmp_path / "wide", {"x": [1.0, 2.0], "k": [*range(8)]}, over=["x"])
    assert len(axes_of(wide)) == 8  # a scale for each


def test_what_a_panel_or_the_font_lacks_is_named(tmp_path, caplog):
    def chosen(x: float, clip: str, gamma: float | None = None, mode: str | None = None):
        return x * (gamma or 1.0) + len(clip + (mode or ""))

    axes = {"x": [1.0, 2.0, 3.0], "clip": ["none", "hard"], "gamma": [0.5, 2.0], "mode": [r"$\a_$", "b"]}
    when = {"gamma": {"clip": ["none"]}, "mode": {"clip": ["hard"]}}
    figure = linksweep.plot(linksweep.run(chosen, tmp_path / "s.zarr", axes=axes, when=when, pool="serial"))
    shown = ", ".join([*(axes.get_title() for axes in axes_of(figure)), *texts(figure.legends[0])]).split(", ")
    assert {"no clip", "clip = hard", r"no $\gamma$", r"$\gamma$ = 2", "no mode", r"mode = \$\a_\$"} <= {*shown}
    figure.suptitle("温度, 温")
    style.save(figure, tmp_path / "a.png")
    assert "a.png: the font lacks 温度, drawn as boxes" in caplog.text


def drawn(figure):
    labels = [(axes.get_xlabel(), axes.get_ylabel()) for axes in figure.axes if axes.get_visible()]
    return labels, [line for axes in figure.axes for line in axes.get_lines()]


def test_points_are_drawn_over_each_parameter_and_never_joined_crossed_axes_are_colours_and_variables_rows(tmp_path):
    def model(x: float = 1.0, k: int = 1, kind: str = "one", scale: float = 1.0):
        return {"y": x * k * scale, "z": x, "curve": np.array([x, k])}

    ranges = {"x": {"low": 0.01, "high": 1.0, "spacing": "log"}, "k": [1, 9], "kind": {"values": ["one", "two"]}}
    design = {"design": "sobol", "n": 16, "ranges": ranges}
    points = linksweep.run(model, tmp_path / "s.zarr", points=design, axes={"scale": [1.0, 2.0]}, pool="serial")
    figure = linksweep.plot(points.isel(scale=0))
    labels, lines = drawn(figure)
    assert [x for x, _ in labels] == ["$x$", "$k$", "kind"]
    assert np.array_equal(np.sort(lines[0].get_xdata()), np.sort(points.x.values))
    assert np.array_equal(np.sort(lines[0].get_ydata()), np.sort(points.y.values[:, 0]))
    assert figure.axes[0].get_xscale() == "log"
    figure = linksweep.plot(points, variables=["y", "z"], over=["x", "k"])
    labels, lines = drawn(figure)
    assert (len(labels), {line.get_linestyle() for line in lines}) == (4, {"None"})
    assert texts(figure.legends[0])[:2] == ["scale = 1", "scale = 2"]
    named = points.isel(scale=1).assign_coords(k=("point", ["a", "b"] * 8))
    named["y"] = (1e-3 * named["y"]).assign_attrs(units="m")  # drawn in mm
    figure = linksweep.plot(named, kind="pairs")  # a panel for every two parameters
    labels, lines = drawn(figure)
    assert (labels[:-1], lines) == ([("", "$k$"), ("$x$", "kind"), ("$k$", "")], [])  # the last is the scale of colours
    assert np.array_equal(np.sort(figure.axes[0].collections[0].get_offsets()[:, 0]), np.sort(points.x.values))
    assert np.allclose(np.sort(figure.axes[0].collections[0].get_array()), np.sort(points.y.values[:, 1]))
    x, y = figure.axes[3].collections[0].get_offsets().T  # where both are names, the points are on no line
    assert abs(np.corrcoef(x - x.round(), y - y.round())[0, 1]) < 0.5 >= 2.0 * abs(x - x.round()).max()


@pytest.mark.slow
def test_a_series_at_many_points_is_a_median_with_bands(tmp_path):
    times = np.linspace(0.0, 3.0, 9)
    left = linksweep.Output("left", dims="time", coords={"time": (times, "d")}, nan=True)
    declared = linksweep.experiment(outputs=[left])
    kept = declared(lambda rate=1.0: np.where(rate * times < 5.0, np.exp(-rate * times), np.nan))
    design = {"design": "halton", "n": 40, "ranges": {"rate": [0.5, 2.0]}}
    ds = linksweep.run(kept, tmp_path / "s.zarr", points=design, pool="serial")
    for options in ({}, {"over": ["time"]}, {"kind": "curves"}):
        [axes] = linksweep.plot(ds, variables=["left"], **options).axes
        [line] = [line for line in axes.get_lines() if len(line.get_xdata())]
        assert np.array_equal(line.get_xdata(), times)
        assert np.allclose(line.get_ydata(), np.nanmedian(ds["left"].values, axis=0), rtol=1e-12)
        outer = axes.collections[0].get_paths()[0].vertices
        last = outer[np.isclose(outer[:, 0], 3.0), 1]
        assert np.allclose([last.min(), last.max()], np.nanquantile(ds["left"].values[:, -1], [0.05, 0.95]), rtol=1e-12)
        assert texts(axes.figure.legends[0])[-1] == "median of 40 points"
    names = [f"p{k}" for k in range(13)]
    many = xr.Dataset({name: ("point", np.arange(3.0)) for name in ("y", "status", *names)}, attrs=ds.attrs)
    many.attrs["point_table"] = json.dumps({"parameters": names})
    for kind, most in (("points", 12), ("pairs", 8)):
        assert linksweep.plot(many.set_coords(names), kind, over=names[:most])
        with pytest.raises(linksweep.SweepError, match=f"{most + 1} parameters are too many for one picture of {most}"):
            linksweep.plot(many.set_coords(names), kind, over=names[: most + 1])


def test_points_on_which_an_axis_has_no_effect_are_dotted_lines(tmp_path):
    options = {"axes": {"kernel": ["linear", "rbf"], "gamma": [0.1, 0.2, 0.4]}, "when": {"gamma": {"kernel": ["rbf"]}}}
    ds = linksweep.run(lambda kernel, gamma=1.0: gamma, tmp_path / "s.zarr", pool="serial", **options)
    assert linksweep.plot(ds, "law").axes[0].get_legend_handles_labels()[1][0].startswith("kernel = rbf: ")  # alone
    [axes] = linksweep.plot(ds).axes
    apart = {"axes": {"k": [0, 1], "g": [*range(6)], "h": [*range(7)]}, "when": {"g": {"k": [0]}, "h": {"k": [1]}}}
    ds = linksweep.run(lambda k, g=1, h=1: g - h, tmp_path / "t.zarr", pool="serial", **apart)
    assert len(linksweep.plot(ds).axes) == 7  # lines, for a map would be empty
    [dotted] = [line for line in axes.get_lines() if line.get_linestyle() == ":"]
    assert (list(dotted.get_ydata()), axes.get_ylim()[0] < 1.0 < axes.get_ylim()[1]) == ([1.0, 1.0], True)
    assert dotted.get_color() != next(line for line in axes.get_lines() if 0.1 in line.get_ydata()).get_color()
    together = {"experiment": lambda kernel, gamma=1.0: gamma, "grid": {"zip": [["kernel", "gamma"]]}, **options}
    together["axes"] = {"kernel": ["rbf", "none", "linear"], "gamma": [0.1, 0.2, 0.4]}
    ds = linksweep.run(together, tmp_path / "u.zarr", pool="serial")
    assert linksweep.plot(ds.isel(kernel=[1, 2])).axes[0].get_xlabel() == "kernel"
