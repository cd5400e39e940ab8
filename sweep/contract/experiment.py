"""What the platform sweeps, an experiment: its parameters with the values that they may have, its outputs and their
units, its sums and the functions that make them; what is wrong in a declaration, or in what a function returns; and the
errors that are shown to a user as sentences.
"""

import difflib
import inspect
import json
import math
import pickle
import re
import reprlib
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, fields, replace
from decimal import Decimal
from fractions import Fraction
from functools import cached_property, lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Literal, Protocol, TypeVar, get_args
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract.rows import Array, Outcome, Reducer, Rows
from linksweep.sweep.formatting import ESCAPED, harmless, plain

# The most names that a message lists.
FEW = 20


class SweepError(Exception):
    """Bad input, or a state that the user must know about.

    Args:
        problems: a sentence for each problem.
        where: the file or command that they are about.
    """

    # With which a command ends.
    exit_code = 2

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


@contextmanager
def refused(*errors: type[Exception], said: str = "", where: object = "", more: str = "") -> Iterator[None]:
    """Turn errors of some types into a SweepError about a place with their text, between what is ``said`` before it and
    ``more`` after it.  A SweepError keeps its problems apart, and the place that it is about if it names one.
    """
    try:
        yield
    except errors as error:
        text = " ".join(str(getattr(error, "strerror", None) or error).split()) or type(error).__name__
        problems, place = (error.problems, error.where) if isinstance(error, SweepError) else ([text], "")
        raise SweepError([f"{said}{one}{more}" for one in problems], place or str(where)) from error


def needed(package: str, extra: str, where: object = "") -> AbstractContextManager[None]:
    """Turn the error of an import into a SweepError about a place that says which of our extras brings the package."""
    return refused(ImportError, said=f"needs {package}: pip install 'linksweep[{extra}]': ", where=where)


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
    """Return a value as messages show it: its repr in one line, cut short where it is long or deep."""
    return " ".join(map(str.strip, _Short().repr(value).split("\n")))


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
    listed = f"; known are {', '.join(sorted(known))}".translate(ESCAPED)
    return nearest(word, known) or (listed if 0 < len(known) <= FEW else "")


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


def quantity_of(number: Any, unit: str) -> Any:
    """Return a quantity of astropy."""
    from astropy.units import Quantity

    return Quantity(number, unit)


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


@lru_cache(maxsize=256)
def _ratio(factor: float) -> tuple[int, int]:
    """Return two integers whose ratio is a factor without its rounding error: 10**9 and 1 for 999999999.9999999."""
    short = Fraction(f"{factor:.14g}"), 1 / Fraction(f"{1.0 / factor:.14g}"), Fraction(factor).limit_denominator(10_000)
    near = (one for one in short if math.isclose(one, factor, rel_tol=4 * sys.float_info.epsilon))
    return next(near, Fraction(factor)).as_integer_ratio()


def rescaled(number: float, factor: float) -> float:
    """Return ``factor`` times a number as it is written, rounded once: 1.1 cm are 0.011 m and no other number."""
    exact = Decimal(str(number))  # several times faster than a Fraction of a text
    if factor == 1.0 or not exact.is_finite():
        return number
    (above, below), (over, under) = exact.as_integer_ratio(), _ratio(factor)
    try:
        return above * over / (below * under)
    except OverflowError:
        return math.inf if number > 0 else -math.inf


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
RESERVED = ("status", "wall_time", "n_sim_done", "sample", "code", "blocks", "failures", "realisations", "zarr.json")

