"""The link while the reference has errors too: its design differs from one realisation to the next."""

import numpy as np

from linksweep.core.arrays import Array, product_sum
from linksweep.core.design import GLIDE, ORIENTATION, SPIN
from linksweep.core.link import POLE_LIMIT, UnlikeError, hold, pole_error, solve_normal
from linksweep.core.noise import Tile
from linksweep.core.normal_equations import NormalSums, Seen
from linksweep.core.prepared import Setup
from linksweep.core.systematics import DrawnField

ELEMENTS = 8192
"""Objects x realisations in one array operation, so that its arrays of 64 KiB stay near the core."""

SMALL_ANGLE = 1e-3
"""Angle (rad) below which two terms of the series of sin x and 1 - cos x are exact to rounding: x^5/120 and x^6/720 are
below 1e-17.
"""

FARTHEST = 10.0
"""Largest normal deviate that is expected, in sigma; one beyond has a probability of 1e-23."""


class FullPath:
    """The link of a catalogue, or a stack of them, whose reference has errors; its arrays (..., N, 1) and (..., N, 4,
    1) broadcast against (..., N, 4, rows).
    """

    def __init__(self, setup: Setup) -> None:
        catalogue, stacked = setup.catalogue, setup.stacked
        ra, dec = stacked(catalogue.ra)[..., None], stacked(catalogue.dec)[..., None]
        self.setup = setup
        self.ra, self.dec = ra, dec
        self.sin_ra, self.cos_ra, self.sin_dec, self.cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
        self.pmra, self.pmdec = stacked(catalogue.pmra)[..., None], stacked(catalogue.pmdec)[..., None]
        self.differences = stacked(setup.differences)[..., None]
        reference_sigma = stacked(setup.reference.sigma)
        self.reference_sigma = reference_sigma[..., None]
        self.satellite_sigma = stacked(setup.satellite.sigma)[..., None]
        self.small = FARTHEST * reference_sigma[..., :2].max(axis=-1) < SMALL_ANGLE * self.cos_dec[..., 0]
        if setup.stack and not self.small.all():
            raise UnlikeError("some of the catalogues have objects whose errors are no small angles")
        inverse_variance = stacked(setup.sigma)[..., None] ** -2.0
        counted = setup.counted[:, None]
        inverse_variance *= counted
        equal = setup.scenario.weighting == "equal"
        # the weights of the solution, then those of chi2 where they differ
        self.weights = [np.ones_like(inverse_variance) * counted, inverse_variance] if equal else [inverse_variance]

    def begin(self, rows: int, field: DrawnField | None = None) -> "FullSums":
        """Return empty sums of ``rows`` realisations, whose zonal errors are drawn already (``field``)."""
        return FullSums(self, rows, field)


