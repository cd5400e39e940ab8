"""Figures of links and forecasts: what is drawn is what the dataset holds."""

from functools import cache, partial
from itertools import combinations

import numpy as np
import pytest
import xarray as xr
from astropy import units
from astropy.coordinates import SkyCoord
from matplotlib.quiver import Quiver, QuiverKey
from scipy import stats

import linksweep
from linksweep.sweep.plots import link as sky, style
from tests.sweep.plots.drawn import assert_shown


def test_a_figure_that_a_link_cannot_have_is_refused_with_what_it_needs():
    link = linksweep.tie("psrpi-de200", "timing-de200", "orientation")
    for kind, how in (("spectrum", "--degree"), ("bins", "--bins"), ("lines", "no kind 'lines' of a tie")):
        with pytest.raises(linksweep.SweepError, match=how):
            linksweep.plot(link, kind)
    with pytest.raises(linksweep.SweepError, match="no variables"):
        linksweep.plot(link, variables=["estimate"])


def arrows(axes):
    """The places (deg), relative lengths and directions (deg) on the paper of the arrows of a map."""
    axes.figure.draw_without_rendering()
    [drawn] = [one for one in axes.collections if isinstance(one, Quiver)]
    tips = [max(path.vertices, key=lambda place: np.hypot(*place)) for path in drawn.get_paths()]
    angles = np.degrees([np.arctan2(y, x) for x, y in tips])
    return 180.0 - np.degrees(drawn.X), np.degrees(drawn.Y), np.hypot(drawn.U, drawn.V), angles


def residuals(ra, dec, values, errors):
    both = np.full((len(ra), 5), np.nan)
    both[:, :2] = values
    rows = {name: (("row", "observable"), factor * both) for name, factor in (("difference", 1.0), ("residual", 0.5))}
    rows["difference_error"] = ("row", "observable"), np.concatenate([errors, np.ones((len(ra), 3))], axis=1)
    rows |= {"row_source_index": ("row", np.arange(len(ra))), "weight_factor": ("source", np.ones(len(ra)))}
    rows |= {"ra": ("source", ra), "dec": ("source", dec), "observable_unit": ("observable", ["mas"] * 5)}
    return xr.Dataset(rows, attrs={"result": "tie", "satellite": "a", "reference": "b"})


def test_arrows_point_as_the_sky_does():
    ra, dec = np.array([180.0, 180.0, 320.0, 359.0, 20.0]), np.array([0.0, 0.0, 45.0, -20.0, 70.0])
    values = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0], [0.6, -0.8], [-1.0, 0.3]])
    axes, after = linksweep.plot(residuals(ra, dec, 0.01 * values, np.ones((5, 2))), "residuals").axes
    _, _, length, angle = arrows(axes)
    np.testing.assert_allclose(arrows(after)[2], 0.5 * length)  # on the same scale
    np.testing.assert_allclose(length / length[0], np.hypot(*values.T), rtol=1e-9)
    [key] = axes.findobj(QuiverKey)
    assert key.label == f"{10.0 * key.U / length[0]:g} µas"
    np.testing.assert_allclose(angle[:2] % 360.0, [180.0, 90.0], atol=0.1)
    assert 0.0 < angle[2] < 80.0  # on the left edge a meridian leans inwards
    (east, north), places = 1e-3 * values.T, np.radians([180.0 - ra, dec])
    steps = np.radians([-east / np.cos(np.radians(dec)), north])
    there = axes.transProjection.transform((places + steps).T) - axes.transProjection.transform(places.T)
    np.testing.assert_allclose(np.degrees(np.arctan2(there[:, 1], there[:, 0])) % 360.0, angle % 360.0, atol=1.0)


def test_many_arrows_are_weighted_means_of_cells_of_equal_area():
    rng, n, bands = np.random.default_rng(1), 3000, 9
    ra, dec = rng.uniform(0.0, 360.0, n), np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, n)))
    values, errors = rng.normal(size=(n, 2)), rng.uniform(0.5, 2.0, (n, 2))
    cell_ra, cell_dec, length, _ = arrows(linksweep.plot(residuals(ra, dec, values, errors), "residuals").axes[0])
    assert len(cell_ra) == 2 * bands**2
    means = []
    for a, d in zip(cell_ra, cell_dec, strict=True):
        inside = np.abs(ra - a) < 90.0 / bands
        inside &= np.abs(np.sin(np.radians(dec)) - np.sin(np.radians(d))) < 1.0 / bands
        means.append(np.average(values[inside], axis=0, weights=errors[inside] ** -2))
    expected = np.hypot(*np.transpose(means))
    whole = length < 0.999999 * length.max()  # the longest are cut
    np.testing.assert_allclose(length[whole] / length[0], expected[whole] / expected[0], rtol=1e-9)


