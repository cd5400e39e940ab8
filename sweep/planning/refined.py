"""A study with the points and realisations that rounds of refinement have added to it, as a store records them."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from linksweep.sweep.contract import Value
from linksweep.sweep.formatting import counted
from linksweep.sweep.planning.grid import Grid, GridPoint, all_but
from linksweep.sweep.studies.study import Study

REFINED = "refined"
"""The attribute of a store with the rounds that have refined its study, as JSON."""


@dataclass(frozen=True)
class Round:
    """What one round adds, and what it is ``wanted`` for: ``points``, each by its values on all axes, of which that
    ``along`` one may be new; and a larger ``n_sim`` of single points by their digests.
    """

    wanted: str
    along: str
    points: list[dict[str, Any]]
    n_sim: dict[str, int]

    def __str__(self) -> str:
        new = [counted(len(self.points), "new point")] if self.points else []
        more = [f"more realisations of {counted(len(self.n_sim), 'point')}"] if self.n_sim else []
        return f"{', '.join([*new, *more])} for {self.wanted}"


def rounds_of(attributes: Mapping[str, Any]) -> list[Round]:
    """Return the rounds that a store with these attributes records."""
    return [Round(**one) for one in json.loads(attributes.get(REFINED, "[]"))]


def refined(study: Study, rounds: Iterable[Round]) -> Study:
    """Return a study with what some rounds add: of the grown grid their points alone.

    Points on other axes than the study has, or beside its values on them, are left out.
    """
    parameters, axes = {name: study.experiment.parameter(name) for name in study.axes}, dict(study.axes)
    counts, added = dict(study.counts), set[bytes]()
    for one in rounds:
        for raw in one.points if all(point.keys() == axes.keys() for point in one.points) else ():
            point = {name: parameters[name].parse(value) for name, value in raw.items()}
            if all(value in axes[name] for name, value in point.items() if name != one.along):
                axes[one.along] = tuple(dict.fromkeys([*axes[one.along], point[one.along]]))
                added.add(point_at(study, point).digest)
        counts |= {name: max(n, counts.get(name, 0)) for name, n in one.n_sim.items()}
    grown = [name for name, values in study.axes.items() if len(axes[name]) > len(values)]
    axes |= {name: tuple(sorted(axes[name], key=lambda value: (value is None, value or 0))) for name in grown}
    grid, written = Grid(study), {name: parameters[name].written(axes[name]) for name in grown}
    counts |= all_but(replace(study, axes=axes), {*added, *grid.digests(grid.indices())})
    document = {**study.document, "counts": counts, "axes": study.document.get("axes", {}) | written}
    return replace(study, axes=axes, counts=counts, document=document)


def point_at(study: Study, values: Mapping[str, Value]) -> GridPoint:
    """Return the point of a study with some values on its axes, which need not have them."""
    return Grid(replace(study, axes={n: (values[n],) for n in study.axes}, zipped=(), points=None, counts={})).point(0)
