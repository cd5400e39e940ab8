"""Bad input gives one message that names value, allowed values and place, exit code 2, and leaves nothing behind."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from linksweep.sweep.cli import main
from tests.tiers import slow

GOOD = """\
title = "A good study"

[axes]
v_max = [16.0, 17.0]
n_obj = [20, 50]

[fixed]
catalogue = "quasars"

[sampling]
n_sim = 10
seed = 7
"""

Tree = dict[str, bytes | None]


def tree(folder: Path) -> Tree:
    """Every path below a folder, with the content of files."""
    return {
        str(p.relative_to(folder)): p.read_bytes() if p.is_file() and not p.is_symlink() else None
        for p in sorted(folder.rglob("*"))
    }


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def sweep(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments))


def check_refused(here: Path, arguments: tuple[str, ...], *phrases: str) -> Result:
    before = tree(here)
    result = sweep(*arguments)
    assert result.exit_code == 2, (result.exit_code, result.exception, result.output)
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert result.stdout == ""
    for phrase in phrases:
        assert phrase in result.stderr
    assert "Traceback" not in result.output
    assert len(result.stderr) < 20_000
    assert tree(here) == before
    return result


def edited(old: str, new: str) -> str:
    assert GOOD.count(old) == 1
    return GOOD.replace(old, new)


def axis(spec: str, name: str = "v_max") -> str:
    line = "v_max = [16.0, 17.0]" if name == "v_max" else "n_obj = [20, 50]"
    return edited(line, f"{name} = {spec}")


def fixed(line: str) -> str:
    return edited('catalogue = "quasars"', f'catalogue = "quasars"\n{line}')


def sampling(line: str) -> str:
    return edited("n_sim = 10", line)


def after(section: str) -> str:
    return f"{GOOD}\n{section}\n"


CSV = "published/table.csv"
PUBLISHED = f'[published]\nfile = "{CSV}"\nsource = "A paper"'

STUDIES = {
    # keys
    "unknown key": (f"colour = 3\n{GOOD}", "colour (line 1): unknown key; known are axes, claim, conclusion, define"),
    "misspelt section": (edited("[sampling]", "[samplng]"), "samplng", "unknown key; did you mean 'sampling'?"),
    "unknown key in sampling": (sampling("nsim = 3"), "sampling.nsim (line 11): unknown key; did you mean 'n_sim'?"),
    "unknown key in grid": (after("[grid]\nzipp = []"), "grid.zipp (line 15): unknown key; did you mean 'zip'?"),
    "unknown key in published": (after(f"{PUBLISHED}\nyear = 2004"), "published.year (line 17): unknown key"),
    "missing key in published": (after('[published]\nfile = "x"'), "published.source (line 14): is required"),
    "missing title": (edited('title = "A good study"\n', ""), "title: is required"),
    "unknown parameter": (fixed("altitude = 3"), "fixed.altitude (line 9): unknown parameter 'altitude'"),
    "misspelt parameter": (
        fixed("missin_length = 3"),
        "fixed.missin_length (line 9)",
        "did you mean 'mission_length'?",
    ),
    "misspelt axis": (edited("v_max =", "vmax ="), "axes.vmax (line 4): unknown parameter 'vmax'", "mean 'v_max'?"),
    "key with a line feed": (fixed(r'"a\nb" = 1'), r"fixed.'a\nb' (line 7): unknown parameter 'a\nb'"),
    "long key": (fixed(f'"{"k" * 100_000}" = 1'), "kkk...kkk", "unknown parameter"),
    # types
    "string for number": (
        fixed('error_scale = "two"'),
        "fixed.error_scale (line 9): error_scale = 'two': must be a fin",
    ),
    "bool for number": (fixed("error_scale = true"), "error_scale = True: must be a finite number >= 0"),
    "float for int": (axis("[20.5]", "n_obj"), "axes.n_obj (line 5): n_obj = 20.5: must be an integer >= 2"),
    "number for string": (edited('"quasars"', "5"), "catalogue = 5: must be one of 'synthetic', 'quasars'"),
    "misspelt choice": (edited('"quasars"', '"quasar"'), "catalogue = 'quasar': must be", "did you mean 'quasars'?"),
    "number for bool": (fixed("corrections = 1"), "fixed.corrections (line 9): corrections = 1: must be true or false"),
    "date for number": (fixed("error_scale = 2020-01-01"), "error_scale = datetime.date(2020, 1, 1): must be"),
    "control character in the title": (
        edited("A good study", r"A \u001b[2J study"),
        "title (line 1): 'A \\x1b[2J study' holds the control character U+001B",
    ),
    "direction of text": (
        after(PUBLISHED.replace("A paper", r"A \u202e paper")),
        "published.source (line 16): 'A \\u202e paper' holds the control character U+202E",
    ),
    "number for title": (edited('"A good study"', "5"), "title (line 1): input should be a valid string, not 5"),
    "list for section": (edited('[fixed]\ncatalogue = "quasars"\n', "") + "[[fixed]]", "fixed", "valid dictionary"),
    "number for section": ("sampling = 3\n" + GOOD.partition("[sampling]")[0], "sampling (line 1)", "not 3"),
    "vector for number": (fixed("error_scale = [1, 1, 1]"), "error_scale = [1, 1, 1]: must be a finite number"),
    "long value": (fixed(f'error_scale = "{"x" * 100_000}"'), "error_scale = 'xxx", "...", "must be a finite number"),
    # values
    "negative sigma": (fixed("satellite_sigma_pos = -1.0"), "satellite_sigma_pos = -1.0: must be", ">= 0 [mas]"),
    "zero where above": (fixed("mission_length = 0"), "mission_length = 0: must be a finite number > 0 [yr]"),
    "nan": (fixed("error_scale = nan"), "fixed.error_scale (line 9): error_scale = nan: must be a finite number"),
    "infinity": (axis("[16.0, inf]"), "axes.v_max (line 4): v_max = inf: must be a finite number"),
    "huge": (fixed("error_scale = 1e305"), "error_scale = 1e+305: must be a finite number", ", below 1e+300 in size"),
    "integer too long to print": (
        fixed(f"error_scale = 0x{'f' * 5000}"),
        "error_scale = an integer of 20000 bits: must",
    ),
    "integer too long to read": (fixed(f"error_scale = {'9' * 5000}"), "not valid TOML: Exceeds the limit"),
    "too many objects": (axis("[20, 400]", "n_obj"), "n_obj = 400: only 315 quasars are brighter than v_max = 16 mag"),
    "brighter than the brightest": (
        axis("[12.0]"),
        "v_max = 12 mag is outside the quasar counts: the brightest object",
    ),
    "fainter than the counts": (axis("[20.5]"), "v_max = 20.5 mag is outside the quasar counts", "end at V = 20"),
    "v_max below v_min": (
        edited('"quasars"', '"synthetic"\nv_min = 16.5'),
        "v_max = 16 mag: must be fainter than the brightest object, v_min = 16.5 mag (2 points)",
    ),
    "synthetic without n_obj": (
        axis("[true]", "n_obj").replace("n_obj = [true]", "").replace('"quasars"', '"synthetic"'),
        "n_obj: a synthetic catalogue needs a number of objects (2 points)",
    ),
    "vector too short": (fixed("omega = [1.0, 1.0]"), "omega = [1.0, 1.0]: must be a list of three finite numbers"),
    "vector with a string": (fixed('omega = [1.0, 1.0, "x"]'), "omega = 'x': must be a list of three finite numbers"),
    # axes
    "vector as axis": (axis("[1]\nomega = [[1, 1, 1]]"), "axes.omega (line 5): a vector cannot be an axis"),
    "empty axis": (axis("[]"), "axes.v_max (line 4): an axis needs at least one value"),
    "scalar axis": (axis("16.0"), "axes.v_max (line 4): 16.0: write a list, { start, stop, step } or"),
    "duplicate value": (axis("[16.0, 17, 16, 17.0]"), "axes.v_max (line 4): duplicate values 16.0, 17.0"),
    "axis and fixed": (fixed("v_max = 16.0"), "fixed.v_max (line 9): is an axis too; leave out one of the two"),
    "zero step": (axis("{ start = 14, stop = 16, step = 0 }"), "step = 0: does not lead from start = 14 to stop = 16"),
    "wrong direction": (axis("{ start = 16, stop = 14, step = 0.5 }"), "step = 0.5: does not lead from start = 16"),
    "1e9 values": (axis("{ start = 14, stop = 16, step = 2e-9 }"), "make about 1e+09 values; at most 1000000"),
    "bad num": (axis("{ start = 14, stop = 16, num = 0 }"), "num = 0: must be an integer from 1 to 1000000"),
    "fractional num": (axis("{ start = 14, stop = 16, num = 2.5 }"), "num = 2.5: must be an integer from 1"),
    "log with zero": (
        axis('{ start = 0, stop = 16, num = 3, spacing = "log" }'),
        "log spacing needs start and stop > 0",
    ),
    "log that overflows": (
        axis('{ start = 1e-200, stop = 1e200, num = 3, spacing = "log" }', "n_obj"),
        "axes.n_obj (line 5): n_obj = ",
        "must be an integer >= 2",
    ),
    "unknown spacing": (axis('{ start = 14, stop = 16, num = 3, spacing = "cubic" }'), "spacing = 'cubic': must be"),
    "missing stop": (
        axis("{ start = 14, step = 0.5 }"),
        "keys ['start', 'step']: allowed are values; start, stop, step;",
    ),
    "values not a list": (axis("{ values = 16.0 }"), "axes.v_max (line 4): values = 16.0: must be a list"),
    "start a string": (axis('{ start = "a", stop = 16, step = 1 }'), "start = 'a': must be a finite number"),
    "a million rounded to ten": (
        axis('{ start = 2, stop = 11, num = 1000000, spacing = "log" }', "n_obj"),
        "axes.n_obj (line 5): duplicate values 2, 3, 4",
    ),
    "a million bad values": (
        axis("{ start = 21, stop = 30, num = 1000000 }"),
        "v_max = 21 mag is outside the quasar counts",
        "other reasons; the rest of the grid was not checked",
    ),
    "too many points": (
        axis("{ start = 14, stop = 16, num = 1000000 }").replace("[20, 50]", "{ start = 2, stop = 21, step = 1 }"),
        "the grid has 20,000,000 points (v_max 1,000,000 x n_obj 20); at most 10,000,000 are allowed",
    ),
    # zip
    "duplicate point through zip": (
        axis("[16.0, 17.0, 16.0]").replace("[20, 50]", "[20, 50, 20]") + '[grid]\nzip = [["v_max", "n_obj"]]',
        "axes.v_max (line 4): duplicate value 16.0",
        "axes.n_obj (line 5): duplicate value 20",
    ),
    "zip of unequal lengths": (
        axis("[16.0]") + '[grid]\nzip = [["v_max", "n_obj"]]',
        "grid.zip.0 (line 14): zipped axes must have the same number of values: v_max has 1, n_obj has 2",
    ),
    "zip of an unknown axis": (
        after('[grid]\nzip = [["v_max", "n_ob"]]'),
        "'n_ob' is not an axis; did you mean 'n_obj'",
    ),
    "zip of one axis": (after('[grid]\nzip = [["v_max"]]'), "grid.zip.0 (line 15): ['v_max']: name at least two axes"),
    "zipped twice": (after('[grid]\nzip = [["v_max", "n_obj"], ["n_obj", "v_max"]]'), "grid.zip.1", "is zipped twice"),
    # exclusions
    "everything excluded": (after("[[exclude]]\nv_max = { above = 1 }"), "every point of the grid is excluded"),
    "empty exclusion": (after("[[exclude]]"), "exclude.0 (line 14): is empty and would leave out every point"),
    "unknown condition": (
        after("[[exclude]]\nv_max = { over = 1 }"),
        "exclude.0.v_max (line 15): unknown condition ['over']",
    ),
    "no condition": (
        after("[[exclude]]\nv_max = {}"),
        "exclude.0.v_max (line 15): has no condition; allowed are above",
    ),
    "unordered condition": (after("[[exclude]]\nmodel = { above = 1 }"), "model has no order: use equal or in"),
    "condition on an unknown parameter": (
        after("[[exclude]]\nvmax = 1"),
        "exclude.0.vmax (line 15): unknown parameter",
    ),
    "condition not a number": (
        after('[[exclude]]\nv_max = { above = "a" }'),
        "exclude.0.v_max.above",
        "'a': must be a fin",
    ),
    "two conditions": (after("[[exclude]]\nv_max = { in = [1], above = 2 }"), "'in' takes a list, and 'in' or 'equal'"),
    "second exclusion": (
        after("[[exclude]]\nv_max = 17\n[[exclude]]\nv_max = true"),
        "exclude.1.v_max (line 17): v_max = True",
    ),
    "condition on what has no value": (
        axis("", "n_obj").replace("n_obj = ", "") + "[[exclude]]\nn_obj = { above = 30 }",
        "exclude.0.n_obj (line 14): n_obj has no value to compare: it is neither an axis nor fixed",
    ),
    # sampling
    "negative n_sim": (
        sampling("n_sim = -1"),
        "sampling.n_sim (line 11): input should be greater than or equal to 1, not -1",
    ),
    "zero n_sim": (sampling("n_sim = 0"), "sampling.n_sim (line 11)", "not 0"),
    "huge n_sim": (
        sampling("n_sim = 10000000000"),
        "input should be less than or equal to 1000000000, not 10000000000",
    ),
    "unprintable n_sim": (
        sampling(f"n_sim = 0x{'f' * 5000}"),
        "sampling.n_sim (line 11)",
        "not an integer of 20000 bits",
    ),
    "fractional n_sim": (
        sampling("n_sim = 10.0"),
        "sampling.n_sim (line 11): input should be a valid integer, not 10.0",
    ),
    "negative seed": (
        edited("seed = 7", "seed = -1"),
        "sampling.seed (line 12): input should be greater than or equal to 0",
    ),
    "huge seed": (edited("seed = 7", f"seed = {2**64}"), "sampling.seed (line 12)", "less than 18446744073709551616"),
    # text
    "syntax": (edited("[sampling]", "[sampling"), "study.toml: not valid TOML", "at line 10", "'[sampling'"),
    "duplicate key": (sampling("n_sim = 10\nn_sim = 20"), "not valid TOML", "at line 12", "'n_sim = 20'"),
    "duplicate section": (after("[axes]"), "not valid TOML", "at line 14", "'[axes]'"),
    "brackets without end": (fixed(f"omega = {'[' * 10_000}"), "not valid TOML: nested too deeply"),
    "deep keys": (fixed(f"error_scale{'.a' * 90} = 1"), "error_scale = {'a': {'a': {'a': {...}}}}: must be"),
    "deeper keys": (fixed(f"error_scale{' . a' * 200_000} = 1"), "not valid TOML: nested too deeply"),
    "deep header": (after(f"[fixed.{'a.' * 400_000}b]"), "not valid TOML: nested too deeply"),
    "many unknown keys": (
        fixed("\n".join(f"k{i} = {i}" for i in range(50_000))),
        "fixed.k0 (line 9): unknown parameter",
        "... and perhaps more problems like these",
    ),
    "long line of blanks": (f'x = """\n[{" " * 200_000}\n"""\n{GOOD}', "x (line 1): unknown key"),
    # experiment
    "experiment without a colon": (
        f'experiment = "core"\n{GOOD}',
        "experiment (line 1): 'core': write module:attribute",
    ),
    "unknown module": (f'experiment = "no_such:x"\n{GOOD}', "'no_such:x': cannot be imported: ModuleNotFoundError: No"),
    "relative module": (f'experiment = ".:x"\n{GOOD}', "experiment (line 1): '.:x': cannot be imported"),
    "unknown attribute": (f'experiment = "math:taux"\n{GOOD}', "'math:taux': the module has no attribute 'taux'"),
    "not an experiment": (f'experiment = "math:tau"\n{GOOD}', "has a float, not an Experiment or a function, at 'tau'"),
    "experiment file missing": (f'experiment = "no.py:x"\n{GOOD}', "experiment (line 1): there is no file", "no.py"),
    "experiment file with a NUL": (f'experiment = "a\\u0000.py:x"\n{GOOD}', "experiment (line 1)", r"a\x00.py:x': "),
    # published
    "published file missing": (
        after(PUBLISHED),
        "published.file (line 15): 'published/table.csv' cannot be read: No such",
    ),
    "published file a directory": (
        after(PUBLISHED.replace(CSV, ".")),
        "published.file (line 15): '.' cannot be read: Is a",
    ),
    "published file with a NUL": (after(PUBLISHED.replace(CSV, "\\u0000")), "published.file (line 15)", r"'\x00' "),
    "published file a device": (
        after(PUBLISHED.replace(CSV, "/dev/zero")),
        "'/dev/zero' is larger than 1,000,000 bytes",
    ),
}


LARGE = ("a million rounded to ten", "a million bad values", "too many points")


@pytest.mark.parametrize("case", [pytest.param(c, marks=pytest.mark.slow) if c in LARGE else c for c in STUDIES])
@pytest.mark.parametrize("command", ["run", "plan"])
def test_bad_study(here: Path, command: str, case: str) -> None:
    text, *phrases = STUDIES[case]
    (here / "study.toml").write_text(text, encoding="utf-8")
    result = check_refused(here, (command, "study.toml"), *phrases)
    assert "study" in result.stderr.splitlines()[0]


def test_five_problems_are_reported_in_one_message(here: Path) -> None:
    text = """\
title = 5
colour = "red"

[axes]
v_mx = [16.0]
n_obj = []

[fixed]
error_scale = -1.0

[sampling]
n_sim = 0
"""
    (here / "study.toml").write_text(text)
    result = check_refused(
        here,
        ("run", "study.toml"),
        "error: study.toml: 6 problems\n",
        "  - title (line 1): input should be a valid string, not 5\n",
        "  - colour (line 2): unknown key",
        "  - axes.v_mx (line 5): unknown parameter 'v_mx'; did you mean 'v_max'?\n",
        "  - axes.n_obj (line 6): an axis needs at least one value\n",
        "  - fixed.error_scale (line 9): error_scale = -1.0: must be a finite number >= 0",
        "  - sampling.n_sim (line 12): input should be greater than or equal to 1, not 0\n",
    )
    assert len(result.stderr.splitlines()) == 7


def test_all_reasons_of_a_grid_are_reported(here: Path) -> None:
    (here / "study.toml").write_text(axis("[12.0, 16.0, 21.0]").replace("[20, 50]", "[20, 1000]"))
    check_refused(
        here,
        ("run", "study.toml"),
        "3 problems",
        "v_max = 12 mag is outside the quasar counts: the brightest object has V = 12.8, the counts end at V = 20 (2 p",
        "n_obj = 1000: only 315 quasars are brighter than v_max = 16 mag (1 point)",
        "v_max = 21 mag is outside",
    )


@pytest.mark.parametrize(
    ("content", "phrase"),
    [
        ("v_max,sigma\n", "'published/table.csv' holds no rows"),
        ("# nothing\n", "'published/table.csv' holds no rows"),
        ("v_max,colour,sigma_spin\n16,red,1\n", "columns ['colour'] are neither parameters nor outputs"),
        ("# c\nv_max,sigma_spin\n16,0.5\n17\n", "line 4: does not have 2 cells as the header has"),
        ("v_max,sigma_spin\n16,0.5,3\n", "line 2: does not have 2 cells as the header has"),
        ("v_max,sigma_spin\n16,0.5 mas\n", "line 2: sigma_spin = '0.5 mas': must be a number or empty"),
        ("v_max,sigma_spin\n,0.5\n", "line 2: v_max = '': must be a number"),
        ("v_max,sigma_spin\nnan,0.5\n", "line 2: v_max = 'nan': must be a finite number"),
        ("model,v_max,sigma_spin\nhipparcos,16,0.5\n", "line 2: model = 'hipparcos': must be one of 'amex', 'gaia'"),
        (f"v_max,sigma_spin\n16,{'1' * 200_000}\n", "is not a CSV table: field larger than field limit"),
        (b"v_max\n\xff\n", "not UTF-8 text: byte 0xff in line 2"),
    ],
)
def test_bad_published_table(here: Path, content: str | bytes, phrase: str) -> None:
    (here / "study.toml").write_text(after(PUBLISHED))
    (here / CSV).parent.mkdir()
    (here / CSV).write_bytes(content.encode() if isinstance(content, str) else content)
    check_refused(here, ("run", "study.toml"), "published.file (line 15): 'published/table.csv'", phrase)


@pytest.mark.parametrize(
    ("statement", "phrase"),
    [
        ("raise RuntimeError('no licence')", "cannot be imported: RuntimeError: no licence"),
        ("def f(:\n", "cannot be imported: SyntaxError: invalid syntax"),
        ("import sys; sys.exit(0)", "cannot be imported: SystemExit: 0"),
        ("def __getattr__(name): raise ImportError(name)", "cannot be imported: ImportError: experiment"),
        ("experiment = 1", "has a int, not an Experiment or a function, at 'experiment'"),
    ],
)
def test_bad_experiment_file(here: Path, monkeypatch: pytest.MonkeyPatch, statement: str, phrase: str) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", False)  # or no __pycache__ would be written anyway
    (here / "mine.py").write_text(statement + "\n")
    (here / "study.toml").write_text(f'experiment = "mine.py:experiment"\n{GOOD}')
    check_refused(here, ("run", "study.toml"), "experiment (line 1): 'mine.py:experiment': ", phrase)
    check_refused(here, ("params", "mine.py:experiment"), phrase)


def test_python_is_no_study(here: Path) -> None:
    (here / "mine.py").write_text("def f(x: float):\n    return x\n")
    check_refused(here, ("run", "mine.py", "--axis", "x=1"), "mine.py: is Python, not a study", "as mine.py:NAME")


def test_a_package_that_is_not_installed(here: Path) -> None:
    (here / "own" / "inner").mkdir(parents=True)
    (here / "own" / "__init__.py").touch()
    (here / "own" / "inner" / "__init__.py").touch()
    (here / "own" / "inner" / "part.py").write_text("from ..other import unit\ndef f(x: float): return x\n")
    (here / "own" / "other.py").write_text("unit = 1.0\n")
    for reference, phrase in (
        ("own/inner/part.py:f", f"named by its module: PYTHONPATH={here} sweep run own.inner.part:f"),
        ("own.inner.part:f", f"No module named 'own'; it is not installed: PYTHONPATH={here} finds it here"),
    ):
        command = [sys.executable, "-P", "-m", "linksweep", "run", reference, "--axis", "x=1"]  # as the command is
        done = subprocess.run(command, cwd=here, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (2, "")
        assert phrase in done.stderr


def test_a_check_that_raises_is_a_reason(here: Path) -> None:
    (here / "mine.py").write_text(
        "import dataclasses, linksweep.core.experiment\n"
        "def check(point): raise KeyError('lost')\n"
        "experiment = dataclasses.replace(linksweep.core.experiment.link, check=check)\n"
    )
    (here / "study.toml").write_text(f'experiment = "mine.py:experiment"\n{GOOD}')
    check_refused(here, ("run", "study.toml"), "check of a point raises KeyError: 'lost' (4 points)")


def test_not_utf8(here: Path) -> None:
    (here / "study.toml").write_bytes(edited("A good study", "Etude").encode().replace(b"Etude", b"\xc9tude"))
    check_refused(here, ("run", "study.toml"), "study.toml: not UTF-8 text: byte 0xc9 in line 1")


def test_byte_order_mark_and_crlf_are_read(here: Path) -> None:
    (here / "study.toml").write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    assert sweep("plan", "study.toml").exit_code == 0


def test_study_file_too_large(here: Path) -> None:
    (here / "study.toml").write_text(GOOD + "#" * 1_000_000)
    check_refused(here, ("run", "study.toml"), "study.toml: is larger than 1,000,000 bytes")


@pytest.mark.parametrize(
    ("study", "phrase"),
    [
        ("missing.toml", "no study 'missing.toml': neither a file nor a built-in study"),
        ("quasar", "no study 'quasar': neither a file nor a built-in study; did you mean 'quasars'?"),
        ("", "'' is a directory, not a study file"),
        (".", "'.' is a directory, not a study file"),
        ("a" * 300, "cannot be read: File name too long"),
        ("/dev/zero", "/dev/zero: is larger than 1,000,000 bytes"),
        ("/dev/null", "/dev/null: title: is required"),
    ],
)
def test_bad_study_path(here: Path, study: str, phrase: str) -> None:
    check_refused(here, ("run", study), phrase)
    check_refused(here, ("plan", study), phrase)


@pytest.mark.parametrize(
    ("options", "phrase"),
    [
        (("--set", "n_sim"), "--set 'n_sim': must be written KEY=VALUE"),
        (("--set", "=5"), "--set '=5': must be written KEY=VALUE"),
        (("--set", "n_sim="), "--set 'n_sim=': must be written KEY=VALUE"),
        (("--axis", "v_max"), "--axis 'v_max': must be written NAME=SPEC"),
        (("--set", "altitude=5"), "fixed.altitude (--set altitude=5): unknown parameter 'altitude'"),
        (("--set", "n_sims=5"), "fixed.n_sims (--set n_sims=5): unknown parameter 'n_sims'"),
        (("--set", "n_sim=-5"), "sampling.n_sim (--set n_sim=-5): input should be greater than or equal to 1, not -5"),
        (("--set", "n_sim=many"), "sampling.n_sim (--set n_sim=many): input should be a valid integer, not 'many'"),
        (("--set", "n_sim=5\nseed = 9"), "input should be a valid integer"),
        (("--set", f"error_scale={'9' * 5000}"), "fixed.error_scale"),
        (("--set", f"omega={'[' * 5000}"), "omega = '[[["),
        (("--set", "weighting=equl"), "weighting = 'equl': must be one of 'inverse-variance', 'equal'; did you mean"),
        (("--axis", "v_max=14:15"), "axes.v_max (--axis v_max=14:15): v_max = '14:15': must be a finite number"),
        (("--axis", "v_max=14:16:"), "axes.v_max (--axis v_max=14:16:): step = '': must be a finite number"),
        (("--axis", "v_max=14:16:0"), "axes.v_max (--axis v_max=14:16:0): step = 0: does not lead from"),
        (("--axis", "v_max=14:1e305:1"), "stop = 1e+305: must be a finite number, below 1e+300 in size"),
        (("--axis", "v_max=14:16:log"), "num = '': must be a finite number"),
        (("--axis", "v_max=0:16:log5"), "log spacing needs start and stop > 0, not 0 and 16"),
        (("--axis", "v_max=a,b"), "v_max = 'a': must be a finite number"),
        (("--axis", "v_max=[]"), "an axis needs at least one value"),
        (("--axis", "model=amex,amex"), "axes.model (--axis model=amex,amex): duplicate value 'amex'"),
        (("--axis", "modle=amex"), "axes.modle (--axis modle=amex): unknown parameter 'modle'; did you mean 'model'?"),
        (("--workers", "0"), "Invalid value for '--workers': 0 is not in the range 1<=x<=4096"),
        (("--workers", "two"), "Invalid value for '--workers': 'two' is not a valid integer range"),
        (("--pool", "gpu"), "Invalid value for '--pool': 'gpu' is not one of 'processes', 'threads', 'serial'"),
        (("--pool", "serial", "--workers", "2"), "--pool serial has no workers"),
        (("--scheduler", "tcp://127.0.0.1:1", "--workers", "2"), "they do not go with --scheduler"),
    ],
    ids=lambda value: " ".join(value)[:40].replace("\n", " ") if isinstance(value, tuple) else "",
)
def test_bad_option(here: Path, options: tuple[str, ...], phrase: str) -> None:
    (here / "study.toml").write_text(GOOD)
    check_refused(here, ("run", "study.toml", *options), phrase)


def test_problems_of_options_and_study_come_together(here: Path) -> None:
    (here / "study.toml").write_text(fixed("error_scale = -1"))
    check_refused(
        here, ("run", "study.toml", "--set", "seed", "--axis", "model=x"), "3 problems", "--set 'seed'", "'x'", "line 9"
    )


@pytest.mark.parametrize(
    "address",
    [
        "tcp://127.0.0.1:1",
        "tcp://127.0.0.1:99999999",
        "tcp://no-such-host.invalid:8786",
    ],
)
def test_bad_scheduler(here: Path, monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    monkeypatch.setattr("linksweep.sweep.executing.clusters.CONNECT_TIMEOUT_S", 1)
    (here / "study.toml").write_text(GOOD)
    check_refused(here, ("run", "study.toml", "--scheduler", address), "no Dask scheduler", repr(address))


@pytest.mark.parametrize("address", ["host", slow("nonsense://x:1")])
def test_malformed_scheduler_address(here: Path, sweep_here: Callable[..., tuple[int, str, str]], address: str) -> None:
    (here / "study.toml").write_text(GOOD)
    before = tree(here)
    code, _, err = sweep_here("run", "study.toml", "--scheduler", address, cwd=here)
    assert code == 2
    assert repr(address) in err
    assert "Traceback" not in err
    assert tree(here) == before


# Where the store cannot be


def foreign_directory(place: Path) -> None:
    place.mkdir()
    (place / "thesis.txt").write_text("irreplaceable")


def plain_file(place: Path) -> None:
    place.write_text("irreplaceable")


def half_made(place: Path) -> None:
    (place / "blocks").mkdir(parents=True)
    (place / "blocks" / "zarr.json").write_text("{}")


def truncated_metadata(place: Path) -> None:
    place.mkdir()
    (place / "zarr.json").write_text('{"attributes": {"linksweep_f')


def foreign_zarr(place: Path) -> None:
    place.mkdir()
    (place / "zarr.json").write_text(json.dumps({"zarr_format": 3, "node_type": "group", "attributes": {"a": 1}}))


def newer_format(place: Path) -> None:
    place.mkdir()
    (place / "zarr.json").write_text(
        json.dumps({"zarr_format": 3, "node_type": "group", "attributes": {"linksweep_format": 99}})
    )


def loop_of_links(place: Path) -> None:
    place.symlink_to(place.name)


FOREIGN: dict[Callable[[Path], None], str] = {
    foreign_directory: "is not a store of linksweep (foreign or half-made)",
    plain_file: "is a file, not a Zarr store",
    half_made: "zarr.json and its copy in blocks are both damaged",
    truncated_metadata: "is not a store of linksweep (foreign or half-made)",
    foreign_zarr: "is not a store of linksweep (foreign or half-made)",
    newer_format: "has store format 99; this version of linksweep reads format 5. It is newer",
}


@pytest.mark.parametrize("make", FOREIGN, ids=lambda make: make.__name__)
@pytest.mark.parametrize("command", ["run", "plan"])
def test_something_else_where_the_store_should_be(here: Path, command: str, make: Callable[[Path], None]) -> None:
    (here / "study.toml").write_text(GOOD)
    make(here / "s.zarr")
    check_refused(here, (command, "study.toml", "-o", "s.zarr"), "s.zarr: ", FOREIGN[make])


@pytest.mark.parametrize("make", FOREIGN, ids=lambda make: make.__name__)
@pytest.mark.parametrize("command", ["show", "status"])
def test_reading_something_else(here: Path, command: str, make: Callable[[Path], None]) -> None:
    make(here / "s.zarr")
    check_refused(here, (command, "s.zarr"), "s.zarr: ", FOREIGN[make])


@pytest.mark.parametrize("command", ["show", "status"])
@pytest.mark.parametrize("path", ["missing.zarr", "results/missing.zarr"])
def test_reading_a_missing_store(here: Path, command: str, path: str) -> None:
    check_refused(here, (command, path), f"{path}: no store there")


def test_store_under_a_file(here: Path) -> None:
    (here / "study.toml").write_text(GOOD)
    check_refused(
        here,
        ("run", "study.toml", "-o", "study.toml/s.zarr"),
        "cannot make a store there",
        "study.toml is not a directory",
    )


def test_store_in_a_directory_that_is_not_writable(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (here / "study.toml").write_text(GOOD)
    (here / "closed").mkdir(mode=0o500)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "closed")  # root may write anywhere
    check_refused(here, ("run", "study.toml", "-o", "closed/s.zarr"), "closed is not a directory that can be written")


@pytest.mark.parametrize("command", ["run", "plan", "show", "status"])
@pytest.mark.parametrize("path", ["n" * 300, f"{'n' * 300}/s.zarr"])
def test_store_name_too_long(here: Path, command: str, path: str) -> None:
    (here / "study.toml").write_text(GOOD)
    arguments = (command, path) if command in ("show", "status") else (command, "study.toml", "-o", path)
    check_refused(here, arguments, "nnn")


def test_store_at_a_loop_of_links(here: Path) -> None:
    (here / "study.toml").write_text(GOOD)
    loop_of_links(here / "s.zarr")
    check_refused(here, ("run", "study.toml", "-o", "s.zarr"), "s.zarr")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    (folder / "study.toml").write_text(GOOD)
    result = sweep("run", str(folder / "study.toml"), "-o", str(folder / "s.zarr"), "--pool", "serial")
    assert result.exit_code == 0, result.output
    return folder


@pytest.mark.parametrize(
    ("options", "phrases"),
    [
        (("--set", "seed=8"), ("seed: 7 in the store, 8 in the study",)),
        (("--set", "error_scale=2.0"), ("fixed.error_scale: 1.0 in the store, 2.0 in the study",)),
        (
            ("--set", "seed=8", "--set", "catalogue=synthetic", "--set", "weighting=equal"),
            (
                "seed: 7 in the store, 8 in the study",
                "fixed.catalogue: 'quasars' in the store, 'synthetic' in the study",
                "fixed.weighting: 'inverse-variance' in the store, 'equal' in the study",
            ),
        ),
    ],
)
@pytest.mark.parametrize("command", ["run", "plan"])
def test_store_of_another_study(
    here: Path, finished: Path, command: str, options: tuple[str, ...], phrases: tuple[str, ...]
) -> None:
    shutil.copytree(finished, here, dirs_exist_ok=True)
    check_refused(
        here,
        (command, "study.toml", "-o", "s.zarr", *options),
        "s.zarr: ",
        "holds results of a different study",
        "give another store with -o",
        *phrases,
    )


def lose_identity(store: Path) -> None:
    metadata = json.loads((store / "zarr.json").read_text())
    del metadata["attributes"]["study_meaning"]
    (store / "zarr.json").write_text(json.dumps(metadata))


def garble_identity(store: Path) -> None:
    metadata = json.loads((store / "zarr.json").read_text())
    metadata["attributes"]["study_meaning"] = "{"
    (store / "zarr.json").write_text(json.dumps(metadata))


def garble_ledger_metadata(store: Path) -> None:
    (store / "blocks" / "zarr.json").write_text("{")


def flip_ledger_byte(store: Path) -> None:
    chunk = next((store / "blocks").glob("rows.*"))
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 0xFF
    chunk.write_bytes(content)


def lose_variable(store: Path) -> None:
    metadata = json.loads((store / "zarr.json").read_text())
    metadata.pop("consolidated_metadata", None)
    (store / "zarr.json").write_text(json.dumps(metadata))
    shutil.rmtree(store / "status")


def flip_variable_byte(store: Path) -> None:
    chunk = next(p for p in sorted((store / "sigma_spin").rglob("*")) if p.is_file() and p.name != "zarr.json")
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 0xFF
    chunk.write_bytes(content)


@pytest.mark.parametrize(
    "damage",
    [lose_identity, garble_identity, garble_ledger_metadata],
    ids=lambda damage: damage.__name__,
)
def test_going_on_with_a_damaged_store(here: Path, finished: Path, damage: Callable[[Path], None]) -> None:
    shutil.copytree(finished, here, dirs_exist_ok=True)
    damage(here / "s.zarr")
    check_refused(here, ("run", "study.toml", "-o", "s.zarr", "--pool", "serial"), "s.zarr")


def test_going_on_with_a_damaged_ledger(here: Path, finished: Path) -> None:
    shutil.copytree(finished, here, dirs_exist_ok=True)
    flip_ledger_byte(here / "s.zarr")
    check_refused(here, ("run", "study.toml", "-o", "s.zarr", "--pool", "serial"), "s.zarr")


@pytest.mark.parametrize("command", ["show", "status"])
@pytest.mark.parametrize("damage", [lose_variable, flip_variable_byte], ids=lambda damage: damage.__name__)
def test_reading_a_damaged_store(here: Path, finished: Path, command: str, damage: Callable[[Path], None]) -> None:
    shutil.copytree(finished, here, dirs_exist_ok=True)
    damage(here / "s.zarr")
    check_refused(here, (command, "s.zarr"), "s.zarr")
