"""The link as the platform sees it, for tests: points of it, what they draw, and what comes out."""

# ruff: noqa: F401 (tests import from here what they need of the core)
from dataclasses import replace

import numpy as np

from linksweep.core import experiment
from linksweep.core.catalogues import Catalogue, NestedDraw, OwnErrors
from linksweep.core.designs import fixed_designs, neglected
from linksweep.core.errors import CatalogueErrors, MagnitudeErrors, NormalErrors
from linksweep.core.experiment import link
from linksweep.core.fields import Field, ZonalErrors, parse_pattern, pattern_field, rms
from linksweep.core.frames import DEGREE, GALACTIC_AXES, MAS, MICROARCSEC, LinkError, exact_differences, triad
from linksweep.core.missions import CALIBRATED, MISSIONS, FunctionCurve, Mission, calibrate, mission_from_table
from linksweep.core.setup import ROWS, TILE, Prefixes, prepare, scenario
from linksweep.core.simulate import can_stack, simulate
from linksweep.sweep.contract import Named
from linksweep.sweep.tables.columns import table_file

OTHER = {
    **{"counts": "completed", "positions": "own", "model": "gaia", "mission_length": 7.0, "error_scale": 0.5},
    **{"satellite_errors": "normal", "satellite_error_scale": 3.0, "satellite_sigma_pos": 0.3},
    **{"satellite_sigma_pm": 0.2, "satellite_floor_pos": 0.3, "satellite_floor_pm": 0.4, "satellite_error_ratio": 2.0},
    **{"reference_errors": "normal", "reference_error_scale": 2.0, "reference_sigma_pos": 0.5},
    **{"reference_sigma_pm": 0.7, "reference_floor_pos": 0.5, "reference_floor_pm": 0.6, "reference_error_ratio": 0.7},
    **{"corrections": False, "weighting": "equal", "solve_glide": True, "arithmetic": "stored"},
    **{"epsilon": (3.0, 0.0, -1.0), "omega": (0.0, 0.5, 2.0), "epsilon_size": 5.0, "omega_size": 0.1},
    **{"directions": "random", "aberration": True, "glide": (1.0, 2.0, 3.0), "v_min": 13.0, "v_max": 13.4},
    **{"mean_pm": 200.0, "pm_distribution": "constant", "zone_of_avoidance": 20.0, "sky_contrast": 0.4},
    **{"zonal_pos": 1.0, "zonal_pm": 2.0, "zonal_length": 70.0, "v_zero": 9.0, "omega_slope": (0.1, 0.0, -0.2)},
    **{"omega_slope_size": 0.3, "motion_field_size": 0.5, "motion_field": "t_2_0,s_3_1_im=-0.5"},
    **{"magnitude_equation_pmra": 0.2, "magnitude_equation_pmdec": -0.1},
}
"""Another value of every parameter but those of what is drawn."""


def sky(n_obj, seed=1, mean_pm=300.0 * MAS):
    rng = np.random.default_rng(seed)
    place = rng.uniform(0.0, 2.0 * np.pi, n_obj), np.arcsin(rng.uniform(-1.0, 1.0, n_obj))
    return *place, *rng.normal(0.0, mean_pm, (2, n_obj))


def point(**changes):
    """A point of the link, by default of 30 synthetic objects."""
    assert set(changes) <= set(link.defaults())
    return link.defaults() | {"n_obj": 30} | changes


def generators(seed=1):
    return np.random.default_rng(seed), np.random.default_rng(seed + 1)


def drawn(seed=1, **changes):
    return scenario(link.defaults() | changes).draw_catalogue.draw(np.random.default_rng(seed))


def evaluated(n_sim, *points, seed=1):
    return link.evaluate(points, n_sim, *generators(seed))


def results(n_sim, *points, seed=1):
    ones = np.ones(len(points))
    return link.summarise(evaluated(n_sim, *points, seed=seed), n_sim * ones, ones)


def run(physics, n_sim, seed=1, catalogue_seed=2, keep=True):
    streams = np.random.default_rng(seed), np.random.default_rng(catalogue_seed)
    return simulate([physics], n_sim, [streams], keep_estimates=keep)[0]


def of_objects(catalogue, physics, **changes):
    return replace(physics, draw_catalogue=NestedDraw("these", len(catalogue), lambda _: catalogue), **changes)


def set_up(catalogue, physics):
    assert not physics.random_directions
    return prepare(physics, catalogue, np.array([physics.epsilon, physics.omega]), Prefixes())


def design_of(setup):
    return fixed_designs([setup], Prefixes())[0][0]


def random_covariances(n_obj, seed=2):
    """Standard errors (n_obj, 4) in mas and correlations (n_obj, 4, 4) of random covariance matrices."""
    factor = np.random.default_rng(seed).standard_normal((n_obj, 4, 6))
    covariance = factor @ np.swapaxes(factor, 1, 2)
    deviation = np.sqrt(np.einsum("nii->ni", covariance))
    return deviation, covariance / (deviation[:, :, None] * deviation[:, None, :])


class Function:
    """A function with a name and a digest, as the platform loads it."""

    digest = "0123456789ab"

    def __init__(self, function, name="sigma"):
        self.function, self.name = function, name

    def __call__(self, *arguments):
        return self.function(*arguments)
