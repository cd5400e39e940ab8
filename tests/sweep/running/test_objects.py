"""Values of any type on axes, as constants and in tables: under labels, known by their canonical form."""

import datetime
import enum
import importlib
import itertools
import json
from collections import ChainMap
from dataclasses import make_dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from astropy.table import Column, Table
from hypothesis import given, settings, strategies as st

import linksweep
from tests.sweep.analysis.made import shown
from tests.sweep.opening import OpenStore, merge, status_report
from tests.tiers import examples, few, slow

PLAIN = st.one_of(st.none(), st.booleans(), st.floats(1, 9), st.text("abc", max_size=3))
WRONG = ({"gam": {"kernel": ["rbf"]}}, {"gamma": {"kernl": ["rbf"]}}, {"gamma": {"kernel": "rbf"}}, {"gamma": ["rbf"]})
NUMBERS = st.lists(st.sampled_from([1, 2, 3, 1.0, 2.0, 2.5]), min_size=1, unique=True)
ROWS = np.array([[0.0, 1.0], [2.0, 3.0]])
Colour, Size = enum.Enum("Colour", "RED BLUE"), make_dataclass("Size", ["width"], frozen=True)


class Net:
    def __init__(self, width):
        self.width = width


def double(x):
    return 2 * x


def described(thing, x: float = 1.0):
    if isinstance(thing, Net):
        return {"text": f"net {thing.width}", "y": thing.width * x}
    return {"text": f"{type(thing).__name__} {getattr(thing, '__name__', thing)!r}", "y": x}


def run(store, **options):
    return linksweep.run(described, store, **{"pool": "serial", **options})


UNTOLD = [({"thing": [one]}, "has no label of its own") for one in (Net(1), lambda: 1)]
UNTOLD += [({"thing": {"one": (x for x in ())}}, "no canonical form"), ({"thing": [(1,), "(1,)"]}, "two values have")]
UNTOLD += [({"thing": {"one": Net(1), "two": Net(1)}}, "duplicate values 'one', 'two'")]
UNTOLD += [({"thing": [1], "x": [None]}, "x = None: must be a number")]
UNTOLD += [({"thing": numbers}, str(numbers[0])) for numbers in ([2**53 + 1, 0.5], [2, 2.0], [1, 1.0000000000000002])]
LABELS = {"RED": Colour.RED, "sin": np.sin, "(1, 'a')": (1, "a")}
ALIKE = [[0, False, "no"], [*LABELS.values()], [0, False, 1, True, "no"], [True, 1], [1.0, False]]
FEW = (
    *(None, True, 1, 2.5, "a", 1j, (1, "b"), [1, 2], {"k": (1,)}, frozenset({1}), Colour.RED, Colour.BLUE, Size(3)),
    *(double, Net, np.arange(3), datetime.date(2026, 1, 1), np.datetime64("2026-01-02"), Path("a/b")),
)


@pytest.mark.parametrize("pool", ["serial", *map(slow, ["processes", "threads"])])
def test_an_axis_has_values_of_all_types(pool, tmp_path):
    values = list(FEW)
    ds = run(tmp_path / "s.zarr", axes={"thing": values}, pool=pool)
    assert ds.text.values.tolist() == [described(value)["text"] for value in values]
    assert {"a", "a/b", "RED", "double", "Net", "2026-01-01"} <= {*ds.thing.values.tolist()}
    again = run(tmp_path / "s.zarr", axes={"thing": values[::-1]})
    assert again.text.values.tolist() == ds.text.values.tolist()[::-1]
    assert linksweep.open(tmp_path / "s.zarr").sizes["thing"] == len(values)
    numbered = ds.assign(number=("thing", np.arange(len(values)) + 1.0))
    ratios = [linksweep.ratio(numbered, "number", "thing", of=value, to=None)["ratio"] for value in values]
    assert ratios == [*range(1, len(values) + 1)]


