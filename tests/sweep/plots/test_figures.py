"""Pictures of small real stores: what stands on their axes, and what is refused."""

import re

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from astropy import units
from astropy.coordinates import SkyCoord
from click.testing import CliRunner
from matplotlib.container import ErrorbarContainer
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.text import Text

from linksweep.sweep.analysis.laws import fit_power_law
from linksweep.sweep.analysis.quantity import standard_error
from linksweep.sweep.analysis.selection import select
from linksweep.sweep.cli import main
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.plots import scales, style
from linksweep.sweep.plots.caption import caption, description
from linksweep.sweep.plots.figure import draw_figure, possible_kinds
from linksweep.sweep.plots.labels import explained_label, symbol
from linksweep.sweep.plots.layout import arrange
from linksweep.sweep.plots.lines import draw_lines
from linksweep.sweep.plots.maps import add_bar, colour_limits, draw_map
from linksweep.sweep.plots.scatter import draw_scatter
from linksweep.sweep.plots.sky import add_sky, draw_sky
from linksweep.sweep.plots.standalone import accuracy_figure, draw_scaling, sky_figure
from linksweep.sweep.plots.views import accuracy_curves, catalogue_of_point, catalogue_of_table, models_of
from linksweep.sweep.running.run import run_study
from linksweep.sweep.studies.reader import load_study, study_from_dict
from tests.tiers import slow


@pytest.fixture(autouse=True)
def _style():
    with style.settings():
        yield


def axes_of(figure):
    """The panels of a figure, without colour bars."""
    return [axes for axes in figure.axes if axes.get_label() != "<colorbar>"]


def texts(legend):
    return [text.get_text() for text in legend.get_texts()]


def title(figure):
    return figure.get_suptitle()


# Which picture suits


