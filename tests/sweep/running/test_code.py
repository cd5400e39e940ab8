"""A store made by other code is refused, continued on request, or replaced; the same code in any words is not."""

import _ctypes
import contextlib
import functools
import importlib
import json
import re
import runpy
import shutil
import sys

import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st

import linksweep
from linksweep.sweep.code import PREFIX
from tests.sweep.layouts import ENDS, LINKS, Layout
from tests.sweep.opening import files_of
from tests.sweep.user import write_experiment, write_study
from tests.tiers import examples, few, slow

HELPED = {"before": "import helper\n", "evaluate": '{"total": [n_sim * helper.value(p["rate"]) for p in points]}'}
CHANGES = {  # of a file: a text, the other, and what should be named
    "body": ("user.py", 'helper.value(p["rate"])', "100 * helper.value(1.0)", "function user.evaluate ("),
    "default": ("user.py", '"kind", "int", 0', '"kind", "int", 7', "default of kind is 0 in the store, 7 now"),
    "deeper": ("deeper.py", "1.0", "100.0", "value deeper.FACTOR ({folder}/deeper.py, line 1) is 1.0"),
}
RESULTS = [["str(x)", "{'a': x}", "{'b': str(x), 'c': x}"], ["1 / (x - x)", "str(x)", "x"], ["int(x)", "x / 2"]]
RESULTS += [["1 / (x - 1)", "1 / (x + 2)"], ["x", "str(x)", "[x, x]"]]
IMPORTS = ["from m import V", "from m import V as W", "from between import *", "def g():\n    from m import V"]
USES = [  # a value of a module, another one, and what a function does with it
    ("{'k': 3}", "{'k': 4}", "V[x] = x"),
    ("scipy.stats.norm(3)", "scipy.stats.norm(4)", "V.mean() if x < 0 else 0"),
    ("np.random.default_rng(3)", "np.random.default_rng(4)", "V.normal()"),
    ("__import__('typing').NewType('V', 3)", "__import__('typing').NewType('V', 4)", "V(x)"),
]
EQUAL = [("[[0] * 3] * 3", "[[0] * 3 for _ in range(3)]"), ("[np.zeros(2)] * 2", "[np.zeros(2), np.zeros(2)]")]
EQUAL += [("np.array([[0.0, 1.0], [2.0, 3.0]])", "np.array([[0.0, 2.0], [1.0, 3.0]]).T")]
EQUAL += [("np.zeros((2, 3))", "np.zeros((3, 2))")]
# What a function makes of equal values is not equal; where code may name anything the module counts as a whole.
COUNTED = [*((IMPORTS[0], *pair, "copy.deepcopy(V)") for pair in EQUAL), ("import m", "3", "4", "getattr(m, 'V')")]
COUNTED += [(statement, *use) for use in USES for statement in IMPORTS]
COUNTED += [("from m import *", "3", "4", body) for body in ("eval('V')", "s.modules.get(__name__).V")]
COUNTED = few(2, [COUNTED[2], *COUNTED[3:], *COUNTED[:2]])
LATE = "import helper\ndef total(points, n_sim):\n    from late import PLUS\n"
LATE += '    return {"total": [n_sim * (helper.FACTOR * p["rate"] + PLUS) for p in points]}\n'
H = """import numpy as np; from dataclasses import make_dataclass
class B:
    n = 0
    def __init__(self, known={}): type(self).n += 1; known[self.n] = 1
    @property
    def first(self): self.t = 0.0; return C().n * self.t
class B2: z = 1.0
class C(B): k = 1.0
c, d, K, ALL, W, P = C(), B2(), 1.0, {"a": max}, np.zeros(1), make_dataclass("P", "ab")
def g(x, *, s=1.0): d.late = x; return s * x + len(W.fill(x) or "") + P(0, 1).a
def f(x: float): return g(x) * K * c.k * C.k + len(ALL) + ALL["a"]([0.0]) * 0 + getattr(c, "z", 0.0) + c.first
"""
NAMED = {"h.K = 4.0": "value h.K", "h.c.k = 4.0": "value h.c", "h.C.k = 4.0": "value h.C.k ("}
NAMED |= {"h.g.__kwdefaults__['s'] = 2.0": "h.g", "h.ALL['a'] = sum": "value h.ALL"}
NAMED |= {"h.C.__bases__ = h.B, h.B2": "class h.C", "h.P = h.make_dataclass('P', 'ba')": "P.__match_args__"}
DECLARED = """import ctypes, threading, linksweep, zarr
from pathlib import Path
L = threading.Lock()
C = ctypes.CDLL(str(Path(__file__).parent / "c.so"))
Z = zarr.zeros(1)
T = [eval("lambda x: x * K", {"__name__": None, "K": 1})]
@linksweep.experiment(reads=["READS"], packages="pip")
def f(x: float):
    with L:
        C.PyInit__ctypes, Z
        return T[0](x) * float((Path(__file__).parent / "k.csv").read_text())
"""
CHANGES_ITS_FILE = """from pathlib import Path
import linksweep
FILE, ONCE = (Path(__file__).parent / name for name in ("k.csv", "once"))
@linksweep.experiment(reads=["k.csv"])
def f(x: float):
    if x == 3 and not ONCE.exists():
        ONCE.touch()
        FILE.write_text("100")
    return x * float(FILE.read_text())
"""
EXECUTED = """import enum, linksweep
K, gathered = {"k": 2}, {}
class Colour(enum.Enum): RED, BLUE = 1, 2
def f(c, x: int): return c.value * x * K["k"]
def run(n):
    gathered[n] = linksweep.run(f, "s.zarr", axes={"c": list(Colour), "x": list(range(n))}, pool="serial")
    return gathered[n].f.values.sum()
if __name__ == "__main__": first = [run(n) for n in (2, 3)][-1]
"""
CELLS = """import itertools, pandas as pd
class Shell: __module__ = "ipykernel.zmqshell"
S, shell = pd.Series(range(5), pd.date_range("2020", periods=5)), Shell()
D = S.to_xarray()
def get_ipython(): return shell
N = itertools.count()
def g(x): pd.isna._code = str(next(N)); return x + pd.isna(x)
def f(x): return g(x) + len(D["index"].attrs) + S["2020-01-02":].size + len(eval("shell.user_ns_hidden"))
"""
SETS = "import decimal\ndecimal.getcontext().prec = "
ACTS = {"set_a.py": f"{SETS}4\n", "set_b.py": f"{SETS}8\n", "by_b.py": "import set_b\n"}  # on others, by file


