"""The commands tie and forecast as users type them."""

import json
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner

from linksweep.core.frames import MAS
from linksweep.sweep.cli import main
from tests.core.tie.test_missions import EPSILON, OMEGA, missions
from tests.sweep.tie.test_tables import gaia


def run(*arguments):
    return CliRunner().invoke(main, list(arguments))


def test_a_link_is_printed_with_its_sign_and_stored(tmp_path):
    store = tmp_path / "tie.zarr"
    found = run(
        "tie", "psrpi-de200", "timing-de200", "--unknowns", "orientation", "--errors", "jackknife", "-o", str(store)
    )
    assert found.exit_code == 0, found.output
    assert "reference - satellite" in found.output
    assert "epsilon_y" in found.output
    assert "jackknife" in found.output
    with xr.open_zarr(store) as stored:
        assert stored.attrs["sign"] == "reference-satellite"
        assert float(stored.estimate[1]) == pytest.approx(-13.06, abs=0.01)
    again = run("tie", "psrpi-de200", "timing-de200", "-o", str(store))
    assert again.exit_code == 2
    assert "nothing is overwritten" in again.output


def test_json_has_everything():
    found = run(
        "tie",
        "psrpi-de200",
        "timing-de200",
        "--unknowns",
        "orientation",
        "--json",
        "--sign",
        "satellite-reference",
        "--clip",
        "discrepancy:1",
    )
    content = json.loads(found.output)
    assert content["attributes"]["sign"] == "satellite-reference"
    assert content["variables"]["estimate"]["values"][1] > 0.0
    assert content["variables"]["step_chosen"]["values"] == 1


def test_a_forecast_is_printed():
    found = run(
        *("forecast", "psrpi", "psrpi", "--unknowns", "orientation,spin", "--add", "2026,2030", "--choose", "2"),
        *("--for", "spin", "--release", "dr4", "--from-release", "dr3", "--error", "0.2"),
    )
    assert found.exit_code == 0, found.output
    assert "chosen for spin" in found.output
    assert "all observed at 2030" in found.output
    assert max(map(len, found.output.splitlines())) <= 88  # a page of the documentation has room for it


def two_missions(tmp_path):
    """Write the tables of two missions and a reference whose rows are exact; return their paths."""
    made = missions(n=20, noisy=False)
    rows = made.rows
    names = np.arange(20)
    first, other = rows.frame == 1, rows.frame == 0
    gaia(tmp_path / "hipparcos.ecsv", replace(rows.taken(first), radial_velocity=np.zeros(20)), source_id=names)
    vlbi = replace(rows.taken(other), radial_velocity=np.zeros(other.sum()))
    gaia(tmp_path / "vlbi.ecsv", vlbi, source_id=names[: other.sum()])
    gaia(tmp_path / "gaia.ecsv", made.satellite, source_id=names)
    return [str(tmp_path / f"{name}.ecsv") for name in ("gaia", "vlbi", "hipparcos")]


@pytest.mark.slow
def test_two_missions_have_an_orientation_and_a_spin_each(tmp_path):
    first, reference, second = two_missions(tmp_path)
    store = tmp_path / "tie.zarr"
    found = run("tie", first, reference, "--mission", f"hip={second}", "--errors", "jackknife", "-o", str(store))
    assert found.exit_code == 0, found.output
    assert "reference - hip: " in found.output
    assert "hip:omega_z" in found.output
    with xr.open_zarr(store) as stored:
        estimate = stored.estimate.values.reshape(4, 3)
        np.testing.assert_allclose(estimate[[0, 2]], EPSILON / MAS, atol=5e-4)
        np.testing.assert_allclose(estimate[[1, 3]], OMEGA / MAS, atol=2e-5)
        assert set(stored.row_table.values) == {"reference", "hip"}
        assert list(stored.attrs["missions"]) == ["hip"]
    for kind in ("solution", "residuals", "jackknife", "ranking"):
        assert run("plot", str(store), "--kind", kind, "-o", str(tmp_path / f"{kind}.png")).exit_code == 0
    only = run("tie", first, reference, "--mission", f"hip={second}", "--unknowns", "orientation,spin,hip:spin")
    assert "hip:epsilon_x" not in only.output


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--mission", "hip"], "NAME=TABLE"),
        (["--mission", "spin=psrpi"], "none of the unknowns"),
        (["--mission", "hip=nowhere.fits"], "nowhere.fits: no such file"),
        (["--mission", "a=psrpi", "--mission", "a=psrpi"], "named twice"),
        (["--mission", "a=psrpi", "--unknowns", "orientation,b:spin"], "'b:spin'"),
        (["--mission", "a=psrpi", "--mission-epoch", "b=1991.25"], "no table b"),
        (["--mission", "a=psrpi", "--mission-epoch", "a=1991.25,1992"], "is not NAME=YEAR"),
        (["--mission", "a=psrpi", "--mission-epoch", "a=,"], "is not NAME=YEAR"),
        (["--mission", "a=psrpi", "--jitter", "b:position=1"], "no mission 'b'"),
        (["--without-cos-dec", "b"], "no table b"),
    ],
)
def test_a_wrong_mission_is_one_message(options, message):
    found = run("tie", "psrpi", "psrpi", *options)
    assert found.exit_code == 2, found.output
    assert message in found.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["psrpi", "nowhere.fits"], "nowhere.fits: no such file"),
        (["psrpi", "icrf3"], "within 1 arcsec"),
        (["psrpi", "psrpi", "--clip", "median"], "clip 'median'"),
        (["psrpi", "psrpi", "--unknowns", "spinn"], "'spinn' are not known"),
        (["psrpi", "psrpi", "--jitter", "position"], "--jitter"),
        (["psrpi", "psrpi", "--bins", "mag"], "COLUMN=EDGE"),
        (["psrpi", "psrpi", "--known-spin", "0.1,0.2"], "three numbers"),
        (["psrpi", "psrpi", "--column", "ra"], "--column"),
        (["psrpi", "psrpi", "--column", "ra=x"], "no column 'x'"),
        (["psrpi", "psrpi", "-o", "out.nc"], "ends in .zarr"),
        (["icrf3", "icrf2", "--unknowns", "spin"], "nothing in the tables determines omega_x"),
    ],
)
def test_wrong_input_is_one_message_and_exit_code_2(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    found = run("tie", *arguments)
    assert found.exit_code == 2, found.output
    assert message in found.output
    assert "Traceback" not in found.output
    assert not list(tmp_path.iterdir())
