"""Made skies with one mistake each, which is refused or named with its cause; without one nothing is suspected."""

import re
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table, vstack
from click.testing import CliRunner
from hypothesis import given, settings, strategies as st

import linksweep
from linksweep import SweepError, tie
from tests.core.tie.made import (
    DEGREE,
    MAS,
    NAMES,
    gaia_table,
    main,
    noise,
    parallax_factors,
    propagated,
    seen_by_satellite,
    stars,
)
from tests.tiers import slow

EPSILON, OMEGA = np.array([0.8, -1.5, 0.6]) * MAS, np.array([-0.12, 0.25, 0.07]) * MAS


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
    satellite = gaia_table(replace(own, values=own.values + step), source_id=names)
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


def one_motion_reversed(table, rng):
    table["pmra"][np.argmax(np.abs(table["pmra"]))] *= -1.0


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
    exchange(table, *rng.choice(np.unique(table["source_id"]), 2, replace=False))


def exchange(table, one, other):
    place = {one: other, other: one}
    table["source_id"] = [place.get(name, name) for name in table["source_id"]]


POSITIONS, MOTIONS = ("ra_error", "dec_error"), ("pmra", "pmdec")
ERRORS = tuple(f"{name}_error" for name in NAMES)
MISTAKES = {
    "mu_alpha": ("satellite", without_cosine, "pmra of the satellite is mu_alpha"),
    "mu_alpha there": ("reference", without_cosine, "pmra of the reference is mu_alpha"),
    "motions exchanged": ("satellite", motions_exchanged, "pmra and pmdec of the satellite exchanged"),
    "motions reversed": ("satellite", scaled(MOTIONS, -1.0), "proper motions of the satellite with reversed sign"),
    "half a year early there": ("reference", epochs_moved(-0.5), "epochs of the reference 0.5 years too early"),
    "a quarter year late there": ("reference", epochs_moved(0.25), "epochs of the reference 0.25 years too late"),
    "a century early there": ("reference", epochs_moved(-100.0), "epochs of the reference 100 years too early"),
    "one star reversed": ("satellite", one_motion_reversed, r"pmra of \d+ in the satellite with reversed sign"),
    "epochs equal": ("reference", epochs_equal, "epochs of .* equal"),
    "parallax in arcsec": ("satellite", scaled(["parallax"], 1e-3), "parallaxes of the satellite, arcsec taken"),
    "motions in arcsec there": ("reference", scaled(MOTIONS, 1e-3), "proper motions of the reference, arcsec taken"),
    "position errors in deg": ("satellite", scaled(POSITIONS, 1.0 / 3.6e6), "deg taken for mas"),
    "errors of ra in seconds": (
        "reference",
        scaled(["ra_error"], 1.0 / 1.5e4),
        "errors of ra.*(seconds of time|no inst)",
    ),
    "errors in mas declared as deg": ("reference", declared(POSITIONS, "deg"), "mas taken for deg"),
    "errors in uas": ("satellite", scaled(ERRORS, 1e3), "too large, uas taken for mas"),
    "no correlations": ("satellite", without_correlations, "no correlations"),
    "one row twice": ("reference", twice_with_other_digits, "(nearly the|the same) numbers (of|as) another row"),
    "errors that are NaN": ("reference", errors_nan, "rows have no error of ra, dec"),
    "names exchanged": ("reference", names_exchanged, "exchanged"),
}
QUICK = {"mu_alpha", "half a year early there", "one star reversed", "errors in uas", "one row twice"}


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


@pytest.mark.parametrize("mistake", [m if m in QUICK else slow(m) for m in MISTAKES])
@pytest.mark.parametrize(
    ("n", "seed"),
    [(9, 1), *(slow(n, n + seed) for n in (5, 60) for seed in (2, 3))],
)
def test_a_mistake_is_named(tmp_path, mistake, n, seed):
    side, change, words = MISTAKES[mistake]
    tables = dict(zip(("satellite", "reference"), sky(n, seed), strict=True))
    change(tables[side], np.random.default_rng(seed))
    found = solved(tmp_path, **tables)
    assert any(re.search(words, note) for note in found), found


PAIRS = [
    ("mu_alpha", "a quarter year late there", 12, 3),
    ("motions exchanged", "motions in arcsec there", 12, 3),
    ("a century early there", "one star reversed", 12, 3),
    ("mu_alpha there", "motions exchanged", 12, 3),
    ("mu_alpha", "mu_alpha there", 10, 2),  # which wrong epochs of single rows would explain as well
]


@pytest.mark.slow
@pytest.mark.parametrize(("one", "other", "n", "seed"), PAIRS)
def test_two_mistakes_at_once_are_both_named(tmp_path, one, other, n, seed):
    pair, tables = (one, other), dict(zip(("satellite", "reference"), sky(n, seed), strict=True))
    for mistake in pair:
        side, change, _ = MISTAKES[mistake]
        change(tables[side], np.random.default_rng(1))
    found = solved(tmp_path, **tables)
    assert all(re.search(MISTAKES[mistake][2], found[0]) for mistake in pair), found


OFF = ["half a year early there", "a quarter year late there", "a century early there"]
VALUES = [
    "mu_alpha",
    "mu_alpha there",
    "motions exchanged",
    "motions reversed",
    "motions in arcsec there",
    "one star reversed",
]


