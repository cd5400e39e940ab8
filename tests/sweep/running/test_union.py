"""A store shows every point that it holds: random commands, kills, merges and edits of code against a dictionary."""

import itertools
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings, strategies as st

import linksweep
from tests.sweep.opening import OpenStore, Stopping, check, dying, merge, same, status_report, until_done
from tests.tiers import examples, few, slow

CODE = """
import numpy as np
from linksweep import Output, experiment
OUTPUTS = [Output(name, dims="step") for name in ("words", "counts", "times")]
OUTPUTS += [Output("path", dims="step", ragged=True), Output("table", dims=("k", "step")), Output("number", nan=True)]
@experiment(outputs=OUTPUTS)
def plain(x: float, y: int = 2, name: str = "a"):
    steps, when = int(2.0 * x) - 1, np.datetime64("2020-01-01T00:00:00.00000000" + str(y))
    return {
        "value": VERSION * 1000.0 + 10.0 * x + y + ord(name),
        "number": y if x < 2.0 else np.nan if y == 5 else x / 3.0,
        "big": 2**60 + y,
        "truth": y == 3,
        "text": name * y,
        "when": when,
        "path": [y] * steps if name == "a" else x / np.arange(1.0, steps + 1.0),
        "words": np.array(["é" * y] * steps, dtype=str),
        "counts": [2**60 + y + k for k in range(steps)],
        "times": when + np.arange(steps),
        "table": np.outer([1.0, y], np.arange(steps)),
        "image": np.random.default_rng([y, steps]).normal(size=(5, 16)),
    }
@experiment(shared="x")
def noisy(x: float, y: int = 2, name: str = "a", *, rng, n_sim):
    return {"value": np.full(n_sim, VERSION * 1000.0 + 10.0 * x + y + ord(name)), "random": rng.random(n_sim)}
"""
X, Y, NAMES = (0.5, 1.0, 2.0, 4.0), (2, 3, 5), ("a", "b")
DEFAULTS = {"y": 2, "name": "a"}
CHOSEN = [(["b", "c", None], "k != 'b'", ["c", None]), (["b", "c", None], "k == 'None'", [None])]
CHOSEN += [([1, "b"], "k == '1'", [1]), ([1, 2, None], "not k == k or k > 1", [2, None])]
TABLES = [{"x": [1, 2], "y": [1, 3]}, {"d": [1, 1, 0]}, {"x": [4, 4]}, {"d": [0, 0]}]


