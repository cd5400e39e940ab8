"""Figures that say nothing untrue, whose letters have their size and whose parts do not cover each other."""

import json
from itertools import combinations, pairwise

import numpy as np
import pytest
import xarray as xr
from hypothesis import example, given, settings, strategies as st
from matplotlib.collections import PolyCollection
from matplotlib.container import ErrorbarContainer
from matplotlib.text import Text

import linksweep
from linksweep.sweep.analysis import quantity
from linksweep.sweep.plots import style
from tests.tiers import examples, slow

LARGE, CLOSE = [50.0, 7.0, 90.0, 41.0, 23.0, 77.0, 64.0, 12.0, 34.0, 58.0], [1.0 + 1e-12 * i for i in range(9)]
OTHERS = [([1, 2, 5, 10, 20, 50], "log"), ([1.0, 1.19, 1.41, 1.68, 2.0], "log"), (LARGE, "linear"), (CLOSE, "linear")]
OTHERS += [([1.0, 2.0, 2.5, 4.0, 5.5, 7.0], "linear"), ([0.0, 1.0, 10.0], "linear"), ([1.0, 100.0], "linear")]
OTHERS += [([0, 1, 10, 100], "symlog"), ([-100.0, -10.0, -1.0, 0.1, 1.0], "symlog"), ([0.0, 1e-300, 1.0], "linear")]
WIDTH = 88.0
KINDS = ["steel", "aluminium", "carbon fibre composite"]
TOWNS = ["Amsterdam", "Buenos Aires", "Constantinople", "Heidelberg", "Kuala Lumpur", "Llanfairpwllgwyngyll", "Turin"]
NAMES = [(KINDS, 88.0, 0.0), (TOWNS, None, 45.0), slow(TOWNS * 4, 88.0, 90.0)]


def results(x):
    variables = {"y": ("x", np.linspace(1.0, 2.0, len(x)), {"headline": 1}), "status": ("x", np.ones(len(x), int))}
    return xr.Dataset(variables, {"x": x}, {"title": "", "function": "f"})


def scales(dataset, **options):
    [axes] = linksweep.plot(dataset, "lines", **options).axes
    return axes.get_xscale(), axes.get_yscale()


@settings(max_examples=examples(25))
@given(st.floats(1e-6, 1e6), st.floats(0.01, 100.0), st.integers(3, 40), st.randoms(use_true_random=False))
def test_equal_steps_are_linear_however_far_they_go_and_equal_ratios_logarithmic(start, step, n, shuffle):
    for scale in ("linear", "log"):
        x = [start * (1.0 + step * i if scale == "linear" else (1.0 + step) ** i) for i in range(n)]
        shuffle.shuffle(x)
        assert scales(results(x))[0] == scale


@settings(max_examples=examples(25), deadline=None)
@example([1, 0] * 30)
@example([1] * 30 + [4] * 30)
@given(st.lists(st.sampled_from([0, 1, 4]), min_size=3, max_size=60).filter(any))
def test_every_value_is_seen_whatever_is_missing_beside_it_and_what_is_still_running_has_a_hollow_marker(status):
    dataset, seen, marks = results(np.arange(float(len(status)))), set(), {True: [], False: []}
    dataset = dataset.assign(y=dataset.y.where(np.array(status) > 0), status=("x", status))
    [axes] = linksweep.plot(dataset, "lines").axes
    for line in axes.lines:
        x, there = line.get_xdata(), np.isfinite(line.get_ydata())
        if is_marked := line.get_marker() not in ("None", "_", "|"):
            marks[line.get_color() == "white"] += x.tolist()
        seen |= {*x[there & (is_marked or np.convolve(there, [1, 0, 1], "same") > 0)].tolist()}
    running = np.flatnonzero(np.array(status) == 4).tolist()
    assert (seen, marks[True], {*running} - {*marks[False]}) == ({*np.flatnonzero(status).tolist()}, running, set())


@pytest.mark.parametrize(("x", "scale"), OTHERS)
def test_other_axes_have_the_scale_on_which_they_are_more_even(x, scale):
    assert scales(results(x))[0] == scale
    assert scales(results(x), linear=["x"])[0] == "linear"


def test_numbers_of_six_hundred_decades_are_all_in_view_and_integers_have_ticks_at_integers():
    x = 10.0 ** np.arange(-300.0, 301.0, 50.0)
    [axes] = linksweep.plot(results(x).assign(y=("x", x)), "lines").axes
    for low, high in (axes.get_xlim(), axes.get_ylim()):
        assert (low < 1e-299, high > 1e299) == (True, True)
    with pytest.raises(linksweep.SweepError, match="y has only numbers below 1e-286, which a linear axis cannot show"):
        linksweep.plot(results(x).assign(y=("x", 1e-300 * np.arange(13.0))))
    assert not (linksweep.plot(results(np.arange(1, 4))).axes[0].get_xticks() % 1.0).any()


