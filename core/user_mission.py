"""A mission that a study defines: its accuracy curves, read from a table of TOML and checked."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from linksweep.core.missions import MISSIONS, Exponentials, Floor, FunctionCurve, LogLinear, Mission
from linksweep.sweep.contract import DefinitionError, Function, Named, SweepError, shown, suggest

UserCurve = Exponentials | LogLinear | FunctionCurve

UNITS = {"mas": 1.0, "uas": 1000.0}
"""Units per mas."""

SIGMA_MAS = 1e-9, 1e7
MAGNITUDES = -5.0, 30.0
SLOPES = -10.0, 10.0
"""Change of ln(sigma) per magnitude, so that no curve of finite values vanishes or overflows."""

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
        self.per_mas = 1.0

    def mission(self) -> tuple[Mission, dict[str, Any]]:
        self.problems += [(key, f"unknown key{suggest(key, KEYS)}") for key in self.table if key not in KEYS]
        length = self._number("nominal_length", "yr", above=0.0, most=1000.0)
        unit, source = self.table.get("unit", "mas"), self.table.get("source", "")
        if not isinstance(unit, str) or unit not in UNITS:
            self._problem("unit", f"{shown(unit)}: must be 'mas' or 'uas' (a year for proper motions)")
        else:
            self.per_mas = UNITS[unit]
        if not isinstance(source, str):
            self._problem("source", f"{shown(source)}: must be a text that says where the numbers come from")
        motions = self._curve("sigma_pm")
        positions = self._positions(motions)
        tables = [curve.magnitudes for curve in (motions, positions) if isinstance(curve, LogLinear)]
        limit = self._limit(min((table[-1] for table in tables), default=math.inf))
        valid = self._range(max((table[0] for table in tables), default=-math.inf), limit)
        floor = Floor(self._floor("floor_pos"), self._floor("floor_pm"))
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

    def _positions(self, motions: UserCurve | None) -> UserCurve | None:
        if ("sigma_pos" in self.table) == ("position_ratio" in self.table):
            self._problem("", "needs either sigma_pos or position_ratio (sigma_pos = position_ratio x sigma_pm)")
            return None
        if "sigma_pos" in self.table:
            return self._curve("sigma_pos")
        ratio_yr = self._number("position_ratio", "yr", above=0.0, most=1000.0)
        return None if motions is None else motions.times(ratio_yr)

    def _limit(self, end: float) -> float:
        if "faint_limit" not in self.table:
            return end
        limit = self._number("faint_limit", "mag", *MAGNITUDES)
        if limit > end:
            self._problem("faint_limit", f"{limit:g} mag: the table ends at {end:g} mag")
        return limit

    def _range(self, low: float, high: float) -> tuple[float, float]:
        if "range" not in self.table:
            return low, high
        raw, (brightest, faintest) = self.table["range"], MAGNITUDES
        ends = [_finite(end) for end in raw] if isinstance(raw, list) and len(raw) == 2 else [math.nan] * 2
        if not brightest <= ends[0] < ends[1] <= faintest:
            words = f"must be [brightest, faintest], two magnitudes from {brightest:g} to {faintest:g}"
            self._problem("range", f"{shown(raw)}: {words}")
        return ends[0], ends[1]

    def _floor(self, key: str) -> float:
        if key not in self.table:
            return 0.0
        self._within(key, "the least error", self.table[key], self._sigmas)
        return _finite(self.table[key]) / self.per_mas

    @property
    def _sigmas(self) -> tuple[float, float]:
        return SIGMA_MAS[0] * self.per_mas, SIGMA_MAS[1] * self.per_mas

    def _curve(self, key: str) -> UserCurve | None:
        raw = self.table.get(key)
        if isinstance(raw, str):
            try:
                return FunctionCurve(self.load(raw), 1.0 / self.per_mas)
            except SweepError as error:
                self._problem(key, str(error))
                return None
        if isinstance(raw, list) and raw and all(isinstance(row, list) for row in raw):
            return self._log_linear(key, raw)
        if isinstance(raw, list) and raw and all(isinstance(row, dict) for row in raw):
            return self._exponentials(key, raw)
        self._problem(key, "is required: " + FORMS if raw is None else f"{shown(raw)}: must be {FORMS}")
        return None

    def _log_linear(self, key: str, rows: Sequence[Sequence[object]]) -> LogLinear | None:
        before = len(self.problems)
        if len(rows) < 2:
            self._problem(key, f"{len(rows)} row: a table needs at least two")
        for number, row in enumerate(rows, 1):
            if len(row) != 2:
                self._problem(key, f"row {number}, {shown(row)}: must be [magnitude, sigma]")
                continue
            self._within(key, f"row {number}, magnitude", row[0], MAGNITUDES)
            self._within(key, f"row {number}, sigma", row[1], self._sigmas)
        if len(self.problems) > before:
            return None
        magnitudes = tuple(_finite(row[0]) for row in rows)
        for number, (one, following) in enumerate(itertools.pairwise(magnitudes), 2):
            if following <= one:
                self._problem(key, f"row {number}: magnitude {following:g} does not come after {one:g}")
        return LogLinear(magnitudes, tuple(_finite(row[1]) / self.per_mas for row in rows))

    def _exponentials(self, key: str, rows: Sequence[Mapping[str, object]]) -> Exponentials | None:
        before, bounds = len(self.problems), {"at": MAGNITUDES, "sigma": self._sigmas, "slope": SLOPES}
        for number, row in enumerate(rows, 1):
            if set(row) != set(bounds):
                keys = ", ".join(map(shown, row)) or "none"
                self._problem(key, f"exponential {number}: its keys must be at, sigma and slope, not {keys}")
                continue
            for name, ends in bounds.items():
                self._within(key, f"exponential {number}, {name}", row[name], ends)
        if len(self.problems) > before:
            return None
        return Exponentials(
            tuple((_finite(r["sigma"]) / self.per_mas, _finite(r["slope"]), _finite(r["at"])) for r in rows)
        )

    def _number(self, key: str, unit: str, least: float = 0.0, most: float = 0.0, above: float | None = None) -> float:
        raw = self.table.get(key)
        if raw is None:
            self._problem(key, f"is required [{unit}]")
            return 1.0
        number = _finite(raw)
        if (number > above if above is not None else number >= least) and number <= most:
            return number
        bounds = f"> {above:g}" if above is not None else f">= {least:g}"
        self._problem(key, f"{shown(raw)}: must be a number {bounds} and <= {most:g} [{unit}]")
        return 1.0

    def _within(self, key: str, what: str, raw: object, ends: tuple[float, float]) -> None:
        if not ends[0] <= _finite(raw) <= ends[1]:
            self._problem(key, f"{what} = {shown(raw)}: must be a number from {ends[0]:g} to {ends[1]:g}")

    def _problem(self, key: str, sentence: str) -> None:
        self.problems.append((key, sentence))


def _identity(curve: UserCurve) -> dict[str, Any]:
    if isinstance(curve, FunctionCurve):
        return {"function": curve.function.name, "source": curve.function.digest, "factor": curve.factor}
    return {type(curve).__name__: vars(curve)}


def _finite(raw: object) -> float:
    """Return a finite number as float, NaN for anything else."""
    if isinstance(raw, (int, float)) and not isinstance(raw, bool) and abs(raw) < 1e300:
        return float(raw) + 0.0  # no negative zero, which would change the identity
    return math.nan
