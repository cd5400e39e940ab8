"""Random layouts of packages: other code is refused, and the same code is not, wherever a constant is."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import linksweep
from linksweep.sweep.code.reach import PREFIX
from tests.sweep.layouts import ENDS, LINKS, Layout
from tests.tiers import examples, slow

SCRIPT = """

if __name__ == "__main__":
    import linksweep

    print(f(1.0), f(2.0))
    try:
        dataset = linksweep.run(f, axes={"x": AXIS}, store="../s.zarr", pool="serial")
    except linksweep.SweepError as error:
        raise SystemExit("\\n".join(error.problems))
    assert dataset.f.values.tolist() == [f(x) for x in AXIS], dataset.f.values
"""
MANY = {"deadline": None, "derandomize": True, "suppress_health_check": list(HealthCheck)}


def run(folder: Path, axis: str, script: bool) -> tuple[int, str]:
    """Sweep ``f`` over an axis, by the command or by a script; return the exit code and what was printed."""
    work = folder / "work"
    command = ["-m", "linksweep", "run", "main.py:f", "--axis", f"x={axis}", "-o", "../s.zarr", "--pool", "serial"]
    if script:
        (work / "main.py").write_text((work / "main.py").read_text() + SCRIPT.replace("AXIS", f"[{axis}]"))
        command = ["main.py"]
    environment = os.environ | {"PYTHONPATH": str(folder / "lib")}
    done = subprocess.run(
        [sys.executable, *command], cwd=work, env=environment, capture_output=True, text=True, check=False
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, done.stdout + done.stderr


def run_here(folder: Path, axis: str) -> tuple[int, str]:
    """Sweep ``f`` over an axis in this process; return 1 and the message if that is refused."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "pkg" or name.startswith(PREFIX)]:
        del sys.modules[name]  # as in a new process; a session keeps a file that has not changed with what it imported
    importlib.invalidate_caches()
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder / "lib")
        patch.setattr(sys, "dont_write_bytecode", True)  # Python takes it by the second and the size of a file
        axes = {"x": [float(x) for x in axis.split(",")]}
        try:
            linksweep.run(f"{folder}/work/main.py:f", axes=axes, store=folder / "s.zarr", pool="serial")
        except linksweep.SweepError as error:
            return 1, "\n".join(error.problems)
        return 0, ""


def check(layout: Layout, folder: Path, run) -> None:
    """Require that other code is refused by name, and that the same in other words is not."""
    layout.write(folder)
    code, said = run(folder, "1.0,2.0")
    assert code == 0, (layout.kinds, said)
    layout.write(folder, cosmetic=True)
    code, said = run(folder, "1.0,2.0,3.0")
    assert code == 0, (layout.kinds, said)
    layout.write(folder, constant="4.0")
    code, said = run(folder, "1.0,2.0,3.0,4.0")
    assert code != 0, (layout.kinds, said)
    assert "was made by other code" in said
    assert " in the store, " in said or "has changed" in said


@given(seed=st.integers(0, 10**6))
@settings(max_examples=examples(25), **MANY)
def test_other_code_is_refused_and_the_same_is_not(tmp_path_factory, seed):
    check(Layout(seed), tmp_path_factory.mktemp("layout"), run_here)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*ENDS, *LINKS])
def test_so_it_is_for_each_kind(tmp_path, kind):
    check(Layout(1, only=kind), tmp_path, run_here)


@pytest.mark.slow
@given(seed=st.integers(0, 10**6), script=st.booleans())
@settings(max_examples=10, **MANY)
def test_so_it_is_for_commands_and_scripts(tmp_path_factory, seed, script):
    check(Layout(seed), tmp_path_factory.mktemp("layout"), lambda folder, axis: run(folder, axis, script))


CHANGES = {  # what a script does with its module h, first and then, and what is named
    "attribute of a module": ("h.K = 2.0", "h.K = 4.0", "value h.K"),
    "attribute of a class": ("h.C.k = 2.0", "h.C.k = 4.0", "value h.C.k"),
    "attribute of an instance": ("h.c.k = 2.0", "h.c.k = 4.0", "value h.c"),
    "entry of a registry": ("h.ALL['a'] = len", "h.ALL['a'] = sum", "value h.ALL"),
    "base class": ("", "h.C.__bases__ = (h.B2,)", "class h.C"),
    "array": ("h.A[0] = 1.0", "h.A[0] = 2.0", "value h.A"),
}
H = """
import numpy as np
K = 1.0
ALL = {"a": max}
A = np.zeros(3)
class B: ...
class B2:
    z = 1.0
class C(B):
    k = 1.0
c = C()
def f(x: float):
    return x * K * c.k * C.k + len(ALL) + A[0] + ALL["a"]([0.0]) * 0 + getattr(c, "z", 0.0)
"""


