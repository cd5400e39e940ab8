"""Pictures of results of plain functions: lists, truth values, names, and no errors."""

from itertools import pairwise

import numpy as np
import pytest

import linksweep
from linksweep.sweep.plots import style
from linksweep.sweep.plots.caption import caption, caption_and_description, description
from linksweep.sweep.plots.figure import draw_figure


def decay(half_life: float, years: int = 10):
    rest = [0.5 ** (year / half_life) for year in range(years + 1)]
    return {"rest": rest, "lost": 1.0 - rest[-1], "short": half_life < years}


@pytest.fixture(scope="module")
def decayed(tmp_path_factory):
    axes = {"half_life": [1.0, 2.0, 3.0, 6.0, 12.0, 20.0]}
    return linksweep.run(decay, tmp_path_factory.mktemp("decay") / "s.zarr", axes=axes, pool="serial")


def panels(figure):
    return [axes for axes in figure.axes if axes.get_label() != "<colorbar>" and axes.get_visible()]


def test_a_list_at_each_point_of_an_axis_is_a_map_over_both(decayed):
    [axes] = panels(linksweep.plot(decayed, variables=["rest"]))
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("half life", "rest dim 0")
    shown = np.asarray(axes.collections[0].get_array()).reshape(11, 6)
    assert shown == pytest.approx(decayed["rest"].values.T)


def test_words_beside_a_picture_are_about_what_it_draws(decayed):
    figure = linksweep.plot(decayed, variables=["short"])
    assert caption_and_description(figure, decayed) == (
        "decay. short: It is True at 4 of 6 points.\n\n"
        "Alternative text: Short against half life. short: It is True at 4 of 6 points.\n"
    )
    words = description(linksweep.plot(decayed, variables=["rest"]), decayed)
    assert words.startswith("Rest dim 0 against half life, coloured by rest. rest: With 11 values along rest_dim_0")


@pytest.mark.parametrize("kind", ["lines", "law"])
def test_points_without_errors_are_neither_simulated_nor_said_to_have_any(decayed, kind):
    figure = linksweep.plot(decayed, kind, variables=["lost"])
    assert "simulated" not in caption(figure, decayed)
    assert "simulated" not in [text for axes in figure.axes for text in axes.get_legend_handles_labels()[1]]


def test_one_point_of_a_function_is_computed(decayed):
    [axes] = linksweep.plot(decayed.sel(half_life=[2.0]), variables=["lost"]).axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["computed"]


def letters_in(town: str) -> int:
    return len(town)


KINDS = ["steel", "aluminium", "carbon fibre composite"]
TOWNS = ["Amsterdam", "Buenos Aires", "Constantinople", "Heidelberg", "Kuala Lumpur", "Llanfairpwllgwyngyll", "Turin"]


@pytest.mark.parametrize(
    ("names", "width", "turned"), [(KINDS, None, 0.0), (KINDS, 88.0, 0.0), (TOWNS, None, 45.0), (TOWNS * 4, 88.0, 90.0)]
)
def test_names_below_an_axis_do_not_cover_each_other(tmp_path, names, width, turned):
    different = [f"{name}{'' if i < len(TOWNS) else i}" for i, name in enumerate(names)]
    ds = linksweep.run(letters_in, tmp_path / "s.zarr", axes={"town": different}, pool="serial")
    with style.settings(width):
        figure = draw_figure(ds)
        figure.draw_without_rendering()
    [axes] = figure.axes
    texts = axes.get_xticklabels()
    assert [" ".join(text.get_text().split()) for text in texts] == different
    assert {text.get_rotation() for text in texts} == {turned}
    if turned == 0.0:
        boxes = [text.get_window_extent() for text in texts]
        assert all(left.x1 < right.x0 for left, right in pairwise(boxes))
    assert axes.get_window_extent().height > 0.3 * figure.bbox.height
