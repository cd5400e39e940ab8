"""Figures of links and forecasts: what is drawn is what the dataset holds."""

import numpy as np
import pytest

import linksweep
from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots import kinds
from linksweep.sweep.plots.caption import caption
from linksweep.sweep.plots.tie.figure import draw_link, link_figures
from linksweep.sweep.plots.tie.names import readable, unknown_symbol
from linksweep.sweep.plots.tie.residuals import BANDS, _angles, _averaged


@pytest.fixture(scope="module")
def link():
    return linksweep.tie("psrpi-de200", "timing-de200", "orientation", clip="discrepancy:1", errors="jackknife,scaled")


@pytest.fixture(scope="module")
def plan():
    options = {"add": [2026.0, 2030.0], "number": 2, "goal": ["spin"]}
    return linksweep.forecast("psrpi", "psrpi", "orientation,spin", **options)


def test_every_kind_of_figure_is_there_and_those_of_a_link_have_captions():
    for table in (kinds.GRID, kinds.SCALING, kinds.STANDALONE, *kinds.LINK.values()):
        assert all(kind.load() for kind in table.values())
    assert all(kind.caption for table in kinds.LINK.values() for kind in table.values())


def test_a_link_has_the_figures_that_its_content_allows(link):
    figures = link_figures(link)
    assert list(figures) == ["solution", "residuals", "separations", "weight", "ranking", "jackknife", "trajectory"]
    for figure in figures.values():
        assert "reference" in figure.get_suptitle()
    with pytest.raises(SweepError, match="--degree"):
        draw_link(link, "spectrum")
    with pytest.raises(SweepError, match="no kind 'lines' of a tie"):
        linksweep.plot(link, "lines")
    with pytest.raises(SweepError, match="no variables"):
        linksweep.plot(link, variables=["estimate"])


def test_the_caption_of_a_link_says_what_its_kind_shows(link):
    words = caption(linksweep.plot(link, "weight"), link)
    assert words.startswith("Discrepancy of each source per observation, against its share of the weight: ")
    assert "reference" in words


def test_the_legend_of_weights_covers_no_points(link):
    figure = linksweep.plot(link, "weight")
    figure.draw_without_rendering()
    [legend] = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["kept", "dropped, of no weight", "10 %"]
    assert not any(legend.get_window_extent().overlaps(axes.get_window_extent()) for axes in figure.axes)
    assert figure.axes[0].get_title() == "8 kept, 1 dropped"


@pytest.mark.slow
def test_the_scatter_of_the_stretched_solutions_is_the_jackknife_error(link):
    axes = linksweep.plot(link, "jackknife").axes[0]
    points = axes.lines[0].get_xydata()
    assert len(points) == 8
    expected = link.errors.sel(error_kind="jackknife").values[:2]
    np.testing.assert_allclose(points.std(axis=0), expected, rtol=1e-9)
    ellipse = axes.patches[0]  # of the first kind: 68.3 % of a normal law in two dimensions
    covariance = link.covariance.values[:2, :2]
    sizes = np.sort([ellipse.width, ellipse.height]) / 2.0
    np.testing.assert_allclose(sizes**2, np.linalg.eigvalsh(covariance) * -2.0 * np.log(1.0 - 0.683), rtol=1e-9)


def test_the_solution_is_drawn_with_every_kind_of_error(link):
    axes = linksweep.plot(link).axes[0]
    assert [text.get_text() for text in linksweep.plot(link).legends[0].get_texts()] == list(link.error_kind.values)
    drawn = axes.containers[1].lines[0].get_ydata()
    np.testing.assert_allclose(drawn, link.estimate.values)


def test_the_trajectory_marks_the_step_that_was_chosen(link):
    figure = linksweep.plot(link, "trajectory")
    upper, lower = figure.axes
    np.testing.assert_allclose(upper.lines[0].get_ydata(), link.step_estimate.values[:, 0])
    assert upper.lines[-1].get_xdata()[0] == int(link.step_chosen) == 1
    assert [text.get_text() for text in lower.get_xticklabels()][1:] == list(link.step_dropped.values[1:])


