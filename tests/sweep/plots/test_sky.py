"""The sky of catalogues and the accuracy of missions: what is drawn is where and what it should be."""

import numpy as np
import pytest
import xarray as xr
from astropy import units
from astropy.coordinates import SkyCoord

from linksweep.sweep.plots import link as sky


def test_right_ascension_grows_to_the_left():
    dataset = xr.Dataset({"ra": ("object", [170.0, 180.0, 190.0]), "dec": ("object", [0.0, 10.0, -20.0])})
    [axes] = sky.sky_figure(dataset).axes
    x, y = np.asarray(axes.collections[0].get_offsets()).T
    assert x == pytest.approx(np.deg2rad([10.0, 0.0, -10.0]))
    assert y == pytest.approx(np.deg2rad([0.0, 10.0, -20.0]))
    labels = [text for text in axes.texts if text.get_text().endswith("°")]
    assert [text.get_text() for text in labels] == ["300°", "240°", "180°", "120°", "60°"]
    assert min(text.get_zorder() for text in labels) > axes.collections[0].get_zorder()  # not under the dots


def test_the_galactic_plane_is_that_of_astropy():
    [axes] = sky.sky_figure(xr.Dataset({"ra": ("object", [0.0]), "dec": ("object", [0.0])})).axes
    plane, centre = (
        next(line for line in axes.lines if line.get_label() == f"Galactic {n}") for n in ("plane", "centre")
    )
    x, y = plane.get_xdata(), plane.get_ydata()
    drawn = np.isfinite(y)
    assert drawn.sum() >= len(y) - 2
    assert not drawn[:-1][np.abs(np.diff(x)) > 1.0].any()  # no line from one edge to the other
    places = SkyCoord(ra=(180.0 - np.rad2deg(x[drawn])) * units.deg, dec=np.rad2deg(y[drawn]) * units.deg)
    assert np.abs(places.galactic.b.arcsec).max() < 0.1
    middle = SkyCoord(l=0.0 * units.deg, b=0.0 * units.deg, frame="galactic").icrs
    assert np.rad2deg(centre.get_ydata()[0]) == pytest.approx(middle.dec.deg, abs=1e-4)
    assert 180.0 - np.rad2deg(centre.get_xdata()[0]) == pytest.approx(middle.ra.deg, abs=1e-4)


def test_the_sky_of_a_point_is_its_catalogue(store_of):
    dataset = sky.catalogue_of_point(store_of("quasars"), ["model=gaia", "v_max=15"])
    assert dataset.sizes["object"] == 88
    assert dataset["v_mag"].max() <= 15.0
    figure = sky.sky_figure(dataset)
    title = " ".join(figure.get_suptitle().split())
    assert "the 88 objects of one catalogue, model=gaia, v_max=15" in title
    assert figure.axes[1].get_xlabel() == "$V$ [mag]"
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
    left, right = sky.accuracy_figure(dataset).axes
    assert (left.get_ylabel(), right.get_ylabel()) == (r"$\sigma_\mu$ [mas/yr]", r"$\sigma_\mathrm{pos}$ [mas]")
    assert left.get_yscale() == "log"
    assert [text.get_text() for text in left.figure.legends[0].get_texts()] == ["amex", "gaia-2001"]
    assert len(left.collections) == 1  # the band of the calibrated one
