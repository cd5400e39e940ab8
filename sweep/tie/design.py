"""What a point of a study of a link stands for: tables as they are, their solution, and the tables to simulate."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.constants import MAS
from linksweep.core.tie.clips import Clip, parse_clip
from linksweep.core.tie.forecast import Goal, choose, released, scaled_from, scaling_notes, with_new_rows
from linksweep.core.tie.problem import Problem, source_sums
from linksweep.sweep.contract import Point, SweepError
from linksweep.sweep.tie.options import Options, TableOptions, parse_bins
from linksweep.sweep.tie.parameters import PARAMETERS, TABLE
from linksweep.sweep.tie.setup import ALL, ZERO_MOTION, Setup, set_up
from linksweep.sweep.tie.solution import Link, solve_link

ERRORS = ("scaled", "formal", "jackknife")

DECIDING = (
    *("satellite", "reference", "zero_motion", "unknowns", "degree", "bins", "by", "epoch", "weights", "known_spin"),
    *("aberration", "positions", "zero_errors", "extragalactic", "satellite_columns", "reference_columns"),
    *("satellite_epoch", "reference_epoch", "position_jitter", "motion_jitter", "candidates"),
)
"""The parameters that decide which rows belong to which sources."""


@dataclass(frozen=True)
class Design:
    """A point: its clip, the solution of the tables as they are (None without rows of a reference), and the problem
    with the release and the new rows, whose sources all have rows; ``notes`` are for the reader.
    """

    clip: Clip
    solved: Link | None
    matched: int
    problem: Problem
    notes: tuple[str, ...]

    @property
    def truth(self) -> Array:
        """The solution of the tables as they are; zero where there is none."""
        return np.zeros(len(self.problem.unknowns)) if self.solved is None else self.solved.solution.estimate


def design_of(point: Point) -> Design:
    """Return the design of a point; raises SweepError or another ValueError that says what is wrong."""
    return _design(tuple((parameter.name, point[parameter.name]) for parameter in PARAMETERS))


@lru_cache(maxsize=16)
def _design(values: tuple[tuple[str, Any], ...]) -> Design:
    point = dict(values)
    clip = parse_clip(point["clip"])
    setup = _within(_set_up(tuple((name, point[name]) for name in DECIDING)), point)
    problem = setup.problem
    if not point["correlations"]:
        own, rows = (replace(one, correlations=None) for one in (problem.satellite, problem.rows))
        problem = replace(problem, satellite=own, rows=rows)
        setup = replace(setup, problem=problem)
    matched = np.unique(problem.source)
    solved = solve_link(setup.only(matched), str(clip), ERRORS) if len(matched) else None
    notes = [] if solved is None else [*solved.notes]
    if (release := point["release"]) != TABLE:
        named = None if point["from_release"] == TABLE else point["from_release"]
        old = scaled_from(problem.satellite.epoch, release, named)
        problem = released(problem, old, release, point["epoch"] is None)
        notes += scaling_notes(old, release)
    if point["n_new"]:
        problem = _with_chosen(problem, point)
    if not len(problem.rows):
        raise SweepError("no rows: give a reference, or zero_motion = true, or n_new above 0")
    return Design(clip, solved, len(matched), problem.only(np.unique(problem.source)), tuple(notes))


@lru_cache(maxsize=4)
def _set_up(values: tuple[tuple[str, Any], ...]) -> Setup:
    """Return the tables as they are; points that differ in nothing of `DECIDING` share them."""
    point = dict(values)
    reference, zero_motion = point["reference"], point["zero_motion"]
    if point["satellite"] is None:
        raise SweepError("satellite is required: the table of the satellite")
    if reference is not None and zero_motion:
        raise SweepError("zero_motion = true is for quasars without a table, and there is a reference")
    jitter = point["position_jitter"], point["motion_jitter"]
    satellite_options, reference_options = (
        TableOptions(
            columns=dict(point[f"{side}_columns"]),
            epoch=point[f"{side}_epoch"],
            zero_errors=point["zero_errors"],
            extragalactic=point["extragalactic"] in (side, "both"),
            positions=None if side == "satellite" or point["positions"] == "table" else point["positions"],
        )
        for side in ("satellite", "reference")
    )
    options = Options(
        **{name: point[name] for name in ("unknowns", "degree", "epoch", "weights", "known_spin", "aberration")},
        bins=parse_bins(point["bins"]) if point["bins"] else None,
        by=point["by"] or None,
        jitter={ALL: jitter} if any(jitter) else {},
        satellite_options=satellite_options,
        reference_options=reference_options,
    )
    everything = reference is None or point["candidates"] == "all"
    setup = set_up(point["satellite"].path, reference.path if reference else ZERO_MOTION, options, everything)
    if reference is None and not zero_motion:
        none = np.zeros(0, dtype=np.int64)
        setup = replace(setup, problem=replace(setup.problem, rows=setup.problem.rows.taken(none), source=none))
    return setup


def _within(setup: Setup, point: Mapping[str, Any]) -> Setup:
    """Leave out the sources outside the limits of magnitude; if there is a limit, also those without a magnitude."""
    low, high, column = point["g_min"], point["g_max"], point["magnitude"]
    if low is None and high is None:
        return setup
    columns = setup.problem.satellite.columns
    if column not in columns:
        known = ", ".join(columns) or "none"
        raise SweepError(f"magnitude = {column!r}: the satellite has no such column of numbers; there are {known}")
    magnitude = columns[column]
    kept = (magnitude >= (-np.inf if low is None else low)) & (magnitude <= (np.inf if high is None else high))
    if not np.any(kept):
        raise SweepError(f"no source has a {column} within the limits g_min and g_max")
    return setup.only(np.flatnonzero(kept))


def _with_chosen(problem: Problem, point: Mapping[str, Any]) -> Problem:
    """Return the problem with a new position of the ``n_new`` sources that help most, chosen one after the other."""
    n_sources, number = len(problem.satellite), point["n_new"]
    if number > n_sources:
        raise SweepError(f"n_new = {number}: there are {n_sources} sources to observe")
    epoch = np.nan if point["new_epoch"] is None else point["new_epoch"]
    apparent = point["new_positions"] == "single-epoch"
    planned = with_new_rows(problem, [epoch], point["new_error"] * MAS, apparent)
    if number == n_sources:
        return planned
    blocks = tuple(name.strip() for name in point["goal"].split(",") if name.strip())
    goal = Goal(problem.unknowns, blocks, "A")
    chosen = choose(source_sums(problem), source_sums(planned), number, goal).sources
    old = len(problem.rows)
    rows = np.concatenate([np.arange(old), old + np.sort(np.array(chosen, dtype=np.int64))])
    return replace(planned, rows=planned.rows.taken(rows), source=planned.source[rows])
