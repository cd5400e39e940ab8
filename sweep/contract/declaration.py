"""What an experiment declares: its parameters with the values that they may have, its outputs, and their units; and the
errors that are shown to a user as sentences.
"""

import difflib
import pickle
import re
import reprlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Literal, Protocol, TypeVar, get_args

import numpy as np

from linksweep.sweep.formatting import harmless

# The most names that a message lists.
FEW = 20


class SweepError(Exception):
    """Bad input, or a state that the user must know about.

    Args:
        problems: a sentence for each problem.
        where: the file or command that they are about.
    """

    exit_code = 2
    """With which a command ends."""

    def __init__(self, problems: str | Sequence[str], where: str = "") -> None:
        self.problems = [harmless(text) for text in ([problems] if isinstance(problems, str) else problems)]
        self.where = where
        super().__init__("\n".join(self.problems))

    def __str__(self) -> str:
        """Return a line for each problem, behind the file or command that it is about."""
        where = f"{harmless(self.where)}: " if self.where else ""
        return "\n".join(f"{where}{problem}" for problem in self.problems)

    def _render_traceback_(self) -> list[str]:
        """Return what IPython shows in place of a traceback, which would be that of linksweep."""
        return [f"{type(self).__name__}: {self}"]


class _Short(reprlib.Repr):
    """A repr of bounded length and depth, also of integers so large that Python refuses to print them."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 3
        self.maxstring = self.maxother = 60

    def repr_int(self, x: int, level: int) -> str:
        return super().repr_int(x, level) if x.bit_length() <= 1100 else f"an integer of {x.bit_length()} bits"

    def repr_Named(self, x: Any, level: int) -> str:  # noqa: N802 (the name is reprlib's)
        return self.repr_str(x.name, level)


def shown(value: object) -> str:
    """Return a value as messages show it: its repr, cut short where it is long or deep."""
    return _Short().repr(value)


class DefinitionError(ValueError):
    """A wrong definition of a value; ``problems`` holds pairs (key, sentence), with an empty key for the whole."""

    def __init__(self, problems: Sequence[tuple[str, str]]) -> None:
        self.problems = list(problems)
        super().__init__("; ".join(f"{key}: {sentence}" if key else sentence for key, sentence in problems))


def nearest(word: str, known: Sequence[str]) -> str:
    """Return '; did you mean ...?' for a misspelt word; '' where none of the known words is like it."""
    near = [one for one in known if len(word) > 2 and one.startswith(f"{word}_")]  # the mean of what was returned
    near += difflib.get_close_matches(word, known, n=1, cutoff=0.65)
    # One that is in the other: `heatmap` is no map, and `decay` may be decay.zarr.
    near += sorted(
        (one for one in known if word and min(len(word), len(one)) > 2 and (one in word or word in one)), key=len
    )
    return f"; did you mean {near[0]!r}?" if near else ""


def suggest(word: str, known: Sequence[str]) -> str:
    """Return what `nearest` does, or else the list of known words if it is short."""
    return nearest(word, known) or (f"; known are {', '.join(sorted(known))}" if len(known) <= FEW else "")


# Recognised without astropy, whose import takes longer than a command that needs nothing else from it.
FAMILIAR = frozenset(
    [
        *("m", "cm", "mm", "km", "g", "kg", "s", "min", "h", "d", "yr"),
        *("Hz", "K", "mol", "J", "W", "N", "V", "A", "Pa"),
        *("rad", "deg", "arcmin", "arcsec", "mas", "uas", "mag", "pc", "kpc", "au", "eV"),
    ]
)


def unit_problem(text: object) -> str | None:
    """Return what is wrong with a unit, None if nothing is."""
    if not isinstance(text, str):
        return f"the unit {text!r} is no text"
    known = all(word in FAMILIAR for word in re.findall(r"[^\W\d]+", text)) and re.fullmatch(r"[\w\s/(),-]*", text)
    if known and not re.search(r"/\s*([/),]|$)", text) and text.count("(") == text.count(")"):
        return None
    from astropy.units import Unit

    try:
        Unit(text)
    except (ValueError, TypeError) as error:
        hint = str(error).partition("Did you mean ")[2].partition("?")[0]
        return f"the unit {text!r} is none that astropy knows{f'; did you mean {hint}?' if hint else ''}"
    return None


def is_quantity(value: object) -> bool:
    """Return whether a value, or a type, is a quantity of astropy, without importing astropy."""
    return hasattr(value, "unit") and hasattr(value, "to_value")


@lru_cache(maxsize=256)
def factor_between(one: str, other: str) -> float | None:
    """Return the factor that converts numbers from one unit to another; None for units of different kinds."""
    if one == other:
        return 1.0
    from astropy.units import Unit, UnitsError

    try:
        return float(Unit(one).to(Unit(other)))
    except (UnitsError, TypeError, ValueError):
        return None


def same_unit(one: str, other: str) -> bool:
    """Return whether two texts are the same unit."""
    return factor_between(one, other) == 1.0


T = TypeVar("T")
Value = Any  # of a parameter: bool, int, float, str, a tuple, a table file, or None
# A point's parameters by name, every declared one with a value.
Point = Mapping[str, Any]

# Parameters must be smaller in size: beyond it arithmetic overflows.
HUGE = 1e300

# The largest value in an array of integers.
LARGEST_INT = 2**63 - 1

Kind = Literal["float", "int", "str", "bool", "any", "object", "vector", "map", "file", "files"]

# The key in place of an object in the study of a store.
LABEL = "label"

# Names that the platform uses in every dataset or store.
RESERVED = ("status", "wall_time", "n_sim_done", "sample", "code", "blocks", "failures", "realisations")

TAKEN = "the platform gives this name in every dataset; take another"
GOOD_NAME = re.compile(r"[^\W\d][\w.-]{0,99}")
WORDS: Mapping[Kind, str] = {
    "float": "a finite number",
    "int": "an integer",
    "str": "a string",
    "bool": "true or false",
    "any": "a finite number, a string, true or false, or in Python any object",
    "object": "an object of another type than numbers, texts and truth values",
    "vector": "a list of three finite numbers",
    "map": 'a table of strings, { quantity = "column" }',
    "file": "the path of a table",
    "files": 'a table of paths, { name = "table.fits" }',
}


def bound_in_words(raw: object) -> str:
    """Return the bound that a finite number exceeds if it is refused for its size alone; '' for anything else.

    >>> bound_in_words(-1e305), bound_in_words(float("inf"))
    (', below 1e+300 in size', '')
    """
    is_huge = isinstance(raw, (int, float)) and HUGE <= abs(raw) < np.inf
    return f", below {HUGE:g} in size" if is_huge else ""


class Function(Protocol):
    """A function from a user's module or file, by its name and the digest of its source."""

    @property
    def name(self) -> str:
        """What it is called in its source."""

    @property
    def digest(self) -> str:
        """The digest of its source."""

    def __call__(self, *arguments: Any) -> Any:
        """Call it."""