def holding(inner):
    lists = st.lists(inner, max_size=3)
    return lists | lists.map(tuple) | st.dictionaries(st.text("ab", max_size=2), inner, max_size=2)


THINGS = st.recursive(PLAIN, holding, max_leaves=5)
BESIDE = st.lists(st.tuples(st.sampled_from([{}, {"(0,)": (0,)}]), st.booleans()), min_size=2, max_size=2)


@given(st.lists(THINGS, min_size=1, max_size=6, unique_by=repr), st.integers(1, 6), st.randoms(), BESIDE)
@settings(max_examples=examples(15, quick=2), derandomize=True)
def test_what_is_there_under_a_label_is_not_computed_again(tmp_path_factory, things, some, seed, beside):
    calls, expected = [], dict[tuple[str, str], str]()

    def seen(thing, other=(0,)):
        calls.append(repr((thing, other)))
        return calls[-1]

    store = tmp_path_factory.mktemp("objects") / "s.zarr"
    labels = {f"label {number}": thing for number, thing in enumerate(things)}
    few, others = (dict(seed.sample(list(labels.items()), min(k, len(labels)))) for k in (some, seed.randint(1, 6)))
    for axis, (default, is_more) in zip((few, others), beside, strict=True):
        more = default | {f"other {label}": thing for label, thing in few.items() if is_more}
        number, pairs = len(calls), itertools.product(axis.items(), (more or {"(0,)": (0,)}).items())
        ds = linksweep.run(seen, store, axes={"thing": axis} | ({"other": more} if more else {}), pool="serial")
        asked = {(label, name): repr((thing, other)) for (label, thing), (name, other) in pairs}
        assert ds.seen.values.ravel().tolist() == list(asked.values())
        assert set(calls[number:]) == {text for key, text in asked.items() if key not in expected}
        expected |= asked
    whole = linksweep.open(store).seen
    whole = whole if "other" in whole.dims else whole.expand_dims(other=["(0,)"])
    assert dict(whole.transpose("thing", "other").to_series().replace("", np.nan).dropna()) == expected


def test_an_object_of_ones_own_needs_a_label_and_constants_and_tables_have_objects(tmp_path):
    ds = run(tmp_path / "s.zarr", axes={"thing": {"small": Net(8), "large": Net(16)}, "x": [1.0, 2.0]})
    assert ds.y.sel(x=2.0).values.tolist() == [16.0, 32.0]
    axes = {"thing": {"small": Net(9), "large": Net(16)}, "x": [2.0]}
    with pytest.raises(linksweep.SweepError, match="thing: 'small' is another value than in the store"):
        run(tmp_path / "s.zarr", axes=axes)
    run(tmp_path / "s.zarr", axes=axes, only=True)
    assert linksweep.open(tmp_path / "s.zarr").y.sel(x=2.0).values.tolist() == [18.0, 32.0]
    assert run(tmp_path / "c.zarr", fixed={"thing": (1, 2)}).text.item() == "tuple (1, 2)"
    things = [(1, 2), None, Colour.BLUE, np.sin, [3], {"k": (1, 2)}, (1, (2, 3))]
    table = {"thing": things, "x": [*map(float, range(7))], "w": things}
    for number, points in enumerate((table, pd.DataFrame(table))):
        for rows in (3, 3, 7):  # it goes on and grows
            part = points.head(rows) if number else {name: column[:rows] for name, column in table.items()}
            ds = run(tmp_path / f"t{number}.zarr", points=part, labels="w")
        assert ds.thing.values.tolist() == ["(1, 2)", "None", "BLUE", "sin", "[3]", "{'k': (1, 2)}", "(1, (2, 3))"]
        assert ds.w.values.tolist() == ["(1, 2)", "", *ds.thing.values[2:]]
        assert ds.text.values.tolist() == [described(thing)["text"] for thing in things]


