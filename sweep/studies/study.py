"""What a study is: the form of its file, its tables with the types of their values, and the record that was checked."""

import hashlib
import json
import math
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from linksweep.sweep.contract import Experiment, Value
from linksweep.sweep.tables.file import content_digest

DEFAULT_EXPERIMENT = "linksweep.core.experiment:link"
"""The experiment of a study that names none; any store may name it, as it comes with linksweep."""

Seed = Annotated[int, Field(ge=0, lt=2**64)]
Count = Annotated[int, Field(ge=1, le=10**9)]
Tolerance = Annotated[float, Field(gt=0.0, lt=1.0)]

HIDDEN = {"Cc", "Cs", "Zl", "Zp"}
"""Unicode's categories of control characters, surrogates and separators of lines and paragraphs."""

TURNING = "\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
"""Characters that change the direction of what follows them."""


def _plain(text: str) -> str:
    if hidden := next((c for c in text if unicodedata.category(c) in HIDDEN or c in TURNING), None):
        raise ValueError(f"holds the control character U+{ord(hidden):04X}; a terminal or a report would obey it")
    return text


Text = Annotated[str, AfterValidator(_plain)]
"""A sentence for people, in one line."""

MOST_SIMS = 1_000_000
"""`Sampling.max_n_sim` where a study says nothing: enough for an error of 0.04 % of an RMS."""


