"""The design matrix, the weights and the solution of the link."""

import numpy as np
import pytest

from linksweep.core.frames import MAS, exact_differences, position, triad
from linksweep.core.link import LinkError, combined_error, inverse_and_condition, solve_normal
from tests.core.points import core_design as design_matrix, sky


def test_design_matrix_is_the_derivative_of_the_exact_differences():
    catalogue = sky(200, mean_pm=1.0)  # motions of order 1, so that A21 weighs as much as A11
    shifts = 1e-6 * np.eye(6).reshape(6, 2, 3)
    columns = [(exact_differences(*catalogue, *s) - exact_differences(*catalogue, *-s)) / 2e-6 for s in shifts]
    steepness = np.cos(catalogue[1])[:, None] ** -3  # truncation h^2 times the third derivative
    assert np.all(np.abs(np.stack(columns, axis=-1) - design_matrix(*catalogue)) < 1e-10 * steepness)


def test_columns_are_the_derivative_of_proper_motions_by_the_glide():
    """A glide moves an object towards its apex: r -> <r + t g>, read off as ra and dec after a short time."""
    ra, dec, none, _ = sky(100, 2, 0.0)
    design, r, step = design_matrix(ra, dec, none, none, glide=True), triad(ra, dec).r, 1e-6
    for k, apex in enumerate(np.eye(3)):
        ahead, behind = (np.array(position(r + sign * step * apex[:, None])) for sign in (1, -1))
        d_ra, d_dec = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(design[2:, :, 6 + k], [d_ra * np.cos(dec), d_dec], atol=1e-8)
    np.testing.assert_array_equal(design[:2, :, 6:], 0.0)  # no position moves


def test_solve_normal_refuses_what_the_inverse_refuses():
    good = np.eye(6)
    flat = np.ones((6, 6))
    indefinite = np.eye(6)
    indefinite[0, 1] = indefinite[1, 0] = 1.0 + 1e-9
    weightless = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    for bad in (flat, indefinite, weightless):
        with pytest.raises(LinkError) as by_inverse:
            inverse_and_condition(np.stack([good, bad]))
        with pytest.raises(LinkError) as by_elimination:
            solve_normal(np.stack([good, bad], axis=-1), np.ones((6, 2)))
        assert str(by_elimination.value) == str(by_inverse.value)


@pytest.mark.parametrize("side", [0, 1])
def test_negative_and_partly_zero_errors_are_named(side):
    pair = [np.zeros((3, 4)), np.zeros((3, 4))]
    pair[side][:] = MAS
    pair[side][2, 1] = -MAS
    with pytest.raises(LinkError, match="negative standard error in dec of object 2"):
        combined_error(*pair)
    pair[side][2, 1] = 0.0
    with pytest.raises(LinkError, match=r"zero standard error beside non-zero ones, .* in dec of object 2"):
        combined_error(*pair)
