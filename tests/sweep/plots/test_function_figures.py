"""Pictures of results of plain functions: lists, truth values, names, and no errors."""

import numpy as np
import pytest

import linksweep
from sweep.plots.caption import caption, caption_and_description, description


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
        "decay. short: Over 6 points it goes from 0, at half_life=12, to 1, at half_life=1.\n\n"
        "Alternative text: Short against half life. "
        "short: Over 6 points it goes from 0, at half_life=12, to 1, at half_life=1.\n"
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