@pytest.fixture
def folder(tmp_path, sweep):
    write_experiment(tmp_path, **HELPED)
    (tmp_path / "helper.py").write_text("from deeper import FACTOR\n\n\ndef value(rate):\n    return FACTOR * rate\n")
    (tmp_path / "deeper.py").write_text("FACTOR = 1.0\n")
    write_study(tmp_path)
    sweep("run", "s.toml", "-o", "s.zarr", cwd=tmp_path, code=0)
    return tmp_path


def change(folder, kind):
    file, old, new, named = CHANGES[kind]
    (folder / file).write_text((folder / file).read_text().replace(old, new))
    return named.format(folder=folder)


@pytest.mark.parametrize("kind", ["body", "default", slow("deeper")])
def test_other_code_is_refused_with_what_differs_and_nothing_is_written(kind, folder, sweep):
    named = change(folder, kind)
    write_study(folder, "rate = [1.0, 2.0, 3.0]")
    before = files_of(folder / "s.zarr")
    for command in ("run s.toml -o s.zarr", "plan s.toml -o s.zarr", "run --retry s.zarr"):
        code, out, err = sweep(*command.split(), cwd=folder)
        assert (code, out, named in err) == (2, "", True), err
        assert re.search(r"(?s)was made by other code.*--fresh", err)
        assert ("--accept-code" in err) == ("--redo old" in err) == (kind != "default")
    assert before == files_of(folder / "s.zarr")
    for command in ("show", "status"):  # what there is can be read
        assert sweep(command, "s.zarr", cwd=folder)[0] == 0
    for points, words in (("--at rate=2.0", "differs from s.zarr in mean"), ("--points 1", "differs: rate=")):
        code, _, err = sweep("reproduce", "s.zarr", *points.split(), cwd=folder)
        same = 2 if "--points" in points else 0  # points at another default are not looked up
        assert (code, named in err, words in err) == ((same, True, False) if kind == "default" else (1, True, True))