@dataclass(frozen=True)
class Named:
    """A value of a parameter that a study defines under a name of its own.

    ``identity`` is JSON of everything in it that determines results; values with equal identities are equal, whatever
    their names.  ``value`` is what the experiment made from the definition.
    """

    name: str = field(compare=False)
    identity: str
    value: Any = field(compare=False, repr=False)

    def __str__(self) -> str:
        return self.name

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how it is made again elsewhere; raises SweepError where its value cannot be sent there."""
        import cloudpickle  # which takes lambdas and what only this session defines

        try:
            return _sent, (self.name, self.identity, cloudpickle.dumps(self.value))
        except Exception as error:  # whatever keeps an object from being pickled
            why = f"cannot be sent to other processes ({type(error).__name__}: {error}); use pool='threads' or 'serial'"
            raise SweepError(f"the value {shown(self.name)} {why}") from error


def _sent(name: str, identity: str, pickled: bytes) -> Named:
    return Named(name, identity, pickle.loads(pickled))


class Define(Protocol):
    """The function that makes a value from a study's table [define.PARAMETER.NAME]."""

    def __call__(self, table: Mapping[str, Any], load: Callable[[str], Function]) -> tuple[Any, Mapping[str, Any]]:
        """Return the value, and everything in it that determines results, in the types of JSON.

        ``load`` returns the function at ``module:function`` or ``file.py:function``.  Raises DefinitionError for a
        wrong table, SweepError where a function cannot be loaded.
        """


