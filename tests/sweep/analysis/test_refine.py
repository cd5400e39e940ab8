"""Points and realisations that are added where they matter, against roots that are known in closed form."""

import json
import math
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings as examples_of, strategies as st

import linksweep
from linksweep.sweep.contract import SweepError
from tests.sweep.opening import Stopping, bare, merge
from tests.tiers import examples, few, slow

pytestmark = pytest.mark.usefixtures("here")
ELEVEN = {"x": np.linspace(0.0, 1.0, 11)}
FOUND = {"find": "shape > 0", "within": 0.1}
GOALS = [({}, "find"), (FOUND | {"until": "error < 1"}, "until"), ({"find": "shape > 0"}, "within")]
GOALS += [(FOUND | {"within": math.nan}, "within"), (FOUND | {"find": "shape is 0"}, "shape is 0")]
GOALS += [(FOUND | {"along": "y"}, "y"), (FOUND | {"variable": "other"}, "other"), ({"until": "shape < 0"}, "< 0.002")]
GOALS += [(FOUND | {"axes": ELEVEN | {"power": [1.0, 2.0]}}, r"--along\): x, power$")]
GOALS += [(FOUND | {name: True}, f"^{name} is an argument of run") for name in ("part", "fresh", "redo")]
GOALS += [(FOUND | {"axes": {"x": [0, 0.3, x]}}, why) for x, why in ((0.1 + 0.2, "rounding"), (math.inf, "there$"))]


def shape(x: float, root: float, power: float = 1.0, is_step: bool = False) -> float:
    return math.copysign(1.0 if is_step else abs(x - root) ** power, x - root)


def noisy(rng, x: float, sigma: float = 0.1) -> float:
    return {"y": x - 0.4321 + sigma * rng.normal()}


def shelf(rng, x: float):
    return {"y": max(-0.06, 5.0 * (x - 0.75)) + 0.3 * rng.normal()}


def rounds(ds):
    return json.loads(ds.attrs.get("refined", "[]"))


@pytest.mark.slow
@examples_of(max_examples=examples(25), deadline=None)
@given(st.floats(0.01, 0.99), st.floats(0.3, 3.0), st.booleans(), st.sampled_from([0.003, 0.01]), st.integers(2, 12))
def test_a_root_is_located_with_a_fifth_of_the_points_of_the_full_grid(root, power, is_step, finest, number):
    fixed, axes = {"root": root, "power": power, "is_step": is_step}, {"x": np.linspace(0.0, 1.0, number)}
    ds = linksweep.refine(shape, axes=axes, fixed=fixed, find="shape > 0", within=finest, pool="serial")
    result, x = linksweep.find(ds, "shape > 0", "x"), ds.x.values
    assert (int(result["crossings"]), abs(float(result["first"]) - root) <= finest) == (1, True)
    # A point may be the root itself, on either side of the condition.
    beside = {side: int(np.searchsorted(x, root, side=side)) for side in ("left", "right")}
    assert min(x[i] - x[i - 1] for i in beside.values()) <= finest * (1.0 + 1e-9)
    assert len(x) <= 0.2 * (1.0 / finest + 1.0)
    added = [point["x"] for one in rounds(ds) for point in one["points"]]
    assert sorted({*axes["x"], *added}) == x.tolist()  # the store says why each point is there


