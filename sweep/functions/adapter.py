"""A plain function as an `Experiment`: parameters from its signature, what `linksweep.experiment` declares beside, and
how its results are computed, so that its studies are run and stored like all others.
"""

import functools
import inspect
import sys
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from typing import Annotated, Any, Final, Literal, TypeVar, Union, cast, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Experiment, Named, Output, Parameter, Point, SweepError, experiment as rules, shown
from linksweep.sweep.contract.experiment import GeneratorPair, Kind
from linksweep.sweep.contract.rows import Array, Outcome, Reducer, Rows
from linksweep.sweep.functions import results
from linksweep.sweep.functions.statistics import Moments, drawn, quantile_of, statistic_problem

# Arguments that the platform gives: a NumPy generator, and how many realisations are wanted at once.
RNG, N_SIM = "rng", "n_sim"

KINDS: dict[Any, Kind] = {float: "float", int: "int", bool: "bool", str: "str", Any: "any"}
NUMPY_KINDS: dict[type, Kind] = {np.bool_: "bool", np.integer: "int", np.floating: "float", np.str_: "str"}

# What an experiment has as its declaration has it.
TAKEN_OVER = ("vectorised", "tolerance", "packages", "citation", "shared")

# The attribute of a function that holds its declaration.
ATTRIBUTE = "__linksweep__"

# Relative difference of two results of the same point that differ by rounding only.
ROUNDING = 1e-12

AnyFunction = TypeVar("AnyFunction", bound=Callable[..., Any])