def test_a_study_chooses_scales_a_call_overrides_it_and_a_logarithm_needs_numbers_above_zero(tmp_path):
    study = {"experiment": lambda width: {"area": width**2}, "axes": {"width": [1.0, 2.0, 3.0, 4.0]}}
    study["figure"] = {"log": ["width", "area"]}
    dataset = linksweep.run(study, tmp_path / "a.zarr", pool="serial")
    assert (scales(dataset), scales(dataset, linear=["area"])) == (("log", "log"), ("log", "linear"))
    again = linksweep.run(study | {"figure": {"linear": ["area"]}}, tmp_path / "a.zarr", pool="serial")
    assert scales(again) == ("linear", "linear")
    assert "scale" not in again["area"].attrs
    for lowest, scale in (-1.0, "linear"), (1.0, "log"):  # a prediction is seen, too
        ds = results(x := [1.0, 10.0, 100.0]).assign(y=("x", x), y_predicted=("x", [lowest, *x[1:]]))
        assert linksweep.plot(ds).axes[0].get_yscale() == scale
    with pytest.raises(linksweep.SweepError, match="x = 0: a logarithmic axis has only numbers above zero"):
        linksweep.plot(results([0.0, 1.0, 10.0]), log=["x"])
    wrong = {"title": "a", "axes": {"sky_contrast": [0.0, 0.5]}, "figure": {"log": ["sky_contrast", "n_obi"]}}
    with pytest.raises(linksweep.SweepError) as raised:
        linksweep.run(wrong, tmp_path / "a.zarr")
    zero = "figure.log.0: sky_contrast = 0.0: a logarithmic axis has only numbers above zero"
    misspelt = "figure.log.1: 'n_obi' is neither a parameter nor an output; did you mean 'n_obj'?"
    assert raised.value.problems == [zero, misspelt]


def test_series_of_close_values_and_of_times_have_colours_and_names_and_days_are_words(tmp_path):
    days = [59000.04, 59000.08, 59000.12]
    axes = {"mjd": days, "period": [1.0, 2.0]}
    dataset = linksweep.run(lambda mjd, period: mjd * period, tmp_path / "s.zarr", axes=axes, pool="serial")
    [axes] = linksweep.plot(dataset, "lines", over="period").axes
    assert len({line.get_color() for line in axes.lines if len(line.get_xdata())}) == 3
    names = axes.get_legend_handles_labels()[1]
    assert {name for name in names if "59000" in name} == {f"mjd = {day}" for day in days}
    days = np.array(["2020-01-01", "2020-01-02", "2020-01-03"], dtype="datetime64[D]")
    u = linksweep.Output("u", "K", dims="time", coords={"time": (days, "")})
    watch = linksweep.experiment(outputs=[u])(lambda k: {"u": k * np.arange(1.0, 4.0)})
    dataset = linksweep.run(watch, tmp_path / "t.zarr", axes={"k": [1.0, 2.0]}, pool="serial")
    [axes] = linksweep.plot(dataset, "lines", over="k").axes
    assert {*axes.get_legend_handles_labels()[1]} >= {*map(str, days)}
    for day in (str(days[2]), days[2], days[2].item(), f"{days[2]}T00:00"):
        assert quantity.select(dataset, {"time": day})["u"].values.tolist() == [3.0, 6.0]
    assert "time=2020-01-03" in linksweep.answer(dataset).sentences[0]


