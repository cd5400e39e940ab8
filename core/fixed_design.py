"""The link while its design matrix is that of the true reference: matrix products of unit normals.

With the design a (4N, K) and the misclosure in units of the weighing sigma, and standardised errors z of the satellite
(reference - satellite: the sign is minus), the error of the estimate is b - g^T z with the gain g (4N, K) and the bias
b = g^T misclosure, and the residuals are r - z + a g^T z with r = misclosure - a b.  Hence chi2 follows from a^T z,
g^T z, r^T z and z^T z, so the objects are met only in products with the columns [a, r], or [a, g, r] for equal weights
(for inverse-variance ones g = a (a^T a)^-1).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.link import design_matrix, normal_inverse, require_off_poles
from core.noise import Tile
from core.setup import Setup, parts

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FixedDesign:
    """The columns (N, 4, C) that turn unit normals into estimates, and the small matrices of their products."""

    setup: Setup
    columns: Array
    normal: Array  # a^T a, (K, K)
    inverse: Array  # of A^T W A, W the weights of the solution
    bias: Array  # (K,)
    design_residual: Array  # a^T r, (K,): zero for inverse-variance weights
    residual_squares: float

    def begin(self, rows: int) -> "FixedSums":
        """Return empty sums of ``rows`` realisations."""
        return FixedSums(self, np.zeros((self.columns.shape[2], rows)))

    def predicted_variance(self) -> Array:
        """Return the variance of each unknown; shape (K,)."""
        sides = self.setup.reference, self.setup.satellite
        if not any(sides):
            return np.zeros(len(self.bias))
        unknowns = len(self.bias)
        if any(side.factor is not None for side in sides):
            gain = self.columns[..., :unknowns] @ self.inverse if self.optimal else self.columns[..., unknowns:-1]
            gain = gain / self.setup.sigma[..., None]
            return np.asarray(sum(side.variance_through(gain) for side in sides))
        if self.optimal:
            return np.diag(self.inverse)
        flat = self.columns[..., unknowns:-1].reshape(-1, unknowns)
        return np.asarray(np.einsum("ik,ik->k", flat, flat))

    @property
    def optimal(self) -> bool:
        """Whether the weights are those of the errors, so that the gain follows from the design."""
        return self.setup.scenario.weighting == "inverse-variance"

    def solved(self, products: Array, squares: float) -> tuple[Array, float]:
        """Return estimate - truth (K, rows) and the sum of chi2 from ``products`` = columns^T z (C, rows) and the sum
        of z^2.
        """
        unknowns = len(self.bias)
        a_z, r_z = products[:unknowns], products[-1]
        g_z = self.inverse @ a_z if self.optimal else products[unknowns:-1]
        chi2 = products.shape[1] * self.residual_squares + squares - 2.0 * np.sum(r_z)
        chi2 += np.sum(g_z * (self.normal @ g_z - 2.0 * a_z + 2.0 * self.design_residual[:, None]))
        return self.bias[:, None] - g_z, float(chi2)


@dataclass
class FixedSums:
    """Products of the columns with the normals of the objects met so far, for the realisations of one chunk."""

    design: FixedDesign
    products: Array
    squares: float = 0.0

    def add(self, satellite: Tile | None, reference: Tile | None) -> None:
        """Add the objects of a tile; the reference has no errors here."""
        setup, columns = self.design.setup, self.design.columns
        if satellite is None or satellite.start >= len(columns) or not setup.satellite:
            return
        noise = setup.satellite.standardised(satellite.of(len(columns)), satellite.start)
        part = columns[satellite.start : satellite.start + len(noise)]
        self.products += part.reshape(-1, columns.shape[2]).T @ noise.reshape(-1, noise.shape[2])
        correlated = setup.satellite.factor is not None
        self.squares += float(np.vdot(noise, noise)) if correlated else satellite.squares(len(columns))

    def solved(self) -> tuple[Array, float]:
        """Return estimate - truth of each realisation, (K, rows), and the sum of chi2."""
        return self.design.solved(self.products, self.squares)


def fixed_design(setup: Setup) -> FixedDesign:
    """Return the design at the true reference; raises LinkError where the catalogue does not determine the link."""
    unknowns = len(setup.truth)
    optimal = setup.scenario.weighting == "inverse-variance"
    columns = _whitened(setup, 1 if optimal else 2)
    flat = columns.reshape(-1, columns.shape[2])
    a, misclosure = flat[:, :unknowns], flat[:, -1]
    normal = a.T @ a
    if optimal:
        inverse = normal_inverse(normal)
        bias = inverse @ (a.T @ misclosure)
    else:  # the estimate is (A^T A)^-1 A^T y with A = sigma a, and A^T A = a^T (sigma^2 a)
        gain = flat[:, unknowns:-1]
        inverse = normal_inverse(a.T @ gain)
        gain @= inverse
        bias = gain.T @ misclosure
    misclosure -= a @ bias
    return FixedDesign(
        setup=setup,
        columns=columns,
        normal=normal,
        inverse=inverse,
        bias=bias,
        design_residual=np.zeros(unknowns) if optimal else a.T @ misclosure,
        residual_squares=float(misclosure @ misclosure),
    )


def _whitened(setup: Setup, copies: int) -> Array:
    """Return the columns [a, misclosure], or with two ``copies`` [a, sigma^2 a, misclosure]; shape (N, 4, C)."""
    catalogue, scenario, unknowns = setup.catalogue, setup.scenario, len(setup.truth)
    require_off_poles(catalogue.dec, np.cos(catalogue.dec))
    columns = np.empty((len(catalogue), 4, copies * unknowns + 1))
    for part in parts(len(catalogue)):
        design = design_matrix(
            catalogue.ra[part],
            catalogue.dec[part],
            catalogue.pmra[part],
            catalogue.pmdec[part],
            corrections=scenario.corrections,
            glide=scenario.solve_glide,
        )
        sigma = setup.sigma[part, :, None]
        columns[part, :, :unknowns] = np.moveaxis(design, 0, 1)
        columns[part, :, -1] = setup.differences[part] - (design @ setup.truth).T
        if copies == 2:
            np.multiply(columns[part, :, :unknowns], sigma, out=columns[part, :, unknowns:-1])
        columns[part, :, :unknowns] /= sigma
        columns[part, :, -1:] /= sigma
    return columns
