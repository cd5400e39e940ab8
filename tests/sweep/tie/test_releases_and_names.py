"""Which rows are taken as which star: identifiers of two releases, companions, leftovers; and Hipparcos-2 as it is."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Column, Table

import linksweep
from linksweep.core.frames import ARCSEC, DEGREE, MAS
from linksweep.core.tie.astrometry import joined, propagated
from linksweep.sweep.tie.tables import TableOptions, read_table
from tests.core.tie.made import POSITION, gaia, gaia_table, only, random_correlations, seen_by_satellite, stars
from tests.tiers import few

TURN = np.array([1.0, -2.0, 3.0]) * MAS
# How far rows are apart in errors, those of one in units of the other's, and what is said of them
REPEATED = [(0.0, 1.0, "the same numbers"), (1.9, 1.0, "nearly"), (0.28, 1.1, "nearly"), (0.32, 1.1, "")]
HIP2 = "{:6d}   5 0 1 {:13.10f} {:13.10f} {:7.2f} {:8.2f} {:8.2f}" + 5 * " {:6.2f}"  # of hip2.dat, byte by byte
HIP2 += "  60  0.50  0    0.0    0  9.5000 0.0010 0.020 0  0.500 0.010  0.550" + 15 * "{:7.2f}"


def still(n=12, epoch=2016.0, **options):
    return replace(stars(n, 3, epoch=epoch, **options), radial_velocity=np.zeros(n))


def two_tables(folder, n=12, ours=None, other=None, epoch=2017.5):
    made = still(n, epoch)
    there = propagated(made.values, made.radial_velocity, made.epoch, np.full(n, 2016.0))
    seen = replace(made, values=seen_by_satellite(made, TURN, 0.0 * TURN))
    other_made = replace(made, values=there, epoch=np.full(n, 2016.0))
    return gaia(folder / "own.ecsv", seen, **(ours or {})), gaia(folder / "other.ecsv", other_made, **(other or {}))


def said(link, words):
    return any(words in note for note in link.attrs["notes"])


def test_identifiers_of_two_releases_are_different_names(tmp_path):
    numbers = np.arange(12) + 100
    exchanged = np.roll(numbers, 1)  # the same numbers, of other stars
    ours = {"source_id": exchanged, "designation": [f"Gaia DR4 {number}" for number in exchanged]}
    other = {"source_id": numbers, "designation": [f"Gaia DR3 {number}" for number in numbers]}
    tables = two_tables(tmp_path, ours=ours, other=other)
    Table.read(tables[0])[1:].write(tables[0], overwrite=True)  # the first of other.ecsv is nobody
    link = linksweep.tie(*tables, "orientation,spin")
    np.testing.assert_allclose(link.estimate[:3], TURN / MAS, atol=1e-4)
    assert said(link, "identifiers of dr4 and dr3 are different names; stars are named as in other.ecsv")
    assert link.source.values.tolist() == [*map(str, numbers[1:])]
    # without designations the epochs say it
    bare = two_tables(tmp_path, ours={"source_id": exchanged}, other={"source_id": numbers})
    assert said(linksweep.tie(*bare, "orientation,spin"), "are different names")
    # another name that both have is as good as ever
    named = two_tables(tmp_path, ours=ours | {"hip": numbers}, other=other | {"hip": numbers})
    assert linksweep.tie(*named, "orientation").attrs["matched_by"] == "hip"


@pytest.mark.parametrize("by", few(2, [None, "HIP", "hip", "name"]))
def test_columns_of_names_are_the_same_in_any_case(tmp_path, by):
    numbers = np.arange(12) + 100
    tables = two_tables(tmp_path, ours={"hip": [*map(str, numbers[:-1]), ""]}, other={"HIP": numbers})
    link = linksweep.tie(*tables, "orientation", by=by)
    assert link.attrs["matched_by"] == "hip = HIP"
    assert said(link, "11; no name in row 12 of own.ecsv")
    with pytest.raises(linksweep.SweepError, match="like '100"):
        linksweep.tie(*tables, "orientation", by="hipp")


def test_sources_within_the_radius_and_leftovers_are_named(tmp_path):
    made = still(pm=0.0)
    values, rows = made.values.copy(), made.values.copy()
    values[:2, 1] = values[:2, 0] + np.array([0.0, 0.4 * ARCSEC])  # a companion of S0 in the satellite's table
    ours = gaia(tmp_path / "own.ecsv", replace(made, values=values), source_id=[f"A{k}" for k in range(12)])
    rows[1, 11] += 0.01  # nothing is there
    reference = gaia_table(replace(made, values=rows), source_id=[f"S{k}" for k in range(12)])
    reference.remove_row(1)
    reference.write(tmp_path / "other.ecsv")
    link = linksweep.tie(ours, tmp_path / "other.ecsv", "orientation", by="position", accept_misfit=True)
    assert said(link, "several sources are within the radius (A0 and A1); the nearest is taken")
    assert said(link, "1 of 11 rows of other.ecsv match no source: S11")


@pytest.mark.parametrize(("step", "factor", "words"), REPEATED)
def test_rows_that_repeat_another_of_their_source_are_named(tmp_path, step, factor, words):
    made, source = still(), np.arange(24) % 12 + 10**17
    moved = made.values + step * factor * made.errors / np.array([np.cos(made.values[1]), *np.ones((4, 12))])
    rows = joined(made, replace(made, values=moved, errors=factor * made.errors))
    twice = gaia(tmp_path / "twice.ecsv", replace(rows, radial_velocity=np.zeros(24)), source_id=source)
    link = linksweep.tie(gaia(tmp_path / "own.ecsv", made), twice, "orientation,spin", accept_misfit=True)
    assert said(link, f"row 13, 14, 15, 16, 17 and 7 more of twice.ecsv: {words}") == bool(words)


def test_raw_hip2_is_recognised_whatever_its_readme_says(tmp_path):
    rng = np.random.default_rng(4)
    made, wanted = stars(8), random_correlations(rng, 8)
    matrix = replace(made, errors=np.ones((5, 8)), correlations=wanted).covariance()[:, :5, :5]
    upper = np.linalg.cholesky(np.linalg.inv(matrix)).swapaxes(1, 2)
    elements = np.array([upper[:, i, j] for j in range(5) for i in range(j + 1)])
    elements *= 900.0 / np.abs(elements).max(axis=0)  # a factor is the same, and large numbers keep their digits
    sigma = rng.uniform(0.5, 2.0, (8, 5))
    each = enumerate(zip(made.values.T, sigma, elements.T, strict=True), start=1)
    lines = [HIP2.format(k, *row[:2], *(row[2:] / MAS), *errors, *element) for k, (row, errors, element) in each]
    assert set(map(len, lines)) == {276}
    (tmp_path / "hip2.dat").write_text("\n".join(lines) + "\n")
    (tmp_path / "ReadMe").write_text("Byte-by-byte Description of file: hip2.dat\n")  # which astropy cannot follow
    read = read_table(tmp_path / "hip2.dat")
    np.testing.assert_allclose(read.astrometry.values[:2], made.values[:2], atol=1e-10)
    np.testing.assert_allclose(read.astrometry.values[2:], made.values[2:], atol=0.006 * MAS)
    np.testing.assert_allclose(read.astrometry.errors / MAS, sigma.T, atol=0.006)
    np.testing.assert_allclose(read.astrometry.correlations, wanted, atol=2e-3)
    assert set(read.astrometry.epoch) == {1991.25}
    assert next(iter(read.names.values())).tolist() == [str(k + 1) for k in range(8)]
    (tmp_path / "cut.dat").write_text("\n".join([*lines[:2], lines[2][:200], *lines[3:]]))
    with pytest.raises(linksweep.SweepError, match="no such row in line 3"):
        read_table(tmp_path / "cut.dat")


def test_what_is_known_is_taken_out_in_the_sign_of_the_results(tmp_path):
    tables = two_tables(tmp_path)
    free = linksweep.tie(*tables, "orientation,spin", epoch=2016.0)
    known = {"known_orientation": [0.5, 0.0, -1.0], "known_spin": [0.0, 0.2, 0.0]}
    for sign, factor in (("reference-satellite", 1.0), ("satellite-reference", -1.0)):
        link = linksweep.tie(*tables, "orientation,spin", epoch=2016.0, sign=sign, **known)
        wanted = factor * free.estimate.values - np.concatenate(list(known.values()))
        np.testing.assert_allclose(link.estimate, wanted, atol=1e-5)


@pytest.mark.slow
def test_positions_of_one_epoch_give_epsilon_and_omega_only_together_and_are_no_release(tmp_path):
    made = still()
    for epoch in (2010.0, 2017.5):
        table = gaia_table(only(made, POSITION, epoch=np.full(12, epoch)))
        table.keep_columns(["source_id", "ra", "ra_error", "dec", "dec_error", "ref_epoch"])
        table.write(tmp_path / f"{epoch}.ecsv")
    link = linksweep.tie(tmp_path / "2010.0.ecsv", tmp_path / "2010.0.ecsv", epoch=2016.0, positions="mean")
    assert said(link, "determine only epsilon + t omega, here t = -6 years")
    assert link.unknown.values.tolist() == ["epsilon_x", "epsilon_y", "epsilon_z"]
    link = linksweep.tie(gaia(tmp_path / "own.ecsv", made), tmp_path / "2017.5.ecsv", "orientation", accept_misfit=True)
    assert (link.attrs["matched_by"], said(link, "different names")) == ("source_id", False)
    campaigns = gaia(tmp_path / "campaigns.ecsv", replace(made, epoch=np.repeat([2016.0, 2020.0], 6)))
    assert len(read_table(campaigns).astrometry) == 12


@pytest.mark.slow
def test_a_row_for_each_star_is_a_table_in_every_format(tmp_path, sweep):
    tables = two_tables(tmp_path, ours={"source_id": [f"S{k}" for k in range(12)]})
    link = linksweep.tie(*tables, "orientation,spin", by="position")
    arguments = [*map(str, tables), "--unknowns", "orientation,spin", "--by", "position", "-o", "a.zarr"]
    assert sweep("tie", *arguments, cwd=tmp_path)[0] == 0
    out = sweep("show", "a.zarr", "--stars", "--format", "ecsv", cwd=tmp_path)[1]
    table, shifts = Table.read(out, format="ascii.ecsv"), link.estimate_without - link.estimate
    assert table["source"].tolist() == link.source.values.tolist()
    np.testing.assert_allclose(table["q_over_n"], link.discrepancy / link.n_observations)
    np.testing.assert_allclose(table["share_spin"], link.share.sel(block_name="spin"))
    for name in link.unknown.values:
        np.testing.assert_allclose(table[f"shift_{name}"], shifts.sel(unknown=name), atol=1e-9)
    assert str(table["shift_omega_x"].unit) == "mas / yr"
    assert sweep("show", "a.zarr", "--stars", "--format", "csv", cwd=tmp_path)[1].count("\n") == 13
    assert "cook" in sweep("show", "a.zarr", "--stars", cwd=tmp_path)[1]


def test_only_rows_that_meet_a_condition_are_used(tmp_path):
    ruwe = {"ruwe": np.where(np.arange(12) < 8, 1.0, 3.0)}
    ours, other = two_tables(tmp_path, ours=ruwe, other={"snr": np.arange(12.0)})
    whole = linksweep.tie(ours, other, "orientation,spin")
    assert said(whole, "the usual choices would drop some (where): ruwe < 1.4 (4 rows)")
    Table.read(ours)[:8].write(tmp_path / "few.ecsv")
    few = linksweep.tie(tmp_path / "few.ecsv", other, "orientation,spin")
    chosen = linksweep.tie(ours, other, "orientation,spin", where="ruwe < 1.4; ruwe < 9")
    assert int(whole.n_sources) == 12
    for link in (chosen, linksweep.tie(ours, other, "orientation,spin", where="reference: snr < 8")):
        np.testing.assert_array_equal(link.source, few.source)
        np.testing.assert_allclose(link.estimate, few.estimate, atol=1e-9)
    words = "where '(ruwe < 1.4) & (ruwe < 9)' keeps 8 of 12 rows"
    assert (said(chosen, words), said(chosen, "usual choices")) == (True, False)


def test_parallaxes_are_those_of_the_authors_package(tmp_path, monkeypatch):
    """Of columns of gaia_source: five- and six-parameter solutions, one of two and one too bright."""
    zpt = pytest.importorskip("zero_point").zpt
    rng, made = np.random.default_rng(1), stars(30)
    six, magnitude = np.arange(30) % 3 == 0, rng.uniform(7.0, 20.0, 30)
    solved = np.where(six, 95, 31)
    solved[4], magnitude[5] = 3, 4.0
    columns = {"phot_g_mean_mag": magnitude}
    columns["nu_eff_used_in_astrometry"] = np.where(six, np.nan, rng.uniform(1.2, 1.8, 30))
    columns["pseudocolour"] = np.where(six, rng.uniform(1.25, 1.7, 30), np.nan)
    columns |= {"ecl_lat": rng.uniform(-90.0, 90.0, 30), "astrometric_params_solved": solved}
    table = gaia(tmp_path / "gaia.ecsv", made, **columns | {"ecl_lat": Column(columns["ecl_lat"] * DEGREE, unit="rad")})
    result = read_table(table, TableOptions(parallax_zero_point=True))
    zpt.load_tables()
    wanted = [0.0 if k in (4, 5) else zpt.get_zpt(*(column[[k]] for column in columns.values()))[0] for k in range(30)]
    np.testing.assert_allclose((made.values[2] - result.astrometry.values[2]) / MAS, wanted, atol=1e-9)
    assert any("zero points of 28 of 30 parallaxes subtracted" in note for note in result.notes)
    Table.read(table).write(tmp_path / "gaia.parquet")
    monkeypatch.setattr("linksweep.sweep.tie.setup.FROM_ROWS", 30)
    options = {"unknowns": "parallax", "parallax_zero_point": "satellite", "accept_misfit": True}
    links = [linksweep.tie(tmp_path / f"gaia.{form}", "zero-motion", **options) for form in ("ecsv", "parquet")]
    np.testing.assert_allclose(links[1].estimate, links[0].estimate, rtol=1e-9)


def bright(folder):
    """Write motions with the spin of bright stars of EDR3 (Cantat-Gaudin & Brandt 2021, three bins), and without it."""
    made = replace(stars(30, 2), radial_velocity=np.zeros(30))
    x, y, z = np.tile([[18.4, 27.3, 0.0], [33.8, 76.6, 0.0], [-11.3, 0.5, 0.0]], 10) * MAS / 1000.0
    values, (ra, dec) = made.values.copy(), made.values[:2]
    values[3] -= -np.sin(dec) * np.cos(ra) * x - np.sin(dec) * np.sin(ra) * y + np.cos(dec) * z
    values[4] -= np.sin(ra) * x - np.cos(ra) * y
    table = gaia(folder / "gaia.ecsv", made, phot_g_mean_mag=np.tile([8.0, 12.6, 15.0], 10))
    return table, gaia(folder / "true.ecsv", replace(made, values=values))


@pytest.mark.slow
def test_the_published_spin_of_bright_stars_is_subtracted_and_chi2_says_whether_its_sign_is_right(tmp_path):
    tables, bins = bright(tmp_path), ("phot_g_mean_mag", [10.0, 14.0])
    spins = Table.read("linksweep/sweeps/data/edr3-spin.ecsv")
    for known, factor in (("wrong", -100.0), ("too small to say", -0.1)):
        some = {name: factor * spins[name] if name.startswith("omega") else spins[name] for name in spins.colnames}
        Table(some).write(tmp_path / f"{known}.ecsv")
    spins["omega_x"].convert_unit_to("mas/yr")
    spins.write(tmp_path / "spins.ecsv")
    spins.meta["sign"] = "foo"
    spins.write(tmp_path / "unsigned.ecsv")
    with pytest.raises(linksweep.SweepError, match="sign 'foo' in its metadata: must be"):
        linksweep.tie(*tables, "spin", known_spin=tmp_path / "unsigned.ecsv")
    as_it_is = linksweep.tie(*tables, "spin", bins=bins)
    np.testing.assert_allclose(as_it_is.spin_by_bin[0], [-0.0184, -0.0338, 0.0113], atol=1e-6)
    for sign in ("reference-satellite", "satellite-reference"):
        for known in ("edr3-spin", tmp_path / "spins.ecsv"):
            link = linksweep.tie(*tables, "spin", bins=bins, known_spin=known, sign=sign)
            np.testing.assert_allclose(link.estimate, 0.0, atol=1e-6)
    for known in ("spins", "wrong", "too small to say"):
        link = linksweep.tie(*tables, "spin", known_spin=tmp_path / f"{known}.ecsv", accept_misfit=True)
        (said,) = [note for note in link.attrs["notes"] if "with the opposite sign" in note]
        assert ("sign right?" in said) == (known == "wrong")
