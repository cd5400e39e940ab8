"""The sections of a study file, each with the checks of what stands in it; and the `Study` that comes of them."""

import hashlib
import json
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal, InvalidOperation
from functools import cached_property
from itertools import count, groupby
from string import Formatter
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from linksweep.sweep.contract import Experiment, Named, Parameter, Value, is_number, nearest, number_at, shown, suggest
from linksweep.sweep.formatting import ESCAPED, first_of
from linksweep.sweep.tables.columns import content_digest

# The experiment of a study that names none; any store may name it, as it comes with linksweep.
DEFAULT_EXPERIMENT = "linksweep.core.experiment:link"

# `Sampling.max_n_sim` where a study says nothing: enough for an error of 0.04 % of an RMS.
MOST_SIMS = 1_000_000

# What may follow a name in a sentence: nothing for the number, ``:error`` for its error beside it, ``:%`` for percent.
FORMATS = ("", "error", "%")


@dataclass(frozen=True)
class Context:
    """What sections of a study are checked against, once its experiment and its axes are known.

    Of ``axes`` and ``columns``, those that are wrong may be None; ``known`` are all parameters that the study sets.
    ``changed`` are those that the command line changed: a claim that no longer fits them is not a mistake of the study,
    and is left for the comparison to report.  ``compared`` reads a value of a condition.
    """

    experiment: Experiment
    axes: Mapping[str, tuple[Value, ...] | None]
    zipped: Sequence[Sequence[str]]
    known: frozenset[str]
    changed: frozenset[str]
    compared: Callable[[Parameter, Any], Value] = Parameter.parse
    columns: Mapping[str, tuple[Value, ...] | None] = field(default_factory=dict)

    def values(self, name: str) -> tuple[Value, ...] | None:
        """Return the values of an axis or column, None where they are not known, or may be others than the study means.

        Raises ValueError where there is no such axis.
        """
        if name in self.changed:
            return None
        if name not in (there := {**self.axes, **self.columns}):
            raise ValueError(
                f"{shown(name)} is not an axis{suggest(name, [*there]) if there else '; the study has none'}"
            )
        return there[name]

    def partners(self, name: str) -> Sequence[str]:
        """Return the axes, or the columns, that advance together with one."""
        return next((group for group in (*self.zipped, [*self.columns]) if name in group), [name])


def _checked(check: Callable[[Any, Context], Any]) -> AfterValidator:
    """Return a validator that checks a value against a `Context`, and takes it as it is where there is none."""
    return AfterValidator(lambda value, info: value if info.context is None else check(value, info.context))


def _each(check: Callable[[str, Any, Context], Any]) -> AfterValidator:
    """Return a validator that checks each entry of a table by its name against a `Context`."""

    def check_all(table: dict[str, Any], context: Context) -> dict[str, Any]:
        entries, errors = dict[str, Any](), list[InitErrorDetails]()
        for name, raw in table.items():
            try:
                entries[name] = check(name, raw, context)
            except ValueError as error:
                # A validator of the values of a table does not know their keys, so places are given here.
                kind = PydanticCustomError("value_error", "{error}", {"error": str(error)})
                errors.append(InitErrorDetails(type=kind, loc=(name,), input=raw))
        if errors:
            raise ValidationError.from_exception_data("study", errors)
        return entries

    return _checked(check_all)


def printed_rounding(text: str) -> float:
    """Return half a unit of the last digit of a number as printed: 0.005 for '0.60'; NaN for any other text."""
    try:
        exponent = Decimal(text).as_tuple().exponent
    except InvalidOperation:
        return math.nan
    return float(f"5e{exponent - 1}") if isinstance(exponent, int) else math.nan


def _names(value: Value) -> list[tuple[Value, bool]]:
    """Return under what a condition knows a value, told apart as by `is_other`."""
    names = [value, value.name, content_digest(value)] if isinstance(value, Named) else [value]
    return [(name, type(name) is bool) for name in names]


