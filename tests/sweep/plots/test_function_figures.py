"""Pictures of results of plain functions: lists, truth values, names, and no errors."""

import numpy as np
import pytest

import linksweep


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