@pytest.mark.parametrize(
    ("name", "panels", "along"),
    [
        ("quasars", 2, r"$V_\mathrm{max}$ [mag]"),
        pytest.param("sqrt-n", 2, r"$N_\mathrm{obj}$", marks=pytest.mark.slow),
        pytest.param("mission-length", 2, "$T$ [yr]", marks=pytest.mark.slow),
        slow("error-surface", 1, r"reference error scale $\Delta_\mathrm{ref}$"),
        slow("algorithm", 6, r"$|\epsilon|$ [mas] = $|\omega|$ [mas/yr]"),
        pytest.param("grid", 4, r"$N_\mathrm{obj}$", marks=pytest.mark.slow),
        pytest.param("aberration", 4, r"$V_\mathrm{max}$ [mag]", marks=pytest.mark.slow),
        pytest.param("radio-stars", 1, r"$N_\mathrm{obj}$", marks=pytest.mark.slow),
        slow("galaxies", 1, r"$\sigma(\omega)$ [mas/yr]"),
        slow("scatter", 1, r"$\omega_{x}$ [mas/yr]"),
    ],
)
def test_every_study_has_a_picture_without_options(dataset_of, tmp_path, name, panels, along):
    dataset = dataset_of(name)
    figure = draw_figure(dataset)
    assert len(axes_of(figure)) == panels
    assert axes_of(figure)[-1].get_xlabel() == along
    assert title(figure).startswith(dataset.attrs["title"])
    style.save(figure, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_missions_that_differ_by_orders_have_panels_of_their_own(dataset_of):
    amex, gaia = axes_of(draw_figure(dataset_of("quasars")))
    assert (amex.get_title(), gaia.get_title()) == ("amex", "gaia")
    assert amex.get_ylim() != gaia.get_ylim()
    assert amex.get_ylabel() == r"$\sigma(\omega)$ [mas/yr]"
    assert gaia.get_ylabel() == r"$\sigma(\omega)$ [µas/yr]"


@pytest.mark.slow
def test_layouts(dataset_of):
    layout = arrange(dataset_of("mission-length"), "sigma_spin", ("mission_length",))
    assert (layout.series, layout.columns, layout.rows, layout.far) == (("n_obj",), "model", None, True)
    layout = arrange(dataset_of("radio-stars"), "sigma_spin", ("n_obj",))
    assert (layout.series, layout.columns) == (("reference_error_scale",), None)
    with pytest.raises(SweepError, match=r"\(6\).*are too many for one picture.*fix some with --at"):
        arrange(dataset_of("aberration"), "sigma", ("v_max",))
    with pytest.raises(SweepError, match="3 dimensions are left for panels"):
        arrange(dataset_of("aberration"), "sigma_spin", ("v_max", "sky_contrast"), series=False)


def test_incomplete_stores_say_so_in_the_title(dataset_of):
    dataset = dataset_of("sqrt-n")
    dataset["status"][2] = Status.MISSING
    dataset["sigma_spin"][2] = np.nan
    assert "INCOMPLETE: 1 of 7 points are not done" in title(draw_figure(dataset, "lines"))


def test_a_series_keeps_its_colour_where_another_has_no_values(dataset_of):
    dataset = dataset_of("mission-length")
    gone = (dataset["n_obj"] == dataset["n_obj"][0]) & (dataset["model"] == dataset["model"][1])
    figure = draw_figure(dataset.assign(sigma_spin=dataset["sigma_spin"].where(~gone)), "lines")
    colours = []
    for axes in axes_of(figure):
        series = zip(*axes.get_legend_handles_labels(), strict=True)
        colours.append({text: one[0].get_color() for one, text in series if isinstance(one, ErrorbarContainer)})
    whole, part = (set(panel.items()) for panel in colours)
    assert len(whole - part) == 1
    assert part < whole


@pytest.mark.slow
def test_what_is_chosen_stands_in_the_title(dataset_of):
    figure = draw_figure(select(dataset_of("grid"), {"model": "gaia", "error_scale": "2"}))
    assert title(figure).splitlines()[1] == "gaia, error scale = 2"


# Lines


def test_lines_have_points_with_errors_prediction_and_published_values(dataset_of):
    one = dataset_of("quasars").sel(model="gaia")
    axes = draw_lines(Figure().add_subplot(), one, "sigma_spin", "v_max")
    points, published = axes.containers
    assert points.lines[0].get_ydata() == pytest.approx(one["sigma_spin"].values)
    (bars,) = points.lines[2]
    half = [(segment[1, 1] - segment[0, 1]) / 2.0 for segment in bars.get_segments()]
    assert half == pytest.approx(standard_error(one, "sigma_spin").values, rel=1e-6)
    assert published.lines[0].get_ydata() == pytest.approx(one["sigma_spin_published"].values)
    drawn = [line.get_ydata() for line in axes.lines if len(line.get_ydata()) == one.sizes["v_max"]]
    assert any(np.array_equal(ydata, one["sigma_spin_rms_predicted"].values) for ydata in drawn)
    assert texts(axes.get_legend()) == ["simulated", "predicted", "published"]
    assert len(axes.collections) >= 2  # a band, and the error bars


@pytest.mark.slow
def test_series_have_names_with_symbol_value_and_unit(dataset_of):
    axes = axes_of(draw_figure(dataset_of("radio-stars")))[0]
    assert texts(axes.get_legend()) == [
        r"$\Delta_\mathrm{ref}$ = 1",
        r"$\Delta_\mathrm{ref}$ = 0.5",
        "predicted",
        "published",
    ]
    assert axes.get_xscale() == axes.get_yscale() == "log"
    figure = draw_figure(dataset_of("aberration"))
    (legend,) = figure.legends
    assert texts(legend)[0] == "aberration = False, solve glide = False"
    assert len(texts(legend)) >= 4  # three that are not excluded, and the prediction


def test_components_have_their_own_symbol_and_unit(dataset_of):
    one = dataset_of("sqrt-n").sel(component="omega_x")
    axes = draw_lines(Figure().add_subplot(), one, "sigma", "n_obj")
    assert axes.get_ylabel() == r"$\sigma$($\omega_{x}$) [mas/yr]"


def test_a_component_keeps_its_symbol_where_a_panel_has_a_unit_of_its_own(dataset_of):
    one = select(dataset_of("quasars"), {"component": "omega_x"})
    labels = [axes.get_ylabel() for axes in axes_of(draw_figure(one, variables=["sigma"]))]
    assert labels == [r"$\sigma$($\omega_{x}$) [mas/yr]", r"$\sigma$($\omega_{x}$) [µas/yr]"]


def test_components_in_different_units_are_refused(dataset_of):
    with pytest.raises(
        SweepError, match="sigma has components in mas and mas / yr; choose one with --at component=epsilon_x"
    ):
        draw_figure(dataset_of("sqrt-n"), variables=["sigma"])


@pytest.mark.slow
def test_several_variables_are_columns(dataset_of):
    dataset = dataset_of("algorithm").sel(n_obj=50, mean_pm=500.0)
    figure = draw_figure(dataset, variables=["sigma_spin", "sigma_orientation"])
    assert len(axes_of(figure)) == 4
    assert [axes.get_ylabel() for axes in axes_of(figure)[:2]] == [
        r"$\sigma(\omega)$ [µas/yr]",
        r"$\sigma(\epsilon)$ [µas]",
    ]


# Laws


def test_a_law_is_drawn_as_fitted_with_its_guide(dataset_of):
    dataset = dataset_of("sqrt-n")
    upper, lower = axes_of(draw_figure(dataset))
    result = fit_power_law(dataset, "sigma_spin", "n_obj")
    fit, guide = (line for line in upper.lines if len(line.get_xdata()) == 100)
    slope = np.polyfit(np.log(fit.get_xdata()), np.log(fit.get_ydata()), 1)[0]
    assert slope == pytest.approx(result["exponent"].item(), abs=1e-9)
    slope = np.polyfit(np.log(guide.get_xdata()), np.log(guide.get_ydata()), 1)[0]
    assert slope == pytest.approx(-0.5, abs=1e-9)
    assert texts(upper.get_legend())[0] == "simulated"
    assert r"$N_\mathrm{obj}^{-0.5}$" in texts(upper.get_legend())[2]
    residuals = lower.containers[0].lines[0].get_ydata()
    assert np.abs(residuals).max() < 20.0  # percent
    assert lower.get_ylabel() == "residual [%]"


@pytest.mark.slow
def test_a_law_of_several_lines_needs_one_dimension(dataset_of):
    assert len(axes_of(draw_figure(dataset_of("radio-stars"), "law"))) == 2
    with pytest.raises(SweepError, match="a law is drawn for one further dimension at most"):
        draw_figure(dataset_of("grid"), "law", over=["n_obj"])


# Maps


def test_a_map_shows_the_values_in_their_places(dataset_of):
    dataset = dataset_of("error-surface")
    figure = Figure()
    scales = ("reference_error_scale", "satellite_error_scale")
    axes = draw_map(figure.add_subplot(), dataset, "sigma_spin", *scales, colour_limits(dataset, "sigma_spin"))
    add_bar(figure, dataset, "sigma_spin")
    mesh = axes.collections[0]
    wanted = dataset["sigma_spin"].transpose("satellite_error_scale", "reference_error_scale").values
    assert np.asarray(mesh.get_array()).reshape(wanted.shape) == pytest.approx(wanted)
    assert axes.get_xlabel() == r"reference error scale $\Delta_\mathrm{ref}$"
    assert axes.get_ylabel() == r"satellite error scale $\Delta_\mathrm{sat}$"
    assert axes.get_xlim() == pytest.approx((-0.5, 4.5))
    assert figure.axes[1].get_ylabel() == r"$\sigma(\omega)$ [mas/yr]"


def test_two_axes_of_any_study_make_maps(dataset_of):
    figure = draw_figure(dataset_of("grid").sel(model="gaia"), over=["n_obj", "error_scale"])
    assert [axes.get_title() for axes in axes_of(figure)] == [
        r"$V_\mathrm{max}$ = 16 mag",
        r"$V_\mathrm{max}$ = 17 mag",
    ]
    assert axes_of(figure)[0].get_xscale() == "log"


@pytest.mark.parametrize(
    ("places", "logarithm"), [([1.0, 2.0, 4.0], False), ([1.0, 10.0, 100.0], True), ([3.0], False)]
)
def test_cells_surround_their_places(places, logarithm):
    borders = scales.edges(np.array(places), logarithm)
    assert len(borders) == len(places) + 1
    assert np.all(borders[:-1] < places)
    assert np.all(borders[1:] > places)
    if logarithm:
        assert borders == pytest.approx(10.0 ** np.array([-0.5, 0.5, 1.5, 2.5]))


# Scatter


@pytest.mark.slow
def test_a_scatter_has_all_estimates_ellipses_and_truth(dataset_of):
    dataset = dataset_of("scatter").squeeze("model")
    axes = draw_scatter(Figure().add_subplot(), dataset, "estimate", ("omega_x", "omega_y"))
    x, y = (dataset["estimate"].sel(component=name).values for name in ("omega_x", "omega_y"))
    assert np.array_equal(axes.lines[0].get_xdata(), x)
    assert np.array_equal(axes.lines[0].get_ydata(), y)
    truth = next(line for line in axes.lines if line.get_label() == "truth")
    assert (truth.get_xdata()[0], truth.get_ydata()[0]) == pytest.approx((1.0, 1.0), abs=1e-9)  # of the study
    inverse = np.linalg.inv(np.cov(x, y))
    offset = np.stack([x - x.mean(), y - y.mean()])
    distance = np.einsum("in,ij,jn->n", offset, inverse, offset)
    for ellipse, share in zip(axes.patches, (0.683, 0.954), strict=True):
        inside = ellipse.contains_points(axes.transData.transform(np.stack([x, y], axis=1)))
        assert inside.mean() == pytest.approx(share, abs=4.0 * np.sqrt(share * (1 - share) / len(x)))
        assert inside.sum() == pytest.approx((distance < -2.0 * np.log(1.0 - share)).sum(), abs=5)
    assert axes.get_aspect() == 1.0


def test_a_scatter_of_chosen_components(dataset_of):
    axes = axes_of(draw_figure(dataset_of("scatter"), over=["epsilon_x", "omega_z"]))[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == (r"$\epsilon_{x}$ [mas]", r"$\omega_{z}$ [mas/yr]")
    assert axes.get_aspect() == "auto"
    with pytest.raises(SweepError, match="'omega' is no component of estimate"):
        draw_figure(dataset_of("scatter"), over=["omega", "omega_x"])
    with pytest.raises(SweepError, match="a scatter is of kept samples, not of a variable"):
        draw_figure(dataset_of("scatter"), "scatter", variables=["sigma_spin"])
    with pytest.raises(SweepError, match="a scatter needs two components"):
        draw_figure(dataset_of("scatter"), over=["omega_x"])


def test_kept_samples_of_several_points_do_not_hide_the_results(dataset_of):
    one = dataset_of("scatter")
    two = xr.concat([one.assign_coords(model=[name]) for name in ("amex", "gaia")], "model", data_vars="minimal")
    assert axes_of(draw_figure(two))[0].get_xlabel() == "model"
    with pytest.raises(SweepError, match=r"a scatter is of one point; choose it with --at AXIS=VALUE: model \(2\)"):
        draw_figure(two, "scatter")


# Scaling


def scaling_dataset():
    workers = np.array([1, 2, 4, 8])
    efficiency = np.array([[1.0, 0.95, 0.9, 0.7], [1.0, 0.98, 0.96, 0.92]])
    variables = {
        "efficiency": (("kind", "workers"), efficiency),
        "efficiency_error": (("kind", "workers"), 0.02 * efficiency),
        "seconds": (("kind", "workers"), np.array([8.0 / workers / efficiency[0], 8.0 / efficiency[1]])),
    }
    return xr.Dataset(variables, {"kind": ["strong", "weak"], "workers": workers}, {"title": "Scaling"})


def test_scaling_is_drawn_beside_the_ideal():
    left, right = axes_of(draw_figure(scaling_dataset()))
    for axes, ideal in ((left, [1, 2, 4, 8]), (right, [1, 1, 1, 1])):
        assert axes.lines[0].get_ydata().tolist() == ideal
        assert texts(axes.get_legend()) == ["strong scaling", "weak scaling", "ideal"]
        assert axes.get_xlabel() == "workers"
    assert left.containers[0].lines[0].get_ydata() == pytest.approx([1.0, 1.9, 3.6, 5.6])
    assert right.containers[1].lines[0].get_ydata() == pytest.approx([1.0, 0.98, 0.96, 0.92])
    assert possible_kinds(scaling_dataset(), "efficiency") == ["scaling"]
    with pytest.raises(SweepError, match="no map of this; possible is scaling"):
        draw_figure(scaling_dataset(), "map")
    for name in ("speed-up", "efficiency"):
        with pytest.raises(SweepError, match="scaling needs the dimensions kind and workers"):
            draw_scaling(Figure().add_subplot(), scaling_dataset().drop_vars("seconds"), name)


# Sky


def test_right_ascension_grows_to_the_left():
    dataset = xr.Dataset({"ra": ("object", [170.0, 180.0, 190.0]), "dec": ("object", [0.0, 10.0, -20.0])})
    axes = draw_sky(add_sky(Figure()), dataset)
    x, y = np.asarray(axes.collections[0].get_offsets()).T
    assert x == pytest.approx(np.deg2rad([10.0, 0.0, -10.0]))
    assert y == pytest.approx(np.deg2rad([0.0, 10.0, -20.0]))
    labels = [text for text in axes.texts if text.get_text().endswith("°")]
    assert [text.get_text() for text in labels] == ["300°", "240°", "180°", "120°", "60°"]
    assert min(text.get_zorder() for text in labels) > axes.collections[0].get_zorder()  # not under the dots


def test_the_galactic_plane_is_that_of_astropy():
    axes = draw_sky(add_sky(Figure()), xr.Dataset({"ra": ("object", [0.0]), "dec": ("object", [0.0])}))
    plane, centre = (
        next(line for line in axes.lines if line.get_label() == f"Galactic {n}") for n in ("plane", "centre")
    )
    x, y = plane.get_xdata(), plane.get_ydata()
    drawn = np.isfinite(y)
    assert drawn.sum() >= len(y) - 2
    sky = SkyCoord(ra=(180.0 - np.rad2deg(x[drawn])) * units.deg, dec=np.rad2deg(y[drawn]) * units.deg)
    assert np.abs(sky.galactic.b.arcsec).max() < 0.1
    middle = SkyCoord(l=0.0 * units.deg, b=0.0 * units.deg, frame="galactic").icrs
    assert np.rad2deg(centre.get_ydata()[0]) == pytest.approx(middle.dec.deg, abs=1e-4)
    assert 180.0 - np.rad2deg(centre.get_xdata()[0]) == pytest.approx(middle.ra.deg, abs=1e-4)


def test_the_sky_of_a_point_is_its_catalogue(store_of):
    dataset = catalogue_of_point(store_of("quasars"), ["model=gaia", "v_max=15"])
    assert dataset.sizes["object"] == 88
    assert dataset["v_mag"].max() <= 15.0
    figure = sky_figure(dataset)
    assert "the 88 objects of one catalogue, model=gaia, v_max=15" in title(figure)
    assert figure.axes[1].get_xlabel() == "$V$ [mag]"
    again = catalogue_of_point(store_of("quasars"), ["model=gaia,v_max=15"])
    assert np.array_equal(again["ra"], dataset["ra"])


def test_the_sky_of_a_table(tmp_path):
    (tmp_path / "table.csv").write_text("ra,dec\n10.0,20.0\n200.0,-40.0\n")
    dataset = catalogue_of_table(tmp_path / "table.csv")
    assert dataset["ra"].values.tolist() == [10.0, 200.0]
    (tmp_path / "table.csv").write_text("ra,dec\n10.0,91.0\n")
    with pytest.raises(SweepError, match="column 'dec' has 91, beyond 90 deg"):
        catalogue_of_table(tmp_path / "table.csv")


# Accuracy


@pytest.mark.slow
def test_accuracy_curves_are_those_of_the_missions():
    dataset = accuracy_curves(["amex", "gaia-2001"])
    assert dataset["sigma_pm"].sel(model="amex", v=9.0).item() == pytest.approx(0.181, abs=0.001)  # docs/science.md
    assert dataset["sigma_pm"].sel(model="gaia-2001", v=15.0).item() == pytest.approx(0.008)  # ESA's table
    relative = (dataset["sigma_pm_error"] / dataset["sigma_pm"]).sel(model="amex")
    assert 0.0 < relative.min() < 0.1  # docs/calibration.md: some percent where the numbers are
    assert np.isnan(dataset["sigma_pm_error"].sel(model="gaia-2001")).all()
    left, right = axes_of(accuracy_figure(dataset))
    assert (left.get_ylabel(), right.get_ylabel()) == (r"$\sigma_\mu$ [mas/yr]", r"$\sigma_\mathrm{pos}$ [mas]")
    assert left.get_yscale() == "log"
    assert texts(left.get_legend()) == ["amex", "gaia-2001"]
    assert len(left.collections) == 1  # the band of the calibrated one
    with pytest.raises(SweepError, match="no model 'amax'; did you mean 'amex'"):
        accuracy_curves(["amax"])


MISSION = """
title = "A mission of our own"
[axes]
model = ["gaia-2001", "mine", "broken"]
v_max = [16.0]
[define.model.mine]
nominal_length = 4.0
sigma_pm = [[9.0, 0.1], [17.0, 3.2]]
position_ratio = 0.5
[define.model.broken]
nominal_length = 4.0
sigma_pm = "curves.py:broken"
position_ratio = 0.5
[fixed]
n_obj = 20
"""


@pytest.mark.slow
def test_missions_of_a_study_are_drawn_beside_the_built_in_ones(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "curves.py").write_text("def broken(v):\n    return v - 12.0\n")
    (tmp_path / "mine.toml").write_text(MISSION)
    study = load_study("mine.toml")
    dataset = accuracy_curves(models_of(study, ["mine", "gaia-2001"]))
    assert dataset["model"].values.tolist() == ["gaia-2001", "mine"]
    np.testing.assert_allclose(dataset["sigma_pm"].sel(model="mine", v=[9.0, 13.0]), [0.1, 0.32**0.5], rtol=1e-12)
    np.testing.assert_allclose(dataset["sigma_pos"].sel(model="mine", v=[9.0]), [0.05], rtol=1e-12)
    assert np.isnan(dataset["sigma_pm"].sel(model="mine", v=17.1))
    with pytest.raises(SweepError, match="'gaia' is no mission of this study"):
        models_of(study, ["gaia"])
    done = invoke("mine.toml", "--kind", "accuracy", "-o", "a.png")
    assert (done.exit_code, "the function 'broken' returns -3 at V = 9 mag" in done.stderr) == (2, True)
    assert invoke("mine.toml", "--kind", "accuracy", "--model", "mine", "-o", "a.png").exit_code == 0
    named = MISSION[MISSION.index("[define.model.broken]") : MISSION.index("[fixed]")]
    (tmp_path / "mine.toml").write_text(MISSION.replace(', "broken"', "").replace(named, ""))
    run_study(load_study("mine.toml"), "mine.zarr", Resources(pool="serial"))
    assert invoke("mine.zarr", "--kind", "accuracy", "-o", "b.png").exit_code == 0
    assert (tmp_path / "b.png").stat().st_size > 10_000


# Style


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("omega_x", r"$\omega_{x}$"),
        ("sigma_spin", r"$\sigma_{\mathrm{spin}}$"),
        ("chi2", r"$\chi^2$"),
        ("x1", "$x_{1}$"),
        ("x12", r"$x_{\mathrm{12}}$"),
        ("beta2_left", r"$\beta_{\mathrm{2,left}}$"),
        ("n_obj", r"$n_{\mathrm{obj}}$"),
        ("share", "share"),
        ("mean_pm", "mean pm"),
        ("gaia-dr3", "gaia-dr3"),
    ],
)
def test_symbols(name, shown):
    assert symbol(name) == shown