@dataclass(frozen=True)
class Condition:
    """A condition of an exclusion or an effect: a parameter's value is in ``among``, or above and below the bounds that
    are given.  An object is known there by its label or its digest.
    """

    name: str
    among: tuple[Value, ...] | None = None
    above: float | None = None
    below: float | None = None

    def holds(self, value: Any) -> bool:
        """Return whether a parameter's value meets the condition."""
        if self.among is not None:
            return not self._among.isdisjoint(_names(value))
        value = value.value if isinstance(value, Named) else value
        return (
            isinstance(value, int | float)
            and type(value) is not bool
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
        )

    def written(self, parameter: Parameter) -> dict[str, Any]:
        """Return it as a study file has it, objects as their digests."""
        among = None if self.among is None else [*map(parameter.written, self.among)]
        rule = {"in": among, "above": self.above, "below": self.below}
        return {key: value for key, value in rule.items() if value is not None}

    def unmet(self, values: Sequence[Value], is_declared: bool) -> str:
        """Return a sentence where none of some values meets it, or where one of ``among`` looks misspelt, unless it
        ``is_declared`` for studies with other values; '' elsewhere.
        """
        there = {name for value in values for name in _names(value)} if self.among else set()
        lacking = [value for value in self.among or () if there.isdisjoint(_names(value))]
        named = [value for value in lacking if not str(value).startswith("sha256:")][:20]
        known = list(dict.fromkeys(str(value) for value in values if isinstance(value, str | Named)))[:1000]
        near = [value for value in named if nearest(str(value), known)]
        if any(map(self.holds, values)) and (is_declared or not near):
            return ""
        hints = [f": {shown(value)}{suggest(str(value), known)}" for value in [*near, *named][:1]]
        return f"no point has such a value of {self.name}{''.join(hints)}"

    @cached_property
    def _among(self) -> frozenset[tuple[Value, bool]]:
        """What is ``among``; there may be thousands, and a million points to ask."""
        return frozenset(name for value in self.among or () for name in _names(value))


def are_met(conditions: Iterable[Condition], parameters: Mapping[str, Any], gone: Collection[str]) -> bool:
    """Return whether a point meets all conditions; parameters that are ``gone``, without effect there, meet none."""
    return all(one.name not in gone and one.holds(parameters[one.name]) for one in conditions)


def _condition(name: str, written: Any, context: Context) -> Condition:
    parameter = context.experiment.parameter(name)
    rule: dict[str, Any] = written if isinstance(written, dict) else {"equal": written}
    if not rule or rule.keys() - {"above", "below", "equal", "in"}:
        raise ValueError(f"unknown condition {shown(list(rule))}; allowed are above, below, equal, in")
    listed = [rule["equal"]] if "equal" in rule else rule.get("in")
    if listed is not None:
        if not isinstance(listed, list) or len(rule) > 1:
            raise ValueError("'in' takes a list, and 'in' or 'equal' stands alone")
        return Condition(name, among=tuple(context.compared(parameter, raw) for raw in listed))
    values = context.axes.get(name) or ()
    are_numbers = parameter.kind == "any" and all(value is None or is_number(value) for value in values)
    if parameter.kind not in ("float", "int") and not are_numbers:
        raise ValueError(f"{name} has no order: use equal or in")
    if parameter.default is None and name not in context.known:
        raise ValueError(f"{name} has no value to compare: it is neither an axis nor fixed, and has no default")
    bounds = (number_at(key, rule) if key in rule else None for key in ("above", "below"))
    above, below = (bound if bound is None or bound != float(bound) else float(bound) for bound in bounds)
    return Condition(name, above=above, below=below)


def _place(name: str, raw: Any, context: Context) -> Value:
    """Return the value of an axis as the grid has it, of an object its label."""
    values = context.values(name)
    value = context.compared(context.experiment.parameter(name), raw)
    there = [value] if values is None else [one for one in values if (value, type(value) is bool) in _names(one)]
    if not there:
        listed = first_of([shown(one) for one in dict.fromkeys(values or ())], 20)
        raise ValueError(f"{shown(raw)} is not on the axis, which has {listed}")
    return there[0].name if isinstance(there[0], Named) else there[0]


def _variable(name: str, context: Context) -> str:
    outputs = {output.name: output for output in context.experiment.outputs if output.name not in context.axes}
    if context.experiment.undeclared and name not in context.experiment.defaults():
        return name  # what it is not is said where numbers are compared
    if name not in outputs:
        raise ValueError(f"{shown(name)} is no output{suggest(name, list(outputs))}")
    if len(dims := outputs[name].dims) > 1:
        raise ValueError(f"{name} has the dimensions {', '.join(dims)}; at most one is allowed")
    return name


def _over(name: str, context: Context) -> str:
    values = context.values(name)
    if values is not None and all(one.name != name or not one.optional for one in context.experiment.parameters):
        values = tuple(value for value in values if value is not None)  # which says that it has no effect
    if values is not None and (len(values) < 2 or not all(is_number(value) and value > 0 for value in values)):
        raise ValueError(f"{shown(name)} needs at least two numbers, all above 0, for a power law")
    return name


def _drawn(name: str, context: Context) -> str:
    experiment = context.experiment
    known = [*experiment.defaults(), *(output.name for output in experiment.outputs), *experiment.coordinates]
    if name not in known and not experiment.undeclared:
        raise ValueError(f"{shown(name)} is neither a parameter nor an output{suggest(name, known)}")
    return name


def _drawn_log(name: str, context: Context) -> str:
    values = context.axes.get(_drawn(name, context)) if name not in context.changed else None
    if wrong := [value for value in values or () if not is_number(value) or value <= 0]:
        raise ValueError(f"{name} = {shown(wrong[0])}: a logarithmic axis has only numbers above zero")
    return name


