"""Calibration of the mission curves: the constants that make the closed-form link give the paper's numbers.

``python -m linksweep.core.missions.calibrate`` refits them, in ten seconds, and prints constants and residuals as JSON.

The paper says which functions it fitted to the missions' accuracy (two exponentials for AMEX, one for GAIA) but prints
no constants.  It prints the link errors sigma(omega) that follow from them, so the constants are inferred from these:
each printed number is compared with its closed form, averaged over a fixed set of drawn catalogues.  The seeds are
fixed, so the model is a smooth function of the constants (common random numbers).
"""

import csv
import itertools
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, Literal

import numpy as np
from scipy.optimize import NonlinearConstraint, least_squares, minimize

from linksweep.core.catalogues import (
    COUNT,
    GALAXY_FAINT_LIMIT_MAG,
    N_GALAXIES,
    V_MAX,
    Catalogue,
    Sky,
    galaxies,
    quasars,
    radio_stars,
    resample,
)
from linksweep.core.frames import MAS, Array, triad
from linksweep.core.link import Weighting
from linksweep.core.missions import AMEX_PM, GAIA_PM, Curve, Exponentials

Kind = Literal["quasars", "galaxies", "radio-stars"]
Model = Literal["amex", "gaia"]

PAPER_MC_ERROR = 1.0 / np.sqrt(2.0 * 3.0 * 10_000)
"""Relative Monte-Carlo error of a printed number: 10 000 realisations of 3 components (paper, Sect. 5.1), 0.4 %."""

MODEL_ERROR = 0.03
"""Relative error of the model itself: one exponential for GAIA, smooth counts for a catalogue that was drawn once.

With it chi2 is about one per degree of freedom for GAIA; without it the faint cells, whose rounding errors are the
smallest, decide alone and the bright GAIA cells are off by 11 %.
"""

LIMITS: dict[Model, dict[Kind, tuple[float, float]]] = {
    "amex": {"quasars": (0.0, 0.013), "galaxies": (0.0, 0.02), "radio-stars": (0.055, 0.0014)},
    "gaia": {"quasars": (0.057, 0.0)},
}
"""How far a number may be off, relative or in mas/yr, whichever is more.

Stricter than what the project promises for the paper's tables (Table 1: AMEX 0.02 mas/yr, GAIA 7 %; galaxies 0.02
mas/yr; Table 2: 6 % or 0.0015 mas/yr), to leave room for a simulation's own error.
"""

CONSTANTS: dict[Model, tuple[str, ...]] = {
    "amex": ("amplitude_bright", "slope_bright", "amplitude_faint", "slope_faint"),
    "gaia": ("amplitude", "slope"),
}
"""The constants of each curve, amplitudes in mas/yr and slopes in 1/mag."""

IN_CODE: dict[Model, Exponentials] = {"amex": AMEX_PM, "gaia": GAIA_PM}
"""The curves that the missions use."""


@dataclass(frozen=True)
class Skies:
    """C nested catalogues of N objects; the first ``counts[k]`` objects of each are a catalogue of their own.

    ``v_mag`` (C, N); ``sigma_reference_mas_yr`` (C, D, N) and ``geometry`` (C, D, 6, N), the upper triangles of q q^T
    and p p^T by which pmra and pmdec add to the normal matrix of the spin.  D = 2, or 1 where both coordinates have the
    same error and their sum is enough.
    """

    v_mag: Array
    sigma_reference_mas_yr: Array
    geometry: Array
    counts: tuple[int, ...]


def draw_skies(kind: Kind, n_cat: int, seed: int, faintest: float = 20.0) -> Skies:
    """Return ``n_cat`` isotropic catalogues of a kind as the experiment draws them: quasars down to V = ``faintest``,
    the galaxies, or up to 100 radio stars drawn with replacement from the eleven.
    """
    rng = np.random.default_rng(seed)
    sky = Sky()
    if kind == "quasars":
        counts = tuple(int(n) for n in COUNT[faintest >= V_MAX])
        catalogues = [quasars(rng, faintest, sky) for _ in range(n_cat)]
    elif kind == "galaxies":
        counts = (N_GALAXIES,)
        catalogues = [galaxies(rng, N_GALAXIES, GALAXY_FAINT_LIMIT_MAG, sky) for _ in range(n_cat)]
    else:
        counts = tuple(range(10, 110, 10))
        catalogues = [resample(rng, radio_stars(), counts[-1], sky) for _ in range(n_cat)]
    return _skies(catalogues, counts)