@pytest.mark.parametrize(("axes", "said"), UNTOLD)
def test_objects_and_numbers_that_cannot_be_told_apart_are_refused(axes, said, tmp_path):
    with pytest.raises(linksweep.SweepError, match=said):
        run(tmp_path / "s.zarr", axes=axes)
    assert not (tmp_path / "s.zarr").exists()


def test_objects_of_classes_that_are_there_twice_are_refused(tmp_path, monkeypatch):
    (tmp_path / "twice.py").write_text("import enum\nK = enum.Enum('K', 'A B')\ndef g(k): return k is K.B\n")
    monkeypatch.syspath_prepend(tmp_path)
    axes = {"k": [*(module := importlib.import_module("twice")).K]}
    with pytest.raises(linksweep.SweepError, match=r"axes\.k: A is of the module twice, which .* has loaded apart"):
        linksweep.run(f"{tmp_path}/twice.py:g", tmp_path / "s", axes=axes)
    importlib.reload(module)  # as a cell that is executed again
    with pytest.raises(linksweep.SweepError, match=r"axes\.k: A is of another definition of the class twice\.K"):
        linksweep.run(module.g, tmp_path / "s", axes=axes)


def test_what_may_be_none_infinite_or_nan_can_be_and_large_defaults_are_left_as_they_are(tmp_path, sweep):
    text = "def f(a: Optional[float] = None, b: int | None = 3, name: str = 'x', s: str | None = None, c=None):\n"
    text = f"from typing import Optional\n{text}    return {{'text': f'{{a}} {{b}} {{name}} {{s!r}} {{c!r}}'}}\n"
    (tmp_path / "m.py").write_text(text)
    for more in ((), ("--set", "s=None"), ("--axis", "s=None,abc")):
        asked = ("--axis", "a=None,1", "--axis", "b=None,3", "--axis", "name=1e3,True", "--set", "c=False", *more)
        sweep("run", "m.py:f", *asked, "-o", "s.zarr", "-q", cwd=tmp_path, code=0)
    text = linksweep.open(tmp_path / "s.zarr").text.sel(b="None", name="1e3")
    assert text.sel(s="None").values.tolist() == ["None None 1e3 None False", "1.0 None 1e3 None False"]
    assert text.sel(s="abc").values.tolist() == ["None None 1e3 'abc' False", "1.0 None 1e3 'abc' False"]
    assert sweep("reproduce", "s.zarr", "--at", "a=None,b=3,name=True,s=None", cwd=tmp_path)[0] == 0
    text = "def f(x: float = 1.0, p: float = float('inf'), q=float('nan'), n=2**70):\n    return repr((x, p, q, n))\n"
    (tmp_path / "m.py").write_text(text)
    for axis in ("x=2,3", "p=1,inf,nan", "q=inf"):
        sweep("run", "m.py:f", "--axis", axis, "--exclude", "p>1,x=3", "-o", "t.zarr", "-q", cwd=tmp_path, code=0)
    actual = {*linksweep.open(tmp_path / "t.zarr").f.to_series()} - {""}
    values = [(2.0, "inf", "nan"), (1.0, "1.0", "nan"), (1.0, "inf", "nan"), (1.0, "nan", "nan"), (1.0, "inf", "inf")]
    assert actual == {f"({x}, {p}, {q}, {2**70})" for x, p, q in values}
    assert "every bit" in sweep("reproduce", "t.zarr", "--at", "x=1,p=nan,q=nan", cwd=tmp_path)[2]