@pytest.mark.slow
def test_every_line_gets_points_at_its_own_crossing_and_further_runs_leave_no_gaps():
    def decay(x: float, rate: float) -> float:
        return math.exp(-rate * x)

    goal = {"find": "decay < 0.2", "along": "x", "pool": "serial"}
    rates = {"rate": [1.0, 2.0, 3.0]}
    ds = linksweep.refine(decay, "s.zarr", axes=ELEVEN | rates, within=0.01, **goal)
    first = linksweep.find(ds, "decay < 0.2", "x")["first"].values
    assert np.isnan(first[0])  # it is above everywhere
    np.testing.assert_allclose(first[1:], math.log(5.0) / np.array([2.0, 3.0]), atol=0.001)
    new = ~np.isin(ds.x.values, ELEVEN["x"])
    assert (ds.status.values[new] == 1).sum(axis=1).tolist() == [1] * new.sum()  # on one line each
    assert bare(linksweep.refine(decay, "s.zarr", axes=ELEVEN | rates, within=0.01, **goal)).equals(bare(ds))
    finer = linksweep.refine(decay, "s.zarr", axes=ELEVEN | rates, within=0.001, **goal)
    assert rounds(finer)[: len(rounds(ds))] == rounds(ds)
    linksweep.run(decay, "s.zarr", axes=ELEVEN | rates, pool="serial")
    assert bare(linksweep.open("s.zarr")).equals(bare(finer))
    linksweep.run(decay, "s.zarr", axes=ELEVEN | {"rate": [4.0]}, pool="serial")
    whole = linksweep.open("s.zarr")
    assert (whole.attrs["complete"], {*whole.status.values.flat}) == (1, {1, 3})
    both = linksweep.refine(decay, "s.zarr", axes=ELEVEN | {"rate": [1.0, 2.0, 3.0, 4.0]}, within=0.001, **goal)
    last = linksweep.find(both, "decay < 0.2", "x")["first"].values[-1]
    assert last == pytest.approx(math.log(5.0) / 4.0, abs=1e-3)


def test_values_between_points_are_interpolated_to_the_error_that_was_asked_for():
    def wave(x: float) -> float:
        return math.sin(2.0 * math.pi * x)

    def uneven(rng, x: float):
        return noisy(rng, x, 0.02 * (1.0 + 9.0 * x))

    ds = linksweep.refine(wave, axes={"x": [0.0, 0.5, 1.0]}, until="error < 0.05", pool="serial")  # where it is 0
    x = np.linspace(0.0, 1.0, 2001)
    assert np.abs(np.interp(x, ds.x.values, ds.wave.values) - np.sin(2.0 * np.pi * x)).max() < 0.05
    assert ds.sizes["x"] <= 0.1 / np.diff(ds.x.values).min() * 10  # not all of it
    log = {"axes": {"x": np.geomspace(1e-3, 100.0, 6)}, "fixed": {"root": 0.03}}
    ds = linksweep.refine(shape, **log, until="error < 0.01", pool="serial")
    assert all(abs(linksweep.interpolate(ds, "shape", "x", x)["shape"] - x + 0.03) < 0.01 for x in x[2::200])
    # two errors of a value less what its neighbours say of it are below that, too; realisations grow by factors of four
    goal = {"axes": {"x": [0.0, 0.2, 0.4]}, "sampling": {"n_sim": 60, "seed": 3}, "pool": "serial"}
    ds = linksweep.refine(uneven, until="error < 0.01", variable="y_mean", max_realisations=10**6, **goal)
    noise = 2.0 * np.sqrt(np.convolve(ds.y_mean_mc_error**2, [0.25, 1.0, 0.25], "valid").max())
    assert noise < 0.01 < 2.0 * noise
    assert ds.sizes["x"] == 5  # each interval is halved, and a line has no use for more points


@pytest.mark.slow
def test_midpoints_are_values_of_the_axis_in_its_own_spacing():
    def inverse(x, less=0.0):
        return 1.0 / (x - less)

    ds = linksweep.refine(inverse, axes={"x": [1, 100, 200]}, find="inverse < 0.017", within=1, pool="serial")
    assert (ds.x.dtype.kind, {58, 59} <= {*ds.x.values.tolist()}) == ("i", True)  # 1/0.017 = 58.8
    log = linksweep.refine(inverse, axes={"x": [1.0, 100.0, 1e4]}, find="inverse < 0.0005", within=500.0, pool="serial")
    assert rounds(log)[0]["points"] == [{"x": 1000.0}]
    goal = {"fixed": {"less": 2459999.0}, "find": "inverse < 0.6", "pool": "serial"}  # dates go on until they are equal
    ds = linksweep.refine(inverse, axes={"x": [2460000.0, 2460001.0]}, within=1e-300, **goal)
    assert 1e-9 < np.sort(abs(ds.x.values - 2459999.0 - 1.0 / 0.6))[1] < 5e-6


