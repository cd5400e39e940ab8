"""Figures of 88 mm, the width of a column: nothing is cut, covered or squeezed."""

from itertools import combinations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from linksweep.sweep.plots import style
from linksweep.sweep.plots.figure import draw_figure
from linksweep.sweep.plots.layout import Layout
from linksweep.sweep.plots.lines import draw_lines
from linksweep.sweep.plots.panels import draw_panels
from tests.tiers import slow

WIDTH = 88.0


@pytest.fixture(params=["paper", slow("talk")])
def narrow(request):
    with style.settings(WIDTH, request.param):
        yield


def drawn(figure):
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return canvas.get_renderer()


@pytest.mark.usefixtures("narrow")
def test_titles_and_labels_of_panels_neither_overlap_nor_leave_the_figure(dataset_of):
    dataset = dataset_of("quasars").sel(v_max=[14.0, 20.0])
    long = dataset["v_max"].assign_attrs(symbol="a parameter with a long name")
    dataset = dataset.assign_coords(v_max=long).assign_coords(model=["one of two long names", "the other of them"])
    figure = draw_panels(
        dataset,
        ["sigma_spin"],
        Layout((), "model", None, False),
        lambda axes, part, name: draw_lines(axes, part, name, "v_max"),
    )
    renderer = drawn(figure)
    for texts in ([axes.title for axes in figure.axes], [axes.xaxis.label for axes in figure.axes]):
        boxes = [text.get_window_extent(renderer) for text in texts if text.get_text()]
        assert boxes
        assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
        assert all(box.x0 >= 0.0 and box.x1 <= figure.bbox.width for box in boxes)


@pytest.mark.slow
@pytest.mark.usefixtures("narrow")
def test_a_legend_takes_no_height_from_its_panel(dataset_of):
    dataset = dataset_of("quasars").sel(model="gaia")
    many = dataset.expand_dims(draw=np.arange(6.0))
    figure = draw_panels(
        many,
        ["sigma_spin"],
        Layout(("draw",), None, None, False),
        lambda axes, part, name: draw_lines(axes, part, name, "v_max"),
    )
    drawn(figure)  # a warning of a collapsed layout would be an error
    (panel,) = figure.axes
    assert figure.legends
    assert panel.get_legend() is None
    height = panel.get_window_extent().height / figure.dpi
    assert height > 0.5 * style.least_height()


def test_no_sign_of_the_legend_of_a_scatter_is_cut(dataset_of):
    with style.settings(WIDTH):
        figure = draw_figure(dataset_of("scatter"))
        renderer = drawn(figure)
    signs = figure.axes[0].get_legend().get_lines()
    assert signs
    assert min(sign.get_window_extent(renderer).y0 for sign in signs) > 0.0
