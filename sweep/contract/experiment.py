"""What the platform sweeps: declared parameters, sums and outputs, and the functions that make them."""

import inspect
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from linksweep.sweep.contract import declaration
from linksweep.sweep.contract.declaration import Output, Parameter, Point, SweepError, T, Value, shown, suggest
from linksweep.sweep.contract.rows import Array, Outcome, Reducer, Rows, Sums, check_finite, checked

# The generators of a block's realisations and of their catalogue.
GeneratorPair = tuple[np.random.Generator, np.random.Generator]


# The functions of an experiment, and what they are called with.
CALLS = {
    "evaluate": ("points", "n_sim", "rng", "catalogue_rng"),
    "samples": ("points", "n_sim", "rng", "catalogue_rng"),
    "summarise": ("sums", "n", "n_cat"),
    "check": ("point",),
    "cost": ("point",),
    "unused": ("point",),
}


class Evaluate(Protocol):
    """The function that does the work of one block for one catalogue."""

    def __call__(
        self, points: Sequence[Point], n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator
    ) -> Mapping[str, Any]:
        """Return sums over ``n_sim`` realisations, each of shape (len(points), *shape declared in `Experiment.sums`).

        ``rng`` belongs to this block; ``catalogue_rng`` is the same for all blocks of one catalogue (an outer draw
        that several blocks share).  All randomness must come from these two.  Several ``points`` differ only in
        parameters that are `Experiment.shared`, and must use the same random numbers; otherwise there is one at a time.
        The sums of a point must not depend on the other points, not even in the last bit.
        """


class EvaluateCatalogues(Protocol):
    """The function that does the work of one block for several catalogues."""

    def __call__(self, points: Sequence[Point], n_sim: int, streams: Sequence[GeneratorPair]) -> Mapping[str, Any]:
        """Return what `Evaluate` returns for each (rng, catalogue_rng) of ``streams``, to the last bit; each sum is of
        shape (len(streams), len(points), *shape).

        If it raises an Exception, the catalogues are evaluated one by one.
        """


class Summarise(Protocol):
    """The function that turns merged sums into results."""

    def __call__(self, sums: Mapping[str, Array], n: Array, n_cat: Array) -> Mapping[str, Array]:
        """Return every declared output, shape (points, *dims), from sums of shape (points, ...) over n realisations
        each.

        ``n`` and ``n_cat`` (points,) count realisations and catalogues; all are at least 1.
        """


def _one(point: Point) -> float:
    return 1.0


