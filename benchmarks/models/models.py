"""The models: plain functions that know of none of the tools.  ``AXES`` says where each is swept."""

import time

import numpy as np
from scipy.integrate import solve_ivp

DAYS = np.linspace(0.0, 160.0, 81)
CUSTOMERS, REALISATIONS = 50, 200


def sir(beta, gamma):
    """Return the curve of an epidemic of 1000 people, (81,), and its peak."""

    def slope(_, y):
        new, over = beta * y[0] * y[1] / 1000.0, gamma * y[1]
        return [-new, new - over]

    infected = solve_ivp(slope, (0.0, 160.0), [999.0, 1.0], t_eval=DAYS, rtol=1e-6).y[1]
    return infected, infected.max()


def wait(load, rng):
    """Return how long the last of some customers waits, in one random queue."""
    longest = 0.0
    for step in rng.exponential(load, CUSTOMERS) - rng.exponential(1.0, CUSTOMERS):
        longest = max(0.0, longest + step)
    return longest


def sun(tilt, azimuth, sky):
    """Return what a clear June day in Bonn gives on a tilted plane, in Wh/m^2."""
    import pandas as pd
    from pvlib import clearsky, irradiance, location

    hours = pd.date_range("2024-06-21", periods=24, freq="h", tz="UTC")
    place = location.Location(50.7, 7.1)
    at = place.get_solarposition(hours)
    clear = clearsky.simplified_solis(at["apparent_elevation"])
    extra = irradiance.get_extra_radiation(hours)
    ours = clear["dni"], clear["ghi"], clear["dhi"]
    total = irradiance.get_total_irradiance(
        tilt, azimuth, at["apparent_zenith"], at["azimuth"], *ours, dni_extra=extra, model=sky
    )
    return float(total["poa_global"].fillna(0.0).sum())


def area(width, height):
    """Return a product: of numbers or of arrays of them."""
    return width * height


def nap(number):
    """Return a number after half a second."""
    time.sleep(0.5)
    return 2.0 * number


AXES = {
    "sir": {"beta": np.linspace(0.1, 0.5, 41).tolist(), "gamma": np.linspace(0.05, 0.2, 16).tolist()},
    "wait": {"load": np.linspace(0.1, 0.9, 9).tolist()},
    "sun": {
        "tilt": np.arange(0.0, 90.0, 10.0).tolist(),
        "azimuth": np.arange(90.0, 270.0, 30.0).tolist(),
        "sky": ["isotropic", "haydavies"],
    },
    "vectorised": {"width": np.arange(1.0, 201.0).tolist(), "height": np.arange(1.0, 101.0).tolist()},
    "trivial": {"width": np.arange(1.0, 101.0).tolist(), "height": np.arange(1.0, 101.0).tolist()},
    "nap": {"number": np.arange(40.0).tolist()},
}
