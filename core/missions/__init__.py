"""Missions: how accurately each measures an object of a given magnitude.

A new one is an entry in `MISSIONS`, or a table of a study, which is read and checked here.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from linksweep.core.frames import Array
from linksweep.sweep.contract import DefinitionError, Function, Named, SweepError, rescaled, shown, suggest
from linksweep.sweep.contract.experiment import is_number, needed

# A function that returns the standard error at each magnitude, in the same shape.
Curve = Callable[[Array], Array]


@dataclass(frozen=True)
class Exponentials:
    """The sum of ``amplitude * exp(slope * (V - pivot))`` over terms (amplitude, slope 1/mag, pivot mag)."""

    terms: tuple[tuple[float, float, float], ...]

    def __call__(self, v_mag: Array) -> Array:
        """Return the sum at each magnitude."""
        return np.asarray(sum(a * np.exp(slope * (v_mag - pivot)) for a, slope, pivot in self.terms))

    def times(self, factor: float) -> "Exponentials":
        """Return the curve times a factor."""
        return Exponentials(tuple((factor * a, slope, pivot) for a, slope, pivot in self.terms))


@dataclass(frozen=True)
class LogLinear:
    """Log-linear interpolation in a table; constant outside its ends."""

    magnitudes: tuple[float, ...]
    values: tuple[float, ...]

    def __call__(self, v_mag: Array) -> Array:
        """Return the interpolated value at each magnitude."""
        return np.asarray(np.exp(np.interp(v_mag, self.magnitudes, np.log(self.values))))

    def times(self, factor: float) -> "LogLinear":
        """Return the curve times a factor."""
        return LogLinear(self.magnitudes, tuple(factor * value for value in self.values))


@dataclass(frozen=True)
class FunctionCurve:
    """A user's function of an array of magnitudes, shape (N,), times ``factor``; it must depend on nothing else.

    Raises SweepError where it raises, or returns anything but positive finite numbers of the same shape.
    """

    function: Function
    factor: float = 1.0

    def __call__(self, v_mag: Array) -> Array:
        """Return the function's values."""
        name, flat = f"the function {self.function.name!r}", np.array(v_mag, dtype=np.float64).reshape(-1)
        try:
            with np.errstate(all="ignore"):  # the values are checked below
                raw = self.function(flat.copy())  # a copy: the function may change it
                returned, unit = np.ma.asarray(raw), getattr(raw, "unit", None) or getattr(raw, "units", None)
        except (Exception, SystemExit) as error:  # whatever a user's function raises
            raise SweepError(f"{name} raises {type(error).__name__}: {error}") from error
        if returned.shape != flat.shape or returned.dtype.kind not in "fiu" or unit is not None:
            what = f"{returned.dtype} of shape {returned.shape}" + ("" if unit is None else f" in {unit}")
            raise SweepError(f"{name} returns {what}, not plain numbers of shape {flat.shape}")
        values = np.ma.filled(returned.astype(np.float64), np.nan)
        if (bad := ~(np.isfinite(values) & (values > 0))).any():
            value, at = values[bad][0], flat[bad][0]
            raise SweepError(f"{name} returns {value:g} at V = {at:g} mag: must be positive and finite")
        return np.asarray(self.factor * values).reshape(np.shape(v_mag))

    def times(self, factor: float) -> "FunctionCurve":
        """Return the curve times a factor."""
        return FunctionCurve(self.function, factor * self.factor)


Release = Literal["dr3", "dr4", "dr5"]


