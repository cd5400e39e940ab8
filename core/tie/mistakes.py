"""What is likely to be wrong in tables whose differences do not have the size of their errors.

The corrections of common mistakes are applied to the rows one after the other, and the link is solved with each: the
mistake that was made is the one whose correction brings chi2 down to the level of good tables.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtr, chdtrc, chdtri

from linksweep.core.frames import MAS, Array, Flags, Indices, LinkError, Names
from linksweep.core.tie.astrometry import HALF_SPAN, PAIRS, Astrometry, by_errors, julian_years, kinds
from linksweep.core.tie.problem import NormalSums, Problem, Solution, discrepancies, leave_one_out, solve, source_sums

# chi2 over its expectation above and below which it is said first, and above which a link is not given unasked. Radio
# stars, many of which are binaries, have 7.
EXCESS, DEFICIT, ABSURD = 30.0, 0.5, 1000.0

# Probability below which chi2 is not that of correct errors; small tables scatter.
CHANCE = 1e-6

# chi2 over its expectation above which corrections are tried, and at which no further ones are.
GOOD = 3.0

# Of more sources, or with larger normal equations, only some sources are examined.
MOST_SOURCES, MOST_NUMBERS = 2000, 10_000_000

# Factors by which numbers are too small, with the mistake in their units.
SMALLER = {
    1e3: "arcsec taken for mas (or mas for uas)",
    3.6e6: "deg taken for mas",
    15.0: "time taken for an angle: 1 s is 15 arcsec",
    1.5e4: "seconds of time taken for mas",
}
LARGER = {
    1e-3: "uas taken for mas (or mas for arcsec)",
    1.0 / 3.6e6: "mas taken for deg",
    1.0 / 15.0: "an angle taken for time: 1 s is 15 arcsec",
    1.0 / 1.5e4: "mas taken for seconds of time",
}
# What stands there in place of a factor for numbers that are squares.
ROOTS = {np.nan: "variances taken for errors"}
RATES = {365.25: "per day taken for per year", 0.01: "per century taken for per year"}
RATES |= {10.0: "arcsec per century taken for mas per year"}
# No star has a larger parallax (Proxima: 769 mas) or proper motion (Barnard's star: 10 400 mas/yr).
LARGEST = {"mas": 1000.0, "mas/yr": 12_000.0, "mas/yr2": 300.0, "mas/yr3": 300.0}

# Shifts of epochs (years) from which the best is looked for.
STARTS = range(-200, 201, 20)

# Epochs of positions with errors below 10 mas.
EARLIEST, LATEST, WHEN_NONE = 1970.0, 2060.0, "when no position had errors below 10 mas"


Rows = tuple[int, ...]
# Errors below it are hardly right, mas or mas/yr.
SMALLEST = 0.005

# The smallest and the largest median error of a table, mas or mas/yr: pulsar timing reaches 1 uas, meridian circles had
# some arcsec.
PLAUSIBLE = 2e-4, 1e4

GROUPS: dict[str, Rows] = {"positions": (0, 1), "parallaxes": (2,), "proper motions": (3, 4)}
NOT_POSITIONS: dict[str, Rows] = {"parallaxes": (2,), "proper motions": (3, 4), "pmra": (3,), "pmdec": (4,)}
# What may have errors in another unit.
WITH_ERRORS: dict[str, Rows] = {**GROUPS, "all quantities": (0, 1, 2, 3, 4), "ra": (0,), "dec": (1,)}

UNEXPLAINED = "no known mistake explains it: errors may be too small, two mistakes made, or sources not single"

# How much a correction hides that makes errors larger.
HIDES_ALL = 2

Change = Callable[[Astrometry], Astrometry]


class Misfit(NamedTuple):
    """chi2 over its expectation, and the sentence about it, empty where there is nothing to say; ``first`` says whether
    it comes before the result.
    """

    ratio: float = np.nan
    text: str = ""
    first: bool = True

    @property
    def absurd(self) -> bool:
        """Whether the link is not to be given unless asked for."""
        return bool(self.text) and self.ratio > ABSURD


class _Part(NamedTuple):
    """Some sources of the satellite, or some rows of another table."""

    table: str
    words: str
    at: Flags


class Cause(NamedTuple):
    """What is likely to be wrong, chi2 over its expectation when it is corrected, and how much the correction could
    hide: 0 nothing, 1 what is along the proper motions, 2 everything, because errors grow.
    """

    words: str
    ratio: float
    hides: int = 0


def misfit(problem: Problem, kept: Indices, solution: Solution, names: Names) -> Misfit:
    """Return what is to be said of chi2 of a solution with the best weights.

    ``kept`` are the sources that it is of, ``names`` (S,) the names of all.  The solution may be that
    of more sources than the problem has.
    """
    if not solution.dof > 0 or not solution.expected > 0.0:
        return Misfit()
    ratio = solution.squares / solution.expected
    most = int(np.clip(MOST_NUMBERS // len(solution.estimate) ** 2, 50, MOST_SOURCES))
    if len(kept) > most:
        kept = kept[np.linspace(0, len(kept) - 1, most).astype(np.int64)]
    problem = replace(problem, satellite=replace(problem.satellite, names=names)).only(kept)
    groups = _groups(problem, solution)
    if ratio > GOOD and chdtrc(solution.expected, solution.squares) < CHANCE:
        worst = max(groups, key=lambda group: group.squares)
        asked = " (are these quasars?)" * bool(np.any(problem.rows.at_rest[list(worst.rows)] & worst.part.at))
        said = f"chi2 is {ratio:.3g} times its expectation, most of it in {worst.words}{asked}"
        level = _ratio(problem)  # a sample may lack the few sources that do not fit
        cause = _excess(problem, level) if most > len(solution.estimate) and np.isfinite(level) else UNEXPLAINED
        return Misfit(ratio, f"{said}; {cause}", ratio > EXCESS or cause != UNEXPLAINED)
    low = [one for one in groups if one.squares < 0.1 * one.expected and chdtr(one.dof, one.squares) < CHANCE]
    said = f"chi2 is {ratio:.2g} times its expectation"
    if ratio >= DEFICIT or chdtr(solution.dof, solution.squares) > 100.0 * CHANCE:
        if not low:
            return Misfit(ratio)
        said = f"chi2 of {low[0].words} is {low[0].squares / low[0].expected:.2g} times its expectation"
    too_large = "errors are too large, or the tables are not independent"
    return Misfit(ratio, f"{said}: {_deficit(problem, low) or too_large}")


class _Group(NamedTuple):
    """The residuals of a group of quantities in the rows of a kind, and the part that they are of."""

    words: str
    part: _Part
    rows: Rows
    squares: float
    expected: float
    dof: float


def _groups(problem: Problem, solution: Solution) -> list[_Group]:
    """Return the squares of the residuals over their errors by table, kind of row and quantity, with their means.

    ``dof`` is less where rows share the errors of a source.  What depends on parameters that the satellite lacks is
    left out.
    """
    star, source = problem.satellite, problem.source
    differences = problem.differences()
    design = differences.by_frames @ problem.unknowns.matrix(*problem.objects(star))[source]
    variance = np.einsum("rii->ri", differences.whole(star.covariance()[source]))
    by_free = np.abs(differences.partials[..., :5]) @ (~star.present).T[source][..., None]
    usable = differences.present & ~(by_free > 0.0)[..., 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = (differences.values - design @ solution.estimate) ** 2 / variance
        means = 1.0 - np.einsum("rik,kl,ril->ri", design, solution.covariance, design) / variance
    groups = []
    for part in _by_kind(problem):
        for quantity, rows in GROUPS.items():
            used = usable & part.at[:, None] & [k in rows for k in range(5)]
            if np.any(used):
                mean = float(np.sum(np.clip(means[used], 0.0, 1.0)))
                at = used.any(axis=1)
                each = len(np.unique(source[at])) / np.count_nonzero(at)
                words = f"the {quantity} of {part.words}"
                groups.append(_Group(words, part, rows, float(np.sum(squares[used])), mean, mean * each))
    return groups


def _wholes(problem: Problem) -> list[_Part]:
    parts = [_Part("satellite", "the satellite", np.ones(len(problem.satellite), dtype=bool))]
    of_tables = [_Part(name, f"the {name}", problem.rows.frame == k) for k, name in enumerate(problem.tables)]
    return parts + [part for part in of_tables if np.any(part.at)]


def _by_kind(problem: Problem) -> list[_Part]:
    """Return the rows of each kind in each table."""
    labels = kinds(problem.rows)
    return [
        _Part(part.table, f"the {label} rows of {part.words}", part.at & (labels == label))
        for part in _wholes(problem)[1:]
        for label in np.unique(labels[part.at])
    ]


def _excess(problem: Problem, ratio: float) -> str:
    """Return a clause about the likely cause."""
    causes = list(_causes(problem, _wholes(problem), ratio))
    alone = ""
    if ratio <= EXCESS:  # real stars may be as bad: only a correction after which all is well is a cause
        least = chdtri(problem.rows.present.sum(), 0.001) / problem.rows.present.sum()
        causes = [cause for cause in causes if not cause.hides and cause.ratio < least]
    elif not any(cause.ratio < GOOD and not cause.hides for cause in causes):
        best = min((cause.ratio for cause in causes), default=EXCESS)
        worst, left = _outliers(problem, ratio)
        causes += _exchanged(problem, ratio)
        if left < max(GOOD, best):
            alone = f"without {_listed(problem, worst)} it is {left:.2g} times its expectation; "
            causes = [cause for cause in causes if not cause.hides and cause.ratio < GOOD]
        elif best > GOOD:
            causes += _causes(problem, _by_kind(problem), ratio)
    said = likely(causes, _alike_within(problem))
    return f"{alone}{said}" if said == UNEXPLAINED else said


def likely(causes: Sequence[Cause], alike: float) -> str:
    """Return a clause about the causes that hide least: the best, and those that are as good within ``alike``.

    Larger errors always bring chi2 down: of these the best brings it to its expectation.
    """
    if not causes:
        return UNEXPLAINED
    least = min(cause.hides for cause in causes)
    bad = {cause: abs(np.log(cause.ratio)) if least == HIDES_ALL else cause.ratio for cause in causes}
    ordered = sorted((cause for cause in causes if cause.hides == least), key=bad.__getitem__)
    best = bad[ordered[0]]
    same = [cause.words for cause in ordered if bad[cause] <= best + alike * max(best, 1.0)]
    words = ", or ".join(dict.fromkeys(same[:3]))
    return f"the likely cause: {words} (corrected, chi2 is {ordered[0].ratio:.2g} times its expectation)"


def _deficit(problem: Problem, groups: Sequence[_Group]) -> str:
    """Return which errors are too large by a factor of units: those that bring chi2 of some groups up to their level
    and that of all next to its expectation.
    """
    causes: dict[float, Cause] = {}  # the same errors may have several names
    levels: dict[Any, dict[str, float]] = {}  # and so may the same rows: of 40 stars two thirds of the changes
    for group in groups:
        names = {group.words.removeprefix("the ").partition(" of ")[0]: group.rows} | WITH_ERRORS
        wholes = [part for part in _wholes(problem) if part.table in ("satellite", group.part.table)]
        for (factor, unit, name, rows), part in product(_in_units(LARGER | ROOTS, names), (group.part, *wholes[::-1])):
            change = factor, rows, part.table, part.at.tobytes()
            if change not in levels:
                levels[change] = _levels(problem, part, _scaled(rows, factor, errors=True))
            level = levels[change]
            if level and 0.1 < level[group.words] < EXCESS:
                ratio = max(level[group.words], level[""], key=lambda one: abs(np.log(one)))
                # a unit brings chi2 at least four times nearer to 1, in the logarithm; errors may just be too large
                if ratio > DEFICIT and 4.0 * np.log(ratio) < np.log(group.expected / group.squares):
                    cause = Cause(f"errors of {name} of {part.words} too large, {unit}", ratio, HIDES_ALL)
                    causes.setdefault(round(ratio, 9), cause)
    return likely(list(causes.values()), _alike_within(problem)) if causes else ""


def _levels(problem: Problem, part: _Part, change: Change) -> dict[str, float]:
    """Return chi2 over its expectation with a part changed, of each group and under '' of all; nothing where that
    changes nothing or has no solution.
    """
    if (trial := _applied(problem, part, change)) is None:
        return {}
    try:
        solution = solve(source_sums(trial))
    except LinkError:
        return {}
    return {one.words: one.squares / one.expected for one in _groups(trial, solution)} | {"": solution.scale**2}


def _alike_within(problem: Problem) -> float:
    """Return by how much chi2 over its expectation may differ between corrections that are equally good."""
    return 30.0 / max(1, int(np.sum(problem.rows.present)))


def explains(corrected: float, ratio: float) -> bool:
    """Return whether a correction brings chi2 over its expectation down from ``ratio`` to that of good tables."""
    return corrected < EXCESS and corrected < (0.1 if ratio > EXCESS else 0.5) * ratio


def _causes(problem: Problem, parts: Iterable[_Part], ratio: float) -> Iterator[Cause]:
    """Yield the mistakes in parts whose correction brings chi2 down to the level of good tables."""
    for part in parts:
        for words, hides, change in _corrections(problem, part):
            trial = _applied(problem, part, change)
            # errors that are too small are so for all sources
            if explains(corrected := _ratio(trial), ratio) and (not hides or 0.1 < _ratio(trial, typical=True) < GOOD):
                yield Cause(words, corrected, hides)
        if part.table == "satellite" or np.count_nonzero(part.at) < 3:
            continue
        epochs = np.unique(problem.rows.epoch[part.at & problem.rows.present[0]])
        words = "wrong in single rows: positions are off along the proper motion"
        if len(epochs) == 1:
            words = f"equal ({epochs[0]:g}), but they were measured at different ones"
        along, across = (_ratio(_applied(problem, part, _freed(problem, turn))) for turn in (False, True))
        if explains(along, ratio) and across > max(GOOD, 2.0 * along):
            yield Cause(f"epochs of {part.words} {words}", along, 1)


def impossible(errors: Array, epoch: Array) -> Flags:
    """Return which positions (N,) are of an epoch when none had such errors, of the errors (5, N) of rows."""
    return np.asarray((errors[0] < 10.0 * MAS) & ((epoch < EARLIEST) | (epoch > LATEST)))


def _corrections(problem: Problem, part: _Part) -> Iterator[tuple[str, int, Change]]:
    """Yield mistakes in a part, how much their corrections hide, and the changes of its table that correct them."""
    table, words, stars = part.table, part.words, problem.satellite.values
    _, dec, parallax, *_ = stars if table == "satellite" else stars[:, problem.source]
    factor, velocity = np.ones((2, 5, len(part.at)))
    factor[3], velocity[3:] = np.cos(dec), np.abs(np.nan_to_num(parallax)) / (4.74 * MAS)  # 1 au/yr is 4.74 km/s
    both = partial(_changed, ("values", "errors"))
    cos_dec = f"pmra of {words} is mu_alpha, without cos(dec): say --without-cos-dec {table}"
    yield cos_dec, 0, both(lambda array: array * factor)
    yield f"pmra of {words} has a factor cos(dec) too many", 0, both(lambda array: array / factor)
    yield f"pmra and pmdec of {words} exchanged", 0, both(lambda array: array[[0, 1, 2, 4, 3]])
    for name, rows in NOT_POSITIONS.items():
        yield f"{name} of {words} with reversed sign", 0, _scaled(rows, -1.0, values=True)
    if table != "satellite":
        mean = f"mean positions of {words} taken as those of a single epoch, or the other way round"
        yield mean, 0, _changed(["apparent"], np.logical_not)
    for ratio, unit, name, rows in _in_units(SMALLER | LARGER | RATES, NOT_POSITIONS):
        yield f"{name} of {words}, {unit}", 0, _scaled(rows, ratio, values=True)
        yield f"{name} and their errors of {words}, {unit}", 0, _scaled(rows, ratio, values=True, errors=True)
    if table == "satellite" and problem.satellite.further is not None:
        orbits = f"orbits of {words} that the other table does not have"
        yield orbits, 0, _changed(["further"], lambda further: further * np.array([[1.0]] * 4 + [[0.0]]))
        mean = f"positions of {words} that are averages: say --accelerations mean"
        yield mean, 0, lambda table: replace(table, averaged=np.full(len(table), HALF_SPAN))
    yield f"proper motions of {words} in km/s, taken for mas/yr", 0, both(lambda array: array * velocity)
    for ratio, unit, name, rows in _in_units(SMALLER | ROOTS, WITH_ERRORS):
        yield f"errors of {name} of {words} too small, {unit}", HIDES_ALL, _scaled(rows, ratio, errors=True)
    shift = best_shift(lambda years: _ratio(_applied(problem, part, _later(years)) if years else problem))
    moved = _later(shift)(problem.satellite if table == "satellite" else problem.rows)
    if not np.any(part.at & impossible(moved.errors, moved.epoch)):
        early = "early" if shift > 0.0 else "late"
        yield f"epochs of {words} {round(abs(shift), 2) or abs(shift):.3g} years too {early}", 0, _later(shift)
    yield f"epochs of {words} in Besselian years, taken for Julian ones", 0, _changed(["epoch"], julian_years)


def _later(years: float) -> Change:
    return _changed(["epoch"], lambda epoch: epoch + years)


def _in_units(factors: dict[float, str], quantities: dict[str, Rows]) -> Iterator[tuple[float, str, str, Rows]]:
    """Yield each factor with its unit and each quantity: times only along right ascension, rates only of motions."""
    for (factor, unit), (name, rows) in product(factors.items(), quantities.items()):
        if ("time" not in unit or rows in ((0,), (3,))) and ("year" not in unit or min(rows) > 2):
            yield factor, unit, name, rows


def _changed(names: Sequence[str], change: Callable[[Any], Any]) -> Change:
    """Return a change of some arrays of a table."""
    return lambda table: replace(table, **{name: change(getattr(table, name)) for name in names})


def _scaled(rows: Sequence[int], factor: float, values: bool = False, errors: bool = False) -> Change:
    """Return a change of values or errors by a factor, or of squares (NaN) to their roots; it leaves the table as it is
    if nothing of it is plausible then: errors that no instrument has, values that vanish in their errors, or larger
    errors where they may be right as they are.
    """

    def change(table: Astrometry) -> Astrometry:
        factors = np.ones_like(table.errors)
        to_roots = np.sqrt(MAS / np.maximum(table.errors, 1e-300))  # some are exact
        factors[list(rows)] = to_roots[list(rows)] if np.isnan(factor) else factor
        after = table.errors * np.abs(factors) if errors else table.errors
        changed = replace(table, values=table.values * factors if values else table.values, errors=after)
        used = changed.present[list(rows)]
        if not np.any(used):
            return table
        size, error, before = (abs(one[list(rows)][used]) / MAS for one in (changed.values, after, table.errors))
        plausible = PLAUSIBLE[0] <= np.median(error) <= PLAUSIBLE[1]
        if values:
            most = LARGEST["mas" if min(rows) == 2 else "mas/yr"]
            plausible &= np.median(size - 3.0 * error) > 0.0 and np.median(size) < most
        elif np.median(error) > np.median(before):
            plausible &= np.median(before) < SMALLEST
        return changed if plausible else table

    return change


def _freed(problem: Problem, turned: bool) -> Change:
    """Return a change that gives positions an error along the proper motions, as if epochs were known to a century
    only; or, if ``turned``, across them.  Single-epoch positions are also uncertain by the parallax.
    """

    def change(rows: Astrometry) -> Astrometry:
        star = problem.satellite.taken(problem.source)
        motion = np.nan_to_num(star.values[[4, 3] if turned else [3, 4]]) * np.array([[-1.0 if turned else 1.0], [1.0]])
        with np.errstate(invalid="ignore", divide="ignore"):
            size = np.where(np.any(motion != 0.0, axis=0), 1e5 * rows.errors[0] / np.hypot(*motion), 0.0)
        along = motion * np.where(rows.present[0], np.minimum(size, 100.0), 0.0)
        covariance = rows.covariance()
        covariance[:, :2, :2] += np.einsum("ir,jr->rij", along, along)
        seen = rows.apparent & rows.present[0]
        covariance[seen, :2, :2] += np.eye(2) * np.nan_to_num(star.values[2, seen, None, None]) ** 2
        errors, correlations = by_errors(covariance)
        errors = np.where(rows.present, errors, rows.errors)
        return replace(rows, errors=errors, correlations=correlations[*np.array(PAIRS).T])

    return change


def _applied(problem: Problem, part: _Part, change: Change) -> Problem | None:
    """Return the problem with a part of a table changed as if it were alone; None where that changes nothing."""
    of_satellite = part.table == "satellite"
    table = problem.satellite if of_satellite else problem.rows
    new, arrays, differs = change(replace(table, errors=np.where(part.at, table.errors, np.nan))), {}, False
    for name in ("values", "errors", "epoch", "apparent", "correlations", "further", "averaged"):
        if (after := getattr(new, name)) is not None:
            before = getattr(table, name)
            arrays[name] = np.where(part.at, after, np.zeros_like(after) if before is None else before)
            differs |= before is None or not np.array_equal(arrays[name], before, equal_nan=True)
    merged = replace(table, **arrays)
    if not differs:
        return None
    return replace(problem, satellite=merged) if of_satellite else replace(problem, rows=merged)


def _ratio(problem: Problem | None, typical: bool = False) -> float:
    """Return chi2 over its expectation, or that of the typical source; infinite where there is no solution."""
    if problem is None:
        return np.inf
    try:
        solution = solve(sums := source_sums(problem))
    except LinkError:
        return np.inf
    value = np.median(_each(sums, solution)[sums.count > 0]) if typical else solution.scale**2
    return float(value) if np.isfinite(value) else np.inf


def _each(sums: NormalSums, solution: Solution) -> Array:
    """Return chi2 of each source over its number of observations."""
    return discrepancies(sums, solution.estimate) / np.maximum(sums.count, 1.0)


def best_shift(at: Callable[[float], float]) -> float:
    """Return the years for which a function is smallest.

    Near its minimum chi2 is a parabola in the shift.  Starts and first steps are whole years, over which the parallax
    does not change.
    """
    at = cache(at)
    shift: float = min(STARTS, key=at)
    for step in (8.0, 8.0, 4.0, 2.0, 1.0):  # twice, as the best start may be the second nearest
        shift = min((shift, shift - step, shift + step), key=at)
    for step in (1.0, 0.05, 0.02, 0.02):
        low, here, high = (at(shift + d) for d in (-step, 0.0, step))
        curvature = low + high - 2.0 * here
        if not 0.0 < curvature < np.inf:
            break
        shift = min(shift, float(np.clip(shift - 0.5 * step * (high - low) / curvature, -200.0, 200.0)), key=at)
    return shift


def _outliers(problem: Problem, ratio: float) -> tuple[Indices, float]:
    """Return the few sources without which chi2 is at its level, and what it then is; none if there are more."""
    sums = source_sums(problem)
    kept = np.arange(len(sums))
    for _ in range(min(3, len(sums) // 4)):
        used = sums.taken(kept)
        normal, right = used.normal.sum(axis=0), used.right.sum(axis=0)
        # chi2 without each: a source with errors that are too small fits well itself
        lost = used.squares + np.sum((right - used.right) * leave_one_out(used, normal, right), axis=1)
        kept = np.delete(kept, np.argmax(np.nan_to_num(lost, nan=-np.inf)))
        if explains(left := _ratio(problem.only(kept)), ratio):
            return np.setdiff1d(np.arange(len(sums)), kept), left
    return np.zeros(0, dtype=np.int64), np.nan


def _exchanged(problem: Problem, ratio: float) -> Iterator[Cause]:
    """Yield, as `_causes`, pairs of sources whose rows belong to one another, of those that fit worst."""
    sums = source_sums(problem)
    worst = np.argsort(-_each(sums, solve(sums)))[:6]
    for part in _wholes(problem)[1:]:
        for pair in combinations(worst, 2):
            place = np.arange(len(problem.satellite))
            place[list(pair)] = pair[::-1]
            trial = replace(problem, source=np.where(part.at, place[problem.source], problem.source))
            if explains(corrected := _ratio(trial), ratio):
                yield Cause(f"the names {_listed(problem, pair, ' and ')} exchanged in {part.words}", corrected)


def _listed(problem: Problem, sources: Sequence[int] | Indices, separator: str = ", ") -> str:
    return separator.join(map(str, np.asarray(problem.satellite.names)[list(sources)]))