def test_points_at_a_default_are_never_taken_for_those_at_another(tmp_path, sweep):
    def run(default, *more, code=0):
        (tmp_path / "m.py").write_text(f"def f(x: float, z: int = {default}):\n    return 100 * x + z\n")
        return sweep(*(["run", "m.py:f"] if more[0] == "--axis" else []), *more, cwd=tmp_path, code=code)

    run(2, "--axis", "x=1,2", "--axis", "z=2,3", "-o", "s.zarr")
    for z, store in ((2, "v.zarr"), (3, "t.zarr")):
        run(z, "--axis", "x=5", "-o", store)
    commands = ["--axis x=1 --set z=3 -o s.zarr --accept-code", "--axis x=1 --set z=2 -o v.zarr"]
    commands += ["--axis x=1 -o s.zarr --redo old", "--axis x=1 -o s.zarr --only --accept-code"]
    for command in (*commands, "merge s.zarr t.zarr -o u.zarr --accept-code"):
        assert "default of z is 2" in run(3, *command.split(), code=2)[2]
    assert linksweep.open(tmp_path / "s.zarr").f.values.tolist() == [[102.0, 103.0], [202.0, 203.0]]


@pytest.mark.parametrize("results", few(2, RESULTS), ids=str)
def test_where_all_points_are_computed_again_results_may_be_others(tmp_path, sweep, results):
    for result in results:
        (tmp_path / "m.py").write_text(f"def f(x: float):\n    return {result}\n")
        code = int(" - " in result)
        sweep("run", "m.py:f", "--axis", "x=1,2", "-o", "s.zarr", "--redo", "old", cwd=tmp_path, code=code)
    assert sweep("check", "s.zarr", cwd=tmp_path)[0] == 0
    actual = linksweep.open(tmp_path / "s.zarr").drop_vars(["status", "wall_time", "code"], errors="ignore")
    want = eval(results[-1], {"x": 2.0})
    want = want if isinstance(want, dict) else {"f": want}
    assert {name: values.sel(x=2.0).values.tolist() for name, values in actual.data_vars.items()} == want


def test_other_statistics_are_computed_again_and_never_joined(tmp_path, sweep):
    run = ["run", "m.py:f", "--axis", "x=1,2", "--set", "n_sim=80", "-o"]
    for name in ("mean", "q50", "mean"):
        head = f"import linksweep as s\n@s.experiment(outputs=[s.Output('w', statistics=['{name}'])])\n"
        (tmp_path / "m.py").write_text(f"{head}def f(x: float, rng):\n    return {{'w': x}}\n")
        sweep(*run, f"{name}.zarr", cwd=tmp_path, code=0)
        code, _, err = sweep(*run, "s.zarr", "--accept-code", cwd=tmp_path)
        sweep(*run, "s.zarr", "--redo", "old", cwd=tmp_path, code=0)
        assert linksweep.open(tmp_path / "s.zarr")[f"w_{name}"].values.tolist() == [1.0, 2.0]
    _, _, of_merge = sweep("merge", "mean.zarr", "q50.zarr", "-o", "u.zarr", "--accept-code", cwd=tmp_path, code=2)
    assert (code, "other statistics" in err, "other statistics" in of_merge) == (2, True, True)