def _drawn_at(name: str, raw: Any, context: Context) -> Any:
    labels = context.experiment.coordinates.get(name)
    if labels is None:
        return raw if context.experiment.undeclared and name not in context.axes else _place(name, raw, context)
    if raw not in labels:
        raise ValueError(f"{shown(raw)} is none of {', '.join(map(str, labels))}")
    return raw


def _zip(group: list[str], context: Context) -> list[str]:
    for name in group:
        if name not in context.axes:
            raise ValueError(f"{shown(name)} is not an axis{suggest(name, list(context.axes))}")
    lengths = {name: len(values) for name in group if (values := context.axes[name]) is not None}
    if len(group) < 2 or len(set(group)) < len(group) or len(set(lengths.values())) > 1:
        sizes = ", ".join(f"{name} has {n}" for name, n in lengths.items())
        raise ValueError(f"{shown(group)}: name two or more axes with the same number of values; {sizes}")
    return group


def _plain(text: str) -> str:
    if hidden := next((c for c in text if ord(c) in ESCAPED or "\ud800" <= c <= "\udfff"), None):
        raise ValueError(f"{shown(text)} holds the control character U+{ord(hidden):04X}, which a terminal would obey")
    return text


def _as_printed(text: str) -> str:
    if not math.isfinite(printed_rounding(text)) or not math.isfinite(float(text)):
        raise ValueError(f"{shown(text)}: must be a number as printed, in quotes, like '0.60'")
    return text


def _sentence(text: str) -> str:
    ways = "{name}, {name:error} or {name:%} stands for a value, and {{ for a brace"
    try:
        for _, name, written, conversion in Formatter().parse(text):
            if name is not None and (conversion or (written or "") not in FORMATS or not name.isidentifier()):
                raise ValueError(f"{shown(name)} is no value")
    except ValueError as error:  # of stray braces too
        raise ValueError(f"{shown(text)}: {error}; {ways}") from error
    return text


Seed = Annotated[int, Field(ge=0, lt=2**64)]
Count = Annotated[int, Field(ge=1, le=10**9)]
Tolerance = Annotated[float, Field(gt=0.0, lt=1.0)]
Several = Annotated[list[Any], Field(min_length=1)]
# A sentence for people, in one line.
Text = Annotated[str, AfterValidator(_plain)]

# Values of axes, which are a place of the grid.
Places = Annotated[dict[str, Any], _each(_place)]


class Section(BaseModel):
    """A table of the study file: unknown keys and values of another type are errors.

    Without a `Context` only its form is checked.
    """

    model_config = ConfigDict(extra="forbid", strict=True, defer_build=True)


class Sampling(Section):
    """How many realisations: ``n_sim`` for each of ``n_cat`` catalogues, from one ``seed``.

    With a ``precision`` a point gets at least ``n_sim`` and at most ``max_n_sim``, both rounded up to whole parts,
    until the relative Monte-Carlo error of its headline results is below the precision.  With
    ``common_random_numbers`` points that differ only in parameters that do not change the random numbers draw the same
    ones.
    """

    n_sim: Count = Field(1000, description="realisations of each catalogue")
    n_cat: Count = Field(1, description="catalogues of each point, an outer draw that realisations share")
    seed: Seed = Field(0, description="same seed, same numbers, on any number of workers")
    keep_samples: bool = Field(False, description="keep every single estimate too")
    precision: Tolerance | None = Field(
        None,
        description="relative error of the headline results at which a point stops, after n_sim at least",
        examples=[0.01],
    )
    max_n_sim: Count | None = Field(None, description="but not more than these, in whole parts", examples=[MOST_SIMS])
    common_random_numbers: bool = Field(
        False, description="let points share what they can: ratios and exponents have far less noise"
    )

    @property
    def most(self) -> int:
        """The most realisations of a catalogue, for a point that must reach a precision."""
        return max(self.n_sim, MOST_SIMS) if self.max_n_sim is None else self.max_n_sim

    @model_validator(mode="after")
    def _no_contradiction(self, info: ValidationInfo) -> Self:
        if info.context is None:
            return self
        experiment: Experiment = info.context.experiment
        if experiment.deterministic:
            if keys := ", ".join(sorted(self.model_fields_set)):
                raise ValueError(f"{experiment.name} takes no rng and is evaluated once: leave out {keys}")
            return self
        if experiment.draws_alone and experiment.shared and "common_random_numbers" not in self.model_fields_set:
            self.common_random_numbers = True
        precise, most, keeps = self.precision is not None, self.max_n_sim, experiment.samples or experiment.draws_alone
        judged, beyond = experiment.errors_of_headline(), most is not None and most < self.n_sim
        wrong = {
            "n_cat: it has no outer draw that realisations share": self.n_cat > 1 and not experiment.outer_draw,
            "keep_samples: it has no samples to keep": self.keep_samples and not keeps,
            "common_random_numbers: no parameter leaves its random numbers unchanged": (
                self.common_random_numbers and not experiment.shared
            ),
            "max_n_sim: has an effect only with a precision, which is not set": most is not None and not precise,
            f"max_n_sim = {most}: must be at least n_sim = {self.n_sim}": precise and beyond,
            "precision: points would keep different numbers with keep_samples": precise and self.keep_samples,
            "precision: no headline result X has an error X_mc_error to judge by": precise and not judged,
        }
        if sentences := [sentence for sentence, is_so in wrong.items() if is_so]:
            raise ValueError(f"not with {experiment.name}: {'; '.join(sentences)}")
        return self


