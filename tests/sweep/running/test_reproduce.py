"""`sweep run --retry` and `sweep reproduce`; of the command line a store records no secrets, nothing of a script."""

import itertools
import json
import runpy
import sys
from pathlib import Path

import pytest

import linksweep
from linksweep.sweep.analysis.quantity import point_in
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.executor import Children
from linksweep.sweep.formatting import without_secrets
from linksweep.sweep.running import reproduce
from linksweep.sweep.studies.reader import live_study, parse_places
from tests.sweep.opening import OpenStore, same
from tests.tiers import slow

TABLE, ZIPPED = {"a": [0.0, 1.0, 0.0], "b": [None, 6.0, 7.0]}, {"a": [0.0, 1.0], "b": [5.0, 6.0]}
BREAKS = """    from pathlib import Path
    if points[0]["coins"] == 5 and Path(__file__).with_name("broken").exists():
        raise ZeroDivisionError(f"no {points[0]['metal']} coins left")
    bias ="""
FRAGILE = (Path(__file__).parents[1] / "coins.py").read_text().replace("    bias =", BREAKS)
HEAD = "import itertools, random, time\nimport numpy as np\ncalls = itertools.count()\nseen = {}\n"
BESIDE = "def f(rng: np.random.Generator, x: float = 0.0):\n    return np.random.default_rng().normal()\n"
DIFFERENT = {
    "a counter": "def f(x: float = 0.0):\n    return x + next(calls)\n",
    "a mutable default": "def f(x: float = 0.0, k=[]):\n    k.append(x)\n    return float(len(k))\n",
    "a clock": "def f(x: float = 0.0):\n    return x + time.time()\n",
    "beside rng": BESIDE,
    "tiny": "def f(x: float = 0.0):\n    return 1e-12 * os.getpid() * x\n",
}
ACCEPTED = "import linksweep, os\n@linksweep.experiment(deterministic=False, vectorised={})\n"
SECRET = "hunter2"
SCRIPT = """
import linksweep, math, time
two = 2.0
def double(x): return two * x
begun = {}; begun[math.copysign(1, 1)] = time.time()
if __name__.endswith("main__"):
    linksweep.run(double, axes={"x": [1.0, 2.0]}, store="s.zarr", pool="serial")
"""
SCHEMES, HOSTS = ["tcp", "tls", "https", "s3", "WSS"], ["host", "a.b-c:1234", "x"]
USERS = ["", f"me:{SECRET}@", f"{SECRET}@", f"me:{SECRET}/x@", f"me:@{SECRET}:@"]
RESTS = ["", f"/?token={SECRET}", f"?X-Amz-Signature={SECRET}&x=1", f"/#{SECRET}", "/a/b"]


def test_a_failed_point_is_left_alone_shown_and_on_request_computed_again(tmp_path, sweep):
    (tmp_path / "fragile.py").write_text(FRAGILE)
    text = 'title = "Coins"\nexperiment = "fragile.py:experiment"\nsampling = { n_sim = 1000, n_cat = 20, seed = 7 }\n'
    (tmp_path / "coins.toml").write_text(text + 'axes = { metal = ["gold", "tin"], coins = [1, 5, 20] }\n')
    (tmp_path / "broken").touch()
    store, command = tmp_path / "s.zarr", ("run", tmp_path / "coins.toml", "-o")
    failed, good = (("reproduce", store, "--at", f"metal=tin,coins={n}") for n in (5, 20))
    assert sweep(*command, store, cwd="/")[0] == 1
    report = json.loads(sweep("status", store, "--json")[1])
    assert report["failures"]["metal=tin,coins=5"] == "ZeroDivisionError: no tin coins left"
    records = OpenStore(store).ledger().failures.values()
    assert [("fragile.py" in r["traceback"], r["kind"]) for r in records] == [(True, "exception")] * 2
    for again, words in ((failed, "ZeroDivisionError: no tin coins left"), (("run", "--retry", store), "40,000")):
        assert words in sweep(*again, cwd="/", code=1)[2]
    (tmp_path / "broken").unlink()
    for again, expected, words in (((*command, store), 1, "already, 2 failed"), (failed, 0, "is failed in")):
        assert words in sweep(*again, code=expected)[2]
    code, out, err = sweep("run", "--retry", store, cwd="/")
    assert (code, "40,000 realisations to do" in err, "INCOMPLETE" in out) == (0, True, False), err
    assert sweep(*command, tmp_path / "whole.zarr")[0] == 0
    same(store, tmp_path / "whole.zarr")
    code, out, err = sweep(*good, cwd="/")
    assert (code, "every bit" in err, "share" in out) == (0, True, True), err
    assert "no point" in sweep("run", "--retry", store, code=0)[2]


def written(folder, text):
    (folder / "f.py").write_text(HEAD + (text if "rng:" in text else ACCEPTED.format("getpid" in text) + text))
    more = ("--set", "n_sim=20") if "rng:" in text else ()
    return ("f.py:f", "--axis", "x=1,2,3", *more, "-o", "s.zarr")


