"""Missions of a study's own, against the built-in ones and formulas written out."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from linksweep.core.missions import MISSIONS, mission_from_table
from linksweep.sweep.contract import DefinitionError, SweepError
from tests.tiers import examples

EITHER = "needs either sigma_pos or position_ratio (sigma_pos = position_ratio x sigma_pm)"
BOUNDS = ": must be a number from 1e-09 to 1e+07"
V = np.linspace(4.0, 21.0, 69)
TABLE = {"nominal_length": 4.0, "sigma_pm": [[9.0, 0.1], [13.0, 0.4], [18.0, 3.2]], "position_ratio": 0.5}
GAIA_2001 = {
    "nominal_length": 5,
    "unit": "uas",
    "sigma_pm": [[10 + i, s] for i, s in enumerate((3, 3, 3, 4, 5, 8, 13, 20, 34, 60, 120, 380))],
    "sigma_pos": [[10 + i, s] for i, s in enumerate((3, 3, 3, 4, 6, 9, 15, 23, 39, 70, 140, 440))],
}
AMEX = {
    "nominal_length": 2.0,
    "sigma_pm": [{"at": 9, "sigma": 0.139, "slope": 0.215}, {"at": 15.0, "sigma": 14.2, "slope": 0.973}],
    "position_ratio": 0.60,
    "floor_pm": 0.0315,
    "floor_pos": 0.60 * 0.0315,
}
GAIA = {"nominal_length": 5.0, "sigma_pm": [{"at": 15.0, "sigma": 0.01496, "slope": 0.443}], "position_ratio": 1.15}
GAIA |= {"floor_pm": 3e-3, "floor_pos": 3e-3}


class Power:
    """A function of the platform's kind."""

    name, digest = "power", "0123456789ab"

    def __call__(self, v):
        return 10.0 ** (0.2 * (v - 15.0))


def load(reference):
    if reference != "curves.py:power":
        raise SweepError(f"there is no file {reference}")
    return Power()


def mission(table):
    return mission_from_table(table, load)[0]


def identity(table):
    return json.dumps(mission_from_table(table, load)[1], sort_keys=True)


def problems(table):
    with pytest.raises(DefinitionError) as caught:
        mission_from_table(table, load)
    return caught.value.problems


@pytest.mark.parametrize(("name", "table"), [("gaia-2001", GAIA_2001), ("amex", AMEX), ("gaia", GAIA)])
def test_a_built_in_mission_written_out_is_the_same_to_the_last_bit(name, table):
    own, built_in = mission(table), MISSIONS[name]
    for length in (None, 3.3):
        np.testing.assert_array_equal(own.sigma_pm_mas_yr(V, length), built_in.sigma_pm_mas_yr(V, length))
        np.testing.assert_array_equal(own.sigma_pos_mas(V, length), built_in.sigma_pos_mas(V, length))
    assert (own.nominal_length_yr, own.faint_limit_mag) == (built_in.nominal_length_yr, built_in.faint_limit_mag)


def test_a_table_is_log_linear_and_constant_on_the_bright_side():
    own = mission(TABLE)
    expected = [0.1, 0.1, 0.2, 0.4, 0.4 * 8**0.4]  # 0.4 of the way from 13 to 18 mag, and of ln(3.2/0.4)
    np.testing.assert_allclose(own.sigma_pm_mas_yr(np.array([4.0, 9.0, 11.0, 13.0, 15.0])), expected, rtol=1e-14)
    np.testing.assert_allclose(own.sigma_pos_mas(V), 0.5 * own.sigma_pm_mas_yr(V), rtol=1e-14)
    assert own.faint_limit_mag == 18.0


def test_forms_can_be_mixed_and_a_function_is_in_the_unit():
    own = mission(
        {"nominal_length": 1.0, "unit": "uas", "sigma_pm": "curves.py:power", "sigma_pos": [[9, 50], [20, 80]]}
    )
    np.testing.assert_allclose(own.sigma_pm_mas_yr(V), 1e-3 * 10.0 ** (0.2 * (V - 15.0)), rtol=1e-14)
    assert own.sigma_pos_mas(np.array([5.0]))[0] == pytest.approx(0.05, rel=1e-14)
    assert own.faint_limit_mag == 20.0
    ratio = mission({"nominal_length": 1.0, "sigma_pm": "curves.py:power", "position_ratio": 2.0})
    np.testing.assert_allclose(ratio.sigma_pos_mas(V), 2.0 * 10.0 ** (0.2 * (V - 15.0)), rtol=1e-14)
    assert ratio.faint_limit_mag == math.inf