@pytest.mark.slow
def test_a_point_gets_realisations_rather_than_neighbours_below_its_error_and_no_more_than_a_fifth_are_spent():
    goal = {"axes": ELEVEN, "sampling": {"n_sim": 100, "seed": 3}, "find": "y_mean > 0", "pool": "serial"}
    ds = linksweep.refine(noisy, "n.zarr", within=0.01, **goal)
    assert int(ds.n_sim_done.sum()) <= 0.2 * 101 * 100
    assert np.abs(ds.x.values[ds.n_sim_done.values > 100] - 0.4321).max() < 0.11  # there are some
    base = linksweep.run(noisy, "b.zarr", axes=ELEVEN, sampling=goal["sampling"], pool="serial")
    far = base.x[np.abs(base.x - 0.4321) > 0.2]
    assert ds.sel(x=far).y_mean.equals(base.sel(x=far).y_mean)  # to the bit
    lavish = linksweep.refine(noisy, "n.zarr", within=0.005, max_realisations=10**5, **goal)
    assert abs(float(linksweep.find(lavish, "y_mean > 0", "x")["first"]) - 0.4321) < 0.0075
    # of 400, two errors are 0.01 and a bit more: twice as exact takes just over four times as many, in doublings
    assert [*rounds(lavish)[len(rounds(ds))]["n_sim"].values()] == [3200]
    linksweep.refine(noisy, "few.zarr", within=0.006, max_realisations=10**5, **goal)
    merge(["n.zarr", "few.zarr"], "both.zarr")  # whose last rounds ask for fewer than are there
    both = linksweep.refine(noisy, "both.zarr", within=0.003, max_realisations=10**5, **goal)
    assert [[*one["n_sim"].values()] for one in rounds(both)[-2:]] == [[1600], [6400]]
    mine = linksweep.run(noisy, "n.zarr", axes=ELEVEN, sampling=goal["sampling"], pool="serial")
    assert bare(mine).equals(bare(lavish.sel(x=ELEVEN["x"])))
    ds = linksweep.refine(shelf, within=0.01, **goal | {"sampling": {"n_sim": 50, "seed": 8}})
    assert float(linksweep.find(ds, "y_mean > 0", "x")["first_error"]) < 0.01  # values beside the limit come later


@pytest.mark.parametrize(("axis", "most"), [([0.0, 0.425], 300), ([0.0, 0.425, 0.8], 10**5)])
def test_a_point_that_is_not_decided_gets_realisations_or_the_answer_says_so(axis, most):
    def peak(rng, x: float):
        return {"y": -0.0071 - abs(x - 0.425) + 0.1 * rng.normal()}

    goal = {"find": "y_mean > 0", "within": 0.01, "max_realisations": most, "pool": "serial"}
    study = {"store": "p.zarr", "axes": {"x": axis}, "sampling": {"n_sim": 100, "seed": 3}}
    ds = linksweep.refine(peak, **study, **goal)
    linksweep.run(peak, **study, pool="serial")  # the study as it was takes no realisations from the store
    assert linksweep.open("p.zarr").n_sim_done.equals(ds.n_sim_done)
    is_decided = (abs(ds.y_mean) > 3.0 * ds.y_mean_mc_error).all()
    words = linksweep.find(ds, "y_mean > 0", "x")["conclusion"].item()
    assert (is_decided, words.startswith("never"), "not decided" in words) == (most > 300, True, most == 300)
    # it was 0.65 of its errors from the limit: three would take 21 times as many realisations, and 16 are the most
    assert [[*one["n_sim"].values()] for one in rounds(ds)[:1]] == [[1600]] * (most > 300)


@linksweep.experiment(outputs=[linksweep.Output("y", statistics=["q99", "max"])])
def high(rng, x: float):
    return {"y": x + rng.normal()}


def test_points_whose_errors_are_not_known_get_realisations_and_no_neighbours():
    goal = {"axes": {"x": [0.0, 0.6, 2.0]}, "sampling": {"n_sim": 200, "seed": 1}, "pool": "serial"}
    ds = linksweep.refine(high, "q.zarr", find="y_q99 > 3", within=0.001, max_realisations=2000, **goal)
    assert (rounds(ds)[0]["points"], ds["y_q99_mc_error"].sel(x=0.6).notnull()) == ([], True)
    more = goal | {"sampling": {"n_sim": 3000, "seed": 1}}  # than that point has got
    assert (linksweep.run(high, "q.zarr", **more).n_sim_done == 3000).all()
    with pytest.raises(SweepError, match="y_max has no Monte-Carlo error"):
        linksweep.refine(high, "q.zarr", find="y_max > 3", within=0.01, **goal)


