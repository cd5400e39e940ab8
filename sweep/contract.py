"""The contract between the platform and an experiment: declared parameters, declared outputs, one function for a block.

This module and NumPy are all that an experiment needs; the platform knows nothing of what is inside one.
"""

import difflib
import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Value = Any  # of a parameter: bool, int, float, str, a tuple, a table file, or None
Point = Mapping[str, Any]
"""A point's parameters by name, every declared one with a value."""
FEW = 20
"""As many names as a message may list."""

HUGE = 1e300
"""No parameter is as large: beyond it arithmetic overflows."""

Kind = Literal["float", "int", "str", "bool", "vector", "map", "file"]


class SweepError(Exception):
    """Bad input or a state that the user must know of; ``problems`` holds one sentence each, ``where`` a file or
    command.
    """

    def __init__(self, problems: str | Sequence[str], where: str = "") -> None:
        self.problems = [problems] if isinstance(problems, str) else list(problems)
        self.where = where
        super().__init__("\n".join(self.problems))


class _Short(reprlib.Repr):
    """A repr of bounded length and depth, also of integers so large that Python refuses to print them."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 3
        self.maxstring = self.maxother = 60

    def repr_int(self, x: int, level: int) -> str:
        return super().repr_int(x, level) if x.bit_length() <= 1100 else f"an integer of {x.bit_length()} bits"

    def repr_Named(self, x: "Named", level: int) -> str:  # noqa: N802 (the name is reprlib's)
        return self.repr_str(x.name, level)


def shown(value: object) -> str:
    """Return a value as messages show it: its repr, cut short where it is long or deep."""
    return _Short().repr(value)


class DefinitionError(ValueError):
    """A definition of a value that is wrong; ``problems`` holds (key, sentence) for each mistake, with an empty key for
    the whole.
    """

    def __init__(self, problems: Sequence[tuple[str, str]]) -> None:
        self.problems = list(problems)
        super().__init__("; ".join(f"{key}: {sentence}" if key else sentence for key, sentence in problems))


class Function(Protocol):
    """A function from a user's module or file, by its name and the digest of its source."""

    @property
    def name(self) -> str:
        """What it is called in its source."""
        ...

    @property
    def digest(self) -> str:
        """The digest of its source."""
        ...

    def __call__(self, *arguments: Any) -> Any:
        """Call it."""
        ...


@dataclass(frozen=True)
class Named:
    """A value of a parameter that a study defines under a name of its own.

    ``identity`` is JSON of everything in it that decides a number; equal identities are equal values, whatever their
    names.  ``value`` is what the experiment made of the definition.
    """

    name: str = field(compare=False)
    identity: str
    value: Any = field(compare=False, repr=False)

    def __str__(self) -> str:
        return self.name


class Define(Protocol):
    """What an experiment makes of a study's table [define.PARAMETER.NAME]."""

    def __call__(self, table: Mapping[str, Any], load: Callable[[str], Function]) -> tuple[Any, Mapping[str, Any]]:
        """Return the value and everything that decides a number in it, as JSON knows it.

        ``load`` returns the function at ``module:function`` or ``file.py:function``.  Raises DefinitionError for a
        wrong table, SweepError where a function cannot be loaded.
        """
        ...


def suggest(word: str, known: Sequence[str]) -> str:
    """Return '; did you mean ...?' for a misspelt word, or the list of what is known if it is short."""
    if close := difflib.get_close_matches(word, known, n=1, cutoff=0.65):
        return f"; did you mean {close[0]!r}?"
    return f"; known are {', '.join(sorted(known))}" if len(known) <= FEW else ""


@dataclass(frozen=True)
class Parameter:
    """One parameter: its kind, unit (as astropy writes it), default, allowed values and a one-line meaning.

    A default of None means that the experiment decides (the meaning says how).  ``minimum`` and ``maximum`` are
    inclusive, ``above`` is not.  A "vector" has three components, a "map" is a table of strings, and of a "file" the
    experiment gets an object that gives the columns of the table in it.  With ``define`` a study may define further
    choices of a "str"; ``defined`` are those of one study, and the experiment gets them as they stand there.  Pictures
    show the ``symbol`` where there is one, as Matplotlib sets it.
    """

    name: str
    kind: Kind
    default: Value
    meaning: str
    unit: str = ""
    choices: tuple[str, ...] = ()
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    symbol: str = ""
    define: Define | None = field(default=None, compare=False, repr=False)
    defined: tuple[Named, ...] = ()

    @property
    def may_be_axis(self) -> bool:
        """Whether its values can be those of an axis."""
        return self.kind not in ("vector", "map", "file")

    def written_default(self) -> Any:
        """Return the default as a study writes it."""
        if isinstance(self.default, tuple):
            return dict(self.default) if self.kind == "map" else list(self.default)
        return self.default.item() if isinstance(self.default, np.generic) else self.default

    def parse(self, raw: object) -> Value:
        """Return ``raw`` as a value of this parameter; raises ValueError with a sentence that says what is allowed."""
        if self.kind == "str":
            known = (*self.choices, *(named.name for named in self.defined))
            if not isinstance(raw, str) or (self.choices and raw not in known):
                hint = suggest(raw, known) if isinstance(raw, str) and self.choices else ""
                raise ValueError(
                    f"{self.name} = {shown(raw)}: must be {self.allowed()}{hint if 'did you mean' in hint else ''}"
                )
            return next((named for named in self.defined if named.name == raw), raw)
        if self.kind == "bool":
            if not isinstance(raw, bool):
                raise ValueError(f"{self.name} = {shown(raw)}: must be true or false")
            return raw
        if self.kind == "map":
            if not isinstance(raw, dict) or not all(isinstance(text, str) for text in raw.values()):
                raise ValueError(f"{self.name} = {shown(raw)}: must be {self.allowed()}")
            return tuple(sorted(raw.items()))
        if self.kind == "file":
            if not isinstance(raw, str):
                raise ValueError(f"{self.name} = {shown(raw)}: must be {self.allowed()}")
            return raw
        if self.kind == "vector":
            if not isinstance(raw, (list, tuple)) or len(raw) != 3:
                raise ValueError(f"{self.name} = {shown(raw)}: must be {self.allowed()}")
            return tuple(self._number(x) for x in raw)
        number = self._number(raw)
        return int(number) if self.kind == "int" else number

    def _number(self, raw: object) -> float:
        if isinstance(raw, (int, float)) and not isinstance(raw, bool) and abs(raw) < HUGE:  # NaN is not < either
            number = float(raw) + 0.0  # no negative zero: it would be another point
            whole = self.kind != "int" or (number == raw and number.is_integer())
            above_floor = self.minimum is None or number >= self.minimum
            above_open = self.above is None or number > self.above
            if whole and above_floor and above_open and (self.maximum is None or number <= self.maximum):
                return number
        raise ValueError(f"{self.name} = {shown(raw)}: must be {self.allowed()}")

    def allowed(self) -> str:
        """Return in words what values are allowed."""
        if self.choices:
            further = "" if self.define is None or self.defined else f", or of [define.{self.name}.NAME]"
            known = (*self.choices, *(named.name for named in self.defined))
            return "one of " + ", ".join(repr(c) for c in known) + further
        words = {
            "float": "a finite number",
            "int": "an integer",
            "str": "a string",
            "bool": "true or false",
            "vector": "a list of three finite numbers",
            "map": 'a table of strings, { quantity = "column" }',
            "file": "the path of a table",
        }[self.kind]
        bounds = [
            f"{symbol} {bound:g}"
            for symbol, bound in ((">=", self.minimum), (">", self.above), ("<=", self.maximum))
            if bound is not None
        ]
        return words + (" " + " and ".join(bounds) if bounds else "") + (f" [{self.unit}]" if self.unit else "")