@dataclass(frozen=True)
class Parameter:
    """One parameter of an experiment.

    In the signature of a plain function, ``Annotated[float, Parameter("contact rate", unit="1/d", above=0)]``, the
    first argument is the meaning; name, kind and default are those of the signature.

    Args:
        name: the name in studies and datasets.
        kind: "float", "int", "str", "bool"; "any" is a number, text or truth value as the study writes it, or an object
            of Python, which has a label; "object" is the latter only; "vector" has three components, "map" is a table
            of strings, and for a "file" the experiment gets an object that gives the columns of the table in it;
            "files" are several of these by name.
        default: its value where a study says nothing.  None means that the experiment decides, and the meaning says
            how.
        meaning: one line for tables and figures.
        unit: as astropy writes it.
        choices: the values that are allowed; any unless given.
        minimum: the least value that is allowed.
        maximum: the largest value that is allowed.
        above: a lower bound that is not allowed itself.
        symbol: what figures show instead of the name, in the notation of Matplotlib.
        symbols: what they show instead of values.
        define: a function that makes a further choice of a "str" from a study's table [define.PARAMETER.NAME].
        defined: the choices that one study defines; the experiment gets these objects.
        required: whether every study must set it; then there is no default.
        optional: whether None is a value, too.
        when: the values of other parameters with which this one has an effect, ``{"kernel": ("rbf",)}``; where it has
            none, a grid has one point in which it is missing.
    """

    name: str
    kind: Kind = "any"
    default: Value = None
    meaning: str = ""
    unit: str = ""
    choices: tuple[Any, ...] = ()
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    symbol: str = ""
    symbols: Mapping[str, str] = field(default_factory=dict)
    define: Define | None = field(default=None, compare=False, repr=False)
    defined: tuple[Named, ...] = ()
    required: bool = False
    optional: bool = False
    when: Mapping[str, Sequence[Any]] = field(default_factory=dict)

    @property
    def may_be_axis(self) -> bool:
        """Whether its values can be those of an axis."""
        return self.kind not in ("vector", "map", "file", "files")

    @property
    def takes_objects(self) -> bool:
        """Whether its values can be objects of any type."""
        return self.kind in ("any", "object")

    def written_default(self) -> Any:
        """Return the default as a study writes it."""
        if isinstance(self.default, tuple):
            return dict(self.default) if self.kind in ("map", "files") else list(self.default)
        return self.default.item() if isinstance(self.default, np.generic) else self.default

    def parse(self, raw: object) -> Value:
        """Return ``raw`` as a value of this parameter; raises ValueError with a sentence that says what is allowed."""
        if self.optional and (raw is None or (raw == "None" and self.kind in ("float", "int", "bool"))):
            return None
        value = self._object(raw) if self.takes_objects else raw
        return value if isinstance(value, Named) else self._plain(value)

    def _object(self, raw: Any) -> Any:
        """Return the object with a label that ``raw`` is or names, ``raw`` itself where it is none."""
        is_label = isinstance(raw, dict) and raw.keys() == {LABEL}
        label = raw[LABEL] if is_label else raw if isinstance(raw, str) and not self.choices else None
        named = next((one for one in self.defined if one.name == label), None)
        if named is None and is_label:
            raise ValueError(
                f"{self.name} = {shown(label)} is the label of an object that only its script can make again; "
                "run that, retry=True for failed points"
            )
        return raw if named is None else named

    def _plain(self, raw: object) -> Value:
        kind, known = self.kind, self._known()
        if kind == "str" and isinstance(raw, str) and (not self.choices or raw in known):
            return next((named for named in self.defined if named.name == raw), raw)
        if kind == "str" or (self.choices and (type(raw), raw) not in [(type(choice), choice) for choice in known]):
            hint = nearest(raw, known) if isinstance(raw, str) and kind == "str" else ""
            raise self._refused(raw, hint)
        if kind in ("float", "int"):
            return self._number(raw)
        if kind == "any" and isinstance(raw, int | float) and not isinstance(raw, bool):
            return self._number(raw, whole=isinstance(raw, int))
        allowed = {"any": str | bool, "bool": bool, "file": str}
        if kind in allowed and isinstance(raw, allowed[kind]):
            return raw
        if kind in ("map", "files") and isinstance(raw, dict) and all(isinstance(text, str) for text in raw.values()):
            return tuple(sorted(raw.items()))
        if kind == "vector" and isinstance(raw, list | tuple) and len(raw) == 3:
            return tuple(self._number(x) for x in raw)
        raise self._refused(raw)

    def written(self, value: Value) -> Any:
        """Return a value, or those of an axis, as the study of a store has it: in place of an object its label."""
        if isinstance(value, tuple) and self.may_be_axis:
            return [self.written(one) for one in value]
        if not isinstance(value, Named):
            return value
        is_list = isinstance(value.value, list) and all(type(one) in (bool, int, float, str) for one in value.value)
        return value.name if self.kind == "str" else value.value if is_list else {LABEL: value.name}

    def _number(self, raw: object, whole: bool | None = None) -> float:
        whole = self.kind == "int" if whole is None else whole
        if isinstance(raw, int | float) and not isinstance(raw, bool) and abs(raw) < HUGE:  # refuses NaN too
            if whole and abs(raw) > LARGEST_INT:
                raise self._refused(raw, ", of 64 bits at most")
            number = float(raw) + 0.0  # no negative zero: it would be another point
            low = self.minimum is not None and number < self.minimum
            low |= self.above is not None and number <= self.above
            high = self.maximum is not None and number > self.maximum
            if not low and not high and (not whole or number.is_integer()):
                return int(raw) if whole else number
        raise self._refused(raw)

    def _refused(self, raw: object, more: str = "") -> ValueError:
        between = re.fullmatch(r"([^:]+):([^:]+)|([\d.]+) ?[-;] ?([\d.]+)", raw) if isinstance(raw, str) else None
        if between and self.kind in ("float", "int"):
            ends = ":".join(filter(None, between.groups()))
            number = "" if self.kind == "int" else f", or a number of values, as {ends}:log5"
            more = f"; several are 1,2,3; a range has a step, as {ends}:{1 if self.kind == 'int' else 0.5}{number}"
        return ValueError(f"{self.name} = {shown(raw)}: must be {self.allowed()}{more or bound_in_words(raw)}")

    def _known(self) -> tuple[Any, ...]:
        return (*self.choices, *(named.name for named in self.defined))

    def allowed(self) -> str:
        """Return in words what values are allowed."""
        if self.choices:
            further = "" if self.define is None or self.defined else f", or of [define.{self.name}.NAME]"
            return "one of " + ", ".join(map(repr, self._known())) + further
        bounds = {">=": self.minimum, ">": self.above, "<=": self.maximum}
        words = [f"{symbol} {bound:g}" for symbol, bound in bounds.items() if bound is not None]
        limits = f" {' and '.join(words)}" if words and self.kind != "bool" else ""
        return WORDS[self.kind] + limits + (f" [{self.unit}]" if self.unit else "")


