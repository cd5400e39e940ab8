"""Frames, the design matrix and its solution, unknowns and harmonics; against SciPy, astropy and ERFA."""

import re

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from linksweep.core import frames
from linksweep.core.fields import terms, toroidal
from linksweep.core.frames import MAS, combined_error, inverse_and_condition, solve_normal, stored_differences
from linksweep.core.unknowns import Objects, link_unknowns, parse_unknowns
from tests.core.points import GALACTIC_AXES, LinkError, exact_differences, sky, triad

ROUNDING = 1e-15  # a few units in the last place of numbers of order 1
MILLI_ROTATION = (np.array([1.0, -2.0, 0.5]) * MAS, np.array([0.3, 0.7, -1.1]) * MAS)
WRONG_LINES = [("", None, "no unknowns"), ("spin,spin", None, "spin twice"), ("vsh_motion", None, "give a degree")]
WRONG_LINES += [("vsh_motion:3-2", None, "the lower one first"), ("spin,glide,vsh_motion:1", None, "are these already")]
WRONG_LINES += [("orientation", ("mag", [6.0]), "not among the unknowns"), ("spin", ("g", [8.0, 6.0]), "increase")]
WRONG_LINES += [("spin", ("g", [6.0]), "g is missing in 1 of 2")]


def reference_differences(ra, dec, pmra, pmdec, epsilon, omega):
    """Step B and the subtraction in 80-bit numbers, whose rounding is 2000 times finer."""
    numbers = (ra, dec, pmra, pmdec, epsilon, omega)
    ra, dec, pmra, pmdec, epsilon, omega = (np.asarray(x, np.longdouble) for x in numbers)
    angle = np.sqrt(np.sum(epsilon**2))
    x, y, z = -epsilon / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    back = np.eye(3, dtype=np.longdouble) + np.sin(angle) * cross + 2 * np.sin(angle / 2) ** 2 * (cross @ cross)
    reference = triad(ra, dec)
    v = back @ (reference.p * pmra + reference.q * pmdec - np.cross(omega, reference.r, axisb=0, axisc=0))
    r = back @ reference.r
    ra_sat, dec_sat = np.arctan2(r[1], r[0]), np.arctan2(r[2], np.hypot(r[0], r[1]))
    satellite = triad(ra_sat, dec_sat)
    turn = 8 * np.arctan(np.longdouble(1))
    d_ra = ra - ra_sat
    d_ra -= turn * np.round(d_ra / turn)
    d_pm = pmra - np.sum(satellite.p * v, axis=0), pmdec - np.sum(satellite.q * v, axis=0)
    return np.stack([d_ra * np.cos(dec), dec - dec_sat, *d_pm])


def test_satellite_catalogue_obeys_the_vector_equations_and_no_position_is_a_full_turn():
    ra, dec, pmra, pmdec = sky(500)
    epsilon, omega = np.array([0.3, -0.8, 1.1]), np.array([0.1, 0.2, -0.3])
    ra_sat, dec_sat, pmra_sat, pmdec_sat = frames.satellite_catalogue(ra, dec, pmra, pmdec, epsilon, omega)
    reference, satellite = triad(ra, dec), triad(ra_sat, dec_sat)
    turn = Rotation.from_rotvec(epsilon)
    np.testing.assert_allclose(turn.apply(satellite.r.T).T, reference.r, atol=2 * ROUNDING)
    v_ref = reference.p * pmra + reference.q * pmdec
    v_sat = satellite.p * pmra_sat + satellite.q * pmdec_sat
    np.testing.assert_allclose(v_ref, turn.apply(v_sat.T).T + np.cross(omega, reference.r.T).T, atol=2 * ROUNDING)
    exact, stored = (f(ra, dec, pmra, pmdec, epsilon, omega) for f in (exact_differences, stored_differences))
    np.testing.assert_allclose(exact, stored, atol=100 * ROUNDING)  # by finite angles too
    ra, _ = frames.position(np.array([1.0, -1e-20, 0.0]))
    assert 0.0 <= ra < 2.0 * np.pi


@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="needs 80-bit or longer long doubles")
@pytest.mark.parametrize("distance", [None, 1e-2, 5e-6])
def test_exact_differences_lie_far_below_the_floor_of_stored_angles(distance):
    ra, dec, pmra, pmdec = sky(500)
    catalogue = (ra, dec if distance is None else np.full(500, np.pi / 2 - distance), pmra, pmdec)
    truth = reference_differences(*catalogue, *MILLI_ROTATION)
    exact, stored = (f(*catalogue, *MILLI_ROTATION) - truth for f in (exact_differences, stored_differences))
    assert np.abs(exact).max() < 1e-9 * MAS * (1.0 + 300 * MAS / (distance or 1.0))
    if distance is None:
        assert 1e-9 * MAS < np.abs(stored)[:2].max() < 1e-6 * MAS  # the last bit of an angle is 4e-7 mas at most
        assert np.abs(exact)[:2].max() < 1e-3 * np.abs(stored)[:2].max()  # the rounding of the 80-bit numbers