def spin_variance(
    skies: Skies, curve: Curve, weighting: Weighting = "inverse-variance", reference_error_scale: float = 1.0
) -> Array:
    """Return the closed-form variance of the spin in (mas/yr)^2, mean of its three components; shape (counts, C).

    It is the mean diagonal of (A^T W A)^-1, or of its sandwich for equal weights.  The terms of the orientation are
    left out: they add less than 1e-5 of the spin's error here.
    Source: Metz & Geffert 2004, Eqs. 10-12; docs/science.md.
    """
    satellite = curve(skies.v_mag)[:, None, :]
    variance = np.square(reference_error_scale * skies.sigma_reference_mas_yr) + np.square(satellite)
    if weighting == "inverse-variance":
        covariance = np.linalg.inv(_normal(skies, 1.0 / variance))
    else:
        inverse = np.linalg.inv(_normal(skies, np.ones_like(variance)))
        covariance = inverse @ _normal(skies, variance) @ inverse
    return np.asarray(np.trace(covariance, axis1=-2, axis2=-1) / 3.0)


def _skies(catalogues: Sequence[Catalogue], counts: tuple[int, ...]) -> Skies:
    v_mag, ra, dec = (np.stack([getattr(c, name) for c in catalogues]) for name in ("v_mag", "ra", "dec"))
    own = [c.own.sigma[:, 2:].T for c in catalogues if c.own is not None]
    if own:
        return Skies(v_mag, np.stack(own) / MAS, _geometry(ra, dec), counts)
    return Skies(v_mag, np.zeros_like(v_mag)[:, None], _geometry(ra, dec).sum(axis=1, keepdims=True), counts)


_ROW, _COLUMN = np.triu_indices(3)
_SQUARE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def _geometry(ra: Array, dec: Array) -> Array:
    """Return the upper triangles of q q^T (of pmra) and p p^T (of pmdec); shape (C, 2, 6, N)."""
    p, q, _ = triad(ra, dec)
    return np.stack([np.stack([e[i] * e[j] for i, j in zip(_ROW, _COLUMN, strict=True)], axis=1) for e in (q, p)], 1)


def _normal(skies: Skies, weight: Array) -> Array:
    """Return sum of weight x geometry over the first counts[k] objects; shape (counts, C, 3, 3)."""
    edges = itertools.pairwise((0, *skies.counts))
    steps = [np.einsum("cdn,cdkn->ck", weight[..., low:high], skies.geometry[..., low:high]) for low, high in edges]
    return np.asarray(np.cumsum(steps, axis=0)[..., _SQUARE])


@dataclass(frozen=True)
class PublishedSigma:
    """A printed sigma(omega) in mas/yr, half a unit of its last digit, and the sky it belongs to."""

    kind: Kind
    n_obj: int
    sigma_mas_yr: float
    rounding_mas_yr: float
    reference_error_scale: float = 1.0


@dataclass(frozen=True)
class Fit:
    """A fitted curve: constants (P,) in the order of `CONSTANTS`, and the covariance (P, P) of their logarithms, scaled
    by chi2/dof where that is above one.

    ``sigma_mas_yr`` (M,) are the model's values of the published numbers and ``relative_error`` (M,) the errors that
    weighed them.
    """

    model: Model
    weighting: Weighting
    constants: Array
    log_covariance: Array
    sigma_mas_yr: Array
    relative_error: Array
    chi2: float
    dof: int

    @property
    def standard_error(self) -> Array:
        """Standard errors of the constants; shape (P,)."""
        return np.asarray(self.constants * np.sqrt(np.diag(self.log_covariance)))

    @property
    def curve(self) -> Exponentials:
        """The fitted sigma_mu(V) in mas/yr."""
        return curve_of(self.model, self.constants)

    def distance(self, curve: Exponentials) -> float:
        """Return how far a curve's constants are from the fitted ones in the metric of the covariance, squared.

        For constants from another sample of the same data about P is expected.
        """
        step = np.log(constants_of(curve) / self.constants)
        return float(step @ np.linalg.solve(self.log_covariance, step))


def curve_of(model: Model, constants: Array) -> Exponentials:
    """Return sigma_mu(V) in mas/yr of constants in the order of `CONSTANTS`; pivots at V = 9 and 15, or 15.

    Source: Metz & Geffert 2004, Sect. 5 (two exponentials for AMEX, a single one for GAIA).
    """
    pivots = (9.0, 15.0) if model == "amex" else (15.0,)
    pairs = np.reshape(constants, (-1, 2)).tolist()
    return Exponentials(tuple((a, slope, pivot) for (a, slope), pivot in zip(pairs, pivots, strict=True)))


def constants_of(curve: Exponentials) -> Array:
    """Return the constants of a curve in the order of `CONSTANTS`."""
    return np.array([constant for a, slope, _ in curve.terms for constant in (a, slope)])