@dataclass(frozen=True)
class Output:
    """One result of a point: its unit (as astropy writes it), meaning and dimensions beside the axes of the grid.

    ``headline`` outputs are the columns of the printed table; pictures show the ``symbol`` where there is one.
    """

    name: str
    unit: str
    meaning: str
    dims: tuple[str, ...] = ()
    headline: bool = False
    symbol: str = ""


class Evaluate(Protocol):
    """The function that does the work of one block for one catalogue."""

    def __call__(
        self,
        points: Sequence[Point],
        n_sim: int,
        rng: np.random.Generator,
        catalogue_rng: np.random.Generator,
    ) -> Mapping[str, Any]:
        """Return sums over ``n_sim`` realisations, each of shape (len(points), *shape declared in `Experiment.sums`).

        ``rng`` belongs to this block; ``catalogue_rng`` is the same for all blocks of one catalogue (an outer draw
        that several blocks share).  All randomness must come from these two.  ``points`` differ in parameters that are
        `Experiment.shared` and are to use the same random numbers; elsewhere there is one at a time.  The sums of a
        point must not depend, not in the last bit, on the others.
        """
        ...


class Summarise(Protocol):
    """The function that turns merged sums into results."""

    def __call__(self, sums: Mapping[str, Array], n: Array, n_cat: Array) -> Mapping[str, Array]:
        """Return every declared output, shape (points, *dims), from sums of shape (points, ...) over n realisations
        each.

        ``n`` and ``n_cat`` (points,) count realisations and catalogues; all are at least 1.
        """
        ...


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
    """What the platform sweeps.

    ``sums`` gives the shape of each additive quantity that ``evaluate`` returns, ``coordinates`` the labels of each
    dimension that an output uses, ``component_units`` the unit of each label where they differ, ``check`` a sentence
    about a point that cannot be computed (None if it can), ``cost`` the random numbers drawn per realisation.
    ``unused`` gives the parameters that change nothing at a point, each with the reason; it is asked about points that
    can be computed only, and a study that sets such a parameter is refused.  ``warn`` gives sentences about what makes
    the result of such a point less certain than it looks: a run prints and stores them.
    ``samples``, for studies that keep them, returns what ``evaluate`` does and the realisations that it adds up, each
    of ``sample_outputs`` of shape (points, n_sim, *dims).  ``shared`` names parameters that do not change the
    random numbers that a block draws, only what is made of them.  A new ``version`` says that the same parameters now
    give other numbers: stores of another version are not continued.
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
    check: Callable[[Point], str | None] = _no_problem
    unused: Callable[[Point], Mapping[str, str]] = _all_matter
    warn: Callable[[Point], Sequence[str]] = _no_warning
    cost: Callable[[Point], float] = _one
    shared: tuple[str, ...] = ()

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
        pieces: dict[str, Array] = {}
        start = 0
        for name, shape in self.sums.items():
            size = math.prod(shape)
            pieces[name] = rows[:, start : start + size].reshape(-1, *shape)
            start += size
        return pieces

    def errors_of_headline(self) -> list[tuple[str, str]]:
        """Return the headline outputs that have a Monte-Carlo error, and its name: ``X`` and ``X_mc_error``."""
        names = {output.name for output in self.outputs}
        headline = [output.name for output in self.outputs if output.headline]
        return [(name, f"{name}_mc_error") for name in headline if f"{name}_mc_error" in names]

    def size_of(self, output: Output) -> int:
        """Return the number of floats of one value of an output."""
        return math.prod(len(self.coordinates[dim]) for dim in output.dims)

    @cached_property
    def sums_width(self) -> int:
        """Number of floats in one block's sums."""
        return sum(math.prod(shape) for shape in self.sums.values())
