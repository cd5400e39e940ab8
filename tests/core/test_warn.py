"""What makes a result less certain than it looks is said: curves beyond their range, objects that decide alone."""

import json

import numpy as np
import pytest
from astropy.table import Table
from click.testing import CliRunner

from linksweep.core.experiment import link
from linksweep.core.missions import MISSIONS
from linksweep.sweep.cli.group import main
from linksweep.sweep.stores.store import open_dataset
from linksweep.sweep.tables.file import table_file


def point(**changes):
    return link.defaults() | {"n_obj": 30} | changes


def sky(path, v_mag, **columns):
    rng, n = np.random.default_rng(2), len(v_mag)
    position = {"ra": rng.uniform(0.0, 360.0, n), "dec": np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, n)))}
    Table(columns | position | {"v_mag": v_mag}).write(path, overwrite=True)
    return table_file(path)


def test_a_curve_is_never_better_than_its_floor():
    bright = np.array([3.0, 7.9])
    np.testing.assert_array_equal(1000.0 * MISSIONS["gaia"].sigma_pm_mas_yr(bright), 3.0)
    assert np.all(MISSIONS["gaia-dr3"].sigma_pm_mas_yr(bright) > 0.046)
    for name, mission in MISSIONS.items():
        sigma = mission.sigma_pm_mas_yr(np.linspace(-5.0, 20.0, 251))
        held = mission.sigma_pm_mas_yr(np.linspace(-5.0, min(5.0, mission.floor.brighter_than_mag), 20))
        assert held.min() >= mission.floor.pm_mas_yr, name
        assert sigma.min() > 1e-3, name  # no uas/yr


@pytest.mark.parametrize("name", ["amex", "gaia"])
def test_the_floor_leaves_the_papers_magnitudes_to_the_curve(name):
    mission, v_mag = MISSIONS[name], np.linspace({"amex": 2.1, "gaia": 12.8}[name], 20.0, 400)
    np.testing.assert_array_equal(mission.sigma_pm_mas_yr(v_mag), mission.curve_pm_mas_yr(v_mag))
    np.testing.assert_array_equal(mission.sigma_pos_mas(v_mag), mission.curve_pos_mas(v_mag))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"model": "gaia"}, "model = 'gaia': its accuracy curve is known from V = 12.8 to 20, and the catalogue has"),
        (
            {"model": "gaia-dr3"},
            "known from V = 8 to 21, and the catalogue has or may have objects brighter than V = 8",
        ),
        ({"model": "gaia", "v_min": 13.0, "v_max": 20.5}, "objects fainter than V = 20, where it is extrapolated"),
        ({"model": "gaia", "v_min": 13.0}, None),
        ({"model": "amex"}, None),
        ({"model": "gaia", "catalogue": "quasars", "n_obj": None}, None),
        ({"model": "gaia", "satellite_errors": "normal"}, None),
    ],
)
def test_magnitudes_outside_of_a_curves_range_are_warned_of(changes, words):
    found = link.warn(point(**changes))
    assert len(found) == (words is not None)
    assert all(words in sentence for sentence in found)


def test_an_object_with_most_of_the_weight_is_named_with_its_share(tmp_path):
    v_mag = np.array([9.37, *np.full(40, 15.0)])
    table = sky(tmp_path / "sky.ecsv", v_mag, Name=np.array(["Mrk 421", *(f"q{k}" for k in range(40))]))
    one = point(catalogue="file", file=table, n_obj=None, satellite_errors="magnitude", model="amex")
    (found,) = link.warn(one)
    weight = MISSIONS["amex"].sigma_pm_mas_yr(v_mag) ** -2.0
    assert f"row 1 (Mrk 421, V = 9.37) holds {100 * weight[0] / weight.sum():.0f} % of the weight" in found
    assert link.warn(one | {"v_min": 10.0}) == []
    assert link.warn(one | {"weighting": "equal"}) == []


def test_a_run_says_and_stores_its_warnings_and_show_repeats_them(tmp_path):
    study, store = tmp_path / "bright.toml", tmp_path / "bright.zarr"
    study.write_text('title = "t"\n[axes]\nmodel = ["gaia"]\n[fixed]\nn_obj = 12\n[sampling]\nn_sim = 3\n')
    run = CliRunner()
    planned = run.invoke(main, ["plan", str(study), "-o", str(store)])
    assert "its accuracy curve is known from V = 12.8 to 20" in planned.output
    ran = run.invoke(main, ["run", str(study), "-o", str(store)])
    assert "warning: model = 'gaia'" in ran.output + ran.stderr
    (stored,) = json.loads(open_dataset(store).attrs["warnings"])
    assert stored.endswith("held at its floor (1 point)")
    assert f"warning: {stored}" in " ".join(run.invoke(main, ["show", str(store)]).output.split())


@pytest.mark.parametrize(("last", "warned"), [(2016.5, True), (2016.0, False), (np.nan, False)])
def test_rows_of_different_epochs_are_told(tmp_path, last, warned):
    file = sky(tmp_path / "sky.ecsv", np.full(30, 15.0), ref_epoch=[2016.0] * 29 + [last])
    found = [s for s in link.warn(point(catalogue="file", file=file, n_obj=None)) if "ref_epoch" in s]
    assert found == warned * [
        "file: ref_epoch is between 2016 and 2016.5, and the simulation takes all rows as of one epoch; "
        "`sweep tie` links rows of different epochs"
    ]
