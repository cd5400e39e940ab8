"""`sweep watch`: what it says is what the store holds at any time; only what has changed is read, nothing written."""

import heapq
import math
import os
import pickle
import random
import re
import shutil
import subprocess
import sys
from contextlib import suppress
from types import SimpleNamespace

import pytest
from hypothesis import given, settings as examples_of, strategies as st

from linksweep.sweep.formatting import in_words
from linksweep.sweep.running import status as watch
from linksweep.sweep.running.progress import Eta
from tests.sweep import opening
from tests.sweep.opening import OFTEN, Progress, Stopping, files_of, located, parts_of, run, status_report
from tests.tiers import PATIENCE_S, examples, slow

CODE = 'def f(x: float, y: int = 0, rng=None):\n    if x == 2.0:\n        raise ValueError(f"no root at {x}")\n'
CODE += "    return rng.normal(x)\n"
XS = st.lists(st.sampled_from([0.0, 1.0, 2.0, 3.0]), min_size=1, unique=True)
SIMS, FLAGS = st.lists(st.integers(1, 700), min_size=1, max_size=2).map(sorted), st.tuples(*[st.booleans()] * 3)
START_S = 7.0  # until workers are there: not work, and not extrapolated
STEPS = st.tuples(st.floats(0, 1e6), st.floats(0, 1e12), st.floats(0, 1e6), st.floats(0, 1e12))
KINDS = {  # from a random generator and the place in the grid: cost and seconds of a task
    "equal": lambda chance, place: (1.0, chance.uniform(0.9, 1.1)),
    "growing": lambda chance, place: (1.0 + 9.0 * place, (1.0 + 9.0 * place) * chance.uniform(0.8, 1.2)),
    "shrinking": lambda chance, place: KINDS["growing"](chance, 1.0 - place),
}
KINDS["scattered"] = lambda chance, _: (cost := chance.lognormvariate(0.0, 0.7), cost * chance.lognormvariate(0.0, 0.3))
SLOW = "import time\ndef f(x: float):\n    time.sleep(0.05)\n    if x == 7.0:\n"
SLOW += '        raise ValueError("\\x1b[31m[bold]no root[/bold]")\n    return x\n'


def g(a=0, b=0, c=0, d=0):
    return 1.0 / (a + b + c + d - 3)


def look(store):
    watched = watch.Watched(store)
    watched.look()
    return watched


@examples_of(max_examples=examples(25, quick=2))
@given(XS, SIMS, st.integers(1, 20), FLAGS, st.integers(0, 2000))
def test_the_points_are_those_of_the_status(tmp_path_factory, xs, sims, tasks, flags, refined):
    (excluded, table, precision), folder = flags, tmp_path_factory.mktemp("any")
    store = folder / "s.zarr"
    (folder / "f.py").write_text(CODE)
    document = {"title": "f", "experiment": f"{folder}/f.py:f", "axes": {"x": xs, "y": [0, 1]}}
    if table:
        document |= {"axes": {"y": [0, 1]}, "points": {"columns": {"x": [*xs, xs[0]]}}}
    if excluded:
        document["exclude"] = [{"x": xs[-1], "y": 1}]
    for n_sim in sims:
        sampling = {"n_sim": n_sim, "seed": 1} | ({"precision": 0.5, "max_n_sim": 4096} if precision else {})
        if refined and not precision:
            grid = opening.make_grid(opening.live_study(document | {"sampling": sampling}))
            document["counts"] = {grid.digests(grid.indices())[-1].hex(): refined}
        with suppress(KeyboardInterrupt):
            run(document | {"sampling": sampling}, store, OFTEN, progress=Stopping(tasks))
        watched, report = look(store), status_report(store)
        counts = {code.word: n for code, n in watch.count_status(watched.status).items()}
        assert counts == report["points"]
        if "n_sim_done" in (dataset := opening.OpenStore(store).dataset()):
            assert report["realisations_done"] == int(dataset["n_sim_done"].sum())
            assert counts["done"] == int((dataset["status"] == 1).sum())
        assert (watched.is_over, watched.state) == (True, "stopped" if counts["missing"] else "finished")
        assert sum(points for points, *_ in watched.reasons) == len(report["failures"])
        assert watched.bar["running"] + watched.bar["waiting"] == counts["missing"]
        tiles = [tile for row in watched.tiles(2000, 2000, 2000) for tile in row]
        assert watched.status.size - counts["excluded"] <= len(tiles) <= watched.status.size
        assert [tile.state for tile in tiles].count("failed") == counts["failed"]
        assert all(0.0 <= tile.share <= 1.0 for row in watched.tiles(1, 1, 1) for tile in row)