@dataclass(frozen=True)
class Output:
    """One result of a point.  An output of a plain function (`linksweep.experiment`) needs only a name.

    Args:
        name: the name of the variable in the dataset.
        unit: as astropy writes it.
        meaning: one line for tables and figures.
        dims: dimensions besides those of the grid; a single one may be a string.
        headline: whether it is a column of the printed table and comes first in reports and figures.
        errors: the names of further outputs with the same dimensions that are its one-sigma errors, of several kinds;
            tables and reports show each beside it.
        symbol: what figures show instead of the name, in the notation of Matplotlib.
        nan: whether NaN and infinity are allowed; otherwise a point with such a value fails.
        coords: for a plain function, the coordinate of each dimension: values or (values, unit), where values are
            numbers, texts or times.
        statistics: for a plain function that draws random numbers, what is computed from its realisations: "mean",
            "std", "min", "max", "count" (how many are true), "median" and quantiles such as "q95".
        ragged: for a plain function, the dimension along which its length may differ between points, or True for its
            only one; the dataset has the lengths as ``NAME_length``, and missing values beyond them.
    """

    name: str
    unit: str = ""
    meaning: str = ""
    dims: tuple[str, ...] | str = ()
    headline: bool = False
    symbol: str = ""
    nan: bool = False
    coords: Mapping[str, Any] | None = field(default=None, compare=False)
    statistics: Sequence[str] = field(default=(), compare=False)
    errors: Sequence[str] = ()
    ragged: bool | str = False