@pytest.mark.slow
def test_weights_show_the_dropped_source_apart(link):
    figure = linksweep.plot(link, "weight")
    kept, dropped = (np.asarray(c.get_offsets()) for c in figure.axes[0].collections[:2])
    assert len(kept) == 8
    assert len(dropped) == 1
    ratio = link.discrepancy.values / link.n_observations.values
    np.testing.assert_allclose(dropped[0, 1], ratio[link.weight_factor.values == 0.0])
    np.testing.assert_allclose(np.sort(kept[:, 0]), np.sort(link.share.values[link.weight_factor.values > 0.0, 0]))


def test_arrows_point_as_the_sky_does(link):
    """East is to the left and north up at the middle of the map; on the left edge a meridian leans inwards."""
    axes = linksweep.plot(link, "residuals").axes[0]
    at = np.zeros(2)
    angles = _angles(axes, at, at, np.array([1.0, 0.0]), np.array([0.0, 1.0])) % 360.0
    np.testing.assert_allclose(angles, [180.0, 90.0], atol=0.1)
    leaning = _angles(axes, np.array([-2.5]), np.array([0.8]), np.zeros(1), np.ones(1))[0]
    assert 0.0 < leaning < 80.0


def test_cells_have_weighted_means():
    rng = np.random.default_rng(1)
    n = 3000
    ra, dec = rng.uniform(0.0, 360.0, n), np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, n)))
    values, errors = rng.normal(size=(n, 2)), rng.uniform(0.5, 2.0, (n, 2))
    found = _averaged(ra, dec, values, errors)
    assert len(found.ra) == 2 * BANDS**2
    k = 40
    step = 180.0 / BANDS
    inside = (np.abs(ra - found.ra[k]) < step / 2) & (
        np.abs(np.sin(np.radians(dec)) - np.sin(np.radians(found.dec[k]))) < 1.0 / BANDS
    )
    assert found.east[k] == pytest.approx(np.average(values[inside, 0], weights=errors[inside, 0] ** -2))
    assert found.north[k] == pytest.approx(np.average(values[inside, 1], weights=errors[inside, 1] ** -2))


def test_a_forecast_has_its_epochs_and_ranking(plan):
    figures = link_figures(plan)
    assert list(figures) == ["epochs", "ranking"]
    right = figures["epochs"].axes[1]
    np.testing.assert_allclose(right.lines[0].get_ydata(), 1000.0 * plan.error_with_epoch.values[:, 3])
    assert "µas/yr" in right.get_ylabel()
    bars = [bar.get_width() for bar in figures["ranking"].axes[0].patches]
    now = float(plan.criterion.sel(stage="now"))
    np.testing.assert_allclose(bars[-1], 100.0 * (1.0 - plan.criterion_alone.values.min() / now))
    with pytest.raises(SweepError, match="--add"):
        draw_link(linksweep.forecast("psrpi", "psrpi", "orientation"))


def test_units_and_symbols_can_be_read():
    assert readable(np.array([0.01, np.nan, -0.2]), "mas/yr") == (1000.0, "µas/yr")
    assert readable(np.array([0.01, 3.0]), "mas") == (1.0, "mas")
    assert readable(np.array([0.0, np.nan]), "mas") == (1.0, "mas")
    assert unknown_symbol("epsilon_x") == r"$\epsilon_x$"
    assert unknown_symbol("position_glide_z") == "$G_z$"
    assert unknown_symbol("omega_y[6,8)") == r"$\omega_y$[6,8)"
    assert unknown_symbol("vsh_motion_t_2_1_im") == r"$t_{2,1}^\mathrm{Im}$"
    assert unknown_symbol("vsh_position_s_12_0") == "$s_{12,0}$"
