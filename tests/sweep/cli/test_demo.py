"""The demonstration: everything that it shows is there afterwards, and nothing that was there is touched."""

import pytest

from linksweep.sweep.cli import demo
from linksweep.sweep.stores.store import open_dataset
from linksweep.sweep.studies.reader import load_study


def test_the_study_is_one_with_a_question_and_an_answer():
    study = load_study(str(demo.STUDY))
    assert study.question.endswith("?")
    assert study.conclusion.sentences


@pytest.mark.slow
def test_the_whole_way_ends_with_the_answer_and_what_comes_next(sweep, tmp_path):
    code, out, err = sweep("demo", "here", cwd=tmp_path)
    assert code == 0, err
    commands = [line.removeprefix("$ ") for line in out.splitlines() if line.startswith("$ ")]
    assert commands == ["cd here", *demo.STEPS]
    made = {path.name for path in (tmp_path / "here").iterdir()}
    assert {"demo.toml", "demo.png", "demo.html", "results"} <= made
    assert open_dataset(tmp_path / "here" / "results" / "demo.zarr").attrs["complete"]
    last = out[out.index("What do fainter quasars bring", out.index("$ sweep report")) :].splitlines()
    assert last[1].startswith("1,156 quasars to V = 17 tie GAIA's spin to 0.7")
    assert last[-len(demo.NEXT) - 1] == "next: cd here"
    assert max(map(len, out.splitlines())) <= 80


def test_a_folder_that_is_there_is_not_touched(sweep, tmp_path):
    (tmp_path / "linksweep-demo").mkdir()
    code, out, err = sweep("demo", cwd=tmp_path)
    assert (code, out) == (2, "")
    assert "linksweep-demo: exists already; nothing is overwritten" in err
    assert not list((tmp_path / "linksweep-demo").iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("package", ["matplotlib", "bokeh"])
def test_steps_whose_packages_are_missing_are_left_out(tmp_path, monkeypatch, package):
    from click.testing import CliRunner

    from linksweep.sweep.cli import main

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        demo, "STEPS", {line: "" for line in demo.STEPS if line.split()[1] in ("run", "plot", "report")}
    )
    monkeypatch.setattr(demo, "find_spec", lambda name: None if name == package else object())
    outcome = CliRunner().invoke(main, ["demo", "here"])
    assert outcome.exit_code == 0, outcome.output
    assert f"left out: `sweep report demo -o demo.html` needs {package}" in outcome.stdout
    assert (tmp_path / "here" / "demo.png").exists() == (package == "bokeh")