@dataclass(frozen=True)
class PyGaia:
    """The predicted error of a Gaia release per coordinate, mean square of ra* and dec, in mas or mas/yr.

    The study's V is taken as G; for quasars G - V is about -0.1 to 0 mag, which changes an error by at most 9 %.  The
    formula holds for G = 3 to 21 and is constant brighter than 13.
    Raises SweepError, when it is called, without the package PyGaia.
    Source: PyGaia (A. Brown), `pygaia.errors.astrometric`, the model of ESA's Gaia science performance pages.
    """

    quantity: Literal["position", "proper_motion"]
    release: Release

    def __call__(self, v_mag: Array) -> Array:
        """Return the error at each magnitude."""
        # only here: PyGaia is optional, and importing it takes half a second
        with needed("PyGaia", "gaia", f"the model 'gaia-{self.release}'"):
            from pygaia.errors import astrometric
        formula = getattr(astrometric, f"{self.quantity}_uncertainty")
        ra_uas, dec_uas = formula(np.atleast_1d(v_mag), release=self.release)
        return np.asarray(np.sqrt((ra_uas**2 + dec_uas**2) / 2.0) / 1000.0).reshape(np.shape(v_mag))


@dataclass(frozen=True)
class Floor:
    """The least errors at the nominal length, of objects brighter than ``brighter_than_mag`` (of all by default)."""

    pos_mas: float = 0.0
    pm_mas_yr: float = 0.0
    brighter_than_mag: float = np.inf


@dataclass(frozen=True)
class Mission:
    """One mission's accuracy at its nominal length, and how it changes with length.

    Errors of positions fall as T^-1/2 and those of proper motions as T^-3/2, those of the ``floor`` too.
    ``faint_limit_mag`` is where the curve ends; from ``valid_mag[0]`` to ``valid_mag[1]`` it rests on the data that
    ``source`` names, and objects outside cause a warning.
    """

    curve_pos_mas: Curve
    curve_pm_mas_yr: Curve
    nominal_length_yr: float
    faint_limit_mag: float
    source: str
    valid_mag: tuple[float, float] = (-np.inf, np.inf)
    floor: Floor = Floor()

    def sigma_pos_mas(self, v_mag: Array, mission_length_yr: float | None = None) -> Array:
        """Return the position error per coordinate in mas; ``v_mag`` of any shape, None for the nominal length."""
        return self._sigma(self.curve_pos_mas, self.floor.pos_mas, -0.5, v_mag, mission_length_yr)

    def sigma_pm_mas_yr(self, v_mag: Array, mission_length_yr: float | None = None) -> Array:
        """Return the proper-motion error per coordinate in mas/yr."""
        return self._sigma(self.curve_pm_mas_yr, self.floor.pm_mas_yr, -1.5, v_mag, mission_length_yr)

    def sigmas_to_limit(self, v_mag: Array) -> tuple[Array, Array]:
        """Return both errors (mas, mas/yr) at magnitudes (N,) for the nominal length, NaN beyond the faint limit."""
        pos, pm = np.full((2, len(v_mag)), np.nan)
        seen = v_mag <= self.faint_limit_mag
        pos[seen], pm[seen] = self.sigma_pos_mas(v_mag[seen]), self.sigma_pm_mas_yr(v_mag[seen])
        return pos, pm

    def _sigma(self, curve: Curve, least: float, exponent: float, v_mag: Array, length_yr: float | None) -> Array:
        sigma = curve(v_mag)
        if least > 0.0:
            sigma = np.where(v_mag < self.floor.brighter_than_mag, np.maximum(sigma, least), sigma)
        # 1.0 ** exponent is exactly 1: the nominal length changes no bit
        ratio = 1.0 if length_yr is None else length_yr / self.nominal_length_yr
        return np.asarray(sigma * np.float64(ratio) ** exponent)


AMEX_PM = Exponentials(((0.139, 0.215, 9.0), (14.2, 0.973, 15.0)))
# The curves that were fitted to the tables of Metz & Geffert 2004: docs/calibration.md.
GAIA_PM = Exponentials(((0.01496, 0.443, 15.0),))


@dataclass(frozen=True)
class Calibrated:
    """A fitted curve, and the covariance of the logarithms of its constants, amplitude and slope of each term."""

    curve: Exponentials
    log_covariance: tuple[tuple[float, ...], ...]

    def relative_error(self, v_mag: Array) -> Array:
        """Return the one-sigma error of the curve at magnitudes (N,) as a share of its value."""
        terms = [(a * np.exp(slope * (v_mag - pivot)), slope * (v_mag - pivot)) for a, slope, pivot in self.curve.terms]
        gradient = np.stack([row for term, power in terms for row in (term, term * power)]) / self.curve(v_mag)
        return np.asarray(np.sqrt(np.einsum("iv,ij,jv->v", gradient, np.array(self.log_covariance), gradient)))


