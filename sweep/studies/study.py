"""What a study is once it was read and checked."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from linksweep.sweep.contract import Experiment, Value
from linksweep.sweep.studies.form import Claim, Conclusion, Condition, PublishedForm, Sampling
from linksweep.sweep.studies.part import Part
from linksweep.sweep.tables.file import content_digest


@dataclass(frozen=True)
class Published:
    """Published results: rows of {column: number as printed}, the columns being axes and outputs, and what is known of
    them.
    """

    about: PublishedForm
    rows: tuple[Mapping[str, str], ...]


POINT = "point"
"""The dimension of the points of a table or a design, which are in no order."""

POINT_TABLE = "point_table"
"""The attribute of results that have this dimension: JSON of the table's parameters, and where it comes from."""


@dataclass(frozen=True)
class PointTable:
    """A table of points: the parameters that its columns are, what it comes from, and the labels of its rows by name.

    ``origin`` has ``file``, or ``design``, ``n``, ``seed`` and ``ranges`` as the study writes them.
    """

    names: tuple[str, ...]
    origin: Mapping[str, Any] = field(default_factory=dict)
    labels: Mapping[str, Sequence[Any]] = field(default_factory=dict)

    def written(self, columns: Mapping[str, Any]) -> dict[str, Any]:
        """Return the table [points] that has these columns and what is known of them."""
        further = {"labels": list(self.labels), "origin": dict(self.origin)}
        return {"columns": {**columns, **self.labels}} | {key: value for key, value in further.items() if value}


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
        counts: a larger n_sim of single points, by their digests, or 0 for those that are left out, as `sweep refine`
            has them.
        when: the parameters that have an effect only with some values of others; None where they have none.
        published: published results.
        source: the file that it was read from.
        question: what it asks, for reports.
        claims: published statements, with the numbers that they are about.
        conclusion: the sentences of its answer.
        text: the file as written.
        overrides: what the command line changed.
        document: what a store needs to make the study again: with overrides, and with absolute paths of files.
        part: the part of its work that is computed, None for all.
        description: what the docstring of a function says, without its title.
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
    counts: Mapping[str, int] = field(default_factory=dict)
    when: tuple[str, ...] = ()
    published: Published | None = None
    source: str = ""
    question: str = ""
    claims: tuple[Claim, ...] = ()
    conclusion: Conclusion | None = None
    text: str = ""
    overrides: tuple[str, ...] = ()
    document: Mapping[str, Any] = field(default_factory=dict, repr=False)
    part: Part | None = None
    description: str = ""

    def __repr__(self) -> str:
        return f"<Study {self.name} over {', '.join(self.axes) or 'one point'}: {self.title!r}>"

    @property
    def dimensions(self) -> dict[str, tuple[str, ...]]:
        """The axes along each dimension, by the dimension's name: `POINT`, or the first of these axes."""
        groups = [] if self.points is None else [(POINT, self.points.names)]
        partner = {name: group for group in self.zipped for name in group}
        groups += [(group[0], group) for group in (partner.get(name, (name,)) for name in self.axes)]
        dimensions: dict[str, tuple[str, ...]] = {}
        for dimension, group in groups:
            if not any(group[0] in axes for axes in dimensions.values()):
                dimensions[dimension] = group
        return dimensions

    @property
    def is_ours(self) -> bool:
        """Whether only code that comes with linksweep computes it."""
        return self.experiment_reference.partition(".")[0] == "linksweep" and not self.document.get("define")

    @property
    def draws_together(self) -> bool:
        """Whether points that share random numbers are computed in one call, for which they are drawn once."""
        return self.sampling.common_random_numbers and not self.experiment.draws_alone

    @property
    def keeps_samples(self) -> bool:
        """Whether the ledger holds realisations: the study or the experiment asks for them."""
        return self.sampling.keep_samples or self.experiment.keeps_samples

    def meaning(self) -> dict[str, Any]:
        """Return what determines the results of every point besides its own parameters: if this differs, results cannot
        be mixed.
        """
        defaults = self.experiment.defaults()
        shared = sorted(self.experiment.shared) if self.experiment.draws_alone else True
        return {
            "experiment": self.experiment.name,
            "experiment_version": self.experiment.version,
            **({} if self.experiment.deterministic else {"seed": self.sampling.seed}),
            **({"keep_samples": True} if self.sampling.keep_samples else {}),
            **({"common_random_numbers": shared} if self.sampling.common_random_numbers else {}),
            **({"when": self.document["when"]} if self.document.get("when") else {}),
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
            **({"labels": self.points.labels} if self.points is not None and self.points.labels else {}),
            **({"counts": self.counts} if self.counts else {}),
            "exclude": [[vars(c) for c in clause] for clause in self.excluded],
        }
        return hashlib.sha256(json.dumps(whole, sort_keys=True, default=content_digest).encode()).hexdigest()
