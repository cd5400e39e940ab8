"""`--verify` and `sweep reproduce`: points are computed again in new processes, in two orders."""

import json

import numpy as np
import pytest

from linksweep import SweepError, run
from tests.tiers import slow

HEAD = "import itertools, random, time\nimport numpy as np\ncalls = itertools.count()\nseen = {}\n"
DIFFERENT = {
    "a counter": ("def f(x: float = 0.0):\n    return x + next(calls)\n", "keeps state"),
    "a cache of another point": ("def f(x: float = 0.0):\n    return seen.setdefault('first', x)\n", "keeps state"),
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
    return ("f.py:f", "--axis", "x=1:4:1", *more, "-o", "s.zarr")


@pytest.mark.parametrize("kind", [k if k == "a counter" else slow(k) for k in DIFFERENT])
def test_points_that_differ_are_named_with_the_likely_cause(kind, tmp_path, sweep):
    text, cause = DIFFERENT[kind]
    code, out, err = sweep("run", *written(tmp_path, text), "--verify", "3", cwd=tmp_path)
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
    code, _, err = sweep("run", *study, *(("--verify", "4") if command == "run" else ()), cwd=tmp_path)
    if command == "reproduce":
        code, _, err = sweep("reproduce", "s.zarr", cwd=tmp_path)
        assert sweep("reproduce", "s.zarr", "--json", cwd=tmp_path)[0] == 2
    assert code == 0, err
    assert "4 points computed again, alone and in two orders: every bit as in s.zarr" in err


@pytest.mark.slow
def test_reproduce_finds_what_the_run_left_behind(tmp_path, sweep):
    study = written(tmp_path, DIFFERENT["a counter"][0])
    assert sweep("run", *study, cwd=tmp_path)[0] == 0
    code, _, err = sweep("reproduce", "s.zarr", "--points", "4", cwd=tmp_path)
    assert code == 1, err
    assert err.count("differs: x=") >= 2


@pytest.mark.slow
def test_a_link_is_verified_block_by_block(tmp_path, sweep):
    few = ("--axis", "v_max=14,15", "--set", "n_sim=600", "--set", "n_cat=3", "-o", tmp_path / "q.zarr")
    code, out, err = sweep("run", "quasars", *few, "--verify", "2", "--json")
    assert code == 0, err
    assert "2 points computed again" in err
    json.loads(out)


@pytest.mark.slow
def test_in_python_they_are_an_error_and_the_results_are_kept(tmp_path):
    def drifting(x: float):
        return np.random.default_rng().normal()

    with pytest.raises(SweepError, match=r"x=2\.0 has another result each time") as error:
        run(drifting, tmp_path / "s.zarr", axes={"x": [1.0, 2.0]}, deterministic=False, verify=5)
    assert len(error.value.problems) == 2
    assert (tmp_path / "s.zarr").is_dir()
    assert run(lambda x: 2.0 * x, tmp_path / "t.zarr", axes={"x": [1.0]}, verify=5).status.values.tolist() == [1]
    with pytest.raises(SweepError, match="verify = -1: must be a number of points"):
        run(lambda x: x, tmp_path / "u.zarr", axes={"x": [1.0]}, verify=-1)