class Section(BaseModel):
    """A table of the study file: unknown keys and values of another type are errors."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Sampling(Section):
    """How many realisations: ``n_sim`` for each of ``n_cat`` catalogues, from one ``seed``.

    With a ``precision`` a point gets at least ``n_sim`` and at most ``max_n_sim``, until the relative Monte-Carlo error
    of its headline results is below the precision.  With ``common_random_numbers`` points that differ only in
    parameters that do not change the random numbers draw the same ones.
    """

    n_sim: Count = 1000
    n_cat: Count = 1
    seed: Seed = 0
    keep_samples: bool = False
    precision: Tolerance | None = None
    max_n_sim: Count | None = None
    common_random_numbers: bool = False

    @property
    def most(self) -> int:
        """The most realisations of a catalogue, for a point that must reach a precision."""
        return max(self.n_sim, MOST_SIMS) if self.max_n_sim is None else self.max_n_sim


class Slope(Section, frozen=True):
    """The exponent p of variable ~ over**p along an axis."""

    variable: str
    over: str
    component: str | None = None


class Ratio(Section, frozen=True):
    """The variable at one place of the grid divided by that at another."""

    variable: str
    of: dict[str, Any]
    to: dict[str, Any]
    component: str | None = None


class Reading(Section, frozen=True):
    """The variable at one place of the grid."""

    variable: str
    at: dict[str, Any] = Field(default_factory=dict)
    component: str | None = None


class Derived(Section, frozen=True):
    """A number that is derived from the grid: exactly one of ``slope``, ``ratio`` and ``value``.

    ``where`` fixes axes for any of the three; an axis that is fixed nowhere gives one number for each of its values.
    """

    slope: Slope | None = None
    ratio: Ratio | None = None
    value: Reading | None = None
    where: dict[str, Any] = Field(default_factory=dict)

    def quantity(self) -> Slope | Ratio | Reading:
        """Return the one quantity of a valid table; raises ValueError if there is not exactly one."""
        quantities = [q for q in (self.slope, self.ratio, self.value) if q is not None]
        if len(quantities) != 1:
            raise ValueError("needs exactly one of slope, ratio and value")
        return quantities[0]


class Claim(Derived, frozen=True):
    """A published statement about a number that can be derived from the grid.

    ``published`` is the number as printed, so that its rounding is known; an ``exact`` law has none.  ``null`` is
    the number without the effect that is claimed, which a verdict must tell from the published one; ``not_comparable``
    says why there can be no verdict.
    """

    text: Text
    source: Text
    published: str
    exact: bool = False
    tolerance: Tolerance | None = None
    tolerance_reason: Text | None = None
    null: float | None = None
    not_comparable: Text | None = None


class ConclusionValue(Derived, frozen=True):
    """A number in a conclusion: at one place of the grid, or the ``least`` or ``largest`` of several.

    It must meet the conditions ``above``, ``below`` and ``equals``, in the unit of the output, within three of its
    errors.  Otherwise the sentences that use it are reported as not found, or as not judged if its error is not known.
    """

    choose: Literal["least", "largest"] | None = None
    above: float | None = None
    below: float | None = None
    equals: float | None = None

    @property
    def has_bounds(self) -> bool:
        """Whether there is a condition."""
        return any(bound is not None for bound in (self.above, self.below, self.equals))


class Conclusion(Section, frozen=True):
    """What a study found: sentences, with ``{name}`` in place of each of the ``values``.

    ``{name}`` is the number rounded, with a unit; ``{name:error}`` has its error beside it; ``{name:%}`` is in percent.
    ``{name} ± {other}`` is a number with another as its error, in one unit.
    """

    sentences: list[Text] = Field(min_length=1)
    values: dict[str, ConclusionValue] = Field(default_factory=dict)


class GridForm(Section):
    """The table [grid]."""

    zip: list[list[str]] = Field(default_factory=list)


class PointsForm(Section):
    """The table [points]: exactly one of ``file``, ``design`` and ``columns``.

    ``derive`` names a function of a row that gives further columns; ``origin`` is where the columns in a store come
    from.
    """

    file: str | None = None
    design: str | None = None
    n: Count | None = None
    seed: Seed = 0
    ranges: dict[str, Any] = Field(default_factory=dict)
    columns: dict[str, list[Any]] | None = None
    units: dict[str, str] = Field(default_factory=dict)
    derive: str | None = None
    origin: dict[str, Any] | None = None


class PublishedForm(Section):
    """The table [published]."""

    file: str
    source: Text
    tolerance: Tolerance | None = None
    tolerance_reason: Text | None = None


class FigureForm(Section, frozen=True):
    """The table [figure]: axes and results that are drawn on a logarithmic or a linear axis, whatever their spacing."""

    log: list[str] = Field(default_factory=list)
    linear: list[str] = Field(default_factory=list)


class Form(Section):
    """The fixed part of a study file; axes and parameters are checked against the experiment."""

    title: Text
    question: Text | None = None
    experiment: str = DEFAULT_EXPERIMENT
    axes: dict[str, Any] = Field(default_factory=dict)
    fixed: dict[str, Any] = Field(default_factory=dict)
    define: dict[str, dict[str, dict[str, Any]]] = Field(default_factory=dict)
    sampling: Sampling = Sampling()
    grid: GridForm = GridForm()
    points: PointsForm | None = None
    exclude: list[dict[str, Any]] = Field(default_factory=list)
    published: PublishedForm | None = None
    claim: list[Claim] = Field(default_factory=list)
    conclusion: Conclusion | None = None
    figure: FigureForm = FigureForm()


def printed_rounding(text: str) -> float:
    """Return half a unit of the last digit of a number as printed: 0.005 for '0.60'; NaN for any other text."""
    try:
        exponent = Decimal(text).as_tuple().exponent
    except InvalidOperation:
        return math.nan
    return float(f"5e{exponent - 1}") if isinstance(exponent, int) else math.nan


@dataclass(frozen=True)
class Condition:
    """One clause of an exclusion: the parameter's value is in ``among``, or above and below the bounds that are
    given.
    """

    name: str
    among: tuple[Value, ...] | None = None
    above: float | None = None
    below: float | None = None

    def holds(self, value: Any) -> bool:
        """Return whether a parameter's value meets the condition."""
        if self.among is not None:
            return value in self.among
        return (self.above is None or value > self.above) and (self.below is None or value < self.below)


@dataclass(frozen=True)
class Published:
    """Published results: rows of {column: number as printed}, the columns being axes and outputs.

    ``tolerance`` (relative, 0 for none) is how far computed values may be from them beyond rounding and Monte-Carlo
    error, for the reason that ``tolerance_reason`` gives.
    """

    source: str
    rows: tuple[Mapping[str, str], ...]
    tolerance: float = 0.0
    tolerance_reason: str = ""


POINT = "point"
"""The dimension of the points of a table or a design, which are in no order."""

POINT_TABLE = "point_table"
"""The attribute of results that have this dimension: JSON of the table's parameters, and where it comes from."""


