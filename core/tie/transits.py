"""Observations of stars by a satellite that scans: a position along the scan at each passage of a CCD.

An observation is w = (da + mu_a t) sin psi + (dd + mu_d t) cos psi + F parallax + c colour, in the tangent plane of a
reference position, with t from the star's epoch and psi the position angle of the scan.  The normal equations of a star
give the parameters of its path, five or more, with a covariance: in a link they take the place of its catalogue row.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag

from linksweep.core.frames import DEGREE, Array, Flags, Indices, LinkError, Names, Texts
from linksweep.core.tie import astrometry, mistakes
from linksweep.core.tie.astrometry import FURTHER, Astrometry, Differences, bends, by_errors, differences
from linksweep.core.tie.mistakes import EXCESS, LARGER, SMALLER, Cause, Misfit, best_shift, explains, likely
from linksweep.core.tie.problem import inverted
from linksweep.core.unknowns import PARAMETERS

# The parameters of a path, and last the error of the colour in 1/nm, which is about as large as said here.
# Source: gaiasupdate 0.1.2, which solves for the sources of DR4 as Gaia did.
PATH = (*PARAMETERS, *FURTHER, "pseudocolour")
COLOUR, COLOUR_ERROR = len(PATH) - 1, 0.085e-3
# Names of models, and the parameters that a path has.
MODELS = {"5": (0, 1, 2, 3, 4), "7": (0, 1, 2, 3, 4, 5, 6), "9": tuple(range(9)), "orbit": (0, 1, 2, 3, 4, 9)}

# chi2 over its expectation below which errors are too large, and by how much that of likely causes may differ.
LOW, ALIKE = 0.1, 0.1

# Mistakes, and the factors and summands that correct them.
MISTAKES = {
    "scan angles in radians, taken for degrees": {"scan_pos_angle": (1.0 / DEGREE, 0.0)},
    "scan angles in degrees, taken for radians": {"scan_pos_angle": (DEGREE, 0.0)},
    "sine and cosine of the scan angles exchanged": {"scan_pos_angle": (-1.0, np.pi / 2.0)},
    "scan angles with reversed sign": {"scan_pos_angle": (-1.0, 0.0)},
    "scan angles off by 180 deg": {"scan_pos_angle": (1.0, np.pi)},
    "positions along the scan with reversed sign": {"centroid_pos_al": (-1.0, 0.0)},
    "parallax factors with reversed sign": {"parallax_factor_al": (-1.0, 0.0)},
}
VALUE, ERROR, NOISE = "centroid_pos_al", "centroid_pos_error_al", "agis_source_excess_noise"

Change = Mapping[str, tuple[Any, float]]


class Paths(NamedTuple):
    """The parameters `PATH` of S stars (S, 11), zero for those that their models lack, with covariance (S, 11, 11), in
    rad and years; chi2 of the observations and its degrees of freedom (S,), and the residuals (N,), rad.
    """

    values: Array
    covariance: Array
    squares: Array
    dof: Array
    residuals: Array


@dataclass(frozen=True)
class Transits:
    """N observations of S stars, sorted by ``star`` (N,).

    ``observed`` (N,) are by the name that Gaia's archive has: parallax_factor_al F, scan_pos_angle psi (from north
    through east), centroid_pos_al w, centroid_pos_error_al and in quadrature agis_source_excess_noise in rad,
    colour_factor_al c in rad nm; transit_id numbers the passages over the field of view, and relative_time_year is from
    ``epoch`` (Julian years).  ``models`` (S,) are those of `MODELS`, ``orbit`` (7, S) as in `bends`, ``origin`` (2, S)
    are the reference positions, and ``catalogue`` has the rows of the stars.
    """

    star: Indices
    observed: Mapping[str, Array]
    models: Texts
    orbit: Array
    origin: Array
    epoch: float
    names: Names
    catalogue: Astrometry

    def weights(self) -> Array:
        """Return the weight of each observation, rad^-2."""
        return np.asarray(1.0 / (self.observed[ERROR] ** 2 + self.observed[NOISE] ** 2))

    def design(self) -> Array:
        """Return the derivatives of w by the parameters `PATH`; shape (N, 11)."""
        years, angle = self.observed["relative_time_year"], self.observed["scan_pos_angle"]
        along = np.array([np.sin(angle), np.cos(angle)])
        bend = np.einsum("in,nik->kn", along, bends(years, self.orbit[:, self.star])[:, :2])
        factors = [self.observed[name] for name in ("parallax_factor_al", "colour_factor_al")]
        return np.array([*along, factors[0], *(along * years), *bend, factors[1]]).T

    def paths(self, straight: bool = False) -> Paths:
        """Return what the observations say of each star, all of them with the model "5" if ``straight``.

        Raises LinkError that names a star whose path they do not determine.
        """
        n, size = len(self.models), len(PATH)
        values, covariance, (squares, dof) = np.zeros((n, size)), np.zeros((n, size, size)), np.zeros((2, n))
        design, weights, residuals = self.design(), self.weights(), self.observed[VALUE].copy()
        first = np.searchsorted(self.star, np.arange(n + 1))
        for s in range(n):
            at, free = slice(first[s], first[s + 1]), [*MODELS["5" if straight else self.models[s]], COLOUR]
            weighted = (design[at, free] * weights[at, None]).T
            normal = weighted @ design[at, free]
            normal[-1, -1] += COLOUR_ERROR**-2
            inverse = inverted(normal, tuple(f"{PATH[k]} of {self.names[s]}" for k in free))
            values[s, free], covariance[s][np.ix_(free, free)] = inverse @ (weighted @ residuals[at]), inverse
            residuals[at] -= design[at] @ values[s]
            squares[s] = weights[at] @ residuals[at] ** 2 + (values[s, COLOUR] / COLOUR_ERROR) ** 2
            dof[s] = weighted.shape[1] + 1 - len(free)
        return Paths(values, covariance, squares, dof, residuals)

    def in_place(self, paths: Paths, table: Astrometry, rows: Indices) -> Astrometry:
        """Return a catalogue in which paths take the place of some rows (S,)."""
        error, between = by_errors(paths.covariance[:, :COLOUR, :COLOUR])
        position = astrometry.from_tangent_plane(*paths.values[:, :2].T, *self.origin)
        arrays: dict[str, Any] = {
            "values": np.concatenate([position, paths.values[:, 2:5].T]),
            "errors": error[:5],
            "epoch": np.full(len(rows), self.epoch),
            "correlations": between[astrometry.FIRST, astrometry.SECOND],
            "further": np.array([paths.values[:, 5:COLOUR].T, error[5:]]),
            "orbit": self.orbit,
            "averaged": np.zeros(len(rows)),
        }
        for name, new in arrays.items():
            arrays[name] = np.zeros((*new.shape[:-1], len(table)))
            if (before := getattr(table, name)) is not None:
                arrays[name][: len(before)] = before
            arrays[name][..., rows] = new
        return replace(table, **arrays)

    def ratios(self, change: Change) -> Array:
        """Return chi2 over its expectation of the observations of each star, and of the difference of what they say of
        a straight path from the catalogue's row, which is mostly below 1; shape (2, S), infinite where there is none.

        ``change`` are factors and summands of quantities that are changed before.
        """
        changed = {name: self.observed[name] * by + plus for name, (by, plus) in change.items()}
        trial, every = replace(self, observed={**self.observed, **changed}), np.arange(len(self.models))
        try:
            bent, straight = trial.paths(), trial.paths(straight=True)
        except LinkError:
            return np.full((2, len(every)), np.inf)
        replaced = self.in_place(straight, self.catalogue, every)
        rows = replace(astrometry.of_five(self.catalogue), apparent=np.zeros(len(every), dtype=bool))
        off = differences(replaced, rows, every)
        scale = np.maximum(straight.squares / np.maximum(straight.dof, 1.0), 1.0)
        whole = off.whole(replaced.covariance() * scale[:, None, None])
        whole[:, range(5), range(5)] += np.where(off.present, 0.0, 1.0)
        squares = np.einsum("si,si->s", off.values, np.linalg.solve(whole, off.values[..., None])[..., 0])
        if self.catalogue.further is not None:  # rows of another model are not those of a straight path
            squares *= ~np.any(self.catalogue.further[1] > 0.0, axis=0)
        return np.array([bent.squares / np.maximum(bent.dof, 1.0), squares / np.maximum(off.present.sum(axis=1), 1)])


def joint(alone: Array, rows: Differences, at: Indices, design: Array, estimate: Array, covariance: Array) -> Array:
    """Return how a link changes the parameters of a star (11,) and below it their covariance in the link (11, 11).

    ``alone`` (11, 11) is the covariance without the link, ``rows`` ``at`` are those of the star, and ``design``
    (5 F, K) are the derivatives of its parameters by the unknowns, of which there are estimate and covariance.
    """
    seen = rows.present[at].ravel()
    partials = np.pad(rows.partials[at].reshape(-1, COLOUR)[seen], ((0, 0), (0, 1)))
    by_unknowns = (rows.by_frames[at] @ design).reshape(-1, len(estimate))[seen]
    whole = block_diag(*rows.covariance[at]) + rows.across(at[None])[0].reshape(len(seen), len(seen))
    whole = whole[np.ix_(seen, seen)] + partials @ alone @ partials.T
    gain = np.linalg.solve(whole, partials @ alone).T
    moved, residual = gain @ by_unknowns, rows.values[at].ravel()[seen] - by_unknowns @ estimate
    return np.vstack([gain @ residual, alone - gain @ partials @ alone + moved @ covariance @ moved.T])


def misfit(transits: Transits) -> Misfit:
    """Return what is to be said of observations whose chi2 is not that of their errors, or of those that contradict
    the catalogue, with the likely cause: the mistake whose correction brings both down to the level of good ones.
    """
    before, causes = transits.ratios({}), []
    bad = (before.max(axis=0) > EXCESS) | (before[0] < LOW)
    if not np.any(bad):
        return Misfit()
    ratio = float(before[:, bad].max())
    for words, change in _corrections(transits, bad):
        after = transits.ratios(change)[:, bad]
        left = float(after.max())
        if after[0].min() > LOW and left < EXCESS and (ratio < EXCESS or explains(left, ratio)):
            causes.append(Cause(words, left, hides="too small" in words))  # which would hide any mistake
    said = f"chi2 of the transits of {', '.join(map(str, transits.names[bad][:5]))}"
    said += " against the satellite's rows" if ratio > EXCESS and ratio == before[1, bad].max() else ""
    said += f" is {ratio if ratio > EXCESS else before[0, bad].min():.3g} times its expectation"
    unknown = f"{mistakes.UNEXPLAINED}, whose paths --star-model and --orbits give"
    unknown = unknown if ratio > EXCESS else "errors or excess noise are too large"
    return Misfit(ratio, f"{said}; {likely(causes, ALIKE) if causes else unknown}")


def _corrections(transits: Transits, bad: Flags) -> Iterator[tuple[str, Change]]:
    """Yield mistakes and their corrections."""
    yield from MISTAKES.items()
    for factor, unit in (SMALLER | LARGER).items():
        yield f"positions along the scan, {unit}", {VALUE: (factor, 0.0)}
        yield f"positions along the scan and their errors, {unit}", {VALUE: (factor, 0.0), ERROR: (factor, 0.0)}
        if factor < 1.0 or (bad.all() and len(bad) > 1):  # errors are too small for all stars, or for none
            yield f"errors too {'small' if factor > 1.0 else 'large'}, {unit}", {ERROR: (factor, 0.0)}
    yield "excess noise, uas taken for mas", {NOISE: (1e-3, 0.0)}
    passage, time = transits.observed["transit_id"], transits.epoch + transits.observed["relative_time_year"]
    squares = np.bincount(passage, transits.weights() * transits.paths().residuals ** 2)[passage]
    worst = [np.argmax(np.where(transits.star == s, squares, -1.0)) for s in np.flatnonzero(bad)]
    words = ", ".join(f"the transit of {transits.names[transits.star[k]]} at {time[k]:.2f}" for k in worst[:5])
    yield f"{words} alone", {ERROR: (np.where(np.isin(passage, passage[worst]), 1e6, 1.0), 0.0)}
    shift = best_shift(lambda years: float(transits.ratios({"relative_time_year": (1.0, years)})[1, bad].sum()))
    words = f"times {abs(shift):.3g} years too {'early' if shift > 0.0 else 'late'}, or positions of another epoch"
    yield words, {"relative_time_year": (1.0, shift)}