# The calibrated curves by mission; `linksweep.core.missions.calibrate` gives these numbers.
# The covariances are those of the free fits, whose constants are within their errors of those above.
CALIBRATED: Mapping[str, Calibrated] = {
    "amex": Calibrated(
        AMEX_PM,
        (
            (0.0608, 0.0566, 0.0029, 0.0168),
            (0.0566, 0.0530, 0.0023, 0.0155),
            (0.0029, 0.0023, 0.0037, 0.0028),
            (0.0168, 0.0155, 0.0028, 0.0059),
        ),
    ),
    "gaia": Calibrated(GAIA_PM, ((1.14e-4, -4.70e-5), (-4.70e-5, 4.12e-4))),
}

_GAIA_2001_MAG = tuple(float(g) for g in range(10, 22))
_GAIA_2001_POS_UAS = (3, 3, 3, 4, 6, 9, 15, 23, 39, 70, 140, 440)
_GAIA_2001_PM_UAS = (3, 3, 3, 4, 5, 8, 13, 20, 34, 60, 120, 380)

# Medians of DR3's proper-motion errors at G < 8 are 0.046 to 0.051 mas/yr, where PyGaia's formula says 0.012;
# positions follow from PyGaia's ratio of positions to motions, and other releases as T^-1/2 and T^-3/2.
BRIGHT_MAG, BRIGHT_POS_MAS, BRIGHT_PM_MAS_YR = 8.0, 0.037, 0.048


def _release(release: Release, months: float) -> Mission:
    scale = months / 12.0 / (34 / 12)  # of the length of DR3
    return Mission(
        curve_pos_mas=PyGaia("position", release),
        curve_pm_mas_yr=PyGaia("proper_motion", release),
        nominal_length_yr=months / 12.0,
        faint_limit_mag=21.0,
        source=f"PyGaia, pygaia.errors.astrometric, release {release}; V taken as G; {months:g} months of data",
        valid_mag=(BRIGHT_MAG, 21.0),
        floor=Floor(BRIGHT_POS_MAS * scale**-0.5, BRIGHT_PM_MAS_YR * scale**-1.5, BRIGHT_MAG),
    )


# The built-in missions by name.
MISSIONS: Mapping[str, Mission] = {
    "amex": Mission(
        curve_pos_mas=AMEX_PM.times(0.60),
        curve_pm_mas_yr=AMEX_PM,
        nominal_length_yr=2.0,
        faint_limit_mag=np.inf,
        source="two exponentials fitted to the 28 AMEX numbers of Metz & Geffert 2004 (Tables 1 and 2) with "
        "inverse-variance weights; position/motion ratio of DIVA, 0.15 mas to 0.25 mas/yr (at V = 9, where the "
        "fitted curve has 0.18 mas/yr)",
        # from Algol, of Table 2, to the quasars of Table 1; those beyond V = 17 have next to no weight
        valid_mag=(2.1, 20.0),
        floor=Floor(0.60 * 0.0315, 0.0315),  # the curve at V = 2.1, its brightest object
    ),
    "gaia": Mission(
        curve_pos_mas=GAIA_PM.times(1.15),
        curve_pm_mas_yr=GAIA_PM,
        nominal_length_yr=5.0,
        faint_limit_mag=np.inf,
        source="one exponential fitted to the GAIA column of Metz & Geffert 2004, Table 1",
        valid_mag=(12.8, 20.0),
        floor=Floor(0.003, 0.003),  # ESA's prediction of 2001, constant from G = 12 on (Perryman et al. 2001)
    ),
    "gaia-2001": Mission(
        curve_pos_mas=LogLinear(_GAIA_2001_MAG, tuple(s / 1000.0 for s in _GAIA_2001_POS_UAS)),
        curve_pm_mas_yr=LogLinear(_GAIA_2001_MAG, tuple(s / 1000.0 for s in _GAIA_2001_PM_UAS)),
        nominal_length_yr=5.0,
        faint_limit_mag=21.0,
        source="ESA's 2001 prediction for G = 10..21 (Perryman et al. 2001), log-linear between; "
        "the table was not confirmed in print",
        valid_mag=(10.0, 21.0),
    ),
    # The length is the one PyGaia's numbers stand for: it puts DR4 at 60 months, though DR4 itself will have 66.
    "gaia-dr3": _release("dr3", 34),
    "gaia-dr4": _release("dr4", 60),
    "gaia-dr5": _release("dr5", 120),
}

