"""Tables carried into the other frame, against the simulation's exact step, ERFA, and derivatives by differences."""

import re
from contextlib import nullcontext
from dataclasses import replace

import erfa
import numpy as np
import pandas as pd
import pyarrow.parquet
import pytest
from astropy.table import Column, QTable, Table
from hypothesis import HealthCheck, given, settings, strategies as st

import linksweep
from linksweep.sweep.tie.tables import read_table
from tests.conftest import run_sweep
from tests.core.tie.made import DEGREE, MAS, NAMES, PAIRS, gaia, gaia_table, noise, seen_by_satellite, stars
from tests.sweep.tie.test_accelerations import drawn, satellite_table
from tests.tiers import few, slow

EPSILON, OMEGA = np.array([0.4, -0.3, 0.9]) * MAS, np.array([0.02, -0.1, 0.06]) * MAS
SIGNS = st.sampled_from(["reference-satellite", "satellite-reference"])
ANGLES = {"pmra": ("arcsec/yr", 1e-3), "pmra_error": ("arcsec/yr", 1e-3), "ra_error": ("uas", 1e3)}
TIME = {"pmra": ("ms/yr", 0), "pmra_error": ("ms/yr", 0), "ra_error": ("ms", 0)}  # of the parallel
ARCSEC = dict.fromkeys(("pmra", "pmdec", "pmra_error", "pmdec_error"), "arcsec/yr")
OWN = {name: f"my {name}" for name in ("ra", *ARCSEC)}
READ = [{"units": ARCSEC}, {"columns": OWN}, {"without_cos_dec": True}, {"epoch": 2016.0}, {"zero_errors": "missing"}]


def linked(folder, epsilon, omega, sign="reference-satellite", unknowns="orientation,spin", epoch=2016.0, noisy=True):
    """A link that has these numbers (rad, rad/yr), with a covariance that a link of two tables has."""
    truth = stars(30, 9)
    reference = gaia(folder / "reference.ecsv", truth)
    values = seen_by_satellite(truth, epsilon, omega) + noisy * noise(np.random.default_rng(1), truth)
    satellite = gaia(folder / "satellite.ecsv", replace(truth, values=values))
    link = linksweep.tie(satellite, reference, unknowns, sign=sign, epoch=epoch, accept_misfit=True)
    exact = {"orientation": epsilon, "spin": omega}
    numbers = np.concatenate([exact[name] for name in unknowns.split(",")]) / MAS
    link["estimate"][:] = numbers if sign == "reference-satellite" else -numbers
    return link


def values_of(table):
    return np.array([table[name] * (DEGREE if i < 2 else MAS) for i, name in enumerate(NAMES)])