class Quantity(Section, frozen=True):
    """A number that the grid gives, of one component of an output."""

    variable: Annotated[str, _checked(_variable)]
    component: Any = None

    @property
    def places(self) -> dict[str, dict[str, Any]]:
        """The places of the grid that it names, by their keys."""
        return {key: place for key, place in self if isinstance(place, dict)}

    @model_validator(mode="after")
    def _has_component(self, info: ValidationInfo) -> Self:
        if self.component is not None and type(self.component) not in (str, int, float):
            raise ValueError(f"component = {shown(self.component)}: must be a text or a number")
        if info.context is not None and not info.context.experiment.undeclared:
            (output,) = (one for one in info.context.experiment.outputs if one.name == self.variable)
            labels = info.context.experiment.coordinates[output.dims[0]] if output.dims else ()
            if self.component not in (labels or (None,)):
                wanted = f"one of {', '.join(labels)}" if labels else f"left out: {self.variable} is one number"
                raise ValueError(f"component = {shown(self.component)}: must be {wanted}")
        return self


class Slope(Quantity, frozen=True):
    """The exponent p of variable ~ over**p along an axis."""

    over: Annotated[str, _checked(_over)]


class Ratio(Quantity, frozen=True):
    """The variable at one place of the grid divided by that at another."""

    of: Places
    to: Places

    @model_validator(mode="after")
    def _two_places(self) -> Self:
        if set(self.of) != set(self.to) or self.of == self.to:
            raise ValueError("'of' and 'to' must give different values of the same axes")
        return self


class Reading(Quantity, frozen=True):
    """The variable at one place of the grid."""

    at: Places = Field(default_factory=dict)


class Derived(Section, frozen=True):
    """A number that is derived from the grid: exactly one of ``slope``, ``ratio`` and ``value``.

    ``where`` fixes axes for any of the three; an axis that is fixed nowhere gives one number for each of its values.
    """

    slope: Slope | None = None
    ratio: Ratio | None = None
    value: Reading | None = None
    where: Places = Field(default_factory=dict)

    def quantity(self) -> Slope | Ratio | Reading:
        """Return the one quantity of a valid table; raises ValueError if there is not exactly one."""
        quantities = [q for q in (self.slope, self.ratio, self.value) if q is not None]
        if len(quantities) != 1:
            raise ValueError("needs exactly one of slope, ratio and value")
        return quantities[0]

    @model_validator(mode="after")
    def _one_quantity(self, info: ValidationInfo) -> Self:
        quantity = self.quantity()
        if twice := [name for place in quantity.places.values() for name in place if name in self.where]:
            raise ValueError(f"{', '.join(twice)}: is given by 'where' too; leave out one of the two")
        if isinstance(quantity, Slope):
            partners = [quantity.over] if info.context is None else info.context.partners(quantity.over)
            if fixed := [name for name in partners if name in self.where]:
                raise ValueError(f"{shown(quantity.over)} cannot vary, because 'where' fixes {', '.join(fixed)}")
        return self


class Printed(Section, frozen=True):
    """What is known of a published number: how far ours may be from it besides errors and rounding, and why."""

    source: Text
    tolerance: Tolerance | None = None
    tolerance_reason: Text | None = None

    @model_validator(mode="after")
    def _has_reason(self) -> Self:
        if (self.tolerance is None) != (self.tolerance_reason is None):
            raise ValueError("a tolerance needs a tolerance_reason, and the other way round")
        return self


class Claim(Derived, Printed, frozen=True):
    """A published statement about a number that can be derived from the grid.

    ``published`` is the number as printed, so that its rounding is known; an ``exact`` law has none.  ``null`` is
    the number without the effect that is claimed, which a verdict must tell from the published one; ``not_comparable``
    says why there can be no verdict.
    """

    text: Text
    published: Annotated[str, AfterValidator(_as_printed)]
    exact: bool = False
    null: Annotated[float, Field(allow_inf_nan=False)] | None = None
    not_comparable: Text | None = None

    @model_validator(mode="after")
    def _verdict_is_possible(self) -> Self:
        if self.null is not None and self.published == str(self.null):
            raise ValueError(f"null = {self.null}: must not be the published number")
        return self