def all_skies(model: Model, n_cat: int = 200) -> dict[Kind, Skies]:
    """Return the fixed catalogues that a model's numbers are compared with, always the same for one ``n_cat``.

    GAIA's quasars go to V = 20.  AMEX needs quasars only to V = 17, but more catalogues, most of all of radio stars,
    because few stars carry the weight.  With the default ``n_cat`` every number has an error below 1 %.
    """
    if model == "gaia":
        return {"quasars": draw_skies("quasars", n_cat // 2, seed=4)}
    return {
        "quasars": draw_skies("quasars", 2 * n_cat, seed=1, faintest=17.0),
        "galaxies": draw_skies("galaxies", 2 * n_cat, seed=2),
        "radio-stars": draw_skies("radio-stars", 10 * n_cat, seed=3),
    }


def published_model(
    numbers: Sequence[PublishedSigma], skies: dict[Kind, Skies], curve: Curve, weighting: Weighting
) -> tuple[Array, Array]:
    """Return what the closed form gives for each published number, RMS over the catalogues in mas/yr, and the relative
    error of that for the finite number of catalogues; both of shape (M,).
    """
    known: dict[tuple[Kind, float], Array] = {}
    sigma, error = np.empty(len(numbers)), np.empty(len(numbers))
    for i, number in enumerate(numbers):
        key = (number.kind, number.reference_error_scale)
        if key not in known:
            known[key] = spin_variance(skies[number.kind], curve, weighting, number.reference_error_scale)
        each = known[key][skies[number.kind].counts.index(number.n_obj)]
        sigma[i] = np.sqrt(each.mean())
        error[i] = 0.5 * each.std(ddof=1) / each.mean() / np.sqrt(len(each))
    return sigma, error


def fit(
    model: Model, numbers: Sequence[PublishedSigma], skies: dict[Kind, Skies], weighting: Weighting = "inverse-variance"
) -> Fit:
    """Fit a curve's constants to published numbers by least squares of log sigma in log constants.

    Each number weighs by its rounding error (half a unit of the last digit over sqrt 3), the paper's Monte-Carlo error,
    that of ``skies`` and `MODEL_ERROR`, in quadrature.  The fit starts at the constants in the code.
    """
    published = np.array([number.sigma_mas_yr for number in numbers])
    rounding = np.array([number.rounding_mas_yr for number in numbers]) / published / np.sqrt(3.0)
    start = np.log(constants_of(IN_CODE[model]))
    _, own = published_model(numbers, skies, IN_CODE[model], weighting)
    relative_error = np.sqrt(rounding**2 + PAPER_MC_ERROR**2 + own**2 + MODEL_ERROR**2)

    def misfit(log_constants: Array) -> Array:
        sigma, _ = published_model(numbers, skies, curve_of(model, np.exp(log_constants)), weighting)
        return np.asarray(np.log(sigma / published) / relative_error)

    found = least_squares(
        misfit, start, method="trf", bounds=(start - 6.0, start + 6.0), x_scale=0.1, xtol=1e-6, ftol=1e-6
    )
    constants = np.exp(found.x)
    chi2, dof = float(found.fun @ found.fun), len(numbers) - len(start)
    jacobian = np.asarray(found.jac, dtype=np.float64)
    log_covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian) * max(1.0, chi2 / dof), dtype=np.float64)
    sigma, _ = published_model(numbers, skies, curve_of(model, constants), weighting)
    return Fit(model, weighting, constants, log_covariance, sigma, relative_error, chi2, dof)


def constrained(found: Fit, numbers: Sequence[PublishedSigma], skies: dict[Kind, Skies]) -> Array:
    """Return the constants of smallest chi2 at which no number is off by more than its `LIMITS` entry; shape (P,).

    The numbers leave a long valley of constants that fit about equally well; the free fit in it misses one number (ten
    radio stars with halved errors) by 7 %.  Raises ValueError where no constants meet the limits.
    """
    published = np.array([number.sigma_mas_yr for number in numbers])
    allowed = [(n.sigma_mas_yr, *LIMITS[found.model][n.kind]) for n in numbers]
    limits = np.array([max(relative * value, absolute) for value, relative, absolute in allowed])

    def sigma(log_constants: Array) -> Array:
        return published_model(numbers, skies, curve_of(found.model, np.exp(log_constants)), found.weighting)[0]

    solution = minimize(  # type: ignore[call-overload]  # the stubs want arrays that are known to have one dimension
        lambda x: chi2_of(numbers, sigma(x), found.relative_error),
        np.log(constants_of(IN_CODE[found.model])),
        method="SLSQP",
        constraints=[NonlinearConstraint(lambda x: np.abs(sigma(x) - published) / limits, 0.0, 1.0)],
        options={"maxiter": 200, "ftol": 1e-5},
    )
    if not solution.success:
        raise ValueError(f"no constants of {found.model!r} meet the limits: {solution.message}")
    return np.asarray(np.exp(solution.x))


