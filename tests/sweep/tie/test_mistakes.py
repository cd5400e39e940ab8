"""Made skies with one mistake each, which is refused or named with its cause; without one nothing is suspected."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import Column, vstack
from astropy.time import Time
from click.testing import CliRunner

import linksweep
from linksweep import SweepError
from linksweep.core.frames import MAS
from linksweep.core.tie.astrometry import parallax_factors, propagated
from linksweep.core.tie.mistakes import best_shift
from linksweep.sweep.cli import main
from tests.core.tie.made import NAMES, gaia, gaia_table, noise, seen_by_satellite, stars
from tests.sweep.tie.test_against_least_squares import drawn_tables, linked
from tests.tiers import few, slow

EPSILON, OMEGA = np.array([0.8, -1.5, 0.6]) * MAS, np.array([-0.12, 0.25, 0.07]) * MAS
POSITIONS, MOTIONS = ("ra_error", "dec_error"), ("pmra", "pmdec")
ERRORS = tuple(f"{name}_error" for name in NAMES)
EXCHANGED = {a + end: lambda t, name=b + end: t[name] for a, b in (MOTIONS, MOTIONS[::-1]) for end in ("", "_error")}
WITHOUT_COS = {n: lambda table, n=n: table[n] / np.cos(np.radians(table["dec"])) for n in ("pmra", "pmra_error")}
VELOCITIES = {n: lambda t, n=n: 4.74 * t[n] / t["parallax"] for n in (*MOTIONS, *ERRORS[3:])}
BESSELIAN = {"ref_epoch": lambda table: Time(table["ref_epoch"], format="jyear").byear}
VARIANCES = {n: lambda table, n=n: table[n] ** 2 for n in POSITIONS}
DECLARED = {n: lambda table, n=n: Column(table[n].data, unit="deg") for n in POSITIONS}


def sky(n, seed, pm=60.0, scale=1.0, silent=False):
    """Return a satellite's table and VLBI rows: three or four positions of a star, and some motions and parallaxes;
    if ``silent`` with twice as many stars of which the rows say nothing.
    """
    rng = np.random.default_rng(seed)
    truth, names = stars(n, seed + 1, pm, parallax=15.0), 10**17 + 7 * np.arange(n)
    ours = replace(truth, values=seen_by_satellite(truth, EPSILON, OMEGA))
    step = noise(rng, ours) / [np.cos(ours.values[1]), *np.ones((4, n))]
    source = np.concatenate([np.repeat(np.arange(n), 3 + np.arange(n) % 2), np.arange(0, n, 2)])
    size, there = len(source), truth.taken(source)
    is_motion = np.arange(size) >= size - (n + 1) // 2
    epoch = np.where(is_motion, 2016.0, rng.uniform(2003.0, 2024.0, size))
    values = propagated(there.values, there.radial_velocity, there.epoch, epoch)
    along = np.array([np.cos(values[1]), np.ones(size)])
    values[:2] += ~is_motion * parallax_factors(*values[:2], epoch) * values[2] / along
    errors = scale * np.array([0.15, 0.2, 0.1, 0.05, 0.05])[:, None] * rng.uniform(0.5, 2.0, (5, size)) * MAS
    values += errors * rng.normal(size=(5, size)) / [along[0], *np.ones((4, size))]
    is_position = np.arange(5)[:, None] < 2
    errors = np.where(is_position != is_motion, errors, np.nan)
    values = np.where(is_position | is_motion, values, np.nan)  # every row says where the star is
    rows = gaia_table(replace(there, values=values, errors=errors, epoch=epoch), source_id=names[source])
    rows.keep_columns(["source_id", "ref_epoch", *NAMES, *ERRORS])
    tables = [gaia_table(replace(ours, values=ours.values + step), source_id=names), rows]
    for k in range(2 * silent):
        more = [table[np.isin(table["source_id"], names)] for table in tables]
        for name in (*NAMES, *ERRORS):
            more[1][name] = np.nan
        for table in more:
            table["source_id"] += 10**6 * (k + 1)
        tables = [vstack(pair) for pair in zip(tables, more, strict=True)]
    return tables


def scaled(names, factor):
    return {name: lambda table, name=name: factor * table[name] for name in names}


def epochs_moved(years):
    return {"ref_epoch": lambda table: table["ref_epoch"] + years}


def of_one(keys, change):
    """Return columns that are changed where the motion is largest, or in the first row that has none."""
    return {k: lambda t, k=k: np.where(np.arange(len(t)) == abs(t["pmra"]).argmax(), change(t[k]), t[k]) for k in keys}


def twice_with_other_digits(table, rng):
    again = table[[rng.choice(np.flatnonzero(np.isfinite(table["ra_error"])))]].copy()
    for name, digits in (("ra", 8), ("dec", 8), ("ra_error", 3)):
        again[name] = np.round(again[name], digits)
    table.add_row(again[0])


def names_exchanged(table, rng):
    one, other = rng.choice(np.unique(table["source_id"]), 2, replace=False)
    table["source_id"] = [{one: other, other: one}.get(name, name) for name in table["source_id"]]


def in_frame(table, rng, frame):
    there = SkyCoord(table["ra"], table["dec"], unit="deg").transform_to(frame).spherical
    table["ra"], table["dec"] = there.lon.deg, there.lat.deg
    table["source_id"] += frame == "galactic"  # without a name in common


MISTAKES = {
    "a century early there": ("reference", epochs_moved(-150.0), "no position .* of the reference 150 years too early"),
    "one star reversed": ("satellite", of_one(["pmra"], np.negative), r"without \d+ it is"),
    "one row late there": ("reference", of_one(["ref_epoch"], lambda t: t + 7), r"without \d+ it is"),
    "errors in uas": ("satellite", scaled(ERRORS, 1e3), "too large, uas taken for mas"),
    "one row twice": ("reference", twice_with_other_digits, "(nearly the|the same) numbers (of|as) another row"),
    "arcsec, most rows silent": ("reference", scaled(POSITIONS, 1e-3), "of pos.* small, arcsec", 60.0, 1.0, True),
    "galactic": ("reference", partial(in_frame, frame="galactic"), "frame and units of the positions right"),
    "mu_alpha": ("satellite", WITHOUT_COS, "pmra of the satellite is mu_alpha"),
    "mu_alpha there": ("reference", WITHOUT_COS, "pmra of the reference is mu_alpha"),
    "motions exchanged": ("satellite", EXCHANGED, "pmra and pmdec of the satellite exchanged"),
    "motions reversed": ("satellite", scaled(MOTIONS, -1.0), "proper motions of the satellite with reversed sign"),
    "a quarter year late there": ("reference", epochs_moved(0.25), "epochs of the reference 0.25 years too late"),
    "Besselian": ("reference", BESSELIAN, "reference in Besselian years, taken for Julian ones", 500.0, 0.1),
    "variances": ("reference", VARIANCES, "errors of pos.* reference too small, variances taken for err", 500.0, 0.1),
    "epochs cut": ("reference", {"ref_epoch": lambda t: np.floor(t["ref_epoch"])}, "epochs .* wrong in single rows"),
    "epochs rounded": ("reference", {"ref_epoch": lambda t: np.round(t["ref_epoch"], 2)}, "epoch has too few digits"),
    "no parallaxes": ("satellite", lambda t, rng: t.remove_columns([NAMES[2], ERRORS[2]]), r"no parallax of \d+, "),
    "epochs equal": ("reference", {"ref_epoch": lambda t: 0.0 * t["ref_epoch"] + 2016.0}, "epochs of .* equal"),
    "parallax in arcsec": ("satellite", scaled(["parallax"], 1e-3), "parallaxes of the satellite, arcsec taken"),
    "motions per 100 yr there": ("reference", scaled(MOTIONS, 100.0), "motions of the reference, per century taken"),
    "arcsec per 100 yr": ("satellite", scaled([*MOTIONS, *ERRORS[3:]], 0.1), "arcsec per century taken"),
    "velocities": ("satellite", VELOCITIES, "proper motions of the satellite in km/s, taken for mas/yr"),
    "position errors in deg": ("satellite", scaled(POSITIONS, 1.0 / 3.6e6), "deg taken for mas"),
    "B1950": ("reference", partial(in_frame, frame="fk4"), "frame and units of the positions right"),
    "position errors in rad there": ("reference", scaled(POSITIONS, MAS), "no (known m|instrument)"),
    "errors of ra in seconds": ("reference", scaled(["ra_error"], 1.0 / 1.5e4), "errors of ra.*(seconds of t|no inst)"),
    "errors in mas declared as deg": ("reference", DECLARED, "mas taken for deg"),
    "motion errors in uas": ("satellite", scaled(ERRORS[3:], 1e3), "of pmra are .* those of ra: is one .* in another"),
    "a parallax missing": ("satellite", of_one(["parallax"], lambda _: 999), r"without \d+ it is .*; no known mistake"),
    "errors that are NaN": ("reference", of_one(POSITIONS, lambda _: np.nan), "rows have no error of ra, dec"),
    "names exchanged": ("reference", names_exchanged, "exchanged|are the names"),
}


def with_mistake(n, seed, mistake):
    side, change, _, *how = MISTAKES[mistake]
    tables = dict(zip(("satellite", "reference"), sky(n, seed, *how), strict=True))
    if callable(change):
        change(tables[side], np.random.default_rng(seed))
    else:
        tables[side].update({name: column(tables[side]) for name, column in change.items()})
    return tables.values()


def written(folder, *tables):
    paths = [str(folder / "satellite.fits"), str(folder / "reference.fits")]
    for path, table in zip(paths, tables, strict=True):
        table.write(path, overwrite=True)
    return paths


def solved(folder, *tables, unknowns="orientation,spin"):
    try:
        return linksweep.tie(*written(folder, *tables), unknowns, accept_misfit=True).attrs["notes"]
    except SweepError as error:
        return [str(error)]


@pytest.mark.parametrize("mistake", few(5, MISTAKES))
@pytest.mark.parametrize(("n", "seed"), [(9, 2), *(slow(n, n + seed) for n in (5, 60) for seed in (2, 3))])
def test_a_mistake_is_named(tmp_path, mistake, n, seed):
    result = solved(tmp_path, *with_mistake(n, seed, mistake))
    assert any(re.search(MISTAKES[mistake][2], note) for note in result), result


def test_a_shift_of_epochs_is_found_although_the_search_begins_far_from_it():
    assert best_shift(lambda years: (years + 3.0) ** 2 / (1.0 + years**2 / 12.0)) == pytest.approx(-3.0)


@pytest.mark.parametrize(("n", "seed", "larger"), [(5, 1, 1.0), (4, 1, 20.0), slow(20, 2, 1.0), slow(60, 3, 1.0)])
def test_a_sky_without_a_mistake_is_not_suspected(tmp_path, n, seed, larger):
    satellite, reference = sky(n, seed)
    satellite.update({k: larger * satellite[k] for k in POSITIONS})  # of four sources, however many rows share it
    usual = "of the weight|have no error of ra, dec, which"
    assert not [note for note in solved(tmp_path, satellite, reference) if not re.search(usual, note)]


@pytest.mark.slow
def test_an_absurd_link_is_printed_but_not_written_unless_it_is_accepted_also_in_a_study(tmp_path):
    tables = written(tmp_path, *with_mistake(8, 4, "mu_alpha"))
    command = ["tie", *tables, "-o", str(tmp_path / "tie.zarr")]
    refused = CliRunner().invoke(main, command)
    first = " ".join(refused.stdout.split())
    assert (refused.exit_code, first.startswith("warning: chi2 is "), "epsilon_x" in first) == (1, True, True)
    assert "pmra of the satellite is mu_alpha, without cos(dec): say --without-cos-dec satellite" in first
    assert ("written; --accept-misfit accepts it" in refused.stderr, (tmp_path / "tie.zarr").exists()) == (True, False)
    accepted = CliRunner().invoke(main, [*command, "--accept-misfit"])
    assert (accepted.exit_code, accepted.stdout) == (0, refused.stdout)
    cured = CliRunner().invoke(main, ["tie", *tables, "--without-cos-dec", "satellite"])
    assert (cured.exit_code, "warning" in cured.stdout) == (0, False)
    with pytest.raises(SweepError, match="accept_misfit=True accepts it") as error:
        linksweep.tie(*tables)
    assert first.startswith(f"warning: {error.value.link.attrs['misfit']}")
    tables = dict(zip(("satellite", "reference"), tables, strict=True))
    study = {"experiment": "linksweep.sweep.tie.experiment:tie", "fixed": tables, "sampling": {"n_sim": 2}}
    with pytest.raises(SweepError, match=r"pmra of the satellite is mu_alpha.*accept_misfit = true"):
        linksweep.run(study, tmp_path / "s.zarr", pool="serial")
    study["fixed"] = tables | {"accept_misfit": True}
    assert "is mu_alpha" in linksweep.run(study, tmp_path / "s.zarr", pool="serial").attrs["warnings"]


@pytest.mark.slow
@pytest.mark.parametrize("size", [2.5, 10.0])
def test_a_real_misfit_has_no_invented_cause_and_sources_that_alone_carry_it_are_named(tmp_path, size):
    satellite, reference = sky(8, 6)
    rng = np.random.default_rng(1)
    for k, name in enumerate(NAMES):
        step = size * rng.normal(size=len(reference)) * reference[f"{name}_error"]
        reference[name] += step / (1.0 if k > 1 else 3.6e6)
    assert re.search("no known mistake .* or sources not single$", solved(tmp_path, satellite, reference)[0])
    satellite, reference = sky(8, 6)
    at = reference["source_id"] == (bad := reference["source_id"][0])
    reference["dec"][at] += np.random.default_rng(1).normal(size=np.count_nonzero(at)) * 30.0 / 3.6e6
    assert f"without {bad} it is " in solved(tmp_path, satellite, reference)[0]
    reference = satellite.copy()
    reference.remove_columns([name for name in reference.colnames if name.endswith("_corr")])
    for k, name in enumerate(NAMES):
        reference[f"{name}_error"] *= 4.0
        reference[name] += rng.normal(size=8) * reference[f"{name}_error"] / (1.0 if k > 1 else 3.6e6)
    for name in (*MOTIONS, *ERRORS[3:]):
        reference[name][0] /= 1e3
    assert f"without {bad} it is " in solved(tmp_path, satellite, reference)[0]  # although it fits well itself
    satellite, reference = sky(15, 7)
    reference = reference[np.isfinite(reference["pmra_error"])]["source_id", *MOTIONS, *ERRORS[3:]]
    names_exchanged(reference, rng)  # without positions, which would tell
    assert "exchanged in the reference (corrected" in solved(tmp_path, satellite, reference, unknowns="spin")[0]
    many = gaia(tmp_path / "many.fits", stars(2100, pm=0.05), pmra=1e4 * (np.arange(2100) == 20))  # not in the sample
    alone = linksweep.tie(many, "zero-motion", "spin", accept_misfit=True).attrs["misfit"]
    assert re.search("rows of the reference; no known mistake .* or sources not single$", alone)
    notes = linked(drawn_tables(tmp_path, 1, scale=3.0)).attrs["notes"]  # some positions say nothing without motions
    assert any("most of it in the proper motions of the five-parameter rows of" in note for note in notes)
