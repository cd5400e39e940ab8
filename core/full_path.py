"""The link while the reference has errors too: its design differs from one realisation to the next."""

import numpy as np
from numpy.typing import NDArray

from core.link import POLE_LIMIT, pole_error, solve_normal
from core.noise import Tile
from core.normal_sums import NormalSums, Seen
from core.setup import Setup

Array = NDArray[np.float64]

ELEMENTS = 8192
"""Objects x realisations in one array operation, so that its arrays of 64 KiB stay near the core."""

SMALL_ANGLE = 1e-3
"""Rad below which two terms of the series of sin x and 1 - cos x are exact to rounding: x^5/120 and x^6/720 are below
1e-17.
"""

FARTHEST = 10.0
"""Sigma; a normal deviate beyond has a probability of 1e-23."""


class FullPath:
    """The link of a catalogue whose reference has errors; arrays (N, 1) and (N, 4, 1) stand beside (N, 4, rows)."""

    def __init__(self, setup: Setup) -> None:
        catalogue = setup.catalogue
        ra, dec = catalogue.ra[:, None], catalogue.dec[:, None]
        self.setup = setup
        self.ra, self.dec = ra, dec
        self.sin_ra, self.cos_ra, self.sin_dec, self.cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
        self.pmra, self.pmdec = catalogue.pmra[:, None], catalogue.pmdec[:, None]
        self.differences = setup.differences[..., None]
        self.reference_sigma, self.satellite_sigma = setup.reference.sigma[..., None], setup.satellite.sigma[..., None]
        self.small = FARTHEST * setup.reference.sigma[:, :2].max(axis=1) < SMALL_ANGLE * self.cos_dec[:, 0]
        inverse_variance = setup.sigma[..., None] ** -2.0
        equal = setup.scenario.weighting == "equal"
        # the weights of the solution, then those of chi2 where they are others
        self.weights = [np.ones_like(inverse_variance), inverse_variance] if equal else [inverse_variance]

    def begin(self, rows: int) -> "FullSums":
        """Return empty sums of ``rows`` realisations."""
        return FullSums(self, rows)


class FullSums:
    """Normal equations of the objects met so far, for the realisations of one chunk."""

    def __init__(self, path: FullPath, rows: int) -> None:
        scenario, n_obj = path.setup.scenario, len(path.ra)
        self.path = path
        self.objects = min(max(1, ELEMENTS // rows), n_obj)
        self.squares = 0.0
        self.sums = [NormalSums(self.objects, rows, scenario.corrections, scenario.solve_glide) for _ in path.weights]

    def add(self, satellite: Tile | None, reference: Tile | None) -> None:
        """Add the objects of a tile, the same on both sides; a side without errors may have none."""
        n_obj = len(self.path.ra)
        if reference is None:
            return
        for first in range(0, len(reference.of(n_obj)), self.objects):
            inside = slice(first, first + self.objects)
            self._add(
                reference.start + first,
                reference.of(n_obj)[inside],
                satellite.of(n_obj)[inside] if satellite is not None and self.path.setup.satellite else None,
            )

    def solved(self) -> tuple[Array, float]:
        """Return estimate - truth of each realisation, (K, rows), and the sum of chi2."""
        normal, right = self.sums[0].equations()
        error = solve_normal(normal, right)
        normal, right = self.sums[-1].equations()
        chi2 = self.squares + np.sum(error * (np.einsum("klr,lr->kr", normal, error) - 2.0 * right))
        return error, float(chi2)

    def _add(self, start: int, reference: Array, satellite: Array | None) -> None:
        path, setup = self.path, self.path.setup
        part = slice(start, start + len(reference))
        shift = setup.reference.standardised(reference, start) * path.reference_sigma[part]
        misclosure = shift + path.differences[part]
        if satellite is not None:
            misclosure -= setup.satellite.standardised(satellite, start) * path.satellite_sigma[part]
        seen = self._seen(part, shift)
        self._subtract_truth(seen, misclosure)
        for sums, weights in zip(self.sums, path.weights, strict=True):
            weighted = misclosure * weights[part]
            sums.add(seen, weights[part], weighted)
        self.squares += float(np.vdot(weighted, misclosure))  # the last weights are those of chi2

    def _seen(self, part: slice, shift: Array) -> Seen:
        path = self.path
        d_ra, d_dec = shift[:, 0] / path.cos_dec[part], shift[:, 1]
        if path.small[part].all():
            s, c = _turned(path.sin_ra[part], path.cos_ra[part], d_ra)
            sin_dec, cos_dec = _turned(path.sin_dec[part], path.cos_dec[part], d_dec)
        else:
            ra, dec = path.ra[part] + d_ra, path.dec[part] + d_dec
            s, c, sin_dec, cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
        if cos_dec.min() < POLE_LIMIT:
            at = tuple(np.argwhere(cos_dec < POLE_LIMIT)[0])
            raise pole_error(part.start + int(at[0]), float(path.dec[part][at[0], 0] + d_dec[at]))
        pmra, pmdec = path.pmra[part] + shift[:, 2], path.pmdec[part] + shift[:, 3]
        return Seen(s, c, sin_dec, cos_dec, pmra, pmdec, pmra / cos_dec, pmdec / cos_dec)

    def _subtract_truth(self, seen: Seen, misclosure: Array) -> None:
        """Subtract A truth, A the noisy design, so that the solution is estimate - truth."""
        scenario, truth = self.path.setup.scenario, self.path.setup.truth
        ra, dec, pmra, pmdec = (misclosure[:, k] for k in range(4))
        if scenario.corrections:
            turn = seen.c * truth[0] + seen.s * truth[1]  # eta.epsilon cos dec
            pmra += seen.pmdec_turn * turn
            pmdec -= seen.pmra_turn * turn
        _subtract_field(ra, dec, seen, truth[:3])
        _subtract_field(pmra, pmdec, seen, truth[3:6])
        if scenario.solve_glide:  # g adds p.g and q.g
            along_p, along_q = np.zeros_like(pmra), np.zeros_like(pmra)
            _subtract_field(along_q, along_p, seen, truth[6:])
            pmra -= along_p
            pmdec += along_q


def _subtract_field(along_q: Array, along_p: Array, seen: Seen, vector: Array) -> None:
    """Subtract q.vector from the one and -p.vector from the other, in place."""
    x, y, z = vector
    inward = (seen.c * x + seen.s * y) * seen.sin_dec
    inward -= seen.cos_dec * z
    along_q += inward
    along_p += seen.c * y - seen.s * x


def _turned(sin: Array, cos: Array, angle: Array) -> tuple[Array, Array]:
    """Return sin and cos of the sum of an angle and one below `SMALL_ANGLE`, by the addition theorem."""
    square = angle * angle
    minus = square * (1.0 / 24.0)
    minus -= 0.5
    minus *= square  # cos - 1
    square *= -1.0 / 6.0
    square += 1.0
    square *= angle  # sin
    return sin + (sin * minus + cos * square), cos + (cos * minus - sin * square)
