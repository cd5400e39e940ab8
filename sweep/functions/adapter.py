"""A plain function as an `Experiment`, so that its studies are run and stored like all others."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Array, Experiment, Output, Parameter, Point, SweepError
from linksweep.sweep.functions.declared import ATTRIBUTE, Declaration, declaration_of, problems
from linksweep.sweep.functions.layout import SLOTS, Layout
from linksweep.sweep.functions.named_results import Declared
from linksweep.sweep.functions.realisations import Realisations, drawn
from linksweep.sweep.functions.results import Flat, flatten, split_points
from linksweep.sweep.functions.signature import ALLOWED, Signature, name_of, signature_of

COUNT = 1
"""Numbers at the start of a row of realisations: how many it holds.  So no row is all NaN, which marks a lost row."""

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

    def realised(self, point: Point, n_sim: int, rng: np.random.Generator) -> list[Flat]:
        """Return the results of ``n_sim`` realisations; raises ResultError as `flatten`."""
        if self.signature.n_sim:
            return split_points(self.call(**point, rng=rng, n_sim=n_sim), n_sim, self.declared, "realisations")
        return [flatten(self.call(**point, rng=rng), self.declared) for _ in range(n_sim)]


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
        random = Realisations(layout, self.declared)
        return replace(
            self,
            layout=layout,
            outputs=random.outputs() if self.rng else _outputs(layout, self.declared),
            sums={"row": (COUNT + random.width if self.rng else layout.head + layout.width,)},
            coordinates={coordinate.name: coordinate.values for coordinate in layout.coordinates},
            nan_sums=("row",),
        )

    @cached_property
    def realisations(self) -> Realisations | None:
        """What is kept of random realisations; None before the layout is known, and for a function without ``rng``."""
        return Realisations(self.layout, self.declared) if self.rng and self.layout is not None else None

    def block(self, points: Sequence[Point], n_sim: int, rng: Iterator[np.random.Generator]) -> list[Flat]:
        """Return the result of each point: of one evaluation, or of ``n_sim`` realisations with the next generator.

        Raises ResultError for an invalid result, and whatever the function raises.
        """
        assert self.function is not None, "the record of an experiment computes nothing"
        function, declared = self.function, self.function.declared
        if not self.rng:
            return [flatten(function.call(**point), declared) for point in points]
        generator = next(rng)
        return [drawn(function.realised(point, n_sim, generator), declared) for point in points]

    def many(self, points: Sequence[Point]) -> list[Flat]:
        """Return the results of points from one call of a vectorised function; raises as `block`."""
        assert self.function is not None, "the record of an experiment computes nothing"
        columns = {name: np.array([point[name] for point in points]) for name in points[0]}
        return split_points(self.function.call(**columns), len(points), self.function.declared, "points")

    def text_places(self) -> list[int]:
        """Return the positions in a row, in bytes, at which the digests of texts begin."""
        if self.layout is None or self.rng:
            return []
        fields = [field for field in self.layout.fields if field.type == "text"]
        spans = (self.layout.places[field.name] for field in fields)
        head = self.layout.head
        return [8 * (head + number) for span in spans for number in range(span.start, span.stop, SLOTS["text"])]

    def added(self, total: Array, row: Array) -> Array:
        """Return the row of a point with one block more: a single evaluation as it is, moments merged."""
        if self.realisations is None or total[0] == 0.0:
            return row
        return self.realisations.merged(total, row)

    def alone(self, rows: Array) -> Array:
        """Return the rows of points that have one block each, as they are."""
        return rows

    @property
    def keeps_samples(self) -> bool:
        """Whether realisations are kept, for quantiles."""
        return self.samples_width > 0

    @property
    def samples_width(self) -> int:
        """Number of floats of one kept realisation."""
        return 0 if self.realisations is None else self.realisations.kept_width

    @property
    def further_width(self) -> int:
        """Number of floats that kept realisations add to the row of a point."""
        return 0 if self.realisations is None else self.realisations.further_width

    def of_samples(self, samples: Array) -> Array:
        """Return what the kept realisations (n, samples_width) of a point add, (further_width,)."""
        assert self.realisations is not None, "samples have a layout"
        return self.realisations.of_samples(samples)

    def results(self, rows: Array, n: Array, n_cat: Array) -> dict[str, Array]:
        """Return every output from rows as `added` makes them, digests in place of texts."""
        if self.realisations is not None:
            return self.realisations.results(rows)
        return {} if self.layout is None else self.layout.joined(rows)

    def not_joined(self, rows: Array, some: NDArray[np.intp]) -> dict[int, str]:
        """Return which of ``some`` rows have an integer that cannot be joined with the floats of others, and why."""
        found = {} if self.layout is None or self.rng else self.layout.not_joined(rows, some)
        return {row: f"{self.name}: {why}" for row, why in found.items()}

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
            "rng": self.rng,
            "layout": None if self.layout is None else asdict(self.layout),
            "outputs": [{name: getattr(one, name) for name in _RECORDED} for one in self.declared],
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
        sums={"row": (COUNT,)},
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
