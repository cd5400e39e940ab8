"""Further values of parameters that a study defines in its tables [define.PARAMETER.NAME]."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from linksweep.sweep.code.load import Code
from linksweep.sweep.contract import DefinitionError, Experiment, Function, Named, Parameter, shown
from linksweep.sweep.studies.problems import Problems

Tables = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""Definitions as the study has them, by parameter and name."""

GOOD_NAME = re.compile(r"[A-Za-z_][\w.+-]{0,59}", re.ASCII)
"""Names that can be written on the command line wherever it takes a value of an axis."""


def defined_values(
    experiment: Experiment, tables: Tables, folder: Path, code: Code, problems: Problems
) -> tuple[Experiment, dict[str, dict[str, dict[str, Any]]]]:
    """Return the experiment with the values that the study defines, and the definitions with references that work from
    any directory; ``problems`` takes what is wrong.
    """
    known: dict[str, Parameter] = {}
    portable: dict[str, dict[str, dict[str, Any]]] = {}
    for name, by_name in tables.items():
        with problems.at(("define", name, *list(by_name)[:1])):
            parameter = experiment.parameter(name)
            if parameter.define is None:
                raise ValueError(f"{name} takes no values that a study defines, but {parameter.allowed()}")
            found: list[Named] = []
            for own_name, table in by_name.items():
                own = problems.inside("define", name, own_name)
                if not GOOD_NAME.fullmatch(own_name):
                    own.add((), "a name begins with a letter and has at most 60 letters, digits and any of _ . + -")
                if own_name in parameter.choices:
                    own.add((), f"{shown(own_name)} is there already; take another name")
                loaded: dict[str, str] = {}
                found.append(_named(parameter, own_name, table, partial(_load, code, folder, loaded), own))
                portable.setdefault(name, {})[own_name] = {
                    key: loaded.get(text, text) if isinstance(text, str) else text for key, text in table.items()
                }
            known[name] = replace(parameter, defined=tuple(found))
    parameters = tuple(known.get(parameter.name, parameter) for parameter in experiment.parameters)
    return replace(experiment, parameters=parameters), portable


def _named(
    parameter: Parameter, name: str, table: Mapping[str, Any], load: Callable[[str], Function], problems: Problems
) -> Named:
    assert parameter.define is not None, "checked before"
    try:
        value, identity = parameter.define(table, load)
        return Named(name, json.dumps(identity, sort_keys=True), value)
    except DefinitionError as error:
        for key, sentence in error.problems:
            problems.add((key,) if key else (), sentence)
    except Exception as error:  # whatever a user's experiment raises
        problems.add((), f"the experiment cannot make anything of it: {type(error).__name__}: {error}")
    return Named(name, name, None)  # so that its name is known where it is used


def _load(code: Code, folder: Path, loaded: dict[str, str], reference: str) -> Function:
    """Return the function at a reference, and note the reference that works from any directory."""
    function = code.function(reference, folder)
    loaded[reference] = function.reference
    return function
