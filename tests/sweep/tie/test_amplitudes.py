"""Harmonics as rotation, glide and quadrupoles, and differences of links, against closed forms."""

import numpy as np
import pytest
from scipy.stats import chi2

import linksweep


def field(amplitudes, ra, dec):
    """The displacements to the east and north of Charlot et al. 2020, Eq. 5, with our sign of R."""
    a = {name.split(" ")[1]: value for name, value in amplitudes.items()}
    s, c = np.sin, np.cos
    east = -a["R_x"] * c(ra) * s(dec) - a["R_y"] * s(ra) * s(dec) + a["R_z"] * c(dec)
    north = a["R_x"] * s(ra) - a["R_y"] * c(ra)
    east += -a["G_x"] * s(ra) + a["G_y"] * c(ra)
    north += -a["G_x"] * c(ra) * s(dec) - a["G_y"] * s(ra) * s(dec) + a["G_z"] * c(dec)
    east += a["M_20"] * s(2 * dec) - (a["M_21_re"] * c(ra) - a["M_21_im"] * s(ra)) * c(2 * dec)
    east += (a["E_21_re"] * s(ra) + a["E_21_im"] * c(ra)) * s(dec)
    east -= (a["M_22_re"] * c(2 * ra) - a["M_22_im"] * s(2 * ra)) * s(2 * dec)
    east -= 2 * (a["E_22_re"] * s(2 * ra) + a["E_22_im"] * c(2 * ra)) * c(dec)
    north += a["E_20"] * s(2 * dec) - (a["E_21_re"] * c(ra) - a["E_21_im"] * s(ra)) * c(2 * dec)
    north -= (a["M_21_re"] * s(ra) + a["M_21_im"] * c(ra)) * s(dec)
    north -= (a["E_22_re"] * c(2 * ra) - a["E_22_im"] * s(2 * ra)) * s(2 * dec)
    north += 2 * (a["M_22_re"] * s(2 * ra) + a["M_22_im"] * c(2 * ra)) * c(dec)
    return np.array([east, north])


def test_the_amplitudes_are_the_field_that_was_fitted():
    link = linksweep.tie("icrf3", "icrf2", "vsh_position:2")
    fitted = (link.difference - link.residual).sel(observable=["ra", "dec"]).values.T
    ra, dec = np.radians([link[name].values[link.row_source_index.values] for name in ("ra", "dec")])
    np.testing.assert_allclose(field(link.amplitude.to_series(), ra, dec), fitted, atol=1e-9)
    # The norm of the harmonics (Mignard & Klioner 2012): order 0 of degree 2 is sqrt(15/32 pi) sin 2 dec.
    factor = np.sqrt(15.0 / 32.0 / np.pi)
    for harmonic, amplitude in (("s", "E"), ("t", "M")):
        one, other = f"vsh_position_{harmonic}_2_0", f"position {amplitude}_20"
        assert link.amplitude.sel(amplitude_name=other) == pytest.approx(factor * link.estimate.sel(unknown=one))
        errors = link.amplitude_errors.sel(amplitude_name=other).values
        np.testing.assert_allclose(errors, factor * link.errors.sel(unknown=one).values)


@pytest.mark.parametrize("sign", ["reference-satellite", "satellite-reference"])
def test_a_difference_is_at_the_epoch_and_in_the_sign_of_the_first(sign):
    tables = "psrpi-de200", "timing-de200", "orientation,spin"
    one, other = linksweep.tie(*tables, epoch=2010.0), linksweep.tie(*tables, epoch=2016.0, sign=sign)
    made = linksweep.difference(one, other)  # the same link at two epochs
    # But for terms of the second order: the motions of stars turn with the orientation.
    assert (abs(made.estimate) < 1e-4 * made.error).all()
    np.testing.assert_allclose(made.covariance, 2.0 * one.covariance.values, rtol=1e-3)
    assert made.attrs["sign"] == "reference-satellite"


def test_chi2_of_a_difference_is_that_of_its_covariance():
    tables = "psrpi-de200", "timing-de200", "orientation"
    one, other = (linksweep.tie(*tables, weights=weights) for weights in ("variance", "equal"))
    made = linksweep.difference(one, other)
    apart = one.estimate.values - other.estimate.values
    expected = apart @ np.linalg.inv(one.covariance.values + other.covariance.values) @ apart
    assert made.chi2.item() == pytest.approx(expected)
    assert made.probability.item() == pytest.approx(chi2(3).sf(expected))


def test_what_has_no_difference_is_refused(tmp_path, sweep_here, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, unknowns, epoch in (("a", "orientation", "2010"), ("b", "orientation", "2016")):
        arguments = "psrpi-de200", "timing-de200", "--unknowns", unknowns, "--epoch", epoch, "-o", f"{name}.zarr"
        assert sweep_here("tie", *arguments)[0] == 0
    assert sweep_here("show", "a.zarr", "--minus", "a.zarr")[0] == 0
    for other, why in (("b", "no omega_x"), ("d", "two links")):
        code, out, err = sweep_here("show", "a.zarr", "--minus", f"{other}.zarr")
        assert (code, out) == (2, "")
        assert why in err
