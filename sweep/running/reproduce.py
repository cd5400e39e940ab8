"""Makes the study of an existing store again, and computes one of its points again in this process."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from linksweep.sweep.contract import Array, Experiment, ResultError, Rows, SweepError, Value, shown, suggest
from linksweep.sweep.formatting import first_of
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.failing import failing
from linksweep.sweep.planning.grid import Grid, describe
from linksweep.sweep.planning.plan import Plan, Work
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.planning.streams import generators_of
from linksweep.sweep.planning.work_queue import Pending
from linksweep.sweep.running.results import assemble
from linksweep.sweep.running.trust import asking, ours_alone
from linksweep.sweep.stores.code import differences_of_code
from linksweep.sweep.stores.location import Where
from linksweep.sweep.stores.store import OpenStore
from linksweep.sweep.studies.document import parse_places, parse_value
from linksweep.sweep.studies.reader import study_of_attributes
from linksweep.sweep.studies.record import as_recorded
from linksweep.sweep.studies.study import POINT, Study

MAX_NAMED = 10


@dataclass(frozen=True)
class Reproduction:
    """One point computed again: its results, and the variables that differ from those in the store in any bit.

    ``differences`` is None where the store has no results of the point, ``stored`` is the word for its status
    there, ``other_code`` says how today's code differs from that of the store.
    """

    place: str
    dataset: xr.Dataset
    stored: str
    differences: dict[str, tuple[Any, Any]] | None
    other_code: list[str]


def study_of(store: Where, *, trust: bool = False) -> Study:
    """Return the study whose results a store holds, with its experiment imported.

    Raises SweepError if there is none or it cannot be made again, and where its code needs the user's ``trust`` (see
    `sweep.running.trust`).
    """
    return _study_of(OpenStore(store), trust)


def _study_of(store: OpenStore, trust: bool) -> Study:
    where = str(store.location)
    return study_of_attributes(store.attributes, where, asking(store.location, store.attributes, trust))


def study_to_look_at(store: Where) -> Study:
    """Return the study of a store of the link, to draw what it simulates; nothing that the store names is imported.

    Raises SweepError for another experiment, and where the study names functions in files.
    """
    return study_of_attributes(OpenStore(store).attributes, str(store), ours_alone())


def reproduce(store: Where, at: str, *, trust: bool = False) -> Reproduction:
    """Compute the point at ``NAME=VALUE,...`` again, serially, in this process.

    Raises SweepError where that is not one point of the store, as `study_of`, and whatever the experiment raises.
    """
    opened = OpenStore(store)
    study = _study_of(opened, trust)
    place = place_of(study, at, str(store))
    own = {name: value for name, value in place.items() if value != study.experiment.defaults()[name]}
    alone = replace(study, axes={}, zipped=(), points=None, fixed={**study.fixed, **own}, published=None)
    result = compute(Plan(Grid(as_recorded(alone, opened.attributes))))
    axes = study.dimensions
    indices = {name: rows.index(tuple(place[axis] for axis in axes[name])) for name, rows in Grid(study).rows.items()}
    stored = opened.dataset().isel(indices)
    status = Status(int(stored["status"]))
    other_code = differences_of_code(opened.attributes, study)
    differences = None
    if status == Status.DONE:
        pairs = {name: (stored[name].values, result[name].values) for name in map(str, result) if name in stored}
        differences = {
            name: (was, now)
            for name, (was, now) in pairs.items()
            if not np.array_equal(was, now, equal_nan=was.dtype.kind == "f")
        }
    return Reproduction(describe(study, place), result, status.word, differences, other_code)


def compute(plan: Plan) -> xr.Dataset:
    """Return the dataset of a plan, computed in this process; an exception of the experiment is not caught."""
    accumulator = Accumulator(plan)
    pending = Pending(plan, accumulator)
    with threadpool_limits(1):  # as everywhere, since the last bits depend on it
        while tasks := pending.take(1):
            for work in tasks[0]:
                experiment, rows, kept = _rows(accumulator.plan.grid.study, work)
                accumulator.learn(experiment)
                for row, point in enumerate(work.points):
                    more = accumulator.add(point, work.block, rows[row : row + 1], kept[row])
                    pending.add(plan.work((point,), block) for block in more)
    for problem in failing(accumulator, np.flatnonzero(accumulator.status == Status.DONE).tolist()).values():
        raise problem
    return assemble(accumulator.plan, accumulator)


def _rows(study: Study, work: Work) -> tuple[Experiment, Rows, list[Array | None]]:
    """Return the experiment as it is known from what a block left of its points, the rows of these, and what was kept.

    Raises ResultError where that is not as in the store, and whatever the experiment raises.
    """
    points = [point.parameters for point in work.points]
    pairs = generators_of(study.sampling.seed, work.points[0].stream, work.block)
    outcomes = study.experiment.compute(points, work.block.n_sim, pairs)
    experiment, fields, refused = study.experiment.learned(dict(enumerate(outcomes)))
    for why in refused.values():
        raise ResultError(why)
    rows = np.array([fields[row] for row in range(len(outcomes))], dtype=experiment.reducer.dtype)
    return experiment, rows, [outcome.kept for outcome in outcomes]


def place_of(study: Study, at: str, where: str) -> dict[str, Any]:
    """Return a point's parameters from ``NAME=VALUE,...``; raises SweepError that says what is wrong or missing."""
    problems: list[str] = []
    given: dict[str, Any] = {}
    for name, text in parse_places([at] if at.strip() else []).items():
        if name == POINT and study.points is not None:
            given |= _row(study, text, problems)
        elif name not in study.axes:
            hint = suggest(name, list(study.axes)) if study.axes else ""
            problems.append(f"--at {name}: is not an axis{hint or f'; axes are {_listed(study.axes)}'}")
        else:
            given[name] = _on_axis(study, name, text, problems)
    grid = Grid(study)
    fitting: dict[str, list[tuple[Value, ...]]] = {}
    for dimension, rows in grid.rows.items():
        wanted = {k: given[name] for k, name in enumerate(grid.dimensions[dimension]) if name in given}
        fitting[dimension] = [row for row in dict.fromkeys(rows) if all(row[k] == v for k, v in wanted.items())]
    if not problems:
        problems += [
            f"--at: {dimension} needs a value, one of {_listed(study.axes.get(dimension) or range(len(rows)))}"
            if rows
            else f"--at {shown(at)}: no point has these values together"
            for dimension, rows in fitting.items()
            if len(rows) != 1
        ]
    if problems:
        raise SweepError(problems, where)
    parameters = study.experiment.defaults() | dict(study.fixed)
    for dimension, axes in study.dimensions.items():
        parameters |= dict(zip(axes, fitting[dimension][0], strict=True))
    if grid.excludes(parameters):
        raise SweepError(f"--at {shown(at)}: the study excludes this point", where)
    return parameters


def _row(study: Study, text: str, problems: list[str]) -> dict[str, Any]:
    """Return the parameters of a row of a table of points, which are counted from 0."""
    assert study.points is not None, "asked before"
    rows = len(study.axes[study.points.names[0]])
    if not text.isdecimal() or int(text) >= rows:
        problems.append(f"--at {POINT} = {shown(text)}: must be the number of a point, from 0 to {rows - 1}")
        return {}
    return {name: study.axes[name][int(text)] for name in study.points.names}


def _on_axis(study: Study, name: str, text: str, problems: list[str]) -> Any:
    try:
        value = study.experiment.parameter(name).parse(parse_value(text))
    except ValueError as error:
        problems.append(f"--at {error}")
        return None
    if value not in study.axes[name]:
        problems.append(f"--at {name} = {shown(value)}: not on the axis, which has {_listed(study.axes[name])}")
    return value


def _listed(values: Any) -> str:
    return first_of(list(values), MAX_NAMED)