class ConclusionValue(Derived, frozen=True):
    """A number in a conclusion: at one place of the grid, or the ``least`` or ``largest`` of several.

    It must meet the conditions ``above``, ``below`` and ``equals``, in the unit of the output, within three of its
    errors.  Otherwise the sentences that use it are reported as not found, or as not judged if its error is not known.
    """

    choose: Literal["least", "largest"] | None = None
    above: float | None = None
    below: float | None = None
    equals: float | None = None

    @model_validator(mode="after")
    def _one_number(self, info: ValidationInfo) -> Self:
        context, quantity = info.context, self.quantity()
        if context is None or self.choose is not None:
            return self
        fixed = {*self.where, *(name for place in quantity.places.values() for name in place), *context.changed}
        # the exponent along an axis is one number for all of its values
        fixed |= {quantity.over} if isinstance(quantity, Slope) else set()
        for name, values in {**context.axes, **context.columns}.items():
            if len(values or ()) > 1 and not fixed & {*context.partners(name)}:
                raise ValueError(
                    f"{name} has several values; fix it with 'where', or choose the least or largest number"
                )
        return self


class Conclusion(Section, frozen=True):
    """What a study found: sentences, with ``{name}`` in place of each of the ``values``.

    ``{name}`` is the number rounded, with a unit; ``{name:error}`` has its error beside it; ``{name:%}`` is in percent.
    ``{name} ± {other}`` is a number with another as its error, in one unit.
    """

    sentences: list[Annotated[Text, AfterValidator(_sentence)]] = Field(min_length=1)
    values: dict[str, ConclusionValue] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _sentences_have_values(self) -> Self:
        names = {name for sentence in self.sentences for _, name, *_ in Formatter().parse(sentence) if name is not None}
        if missing := sorted(names - self.values.keys()):
            raise ValueError(f"sentences: unknown value {shown(missing[0])}{suggest(missing[0], list(self.values))}")
        return self


class GridForm(Section):
    """The table [grid]."""

    zip: list[Annotated[list[str], _checked(_zip)]] = Field(default_factory=list)

    @model_validator(mode="after")
    def _each_axis_once(self) -> Self:
        names = [name for group in self.zip for name in group]
        if len(set(names)) < len(names):
            raise ValueError(f"zip = {shown(self.zip)}: an axis is zipped twice")
        return self


class PointsForm(Section):
    """The table [points]: exactly one of ``file``, ``design`` and ``columns``.

    ``derive`` names a function of a row that gives further columns; ``labels`` are the columns that are no parameters,
    but say what a point is; ``origin`` is where the columns in a store come from.
    """

    file: str | None = None
    design: Literal["sobol", "latin-hypercube", "halton", "random", "saltelli", "morris"] | None = None
    n: Count | None = None
    seed: Seed = 0
    ranges: dict[str, Any] = Field(default_factory=dict)
    columns: dict[str, list[Any]] | None = None
    units: dict[str, str] = Field(default_factory=dict)
    derive: str | None = None
    labels: list[str] = Field(default_factory=list)
    origin: dict[str, Any] | None = None

    @property
    def source(self) -> str:
        """Which of the three it is."""
        return "file" if self.file is not None else "design" if self.design is not None else "columns"

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if [self.file, self.design, self.columns].count(None) != 2:
            raise ValueError("needs exactly one of file (--points), design (--design) and columns")
        keys = {"file": "units labels", "design": "n seed ranges", "columns": "units labels origin"}[self.source]
        if stray := sorted(self.model_fields_set - {*keys.split(), self.source, "derive"}):
            raise ValueError(f"{', '.join(stray)}: does not go with {self.source}")
        if self.design is not None and (self.n is None or not self.ranges):
            raise ValueError(f"n = {self.n}, ranges = {shown(self.ranges)}: needs both (--design sobol:8, --range)")
        return self


class PublishedForm(Printed, frozen=True):
    """The table [published]; ``where`` has the values of axes that its file has no column of, by default those of
    [fixed].
    """

    file: str
    where: dict[str, Any] = Field(default_factory=dict)


