"""Labels of the rows of a table: coordinates of a store that change no number, whatever joins its points."""

import pandas as pd
import pytest
import xarray as xr
from astropy.table import Table
from hypothesis import HealthCheck, given, settings, strategies as st

import linksweep
from linksweep import SweepError
from tests.sweep.opening import POINT, merge
from tests.tiers import examples


def noisy(x: float, k: int = 1, *, rng):
    return {"y": k * x + rng.normal()}


def run(store, rows=None, labels=None, function=noisy, **more):
    return linksweep.run(function, store, points=rows, labels=labels, pool="serial", **more)


STARS = {"x": [1.0, 2.0, 2.0], "star": ["Sirius", None, "Vega"], "hd": [48915, 2**62, 172167]}


@pytest.mark.parametrize("form", ["mapping", "frame", "index", "levels", "table", "file"])
def test_labels_are_coordinates_along_points_and_change_no_number(tmp_path, form):
    store, rows, labels = tmp_path / "s.zarr", STARS, ["star", "hd"]
    if form in ("frame", "index", "levels"):
        index = {"frame": [], "index": ["star"], "levels": ["star", "hd"]}[form]
        rows = pd.DataFrame(STARS).set_index(index) if index else pd.DataFrame(STARS)
        labels = [name for name in labels if name not in index]
    elif form != "mapping":
        rows = Table({**STARS, "star": ["Sirius", "", "Vega"]})
        rows.write(tmp_path / "t.ecsv")
        rows = rows if form == "table" else str(tmp_path / "t.ecsv")
    ds = run(store, rows, labels)
    assert ds.y_mean.values.tobytes() == run(tmp_path / "plain.zarr", {"x": STARS["x"]}).y_mean.values.tobytes()
    for found_there in (ds, linksweep.open(store), xr.open_zarr(store).load()):
        assert found_there.star.dims == found_there.hd.dims == (POINT,)
        assert found_there.star.values.tolist() == ["Sirius", "", "Vega"]
        assert found_there.hd.values.tolist() == STARS["hd"]


def test_a_name_of_digits_in_a_file_stays_what_is_written(tmp_path):
    def of_text(name: str, x: float = 1.0):
        return {"name_back": name}

    def of_any(name, x: float = 1.0):
        return {"name_back": str(name)}

    (tmp_path / "t.csv").write_text("name,x,hip,field\n0071,1,7,007\n12,2,8,\n")
    for k, function in enumerate((of_text, of_any)):
        ds = run(tmp_path / f"{k}.zarr", str(tmp_path / "t.csv"), ["hip", "field"], function)
        assert ds.name.values.tolist() == ds.name_back.values.tolist() == ["0071", "12"]
        assert ds.hip.values.tolist() == [7, 8]
        assert ds.field.values.tolist() == ["007", ""]


def test_what_is_no_label_is_refused_by_name(tmp_path):
    frame = pd.DataFrame({"x": [1.0], "star": ["a"]})
    for rows, labels, words in (
        (frame, None, r'unknown parameter .star.; .*labels = \["star"\]'),
        (frame, "starr", "no column; did you mean 'star'"),
        (frame.set_index("x"), "star", "'x': is a parameter or a result"),
        (frame.rename(columns={"star": "status"}), "status", "'status': the platform gives this name"),
        (frame.rename(columns={"star": "a/b"}), "a/b", "a name begins with a letter"),
        ({"x": [1.0, 2.0], "star": ["a"]}, "star", "x has 2, star has 1"),
        (frame, 3, "labels.0: input should be a valid string"),
        (None, "star", "points = None"),
        (frame.rename(columns={"star": "y_std"}), "y_std", "y_std is a label and the name of a result"),
    ):
        with pytest.raises(SweepError, match=words):
            run(tmp_path / "s.zarr", rows, labels)


CELLS = st.one_of(st.none(), st.text("ab", max_size=2), st.integers(0, 3), st.floats(0, 2))
TABLES = st.lists(st.tuples(st.sampled_from([1.0, 2.0, 3.0]), CELLS), min_size=1, max_size=5)


@settings(
    max_examples=max(2, examples(12) // 3), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(table=TABLES, first=st.integers(1, 4), number=st.integers(1, 3))
def test_rows_of_any_labels_grow_are_corrected_and_come_together_from_parts(tmp_path_factory, table, first, number):
    folder = tmp_path_factory.mktemp("labels")
    columns = {"x": [x for x, _ in table], "label": [label for _, label in table]}
    whole = run(folder / "s.zarr", columns, "label")
    expected = ["" if cell is None else str(cell) for cell in columns["label"]]
    texts = whole.label.dtype.kind not in "if"
    got = whole.label.values.tolist()
    assert got == expected if texts else [float(cell) for cell in expected if cell] == [c for c in got if c == c]  # noqa: PLR0124
    run(folder / "grown.zarr", {"x": columns["x"][:first], "label": ["another"] * len(columns["x"][:first])}, "label")
    run(folder / "grown.zarr", columns, "label")
    for k in range(1, number + 1):
        run(folder / "parts.zarr", columns, "label", part=f"{k}/{number}")
    merge(sorted(folder.glob("parts.zarr.part-*")), folder / "parts.zarr")
    for store in ("grown.zarr", "parts.zarr"):
        again = linksweep.open(folder / store)
        assert again.y_mean.values.tobytes() == whole.y_mean.values.tobytes()
        assert again.x.values.tolist() == columns["x"]
        assert str(again.label.values.tolist()) == str(got)


def test_points_beside_a_table_have_no_labels(tmp_path):
    run(tmp_path / "s.zarr", {"x": [1.0, 2.0], "star": ["a", "b"]}, "star")
    run(tmp_path / "s.zarr", {"x": [1.0]})
    run(tmp_path / "s.zarr", axes={"x": [2.0, 9.0]})
    ds = linksweep.open(tmp_path / "s.zarr")
    rows = list(zip(ds.x.values.tolist(), ds.star.values.tolist(), strict=True))
    assert rows == [(1.0, "a"), (2.0, "b"), (9.0, "")]
