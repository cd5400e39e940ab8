"""Links as they may become: errors of a later Gaia release, new observations and which sources to observe, and tables
drawn again and again with their errors.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from linksweep.core.frames import Array, Indices
from linksweep.core.tie.astrometry import Differences, by_errors
from linksweep.core.tie.problem import KeptSources, NormalSums, Problem, add_separations, covariance_of, eliminate
from linksweep.core.unknowns import Unknowns


class Release(NamedTuple):
    """Reference epoch (Julian year TCB) and the months of observations of a release."""

    epoch: float
    months: float


# Sources: Gaia Collaboration 2016 (DR1), 2018 (DR2, 2014.56 to 2016.39), 2021 (EDR3 to 2017.41); ESA's pages of the
# data releases for DR4 (66 months, J2017.5) and DR5 (to the end of observations in January 2025; its epoch is not
# announced, here the middle).
RELEASES = {
    "dr1": Release(2015.0, 14.0),
    "dr2": Release(2015.5, 22.0),
    "dr3": Release(2016.0, 34.0),
    "dr4": Release(2017.5, 66.0),
    "dr5": Release(2020.0, 126.0),
}

# Epochs that differ by less (years) are the same: some are written as whole days.
SAME_EPOCH = 0.01


def releases_at(epochs: Array) -> list[str]:
    """Return the releases whose epochs a table has (N,), in Julian years; none if it has others too."""
    known = np.unique(epochs[np.isfinite(epochs)])
    near = [{name for name, one in RELEASES.items() if abs(one.epoch - epoch) < SAME_EPOCH} for epoch in known]
    return sorted(set().union(*near)) if all(near) else []


def released(
    problem: Problem, new: str, named: str = "table", epoch_moves: bool = True
) -> tuple[Problem, str, list[str]]:
    """Return the problem with the satellite's table as another release may give it: errors scaled, correlations kept,
    at that release's epoch, to which the epoch of the unknowns ``moves`` with it; the release of the table's epoch,
    from which it is scaled; and notes on what was assumed.  "table" leaves all as it is.

    ``named`` is a release for epochs that are those of none; with it, ``new`` may also be an earlier release.  Raises
    ValueError where errors would be scaled twice or, without ``named``, backwards.  For forecasts: the values stay the
    same, so only errors are meaningful.
    """
    if new == "table":
        return problem, "", []
    star = problem.satellite
    known, at = np.unique(star.epoch[np.isfinite(star.epoch)]), releases_at(star.epoch) or [named] * (named != "table")
    if len(at) != 1 or named not in ("table", *at):
        span = " to ".join(dict.fromkeys(f"{epoch:.10g}" for epoch in (*known[:1], *known[-1:]))) or "none"
        there = ", ".join(f"{name} {one.epoch:g}" for name, one in RELEASES.items())
        said = f"the satellite's epochs ({span}) are those of {' and '.join(at) or 'no release'} ({there})"
        raise ValueError(f"{said}: errors are scaled from one; name it, from_release, only for epochs of none")
    old = at[0]
    if old == new or (named == "table" and RELEASES[new].months < RELEASES[old].months):
        said = f"release {new}: the satellite's epoch {known[0]:g} is that of {old}, the same or a later one"
        raise ValueError(f"{said}; to scale errors backwards, name from_release {old}")
    # T^-1/2 and T^-3/2 with the time T that observations span, as on ESA's Gaia science performance pages
    ratio = RELEASES[old].months / RELEASES[new].months
    position, motion = ratio**0.5, ratio**1.5
    scale = np.array([position, position, position, motion, motion])[:, None]
    shift = RELEASES[new].epoch - RELEASES[old].epoch
    satellite = replace(star, errors=star.errors * scale, epoch=star.epoch + shift)
    if star.further is not None:
        slower = np.stack([np.ones(5), ratio ** np.array([2.5, 2.5, 3.5, 3.5, 0.5])])[..., None]
        satellite = replace(satellite, further=star.further * slower)
    first = f"errors scaled from {old} ({RELEASES[old].epoch:g}) to {new}: positions x {position:.3g}"
    notes = [f"{first}, motions x {motion:.3g}"]
    if "dr1" in (old, new):
        notes.append("motions of dr1 rest on Hipparcos and Tycho-2 positions, so their errors do not scale as T^-3/2")
    epoch = problem.epoch + shift if epoch_moves else problem.epoch
    return replace(problem, satellite=satellite, epoch=epoch), old, notes


@dataclass(frozen=True)
class Goal:
    """What is minimised: the trace (A) or the log determinant (D) of the covariance of some unknowns."""

    unknowns: Unknowns
    blocks: tuple[str, ...]
    criterion: str = "A"

    @property
    def parts(self) -> Indices:
        """Places of the unknowns of the blocks, or of all unknowns if no block is named (D_s otherwise)."""
        names = self.blocks or self.unknowns.names
        return np.concatenate([np.arange(len(self.unknowns))[self.unknowns.part(name)] for name in names])

    def value(self, matrices: Array) -> float:
        """Return the criterion of sums as in `covariance_of`; infinite where they do not determine the unknowns."""
        covariance = covariance_of(matrices)[np.ix_(self.parts, self.parts)]
        if not np.all(np.isfinite(covariance)):
            return np.inf
        return float(np.trace(covariance) if self.criterion == "A" else np.linalg.slogdet(covariance)[1])


def choose(now: NormalSums, new: NormalSums, number: int, goal: Goal) -> tuple[list[int], Array]:
    """Return the sources to observe, the best first, then the best beside it, and so on, and the sums of the
    `NormalSums.matrices` before and after each (n + 1, 1 or 2, K, K).

    ``now`` and ``new`` are the sums of each source without and with the new rows.  While no single one determines the
    unknowns, the one that adds most to the smallest eigenvalues is taken.
    """
    gain = new.matrices - now.matrices
    totals, chosen = [now.matrices.sum(axis=0)], list[int]()
    for _ in range(min(number, len(gain))):
        left = [i for i in range(len(gain)) if i not in chosen]
        trials = [totals[-1] + gain[i] for i in left]
        values = [goal.value(trial) for trial in trials]
        if not np.any(np.isfinite(values)):
            values = [-_regularised(trial[0]) for trial in trials]
        best = left[int(np.argmin(values))]
        chosen.append(best)
        totals.append(totals[-1] + gain[best])
    return chosen, np.array(totals)


def _regularised(normal: Array) -> float:
    """Return a log determinant relative to the trace that is finite for a singular matrix too."""
    size = np.trace(normal) / len(normal)
    return float(np.linalg.slogdet(normal / size + 1e-9 * np.eye(len(normal)))[1]) if size > 0.0 else -np.inf


# ---- tables drawn with their errors

# Sources, counted over all draws that are made together: the random numbers depend on it.
DRAWN_AT_ONCE = 8192


@dataclass
class Simulation:
    """The tables of a problem as they might have been, had the unknowns the values ``truth`` (K,).

    The errors of the satellite's parameters and of the rows are normal with the covariances of the tables, times
    ``error_factor``; those of a fraction ``outliers`` of the sources are ``outlier_factor`` times larger still.
    """

    problem: Problem
    truth: Array
    error_factor: float = 1.0
    outliers: float = 0.0
    outlier_factor: float = 1.0

    def __post_init__(self) -> None:
        star = self.problem.satellite
        self._covariance, self._free = star.covariance(), ~star.present.T
        self._rows = self.problem.differences()
        self._matrix = self.problem.unknowns.matrix(*self.problem.objects(star))

    @property
    def normals(self) -> NormalSums:
        """The sums of each source for differences of zero: N, counts and averages are the same in every draw."""
        return self._sums(np.zeros((1, *self._rows.values.shape)))[0]

    def draws(self, number: int, rng: np.random.Generator) -> Iterator[KeptSources]:
        """Yield the sources of ``number`` draws; memory is that of a block of sources, or of one draw."""
        n_sources, source, rows = len(self._free), self.problem.source, self._rows
        alone, pairs = rows.covariance.copy(), np.stack([source.astype(np.str_), rows.calibrator])
        alone[:, range(2), range(2)] -= rows.present[:, :2] * rows.shared[:, None] ** 2
        own_half, row_half = _half(self._covariance), _half(alone)
        group = np.unique(pairs, axis=1, return_inverse=True)[1].ravel()  # rows of a source that share a calibrator
        at_once = max(1, DRAWN_AT_ONCE // n_sources)
        for start in range(0, number, at_once):
            n = min(at_once, number - start)
            scale = np.full((n, n_sources, 1), self.error_factor)
            if self.outliers > 0.0:
                scale[rng.random(scale.shape) < self.outliers] *= self.outlier_factor
            own_errors = scale * np.einsum("sij,nsj->nsi", own_half, rng.standard_normal((n, *own_half.shape[:2])))
            row_errors = np.einsum("rij,nrj->nri", row_half, rng.standard_normal((n, len(source), 5)))
            if np.any(rows.shared):
                common = rng.standard_normal((n, group.max() + 1, 2))[:, group]
                row_errors[..., :2] += rows.shared[:, None] * common
            inside = np.tile(self._matrix @ self.truth, (n, 1, 1))
            inside[..., :5] -= own_errors[..., :5]
            values = np.einsum("rij,nrj->nri", rows.by_frames, inside[:, source]) + scale[:, source] * row_errors
            values -= np.einsum("rij,nrj->nri", rows.partials[:, :, 5:], own_errors[:, source, 5:])  # of accelerations
            values = np.where(rows.present, values, 0.0)
            for one, sums in zip(values, self._sums(values), strict=True):
                yield KeptSources(self.problem, sums, partial(self._separations, one))

    def _sums(self, values: Array) -> list[NormalSums]:
        """Return the sums of each draw of the differences (n, R, 5)."""
        # many draws are eliminated at once, as sources of one large table: small tables would spend their time in calls
        n, n_sources = len(values), len(self._free)
        tiled = {name: np.concatenate([array] * n) for name, array in vars(self._rows).items() if name != "values"}
        rows = Differences(values.reshape(-1, 5), **tiled)
        source = (self.problem.source + n_sources * np.arange(n)[:, None]).ravel()
        covariance, free = np.tile(self._covariance, (n, 1, 1)), np.tile(self._free, (n, 1))
        left = eliminate(rows, source, covariance, free, self.problem.weights)
        matrix, across, first = self._matrix, self._matrix.swapaxes(1, 2), slice(0, n_sources)
        normal = across @ left.normal[first] @ matrix
        spread = None if left.spread is None else across @ left.spread[first] @ matrix
        rights = np.einsum("ski,nsi->nsk", across, left.right.reshape(n, n_sources, -1))
        both = zip(rights, left.squares.reshape(n, n_sources), strict=True)
        return [NormalSums(normal, *one, left.count[first], left.expected[first], spread) for one in both]

    def _separations(self, values: Array) -> Array:
        largest, source = np.zeros((2, len(self._free))), self.problem.source
        rows = replace(self._rows, values=values)
        add_separations(largest, source, rows, self._covariance[source], self._free[source])
        return largest


def _half(covariance: Array) -> Array:
    """Return a square root L of each covariance (N, 5, 5), L L' = C, which may be singular."""
    errors, correlations = by_errors(covariance)
    values, vectors = np.linalg.eigh(np.moveaxis(correlations, -1, 0))
    return np.asarray(errors.T[:, :, None] * vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])
