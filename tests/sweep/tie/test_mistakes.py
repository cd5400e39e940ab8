"""Made skies with one mistake each, which is refused or named with its cause; without one nothing is suspected."""

import re
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table, vstack

from core.constants import DEGREE, MAS
from core.tie.astrometry import PAIRS
from core.tie.motion import parallax_factors, propagated
from sweep.contract import SweepError
from sweep.tie.link_tables import tie
from tests.core.tie.made import noise, seen_by_satellite, stars
from tests.sweep.tie.test_tables import NAMES

EPSILON, OMEGA = np.array([0.8, -1.5, 0.6]) * MAS, np.array([-0.12, 0.25, 0.07]) * MAS


def table_of(made):
    """Return a table of the Gaia archive's names without units, as in CSV."""
    table = Table({"source_id": made.names, "ref_epoch": made.epoch})
    for k, name in enumerate(NAMES):
        table[name] = made.values[k] / (MAS if k > 1 else DEGREE)
        table[f"{name}_error"] = made.errors[k] / MAS
    for (i, j), row in zip(PAIRS, made.correlations, strict=True):
        table[f"{NAMES[i]}_{NAMES[j]}_corr"] = row
    return table


def sky(n, seed):
    """Return a satellite's table and VLBI rows: positions of three or four epochs of each star, and for every other
    star motion and parallax.
    """
    rng = np.random.default_rng(seed)
    truth = stars(n, seed + 1, pm=60.0, parallax=15.0)
    names = 10**17 + 7 * np.arange(n)
    own = replace(truth, values=seen_by_satellite(truth, EPSILON, OMEGA), names=names, columns={})
    step = noise(rng, own)
    step[0] /= np.cos(own.values[1])
    satellite = table_of(replace(own, values=own.values + step))
    satellite["radial_velocity"] = truth.radial_velocity
    parts = []
    for i in range(n):
        one = truth.taken(np.array([i]))
        for epoch in np.sort(rng.uniform(2003.0, 2024.0, 3 + i % 2)):
            there = propagated(one.values, one.radial_velocity, one.epoch, np.array([epoch]))
            there[:2] += parallax_factors(there[0], there[1], np.array([epoch])) * there[2] / [np.cos(there[1]), [1.0]]
            parts.append(row(rng, there, epoch, names[i], (0, 1)))
        if i % 2 == 0:
            parts.append(row(rng, one.values, 2016.0, names[i], (2, 3, 4)))
    return satellite, vstack(parts)


def row(rng, values, epoch, name, which):
    errors = np.array([0.15, 0.2, 0.1, 0.05, 0.05]) * rng.uniform(0.5, 2.0, 5)
    step = errors * rng.normal(size=5) * MAS
    step[0] /= np.cos(values[1, 0])
    found = Table({"source_id": [name], "ref_epoch": [epoch]})
    for k, key in enumerate(NAMES):
        value = values[k, 0] + step[k] if k in which or k < 2 else np.nan  # every row says where the star is
        error = errors[k] if k in which else np.nan
        found[key], found[f"{key}_error"] = [value / (MAS if k > 1 else DEGREE)], [error]
    return found


def scaled(names, factor):
    def change(table, rng):
        for name in names:
            table[name] *= factor

    return change


def without_cosine(table, rng):
    cosine = np.cos(np.radians(table["dec"]))
    table["pmra"] /= cosine
    table["pmra_error"] /= cosine


def motions_exchanged(table, rng):
    for end in ("", "_error"):
        table[f"pmra{end}"], table[f"pmdec{end}"] = table[f"pmdec{end}"].copy(), table[f"pmra{end}"].copy()


def epochs_moved(years):
    def change(table, rng):
        table["ref_epoch"] += years

    return change


def epochs_equal(table, rng):
    table["ref_epoch"] = 2016.0


def declared(names, unit):
    def change(table, rng):
        for name in names:
            table[name].unit = unit

    return change


def without_correlations(table, rng):
    table.remove_columns([name for name in table.colnames if name.endswith("_corr")])


def twice_with_other_digits(table, rng):
    positions = np.flatnonzero(np.isfinite(table["ra_error"]))
    again = table[[rng.choice(positions)]].copy()
    again["ra"], again["dec"] = np.round(again["ra"], 8), np.round(again["dec"], 8)
    again["ra_error"] = np.round(again["ra_error"], 3)
    table.add_row(again[0])


def errors_nan(table, rng):
    rows = rng.choice(np.flatnonzero(np.isfinite(table["ra_error"])), 2, replace=False)
    table["ra_error"][rows] = table["dec_error"][rows] = np.nan