def test_accepted_code_is_told_for_each_point(folder, sweep):
    named = change(folder, "deeper")
    write_study(folder, "rate = [1.0, 2.0, 3.0]")
    asked = ("s.toml", "-o", "s.zarr", "--accept-code")
    assert "3, 2 of them done" in sweep("plan", *asked, cwd=folder, code=0)[1]
    assert named in sweep("run", *asked, cwd=folder, code=0)[2]
    dataset = linksweep.open(folder / "s.zarr")
    assert (dataset["mean"].values.tolist(), dataset["code"].values.tolist()) == ([1.0, 2.0, 300.0], [1, 1, 2])
    first, second = (record["code"] for record in json.loads(dataset.attrs["code"]))
    assert (first["value deeper.FACTOR"], second["value deeper.FACTOR"]) == ("1.0", "100.0")
    assert first["function user.evaluate"] == second["function user.evaluate"]
    write_study(folder, "rate = [1.0, 2.0, 3.0, 4.0]")  # and the same code again needs no flag
    assert sweep("run", "s.toml", "-o", "s.zarr", cwd=folder)[0] == 0
    dataset = linksweep.open(folder / "s.zarr")
    assert (dataset["code"].values.tolist(), len(json.loads(dataset.attrs["code"]))) == ([1, 1, 2, 2], 2)
    (folder / "deeper.py").write_text("FACTOR = 1.0\n")  # the first code again, which has not made rows of others
    assert sweep("run", "s.toml", "-o", "s.zarr", "--redo", "rate != 3.0", cwd=folder)[0] == 2
    for kind, n_sim, made_by in (("body", 600, 3), ("deeper", 1100, -1)):  # blocks of 512: all are new, or one is kept
        change(folder, kind)
        write_study(folder, "rate = [1.0]", f"n_sim = {n_sim}")
        assert [sweep("run", *some, cwd=folder)[0] for some in (asked[:-1], asked)] == [2, 0]
        assert {*linksweep.open(folder / "s.zarr")["code"].values.tolist()} == {made_by}


def test_fresh_replaces_a_store_and_nothing_else(folder, sweep):
    change(folder, "deeper")
    write_study(folder, "rate = [2.0, 3.0]")
    (folder / "s.zarr" / "notes.txt").write_text("mine")
    (folder / "refused.py").write_text("import os\ndef f(x: float):\n    return os.urandom(6).hex()\n")
    sweep("run", "refused.py:f", "--axis", "x=1,2", "-o", "s.zarr", "--fresh", cwd=folder, code=2)
    sweep("run", "s.toml", "-o", "s.zarr", "--fresh", cwd=folder, code=0)
    dataset = linksweep.open(folder / "s.zarr")
    assert (dataset["mean"].values.tolist(), "code" in dataset) == ([200.0, 300.0], False)
    assert ((folder / "s.zarr" / "notes.txt").read_text(), sweep("check", "s.zarr", cwd=folder)[0]) == ("mine", 0)
    (folder / "other").mkdir()
    (folder / "other" / "thesis.txt").write_text("years of work")
    for place, code in (("other", 2), ("helper.py", 2), ("none.zarr", 0)):
        sweep("run", "s.toml", "-o", place, "--fresh", cwd=folder, code=code)
    assert [path.read_text() for path in (folder / "other").iterdir()] == ["years of work"]


@pytest.mark.parametrize("pool", ["serial", slow("threads"), slow("processes")])
def test_helpers_of_the_same_name_in_two_folders_do_not_mix(tmp_path, pool):
    folders = [tmp_path / str(number) for number in (1, 2)]
    for number, folder in enumerate(folders, 1):
        write_experiment(folder, **HELPED | {"evaluate": "total(points, n_sim)", "before": LATE})
        (folder / "helper.py").write_text(f"FACTOR = {number}.0\n")
        (folder / "late.py").write_text(f"import helper\nPLUS = {number}00.0\nassert helper.FACTOR == {number}\n")
        write_study(folder)
    for folder, means in zip(folders, [[101.0, 102.0], [202.0, 204.0]], strict=True):
        dataset = linksweep.run(folder / "s.toml", tmp_path / "x.zarr", pool=pool, fresh=True)
        assert dataset["mean"].values.tolist() == means


