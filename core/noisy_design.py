"""The link while the reference has errors too: its design differs from one realisation to the next."""

import numpy as np

from core.arrays import Array
from core.design import GLIDE, ORIENTATION, SPIN
from core.link import POLE_LIMIT, hold, pole_error, solve_normal
from core.noise import Tile
from core.normal_equations import NormalSums, Seen
from core.prepared import Setup
from core.zonal import DrawnField

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
        counted = setup.counted[:, None]
        inverse_variance *= counted
        equal = setup.scenario.weighting == "equal"
        # the weights of the solution, then those of chi2 where they are others
        self.weights = [np.ones_like(inverse_variance) * counted, inverse_variance] if equal else [inverse_variance]

    def begin(self, rows: int, field: DrawnField | None = None) -> "FullSums":
        """Return empty sums of ``rows`` realisations, of which the satellite's zonal errors are drawn."""
        return FullSums(self, rows, field)


class FullSums:
    """Normal equations of the objects met so far, for the realisations of one chunk."""

    def __init__(self, path: FullPath, rows: int, field: DrawnField | None = None) -> None:
        scenario, n_obj = path.setup.scenario, len(path.ra)
        self.path, self.field = path, field
        self.objects = min(max(1, ELEMENTS // rows), n_obj)
        self.squares = 0.0
        # written to again and again: temporary arrays would cost more than the arithmetic
        self.errors = np.empty((3, self.objects, 4, rows))
        self.seen = np.empty((len(Seen._fields), self.objects, rows))
        self.scratch = np.empty((3, self.objects, rows))
        # an orientation that is held at its true value has no derivatives
        turns = scenario.corrections and path.setup.measured[0]
        self.sums = [NormalSums(self.objects, rows, turns, scenario.solve_glide) for _ in path.weights]

    def add(self, satellite: Tile | None, reference: Tile | None) -> None:
        """Add the objects of a tile, the same on both sides; a side without errors may have none."""
        n_obj = len(self.path.ra)
        if reference is None:
            return
        for first in range(0, len(reference.head(n_obj)), self.objects):
            inside = slice(first, first + self.objects)
            self._add(
                reference.start + first,
                reference.head(n_obj)[inside],
                satellite.head(n_obj)[inside] if satellite is not None and self.path.setup.satellite else None,
            )

    def solved(self) -> tuple[Array, float]:
        """Return estimate - truth of each realisation, (K, rows), and the sum of chi2."""
        normal, right = self.sums[0].equations()
        error = solve_normal(hold(normal, self.path.setup.held), right)
        normal, right = self.sums[-1].equations()
        chi2 = self.squares + np.sum(error * (np.einsum("klr,lr->kr", normal, error) - 2.0 * right))
        return error, float(chi2)

    def _add(self, start: int, reference: Array, satellite: Array | None) -> None:
        path, setup = self.path, self.path.setup
        part = slice(start, start + len(reference))
        shift, misclosure, weighted = self.errors[:, : len(reference)]
        np.multiply(setup.reference.standardised(reference, start), path.reference_sigma[part], out=shift)
        np.add(shift, path.differences[part], out=misclosure)
        if satellite is not None:
            noise = setup.satellite.standardised(satellite, start)
            misclosure -= np.multiply(noise, path.satellite_sigma[part], out=weighted)
        if self.field is not None:
            misclosure -= self.field.values(part)
        seen = self._seen(part, shift)
        self._subtract_truth(seen, misclosure)
        for sums, weights in zip(self.sums, path.weights, strict=True):
            sums.add(seen, weights[part], np.multiply(misclosure, weights[part], out=weighted))
        self.squares += float(np.vdot(weighted, misclosure))  # the last weights are those of chi2

    def _seen(self, part: slice, shift: Array) -> Seen:
        path, seen, scratch = self.path, Seen(*self.seen[:, : len(shift)]), self.scratch[:, : len(shift)]
        d_ra, d_dec = np.divide(shift[:, 0], path.cos_dec[part], out=scratch[0]), shift[:, 1]
        if path.small[part].all():
            _turn(path.sin_ra[part], path.cos_ra[part], d_ra, scratch[1:], seen.s, seen.c)
            _turn(path.sin_dec[part], path.cos_dec[part], d_dec, scratch[1:], seen.sin_dec, seen.cos_dec)
        else:
            ra, dec = path.ra[part] + d_ra, path.dec[part] + d_dec
            np.sin(ra, out=seen.s)
            np.cos(ra, out=seen.c)
            np.sin(dec, out=seen.sin_dec)
            np.cos(dec, out=seen.cos_dec)
        if seen.cos_dec.min() < POLE_LIMIT:
            at = tuple(np.argwhere(seen.cos_dec < POLE_LIMIT)[0])
            raise pole_error(part.start + int(at[0]), float(path.dec[part][at[0], 0] + d_dec[at]))
        np.add(path.pmra[part], shift[:, 2], out=seen.pmra)
        np.add(path.pmdec[part], shift[:, 3], out=seen.pmdec)
        np.divide(seen.pmra, seen.cos_dec, out=seen.pmra_turn)
        np.divide(seen.pmdec, seen.cos_dec, out=seen.pmdec_turn)
        return seen

    def _subtract_truth(self, seen: Seen, misclosure: Array) -> None:
        """Subtract A truth, A the noisy design, so that the solution is estimate - truth."""
        scenario, truth = self.path.setup.scenario, self.path.setup.truth
        turn, work = self.scratch[:2, : len(misclosure)]
        ra, dec, pmra, pmdec = (misclosure[:, k] for k in range(4))
        if scenario.corrections:
            np.multiply(seen.c, truth[0], out=turn)
            turn += np.multiply(seen.s, truth[1], out=work)  # eta.epsilon cos dec
            pmra += np.multiply(seen.pmdec_turn, turn, out=work)
            pmdec -= np.multiply(seen.pmra_turn, turn, out=work)
        self._add_field(ra, dec, seen, -truth[ORIENTATION])
        self._add_field(pmra, pmdec, seen, -truth[SPIN])
        if scenario.solve_glide:  # g adds p.g and q.g
            along_p = np.zeros_like(pmra)
            self._add_field(pmdec, along_p, seen, -truth[GLIDE])
            pmra -= along_p

    def _add_field(self, along_q: Array, along_p: Array, seen: Seen, vector: Array) -> None:
        """Add q.vector to the one and -p.vector to the other, in place."""
        x, y, z = vector
        field, work = self.scratch[:2, : len(along_q)]
        np.multiply(seen.c, -x, out=field)
        field -= np.multiply(seen.s, y, out=work)
        field *= seen.sin_dec
        along_q += field
        along_q += np.multiply(seen.cos_dec, z, out=work)
        along_p += np.multiply(seen.s, x, out=work)
        along_p -= np.multiply(seen.c, y, out=work)


def _turn(sin: Array, cos: Array, angle: Array, scratch: Array, sin_out: Array, cos_out: Array) -> None:
    """Write sin and cos of the sum of an angle and one below `SMALL_ANGLE`, by the addition theorem."""
    small_sin, minus = scratch  # sin of the small angle, and its cos - 1
    np.multiply(angle, angle, out=small_sin)
    np.multiply(small_sin, 1.0 / 24.0, out=minus)
    minus -= 0.5
    minus *= small_sin
    small_sin *= -1.0 / 6.0
    small_sin += 1.0
    small_sin *= angle
    np.multiply(sin, minus, out=sin_out)
    np.multiply(cos, small_sin, out=cos_out)
    sin_out += cos_out
    sin_out += sin
    np.multiply(cos, minus, out=cos_out)
    small_sin *= sin
    cos_out -= small_sin
    cos_out += cos
