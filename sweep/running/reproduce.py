"""The study of an existing store, and one of its points computed again in this process."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from sweep.contract import Experiment, GeneratorPair, ResultError, SweepError, shown, suggest
from sweep.executing.task import TaskResult
from sweep.executing.worker import function_values, run_block
from sweep.formatting import first_of
from sweep.functions.adapter import FunctionExperiment
from sweep.functions.results import Flat
from sweep.planning.accumulator import Accumulator
from sweep.planning.failing import failing
from sweep.planning.grid import Grid, describe
from sweep.planning.plan import Plan, Work
from sweep.planning.point_status import Status
from sweep.planning.streams import generators_of
from sweep.planning.work_queue import Pending
from sweep.running.first_result import as_rows
from sweep.running.results import assemble
from sweep.running.trust import foreign_code, require_trust
from sweep.stores.code import differences_of_code
from sweep.stores.location import Where
from sweep.stores.opened import OpenStore
from sweep.studies.option_values import parse_places, parse_value
from sweep.studies.reader import study_of_attributes
from sweep.studies.record import as_recorded
from sweep.studies.study import POINT, Study

MAX_NAMED = 10


@dataclass(frozen=True)
class Reproduction:
    """One point again: its results, and the variables that differ from those in the store in any bit.

    ``differences`` is None where the store has no results of the point, ``stored`` the word for its status there,
    ``other_code`` says in what today's code differs from that of the store.
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
    require_trust(store.location, store.attributes, trust)
    return study_of_attributes(store.attributes, str(store.location))


def study_to_look_at(store: Where) -> Study:
    """Return the study of a store of the link, to draw what it is about; nothing that the store names is imported.

    Raises SweepError for another experiment, and where the study names functions in files.
    """
    attributes = OpenStore(store).attributes
    if code := foreign_code(attributes):
        raise SweepError(
            f"only stores of the link alone can be drawn so; this one names {', '.join(code)}, and looking at a store "
            "never runs what it names",
            str(store),
        )
    return study_of_attributes(attributes, str(store))


def reproduce(store: Where, at: str, *, trust: bool = False) -> Reproduction:
    """Compute the point at ``NAME=VALUE,...`` again, serially, in this process.

    Raises SweepError where that is not one point of the store, as `study_of`, and whatever the experiment raises.
    """
    opened = OpenStore(store)
    study = _study_of(opened, trust)
    place = place_of(study, at, str(store))
    own = {name: value for name, value in place.items() if value != study.experiment.defaults()[name]}
    fixed = {name: value for name, value in study.fixed.items() if name not in study.axes}
    alone = replace(
        study,
        axes={},
        zipped=(),
        points=None,
        excluded=(),
        fixed=fixed | own,
        published=None,
        claims=(),
        conclusion=None,
    )
    alone = as_recorded(alone, opened.attributes)
    result = compute(Plan(Grid(alone)))
    stored = opened.dataset().isel(_indices(study, place))
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
    plan = _with_layout(plan)
    accumulator = Accumulator(plan, {}, np.empty((0, 0)))
    pending = Pending(plan, accumulator)
    texts: dict[bytes, str] = {}
    with threadpool_limits(1):  # as everywhere: the last bits depend on it
        while tasks := pending.take(1):
            for work in tasks[0]:
                result = _result(plan.grid.study, work)
                texts |= result.texts
                for row, point in enumerate(work.points):
                    more = accumulator.add(point, work.block, result.sums[row], result.samples.get(row))
                    pending.add(plan.work((point,), block) for block in more)
    for problem in failing(accumulator, np.flatnonzero(accumulator.status == Status.DONE).tolist()).values():
        raise problem
    return assemble(plan, accumulator, texts)


def _with_layout(plan: Plan) -> Plan:
    """Return the plan of a plain function whose results are only known after the first with what that is like."""
    study = plan.grid.study
    if not isinstance(study.experiment, FunctionExperiment) or not study.experiment.undeclared:
        return plan
    [[work]] = Pending(plan, Accumulator(plan, {}, np.empty((0, 0)))).take(1)
    first = _values(study, study.experiment, work)[0]
    return plan.of(replace(study, experiment=study.experiment.with_layout(first.layout)))


def _result(study: Study, work: Work) -> TaskResult:
    if not isinstance(study.experiment, FunctionExperiment):
        points = [point.parameters for point in work.points]
        rows, _ = run_block(study.experiment, points, work.block.n_sim, _generators(study, work))
        return TaskResult(rows, np.zeros(len(rows)))
    flats = _values(study, study.experiment, work)
    values = TaskResult(np.empty((0, 0)), np.zeros(len(flats)), values=dict(enumerate(flats)))
    result = as_rows(study.experiment, [work], values)
    for failure in result.failures.values():
        raise ResultError(failure.message)
    return result


def _values(study: Study, experiment: FunctionExperiment, work: Work) -> list[Flat]:
    points = [point.parameters for point in work.points]
    return function_values(experiment, points, work.block.n_sim, _generators(study, work))


def _generators(study: Study, work: Work) -> list[GeneratorPair]:
    return generators_of(study.sampling.seed, work.points[0].stream, work.block)


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
            given[name] = _on_axis(study.experiment, study.axes, name, text, problems)
    fitting = {
        dimension: [values for values in rows if all(given.get(n, v) == v for n, v in zip(axes, values, strict=True))]
        for dimension, axes in study.dimensions.items()
        for rows in [dict.fromkeys(zip(*(study.axes[name] for name in axes), strict=True))]
    }
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
    if any(all(c.holds(parameters[c.name]) for c in clause) for clause in study.excluded):
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


def _on_axis(
    experiment: Experiment, axes: Mapping[str, Sequence[Any]], name: str, text: str, problems: list[str]
) -> Any:
    try:
        value = experiment.parameter(name).parse(parse_value(text))
    except ValueError as error:
        problems.append(f"--at {error}")
        return None
    if value not in axes[name]:
        problems.append(f"--at {name} = {shown(value)}: not on the axis, which has {_listed(axes[name])}")
    return value


def _indices(study: Study, place: Mapping[str, Any]) -> dict[str, int]:
    """Return where along each dimension a point stands."""
    return {
        dimension: list(zip(*(study.axes[name] for name in axes), strict=True)).index(tuple(place[n] for n in axes))
        for dimension, axes in study.dimensions.items()
    }


def _listed(values: Any) -> str:
    return first_of(list(values), MAX_NAMED)
