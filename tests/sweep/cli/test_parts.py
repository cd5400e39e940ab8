"""Parts of a grid that ``--at`` names: those that the study excludes are not shown as if they were empty."""

import json

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner

import linksweep
from linksweep.sweep.cli import main


def law(a: float, b: float = 1.0):
    return b / a


@pytest.fixture(scope="module")
def part_excluded(tmp_path_factory):
    store = tmp_path_factory.mktemp("excluded") / "law.zarr"
    document = {
        "experiment": law,
        "axes": {"a": [1.0, 2.0], "b": [1.0, 2.0, 3.0]},
        "exclude": [{"b": 3.0}, {"a": 2.0, "b": 2.0}],
    }
    linksweep.run(document, store, pool="serial")
    return str(store)


@pytest.mark.parametrize("command", ["show", "fit", "find --where law<1", "plot -o p.png", "sensitivity"])
@pytest.mark.parametrize(("at", "points"), [("a=2,b=2", "this point"), ("b=3", "all of these points")])
def test_a_part_that_the_study_excludes_is_refused(part_excluded, command, at, points, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = CliRunner().invoke(main, [*command.split(), part_excluded, "--at", at])
    assert (told.exit_code, told.stdout) == (2, "")
    assert f"--at {at}: the study excludes {points}" in told.stderr
    assert not list(tmp_path.iterdir())


def test_tables_for_programs_have_a_column_that_says_so(part_excluded):
    told = CliRunner().invoke(main, ["show", part_excluded, "--at", "a=2,b=2", "--format", "csv"])
    assert (told.exit_code, told.stdout.split()) == (0, ["law,status", ",excluded"])


def test_a_figure_of_excluded_points_alone_is_refused(part_excluded):
    with pytest.raises(linksweep.SweepError, match="every point is excluded by the study"):
        linksweep.plot(linksweep.open(part_excluded).sel(b=3.0))


def half(a: int, b: int = 1):
    if a == 2:
        raise ValueError("two is bad")
    return float(a * b)


@pytest.mark.parametrize(("at", "count"), [("a=2", 2), ("a=2,b=1", 1)])
def test_a_figure_of_failed_points_alone_is_refused(at, count, tmp_path):
    linksweep.run(half, tmp_path / "half.zarr", axes={"a": [1, 2, 3], "b": [1, 2]}, pool="serial")
    picture = tmp_path / "p.png"
    told = CliRunner().invoke(main, ["plot", str(tmp_path / "half.zarr"), "--at", at, "-o", str(picture)])
    assert told.exit_code == 2
    assert f"half: there is no value to draw here: of {count} points {count} failed" in told.stderr
    assert not picture.exists()


def cooling(a: float):
    t = np.array([0.0, 1.0, 2.0])
    curve = xr.DataArray(a * np.exp(-t), dims="t", coords={"t": t})
    return {"tot": a, "curve": curve}


def test_an_output_is_shown_where_a_place_along_its_own_dimension_is_chosen(tmp_path):
    store = str(tmp_path / "cooling.zarr")
    linksweep.run(cooling, store, axes={"a": [1.0, 2.0]}, pool="serial")
    whole = CliRunner().invoke(main, ["show", store])
    assert "curve: values at each point, 3 along t" in " ".join(whole.stdout.split())
    told = CliRunner().invoke(main, ["show", store, "--at", "t=1"])
    assert told.exit_code == 0
    lines = told.stdout.splitlines()
    assert next(line.split() for line in lines if "tot" in line) == ["a", "tot", "curve"]
    assert next(line.split()[-1] for line in lines if line.split()[:1] == ["2"]) == "0.7358"


def wave(a: int, kind: str, b: float = 1.0):
    return float(a) if kind == "sin" else -b


@pytest.fixture(scope="module", params=[False, True], ids=["alone", "crossed"])
def table(request, tmp_path_factory):
    store = tmp_path_factory.mktemp("table") / "wave.zarr"
    points = {"a": [1, 2, 3, 4], "kind": ["sin", "cos", "sin", "sin"]}
    linksweep.run(wave, store, points=points, axes={"b": [1.0, 2.0]} if request.param else None, pool="serial")
    return str(store), 2 if request.param else 1


def test_all_points_of_a_table_that_have_a_value_are_shown(table, tmp_path):
    store, each = table
    told = CliRunner().invoke(main, ["show", store, "--at", "kind=sin", "--json"])
    assert [row["a"] for row in json.loads(told.stdout)["rows"]] == sorted([1, 3, 4] * each)
    told = CliRunner().invoke(main, ["show", store, "--at", "kind=sin,a=3", "--json"])
    assert [row["wave"] for row in json.loads(told.stdout)["rows"]] == [3.0] * each
    told = CliRunner().invoke(main, ["fit", store, "--at", "kind=sin", "--over", "a", "--json"])
    assert [row["points"] for row in json.loads(told.stdout)["rows"]] == [3.0] * each
    told = CliRunner().invoke(main, ["find", store, "--at", "kind=sin", "--where", "wave > 2", "--over", "a", "--json"])
    assert [row["first"] for row in json.loads(told.stdout)["rows"]] == [pytest.approx(2.0)] * each
    picture = tmp_path / "p.svg"
    told = CliRunner().invoke(main, ["plot", store, "--at", "kind=sin", "-o", str(picture), "--caption"])
    assert (told.exit_code, picture.exists()) == (0, True), told.stderr
    assert f"Over {3 * each} points it goes from 1" in picture.with_suffix(".txt").read_text()


def test_a_ratio_of_several_points_of_a_table_is_refused(table):
    with pytest.raises(linksweep.SweepError, match="kind = sin is at 3 points along point, and a ratio is of two"):
        linksweep.ratio(linksweep.open(table[0]), "wave", "kind", of="cos", to="sin")