def test_units_and_the_galactic_axes_are_astropys():
    theirs = [unit.to(units.rad) for unit in (units.mas, units.uas, units.deg, units.arcsec)]
    np.testing.assert_allclose([MAS, frames.MICROARCSEC, frames.DEGREE, frames.ARCSEC], theirs, rtol=1e-14)
    xyz = SkyCoord([0, 90, 0] * units.deg, [0, 0, 90] * units.deg, frame="galactic").icrs.cartesian.xyz.value
    np.testing.assert_allclose(GALACTIC_AXES, xyz.T, atol=0.03 * frames.ARCSEC)  # it has those of FK5, 0.023 arcsec off
    np.testing.assert_allclose(GALACTIC_AXES @ GALACTIC_AXES.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(GALACTIC_AXES) == pytest.approx(1.0, abs=1e-14)


def test_design_matrix_is_the_derivative_of_the_exact_differences():
    catalogue = sky(200, mean_pm=1.0)  # motions of order 1, so that A21 weighs as much as A11
    shifts = 1e-6 * np.eye(6).reshape(6, 2, 3)
    columns = [(exact_differences(*catalogue, *s) - exact_differences(*catalogue, *-s)) / 2e-6 for s in shifts]
    derivatives = link_unknowns(False, True).derivatives(Objects(*catalogue))[1]
    steepness = np.cos(catalogue[1]) ** -3  # truncation h^2 times the third derivative
    assert np.all(np.abs(np.array(columns) - derivatives) < 1e-10 * steepness)


def test_solve_normal_refuses_what_the_inverse_refuses():
    good, indefinite = np.eye(6), np.eye(6)
    indefinite[0, 1] = indefinite[1, 0] = 1.0 + 1e-9
    for bad in (np.ones((6, 6)), indefinite, np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0])):
        with pytest.raises(LinkError) as by_inverse:
            inverse_and_condition(np.stack([good, bad]))
        with pytest.raises(LinkError, match=re.escape(str(by_inverse.value))):
            solve_normal(np.stack([good, bad], axis=-1), np.ones((6, 2)))


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


# ----- blocks of unknowns and vector harmonics


def test_the_fields_are_the_gradients_of_scipys_harmonics_of_which_degree_1_is_rotation_and_glide():
    objects, step = Objects(*sky(50)), 1e-5
    fields = toroidal(7, objects.ra, objects.dec)
    ra, dec = objects.ra, objects.dec

    def harmonic(term, ra, dec):
        return sph_harm_y(term.degree, term.order, 0.5 * np.pi - dec, ra)

    for result, term in zip(fields, (one for degree in range(1, 8) for one in terms("t", degree)), strict=True):
        by_dec = (harmonic(term, ra, dec + step) - harmonic(term, ra, dec - step)) / (2.0 * step)
        by_ra = (harmonic(term, ra + step, dec) - harmonic(term, ra - step, dec)) / (2.0 * step) / np.cos(dec)
        field = np.array([by_dec, -by_ra]) / np.sqrt(term.degree * (term.degree + 1))
        expected = {"": field.real, "re": 2.0 * field.real, "im": -2.0 * field.imag}[term.part]
        np.testing.assert_allclose(result, expected, atol=2e-7, rtol=1e-6)
    ra, dec = np.array([0.3, 0.3]), np.array([0.5 * np.pi, -0.5 * np.pi])  # the poles
    np.testing.assert_allclose(toroidal(4, ra, dec), toroidal(4, ra, dec * (1.0 - 1e-9)), atol=1e-7)
    objects = Objects(*sky(40)[:2], *np.zeros((2, 40)))  # at rest: no motion is turned
    r1, r2, r3 = rotation = np.array([0.3, -0.7, 1.1])
    # Mignard & Klioner 2012, Sect. 4.1
    coefficients = np.sqrt(4.0 * np.pi / 3.0) * np.array([np.sqrt(2.0) * r3, -r1, r2])
    for kind, *vectors in (("motion", "spin", "glide"), ("position", "orientation", "position_glide")):
        harmonics = parse_unknowns(f"vsh_{kind}:1").matrix(objects)
        for vector, part in zip(vectors, (harmonics[..., :3], harmonics[..., 3:]), strict=True):
            direct = parse_unknowns(vector).matrix(objects) @ rotation
            np.testing.assert_allclose(part @ coefficients, direct, atol=1e-14)


@pytest.mark.parametrize(("text", "bins", "message"), WRONG_LINES)
def test_a_wrong_line_is_refused(text, bins, message):
    with pytest.raises(ValueError, match=message):
        parse_unknowns(text, bins, {"g": np.array([5.0, np.nan])})
