"""The fixed part of a study file: its tables and keys."""

from typing import Any

from pydantic import Field

from sweep.studies.source import Place
from sweep.studies.study import (
    Claim,
    Conclusion,
    ConclusionValue,
    Count,
    Ratio,
    Reading,
    Sampling,
    Section,
    Seed,
    Slope,
    Text,
    Tolerance,
)


class GridForm(Section):
    """The table [grid]."""

    zip: list[list[str]] = Field(default_factory=list)


class PointsForm(Section):
    """The table [points]: exactly one of ``file``, ``design`` and ``columns``.

    ``derive`` names a function of a row that gives further columns; ``origin`` is what a store remembers of where its
    columns come from.
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


class Form(Section):
    """The fixed part of a study file; axes and parameters are checked against the experiment."""

    title: Text
    question: Text | None = None
    experiment: str = "core.experiment:link"
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


def known_keys(where: Place) -> list[str]:
    """Return the keys that are allowed beside the one at ``where``."""
    sections: dict[str | int, type[Section]] = {
        **{"sampling": Sampling, "grid": GridForm, "points": PointsForm, "published": PublishedForm, "claim": Claim},
        **{"conclusion": Conclusion, "values": ConclusionValue},
        **{"slope": Slope, "ratio": Ratio, "value": Reading},
    }
    table = next((sections[key] for key in reversed(where[:-1]) if key in sections), Form)
    return list(table.model_fields)
