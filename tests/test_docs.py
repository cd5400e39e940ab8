"""What the documents show is true: their files and commands are run as they stand there."""

import re
import shlex
from pathlib import Path

import pytest
import xarray as xr

ROOT = Path(__file__).parent.parent


def code(document, language):
    text = (ROOT / "docs" / document).read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def commands(document):
    return [line for block in code(document, "sh") for line in block.splitlines() if line.startswith("sweep ")]


def test_the_experiment_of_the_document_runs(tmp_path, sweep):
    (tmp_path / "walk.py").write_text(code("experiments.md", "python")[0])
    (tmp_path / "walk.toml").write_text(code("experiments.md", "toml")[0])
    for command in commands("experiments.md"):
        status, _, err = sweep(*shlex.split(command, comments=True)[1:], cwd=tmp_path)
        assert status == 0, err
    distance = xr.open_zarr(tmp_path / "results" / "walk.zarr")["distance"].load()
    for length in (10, 100, 1000):  # RMS of 5000 walks: 1/sqrt(2 x 5000) = 1 %
        assert distance.sel(length=length).item() == pytest.approx(length**0.5, rel=0.05)


def test_the_study_of_the_document_runs(tmp_path, sweep):
    (tmp_path / "study.toml").write_text(code("studies.md", "toml")[0])
    status, _, err = sweep("run", "study.toml", "--set", "n_sim=10", cwd=tmp_path)
    assert status == 0, err
    assert xr.open_zarr(tmp_path / "results" / "study.zarr").attrs["complete"] == 1


def test_the_commands_of_the_document_run(tmp_path, sweep):
    for command in commands("studies.md"):
        status, _, err = sweep(*shlex.split(command, comments=True)[1:], cwd=tmp_path)
        assert status == 0, f"{command}: {err}"
    assert (tmp_path / "quick.png").stat().st_size > 10_000


def test_the_commands_of_the_analysis_run(tmp_path, sweep):
    for command in commands("analysis.md"):
        status, _, err = sweep(*shlex.split(command, comments=True)[1:], cwd=tmp_path)
        assert status == 0, f"{command}: {err}"
    assert {path.name for path in tmp_path.iterdir() if path.is_file()} == {
        *("quasars.png", "sky.png", "both.svg", "accuracy.pdf"),
    }


def test_links_between_documents_lead_somewhere():
    for document in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", document.read_text()):
            assert target.startswith("https://") or (document.parent / target).exists(), f"{document.name}: {target}"


def test_the_readme_shows_the_table_that_the_study_prints(tmp_path, sweep):
    """The first rows of the README's table, computed again."""
    table = re.search(r"```text\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)[1]
    status, out, err = sweep("run", "quasars", "--axis", "v_max=14,14.5", "-o", tmp_path / "s.zarr")
    assert status == 0, err
    printed = [line.split() for line in out.splitlines() if line.split()[:1] in (["amex"], ["gaia"])]
    assert len(printed) == 4
    shown = [line.split() for line in table.splitlines()]
    assert all(row in shown for row in printed)