TAKEN = "the platform gives this name in every dataset; take another"
GOOD_NAME = re.compile(r"[^\W\d][\w.-]{0,99}")
WORDS: Mapping[Kind, str] = {
    "float": "a finite number",
    "int": "an integer",
    "str": "a string",
    "bool": "true or false",
    "any": "a finite number, a string, true or false, or in Python any object",
    "object": "an object that is no number, text or truth value, such as 2024-06-01 or 2024-06-01T12:30:00",
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


def is_number(x: object) -> bool:
    """Return whether x is a finite number that a study may contain."""
    return isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < HUGE


def number_at(key: str, table: Mapping[str, Any]) -> Any:
    """Return the number in a table of a study; raises ValueError where it is none, or not finite."""
    if not is_number(table[key]):
        raise ValueError(f"{key} = {shown(table[key])}: must be a finite number{bound_in_words(table[key])}")
    return table[key]


def _is_finite(value: object) -> bool:
    return not isinstance(value, float) or math.isfinite(value)


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


class Unknown:
    """Stands for the value of a `Named` that a store has: only the script that made it has the object."""


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

        said = f"the value {shown(self.name)} cannot be sent to other processes: "
        with refused(Exception, said=said, more="; use pool='threads' or 'serial'"):  # of whatever cannot be pickled
            return _sent, (self.name, self.identity, cloudpickle.dumps(self.value))


# The objects of this session by identity: in a forked process pickle would make their classes anew, which are not those
# that its functions know.
OBJECTS = WeakValueDictionary[str, Named]()


def _sent(name: str, identity: str, pickled: bytes) -> Named:
    return OBJECTS.get(identity) or Named(name, identity, pickle.loads(pickled))


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
        finite: whether NaN and infinities are refused.  They are objects, as parameters of plain functions take them.
    """

    name: str
    kind: Kind = "any"
    default: Value = None
    meaning: str = ""
    unit: str = ""
    choices: tuple[Any, ...] = ()
    minimum: float | int | None = None
    maximum: float | int | None = None
    above: float | int | None = None
    symbol: str = ""
    symbols: Mapping[str, str] = field(default_factory=dict)
    define: Define | None = field(default=None, compare=False, repr=False)
    defined: tuple[Named, ...] = ()
    required: bool = False
    optional: bool = False
    when: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    finite: bool = True

    def __hash__(self) -> int:
        """Return a hash, which `typing.Optional` of an annotation with a parameter needs."""
        return hash(self.name)

    @property
    def may_be_axis(self) -> bool:
        """Whether its values can be those of an axis."""
        return self.kind not in ("vector", "map", "file", "files")

    @property
    def takes_objects(self) -> bool:
        """Whether its values can be objects of any type."""
        return self.kind in ("any", "object") and not self.choices

    @property
    def reads_none(self) -> bool:
        """Whether the text None on the command line or in a study file is None, and no text."""
        if self.kind == "any" and (not self.choices or "None" in self.choices):
            return self.default is None and not self.required
        return self.optional if self.kind == "str" else self.may_be_axis

    def written_default(self) -> Any:
        """Return the default as a study file writes it, which has no objects."""
        default = None if isinstance(self.default, Named) else self.written(self.default)
        return default.item() if isinstance(default, np.generic) else default

    def parse(self, raw: Any) -> Value:
        """Return ``raw`` as a value of this parameter; raises ValueError with a sentence that says what is allowed."""
        if raw is None and (self.optional or self.when):
            return None
        is_label = self.takes_objects and isinstance(raw, dict) and raw.keys() == {LABEL}
        name = raw[LABEL] if is_label else raw
        may_name = isinstance(name, str) and (self.takes_objects or self.kind == "str")
        named = next((one for one in self.defined if may_name and one.name == name), None)
        if is_label and named is None:
            words = "only its script can make again; run that, retry=True for failed points"
            raise ValueError(f"{self.name} = {shown(name)} is the label of an object that {words}")
        if isinstance(raw, Named) and (self.takes_objects or raw in self.defined):
            named = raw
        return self._plain(raw) if named is None else named

    def _plain(self, raw: object) -> Value:
        kind, known = self.kind, self._known()
        if kind != "file" and isinstance(raw, str) and raw != raw.encode(errors="ignore").decode():
            raise ValueError(f"{self.name} = {raw!a} has a lone surrogate: no file can hold it")
        is_truth = isinstance(raw, bool)
        if self.choices:
            is_plain = isinstance(raw, int | float | str)  # an array is compared value by value
            like = [one for one in known if is_plain and isinstance(one, bool) == is_truth and one == raw]
            if not like:
                raise self._refused(raw, nearest(raw, known) if kind == "str" and isinstance(raw, str) else "")
            raw = like[0]  # 2.0 is the choice 2
        if kind in ("float", "int") or (kind == "any" and isinstance(raw, int | float) and not is_truth):
            return self._number(raw, whole=kind == "int" or (kind == "any" and isinstance(raw, int)))
        allowed = {"str": str, "any": str | bool, "bool": bool, "file": str}
        if kind in allowed and isinstance(raw, allowed[kind]):
            return raw
        if kind in ("map", "files") and isinstance(raw, dict) and all(isinstance(text, str) for text in raw.values()):
            return tuple(sorted(raw.items()))
        if kind == "vector" and isinstance(raw, list | tuple) and len(raw) == 3:
            return tuple(self._number(x, whole=False) for x in raw)
        raise self._refused(raw)

    def written(self, value: Value) -> Any:
        """Return a value, or those of an axis, as the study of a store has it: the label of an object, the path of a
        table.
        """
        if isinstance(value, tuple):
            is_table = self.kind in ("map", "files")
            return {key: self.written(one) for key, one in value} if is_table else [*map(self.written, value)]
        if not isinstance(value, Named):
            return getattr(value, "path", value)  # of a table
        is_list = isinstance(value.value, list) and all(type(one) in (bool, int, float, str) for one in value.value)
        is_itself = is_list or (not _is_finite(value.value) and value.name == repr(value.value))
        return value.name if self.kind == "str" else value.value if is_itself else {LABEL: value.name}

    def _number(self, raw: Any, whole: bool) -> Value:
        is_beyond = not (self.finite or whole or _is_finite(raw))
        if is_beyond or is_number(raw):
            if whole and abs(raw) > LARGEST_INT:
                raise self._refused(raw, ", below 2**63 in size")
            number = float(raw) + 0.0  # no negative zero: it would be another point
            allowed = self.minimum is None or number >= self.minimum  # no NaN is
            allowed &= self.above is None or number > self.above
            allowed &= self.maximum is None or number <= self.maximum
            if allowed and is_beyond:
                return Named(text := repr(number), json.dumps({"value value": text}), number)
            if allowed and (not whole or number.is_integer()):
                return int(raw) if whole else number
        raise self._refused(raw)

    def _refused(self, raw: object, more: str = "") -> ValueError:
        if self.kind in ("float", "int") and isinstance(raw, str) and re.search(r"\d\s*[:;]|^\d+-\d+$", raw):
            more = "; several are 1,2,3; a range is START:STOP:STEP, or START:STOP:log5 for five values"
        more = more or bound_in_words(raw)
        label = "; beyond that under a label, {'label': value}" if more and self.takes_objects else ""
        return ValueError(f"{self.name} = {shown(raw)}: must be {self.allowed()}{more}{label}")

    def _known(self) -> tuple[Any, ...]:
        return (*self.choices, *(named.name for named in self.defined))

    def allowed(self) -> str:
        """Return in words what values are allowed."""
        none = " or None" if self.optional and (self.kind != "any" or self.choices) else ""
        if self.choices:
            further = "" if self.define is None or self.defined else f", or of [define.{self.name}.NAME]"
            return "one of " + ", ".join(map(repr, self._known())) + further + none
        bounds = {">=": self.minimum, ">": self.above, "<=": self.maximum}
        words = [f"{symbol} {plain([float(bound)])[0]}" for symbol, bound in bounds.items() if bound is not None]
        limits = f" {' and '.join(words)}" if words and self.kind != "bool" else ""
        kind = WORDS[self.kind] if self.finite else WORDS[self.kind].replace("finite ", "")
        return kind + limits + (f" [{self.unit}]" if self.unit else "") + none


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
    meant = {f"{name}_unit": f"the unit of each {name}" for name in with_units}
    for name in (name for kind, name in names if kind == "output"):
        meant |= dict.fromkeys((f"{name}_published", f"{name}_published_rounding"), f"what is published of {name}")
    first: dict[str, str] = {}
    for kind, name in [*(("parameter", name) for name in parameters), *names]:
        if wrong := name_problem(name):
            yield f"{kind} {shown(name)}: {wrong}"
        elif kind != "parameter" and name == "point":  # the dimension of tables of points
            yield f"{kind} {name!r}: {TAKEN}"
        elif name in meant:
            yield f"{kind} {name!r}: this name is for {meant[name]}; take another"
        elif name in first and not (name in may_repeat and (first[name], kind) == ("parameter", "output")):
            yield f"{kind} {name!r}: is the name of another {first[name]}"
        first.setdefault(str(name), kind)


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


def setting_problem(one: "Parameter | Output | Experiment") -> str | None:
    """Return which text, truth value, number or unit of a declaration is none, None if all are."""
    kinds: dict[Any, tuple[Any, str]]
    kinds = {str: (str, "a string"), bool: (bool, "True or False"), int: (int, "an integer")}
    kinds |= {float | int | None: (float | int | None, "a number")}
    kinds |= {Mapping[str, str]: (Mapping, "a mapping of values to symbols")}
    for each in fields(one):
        value, (kind, words) = getattr(one, each.name), kinds.get(each.type, (object, ""))
        if not isinstance(value, kind):
            return f"{each.name} = {shown(value)}: must be {words}"
    return unit_problem(getattr(one, "unit", ""))


def parameter_problems(parameter: Parameter) -> Iterator[str]:
    """Yield what is wrong with a parameter by itself."""
    if parameter.kind not in WORDS:
        yield f"there is no kind {shown(parameter.kind)}{suggest(str(parameter.kind), get_args(Kind))}"
    elif not isinstance(parameter.choices, tuple | list) or not all(
        isinstance(choice, str | int | float) for choice in parameter.choices
    ):
        yield f"choices = {shown(parameter.choices)}: must be a tuple of numbers, texts and truth values"
    elif text := setting_problem(parameter):
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


class ResultError(ValueError):
    """What a function of an experiment returned is not what is declared."""


class NotFiniteError(ResultError):
    """Numbers are NaN or infinite where that is not allowed."""


@dataclass(frozen=True)
class Sums(Reducer):
    """Adds up sums of 64-bit floats, of these ``shapes``; a function makes outputs of their shapes from them."""

    shapes: Mapping[str, tuple[int, ...]]
    outputs: Mapping[str, tuple[int, ...]]
    summarise: Callable[[Mapping[str, Array], Array, Array], Mapping[str, Any]]

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """A field of floats for each sum."""
        return np.dtype([(name, "<f8", tuple(shape)) for name, shape in self.shapes.items()])

    def add(self, total: Rows, block: Rows) -> Rows:
        """Return sums with those of one block more."""
        return self.typed(self.flat(total) + self.flat(block))

    def finish(self, total: Rows, n: Array, n_cat: Array) -> dict[str, NDArray[Any]]:
        """Return every output from sums."""
        expected = {name: (len(total), *shape) for name, shape in self.outputs.items()}
        returned = self.summarise({name: total[name] for name in self.shapes}, n, n_cat)
        return checked("summarise", returned, "output", expected)

    def flat(self, rows: Rows) -> Array:
        """Return sums as one array of floats, (rows, width)."""
        return np.ascontiguousarray(rows).view("<f8").reshape(len(rows), self.dtype.itemsize // 8)

    def typed(self, flat: Array) -> Rows:
        """Return floats, (rows, width), as rows."""
        return np.ascontiguousarray(flat, dtype="<f8").view(self.dtype).reshape(len(flat))


def checked(
    who: str, returned: object, noun: str, expected: Mapping[str, tuple[int, ...]], beside: Sequence[str] = ()
) -> dict[str, Array]:
    """Return what the function ``who`` ``returned`` as arrays of 64-bit floats of exactly the ``expected`` names and
    shapes; names ``beside`` them are allowed, and ignored.

    The first axis of a shape counts points; it may be missing if there is only one.  Nothing is broadcast.
    Raises ResultError that names everything that is wrong.
    """
    if not isinstance(returned, Mapping):
        raise ResultError(f"{who} returns a {type(returned).__name__}, not a mapping of {noun}s by name")
    problems = []
    for name in returned:
        if name not in expected and name not in beside:
            missing = [known for known in expected if known not in returned]
            problems.append(f"{who} returns {shown(name)}, which is no declared {noun}{suggest(str(name), missing)}")
    arrays: dict[str, Array] = {}
    for name, shape in expected.items():
        try:
            arrays[name] = _array(returned[name], shape)
        except KeyError:
            problems.append(f"{who} does not return the {noun} {name!r}")
        except ResultError as error:
            problems.append(f"{who}: the {noun} {name!r} {error}")
    if problems:
        raise ResultError("; ".join(problems))
    return arrays


def check_finite(arrays: Mapping[str, NDArray[Any]], may_be_nan: Collection[str]) -> None:
    """Raise NotFiniteError that says how many values of which array are NaN or infinite, or which of the two a single
    one is.
    """
    phrases = []
    for name, array in arrays.items():
        if name in may_be_nan or (finite := np.isfinite(array)).all():
            continue
        nan = np.count_nonzero(np.isnan(array))
        kinds = {"NaT" if array.dtype.kind == "M" else "NaN": nan, "infinite": np.count_nonzero(~finite) - nan}
        counts = {word: n for word, n in kinds.items() if n}
        of_many = " and ".join(f"{n} {word}" for word, n in counts.items())
        phrases.append(
            f"{name} is {min(counts)}" if array.size == 1 else f"{name} has {of_many} of {array.size} values"
        )
    if phrases:
        raise NotFiniteError("; ".join(phrases))


def _array(returned: Any, shape: tuple[int, ...]) -> Array:
    """Return one result as an array of this shape."""
    try:
        array = np.asarray(returned)
    except ValueError as error:  # lists of different lengths
        raise ResultError(f"has parts of different lengths, expected the shape {shape}") from error
    if array.dtype.kind not in "biuf":
        raise ResultError(f"is of type {array.dtype}, expected real numbers")
    if array.shape != shape and not (shape[0] == 1 and array.shape == shape[1:]):
        raise ResultError(f"has the shape {array.shape}, expected {shape}")
    return array.astype(np.float64, copy=False).reshape(shape)


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
    coordinates: Mapping[str, Sequence[str]] = field(default_factory=dict)
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

    # Whether points that share no random numbers are computed in one call, and whether every call at a point is to
    # return the same.
    vectorised = repeatable = False

    # How far the result of a point among others may be from that of the point alone, relative to it.
    tolerance = 0.0

    @property
    def deterministic(self) -> bool:
        """Whether a point is computed once, without random numbers."""
        return False

    @property
    def undeclared(self) -> bool:
        """Whether the outputs are unknown until there is a first result."""
        return not self.outputs

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
        """Number of floats of one realisation of which samples are kept, for results or as results."""
        return self.reducer.samples_width or sum(self.size_of(output) for output in self.sample_outputs)

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
            flat_sums = np.concatenate([array.reshape(len(points), -1) for array in sums.values()], axis=1)
            if not np.isfinite(flat_sums).all():  # at once: one by one takes a tenth of a cheap point
                check_finite(sums, self.nan_sums)
            total += flat_sums
            if kept:
                realisations = checked(who, drawn, "sample output", shapes_kept, beside=list(shapes))
                check_finite(realisations, [output.name for output in kept if output.nan])
                flat = [array.reshape(len(points), n_sim, -1) for array in realisations.values()]
                samples.append(np.concatenate(flat, axis=2))
        whole = np.concatenate(samples, axis=1) if samples else len(points) * [None]
        rows = total.view(self.reducer.dtype).reshape(-1)
        return [Outcome(row, result) for row, result in zip(rows, whole, strict=True)]

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
            outcomes += map(Outcome, total.view(self.reducer.dtype).reshape(-1))
        return outcomes

    def learned(self, outcomes: Mapping[int, Outcome]) -> "tuple[Experiment, dict[int, Any], dict[int, str]]":
        """Return the experiment as it is known from results too, the fields of the rows of its reducer, and why some of
        the results are refused.
        """
        return self, {place: outcome.row for place, outcome in outcomes.items()}, {}

    def with_layout(self, layout: Any) -> "Experiment":
        """Return the experiment with what is known of its results, None where nothing is."""
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

    def with_setting(self, setting: str, values: Mapping[str, Any]) -> "Experiment":
        """Return the experiment with other values of one setting of its parameters, by their names."""
        changed = (replace(p, **{setting: values[p.name]}) if p.name in values else p for p in self.parameters)
        return replace(self, parameters=tuple(changed)) if values else self

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

    def dimension_coordinates(self) -> dict[str, tuple[Any, str, str]]:
        """Return the values along each dimension of outputs, their unit and their meaning."""
        return {name: (np.array(labels, dtype=object), "", "") for name, labels in self.coordinates.items()}

    def shape_of(self, output: Output) -> tuple[int, ...]:
        """Return the shape of one value of an output."""
        return tuple(len(self.coordinates[dim]) for dim in output.dims)

    def size_of(self, output: Output) -> int:
        """Return the number of values in one value of an output."""
        return math.prod(self.shape_of(output))


def _problems(experiment: Experiment) -> list[str]:
    """Return a sentence for each mistake in a declaration, none if there are none."""
    problems = [*filter(None, [setting_problem(experiment)])]
    if isinstance(experiment.name, str) and not experiment.name.strip():
        problems.append(f"name = {shown(experiment.name)}: must be a text")
    parameters = members("parameters", experiment.parameters, Parameter, problems)
    outputs = members("outputs", experiment.outputs, Output, problems)
    samples = members("sample_outputs", experiment.sample_outputs, Output, problems)
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
        texts = [*_of_no_function(parameter), *parameter_problems(parameter)]
        problems += [f"parameter {parameter.name!r}: {text}" for text in texts]
    for output in (*outputs, *samples):
        alike = [other.name for other in outputs if (other.dims, other.unit) == (output.dims, output.unit)]
        texts = [*_of_no_function(output), *filter(None, [setting_problem(output)])]
        texts += named("dims", output.dims, list(labels), "dimension with labels in coordinates")
        texts += named("errors", output.errors, alike, "output with its dimensions and unit")
        problems += [f"output {output.name!r}: {text}" for text in texts]
    names = [*(("output", one.name) for one in (*outputs, *samples)), *(("dimension", name) for name in labels)]
    # If the experiment itself decides the value of a parameter, an output of the same name may report it.
    decided = {parameter.name for parameter in parameters if parameter.default is None}
    problems += names_problems([one.name for one in parameters], names, units, decided)
    shapes = _by_name("sums", experiment.sums, int, problems)
    if experiment.sums == {}:
        problems.append("sums = {}: must give the shape of each sum, such as {'squares': ()}")
    problems += named("nan_sums", experiment.nan_sums, list(shapes), "sum")
    problems += [text for name in CALLS for text in _calls(name, getattr(experiment, name))]
    if experiment.samples is not None and not experiment.sample_outputs:
        problems.append("samples: needs sample_outputs, which say what it gives")
    problems += named("shared", experiment.shared, [parameter.name for parameter in parameters], "parameter")
    problems += packages_problems(experiment.packages)
    return problems


def _by_name(what: str, mapping: object, kind: type[T], problems: list[str]) -> dict[str, list[T]]:
    """Return what a declaration has for each name: labels or units of a dimension, the shape of a sum."""
    if not isinstance(mapping, Mapping):
        problems.append(f"{what} = {shown(mapping)}: must be a mapping of names to tuples of {kind.__name__}")
        return {}
    return {name: members(f"{what}[{name!r}]", some, kind, problems) for name, some in mapping.items()}


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
