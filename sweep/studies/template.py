"""What to begin a study with: a study that runs as it is, and the form of studies as JSON Schema, for editors."""

import json
import math
from typing import Any

from linksweep.sweep.contract import Experiment, Parameter
from linksweep.sweep.studies.study import Form, Sampling
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

Schema = dict[str, Any]
SPACING: Schema = {"spacing": {"enum": ["linear", "log"]}}


def new_study(title: str, reference: str, experiment: Experiment) -> str:
    """Return the text of a study of the experiment at ``reference``, with all parameters in comments."""
    name, values = _first_axis(experiment)
    lines = [
        f"title = {_toml(title)}",
        '# question = "What do you want to know?"  # the report begins with it',
        f"experiment = {_toml(reference)}",
        "",
        "[axes]  # every combination of the values is a point of the grid",
        "# NAME = { start = 1.0, stop = 2.0, step = 0.5 }",
        '# NAME = { start = 10, stop = 1000, num = 5, spacing = "log" }',
        *([f"{name} = {_toml(values)}"] if name else []),
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
    unused = _unused(experiment, name, values)
    for parameter in (one for one in experiment.parameters if one.name != name):
        unit = f" [{parameter.unit}]" if parameter.unit and f"[{parameter.unit}]" not in parameter.allowed() else ""
        why = f" ({NOT_HERE} {unused[parameter.name]})" if parameter.name in unused else ""
        words = f"# {parameter.meaning}{unit}; {parameter.allowed()}{why}".split()
        lines += ["", "".join(c for c in " ".join(words) if c.isprintable())]
        if parameter.required:
            lines.append(f"{parameter.name} = {_toml(_example(parameter))}  # has no default")
        else:
            default = "" if parameter.default is None else f" {_toml(parameter.written_default())}"
            lines.append(f"# {parameter.name} ={default}")
    main = dict(experiment.errors_of_headline())  # what tables and figures begin with
    numbers = [output.name for output in experiment.outputs if not output.dims and "," not in output.unit]
    if numbers and not experiment.as_record():
        number = min(numbers, key=lambda one: one not in main)
        value = f"{{ variable = {_toml(number)} }}"
        lines += [
            "",
            "[conclusion]  # the answer: the last lines of a run, and the first of its report",
            f"sentences = [{_toml(f'{number} goes from {{least}} to {{largest}}.')}]",
            "",
            "[conclusion.values]  # numbers of the results; ratios and slopes too, see docs/studies.md",
            f'least = {{ value = {value}, choose = "least" }}',
            f'largest = {{ value = {value}, choose = "largest" }}',
        ]
    return "\n".join(lines) + "\n"


def _example(parameter: Parameter) -> object:
    """Return a value that a parameter without a default may have."""
    above = [] if parameter.above is None else [parameter.above + 1, 1.5 * parameter.above]
    for value in (*parameter.choices, 1.0, 1, True, "text", parameter.minimum, parameter.maximum, *above):
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
    keys = [name for name in Sampling.model_fields if needed.get(name, True)]
    values = {name: field.default for name, field in Sampling.model_fields.items()} | SUGGESTED
    words = {name: SAMPLING[name].replace("catalogue", experiment.outer_draw or "point") for name in keys}
    return [f"{'# ' if name in SUGGESTED else ''}{name} = {_toml(values[name])}  # {words[name]}" for name in keys]


def _first_axis(experiment: Experiment) -> tuple[str, list[Any]]:
    """Return a parameter and values of it that can be computed with all others at their defaults, '' if none can."""
    known = [parameter for parameter in experiment.parameters if parameter.default is not None]
    for parameter in sorted(known, key=lambda one: one.define is None):  # first those that users can extend
        good = []
        for choice in parameter.choices:
            try:
                if experiment.check(experiment.defaults() | {parameter.name: choice}) is None:
                    good.append(choice)
            except Exception:
                pass
        if len(good) >= 2:
            return parameter.name, good[:2]
    return next(((p.name, [p.written_default()]) for p in known if p.may_be_axis), ("", []))


def _unused(experiment: Experiment, name: str, values: list[Any]) -> dict[str, str]:
    """Return the parameters that change nothing at any point of the new study, and why."""
    try:
        reasons = [dict(experiment.unused(experiment.defaults() | {name: value})) for value in values]
    except Exception:  # whatever a user's experiment raises; `sweep plan` says what
        return {}
    return {key: why for key, why in reasons[0].items() if all(key in other for other in reasons)} if reasons else {}


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(k)} = {_toml(v)}" for k, v in value.items()) + " }" if value else "{}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    # TOML's strings, integers and booleans are JSON's, but for one character
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def study_schema(experiment: Experiment) -> Schema:
    """Return the JSON Schema of studies of an experiment.

    A study that `sweep plan` accepts conforms to it.  What depends on several values at once is left to `sweep plan`.
    """
    schema, parameters = Form.model_json_schema(), experiment.parameters
    swept = [p for p in parameters if p.may_be_axis]
    defined = {p.name: {"type": "object", "description": f"own values of {p.name}"} for p in parameters if p.define}
    schema["properties"] |= {
        "axes": _table({p.name: _ways(p, _axis_ways(p)) for p in swept}),
        "fixed": _table({p.name: _value(p) for p in parameters}),
        "define": _table(defined),
    }
    schema["$defs"]["PointsForm"]["properties"] |= {
        "design": {"enum": list(DESIGNS), "description": "a design of points in the ranges"},
        "ranges": _table({p.name: _ways(p, _range_ways(p)) for p in swept}),
        "columns": _table({p.name: {"type": "array", "items": _value(p)} for p in swept}),
    }
    schema["properties"]["exclude"]["items"] = _table({p.name: _described(p) for p in parameters})
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, **schema, "title": f"a study of the experiment {experiment.name}"}