@cache
def tie():
    options = {"clip": "discrepancy:2", "errors": "jackknife,scaled", "bins": ("parallax", [3.0])}
    return linksweep.tie("dr4-gaia", "dr4-vlbi", "orientation,spin", **options)


@cache
def forecast(criterion="A"):
    options = {"add": [2026.0, 2030.0], "number": 2, "goal": ["spin"], "release": "dr5", "criterion": criterion}
    return linksweep.forecast("dr4-gaia", "dr4-vlbi", "orientation,spin", **options)


def of_ranking(plan):
    now, alone = float(plan.criterion.sel(stage="dr5")), np.sort(plan.criterion_alone)[::-1]
    gain = alone / now if plan.attrs["criterion"] == "A" else np.exp((alone - now) / 6)  # a determinant of 3 x 3
    return [[100.0 * (1.0 - gain)], (plan.step_error[:, 3:] / plan.step_error[0, 3:]).values.T]


def of_sources(kind):
    def panels(link):
        kept, ratio = link.weight_factor.values > 0.0, link.discrepancy / link.n_observations  # six of eight
        if kind == "weight":
            return [[one[kept], ratio[kept]] for one in link.share.values.T]
        order = np.argsort(link.share.values.max(axis=1))[2:]  # the largest is on top
        if kind == "ranking":
            return [link.share.values[order].T.reshape(1, -1), [link.cook_distance[order]]]
        if kind == "separations":  # after the fit the X of two observations that is as rare as Q of n
            after = np.sqrt(stats.chi2.isf(stats.chi2.sf(link.discrepancy, link.n_observations), 2))
            steps = [np.append(0.1, np.sort(one)) for one in (link.normalised_separation, after)]
            return [[*steps, np.append(1.0, np.arange(8, 0, -1) / 8)]]
        without = link.estimate_without.values[kept]
        stretched = without.mean(axis=0) + np.sqrt(5.0) * (without - without.mean(axis=0))
        half = np.sqrt(stats.chi2.ppf(0.683, 2) * np.einsum("ekk->ek", link.covariances))
        pairs = (list(pair) for block in ([0, 1, 2], [3, 4, 5]) for pair in combinations(block, 2))
        return [[*stretched[:, pair].T, *half[:, pair]] for pair in pairs]

    return panels


BLOCKS = slice(0, 3), slice(3, 6)
FIGURES = {  # of a dataset, and what their panels show of it
    "solution": (tie, lambda d: [[d.estimate[b], *d.errors[:, b]] for b in BLOCKS]),
    "bins": (tie, lambda d: [[*d.spin_by_bin.T, *d.spin_by_bin_error.T]]),
    "trajectory": (
        tie,
        lambda d: [
            *([*d.step_estimate[:, b].T, *d.step_error[:, b].T] for b in BLOCKS),
            [d.step_chi2 / d.step_dof, np.full(2, d.step_chosen)],
        ],
    ),
    **{kind: (tie, of_sources(kind)) for kind in ("weight", "ranking", "separations", "jackknife")},
    "spectrum": (
        lambda: linksweep.tie("icrf3", "icrf2", "orientation,vsh_position:2"),
        lambda d: [np.sqrt([*d.power, *d.power_noise]), np.minimum(stats.norm.isf(d.power_probability), 10.0)],
    ),
    "epochs": (
        forecast,
        lambda d: [[*d.error_with_epoch[:, b].T, *np.tile(d.error.values[:, b].reshape(-1, 1), 2)] for b in BLOCKS],
    ),
    **{f"ranking {which}": (partial(forecast, which), of_ranking) for which in "AD"},
}