@pytest.mark.parametrize("factors", [slow([1.0] * 2), [1.0] * 3, slow([1.0] * 7), [1.0, 1.0, 2.2, 5.0, 11.0, 25.0]])
def test_only_markers_are_moved_aside_and_the_figure_says_so(factors):
    x = np.geomspace(1e-6, 100.0, 5)
    y = np.outer(factors, x**2)
    variables = {"y": y, "y_mc_error": 0.01 * y, "y_predicted": 1.1 * y, "status": 0 * y + 1}
    variables = {name: (("kind", "x"), values) for name, values in variables.items()}
    coords = {"kind": [f"k{i}" for i in range(len(y))], "x": x}
    figure = linksweep.plot(xr.Dataset(variables, coords, {"title": "A", "function": "f"}), "lines")
    figure.draw_without_rendering()
    [axes] = figure.axes
    true = [axes.transData.transform(np.stack([x, one], axis=1)) for one in y]

    def pixels(artist):
        return artist.get_transform().transform(np.stack([artist.get_xdata(), artist.get_ydata()], axis=1))

    marks = [one for one in axes.containers if isinstance(one, ErrorbarContainer)]
    aside = [pixels(one.lines[0]) - at for one, at in zip(marks, true, strict=True)]
    assert all(np.allclose(one[:, 1], 0.0) for one in aside)
    shifts = [one[0, 0] / figure.dpi * 72.0 for one in aside]
    assert np.all(np.diff(shifts) > 1.0)
    assert np.abs(shifts).max() < 6.0
    for one, shift in zip(marks, aside, strict=True):  # the bars go with their markers
        [bars], at = one.lines[2], [[x[1], 1.0]]
        assert np.allclose(bars.get_transform().transform(at) - axes.transData.transform(at), shift[0])
    joined = [line for line in axes.lines if line.get_linestyle() == "-" and len(line.get_xdata()) == 5]
    assert np.allclose([pixels(line) for line in joined], true)
    predicted = [line for line in axes.lines if any(np.array_equal(line.get_ydata(), 1.1 * one) for one in y)]
    assert {(line.get_linestyle(), line.get_marker()) for line in predicted} == {("None", "_")}
    assert not figure.findobj(PolyCollection)  # nothing is drawn between the points of a prediction
    assert "markers moved sideways, lines not" in [text.get_text() for text in figure.legends[0].get_texts()]


@pytest.mark.parametrize("over", [slow("load"), "strong"])
def test_figures_and_their_words_have_true_and_false(tmp_path, over):
    def weigh(load: float, strong: bool):
        if load == 3.0 and strong:
            raise ValueError("too heavy to know")
        return {"stands": load < (3.5 if strong else 1.5)}

    axes = {"load": [1.0, 2.0, 3.0, 4.0], "strong": [True, False]}
    dataset = linksweep.run(weigh, tmp_path / "s.zarr", axes=axes, pool="serial")
    figure = linksweep.plot(dataset, "lines", variables=["stands"], over=[over])
    figure.draw_without_rendering()
    [axes] = figure.axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["False", "True"]
    assert axes.get_yticks().tolist() == [0.0, 1.0]
    assert not [line for line in axes.lines if line.get_linestyle() == "-"]  # nothing is half true
    if over == "load":
        said = axes.get_legend_handles_labels()[1]
        assert [label for label in said if "strong" in label] == ["strong = True", "strong = False"]
    else:
        assert [text.get_text() for text in axes.get_xticklabels()] == ["True", "False"]
    assert "stands: It is True at 3 of" in style.caption(figure, dataset, with_answer=True)


def test_maps_of_truth_values_have_two_colours(tmp_path):
    ds = linksweep.run(lambda x, y: x * y > 2.0, tmp_path / "s.zarr", axes={"x": [0.0, 1.0, 2.0], "y": [0.0, 2.0, 3.0]})
    panel, bar = linksweep.plot(ds, "map").axes
    assert [text.get_text() for text in bar.get_yticklabels()] == ["False", "True"]
    assert [text.get_text() for text in panel.get_yticklabels()] == ["0", "2", "3"]  # those of a short axis alone
    gap = ds.assign_coords(x=[0.0, np.nan, 2.0])  # one without an effect of x
    assert linksweep.plot(gap, "map").axes[0].collections[0].get_array().shape == (3, 2)


def test_a_series_over_days_is_a_line_over_days_a_figure_may_be_at_a_date_and_a_legend_has_its_times(tmp_path):
    days = np.datetime64("2024-01-01", "ns") + np.arange(60) * np.timedelta64(1, "D")
    tide = xr.DataArray(np.cos(np.arange(60) / 9.0), {"day": days}, ("day",), "height")
    ds = linksweep.run(lambda rate: rate * tide, tmp_path / "s.zarr", axes={"rate": [1.0, 2.0]}, pool="serial")
    [axes] = linksweep.plot(ds).axes
    for line, values in zip(axes.lines, ds["height"].transpose("rate", "day").values, strict=False):
        assert np.array_equal(np.diff(line.get_xdata()), np.ones(59))
        assert np.array_equal(line.get_ydata(), values)
    with pytest.raises(linksweep.SweepError, match="'day' is no axis with several numbers"):
        linksweep.find(ds, "height > 0", over="day")
    with pytest.raises(linksweep.SweepError, match="first cannot be drawn along day; its axes are rate"):
        linksweep.plot(ds.assign(first=ds.height[:, 0].drop_vars("day")), variables=["height", "first"])
    axes = {"day": ["2024-01-01", "2024-01-03"], "start": ["2024-01-01 06:30", "2024-01-01 18:00"], "n": [1, 2, 3]}
    ds = linksweep.run(lambda day, start, n: n + len(day + start), tmp_path / "t.zarr", axes=axes, pool="serial")
    figure = json.dumps({"figure": {"at": {"day": "2024-01-03"}, "over": ["n"]}})
    [panel] = linksweep.plot(ds.assign_attrs(study_document=figure)).axes
    assert set(axes["start"]) <= set(panel.get_legend_handles_labels()[1])


