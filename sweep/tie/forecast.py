"""`forecast`: what further observations would do to the link of two tables, and which sources to observe."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from linksweep.core.frames import MAS, Array
from linksweep.core.link import LinkError
from linksweep.core.tie import forecast as core
from linksweep.core.tie.noise import ESTIMATE
from linksweep.core.tie.problem import Problem, source_sums
from linksweep.core.tie.solution import inverted
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tables.options import number
from linksweep.sweep.tie.options import FORECAST, TABLE, ForecastOptions, Options
from linksweep.sweep.tie.setup import DECLARED, Setup, listed, set_up

if TYPE_CHECKING:
    import xarray as xr


def forecast(satellite: str | Path, reference: str | Path, unknowns: str | None = None, **options: Any) -> "xr.Dataset":
    """Predict the formal errors of a link with further observations, and the sources to observe first.

    Args:
        satellite: the table with the five astrometric parameters, as for `tie`.
        reference: the table with the measurements of the same objects so far.
        unknowns: blocks like "orientation,spin".
        options: those of `sweep forecast`, under the names of `ForecastOptions` and `Options` in `sweep.tie.options`:
            ``add`` (epochs, Julian years, at which a single-epoch position of each source is added), ``error`` (mas, of
            its coordinates), ``release`` (to which the satellite's errors are scaled), ``from_release``, ``number`` (of
            sources to choose), ``goal`` (the blocks for which these are best), ``criterion`` ("A": the trace of their
            covariance, "D": its determinant), ``all_sources``, and those of tables as for `tie`.

    Returns:
        A dataset with ``error`` (stage, unknown) in mas and mas/yr, ``error_with_epoch`` (new_epoch, unknown),
        ``criterion_alone`` and ``rank`` of each source, and the steps of the choice; `plot` draws it.

    Raises:
        SweepError: for bad input, or if the tables do not determine the unknowns.

    Example:
        >>> plan = forecast("psrpi", "psrpi", "orientation,spin", add=[2030], number=2, goal=["spin"])
        >>> plan.stage.values.tolist()
        ['now', 'all observed']
        >>> plan.step_source.values.tolist()
        ['', 'J1537+1155', 'J2354+6155']
    """
    plan = ForecastOptions.named(FORECAST, options, Options)
    asked = Options.named(FORECAST, {"unknowns": unknowns, **options}, ForecastOptions)
    goal = tuple(listed(plan.goal))
    add = _epochs(plan)
    if ESTIMATE in asked.jitter:
        raise SweepError("a forecast uses no measured values: sweep tie --jitter estimate says how large a jitter is")
    setup = set_up(satellite, reference, asked, plan.all_sources)
    problem = setup.problem
    goals = core.Goal(problem.unknowns, goal, plan.criterion)
    try:
        _ = goals.parts  # raises for an unknown block
        future, old, further = released(problem, plan.release, plan.from_release, asked.epoch is None)
        variables, coordinates = _planned(setup, future, plan.release, add, plan.error * MAS, plan.number, goals)
    except ValueError as problem_found:
        raise SweepError(str(problem_found)) from problem_found
    attributes = {
        "result": "forecast",
        "epoch_of_forecast": future.epoch,
        "release": plan.release if old else "",
        "from_release": old,
        "new_error_mas": plan.error,
        "goal": ", ".join(goal or problem.unknowns.names),
        "criterion": plan.criterion,
        **setup.attributes(),
        "notes": [*further, *setup.notes],
    }
    import xarray as xr

    return xr.Dataset(variables, coords=coordinates, attrs=attributes)


def released(
    problem: Problem, release: str, from_release: str, epoch_moves: bool
) -> tuple[Problem, str, Sequence[str]]:
    """Return a problem with the errors of a release, the release that they were of, and notes; "table" leaves them."""
    if release == TABLE:
        return problem, "", ()
    old = core.release_of(problem.satellite.epoch, release, None if from_release == TABLE else from_release)
    future, notes = core.released(problem, old, release, epoch_moves)
    return future, old, notes


def _epochs(plan: ForecastOptions) -> list[float]:
    """Return the epochs of new positions; raises SweepError for what is no list of years, and for none to choose."""
    try:
        epochs = [DECLARED["epoch"].parse(number(year)) for year in listed(plan.add)]
    except ValueError as error:
        raise SweepError(f"add: {error}") from None
    if plan.number and not epochs:
        raise SweepError(f"{plan.number} sources to choose, but no epochs to observe them at")
    return epochs


def _planned(
    setup: Setup, future: Problem, release: str, add: list[float], error: float, number: int, goal: core.Goal
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the variables and coordinates of the dataset; ``error`` (rad) is that of the new positions."""
    base = source_sums(future)
    planned = source_sums(core.with_new_rows(future, add, error)) if add else base
    sources, normals = core.choose(base, planned, number, goal)
    unknowns, total = setup.problem.unknowns, base.normal.sum(axis=0)
    stages = {"now": source_sums(setup.problem).normal.sum(axis=0)}
    stages |= {} if release == TABLE else {release: total}
    stages |= {"all observed": planned.normal.sum(axis=0)} if add else {}
    gain = np.array([goal.value(total + one) for one in planned.normal - base.normal])
    variables: dict[str, Any] = {
        "error": (("stage", "unknown"), np.array([_errors(normal) for normal in stages.values()])),
        "criterion": ("stage", _scaled([goal.value(normal) for normal in stages.values()], goal)),
        "criterion_alone": ("source", _scaled(gain, goal), {"long_name": "if this source alone is observed"}),
        "rank": ("source", np.argsort(np.argsort(gain)) + 1),
    }
    if add:
        observed = (source_sums(core.with_new_rows(future, [epoch], error)).normal.sum(axis=0) for epoch in add)
        errors = np.array([_errors(normal) for normal in observed])
        variables["error_with_epoch"] = (("new_epoch", "unknown"), errors)
    if sources:
        chosen = np.array(["", *setup.names[sources]]).astype(str)
        variables |= {
            "step_source": ("step", chosen),
            "step_error": (("step", "unknown"), np.array([_errors(normal) for normal in normals])),
            "step_criterion": ("step", _scaled([goal.value(normal) for normal in normals], goal)),
        }
    coordinates = {
        "stage": list(stages),
        "unknown": list(unknowns.labels),
        "unit": ("unknown", list(unknowns.units)),
        "block": ("unknown", [b.name for b in unknowns.blocks for _ in b.labels]),
        "source": setup.names.astype(str),
    } | ({"new_epoch": add} if add else {})
    return variables, coordinates


def _errors(normal: Array) -> Array:
    """Return formal errors in mas and mas/yr; NaN where the unknowns are not determined."""
    try:
        return np.sqrt(np.diag(inverted(normal))) / MAS
    except LinkError:
        return np.full(len(normal), np.nan)


def _scaled(values: Sequence[float] | Array, goal: core.Goal) -> Array:
    """Return a criterion in mas instead of rad: the root of the mean variance, or the log determinant."""
    numbers, n = np.asarray(values), len(goal.parts)
    return np.asarray(np.sqrt(numbers / n) / MAS if goal.criterion == "A" else numbers - 2.0 * n * np.log(MAS))