@dataclass(frozen=True)
class PointTable:
    """A table of points: the parameters that its columns are, and what it comes from.

    ``origin`` has ``file``, or ``design``, ``n``, ``seed`` and ``ranges`` as the study writes them.
    """

    names: tuple[str, ...]
    origin: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Study:
    """A study that was read and checked, as `linksweep.load_study` returns it.

    Attributes:
        name: names its store.
        title: the heading of tables, figures and reports.
        experiment_reference: ``module:attribute`` or ``file.py:attribute`` of the experiment.
        experiment: what it sweeps.
        axes: the values of each parameter that is swept.
        fixed: the other parameters that it sets.
        sampling: how many realisations, and the seed.
        zipped: groups of axes that share a dimension.
        points: the columns of a table of points, which share a dimension and in which values may repeat.
        excluded: the conditions under which points are left out.
        published: published results.
        source: the file that it was read from.
        question: what it asks, for reports.
        claims: published statements, with the numbers that they are about.
        conclusion: the sentences of its answer.
        text: the file as written.
        overrides: what the command line changed.
        document: what a store needs to make the study again: with overrides, and with absolute paths of files.
    """

    name: str
    title: str
    experiment_reference: str
    experiment: Experiment = field(repr=False)
    axes: Mapping[str, tuple[Value, ...]]
    fixed: Mapping[str, Value]
    sampling: Sampling
    zipped: tuple[tuple[str, ...], ...] = ()
    points: PointTable | None = None
    excluded: tuple[tuple[Condition, ...], ...] = ()
    published: Published | None = None
    source: str = ""
    question: str = ""
    claims: tuple[Claim, ...] = ()
    conclusion: Conclusion | None = None
    text: str = ""
    overrides: tuple[str, ...] = ()
    document: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @property
    def dimensions(self) -> dict[str, tuple[str, ...]]:
        """The axes along each dimension, by the dimension's name: `POINT`, or the first of these axes."""
        groups = [] if self.points is None else [(POINT, self.points.names)]
        partner = {name: group for group in self.zipped for name in group}
        groups += [(group[0], group) for group in (partner.get(name, (name,)) for name in self.axes)]
        dimensions: dict[str, tuple[str, ...]] = {}
        for dimension, group in groups:
            if not any(group[0] in axes for axes in dimensions.values()):
                dimensions[dimension] = group
        return dimensions

    @property
    def is_ours(self) -> bool:
        """Whether only code that comes with linksweep computes it."""
        return self.experiment_reference.partition(".")[0] == "linksweep" and not self.document.get("define")

    @property
    def keeps_samples(self) -> bool:
        """Whether the ledger holds realisations: the study or the experiment asks for them."""
        return self.sampling.keep_samples or self.experiment.keeps_samples

    def meaning(self) -> dict[str, Any]:
        """Return what determines the results of every point besides its own parameters: if this differs, results cannot
        be mixed.
        """
        defaults = self.experiment.defaults()
        return {
            "experiment": self.experiment.name,
            "experiment_version": self.experiment.version,
            **({} if self.experiment.deterministic else {"seed": self.sampling.seed}),
            **({"keep_samples": True} if self.sampling.keep_samples else {}),
            **({"common_random_numbers": True} if self.sampling.common_random_numbers else {}),
            "fixed": {k: v for k, v in sorted(self.fixed.items()) if v != defaults[k]},
        }

    def numbers(self) -> dict[str, int]:
        """Return how many realisations there are, nothing where a point is computed once."""
        if self.experiment.deterministic:
            return {}
        return {"n_sim": self.sampling.n_sim, "n_cat": self.sampling.n_cat}

    def digest(self) -> str:
        """Return a SHA-256 of everything that determines the results, whatever the layout of the file."""
        whole = self.meaning() | {
            "axes": self.axes,
            **self.numbers(),
            **({} if self.sampling.precision is None else {"precision": [self.sampling.precision, self.sampling.most]}),
            "zip": self.zipped,
            **({} if self.points is None else {"points": self.points.names}),
            "exclude": [[vars(c) for c in clause] for clause in self.excluded],
        }
        return hashlib.sha256(json.dumps(whole, sort_keys=True, default=content_digest).encode()).hexdigest()
