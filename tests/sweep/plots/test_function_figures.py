"""Pictures of results of plain functions: lists, truth values, and no errors."""

import numpy as np
import pytest

import linksweep


def decay(half_life: float, years: int = 10):
    rest = [0.5 ** (year / half_life) for year in range(years + 1)]
    return {"rest": rest, "lost": 1.0 - rest[-1], "short": half_life < years}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path, axes = tmp_path_factory.mktemp("decay") / "s.zarr", {"half_life": [1.0, 2.0, 3.0, 6.0, 12.0, 20.0]}
    linksweep.run(decay, path, axes=axes, pool="serial")
    return path


@pytest.fixture(scope="module")
def decayed(store):
    return linksweep.open(store)


def test_a_list_at_each_point_of_an_axis_is_a_map_over_both(decayed):
    axes = linksweep.plot(decayed, variables=["rest"]).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("half life", "rest dim 0")
    shown = np.asarray(axes.collections[0].get_array()).reshape(11, 6)
    assert shown == pytest.approx(decayed["rest"].values.T)


def test_words_beside_a_picture_are_about_what_it_draws(store, tmp_path, sweep):
    def words(variable):
        assert sweep("plot", store, "--variable", variable, "--caption", "-o", tmp_path / "a.svg")[0] == 0
        return (tmp_path / "a.txt").read_text()

    assert words("short") == (
        "decay. short: It is True at 4 of 6 points.\n\n"
        "Alternative text: Short against half life. short: It is True at 4 of 6 points.\n"
    )
    text = "Alternative text: Rest dim 0 against half life, coloured by rest. rest: Over "
    assert text in words("rest")


@pytest.mark.parametrize("kind", ["lines", "law"])
def test_points_without_errors_are_neither_simulated_nor_said_to_have_any(store, decayed, tmp_path, sweep, kind):
    figure = linksweep.plot(decayed, kind, variables=["lost"])
    assert "simulated" not in [text for axes in figure.axes for text in axes.get_legend_handles_labels()[1]]
    options = ["--kind", kind, "--variable", "lost", "--caption"]
    assert sweep("plot", store, *options, "-o", tmp_path / "a.svg")[0] == 0
    assert "simulated" not in (tmp_path / "a.txt").read_text()


def test_one_point_of_a_function_is_computed(decayed):
    [axes] = linksweep.plot(decayed.sel(half_life=[2.0]), variables=["lost"]).axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["computed"]