@pytest.mark.parametrize(
    ("name", "attributes", "shown"),
    [
        ("n", {}, "$n$"),
        ("theta", {"units": "deg"}, r"$\theta$ [deg]"),
        ("mission_length", {"symbol": "$T$", "units": "yr"}, "mission length $T$ [yr]"),
        ("share", {"symbol": "share"}, "share"),
        ("n_obj", {"symbol": r"$N_\mathrm{obj}$"}, r"$N_\mathrm{obj}$"),
    ],
)
def test_only_a_symbol_of_its_own_is_explained(name, attributes, shown):
    assert explained_label(xr.DataArray([1.0, 2.0], dims=name, name=name, attrs=attributes), name) == shown


def test_a_map_over_whole_numbers_has_ticks_at_them():
    values = xr.Dataset(
        {"end": (("n", "rate"), np.arange(6.0).reshape(3, 2))}, coords={"n": [3, 4, 5], "rate": [0.1, 0.2]}
    )
    axes = draw_map(Figure().add_subplot(), values, "end", "rate", "n", colour_limits(values, "end"))
    assert all(tick == round(tick) for tick in axes.get_yticks())
    assert not all(tick == round(tick) for tick in axes.get_xticks())


def test_contours_of_negative_numbers_are_solid_and_have_plain_numbers():
    numbers = np.linspace(-4000.0, 4000.0, 25).reshape(5, 5)
    values = xr.Dataset({"z": (("x", "y"), numbers)}, coords={"x": np.arange(5.0), "y": np.arange(5.0)})
    axes = draw_map(Figure().add_subplot(), values, "z", "x", "y", colour_limits(values, "z"))
    lines = next(one for one in axes.collections if isinstance(one, ContourSet))
    assert min(lines.levels) < 0.0
    assert {style for _, style in lines.get_linestyle()} == {None}
    assert "-2000" in [text.get_text() for text in lines.labelTexts]


