"""Random layouts of packages: other code is refused, and the same code is not, wherever a constant is."""

import importlib
import re
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import linksweep
from linksweep.sweep.code.reach import PREFIX
from tests.sweep.layouts import ENDS, LINKS, Layout
from tests.tiers import examples, slow

MANY = {"deadline": None, "derandomize": True, "suppress_health_check": list(HealthCheck)}


def run(folder: Path, axis: str) -> tuple[int, str]:
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


def check(layout: Layout, folder: Path) -> None:
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
    check(Layout(seed), tmp_path_factory.mktemp("layout"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*ENDS, *LINKS])
def test_so_it_is_for_each_kind(tmp_path, kind):
    check(Layout(1, only=kind), tmp_path)


H = """
K = 1.0
ALL = {"a": max}
class B: ...
class B2:
    z = 1.0
class C(B):
    k = 1.0
c = C()
def f(x: float):
    return x * K * c.k * C.k + len(ALL) + ALL["a"]([0.0]) * 0 + getattr(c, "z", 0.0)
"""


@pytest.mark.parametrize(
    ("change", "named"),  # what a script does with its module h, and what is named
    [
        ("h.K = 4.0", "value h.K"),
        ("h.c.k = 4.0", "value h.c"),
        slow("h.C.k = 4.0", "value h.C.k"),
        slow("h.ALL['a'] = sum", "value h.ALL"),
        slow("h.C.__bases__ = (h.B2,)", "class h.C"),
    ],
)
def test_attributes_count_as_they_are_when_the_run_starts(tmp_path, monkeypatch, change, named):
    (tmp_path / "h.py").write_text(H)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "h", raising=False)
    h = importlib.import_module("h")
    linksweep.run(h.f, axes={"x": [1.0]}, store=tmp_path / "s.zarr", pool="serial")
    exec(change, {"h": h})
    with pytest.raises(linksweep.SweepError, match=rf"(?s)was made by other code.*{re.escape(named)}"):
        linksweep.run(h.f, axes={"x": [1.0]}, store=tmp_path / "s.zarr", pool="serial")


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


IMPORTS = ["from m import V", "from m import V as W", "from between import *", "def g():\n    from m import V"]


@pytest.mark.parametrize("statement", [IMPORTS[0], *map(slow, IMPORTS[1:])])
@pytest.mark.parametrize("value", ["{'k': K}", slow("scipy.stats.norm(K)"), slow("np.random.default_rng(K)")])
def test_a_value_counts_where_it_is_bound_whoever_imports_it(tmp_path, sweep, statement, value):
    name = "W" if " as W" in statement else "V"
    body = (
        f"{name}[x] = x"
        if "k" in value
        else f"{name}.mean() if x < 0 else 0"
        if "norm" in value
        else f"{name}.normal()"
    )
    inside = "    from m import V\n" if "def g" in statement else ""
    (tmp_path / "between.py").write_text("from m import *\n")
    (tmp_path / "main.py").write_text(f"{statement}\ndef f(x: float):\n{inside}    {body}\n    return x\n")
    for constant, expected in (("3", 0), ("3", 0), ("4", 2)):
        (tmp_path / "m.py").write_text(f"import numpy as np\nimport scipy.stats\nV = {value.replace('K', constant)}\n")
        code, _, err = sweep("run", "main.py:f", "--axis", "x=1", "-o", "s.zarr", "--pool", "serial", cwd=tmp_path)
        assert code == expected, err
    assert f"value m.V ({tmp_path}/m.py, line 3)" in err


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
