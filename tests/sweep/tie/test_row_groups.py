"""Millions of quasars by row groups: the numbers of the whole table, the same bits on any workers, in little memory."""

import tracemalloc
from contextlib import closing

import numpy as np
import pyarrow as pa
import pytest
from click.testing import CliRunner
from pyarrow import parquet

from linksweep import SweepError, tie
from tests.core.tie.made import main
from tests.sweep.outside import Outside
from tests.tiers import few, slow

SPIN = (0.03, -0.02, 0.05)
OF_ALL = {"unknowns": "spin", "degree": 2, "clip": "median:5", "errors": "cells"}
OPTIONS = [
    *(OF_ALL, {"unknowns": "spin,glide", "clip": "rayleigh", "errors": "sandwich,bootstrap"}),
    {"unknowns": "spin", "clip": "huber:3", "weights": "variance", "bins": ("phot_g_mean_mag", [17.0, 19.0])},
    *({"known_spin": SPIN, "clip": "discrepancy:2"}, {"unknowns": "spin", "jitter": {"motion": (0.0, 0.4)}}),
    {"unknowns": "spin", "clip": "huber:0.5", "bins": ("phot_g_mean_mag", [20.99, 20.995])},  # few are so faint
]


def quasars(path, n=3000, group=700, **changes):
    rng = np.random.default_rng(6)
    ra, dec = rng.uniform(0.0, 2.0 * np.pi, n), np.arcsin(rng.uniform(-1.0, 1.0, n))
    x, y, z = SPIN
    along = -np.sin(dec) * (np.cos(ra) * x + np.sin(ra) * y) + np.cos(dec) * z, np.sin(ra) * x - np.cos(ra) * y
    motion = -np.array(along) + rng.normal(0.0, 0.3, (2, n)) + 50.0 * (rng.random(n) < 0.01)
    columns = {"source_id": 1 + np.arange(n), "ra": np.degrees(ra), "dec": np.degrees(dec)}
    columns |= {"pmra": motion[0], "pmdec": motion[1], "pmra_pmdec_corr": rng.uniform(-0.4, 0.4, n)}
    columns |= {"pmra_error": np.full(n, 0.3), "pmdec_error": np.full(n, 0.3), "ref_epoch": np.full(n, 2016.0)}
    columns["phot_g_mean_mag"] = rng.uniform(15.0, 21.0, n)
    parquet.write_table(pa.table(columns | changes), path, row_group_size=group)
    return path


@pytest.fixture
def by_groups(monkeypatch):
    monkeypatch.setattr("linksweep.sweep.tie.setup.FROM_ROWS", 1000)


@pytest.mark.parametrize("options", [slow(one) for one in OPTIONS])
def test_it_is_the_solution_of_the_whole_table(tmp_path, monkeypatch, options):
    path = quasars(tmp_path / "quasars.parquet")
    whole = tie(path, "zero-motion", **options)
    monkeypatch.setattr("linksweep.sweep.tie.setup.FROM_ROWS", 1000)
    monkeypatch.setattr("linksweep.sweep.tie.link.HEAVIEST", 3000)
    split = tie(path, "zero-motion", **options)
    error = whole.errors.sel(error_kind="formal").values
    np.testing.assert_allclose(split.estimate / error, whole.estimate / error, atol=1e-9)
    np.testing.assert_allclose(split.errors.sel(error_kind="formal"), error, rtol=1e-9)
    if "cells" in options.get("errors", ""):
        np.testing.assert_allclose(split.error, whole.error, rtol=1e-8)
    for name in ("weight_factor", "discrepancy", "n_sources", "chi2_expected"):
        np.testing.assert_allclose(split[name], whole[name], rtol=1e-7, atol=1e-9, err_msg=name)
    heavy = [[note for note in link.attrs["notes"] if "of the weight" in note] for link in (split, whole)]
    assert (heavy[0], bool(heavy[0])) == (heavy[1], "20.995" in str(options))
    assert (split.attrs["satellite_sha256"], *split.source.values) == (whole.attrs["satellite_sha256"], *range(1, 3001))


