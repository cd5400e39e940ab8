"""What cannot be linked is refused by name: each table or option with one thing wrong."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Column, MaskedColumn, Table

import linksweep
from tests.core.tie.made import gaia_table, stars

N = 12


def at(row, value, others=0.1):
    return np.where(np.arange(1, N + 1) == row, value, others)


POSITION = ("ra", "dec", "ra_error", "dec_error")
ACCELERATED = {f"accel_{axis}{end}": at(0, 0) for axis in ("ra", "dec") for end in ("", "_error")}
DR4, CALIBRATED = {"ref_epoch": at(0, 0, 2017.5)}, {"calibrator": ["J1"] * N}
GAP = MaskedColumn(at(0, 0, 2016.0), mask=at(2, 1, 0))
FEW = np.where(np.arange(N) < 4, 10**17 + np.arange(N), 1)  # all but four match no source
CORRELATED = dict.fromkeys(("ra_pmra_corr", "dec_pmra_corr"), at(0, 0, 0.9))
SPIN = {"mag_min": [0.0], "mag_max": [30.0]} | {f"omega_{axis}": [10.0] for axis in "xyz"}
BLANK = {f"omega_{axis}": MaskedColumn([1.0], mask=[axis == "y"], unit="uas/yr") for axis in "xyz"}
DR3 = {"phot_g_mean_mag": at(1, 8.0, 12.0), "nu_eff_used_in_astrometry": np.full(N, 1.5), "pseudocolour": at(1, 1.4)}
DR3 |= {"ecl_lat": at(1, 30.0), "astrometric_params_solved": np.full(N, 31)}
ARCSEC, RATE = Column(at(0, 0), unit="arcsec"), Column([10.0], unit="uas/yr")
SHIFTED = {"parallax_zero_point": "satellite"}

# The sentence, the changes of the columns (None: without it) of either table, and the options.
REFUSED = [
    ("a pmra_error of 0 .* in row 3", {"pmra_error": at(3, 0.0)}, {}, {}),
    ("of the position has a value in row 2", {}, {"ra": at(2, np.nan), "ra_error": at(2, np.nan)}, {}),
    ("impossible .* in row 3", {"ra_dec_corr": at(3, 1.5, 0.0)}, {}, {}),
    ("single precision .* too coarse .* in row 1, 2, 3", {"ra": np.float64(np.linspace(1, 99, N, dtype="f4"))}, {}, {}),
    (r"no ra_dec_corr \(write 0 for none\) in row 2", CORRELATED | {"ra_dec_corr": at(2, np.nan, 0.9)}, {}, {}),
    ("contradict corr_vec in row 1, 2, 3", {"corr_vec": np.full((N, 10), 0.1)}, {}, {}),
    ("no position in row 1, 2, 3, 4, 5 and 7 more; each source needs one", dict.fromkeys(POSITION), {}, {}),
    ("epsilon_z; rows are of the kind three-parameter", {}, dict.fromkeys(POSITION), {"unknowns": "orientation"}),
    *(("give the epoch", {}, {"ref_epoch": None}, {}), ("no column 'q'", {}, {}, {"columns": {"parallax": "q"}})),
    ("'parallax' is in arcsec, and 'parallax_error' has no unit; say --unit", {"parallax": ARCSEC}, {}, {}),
    *(("no column 'parallax'", {"parallax": None}, {}, {}), ("is no quantity", {}, {}, {"columns": {"paralax": "p"}})),
    ("an error but no value of parallax in row 2", {"parallax": at(2, np.nan)}, {}, {}),
    ("no Julian year, MJD or JD from 1700 to 2300 in row 2", {}, {"ref_epoch": at(2, 0.0, 2016.0)}, {}),
    ("no date like .* row 1 .June 2015", {}, {"ref_epoch": ["June 2015", *["2016-01-01"] * (N - 1)]}, {}),
    (r"no epoch \(column 'ref_epoch'\) in row 2", {}, {"ref_epoch": GAP}, {}),
    ("without one of its coordinates", ACCELERATED | {"accel_dec": at(0, 0, np.nan)}, {}, {}),
    ("a column calibrator needs calibrator_error", {}, CALIBRATED, {}),
    ("a calibrator without an error that is 0 .* row 1", {}, CALIBRATED | {"calibrator_error": at(1, np.nan)}, {}),
    ("those of dr3, and the epochs are of dr4", DR3 | DR4, {}, SHIFTED),
    ("epochs of dr3 and dr4, each", {"Ref_epoch": at(1, 2017.5, 2016), "ref_epoch": None, "ra_error": None}, {}, {}),
    ("no column 'ecl_lat'", DR3 | {"ecl_lat": None}, {}, SHIFTED),
    ("spins of dr3, and the satellite's epochs are those of dr4", DR4, {}, {"known_spin": "edr3-spin"}),
    ("'omega_y' has no unit, uas/yr or mas/yr", {}, {}, {"known_spin": SPIN | {"omega_x": RATE, "omega_z": RATE}}),
    ("no omega_y in row 1", {}, {}, {"known_spin": SPIN | BLANK}),
    ("Say it: units ra = deg", {}, {"ra": ["225:30:01.5"] * N, "ra_error": Column(at(0, 0), unit="mas")}, {}),
    *(("': .* no side", {}, {}, {"missions": {"satellite": "r"}}), ("no option degrees", {}, {}, {"degrees": 3})),
    *(("sign = 'minus'", {}, {}, {"sign": "minus"}), ("three finite", {}, {}, {"known_orientation": [1.0, 2.0]})),
    ("workers are for Parquet tables of 100,000 quasars", {}, {}, {"workers": 2}),
    ("quasars hold at any epoch", {}, {}, {"extragalactic": "reference", "reference_epoch": 2015.5}),
    *(("no numbers 'mag'", {}, {}, {"bins": ("mag", [3.0])}), ("match by 'star'", {}, {}, {"by": "star"})),
    *(("is such a position", {}, {}, {"aberration": 5.8}), ("radius must be above 0", {}, {}, {"by": "position:-1"})),
    ("no row is of the kind position; there are five-parameter", {}, {}, {"jitter": {"position": (0.1, 0.0)}}),
    *(("and mas/yr, each once", {}, {}, {"jitter": text}) for text in ("all=0.2 mas", "all=1,all=0", "estimate,all=1")),
    *(("no kind of row five", {}, {}, {"jitter": {"five": (1.0, 1.0)}}), ("KIND=MAS", {}, {}, {"jitter": "estimated"})),
    *(("not neg", {}, {}, {"jitter": {"motion": -0.1}}), ("mean 'phot_g", {}, {}, {"where": "phot_g_mean_mg < 1"})),
    *(("weights by cov", {}, {}, {"jitter": "estimate", "weights": "equal"}), ("apart by", {}, {}, {"degree": 50})),
    ("5 rows of .* and there are 4", {}, {"source_id": FEW}, {"jitter": "estimate"}),
]  # fmt: skip


@pytest.mark.parametrize(("words", "ours", "rows", "options"), REFUSED, ids=[one[0] for one in REFUSED])
def test_what_is_wrong_is_named(tmp_path, words, ours, rows, options):
    paths = [tmp_path / "own.fits", tmp_path / "rows.ecsv"]
    for path, changes in zip(paths, (ours, rows), strict=True):
        table = gaia_table(replace(stars(N, 1), correlations=np.zeros((10, N))))
        for name, column in changes.items():
            table[name] = column if column is not None else table.columns[0]
        table.remove_columns([name for name, column in changes.items() if column is None])
        table.write(path)
    if isinstance(options.get("known_spin"), dict):
        Table(options["known_spin"]).write(tmp_path / "spins.ecsv")
        options = {"known_spin": tmp_path / "spins.ecsv"}
    with pytest.raises(linksweep.SweepError, match=words) as error:
        linksweep.tie(*paths, **options)
    assert len(error.value.problems) == 1
