"""The closed form of the spin's error, averaged over a fixed set of drawn catalogues that share their sky."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.catalogue import Catalogue, Sky
from linksweep.core.catalogues import (
    COUNT,
    GALAXY_FAINT_LIMIT_MAG,
    N_GALAXIES,
    V_MAX,
    galaxies,
    quasars,
    radio_stars,
    resample,
)
from linksweep.core.constants import MAS
from linksweep.core.frames import triad
from linksweep.core.link import Weighting
from linksweep.core.missions import Curve

Kind = Literal["quasars", "galaxies", "radio-stars"]


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
    own = [c.sigma[2:] for c in catalogues if c.sigma is not None]
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
