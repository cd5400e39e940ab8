"""`sweep run --retry` and `sweep reproduce`."""

import json
from pathlib import Path

import pytest

from linksweep.sweep.executing.executor import Children
from linksweep.sweep.running import reproduce
from tests.sweep.opening import OpenStore, same
from tests.tiers import slow

EXPERIMENT = (Path(__file__).parents[1] / "coins.py").read_text()
FRAGILE = EXPERIMENT.replace(
    "    bias =",
    """    from pathlib import Path
    if points[0]["coins"] == 5 and Path(__file__).with_name("broken").exists():
        raise ZeroDivisionError(f"no {points[0]['metal']} coins left")
    bias =""",
)


@pytest.fixture
def broken(tmp_path, sweep):
    """A store in which the points with five coins have failed, and the way to mend the experiment."""
    (tmp_path / "fragile.py").write_text(FRAGILE)
    (tmp_path / "coins.toml").write_text(
        'title = "Coins"\nexperiment = "fragile.py:experiment"\nsampling = { n_sim = 1000, n_cat = 20, seed = 7 }\n'
        'axes = { metal = ["gold", "tin"], coins = [1, 5, 20] }\n'
    )
    (tmp_path / "broken").touch()
    code, _, err = sweep("run", tmp_path / "coins.toml", "-o", tmp_path / "s.zarr", cwd="/")
    assert code == 1
    assert "2 points failed" in err
    return tmp_path / "s.zarr", (tmp_path / "broken").unlink


def test_a_failed_point_is_recorded_with_its_traceback_and_left_alone(broken, tmp_path, sweep):
    store, mend = broken
    report = json.loads(sweep("status", store, "--json")[1])
    assert report["failures"]["metal=tin,coins=5"] == "ZeroDivisionError: no tin coins left"
    records = OpenStore(store).ledger().failures
    assert all("fragile.py" in r["traceback"] and r["kind"] == "exception" for r in records.values())
    mend()
    code, _, err = sweep("run", tmp_path / "coins.toml", "-o", store)
    assert code == 1
    assert "0 realisations to do" in err


def test_retry_computes_the_failed_points_and_only_those(broken, tmp_path, sweep):
    store, mend = broken
    code, _, err = sweep("run", "--retry", store, cwd="/")
    assert code == 1
    mend()
    code, out, err = sweep("run", "--retry", store, cwd="/")
    assert code == 0, err
    assert "40,000 realisations to do" in err
    assert "INCOMPLETE" not in out
    code, _, err = sweep("run", tmp_path / "coins.toml", "-o", tmp_path / "whole.zarr")
    assert code == 0, err
    same(store, tmp_path / "whole.zarr")
    code, out, err = sweep("reproduce", store, "--at", "metal=tin,coins=20", cwd="/")
    assert (code, "every bit" in err, "share" in out) == (0, True, True), err
    code, _, err = sweep("run", "--retry", store)
    assert code == 0
    assert "no point" in err


def test_reproduce_shows_what_a_failed_point_raises(broken, sweep):
    store, mend = broken
    code, _, err = sweep("reproduce", store, "--at", "metal=tin,coins=5")
    assert code == 1
    assert "ZeroDivisionError: no tin coins left" in err
    mend()
    code, _, err = sweep("reproduce", store, "--at", "metal=tin,coins=5")
    assert (code, "is failed in" in err) == (0, True)


def test_a_place_that_is_none_is_refused(broken, sweep):
    for at, message in (
        ("metal=tin", "--at: coins needs a value, one of 1, 5, 20"),
        ("metal=tun,coins=1", "--at metal = 'tun': must be one of 'gold', 'tin'; did you mean 'tin'?"),
        ("metal=tin,coins=6", "--at coins = 6: not on the axis, which has 1, 5, 20"),
        ("metall=tin,coins=6", "--at metall: is not an axis; did you mean 'metal'?"),
        ("tin", "'tin': a place is AXIS=VALUE"),
    ):
        code, _, err = sweep("reproduce", broken[0], "--at", at)
        assert (code, message in err, "Traceback" in err) == (2, True, False), err


HEAD = "import itertools, random, time\nimport numpy as np\ncalls = itertools.count()\nseen = {}\n"
DIFFERENT = {
    "a counter": ("def f(x: float = 0.0):\n    return x + next(calls)\n", "keeps state"),
    "a mutable default": ("def f(x: float = 0.0, k=[]):\n    k.append(x)\n    return float(len(k))\n", "keeps state"),
    "a clock": ("def f(x: float = 0.0):\n    return x + time.time()\n", "draws random numbers"),
    "beside rng": (
        "def f(rng: np.random.Generator, x: float = 0.0):\n    return np.random.default_rng().normal()\n",
        "draws random numbers",
    ),
}
ACCEPTED = "import linksweep\n@linksweep.experiment(deterministic=False)\n"


def written(folder, text):
    (folder / "f.py").write_text(HEAD + (text if "rng:" in text else ACCEPTED + text))
    more = ("--set", "n_sim=20") if "rng:" in text else ()
    return ("f.py:f", "--axis", "x=1,2,3", *more, "-o", "s.zarr")


@pytest.mark.parametrize("forked", [True, slow(False)])  # forks are quick, and see what this process has changed
@pytest.mark.parametrize("kind", [kind if kind == "a counter" else slow(kind) for kind in DIFFERENT])
def test_points_that_differ_are_named_with_the_likely_cause(kind, forked, tmp_path, sweep, monkeypatch):
    monkeypatch.setattr(reproduce, "Children", lambda reference, **_: Children(reference, forked=forked))
    text, cause = DIFFERENT[kind]
    code, out, err = sweep("run", *written(tmp_path, text), "--verify", "2", cwd=tmp_path)
    assert code == 1, err
    differing = [line for line in err.splitlines() if line.startswith("differs: x=")]
    assert differing
    assert all(cause in line for line in differing)
    assert "every bit" not in err
    assert "f" in out


@pytest.mark.parametrize("command", ["run", slow("reproduce")])
def test_points_that_do_not_differ_are_counted(tmp_path, sweep, command):
    text = "def f(rng: np.random.Generator, x: float = 0.0):\n    return {'y': rng.normal(x), 'z': f'{x}' > '2'}\n"
    study = written(tmp_path, text)
    code, _, err = sweep("run", *study, *(("--verify", "1") if command == "run" else ()), cwd=tmp_path)
    if command == "reproduce":
        code, _, err = sweep("reproduce", "s.zarr", cwd=tmp_path)
        assert sweep("reproduce", "s.zarr", "--json", cwd=tmp_path)[0] == 2
    assert code == 0, err
    number = "1 point" if command == "run" else "3 points"
    assert f"{number} computed again, alone and in two orders: every bit as in s.zarr" in err
