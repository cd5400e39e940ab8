"""What to begin a study with: a study that runs as it is, and the form of studies as JSON Schema, for editors."""

import json
import math
import re
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from linksweep.sweep.contract import Experiment, Parameter
from linksweep.sweep.studies.study import Form, Sampling

Schema = dict[str, Any]

# The values that a study has for parameters of each kind.
_TEXTS: Schema = {"type": "object", "additionalProperties": {"type": "string"}}
VALUES: dict[str, Schema] = {
    "float": {"type": "number"},
    "int": {"type": "integer"},
    "str": {"type": "string"},
    "bool": {"type": "boolean"},
    "any": {},
    "object": {"not": {"type": ["number", "string", "boolean"]}},
    "vector": {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3},
    "map": _TEXTS,
    "file": {"type": "string"},
    "files": _TEXTS,
}


def new_study(title: str, reference: str, experiment: Experiment) -> str:
    """Return the text of a study of the experiment at ``reference``, with all parameters in comments."""
    name, values = _first_axis(experiment)
    lines = [
        f"title = {_toml(title)}",
        '# question = "What do you want to know?"  # the report begins with it; [conclusion] answers: docs/studies.md',
        f"experiment = {_toml(reference)}",
        "",
        "[axes]  # every combination of the values is a point of the grid",
        "# NAME = { start = 1.0, stop = 2.0, step = 0.5 }",
        '# NAME = { start = 10, stop = 1000, num = 5, spacing = "log" }',
        *([f"{_key(name)} = {_toml(values)}"] if name else []),
        "",
        "# [points]  # many parameters at once, from a table or a design: docs/points.md",
        '# file = "runs.csv"  # a column for each parameter',
    ]
    if not experiment.deterministic:
        alone, judged = experiment.draws_alone, bool(experiment.errors_of_headline())
        takes = {"n_cat": experiment.outer_draw, "precision": judged, "max_n_sim": judged}
        takes |= {"keep_samples": experiment.samples or alone, "common_random_numbers": experiment.shared and not alone}
        lines += ["", "[sampling]"]
        for key, entry in Sampling.model_fields.items():
            if takes.get(key, True):
                words = str(entry.description).replace("catalogue", experiment.outer_draw or "point")
                value = f"{key} = {_toml(entry.examples[0] if entry.examples else entry.default)}"
                lines.append(f"{'# ' if entry.examples else ''}{value}  # {words}")
    lines += ["", "[fixed]  # any other parameter; these are the defaults"]
    for parameter in (one for one in experiment.parameters if one.name != name):
        words = " ".join("; ".join(filter(None, [parameter.meaning, parameter.allowed()])).split())
        lines += ["", "".join(c for c in f"# {words}" if c.isprintable())]
        key = _key(parameter.name)
        if parameter.required:
            lines.append(f"{key} = {_toml(_example(parameter))}  # has no default")
        else:
            default = "" if parameter.default is None else _toml(parameter.written_default())
            lines.append(f"# {key} = {default}".rstrip())
    return "\n".join(lines) + "\n"


def _example(parameter: Parameter) -> object:
    """Return a value that a parameter without a default may have."""
    above = [] if parameter.above is None else [parameter.above + 1, 1.5 * parameter.above]
    for value in (*parameter.choices, 1, True, "text", parameter.minimum, parameter.maximum, *above):
        with suppress(ValueError):
            return parameter.parse(value)
    return 1.0


def _first_axis(experiment: Experiment) -> tuple[str, list[Any]]:
    """Return a parameter and values of it that can be computed with all others at their defaults, '' if none can."""
    known = [parameter for parameter in experiment.parameters if parameter.default is not None]
    for parameter in sorted(known, key=lambda one: one.define is None):  # first those that users can extend
        good = []
        for choice in parameter.choices:
            with suppress(Exception):  # whatever a user's check raises: `sweep plan` says it
                if experiment.check(experiment.defaults() | {parameter.name: choice}) is None:
                    good.append(choice)
        if len(good) >= 2:
            return parameter.name, good[:2]
    return next(((p.name, [p.written_default()]) for p in known if p.may_be_axis), ("", []))


def _key(name: str) -> str:
    """Return a name as a key of TOML, which has only some letters without quotes, and for which dots divide."""
    return name if re.fullmatch(r"[\w-]+", name, re.ASCII) else _toml(name)


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(k)} = {_toml(v)}" for k, v in value.items()) + " }" if value else "{}"
    if isinstance(value, list | tuple):
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
    number, spacing = {"type": "number"}, {"enum": ["linear", "log"]}
    steps = {"start": number, "stop": number}
    counted = steps | {"num": {"type": "integer", "minimum": 1}}
    spans = [_table({**steps, "step": number}), _table({**counted, "spacing": spacing}, list(counted))]
    ends = {"low": number, "high": number}
    ranges = [_table({**ends, "spacing": spacing}, list(ends)), _array(number, 2) | {"maxItems": 2}]
    schema["properties"] |= {
        "axes": _table({p.name: _ways(p, spans, _array(_value(p), 1)) for p in swept}, []),
        "fixed": _table({p.name: _value(p) for p in parameters}, []),
        "define": _table({p.name: {"type": "object"} | _described(p) for p in parameters if p.define}, []),
    }
    schema["$defs"]["PointsForm"]["properties"]["ranges"] = _table({p.name: _ways(p, ranges) for p in swept}, [])
    # conditions and values are told apart by what they are: that is left to `sweep plan`
    schema["properties"]["exclude"]["items"] = _table({p.name: _described(p) for p in parameters}, [])
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, **schema, "title": f"a study of the experiment {experiment.name}"}


def _table(properties: Schema, required: Sequence[str] | None = None) -> Schema:
    """Return the schema of a table with these properties, all of which are required by default."""
    needed = list(properties) if required is None else list(required)
    return {"type": "object", "properties": properties, "required": needed, "additionalProperties": False}


def _array(items: Schema, least: int) -> Schema:
    return {"type": "array", "items": items, "minItems": least}


def _described(parameter: Parameter) -> Schema:
    return {"description": f"{parameter.meaning}{f' [{parameter.unit}]' if parameter.unit else ''}"}


def _ways(parameter: Parameter, ranges: Sequence[Schema], *lists: Schema) -> Schema:
    """Return the ways to write several values of a parameter: in a table, as lists, and numbers as ranges."""
    ranges = ranges if parameter.kind in ("float", "int", "any") else ()
    return {**_described(parameter), "anyOf": [_table({"values": _array(_value(parameter), 1)}), *lists, *ranges]}


def _value(parameter: Parameter) -> Schema:
    schema = dict(VALUES[parameter.kind])
    bounds = {"minimum": parameter.minimum, "maximum": parameter.maximum, "exclusiveMinimum": parameter.above}
    if parameter.kind in ("float", "int"):
        schema |= {key: bound for key, bound in bounds.items() if bound is not None and math.isfinite(bound)}
    if parameter.choices:
        schema |= {"enum" if parameter.define is None else "examples": list(parameter.choices)}
    if parameter.optional or parameter.when:
        schema = {"anyOf": [schema, {"const": "None"}]}
    schema = _described(parameter) | schema
    return schema if parameter.default is None else schema | {"default": parameter.written_default()}
