"""A store keeps and shows every point that it holds: random commands, kills and edits of code against a dictionary."""

import itertools

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import linksweep
from linksweep import SweepError
from tests.sweep.opening import Stopping, check, dying, same, status_report, until_done
from tests.tiers import examples

CODE = """
def f(x: float, y: int = 2, name: str = "a", *, rng):
    return {"value": VERSION * 1000.0 + 10.0 * x + y + ord(name), "random": rng.random()}
"""
X, Y, NAMES = (0.5, 1.0, 2.0, 4.0), (2, 3, 5), ("a", "b")
DEFAULTS = {"y": 2, "name": "a"}


class Sweeps:
    """Runs of one function into one store, and what the store must show: the version of the code of each point."""

    def __init__(self, folder, patch):
        self.file, self.store, self.random = folder / "m.py", folder / "s.zarr", {}
        self.version, self.left = 1, dying(patch)
        self.ledger, self.shown = dict[tuple, int](), set[tuple]()
        self.axes, self.fixed = None, {}
        self.edit(1)
        whole = self.run({"axes": {"x": X, "y": Y, "name": NAMES}, "fixed": {}}, folder / "whole.zarr")
        self.random = {point: random for point, (_, random) in found_in(whole, {}).items()}

    def edit(self, version):
        self.version = version
        self.file.write_text(CODE.replace("VERSION", str(version)))

    def run(self, asked, store=None, **options):
        more = {"sampling": {"n_sim": 2, "seed": 3}, "pool": "serial"}
        return linksweep.run(f"{self.file}:f", store or self.store, **asked, **more, **options)

    def is_refused(self, asked, keep, again):
        """Whether constants differ, or points of other code would be left beside those of today's."""
        if self.axes is None:
            return False
        constants = {name: asked["fixed"].get(name, value) for name, value in DEFAULTS.items()}
        differ = any(constants[n] != self.fixed[n] for n in DEFAULTS.keys() - self.axes - asked["axes"].keys())
        return (differ and not keep) or any(v != self.version for p, v in self.ledger.items() if p not in again)

    def do(self, asked, kill, only, keep, redo):
        constants = {**DEFAULTS, **asked["fixed"]}
        points = set(itertools.product(*(asked["axes"].get(n, (constants.get(n),)) for n in ("x", "y", "name"))))
        there = {point for point in self.ledger if point in (points if only else self.shown | points)}
        old = {point for point, version in self.ledger.items() if version != self.version}
        again = {
            "": set(),
            "old": old,
            "x > 1 and y != 3": {(x, y, name) for x, y, name in there if x > 1 and y != 3} | (old - there),
        }[redo]
        options = {"only": only, "keep": keep, "redo": redo}
        if self.is_refused(asked, keep, again):
            with pytest.raises(SweepError):
                self.run(asked, **options)
            assert self.now() == self.expected()
            return
        before = self.expected()

        def between():
            if (self.store / "zarr.json").exists():
                assert not check(self.store)
                now = self.now()
                kept = {point for point in before if point not in again and (not only or point in points)}
                assert all(now.get(point) == before[point] for point in kept if now), "a kill loses nothing"
                new = {point: self.result(point, self.version) for point in points | again}
                assert all(result in (before.get(p), new.get(p)) for p, result in now.items())

        part, _ = until_done(self.left, kill, lambda: self.run(asked, **options), between)
        for point in [*again, *points]:
            if point in again and point not in there | points:
                self.ledger.pop(point, None)
            elif point in again or point not in self.ledger:
                self.ledger[point] = self.version
        self.shown = points if only or self.axes is None else self.shown | points
        before_axes = set() if only or self.axes is None else self.axes
        differ = {n for n in DEFAULTS if before_axes and self.fixed[n] != constants[n]}
        self.axes = before_axes | asked["axes"].keys() | (differ if keep else set())
        self.fixed = constants
        assert found_in(part, constants) == {point: self.result(point, self.version) for point in points}
        assert self.now() == self.expected()
        assert not check(self.store)

    def result(self, point, version):
        x, y, name = point
        return version * 1000.0 + 10.0 * x + y + ord(name), self.random[point]

    def expected(self):
        return {point: self.result(point, self.ledger[point]) for point in self.shown}

    def now(self):
        is_there = (self.store / "status").exists() and (self.store / "zarr.json").exists()
        return found_in(linksweep.open(self.store), self.fixed) if is_there else {}