def test_a_map_of_truth_values_has_no_contours():
    coords = {"x": np.arange(5.0), "y": np.arange(5.0)}
    values = xr.Dataset({"z": (("x", "y"), np.tri(5, dtype=bool))}, coords=coords)
    figure = Figure()
    axes = draw_map(figure.add_subplot(), values, "z", "x", "y", colour_limits(values, "z"))
    add_bar(figure, values, "z")
    assert not any(isinstance(one, ContourSet) for one in axes.collections)
    assert [text.get_text() for text in figure.axes[1].get_yticklabels()] == ["False", "True"]


def test_ticks_below_two_decades_all_have_numbers():
    axes = Figure().add_subplot()
    axes.plot([1, 2], [1.4e-5, 9e-5])
    scales.logarithmic(axes, "y", [1.4e-5, 9e-5])
    labels = [axes.yaxis.get_major_formatter()(tick, 0) for tick in (1e-5, 2e-5, 5e-5)]
    assert labels == ["$10^{-5}$", r"$2\times10^{-5}$", r"$5\times10^{-5}$"]
    assert axes.yaxis.get_major_formatter()(0.005, 0) == "0.005"


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["svg", slow("pdf"), slow("png")])
def test_the_same_picture_is_the_same_file(dataset_of, tmp_path, ending):
    for name in ("a", "b"):
        style.save(draw_figure(dataset_of("sqrt-n")), tmp_path / f"{name}.{ending}")
    assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()