UserCurve = Exponentials | LogLinear | FunctionCurve

UNITS_MAS = {"mas": 1.0, "uas": 1e-3}

SIGMA_MAS = 1e-9, 1e7
MAGNITUDES = -5.0, 30.0
# Change of ln(sigma) per magnitude, so that no curve of finite values vanishes or overflows.
SLOPES = -10.0, 10.0
YEARS = 1e-3, 1e3

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
    read = _Reader(table, load)
    length = read.number("nominal_length", YEARS)
    motions = read.curve("sigma_pm")
    positions: UserCurve | None = None
    if ("sigma_pos" in table) == ("position_ratio" in table):
        read.problem("", "needs either sigma_pos or position_ratio (sigma_pos = position_ratio x sigma_pm)")
    elif "sigma_pos" in table:
        positions = read.curve("sigma_pos")
    else:
        ratio_yr = read.number("position_ratio", YEARS)
        positions = None if motions is None else motions.times(ratio_yr)
    tables = [curve.magnitudes for curve in (motions, positions) if isinstance(curve, LogLinear)]
    brightest, end = max([-np.inf, *(mags[0] for mags in tables)]), min([np.inf, *(mags[-1] for mags in tables)])
    limit = read.number("faint_limit", MAGNITUDES, end)
    if limit > end:
        read.problem("faint_limit", f"{limit:g} mag: the table ends at {end:g} mag")
    pos, pm = (rescaled(read.number(key, read.sigmas, 0.0), read.unit_mas) for key in ("floor_pos", "floor_pm"))
    floor = Floor(pos, pm)
    valid = read.range((brightest, limit))
    if read.problems or motions is None or positions is None:
        raise DefinitionError(read.problems)
    # what decides the numbers and nothing else: with another name or unit of sigma, results are still found
    identity: dict[str, Any] = {"nominal_length_yr": length, "faint_limit_mag": limit if limit < np.inf else None}
    identity |= {"sigma_pm": _identity(motions), "sigma_pos": _identity(positions)}
    if floor != Floor():
        identity["floor_mas"] = [floor.pos_mas, floor.pm_mas_yr]
    source = table.get("source") or "a mission of the study"
    return Mission(positions, motions, length, limit, source, valid, floor), identity


