"""`linksweep.experiment`: what a plain function declares besides its signature."""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, TypeVar, cast

from linksweep.sweep.contract import Output, ResultError, SweepError, shown
from linksweep.sweep.contract.declaration import RESERVED, TAKEN, name_problem, packages_problems, parameter_problems
from linksweep.sweep.contract.units import unit_problem
from linksweep.sweep.functions.results import coordinate_of
from linksweep.sweep.functions.signature import Signature, signature_of
from linksweep.sweep.functions.statistics import statistic_problem

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