def test_where_a_declared_parameter_has_no_effect_there_is_one_point_without_it(tmp_path, sweep):
    @linksweep.experiment(when={"gamma": {"kernel": ["rbf", "poly"]}}, outputs={"fit": "mm"})
    def fit(kernel: str, gamma: float = 7.0, c: float = 1.0):
        return {"linear": 0.0, "rbf": 10.0, "poly": 20.0}[kernel] + gamma + 100.0 * c

    for kernels, gammas in ((["linear", "rbf"], [0.5, 1.0]), (["linear", "poly"], [2.0, 0.5])):
        ds = linksweep.run(fit, tmp_path / "s.zarr", axes={"kernel": kernels, "gamma": gammas}, pool="serial")
        assert (ds.attrs["points"], ds.attrs["complete"], ds.fit.units) == (3, 1, "mm")
    zipped = {"experiment": fit, "axes": {"gamma": gammas, "c": gammas}, "grid": {"zip": [["gamma", "c"]]}}
    with pytest.raises(linksweep.SweepError, match="gamma shares a dimension"):
        linksweep.run(zipped | {"axes": zipped["axes"] | {"kernel": kernels}}, tmp_path / "z.zarr")
    for kernel in kernels[::-1]:  # together they are a table
        ds = linksweep.run(zipped | {"fixed": {"kernel": kernel}}, tmp_path / "z.zarr", pool="serial", keep=True)
        assert np.isnan(ds.gamma).all() == (kernel == "linear")
        ds = linksweep.run(fit, tmp_path / "l.zarr", fixed={"kernel": kernel}, axes={"gamma": gammas}, keep=True)
        assert ("no point has such a value of kernel" in str(ds.warnings)) == (kernel == "linear")
    both = linksweep.open(tmp_path / "l.zarr")
    assert (sorted(both.fit.to_series().dropna()), both.warnings) == ([107.0, 120.5, 122.0], "[]")
    np.testing.assert_array_equal((rows := linksweep.open(tmp_path / "z.zarr")).gamma, [*gammas, np.nan, np.nan])
    assert linksweep.find(rows.isel(point=[2, 3]), "fit > 100", "c")["crossings"] == 1  # they differ in c alone
    for missing in ("nan", "None"):
        code, out, err = sweep("show", tmp_path / "s.zarr", "--at", f"gamma={missing}", "--json")
        assert (code, [row["fit"] for row in json.loads(out)["rows"] if row["fit"] is not None]) == (0, [107.0]), err


def test_values_without_effect_are_on_no_axis_and_none_is_one_of_its_own(tmp_path, sweep):
    g = "def g(star='Sun', tag=None, mode='m'):\n    return repr((star, tag))\n"
    (tmp_path / "m.py").write_text(f"{g}def f(kernel: str, gamma=None):\n    return {{'y': repr(gamma)}}\n")
    study = {"experiment": f"{tmp_path}/m.py:f", "when": {"gamma": {"kernel": ["rbf"]}}}
    store = tmp_path / "s.zarr"
    two, text = ({"kernel": ["rbf"], "gamma": values} for values in ([0.5, 2.0], ["None"]))
    for axes, labels in (({"kernel": ["linear"]}, None), (two, [0.5, 2.0, None]), (text, ["0.5", "2.0", "None", ""])):
        linksweep.run(study | {"axes": axes}, store, pool="serial")
        whole = linksweep.open(store)
        assert labels is None or pd.Series(whole.gamma.values).replace(np.nan, None).tolist() == labels
    for at, words in (("kernel=rbf,gamma=None", "every bit"), ("kernel=linear", "every bit"), ("kernel=rbf", "0.5, 2")):
        assert words in sweep("reproduce", store, "--at", at)[2]
    fixed, some = (dict.fromkeys(["star", "tag"], one) for one in ("None", ["None"]))
    for number, more in enumerate(({"fixed": fixed}, {"axes": some}, {"points": some})):
        ds = linksweep.run(f"{tmp_path}/m.py:g", tmp_path / f"{number}", when={"star": {"mode": ["m"]}}, **more)
        assert ds.g.values.ravel().tolist() == ["('None', 'None')"]

    def f(k: str, n: int):
        return f"{k} {n}"

    axes = {"k": ["a", "b"], "n": [1, 2]}  # without a default n is None
    ds = linksweep.run(f, tmp_path / "n.zarr", axes=axes, when={"n": {"k": ["b"]}}, pool="serial")
    assert {*ds.f.values[ds.status.values == 1]} == {"a None", "b 1", "b 2"}