@pytest.mark.parametrize("rows", [1000, 10**6], ids=["by groups", "whole"])
def test_sources_without_a_motion_are_left_out_with_a_note(tmp_path, monkeypatch, rows):
    monkeypatch.setattr("linksweep.sweep.tie.setup.FROM_ROWS", rows)
    ra = np.linspace(0.0, 100.0, 3000)  # the first group lies within 24 deg
    table = parquet.read_table(quasars(tmp_path / "quasars.parquet", ra=ra))
    lacks = np.isin(np.arange(3000), [*range(720), 2000])  # all of the first group
    parquet.write_table(table.filter(~lacks), tmp_path / "moving.parquet", row_group_size=700)
    motions = ("pmra", "pmdec", "pmra_error", "pmdec_error")
    blank = {name: pa.array(table[name].to_numpy(), mask=lacks) for name in motions}
    paths = quasars(tmp_path / "b.parquet", ra=ra, **blank), tmp_path / "moving.parquet"
    links = [tie(path, "zero-motion", clip="median:5") for path in paths]
    np.testing.assert_allclose(links[0].estimate, links[1].estimate, rtol=1e-9)
    assert [int(link.n_sources) for link in links] == [int(links[1].n_sources)] * 2
    assert any("721 of 3000 sources" in note for note in links[0].attrs["notes"])
    assert any("from row 1 on: no errors of ra" in note for note in links[0].attrs["notes"]) == (rows == 1000)


@pytest.mark.parametrize("clip", [*map(slow, ["none", "rayleigh", "median:5"])])
def test_the_bits_are_the_same_on_any_workers_and_without_sources(tmp_path, by_groups, clip):
    path, options = quasars(tmp_path / "quasars.parquet"), OF_ALL | {"clip": clip}
    here, there = (tie(path, "zero-motion", workers=workers, **options) for workers in (None, 2))
    rest = tie(path, "zero-motion", **options, per_source=False)
    assert {"discrepancy", "n_observations", "weight_factor"} == set(here.data_vars) - set(rest.data_vars)
    for other in (there, rest):
        for name in other.data_vars:
            np.testing.assert_array_equal(other[name].values, here[name].values, err_msg=name)
    assert (rest.attrs, len(there.data_vars)) == (here.attrs, len(here.data_vars))


@pytest.mark.slow
def test_a_scheduler_elsewhere_gives_the_same_bits(tmp_path, by_groups):
    path = quasars(tmp_path / "quasars.parquet")
    with closing(Outside(tmp_path)) as outside:
        outside.start_worker("--nworkers", "2")
        outside.wait_for_workers(2)
        there = tie(path, "zero-motion", "spin", scheduler=outside.address)
    np.testing.assert_array_equal(there.estimate, tie(path, "zero-motion", "spin").estimate)


@pytest.mark.parametrize("seed", few(1, [6, 1, 3, 5, 7]))
def test_the_epoch_is_the_median_of_all_row_groups(tmp_path, by_groups, monkeypatch, seed):
    rng, n = np.random.default_rng(seed), 20 + seed
    epochs = np.round(rng.uniform(2014.0, 2018.0, n), [0, 5][seed // 2 % 2])
    epochs = epochs if seed < 6 else np.repeat([2014.0, 2016.0], [n // 2, n - n // 2])  # the middle is where they meet
    path = quasars(tmp_path / "q.parquet", n, int(rng.integers(3, 12)), ref_epoch=epochs)
    for rows in (10, 1000):
        monkeypatch.setattr("linksweep.sweep.tie.setup.FROM_ROWS", rows)
        assert tie(path, "zero-motion", "spin").attrs["epoch"] == np.median(epochs)


def test_wrong_rows_are_named_with_their_row_group(tmp_path, by_groups):
    path = quasars(tmp_path / "quasars.parquet", dec=np.where(np.arange(3000) == 1500, 95.0, 0.0))
    result = CliRunner().invoke(main, ["tie", str(path), "zero-motion"])
    words = "the 700 rows from row 1401 on: a dec outside -90..90 deg in row 101"
    assert (result.exit_code, words in result.output) == (2, True), result.output
    epochs = np.repeat([2016.0, 2017.5], [1400, 1600])  # one in each row group
    with pytest.raises(SweepError, match="rows have the epochs of dr3 and dr4"):
        tie(quasars(tmp_path / "two.parquet", ref_epoch=epochs), "zero-motion")
    for options in ({"aberration": 5.8}, {"orbits": "o.csv"}):
        with pytest.raises(SweepError, match=r"is such a position|models and orbits"):
            tie(quasars(tmp_path / "quasars.parquet"), "zero-motion", **options)


@pytest.mark.slow
def test_without_sources_memory_hardly_grows_with_their_number(tmp_path, by_groups):

    def peak(n):
        path = quasars(tmp_path / f"{n}.parquet", n, 2000)
        tracemalloc.start()
        link = tie(path, "zero-motion", "spin", clip="median:50", errors="cells", per_source=False)
        result = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return result, link

    _, (small, _), (large, link) = peak(2000), peak(2000), peak(10_000)  # the first imports
    assert (large - small) / 8_000 < 40.0
    assert not {"source", "row"} & set(link.dims)
