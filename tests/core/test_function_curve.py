"""A curve that a user's function gives, and what is said of one that gives none."""

import numpy as np
import pytest

from linksweep.core.missions import CurveError, FunctionCurve


class Known:
    """A function with a name and a digest, as the platform loads it."""

    digest = "0123456789ab"

    def __init__(self, function, name="sigma"):
        self.function, self.name = function, name

    def __call__(self, *arguments):
        return self.function(*arguments)


def test_the_function_gets_one_dimension_of_its_own():
    seen = []

    def spoil(v):
        seen.append(v.shape)
        v[:] = 99.0
        return np.ones(len(v))

    v_mag = np.full((2, 3), 15.0)
    FunctionCurve(Known(spoil))(v_mag)
    assert seen == [(6,)]
    np.testing.assert_array_equal(v_mag, 15.0)


def leave(v):
    raise SystemExit(3)


@pytest.mark.parametrize(
    ("function", "sentence"),
    [
        (lambda v: v[100], "the function 'sigma' raises IndexError: "),
        (leave, "the function 'sigma' raises SystemExit: 3"),
        (lambda v: np.log10(v - 16.0), "the function 'sigma' returns nan at V = 15 mag: must be positive and finite"),
        (lambda v: v - 18.0, "returns -3 at V = 15 mag"),
        (lambda v: np.where(v == 17.0, 0.0, 1.0), "returns 0 at V = 17 mag"),
        (lambda v: 1.0 / (v - 19.0) ** 2, "returns inf at V = 19 mag"),
        (lambda v: 0.3, "returns float64 of shape (), not numbers of shape (5,)"),
        (lambda v: v[:, None], "returns float64 of shape (5, 1), not numbers of shape (5,)"),
        (lambda v: v.astype(str), "not numbers of shape (5,)"),
        (lambda v: v + 1j, "returns complex128 of shape (5,), not numbers"),
        (lambda v: np.ma.masked_greater(v, 17.5), "the function 'sigma' returns 2 masked values"),
        (lambda v: None, "not numbers"),
        (lambda v: [[1.0], [1.0, 2.0]], "raises ValueError"),
    ],
)
def test_what_is_no_curve(function, sentence):
    with pytest.raises(CurveError) as caught:
        FunctionCurve(Known(function))(np.arange(15.0, 20.0))
    assert sentence in str(caught.value)