def chi2_of(numbers: Sequence[PublishedSigma], sigma_mas_yr: Array, relative_error: Array) -> float:
    """Return the sum of squared log residuals in units of their errors."""
    published = np.array([number.sigma_mas_yr for number in numbers])
    return float(np.sum((np.log(sigma_mas_yr / published) / relative_error) ** 2))


def published_numbers(model: Model) -> dict[str, PublishedSigma]:
    """Return a model's numbers from the paper, as printed, each with a label as key: 28 for amex, 13 for gaia."""
    numbers = {
        f"quasars to V = {row['v_max']}": _number("quasars", int(row["n_obj"]), row["sigma_spin"])
        for row in _rows("table1_quasars.csv")
        if row["model"] == model and row["sigma_spin"]
    }
    if model == "amex":
        for row in _rows("galaxies.csv"):
            numbers[f"{N_GALAXIES} galaxies"] = _number("galaxies", N_GALAXIES, row["sigma_spin"])
        for row in _rows("table2_radio_stars.csv"):
            scale = float(row["reference_error_scale"])
            label = f"{row['n_obj']} radio stars" + ("" if scale == 1.0 else f", VLBI errors x {scale:g}")
            numbers[label] = _number("radio-stars", int(row["n_obj"]), row["sigma_spin"], scale)
    return numbers


def _rows(name: str) -> list[dict[str, str]]:
    text = (resources.files("linksweep") / "sweeps" / "published" / name).read_text(encoding="utf-8")
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


def _number(kind: Kind, n_obj: int, printed: str, reference_error_scale: float = 1.0) -> PublishedSigma:
    decimals = len(printed.partition(".")[2])
    return PublishedSigma(kind, n_obj, float(printed), 0.5 * 10.0**-decimals, reference_error_scale)


def calibration(model: Model, n_cat: int = 200) -> dict[str, Any]:
    """Return a curve's constants, their uncertainties and all residuals, as values for JSON.

    Constants are ``fitted`` freely with a ``standard_error``, ``chosen`` within `LIMITS`, ``in_code``, and
    ``equal_weights``, fitted to the quasars alone under the hypothesis that the paper weighted all objects equally.
    Residuals are relative: value / published - 1.  With equal weights no curve improves on a ``perfect_satellite``,
    which measures radio stars without errors.  ``n_cat`` sets how many catalogues the closed form is averaged over.
    """
    numbers, skies, code = published_numbers(model), all_skies(model, n_cat), IN_CODE[model]
    printed = list(numbers.values())
    published = np.array([number.sigma_mas_yr for number in printed])
    free = fit(model, printed, skies)
    equal = fit(model, [number for number in printed if number.kind == "quasars"], skies, "equal")
    in_code = published_model(printed, skies, code, "inverse-variance")[0]
    sigmas = {
        "fitted": free.sigma_mas_yr,
        "in_code": in_code,
        "equal_weights": published_model(printed, skies, equal.curve, "equal")[0],
    }
    if stars := [number for number in printed if number.kind == "radio-stars"]:
        sigmas["perfect_satellite"] = np.full(len(printed), np.nan)
        nothing = curve_of(model, 0.0 * free.constants)
        is_star = np.array([number in stars for number in printed])
        sigmas["perfect_satellite"][is_star] = published_model(stars, skies, nothing, "equal")[0]
    columns = {
        "fitted": free.constants,
        "standard_error": free.standard_error,
        "chosen": constrained(free, printed, skies),
        "in_code": constants_of(code),
        "equal_weights": equal.constants,
    }
    return {
        "constants": {
            name: {column: float(values[i]) for column, values in columns.items()}
            for i, name in enumerate(CONSTANTS[model])
        },
        "chi2": free.chi2,
        "dof": free.dof,
        "in_code_chi2": chi2_of(printed, in_code, free.relative_error),
        "in_code_distance2": free.distance(code),
        "residuals": {
            label: {"published": number.sigma_mas_yr}
            | {name: float(values[i] / published[i] - 1.0) for name, values in sigmas.items() if np.isfinite(values[i])}
            for i, (label, number) in enumerate(numbers.items())
        },
    }


if __name__ == "__main__":
    json.dump({model: calibration(model) for model in CONSTANTS}, sys.stdout, indent=1)
    print()