class FullSums:
    """Normal equations of the objects met so far, for the realisations of one chunk."""

    def __init__(self, path: FullPath, rows: int, field: DrawnField | None = None) -> None:
        scenario, n_obj, stack = path.setup.scenario, path.setup.n_obj, path.setup.stack
        self.path, self.field = path, field
        self.objects = min(max(1, ELEMENTS // rows), n_obj)
        self.squares = np.zeros(stack)
        # reused for all objects: temporary arrays would cost more than the arithmetic
        self.errors = np.empty((3, *stack, self.objects, 4, rows))
        self.seen = np.empty((len(Seen._fields), *stack, self.objects, rows))
        self.scratch = np.empty((3, *stack, self.objects, rows))
        # an orientation that is held at its true value has no derivatives
        turns = scenario.corrections and path.setup.measured[0]
        self.sums = [NormalSums(self.objects, rows, turns, scenario.solve_glide, stack) for _ in path.weights]

    def add(self, satellite: Tile | None, reference: Tile | None) -> None:
        """Add the objects of a tile, the same on both sides; None for a side without errors."""
        n_obj = self.path.setup.n_obj
        if reference is None:
            return
        for first in range(0, reference.head(n_obj).shape[-3], self.objects):
            inside = slice(first, first + self.objects)
            self._add(
                reference.start + first,
                reference.head(n_obj)[..., inside, :, :],
                satellite.head(n_obj)[..., inside, :, :]
                if satellite is not None and self.path.setup.satellite
                else None,
            )

    def solved(self) -> tuple[Array, Array]:
        """Return estimate - truth of each realisation, (..., K, rows), and the sum of chi2, (...)."""
        normal, right = self.sums[0].equations()
        error = solve_normal(hold(normal, self.path.setup.held), right)
        normal, right = self.sums[-1].equations()
        terms = error * (np.einsum("kl...,l...->k...", normal, error) - 2.0 * right)
        error, terms = (np.ascontiguousarray(np.moveaxis(array, 0, -2)) for array in (error, terms))
        return error, self.squares + terms.reshape(*self.path.setup.stack, -1).sum(axis=-1)

    def _add(self, start: int, reference: Array, satellite: Array | None) -> None:
        path, setup, n_obj = self.path, self.path.setup, reference.shape[-3]
        part = slice(start, start + n_obj)
        shift, misclosure, weighted = self.errors[..., :n_obj, :, :]
        standardised = setup.reference.standardised(reference, start)
        np.multiply(standardised, path.reference_sigma[..., part, :, :], out=shift)
        np.add(shift, path.differences[..., part, :, :], out=misclosure)
        if satellite is not None:
            noise = setup.satellite.standardised(satellite, start)
            misclosure -= np.multiply(noise, path.satellite_sigma[..., part, :, :], out=weighted)
        if self.field is not None:
            misclosure -= self.field.values(part)
        seen = self._seen(part, shift)
        self._subtract_truth(seen, misclosure)
        for sums, all_weights in zip(self.sums, path.weights, strict=True):
            weights = all_weights[..., part, :, :]
            sums.add(seen, weights, np.multiply(misclosure, weights, out=weighted))
        self.squares += product_sum(weighted, misclosure)  # the last weights are those of chi2

    def _seen(self, part: slice, shift: Array) -> Seen:
        path, n_obj = self.path, shift.shape[-3]
        seen, scratch = Seen(*self.seen[..., :n_obj, :]), self.scratch[..., :n_obj, :]
        sin_ra, cos_ra, sin_dec, cos_dec, pmra, pmdec = (
            array[..., part, :]
            for array in (path.sin_ra, path.cos_ra, path.sin_dec, path.cos_dec, path.pmra, path.pmdec)
        )
        d_ra, d_dec = np.divide(shift[..., 0, :], cos_dec, out=scratch[0]), shift[..., 1, :]
        if path.small[..., part].all():
            _turn(sin_ra, cos_ra, d_ra, scratch[1:], seen.s, seen.c)
            _turn(sin_dec, cos_dec, d_dec, scratch[1:], seen.sin_dec, seen.cos_dec)
        else:
            ra, dec = path.ra[..., part, :] + d_ra, path.dec[..., part, :] + d_dec
            np.sin(ra, out=seen.s)
            np.cos(ra, out=seen.c)
            np.sin(dec, out=seen.sin_dec)
            np.cos(dec, out=seen.cos_dec)
        if seen.cos_dec.min() < POLE_LIMIT:
            at = tuple(np.argwhere(seen.cos_dec < POLE_LIMIT)[0])
            item = part.start + int(at[-2])
            raise pole_error(item, float(path.dec[(*at[:-2], item, 0)] + d_dec[at]))
        np.add(pmra, shift[..., 2, :], out=seen.pmra)
        np.add(pmdec, shift[..., 3, :], out=seen.pmdec)
        np.divide(seen.pmra, seen.cos_dec, out=seen.pmra_turn)
        np.divide(seen.pmdec, seen.cos_dec, out=seen.pmdec_turn)
        return seen

    def _subtract_truth(self, seen: Seen, misclosure: Array) -> None:
        """Subtract A times the truth, A the noisy design, so that the solution is estimate - truth."""
        scenario, truth = self.path.setup.scenario, self.path.setup.truth
        turn, work = self.scratch[:2, ..., : misclosure.shape[-3], :]
        ra, dec, pmra, pmdec = (misclosure[..., k, :] for k in range(4))
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
        field, work = self.scratch[:2, ..., : along_q.shape[-2], :]
        np.multiply(seen.c, -x, out=field)
        field -= np.multiply(seen.s, y, out=work)
        field *= seen.sin_dec
        along_q += field
        along_q += np.multiply(seen.cos_dec, z, out=work)
        along_p += np.multiply(seen.s, x, out=work)
        along_p -= np.multiply(seen.c, y, out=work)


def _turn(sin: Array, cos: Array, angle: Array, scratch: Array, sin_out: Array, cos_out: Array) -> None:
    """Write sin and cos of the sum of two angles by the addition theorem; ``angle`` is below `SMALL_ANGLE`."""
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