def names_exchanged(table, rng):
    names = np.unique(table["source_id"])
    one, other = rng.choice(names, 2, replace=False)
    place = {one: other, other: one}
    table["source_id"] = [place.get(name, name) for name in table["source_id"]]


POSITIONS, MOTIONS, PARALLAX = ("ra_error", "dec_error"), ("pmra", "pmdec"), ("parallax", "parallax_error")
ERRORS = tuple(f"{name}_error" for name in NAMES)
MISTAKES = {
    "mu_alpha": ("satellite", without_cosine, "pmra of the satellite is mu_alpha"),
    "mu_alpha there": ("reference", without_cosine, "pmra of the reference is mu_alpha"),
    "motions exchanged": ("satellite", motions_exchanged, "pmra and pmdec of the satellite exchanged"),
    "motions exchanged there": ("reference", motions_exchanged, "pmra and pmdec of the reference exchanged"),
    "motions reversed": ("satellite", scaled(MOTIONS, -1.0), "proper motions of the satellite with reversed sign"),
    "one motion reversed": ("satellite", scaled(["pmdec"], -1.0), "pmdec of the satellite with reversed sign"),
    "half a year late": ("satellite", epochs_moved(0.5), "epochs of the satellite 0.5 years too late"),
    "half a year early there": ("reference", epochs_moved(-0.5), "epochs of the reference 0.5 years too early"),
    "a quarter year late there": ("reference", epochs_moved(0.25), "epochs of the reference 0.25 years too late"),
    "a century early": ("satellite", epochs_moved(-100.0), "epochs of the satellite 100 years too early"),
    "a century early there": ("reference", epochs_moved(-100.0), "epochs of the reference 100 years too early"),
    "epochs equal": ("reference", epochs_equal, "epochs of .* equal"),
    "parallax in arcsec": ("satellite", scaled(["parallax"], 1e-3), "parallaxes of the satellite, arcsec taken"),
    "all of parallax in arcsec": ("satellite", scaled(PARALLAX, 1e-3), "parallax.*(arcsec taken|no instrument)"),
    "motions in arcsec": ("satellite", scaled(MOTIONS, 1e-3), "proper motions of the satellite, arcsec taken"),
    "motions in arcsec there": ("reference", scaled(MOTIONS, 1e-3), "proper motions of the reference, arcsec taken"),
    "position errors in deg": ("satellite", scaled(POSITIONS, 1.0 / 3.6e6), "deg taken for mas"),
    "position errors in deg there": ("reference", scaled(POSITIONS, 1.0 / 3.6e6), "deg taken for mas"),
    "errors in mas declared as deg": ("reference", declared(POSITIONS, "deg"), "mas taken for deg"),
    "position errors in uas": ("reference", scaled(POSITIONS, 1e3), "errors of positions.*uas taken for mas"),
    "errors in uas": ("satellite", scaled(ERRORS, 1e3), "too large, uas taken for mas"),
    "no correlations": ("satellite", without_correlations, "no correlations"),
    "one row twice": ("reference", twice_with_other_digits, "(nearly the|the same) numbers (of|as) another row"),
    "errors that are NaN": ("reference", errors_nan, "rows have no error of ra, dec"),
    "names exchanged": ("reference", names_exchanged, "exchanged"),
}


def solved(folder, satellite, reference, **options):
    """Return the notes of a link, or the message that refuses it."""
    for name, table in (("satellite", satellite), ("reference", reference)):
        table.write(folder / f"{name}.ecsv", overwrite=True)
    try:
        link = tie(
            folder / "satellite.ecsv", folder / "reference.ecsv", "orientation,spin", accept_misfit=True, **options
        )
    except SweepError as error:
        return [str(error)]
    return link.attrs["notes"]


def suspicions(notes):
    """Return the notes that are not about shares of the weight."""
    return [note for note in notes if "of the weight" not in note and "have no error of ra, dec, which" not in note]


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize(("n", "seed"), [(20, 1)])
def test_a_mistake_is_named(tmp_path, mistake, n, seed):
    side, change, words = MISTAKES[mistake]
    tables = dict(zip(("satellite", "reference"), sky(n, seed), strict=True))
    change(tables[side], np.random.default_rng(seed))
    found = solved(tmp_path, **tables)
    assert any(re.search(words, note) for note in found), found


@pytest.mark.parametrize(("n", "seed"), [(5, 1), (20, 2), (60, 3)])
def test_a_sky_without_a_mistake_is_not_suspected(tmp_path, n, seed):
    satellite, reference = sky(n, seed)
    assert not suspicions(solved(tmp_path, satellite, reference))
