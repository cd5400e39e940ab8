"""What a plain function takes and declares: parameters from its signature, and `linksweep.experiment`."""

import functools
import inspect
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import Annotated, Any, Literal, TypeVar, Union, cast, get_args, get_origin

import numpy as np

from linksweep.sweep.contract import Output, Parameter, ResultError, SweepError, shown
from linksweep.sweep.contract.declaration import RESERVED, TAKEN, name_problem, packages_problems, parameter_problems
from linksweep.sweep.contract.parameter import Kind
from linksweep.sweep.contract.units import unit_problem
from linksweep.sweep.functions.results import coordinate_of
from linksweep.sweep.functions.statistics import statistic_problem

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


ATTRIBUTE = "__linksweep__"
"""The attribute of a function that holds its declaration."""

ROUNDING = 1e-12
"""Relative difference of two results of the same point that differ by rounding only."""

AnyFunction = TypeVar("AnyFunction", bound=Callable[..., Any])


@dataclass(frozen=True)
class Declaration:
    """What a plain function declares: outputs, whether it takes arrays of points, packages whose versions count, and
    whether two calls at a point return the same.
    """

    outputs: tuple[Output, ...] = ()
    vectorised: bool = False
    packages: tuple[str, ...] = ()
    citation: tuple[str, ...] = ()
    tolerance: float = ROUNDING
    reads: tuple[str, ...] = ()
    deterministic: bool = True


def experiment(
    *,
    outputs: Sequence[Output | str] = (),
    vectorised: bool = False,
    packages: Sequence[str] = (),
    citation: str | Sequence[str] = (),
    tolerance: float = ROUNDING,
    reads: str | Sequence[str] = (),
    deterministic: bool = True,
) -> Callable[[AnyFunction], AnyFunction]:
    """Declare more about a function than its signature says.  The function can be called as before.

    Args:
        outputs: units, meanings, dimensions and coordinates of results, and which statistics are computed from them if
            the function takes ``rng``.  Results that are not declared are kept too.
        vectorised: whether the function takes an array of each parameter, all of one length, and returns arrays of that
            length; it is then called for many points at once.
        packages: distributions whose versions determine the results; a store is not continued with another version.
        citation: what users of the results should cite, for reports.
        tolerance: how far the results of a vectorised function for one point alone and among others may differ,
            relative to them; by default only by rounding.
        reads: data files, relative to the file of the function, whose content counts as code does.
        deterministic: whether a function without ``rng`` returns the same whenever it is called at a point, which is
            tried at the first one; False accepts any result.

    Returns:
        A decorator that returns the function.  If that is already defined, for example in another package, it returns
        a new function that calls it.

    Raises:
        SweepError: with everything that is wrong in the declaration and in the signature.

    Example:
        >>> import numpy as np
        >>> @experiment(outputs=[Output("range", unit="m")])
        ... def throw(speed: float = 10.0, angle: float = 45.0):
        ...     return {"range": speed**2 * np.sin(2.0 * np.radians(angle)) / 9.81}
        >>> round(float(throw()["range"]), 2)
        10.19
    """

    def declare(function: AnyFunction) -> AnyFunction:
        given = [_output(one) for one in _sequence(outputs)]
        named = _sequence(packages), _sequence(citation)
        declaration = Declaration(tuple(given), vectorised, *named, tolerance, _sequence(reads), deterministic)
        if found := problems(function, declaration):
            name = getattr(function, "__name__", type(function).__name__)
            raise SweepError(found, f"function {name}")
        declared = _one_to_declare(function)
        setattr(declared, ATTRIBUTE, declaration)
        return declared

    return declare


def _one_to_declare(function: AnyFunction) -> AnyFunction:
    """Return a function that is being defined; for a function that is already defined, return a new one that calls it:
    other code must import it unchanged, and workers would import it without the declaration.
    """
    module = sys.modules.get(getattr(function, "__module__", None) or "")
    if getattr(module, getattr(function, "__qualname__", ""), None) is not function:
        return function

    @wraps(function)
    def declared(*arguments: Any, **named: Any) -> Any:
        return function(*arguments, **named)

    return cast(AnyFunction, declared)


def _sequence(given: Any) -> tuple[Any, ...]:
    return (given,) if isinstance(given, str | Output) else tuple(given)