@pytest.mark.parametrize(("most", "spent"), few(2, [(1000, 1100), (1250, 1200), (1100, 1100), (1500, 1500)]))
def test_no_more_than_the_realisations_that_are_allowed_are_spent_on_new_points(most, spent):
    def wave(rng, x: float):
        return {"y": np.exp(3.0 * x) * np.sin(20.0 * x) + 1e-6 * rng.normal()}

    more = {"axes": ELEVEN, "sampling": {"n_sim": 100}, "max_realisations": most, "pool": "serial"}
    ds = linksweep.refine(wave, f"{most}.zarr", until="error < 0.001", **more)
    assert int(ds.n_sim_done.sum()) == spent
    new = set(ds.x.values.tolist()) - set(ELEVEN["x"])
    assert not new or max(new) > 0.75  # where the wave is largest
    link = {"title": "", "axes": {"n_obj": [10, 20, 40]}, "sampling": {"n_sim": 10, "n_cat": 10}}  # 10 of one catalogue
    ds = linksweep.refine(link, "l.zarr", find="sigma_spin < 0.0432", within=1, max_realisations=most, pool="serial")
    assert 300 < int(ds.n_sim_done.sum()) <= most


def known_of(x, y, errors):
    """Two errors of the better point beside a crossing over the least slope to the points that surely differ."""
    x, y, errors = (one.values.tolist() for one in (x, y, errors))
    known, [i] = [], np.flatnonzero(np.diff(np.sign(y)))
    for k in (k for k in (i, i + 1) if abs(y[k]) < 3.0 * errors[k]):
        sides = (
            [j for j in some if abs(y[j] - y[k]) > 3.0 * math.hypot(errors[j], errors[k])][:1]
            for some in (range(k)[::-1], range(k + 1, len(x)))
        )
        slopes = [abs((y[j] - y[k]) / (x[j] - x[k])) for some in sides for j in some]
        known.append(2.0 * errors[k] / min(slopes))
    return min(known, default=x[i + 1] - x[i])


@pytest.mark.slow
def test_what_is_said_to_be_known_of_a_noisy_crossing_is_true_as_often_as_two_errors_are(sweep, tmp_path):
    inside = []
    for seed in range(40):
        command = ["refine", f"{__file__}:noisy", "--axis", "x=0:1:0.1", "--set", f"seed={seed}", "--set", "n_sim=200"]
        goal = ("--find", "y_mean > 0", "--within", "0.01", "--json", "-o", f"{seed}.zarr")
        report = json.loads(sweep(*command, *goal, cwd=tmp_path, code=0)[1])
        assert report["spent"] <= 0.2 * report["full"]
        ds = linksweep.open(tmp_path / f"{seed}.zarr")
        result = linksweep.find(ds, "y_mean > 0", "x")
        inside.append(abs(float(result["first"]) - 0.4321) <= report["known"][""])
        assert result["crossings"] > 1 or report["known"][""] == pytest.approx(
            known_of(ds.x, ds.y_mean, ds.y_mean_mc_error)
        )
    assert np.mean(inside) >= 0.9


@pytest.mark.parametrize("pool", ["serial", slow("processes")])
@pytest.mark.parametrize("after", [3, *map(slow, (0, 5, 9))])
def test_what_is_stopped_in_any_round_goes_on_to_the_same_bits(after, pool):
    goal = {"axes": ELEVEN, "sampling": {"n_sim": 600}, "find": "y_mean > 0", "within": 0.02}
    whole = linksweep.refine(noisy, "whole.zarr", **goal, pool="serial")
    ds = None
    while ds is None:
        with suppress(KeyboardInterrupt):
            ds = linksweep.refine(noisy, "stopped.zarr", **goal, pool=pool, progress=Stopping(after + 1))
        after += 3
    stopped = linksweep.open("stopped.zarr")
    assert (bare(ds).equals(bare(whole)), bare(stopped).equals(bare(whole)), rounds(ds)) == (True, True, rounds(whole))


