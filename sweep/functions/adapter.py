"""A plain function as an `Experiment`, so that its studies are run and stored like all others."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import (
    Array,
    Experiment,
    GeneratorPair,
    Outcome,
    Output,
    Parameter,
    Point,
    Reducer,
    ResultError,
    Rows,
    SweepError,
)
from linksweep.sweep.functions.declared import (
    ALLOWED,
    ATTRIBUTE,
    Declaration,
    Signature,
    declaration_of,
    name_of,
    problems,
    signature_of,
)
from linksweep.sweep.functions.results import (
    Declared,
    Layout,
    as_row,
    differences,
    flatten,
    joined,
    layout_of_json,
    split_points,
)
from linksweep.sweep.functions.statistics import Moments, drawn, quantile_of

_RECORDED = [field.name for field in fields(Output) if field.name != "coords"]


@dataclass(frozen=True)
class PlainFunction:
    """A function with what is known of it before it is called."""

    call: Callable[..., Any]
    signature: Signature
    declaration: Declaration

    @cached_property
    def declared(self) -> Declared:
        """What results are checked against."""
        names = tuple(parameter.name for parameter in self.signature.parameters)
        outputs, name = self.declaration.outputs, self.signature.name
        single = outputs[0].name if len(outputs) == 1 else "result" if name in ("function", *names) else name
        return Declared(name, single, outputs, names)

    def realised(self, point: Point, n_sim: int, rng: np.random.Generator) -> list[Outcome]:
        """Return the results of ``n_sim`` realisations; raises ResultError as `flatten`."""
        if self.signature.n_sim:
            return split_points(self.call(**point, rng=rng, n_sim=n_sim), n_sim, self.declared, "realisations")
        return [flatten(self.call(**point, rng=rng), self.declared) for _ in range(n_sim)]


@dataclass(frozen=True)
class Typed:
    """The reducer of results that are there after one call: a row has each of them as itself."""

    layout: Layout | None
    samples_width = 0

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """The type of a row; without fields before there is a first result."""
        return np.dtype([]) if self.layout is None else self.layout.dtype

    def add(self, total: Rows, block: Rows) -> Rows:
        """Return the only block."""
        return block

    def close(self, total: Rows, samples: Array) -> Rows:
        """Return the row as it is."""
        return total

    def finish(self, total: Rows, n: Array, n_cat: Array) -> dict[str, NDArray[Any]]:
        """Return the results."""
        return {name: total[name] for name in self.dtype.names or ()}


@dataclass(frozen=True)
class FunctionExperiment(Experiment):
    """A plain function as an experiment.

    ``layout`` describes its results, None before the first.  ``declared`` are the outputs that the function declares,
    ``rng`` says whether it takes a generator; without one it is evaluated once at each point.  An experiment that is
    made from the record in a store has no ``function`` and computes nothing.
    """

    function: PlainFunction | None = None
    declared: tuple[Output, ...] = ()
    rng: bool = False
    layout: Layout | None = None

    def __post_init__(self) -> None:
        """Do nothing: `experiment_of` checks the declaration."""

    def parameter(self, name: str) -> Parameter:
        """Return the declared parameter; raises ValueError that says why an argument cannot be one."""
        others = {} if self.function is None else dict(self.function.signature.others)
        if name in others:
            raise ValueError(f"is of type {others[name]} in {self.name}, none of {ALLOWED}: it stays at its default")
        if self.rng and name in ("n_sim", "precision", "max_n_sim"):
            raise ValueError(f"belongs to the sampling: sampling={{{name!r}: ...}}, in a study file [sampling]")
        return super().parameter(name)

    @property
    def deterministic(self) -> bool:
        """Whether a point is evaluated once, without random numbers."""
        return not self.rng

    @property
    def repeatable(self) -> bool:
        """Whether every call at a point is to return the same."""
        return not self.rng and self.function is not None and self.function.declaration.deterministic

    @property
    def undeclared(self) -> bool:
        """Whether the outputs are unknown until there is a first result."""
        return self.layout is None

    @property
    def vectorised(self) -> bool:
        """Whether the function takes many points at once."""
        return self.function is not None and self.function.declaration.vectorised

    @property
    def tolerance(self) -> float:
        """How far the result of a point among others may be from that of the point alone, relative to it."""
        return 0.0 if self.function is None else self.function.declaration.tolerance

    def with_layout(self, layout: Layout) -> "FunctionExperiment":
        """Return the experiment with a known layout of its results."""
        return replace(
            self,
            layout=layout,
            outputs=Moments(layout, self.declared).outputs() if self.rng else _outputs(layout, self.declared),
            coordinates={coordinate.name: coordinate.values for coordinate in layout.coordinates},
        )

    @cached_property
    def reducer(self) -> Reducer:
        """What a call, or a block of realisations, leaves of a point."""
        return Moments(self.layout, self.declared) if self.rng and self.layout is not None else Typed(self.layout)

    def compute(
        self, points: Sequence[Point], n_sim: int, pairs: Iterable[GeneratorPair], keep_samples: bool = False
    ) -> list[Outcome]:
        """Return the result of each point: of one call, or of ``n_sim`` realisations with the next generator.

        Raises ResultError for an invalid result, and whatever the function raises.
        """
        assert self.function is not None, "the record of an experiment computes nothing"
        function, declared = self.function, self.function.declared
        if self.vectorised:
            columns = {name: np.array([point[name] for point in points]) for name in points[0]}
            return split_points(function.call(**columns), len(points), declared, "points")
        if not self.rng:
            return [flatten(function.call(**point), declared) for point in points]
        rng = next(iter(pairs))[0]
        return [drawn(function.realised(point, n_sim, rng), declared.function, declared.outputs) for point in points]

    def learned(self, outcomes: Mapping[int, Outcome]) -> "tuple[FunctionExperiment, dict[int, Any], dict[int, str]]":
        """Return the experiment with the layout that the first result has, with floats where any result has; the fields
        of rows of it; and why other results are refused.
        """
        layout, fitting, refused = self.layout, list[int](), dict[int, str]()
        checked: dict[int, str] = {}  # by layouts: those that come in one message are mostly one object
        for place, outcome in outcomes.items():
            layout = layout or outcome.layout
            if id(outcome.layout) not in checked:
                checked[id(outcome.layout)] = self._refusal(layout, outcome.layout)
                if not checked[id(outcome.layout)]:
                    layout = joined(layout, outcome.layout)
            if why := checked[id(outcome.layout)]:
                refused[place] = f"{self.name}: not as at the first point: {why}"
            else:
                fitting.append(place)
        if layout is None:
            return self, {}, refused
        known, rows = self if layout == self.layout else self.with_layout(layout), dict[int, Any]()
        for place in fitting:
            try:
                rows[place] = outcomes[place].row if self.rng else as_row(outcomes[place], layout)
            except ResultError as error:
                refused[place] = f"{self.name}: {error}"
        return known, rows, refused

    def joined(self, other: Experiment) -> Experiment:
        """Return the experiment with floats where another store has floats."""
        layouts = self.layout, getattr(other, "layout", None)
        return self if None in layouts else self.with_layout(joined(*layouts))

    def recalled(self, record: Mapping[str, Any]) -> Experiment:
        """Return the experiment with the layout of results that a store has recorded, if any."""
        layout = layout_of_record(record)
        return self if layout is None else self.with_layout(layout)

    def _refusal(self, expected: Layout, found: Layout) -> str:
        """Return why results of one layout are not taken beside those of another, '' where they are."""
        wrong = () if found == expected else differences(expected, found)
        if self.rng and not wrong and [f.name for f in found.fields] != [f.name for f in expected.fields]:
            wrong = ("its results are in another order",)
        return "; ".join(wrong)

    @property
    def keeps_samples(self) -> bool:
        """Whether realisations are kept, for quantiles."""
        return self.rng and any(quantile_of(name) is not None for o in self.declared for name in o.statistics)

    @property
    def samples_width(self) -> int:
        """Number of floats of one kept realisation."""
        return self.reducer.samples_width

    def dimension_coordinates(self) -> dict[str, tuple[Any, str]]:
        """Return the values along each dimension of results, and their unit."""
        coordinates = () if self.layout is None else self.layout.coordinates
        return {coordinate.name: (coordinate.array(), coordinate.unit) for coordinate in coordinates}

    def nan_outputs(self) -> list[str]:
        """Return all outputs: results have been checked when the function returned them."""
        return [output.name for output in self.outputs]

    def errors_of_headline(self) -> list[tuple[str, str]]:
        """Return the headline outputs that have a Monte-Carlo error, and its name."""
        if self.layout is None and self.rng:
            return [("results", "results_mc_error")]  # mean and the like always have one
        return super().errors_of_headline()

    def as_record(self) -> dict[str, Any]:
        """Return what a store records of a plain function besides what it records of every experiment."""
        return {
            "function": {
                "rng": self.rng,
                "layout": None if self.layout is None else asdict(self.layout),
                "outputs": [{name: getattr(one, name) for name in _RECORDED} for one in self.declared],
            }
        }


def is_plain_function(found: object) -> TypeGuard[Callable[..., Any]]:
    """Return whether something may be swept as a function: it can be called and is no experiment."""
    return callable(found) and not isinstance(found, Experiment)


def experiment_of(function: Callable[..., Any]) -> FunctionExperiment:
    """Return a plain function as an experiment; raises SweepError with every reason why it cannot be one."""
    try:
        return _made(function)
    except TypeError:  # a function that cannot be hashed cannot be cached
        return _made.__wrapped__(function)


@lru_cache(maxsize=64)
def _made(function: Callable[..., Any]) -> FunctionExperiment:
    declaration = declaration_of(function)
    if not hasattr(function, ATTRIBUTE) and (found := problems(function, declaration)):
        raise SweepError(found, f"function {name_of(function)}")
    signature = signature_of(function)
    made = undeclared_experiment(signature.name, signature.parameters, declaration.outputs, signature.rng)
    return replace(
        made,
        function=PlainFunction(function, signature, declaration),
        packages=tuple(declaration.packages),
        citation=declaration.citation,
    )


def undeclared_experiment(
    name: str, parameters: tuple[Parameter, ...], outputs: tuple[Output, ...], rng: bool
) -> FunctionExperiment:
    """Return the experiment of a function whose results are not known yet."""
    return FunctionExperiment(
        name=name,
        version=1,
        parameters=parameters,
        sums={},
        outputs=(),
        evaluate=_not_additive,
        summarise=_not_additive,
        outer_draw="",
        declared=outputs,
        rng=rng,
    )


def _not_additive(*_arguments: Any, **_named: Any) -> Any:
    raise TypeError("a plain function has no sums")


def _outputs(layout: Layout, declared: Sequence[Output]) -> tuple[Output, ...]:
    """Return the outputs of a layout; where none is declared as headline, those without dimensions are."""
    by_name = {output.name: output for output in declared}
    headline = layout.headline(declared)
    made = []
    for field in layout.fields:
        output = by_name.get(field.name, Output(field.name))
        meaning, named = field.meaning or field.name.replace("_", " "), field.name in headline
        made.append(replace(output, unit=field.unit, meaning=meaning, dims=field.dims, headline=named, coords=None))
    return tuple(made)


def experiment_of_record(record: Mapping[str, Any], parameters: tuple[Parameter, ...]) -> FunctionExperiment:
    """Return the experiment that a store has recorded, which computes nothing."""
    told = record["function"]
    outputs = tuple(Output(**{**one, "dims": tuple(one["dims"])}) for one in told["outputs"])
    empty = undeclared_experiment(record["name"], parameters, outputs, told["rng"])
    return empty if told["layout"] is None else empty.with_layout(layout_of_json(told["layout"]))


def layout_of_record(record: Mapping[str, Any]) -> Layout | None:
    """Return the layout of results that a store has recorded; None where there is none."""
    layout = record.get("function", {}).get("layout")
    try:
        return None if layout is None else layout_of_json(layout)
    except (KeyError, TypeError) as error:
        raise SweepError(f"the record of its experiment cannot be read ({error})") from error
