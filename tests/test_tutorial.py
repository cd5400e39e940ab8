"""The tutorial is run from top to bottom: files are saved, commands and scripts run where they stand."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import xarray as xr

pytestmark = pytest.mark.slow  # a dozen runs, each a process of its own

TUTORIAL = Path(__file__).parent.parent / "docs" / "tutorial.md"
BLOCK = re.compile(r"```(\w+|\{picture\})(?: (\S+))?\n(.*?)```", re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder in which the tutorial was done, what its scripts and its commands printed."""
    path = tmp_path_factory.mktemp("tutorial")
    printed, outputs = [], []
    for language, file, text in BLOCK.findall(TUTORIAL.read_text()):
        if file:
            (path / file).write_text(text)
        elif language in ("sh", "{picture}"):
            for words in filter(None, (shlex.split(line, comments=True) for line in text.splitlines())):
                assert words[0] == "sweep"
                out = run(path, "-m", "linksweep", *words[1:])
                outputs.append((words[1:3], out))
        elif language == "python":
            (path / "script.py").write_text(text)
            printed.append(run(path, "script.py"))
    return path, printed, outputs


def run(folder, *arguments):
    done = subprocess.run([sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{arguments}: {done.stderr}"
    return done.stdout


def test_every_file_and_figure_is_there(folder):
    path, _, _ = folder
    assert {p.name for p in (path / "results").glob("*.zarr")} == {
        *("demo.zarr", "first.zarr", "precise.zarr", "mission.zarr", "pi.zarr", "elsewhere.zarr")
    }
    assert all(
        (path / name).stat().st_size > 10_000
        for name in ("demo.svg", "demo.html", "first.svg", "curves.svg", "spin.png")
    )


def test_the_numbers_are_what_the_text_says(folder):
    path, printed, _ = folder
    exponents = [float(x) for x in re.findall(r"-0\.\d+", printed[-1])]
    assert len(exponents) == 2, printed
    assert exponents[1] == pytest.approx(-0.5, abs=0.05)
    assert -0.8 < exponents[0] < -0.52
    mission = xr.open_zarr(path / "results" / "mission.zarr")["sigma_spin"].load()
    ratio = mission.sel(model="half") / mission.sel(model="gaia")
    assert ratio.values == pytest.approx(0.5, rel=0.1)
    share = xr.open_zarr(path / "results" / "pi.zarr")["share"].load()
    assert share.sel(side=1.0).item() == pytest.approx(3.14159 / 4, abs=4 * 0.41 / 20000**0.5)


def test_the_text_has_the_answer_of_its_own_run(folder):
    """The sentences of the conclusion, as the run prints them last."""
    run = next(out for command, out in folder[2] if command == ["run", "demo.toml"])
    assert run.endswith(re.search(r"```text\n(.*?)```", TUTORIAL.read_text(), flags=re.DOTALL)[1])


def test_the_text_has_the_exponents_and_the_verdict_of_its_own_fit(folder):
    fit = next(out for (command, _), out in folder[2] if command == "fit")
    text = TUTORIAL.read_text().partition("sweep fit")[2]
    amex, gaia = (re.search(rf"{model} .*?(-0\.\d+) ±", fit)[1] for model in ("amex", "gaia"))
    assert f"is {float(gaia):.2f} for\nGAIA" in text
    assert f"{float(amex):.2f} for AMEX" in text
    assert "2 of 2 lines: the law does not hold" in fit
    assert "neither is a law within the errors" in text
