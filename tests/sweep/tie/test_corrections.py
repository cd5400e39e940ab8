"""What is known of DR3 and subtracted: parallax zero points and the spin by magnitude; other releases are refused."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

import linksweep
from linksweep.sweep.tie.tables import TableOptions, read_table
from tests.core.tie.made import MAS, gaia, stars

zpt = pytest.importorskip("zero_point").zpt


def test_parallaxes_are_those_of_the_authors_package(tmp_path):
    """Of columns of gaia_source: five- and six-parameter solutions, one of two and one too bright."""
    rng, made = np.random.default_rng(1), stars(30)
    six, magnitude = np.arange(30) % 3 == 0, rng.uniform(7.0, 20.0, 30)
    solved = np.where(six, 95, 31)
    solved[4], magnitude[5] = 3, 4.0
    columns = {"phot_g_mean_mag": magnitude}
    columns["nu_eff_used_in_astrometry"] = np.where(six, np.nan, rng.uniform(1.2, 1.8, 30))
    columns["pseudocolour"] = np.where(six, rng.uniform(1.25, 1.7, 30), np.nan)
    columns |= {"ecl_lat": rng.uniform(-90.0, 90.0, 30), "astrometric_params_solved": solved}
    found = read_table(gaia(tmp_path / "gaia.ecsv", made, **columns), TableOptions(parallax_zero_point=True))
    zpt.load_tables()
    for k in range(30):
        wanted = 0.0 if k in (4, 5) else zpt.get_zpt(*(column[[k]] for column in columns.values()))[0]
        assert (made.values[2, k] - found.astrometry.values[2, k]) / MAS == pytest.approx(wanted, abs=1e-9)
    assert any("zero points of 28 of 30 parallaxes subtracted" in note for note in found.notes)


def bright(folder):
    """Write motions with the spin of bright stars of EDR3, and those without it.

    Cantat-Gaudin & Brandt 2021 (A&A 649, A124), in three bins.
    """
    made = replace(stars(30, 2), radial_velocity=np.zeros(30))
    x, y, z = np.tile([[18.4, 27.3, 0.0], [33.8, 76.6, 0.0], [-11.3, 0.5, 0.0]], 10) * MAS / 1000.0
    values, (ra, dec) = made.values.copy(), made.values[:2]
    values[3] -= -np.sin(dec) * np.cos(ra) * x - np.sin(dec) * np.sin(ra) * y + np.cos(dec) * z
    values[4] -= np.sin(ra) * x - np.cos(ra) * y
    table = gaia(folder / "gaia.ecsv", made, phot_g_mean_mag=np.tile([8.0, 12.6, 15.0], 10))
    return table, gaia(folder / "true.ecsv", replace(made, values=values))


def test_the_published_spin_of_bright_stars_is_subtracted_and_chi2_says_whether_its_sign_is_right(tmp_path):
    tables, bins = bright(tmp_path), ("phot_g_mean_mag", [10.0, 14.0])
    spins = Table.read("linksweep/sweeps/data/edr3-spin.ecsv")
    wrong = spins.copy()
    for axis in "xyz":
        wrong[f"omega_{axis}"] *= -100.0
    wrong.write(tmp_path / "wrong.ecsv")
    spins["omega_x"].convert_unit_to("mas/yr")
    spins.write(tmp_path / "spins.ecsv")
    as_it_is = linksweep.tie(*tables, "spin", bins=bins)
    np.testing.assert_allclose(as_it_is.spin_by_bin[0], [-0.0184, -0.0338, 0.0113], atol=1e-6)
    for sign in ("reference-satellite", "satellite-reference"):
        for known in ("edr3-spin", tmp_path / "spins.ecsv"):
            link = linksweep.tie(*tables, "spin", bins=bins, known_spin=known, sign=sign)
            np.testing.assert_allclose(link.estimate, 0.0, atol=1e-6)
    for known in ("spins", "wrong"):
        link = linksweep.tie(*tables, "spin", known_spin=tmp_path / f"{known}.ecsv", accept_misfit=True)
        (said,) = [note for note in link.attrs["notes"] if "with the opposite sign" in note]
        assert ("sign right?" in said) == (known == "wrong")