@settings(max_examples=3, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(SIGNS, st.sampled_from([2006.0, 2020.0]), st.integers(0, 99))
def test_it_is_the_exact_inverse_of_what_the_satellite_sees(tmp_path, sign, epoch, seed):
    epsilon, omega = np.random.default_rng(seed).uniform(-300.0, 300.0, (2, 3)) * MAS
    link, truth = linked(tmp_path, epsilon, omega, sign, epoch=epoch), stars(25, seed, pm=200.0)
    then = epsilon + (2016.0 - epoch) * omega
    seen = gaia(tmp_path / "seen.ecsv", replace(truth, values=seen_by_satellite(truth, then, omega)))
    moved = linksweep.apply(link, Table.read(seen))
    np.testing.assert_allclose(values_of(moved), truth.values, rtol=0.0, atol=1e-6 * MAS)
    moved.write(tmp_path / "moved.ecsv", overwrite=True)
    back = linksweep.apply(link, tmp_path / "moved.ecsv", inverse=True)
    np.testing.assert_allclose(values_of(back), values_of(Table.read(seen)), rtol=0.0, atol=1e-6 * MAS)


def test_from_fk5_to_hipparcos_as_erfa_does(tmp_path):
    """ERFA rotates the frame, so its numbers are minus ours."""
    matrix, spin = erfa.fk5hip()
    link = linked(tmp_path, -erfa.rm2v(matrix), -matrix @ spin)
    fk5 = replace(stars(40, 5, pm=300.0), radial_velocity=np.zeros(40))
    gaia(tmp_path / "fk5.ecsv", fk5)
    ra, dec, parallax, pmra, pmdec = fk5.values
    arcsec = 1000.0 * MAS
    new = erfa.fk52h(ra, dec, pmra / np.cos(dec), pmdec, parallax / arcsec, np.zeros(40))
    moved = values_of(linksweep.apply(link, tmp_path / "fk5.ecsv"))
    both = np.array([new[0] % (2 * np.pi), new[1], new[2] * np.cos(new[1]), new[3]])
    np.testing.assert_allclose(moved[[0, 1, 3, 4]], both, rtol=0.0, atol=2e-5 * MAS)
    linksweep.apply(link, tmp_path / "fk5.ecsv", tmp_path / "hip.fits")
    back = erfa.h2fk5(*[*both[:2], both[2] / np.cos(both[1]), both[3]], parallax / arcsec, np.zeros(40))
    returned = values_of(linksweep.apply(link, tmp_path / "hip.fits", inverse=True))
    np.testing.assert_allclose(returned[:2], [back[0] % (2 * np.pi), back[1]], rtol=0.0, atol=2e-5 * MAS)


def test_the_covariance_of_the_link_is_added(tmp_path):
    """Against derivatives by differences of the estimate, with an orientation at another epoch than the stars'."""
    link, mine = linked(tmp_path, EPSILON, OMEGA, epoch=2011.0), stars(12, 3, pm=5000.0)
    table = gaia(tmp_path / "own.ecsv", mine)
    linksweep.apply(link, table, tmp_path / "moved.ecsv")
    derivatives = []
    for step in 10.0 * np.eye(6):
        ends = [values_of(linksweep.apply(link.assign(estimate=link.estimate + s), table)) for s in (step, -step)]
        derivatives.append((ends[0] - ends[1]) / (20.0 * MAS))
        derivatives[-1][0] *= np.cos(mine.values[1])
    jacobian = np.moveaxis(np.array(derivatives), 0, -1).swapaxes(0, 1)
    expected = mine.covariance() / MAS**2 + jacobian @ link.covariance.values @ jacobian.swapaxes(1, 2)
    result = read_table(tmp_path / "moved.ecsv").astrometry.covariance() / MAS**2
    np.testing.assert_allclose(result, expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("both", [slow(False), True])
@pytest.mark.parametrize(("form", "ending"), few(1, [("padded", "fits"), ("named", "ecsv"), ("text", "csv")]))
def test_only_covariances_of_what_is_turned_change_in_rows_with_accelerations(tmp_path, form, ending, both):
    truth, *made = drawn(12, 3)
    further = ["corr_vec"] if form == "named" else [f"{NAMES[i]}_{NAMES[j]}_corr" for i, j in PAIRS]
    other = satellite_table(tmp_path / "other.ecsv", truth, *made, "padded" if form == "named" else "named")
    table, moved = (tmp_path / f"{name}.{ending}" for name in ("own", "moved"))
    satellite_table(table, truth, *made, form, **(dict(Table.read(other)[further].items()) if both else {}))
    link = linksweep.tie(table, gaia(tmp_path / "reference.ecsv", truth), "orientation,spin", errors="formal")
    linksweep.apply(link, table, moved)
    before, after = (read_table(path).astrometry.covariance() for path in (table, moved))
    change = np.round((after - before) / MAS**2, 12)
    assert np.all(change[:, [0, 1, 3, 4], [0, 1, 3, 4]] > 0.0)
    change[:, :5, :5] = 0.0
    assert not np.any(change)
    if both:
        table = Table.read(moved)
        table.remove_columns([name for name in table.colnames if "corr" in name and name not in further])
        table.write(moved, overwrite=True)
        result = read_table(moved).astrometry.covariance()[:, :5, :5]
        np.testing.assert_allclose(result, after[:, :5, :5], rtol=1e-9, atol=1e-12 * after.max())


@pytest.mark.parametrize("has", [("ra_dec_corr",), ()])
def test_correlations_without_a_column_are_named_and_motions_without_errors_turned(tmp_path, has):
    link, mine = linked(tmp_path, EPSILON, OMEGA), Table.read(tmp_path / "satellite.ecsv")
    mine = mine[[name for name in mine.colnames if name in has or not name.endswith("_corr")]]
    whole, motion = linksweep.apply(link, mine), ["ra", "dec", "pmra", "pmdec"]
    lost = re.findall(r"\w+_corr\b", next(note for note in whole.meta["comments"] if note.endswith("lost")))
    pairs = ("ra_dec", "ra_pmra", "ra_pmdec", "dec_pmra", "dec_pmdec", "pmra_pmdec")
    assert {*lost, *has} == {f"{pair}_corr" for pair in pairs}
    bare = linksweep.apply(link, mine["source_id", "ref_epoch", *motion])
    assert np.all([bare[name] == whole[name] for name in motion])
    with pytest.raises(linksweep.SweepError, match="one coordinate of the motion"):
        linksweep.apply(link, mine["source_id", "ref_epoch", "ra", "dec", "pmra"])


@pytest.mark.parametrize("turn", [slow(-5.0), 5.0])
@pytest.mark.parametrize("low", [0.0, -180.0])
def test_right_ascensions_stay_in_the_range_of_the_table(tmp_path, turn, low):
    link = linked(tmp_path, [0.0, 0.0, turn * MAS], np.zeros(3))
    mine = gaia_table(stars(6, 2))
    mine["ra"] = ra = low + np.array([1e-9, 180.0 - 1e-9, 180.0, 180.0 + 1e-9, 350.0, 360.0 - 1e-9])
    moved = linksweep.apply(link, mine)["ra"]
    assert np.all((moved >= low) & (moved <= low + 360.0))
    np.testing.assert_allclose((moved - ra + 180.0) % 360.0 - 180.0, turn / 3.6e6, atol=1e-12)


@pytest.mark.parametrize("form", few(1, ["fits", "csv", "ecsv", "parquet"]))
def test_the_file_has_the_columns_of_the_input_and_a_tie_finds_no_rotation(tmp_path, form):
    link = linked(tmp_path, 20.0 * EPSILON, OMEGA, noisy=False)
    out = tmp_path / f"moved.{form}"
    result = linksweep.apply(link, tmp_path / "satellite.ecsv", out)
    written, before = Table.read(out), Table.read(tmp_path / "satellite.ecsv")
    assert written.colnames == before.colnames == result.colnames
    for name in ("source_id", "parallax", "parallax_error", "ref_epoch", "phot_g_mean_mag"):
        np.testing.assert_array_equal(written[name], before[name])
    again = linksweep.tie(out, tmp_path / "reference.ecsv", "orientation,spin")
    assert np.all(np.abs(again.estimate) < 1e-3 * again.errors.sel(error_kind="formal"))


def test_what_is_missing_is_missing_in_the_file_and_a_pole_is_a_place_like_others(tmp_path):
    link = linked(tmp_path, EPSILON, OMEGA)
    frame = pd.DataFrame({"source_id": [11, 12], "ref_epoch": 2016.0, "ra": [10.0, 20.0], "dec": [90.0, 2.0]})
    for name, kind, value in (("hip", "Int64", 5), ("var", "boolean", False), ("sp", object, "K0")):
        frame[name] = pd.Series([value, None], dtype=kind)
    frame.to_parquet(tmp_path / "gaps.parquet")
    linksweep.apply(link, tmp_path / "gaps.parquet", tmp_path / "moved.parquet")
    result = pyarrow.parquet.read_table(tmp_path / "moved.parquet").to_pydict()
    assert [*result] == [*frame]
    assert [result[name] for name in ("hip", "var", "sp")] == [[5, None], [False, None], ["K0", None]]
    assert result["dec"][0] == pytest.approx(90.0 - np.hypot(*EPSILON[:2]) / DEGREE, abs=1e-12)
    again = linksweep.apply(link, tmp_path / "moved.parquet", tmp_path / "back.ecsv", inverse=True)
    assert again["dec"].tolist() == pytest.approx(frame["dec"].tolist(), abs=1e-12)
    with pytest.raises(linksweep.SweepError, match="no truth value is missing in FITS"):
        linksweep.apply(link, tmp_path / "gaps.parquet", tmp_path / "moved.fits")


@pytest.mark.parametrize("units", [slow(ANGLES | {"dec": ("rad", DEGREE)}), TIME | {"ra": ("hourangle", 1.0 / 15.0)}])
def test_columns_keep_their_units_and_names(tmp_path, units):
    link = linked(tmp_path, EPSILON, OMEGA)

    def converted(table):
        table = table.copy()
        for name, (unit, factor) in units.items():
            by = factor or 1.0 / 15.0 / np.cos(np.radians(table["dec"]))
            table[name] = Column(table[name] * by, unit=unit)
        if "ra" not in units:
            table["ra"] = (table["ra"] + 180.0) % 360.0 - 180.0  # which the result keeps to
        table.rename_column("pmdec", "pm_dec")
        return table

    plain = Table.read(tmp_path / "satellite.ecsv")
    converted(plain).write(tmp_path / "units.ecsv")
    moved, expected = linksweep.apply(link, tmp_path / "units.ecsv"), converted(linksweep.apply(link, plain))
    for name in ("ra", "dec", "ra_error", "pmra", "pmra_error", "pm_dec", "ra_pmra_corr"):
        np.testing.assert_allclose(moved[name], expected[name], rtol=1e-12, err_msg=name)
        assert moved[name].unit == expected[name].unit
    with pytest.raises(linksweep.SweepError, match="CSV cannot say"):
        linksweep.apply(link, tmp_path / "units.ecsv", tmp_path / "units.csv")
    assert not (tmp_path / "units.csv").exists()
    with pytest.raises(linksweep.SweepError, match=r"cannot hold .* write \.ecsv") if "ra" in units else nullcontext():
        linksweep.apply(link, tmp_path / "units.ecsv", tmp_path / "units.fits")
    quantities = linksweep.apply(link, QTable.read(tmp_path / "units.ecsv"), tmp_path / "quantities.ecsv")
    np.testing.assert_array_equal(quantities["ra"], moved["ra"])


@pytest.mark.parametrize("said", [READ[0] | READ[1] | READ[2], *few(1, READ[::-1])], ids=" ".join)
def test_a_table_is_read_as_the_link_read_it_or_as_is_said(tmp_path, said):
    linked(tmp_path, EPSILON, OMEGA)
    of_satellite, reference, form = (tmp_path / name for name in ("satellite.ecsv", "reference.ecsv", "form.csv"))
    names = said.get("columns", {})

    def written(table):
        table = table.copy()
        for name in table.colnames:
            table[name].unit = None
            table[name] = table[name] / (1000.0 if name in said.get("units", {}) else 1)
        for name in ("pmra", "pmra_error") if "without_cos_dec" in said else ():
            table[name] = table[name] / np.cos(np.radians(table["dec"]))
        if "zero_errors" in said:
            table["parallax_error"][3] = 0.0
        if "epoch" in said:
            table.remove_column("ref_epoch")
        for name, another in names.items():
            table.rename_column(name, another)
        return table

    written(Table.read(of_satellite)).write(form)
    options = {"satellite_epoch" if name == "epoch" else name: value for name, value in said.items()}
    options |= {"without_cos_dec": "satellite"} if "without_cos_dec" in said else {}
    for name in ("units", "columns") & said.keys():
        options[name] = {f"satellite:{key}": value for key, value in said[name].items()}
    link = linksweep.tie(form, reference, "orientation,spin", accept_misfit=True, **options)
    usual = linksweep.tie(of_satellite, reference, "orientation,spin", accept_misfit=True)
    usual["estimate"][:], usual["covariance"][:] = link.estimate, link.covariance
    expected = written(linksweep.apply(usual, of_satellite))
    if said == {"units": ARCSEC}:  # another table, which says no units
        assert "is its unit right" in " ".join(linksweep.apply(link, of_satellite).meta["comments"])
        stated = Table.read(of_satellite)
        for name in ARCSEC:
            stated[name].unit = "mas/yr"
        for name in ARCSEC:
            np.testing.assert_array_equal(linksweep.apply(link, stated)[name], linksweep.apply(usual, stated)[name])
    for one, table, report in ((link, form, {}), (link, Table.read(form), {}), (usual, form, said)):
        moved = linksweep.apply(one, table, **report)
        assert moved.colnames == Table.read(form).colnames
        for name in moved.colnames:
            if name not in ("ra_parallax_corr", "dec_parallax_corr", "parallax_pmra_corr", "parallax_pmdec_corr"):
                np.testing.assert_allclose(moved[name], expected[name], rtol=1e-9, err_msg=name)


@pytest.mark.parametrize(("has", "lacks"), [("orientation", "spin"), ("spin", "orientation")])
def test_what_the_link_lacks_stays_and_is_said(tmp_path, has, lacks):
    link, mine = linked(tmp_path, EPSILON, OMEGA, unknowns=has, epoch=2011.0), gaia(tmp_path / "own.ecsv", stars(10, 4))
    moved, zero = linksweep.apply(link, mine), np.zeros(3)
    shared = linksweep.apply(link, gaia(tmp_path / "shared.ecsv", stars(10, 4), calibrator="J1", calibrator_error=0.5))
    np.testing.assert_allclose(shared["ra_error"], moved["ra_error"])  # that of the calibrator has its own column
    whole = linked(tmp_path, *((EPSILON, zero) if lacks == "spin" else (zero, OMEGA)))
    np.testing.assert_allclose(values_of(moved), values_of(linksweep.apply(whole, mine)), rtol=0.0, atol=1e-6 * MAS)
    assert all(words in " ".join(moved.meta["comments"]) for words in (f"the link has no {lacks}", "correlated"))


def test_what_cannot_be_carried_is_refused_by_name(here):
    linked(here, EPSILON, OMEGA)
    both = ("satellite.ecsv", "reference.ecsv")
    glide, bins = {"unknowns": "orientation,spin,glide"}, {"bins": ("phot_g_mean_mag", [8.0])}
    for options, said in ((glide, "has glide too"), (bins, "spin"), ({"known_spin": [0.1, 0.0, 0.0]}, "spin")):
        with pytest.raises(linksweep.SweepError, match=said):
            linksweep.apply(linksweep.tie(*both, **options), "satellite.ecsv")
    run_sweep("tie", *both, "-o", "tie.zarr", code=0)
    gaia(here / "dr4.ecsv", stars(10, 1, epoch=2017.5))
    bare = Table.read("satellite.ecsv")
    bare.remove_column("ref_epoch")
    bare.write("bare.ecsv")
    run_sweep("tie", "bare.ecsv", both[1], "--satellite-epoch", "2016", "-o", "said.zarr", code=0)
    Table({"a": [1]}).write("other.ecsv")
    gaia("hip.ecsv", stars(10, 1), RArad=np.ones(10), UW=["1.00" * 15] * 10)
    before = sorted(path.name for path in here.iterdir())
    for arguments, said in (
        (("tie.zarr", "dr4.ecsv", "-o", "o.fits"), "epoch 2017.5 in row 1"),
        (("said.zarr", "bare.ecsv", "-o", "o.fits", "--epoch", "2017.5"), "epoch 2017.5 in row 1"),
        (("satellite.ecsv", "satellite.ecsv", "-o", "o.fits"), "is no link of two tables"),
        (("tie.zarr", "satellite.ecsv", "-o", "dr4.ecsv"), "exists already"),
        (("tie.zarr", "other.ecsv", "-o", "o.fits"), "'ra'"),
        (("tie.zarr", "hip.ecsv", "-o", "o.fits"), "elements U1 to U15"),
    ):
        assert said in " ".join(run_sweep("apply", *arguments, code=2)[2].split())
    assert sorted(path.name for path in here.iterdir()) == before
    assert "by orientation and spin" in run_sweep("apply", "tie.zarr", "satellite.ecsv", "-o", "o.fits", code=0)[2]