@pytest.mark.parametrize(("kind", "year"), [("axes", 2024), ("points", 2024), ("axes", 1600)])
def test_an_axis_of_dates_has_their_distances(tmp_path, kind, year):
    days = [f"{year}-01-01", f"{year}-01-03", f"{year}-06-01"]
    ds = linksweep.run(lambda day: float(day > days[0]), tmp_path / "s.zarr", **{kind: {"day": days}}, pool="serial")
    [axes] = linksweep.plot(ds).axes
    assert np.diff(axes.lines[0].get_xdata()).tolist() == [2.0, 150.0]


@pytest.mark.parametrize("known", [False, True])
def test_a_caption_has_the_signs_that_are_drawn_and_symbols_as_they_are(known):
    ds = results([1.0, 2.0, 3.0]).assign(y_predicted=("x", [1.0, 2.0, 3.0])).assign_coords(cut=2.5)
    ds = ds.assign(y_catalogue_error=("x", np.full(3, 0.1 if known else np.nan))).assign_attrs(title="5 $_a to 10 $")
    text = style.caption_and_description(linksweep.plot(ds), ds)
    assert ("errors of the predictions" in text) == known
    assert (text[:26], "y against x." in text) == ("5 $_a to 10 $; cut = 2.5. ", True)
    ds["z"] = ds["y"].copy(data=np.full(3, 7.0))
    assert "z: It is 7 at 3 points" in style.caption_and_description(linksweep.plot(ds, variables=["y", "z"]), ds)


def drawn(dataset, *arguments, width=WIDTH):
    with style.settings(width):
        figure = linksweep.plot(dataset, *arguments)
    figure.draw_without_rendering()  # a warning of a collapsed layout would be an error
    return figure


@pytest.mark.slow
@pytest.mark.parametrize("width", [WIDTH, 180.0])
@pytest.mark.parametrize("name", ["quasars", "algorithm", "error-surface", "scatter"])
def test_letters_have_their_size_at_the_width_of_print(dataset_of, name, width):
    figure = drawn(dataset_of(name), width=width)
    assert figure.get_figwidth() == pytest.approx(width / 25.4)
    assert min(t.get_fontsize() for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip()) >= 6.0  # pt


def test_titles_and_labels_of_panels_neither_overlap_nor_leave_the_figure(dataset_of):
    dataset = dataset_of("quasars").sel(v_max=[14.0, 20.0])
    long = dataset["v_max"].assign_attrs(symbol="a parameter with a long name")
    dataset = dataset.assign_coords(v_max=long).assign_coords(model=["one of two long names", "the other of them"])
    figure = drawn(dataset, "lines")
    assert all(a.get_ylim() == b.get_ylim() or b.yaxis.get_tick_params()["labelleft"] for a, b in pairwise(figure.axes))
    for texts in ([axes.title for axes in figure.axes], [axes.xaxis.label for axes in figure.axes]):
        boxes = [text.get_window_extent() for text in texts if text.get_text()]
        assert boxes
        assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
        assert all(box.x0 >= 0.0 and box.x1 <= figure.bbox.width for box in boxes)
    assert (len(figure.legends), [axes.get_legend() for axes in figure.axes]) == (1, [None] * len(figure.axes))


@pytest.mark.parametrize(("names", "width", "turned"), NAMES)
def test_names_below_an_axis_do_not_cover_each_other(tmp_path, names, width, turned):
    different = [f"{name}{'' if i < len(TOWNS) else i}" for i, name in enumerate(names)]
    dataset = linksweep.run(lambda town: 1.0 * len(town), tmp_path / "s.zarr", axes={"town": different}, pool="serial")
    [axes] = drawn(dataset, width=width).axes
    texts = axes.get_xticklabels()
    assert [" ".join(text.get_text().split()) for text in texts] == different
    assert {text.get_rotation() for text in texts} == {turned}
    boxes = [text.get_window_extent() for text in texts]
    assert turned or all(left.x1 < right.x0 for left, right in pairwise(boxes))
    assert axes.get_window_extent().height > 0.6 * axes.figure.bbox.height