def _output(given: Any) -> Any:
    """Return an output, made from a name if need be, with tuples of dimensions and statistics."""
    output = Output(given) if isinstance(given, str) else given
    if not isinstance(output, Output):
        return output
    return replace(output, dims=_sequence(output.dims), statistics=_sequence(output.statistics))


def declaration_of(function: Callable[..., Any]) -> Declaration:
    """Return what a function declares, nothing by default."""
    while not hasattr(function, ATTRIBUTE) and hasattr(function, "func"):  # a partial
        function = function.func
    found = getattr(function, ATTRIBUTE, None)
    return found if isinstance(found, Declaration) else Declaration()


def problems(function: Callable[..., Any], declaration: Declaration) -> list[str]:
    """Return a sentence for each mistake in a function's signature and declaration."""
    found: list[str] = []
    try:
        signature = signature_of(function)
    except SweepError as error:
        found += error.problems
        signature = Signature("", ())
    names = [parameter.name for parameter in signature.parameters]
    for parameter in signature.parameters:
        texts = [*([TAKEN] if parameter.name in RESERVED else []), *parameter_problems(parameter)]
        found += [f"parameter {parameter.name!r}: {text}" for text in texts]
    known: set[str] = set()
    for output in declaration.outputs:
        if not isinstance(output, Output):
            found.append(f"outputs: {shown(output)} is no Output")
            continue
        found += [f"output {shown(output.name)}: {text}" for text in _problems_of_output(output, signature, names)]
        if output.name in known:
            found.append(f"output {output.name!r}: is declared twice")
        known.add(output.name)
    found += _problems_of_coordinates([o for o in declaration.outputs if isinstance(o, Output)], names)
    found += packages_problems(declaration.packages)
    tolerance = declaration.tolerance
    if type(tolerance) not in (int, float) or not 0.0 <= tolerance < 1.0:
        found.append(f"tolerance = {shown(tolerance)}: must be a number from 0 to below 1")
    elif tolerance != ROUNDING and not declaration.vectorised:
        found.append(
            f"tolerance = {shown(tolerance)}: is for vectorised functions; declare vectorised=True or leave it out"
        )
    if not isinstance(declaration.deterministic, bool):
        found.append(f"deterministic = {shown(declaration.deterministic)}: must be True or False")
    if declaration.vectorised and signature.rng:
        found.append(
            "vectorised: a function of rng is called for one point; take n_sim to get all realisations of it at once"
        )
    return found


def _problems_of_output(output: Output, signature: Signature, parameters: Sequence[str]) -> Iterator[str]:
    if wrong := name_problem(output.name):
        yield wrong
    elif output.name in parameters:
        yield "is the name of a parameter too"
    if wrong_unit := unit_problem(output.unit):
        yield wrong_unit
    dims = output.dims
    if not all(isinstance(dim, str) for dim in dims) or len(set(dims)) < len(dims):
        yield f"dims = {shown(output.dims)}: must be different names"
        return
    for dim in dims:
        if name_problem(dim):
            yield f"{shown(dim)} is not allowed as the name of a dimension"
    for dim in output.coords or {}:
        if dim not in dims:
            yield f"coords: {shown(dim)} is none of its dimensions ({', '.join(dims) or 'it has none'})"
    if output.statistics and not signature.rng:
        yield "statistics are made of realisations, and the function takes no rng"
    for name in output.statistics:
        if text := statistic_problem(name):
            yield text


def _problems_of_coordinates(outputs: Sequence[Output], parameters: Sequence[str]) -> Iterator[str]:
    known: dict[str, Any] = {}
    for output in outputs:
        for dim, given in (output.coords or {}).items():
            try:
                coordinate = coordinate_of(dim, given)
            except ResultError as error:
                text = str(error)
                yield f"output {output.name!r}: " + (text if "coordinate" in text else f"the coordinate {dim!r} {text}")
                continue
            if known.setdefault(dim, coordinate) != coordinate:
                yield f"output {output.name!r}: the coordinate {dim!r} has other values than in another output"
            if coordinate.unit and (wrong := unit_problem(coordinate.unit)):
                yield f"output {output.name!r}: the coordinate {dim!r}: {wrong}"
        for dim in output.dims:
            if dim in parameters:
                yield f"output {output.name!r}: the dimension {dim!r} is the name of a parameter too"
            if dim in [other.name for other in outputs]:
                yield f"output {output.name!r}: the dimension {dim!r} is the name of an output too"
