"""Tables of every kind, what is missing in them, and what is wrong with them."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.coordinates import Angle, SkyCoord
from astropy.table import MaskedColumn, Table
from astropy.time import Time

from linksweep import SweepError, answer, tie
from linksweep.core.frames import ARCSEC, DEGREE, MAS, triad
from linksweep.core.tie.astrometry import PAIRS, kinds, propagated
from linksweep.sweep.tie.setup import match
from linksweep.sweep.tie.tables import TableOptions, read_table
from tests.core.tie.made import NAMES, gaia, gaia_table, only, seen_by_satellite, stars

WRITTEN = [("deg", 7), ("deg", 6), ("arcsec", 3), ("hms", 4), ("rad", 9), ("deg", 12), ("hms", 8)]
WHEN = Time([1991.25, 2016.0, 2030.4], format="jyear", scale="tdb")
YEARS = ([f"{letter}{year}" for year in WHEN.jyear] for letter in ("J", ""))
UTC = {zone: Time(WHEN.mjd + days, format="mjd", scale="tdb") for zone, days in (("Z", 0.0), ("-05:30", -5.5 / 24.0))}
ZONED = ([f"{text}{zone}" for text in when.isot] for zone, when in UTC.items())
TEXTS = *ZONED, *YEARS, [f"B{y:.6f}" for y in WHEN.byear]
EXACTLY = [(when, 1e-6) for when in (WHEN.jyear, WHEN.mjd, WHEN.jd, WHEN)]
TIMES = [("fits", Time(WHEN.jyear, format="jyear", scale=scale), 0.01) for scale in ("tcb", "tai")]
FORMS = [*EXACTLY, *((text, 0.01) for text in (*TEXTS, WHEN.datetime64))]
VIZIER = ("RA", "DE", "Plx", "pmRA", "pmDE")
POSITIONS = [("RA_ICRS", "DE_ICRS", "tsv"), ("_RA.icrs", "_DE.icrs", "vot"), ("RAJ2000", "DEJ2000", "ecsv")]
ICRF = """
ICRF J000211.9-215309  2359-221     00 02 11.98262436  -21 53 09.8359742  0.00115400 0.0386714   0.971  54818.7 548
ICRF J001031.0+105829  0007+106  D  00 10 31.00590186   10 58 29.5043827  0.00000491 0.0000930  -0.187  53063.9 472
ICRF J001031.0-001000  x            23 10 31.00590186  -00 10 00.0000000  0.00000491 0.0000930  -0.187  53063.9 472
"""


def test_blank_values_decide_the_kind_and_are_no_zeros(tmp_path):
    made, changes, blank = stars(4), {}, np.array([False, True, False, False])
    for i, name in enumerate(NAMES[2:], 2):
        changes[name] = MaskedColumn(made.values[i] / MAS, mask=blank)
        changes[f"{name}_error"] = MaskedColumn(made.errors[i] / MAS, mask=blank)
    changes["pmra_pmdec_corr"] = MaskedColumn(made.correlations[9], mask=blank)
    changes["radial_velocity"] = MaskedColumn(made.radial_velocity, mask=[True, False, False, True])
    result = read_table(gaia(tmp_path / "g.ecsv", made, **changes)).astrometry
    assert list(kinds(result)) == ["five-parameter", "single epoch", "five-parameter", "five-parameter"]
    assert np.all(np.isnan(result.values[2:, 1]))
    assert np.isnan(result.radial_velocity[0])
    zeros = gaia(tmp_path / "z.ecsv", made, **{f"{name}_error": [0.1, 0.0, 0.1, 0.1] for name in NAMES[2:]})
    missing, exact = (read_table(zeros, TableOptions(zero_errors=how)).astrometry for how in ("missing", "exact"))
    assert (list(kinds(missing)), list(exact.errors[2:, 1])) == (list(kinds(result)), [0.0] * 3)
    blank = {f"{NAMES[i]}_{NAMES[j]}_corr": MaskedColumn(np.zeros(4), mask=True) for i, j in PAIRS}
    for ending in ("ecsv", "fits"):
        result = read_table(gaia(tmp_path / f"blank.{ending}", made, **blank)).astrometry
        np.testing.assert_array_equal(result.correlations, 0.0)  # as without these columns


def test_errors_of_ra_in_the_icrf_are_seconds_of_time_and_those_of_other_rows_in_hours_need_a_unit(tmp_path):
    (tmp_path / "icrf.txt").write_text(ICRF)
    table = read_table(tmp_path / "icrf.txt")
    result = table.astrometry
    dec = -(21 + 53 / 60 + 9.8359742 / 3600) * DEGREE
    assert result.values[1, 0] == pytest.approx(dec, rel=1e-15)
    assert result.values[1, 2] == pytest.approx(-10 / 60 * DEGREE)  # -00 deg is south
    assert result.errors[0, 0] == pytest.approx(0.001154 * 15 * np.cos(dec) * ARCSEC)
    assert (result.errors[1, 0], result.correlations[0, 0]) == (pytest.approx(0.0386714 * ARCSEC), 0.971)
    assert list(table.names["iers_name"]) == ["2359-221", "0007+106", "x"]
    assert list(kinds(result)) == ["position"] * 3
    row = {"star": ["HR 1099"], "mjd": [57388.5], "ra": ["12:00:00.0"], "dec": ["-00:30:00"], "e_ra": [1e-5]}
    Table(row | {"e_dec": [2e-4]}, units={"e_ra": "s", "e_dec": "arcsec"}).write(tmp_path / "vlbi.ecsv")
    result = read_table(tmp_path / "vlbi.ecsv").astrometry
    np.testing.assert_allclose(result.values[:2, 0], [np.pi, -0.5 * DEGREE], rtol=1e-9)
    np.testing.assert_allclose(result.errors[:2, 0], np.array([0.15 * np.cos(0.5 * DEGREE), 0.2]) * MAS, rtol=1e-9)
    assert result.epoch[0] == pytest.approx(2016.0, abs=1e-3)
    assert list(kinds(result)) == ["single epoch"]
    assert list(kinds(read_table(tmp_path / "vlbi.ecsv", TableOptions(positions="mean")).astrometry)) == ["position"]
    (tmp_path / "t.csv").write_text("name,epoch,RA,Dec,e_RA,e_Dec\nA,2015.5,1 2 3.4,-5 6 7.8,0.1,0.2\n")
    with pytest.raises(SweepError, match="column 'RA' is sexagesimal, and 'e_RA' has no unit") as refused:
        read_table(tmp_path / "t.csv")
    assert "--unit dec_error=mas" in str(refused.value)
    options = TableOptions(units={"ra_error": "ms", "dec_error": "mas"})
    errors = read_table(tmp_path / "t.csv", options).astrometry.errors
    np.testing.assert_allclose(errors[:2, 0] / MAS, [1.5 * np.cos(np.radians(5.1021667)), 0.2], rtol=1e-6)


def test_matching_by_name_and_by_position_with_proper_motion(tmp_path):
    made = stars(6, pm=3000.0)
    left = read_table(gaia(tmp_path / "a.ecsv", made))
    moved = propagated(made.values, made.radial_velocity, made.epoch, made.epoch - 20.0)
    moved[1, :3] += 0.4 * ARCSEC
    order = np.array([4, 2, 0])
    other = replace(made, values=moved, epoch=made.epoch - 20.0).taken(order)
    right = read_table(gaia(tmp_path / "b.ecsv", other))
    for by, expected in (("position:0.5", order), ("position:0.3", order[:1]), ("source_id", [0, 1, 2])):
        np.testing.assert_array_equal(match(left, right, by).source, expected)


def test_the_dataset_states_its_epoch_units_spins_by_bins_and_large_shares(tmp_path):
    made = stars(25)
    truth = epsilon, omega = np.array([0.4, -0.3, 0.9]), np.array([-0.2, 0.1, 0.3])
    satellite = gaia(tmp_path / "sat.ecsv", replace(made, values=seen_by_satellite(made, *np.array(truth) * MAS)))
    reference = gaia(tmp_path / "ref.ecsv", made)
    link = tie(satellite, reference, errors="jackknife,bootstrap", epoch=2020.0)
    np.testing.assert_allclose(link.estimate, [*(epsilon + 4.0 * omega), *omega], atol=1e-6)
    assert list(link.error_kind.values) == ["jackknife", "bootstrap", "formal", "scaled"]
    assert (list(link.unit.values), link.attrs["epoch"]) == (["mas"] * 3 + ["mas/yr"] * 3, 2020.0)
    assert len(link.attrs["satellite_sha256"]) == 64
    plain = tie(satellite, reference, errors="formal", epoch=2020.0)
    x, spread = plain.estimate.values[:3], plain.covariance.values[:3, :3]
    _, _, length, _, error, unit, *more = answer(plain).sentences[0].split()  # Turned by 2 ± 1 mas (1, 1, 1), ...
    expected = np.linalg.norm(x), np.sqrt(x @ spread @ x) / np.linalg.norm(x)
    assert ((float(length), float(error)), unit) == (pytest.approx(expected, rel=0.06), "mas")
    assert [float(text.strip("(),")) for text in more[:3]] == pytest.approx(x.tolist(), abs=0.06 * expected[1])
    assert [answer(one).sentences[0].split()[-2] for one in (link, plain)] == ["jackknife", "formal"]
    binned = tie(satellite, reference, bins=("phot_g_mean_mag", [4.0, 6.0, 8.0]))  # none below
    np.testing.assert_allclose(binned.spin_by_bin, [omega] * 3, atol=1e-5)
    made.errors[:, 7] /= 300.0
    heavy = tie(gaia(tmp_path / "s.ecsv", made), gaia(tmp_path / "r.ecsv", made))
    assert any(str(10**17 + 7) in note and "% of the weight" in note for note in heavy.attrs["notes"])


def test_the_galactic_aberration_carries_the_icrf(tmp_path):
    """Positions of 2015.0, moved by the glide towards the Galactic centre to 2020.0, are those of a satellite there."""
    to_centre = np.array(SkyCoord(l=0.0, b=0.0, unit="deg", frame="galactic").icrs.cartesian.xyz)
    exact = {"errors": np.full((5, 40), 0.01 * MAS), "correlations": np.zeros((10, 40))}
    made = only(stars(40, 2, pm=0.0, epoch=2020.0), np.arange(5) != 2, **exact)
    (ra, dec), values = made.values[:2], made.values.copy()
    p, q, _ = triad(ra, dec)
    values[:2] += 5.0 * 5.8e-3 * MAS * np.array([to_centre @ p / np.cos(dec), to_centre @ q])
    gaia(tmp_path / "gaia.ecsv", replace(made, values=values))
    quasars = gaia_table(made)["source_id", "ra", "dec", "ra_error", "dec_error"]
    quasars.meta["extragalactic"] = True
    quasars.write(tmp_path / "quasars.ecsv")
    both = tmp_path / "gaia.ecsv", tmp_path / "quasars.ecsv"
    np.testing.assert_allclose(tie(*both, "orientation,position_glide", aberration=5.8).estimate, 0.0, atol=1e-5)
    np.testing.assert_allclose(tie(*both, "orientation,position_glide").estimate[3:], -0.029 * to_centre, atol=1e-4)


def test_rows_far_from_the_source_of_their_name_are_said_and_refused(tmp_path):
    made = stars(6)
    satellite = gaia(tmp_path / "sat.ecsv", made)
    wrong = gaia(tmp_path / "wrong.ecsv", made, source_id=10**17 + np.array([0, 1, 2, 4, 3, 5]))
    with pytest.raises(SweepError, match=r"row 4, 5 of wrong.ecsv: up to .* deg from .*; are the names"):
        tie(satellite, wrong)
    far = gaia(tmp_path / "far.ecsv", made, dec=made.values[1] / DEGREE + (np.arange(6) == 3) / 180.0)
    notes = tie(satellite, far, accept_misfit=True).attrs["notes"]
    assert any("row 4 of far.ecsv: up to 20 arcsec from the source of the same name" in note for note in notes)
    fast = replace(made, values=made.values * np.array([1.0, 1.0, 1.0, 100.0, 100.0])[:, None])  # 10 arcsec/yr
    later = propagated(fast.values, fast.radial_velocity, fast.epoch, fast.epoch + 20.0)
    moved = gaia(tmp_path / "moved.ecsv", replace(fast, values=later, epoch=fast.epoch + 20.0))
    assert "of the same name" not in str(tie(gaia(tmp_path / "fast.ecsv", fast), moved).attrs["notes"])


@pytest.mark.parametrize("lost", ["ra_pmra_corr", "ra_dec_corr", "parallax_pmdec_corr"])
@pytest.mark.parametrize("way", ["misnamed", "blank", "all others too"])
def test_a_correlation_that_is_not_there_is_said(tmp_path, lost, way):
    table = gaia_table(stars(4))
    if way == "blank":
        table[lost] = MaskedColumn(np.zeros(4), mask=True)
    else:
        table.rename_column(lost, lost.replace("corr", "correlation"))
    others = [name for name in table.colnames if name.endswith("_corr")]
    table.remove_columns(others[1:] if way == "all others too" else [])
    table.write(tmp_path / "g.csv")
    notes = " ".join(read_table(tmp_path / "g.csv").notes)
    assert ("correlation: not used; if these" in notes) == (way != "blank")
    assert f"no {lost}" in notes or "and 4 more" in notes
    gaia(tmp_path / "whole.csv", stars(4))
    assert not read_table(tmp_path / "whole.csv").notes


@pytest.mark.parametrize(("unit", "digits"), WRITTEN)
def test_positions_that_lost_digits_are_said(tmp_path, unit, digits):
    table = gaia_table(stars(40))
    for name in ("ra", "dec"):
        angle = Angle(table[name], "deg")
        if unit == "hms":
            form = {"unit": "hourangle" if name == "ra" else "deg", "sep": ":", "precision": digits, "pad": True}
            table[name] = angle.to_string(**form)
        else:
            table[name] = [f"{value:.{digits}f}" for value in angle.to_value(unit)]
    table.write(tmp_path / "g.csv")
    said = dict.fromkeys(("ra_error", "dec_error"), "mas") | ({} if unit == "hms" else {"ra": unit, "dec": unit})
    lost = [note for note in read_table(tmp_path / "g.csv", TableOptions(units=said)).notes if "digits lost" in note]
    assert [note.split()[1] for note in lost] == (["ra", "dec"] if digits < 8 or unit == "rad" else [])


@pytest.mark.parametrize(("ending", "epoch", "days"), [*(("ecsv", *form) for form in FORMS), *TIMES])
def test_epochs_in_every_form_are_those_of_astropy(tmp_path, ending, epoch, days):
    columns = {"ra": [10.0, 20.0, 30.0], "dec": [0.0] * 3, "ra_error": [1.0] * 3, "dec_error": [1.0] * 3}
    Table(columns | {"epoch": epoch}).write(tmp_path / f"t.{ending}")
    result = read_table(tmp_path / f"t.{ending}").astrometry.epoch
    np.testing.assert_allclose(result, WHEN.jyear, rtol=0.0, atol=days / 365.25)
    Table(columns | {"epoch": [2016.0, *WHEN.mjd[1:]]}).write(tmp_path / "mixed.ecsv")
    with pytest.raises(SweepError, match="that is no Julian year"):
        read_table(tmp_path / "mixed.ecsv")


@pytest.mark.parametrize(("ra", "dec", "form"), [*POSITIONS, ("_RAJ2000", "_DEJ2000", "tsv")])
def test_names_of_vizier_are_read_and_j2000_is_no_epoch_unless_that_is_said(tmp_path, ra, dec, form):
    """Its descriptions say the epochs of positions; without one J2000 is the equinox, and may be the epoch."""
    made, path = stars(6), tmp_path / f"t.{form}"
    names, correlations = [ra, dec, "Plx", "pmRA", "pmDE"], [f"{NAMES[i]}_{NAMES[j]}_corr" for i, j in PAIRS]
    table = gaia_table(made)[[*NAMES, *(f"{name}_error" for name in NAMES), "ref_epoch", *correlations]]
    pairs = [f"{VIZIER[i]}{VIZIER[j]}cor" if form != "ecsv" else f"{NAMES[j]}_{NAMES[i]}_corr" for i, j in PAIRS]
    table.rename_columns(table.colnames, [*names, *(f"e_{name}" for name in names), "Epoch", *pairs])
    if ra == "RA_ICRS":
        table["_RA"] = table["_DE"] = np.zeros(6)

    def written(stated, *absent):
        some = table[[name for name in table.colnames if name not in absent]]
        some[ra].description, some[ra].unit, some[dec].unit = f"Right ascension{stated}", "deg", "deg"
        if form == "tsv":
            lines = [f"#Column\t{ra}\t(F15.11)\tRight ascension{stated}\t[ucd=pos.eq.ra;meta.main]"]
            rows = ["\t".join(map(str, row)) for row in some]
            units = "\t".join("deg" if name in (ra, dec) else " " for name in some.colnames)
            path.write_text("\n".join([*lines, "\t".join(some.colnames), units, *rows]))
        else:
            some.write(path, overwrite=True, **({"format": "votable"} if form == "vot" else {}))
        return path

    read = read_table(written(" (ICRS) at Ep=2000.0", "Epoch"))
    assert set(kinds(read.astrometry)) == {"five-parameter"}
    np.testing.assert_allclose(read.astrometry.values, made.values, rtol=1e-14)
    np.testing.assert_allclose(read.astrometry.covariance(), made.covariance(), rtol=1e-10)
    without = read_table(written(" (ICRS) at Ep=2000.0", "Epoch"), TableOptions(pmra_cos_dec=False)).astrometry
    for plain, less in ((made.values, without.values), (made.errors, without.errors)):
        np.testing.assert_allclose(less[3], plain[3] * np.cos(made.values[1]), rtol=1e-12)
    assert set(read.astrometry.epoch) == {2000.0}
    assert any(f"positions are of 2000, says column {ra!r}" in note for note in read.notes)
    table["Epoch"][0] = 2000.0  # one row
    with pytest.raises(SweepError, match=f"column {ra!r} is of 2000, as its description says, or of the epochs in"):
        read_table(written(" at Epoch=J2000, proper motions taken into account"))
    table["Epoch"][0] = 2016.0
    motions = ("pmRA", "pmDE", "e_pmRA", "e_pmDE", *(name for name in pairs if "pm" in name))
    for stated, absent in (("", ()), (" (ICRS) at Ep=2015.0", motions)):  # the second may be a table of quasars
        with pytest.raises(SweepError, match="no column ref_epoch"):
            read_table(written(stated, "Epoch", *absent))
    if ra == "RA_ICRS":
        assert set(read_table(written("")).astrometry.epoch) == {2016.0}
    else:
        with pytest.raises(SweepError, match=f"column {ra!r} may be of 2000, or of the epochs in 'Epoch'"):
            read_table(written(" (FK5, Equinox=J2000.0)"))
    for options, epoch in ((TableOptions(epoch=2000.0), 2000.0), (TableOptions(columns={"ra": ra}), 2016.0)):
        assert set(read_table(written(""), options).astrometry.epoch) == {epoch}


def test_names_are_the_same_however_they_are_stored(tmp_path):
    made = stars(3)
    for number, names in enumerate(([71, 72, 73], [71.0, 72.0, 73.0], ["71 ", " 72", "73"], [b"71", b"72", b"73"])):
        path = gaia(tmp_path / f"{number}.parquet", made, hip=names)
        assert read_table(path).names["hip"].tolist() == ["71", "72", "73"]
    path = gaia(tmp_path / "gap.fits", made, hip=[71.0, np.nan, 73.0])
    assert read_table(path).names["hip"].tolist() == ["71", "--", "73"]
