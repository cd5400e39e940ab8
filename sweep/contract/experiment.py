"""What the platform sweeps: declared parameters, sums and outputs, and the functions that make them."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any, Protocol

import numpy as np

from linksweep.sweep.contract.checked import Array, checked
from linksweep.sweep.contract.declaration import problems
from linksweep.sweep.contract.errors import SweepError, shown, suggest
from linksweep.sweep.contract.output import Output
from linksweep.sweep.contract.parameter import Parameter, Point, Value

GeneratorPair = tuple[np.random.Generator, np.random.Generator]
"""The generators of a block's realisations and of their catalogue."""


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


def _no_problem(point: Point) -> str | None:
    return None


def _no_warning(point: Point) -> Sequence[str]:
    return ()


def _all_matter(point: Point) -> Mapping[str, str]:
    return {}


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
    check: Callable[[Point], str | None] = _no_problem
    unused: Callable[[Point], Mapping[str, str]] = _all_matter
    warn: Callable[[Point], Sequence[str]] = _no_warning
    cost: Callable[[Point], float] = _one
    shared: tuple[str, ...] = ()
    nan_sums: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()
    cost_unit: str = ""
    outer_draw: str = "outer draw"
    citation: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if found := problems(self):
            raise SweepError(found, f"experiment {shown(self.name)}")

    @property
    def deterministic(self) -> bool:
        """Whether a point is computed once, without random numbers."""
        return False

    @property
    def undeclared(self) -> bool:
        """Whether the outputs are unknown until there is a first result."""
        return False

    @property
    def vectorised(self) -> bool:
        """Whether points that share no random numbers are computed in one call."""
        return False

    @property
    def says_cost(self) -> bool:
        """Whether ``cost`` may differ between points."""
        return self.cost is not _one

    @property
    def keeps_samples(self) -> bool:
        """Whether realisations are kept, whatever a study says, because results are computed from them."""
        return False

    @property
    def further_width(self) -> int:
        """Number of floats that are computed from the kept realisations of a point."""
        return 0

    def of_samples(self, samples: Array) -> Array:
        """Return what is computed from the kept realisations of a point, (further_width,)."""
        return np.empty(0)

    def text_places(self) -> Sequence[int]:
        """Return the positions in a row of sums, in bytes, at which the digests of texts begin."""
        return ()

    def added(self, total: Array, row: Array) -> Array:
        """Return the sums of a point (width,) with those of one block more; ``total`` is 0 before the first."""
        return total + row

    def alone(self, rows: Array) -> Array:
        """Return the sums of points (points, width) that have one block each."""
        return 0.0 + rows

    def parameter(self, name: str) -> Parameter:
        """Return the declared parameter; raises ValueError with a suggestion for an unknown name."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise ValueError(f"unknown parameter {shown(name)}{suggest(name, [p.name for p in self.parameters])}")

    def defaults(self) -> dict[str, Value]:
        """Return the default of every parameter."""
        return {p.name: p.default for p in self.parameters}

    @property
    def samples_width(self) -> int:
        """Number of floats of one kept realisation."""
        return sum(self.size_of(output) for output in self.sample_outputs)

    def named(self, rows: Array) -> dict[str, Array]:
        """Return sums by name, each of shape (rows, *shape), from rows of `sums_width` numbers."""
        ends = pairwise(accumulate(map(math.prod, self.sums.values()), initial=0))
        places = zip(self.sums.items(), ends, strict=True)
        return {name: rows[:, start:end].reshape(-1, *shape) for (name, shape), (start, end) in places}

    def results(self, rows: Array, n: Array, n_cat: Array) -> dict[str, Array]:
        """Return every output, (points, *dims), from rows of `sums_width` sums over n realisations of n_cat catalogues.

        Raises ResultError where `summarise` returns something else, and whatever it raises.
        """
        expected = {output.name: (len(rows), *self.shape_of(output)) for output in self.outputs}
        return checked("summarise", self.summarise(self.named(rows), n, n_cat), "output", expected)

    def nan_outputs(self) -> list[str]:
        """Return the outputs whose values may be NaN or infinite."""
        return [output.name for output in self.outputs if output.nan]

    def errors_of_headline(self) -> list[tuple[str, str]]:
        """Return the headline outputs that have a Monte-Carlo error, and its name: ``X`` and ``X_mc_error``."""
        names = {output.name for output in self.outputs}
        headline = [output.name for output in self.outputs if output.headline]
        return [(name, f"{name}_mc_error") for name in headline if f"{name}_mc_error" in names]

    def shape_of(self, output: Output) -> tuple[int, ...]:
        """Return the shape of one value of an output."""
        return tuple(len(self.coordinates[dim]) for dim in output.dims)

    def size_of(self, output: Output) -> int:
        """Return the number of floats of one value of an output."""
        return math.prod(self.shape_of(output))

    @cached_property
    def sums_width(self) -> int:
        """Number of floats in one block's sums."""
        return sum(math.prod(shape) for shape in self.sums.values())
