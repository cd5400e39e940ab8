"""Finds everything that is wrong with the declaration of an experiment, when it is made."""

import inspect
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any, get_args

from linksweep.sweep.contract.errors import shown, suggest
from linksweep.sweep.contract.parameter import Kind, Output, Parameter
from linksweep.sweep.contract.units import unit_problem

RESERVED = ("status", "n_sim_done", "sample", "code", "blocks", "failures", "realisations")
"""Names that the platform uses in every dataset or store."""

ADDED = ("_published", "_published_rounding")
"""Endings that the platform adds to an output's name, for variables of its own."""

TAKEN = "the platform gives this name in every dataset; take another"
GOOD_NAME = re.compile(r"[^\W\d][\w.-]{0,99}")

CALLS = {
    "evaluate": ("points", "n_sim", "rng", "catalogue_rng"),
    "samples": ("points", "n_sim", "rng", "catalogue_rng"),
    "summarise": ("sums", "n", "n_cat"),
    "check": ("point",),
    "cost": ("point",),
    "unused": ("point",),
}
"""The functions of an experiment, and what they are called with."""


def problems(experiment: Any) -> list[str]:
    """Return a sentence for each mistake in a declaration, none if there are none."""
    found: list[str] = []
    if not isinstance(experiment.name, str) or not experiment.name.strip():
        found.append(f"name = {shown(experiment.name)}: must be a text")
    if not isinstance(experiment.version, int) or isinstance(experiment.version, bool):
        found.append(f"version = {shown(experiment.version)}: must be an integer")
    parameters: list[Parameter] = _members(experiment.parameters, "parameters", Parameter, found)
    outputs: list[Output] = _members(experiment.outputs, "outputs", Output, found)
    samples: list[Output] = _members(experiment.sample_outputs, "sample_outputs", Output, found)
    dimensions = _labels(experiment.coordinates, "coordinates", found)
    units = _labels(experiment.component_units, "component_units", found, unique=False)
    for parameter in parameters:
        texts = [*_not_of_a_signature(parameter), *parameter_problems(parameter)]
        found += [f"parameter {parameter.name!r}: {text}" for text in texts]
    for output in (*outputs, *samples):
        found += [f"output {output.name!r}: {text}" for text in _output_problems(output, dimensions)]
        alike = [other.name for other in outputs if (other.dims, other.unit) == (output.dims, output.unit)]
        found += _listed(f"output {output.name!r}: errors", output.errors, alike, "output with its dimensions and unit")
    for name, of_labels in units.items():
        if (expected := len(dimensions.get(name, ()))) != len(of_labels):
            text = f"{len(of_labels)} units for {expected} labels" if name in dimensions else "no such dimension"
            found.append(f"component_units[{name!r}]: {text}")
    found += _names(parameters, [*outputs, *samples], dimensions, units)
    found += _sums(experiment)
    for name, arguments in CALLS.items():
        found += _call(name, getattr(experiment, name), arguments)
    if experiment.samples is not None and not experiment.sample_outputs:
        found.append("samples: needs sample_outputs, which say what it gives")
    found += _listed("shared", experiment.shared, [parameter.name for parameter in parameters], "parameter")
    if isinstance(experiment.sums, Mapping):
        found += _listed("nan_sums", experiment.nan_sums, [str(name) for name in experiment.sums], "sum")
    found += packages_problems(experiment.packages)
    return found


def _members(given: object, what: str, kind: type[Any], found: list[str]) -> list[Any]:
    """Return the members of a declared sequence that are of the right type."""
    if isinstance(given, kind):
        found.append(f"{what}: is one {kind.__name__}, not a tuple of them; a tuple of one needs a comma at its end")
        return [given]
    if not isinstance(given, (tuple, list)):
        found.append(f"{what}: is {_a(given)}, not a tuple of {kind.__name__}")
        return []
    found += [
        f"{what}[{place}]: is {_a(one)}, not {_a_word(kind.__name__)}"
        for place, one in enumerate(given)
        if not isinstance(one, kind)
    ]
    return [one for one in given if isinstance(one, kind)]


def _labels(given: object, what: str, found: list[str], unique: bool = True) -> dict[str, Sequence[str]]:
    """Return the labels of each dimension that has some."""
    if not isinstance(given, Mapping):
        found.append(f"{what}: is {_a(given)}, not a mapping of dimensions to their labels")
        return {}
    good: dict[str, Sequence[str]] = {}
    for name, labels in given.items():
        if not isinstance(labels, (tuple, list)) or not all(isinstance(label, str) for label in labels):
            found.append(f"{what}[{name!r}]: must be a tuple of strings, not {shown(labels)}")
            continue
        if repeated := [label for label, n in Counter(labels).items() if n > 1 and unique]:
            found.append(f"{what}[{name!r}]: {shown(repeated[0])} is listed twice")
        if not labels:
            found.append(f"{what}[{name!r}]: is empty")
        good[name] = labels
    return good


def _not_of_a_signature(parameter: Parameter) -> Iterator[str]:
    """Yield settings of a parameter that are allowed only in the signature of a plain function."""
    if parameter.required:
        yield "required is for the signatures of plain functions"
    if not all(isinstance(choice, str) for choice in parameter.choices):
        yield f"choices = {shown(parameter.choices)}: must be a tuple of strings"
    elif parameter.choices and parameter.kind != "str":
        yield f"choices are for strings, not for a {parameter.kind}"


def name_problem(name: object) -> str | None:
    """Return why something cannot be a name in a dataset, or None."""
    if not isinstance(name, str) or not GOOD_NAME.fullmatch(name):
        return "a name begins with a letter and has letters, digits and any of _ . - only"
    return TAKEN if name in RESERVED else None


