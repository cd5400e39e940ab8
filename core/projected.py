"""The projected method: the effect of the errors on the link is drawn, not the errors of every object.

With the columns P (4N, C) of the fixed design, estimate and chi2 of a realisation follow from P^T z and z^T z of its
4N unit normals z.  With P = Q R, Q of orthonormal columns, u = Q^T z are unit normals, P^T z = R^T u, and the squared
length of z outside the columns of Q is an independent chi-square of 4N - C degrees of freedom.  So C normals and a
chi-square have exactly the distribution of 4N normals, whatever N.

This needs normal, uncorrelated errors and a fixed design.  Where the reference has errors the design changes with
them, which is neglected here: `neglected` bounds the effect.
"""

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.design import ORIENTATION, link_unknowns
from linksweep.core.fixed_design import FixedDesign
from linksweep.core.link import LinkError
from linksweep.core.shared_arrays import parts

LARGEST_NEGLECT = 0.01
"""Largest bound of `neglected` that is allowed, as a fraction of sigma.  Where it was tried, the effect was 13 to 75
times smaller than the bound: below the Monte-Carlo error of a million realisations.
"""


class Projected:
    """The fixed design of a catalogue, reduced to the triangle R (at most C, C) of its columns."""

    def __init__(self, design: FixedDesign) -> None:
        setup = design.setup
        if setup.reference.factor is not None or setup.satellite.factor is not None:
            raise LinkError("the projected method needs uncorrelated errors: otherwise chi2 has no chi-square law")
        if not (setup.reference.as_weighed and setup.satellite.as_weighed):
            raise LinkError("the projected method needs true errors that equal those in the weights, and no zonal ones")
        worst = float(np.max(neglected(design)))
        if worst > LARGEST_NEGLECT:
            raise LinkError(
                f"the projected method would neglect {worst:.2g} of sigma with these errors of the reference: "
                f"at most {LARGEST_NEGLECT:g}"
            )
        self.design = design
        self.noisy = bool(setup.reference) or bool(setup.satellite)
        self.triangle = np.zeros((0, design.columns.shape[2]))
        for part in parts(len(design.columns)):
            rows = design.columns[part, setup.observables].reshape(-1, design.columns.shape[2])
            self.triangle = np.asarray(np.linalg.qr(np.concatenate([self.triangle, rows]), mode="r"))

    def draw(self, rows: int, rng: np.random.Generator) -> "Drawn":
        """Return the estimates of ``rows`` realisations and the sum of their chi2."""
        if not self.noisy:
            return Drawn(*self.design.solved(np.zeros((self.triangle.shape[1], rows)), 0.0))
        normals = rng.standard_normal((rows, len(self.triangle))).T
        outside = self.design.columns[:, self.design.setup.observables, 0].size - len(self.triangle)
        # only the sum over the realisations is needed, and a sum of chi-squares is a chi-square too
        squares = float(np.vdot(normals, normals)) + (rng.chisquare(rows * outside) if outside else 0.0)
        return Drawn(*self.design.solved(self.triangle.T @ normals, squares))


class Drawn:
    """Realisations that are drawn already, without objects."""

    def __init__(self, error: Array, chi2: Array) -> None:
        self.result = error, chi2

    def solved(self) -> tuple[Array, Array]:
        """Return estimate - truth of each realisation, (K, rows), and the sum of chi2."""
        return self.result


def neglected(design: FixedDesign) -> Array:
    """Return a bound, in units of sigma, of the RMS error of each unknown from the fixed design; shape (K,).

    It is of first order in the change D of the design with the errors of the reference: with the gain (A^T W A)^-1 A^T
    W the estimate changes by (A^T W A)^-1 (D^T W e - A^T W D x), where e are errors and residuals and x is truth plus
    error of the estimate.  The mean of this change comes from the only product of an error with itself, e_ra and the
    turn of q with ra.  Its scatter is bounded by the squared norms of both terms, added up over objects for
    orientation, spin and glide, with the rows of (A^T W A)^-1 (Cauchy and Schwarz); E(a b)^2 <= 3 E a^2 E b^2 for
    normal a and b.
    """
    setup, unknowns = design.setup, len(design.bias)
    if not setup.reference:
        return np.zeros(unknowns)
    predicted = design.predicted_variance()
    # E x^2 of orientation, spin and glide
    size = 2.0 * np.square(np.abs(setup.truth) + np.abs(design.bias)) + 6.0 * predicted
    blocks = len(link_unknowns(setup.scenario.solve_glide).blocks)
    squares, mean = np.zeros(blocks), np.zeros(unknowns)
    for part in parts(len(design.columns)):
        squares += _squared_changes(design, part, size.reshape(blocks, -1).sum(axis=1))
        mean[ORIENTATION] += _mean_change(design, part)
    rows = np.square(design.inverse).reshape(unknowns, blocks, -1).sum(axis=2)
    bound = rows @ squares * len(squares) + np.square(design.inverse @ mean)
    return np.asarray(np.sqrt(np.divide(bound, predicted, out=np.zeros_like(bound), where=predicted > 0.0)))


def _squared_changes(design: FixedDesign, part: slice, size: Array) -> Array:
    """Return bounds of E|D^T W e - A^T W D x|^2, added up over objects, for orientation, spin and glide; (blocks,)."""
    setup, catalogue = design.setup, design.setup.catalogue
    counted = setup.counted[:, None]
    square_sec = np.cos(catalogue.dec[part]) ** -2.0
    reference, variance = np.square(setup.reference.sigma[part]).T, np.square(setup.sigma[part]).T
    weight = counted * (variance**-2.0 if design.optimal else np.ones_like(variance))  # squared
    error = 3.0 * variance * (1.0 + np.square(design.residual(part).T))
    # E|D|^2: p and q turn with ra and dec by at most 1/cos dec, pmdec eta and pmra eta with the motions too
    turn = square_sec * (reference[0] + reference[1])
    eta = square_sec * np.square([catalogue.pmdec[part], catalogue.pmra[part]])
    eta_turn = 2.0 * (square_sec * reference[[3, 2]] + eta * turn)
    if not setup.scenario.corrections:
        eta, eta_turn = np.zeros_like(eta), np.zeros_like(eta)
    positions = weight[:2] * turn * (error[:2] + size[0])
    misfit = 3.0 * (size[1:].sum() * turn + size[0] * eta_turn)
    motions = weight[2:] * (error[2:] * turn + misfit)
    turned = weight[2:] * (error[2:] * eta_turn + eta * misfit)
    # (a + ...)^2 <= 8 (a^2 + ...), both terms of four observables
    return 8.0 * np.array([positions.sum() + turned.sum(), *[motions.sum()] * (len(size) - 1)])


def _mean_change(design: FixedDesign, part: slice) -> Array:
    """Return E[D^T W e] of the orientation added up over objects; q changes by -tan dec p with ra*.  Shape (3,)."""
    catalogue, setup = design.setup.catalogue, design.setup
    ra, dec = catalogue.ra[part], catalogue.dec[part]
    size = np.tan(dec) * np.square(setup.reference.sigma[part, 0])
    if design.optimal:
        size /= np.square(setup.sigma[part, 0])
    return np.array([np.sum(size * np.sin(ra)), -np.sum(size * np.cos(ra)), 0.0])