class FigureForm(Section, frozen=True):
    """The table [figure]: the figure that answers the study, instead of the one that suits its results, and the axes
    and results with a logarithmic or a linear axis, whatever their spacing.

    ``variable``, ``kind``, ``over`` and ``at`` are the options of `sweep plot`.
    """

    variable: Annotated[str, _checked(_drawn)] = ""
    kind: str | None = None
    over: list[Annotated[str, _checked(_drawn)]] = Field(default_factory=list)
    at: Annotated[dict[str, Any], _each(_drawn_at)] = Field(default_factory=dict)
    log: list[Annotated[str, _checked(_drawn_log)]] = Field(default_factory=list)
    linear: list[Annotated[str, _checked(_drawn)]] = Field(default_factory=list)


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
    exclude: list[Annotated[dict[str, Any], Field(min_length=1), _each(_condition)]] = Field(default_factory=list)
    counts: dict[str, Annotated[int, Field(ge=0, le=10**9)]] = Field(default_factory=dict)
    when: dict[str, Annotated[dict[str, Several], Field(min_length=1)]] = Field(default_factory=dict)
    published: PublishedForm | None = None
    claim: list[Claim] = Field(default_factory=list)
    conclusion: Conclusion | None = None
    figure: FigureForm = FigureForm()


# That of docs/errors.md; a run writes the results of a store of another one anew from its blocks.
CONVENTION = 4

# The attribute of a store that says which part of a study it holds.
PART = "part"

# The attribute of a merged store with the numbers of the parts that lack a block, in words.
LOST = "lost_parts"

MOST_PARTS = 100_000

# What SLURM sets for the tasks of a job array.
TASK = "SLURM_ARRAY_TASK_ID"


@dataclass(frozen=True, order=True)
class Part:
    """The part with a ``number``, from 1, of so many in ``total``; as text 3/100."""

    total: int
    number: int

    @classmethod
    def parsed(cls, text: str) -> "Part":
        """Return the part that a user names; raises ValueError for anything else.

        >>> Part.parsed("3/100")
        Part(total=100, number=3)
        """
        match = re.fullmatch(r"\s*(\d{1,6})\s*/\s*(\d{1,6})\s*", str(text))
        number, total = (int(match[1]), int(match[2])) if match else (0, 0)
        if not 1 <= number <= total <= MOST_PARTS:
            raise ValueError(f"{shown(text)}: must be K/N, part K from 1 to N, of N parts from 1 to {MOST_PARTS:,}")
        return cls(total, number)

    @classmethod
    def of_task(cls, environment: Mapping[str, str]) -> "Part":
        """Return the part of a task of a job array of SLURM, whose first task has part 1 whatever its number; raises
        ValueError where this is none, and for an array with gaps, which is some tasks of a larger one.
        """
        names = (TASK, "SLURM_ARRAY_TASK_MIN", "SLURM_ARRAY_TASK_MAX", "SLURM_ARRAY_TASK_COUNT")
        task, first, last, tasks = (int(text) if (text := environment.get(n, "")).isdecimal() else -1 for n in names)
        if min(task, first, last, tasks) < 0 or last - first + 1 != tasks:
            words = "do not say which of how many parts this is; name the part, as in --part"
            raise ValueError(f"array: {', '.join(names)} {words} ${TASK}/100")
        return cls.parsed(f"{task - first + 1}/{tasks}")

    def __str__(self) -> str:
        return f"{self.number}/{self.total}"

    def place(self, store: object) -> str:
        """Return where this part of a store is."""
        return f"{store}.part-{self.number}-of-{self.total}"

    @classmethod
    def recorded(cls, attributes: Mapping[str, Any]) -> "Part | None":
        """Return the part that a store with these attributes holds, None for all of a study; raises as `parsed`."""
        return cls.parsed(attributes[PART]) if PART in attributes else None

    @classmethod
    def named(cls, place: object) -> "Part | None":
        """Return the part whose `place` it is by its name, None for another place."""
        match = re.search(r"\.part-([1-9]\d{0,5})-of-([1-9]\d{0,5})$", str(place))
        return cls(int(match[2]), int(match[1])) if match else None

    @classmethod
    def among(cls, names: Iterable[str], store: str) -> "list[Part]":
        """Return the parts of a store whose places are among these names, in their order."""
        return sorted(part for name in names if (part := cls.named(name)) and name == part.place(store))

    @classmethod
    def places(cls, name: Any) -> list[Any]:
        """Return the places of all parts that ``STORE.part-*-of-N`` names; another name itself, but no lock or so.

        >>> Part.places("s.zarr.part-*-of-2")
        ['s.zarr.part-1-of-2', 's.zarr.part-2-of-2']
        """
        match = re.fullmatch(r"(?s)(.*)\.part-(\*-of-([1-9]\d{0,5})|\d+-of-\d+\.(lock|damaged|rescued).*)", str(name))
        total = int(match[3] or 0) if match else 0
        return [cls(total, k + 1).place(match[1]) for k in range(total)] if match else [name]


def in_ranges(numbers: Iterable[int]) -> str:
    """Return whole numbers in ascending order, neighbours joined.

    >>> in_ranges([7, 1, 2, 3])
    '1-3, 7'
    """
    places = count()
    runs = [list(run) for _, run in groupby(sorted(numbers), key=lambda number: number - next(places))]
    return ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)


