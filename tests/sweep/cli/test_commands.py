"""The commands, as a user types them."""

import json
import shlex
import subprocess
import sys

import click
import pytest
import xarray as xr

from linksweep.sweep.analysis.results_table import headline_table
from linksweep.sweep.cli import main
from linksweep.sweep.cli.group import SECTIONS
from linksweep.sweep.stores.store import open_dataset
from tests.conftest import COINS
from tests.tiers import slow

PRINTING = ["list", "params", "plan quasars", "show quasars --at model=gaia", "status quasars", "compare quasars"]
PRINTING_TOO = [
    *("params icrf2-icrf3", "show quasars", "check quasars"),
    *("fit quasars --over v_max --at model=gaia", "reproduce quasars --at model=gaia,v_max=14"),
    *("find quasars --where 'sigma_spin < 1 uas/yr' --over v_max", "sensitivity quasars"),
    *("tie icrf3 icrf2 --degree 2 --clip rayleigh", "forecast icrf3 icrf2 --add 2030 --choose 3"),
]
"""Commands about a store of `quasars` and the tables that are built in, which print no table of axes of the user's."""


@pytest.mark.parametrize("command", sorted(main.commands))
def test_every_command_has_help_with_an_example(sweep, command):
    code, out, _ = sweep(command, "--help")
    assert code == 0
    assert f"sweep {command}" in out.replace("Usage: sweep", "")
    assert max(map(len, out.splitlines())) <= 80
    assert "..." not in out.replace("STORE...", "").replace("GALAXIES...", "")


def test_help_imports_nothing_heavy():
    """`sweep --help` answers at once: what takes long to import is imported by the commands that need it."""
    code = "import sys, linksweep.sweep.cli; print(*sorted({m.partition('.')[0] for m in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "click" in loaded
    assert not {"numpy", "xarray", "zarr", "dask", "distributed", "pydantic", "rich", "matplotlib"} & set(loaded)


def test_params_tell_unit_default_and_meaning(sweep):
    code, out, _ = sweep("params", "--json")
    by_name = {p["name"]: p for p in json.loads(out)}
    assert code == 0
    assert by_name["v_max"]["unit"] == "mag"
    assert by_name["weighting"]["default"] == "inverse-variance"
    code, out, _ = sweep("params", COINS)
    assert "mean chance of heads; a finite number >= 0.2 and <= 0.8" in out


def test_plan_writes_nothing(sweep, tmp_path):
    code, out, _ = sweep("plan", "grid", cwd=tmp_path)
    assert code == 0
    assert "200" in out
    code, out, _ = sweep("plan", "grid", "--json", "--axis", "n_obj=10:30:10", cwd=tmp_path)
    assert json.loads(out)["points"] == 2 * 5 * 3 * 4
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_overrides_on_the_command_line_are_those_in_the_file(sweep, link_study, tmp_path):
    sweep("run", link_study, "-o", tmp_path / "a.zarr", "--set", "n_sim=100", "--axis", "v_max=14:15:0.5")
    text = (
        link_study.read_text()
        .replace("n_sim = 2000", "n_sim = 100")
        .replace("[14.0, 15.0, 16.0]", "[14.0, 14.5, 15.0]")
    )
    link_study.write_text(text)
    sweep("run", link_study, "-o", tmp_path / "b.zarr")
    a, b = (xr.open_zarr(tmp_path / name).load() for name in ("a.zarr", "b.zarr"))
    xr.testing.assert_identical(a.drop_attrs(), b.drop_attrs())
    assert a.attrs["study_digest"] == b.attrs["study_digest"]
    assert a.attrs["study_overrides"] == "--set n_sim=100 --axis v_max=14:15:0.5"


