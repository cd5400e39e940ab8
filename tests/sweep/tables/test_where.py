"""Conditions on rows: drawn ones against pandas, what is missing, and what is refused."""

import numpy as np
import pandas as pd
import pytest
from astropy.table import MaskedColumn, Table
from hypothesis import given, settings, strategies as st

from linksweep import SweepError
from linksweep.sweep.tables.columns import rows_where
from tests.tiers import examples

FRAME = pd.DataFrame({"flag": [True, False, True, True, False, False, True, False]})
FRAME["a"], FRAME["b"] = [0.5, 1.4, 2.0, -3.0, 7.25, 1e9, 0.0, -0.5], [1.0, 1.4, -2.0, 3.0, 8.0, 1e-9, 0.0, 4.0]
FRAME["n"] = np.array([0, 1, 2, 3, 2**53 + 1, -7, 10**17, 5])
FRAME["s"] = ["S1", "S2", "x", "y", "S1", "z", "x", "long name"]
TABLE = Table.from_pandas(FRAME)
COLUMN = st.sampled_from("abn")
NUMBER = st.sampled_from(["1.4", "-3", "0", "2", "1e9", "-0.5", str(2**53 + 1), str(10**17)])
TEXT = st.sampled_from(["'S1'", '"x"', "'none'"])
COMPARED = st.sampled_from(["<", "<=", ">", ">=", "==", "!="])
IN = st.sampled_from(["in", "not in"])
COMPARISONS = st.one_of(
    st.builds("{} {} {}".format, COLUMN, COMPARED, NUMBER),
    st.builds("{} {} {} < {}".format, NUMBER, st.sampled_from(["<", "<="]), COLUMN, NUMBER),
    st.builds("s {} {}".format, st.sampled_from(["==", "!="]), TEXT),
    *(
        st.builds("{} {} [{}, {}]".format, *one)
        for one in ((COLUMN, IN, NUMBER, NUMBER), (st.just("s"), IN, TEXT, TEXT))
    ),
    *(st.builds("a {} b".format, COMPARED), st.just("flag")),
)
JOINED = [(2, "({}) & ({})"), (2, "{} | {}"), (2, "{} and {}"), (1, "~({})"), (1, "not ({})")]
MISSING = [("ruwe >= 1.4", [1, 2]), ("ruwe != 1.4", [0, 2]), ("~(ruwe < 1.4)", [1, 2, 3]), ("ruwe == ruwe", [0, 1, 2])]
MISSING += [("~duplicated_source & ~good", [1, 3]), ("name in ['A', 'C']", [0, 2]), ("`B-V` < 0.6 & `lambda` > 1", [2])]
MISSING += [("name == 'A & B' | g > 14.5", [3])]
REFUSED = [("ruwee < 1.4", "no column 'ruwee'; did you mean 'ruwe'"), ("ruwe < ", "at the end"), ("", "where")]
REFUSED += [("ruwe < 1.4 & (g < 13", r"at character 14, '\(g < 13'"), ("ruwe.real < 1", "not allowed")]
REFUSED += [("__import__('os').system('true')", "not allowed"), ("ruwe", "numbers without a comparison")]
REFUSED += [("ruwe < 1.4 & name < 3", "text cannot be compared with numbers in this way .*at character 21, '3'")]
REFUSED += [("ruwe + 1 < 2", "not allowed"), ("ruwe in 3", "not a list"), ("pair < 1", "neither numbers nor text")]
REFUSED += [("ruwe < 0.1", "keeps none of 4 rows; ruwe is 0.9 to 2.0"), ("not " * 5000 + "good", "where")]


def joined(inner):
    return st.one_of(st.builds(words.format, *[inner] * number) for number, words in JOINED)


CONDITIONS = st.recursive(COMPARISONS, joined, max_leaves=6)


@settings(max_examples=examples(100))
@given(CONDITIONS)
def test_rows_are_those_of_pandas(condition):
    wanted = FRAME.eval(condition, engine="python").to_numpy(dtype=bool)
    if wanted.any():
        np.testing.assert_array_equal(rows_where(TABLE, condition), wanted)
    else:
        with pytest.raises(SweepError, match="keeps none of 8 rows"):
            rows_where(TABLE, condition)


@settings(max_examples=examples(300))
@given(st.text(alphabet="ab ns<>=!&|~()[]{}'\"`.,:0123eE+-*/%^@#lambdinotrue_\\\n\té", max_size=30))
def test_any_text_gives_rows_or_is_refused_with_its_place(condition):
    try:
        rows = rows_where(TABLE, condition)
    except SweepError:
        return
    assert (rows.dtype, rows.shape, rows.any()) == (bool, (8,), True)


@pytest.mark.parametrize(("condition", "words"), REFUSED)
def test_what_is_refused_names_the_place_and_the_cause(condition, words):
    with pytest.raises(SweepError, match=words):
        rows_where(stars(), condition)


def stars():
    table = Table({"name": ["A", "B", "C", ""], "g": np.float32([12.0, 13.0, 14.0, 15.0])})
    table["ruwe"] = MaskedColumn([0.9, 1.4, 2.0, 1.0], mask=[False, False, False, True])
    table["good"] = [1, 0, 1, 0]
    table["duplicated_source"] = MaskedColumn([True, False, False, True], mask=[False] * 3 + [True])
    table["pair"] = np.zeros((4, 2))
    table["B-V"] = [0.1, np.nan, 0.5, 0.7]
    table["lambda"] = [1, 2, 3, 4]
    return table


@pytest.mark.parametrize(("condition", "rows"), MISSING)
def test_missing_values_truth_values_and_quoted_names(condition, rows):
    assert np.flatnonzero(rows_where(stars(), condition)).tolist() == rows