def run(folder, axis, store="s.zarr"):
    for name in [name for name in sys.modules if name.partition(".")[0] == "pkg" or name.startswith(PREFIX)]:
        del sys.modules[name]  # as in a new process; a session keeps a file that has not changed with what it imported
    importlib.invalidate_caches()
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder / "lib")
        patch.setattr(sys, "dont_write_bytecode", True)  # Python takes it by the second and the size of a file
        linksweep.run(f"{folder}/project/main.py:f", axes={"x": axis}, store=folder / store, pool="serial")


def check(layout, folder):
    layout.write(folder)
    run(folder, [1.0, 2.0])
    layout.write(folder / "copy", cosmetic=True)  # a checkout elsewhere
    run(folder / "copy", [1.0, 2.0, 3.0], "../s.zarr")
    layout.write(folder, constant="4.0")
    with pytest.raises(linksweep.SweepError, match=r"(?s)was made by other code.*( in the store, |has changed)"):
        run(folder, [1.0, 2.0, 3.0, 4.0])


@given(seed=st.integers(0, 10**6))
@settings(max_examples=examples(25, quick=1), derandomize=True)
def test_in_any_layout_other_code_is_refused_and_the_same_is_not(tmp_path_factory, seed):
    check(Layout(seed), tmp_path_factory.mktemp("layout"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*ENDS, *LINKS])
def test_so_it_is_for_each_kind(tmp_path, kind):
    check(Layout(1, only=kind), tmp_path)


@pytest.mark.parametrize("call", few(1, ["im(name='pkg')", "importlib.import_module('pkg')", "__import__('pkg')"]))
def test_a_module_that_a_function_imports_by_a_name_counts(tmp_path, call):
    for place, text in (("project/main", f"    return x * {call}.K\n"), ("lib/pkg", "K = 1.0\n")):
        (tmp_path / place).parent.mkdir()
        head = "import importlib\ndef f(x: float):\n    from importlib import import_module as im\n" * (place[0] == "p")
        (tmp_path / f"{place}.py").write_text(head + text)
    run(tmp_path, [1.0])
    run(tmp_path, [1.0, 2.0])
    (tmp_path / "lib" / "pkg.py").write_text("K = 4.0\n")
    with pytest.raises(linksweep.SweepError, match=r"(?s)was made by other code.*value pkg\.K"):
        run(tmp_path, [1.0, 2.0, 3.0])


# What a script does with its module h, and what is named
@pytest.mark.parametrize(("change", "named"), few(1, [*NAMED.items()][::-1]))
def test_attributes_count_as_they_are_when_the_run_starts(tmp_path, monkeypatch, change, named):
    (tmp_path / "h.py").write_text(H)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "h", raising=False)
    h = importlib.import_module("h")
    run = functools.partial(linksweep.run, store=tmp_path / "s.zarr", axes={"x": [1.0]}, pool="serial")
    assert [run(f).f.values.tolist() for f in (h.f, "h:f")] == [[2.0]] * 2  # what it changes itself is no other code
    exec(change, {"h": h})
    for f in ("h:f", h.f):
        with pytest.raises(linksweep.SweepError, match=rf"(?s)was made by other code.*{re.escape(named)}"):
            run(f)


@pytest.mark.parametrize(("statement", "value", "other", "body"), COUNTED)
def test_a_value_counts_where_it_is_bound_whoever_imports_it(tmp_path, sweep, statement, value, other, body):
    body = "from m import V; " * ("def g" in statement) + body.replace("V", "W" if " as W" in statement else "V")
    (tmp_path / "between.py").write_text("from m import *\n")
    text = f"import copy, sys as s\n{statement}\ndef f(x: float):\n    {body}\n    return x\n"
    (tmp_path / "main.py").write_text(text)
    for there, expected in ((value, 0), (value, 0), (other, 2)):
        needs = "import scipy.stats" if "scipy" in value else "import numpy as np"
        (tmp_path / "m.py").write_text(f"{needs}\nV = {there}\n")
        err = sweep("run", "main.py:f", "--axis", "x=1", "-o", "s.zarr", cwd=tmp_path, code=expected)[2]
    assert f"value m.V ({tmp_path}/m.py, line 2)" in err