def test_points_that_fail_end_the_cutting_and_a_condition_on_a_conditional_axis_leaves_other_points_alone():
    def broken(x: float) -> float:
        if 0.42 < x < 0.48:
            raise ValueError("no")
        return x - 0.45

    ds = linksweep.refine(broken, "f.zarr", axes=ELEVEN, find="broken > 0", within=0.01, pool="serial", max_failures=5)
    assert ((ds.status.values == 2).sum(), ds.sizes["x"]) == (1, 12)

    def kernel(name: str, width: float = 1.0):
        return width if name == "rbf" else 0.5

    axes = {"name": ["flat", "rbf"], "width": [0.0, 0.5, 1.0]}
    study = {"experiment": kernel, "axes": axes, "when": {"width": {"name": ["rbf"]}}}
    ds = linksweep.refine(study, find="kernel > 0.3", within=0.1, along="width", pool="serial")
    done = (ds.status == 1).sum("width")
    assert (done.sel(name="rbf"), done.sel(name="flat")) == (ds.sizes["width"] - 1, 1)


@pytest.mark.parametrize(("goal", "words"), GOALS)
def test_a_goal_that_is_none_is_refused_before_anything_is_written(goal, words, tmp_path):
    with pytest.raises(SweepError, match=words):
        linksweep.refine(shape, "r.zarr", **{"axes": ELEVEN, "fixed": {"root": 0.5}, "pool": "serial"} | goal)
    assert not (tmp_path / "r.zarr").exists()


def test_the_command_says_what_is_known_and_what_it_took(sweep, tmp_path):
    (tmp_path / "f.py").write_text("def step(x: float):\n    return float(x > 0.618)\n")
    command = ["refine", "f.py:step", "--axis", "x=0:1:0.25", "--find", "step > 0.5", "--within", "0.1", "-o", "s.zarr"]
    status, out, err = sweep(*command, cwd=tmp_path)
    assert (status, "round 1: 1 new point" in err, "step > 0.5" in out) == (0, True, True), err
    report = json.loads(sweep(*command, "--json", cwd=tmp_path)[1])
    assert [*map(report.get, ("spent", "full", "upcoming", "known"))] == [7, 11, None, {"": pytest.approx(0.06, 0.3)}]
    text = "import linksweep as l\n@l.experiment(outputs=[l.Output('y', nan=True)])\ndef holes(x: float):\n    return "
    (tmp_path / "h.py").write_text(f"{text}float('nan') if x == 0 else 1 / 0 if x == 1 else float(x > 0.618)\n")
    out = sweep(command[0], "h.py:holes", *command[2:5], "y > 0.5", *command[6:-1], "h.zarr", cwd=tmp_path, code=1)[1]
    assert "from 0.589; points go only from 0.25 to 0.75" in out
    sweep("run", "f.py:step", "--set", "x=5", "-o", "t.zarr", cwd=tmp_path)
    for merged in ("s.zarr t.zarr -o m.zarr", "m.zarr s.zarr -o both.zarr"):
        sweep("merge", *merged.split(), cwd=tmp_path, code=0)
        said = sweep("status", merged.split()[-1], cwd=tmp_path)[1]
        assert said.count("of sweep refine") == len(report["rounds"]) == 2
    goal = "--axis x=0,0.1,0.4 --set n_sim=50 --until error<9 --within 0.3 --json -o u.zarr"
    known = json.loads(sweep("refine", f"{__file__}:noisy", *goal.split(), cwd=tmp_path, code=0)[1])["known"][""]
    assert known == pytest.approx(2.0 * np.linalg.norm(linksweep.open("u.zarr").y_mean_mc_error * [0.75, 1.0, 0.25]))
    (tmp_path / "g.py").write_text("def inverse(x: int, y: int):\n    return 1.0 / x\n")
    two = ["refine", "g.py:inverse", "--axis", "x=1,2", "--axis", "y=1,2", "--along", "x", "-o", "w.zarr", "--within"]
    for more in ("9 --until error<0.1", "0.1 --until error<0.1", "0.1 --find inverse<0.6"):  # no other full grid
        out = sweep(*two, *more.split(), cwd=tmp_path, code=0)[1]
        assert ("100 % of" in out, "whole numbers; written" in out, "inf" in out) == (True, True, False)
    part = "x=1,9 --axis y=1,2 --exclude y=2,x>5 --along x --find inverse<0.3 --within 1 -o p.zarr --json"
    assert json.loads(sweep(*two[:3], *part.split(), cwd=tmp_path, code=0)[1])["full"] == 10  # nine, and one of y = 2