@pytest.mark.parametrize("shape", [(), (3, 5), (400, 2), (1, 90), *map(slow, ((37, 31), (7,), (5, 4, 3, 2)))])
def test_tiles_hold_every_point_once(tmp_path, shape):
    axes = {name: list(range(n)) for name, n in zip("abcd", shape, strict=False)}
    run({"title": "g", "experiment": g, "axes": axes}, tmp_path / "s.zarr")
    watched = look(tmp_path / "s.zarr")
    for most, across, down in ((100, 30, 12), (2000, 2000, 2000)):
        rows = watched.tiles(most, across, down)
        tiles = [tile for row in rows for tile in row]
        assert len(rows) <= max(down, len(tiles) // across + 1)
        assert max(map(len, rows)) <= min(across, shape[-1] if math.prod(shape[:-1]) > 1 else across)
        assert len(tiles) <= max(most, len(axes) and watch.FEWEST_ACROSS)
        numbers = [re.findall(r"([\d,]+) (?:done|failed)", tile.words) for tile in tiles]
        assert sum(int(n.replace(",", "")) for some in numbers for n in some or ["1"]) == math.prod(shape)
        assert [tile.state for tile in tiles].count("failed") >= min(1, len(watched.reasons))
    run({"title": "g", "experiment": g, "axes": {"a": [0, 1], "b": [1]}, "when": {"b": {"a": [1]}}}, tmp_path / "w")
    assert "a=1,b=None" in str(look(tmp_path / "w").tiles(9, 9, 9))


def test_a_store_that_comes_runs_ends_and_goes(coins, place):
    watched, states = watch.Watched(place), []

    class Looking(Progress):
        def advance(self, works, result, taken):
            watched.look()
            states.append((watched.state, watched.progress))

    watched.look()
    assert (watched.state, watched.is_over) == ("waiting", False)
    run(coins, place, OFTEN, progress=Looking())
    assert {state for state, _ in states} == {"running"}
    assert len({progress for _, progress in states}) > 1
    watched.look()
    assert (watched.state, watched.is_over, watched.progress) == ("finished", True, "6 of 6 points done")
    for key in files_of(place):
        located(place).delete(key)
    watched.look()
    assert watched.state == "gone"
    run(coins | {"axes": {"coins": [1, 5]}}, place)
    watched.look()
    assert watched.progress == "2 of 2 points done"


@pytest.mark.parametrize("step", [5.0, 1e-9], ids=["of quick blocks", "of blocks that take longer than was looked"])
def test_speed_is_that_from_one_delivery_to_the_next(tmp_path, monkeypatch, step):
    watched, speeds, clock = watch.Watched(tmp_path / "s.zarr"), [], 0.0
    monkeypatch.setattr(watch, "time", SimpleNamespace(monotonic=lambda: clock))

    class Looking(Progress):
        def advance(self, works, result, taken):
            nonlocal clock
            speeds.append("")
            n = len(speeds)
            # The first look is just before a delivery; nobody runs the study between the 9th and the 10th.
            clock = step * (2.9 if n == 2 else n + max(0, n - 3) * (n > 4)) + 1e5 * (n > 9)
            if n > 1:
                watched.look()
                clock += 1.0
                speeds[-1] = watched.speed
            if n == 9:
                raise KeyboardInterrupt

    (tmp_path / "f.py").write_text("def f(x: int):\n    return 1 // x\n")
    document = {"title": "f", "experiment": f"{tmp_path}/f.py:f", "axes": {"x": list(range(20))}}
    for _ in range(2):
        with suppress(KeyboardInterrupt):
            run(document, tmp_path / "s.zarr", OFTEN, progress=Looking())
    lines = [f"{5 * n} % of the work, 0.1 points/s, about {in_words(199 - 10 * n)} left" for n in range(5, 20)]
    lines = ["", "", "", "20 % of the work, 0.2 points/s, about 1 min 19 s left", *lines[:5], "", "", *lines[7:]]
    assert speeds[:19] == (lines if step > 1.0 else [""] * 19)


def test_looking_writes_nothing_and_what_is_damaged_or_replaced_meanwhile_is_said(sweep_here, coin_store, tmp_path):
    store = tmp_path / "s.zarr"
    shutil.copytree(coin_store, store)
    before, part = files_of(tmp_path), store / parts_of(store)[0]
    for folder, _, _ in os.walk(tmp_path, topdown=False):
        os.chmod(folder, 0o555)
    try:
        code, out, _ = sweep_here("watch", store)
    finally:
        for folder, _, _ in os.walk(tmp_path):
            os.chmod(folder, 0o755)
    assert (code, "6 of 6 points done" in out, files_of(tmp_path)) == (0, True, before)
    part.rename(tmp_path / "away")
    with opening.locked(store):  # from the first look on
        watched = look(store)
        assert (watched.state, watched.is_over, watched.progress) == ("running", False, "")
        (tmp_path / "away").rename(part)
        watched.look()
        assert watched.progress == "6 of 6 points done"
    part.write_bytes(b"other")
    assert "unreadable" in sweep_here("watch", store, coin_store, code=2)[1]
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "zarr.json").write_text("{}")
    assert sweep_here("watch")[0] == sweep_here("watch", tmp_path / "other")[0] == 2


