"""A mission that a study defines: its accuracy curves, read from a table of TOML and checked."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from linksweep.core.function_curve import CurveOfFunction
from linksweep.core.missions import MISSIONS, Exponentials, Floor, LogLinear, Mission
from linksweep.sweep.contract import DefinitionError, Function, Named, SweepError, shown, suggest

OwnCurve = Exponentials | LogLinear | CurveOfFunction

UNITS = {"mas": 1.0, "uas": 1000.0}
"""Units per mas."""

SMALLEST_SIGMA_MAS, LARGEST_SIGMA_MAS = 1e-9, 1e7
BRIGHTEST_MAG, FAINTEST_MAG = -5.0, 30.0
STEEPEST = 10.0
"""Largest change of ln(sigma) per magnitude, so that no curve of finite values vanishes or overflows."""

KEYS = (
    *("nominal_length", "faint_limit", "unit", "sigma_pm", "sigma_pos", "position_ratio", "source"),
    *("range", "floor_pm", "floor_pos"),
)
FORMS = "[[magnitude, sigma], ...], [{ at = magnitude, sigma = ..., slope = ... }, ...] or 'file.py:function'"


def mission_of(model: str | Named) -> Mission:
    """Return the mission of a point's model: a built-in one, or one that its study defines."""
    if isinstance(model, str):
        return MISSIONS[model]
    mission: Mission = model.value
    return mission


def mission_from_table(table: Mapping[str, Any], load: Callable[[str], Function]) -> tuple[Mission, dict[str, Any]]:
    """Return the mission that a table defines, and the part of the table that affects results.

    ``nominal_length`` (yr) and ``sigma_pm`` are required, and one of ``sigma_pos`` and ``position_ratio`` (yr,
    positions as a multiple of proper motions).  Optional are the ``unit`` of every sigma (mas and mas/yr, or uas),
    ``faint_limit`` (mag; the end of a table by default), ``range`` (two magnitudes; both ends of a table by default),
    the least errors ``floor_pm`` and ``floor_pos``, and ``source``.  Raises DefinitionError that lists all mistakes.
    """
    return _Table(table, load).mission()