@pytest.mark.parametrize("forked", [True, slow(False)])  # forks are quick, and see what this process has changed
@pytest.mark.parametrize("kind", [kind if kind == "a counter" else slow(kind) for kind in DIFFERENT])
def test_points_that_differ_are_named(kind, forked, tmp_path, sweep, monkeypatch):
    monkeypatch.setattr(reproduce, "Children", lambda **_: Children(forked=forked))
    code, out, err = sweep("run", *written(tmp_path, DIFFERENT[kind]), "--verify", "2", cwd=tmp_path)
    differing = [line for line in err.splitlines() if line.startswith("differs: x=")]
    assert (code, "f" in out, "every bit" in err) == (1, True, False), err
    assert {"has other results than in the store" in line for line in differing} == {True}


@pytest.mark.parametrize("command", ["run", slow("reproduce")])
def test_points_that_do_not_differ_are_counted(tmp_path, sweep, command):
    text = "def f(rng: np.random.Generator, x: float = 0.0):\n    return {'y': rng.normal(x), 'z': f'{x}' > '2'}\n"
    study = written(tmp_path, text)
    code, _, err = sweep("run", *study, *(("--verify", "1") if command == "run" else ()), cwd=tmp_path)
    if command == "reproduce":
        code, _, err = sweep("reproduce", "s.zarr", cwd=tmp_path)
        assert sweep("reproduce", "s.zarr", "--json", cwd=tmp_path)[0] == 2
    words = f"{'1 point' if command == 'run' else '3 points'} computed again, alone and in two orders: every bit as in"
    assert (code, words in err) == (0, True), err


def everything_in(folder):
    return b"".join(file.read_bytes() for file in folder.rglob("*") if file.is_file() and file.suffix != ".py")


@pytest.mark.parametrize("table", [{"points": TABLE}, {"axes": ZIPPED, "grid": {"zip": [["a", "b"]]}}])
def test_a_row_is_a_place_also_where_one_of_its_values_has_no_effect(table, tmp_path):
    study = live_study({"experiment": lambda a=0.0, b=0.0: a + (b or 0.0), "when": {"b": {"a": [1.0]}}, **table})
    dataset = linksweep.run(study, tmp_path / "s.zarr", pool="serial")
    places = {"a=0,b=None": None, "a=1,b=6": 6.0} | ({"point=0": None, "point=2": None} if "points" in table else {})
    places["a=0,b=nan"] = None  # as tables say it
    assert {at: point_in(dataset, study, parse_places([at]), "").parameters["b"] for at in places} == places
    assert parse_places(["s=a,b, net=D(u=1, v=2), x=1"]) == {"s": "a,b", "net": "D(u=1, v=2)", "x": "1"}
    for at, said in (("a=0,b=5", "b = 5 is not in the grid"), ("a=0,a=1", "a is given twice, as 0 and 1")):
        with pytest.raises(SweepError, match=said):
            point_in(dataset, study, parse_places([at]), "")


@pytest.mark.parametrize("name", ["script.py", slow("sweep"), slow("sweep.py")])
def test_nothing_of_a_scripts_own_options(here, name, monkeypatch):
    (here / name).write_text(SCRIPT)
    monkeypatch.setattr(sys, "argv", [name, "--password", SECRET, f"--token={SECRET}"])
    monkeypatch.setattr(sys, "orig_argv", [sys.executable, *sys.argv])
    monkeypatch.setattr(sys, "ps1", "In: ", raising=False)
    for run_name in ("__main__", "__mp_main__"):  # and what multiprocessing calls it in a process that it spawns
        double = runpy.run_path(name, run_name=run_name)["double"]
    del (main := type(sys)("__main__")).__spec__  # as IPython has it when it executes %run again
    monkeypatch.setitem(sys.modules, "__main__", main)
    double = type(double)(double.__code__, names := {"two": 2.0, "__name__": "__main__"})
    for _ in "ab":
        linksweep.run(double, "s.zarr", axes={"x": [1.0, 2.0]}, pool="serial")
        names.pop("__name__", None)  # as from functions that %run has left
    (here / name).unlink()
    assert SECRET.encode() not in everything_in(here)


def test_neither_the_options_of_sweep_nor_addresses_have_secrets(tmp_path, sweep_here):
    (tmp_path / "double.py").write_text(SCRIPT)
    options = ("--axis", "x=1,2", "--log", "x.log", "-o", "s.zarr")
    scheduler = f"tcp://me:{SECRET}@127.0.0.1:1/?token={SECRET}"
    code, _, err = sweep_here("run", "double.py:double", *options, "--scheduler", scheduler, cwd=tmp_path)
    assert code == 2, err
    sweep_here("run", "double.py:double", *options, "--pool", "serial", cwd=tmp_path, code=0)
    kept = everything_in(tmp_path)
    assert b"sweep run double.py:double --axis x=1,2 --log x.log" in kept
    assert SECRET.encode() not in kept
    for scheme, user, host, rest in itertools.product(SCHEMES, USERS, HOSTS, RESTS):
        for around in ("{}", "--scheduler={}", "run -o '{}' x", '"{}"'):
            said = without_secrets(around.format(f"{scheme}://{user}{host}{rest}"))
            assert (SECRET in said, f"{scheme}://{host}" in said) == (False, True)
