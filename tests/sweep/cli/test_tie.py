"""The commands tie and forecast as users type them, and what is made of their stores: shown, drawn and reported."""

import json

import pytest
import xarray as xr

from tests.conftest import run_sweep

LINK = ("psrpi-de200", "timing-de200", "--unknowns", "orientation", "--clip", "discrepancy", "--errors", "jackknife")
PLAN = ("psrpi", "psrpi", "--unknowns", "orientation", "--add", "2030")


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stored")
    link = run_sweep("tie", *LINK, "-o", folder / "tie.zarr")
    plan = run_sweep("forecast", *PLAN, "-o", folder / "plan.zarr")
    assert (link[0], plan[0]) == (0, 0), link[2] + plan[2]
    return folder, link[1], plan[1]


def test_a_link_is_printed_with_its_sign_stored_and_shown_again_also_in_formats_for_programs(stored):
    folder, link, plan = stored
    assert all(words in link for words in ("reference - satellite", "epsilon_y", "jackknife"))
    with xr.open_zarr(folder / "tie.zarr") as found:
        assert found.attrs["sign"] == "reference-satellite"
        assert float(found.estimate[1]) == pytest.approx(-13.06, abs=0.01)
    code, _, err = run_sweep("tie", *LINK, "-o", folder / "tie.zarr")
    assert (code, "exists already" in err) == (2, True)
    assert run_sweep("show", folder / "tie.zarr")[1] == link
    assert run_sweep("show", folder / "plan.zarr")[1] == plan
    content = json.loads(run_sweep("show", folder / "tie.zarr", "--json")[1])
    assert content["variables"]["estimate"]["values"][1] == pytest.approx(-13.06, abs=0.01)
    lines = run_sweep("show", folder / "tie.zarr", "--format", "csv")[1].splitlines()
    assert lines[0] == "unknown,unit,estimate,error_jackknife,error_formal,error_scaled"
    assert lines[2].startswith("epsilon_y,mas,-13.05")
    assert "reference-satellite" in run_sweep("show", folder / "tie.zarr", "--format", "ecsv")[1]
    assert run_sweep("show", folder / "plan.zarr", "--format", "csv")[1].startswith("unknown,unit,error_now")


def test_json_has_everything():
    options = ("--unknowns", "orientation", "--json", "--sign", "satellite-reference", "--clip", "discrepancy:1")
    content = json.loads(run_sweep("tie", "psrpi-de200", "timing-de200", *options)[1])
    assert content["attributes"]["sign"] == "satellite-reference"
    assert content["variables"]["estimate"]["values"][1] > 0.0
    assert content["variables"]["step_chosen"]["values"] == 1


def test_what_cannot_be_drawn_and_a_damaged_result_are_one_message(stored, tmp_path):
    folder, _, _ = stored
    content = json.loads((folder / "tie.zarr" / "zarr.json").read_text())
    content = {key: part for key, part in content.items() if key not in ("node_type", "consolidated_metadata")}
    (tmp_path / "bad.zarr").mkdir()
    (tmp_path / "bad.zarr" / "zarr.json").write_text(json.dumps(content))
    for command, message in {
        f"plot {folder}/tie.zarr --kind bins": "--bins COLUMN=EDGES",
        f"plot {folder}/tie.zarr --kind epochs": "no kind 'epochs' of a tie",
        f"plot {folder}/tie.zarr --at unknown=epsilon_x": "--at chooses a part of a grid",
        f"plot {folder}/tie.zarr --variable estimate": "only its kind",
        "show bad.zarr": "is damaged",
    }.items():
        code, _, err = run_sweep(*command.split(), cwd=tmp_path)
        assert (code, message in err) == (2, True), err
    assert [path.name for path in tmp_path.iterdir()] == ["bad.zarr"]
