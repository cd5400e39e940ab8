"""The solution of a link with its clip, all kinds of errors, and the influence of each source."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc
from threadpoolctl import threadpool_limits

from linksweep.core.frames import Array, Indices
from linksweep.core.link import LinkError
from linksweep.core.tie.astrometry import kinds
from linksweep.core.tie.clips import Clipped, Sources, SourceTable, clipped, parse_clip
from linksweep.core.tie.mistakes import DEFICIT, GOOD, Misfit, misfit
from linksweep.core.tie.solution import (
    LARGE_SHARE,
    Influence,
    Solution,
    bootstrap,
    influence,
    jackknife,
    sandwich,
    shares,
)
from linksweep.core.unknowns import Harmonics, Unknowns
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tie.row_groups import RowGroupTable
from linksweep.sweep.tie.setup import Setup

ERRORS = ("formal", "scaled", "jackknife", "cells", "bootstrap", "sandwich")
ALWAYS = ("formal", "scaled")
RESAMPLES = 1000

HEAVIEST = 100
"""If there are too many sources to keep the sums of each, so many are examined for a large share."""


VECTOR_POWER = 8.0 * np.pi / 3.0
"""Power of degree 1 of a rotation or a glide is this times the square of its length (Mignard & Klioner 2012)."""

FIELD_OF = {
    "orientation": "position toroidal",
    "position_glide": "position spheroidal",
    "spin": "motion toroidal",
    "glide": "motion spheroidal",
}
"""The field whose degree 1 a block is."""


@dataclass(frozen=True)
class Link:
    """A solved link: its setup, the clip and its solution, the covariances by kind of error, and the influence of each
    source (None where there are too many).  ``discrepancy`` is None where it was not asked for.  The first note is what
    chi2 says of the tables, if anything.
    """

    setup: Setup
    clip: str
    clipped: Clipped
    covariances: dict[str, Array]
    main: str
    influence: Influence | None
    discrepancy: Array | None
    count: NDArray[np.floating[Any]]
    misfit: Misfit
    notes: tuple[str, ...]

    @property
    def solution(self) -> Solution:
        """The solution of the sources that were kept."""
        return self.clipped.solution


def solve_link(
    setup: Setup,
    clip: str = "none",
    errors: Sequence[str] = ("scaled",),
    resamples: int = RESAMPLES,
    seed: int = 0,
    table: RowGroupTable | None = None,
    per_source: bool = True,
) -> Link:
    """Return the solution of a setup; raises SweepError if there is none.

    ``table`` has the sources if they are read by row groups; without ``per_source`` it is not read again for values
    of single sources.
    """
    if not errors or any(name not in ERRORS for name in errors):
        raise SweepError(f"errors {', '.join(errors)!r}: must be among {', '.join(ERRORS)}")
    if resamples < 2:
        raise SweepError(f"{resamples} resamples: must be at least 2")
    try:
        with threadpool_limits(1):  # bitwise the same on any number of cores; products of blocks are small
            kept = table or SourceTable(setup.problem)
            sources = kept.as_sources()
            result = clipped(parse_clip(clip), sources, kept.separations)
            covariances, notes = _covariances(kept, result, errors, resamples, seed)
            squares = sources.discrepancies(result.solution.estimate) if per_source else None
            effect, places, share = _influence(kept, sources, result, setup.problem.unknowns)
            doubt = _misfit(setup, kept, result)
    except LinkError as error:
        raise SweepError(f"{error}{_rows_there_are(setup)}") from error
    except ValueError as error:
        raise SweepError(str(error)) from error
    notes += _large_shares(setup.problem.unknowns.names, setup.names[places], share)
    return Link(
        setup=setup,
        clip=str(parse_clip(clip)),
        clipped=result,
        covariances=covariances,
        main=errors[0],
        influence=effect,
        discrepancy=squares,
        count=sources.count,
        misfit=doubt,
        notes=(*([doubt.text] if doubt.text else []), *setup.notes, *result.notes, *notes),
    )


def _misfit(setup: Setup, table: SourceTable | RowGroupTable, result: Clipped) -> Misfit:
    """Return what chi2 says of the sources that are kept, with the best weights; of all if the clip keeps fewer than
    half of them.
    """
    factors, solution, problem = result.factors, result.solution, setup.problem
    if isinstance(table, RowGroupTable):
        if DEFICIT <= solution.scale**2 <= GOOD:
            return Misfit(solution.scale**2)  # a row group is read again only if something is wrong
        problem = table.groups[0].problem()
    if problem.weights != "covariance" or np.count_nonzero(factors) < 0.5 * len(factors):
        factors = factors if np.count_nonzero(factors) >= 0.5 * len(factors) else np.ones(len(factors), dtype=bool)
        problem = replace(problem, weights="covariance")
        if isinstance(table, SourceTable):
            solution = SourceTable(problem).solve(factors)
    kept = np.flatnonzero(factors[: len(problem.satellite)] > 0.0)
    return misfit(problem, kept, solution, setup.names, ("reference", *setup.missions))


def _rows_there_are(setup: Setup) -> str:
    """Return which kinds of rows there are, and what is known about the tables, for an error."""
    names, numbers = np.unique(kinds(setup.problem.rows), return_counts=True)
    counted = ", ".join(f"{n} {kind}" for kind, n in zip(names, numbers, strict=True))
    if len(epochs := np.unique(setup.problem.rows.epoch[np.isfinite(setup.problem.rows.epoch)])):
        counted += f", of {epochs[0]:g} to {epochs[-1]:g}" if len(epochs) > 1 else f", all of {epochs[0]:g}"
    return f" (rows: {counted}; {'; '.join(setup.notes)})" if setup.notes else f" (rows: {counted})"


def _influence(
    table: SourceTable | RowGroupTable, sources: Sources, result: Clipped, unknowns: Unknowns
) -> tuple[Influence | None, Indices, Array]:
    """Return the influence of each source (None if their sums are not kept), and the places and shares of all sources
    or of the heaviest.
    """
    if table.kept is not None:
        effect = influence(table.kept, result.solution, unknowns, result.factors)
        return effect, np.arange(len(effect.share)), effect.share
    _, places, sums = table.heaviest(HEAVIEST)
    return None, places, shares(sums, result.solution, unknowns) * result.factors[places, None]


def _covariances(
    table: SourceTable | RowGroupTable, result: Clipped, errors: Sequence[str], resamples: int, seed: int
) -> tuple[dict[str, Array], list[str]]:
    solution, notes = result.solution, []
    sums = table.kept
    if sums is not None:
        used = result.factors > 0.0
        sums, factors = sums.taken(used), result.factors[used]
        sums = sums if np.all(factors == 1.0) else sums.scaled(factors)
    right = solution.normal @ solution.estimate
    covariances: dict[str, Array] = {}
    for kind in dict.fromkeys([*errors, *ALWAYS]):
        groups = sums if kind != "cells" and sums is not None else table.cell_sums(result.factors)
        if sums is None and kind in ("jackknife", "bootstrap", "sandwich"):
            notes.append(f"{kind} errors are those of {len(groups)} cells of the sky: there are too many sources")
        if kind == "formal":
            covariances[kind] = solution.covariance
        elif kind == "scaled":
            covariances[kind] = solution.covariance * solution.scale**2
        elif kind in ("jackknife", "cells"):
            covariances[kind] = jackknife(groups, solution.normal, right)
        elif kind == "sandwich":
            covariances[kind] = sandwich(groups, solution)
        else:
            drawn = bootstrap(groups, resamples, np.random.default_rng(seed))
            covariances[kind] = drawn.covariance
            if drawn.failed:
                notes.append(f"{drawn.failed} of {resamples} resamples did not determine the unknowns")
        if not np.all(np.isfinite(covariances[kind])):
            why = "there are no degrees of freedom" if kind == "scaled" else "some unknowns depend on a single source"
            notes.append(f"there are no {kind} errors: {why}")
    return covariances, notes


def _large_shares(blocks: Sequence[str], names: NDArray[Any], shares_of: Array) -> list[str]:
    notes = []
    for block, share in zip(blocks, shares_of.T, strict=True):
        large = np.flatnonzero(share > LARGE_SHARE)
        if len(large):
            large = large[np.argsort(-share[large])]
            listed = ", ".join(f"{names[k]} ({100.0 * share[k]:.0f} %)" for k in large)
            notes.append(f"more than {100 * LARGE_SHARE:.0f} % of the weight in {block}: {listed}")
    return notes


class Power(NamedTuple):
    """Power of one degree l of a field (mas^2 or mas^2/yr^2), its mean for noise alone, c'V^-1 c, which
    for noise alone is a chi2 of 2 l + 1 degrees of freedom, and the probability that noise is as significant.
    """

    field: str
    degree: int
    power: float
    noise: float
    chi2: float
    probability: float


def spectrum(unknowns: Unknowns, estimate: Array, covariance: Array) -> list[Power]:
    """Return the power of each degree among the unknowns (rotations, glides: degree 1); none without harmonics."""
    if not any(isinstance(block, Harmonics) for block in unknowns.blocks):
        return []
    powers = []
    for block in unknowns.blocks:
        part = unknowns.part(block.name)
        x, v = estimate[part], covariance[part, part]
        if isinstance(block, Harmonics):
            start, where = 0, "motion" if block.rate else "position"
            for kind, degree in block.parts:
                weights = np.array([1.0, *[2.0] * (2 * degree)])  # order 0, then both parts of each other order
                piece = slice(start, start + len(weights))
                field = f"{where} {'toroidal' if kind == 't' else 'spheroidal'}"
                powers.append(_power(field, degree, weights, x[piece], v[piece, piece]))
                start = piece.stop
        elif block.name in FIELD_OF and len(x) == 3:
            powers.append(_power(FIELD_OF[block.name], 1, np.full(3, VECTOR_POWER), x, v))
    return powers


def _power(field: str, degree: int, weights: Array, x: Array, v: Array) -> Power:
    chi2 = float(x @ np.linalg.solve(v, x)) if np.any(v) else np.nan  # a table linked to itself has errors of 0
    probability = float(chdtrc(2 * degree + 1, chi2))
    return Power(field, degree, float(weights @ x**2), float(weights @ np.diag(v)), chi2, probability)
