"""Figures in the width of a column, 88 mm: letters have their size, nothing is cut, covered or squeezed."""

from itertools import combinations, pairwise

import numpy as np
import pytest
from matplotlib.text import Text

import linksweep
from linksweep.sweep.plots.style import settings
from tests.tiers import slow

WIDTH = 88.0


def drawn(dataset, *arguments, width=WIDTH):
    with settings(width):
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
    for texts in ([axes.title for axes in figure.axes], [axes.xaxis.label for axes in figure.axes]):
        boxes = [text.get_window_extent() for text in texts if text.get_text()]
        assert boxes
        assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
        assert all(box.x0 >= 0.0 and box.x1 <= figure.bbox.width for box in boxes)


def test_a_legend_takes_no_height_from_its_panel(dataset_of):
    many = dataset_of("quasars").sel(model="gaia").expand_dims(draw=np.arange(6.0))
    [panel] = drawn(many, "lines").axes
    assert panel.figure.legends
    assert panel.get_legend() is None
    assert panel.get_window_extent().height / panel.figure.dpi > 0.85


def letters_in(town: str) -> int:
    return len(town)


KINDS = ["steel", "aluminium", "carbon fibre composite"]
TOWNS = ["Amsterdam", "Buenos Aires", "Constantinople", "Heidelberg", "Kuala Lumpur", "Llanfairpwllgwyngyll", "Turin"]


@pytest.mark.parametrize(
    ("names", "width", "turned"), [(KINDS, 88.0, 0.0), (TOWNS, None, 45.0), slow(TOWNS * 4, 88.0, 90.0)]
)
def test_names_below_an_axis_do_not_cover_each_other(tmp_path, names, width, turned):
    different = [f"{name}{'' if i < len(TOWNS) else i}" for i, name in enumerate(names)]
    dataset = linksweep.run(letters_in, tmp_path / "s.zarr", axes={"town": different}, pool="serial")
    [axes] = drawn(dataset, width=width).axes
    texts = axes.get_xticklabels()
    assert [" ".join(text.get_text().split()) for text in texts] == different
    assert {text.get_rotation() for text in texts} == {turned}
    if turned == 0.0:
        boxes = [text.get_window_extent() for text in texts]
        assert all(left.x1 < right.x0 for left, right in pairwise(boxes))
    assert axes.get_window_extent().height > 0.3 * axes.figure.bbox.height
