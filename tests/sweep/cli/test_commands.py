"""The commands, as a user types them."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest

import linksweep
from tests.conftest import main, run_sweep
from tests.tiers import few, slow

# Commands about a store of `quasars` and the tables that are built in, which print no table of axes of the user's
PRINTING = ["list", "params", "plan quasars", "show quasars --at model=gaia", "status quasars", "compare quasars"]
PRINTING_TOO = ["params icrf2-icrf3", "show quasars", "check quasars", "fit quasars --over v_max --at model=gaia"]
PRINTING_TOO += ["reproduce quasars --at model=gaia,v_max=14", "sensitivity quasars"]
PRINTING_TOO += ["find quasars --where 'sigma_spin < 1 uas/yr' --over v_max"]
PRINTING_TOO += ["tie icrf3 icrf2 --degree 2 --clip rayleigh", "forecast icrf3 icrf2 --add 2030 --choose 3"]
ODD = ["-o.zarr", "a  b.zarr", "$HOME.zarr", "#x&<b>;'\".zarr", "[s]*.zarr", "~.zarr", "two\nlines.zarr", "-long" * 40]


def test_help_and_completion_import_nothing_heavy():
    words = "_SWEEP_COMPLETE='bash_complete', COMP_WORDS='sweep run qua', COMP_CWORD='2'"
    code = f"import os, sys; os.environ.update({words})\nimport linksweep.sweep.cli\n"
    code += "try: linksweep.sweep.cli.main(prog_name='sweep')\n"
    code += "except SystemExit: print(*{m.partition('.')[0] for m in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert {"click", "plain,quasars"} <= set(loaded)
    assert not {"numpy", "xarray", "zarr", "dask", "distributed", "pydantic", "rich", "matplotlib"} & set(loaded)


def test_plan_writes_nothing(sweep, tmp_path):
    assert "200" in sweep("plan", "grid", cwd=tmp_path, code=0)[1]
    _, out, _ = run_sweep("plan", "grid", "--json", "--axis", "n_obj=10:30:10", "--workers", 1, cwd=tmp_path)
    assert (json.loads(out)["points"], json.loads(out)["cores"]) == (2 * 5 * 3 * 4, 1)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", few(4, ODD))
def test_commands_that_are_printed_and_written_can_be_given(name, tmp_path):
    (tmp_path / "half.py").write_text("def half(a: int):\n    return 1 / (a - 2)\n")
    asked, new = ("half.py:half", "--axis", "a=1,2", "-o"), f"{name}.new"
    _, _, failed = run_sweep("run", *asked, name, "--pool", "serial", cwd=tmp_path)
    _, status, _ = run_sweep("status", "--", name, cwd=tmp_path)
    next((tmp_path / name / "blocks").glob("rows.*")).write_bytes(b"")
    _, _, damaged = run_sweep("check", "--", name, cwd=tmp_path)
    assert run_sweep("submit", *asked, new, "--slurm", 2, "--trust", cwd=tmp_path)[0] == 0
    script = (tmp_path / f"{new}.slurm" / "submit.sh").read_text()
    assert "--array=1-2" in script
    lines = [*failed.split("`")[1::2], status.partition("next: ")[2], *damaged.split("`")[1::2]]
    lines += [line for line in script.splitlines() if line.startswith("exec ")]
    shell = 'sweep () { printf \'%s\\0\' "$@"; }; exec () { sweep "$@"; }; '
    said = (subprocess.check_output(["bash", "-c", shell + line], text=True, cwd=tmp_path) for line in lines)
    words = [one.split("\0")[:-1] for one in said]
    at, new = ("./" * name.startswith("-") + one for one in (name, new))
    assert words[:3] == [["status", at], ["run", "--retry", at], ["reproduce", at, "--at", "POINT"]]
    assert words[3:5] == [["run", "--retry", at], ["check", at, "--repair"]]
    assert words[5][4:10] == ["run", "half.py:half", "--axis=a=1,2", "--trust", "-o", new]
    assert words[6][4:] == ["merge", "--trust", "-o", new, f"{new}.part-*-of-2"]


@pytest.mark.parametrize("name", ["run_%j.zarr", "caf\udce9.zarr"])
def test_a_script_for_slurm_has_names_as_they_are_and_the_parts_as_a_pattern(name, tmp_path):
    (folder := tmp_path / f"in {name}").mkdir()
    (folder / "half.py").write_text("def half(a: int):\n    return a / 2\n")
    asked = ("half.py:half", "--axis", "a=1,2", "-o", name)
    assert run_sweep("submit", *asked, "--slurm", 100_000, cwd=folder)[0] == 0
    script = (folder / f"{name}.slurm" / "submit.sh").read_bytes()
    assert script.count(os.fsencode(f"/{name.replace('%', '%%')}.slurm")) == 2
    assert len(script) < 3000
    for part in ("1/2", "2/2"):
        assert run_sweep("run", *asked, "--part", part, cwd=folder)[0] == 0
    assert run_sweep("merge", f"{name}.part-*", "-o", name, cwd=folder)[0] == 0
    assert linksweep.open(folder / name).half.values.tolist() == [0.5, 1.0]


def test_the_help_has_every_command_each_has_its_own_with_an_example_and_one_thing_has_one_name(sweep):
    code, out, _ = sweep("--help")
    commands = out.partition("\nRun:\n")[2]
    listed = [line.split()[0] for line in commands.splitlines() if line.startswith("  ")]
    assert (code, sorted(listed), "..." in commands) == (0, sorted(main.list_commands(None)), False)
    for command in listed:
        code, more, _ = sweep(command, "--help")
        assert (code, f"sweep {command}" in more.replace("Usage: sweep", "")) == (0, True)
        assert max(map(len, (out + more).splitlines())) <= 80, command
    for name, command in main.commands.items():
        for option in (p for p in command.params if isinstance(p, click.Option)):
            long = [spelling for spelling in option.opts if spelling.startswith("--")]
            assert len(long) == 1, (name, option.opts)
            assert ("-o" in option.opts) == (long == ["--output"]), (name, option.opts)
            assert long[0] not in ("--out", "--map", "--dry-run"), name
            assert long[0] != "--along" or name == "refine", name  # which adds points along it, others look over it
            assert "json" not in getattr(option.type, "choices", ()), name


@pytest.mark.parametrize("commands", [PRINTING, slow(PRINTING_TOO)], ids=["some", "others"])
def test_what_is_printed_fits_80_columns(sweep, here, commands):
    _, out, err = sweep("run", "quasars", "--set", "n_sim=2", "--set", "n_cat=5", "--axis", "v_max=14,20", code=0)
    assert out.splitlines()[-1].endswith("times better.")
    assert "next: sweep plot quasars, sweep report quasars" in err
    for line in commands:
        code, printed, err = sweep(*shlex.split(line))
        assert code in (0, 1), (line, err)
        lines = [line.rstrip() for line in printed.splitlines()]
        assert max(map(len, lines)) <= 80, (line, max(lines, key=len))
        assert not [line for line in lines if line.endswith("...")], line
    assert json.loads(sweep("list", "--json")[1])["quasars"]["question"].endswith("?")


def test_a_part_that_the_study_excludes_and_a_figure_of_failed_points_alone_are_refused(tmp_path):
    axes, exclude = {"a": [1.0, 2.0, 3.0], "b": [1.0, 2.0, 3.0]}, [{"b": 3.0}, {"a": 2.0, "b": 2.0}]
    study = {"experiment": lambda a, b: b / (a - 3.0), "axes": axes, "exclude": exclude}
    linksweep.run(study, tmp_path / "s.zarr", pool="serial")
    for command in ("show", "fit", "find --where result<1", "plot -o p.png", "sensitivity"):
        for at in ("a=2,b=2", "b=3"):
            code, out, err = run_sweep(*command.split(), "s.zarr", "--at", at, cwd=tmp_path)
            assert (code, out, f"--at {at}: the study has no point there" in err) == (2, "", True), command
    for at, count in (("a=3", 2), ("a=3,b=1", 1)):
        code, _, err = run_sweep("plot", "s.zarr", "--at", at, "-o", "p.png", cwd=tmp_path)
        assert (code, f"no value to draw here: 0 of {count} points are done, {count} failed" in err) == (2, True)
    assert [path.name for path in tmp_path.iterdir()] == ["s.zarr"]


@pytest.mark.parametrize("each", [1, slow(2)], ids=["alone", "crossed"])
def test_all_points_of_a_table_that_have_a_value_are_shown(each, tmp_path):
    def wave(a: int, kind: str, b: float = 1.0):
        return float(a) if kind == "sin" else -b

    store, picture = tmp_path / "wave.zarr", tmp_path / "p.svg"
    points = {"a": [1, 2, 3, 4], "kind": ["sin", "cos", "sin", "sin"]}
    linksweep.run(wave, store, points=points, axes={"b": [1.0, 2.0]} if each == 2 else None, pool="serial")
    for line, column, values in (
        ("show STORE --at kind=sin", "a", sorted([1, 3, 4] * each)),
        ("show STORE --at kind=sin,a=3", "wave", [3.0] * each),
        ("fit STORE --at kind=sin --over a", "points", [3.0] * each),
        ("find STORE --at kind=sin --where wave>2 --over a", "first", [pytest.approx(2.0)] * each),
    ):
        _, out, err = run_sweep(*line.replace("STORE", str(store)).split(), "--json")
        assert [row[column] for row in json.loads(out)["rows"]] == values, err
    code, _, err = run_sweep("plot", store, "--at", "kind=sin", "-o", picture, "--caption")
    assert (code, err.count("wrote "), picture.exists()) == (0, 2, True), err
    assert f"over {3 * each} points" in picture.with_suffix(".txt").read_text()
    with pytest.raises(linksweep.SweepError, match="kind = sin is at 3 points along point, and a ratio is of two"):
        linksweep.ratio(linksweep.open(store), "wave", "kind", of="cos", to="sin")


def offered(folder, *words):
    script = f"""
eval "$(_SWEEP_COMPLETE=bash_source sweep)"
compopt() {{ echo "option: $1 $2" > options; }}
COMP_WORDS=({" ".join(f"'{word}'" for word in words)})
COMP_CWORD={len(words) - 1}
_sweep_completion sweep
printf '%s\\n' "${{COMPREPLY[@]}}"
[ ! -f options ] || (cat options; rm options)
"""
    here = {"PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin"}
    done = subprocess.run(["bash", "-c", script], cwd=folder, capture_output=True, text=True, check=True, env=here)
    assert done.stderr == ""
    return done.stdout.split("\n")


@pytest.mark.slow
def test_shells_complete_built_in_studies_and_files(tmp_path):
    (tmp_path / "quick.toml").touch()
    for command in ("run", "plan"):
        assert [name for name in offered(tmp_path, "sweep", command, "qu") if name] == ["quasars", "quick.toml"]
        assert "option: -o default" in offered(tmp_path, "sweep", command, "folder/qu")  # bash looks for files itself