@dataclass(frozen=True)
class Experiment:
    """A function that adds up realisations, one that turns the sums into results, and a declaration of both.

    Args:
        name: its name in messages and stores.
        version: to be changed when the same parameters give other results; stores of another version are not
            continued.
        parameters: the inputs.
        sums: the shape of each additive quantity that ``evaluate`` returns.
        outputs: the results.
        evaluate: returns the sums of one block of realisations, see `Evaluate`.
        summarise: returns the outputs, from the sums of all blocks of a point, see `Summarise`.
        coordinates: the labels of each dimension that an output uses.
        component_units: the unit of each label of a dimension, where they differ.
        samples: for studies that keep realisations, returns what ``evaluate`` returns and the realisations behind the
            sums, each of ``sample_outputs`` with the shape (points, n_sim, dims ...).
        sample_outputs: the quantities of a realisation that are kept.
        evaluate_catalogues: for experiments that compute many small catalogues faster together, see
            `EvaluateCatalogues`; without it ``evaluate`` is called for one after the other.
        check: returns a sentence about a point that cannot be computed, None if it can.
        unused: returns the parameters that change nothing at a point, each with the reason.  It is called only for
            points that can be computed; a study that sets such a parameter is refused.
        warn: returns sentences about what makes the result of a point less certain than it looks.  A run prints and
            stores them.
        cost: the random numbers drawn per realisation.
        shared: parameters that do not change the random numbers that a block draws, only what is made of them.
        nan_sums: the sums that may be NaN or infinite.
        packages: distributions whose versions determine the results.
        cost_unit: what ``cost`` counts, in words.
        outer_draw: the name of the draws that several realisations share; empty if there are none.
        citation: what to cite in addition to linksweep.

    Raises:
        SweepError: with everything that is wrong in the declaration.
    """

    name: str
    version: int
    parameters: tuple[Parameter, ...]
    sums: Mapping[str, tuple[int, ...]]
    outputs: tuple[Output, ...]
    evaluate: Evaluate
    summarise: Summarise
    coordinates: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    component_units: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    samples: Evaluate | None = None
    sample_outputs: tuple[Output, ...] = ()
    evaluate_catalogues: EvaluateCatalogues | None = None
    check: Callable[[Point], str | None] = lambda point: None
    unused: Callable[[Point], Mapping[str, str]] = lambda point: {}
    warn: Callable[[Point], Sequence[str]] = lambda point: ()
    cost: Callable[[Point], float] = _one
    shared: tuple[str, ...] = ()
    nan_sums: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()
    cost_unit: str = ""
    outer_draw: str = "outer draw"
    citation: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if faults := _problems(self):
            raise SweepError(faults, f"experiment {shown(self.name)}")

    @property
    def deterministic(self) -> bool:
        """Whether a point is computed once, without random numbers."""
        return False

    @property
    def undeclared(self) -> bool:
        """Whether the outputs are unknown until there is a first result."""
        return not self.outputs

    @property
    def vectorised(self) -> bool:
        """Whether points that share no random numbers are computed in one call."""
        return False

    @property
    def repeatable(self) -> bool:
        """Whether every call at a point is to return the same."""
        return False

    @property
    def tolerance(self) -> float:
        """How far the result of a point among others may be from that of the point alone, relative to it."""
        return 0.0

    @property
    def says_cost(self) -> bool:
        """Whether ``cost`` may differ between points."""
        return self.cost is not _one

    @property
    def draws_alone(self) -> bool:
        """Whether each point draws again the random numbers that it shares, as those of plain functions do, which share
        what they declare.
        """
        return not self.sums

    def keeping_samples(self) -> "Experiment":
        """Return the experiment for a study that keeps its realisations."""
        return self

    @property
    def keeps_samples(self) -> bool:
        """Whether realisations are kept, whatever a study says, because results are computed from them."""
        return False

    @cached_property
    def reducer(self) -> Reducer:
        """What a block leaves of a point, and what comes of it."""
        return Sums(self.sums, {output.name: self.shape_of(output) for output in self.outputs}, self.summarise)

    @property
    def samples_width(self) -> int:
        """Number of floats of one realisation of which samples are kept."""
        return sum(self.size_of(output) for output in self.sample_outputs)

    def compute(
        self, points: Sequence[Point], n_sim: int, pairs: Iterable[GeneratorPair], keep_samples: bool = False
    ) -> list[Outcome]:
        """Return what one block leaves of each point; with ``keep_samples`` its realisations too, (n, width):
        catalogue by catalogue, flat in the order of the outputs.

        Each pair of generators gives the ``n_sim`` realisations of one catalogue.  Raises ResultError where results are
        not as declared or not finite, and whatever the experiment raises.
        """
        kept = self.sample_outputs if keep_samples else ()
        evaluate = self.samples if kept and self.samples is not None else self.evaluate
        who = "samples" if kept else "evaluate"
        shapes = {name: (len(points), *shape) for name, shape in self.sums.items()}
        shapes_kept = {o.name: (len(points), n_sim, *self.shape_of(o)) for o in kept}
        total = np.zeros((len(points), sum(map(math.prod, self.sums.values()))))
        samples: list[Array] = []
        for rng, catalogue_rng in pairs:
            drawn = evaluate(points, n_sim, rng, catalogue_rng)
            sums = checked(who, drawn, "sum", shapes, beside=list(shapes_kept))
            check_finite(sums, self.nan_sums)
            total += np.concatenate([array.reshape(len(points), -1) for array in sums.values()], axis=1)
            if kept:
                realisations = checked(who, drawn, "sample output", shapes_kept, beside=list(shapes))
                check_finite(realisations, [output.name for output in kept if output.nan])
                flat = [array.reshape(len(points), n_sim, -1) for array in realisations.values()]
                samples.append(np.concatenate(flat, axis=2))
        whole = np.concatenate(samples, axis=1) if samples else len(points) * [None]
        return [Outcome(row, result) for row, result in zip(self.as_rows(total), whole, strict=True)]

    def compute_catalogues(
        self, points: Sequence[Point], n_sim: int, pairs: Sequence[GeneratorPair], counts: Sequence[int]
    ) -> list[Outcome]:
        """Return what `compute` leaves of blocks of so many catalogues (``counts``), block by block, from one call of
        ``evaluate_catalogues``; raises as `compute`.
        """
        assert self.evaluate_catalogues is not None, "the caller has asked"
        shapes = {name: (sum(counts), len(points), *shape) for name, shape in self.sums.items()}
        sums = checked("evaluate_catalogues", self.evaluate_catalogues(points, n_sim, pairs), "sum", shapes)
        check_finite(sums, self.nan_sums)
        flat = np.concatenate([array.reshape(sum(counts), len(points), -1) for array in sums.values()], axis=2)
        drawn, outcomes = iter(flat), list[Outcome]()
        for catalogues in counts:
            total = np.zeros(flat.shape[1:])
            for _ in range(catalogues):
                total += next(drawn)  # in the order in which `compute` adds them
            outcomes += map(Outcome, self.as_rows(total))
        return outcomes

    def as_rows(self, flat: Array) -> Rows:
        """Return sums, (points, width), as rows of `reducer`."""
        return flat.view(self.reducer.dtype).reshape(len(flat))

    def learned(self, outcomes: Mapping[int, Outcome]) -> "tuple[Experiment, dict[int, Any], dict[int, str]]":
        """Return the experiment as it is known from results too, the fields of the rows of its reducer, and why some of
        the results are refused.
        """
        return self, {place: outcome.row for place, outcome in outcomes.items()}, {}

    def not_repeatable(self) -> "Experiment":
        """Return the experiment without the promise that a function returns the same whenever it is called."""
        raise SweepError("deterministic: is for a plain function; an Experiment draws from the generators that it gets")

    def joined(self, other: "Experiment") -> "Experiment":
        """Return the experiment with what is known of its results in another store too."""
        return self

    def recalled(self, record: Mapping[str, Any]) -> "Experiment":
        """Return the experiment with what a store has recorded of its results."""
        return self

    def as_record(self) -> dict[str, Any]:
        """Return what a store records besides what is declaration."""
        return {}

    def parameter(self, name: str) -> Parameter:
        """Return the declared parameter; raises ValueError with a suggestion for an unknown name."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise ValueError(f"unknown parameter {shown(name)}{suggest(name, [p.name for p in self.parameters])}")

    def defaults(self) -> dict[str, Value]:
        """Return the default of every parameter."""
        return {p.name: p.default for p in self.parameters}

    def nan_outputs(self) -> list[str]:
        """Return the outputs whose values may be NaN or infinite."""
        return [output.name for output in self.outputs if output.nan]

    def errors_of_headline(self) -> list[tuple[str, str]]:
        """Return the headline outputs that have a Monte-Carlo error, and its name: ``X`` and ``X_mc_error``."""
        names = {output.name for output in self.outputs}
        headline = [output.name for output in self.outputs if output.headline]
        return [(name, f"{name}_mc_error") for name in headline if f"{name}_mc_error" in names]

    def ragged(self) -> dict[str, str]:
        """Return the dimension along which an output has another length at each point, ``NAME_length``, by its name."""
        return {}

    def large(self) -> dict[str, np.dtype[Any]]:
        """Return the types of the outputs that are large arrays, of which rows have only references to their chunks."""
        return {}

    def dimension_coordinates(self) -> dict[str, tuple[Any, str]]:
        """Return the values along each dimension of outputs, and their unit."""
        return {name: (np.array(labels, dtype=object), "") for name, labels in self.coordinates.items()}

    def shape_of(self, output: Output) -> tuple[int, ...]:
        """Return the shape of one value of an output."""
        return tuple(len(self.coordinates[dim]) for dim in output.dims)

    def size_of(self, output: Output) -> int:
        """Return the number of values in one value of an output."""
        return math.prod(self.shape_of(output))


def _problems(experiment: Experiment) -> list[str]:
    """Return a sentence for each mistake in a declaration, none if there are none."""
    problems: list[str] = []
    if not isinstance(experiment.name, str) or not experiment.name.strip():
        problems.append(f"name = {shown(experiment.name)}: must be a text")
    if type(experiment.version) is not int:
        problems.append(f"version = {shown(experiment.version)}: must be an integer")
    parameters = declaration.members("parameters", experiment.parameters, Parameter, problems)
    outputs = declaration.members("outputs", experiment.outputs, Output, problems)
    samples = declaration.members("sample_outputs", experiment.sample_outputs, Output, problems)
    labels = _by_name("coordinates", experiment.coordinates, str, problems)
    units = _by_name("component_units", experiment.component_units, str, problems)
    for dimension in labels:
        if repeated := [label for label, count in Counter(labels[dimension]).items() if count > 1]:
            problems.append(f"coordinates[{dimension!r}]: {shown(repeated[0])} is listed twice")
    for dimension in units:
        if len(labels.get(dimension, ())) != len(units[dimension]):
            text = f"{len(units[dimension])} units for {len(labels.get(dimension, ()))} labels"
            problems.append(f"component_units[{dimension!r}]: {text}")
    for parameter in parameters:
        texts = [*_of_no_function(parameter), *declaration.parameter_problems(parameter)]
        problems += [f"parameter {parameter.name!r}: {text}" for text in texts]
    for output in (*outputs, *samples):
        alike = [other.name for other in outputs if (other.dims, other.unit) == (output.dims, output.unit)]
        texts = [*_of_no_function(output), *filter(None, [declaration.unit_problem(output.unit)])]
        texts += declaration.named("dims", output.dims, list(labels), "dimension with labels in coordinates")
        texts += declaration.named("errors", output.errors, alike, "output with its dimensions and unit")
        problems += [f"output {output.name!r}: {text}" for text in texts]
    names = [*(("output", one.name) for one in (*outputs, *samples)), *(("dimension", name) for name in labels)]
    # If the experiment itself decides the value of a parameter, an output of the same name may report it.
    decided = {parameter.name for parameter in parameters if parameter.default is None}
    problems += declaration.names_problems([one.name for one in parameters], names, units, decided)
    shapes = _by_name("sums", experiment.sums, int, problems)
    if experiment.sums == {}:
        problems.append("sums = {}: must give the shape of each sum, such as {'squares': ()}")
    problems += declaration.named("nan_sums", experiment.nan_sums, list(shapes), "sum")
    problems += [text for name in CALLS for text in _calls(name, getattr(experiment, name))]
    if experiment.samples is not None and not experiment.sample_outputs:
        problems.append("samples: needs sample_outputs, which say what it gives")
    problems += declaration.named(
        "shared", experiment.shared, [parameter.name for parameter in parameters], "parameter"
    )
    problems += declaration.packages_problems(experiment.packages)
    return problems


def _by_name(what: str, mapping: object, kind: type[T], problems: list[str]) -> dict[str, list[T]]:
    """Return what a declaration has for each name: labels or units of a dimension, the shape of a sum."""
    if not isinstance(mapping, Mapping):
        problems.append(f"{what} = {shown(mapping)}: must be a mapping of names to tuples of {kind.__name__}")
        return {}
    return {name: declaration.members(f"{what}[{name!r}]", some, kind, problems) for name, some in mapping.items()}


def _of_no_function(one: Parameter | Output) -> Iterator[str]:
    """Yield settings of a parameter or an output that are allowed only for plain functions."""
    if isinstance(one, Output):
        if one.coords is not None or one.statistics or one.ragged:
            yield "coords, statistics and ragged are for plain functions; an Experiment has coordinates and summarise"
    elif one.required:
        yield "required is for the signatures of plain functions"
    elif one.choices and (one.kind != "str" or not all(isinstance(choice, str) for choice in one.choices)):
        yield f"choices = {shown(one.choices)}: must be strings, of a parameter of kind 'str'"


def _calls(name: str, function: Any) -> Iterator[str]:
    """Yield why a function of an experiment cannot be called as it will be."""
    if function is None and name == "samples":
        return
    if not callable(function):
        yield f"{name} = {shown(function)}: must be a function"
        return
    try:
        inspect.signature(function).bind(*CALLS[name])
    except ValueError:  # of a function in C, which has no signature
        return
    except TypeError:
        yield f"{name}: takes {inspect.signature(function)}, but is called with ({', '.join(CALLS[name])})"
