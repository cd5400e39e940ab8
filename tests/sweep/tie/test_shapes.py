"""Made tables of the shapes of published links, through files: what was put in comes back within its errors."""

from dataclasses import replace

import numpy as np
from astropy.table import Table

from linksweep import tie
from tests.core.tie.made import (
    MAS,
    Astrometry,
    Objects,
    gaia,
    noise,
    parse_unknowns,
    propagated,
    seen_by_satellite,
    stars,
)

EPSILON, OMEGA = np.array([0.8, -1.5, 0.6]), np.array([-0.12, 0.25, 0.07])
"""In mas and mas/yr, reference - satellite."""


def measured(rng, made):
    """Return a table with errors drawn from its covariances."""
    step = noise(rng, made)
    step[0] /= np.cos(made.values[1])
    return replace(made, values=made.values + step)


def within(link, truth, sigmas=4.0):
    """Assert that estimates are within so many errors of the truth, and no better than chance would have it."""
    off = (link.estimate.values - truth) / link.error.values
    assert np.all(np.abs(off) < sigmas), off
    assert np.any(np.abs(off) > 0.05)


def quasars(folder, n=2500):
    """Write a satellite's quasars, and positions without epochs in another frame with glide and harmonics of degree 2,
    3 % of them with an offset of their own.
    """
    rng = np.random.default_rng(42)
    ra, dec = rng.uniform(0.0, 2.0 * np.pi, n), np.arcsin(rng.uniform(-0.99, 0.99, n))
    unknowns = parse_unknowns("orientation,position_glide,vsh_position:2-2")
    truth = rng.normal(0.0, 0.03, len(unknowns))
    zeros = np.zeros(n)
    shift = unknowns.matrix(Objects(ra, dec, zeros, zeros))[:, :2] @ truth * MAS
    errors = np.full((5, n), np.nan)
    errors[:2] = rng.uniform(0.1, 0.4, (2, n)) * MAS
    correlations = np.zeros((10, n))
    correlations[0] = rng.uniform(-0.6, 0.6, n)
    nothing = np.full((3, n), np.nan)
    sides = []
    for values in (
        np.array([ra, dec, *nothing]),
        np.array([ra + shift[:, 0] / np.cos(dec), dec + shift[:, 1], *nothing]),
    ):
        sides.append(measured(rng, Astrometry(values, errors, np.full(n, np.nan), correlations)))
    bad = rng.random(n) < 0.03
    sides[1].values[1, bad] += rng.choice([-3.0, 3.0], bad.sum()) * MAS
    for name, side in zip(("gaia", "vlbi"), sides, strict=True):
        table = Table({"name": [f"Q{i}" for i in range(n)], "ra": np.degrees(side.values[0])})
        table["dec"] = np.degrees(side.values[1])
        table["ra_error"], table["dec_error"] = errors[:2] / MAS
        table["ra_dec_corr"] = correlations[0]
        table.meta["extragalactic"] = True
        table.write(folder / f"{name}.ecsv")
    return folder / "gaia.ecsv", folder / "vlbi.ecsv", truth, bad


def test_positions_of_quasars_with_harmonics_and_the_clip_of_rayleigh(tmp_path):
    satellite, reference, truth, bad = quasars(tmp_path)
    blocks = "orientation,position_glide,vsh_position:2-2"
    link = tie(satellite, reference, blocks, clip="rayleigh", errors="formal,cells")
    dropped = link.weight_factor.values == 0.0
    assert np.all(dropped[bad])
    assert np.sum(dropped & ~bad) <= 5  # one of 2500 is expected
    within(link, truth)
    np.testing.assert_allclose(link.errors[1] / link.errors[0], 1.0, atol=0.35)
    opposite = tie(reference, satellite, blocks, clip="rayleigh")
    np.testing.assert_allclose(opposite.estimate, -link.estimate, atol=1e-5)


def test_a_spin_that_depends_on_magnitude_against_hipparcos(tmp_path):
    """Three bins of magnitude with spins of their own, seen in the motions and over 24.75 years of positions."""
    rng = np.random.default_rng(43)
    truth = stars(600, 9, pm=50.0, parallax=10.0, epoch=2016.0)
    edges, magnitude = [9.0, 11.0], np.linspace(7.0, 13.0, 600)
    spins = np.array([[0.08, -0.1, 0.05], [0.03, 0.02, -0.04], [0.0, 0.0, 0.0]])
    values, bin_of = truth.values.copy(), np.searchsorted(edges, magnitude, side="right")
    for number, spin in enumerate(spins):
        own = bin_of == number
        values[:, own] = seen_by_satellite(truth.taken(own), np.zeros(3), spin * MAS)
    satellite = gaia(tmp_path / "gaia.fits", measured(rng, replace(truth, values=values)), phot_g_mean_mag=magnitude)
    there = propagated(truth.values, truth.radial_velocity, truth.epoch, truth.epoch - 24.75)
    old = replace(truth, values=there, epoch=truth.epoch - 24.75, errors=truth.errors * 8.0)
    reference = gaia(tmp_path / "hip.ecsv", measured(rng, old))
    link = tie(satellite, reference, "spin", bins=("phot_g_mean_mag", edges), errors="formal")
    off = (link.spin_by_bin.values - spins) / link.spin_by_bin_error.values
    assert np.all(np.abs(off) < 4.0)
    assert np.any(np.abs(spins[0] / link.spin_by_bin_error.values[0]) > 10.0)
    table = Table({"mag_min": [0.0, *edges], "mag_max": [*edges, 21.0]})
    for k, axis in enumerate("xyz"):
        table[f"omega_{axis}"] = -spins[:, k]  # in the sign of its authors
    table.write(tmp_path / "spins.ecsv")
    path = tmp_path / "spins.ecsv"
    options = {"known_spin": path, "sign": "satellite-reference", "errors": "formal"}
    corrected = tie(satellite, reference, "spin", **options)
    within(corrected, np.zeros(3))
    plain = tie(satellite, reference, "spin", errors="formal")
    assert float(np.abs(plain.estimate / plain.error).max()) > 5.0