@dataclass(frozen=True)
class Published:
    """Published results: rows of {column: number as printed}, the columns being axes and outputs, what is known of
    them, and ``where`` they are along further axes, unless at the default.
    """

    about: PublishedForm
    rows: tuple[Mapping[str, str], ...]
    where: Mapping[str, Value]

    @property
    def digest(self) -> str:
        """A digest of the numbers."""
        return hashlib.sha256(str(self.rows).encode()).hexdigest()


# The dimension of the points of a table or a design, which are in no order.
POINT = "point"

# The attribute of results that have this dimension: JSON of the table's parameters, and where it comes from.
POINT_TABLE = "point_table"


@dataclass(frozen=True)
class PointTable:
    """A table of points: the parameters that its columns are, what it comes from, and the labels of its rows by name.

    ``origin`` has ``file``, or ``design``, ``n``, ``seed`` and ``ranges`` as the study writes them.
    """

    names: tuple[str, ...]
    origin: Mapping[str, Any] = field(default_factory=dict)
    labels: Mapping[str, Sequence[Any]] = field(default_factory=dict)

    def written(self, columns: Mapping[str, Any]) -> dict[str, Any]:
        """Return the table [points] that has these columns and what is known of them."""
        further = {"labels": list(self.labels), "origin": dict(self.origin)}
        return {"columns": {**columns, **self.labels}} | {key: value for key, value in further.items() if value}