@dataclass(frozen=True, kw_only=True)
class experiment:  # noqa: N801 (a decorator)
    """Declare more about a function than its signature says.  The function can be called as before.

    Args:
        outputs: units, meanings, dimensions and coordinates of results, and which statistics are computed from them if
            the function takes ``rng``; or only their names, or units by name, ``{"range": "m"}``.  Results that are not
            declared are kept too.
        vectorised: whether the function takes an array of each parameter, all of one length, and returns arrays of that
            length; it is then called for many points at once.
        packages: distributions whose versions determine the results; a store is not continued with another version.
        citation: what users of the results should cite, for reports.
        tolerance: how far the results of a vectorised function for one point alone and among others may differ,
            relative to them; by default only by rounding.
        reads: data files, relative to the file of the function, whose content counts as code does.
        deterministic: whether a function without ``rng`` returns the same whenever it is called at a point, which is
            tried at the first one; False accepts any result.
        shared: parameters that do not change the random numbers: points that differ in these alone get the same
            ``rng``, so that their differences have small errors; the errors of such points are correlated.
        when: the values of other parameters with which one has an effect, ``{"gamma": {"kernel": ["rbf"]}}``, as
            `Parameter` has them.

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

    outputs: Sequence[Output | str] | Mapping[str, str] = ()
    vectorised: bool = False
    packages: Sequence[str] = ()
    citation: str | Sequence[str] = ()
    tolerance: float = ROUNDING
    reads: str | Sequence[str] = ()
    deterministic: bool = True
    shared: str | Sequence[str] = ()
    when: Mapping[str, Mapping[str, Sequence[Any]]] = field(default_factory=dict)

    def __new__(cls, *functions: Any, **declared: Any) -> Any:
        """Return a declaration; of a function, as after ``@experiment`` without brackets, the function itself."""
        return cls()(*functions) if functions else super().__new__(cls)

    def __post_init__(self) -> None:
        if isinstance(self.outputs, Mapping):
            object.__setattr__(self, "outputs", [Output(name, unit=unit) for name, unit in self.outputs.items()])
        for name in ("outputs", "packages", "citation", "reads", "shared"):
            object.__setattr__(self, name, _sequence(getattr(self, name)))
        object.__setattr__(self, "outputs", tuple(map(_output, self.outputs)))

    def __call__(self, function: AnyFunction) -> AnyFunction:
        """Return the function, or a new one that calls it, with this declaration."""
        _checked(function, self)
        module = sys.modules.get(getattr(function, "__module__", None) or "")
        defined = getattr(module, getattr(function, "__qualname__", ""), None) is function
        if defined or inspect.ismethod(function):
            # Other code must import it unchanged, and workers would import it undeclared.  Methods take no attributes.
            function = _calling(function)
        setattr(function, ATTRIBUTE, self)
        return function


def _calling(function: AnyFunction) -> AnyFunction:
    @functools.wraps(function)
    def declared(*arguments: Any, **named: Any) -> Any:
        return function(*arguments, **named)

    return cast(AnyFunction, declared)


def _sequence(one_or_more: Any) -> tuple[Any, ...]:
    return (one_or_more,) if isinstance(one_or_more, str | Output) else tuple(one_or_more)


def _output(declared: Any) -> Any:
    """Return an output, made from a name if need be, with tuples of dimensions and statistics."""
    output = Output(declared) if isinstance(declared, str) else declared
    if not isinstance(output, Output):
        return output
    return replace(output, dims=_sequence(output.dims), statistics=_sequence(output.statistics))


def name_of(function: Callable[..., Any]) -> str:
    """Return the name of a function, of the function in a partial, or of the class of another callable."""
    function = _wrapped(function)
    name = getattr(function, "__name__", type(function).__name__)
    return "function" if name == "<lambda>" else name


def _wrapped(function: Callable[..., Any]) -> Any:
    while isinstance(function, functools.partial):
        function = function.func
    return function


def _read_signature(function: Callable[..., Any], problems: list[str]) -> "FunctionExperiment":
    """Return the experiment of a function that declares nothing; ``problems`` takes every reason why it cannot be."""
    name, whole = name_of(function), _wrapped(function)
    call = whole if inspect.isroutine(whole) else getattr(whole, "__call__", whole)  # noqa: B004
    wrap = "wrap it in a function that takes its parameters by name and returns its results"
    later = inspect.iscoroutinefunction, inspect.isasyncgenfunction, inspect.isgeneratorfunction
    # A function with `dispatch` looks at the type of its first argument, which is to be positional.
    if isinstance(whole, type | np.ufunc) or hasattr(whole, "dispatch") or any(is_one(call) for is_one in later):
        problems.append(f"is a class, a NumPy ufunc, a singledispatch, async or a generator; {wrap}")
    arguments: Mapping[str, inspect.Parameter] = {}
    try:
        arguments = {} if problems else inspect.signature(function).parameters
    except (ValueError, TypeError, NameError):  # the last of annotations, in Python 3.14
        problems.append(f"Python cannot read its signature; {wrap}")
    if (first := next(iter(arguments), "")) in ("self", "cls") and "." in getattr(function, "__qualname__", ""):
        problems.append(f"is a method and takes {first}; give the method of an object, thing.{name}")
        arguments = {}
    parameters, rng, inner = [], RNG in arguments, inspect.unwrap(call)
    names = getattr(inner, "__globals__", {})
    for argument in arguments.values():
        if argument.kind not in (argument.POSITIONAL_OR_KEYWORD, argument.KEYWORD_ONLY):
            problems.append(f"{argument} is {argument.kind.description}, and parameters are given by name; {wrap}")
        elif argument.name != RNG and not (rng and argument.name == N_SIM):
            try:
                parameters.append(_parameter(argument, names))
            except (ValueError, NameError) as error:  # the second of an alias
                problems.append(str(error))
    made = _undeclared(name, tuple(parameters), (), rng)
    return replace(made, call=function, takes_n_sim=rng and N_SIM in arguments)


def _parameter(argument: inspect.Parameter, names: Mapping[str, Any]) -> Parameter:
    """Return the parameter of one argument, of a function of a module with these names; raises ValueError.

    Its default is None where that of the argument is no value that a study can write: then the call leaves it out.
    """
    name, annotation = argument.name, _annotation(argument, names)
    required = argument.default is argument.empty
    default = None if required else argument.default
    if isinstance(default, np.generic):
        default = default.item()
    inside = (note for one in (annotation, *get_args(annotation)) for note in getattr(one, "__metadata__", ()))
    noted = next((note for note in inside if isinstance(note, Parameter)), Parameter(name))
    if get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    kind: Kind | None
    choices: tuple[Any, ...] = ()
    if annotation is argument.empty:
        kind = "any" if default is None else KINDS.get(type(default))
    else:
        kind, choices = _kind(annotation)
    optional = any(one in (None, type(None)) for one in get_args(annotation)) or (default is None and not required)
    optional |= kind == "any" and annotation in (argument.empty, Any, object)
    kind = kind or ("object" if default is None or type(default) not in KINDS else "any")
    if default is not None and type(default) not in KINDS:
        kind, default, optional = "object" if annotation is argument.empty else kind, None, False
    if kind == "float" and type(default) is int:  # the digest of a point with 1 would differ from that with 1.0
        default = float(default)
    beyond = rules.HUGE if kind == "float" or type(default) is float else 2**63
    if isinstance(default, int | float) and not abs(default) < beyond:
        default, optional = None, False
    meaning = noted.meaning or (noted.name if noted.name != name else "") or name.replace("_", " ")
    choices = choices or noted.choices
    made = replace(noted, name=name, kind=kind, meaning=meaning, choices=choices, required=required)
    return replace(made, default=default, optional=optional, finite=False)


def _annotation(argument: inspect.Parameter, names: Mapping[str, Any]) -> Any:
    """Return the annotation of an argument, also one that is written as a text; raises ValueError."""
    annotation = argument.annotation
    try:
        for _ in range(2):  # a text in a text, as `from __future__ import annotations` makes it, or an alias
            annotation = eval(annotation, dict(names)) if isinstance(annotation, str) else annotation
            annotation = getattr(annotation, "__value__", annotation)
    except Exception as error:  # whatever a text is
        text = f"parameter {argument.name!r}: its annotation {shown(annotation)} cannot be read"
        raise ValueError(f"{text}: {error}") from error
    return annotation


def _kind(annotation: Any) -> tuple[Kind | None, tuple[Any, ...]]:
    """Return the kind of parameter that an annotation means, None for none, and its choices."""
    origin, args, choices = get_origin(annotation), get_args(annotation), tuple[Any, ...]()
    kinds: set[Kind | None]
    if origin is Annotated:
        return _kind(args[0])
    if (meant := getattr(annotation, "__supertype__", getattr(annotation, "__value__", None))) is not None:
        return _kind(meant)
    if origin is Literal:
        choices = tuple(one for one in args if one is not None)
        kinds = {KINDS.get(type(choice)) for choice in choices}
    elif args and origin in (Union, types.UnionType, Final):
        parts = [_kind(part) for part in args if part is not type(None)]
        kinds = {kind for kind, _ in parts}  # without None, of which `Parameter.optional` tells
        if kinds == {"int", "float"}:
            return "float", ()
        choices = tuple(choice for _, some in parts for choice in some) if all(some for _, some in parts) else ()
    else:
        kinds = {kind for one, kind in KINDS.items() if annotation is one}
        if isinstance(annotation, type):
            kinds |= {kind for base, kind in NUMPY_KINDS.items() if issubclass(annotation, base)}
            with suppress(TypeError):  # of a protocol that nothing can be compared with
                kinds |= {"any" for one in (int, np.float64, complex) if not kinds and issubclass(one, annotation)}
    if not kinds or kinds == {None}:
        return None, ()
    return (kinds.pop() if len(kinds) == 1 else "any"), choices


def _checked(function: Callable[..., Any], declaration: experiment) -> "FunctionExperiment":
    """Return the experiment of a function; raises SweepError with each mistake in its signature and declaration."""
    problems: list[str] = []
    made, when = _read_signature(function, problems), declaration.when
    if not isinstance(when, Mapping):
        problems.append(f"when = {shown(when)}: must be like {{'gamma': {{'kernel': ['rbf']}}}}")
        when = {}
    names = [parameter.name for parameter in made.parameters]
    problems += rules.named("when", list(when), names, "parameter")
    parameters = tuple(replace(one, when=when.get(one.name, one.when)) for one in made.parameters)
    for parameter in parameters:
        problems += [f"parameter {parameter.name!r}: {text}" for text in rules.parameter_problems(parameter)]
    outputs = [one for one in declaration.outputs if isinstance(one, Output)]
    problems += [f"outputs: {shown(one)} is no Output" for one in declaration.outputs if not isinstance(one, Output)]
    problems += _problems_of_outputs(outputs, made)
    problems += rules.packages_problems(declaration.packages)
    tolerance = declaration.tolerance
    if type(tolerance) not in (int, float) or not 0.0 <= tolerance < 1.0:
        problems.append(f"tolerance = {shown(tolerance)}: must be a number from 0 to below 1")
    elif tolerance != ROUNDING and not declaration.vectorised:
        problems.append(f"tolerance = {shown(tolerance)}: is for vectorised functions; declare vectorised=True")
    if not isinstance(declaration.deterministic, bool):
        problems.append(f"deterministic = {shown(declaration.deterministic)}: must be True or False")
    problems += rules.named("shared", declaration.shared, names, "parameter")
    if declaration.shared and not made.rng:
        problems.append("shared: it takes no rng, and so it draws no random numbers")
    if declaration.vectorised and made.rng:
        problems.append("vectorised: a function of rng is called for one point; take n_sim to get all realisations")
    if declaration.vectorised and any(output.ragged for output in outputs):
        problems.append("vectorised: an array over points holds no arrays of different length; leave out ragged")
    if problems:
        raise SweepError(problems, f"function {made.name}")
    return replace(
        made,
        parameters=parameters,
        declared=tuple(outputs),
        repeatable=declaration.deterministic and not made.rng,
        **{name: getattr(declaration, name) for name in TAKEN_OVER},
    )


def _problems_of_outputs(outputs: Sequence[Output], made: "FunctionExperiment") -> Iterator[str]:
    coordinates: dict[str, results.Coordinate] = {}
    for output in outputs:
        dims, coords = output.dims, output.coords or {}
        texts = [rules.setting_problem(output), *map(statistic_problem, output.statistics)]
        if output.statistics and not made.rng:
            texts.append("statistics are made of realisations, and the function takes no rng")
        if output.ragged and made.rng:
            texts.append("ragged: statistics of realisations need one length at all points")
        elif output.ragged is True and len(dims) > 1:
            texts.append(f"ragged = True: say along which of its dimensions, such as ragged={dims[-1]!r}")
        elif output.ragged not in (False, True, *dims):
            texts.append(f"ragged = {shown(output.ragged)}: must be True, or one of its dims ({', '.join(dims)})")
        elif output.ragged in coords or (output.ragged is True and coords):
            texts.append("ragged: values along such a dimension are numbered; return its coordinate as another output")
        if not all(isinstance(dim, str) for dim in dims) or len(set(dims)) < len(dims):
            texts.append(f"dims = {shown(dims)}: must be different names")
        for dim, values in coords.items():
            if dim not in dims:
                texts.append(f"coords: {shown(dim)} is none of its dimensions ({', '.join(dims) or 'it has none'})")
            try:
                coordinate = results.coordinate_of(dim, values)
            except rules.ResultError as error:
                texts.append(str(error))
                continue
            texts.append(rules.unit_problem(coordinate.unit))
            if coordinates.setdefault(dim, coordinate) != coordinate:
                texts.append(f"the coordinate {dim!r} has other values than in another output")
        yield from (f"output {shown(output.name)}: {text}" for text in texts if text)
    dimensions = dict.fromkeys(dim for output in outputs for dim in output.dims)
    names = [*(("output", output.name) for output in outputs), *(("dimension", dim) for dim in dimensions)]
    yield from rules.names_problems([parameter.name for parameter in made.parameters], names)


@dataclass(frozen=True)
class Typed(Reducer):
    """The reducer of results that are there after one call: a row has each of them as itself."""

    layout: results.Layout

    @property
    def dtype(self) -> np.dtype[np.void]:
        """The type of a row; without fields before there is a first result."""
        return self.layout.dtype

    def finish(self, total: Rows, n: Array, n_cat: Array) -> dict[str, NDArray[Any]]:
        """Return the results."""
        return {field.name: total[field.name] for field in self.layout.fields}


@dataclass(frozen=True)
class FunctionExperiment(Experiment):
    """A plain function as an experiment.

    ``declared`` are its outputs as it declares them; ``layout`` describes its results.  ``rng``
    says whether it takes a generator; without one it is evaluated once at each point.  ``keeps_all`` says whether all
    realisations are kept.  An experiment that is made from the record in a store has no function to ``call`` and
    computes nothing.
    """

    call: Callable[..., Any] | None = None
    declared: tuple[Output, ...] = ()
    rng: bool = False
    vectorised: bool = False
    tolerance: float = ROUNDING
    repeatable: bool = False
    takes_n_sim: bool = False
    layout: results.Layout = results.UNKNOWN
    keeps_all: bool = False

    def __post_init__(self) -> None:
        """Do nothing: `experiment_of` checks the declaration."""

    @property
    def deterministic(self) -> bool:
        """Whether a point is evaluated once, without random numbers."""
        return not self.rng

    @functools.cached_property
    def expected(self) -> results.Declared:
        """What results are checked against."""
        names = tuple(parameter.name for parameter in self.parameters)
        outputs = self.declared
        single = outputs[0].name if len(outputs) == 1 else "result" if self.name in ("function", *names) else self.name
        return results.Declared(self.name, single, outputs, names, self.rng)

    def with_layout(self, layout: results.Layout | None) -> "FunctionExperiment":
        """Return the experiment with the layout of its results, if that is known."""
        if layout is None:
            return self
        moments = Moments(layout, self.declared, self.keeps_all)
        return replace(
            self,
            layout=layout,
            outputs=moments.outputs() if self.rng else _outputs(layout, self.declared),
            sample_outputs=moments.sample_outputs(),
            coordinates={coordinate.name: coordinate.labels for coordinate in layout.coordinates},
        )

    @functools.cached_property
    def reducer(self) -> Reducer:
        """What a call, or a block of realisations, leaves of a point."""
        if self.rng and self.layout.fields:
            return Moments(self.layout, self.declared, self.keeps_all)
        return Typed(self.layout)

    def compute(
        self, points: Sequence[Point], n_sim: int, pairs: Iterable[GeneratorPair], keep_samples: bool = False
    ) -> list[Outcome]:
        """Return the result of each point: of one call, or of ``n_sim`` realisations with the next generator.

        Raises rules.ResultError for an invalid result, and whatever the function raises.
        """
        call, expected = self.call, self.expected
        # nothing where an argument has a default, and objects, of which None may be one, in place of labels
        optional = {one.name for one in self.parameters if one.optional or one.required}
        points = [
            {k: v.value if isinstance(v, Named) else v for k, v in point.items() if v is not None or k in optional}
            for point in points
        ]
        assert call is not None, "the record of an experiment computes nothing"
        if self.vectorised:  # the caller sends many points only to such functions
            arguments = inspect.signature(call).parameters  # points at a default may be beside others
            columns = {n: _column([p.get(n, arguments[n].default) for p in points]) for n in set[str]().union(*points)}
            return results.split_points(call(**columns), len(points), expected, "points")
        if not self.rng:
            return [results.flatten(call(**point), expected) for point in points]
        rng, outcomes = next(iter(pairs))[0], []  # a function has no outer draw, so the second one is not used
        for point in points:
            if self.takes_n_sim:
                together = call(**point, rng=rng, n_sim=n_sim)
                realised = results.split_points(together, n_sim, expected, "realisations")
            else:
                realised = [results.flatten(call(**point, rng=rng), expected) for _ in range(n_sim)]
            outcomes.append(drawn(realised, self.name, self.declared, keep_samples))
        return outcomes

    def learned(self, outcomes: Mapping[int, Outcome]) -> "tuple[FunctionExperiment, dict[int, Any], dict[int, str]]":
        """Return the experiment with the layout that the first result has, with floats where any result has; the fields
        of rows of it; and why other results are refused.
        """
        layout, fitting, refused = self.layout, list[int](), dict[int, str]()
        verdicts: dict[int, str] = {}  # by layouts: those that come in one message are mostly one object
        for place, outcome in outcomes.items():
            layout = layout if layout.fields else outcome.layout
            if (key := id(outcome.layout)) not in verdicts:
                # results with arrays come with a layout each: equal ones are told faster than they are hashed
                wrong = () if outcome.layout == layout else results.layout_refusals(layout, outcome.layout)
                if wrong and not self.rng and not self.vectorised and layout.sizes != outcome.layout.sizes:
                    wrong += ("where lengths may differ, declare Output(NAME, ragged=True), or ragged='DIMENSION'",)
                verdicts[key] = "; ".join(wrong)
                layout = layout if wrong else results.joined(layout, outcome.layout)
            if verdicts[key]:
                refused[place] = f"{self.name}: not as at the first point: {verdicts[key]}"
            else:
                fitting.append(place)
        known, rows = self if layout == self.layout else self.with_layout(layout), dict[int, Any]()
        for place in fitting:
            try:
                rows[place] = outcomes[place].row if self.rng else results.as_row(outcomes[place], layout, self.name)
            except rules.ResultError as error:
                refused[place] = str(error)
        return known, rows, refused

    def keeping_samples(self) -> "FunctionExperiment":
        """Return the experiment that keeps all realisations."""
        return replace(self, keeps_all=True).with_layout(self.layout)

    @property
    def keeps_samples(self) -> bool:
        """Whether realisations are kept, for quantiles."""
        return self.rng and any(quantile_of(name) is not None for o in self.declared for name in o.statistics)

    def ragged(self) -> dict[str, str]:
        """Return the ragged dimension of each output that has one."""
        return self.layout.ragged

    def dimension_coordinates(self) -> dict[str, tuple[Any, str, str]]:
        """Return the values along each dimension of results, their unit and their meaning."""
        arrays = ((one, np.array(one.labels, dtype=results.DTYPES[one.type])) for one in self.layout.coordinates)
        return {one.name: (array, one.unit, one.meaning) for one, array in arrays}

    def large(self) -> dict[str, np.dtype[Any]]:
        """Return the types of large results."""
        return self.layout.large

    def nan_outputs(self) -> list[str]:
        """Return all outputs: results have been checked when the function returned them."""
        return [output.name for output in self.outputs]

    def errors_of_headline(self) -> list[tuple[str, str]]:
        """Return the headline outputs that have a Monte-Carlo error, and its name."""
        if self.undeclared and self.rng:
            return [("results", "results_mc_error")]  # whether any has one is seen at the first point
        return super().errors_of_headline()

    def as_record(self) -> dict[str, Any]:
        """Return what a store records of a plain function besides what it records of every experiment."""
        layout = results.json_of_layout(self.layout) if self.layout.fields else None
        outputs = [asdict(replace(output, coords=None)) for output in self.declared]
        return {"function": {"rng": self.rng, "layout": layout, "outputs": outputs}}


def _column(values: list[Any]) -> NDArray[Any]:
    """Return values as an array: of objects where NumPy would make texts or numbers of what has units, several types,
    or members.
    """
    alike = len(kinds := {*map(type, values)}) == 1 or kinds == {int, float}
    are_objects = not alike or isinstance(values[0], Enum) or results.unit_of(values[0])
    return np.fromiter(values, object, len(values)) if are_objects else np.array(values)


def experiment_of(function: Callable[..., Any]) -> FunctionExperiment:
    """Return a plain function as an experiment; raises SweepError with every reason why it cannot be one."""
    declared = (getattr(one, ATTRIBUTE, None) for one in (function, _wrapped(function)))
    return _checked(function, next((one for one in declared if isinstance(one, experiment)), experiment()))


def _undeclared(
    name: str, parameters: tuple[Parameter, ...], declared: tuple[Output, ...], rng: bool
) -> FunctionExperiment:
    """Return the experiment of a function whose results are not known yet."""

    def no_sums(*_arguments: Any, **_named: Any) -> Any:
        raise TypeError("a plain function has no sums")

    return FunctionExperiment(name, 1, parameters, {}, (), no_sums, no_sums, outer_draw="", declared=declared, rng=rng)


def _outputs(layout: results.Layout, declared: Sequence[Output]) -> tuple[Output, ...]:
    """Return the outputs of a layout; where none is declared as headline, those without dimensions are."""
    by_name = {output.name: output for output in declared}
    headline = layout.headline(declared)
    made = []
    for one in layout.fields:
        output = by_name.get(one.name, Output(one.name))
        meaning, is_main = one.meaning or one.name.replace("_", " "), one.name in headline
        made.append(replace(output, unit=one.unit, meaning=meaning, dims=one.dims, headline=is_main, coords=None))
    return tuple(made)


def experiment_of_record(record: Mapping[str, Any], parameters: tuple[Parameter, ...]) -> FunctionExperiment:
    """Return the experiment that a store has recorded, which computes nothing."""
    recorded = record["function"]
    outputs = tuple(Output(**{**one, "dims": tuple(one["dims"])}) for one in recorded["outputs"])
    made = _undeclared(record["name"], parameters, outputs, recorded["rng"])
    return replace(made, shared=tuple(record["shared"])).with_layout(layout_of_record(record))


def layout_of_record(record: Mapping[str, Any]) -> results.Layout | None:
    """Return the layout of results that a store has recorded; None where there is none."""
    layout = record.get("function", {}).get("layout")
    with rules.refused(ValueError, said="the record of its experiment cannot be read: "):
        return None if layout is None else results.layout_of_json(layout)
