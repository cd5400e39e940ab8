"""Parameters come from the signature alone; what cannot be swept is refused with what to do instead."""

import functools
import math
from typing import Annotated, Literal

import numpy as np
import pytest
from scipy.signal.windows import kaiser

from linksweep.sweep.contract import Output, Parameter, SweepError
from linksweep.sweep.functions.adapter import experiment, experiment_of


def several(
    beta: Annotated[float, Parameter("contact rate", unit="1/d", above=0)],
    n: int = 1000,
    solver: Literal["RK45", "LSODA"] = "RK45",
    order: Literal[1, 2] = 1,
    damped: bool = False,
    name: str = "x",
    shift: float | None = None,
    factor=0.5,
    anything=None,
    options: dict = {},  # noqa: B006
):
    return beta


def test_name_type_default_unit_meaning_and_bounds():
    found = {parameter.name: parameter for parameter in experiment_of(several).parameters}
    kinds = {name: parameter.kind for name, parameter in found.items()}
    assert kinds == {
        **{"beta": "float", "n": "int", "solver": "str", "order": "int", "damped": "bool", "name": "str"},
        **{"shift": "float", "factor": "float", "anything": "any"},
    }  # options stays at its default
    beta = found["beta"]
    assert (beta.required, beta.meaning, beta.unit, beta.above) == (True, "contact rate", "1/d", 0)
    assert found["solver"].choices == ("RK45", "LSODA")
    assert found["n"].default == 1000
    assert found["order"].parse(2) == 2
    for name, wrong in (("order", 3), ("order", True), ("solver", "RK"), ("beta", 0.0), ("n", 0.5), ("n", 2**63)):
        with pytest.raises(ValueError, match=f"{name} = .*must be"):
            found[name].parse(wrong)
    assert found["n"].parse(2**53 + 1) == 2**53 + 1


class Thing:
    def method(self, x: float):
        return x

    def __call__(self, x: float = 1.0):
        return x


async def waiting(x: float):
    return x


def yielding(x: float):
    yield x


REFUSED = {
    "positional-only": (math.sin, "x is positional-only"),
    "any arguments": (lambda *args: 1, r"\*args is variadic"),
    "any names": (lambda **options: 1, r"\*\*options is variadic"),
    "a ufunc": (np.hypot, "is a class, a NumPy ufunc"),
    "a builtin without a signature": (max, "its signature|is variadic"),
    "a class": (Thing, "is a class"),
    "a method of a class": (Thing.method, "is a method and takes self"),
    "async": (waiting, "async"),
    "a generator": (yielding, "a generator"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_swept_is_refused(what):
    function, sentence = REFUSED[what]
    with pytest.raises(SweepError, match=sentence):
        experiment_of(function)


def test_a_type_that_is_none_is_refused_by_name():
    def wrong(x: list, y: complex, status: float = 1.0):
        return 1.0

    with pytest.raises(SweepError) as caught:
        experiment_of(wrong)
    text = str(caught.value)
    assert "parameter x: the type list is none of float, int, bool, str or Literal" in text
    assert "parameter y: the type complex" in text


def test_an_argument_that_cannot_be_a_parameter_is_told_so_where_it_is_asked_for():
    made = experiment_of(several)
    with pytest.raises(
        ValueError, match=r"^is in several of a type that is none of float, .*: it stays at its default$"
    ):
        made.parameter("options")
    with pytest.raises(ValueError, match="unknown parameter 'optons'"):
        made.parameter("optons")


def test_what_belongs_to_the_sampling_is_told_so():
    def drawn(x: float, *, rng):
        return rng.normal(x)

    with pytest.raises(ValueError, match=r"^belongs to the sampling: sampling=\{'n_sim': \.\.\.\}"):
        experiment_of(drawn).parameter("n_sim")
    with pytest.raises(ValueError, match="unknown parameter 'n_sim'"):
        experiment_of(several).parameter("n_sim")


def test_methods_of_objects_partials_and_callable_objects_are_functions():
    assert [p.name for p in experiment_of(Thing().method).parameters] == ["x"]
    assert [p.name for p in experiment_of(Thing()).parameters] == ["x"]
    part = functools.partial(several, beta=0.2)
    found = {p.name: p for p in experiment_of(part).parameters}
    assert found["beta"].default == 0.2
    assert experiment_of(part).name == "several"


def test_all_mistakes_of_a_declaration_are_told_at_once():
    outputs = [
        Output("speed", unit="furlong/fortnight"),
        Output("x"),
        Output("a b"),
        Output("status"),
        Output("curve", dims=("time", "x"), coords={"tme": [1.0]}),
        Output("twice"),
        Output("twice", statistics=["men"]),
        Output("bad", dims="k", coords={"k": [1.0, np.nan]}),
    ]
    with pytest.raises(SweepError) as caught:
        experiment(outputs=outputs, packages="no", vectorised=False)(lambda x=1.0, code=2: x)
    text = str(caught.value)
    for sentence in (
        "parameter 'code': the platform gives this name",
        "output 'speed': the unit 'furlong/fortnight' is none",
        "the output 'x' has the name of a parameter",
        "the output 'a b': a name begins with a letter",
        "the output 'status': the platform gives this name",
        "the dimension 'x' has the name of a parameter",
        "output 'curve': coords: 'tme' is none of its dimensions (time, x)",
        "output 'twice': is declared twice",
        "statistics are made of realisations, and the function takes no rng",
        "there is no statistic 'men'; did you mean 'mean'?",
        "output 'bad': has a coordinate 'k' that has values that are not finite",
    ):
        assert sentence in text


def test_a_decorated_function_stays_what_it_is():
    @experiment(outputs=["y"])
    def double(x: float = 1.0):
        return {"y": 2.0 * x}

    assert double(3.0) == {"y": 6.0}


def test_what_other_code_imports_stays_as_it_is_when_it_is_declared():
    declared = experiment(outputs=[Output("window", unit="m")])(kaiser)
    assert not hasattr(kaiser, "__linksweep__")
    assert experiment_of(declared).declaration.outputs[0].unit == "m"
    assert [parameter.name for parameter in experiment_of(declared).parameters][:2] == ["M", "beta"]
    assert np.array_equal(declared(5, 2.0), kaiser(5, 2.0))