class _Table:
    """Reads one table, gathering every mistake on the way."""

    def __init__(self, table: Mapping[str, Any], load: Callable[[str], Function]) -> None:
        self.table, self.load = table, load
        self.problems: list[tuple[str, str]] = []

    def mission(self) -> tuple[Mission, dict[str, Any]]:
        self.problems += [(key, f"unknown key{suggest(key, KEYS)}") for key in self.table if key not in KEYS]
        length = self._number("nominal_length", "yr", above=0.0, most=1000.0)
        unit, source = self.table.get("unit", "mas"), self.table.get("source", "")
        if not isinstance(unit, str) or unit not in UNITS:
            self._problem("unit", f"{shown(unit)}: must be 'mas' or 'uas' (a year for proper motions)")
            unit = "mas"
        if not isinstance(source, str):
            self._problem("source", f"{shown(source)}: must be a text that says where the numbers come from")
        motions = self._curve("sigma_pm", UNITS[unit])
        positions = self._positions(motions, UNITS[unit])
        tables = [curve.magnitudes for curve in (motions, positions) if isinstance(curve, LogLinear)]
        limit = self._limit(min((table[-1] for table in tables), default=math.inf))
        valid = self._range(max((table[0] for table in tables), default=-math.inf), limit)
        floor = Floor(self._floor("floor_pos", UNITS[unit]), self._floor("floor_pm", UNITS[unit]))
        if self.problems or motions is None or positions is None:
            raise DefinitionError(self.problems)
        identity: dict[str, Any] = {
            "nominal_length_yr": length,
            "faint_limit_mag": limit if math.isfinite(limit) else None,
            "sigma_pm": _identity(motions),
            "sigma_pos": _identity(positions),
        }
        if floor != Floor():
            identity["floor_mas"] = [floor.pos_mas, floor.pm_mas_yr]
        return Mission(positions, motions, length, limit, source or "a mission of the study", valid, floor), identity

    def _positions(self, motions: OwnCurve | None, per_mas: float) -> OwnCurve | None:
        if ("sigma_pos" in self.table) == ("position_ratio" in self.table):
            self._problem("", "needs either sigma_pos or position_ratio (sigma_pos = position_ratio x sigma_pm)")
            return None
        if "sigma_pos" in self.table:
            return self._curve("sigma_pos", per_mas)
        ratio_yr = self._number("position_ratio", "yr", above=0.0, most=1000.0)
        return None if motions is None else motions.times(ratio_yr)

    def _limit(self, end: float) -> float:
        if "faint_limit" not in self.table:
            return end
        limit = self._number("faint_limit", "mag", BRIGHTEST_MAG, FAINTEST_MAG)
        if limit > end:
            self._problem("faint_limit", f"{limit:g} mag: the table ends at {end:g} mag")
        return limit

    def _range(self, low: float, high: float) -> tuple[float, float]:
        given = self.table.get("range", [low, high])
        if "range" not in self.table:
            return low, high
        ends = [_number(end) for end in given] if isinstance(given, list) and len(given) == 2 else []
        if not ends or not BRIGHTEST_MAG <= ends[0] < ends[1] <= FAINTEST_MAG:
            words = f"must be [brightest, faintest], two magnitudes from {BRIGHTEST_MAG:g} to {FAINTEST_MAG:g}"
            self._problem("range", f"{shown(given)}: {words}")
            return low, high
        return ends[0], ends[1]

    def _floor(self, key: str, per_mas: float) -> float:
        if key not in self.table:
            return 0.0
        self._within(key, "the least error", self.table[key], *_sigmas(per_mas))
        return _number(self.table[key]) / per_mas

    def _curve(self, key: str, per_mas: float) -> OwnCurve | None:
        given = self.table.get(key)
        if isinstance(given, str):
            return self._function(key, given, 1.0 / per_mas)
        if isinstance(given, list) and given and all(isinstance(row, list) for row in given):
            return self._log_linear(key, given, per_mas)
        if isinstance(given, list) and given and all(isinstance(row, dict) for row in given):
            return self._exponentials(key, given, per_mas)
        self._problem(key, "is required: " + FORMS if given is None else f"{shown(given)}: must be {FORMS}")
        return None

    def _log_linear(self, key: str, rows: Sequence[Sequence[object]], per_mas: float) -> LogLinear | None:
        before = len(self.problems)
        if len(rows) < 2:
            self._problem(key, f"{len(rows)} row: a table needs at least two")
        for number, row in enumerate(rows, 1):
            if len(row) != 2:
                self._problem(key, f"row {number}, {shown(row)}: must be [magnitude, sigma]")
                continue
            self._within(key, f"row {number}, magnitude", row[0], BRIGHTEST_MAG, FAINTEST_MAG)
            self._within(key, f"row {number}, sigma", row[1], *_sigmas(per_mas))
        if len(self.problems) > before:
            return None
        magnitudes = tuple(_number(row[0]) for row in rows)
        for number, (one, following) in enumerate(itertools.pairwise(magnitudes), 2):
            if following <= one:
                self._problem(key, f"row {number}: magnitude {following:g} does not come after {one:g}")
        return LogLinear(magnitudes, tuple(_number(row[1]) / per_mas for row in rows))

    def _exponentials(self, key: str, rows: Sequence[Mapping[str, object]], per_mas: float) -> Exponentials | None:
        before = len(self.problems)
        for number, row in enumerate(rows, 1):
            if set(row) != {"at", "sigma", "slope"}:
                keys = ", ".join(map(shown, row)) or "none"
                self._problem(key, f"exponential {number}: its keys must be at, sigma and slope, not {keys}")
                continue
            self._within(key, f"exponential {number}, at", row["at"], BRIGHTEST_MAG, FAINTEST_MAG)
            self._within(key, f"exponential {number}, sigma", row["sigma"], *_sigmas(per_mas))
            self._within(key, f"exponential {number}, slope", row["slope"], -STEEPEST, STEEPEST)
        if len(self.problems) > before:
            return None
        terms = ((_number(r["sigma"]) / per_mas, _number(r["slope"]), _number(r["at"])) for r in rows)
        return Exponentials(tuple(terms))

    def _function(self, key: str, reference: str, factor: float) -> CurveOfFunction | None:
        try:
            return CurveOfFunction(self.load(reference), factor)
        except SweepError as error:
            self._problem(key, str(error))
            return None

    def _number(self, key: str, unit: str, least: float = 0.0, most: float = 0.0, above: float | None = None) -> float:
        given = self.table.get(key)
        if given is None:
            self._problem(key, f"is required [{unit}]")
            return 1.0
        number = _number(given)
        if (number > above if above is not None else number >= least) and number <= most:
            return number
        bounds = f"> {above:g}" if above is not None else f">= {least:g}"
        self._problem(key, f"{shown(given)}: must be a number {bounds} and <= {most:g} [{unit}]")
        return 1.0

    def _within(self, key: str, what: str, given: object, least: float, most: float) -> None:
        if not least <= _number(given) <= most:
            self._problem(key, f"{what} = {shown(given)}: must be a number from {least:g} to {most:g}")

    def _problem(self, key: str, sentence: str) -> None:
        self.problems.append((key, sentence))


def _identity(curve: OwnCurve) -> dict[str, Any]:
    if isinstance(curve, CurveOfFunction):
        return {"function": curve.function.name, "source": curve.function.digest, "factor": curve.factor}
    return {type(curve).__name__: vars(curve)}


def _sigmas(per_mas: float) -> tuple[float, float]:
    return SMALLEST_SIGMA_MAS * per_mas, LARGEST_SIGMA_MAS * per_mas


def _number(given: object) -> float:
    """Return a finite number as float, NaN for anything else."""
    if isinstance(given, (int, float)) and not isinstance(given, bool) and abs(given) < 1e300:
        return float(given) + 0.0  # no negative zero, which would change the identity
    return math.nan
