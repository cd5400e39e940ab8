"""Blocks of unknowns and vector harmonics, against closed forms, SciPy and the simulated link."""

import numpy as np
import pytest
from scipy.special import sph_harm_y

from linksweep.core.fields import terms, toroidal
from linksweep.core.unknowns import Objects, parse_unknowns
from tests.core.points import sky


def test_the_fields_are_the_gradients_of_scipys_harmonics():
    objects, step = Objects(*sky(50)), 1e-5
    fields = toroidal(7, objects.ra, objects.dec)
    place = 0
    for degree in range(1, 8):
        for term in terms("t", degree):

            def harmonic(ra, dec, term=term):
                return sph_harm_y(term.degree, term.order, 0.5 * np.pi - dec, ra)

            ra, dec = objects.ra, objects.dec
            by_dec = (harmonic(ra, dec + step) - harmonic(ra, dec - step)) / (2.0 * step)
            by_ra = (harmonic(ra + step, dec) - harmonic(ra - step, dec)) / (2.0 * step) / np.cos(dec)
            field = np.array([by_dec, -by_ra]) / np.sqrt(degree * (degree + 1))
            expected = {"": field.real, "re": 2.0 * field.real, "im": -2.0 * field.imag}[term.part]
            np.testing.assert_allclose(fields[place], expected, atol=2e-7, rtol=1e-6)
            place += 1


def test_degree_1_is_rotation_and_glide():
    objects = Objects(*sky(40))
    factor = np.sqrt(8.0 * np.pi / 3.0)
    rotation = np.array([0.3, -0.7, 1.1])
    r1, r2, r3 = rotation
    # Mignard & Klioner 2012, Sect. 4.1
    coefficients = np.array([factor * r3, -np.sqrt(4.0 * np.pi / 3.0) * r1, np.sqrt(4.0 * np.pi / 3.0) * r2])
    for vector, harmonics in (("spin", [0, 1, 2]), ("glide", [3, 4, 5])):
        direct = parse_unknowns(vector).matrix(objects) @ rotation
        by_harmonics = parse_unknowns("vsh_motion:1").matrix(objects)[..., harmonics] @ coefficients
        np.testing.assert_allclose(by_harmonics, direct, atol=1e-14)
    for vector, harmonics in (("orientation", [0, 1, 2]), ("position_glide", [3, 4, 5])):
        direct = parse_unknowns(vector, corrections=False).matrix(objects) @ rotation
        by_harmonics = parse_unknowns("vsh_position:1").matrix(objects)[..., harmonics] @ coefficients
        np.testing.assert_allclose(by_harmonics, direct, atol=1e-14)


def test_a_rate_moves_the_position_of_a_source_with_another_epoch():
    objects, years = Objects(*sky(5)), np.array([0.0, 1.0, -2.0, 0.5, 10.0])
    matrix = parse_unknowns("orientation,spin,glide,vsh_motion:2", corrections=False).matrix(objects, years)
    np.testing.assert_array_equal(matrix[:, :2, 3:], years[:, None, None] * matrix[:, 3:, 3:])
    np.testing.assert_array_equal(matrix[:, 3:, :3], 0.0)


def test_a_spin_for_each_bin_acts_in_its_bin_alone():
    objects = Objects(*sky(4))
    columns = {"mag": np.array([5.0, 6.0, 7.9, 12.0])}
    unknowns = parse_unknowns("spin", ("mag", [6.0, 8.0]), columns)
    matrix = unknowns.matrix(Objects(objects.ra, objects.dec, objects.pmra, objects.pmdec, columns))
    plain = parse_unknowns("spin").matrix(objects)
    assert unknowns.labels[0] == "omega_x[-inf,6)"
    for source, which in enumerate([0, 1, 1, 2]):
        expected = np.zeros((5, 9))
        expected[:, 3 * which : 3 * which + 3] = plain[source]
        np.testing.assert_array_equal(matrix[source], expected)
    assert len(parse_unknowns("spin", ("mag", [1.0, 2.0]), columns)) == 3  # bins without sources have no unknowns


@pytest.mark.parametrize(
    ("text", "bins", "message"),
    [
        ("", None, "no unknowns"),
        ("spin,spin", None, "spin twice"),
        ("vsh_motion", None, "give a degree"),
        ("vsh_motion:3-2", None, "the lower one first"),
        ("spin,glide,vsh_motion:1", None, "are these already"),
        ("orientation", ("mag", [6.0]), "not among the unknowns"),
        ("spin", ("g", [8.0, 6.0]), "increase"),
        ("spin", ("g", [6.0]), "g is missing in 1 of 2"),
    ],
)
def test_a_wrong_line_is_refused(text, bins, message):
    with pytest.raises(ValueError, match=message):
        parse_unknowns(text, bins, {"g": np.array([5.0, np.nan])})


def test_the_fields_are_finite_and_right_at_the_poles():
    ra, dec = np.array([0.3, 0.3]), np.array([0.5 * np.pi, -0.5 * np.pi])
    near = toroidal(4, ra, dec * (1.0 - 1e-9))
    np.testing.assert_allclose(toroidal(4, ra, dec), near, atol=1e-7)