@pytest.mark.slow
def test_the_four_axis_grid_runs(sweep, tmp_path):
    code, _, err = sweep("run", "grid", "-o", tmp_path / "s.zarr", "--set", "n_sim=20", "--set", "n_cat=4", "--json")
    assert code == 0, err
    dataset = xr.open_zarr(tmp_path / "s.zarr").load()
    grid = {name: dataset.sizes[name] for name in dataset["status"].dims}
    assert grid == {"model": 2, "v_max": 5, "n_obj": 5, "error_scale": 4}
    assert dataset["status"].size >= 200
    off = (dataset["sigma_spin"] - dataset["sigma_spin_predicted"]) / dataset["sigma_spin_mc_error"]
    assert abs(off).max() < 4.5  # 200 points


@pytest.mark.slow
def test_no_number_is_cut_on_a_narrow_terminal(sweep, link_study, tmp_path):
    sweep("run", link_study, "-o", tmp_path / "s.zarr", "--set", "n_sim=20")
    command = f"stty cols 40; {sys.executable} -m linksweep show {tmp_path}/s.zarr"
    shown = subprocess.run(["script", "-qec", command, "/dev/null"], capture_output=True, text=True, check=True).stdout
    assert "sigma_spin" in shown
    assert "…" not in shown


def test_the_help_has_every_command_in_one_section_with_a_whole_sentence(sweep):
    listed = [name for commands in SECTIONS.values() for name in commands]
    assert sorted(listed) == sorted(main.commands)
    code, out, _ = sweep("--help")
    assert code == 0
    assert "  run         Run a study into a store" in out.partition("\nRun:\n")[2].partition("\nLook:\n")[0]
    assert "..." not in out.partition("Run:")[2]
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.parametrize("commands", [PRINTING, slow(PRINTING_TOO)], ids=["some", "others"])
def test_what_is_printed_fits_80_columns(sweep, tmp_path, monkeypatch, commands):
    monkeypatch.chdir(tmp_path)
    code, out, err = sweep("run", "quasars", "--set", "n_sim=2", "--set", "n_cat=5", "--axis", "v_max=14,20")
    assert code == 0, err
    assert out.splitlines()[-1].endswith("times better.")
    assert "next: sweep plot quasars, sweep report quasars" in err
    for line in commands:
        code, printed, err = sweep(*shlex.split(line))
        assert code in (0, 1), (line, err)
        lines = [line.rstrip() for line in printed.splitlines()]
        assert max(map(len, lines)) <= 80, (line, max(lines, key=len))
        assert not [line for line in lines if line.endswith("...")], line
    assert "15,533 quasars to V = 20 tie GAIA's spin" in sweep("list")[1]
    assert json.loads(sweep("list", "--json")[1])["quasars"]["question"].endswith("?")


@pytest.mark.slow
def test_a_table_that_is_too_wide_says_what_it_leaves_out(store_of, sweep):
    table = headline_table(open_dataset(store_of("aberration")))
    kept, left_out = table.fitting(80)
    assert max(map(len, kept.text(80).splitlines())) <= 80
    assert left_out
    assert all(column.rank == 0 for column in table.fitting(10)[0].columns)
    out = sweep("show", store_of("aberration"))[1]
    assert "left out to fit 80 columns: " in out


def test_one_thing_has_one_name_in_all_commands():
    """An option has one long spelling; -o is always --output; a script asks for JSON with --json alone."""
    for name, command in main.commands.items():
        for option in (p for p in command.params if isinstance(p, click.Option)):
            long = [spelling for spelling in option.opts if spelling.startswith("--")]
            assert len(long) == 1, (name, option.opts)
            assert ("-o" in option.opts) == (long == ["--output"]), (name, option.opts)
            assert long[0] not in ("--out", "--along", "--map", "--dry-run"), name
            assert "json" not in getattr(option.type, "choices", ()), name


@pytest.mark.parametrize("command", ["show", "compare"])
def test_two_formats_are_refused(sweep, store_of, command):
    code, out, err = sweep(command, store_of("quasars"), "--json", "--format", "csv")
    assert (code, out) == (2, "")
    assert "--json and --format csv are two formats; name one" in err


@pytest.mark.slow
def test_params_of_a_study_are_those_of_its_experiment(sweep):
    assert sweep("params", "icrf2-icrf3") == sweep("params", "linksweep.sweep.tie.experiment:tie")