class _Reader:
    """What a table says, with every mistake on the way."""

    def __init__(self, table: Mapping[str, Any], load: Callable[[str], Function]) -> None:
        self.table, self.load = table, load
        self.problems = [(key, f"unknown key{suggest(key, KEYS)}") for key in table if key not in KEYS]
        unit = table.get("unit", "mas")
        if not (isinstance(unit, str) and unit in UNITS_MAS):
            self.problem("unit", f"{shown(unit)}: must be 'mas' or 'uas' (a year for proper motions)")
            unit = "mas"
        if not isinstance(source := table.get("source", ""), str):
            self.problem("source", f"{shown(source)}: must be a text that says where the numbers come from")
        self.unit_mas = UNITS_MAS[unit]
        self.sigmas = SIGMA_MAS[0] / self.unit_mas, SIGMA_MAS[1] / self.unit_mas

    def problem(self, key: str, sentence: str) -> None:
        self.problems.append((key, sentence))

    def number(self, key: str, ends: tuple[float, float], default: float | None = None) -> float:
        """Return a number, which is required unless there is a default."""
        if key in self.table:
            return self._within(key, "", self.table[key], ends)
        if default is None:
            self.problem(key, "is required")
        return 1.0 if default is None else default

    def range(self, default: tuple[float, float]) -> tuple[float, float]:
        """Return the magnitudes between which the curves are known."""
        if "range" not in self.table:
            return default
        raw = self.table["range"]
        ends = [_finite(end) for end in raw] if isinstance(raw, list) and len(raw) == 2 else [np.nan] * 2
        if not MAGNITUDES[0] <= ends[0] < ends[1] <= MAGNITUDES[1]:
            words = "must be [brightest, faintest], two magnitudes from {:g} to {:g}".format(*MAGNITUDES)
            self.problem("range", f"{shown(raw)}: {words}")
        return ends[0], ends[1]

    def curve(self, key: str) -> UserCurve | None:
        """Return the curve in any of its forms."""
        raw, before = self.table.get(key), len(self.problems)
        if isinstance(raw, str):
            try:
                return FunctionCurve(self.load(raw), self.unit_mas)
            except SweepError as error:
                self.problem(key, str(error))
        elif isinstance(raw, list) and raw and all(isinstance(row, list) for row in raw):
            named = [{"magnitude": row[0], "sigma": row[1]} if len(row) == 2 else {} for row in raw]
            rows = self._rows(key, named, {"magnitude": MAGNITUDES, "sigma": self.sigmas})
            for number, (one, following) in enumerate(itertools.pairwise(rows), 2):
                if following[0] <= one[0]:
                    self.problem(key, f"row {number}: magnitude {following[0]:g} does not come after {one[0]:g}")
            if len(raw) < 2:  # one row would be a constant, which a slip of the pen must not make
                self.problem(key, f"{len(rows)} row: a table needs at least two")
            if len(self.problems) == before:
                magnitudes, sigmas = zip(*rows, strict=True)
                return LogLinear(magnitudes, tuple(rescaled(sigma, self.unit_mas) for sigma in sigmas))
        elif isinstance(raw, list) and raw and all(isinstance(row, dict) for row in raw):
            rows = self._rows(key, raw, {"at": MAGNITUDES, "sigma": self.sigmas, "slope": SLOPES})
            if len(self.problems) == before:
                return Exponentials(tuple((rescaled(sigma, self.unit_mas), slope, at) for at, sigma, slope in rows))
        else:
            self.problem(key, "is required: " + FORMS if raw is None else f"{shown(raw)}: must be {FORMS}")
        return None

    def _rows(
        self, key: str, rows: Sequence[Mapping[Any, object]], bounds: Mapping[Any, tuple[float, float]]
    ) -> list[tuple[float, ...]]:
        """Return the numbers of each row, in the order of their bounds."""
        numbers = []
        for number, row in enumerate(rows, 1):
            where = f"row {number}"
            if set(row) != set(bounds):
                self.problem(key, f"{where}: must be as in {FORMS}")
            else:
                entries = (self._within(key, f"{where}, {name}: ", row[name], ends) for name, ends in bounds.items())
                numbers.append(tuple(entries))
        return numbers

    def _within(self, key: str, where: str, raw: object, ends: tuple[float, float]) -> float:
        number = _finite(raw)
        if not ends[0] <= number <= ends[1]:
            self.problem(key, f"{where}{shown(raw)}: must be a number from {ends[0]:g} to {ends[1]:g}")
        return number


def _identity(curve: UserCurve) -> dict[str, Any]:
    if isinstance(curve, FunctionCurve):
        return {"function": curve.function.name, "source": curve.function.digest, "factor": curve.factor}
    return {type(curve).__name__: vars(curve)}


def _finite(raw: Any) -> float:
    """Return a finite number as float, NaN for anything else."""
    return float(raw) + 0.0 if is_number(raw) else np.nan  # no negative zero, which would change the identity