def is_other(value: object, default: object) -> bool:
    """Return whether a value is another one than a parameter's default; True is 1 to Python, but another value."""
    return value != default or (type(value) is bool) != (type(default) is bool)


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
        counts: a larger n_sim of single points, by their digests, or 0 for those that are left out, as `sweep refine`
            has them.
        when: the conditions under which parameters have an effect, for each those on others; at a point where one is
            not met the parameter is missing, None.  A grid has this one point beside those with the values of its axis.
        published: published results.
        source: the file that it was read from.
        question: what it asks, for reports.
        claims: published statements, with the numbers that they are about.
        conclusion: the sentences of its answer.
        text: the file as written.
        overrides: what the command line changed.
        sections: what a store needs beside these to make the study again, as written: all that is no value of a
            parameter, with overrides, and with absolute paths of files.
        part: the part of its work that is computed, None for all.
        description: what the docstring of a function says, without its title.
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
    counts: Mapping[str, int] = field(default_factory=dict)
    when: Mapping[str, tuple[Condition, ...]] = field(default_factory=dict)
    published: Published | None = None
    source: str = ""
    question: str = ""
    claims: tuple[Claim, ...] = ()
    conclusion: Conclusion | None = None
    text: str = ""
    overrides: tuple[str, ...] = ()
    sections: Mapping[str, Any] = field(default_factory=dict, repr=False)
    part: Part | None = None
    description: str = ""

    def __repr__(self) -> str:
        return f"<Study {self.name} over {', '.join(self.axes) or 'one point'}: {self.title!r}>"

    @cached_property
    def document(self) -> dict[str, Any]:
        """What a store needs to make the study again: the values of a table of points and not the file or the function
        that gave them, since a store is continued as it was begun.
        """
        known = {one.name: one for one in self.experiment.parameters}
        columns = () if self.points is None else self.points.names
        axes = {name: known[name].written(values) for name, values in self.axes.items()}
        table = None if self.points is None else self.points.written({name: axes.pop(name) for name in columns})
        zipped = [list(names) for names in self.zipped]
        sampling = self.sampling.model_dump(exclude_none=True, exclude_unset=True)
        values = {
            "axes": axes,
            "fixed": {name: known[name].written(value) for name, value in self.fixed.items()},
            "sampling": {} if self.experiment.deterministic else sampling,
            "grid": {"zip": zipped} if zipped else {},
            "points": table,
            "exclude": [{one.name: one.written(known[one.name]) for one in clause} for clause in self.excluded],
            "counts": dict(self.counts),
        }
        named = {"experiment": self.experiment_reference}
        return {**self.sections, **named, **{key: section for key, section in values.items() if section}}

    @property
    def dimensions(self) -> dict[str, tuple[str, ...]]:
        """The axes along each dimension, by its name: `POINT`, or the first of them that has an effect all along."""
        columns = () if self.points is None else self.points.names
        partner, partial = {name: group for group in self.zipped for name in group}, self.partial
        groups = dict.fromkeys(partner.get(name, (name,)) for name in self.axes if name not in columns)
        named = {next((n for n in group if n not in partial), group[0]): group for group in groups}
        return ({POINT: columns} if columns else {}) | named

    @property
    def is_ours(self) -> bool:
        """Whether only code that comes with linksweep computes it."""
        return self.experiment_reference.partition(".")[0] == "linksweep" and not self.sections.get("define")

    @property
    def draws_together(self) -> bool:
        """Whether points that share random numbers are computed in one call, for which they are drawn once."""
        return self.sampling.common_random_numbers and not self.experiment.draws_alone

    @property
    def keeps_samples(self) -> bool:
        """Whether the ledger holds realisations: the study or the experiment asks for them."""
        return self.sampling.keep_samples or self.experiment.keeps_samples

    @cached_property
    def values(self) -> dict[str, tuple[Value, ...]]:
        """The values of each parameter: those along its axis, or the one that it has everywhere."""
        constants = self.experiment.defaults() | dict(self.fixed)
        return {name: (value,) for name, value in constants.items()} | dict(self.axes)

    @property
    def partial(self) -> list[str]:
        """The parameters that have no effect at some points."""
        partial: list[str] = []
        for name, conditions in self.when.items():
            if any(c.name in partial or not all(map(c.holds, self.values.get(c.name, ()))) for c in conditions):
                partial.append(name)
        return partial

    @property
    def varying(self) -> list[str]:
        """The axes, and constants that some points are without."""
        return list(dict.fromkeys([*self.axes, *self.partial]))

    @property
    def lacking(self) -> list[str]:
        """The axes of their own with a further place at the end: that of points at which they have no effect."""
        return [name for name in self.partial if name in self.alone]

    @property
    def places(self) -> dict[str, tuple[Value, ...]]:
        """The values along each axis, with None at the end of those that are `lacking`."""
        return {**self.axes, **{name: (*self.axes[name], None) for name in self.lacking}}

    @property
    def alone(self) -> list[str]:
        """The axes with a dimension of their own."""
        return [axes[0] for name, axes in self.dimensions.items() if name != POINT and len(axes) == 1]

    def missing(self, parameters: Mapping[str, Any]) -> list[str]:
        """Return the parameters that have no effect at a point."""
        gone: list[str] = []
        for name, conditions in self.when.items():
            if not are_met(conditions, parameters, gone):
                gone.append(name)
        return gone

    def settled(self) -> "Study":
        """Return the study with None in a table of points for the values that have no effect in their row."""
        names = () if self.points is None else self.points.names
        if {*names}.isdisjoint(self.partial):
            return self
        rows = []
        for row in zip(*(self.axes[name] for name in names), strict=True):
            there = self.values | {name: (value,) for name, value in zip(names, row, strict=True)}
            for name, conditions in self.when.items():
                if not all(any(map(one.holds, there[one.name])) for one in conditions):
                    there[name] = ()
            rows.append([next(iter(there[name]), None) for name in names])
        return replace(self, axes={**self.axes, **dict(zip(names, zip(*rows, strict=True), strict=True))})

    def arguments(self, parameters: dict[str, Any]) -> dict[str, Any]:
        """Return what the experiment gets at a point: the defaults of parameters that are missing."""
        gone = self.missing(parameters)
        return parameters | {name: self.experiment.parameter(name).default for name in gone} if gone else parameters

    def meaning(self) -> dict[str, Any]:
        """Return what determines the results of every point besides its own parameters: if this differs, results cannot
        be mixed.
        """
        defaults = self.experiment.defaults()
        shared = sorted(self.experiment.shared) if self.experiment.draws_alone else True
        return {
            "experiment": self.experiment.name,
            "experiment_version": self.experiment.version,
            **({} if self.experiment.deterministic else {"seed": self.sampling.seed}),
            **({"keep_samples": True} if self.sampling.keep_samples else {}),
            **({"common_random_numbers": shared} if self.sampling.common_random_numbers else {}),
            **({"when": self.sections["when"]} if self.sections.get("when") else {}),
            "fixed": {k: v for k, v in sorted(self.fixed.items()) if is_other(v, defaults[k])},
        }

    def numbers(self) -> dict[str, int]:
        """Return how many realisations there are, nothing where a point is computed once."""
        if self.experiment.deterministic:
            return {}
        return {"n_sim": self.sampling.n_sim, "n_cat": self.sampling.n_cat}

    def digest(self) -> str:
        """Return a SHA-256 of everything that determines the results, whatever the layout of the file."""
        whole = self.meaning() | {
            "axes": self.places,
            **self.numbers(),
            **({} if self.sampling.precision is None else {"precision": [self.sampling.precision, self.sampling.most]}),
            "zip": self.zipped,
            **({} if self.points is None else {"points": self.points.names}),
            **({"labels": self.points.labels} if self.points is not None and self.points.labels else {}),
            **({"counts": self.counts} if self.counts else {}),
            # copies, which have fields alone: no values that were cached
            "exclude": [[vars(replace(c)) for c in clause] for clause in self.excluded],
        }
        return hashlib.sha256(json.dumps(whole, sort_keys=True, default=content_digest).encode()).hexdigest()