class Sweeps:
    def __init__(self, folder, patch, kind):
        self.file, self.store, self.kind = folder / "m.py", folder / "s.zarr", kind
        self.left = dying(patch)
        self.ledger, self.shown = dict[tuple, int](), set[tuple]()
        self.axes, self.fixed = None, {}
        self.edit(1)
        whole = self.run({"axes": {"x": X, "y": Y, "name": NAMES}, "fixed": {}}, folder / "whole.zarr")
        self.results = found_in(whole, {})
        if kind == "plain":
            exec(self.file.read_text(), code := {})
            assert self.results == {point: as_lists(code["plain"](*point)) for point in self.results}
        assert len(self.results) == len(X) * len(Y) * len(NAMES)

    def edit(self, version):
        self.version = version
        self.file.write_text(CODE.replace("VERSION", str(version)))

    def run(self, asked, store=None, **options):
        more = {"sampling": {"n_sim": 600, "seed": 3, "keep_samples": True}} if self.kind == "noisy" else {}
        return linksweep.run(f"{self.file}:{self.kind}", store or self.store, **asked, **more, pool="serial", **options)

    def run_elsewhere(self, asked, parts):
        other, both = (self.store.with_name(name) for name in ("other.zarr", "both.zarr"))
        for number in range(1, parts + 1):
            self.run(asked, other, **({"part": f"{number}/{parts}"} if parts > 1 else {}))
        if parts > 1:
            stores = sorted(other.parent.glob("other.zarr.part-*"))
            merge(stores, other)
            assert len(OpenStore(other).ledger().rows) == sum(len(OpenStore(one).ledger().rows) for one in stores)
        merge([self.store, other], both)
        for old in (self.store, *other.parent.glob("other.zarr*")):
            shutil.rmtree(old)
        both.rename(self.store)
        return linksweep.open(self.store)

    def is_refused(self, constants, axes, keep, again):
        names = DEFAULTS.keys() - (self.axes or DEFAULTS.keys()) - axes.keys()
        differ = any(constants[n] != self.fixed[n] for n in names) and not keep
        others = any(v != self.version for p, v in self.ledger.items() if p not in again)
        return self.axes is not None and (differ or others)

    def do(self, asked, kill, only, keep, redo, parts):
        constants = {**DEFAULTS, **asked["fixed"]}
        points = set(itertools.product(*(asked["axes"].get(n, (constants.get(n),)) for n in ("x", "y", "name"))))
        if parts and self.axes is not None:
            only, keep, redo, kill = False, True, "", 10**9
            call = lambda: self.run_elsewhere(asked, parts)  # noqa: E731
        else:
            call = lambda: self.run(asked, only=only, keep=keep, redo=redo)  # noqa: E731
        asked_before = set() if only or self.axes is None else self.shown
        there = in_grid_of(asked_before | points, self.ledger)
        old = {point for point, version in self.ledger.items() if version != self.version}
        chosen = {(x, y, name) for x, y, name in there if x > 1 and y != 3} | (old - there)
        again = {"": set(), "old": old, "x > 1 and y != 3": chosen}[redo]
        if self.is_refused(constants, asked["axes"], keep, again):
            with pytest.raises(linksweep.SweepError):
                call()
            for left in self.store.parent.glob("other.zarr*"):
                shutil.rmtree(left)
            assert self.now() == self.expected()
            return
        stored, before = {point: self.result(point, version) for point, version in self.ledger.items()}, self.expected()

        def between():
            if (self.store / "zarr.json").exists():
                assert not check(self.store)
                now = self.now()
                kept = {point for point in before if point not in again and (not only or point in points)}
                assert all(now.get(point) == before[point] for point in kept if now), "a kill loses nothing"
                new = {point: self.result(point, self.version) for point in points | again}
                assert all(result in (stored.get(p), new.get(p)) for p, result in now.items())

        part, _ = until_done(self.left, kill, call, between)
        for point in [*again, *points]:
            if point in again and point not in there | points:
                self.ledger.pop(point, None)
            elif point in again or point not in self.ledger:
                self.ledger[point] = self.version
        before_axes = set() if only or self.axes is None else self.axes
        differ = {n for n in DEFAULTS if before_axes and self.fixed[n] != constants[n]}
        self.shown = in_grid_of(asked_before | points, self.ledger)
        self.axes = before_axes | asked["axes"].keys() | (differ if keep else set())
        self.fixed = constants
        shown = {point: r for point, r in found_in(part, constants).items() if not parts or point in points}
        assert shown == {point: self.result(point, self.version) for point in points}
        assert self.now() == self.expected()
        assert not check(self.store)

    def result(self, point, version):
        shift = 1000.0 * (version - 1)
        return {n: v + shift if n in ("value", "value_mean") else v for n, v in self.results[point].items()}

    def expected(self):
        return {point: self.result(point, self.ledger[point]) for point in self.shown}

    def now(self):
        try:
            return found_in(linksweep.open(self.store), self.fixed)
        except linksweep.SweepError:
            assert self.axes is None, "who has results keeps some"
            return {}


def in_grid_of(points, some):
    values = [set(column) for column in zip(*points, strict=True)]
    return {point for point in some if all(v in there for v, there in zip(point, values, strict=True))}