def _table(properties: Schema, **more: Any) -> Schema:
    return {"type": "object", "properties": properties, "additionalProperties": False, **more}


def _described(parameter: Parameter) -> Schema:
    return {"description": f"{parameter.meaning}{f' [{parameter.unit}]' if parameter.unit else ''}"}


def _ways(parameter: Parameter, ranges: list[Schema]) -> Schema:
    """Return the ways to write values of a parameter: a table with a list of them, or in another way."""
    values = {"type": "array", "items": _value(parameter), "minItems": 1}
    return {**_described(parameter), "anyOf": [_way({"values": values}), *ranges]}


def _axis_ways(parameter: Parameter) -> list[Schema]:
    ways: list[Schema] = [{"type": "array", "items": _value(parameter), "minItems": 1}]
    if parameter.kind in ("int", "float"):
        ends, count = {"start": {"type": "number"}, "stop": {"type": "number"}}, {"type": "integer", "minimum": 1}
        ways += [_way({**ends, "step": {"type": "number"}}), _way({**ends, "num": count}, SPACING)]
    return ways


def _range_ways(parameter: Parameter) -> list[Schema]:
    if parameter.kind not in ("int", "float", "any") or parameter.choices:
        return []
    number: Schema = {"type": "number"}
    pair = {"type": "array", "items": number, "minItems": 2, "maxItems": 2}
    return [pair, _way({"low": number, "high": number}, SPACING)]


def _way(needed: Schema, possible: Schema | None = None) -> Schema:
    return _table({**needed, **(possible or {})}, required=list(needed))


def _value(parameter: Parameter) -> Schema:
    number: Schema = {"type": "integer" if parameter.kind == "int" else "number"}
    bounds = {"minimum": parameter.minimum, "maximum": parameter.maximum, "exclusiveMinimum": parameter.above}
    number |= {key: bound for key, bound in bounds.items() if bound is not None and math.isfinite(bound)}
    text: Schema = {"type": "string"}
    if parameter.choices:
        text |= {"enum" if parameter.define is None else "examples": list(parameter.choices)}
    kinds: dict[str, Schema] = {
        "float": number,
        "int": number,
        "str": text,
        "bool": {"type": "boolean"},
        "vector": {"type": "array", "items": number, "minItems": 3, "maxItems": 3},
        "map": {"type": "object", "additionalProperties": {"type": "string"}},
        "file": {"type": "string"},
        "any": {"type": ["number", "string", "boolean"]},
    }
    default = {} if parameter.default is None else {"default": parameter.written_default()}
    return {**_described(parameter), **kinds[parameter.kind], **default}