@pytest.mark.slow
def test_a_terminal_beside_a_run(tmp_path, start_sweep):
    pyte = pytest.importorskip("pyte")
    (tmp_path / "f.py").write_text(SLOW)
    master, terminal = os.openpty()
    command = (sys.executable, "-m", "linksweep", "watch", "s.zarr", "--interval", "0.2")
    watching = subprocess.Popen(command, stdout=terminal, cwd=tmp_path)
    start_sweep("run", "f.py:f", "--axis", "x=0:60:1", "--pool", "serial", "-o", "s.zarr", cwd=tmp_path)
    os.close(terminal)
    screen = pyte.Screen(80, 24)
    stream, seen = pyte.ByteStream(screen), []
    while True:
        try:
            stream.feed(os.read(master, 65536))
        except OSError:
            break
        seen.append("\n".join(line.rstrip() for line in screen.display).strip())
    assert watching.wait(PATIENCE_S) == 0
    assert len({one for one in seen if "running" in one}) > 2
    assert any("about" in one and "points/s" in one for one in seen)
    assert "60 of 61 points done, 1 failed" in seen[-1]
    assert "\\u001b[31m[bold]no root[/bold]" in seen[-1]


def estimates(tasks, workers, known):
    free, ends = [START_S] * workers, []
    for cost, seconds in tasks:
        end = heapq.heappop(free) + seconds
        ends.append((end, cost, seconds))
        heapq.heappush(free, end + 0.002)
    total, done = sum(cost for _, cost, _ in ends), 0.0
    eta = Eta(workers if known else None)
    for now, cost, seconds in sorted(ends):
        eta.take(now, cost, seconds)
        done += cost
        yield done / total, eta.left(now, total - done), max(ends)[0] - now


@pytest.mark.parametrize("known", [True, False], ids=["workers known", "workers seen"])
@pytest.mark.parametrize("workers", [1, slow(2), 7, slow(64)])
@pytest.mark.parametrize("kind", KINDS)
def test_after_a_fifth_of_the_work_it_is_right_within_a_factor_of_one_and_a_half(kind, workers, known):
    n = (50 if kind == "scattered" else 10) * workers
    for seed in range(5):
        random_ = random.Random(seed)
        rows = list(estimates([KINDS[kind](random_, i / n) for i in range(n)], workers, known))
        for share in (0.2, 0.5):
            estimate, truth = next(row[1:] for row in rows if row[0] >= share)
            assert truth / 1.5 < estimate < 1.5 * truth


@examples_of(max_examples=examples(200), derandomize=True)
@given(st.lists(STEPS, max_size=30), st.floats(0, 1e15), st.one_of(st.none(), st.integers(0, 100)))
def test_never_negative_nor_nan(steps, cost, workers):
    eta, now, one = Eta(workers), 0.0, Eta(1)
    assert [one.take(3.0, 1.0, 3.0), one.take(3.0, 1.0, 3.0), one.left(3.0, 8.0)][2] == 24.0  # and not of three workers
    assert eta.left(now, cost) is None
    for passed, done, seconds, more in steps:
        now += passed
        eta.take(now, done, seconds)
        cost += more - done
        for later in (0.0, 1.0, 1e9):
            assert 0.0 <= eta.left(now + later, cost) < math.inf
    assert len(pickle.dumps(eta)) < 400  # a run of weeks has millions of tasks