def as_lists(results):
    lists = {}
    for name, value in results.items():
        array = np.asarray(value)
        array = array.astype("M8[ns]") if array.dtype.kind == "M" else array
        if f"{name}_length" in results:
            array = array[..., : int(results[f"{name}_length"])]
        lists[name] = [None if isinstance(v, float) and math.isnan(v) else v for v in array.reshape(-1).tolist()]
        lists[name] = lists[name] if array.ndim else lists[name][0]
    return lists


def found_in(dataset, constants):
    actual, dims = {}, dataset.status.dims
    coords = {name: one for name, one in dataset.coords.items() if one.dims[0] in dims}
    along = {name: (dims.index(one.dims[0]), one.values.tolist()) for name, one in coords.items()}
    left_out = ("status", "code", "wall_time", "n_sim_done", "value_samples")
    arrays = {n: one.transpose(*dims, ...).values for n, one in dataset.data_vars.items() if n not in left_out}
    for place in zip(*np.nonzero(dataset.status.values == 1), strict=True):
        values = {**DEFAULTS, **constants, **{name: there[place[axis]] for name, (axis, there) in along.items()}}
        lists = as_lists({name: array[place] for name, array in arrays.items()})
        key = tuple(values[name] for name in ("x", "y", "name"))
        actual[key] = {name: value for name, value in lists.items() if not name.endswith("_length")}
    return actual


def some(values):
    return st.lists(st.sampled_from(values), min_size=1, max_size=3, unique=True)


DRAWN = {"kill": [10**9, *range(60)], "keep": [False, True], "redo": ["", "", "old", "x > 1 and y != 3"]}
DRAWN |= {"edit": [False, False, False, True], "only": [False, False, False, True], "parts": [0, 0, 0, 1, 2]}
SIDES = {"x": some(X), "y": st.one_of(st.none(), st.sampled_from(Y), some(Y))}
SIDES |= {"name": st.one_of(st.none(), st.none(), st.sampled_from(NAMES), some(NAMES))}
COMMANDS = st.fixed_dictionaries(SIDES | {name: st.sampled_from(values) for name, values in DRAWN.items()})
UNCHECKED = {"suppress_health_check": list(HealthCheck)}


@pytest.mark.parametrize("kind", ["plain", slow("noisy")])
@given(commands=st.lists(COMMANDS, min_size=3, max_size=7))
@settings(max_examples=examples(20, quick=1), phases=[Phase.generate], derandomize=True, **UNCHECKED)
def test_a_store_shows_every_point_that_it_holds(tmp_path_factory, kind, commands):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("linksweep.sweep.contract.rows.MOST_VALUES", 64)
        sweeps = Sweeps(tmp_path_factory.mktemp("union"), patch, kind)
        for command in commands:
            if command["edit"]:
                sweeps.edit(sweeps.version + 1)
            asked = {"axes": {name: command[name] for name in SIDES if isinstance(command[name], list)}}
            asked["fixed"] = {name: command[name] for name in SIDES if isinstance(command[name], int | str)}
            sweeps.do(asked, **{key: command[key] for key in ("kill", "only", "keep", "redo", "parts")})


def test_what_is_excluded_later_stays_and_a_condition_that_is_none_is_refused_and_never_run(here):
    study = {"axes": {"x": [1.0, 2.0]}, "store": here / "s.zarr", "pool": "serial"}
    linksweep.run(lambda x: 2.0 * x, **study)
    part = linksweep.run(lambda x: 2.0 * x, **study, exclude=[{"x": 2.0}])
    assert [ds.status.values.tolist() for ds in (part, linksweep.open("s.zarr"))] == [[1, 3], [1, 1]]
    for condition, words in (("y > 2", "no column 'y'"), ("__import__('os').mkdir('there') or x > 1", "not allowed")):
        for store in ("s.zarr", "new.zarr"):
            with pytest.raises(linksweep.SweepError, match=words):
                linksweep.run(lambda x: 2.0 * x, **study | {"store": here / store}, redo=condition)
    assert [path.name for path in here.iterdir()] == ["s.zarr"]