def name_problem(name: object) -> str | None:
    """Return why something cannot be a name in a dataset, or None."""
    if not isinstance(name, str) or not GOOD_NAME.fullmatch(name):
        return "a name begins with a letter and has letters, digits and any of _ . - only"
    return TAKEN if name in RESERVED else None


# Endings that the platform adds to an output's name, for variables of its own.
ADDED = ("_published", "_published_rounding")


def names_problems(
    parameters: Sequence[str],
    names: Sequence[tuple[str, Any]],
    with_units: Iterable[str] = (),
    may_repeat: Collection[str] = (),
) -> Iterator[str]:
    """Yield what is wrong with names, which with those of the parameters are used in one dataset.

    Each of ``names`` stands behind "output" or "dimension".  Dimensions ``with_units`` have a coordinate of these, and
    outputs may have the names of parameters that ``may_repeat``.
    """
    added = {f"{name}_unit": f"the unit of each {name}" for name in with_units}
    added |= {
        f"{name}{end}": f"what is published of {name}" for kind, name in names if kind == "output" for end in ADDED
    }
    first: list[tuple[str, Any]] = []
    for kind, name in [*(("parameter", name) for name in parameters), *names]:
        others = [other for other, one in first if one == name]
        if wrong := name_problem(name):
            yield f"{kind} {shown(name)}: {wrong}"
        elif name in added:
            yield f"{kind} {name!r}: this name is for {added[name]}; take another"
        elif others and not (name in may_repeat and (others[0], kind) == ("parameter", "output")):
            yield f"{kind} {name!r}: is the name of another {others[0]}"
        first.append((kind, name))


def members(what: str, values: object, kind: type[T], problems: list[str]) -> list[T]:
    """Return the members of a declared tuple that are of the right type; ``problems`` takes those that are not."""
    if not isinstance(values, tuple | list | set | frozenset):
        problems.append(f"{what} = {shown(values)}: must be a tuple of {kind.__name__}; (one,) has a comma at its end")
        return []
    wrong = [one for one in values if not isinstance(one, kind)]
    problems += [f"{what}: {shown(one)} is no {kind.__name__}" for one in wrong]
    return [one for one in values if isinstance(one, kind)]


def named(what: str, values: object, known: Sequence[str], noun: str) -> list[str]:
    """Return what is wrong with a declared tuple of names that must be ``known``."""
    problems: list[str] = []
    names = members(what, values, str, problems)
    return problems + [f"{what}: {shown(n)} is no {noun}{suggest(n, known)}" for n in names if n not in known]


def parameter_problems(parameter: Parameter) -> Iterator[str]:
    """Yield what is wrong with a parameter by itself."""
    bounds = (parameter.minimum, parameter.above, parameter.maximum)
    if parameter.kind not in WORDS:
        yield f"there is no kind {shown(parameter.kind)}{suggest(str(parameter.kind), get_args(Kind))}"
    elif not isinstance(parameter.choices, tuple | list):
        yield f"choices = {shown(parameter.choices)}: must be a tuple"
    elif any(bound is not None and not isinstance(bound, int | float) for bound in bounds):
        yield f"minimum, above and maximum must be numbers, not {shown(bounds)}"
    elif text := unit_problem(parameter.unit):
        yield text
    elif not isinstance(parameter.when, Mapping) or not all(
        isinstance(values, list | tuple) and values and name != parameter.name
        for name, values in parameter.when.items()
    ):
        example = '{"kernel": ["rbf"]}, with other parameters and a list of values of each'
        yield f"when = {shown(parameter.when)}: must be like {example}"
    elif parameter.default is not None:
        try:
            parameter.parse(parameter.written_default())
        except (ValueError, TypeError) as error:
            yield f"its own default is not allowed: {error}"


def packages_problems(values: object) -> Iterator[str]:
    """Yield what is wrong with names of distributions."""
    problems: list[str] = []
    names = members("packages", values, str, problems)
    yield from problems
    for name in names:
        try:
            version(name)
        except (PackageNotFoundError, ValueError):
            yield f"packages: {shown(name)} is not installed here under this name"