@pytest.mark.slow
@settings(max_examples=12, deadline=None, derandomize=True)
@given(epochs=st.sampled_from(OFF), other=st.sampled_from(VALUES), seed=st.integers(1, 99))
def test_epochs_that_are_off_and_another_mistake_are_both_named_or_none(tmp_path_factory, epochs, other, seed):
    tables = dict(zip(("satellite", "reference"), sky(10, seed), strict=True))
    for mistake in (other, epochs):
        side, change, _ = MISTAKES[mistake]
        change(tables[side], np.random.default_rng(seed))
    found = solved(tmp_path_factory.mktemp("pair"), **tables)[0]
    left = re.search(r"corrected, chi2 is ([\d.e+]+) times its expectation", found)
    is_told = "no known mistake" in found or (left is not None and float(left[1]) > 5.0)  # something else is wrong too
    assert is_told or all(re.search(MISTAKES[one][2], found) for one in (epochs, other)), found


@pytest.mark.parametrize(("n", "seed"), [(5, 1), slow(20, 2), slow(60, 3)])
def test_a_sky_without_a_mistake_is_not_suspected(tmp_path, n, seed):
    satellite, reference = sky(n, seed)
    assert not suspicions(solved(tmp_path, satellite, reference))


def written(folder, *tables):
    """Write a satellite's table and a reference's; return their paths as text."""
    paths = [folder / "satellite.csv", folder / "reference.csv"]
    for path, table in zip(paths, tables, strict=True):
        table.write(path)
    return [str(path) for path in paths]


def test_an_absurd_link_is_printed_but_not_written_unless_it_is_accepted(tmp_path):
    satellite, reference = sky(8, 4)
    without_cosine(satellite, None)
    tables = written(tmp_path, satellite, reference)
    command = ["tie", *tables, "-o", str(tmp_path / "tie.zarr")]
    refused = CliRunner().invoke(main, command)
    first = " ".join(refused.stdout.split())
    assert (refused.exit_code, first.startswith("warning: chi2 is ")) == (1, True)
    assert "pmra of the satellite is mu_alpha, without cos(dec): say --without-cos-dec satellite" in first
    assert "epsilon_x" in refused.stdout
    assert "Nothing is written; --accept-misfit accepts it" in refused.stderr
    assert not (tmp_path / "tie.zarr").exists()
    accepted = CliRunner().invoke(main, [*command, "--accept-misfit"])
    assert (accepted.exit_code, accepted.stdout) == (0, refused.stdout)
    cured = CliRunner().invoke(main, ["tie", *tables, "--without-cos-dec", "satellite"])
    assert (cured.exit_code, "warning" in cured.stdout) == (0, False)
    with pytest.raises(SweepError, match="accept_misfit=True accepts it") as error:
        linksweep.tie(*tables)
    assert first.startswith(f"warning: {error.value.link.attrs['misfit']}")


def test_a_study_of_absurd_tables_is_refused_with_the_cause(tmp_path):
    satellite, reference = sky(8, 4)
    satellite["ref_epoch"] += 0.5
    tables = dict(zip(("satellite", "reference"), written(tmp_path, satellite, reference), strict=True))
    study = {"experiment": "linksweep.sweep.tie.experiment:tie", "fixed": tables, "sampling": {"n_sim": 2}}
    with pytest.raises(SweepError, match=r"epochs of the satellite 0.5 years too late.*accept_misfit = true"):
        linksweep.run(study, tmp_path / "s.zarr", pool="serial")
    study["fixed"] = tables | {"accept_misfit": True}
    assert "0.5 years too late" in linksweep.run(study, tmp_path / "s.zarr", pool="serial").attrs["warnings"]


@pytest.mark.parametrize("size", [slow(2.5), 10.0])
def test_a_real_misfit_has_no_invented_cause(tmp_path, size):
    """Errors that are too small by a factor, as those of radio stars are, also where it is said first."""
    satellite, reference = sky(12, 6)
    rng = np.random.default_rng(1)
    for k, name in enumerate(NAMES):
        reference[name] += (
            size * rng.normal(size=len(reference)) * reference[f"{name}_error"] / (1.0 if k > 1 else 3.6e6)
        )
    found = solved(tmp_path, satellite, reference)[0]
    assert found.startswith("chi2 is ")
    assert found.endswith("no known mistake explains it: errors may be too small, or sources not single")


def test_sources_that_alone_carry_the_excess_are_named(tmp_path):
    satellite, reference = sky(12, 6)
    bad = reference["source_id"][0]
    at = reference["source_id"] == bad
    reference["dec"][at] += np.random.default_rng(1).normal(size=np.count_nonzero(at)) * 30.0 / 3.6e6
    assert f"without {bad} it is " in solved(tmp_path, satellite, reference)[0]


def test_quasars_without_an_epoch_are_mean_positions(tmp_path):
    """An epoch instead would displace them by the noise of the satellite's parallaxes."""
    rng, n = np.random.default_rng(3), 300
    ra, dec = rng.uniform(0.0, 360.0, n), np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, n)))
    satellite = Table({"name": [f"Q{i}" for i in range(n)], "ref_epoch": np.full(n, 2016.0), "ra": ra, "dec": dec})
    for name in NAMES:
        satellite[f"{name}_error"] = np.full(n, 0.1)
    for name in NAMES[2:]:
        satellite[name] = rng.normal(-0.02, 0.1, n)
    reference = satellite["name", "ra", "dec", "ra_error", "dec_error"]
    reference["dec"] = dec + rng.normal(0.0, 0.14, n) / 3.6e6
    tables = written(tmp_path, satellite, reference)
    unknowns = "orientation,position_glide"
    link = linksweep.tie(*tables, unknowns, extragalactic="reference")
    assert set(link.row_kind.values.tolist()) == {"position"}
    offset = (reference["dec"] - satellite["dec"]) * 3.6e6  # neither moved nor displaced
    np.testing.assert_allclose(link.difference.sel(observable="dec"), offset, atol=1e-6)
    obeyed = linksweep.tie(*tables, unknowns, reference_epoch=2015.5)
    assert any("if they are quasars, say --extragalactic reference" in note for note in obeyed.attrs["notes"])
