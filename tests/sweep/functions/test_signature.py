"""Parameters come from the signature, the title from the docstring; what cannot be swept is refused with what to do."""

import asyncio
import functools
import math
import numbers
from collections.abc import Hashable
from dataclasses import replace
from typing import Annotated, AnyStr, Final, Literal, NewType, SupportsFloat, TypeVar

import numpy as np
import pytest
from astropy.table import Column
from scipy.signal.windows import kaiser
from typing_extensions import TypeAliasType

import linksweep
from linksweep import Output, Parameter, SweepError, experiment, load_study, run
from tests.tiers import few

TITLES = [*(("A cup of coffee that cools.", "Coffee", "Coffee"), ("In $x_$.", None, "In $x_$"), (None, None, "f"))]
TITLES += [("A cup of coffee that cools.\n\n    The room has 20 degrees.\n", None, "A cup of coffee that cools")]
TITLES += [("A cup of coffee\n    that cools.\n    The room has 20 degrees.", None, "A cup of coffee that cools")]
TITLES += [("A cup, e.g. of coffee, that cools. The room has 20 degrees.", None, "A cup, e.g. of coffee, that cools")]
RAGGED = Output("a", ragged=True)
WRONG = [  # what is declared of which function, and what is said of it
    ({"shared": "gian"}, lambda rng, gain: gain, "shared: 'gian' is no parameter; did you mean 'gain'?"),
    ({"shared": ["gain"]}, lambda gain: gain, "shared: it takes no rng, and so it draws no random numbers"),
    ({"deterministic": "no"}, lambda x: x, "deterministic = 'no': must be True or False"),
    ({"outputs": [Output("a", dims="s", ragged="t")]}, lambda x: [x], "'t': must be True, or one of its dims (s)"),
    ({"outputs": [replace(RAGGED, dims=("s", "t"))]}, lambda x: [x], "ragged = True: say along which of"),
    ({"outputs": [replace(RAGGED, dims="s", coords={"s": [1, 2]})]}, lambda x: [x], "return its coordinate as another"),
    ({"outputs": [RAGGED]}, lambda x, rng: [x], "ragged: statistics of realisations need one length"),
    ({"outputs": [Output("a", meaning=3)]}, lambda x: x, "output 'a': meaning = 3: must be a string"),
]
Mass = TypeAliasType("Mass", NewType("Mass", float))
REAL, CHOICE = TypeVar("REAL", bound=float), Literal[2.0, "a", None]
NUMBERS = [object, numbers.Real, numbers.Rational, Mass, Mass | int, "Mass", "'float'", REAL, AnyStr, Final[Mass]]
NUMBERS += [SupportsFloat, Hashable, complex, np.number, CHOICE]


def several(
    beta: Annotated[float, Parameter("contact rate", unit="1/d", above=0)],
    n: int = 1000,
    solver: Literal["RK45", "LSODA"] = "RK45",
    order: Literal[1, 2] = 1,
    damped: bool = False,
    name: str = "x",
    shift: Annotated[float, Parameter("shift", unit="m")] | None = None,
    factor=0.5,
    n_sim: float = 1,
    anything=None,
    options: dict = {},  # noqa: B006
):
    return beta


def test_name_type_default_unit_meaning_and_bounds():
    study = load_study(f"{__file__}:several", axes=["beta=1,2"])
    parameters = {parameter.name: parameter for parameter in study.experiment.parameters}
    assert {name: parameter.kind for name, parameter in parameters.items()} == {
        **{"beta": "float", "n": "int", "solver": "str", "order": "int", "damped": "bool", "name": "str"},
        **{"shift": "float", "factor": "float", "n_sim": "float", "anything": "any", "options": "object"},
    }
    beta = parameters["beta"]
    assert (beta.required, beta.meaning, beta.unit, beta.above) == (True, "contact rate", "1/d", 0)
    assert repr(parameters["n_sim"].default) == "1.0"  # else points at 1 and at 1.0 would be two
    solver, shift = parameters["solver"], parameters["shift"]
    assert (solver.choices, parameters["n"].default, shift.unit) == (("RK45", "LSODA"), 1000, "m")
    assert load_study(f"{__file__}:several", ["n=1000"], ["beta=1,2"]).digest() == study.digest()  # as by default
    study = load_study(f"{__file__}:several", ["order=2", f"n={2**53 + 1}", "shift=0.5", "factor=2"], ["beta=1"])
    assert dict(study.fixed) == {"order": 2, "n": 2**53 + 1, "shift": 0.5, "factor": 2.0}
    for name, wrong in (("order", "3"), ("order", "true"), ("solver", "RK"), ("n", "0.5"), ("n", 2**63), ("beta", "0")):
        with pytest.raises(SweepError, match=f"{name} = .*must be"):
            load_study(f"{__file__}:several", [f"{name}={wrong}"], [] if name == "beta" else ["beta=1"])


@pytest.mark.parametrize("annotation", few(6, NUMBERS[::-2] + NUMBERS[-2::-2]), ids=str)
def test_what_may_be_a_number_can_be_one(annotation, tmp_path):
    def double(x=2.0 if annotation == CHOICE else 2):
        return -1.0 if x is None else 2 * x

    double.__annotations__["x"] = annotation
    axes = {"x": [2.0, None] if annotation in (object, CHOICE) else [2.0]}
    for how in ({"axes": axes}, {}):
        ds = run(double, tmp_path / "s.zarr", pool="serial", fresh=True, **how)
        assert (ds.double.values.flat[0], (ds.status == 1).all()) == (4.0, True)
        assert how == {} or ds.double.dtype.kind in "fc"  # a value that equals the default arrives as it is written


