"""Stored links and forecasts: shown, drawn and reported."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

import linksweep
from linksweep.sweep.cli import main


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


LINK = ("psrpi-de200", "timing-de200", "--unknowns", "orientation", "--clip", "discrepancy", "--errors", "jackknife")


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stored")
    link = run("tie", *LINK, "-o", folder / "tie.zarr")
    plan = run("forecast", "psrpi", "psrpi", "--unknowns", "orientation", "--add", "2030", "-o", folder / "plan.zarr")
    assert link.exit_code == plan.exit_code == 0, link.output + plan.output
    return folder, link.stdout, plan.stdout


@pytest.mark.slow
def test_show_prints_what_the_command_printed(stored):
    folder, link, plan = stored
    assert run("show", folder / "tie.zarr").stdout == link
    assert run("show", folder / "plan.zarr").stdout == plan


def test_show_has_formats_for_programs(stored):
    folder, _, _ = stored
    content = json.loads(run("show", folder / "tie.zarr", "--json").stdout)
    assert content["variables"]["estimate"]["values"][1] == pytest.approx(-13.06, abs=0.01)
    lines = run("show", folder / "tie.zarr", "--format", "csv").stdout.splitlines()
    assert lines[0] == "unknown,unit,estimate,error_jackknife,error_formal,error_scaled"
    assert lines[2].startswith("epsilon_y,mas,-13.05")
    assert "reference-satellite" in run("show", folder / "tie.zarr", "--format", "ecsv").stdout
    assert (
        run("show", folder / "plan.zarr", "--format", "csv").stdout.splitlines()[0].startswith("unknown,unit,error_now")
    )


def test_python_opens_it(stored):
    folder, _, _ = stored
    link = linksweep.open(folder / "tie.zarr")
    np.testing.assert_allclose(link.estimate[1], -13.06, atol=0.01)
    assert linksweep.open(str(folder / "plan.zarr")).attrs["result"] == "forecast"


@pytest.mark.slow
def test_figures_are_drawn(stored):
    folder, _, _ = stored
    drawn = run("tie", *LINK, "--figures", folder / "figures")
    assert drawn.exit_code == 0, drawn.output
    names = {path.stem for path in (folder / "figures").iterdir()}
    assert names == {"solution", "residuals", "separations", "weight", "ranking", "jackknife", "trajectory"}
    found = run("plot", folder / "tie.zarr", "--kind", "weight", "-o", folder / "weight.png")
    assert found.exit_code == 0, found.output
    assert (folder / "weight.png").read_bytes() == (folder / "figures" / "weight.png").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--kind", "bins"], "--bins COLUMN=EDGES"),
        (["--kind", "epochs"], "no kind 'epochs' of a tie"),
        (["--at", "unknown=epsilon_x"], "--at chooses a part of a grid"),
        (["--variable", "estimate"], "only its kind"),
    ],
)
def test_what_cannot_be_drawn_is_one_message(stored, arguments, message):
    folder, _, _ = stored
    found = run("plot", folder / "tie.zarr", *arguments, "-o", folder / "none.png")
    assert found.exit_code == 2
    assert message in found.output
    assert not (folder / "none.png").exists()


def test_a_damaged_result_is_one_message(stored, tmp_path):
    (tmp_path / "bad.zarr").mkdir()
    text = (stored[0] / "tie.zarr" / "zarr.json").read_text()
    content = json.loads(text)
    content.pop("node_type")
    content.pop("consolidated_metadata", None)
    (tmp_path / "bad.zarr" / "zarr.json").write_text(json.dumps(content))
    found = run("show", tmp_path / "bad.zarr")
    assert found.exit_code == 2
    assert "is damaged" in found.output


@pytest.mark.slow
def test_the_report_has_the_table_the_sign_and_the_figures(stored):
    folder, _, _ = stored
    found = run("report", folder / "tie.zarr", folder / "plan.zarr", "-o", folder / "page.html")
    assert found.exit_code == 0, found.output
    page = (folder / "page.html").read_text()
    for text in (
        "reference - satellite",
        "-13.05506",
        "jackknife",
        "clip step by step",
        "More than 10 %",
    ):
        assert text in page, text
    assert "Bokeh" not in page  # nothing here is drawn by it
    assert "all observed at 2030" in page
    assert page.count("<figure>") == 7 + 2
    assert "undefined" not in page.partition("<script>")[0]


def test_a_report_without_a_clip_says_so(tmp_path):
    made = run("tie", "psrpi-de200", "timing-de200", "--unknowns", "orientation", "-o", tmp_path / "tie.zarr")
    assert made.exit_code == 0, made.output
    assert run("report", tmp_path / "tie.zarr", "-o", tmp_path / "tie.html").exit_code == 0
    assert "matched by name; clip none;" in (tmp_path / "tie.html").read_text()