def found_in(dataset, constants):
    """Return the results of the points of a dataset that are done, by their parameters."""
    found = {}
    for place in itertools.product(*(range(size) for size in dataset.status.shape)):
        point = dataset.isel(dict(zip(dataset.status.dims, place, strict=True)))
        if point.status == 1:
            key = [
                point[n].item() if n in point.coords else constants.get(n, DEFAULTS.get(n)) for n in ("x", "y", "name")
            ]
            found[tuple(key)] = (point.value_mean.item(), point.random_mean.item())
    return found


def some(values):
    return st.lists(st.sampled_from(values), min_size=1, max_size=3, unique=True)


COMMANDS = st.fixed_dictionaries(
    {
        "x": some(X),
        "y": st.one_of(st.none(), st.sampled_from(Y), some(Y)),
        "name": st.one_of(st.none(), st.none(), st.sampled_from(NAMES), some(NAMES)),
        "edit": st.sampled_from([False, False, False, True]),
        "kill": st.sampled_from([10**9, *range(60)]),
        "only": st.sampled_from([False, False, False, True]),
        "keep": st.booleans(),
        "redo": st.sampled_from(["", "", "old", "x > 1 and y != 3"]),
    }
)


@given(commands=st.lists(COMMANDS, min_size=3, max_size=7))
@settings(
    max_examples=examples(30) if examples(30) == 30 else 2,
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
)
def test_a_store_shows_every_point_that_it_holds(tmp_path_factory, commands):
    with pytest.MonkeyPatch.context() as patch:
        sweeps = Sweeps(tmp_path_factory.mktemp("union"), patch)
        for command in commands:
            sides = {"x": command["x"], "y": command["y"], "name": command["name"]}
            if command["edit"]:
                sweeps.edit(sweeps.version + 1)
            asked = {
                "axes": {name: side for name, side in sides.items() if isinstance(side, list)},
                "fixed": {name: side for name, side in sides.items() if isinstance(side, int | str)},
            }
            sweeps.do(asked, **{key: command[key] for key in ("kill", "only", "keep", "redo")})


def test_a_condition_that_is_none_is_refused_and_never_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    study = {"axes": {"x": [1.0, 2.0]}, "store": tmp_path / "s.zarr", "pool": "serial"}
    linksweep.run(abs_of, **study)
    for condition, words in (("y > 2", "no column 'y'"), ("__import__('os').mkdir('there') or x > 1", "not allowed")):
        with pytest.raises(SweepError, match=words):
            linksweep.run(abs_of, **study, redo=condition)
    assert not (tmp_path / "there").exists()


def abs_of(x: float) -> float:
    return abs(x)


def test_points_that_are_computed_again_say_so_until_they_are_and_each_is_once(tmp_path):
    calls = []

    def f(x: float, *, rng):
        calls.append(x)
        return rng.normal(x)

    study = {"axes": {"x": [1.0, 2.0, 3.0, 4.0]}, "sampling": {"n_sim": 1}, "store": tmp_path / "s.zarr"}
    whole = linksweep.run(f, **study, pool="serial")
    calls.clear()
    with pytest.raises(KeyboardInterrupt):  # with no failure allowed each task is one block
        linksweep.run(f, **study, pool="serial", redo="x > 1", progress=Stopping(2), max_failures=0)
    [left] = status_report(tmp_path / "s.zarr")["failures"].values()
    assert "x > 1" in left
    same(linksweep.run(f, **study, pool="serial", redo="x > 1"), whole)
    assert sorted(calls) == [2.0, 3.0, 4.0]
