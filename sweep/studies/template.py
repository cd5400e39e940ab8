"""A study to start from: it runs as it is, and has every parameter at its default as a comment."""

import json

from linksweep.sweep.contract import Experiment, Parameter
from linksweep.sweep.functions.adapter import FunctionExperiment
from linksweep.sweep.studies.form import Sampling
from linksweep.sweep.studies.values import DESIGNS

SAMPLING = {
    "n_sim": "realisations of each catalogue",
    "n_cat": "catalogues of each point, an outer draw that realisations share",
    "seed": "same seed, same numbers, on any machine layout",
    "precision": "relative error of the headline results at which a point stops, after n_sim at least",
    "max_n_sim": "but not more than these",
    "keep_samples": "keep every single estimate too",
    "common_random_numbers": "let points share what they can: ratios and exponents have far less noise",
}
SUGGESTED = {"precision": 0.01, "max_n_sim": 1_000_000}
NOT_HERE = "not with the values above:"
"""The beginning of the reason why a parameter has no effect with the values of the new study."""

FEW = 2
"""Values on the axis of a new study."""


def new_study(title: str, reference: str, experiment: Experiment) -> str:
    """Return the text of a study of the experiment at ``reference``, ``module:attribute`` or ``file.py:attribute``."""
    axes = _first_axis(experiment)
    lines = [
        f"title = {_toml(title)}",
        '# question = "What do you want to know?"  # the report begins with it',
        f"experiment = {_toml(reference)}",
        "",
        "[axes]  # every combination of the values is a point of the grid",
        "# NAME = { start = 1.0, stop = 2.0, step = 0.5 }",
        '# NAME = { start = 10, stop = 1000, num = 5, spacing = "log" }',
        *(f"{name} = {_toml(values)}" for name, values in axes.items()),
        "",
        "# [points]  # many parameters at once, crossed with the axes: a table, or a design in ranges",
        '# file = "runs.csv"  # a column for each parameter',
        f'# design = "sobol"  # {", ".join(DESIGNS)}',
        "# n = 256",
        "# ranges.NAME = [0.1, 0.5]",
        '# ranges.NAME = { low = 0.01, high = 1.0, spacing = "log" }',
        '# ranges.NAME = { values = ["a", "b"] }',
    ]
    if not experiment.deterministic:
        lines += ["", "[sampling]", *_sampling(experiment)]
    lines += ["", "[fixed]  # any other parameter; these are the defaults"]
    unused = _unused(experiment, axes)
    for parameter in experiment.parameters:
        if parameter.name in axes:
            continue
        unit = f" [{parameter.unit}]" if parameter.unit and f"[{parameter.unit}]" not in parameter.allowed() else ""
        why = f" ({NOT_HERE} {unused[parameter.name]})" if parameter.name in unused else ""
        words = f"# {parameter.meaning}{unit}; {parameter.allowed()}{why}".split()
        lines += ["", "".join(c for c in " ".join(words) if c.isprintable())]
        if parameter.required:
            lines.append(f"{parameter.name} = {_toml(_example(parameter))}  # has no default")
            continue
        default = "" if parameter.default is None else f" {_toml(parameter.written_default())}"
        lines.append(f"# {parameter.name} ={default}")
    return "\n".join([*lines, *_conclusion(experiment)]) + "\n"


def _conclusion(experiment: Experiment) -> list[str]:
    """Return the lines of a conclusion that is valid for any values of the axes; none if no result is one number."""
    numbers = [output for output in experiment.outputs if not output.dims and "," not in output.unit]
    main = dict(experiment.errors_of_headline())  # what tables and figures begin with
    names = sorted((output.name for output in numbers), key=lambda name: name not in main)
    if not names or isinstance(experiment, FunctionExperiment):
        return []
    value = f"{{ variable = {_toml(names[0])} }}"
    return [
        "",
        "[conclusion]  # the answer: the last lines of a run, and the first of its report",
        f"sentences = [{_toml(f'{names[0]} goes from {{least}} to {{largest}}.')}]",
        "",
        "[conclusion.values]  # numbers of the results; ratios and slopes too, see docs/studies.md",
        f'least = {{ value = {value}, choose = "least" }}',
        f'largest = {{ value = {value}, choose = "largest" }}',
    ]


def _example(parameter: Parameter) -> object:
    """Return a value that a parameter without a default may have."""
    tried = [*parameter.choices, 1.0, 1, True, "text", parameter.minimum, parameter.maximum]
    if parameter.above is not None:
        tried += [parameter.above + 1, 1.5 * parameter.above]
    for value in tried:
        try:
            parameter.parse(value)
        except ValueError:
            continue
        return int(value) if parameter.kind == "int" and isinstance(value, float) else value
    return 1.0


def _sampling(experiment: Experiment) -> list[str]:
    """Return the lines of [sampling], without the keys that have no effect for the experiment."""
    needed = {
        "n_cat": experiment.outer_draw,
        "precision": experiment.errors_of_headline(),
        "max_n_sim": experiment.errors_of_headline(),
        "keep_samples": experiment.samples,
        "common_random_numbers": experiment.shared,
    }
    lines = []
    for name, field in Sampling.model_fields.items():
        if needed.get(name, True):
            mark, given = ("# ", SUGGESTED[name]) if name in SUGGESTED else ("", field.default)
            words = SAMPLING[name].replace("catalogue", experiment.outer_draw or "point")
            lines.append(f"{mark}{name} = {_toml(given)}  # {words}")
    return lines


def _first_axis(experiment: Experiment) -> dict[str, list[object]]:
    """Return a parameter and values of it that can be computed with all others at their defaults."""
    chosen = [p for p in experiment.parameters if p.choices and p.default is not None]
    for parameter in sorted(chosen, key=lambda p: p.define is None):  # first those that users can extend
        good = [choice for choice in parameter.choices if _works(experiment, parameter.name, choice)]
        if len(good) >= FEW:
            return {parameter.name: list(good[:FEW])}
    given = [p for p in experiment.parameters if p.default is not None and p.may_be_axis]
    return {p.name: [p.written_default()] for p in given[:1]}


def _works(experiment: Experiment, name: str, choice: str) -> bool:
    try:
        return experiment.check(experiment.defaults() | {name: choice}) is None
    except Exception:  # whatever a user's experiment raises: then it is no value to begin with
        return False


def _unused(experiment: Experiment, axes: dict[str, list[object]]) -> dict[str, str]:
    """Return the parameters that change nothing at any point of the new study, and why."""
    [(name, values)] = axes.items() or [("", [])]
    try:
        found = [dict(experiment.unused(experiment.defaults() | {name: value})) for value in values]
    except Exception:  # whatever a user's experiment raises; `sweep plan` says what
        return {}
    return {key: why for key, why in found[0].items() if all(key in other for other in found)} if found else {}


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(k)} = {_toml(v)}" for k, v in value.items()) + " }" if value else "{}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    # TOML's strings, integers and booleans are JSON's, but for one character
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