@pytest.mark.parametrize("when", [*WRONG, "gamma", {"gamma": {"kernel": []}}, {"gamma": {"gamma": [1.0]}}])
def test_a_condition_that_means_nothing_is_refused(tmp_path, when):
    fit, axes = linksweep.experiment(when=when), {"kernel": ["rbf"], "gamma": [1.0]}
    with pytest.raises(linksweep.SweepError, match="when"):
        linksweep.run(fit(lambda kernel="rbf", gamma=1.0: gamma), tmp_path / "s", axes=axes)
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("kind", [Colour, slow(enum.Enum("Kind", "RED BLUE"))])
@pytest.mark.parametrize("pool", [None, *map(slow, ("serial", "threads", "processes"))])
def test_lambdas_have_labels_and_reach_every_kind_of_worker_and_objects_their_classes(tmp_path, pool, kind):
    axes = {"law": {"square": lambda x: x * x, "cube": lambda x: x**3}}
    ds = linksweep.run(lambda law: law(2.0), tmp_path / "s.zarr", axes=axes, pool=pool)
    assert ds.result.sel(law=["square", "cube"]).values.tolist() == [4.0, 8.0]
    ds = linksweep.run(lambda k: k is kind.BLUE, tmp_path / "k.zarr", axes={"k": list(kind)}, pool=pool, verify=1)
    assert ds.result.values.tolist() == [False, True]


DEFAULTS = {"a": "x", "b": 0, "c": None, "d": 2}
VALUES = {name: ["x", "y", None] if name == "a" else [0, 1, 2, None] for name in DEFAULTS}


def chained(a: str | None = "x", b: int | None = 0, c: int | None = None, d: int | None = 2):
    return f"{a} {b} {c} {d}"


@st.composite
def studies(draw, *kinds):
    groups = dict[tuple[str, int], dict[str, list]]()  # what shares a dimension
    for number, (name, values) in enumerate(VALUES.items()):
        kind = draw(st.sampled_from(kinds))
        least, most = {"axes": (1, 3), "fixed": (1, 1), "default": (0, 0), "zip": (2, 2), "columns": (3, 3)}[kind]
        some = st.lists(st.sampled_from(values), min_size=least, max_size=most, unique=kind != "columns")
        groups.setdefault((kind, number if kind == "axes" else 0), {})[name] = draw(some)
    named = {kind: dict(ChainMap(*(some for (one, _), some in groups.items() if one == kind))) for kind in kinds}
    zipped, columns = named["zip"], named.get("columns")
    study = {"axes": named["axes"] | zipped, "fixed": {name: value for name, (value,) in named["fixed"].items()}}
    study |= {"grid": {"zip": [[*zipped]]}} if len(zipped) > 1 else {}
    study |= {"points": {"columns": columns}} if columns else {}
    rows = [[dict(zip(some, row, strict=True)) for row in zip(*some.values(), strict=True)] for some in groups.values()]
    return study, [DEFAULTS | dict(ChainMap(*row)) for row in itertools.product(*filter(None, rows))]


SUBSETS = {name: st.lists(st.sampled_from(values), min_size=1, unique=True) for name, values in VALUES.items()}
CONDITIONS = {
    name: st.fixed_dictionaries({}, optional={other: SUBSETS[other] for other in earlier}).filter(bool)
    for name, earlier in (("b", "a"), ("c", "ab"), ("d", "abc"))
}
KINDS = "axes", "fixed", "default", "zip"
AMONG = {name: some.map(lambda some: {"in": some}) for name, some in SUBSETS.items()}
BOUNDS = st.dictionaries(st.sampled_from(["above", "below"]), st.integers(0, 2), min_size=1)
CLAUSES = st.fixed_dictionaries({}, optional=AMONG | {name: AMONG[name] | BOUNDS for name in "bd"}).filter(bool)
RUNS = st.tuples(studies(*KINDS, "columns"), studies(*KINDS))