# The command


def invoke(*arguments):
    done = CliRunner().invoke(main, ["plot", *map(str, arguments)])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done


@pytest.fixture
def coin_store(coins, tmp_path):
    run_study(study_from_dict(coins), tmp_path / "coins.zarr", Resources(pool="serial"))
    return tmp_path / "coins.zarr"


@pytest.mark.parametrize(
    "arguments",
    [
        ["STORE"],
        slow(["STORE", "--kind", "law"]),
        slow(["STORE", "--over", "metal"]),
        slow(["STORE", "--at", "metal=tin"]),
        ["STORE", "--at", "metal=tin,coins=5"],
    ],
)
def test_any_experiment_can_be_drawn(coin_store, tmp_path, arguments):
    done = invoke(*(coin_store if a == "STORE" else a for a in arguments), "-o", tmp_path / "coins.svg")
    if arguments[-1].endswith("=5"):
        assert (done.exit_code, "possible are none" in done.stderr) == (2, True)
    else:
        assert done.exit_code == 0, done.stderr
        assert (tmp_path / "coins.svg").read_text().startswith("<?xml")


@pytest.mark.slow
def test_plot_without_options_draws_what_suits(store_of, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert invoke(store_of("error-surface")).exit_code == 0
    assert (tmp_path / "error-surface.png").stat().st_size > 10_000
    assert invoke(store_of("quasars"), "--kind", "sky", "--at", "model=gaia,v_max=16").exit_code == 0
    assert invoke("--kind", "accuracy", "--model", "gaia-2001", "-o", "a.pdf").exit_code == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["STORE", "--kind", "map"], "no map of share here; possible are lines, law"),
        (["STORE", "--kind", "scatter"], "no scatter of share here; possible are lines, law"),
        (["STORE", "--kind", "scaling"], "no scaling of share here; possible are lines, law"),
        (["STORE", "--variable", "heads"], "no quantity 'heads'; known are share"),
        (["STORE", "--over", "length"], "length is not one axis to draw along; there are"),
        (["STORE", "--over", "metal", "--over", "coins"], "no map of share here"),
        (["STORE", "--kind", "law", "--over", "metal"], "'metal' is no axis with several numbers of share"),
        (["STORE", "--at", "metal=lead"], "metal = lead is not in the grid, which has gold, tin"),
        (["STORE", "-o", "coins.bmp"], "coins.bmp: cannot draw there: the name must end with .png, .svg, .pdf"),
        (["STORE", "-o", "nowhere/coins.png"], "cannot draw there: No such file or directory"),
        (["STORE", "--kind", "sky"], "only stores of the link alone can be drawn so"),
        (["STORE", "--kind", "accuracy"], "only stores of the link alone can be drawn so"),
        (["STORE", "--model", "gaia"], "--model goes with --kind accuracy"),
        (["STORE", "--kind", "sky", "--over", "coins"], "--variable and --over do not go with --kind sky"),
        ([], "name the store to draw"),
        (["nothing.zarr"], "no store there"),
        (["--kind", "accuracy", "--model", "hipparcos"], "no model 'hipparcos'"),
        (["none.toml", "--kind", "accuracy"], "no study 'none.toml'"),
    ],
)
def test_bad_combinations_are_one_message(coin_store, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    done = invoke(*(coin_store if a == "STORE" else a for a in arguments))
    assert done.exit_code == 2
    assert message in done.stderr
    assert list(tmp_path.glob("*.png")) == []


# Sizes


def letters(figure):
    """The sizes of all texts that are shown, in points."""
    figure.canvas.draw()
    return [text.get_fontsize() for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()]


@pytest.mark.slow
@pytest.mark.parametrize("width", [88.0, 180.0])
@pytest.mark.parametrize(
    "name", ["quasars", *map(slow, ["algorithm", "sqrt-n", "error-surface", "scatter", "galaxies"])]
)
def test_letters_have_their_size_at_the_width_of_print(dataset_of, name, width):
    with style.settings(width):
        figure = draw_figure(dataset_of(name))
        assert figure.get_figwidth() == pytest.approx(width / 25.4)
        assert min(letters(figure)) >= 6.0


@pytest.mark.slow
def test_a_talk_has_large_letters_and_the_users_own_settings_stay(dataset_of):
    dataset = dataset_of("sqrt-n")
    with style.settings(style="talk"):
        assert min(letters(draw_figure(dataset))) >= 11.0
    with mpl.rc_context({"axes.labelsize": 13.0}), style.settings(88.0):
        assert draw_figure(dataset).axes[0].yaxis.label.get_fontsize() == 13.0


def test_one_point_shows_what_is_simulated_predicted_and_published(dataset_of):
    (axes,) = axes_of(draw_figure(dataset_of("galaxies")))
    assert [text.get_text() for text in axes.get_yticklabels()] == ["simulated", "predicted", "published"]
    assert any("0.16 mas/yr" in text.get_text() for text in axes.texts)


@pytest.mark.slow
def test_panels_without_points_are_left_out(dataset_of):
    dataset = dataset_of("algorithm")
    whole = len(axes_of(draw_figure(dataset)))
    seen = (dataset["mean_pm"] != 50.0) | (dataset["n_obj"] != 50)
    gone = dataset.assign(sigma_spin=dataset["sigma_spin"].where(seen))
    assert (whole, len(axes_of(draw_figure(gone)))) == (6, 5)


@pytest.mark.slow
def test_axes_that_walk_together_are_both_named(dataset_of):
    label = axes_of(draw_figure(dataset_of("algorithm")))[-1].get_xlabel()
    assert label == r"$|\epsilon|$ [mas] = $|\omega|$ [mas/yr]"


@pytest.mark.slow
def test_a_caption_says_what_is_drawn_and_what_follows(store_of, tmp_path, sweep):
    code, _, err = sweep("plot", store_of("sqrt-n"), "--width", "88mm", "--caption", "-o", tmp_path / "a.svg")
    assert code == 0, err
    words, alternative = (tmp_path / "a.txt").read_text().strip().split("\n\n")
    assert words.startswith(
        "The law 1/sqrt(N). Points are simulated, with one-sigma errors. "
        "Bands are the one-sigma errors of the fitted laws. The error falls as N"
    )
    assert alternative.startswith("Alternative text: 2 panels, sigma(omega) [µas/yr] against N_obj")


@pytest.mark.parametrize(
    ("name", "chosen", "signs"),
    [
        ("quasars", {"model": "gaia"}, "Dashes are predicted in closed form. Open symbols are published. "),
        ("galaxies", {}, "The prediction is in closed form. Open symbols are published. "),
    ],
)
def test_a_caption_explains_the_signs_that_are_there(dataset_of, name, chosen, signs):
    dataset = dataset_of(name).sel(chosen)
    text = caption(draw_figure(dataset), dataset)
    assert f"Points are simulated, with one-sigma errors. {signs}" in text
    assert ("Bands are the one-sigma errors of the predictions." in text) == (name == "quasars")


def test_a_caption_explains_points_and_bands_of_several_series(dataset_of):
    dataset = dataset_of("sqrt-n").drop_vars(["sigma_rms_predicted", "sigma_predicted"])
    part = dataset.sel(component=["omega_x", "omega_y", "omega_z"])
    text = caption(draw_figure(part, "lines", variables=["sigma"]), part)
    assert "Points are simulated, with one-sigma errors. Bands join the errors of the points." in text


def test_a_title_that_asks_ends_with_its_question_mark(dataset_of):
    dataset = dataset_of("sqrt-n").assign_attrs(title="How many quasars does GAIA need?")
    assert caption(draw_figure(dataset), dataset).startswith("How many quasars does GAIA need? Points are")


def test_a_description_gives_the_range_of_what_is_drawn(dataset_of):
    dataset = dataset_of("quasars")
    text = description(draw_figure(dataset, variables=["sigma_orientation"]), dataset)
    assert "sigma_orientation (RMS error of the orientation, over its three components): Over 26 points" in text
    assert "sigma_spin" not in text
    one = select(dataset, {"component": "omega_x"})
    text = description(draw_figure(one, variables=["sigma"]), one)
    assert re.search(r"sigma \(.*\): Over 26 points it goes from [\d.]+ ± [\d.]+ µas/yr, at", text)


def test_series_of_one_constant_are_moved_apart():
    values = xr.Dataset({"y": (("kind", "x"), np.ones((2, 3)))}, coords={"kind": ["one", "two"], "x": [1.0, 2.0, 3.0]})
    axes = draw_lines(Figure().add_subplot(), values, "y", "x")
    one, two = (container.lines[0].get_transform().transform((2.0, 1.0)) for container in axes.containers)
    assert one[0] < two[0]
    assert one[1] == two[1]


@pytest.mark.parametrize("width", ["wide", "2mm", "1e9", "nan"])
def test_a_width_must_be_one(store_of, tmp_path, sweep, width):
    code, _, err = sweep("plot", store_of("sqrt-n"), "--width", width, "-o", tmp_path / "a.svg")
    assert code == 2
    assert "must be from 40mm to 1000mm, like 88mm or 180mm" in err
    assert not list(tmp_path.glob("a.*"))
