"""Noise beyond the stated errors, estimated from the tables by restricted maximum likelihood (REML).

The covariance of a source's differences is D = D_0 + sum_k t_k G_k, with a variance t_k >= 0 for each quantity of each
kind of row and of the satellite.  With P = D^-1 - D^-1 X F X' D^-1, F = (X' D^-1 X)^-1, the likelihood of what does not
depend on the unknowns is -1/2 (log |D| + log |X' D^-1 X| + y' P y), and the information on t is I_kl = 1/2 tr(P G_k P
G_l).  Parameters that the satellite lacks are unknowns too.  Source: Patterson & Thompson 1971, Biometrika 58, 545.

The covariance of the unknowns is F and what it lacks because t is estimated, 2 F (sum_kl V_kl (Q_kl - A_k F A_l)) F
with V = I^-1, A_k = X' D^-1 G_k D^-1 X and Q_kl = X' D^-1 G_k D^-1 G_l D^-1 X; errors are multiplied by the quantile of
Student's t at 1 sigma.  Sources: Kackar & Harville 1984, JASA 79, 853; Kenward & Roger 1997, Biometrics 53, 983.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtr, stdtrit

from linksweep.core.frames import MAS, Array, Flags, LinkError
from linksweep.core.tie.astrometry import kinds, with_variance
from linksweep.core.tie.problem import KEPT_NUMBERS, Problem, Solution, inverted

# Stands for a size of a jitter that is estimated, and for every kind of row that has no jitter of its own.
ESTIMATE, ALL = "estimate", "all"

QUANTITIES = {"position": (0, 1), "parallax": (2,), "motion": (3, 4)}

SATELLITE = "satellite"

# Fewer rows of a kind, or sources of the satellite, say nothing about their noise.
FEWEST = 5

# A noise is left out if less of the information on it is not on those before it as well.
DISTINCT = 0.02

# A free parameter is determined by rows whose derivatives are larger.
SMALLEST_DERIVATIVE = 1e-9


class Noise(NamedTuple):
    """Sizes of noises by label and their errors (mas, mas/yr), and the noises that cannot be told from these.

    ``lacking`` (K, K) and ``factor`` (K,) are what the covariance of the unknowns lacks, and the factors of errors.
    """

    size: dict[str, float]
    error: dict[str, float]
    left_out: list[str]
    lacking: Array
    factor: Array

    def added_to(self, problem: Problem, jitter: Mapping[str, Mapping[str, Any]]) -> Problem:
        """Return a problem with the noise in its errors, which may have further rows and other stated errors."""
        rows, star = np.zeros((5, len(problem.rows))), np.zeros((5, len(problem.satellite)))
        for label, at in noises(problem, jitter, fewest=0).items():
            (star if label.startswith(f"{SATELLITE}:") else rows)[at.T] += (self.size.get(label, 0.0) * MAS) ** 2
        noisy = with_variance(problem.satellite, star), with_variance(problem.rows, rows)
        return replace(problem, satellite=noisy[0], rows=noisy[1])

    def covariance(self, solved: Solution) -> Array:
        """Return the covariance of a solution, with the error of the noise; shape (K, K)."""
        return (solved.covariance + self.lacking * MAS**2) * np.outer(self.factor, self.factor)


class _Padded(NamedTuple):
    """S sources, padded to M differences: y (S, M), X (S, M, K), D_0 (S, M, M) and G (C, S, M, M), in mas."""

    values: Array
    design: Array
    covariance: Array
    parts: Array


class _Terms(NamedTuple):
    """-2 log likelihood, its derivatives (C,), F, A (C, K, K), Q (C, C, K, K), I (C, C) and P y (S, M)."""

    value: float
    gradient: Array
    inverse: Array
    first: Array
    second: Array
    information: Array
    residuals: Array


def noises(problem: Problem, jitter: Mapping[str, Mapping[str, Any]], fewest: int = FEWEST) -> dict[str, Flags]:
    """Return the noises that ``jitter`` asks to estimate: those of kinds of rows, and if of all, of the satellite.

    They are labelled like "five-parameter:motion", and have the parameters (N, 5) of rows, or of sources, that have
    them.  Raises LinkError where a kind has fewer rows than ``fewest``.
    """
    kind_of_row, everywhere = kinds(problem.rows), jitter.get(problem.tables[0], {}).get(ALL) == ESTIMATE
    chosen = []
    for frame, table in enumerate(problem.tables):
        of_table, asked = f"{table}:" * bool(frame), jitter.get(table, {})
        for kind in np.unique(kind_of_row[(problem.rows.frame == frame) & problem.rows.present.any(axis=0)]):
            size = asked.get(kind, asked.get(ALL, ESTIMATE if everywhere else None))
            at = (kind_of_row == kind) & (problem.rows.frame == frame)
            chosen += [(f"{of_table}{kind}", at, problem.rows.measured.T)] if size == ESTIMATE else []
    if everywhere:
        with_rows = np.isin(np.arange(len(problem.satellite)), problem.source)
        chosen.append((SATELLITE, with_rows, problem.satellite.measured.T))
    wanted: dict[str, Flags] = {}
    for kind, at, present in chosen:
        if (number := np.count_nonzero(at)) < fewest:
            rows, advice = f"rows of the kind {kind}", f"say how large it is, as in --jitter '{kind}=0.1'"
            if kind == SATELLITE:
                rows, advice = "sources", "leave out estimate, which is of the satellite too"
            raise LinkError(f"jitter estimate: it needs {fewest} {rows}, and there are {number}; {advice}")
        for quantity, which in QUANTITIES.items():
            flags = present & at[:, None] & np.isin(np.arange(5), which)
            wanted |= {f"{kind}:{quantity}": flags} if np.any(flags) else {}
    return wanted


def estimated(problem: Problem, wanted: Mapping[str, Flags]) -> Noise:
    """Return the noises of a problem; raises LinkError where the tables say nothing about any."""
    sources = _padded(problem, wanted)
    inside, of_table = np.einsum("csii->csi", sources.parts), np.einsum("sii->si", sources.covariance)
    residuals = (sources.covariance @ _terms(sources, np.zeros(len(wanted))).residuals[..., None])[..., 0]
    weights = np.sum(inside**2, axis=(1, 2))
    scale = np.sum(inside * (residuals**2 + of_table), axis=(1, 2)) / np.where(weights > 0.0, weights, 1.0)
    kept = _distinct(_terms(sources, scale).information)
    if not kept:
        raise LinkError("jitter estimate: nothing is left of the rows beside the unknowns, from which to estimate it")
    scale, sources = scale[kept], sources._replace(parts=sources.parts[kept])

    def likelihood(scaled: Array) -> tuple[float, Array]:
        terms = _terms(sources, scaled * scale)
        return terms.value, terms.gradient * scale

    from scipy.optimize import Bounds, minimize  # here: importing it takes a tenth of a link without jitter

    how: Any = {"jac": True, "bounds": Bounds(np.zeros(len(kept)), np.inf), "options": {"ftol": 1e-14, "gtol": 1e-7}}
    best: Any = minimize(likelihood, np.ones(len(kept)), **how)
    variance = best.x * scale
    terms = _terms(sources, variance)
    scatter = np.sqrt(np.diag(inverted(terms.information)))
    with np.errstate(divide="ignore"):  # where the noise may well be zero, that which is as likely as one sigma
        error = np.minimum(scatter / (2.0 * np.sqrt(variance)), np.sqrt(scatter))
    labels = [list(wanted)[k] for k in kept]
    sizes, errors = (dict(zip(labels, values.tolist(), strict=True)) for values in (np.sqrt(variance), error))
    left_out = [label for label in wanted if label not in labels]
    return Noise(sizes, errors, left_out, *_beside(terms, variance > 0.0))


def _padded(problem: Problem, wanted: Mapping[str, Flags]) -> _Padded:
    rows, star, source = problem.differences(), problem.satellite, problem.source
    order, n = np.argsort(source, kind="stable"), len(star)
    slot = np.empty_like(source)  # of a row among those of its source
    slot[order] = np.arange(len(source)) - np.searchsorted(source[order], source[order])
    most = int(slot.max()) + 1
    m = 5 * most
    if n * m**2 * (len(wanted) + 1) > KEPT_NUMBERS:
        raise LinkError(f"jitter estimate: {n} sources with up to {most} rows are too many; say how large it is")
    place = np.full((n, most), -1)
    place[source, slot] = np.arange(len(source))

    def by_source(each: Array | Flags) -> Array:
        """Return what rows have (R, 5, ...) source by source, zero where there is no row; shape (S, M, ...)."""
        whole = np.where((place >= 0).reshape(n, most, *[1] * (each.ndim - 1)), each[place], 0.0)
        return whole.reshape(n, m, *each.shape[2:])

    of_rows = rows.across(place)
    of_rows[source, slot, :, slot] = rows.covariance
    partials, present = by_source(rows.partials), by_source(rows.present)
    whole = partials @ star.covariance() @ partials.swapaxes(1, 2) / MAS**2
    whole += np.where(present[:, :, None] * present[:, None] > 0.0, of_rows.reshape(n, m, m) / MAS**2, np.eye(m))
    five = partials[..., :5]
    parts = []
    for label, at in wanted.items():
        of_star = label.startswith(f"{SATELLITE}:")
        parts.append((five * at[:, None]) @ five.swapaxes(1, 2) if of_star else by_source(at)[..., None] * np.eye(m))
    # what is left does not depend on parameters that the satellite lacks: along these there is nothing
    left, singular, _ = np.linalg.svd(five * ~star.present.T[:, None])
    gone = np.arange(m) < np.sum(singular > SMALLEST_DERIVATIVE, axis=1)[:, None]
    left = np.where(gone[:, None], 0.0, left)
    across = left.swapaxes(1, 2)
    design = across @ by_source(rows.by_frames) @ problem.unknowns.matrix(*problem.objects(star))
    values = (across @ by_source(rows.values / MAS)[..., None])[..., 0]
    return _Padded(values, design, across @ whole @ left + gone[:, None] * np.eye(m), across @ np.array(parts) @ left)


def _terms(sources: _Padded, variance: Array) -> _Terms:
    values, design, parts = sources.values, sources.design, sources.parts
    whole = sources.covariance + np.tensordot(variance, parts, axes=1)
    inverse = np.linalg.inv(whole)
    weighted, squares = inverse @ design, np.einsum("si,sij,sj->", values, inverse, values, optimize=True)
    normal, right = np.einsum("sik,sil->kl", design, weighted), np.einsum("sik,si->k", weighted, values)
    covariance = inverted(normal)
    value = np.linalg.slogdet(whole)[1].sum() + np.linalg.slogdet(normal)[1] + squares - right @ covariance @ right
    residuals = np.einsum("sij,sj->si", inverse, values - design @ (covariance @ right))
    half, inside = inverse @ parts, parts @ weighted
    first = np.einsum("sik,csil->ckl", weighted, inside)
    second = np.einsum("csik,dsil->cdkl", inside, inverse @ inside)
    turned = covariance @ first
    gradient = np.einsum("csii->c", half) - np.einsum("ckk->c", turned)
    gradient -= np.einsum("si,csij,sj->c", residuals, parts, residuals, optimize=True)
    traces = np.einsum("csij,dsji->cd", half, half) + np.einsum("ckl,dlk->cd", turned, turned)
    traces -= 2.0 * np.einsum("kl,cdlk->cd", covariance, second)
    return _Terms(float(value), gradient, covariance, first, second, 0.5 * traces, residuals)


def _distinct(information: Array) -> list[int]:
    """Return the noises on which there is information that is not on those before them."""
    kept: list[int] = []
    for k, size in enumerate(np.diag(information)):
        across = information[kept, k]
        if size > 0.0 and size - across @ np.linalg.solve(information[np.ix_(kept, kept)], across) > DISTINCT * size:
            kept.append(k)
    return kept


def _beside(terms: _Terms, positive: Flags) -> tuple[Array, Array]:
    """Return what the covariance of the unknowns lacks, and the factors of errors, for the noises above zero."""
    inverse, first, both = terms.inverse, terms.first[positive], np.ix_(positive, positive)
    scatter = np.linalg.inv(terms.information[both])
    middle = terms.second[both] - np.einsum("cij,jk,dkl->cdil", first, inverse, first)
    lacking = 2.0 * inverse @ np.einsum("cd,cdkl->kl", scatter, middle) @ inverse
    slope = np.einsum("ik,ckl,li->ci", inverse, first, inverse)
    relative = np.einsum("ci,cd,di->i", slope, scatter, slope) / np.diag(inverse) ** 2
    factor = np.asarray(stdtrit(2.0 / np.maximum(relative, 1e-9), ndtr(1.0)), dtype=np.float64)
    return np.asarray(0.5 * (lacking + lacking.T)), factor