def meets(value, rule):
    return value in rule["in"] if "in" in rule else value in range(rule.get("above", -1) + 1, rule.get("below", 3))


@given(RUNS, st.fixed_dictionaries({}, optional=CONDITIONS), st.lists(CLAUSES, max_size=2))
@settings(max_examples=examples(25, quick=2), derandomize=True)
def test_conditions_of_any_depth_hold_at_each_point_wherever_values_come_from(tmp_path_factory, runs, when, clauses):
    store, expected = tmp_path_factory.mktemp("when") / "s.zarr", dict[tuple, str]()
    for number, (study, points) in enumerate(runs):
        asked, places, study["exclude"] = set[str](), set[tuple](), clauses
        for point in points:
            report = dict(point)
            for name in sorted(when):  # each depends on those before it
                if any(point[other] not in some for other, some in when[name].items()):
                    point[name], report[name] = "gone", DEFAULTS[name]
            if not any(all(meets(point[name], rule) for name, rule in one.items()) for one in clauses):
                expected[tuple(point.values())] = result = chained(**report)
                asked.add(result)
                places.add((*(str(point[name]).replace("gone", "") for name in study["axes"]), result))
        try:
            ds = linksweep.run(study | {"experiment": chained, "when": when}, store, pool="serial", keep=True)
        except linksweep.SweepError as error:
            if not asked or ("shares a dimension" in str(error) and study.keys() & {"grid", "points"}):
                return
            raise
        assert {*ds.chained.values[ds.status.values == 1]} == asked
        whole = study | {"experiment": chained, "when": when}
        [linksweep.run(whole, fresh := store.with_name(f"{number}"), part=f"{k}/2", pool="serial") for k in (1, 2)]
        merge([f"{fresh}.part-*"], fresh)
        rows = [row for row in json.loads(shown("show", fresh, "--json"))["rows"] if row["status"] == "done"]
        texts = ([row[name] for name in [*study["axes"], "chained"]] for row in rows)  # a number beside None is one
        assert {tuple("" if v is None else f"{v:g}" if v != str(v) else v for v in row) for row in texts} == places
        assert status_report(fresh)["points"]["done"] == len(rows)
    merge([store.with_name("0"), store.with_name("1")], store.with_name("merged"))
    for place in (store, store.with_name("merged")):
        whole = linksweep.open(place)
        assert {*whole.chained.values[whole.status.values == 1]} == {*expected.values()}
        assert len(OpenStore(place).ledger().rows) == len(expected), "equal points are one"
    if {"b"} <= when.keys() & runs[1][0]["axes"].keys():  # the same points mean something else
        with pytest.raises(linksweep.SweepError, match="when: "):
            linksweep.run(runs[1][0] | {"experiment": chained, "when": {**when, "b": {"a": ["w"]}}}, store)


@pytest.mark.parametrize("axis", few(2, ALIKE))
def test_conditions_tell_values_from_others_that_are_alike_and_objects_by_their_labels_too(tmp_path, axis):
    rows = linksweep.run(lambda k: repr(k) + "", tmp_path / "t", points={"k": [*axis, axis[0]]}, pool="serial")
    assert rows.result.values.tolist() == list(map(repr, [*axis, axis[0]]))
    for number, named in enumerate([*axis, *LABELS] if axis[0] is Colour.RED else axis):
        value = LABELS.get(named, named)
        others = {repr(one) for one in axis if repr(one) != repr(value)}
        axes, store, when = {"k": axis, "g": [2.0, 3.0]}, tmp_path / str(number), {"g": {"k": [named]}}
        ds = linksweep.run(lambda k: repr(k) + "", store, axes={"k": axis}, exclude=[{"k": named}], pool="serial")
        assert {*ds.result.values[ds.status.values == 1]} == others
        declared = linksweep.experiment(when=when)(lambda k, g=0.5: f"{k!r} {g}")
        expected = {f"{one} 0.5" for one in others} | {f"{value!r} {g}" for g in axes["g"]}
        for how, function in (({}, declared), ({"when": when}, lambda k, g=0.5: f"{k!r} {g}")):
            ds = linksweep.run(function, tmp_path / f"{number}w{len(how)}", axes=axes, pool="serial", **how)
            assert {*ds.result.values[ds.status.values == 1]} == expected


