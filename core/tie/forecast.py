"""What a later Gaia release or further observations do to the errors of a link, and which sources to observe."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from linksweep.core.frames import Array, Indices
from linksweep.core.link import LinkError
from linksweep.core.tie.astrometry import Astrometry, joined
from linksweep.core.tie.problem import NormalSums, Problem
from linksweep.core.tie.solution import inverted
from linksweep.core.unknowns import Unknowns

Criterion = Literal["A", "D"]


@dataclass(frozen=True)
class Release:
    """Reference epoch (Julian year TCB) and the months of observations of a release."""

    epoch: float
    months: float


RELEASES = {
    "dr1": Release(2015.0, 14.0),
    "dr2": Release(2015.5, 22.0),
    "dr3": Release(2016.0, 34.0),
    "dr4": Release(2017.5, 66.0),
    "dr5": Release(2020.0, 126.0),
}
"""Sources: Gaia Collaboration 2016 (DR1), 2018 (DR2, 2014.56 to 2016.39), 2021 (EDR3 to 2017.41); ESA's pages of the
data releases for DR4 (66 months, J2017.5) and DR5 (to the end of observations in January 2025; its epoch is not
announced, here the middle).
"""

SAME_EPOCH = 0.01
"""Epochs that differ by less (years) are the same: some are written as whole days."""


def factors(old: str, new: str) -> tuple[float, float]:
    """Return the factors on the errors of positions and parallaxes, and of motions, from one release to another.

    Positions go as T^-1/2 and motions as T^-3/2 with the time T that observations span, as on ESA's Gaia science
    performance pages.  Raises ValueError for an unknown release.
    """
    for name in (old, new):
        if name not in RELEASES:
            raise ValueError(f"no release {name!r}; there are {', '.join(RELEASES)}")
    ratio = RELEASES[old].months / RELEASES[new].months
    return ratio**0.5, ratio**1.5


def scaled_from(epochs: Array, new: str, named: str | None = None) -> str:
    """Return the release from which a table's errors are scaled to ``new``: that of its epochs (N,), in Julian years.

    ``named`` is a release for epochs that are those of none; with it, ``new`` may also be an earlier release.  Raises
    ValueError where errors would be scaled twice or, without ``named``, backwards.
    """
    _ = factors(named or new, new)  # raises for an unknown release
    known = np.unique(epochs[np.isfinite(epochs)])
    near = {epoch: [name for name, one in RELEASES.items() if abs(one.epoch - epoch) < SAME_EPOCH] for epoch in known}
    at = sorted({name for names in near.values() for name in names}) if all(near.values()) else []
    if len(at) > 1:
        raise ValueError(f"the satellite has epochs of {' and '.join(at)}; errors are scaled from one release")
    if not at and named is None:
        found = " to ".join(f"{epoch:.10g}" for epoch in known[[0, -1][: len(known)]]) or "none"
        there = ", ".join(f"{name} {one.epoch:g}" for name, one in RELEASES.items())
        raise ValueError(
            f"the satellite's epochs ({found}) are those of no release ({there}): name the release of its errors, "
            "from_release"
        )
    old = at[0] if at else str(named)
    if named not in (None, old):
        raise ValueError(
            f"from_release {named}: the satellite's epoch {RELEASES[old].epoch:g} is that of {old}, whose errors would "
            f"be scaled as if they were those of {named}; leave from_release out"
        )
    if old == new:
        raise ValueError(f"release {new}: the satellite's errors are those of {new} already; leave release out")
    if named is None and RELEASES[new].months < RELEASES[old].months:
        raise ValueError(
            f"release {new}: the satellite's epoch is that of {old}, which is later; to scale errors backwards, name "
            f"from_release {old}"
        )
    return old


def scaling_notes(old: str, new: str) -> list[str]:
    """Return what was taken to scale errors from one release to another, and what is to be known about it."""
    position, motion = factors(old, new)
    first = f"errors scaled from {old} ({RELEASES[old].epoch:g}) to {new}: positions x {position:.3g}"
    rest = "motions of dr1 rest on Hipparcos and Tycho-2 positions, so their errors do not scale as T^-3/2"
    return [f"{first}, motions x {motion:.3g}", *([rest] if "dr1" in (old, new) else [])]


def released(problem: Problem, old: str, new: str, epoch_moves: bool = True) -> Problem:
    """Return the problem with the satellite's table as another release may give it: errors scaled, correlations kept,
    at that release's epoch, to which the epoch of the unknowns ``moves`` with it.

    For forecasts: the values stay the same, so only errors are meaningful.
    """
    position, motion = factors(old, new)
    scale = np.array([position, position, position, motion, motion])[:, None]
    shift = RELEASES[new].epoch - RELEASES[old].epoch
    own = problem.satellite
    satellite = replace(own, errors=own.errors * scale, epoch=own.epoch + shift)
    return replace(problem, satellite=satellite, epoch=problem.epoch + shift if epoch_moves else problem.epoch)


def with_new_rows(problem: Problem, epochs: Sequence[float], error: float, apparent: bool = True) -> Problem:
    """Return the problem with a position added to each source at each of ``epochs`` (NaN for the source's own).

    ``error`` (rad) is that of each coordinate; the position is of a single epoch (``apparent``) or a mean one.  The
    new rows have the satellite's position, so they serve forecasts, which do not depend on measured values.
    """
    n, times = len(problem.satellite), len(epochs)
    values, errors = np.full((2, 5, n * times), np.nan)
    values[:2] = np.tile(problem.satellite.values[:2], times)
    errors[:2] = error
    new = Astrometry(
        values, errors, np.repeat(np.asarray(epochs, dtype=np.float64), n), apparent=np.full(n * times, apparent)
    )
    source = np.concatenate([problem.source, np.tile(np.arange(n), times)])
    return replace(problem, rows=joined(problem.rows, new), source=source)


@dataclass(frozen=True)
class Goal:
    """What is minimised: the trace (A) or the log determinant (D) of the covariance of some unknowns."""

    unknowns: Unknowns
    blocks: tuple[str, ...]
    criterion: Criterion = "A"

    @property
    def parts(self) -> Indices:
        """Places of the unknowns of the blocks, or of all unknowns if no block is named (D_s otherwise)."""
        names = self.blocks or self.unknowns.names
        return np.concatenate([np.arange(len(self.unknowns))[self.unknowns.part(name)] for name in names])

    def value(self, normal: Array) -> float:
        """Return the criterion of a normal matrix (K, K); infinite where it does not determine the unknowns."""
        try:
            covariance = inverted(normal)[np.ix_(self.parts, self.parts)]
        except LinkError:
            return np.inf
        return float(np.trace(covariance) if self.criterion == "A" else np.linalg.slogdet(covariance)[1])


@dataclass(frozen=True)
class Choice:
    """Sources in the order in which they are chosen, and the normal matrices (n + 1, K, K) before and after each."""

    sources: tuple[int, ...]
    normals: Array


def choose(now: NormalSums, new: NormalSums, number: int, goal: Goal) -> Choice:
    """Return the sources to observe, the best first, then the best beside it, and so on.

    ``now`` and ``new`` are the sums of each source without and with the new rows.  While no single one determines the
    unknowns, the one that adds most to the smallest eigenvalues is taken.
    """
    gain = new.normal - now.normal
    normals = [now.normal.sum(axis=0)]
    chosen: list[int] = []
    for _ in range(min(number, len(gain))):
        left = [i for i in range(len(gain)) if i not in chosen]
        values = [goal.value(normals[-1] + gain[i]) for i in left]
        if not np.any(np.isfinite(values)):
            values = [-_regularised(normals[-1] + gain[i]) for i in left]
        best = left[int(np.argmin(values))]
        chosen.append(best)
        normals.append(normals[-1] + gain[best])
    return Choice(tuple(chosen), np.array(normals))


def _regularised(normal: Array) -> float:
    """Return a log determinant relative to the trace that is finite for a singular matrix too."""
    size = np.trace(normal) / len(normal)
    return float(np.linalg.slogdet(normal / size + 1e-9 * np.eye(len(normal)))[1]) if size > 0.0 else -np.inf