def test_a_function_that_a_notebook_reloads_is_that_of_its_file_and_what_a_notebook_has_no_code(tmp_path, monkeypatch):
    (tmp_path / "reloaded.py").write_text("def g(x: int):\n    return [y for y in (x,)]\n")
    monkeypatch.syspath_prepend(tmp_path)
    g, new, names = importlib.import_module("reloaded").g, "def g(x: int):\n    return [3 * y for y in (x,)]\n", {}
    run = functools.partial(linksweep.run, lambda x: g(x)[0], tmp_path / "s.zarr", axes={"x": [1, 2]}, pool="serial")
    (tmp_path / "reloaded.py").write_text(f"# one\n# two\n{new}")
    with pytest.raises(linksweep.SweepError, match="has changed since it was imported"):
        run()
    exec(compile(new, g.__code__.co_filename, "exec"), names)  # as IPython's autoreload
    g.__code__ = names["g"].__code__
    assert run().result.values.tolist() == [3, 6]
    (tmp_path / "cells.py").write_text(CELLS)
    monkeypatch.setitem(sys.modules, "IPython", cells := importlib.import_module("cells"))
    hidden = cells.shell.user_ns_hidden = {"In": []}
    vars(cells).update(hidden)
    for n in (1, 2):
        hidden["In"].append(cells.shell.__dict__.setdefault(f"cell {n}", n))
        ds = linksweep.run(cells.f, tmp_path / "t.zarr", axes={"x": range(n)}, pool="serial", progress=False)
    assert ds.f.values.tolist() == [5, 6]


def test_a_module_or_script_is_the_same_code_where_python_executes_it_whatever_it_gathers(tmp_path, monkeypatch):
    (tmp_path / "pk").mkdir()
    (tmp_path / "pk" / "executed.py").write_text(EXECUTED)
    (tmp_path / "script.py").write_text(EXECUTED.replace("s.zarr", "t.zarr"))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    for here in ("1", "1", "1 + 1"):
        (tmp_path / "pk" / "__init__.py").write_text(f"import enum\nenum.here = {here}\n")
        with pytest.raises(linksweep.SweepError) if "+" in here else contextlib.nullcontext():
            assert runpy.run_module("pk.executed", run_name="__main__", alter_sys=True)["first"] == 18
            assert importlib.import_module("pk.executed").run(4) == 36
        assert runpy.run_path("script.py", run_name="__main__")["first"] == 18
        assert importlib.import_module("script").run(4) == 36
        for name in [name for name in sys.modules if name.partition(".")[0] in ("pk", "script")]:
            del sys.modules[name]


@pytest.mark.parametrize("last", ["import set_b", slow("import by_b"), "decimal.getcontext().prec = 9"])
def test_the_order_counts_in_which_modules_act_on_others(tmp_path, sweep, last):
    for name, text in ACTS.items():
        (tmp_path / name).write_text(text)
    lines = ["import set_a", last]
    for imports, expected in ((lines, 0), (["import sys", *lines], 0), (lines[::-1], 2)):
        text = "\n".join(["import decimal", *imports, "def f(x: int):", "    return float(decimal.Decimal(x) / 7)"])
        (tmp_path / "m.py").write_text(text)
        code, _, err = sweep("run", "m.py:f", "--axis", "x=1,2", "-o", "s.zarr", cwd=tmp_path)
        assert (code, "order of modules is" in err) == (expected, expected == 2), err