def test_only_the_script_computes_points_of_its_objects_again(here, sweep):
    text = "import os\ndef g(x, m: float = 1.0):\n    if m == 2.0 and not os.path.exists('mended'):\n"
    (here / "m.py").write_text(f"{text}        raise ValueError('broken')\n    return m * len(str(x))\n")

    def run(x, store="s.zarr", **more):
        return linksweep.run("m.py:g", store, axes={"x": x, "m": [1.0, 2.0]}, pool="serial", **more)

    dates = [datetime.date(2020, 1, 1), (1, "a")]
    run(dates)
    for command in (["run", "--retry", "s.zarr"], ["reproduce", "s.zarr", "--at", "x=2020-01-01,m=2"]):
        code, _, said = sweep(*command)
        assert (code, "x = '2020-01-01' is the label of an object that only its script can make" in said) == (2, True)
    (here / "mended").touch()
    assert np.isnan(run(dates).g.values[:, 1]).all()
    assert run(dates[:1], retry=True).g.values.tolist() == [[10.0, 20.0]]
    assert linksweep.open("s.zarr").g.fillna(0.0).values.tolist() == [[10.0, 20.0], [8.0, 0.0]]
    for how, words in (("fresh redo", "fresh and redo do"), ("fresh retry", "do not go"), ("retry", "no store is")):
        with pytest.raises(linksweep.SweepError, match=words):
            run(dates, "t", **dict.fromkeys(how.split(), "old"))
    f = "def f(x=None, y: int = 2):\n    return repr((x, y))\n"
    Path("m.py").write_text(f"{f}\ndef g(rng, x=None):\n    return x is None\n")
    for name, more, changed in (("f", {}, "--redo=y > 1"), ("g", {"sampling": {"n_sim": 60}}, "--set=n_sim=600")):
        linksweep.run(f"m.py:{name}", f"{name}.zarr", axes={"x": [(1, "a"), 1]}, pool="serial", **more)
        before = linksweep.open(f"{name}.zarr")
        code, _, err = sweep("run", f"m.py:{name}", "--axis", "x=1,2", "-o", f"{name}.zarr", changed)
        assert (code, "only its script can make again" in err) == (2, True), err
        assert linksweep.open(f"{name}.zarr").identical(before)
    assert sweep("run", "m.py:f", "--axis", "x=1,2", "-o", "f.zarr", "--verify", "3")[0] == 0
    assert linksweep.open("f.zarr").f.values.tolist() == ["((1, 'a'), 2)", "(1, 2)", "(2, 2)"]


@given(runs=st.lists(st.tuples(st.booleans(), NUMBERS), max_size=4))
@settings(max_examples=examples(40, quick=3), derandomize=True)
def test_equal_numbers_are_one_point_of_the_type_that_came_first(tmp_path_factory, runs):
    store, first, rows = tmp_path_factory.mktemp("numbers") / "s.zarr", dict[float, int | float](), list[float]()
    for is_table, some in runs:
        rows = list(dict.fromkeys([*rows, *some])) if is_table else rows  # it may only grow at its end
        values = rows if is_table else some
        section = {"points" if is_table else "axes": {"x": values}}
        ds = linksweep.run(lambda x: repr(x) + "", store, **section, pool="serial")
        first = {value: value for value in values} | first
        assert sorted(ds.x.values.tolist()) == sorted(values)
        whole = linksweep.open(store)
        shown = list(zip(whole.x.values.tolist(), whole.result.values.tolist(), strict=True))
        assert sorted(shown) == sorted((value, repr(one)) for value, one in first.items())


