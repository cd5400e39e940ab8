"""What a study is: a validated record of axes, fixed parameters and sampling."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from linksweep.sweep.contract import Experiment, Value
from linksweep.sweep.studies.form import Claim, Conclusion, Sampling
from linksweep.sweep.tables.file import content_digest


@dataclass(frozen=True)
class Condition:
    """One clause of an exclusion: the parameter's value is in ``among``, or above and below the bounds that are
    given.
    """

    name: str
    among: tuple[Value, ...] | None = None
    above: float | None = None
    below: float | None = None

    def holds(self, value: Any) -> bool:
        """Return whether a parameter's value meets the condition."""
        if self.among is not None:
            return value in self.among
        return (self.above is None or value > self.above) and (self.below is None or value < self.below)


@dataclass(frozen=True)
class Published:
    """Published results: rows of {column: number as printed}, the columns being axes and outputs.

    ``tolerance`` (relative, 0 for none) is how far computed values may be from them beyond rounding and Monte-Carlo
    error, for the reason that ``tolerance_reason`` gives.
    """

    source: str
    rows: tuple[Mapping[str, str], ...]
    tolerance: float = 0.0
    tolerance_reason: str = ""


POINT = "point"
"""The dimension of the points of a table or a design, which are in no order."""

POINT_TABLE = "point_table"
"""The attribute of results that have this dimension: JSON of the table's parameters, and where it comes from."""


@dataclass(frozen=True)
class PointTable:
    """A table of points: the parameters that its columns are, and what it comes from.

    ``origin`` has ``file``, or ``design``, ``n``, ``seed`` and ``ranges`` as the study writes them.
    """

    names: tuple[str, ...]
    origin: Mapping[str, Any] = field(default_factory=dict)


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
        published: published results.
        source: the file that it was read from.
        question: what it asks, for reports.
        claims: published statements, with the numbers that they are about.
        conclusion: the sentences of its answer.
        text: the file as written.
        overrides: what the command line changed.
        document: what a store needs to make the study again: with overrides, and with absolute paths of files.
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
    published: Published | None = None
    source: str = ""
    question: str = ""
    claims: tuple[Claim, ...] = ()
    conclusion: Conclusion | None = None
    text: str = ""
    overrides: tuple[str, ...] = ()
    document: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @property
    def dimensions(self) -> dict[str, tuple[str, ...]]:
        """The axes along each dimension, by the dimension's name: `POINT`, or the first of these axes."""
        groups = [] if self.points is None else [(POINT, self.points.names)]
        partner = {name: group for group in self.zipped for name in group}
        groups += [(group[0], group) for group in (partner.get(name, (name,)) for name in self.axes)]
        found: dict[str, tuple[str, ...]] = {}
        for dimension, group in groups:
            if not any(group[0] in axes for axes in found.values()):
                found[dimension] = group
        return found

    @property
    def is_ours(self) -> bool:
        """Whether only code that comes with linksweep computes it."""
        return self.experiment_reference.partition(".")[0] == "linksweep" and not self.document.get("define")

    @property
    def keeps_samples(self) -> bool:
        """Whether the ledger holds realisations: the study or the experiment asks for them."""
        return self.sampling.keep_samples or self.experiment.keeps_samples

    def meaning(self) -> dict[str, Any]:
        """Return what determines the results of every point besides its own parameters: if this differs, results cannot
        be mixed.
        """
        defaults = self.experiment.defaults()
        return {
            "experiment": self.experiment.name,
            "experiment_version": self.experiment.version,
            **({} if self.experiment.deterministic else {"seed": self.sampling.seed}),
            **({"keep_samples": True} if self.sampling.keep_samples else {}),
            **({"common_random_numbers": True} if self.sampling.common_random_numbers else {}),
            "fixed": {k: v for k, v in sorted(self.fixed.items()) if v != defaults[k]},
        }

    def numbers(self) -> dict[str, int]:
        """Return how many realisations there are, nothing where a point is computed once."""
        if self.experiment.deterministic:
            return {}
        return {"n_sim": self.sampling.n_sim, "n_cat": self.sampling.n_cat}

    def digest(self) -> str:
        """Return a SHA-256 of everything that determines the results, whatever the layout of the file."""
        whole = self.meaning() | {
            "axes": self.axes,
            **self.numbers(),
            **({} if self.sampling.precision is None else {"precision": [self.sampling.precision, self.sampling.most]}),
            "zip": self.zipped,
            **({} if self.points is None else {"points": self.points.names}),
            "exclude": [[vars(c) for c in clause] for clause in self.excluded],
        }
        return hashlib.sha256(json.dumps(whole, sort_keys=True, default=content_digest).encode()).hexdigest()