def parameter_problems(parameter: Parameter) -> Iterator[str]:
    """Yield what is wrong with a parameter by itself."""
    if parameter.kind not in get_args(Kind):
        yield f"there is no kind {shown(parameter.kind)}{suggest(str(parameter.kind), get_args(Kind))}"
        return
    if text := unit_problem(parameter.unit):
        yield text
    if isinstance(parameter.choices, str):
        yield f"choices = {shown(parameter.choices)}: must be a tuple of strings"
        return
    bounds = (parameter.minimum, parameter.above, parameter.maximum)
    if any(bound is not None and not isinstance(bound, (int, float)) for bound in bounds):
        yield f"minimum, above and maximum must be numbers, not {shown(bounds)}"
        return
    if parameter.default is None:
        return
    if parameter.kind in ("vector", "map") and not isinstance(parameter.default, tuple):
        yield f"the default {shown(parameter.default)} must be a tuple"
        return
    try:
        parameter.parse(parameter.written_default())
    except (ValueError, TypeError) as error:
        yield f"its own default is not allowed: {error}"


def _output_problems(output: Output, dimensions: Mapping[str, Sequence[str]]) -> Iterator[str]:
    if text := unit_problem(output.unit):
        yield text
    if output.coords is not None or output.statistics:
        yield "coords and statistics are for plain functions; an Experiment has coordinates and summarise"
    if isinstance(output.dims, str):
        yield f"dims = {output.dims!r}: must be a tuple; a tuple of one needs a comma at its end"
        return
    if not isinstance(output.dims, (tuple, list)):
        yield f"dims = {shown(output.dims)}: must be a tuple of names"
        return
    for dim in output.dims:
        if dim not in dimensions:
            known = suggest(str(dim), list(dimensions)) if dimensions else ""
            yield f"the dimension {shown(dim)} has no labels in coordinates{known}"
    if repeated := [dim for dim, n in Counter(output.dims).items() if n > 1]:
        yield f"has the dimension {shown(repeated[0])} twice"


def _names(
    parameters: Sequence[Parameter],
    outputs: Sequence[Output],
    dimensions: Mapping[str, Sequence[str]],
    units: Mapping[str, Sequence[str]],
) -> Iterator[str]:
    """Yield what is wrong with names, all of which are used in one dataset."""
    given = [
        *(("parameter", parameter.name) for parameter in parameters),
        *(("output", output.name) for output in outputs),
        *(("dimension", name) for name in dimensions),
    ]
    added = {f"{name}_unit": f"the unit of each {name}" for name in units}
    added |= {f"{o.name}{end}": f"what is published of {o.name}" for o in outputs for end in ADDED}
    # If the experiment itself decides the value of a parameter, an output of the same name may report it.
    decided = {parameter.name for parameter in parameters if parameter.default is None}
    first: dict[str, str] = {}
    for kind, name in given:
        if wrong := name_problem(name):
            yield f"{kind} {shown(name)}: {wrong}"
        elif name in added:
            yield f"{kind} {name!r}: this name is for {added[name]}; take another"
        elif name in first and not (name in decided and (first[name], kind) == ("parameter", "output")):
            same = first[name] == kind
            yield f"{kind} {name!r}: " + ("is declared twice" if same else f"is the name of {_a_word(first[name])} too")
        first.setdefault(name, kind)


def _sums(experiment: Any) -> Iterator[str]:
    if not isinstance(experiment.sums, Mapping) or not experiment.sums:
        yield f"sums = {shown(experiment.sums)}: must give the shape of each sum, such as {{'squares': ()}}"
        return
    for name, shape in experiment.sums.items():
        whole = isinstance(shape, (tuple, list)) and all(isinstance(n, int) and n >= 0 for n in shape)
        if not isinstance(name, str) or not whole:
            yield f"sums[{name!r}] = {shown(shape)}: must be a shape, such as () or (3,)"


def _call(name: str, function: object, arguments: Sequence[str]) -> Iterator[str]:
    if function is None and name == "samples":
        return
    if not callable(function):
        yield f"{name}: is {_a(function)}, not a function"
        return
    try:
        signature = inspect.signature(function)
    except (ValueError, TypeError):  # of a function in C, which has no signature
        return
    try:
        signature.bind(*arguments)
    except TypeError:
        yield f"{name}: takes {signature}, but is called with ({', '.join(arguments)})"


def _listed(what: str, given: object, known: Sequence[str], kind: str) -> Iterator[str]:
    if isinstance(given, str) or not isinstance(given, (tuple, list, set, frozenset)):
        yield f"{what} = {shown(given)}: must be a tuple of names; a tuple of one needs a comma at its end"
        return
    for name in given:
        if name not in known:
            yield f"{what}: {shown(name)} is no {kind}{suggest(str(name), known)}"


def packages_problems(given: object) -> Iterator[str]:
    """Yield what is wrong with names of distributions."""
    if isinstance(given, str) or not isinstance(given, (tuple, list)):
        yield f"packages = {shown(given)}: must be a tuple of names; a tuple of one needs a comma at its end"
        return
    for name in given:
        try:
            version(name)
        except (PackageNotFoundError, ValueError, TypeError):
            yield f"packages: {shown(name)} is not installed here under this name"


def _a(thing: object) -> str:
    return _a_word(type(thing).__name__)


def _a_word(noun: str) -> str:
    return f"an {noun}" if noun[0] in "AEIOUaeiou" else f"a {noun}"