def test_integers_of_a_file_stay_integers_beside_fractions_and_bounds_beyond_2_to_53_are_exact(here):
    for rows, store in (("0 2", "s"), ("0 2 1.5", "s"), ("0 2 1.5", "t")):
        (here / "x.csv").write_text("\n".join(["x", *rows.split()]))
        ds = linksweep.run(lambda x: repr(x) + "", store, points="x.csv", pool="serial")
        assert ds.result.values.tolist() == rows.split()
    for store, asked in (("u", {"fixed": {"x": 2}}), ("u", {"axes": {"x": [2.0]}}), ("v", {"points": {"x": [2, 2.0]}})):
        ds = linksweep.run(lambda x: repr(x) + "", store, pool="serial", **asked)
        assert {*ds.result.values.flat} == {"2"}  # the type that came first
    axes, bounds = {"n": [2**60 + k for k in range(4)]}, [{"n": {"below": 2**60 + 1}}, {"n": {"above": 2**60 + 2}}]
    ds = linksweep.run(lambda n: n % 4, "w", axes=axes, exclude=bounds, pool="serial")
    assert ds.status.values.tolist() == [3, 1, 1, 3]


Level, Word = enum.IntEnum("Level", "LOW HIGH"), enum.StrEnum("Word", {"YES": "y"})
MEMBERS = [("m", [*Level, 3], ["LOW", "HIGH", "3"]), ("m: Level = Level.LOW", [*Level], ["LOW", "HIGH"])]
MEMBERS += [("m", [*Word, "None"], ["YES", "None"]), ("m: int", [*Level], [1, 2]), ("m: str", [*Word], ["y"])]


@pytest.mark.parametrize(("declared", "values", "labels"), few(3, MEMBERS))
def test_members_of_enumerations_of_numbers_and_texts_are_what_they_are(tmp_path, declared, values, labels):
    names = {"Level": Level}
    exec(f"def kind({declared}):\n    return type(m).__name__", names)
    exec(f"def kinds({declared}):\n    return [type(one).__name__ for one in m.tolist()]", names)
    for f in (names["kind"], names["kind"], linksweep.experiment(vectorised=True)(names["kinds"])):
        ds = linksweep.run(f, tmp_path / f.__name__, axes={"m": values}, pool="serial")
        assert ds.m.values.tolist() == labels
        assert ds[f.__name__].values.tolist() == [type(v).__name__ if labels != [1, 2] else "int" for v in values]


@pytest.mark.parametrize("rows", few(2, [f(ROWS) for f in (np.array, pd.DataFrame, xr.DataArray, np.ma.array, Column)]))
def test_rows_of_an_array_are_arrays_as_one_by_one(rows, tmp_path):
    places = ({"axes": {"p": rows}}, {"axes": {"p": {"values": rows}}}, {"points": {"p": rows}})
    for place in (*places, {"points": {"columns": {"p": rows}}}, {"points": Table({"p": rows})}):
        ds = linksweep.run(lambda p: float(np.max(p * 2)), tmp_path / "s.zarr", pool="serial", fresh=True, **place)
        assert ds.result.values.tolist() == [2.0, 6.0], place


def test_what_has_no_label_of_its_own_in_a_store_is_refused_before_it_is_there(tmp_path, sweep):
    def run(axis, *more, annotation=""):
        (tmp_path / "v.py").write_text(f"def score(version{annotation}):\n    return len(str(version))\n")
        return sweep("run", "v.py:score", "--axis", axis, "-o", "s.zarr", *more, cwd=tmp_path)

    assert run("version=1,2")[0] == 0
    wrong = [('"1",2b', "", "have the label '1'"), ("2,3", ": float", "would be"), ("a,b", ": str", "must be")]
    for values, annotation, words in wrong:
        code, _, err = run(f"version={values}", "--accept-code", annotation=annotation)
        assert (code, words in err, "--only" in err) == (2, True, True), err
    assert (run("version=3")[0], linksweep.open(tmp_path / "s.zarr").version.values.tolist()) == (0, [1, 2, 3])
