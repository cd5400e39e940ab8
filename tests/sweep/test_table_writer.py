"""One table for the terminal, CSV, ECSV and JSON: the same numbers in each, exact where programs read them."""

import csv
import json
import math

import numpy as np
import pytest
from astropy import units
from astropy.table import Table as AstropyTable
from hypothesis import example, given, strategies as st

from linksweep.sweep.formatting import described, prefixed, short_meaning
from linksweep.sweep.table_writer import Column, Table

LARGE = 2**60 + 1
COLUMNS = [Column("name", [" =a", "漢字", "c"], left=True), Column("k", [LARGE, math.nan, 3])]
COLUMNS += [Column("width_of_all", [0.1, math.nan, 2.5], ["0.10 ± 0.02", "", "2.5"], "mas", "width", rank=1)]
COLUMNS += [Column("curve", [[1, 2], [3, 4], [5, 6]])]
TABLE = Table(COLUMNS, "Widths", about={"units": {"width_of_all": "mas"}}, meta={"title": "Widths"})
WELL = [
    *((0.0005411, "mas / yr", "uas / yr"), ([0.65, 0.00054, 0.0017], "mas / yr", "uas / yr")),
    *((1e-4, "mas yr-1", "uas yr-1"), (3000.0, "mas", "arcsec"), (2e-4, "s", "us"), (5000.0, "m", "km")),
    *((2e6, "pc", "Mpc"), (1e5, "yr", "kyr"), ([0.0, np.nan, 0.004], "mas", "uas")),
]
OTHERS = ("", "d", "deg", "mag", "users / d", "%", "mas2 / yr2", "mas, mas", "1 / s", "yr", "h")
STAYING = [*((1e-6, unit) for unit in OTHERS), *((x, "mas") for x in (np.nan, 0.0, np.inf, 0.1, 999.0))]
STAYING += [(5000.0, "s"), (5000.0, "arcsec"), (1.1e-14, "W / m2"), (1e16, "m")]


def test_columns_stand_below_each_other_whatever_the_letters():
    title, long, heads, *rows = TABLE.text(40).splitlines()
    assert (title, long.split(), heads.split()) == ("Widths", ["width_of_all"], ["name", "k", "[mas]", "curve"])
    latin, chinese, last = (row.index("[") for row in rows)
    assert latin == last == chinese + 2  # two Chinese letters are as wide as four
    assert "nan" not in rows[1]
    again = AstropyTable.read(TABLE.ecsv(), format="ascii.ecsv")
    assert (again["k"].tolist(), again["width_of_all"].unit, again.meta["title"]) == ([LARGE, None, 3], "mas", "Widths")


@example([1, 1], 20)
@given(st.lists(st.integers(0, 3), max_size=6), st.integers(1, 60))
def test_what_does_not_fit_is_left_out_by_rank_and_named(ranks, width):
    columns = [Column(f"c{i}", [10**6], quantity=f"c{i}", rank=rank) for i, rank in enumerate([0, *ranks])]
    kept, left_out = Table(columns).fitting(width)
    names = [column.name for column in kept.columns]
    assert sorted([*names, *filter(None, left_out.split(", "))]) == [column.name for column in columns]
    by_rank = sorted(columns, key=lambda column: column.rank)  # of one rank the last goes first, and of 0 none
    assert {*names} == {column.name for column in by_rank[: max(len(names), 1 + ranks.count(0))]}
    assert max(map(len, kept.text(width).splitlines())) <= width or not any(column.rank for column in kept.columns)
    assert not left_out or len(Table(columns).text().splitlines()[-1]) > width
    assert Table(columns).fitting(None) == (Table(columns), "")


@given(st.floats() | st.sampled_from([math.inf, -math.inf, math.nan]), st.integers(), st.text())
def test_every_number_and_text_comes_back_from_json_and_numbers_from_csv_and_ecsv(number, whole, text):
    columns = [Column("x", [number], unit="mas"), Column("k", [whole]), Column("gap", [math.nan])]
    table = Table([*columns, Column("t", [text])], about={"x": [number]}, meta={"title": "Widths"})
    document = json.loads(table.json())
    known = {math.inf: "Infinity", -math.inf: "-Infinity"}.get(number, None if math.isnan(number) else number)
    assert (document["x"], document["rows"]) == ([known], [{"x": known, "k": whole, "gap": None, "t": text}])
    head, cells = list(csv.reader(table.csv().splitlines()[:2]))
    assert (head, cells[2]) == (["x [mas]", "k", "gap", "t"], "")
    assert (math.nan if cells[0] == "" else float(cells[0])) == pytest.approx(number, rel=0, abs=0, nan_ok=True)
    assert int(cells[1]) == whole


def test_a_column_that_may_wrap_takes_several_lines_and_loses_no_word():
    words = "a conclusion of many words that needs more than one line"
    table = Table([Column("n", [1.0]), Column("conclusion", [words], wrap=12)])
    lines = table.text(24).splitlines()
    assert max(map(len, lines)) <= 24
    assert " ".join(" ".join(line[3:].split()) for line in lines[1:]) == words
    assert "\x1b[31mNOT reproduced\x1b[0m" in Table([Column("verdict", ["NOT reproduced"])]).text(styled=True)


@given(st.text(max_size=60))
def test_the_whole_meaning_is_kept(meaning):
    attributes = described("", meaning)
    assert attributes.get("description", attributes.get("long_name", "")) == meaning
    assert meaning.startswith(short_meaning(meaning))
    assert all(attributes.values())


def test_a_prefix_is_one_that_reads_well_or_none():
    for values, unit, chosen in WELL:
        result = prefixed(np.array(values), unit)
        assert (result.unit, result.factor) == (chosen, pytest.approx(units.Unit(unit).to(chosen), rel=1e-12))
    for value, unit in STAYING:
        assert prefixed(value, unit) == (unit, 1.0)
