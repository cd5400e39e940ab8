"""How the paths of stars bend, against the equation of Kepler and derivatives."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from linksweep.core.tie.astrometry import bends


@given(
    st.floats(0.05, 30.0), st.floats(0.0, 0.98), st.floats(-40.0, 40.0), st.floats(-40.0, 40.0), st.floats(0.0, 3.14)
)
def test_an_orbit_solves_the_equation_of_kepler(period, e, periastron, years, inclination):
    """With the root found by bisection; the axis of the orbit points north."""
    orbit = np.array([[period, e, periastron, 1.0, 0.0, 0.0, np.cos(inclination)]]).T
    mean = 2.0 * np.pi * (((years - periastron) / period) % 1.0)
    anomaly = brentq(lambda x: x - e * np.sin(x) - mean, 0.0, 2.0 * np.pi, xtol=1e-14)
    north, east = np.cos(anomaly) - e, np.sqrt(1.0 - e**2) * np.sin(anomaly) * np.cos(inclination)
    bend = bends(np.array([years]), orbit)[0]
    np.testing.assert_allclose(bend[:, 4], [east, north, 0.0, 0.0, 0.0], atol=1e-7)


@given(st.floats(-20.0, 20.0))
def test_motions_are_the_derivatives_of_positions(years):
    low, here, high = bends(years + np.array([-1e-4, 0.0, 1e-4]))
    np.testing.assert_allclose((high - low)[:2, :4] / 2e-4, here[3:, :4], rtol=1e-6, atol=1e-6)