class Thing:
    def method(self, x: float):
        return x

    __call__ = method


def odd(x: list, y: complex):
    return 1.0


def measured(x: "number of stars" = 1):  # noqa: F722
    return x


METHOD = Thing().method
REFUSED = [
    (measured, "function measured: parameter 'x': its annotation 'number of stars' cannot be read: invalid syntax"),
    *((math.sin, "x is positional-only"), (lambda *args: 1, r"\*args is variadic"), (max, "its signature|is variadic")),
    *((lambda **options: 1, r"\*\*options is variadic"), (np.hypot, "a NumPy ufunc.*wrap it in a function")),
    *((Thing, "is a class"), (Thing.method, "is a method and takes self"), (asyncio.sleep, "async")),
    *((lambda x: (yield x), "a generator"), (functools.singledispatch(abs), "a singledispatch")),
    (odd, r"(?s)axes.x: x = 1.0: must be an object that is no number.*T12:30:00.*y has no default"),
]


@pytest.mark.parametrize(("function", "sentence"), REFUSED)
def test_what_cannot_be_swept_is_refused(function, sentence, tmp_path):
    with pytest.raises(SweepError, match=sentence):
        run(function, tmp_path / "s.zarr", axes={"x": [1.0]})
    assert not (tmp_path / "s.zarr").exists()


@pytest.mark.parametrize("function", [METHOD, experiment()(METHOD), Thing(), functools.partial(lambda y, x: x * y, 1)])
def test_methods_of_objects_partials_and_callable_objects_are_functions(function, tmp_path):
    ds = run(function, tmp_path / "s.zarr", axes={"x": [1.0, 2.0]}, pool="serial")
    assert [ds[name].values.tolist() for name in ds if name not in ("status", "wall_time")] == [[1.0, 2.0]]


@pytest.mark.parametrize(("declared", "function", "problem"), WRONG)
def test_a_declaration_that_means_nothing_is_refused_by_name(declared, function, problem):
    with pytest.raises(SweepError) as refused:
        experiment(**declared)(function)
    assert problem in str(refused.value)


def test_all_mistakes_of_a_declaration_are_told_at_once():
    hours = {"q": (Column([1.0], unit="h"), "d")}
    mistakes = [  # outputs, and what is said of each
        (Output("speed", unit="furlong/fortnight"), "output 'speed': the unit 'furlong/fortnight' is none"),
        (Output("x"), "output 'x': is the name of another parameter"),
        (Output("a b"), "output 'a b': a name begins with a letter"),
        (Output("status"), "output 'status': the platform gives this name"),
        (Output("curve", dims=("time", "x")), "dimension 'x': is the name of another parameter"),
        (Output("t", dims="time", coords={"tme": [1.0]}), "output 't': coords: 'tme' is none of its dimensions (time)"),
        (Output("m"), "output 'm': is the name of another output"),
        (Output("m", statistics=["men"]), "there is no statistic 'men'; did you mean 'mean'?"),
        (Output("m2", statistics=["mean"]), "statistics are made of realisations, and the function takes no rng"),
        (Output("bad", dims="k", coords={"k": [1.0, np.nan]}), "'bad': has a coordinate 'k' that has values that are"),
        (Output("h", dims="q", coords=hours), "a coordinate 'q' that is in h, expected d"),
    ]
    outputs, sentences = zip(*mistakes, strict=True)
    with pytest.raises(SweepError) as caught:
        experiment(outputs=outputs, packages="no", vectorised=False)(lambda x=1.0, code=2: x)
    for sentence in (*sentences, "parameter 'code': the platform gives this name"):
        assert sentence in str(caught.value)


def test_a_declared_function_is_called_as_before_and_that_of_other_code_stays_as_it_is(tmp_path):
    @experiment(outputs=[Output("y", errors=("s",)), "s"])
    def double(x: float = 1.0):
        return {"y": 2.0 * x, "s": 0.1}

    assert double(3.0) == {"y": 6.0, "s": 0.1}
    assert run(double, tmp_path / "d.zarr", axes={"x": [1.0]}, pool="serial").y.errors == "s"
    declared = experiment(outputs=[Output("window", unit="m")])(kaiser)
    assert not hasattr(kaiser, "__linksweep__")
    assert np.array_equal(declared(5, 2.0), kaiser(5, 2.0))
    ds = run(declared, tmp_path / "s.zarr", axes={"beta": [2.0]}, fixed={"M": 5}, pool="serial")
    assert (ds.window.units, ds.window.values[0].tolist()) == ("m", kaiser(5, 2.0).tolist())


@pytest.mark.parametrize(("docstring", "title", "shown"), TITLES)
def test_the_title_is_the_first_sentence_of_the_docstring(tmp_path, docstring, title, shown):
    def f(start: float):
        return start

    f.__doc__, store = docstring, tmp_path / "s.zarr"
    dataset = linksweep.run(f, store, axes={"start": [30.0, 50.0]}, title=title, pool="serial")
    assert dataset.attrs["title"] == linksweep.open(store).attrs["title"] == shown
    assert ("20 degrees" in dataset.attrs.get("description", "")) == ("20 degrees" in (docstring or ""))