def test_what_has_no_canonical_form_is_named_once_and_declared_files_and_packages_count(tmp_path, sweep, monkeypatch):
    (tmp_path / "k.csv").write_text("3")
    shutil.copy(_ctypes.__file__, tmp_path / "c.so")
    for reads in ("nope.csv", ".", "*.csv"):
        (tmp_path / "m.py").write_text(DECLARED.replace("READS", reads))
        err = sweep("run", "m.py:f", "--axis", "x=1", "-o", "s.zarr", cwd=tmp_path, code=2)[2]
        assert f"reads: {reads!r} is no file in" in err
        assert not (tmp_path / "s.zarr").exists()
    (tmp_path / "m.py").write_text(DECLARED.replace("READS", "k.csv"))
    for axis in ("x=1", "x=1,2"):
        code, _, err = sweep("run", "m.py:f", "--axis", axis, "-o", "s.zarr", cwd=tmp_path)
        for name in ("m.L, a _thread.lock", "m.T, a function without source", "m.Z, a zarr.core.array.Array"):
            assert (code, f"changes of {name}, are not noticed" in err) == (0, axis == "x=1"), err
        assert "m.C" not in err
    for name, said in (("k.csv", "file k.csv"), ("c.so", "value m.C"), ("m.py", "value None.K is 1")):
        (tmp_path / "new").write_bytes((tmp_path / name).read_bytes().replace(b": 1}", b": 2}") + b" ")
        (tmp_path / "new").replace(tmp_path / name)
        assert said in sweep("run", "m.py:f", "--axis", "x=1,2,3", "-o", "s.zarr", cwd=tmp_path, code=2)[2]
    monkeypatch.setattr("linksweep.sweep.code.version_of", lambda name: "9.9")
    err = sweep("run", "m.py:f", "--axis", "x=1,2,3", "-o", "s.zarr", cwd=tmp_path, code=2)[2]
    assert re.search(r"package pip is .* in the store, 9\.9 now", err)


@pytest.mark.parametrize("then", [1, 100])
def test_a_declared_file_that_changes_during_a_run_mixes_nothing(tmp_path, sweep, then):
    (tmp_path / "m.py").write_text(CHANGES_ITS_FILE)
    (tmp_path / "k.csv").write_text("1")
    run = "run", "m.py:f", "--axis", "x=1:6:1", "-o", "s.zarr", "--pool", "serial"
    for said in ("k.csv has changed during the run", "file k.csv has changed"):
        assert said in sweep(*run, cwd=tmp_path, code=2)[2]
        (tmp_path / "k.csv").write_text(str(then))
    assert sweep(*run, "--redo", "old", cwd=tmp_path)[0] == 0
    assert linksweep.open(tmp_path / "s.zarr").f.values.tolist() == [then * x for x in range(1, 7)]


@pytest.mark.slow
def test_a_value_that_each_process_has_otherwise_is_named_and_refuses_nothing(tmp_path, start_sweep):
    xr.Dataset({"k": 1.0}).to_netcdf(tmp_path / "d.nc", engine="h5netcdf")
    text = "import time, xarray\nSTART, K, D = time.time_ns(), 2.0, xarray.open_dataset('d.nc')\n"
    text += "def f(x: float):\n    return K * x * float(D.k) if START else 0.0\n"
    runs = [("x=1", "2.0", "2.0", 0), ("x=1,2", "2.0", "2.0", 0), ("x=1,2", "time_ns()", "time_ns() + 1", 2)]
    for axis, old, new, expected in [*runs, ("x=1,2", "2.0", "3.0", 2)]:
        (tmp_path / "m.py").write_text(text.replace(old, new))
        process = start_sweep("run", "m.py:f", "--axis", axis, "-o", "s.zarr", cwd=tmp_path)
        err = process.communicate(timeout=60)[1]
        assert process.returncode == expected, err
        assert ("m.START differs from process to process" in err) == (axis == "x=1,2"), err
        assert "m.D differs" not in err
    assert "value m.K (" in err
