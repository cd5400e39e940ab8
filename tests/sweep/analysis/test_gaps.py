"""Integers of points that are not done are missing wherever results are shown, and others are exact."""

import json

import numpy as np
import pytest
from astropy.table import Table
from click.testing import CliRunner

import linksweep
from linksweep.sweep.analysis.answer import answers, completeness
from linksweep.sweep.analysis.laws import parse_limit, points_where
from linksweep.sweep.cli import main

LARGE = 2**60


def large(a: int, b: int = 1):
    if a % 3 == 0:
        raise ValueError("no")
    return {"k": LARGE + a * b, "small": a, "line": np.arange(2) + LARGE + a}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    place = tmp_path_factory.mktemp("gaps") / "large.zarr"
    linksweep.run(large, place, axes={"a": range(1, 11)}, pool="serial")
    return str(place)


def shown(*arguments):
    return CliRunner().invoke(main, [*arguments]).stdout


EXPECTED = [None if a % 3 == 0 else a for a in range(1, 11)]
EXACT = [None if a is None else LARGE + a for a in EXPECTED]


def test_tables_have_gaps_and_no_number_in_place_of_them(store):
    text = shown("show", store)
    assert str(np.iinfo(np.int64).min) not in text
    assert ["3", "failed"] in [line.split() for line in text.splitlines()]
    assert str(LARGE + 1) in text
    rows = json.loads(shown("show", store, "--json"))["rows"]
    assert [row["small"] for row in rows] == EXPECTED
    assert [row["k"] for row in rows] == EXACT
    assert (rows[1]["line"], rows[2]["line"]) == ([LARGE + 2, LARGE + 3], [None, None])
    csv = [line.split(",")[1:3] for line in shown("show", store, "--format", "csv").splitlines()[1:]]
    assert [cells[0] for cells in csv] == ["" if k is None else str(k) for k in EXACT]
    assert [float(cells[1]) if cells[1] else None for cells in csv] == EXPECTED
    ecsv = Table.read(shown("show", store, "--format", "ecsv"), format="ascii.ecsv")
    assert ecsv["k"].tolist() == EXACT
    assert ecsv["small"].tolist() == EXPECTED


def test_the_dataset_has_exact_integers_beside_gaps(store):
    found = linksweep.open(store)
    assert [None if k != k else k for k in found.k.values] == EXACT  # noqa: PLR0124 (NaN)
    assert found.small.dtype == float
    for command in ("plot", "fit"):
        done = CliRunner().invoke(main, [command, store, "--over", "a", "--variable", "k"])
        assert done.exit_code == 2
        assert "no numbers to draw or to fit" in done.output


def test_integers_without_gaps_are_exact(tmp_path):
    dataset = linksweep.run(large, tmp_path / "s.zarr", axes={"a": [1, 2]}, pool="serial")
    assert dataset.k.values.tolist() == [LARGE + 1, LARGE + 2]
    assert f"it goes from {LARGE + 1}, at a=1, to {LARGE + 2}" in " ".join(linksweep.answer(dataset).sentences)
    rows = json.loads(shown("show", str(tmp_path / "s.zarr"), "--json"))["rows"]
    assert [row["k"] for row in rows] == [LARGE + 1, LARGE + 2]


def test_a_figure_has_no_points_without_values(store):
    figure = linksweep.plot(linksweep.open(store))
    drawn = [y for axes in figure.axes for line in axes.lines for y in np.atleast_1d(line.get_ydata())]
    assert drawn
    assert all(y != y or y >= 0.0 for y in drawn)  # noqa: PLR0124 (NaN)


def test_excluded_points_meet_no_condition_and_have_no_ratio(tmp_path):
    def k(a: int, b: int):
        return a * b

    points = {"a": [1, 2, 3], "b": [4, 5, 6]}
    document = {"experiment": k, "points": {"columns": points}, "exclude": [{"a": 2}]}
    dataset = linksweep.run(document, tmp_path / "p.zarr", pool="serial")
    assert points_where(dataset, parse_limit("k < 1e30"))["a"].values.tolist() == [1, 3]
    document = {"experiment": k, "axes": points, "exclude": [{"a": 2, "b": 5}]}
    dataset = linksweep.run(document, tmp_path / "g.zarr", pool="serial")
    assert np.isnan(linksweep.ratio(dataset, "k", "a", of=2, to=1)["ratio"].values).tolist() == [False, True, False]


def test_an_integer_beyond_those_of_floats_chooses_its_own_point(tmp_path):
    def f(a: int):
        return float(a % 10)

    linksweep.run(f, tmp_path / "s.zarr", axes={"a": [2**53, 2**53 + 1]}, pool="serial")
    (row,) = json.loads(shown("show", str(tmp_path / "s.zarr"), "--at", f"a={2**53 + 1}", "--json"))["rows"]
    assert row["f"] == (2**53 + 1) % 10


def test_a_list_at_each_name_is_told(tmp_path):
    def curve(town: str):
        return [1.0 * len(town), 2.5]

    linksweep.run(curve, tmp_path / "s.zarr", axes={"town": ["a", "bb"]}, pool="serial")
    (told,) = answers(linksweep.open(tmp_path / "s.zarr"))
    assert "it goes from 1, at town=a" in told.sentences[0]


def test_chosen_points_that_are_done_are_not_incomplete(store):
    done = linksweep.open(store).sel(a=[1, 2])
    assert completeness(done) == []
    assert completeness(linksweep.open(store)) != []