@pytest.mark.parametrize("name", FIGURES)
def test_each_panel_shows_the_numbers_of_the_dataset_in_its_unit(name):
    make, wanted = FIGURES[name]
    figure = linksweep.plot(make(), name.split()[0])
    assert "dr4" in figure.get_suptitle() or "icrf" in figure.get_suptitle()
    for axes, values in zip(figure.axes, wanted(make()), strict=True):
        assert_shown(axes, values)


def test_right_ascension_grows_to_the_left_the_galactic_plane_is_astropys_and_a_points_sky_its_catalogue(store_of):
    places = {"ra": [170.0, 180.0, 190.0], "dec": [0.0, 10.0, -20.0], "v_mag": [3.0, 2.0, 1.0]}  # the brightest last
    axes = sky.sky_figure(xr.Dataset({name: ("object", values) for name, values in places.items()})).axes[0]
    x, y = np.asarray(axes.collections[0].get_offsets()).T
    assert (x, y) == (pytest.approx(np.deg2rad([10.0, 0.0, -10.0])), pytest.approx(np.deg2rad([0.0, 10.0, -20.0])))
    labels = [text for text in axes.texts if text.get_text().endswith("°")]
    assert [text.get_text() for text in labels] == ["300°", "240°", "180°", "120°", "60°"]
    assert min(text.get_zorder() for text in labels) > axes.collections[0].get_zorder()  # not under the dots
    lines = {line.get_label(): line for line in axes.lines}
    plane, centre = lines["Galactic plane"], lines["Galactic centre"]
    x, y = plane.get_xdata(), plane.get_ydata()
    drawn = np.isfinite(y)
    assert drawn.sum() >= len(y) - 2
    assert not drawn[:-1][np.abs(np.diff(x)) > 1.0].any()  # no line from one edge to the other
    places = SkyCoord(ra=(180.0 - np.rad2deg(x[drawn])) * units.deg, dec=np.rad2deg(y[drawn]) * units.deg)
    assert np.abs(places.galactic.b.arcsec).max() < 0.1
    middle = SkyCoord(l=0.0 * units.deg, b=0.0 * units.deg, frame="galactic").icrs
    assert np.rad2deg(centre.get_ydata()[0]) == pytest.approx(middle.dec.deg, abs=1e-4)
    assert 180.0 - np.rad2deg(centre.get_xdata()[0]) == pytest.approx(middle.ra.deg, abs=1e-4)
    dataset = sky.catalogue_of_point(store_of("quasars"), ["model=gaia", "v_max=15"])
    assert dataset.sizes["object"] == 88
    assert dataset["v_mag"].max() <= 15.0
    said = style.caption_and_description(sky.sky_figure(dataset), dataset)
    assert "the 88 objects of one catalogue, model=gaia, v_max=15." in said
    assert "Colours: V [mag]." in said
    again = sky.catalogue_of_point(store_of("quasars"), ["model=gaia,v_max=15"])
    assert np.array_equal(again["ra"], dataset["ra"])


@pytest.mark.slow
def test_accuracy_curves_are_those_of_the_missions():
    dataset = sky.accuracy_curves(["amex", "gaia-2001"])
    assert dataset["sigma_pm"].sel(model="amex", v=9.0).item() == pytest.approx(0.181, abs=0.001)  # docs/science.md
    assert dataset["sigma_pm"].sel(model="gaia-2001", v=15.0).item() == pytest.approx(0.008)  # ESA's table
    relative = (dataset["sigma_pm_error"] / dataset["sigma_pm"]).sel(model="amex")
    assert 0.0 < relative.min() < 0.1  # docs/calibration.md: some percent where the numbers are
    assert np.isnan(dataset["sigma_pm_error"].sel(model="gaia-2001")).all()
    left, right = panels = sky.accuracy_figure(dataset).axes
    for axes, name in zip(panels, ("sigma_pm", "sigma_pos"), strict=True):
        [curve] = dataset[name].sel(model=["amex"]).values
        assert_shown(axes, [*dataset[name].values, (relative * curve)[np.isfinite(curve)]])
    assert (left.get_ylabel(), right.get_ylabel()) == (r"$\sigma_\mu$ [mas/yr]", r"$\sigma_\mathrm{pos}$ [mas]")
    assert left.get_yscale() == "log"
    assert [text.get_text() for text in left.figure.legends[0].get_texts()] == ["model = amex", "model = gaia-2001"]
    assert len(left.collections) == 1  # the band of the calibrated one
