"""Parameters of an experiment from the signature of a plain function."""

import functools
import inspect
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np

from linksweep.sweep.contract import Parameter, SweepError, shown
from linksweep.sweep.contract.parameter import Kind

RNG, N_SIM = "rng", "n_sim"
"""Arguments that the platform gives: a NumPy generator, and how many realisations are wanted at once."""

KINDS: dict[Any, Kind] = {float: "float", int: "int", bool: "bool", str: "str", Any: "any"}
NUMPY_KINDS: dict[type, Kind] = {np.bool_: "bool", np.integer: "int", np.floating: "float", np.str_: "str"}
ALLOWED = "float, int, bool, str or Literal[...]"


@dataclass(frozen=True)
class Signature:
    """What a plain function takes: parameters, and whether it wants a generator or a number of realisations.

    ``others`` are the arguments that cannot be parameters and stay at their defaults, with their types in words.
    """

    name: str
    parameters: tuple[Parameter, ...]
    rng: bool = False
    n_sim: bool = False
    others: tuple[tuple[str, str], ...] = ()


def name_of(function: Callable[..., Any]) -> str:
    """Return the name of a function, of the function in a partial, or of the class of another callable."""
    function = _wrapped(function)
    name = getattr(function, "__name__", type(function).__name__)
    return "function" if name == "<lambda>" else name


def _wrapped(function: Callable[..., Any]) -> Any:
    while isinstance(function, functools.partial):
        function = function.func
    return function


def signature_of(function: Callable[..., Any]) -> Signature:
    """Return what a plain function takes; raises SweepError with every reason why it cannot be swept."""
    name = name_of(function)
    problems = list(_refusals(function))
    found: Mapping[str, inspect.Parameter] = {}
    try:
        found = {} if problems else inspect.signature(function, eval_str=True).parameters
    except NameError as error:
        problems.append(f"an annotation cannot be read: {error}")
    except (ValueError, TypeError):
        problems.append(f"Python cannot read its signature; wrap it: def my_{name}(x: float): return {name}(x)")
    if (first := next(iter(found), "")) in ("self", "cls") and "." in getattr(function, "__qualname__", ""):
        problems.append(f"is a method and takes {first}; give the method of an object, thing.{name}")
        found = {}
    rng = RNG in found
    parameters = []
    others = []
    for argument in found.values():
        if argument.name == RNG or (rng and argument.name == N_SIM):
            if argument.kind is argument.POSITIONAL_ONLY:
                problems.append(f"{argument.name} is positional-only; parameters are given by name")
            continue
        try:
            if (parameter := _parameter(argument)) is not None:
                parameters.append(parameter)
            else:
                others.append((argument.name, _type_in_words(argument)))
        except ValueError as error:
            problems.append(str(error))
    if problems:
        raise SweepError(problems, f"function {name}")
    return Signature(name, tuple(parameters), rng, rng and N_SIM in found, tuple(others))


def _refusals(function: Callable[..., Any]) -> Iterator[str]:
    whole = _wrapped(function)
    call = whole if inspect.isroutine(whole) else getattr(whole, "__call__", whole)  # noqa: B004
    if isinstance(whole, type):
        yield "is a class, not a function; wrap it in a function that returns results"
    elif isinstance(whole, np.ufunc):
        arguments = ", ".join(f"x{i}: float" for i in range(1, whole.nin + 1))
        names = ", ".join(f"x{i}" for i in range(1, whole.nin + 1))
        yield (
            "is a NumPy ufunc, whose arguments have no names; wrap it: "
            f"def {whole.__name__}({arguments}): return numpy.{whole.__name__}({names})"
        )
    elif inspect.iscoroutinefunction(call) or inspect.isasyncgenfunction(call):
        yield "is async; give a function that returns its results"
    elif inspect.isgeneratorfunction(call):
        yield "is a generator (it yields); give a function that returns its results"


def _parameter(argument: inspect.Parameter) -> Parameter | None:
    """Return the parameter of one argument, None for one that always stays at its default; raises ValueError."""
    name = argument.name
    if argument.kind in (argument.VAR_POSITIONAL, argument.VAR_KEYWORD):
        stars = "*" if argument.kind is argument.VAR_POSITIONAL else "**"
        raise ValueError(f"takes {stars}{name}; parameters need names: wrap it in a function that spells them out")
    if argument.kind is argument.POSITIONAL_ONLY:
        raise ValueError(f"{name} is positional-only; parameters are given by name: wrap it in a function")
    required = argument.default is argument.empty
    default = None if required else argument.default
    if isinstance(default, np.generic):
        default = default.item()
    told = Parameter(name)
    annotation = argument.annotation
    if get_origin(annotation) is Annotated:
        annotation, *notes = get_args(annotation)
        told = next((note for note in notes if isinstance(note, Parameter)), told)
    if annotation is argument.empty:
        kind: Kind | None = "any" if default is None else KINDS.get(type(default))
        choices: tuple[Any, ...] = ()
    else:
        kind, choices = _kind(annotation)
    if kind is None and required:
        raise ValueError(f"parameter {name}: the type {_words(annotation)} is none of {ALLOWED}")
    if kind is None or (default is not None and KINDS.get(type(default)) is None):
        return None
    if kind == "float" and type(default) is int:
        default = float(default)
    meaning = told.meaning or (told.name if told.name != name else "") or name.replace("_", " ")
    choices = choices or told.choices
    return replace(told, name=name, kind=kind, default=default, meaning=meaning, choices=choices, required=required)


def _type_in_words(argument: inspect.Parameter) -> str:
    told = argument.annotation
    if told is argument.empty:
        return type(argument.default).__name__
    return _words(get_args(told)[0] if get_origin(told) is Annotated else told)


def _kind(annotation: Any) -> tuple[Kind | None, tuple[Any, ...]]:
    """Return the kind of parameter that an annotation means, None for none, and its choices."""
    origin = get_origin(annotation)
    if origin is Literal:
        choices = get_args(annotation)
        kinds = {KINDS.get(type(choice)) for choice in choices}
        return (kinds.pop(), choices) if len(kinds) == 1 else ("any", choices) if None not in kinds else (None, ())
    if origin in (Union, types.UnionType):
        parts = [part for part in get_args(annotation) if part is not type(None)]
        found = [_kind(part) for part in parts]
        if len(found) == 1:
            return found[0]
        kinds = {kind for kind, _ in found}
        if kinds == {"int", "float"}:
            return "float", ()
        return (None if None in kinds else "any"), tuple(choice for _, some in found for choice in some)
    known = [kind for one, kind in KINDS.items() if annotation is one]
    if isinstance(annotation, type):
        known += [kind for base, kind in NUMPY_KINDS.items() if issubclass(annotation, base)]
    return (known[0] if known else None), ()


def _words(annotation: Any) -> str:
    return annotation.__name__ if isinstance(annotation, type) else shown(annotation)