def test_identity_is_what_decides_the_numbers():
    in_uas = {**TABLE, "unit": "uas", "sigma_pm": [[9.0, 100], [13.0, 400], [18, 3200]]}
    same = [TABLE, in_uas, TABLE | {"source": "a paper"}, TABLE | {"faint_limit": 18}, TABLE | {"nominal_length": 4}]
    assert {identity(table) for table in same} == {identity(TABLE)}
    others = [
        TABLE | {"nominal_length": 4.5},
        TABLE | {"faint_limit": 17.0},
        TABLE | {"position_ratio": 0.51},
        TABLE | {"sigma_pm": [[9.0, 0.1], [13.0, 0.4], [18.0, 3.3]]},
        AMEX,
        AMEX | {"sigma_pm": "curves.py:power"},
        AMEX | {"sigma_pm": "curves.py:power", "unit": "uas"},
    ]
    assert len({identity(table) for table in [TABLE, *others]}) == 1 + len(others)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"sigma_pn": 1}, ("sigma_pn", "unknown key; did you mean 'sigma_pm'?")),
        ({"nominal_length": None}, ("nominal_length", "is required [yr]")),
        ({"nominal_length": True}, ("nominal_length", "True: must be a number > 0 and <= 1000 [yr]")),
        ({"position_ratio": None}, ("", EITHER)),
        ({"sigma_pos": [[9, 1], [10, 1]]}, ("", EITHER)),
        ({"unit": "arcsec"}, ("unit", "'arcsec': must be 'mas' or 'uas' (a year for proper motions)")),
        ({"source": 1}, ("source", "1: must be a text that says where the numbers come from")),
        (
            {"range": [12.0, 11.0]},
            ("range", "[12.0, 11.0]: must be [brightest, faintest], two magnitudes from -5 to 30"),
        ),
        ({"floor_pm": 0.0}, ("floor_pm", "the least error = 0.0: must be a number from 1e-09 to 1e+07")),
        ({"faint_limit": 19.0}, ("faint_limit", "19 mag: the table ends at 18 mag")),
        ({"faint_limit": math.nan}, ("faint_limit", "nan: must be a number >= -5 and <= 30 [mag]")),
        ({"sigma_pm": [[9.0, 0.1]]}, ("sigma_pm", "1 row: a table needs at least two")),
        ({"sigma_pm": [[9.0, 0.1], [12.0]]}, ("sigma_pm", "row 2, [12.0]: must be [magnitude, sigma]")),
        ({"sigma_pm": [[9.0, 0.1], [9.0, 0.2]]}, ("sigma_pm", "row 2: magnitude 9 does not come after 9")),
        ({"sigma_pm": [[9.0, 1], [12, math.inf]]}, ("sigma_pm", f"row 2, sigma = inf{BOUNDS}")),
        ({"sigma_pm": [[9.0, 1], ["x", 1]]}, ("sigma_pm", "row 2, magnitude = 'x': must be a number from -5 to 30")),
        ({"sigma_pm": [{"at": 9}]}, ("sigma_pm", "exponential 1: its keys must be at, sigma and slope, not 'at'")),
        (
            {"sigma_pm": [{"at": 9, "sigma": 1, "slope": 11}]},
            ("sigma_pm", "exponential 1, slope = 11: must be a number from -10 to 10"),
        ),
        ({"sigma_pm": "other.py:f"}, ("sigma_pm", "there is no file other.py:f")),
    ],
)
def test_what_is_wrong_is_said_of_its_key(change, expected):
    table = {key: value for key, value in (TABLE | change).items() if value is not None}
    assert problems(table) == [expected]


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["at", "sigma", "slope"]), inner),
    max_leaves=8,
)


@pytest.mark.slow
@settings(max_examples=examples(300), derandomize=True)
@given(st.dictionaries(st.sampled_from([*GAIA_2001, "position_ratio", "faint_limit", "source"]), anything), st.data())
def test_anything_is_a_mission_or_told_to_be_none(table, data):
    base = data.draw(st.sampled_from([{}, TABLE, GAIA_2001, AMEX]))
    try:
        own, what = mission_from_table(base | table, load)
    except DefinitionError:
        assert problems(base | table)
        return
    json.dumps(what, allow_nan=False)
    with np.errstate(all="raise"):
        assert np.all(own.sigma_pm_mas_yr(V) > 0.0)


def test_curves_of_missions_side_by_side():
    missions = {"gaia-2001": MISSIONS["gaia-2001"], "mine": mission(TABLE), "amex": MISSIONS["amex"]}
    v_mag = np.array([10.0, 15.0, 19.0, 22.0])
    pos, pm = np.stack([each.sigmas_to_limit(v_mag) for each in missions.values()], axis=1)
    seen = np.array([[1, 1, 1, 0], [1, 1, 0, 0], [1, 1, 1, 1]], dtype=bool)
    np.testing.assert_array_equal(np.isfinite(pm), seen)
    np.testing.assert_array_equal(np.isfinite(pos), seen)
    np.testing.assert_allclose(pm[0, :3], [3e-3, 8e-3, 60e-3], rtol=1e-12)
    np.testing.assert_allclose(pos[0, :3], [3e-3, 9e-3, 70e-3], rtol=1e-12)
    assert pos[2, 1] == pytest.approx(0.6 * (0.139 * math.exp(0.215 * 6) + 14.2), rel=1e-12)


def test_a_range_and_a_floor_of_ones_own():
    """Both ends of a table are its range; a floor counts in the identity, a range is only warned of."""
    assert mission(TABLE).valid_mag == (TABLE["sigma_pm"][0][0], TABLE["sigma_pm"][-1][0])
    ranged = TABLE | {"range": [10.0, 16.0]}
    assert mission(ranged).valid_mag == (10.0, 16.0)
    assert identity(ranged) == identity(TABLE)
    low = TABLE | {"floor_pm": TABLE["sigma_pm"][-1][1]}
    assert np.ptp(mission(low).sigma_pm_mas_yr(V)) == 0.0
    assert identity(low) != identity(TABLE)