@pytest.mark.parametrize(("axis", "condition", "chosen"), few(2, CHOSEN[::-1]))
def test_a_condition_has_the_values_that_the_dataset_shows(tmp_path, axis, condition, chosen):
    calls = []

    @linksweep.experiment(deterministic=False)
    def f(k):
        calls.append(k)
        return repr(k)

    for there in (axis, axis[:-1]):  # of all, also where some are new
        study = {"store": tmp_path / f"{len(there)}.zarr", "pool": "serial"}
        linksweep.run(f, axes={"k": there}, **study)
        calls.clear()
        linksweep.run(f, axes={"k": axis}, **study, redo=condition)
        assert {*calls} == {*chosen, *axis[len(there) :]}
        assert len(calls) == len({*calls})


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


@pytest.mark.parametrize("order", [(1, 0, 3), *map(slow, ((2, 1, 0), (0, 1, 2), (3, 2, 1)))])
def test_merged_tables_with_values_that_repeat_keep_each_point_and_merge_again(tmp_path, order):
    (tmp_path / "m.py").write_text("def f(x: int = 0, y: int = 2, d: int = 7):\n    return 100 * x + 10 * y + d\n")
    experiment, stores, wanted = str(tmp_path / "m.py") + ":f", [], set[int]()
    for number in order:
        stores.append(tmp_path / f"{number}")
        wanted |= {*linksweep.run(experiment, stores[-1], points=TABLES[number], pool="serial").f.values.tolist()}
    merge(stores, tmp_path / "m")
    merge([tmp_path / "m", *stores], tmp_path / "n")
    assert {*linksweep.open(tmp_path / "n").f.values.tolist()} == wanted


def test_rows_in_which_a_value_has_no_effect_are_there_as_often_as_asked_for_and_keep_their_labels(here, sweep):
    Path("m.py").write_text("def f(c: float, k='l', g: float = 1.0, n=0):\n    return c + g\n")
    study = {"study": "m.py:f", "when": {"g": {"k": ["r"]}}, "pool": "serial"}
    rows = {"c": [1, 2, 2], "k": ["r", "l", "l"], "g": [0.5, 0.7, 0.9]}
    for axes in ({"c": [2.0, 7.0]}, {"c": [8.0], "n": [1, 2]}):
        linksweep.run(**study, store="s", points={**rows, "who": ["A", "B", "C"]}, labels="who")
        linksweep.run(**study, store="s", points=rows)
        linksweep.run(**study, store="s", axes=axes)
    linksweep.run(**study, store="t", points={**rows, "who": ["D", "E", "F"]}, labels="who")
    merge(["s", "t"], "m")
    for store, labels in (("s", "ABC"), ("m", "DEF")):
        assert [*map(str, linksweep.open(store).who.values)] == [*labels, "", "", ""]
    assert "every bit" in sweep("reproduce", "m", "--at", "who=D", code=0)[2]


@pytest.mark.parametrize("order", [["a", "b"], slow(["b", "a"])])
def test_stores_of_which_one_has_a_parameter_more_are_merged_whole(here, sweep, order):
    for more, name in (("", "a"), (", t: int = 5", "b")):
        Path("m.py").write_text(f"def f(x: float{more}):\n    return x\n")
        assert sweep("run", "m.py:f", "--axis", "x=1,2", *(["--set", "t=1"] if more else []), "-o", name)[0] == 0
    assert sweep("merge", *order, "-o", "c", "--accept-code")[0] == 0
    table = linksweep.open("c").f.to_dataframe().dropna().reset_index()
    assert sorted(zip(table.x, table.t, strict=True)) == [(1, 1), (1, 5), (2, 1), (2, 5)]
    Path("m.py").write_text("def f(x: float, u: int = 5):\n    return x\n")
    assert sweep("run", "m.py:f", "--axis", "x=1", "-o", "d")[0] == 0
    assert "is no parameter" in sweep("merge", "b", "d", "-o", "e", "--accept-code", code=2)[2]