@pytest.mark.parametrize("kind", [*list(CHANGES)[:3], *map(slow, list(CHANGES)[3:])])
def test_attributes_count_as_they_are_when_the_run_starts(tmp_path, monkeypatch, kind):
    first, then, named = CHANGES[kind]
    (tmp_path / "h.py").write_text(H)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "h", raising=False)
    h = importlib.import_module("h")

    def run_after(change):
        exec(change, {"h": h})
        linksweep.run(h.f, axes={"x": [1.0]}, store=tmp_path / "s.zarr", pool="serial")

    run_after(first)
    with pytest.raises(linksweep.SweepError) as error:
        run_after(then)
    assert "was made by other code" in str(error.value)
    assert named in str(error.value)


@pytest.mark.parametrize(
    "name", ["getattr(m, 'K')", *map(slow, ["eval('K')", "globals()['K']", "getattr(sys.modules[__name__], 'K')"])]
)
def test_where_code_may_name_anything_the_module_counts_as_a_whole(tmp_path, sweep, name):
    for constant, expected in (("3", 0), ("4", 2)):
        (tmp_path / "m.py").write_text(f"K = {constant}\n")
        (tmp_path / "main.py").write_text(
            f"import sys\nfrom m import *\nimport m\ndef f(x: float):\n    return x + {name}"
        )
        code, _, err = sweep("run", "main.py:f", "--axis", "x=1", "-o", "s.zarr", "--pool", "serial", cwd=tmp_path)
        assert code == expected, err
    assert "K (" in err


UNCHANGED = {
    "a set of texts": 'WORDS = {"a", "b", "cc", "ddd"}\ndef f(x: float):\n    return x + len(WORDS)',
    "an open file": "F = open(__file__)\ndef f(x: float):\n    F.seek(0)\n    return x",
    "a memory": "M = {}\ndef f(x: float):\n    M[x] = x\n    return x",
    "a random generator": (
        "import numpy as np\nR = np.random.default_rng()\ndef f(x: float):\n    R.normal()\n    return x"
    ),
    "a frozen dataclass with a set": (
        "from dataclasses import dataclass\n@dataclass(frozen=True)\nclass C:\n"
        '    s: frozenset = frozenset({"a", "b", "c"})\nC1 = C()\ndef f(x: float):\n    return x + len(C1.s)'
    ),
    "a distribution": "import scipy.stats\nD = scipy.stats.norm(0, 1)\ndef f(x: float):\n    return D.cdf(x)",
    "a lock": "import threading\nL = threading.Lock()\ndef f(x: float):\n    with L:\n        return x",
}


@pytest.mark.parametrize("kind", [*list(UNCHANGED)[:4], *map(slow, list(UNCHANGED)[4:])])
def test_unchanged_code_is_never_refused(tmp_path, sweep, kind):
    (tmp_path / "m.py").write_text(UNCHANGED[kind])
    for axis in ("x=1", "x=1,2"):
        (tmp_path / "m.py").write_text(f"# {axis}\n{UNCHANGED[kind]}")
        code, _, err = sweep("run", "m.py:f", "--axis", axis, "-o", "s.zarr", "--pool", "serial", cwd=tmp_path)
        assert code == 0, err


def test_what_has_no_canonical_form_is_named(tmp_path, sweep):
    (tmp_path / "other.py").write_text(UNCHANGED["a lock"])  # a process says it once
    for axis in ("x=1", "x=1,2"):
        _, _, err = sweep("run", "other.py:f", "--axis", axis, "-o", "s.zarr", cwd=tmp_path)
        assert ("changes of other.L, a _thread.lock, are not noticed" in err) == (axis == "x=1")


def test_files_that_a_function_declares_count(tmp_path, sweep):
    (tmp_path / "k.csv").write_text("3")
    (tmp_path / "m.py").write_text(
        "from pathlib import Path\nimport linksweep\n\n\n@linksweep.experiment(reads=['k.csv'])\n"
        "def f(x: float):\n    return x * float((Path(__file__).parent / 'k.csv').read_text())\n"
    )
    assert sweep("run", "m.py:f", "--axis", "x=1", "-o", "s.zarr", cwd=tmp_path)[0] == 0
    assert sweep("run", "m.py:f", "--axis", "x=1,2", "-o", "s.zarr", cwd=tmp_path)[0] == 0
    (tmp_path / "k.csv").write_text("4")
    code, _, err = sweep("run", "m.py:f", "--axis", "x=1,2,3", "-o", "s.zarr", cwd=tmp_path)
    assert code == 2
    assert "file k.csv has changed" in err
