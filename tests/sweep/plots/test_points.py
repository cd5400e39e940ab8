"""Pictures of points in no order: scatters and pairs, never a line through them."""

import numpy as np
import pytest

import linksweep


@pytest.fixture(scope="module")
def points(tmp_path_factory):
    def model(x: float = 1.0, k: int = 1, kind: str = "one", scale: float = 1.0):
        return {"y": x * k * scale, "z": x, "curve": np.array([x, k])}

    ranges = {"x": {"low": 0.01, "high": 1.0, "spacing": "log"}, "k": [1, 9], "kind": {"values": ["one", "two"]}}
    design = {"design": "sobol", "n": 16, "ranges": ranges}
    store = tmp_path_factory.mktemp("points") / "s.zarr"
    return linksweep.run(model, store, points=design, axes={"scale": [1.0, 2.0]}, pool="serial")


def drawn(figure):
    """The labels of each visible panel, and all lines."""
    labels = [(axes.get_xlabel(), axes.get_ylabel()) for axes in figure.axes if axes.get_visible()]
    return labels, [line for axes in figure.axes for line in axes.get_lines()]


def test_points_are_drawn_over_each_parameter_and_never_joined_crossed_axes_are_colours_and_variables_rows(points):
    figure = linksweep.plot(points.isel(scale=0))
    labels, lines = drawn(figure)
    assert [x for x, _ in labels] == ["$x$", "$k$", "kind"]
    assert {line.get_linestyle() for line in lines} == {"None"}
    assert np.array_equal(np.sort(lines[0].get_xdata()), np.sort(points.x.values))
    assert np.array_equal(np.sort(lines[0].get_ydata()), np.sort(points.y.values[:, 0]))
    assert figure.axes[0].get_xscale() == "log"
    figure = linksweep.plot(points, variables=["y", "z"], over=["x", "k"])
    labels, lines = drawn(figure)
    assert (len(labels), {line.get_linestyle() for line in lines}) == (4, {"None"})
    [legend] = figure.legends
    assert [text.get_text() for text in legend.get_texts()][:2] == ["scale = 1", "scale = 2"]


def test_pairs_have_a_panel_for_every_two_parameters(points):
    figure = linksweep.plot(points.isel(scale=1), kind="pairs")
    labels, lines = drawn(figure)
    assert labels[:-1] == [("", "$k$"), ("$x$", "kind"), ("$k$", "")]  # the last is the scale of colours
    assert not lines
    offsets = np.asarray(figure.axes[0].collections[0].get_offsets())
    assert np.array_equal(np.sort(offsets, axis=0), np.sort(np.stack([points.x, points.k], axis=1), axis=0))
    assert np.array_equal(np.sort(figure.axes[0].collections[0].get_array()), np.sort(points.y.values[:, 1]))


TIMES = np.linspace(0.0, 3.0, 9)


@linksweep.experiment(outputs=[linksweep.Output("left", dims="time", coords={"time": (TIMES, "d")})])
def decay(rate: float = 1.0):
    return {"left": np.exp(-rate * TIMES)}


@pytest.mark.slow
def test_a_series_at_many_points_is_a_median_with_bands(tmp_path):
    design = {"design": "halton", "n": 40, "ranges": {"rate": [0.5, 2.0]}}
    ds = linksweep.run(decay, tmp_path / "s.zarr", points=design, pool="serial")
    for options in ({}, {"over": ["time"]}, {"kind": "curves"}):
        [axes] = linksweep.plot(ds, variables=["left"], **options).axes
        [line] = [line for line in axes.get_lines() if len(line.get_xdata())]
        assert np.array_equal(line.get_xdata(), TIMES)
        assert np.allclose(line.get_ydata(), np.median(ds["left"].values, axis=0), rtol=1e-12)
        outer = axes.collections[0].get_paths()[0].vertices
        last = outer[np.isclose(outer[:, 0], 3.0), 1]
        assert np.allclose([last.min(), last.max()], np.quantile(ds["left"].values[:, -1], [0.05, 0.95]), rtol=1e-12)
        assert [text.get_text() for text in axes.figure.legends[0].get_texts()][-1] == "median of 40 points"


def test_points_on_which_an_axis_has_no_effect_are_dotted_lines(tmp_path):
    def score(kernel: str, gamma: float = 0.5):
        return 1.0 if kernel == "linear" else gamma

    axes = {"kernel": ["linear", "rbf"], "gamma": [0.1, 0.2, 0.4]}
    ds = linksweep.run(score, tmp_path / "s.zarr", axes=axes, when={"gamma": {"kernel": ["rbf"]}}, pool="serial")
    [axes] = linksweep.plot(ds).axes
    [dotted] = [line for line in axes.get_lines() if line.get_linestyle() == ":"]
    assert list(dotted.get_ydata()) == [1.0, 1.0]
    low, high = axes.get_ylim()
    assert low < 1.0 < high
    assert dotted.get_color() != next(line for line in axes.get_lines() if 0.1 in line.get_ydata()).get_color()
