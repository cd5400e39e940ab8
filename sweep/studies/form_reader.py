"""Reads the form of a study, and rewrites what pydantic finds wrong in a document as problems of the study."""

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from linksweep.sweep.contract import shown, suggest
from linksweep.sweep.studies import form
from linksweep.sweep.studies.problems import Problems
from linksweep.sweep.studies.source import Place


def read_form(document: Mapping[str, Any], problems: Problems) -> form.Form | None:
    """Return the form of a document without its broken sections, so that the others are checked too; None where the
    key ``experiment`` is wrong.
    """
    try:
        return form.Form.model_validate(document)
    except ValidationError as error:
        errors = error.errors()
    for item in errors:
        where = tuple(item["loc"])
        if item["type"] == "extra_forbidden":
            problems.add(where, f"unknown key{suggest(str(where[-1]), _known_keys(where))}")
        elif item["type"] == "missing":
            problems.add(where, "is required")
        elif item["type"] == "value_error":
            problems.add(where, f"{shown(item['input'])} {item['ctx']['error']}")
        else:
            problems.add(where, f"{item['msg'][0].lower()}{item['msg'][1:]}, not {shown(item['input'])}")
    broken = {item["loc"][0] for item in errors}
    if "experiment" in broken:
        return None
    if {"axes", "points"} & broken:
        broken |= {"grid", "claim", "conclusion", "published", "figure"}
    if "grid" in broken:
        broken |= {"claim", "conclusion"}
    rest = {key: value for key, value in document.items() if key not in broken}
    return form.Form.model_validate({"title": "", **rest})


def _known_keys(where: Place) -> list[str]:
    """Return the keys that are allowed beside the one at ``where``."""
    sections: dict[str | int, type[form.Section]] = {
        "sampling": form.Sampling,
        "grid": form.GridForm,
        "points": form.PointsForm,
        "published": form.PublishedForm,
        "figure": form.FigureForm,
        "claim": form.Claim,
        "conclusion": form.Conclusion,
        "values": form.ConclusionValue,
        "slope": form.Slope,
        "ratio": form.Ratio,
        "value": form.Reading,
    }
    table = next((sections[key] for key in reversed(where[:-1]) if key in sections), form.Form)
    return list(table.model_fields)
