"""Makes the study of an existing store again, and computes some of its points again: one in this process, or a few, one
by one in new processes, in two orders, since results must not depend on what a process has computed before.
"""

import heapq
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from linksweep.sweep.code import Code, file_of, load_experiment
from linksweep.sweep.contract import ResultError, Status, SweepError
from linksweep.sweep.executing.executor import Children
from linksweep.sweep.executing.task import Task, TaskResult
from linksweep.sweep.executing.worker import compute, one_thread
from linksweep.sweep.planning.grid import Grid, GridPoint, describe
from linksweep.sweep.running.run import Session, differences_of_code, records_of
from linksweep.sweep.stores.location import Folder, Where, located
from linksweep.sweep.stores.store import OpenStore, was_written_here
from linksweep.sweep.studies.reader import study_of_attributes
from linksweep.sweep.studies.record import Recorded, as_recorded
from linksweep.sweep.studies.study import DEFAULT_EXPERIMENT, Study, is_other

Pairs = dict[str, tuple[Any, Any]]


@dataclass(frozen=True)
class Reproduction:
    """One point computed again: its results, and the variables that differ from those in the store in any bit.

    ``differences`` is None where the store has no results of the point, ``stored`` is the word for its status
    there, ``other_code`` says how today's code differs from that of the store.
    """

    place: str
    dataset: xr.Dataset
    stored: str
    differences: Pairs | None
    other_code: list[str]


def study_of(where: Where | OpenStore, *, trust: bool = False) -> Study:
    """Return the study whose results a store holds, with its experiment imported.

    Looking at a store loads nothing that it names (see `sweep.studies.record.Recorded`); computing from it does.
    Raises SweepError if there is no study or it cannot be made again, and where its code needs the user's ``trust``: it
    lies inside the store, or the store was not written here.
    """
    opened = where if isinstance(where, OpenStore) else OpenStore(where)

    def check(reference: str) -> None:
        if trust or reference == DEFAULT_EXPERIMENT:
            return
        file, reason = file_of(reference), ""
        if not was_written_here(opened.location, opened.attributes):
            reason = "and the store was not written here: by this user, on this host, at this place"
        if isinstance(place := opened.location, Folder) and Path(file).resolve().is_relative_to(place.path.resolve()):
            reason = "which lies inside the store"
        if reason:
            problem = f"would run {file}, {reason}; inspect it, and give --trust if it may run"
            raise SweepError(problem, str(place))

    return study_of_attributes(opened.attributes, str(opened.location), Code(check))


def study_to_look_at(store: Where) -> Study:
    """Return the study of a store of the link, to draw what it simulates; nothing that the store names is imported.

    Raises SweepError for another experiment, and where the study names functions in files.
    """
    attributes = OpenStore(store).attributes
    if attributes["experiment"] != DEFAULT_EXPERIMENT:
        raise SweepError("no sky and no accuracy here: only studies of the link have these figures", str(store))
    return study_of_attributes(attributes, str(store), Recorded(load_experiment(DEFAULT_EXPERIMENT)))


def reproduce(study: Study, dataset: xr.Dataset, point: GridPoint) -> Reproduction:
    """Compute a point of the study of a store, with its ``dataset``, again, serially, in this process; raises what the
    experiment raises.
    """

    def raising(task: Task) -> Any:  # nothing is caught or captured, for the debugger
        return compute(replace(task, caught=False, repeatable=False))

    with one_thread():
        result, why = _alone(as_recorded(study, dataset.attrs), point, raising)
    if why:
        raise ResultError(why)
    stored = _at(dataset, Grid(study), point)
    status = Status(int(stored["status"]))
    differences = _differences(stored, result) if status == Status.DONE else None
    other_code = differences_of_code(records_of(dataset.attrs), study)
    return Reproduction(describe(study, point.parameters), result, status.word, differences, other_code)


def verify(study: Study, where: Where, number: int) -> tuple[int, list[str], list[str]]:
    """Compute ``number`` finished points of a store again, chosen by their digests: alone in new processes, in their
    order and in the reverse order, and compare every bit with what is stored.  Return how many there were, a sentence
    for each that differs, and how today's code differs from that of the store.

    Results of a vectorised function are compared within its tolerance.  Raises SweepError as `OpenStore`, and for a
    function that cannot be sent to another process.
    """
    opened, session = OpenStore(where), Session.open(Grid(study), where, accept_code=True)
    study = session.asked().plan.grid.study
    tolerance = study.experiment.tolerance if study.experiment.vectorised else 0.0
    grid = Grid(study)
    dataset = session.part()[0].to_xarray().transpose(*grid.dimensions, ...)
    done = np.intersect1d(np.flatnonzero(dataset["status"].values == Status.DONE), grid.indices())
    chosen = heapq.nsmallest(number, grid.points(done), key=lambda point: point.digest)

    def computed(points: Sequence[GridPoint]) -> list[tuple[xr.Dataset, str]]:
        with Children(forked=False) as child:  # a fork has the state of this process
            return [_alone(study, point, child.run) for point in points]

    differing: list[str] = []
    forward, backward = computed(chosen), computed(chosen[::-1])[::-1]
    for point, *both in zip(chosen, forward, backward, strict=True):
        stored = _at(dataset, grid, point)
        if any(_differences(stored, again, tolerance) for again, _ in both):  # of a point that fails, its status
            failed = next((f"; computed again it fails: {why}" for _, why in both if why), "")
            differing.append(f"{describe(study, point.parameters)} has other results than in the store{failed}")
    return len(chosen), differing, differences_of_code(records_of(opened.attributes), study)


def _at(dataset: xr.Dataset, grid: Grid, point: GridPoint) -> xr.Dataset:
    return dataset.isel({name: place for name, (place,) in grid.places(np.array([point.index])).items()})


def _alone(study: Study, point: GridPoint, compute: Callable[[Task], TaskResult]) -> tuple[xr.Dataset, str]:
    """Return the dataset of a point in a session of its own, and why it failed, '' if it did not."""
    defaults = study.experiment.defaults()
    swept = {name: value for name, value in point.parameters.items() if is_other(value, defaults[name])}
    alone = replace(study, axes={}, zipped=(), points=None, fixed={**study.fixed, **swept}, published=None, part=None)

    def execute(take: Callable[[int], Sequence[Any]]) -> Iterator[tuple[Any, TaskResult]]:
        while jobs := take(1):
            result = compute(jobs[0].task())
            yield jobs[0], replace(result, refused="")  # what differs between two calls is found by comparing

    with tempfile.TemporaryDirectory(prefix="linksweep-", ignore_cleanup_errors=True) as folder:
        session = Session.open(Grid(alone), located(Path(folder) / "point.zarr"))
        dataset, failures = session.compute(execute)
        return dataset.to_xarray().drop_vars("wall_time").load(), "".join(failures.values())


def _differences(stored: xr.Dataset, again: xr.Dataset, tolerance: float = 0.0) -> Pairs:
    """Return the variables of a point that differ when it is computed again, in any bit or by more than a tolerance."""
    one, other = xr.align(stored, again, join="inner")  # a ragged one of others is longer: their lengths tell
    pairs = {str(name): (one[name].values, other[name].values) for name in other if name in one}
    return {name: pair for name, pair in pairs.items() if not _equal(*pair, tolerance)}


def _equal(one: Any, other: Any, tolerance: float) -> bool:
    if tolerance and one.dtype.kind == "f" and one.shape == other.shape:
        return np.allclose(one, other, rtol=tolerance, atol=0.0, equal_nan=True)
    return np.array_equal(one, other, equal_nan=one.dtype.kind in "fM")
