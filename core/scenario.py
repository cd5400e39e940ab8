"""From a point's parameters to the physics of it: catalogue, errors, truth and solution."""

from collections.abc import Hashable
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from core.catalogue import (
    GALAXY_FAINT_LIMIT_MAG,
    Catalogue,
    NestedDraw,
    Sky,
    galaxies,
    radio_stars,
    resample,
    synthetic,
)
from core.constants import DEGREE, GALACTIC_AXES, MAS, MICROARCSEC
from core.errors import CatalogueErrors, ErrorModel, MagnitudeErrors, NoErrors, NormalErrors
from core.missions import MISSIONS, Mission
from core.prepared import Scenario, TrueVector, Vector
from core.quasars import V_MAX, quasar_count, quasars
from core.table_catalogue import Table, catalogue_from_table
from sweep.contract import Named, Point

Array = NDArray[np.float64]

GALACTIC_GLIDE_UAS_YR = 4.0
"""Towards the Galactic centre.  Source: Kovalevsky 2003, as Metz & Geffert 2004, Sect. 5.1; measured since: 5.05
(Gaia EDR3).
"""

N_GALAXIES = 116
"""Certain galaxies in Tycho-2.  Source: Metz & Geffert 2004, Sect. 3.2."""

FAINTEST_MAG = {"synthetic": 15.0, "quasars": float(V_MAX[-1]), "galaxies": GALAXY_FAINT_LIMIT_MAG}
"""Limiting magnitude where a study gives none; a file or the radio stars have none."""


_OF_CATALOGUE = (
    *("catalogue", "n_obj", "v_min", "v_max", "mean_pm", "pm_distribution", "zone_of_avoidance", "sky_contrast"),
    *("counts", "positions", "file", "columns", "units", "pmra_cos_dec"),
)
"""Parameters of a point that decide which catalogue is drawn."""


def scenario(point: Point) -> Scenario:
    """Return the physics of a point (its parameters by name, in the units of `PARAMETERS`)."""
    random = point["directions"] == "random"
    return Scenario(
        draw_catalogue=NestedDraw(*_family(point), partial(_draw_catalogue, point)),
        reference_errors=error_model(point, "reference"),
        satellite_errors=error_model(point, "satellite"),
        epsilon=TrueVector(_radians(point["epsilon"], point["epsilon_size"]), random),
        omega=TrueVector(_radians(point["omega"], point["omega_size"]), random),
        aberration=_glide(point) if point["aberration"] else (0.0, 0.0, 0.0),
        solve_glide=point["solve_glide"],
        corrections=point["corrections"],
        weighting=point["weighting"],
        arithmetic=point["arithmetic"],
        method=point["method"],
    )


def catalogue_size(point: Point) -> int:
    """Return the number of objects of a point's catalogue."""
    n_obj = point["n_obj"]
    return available_objects(point) if n_obj is None else int(n_obj)


def available_objects(point: Point) -> int:
    """Return how many objects there are where a point does not say how many it wants."""
    catalogue = point["catalogue"]
    if catalogue == "quasars":
        return quasar_count(limiting_magnitude(point), point["counts"] == "completed")
    if catalogue == "file":
        return len(table_objects(point))
    return N_GALAXIES if catalogue == "galaxies" else len(radio_stars())


def limiting_magnitude(point: Point) -> float:
    """Return the limiting magnitude of a synthetic, quasar or galaxy catalogue."""
    v_max = point["v_max"]
    return float(FAINTEST_MAG[point["catalogue"]] if v_max is None else v_max)


def mission_of(model: str | Named) -> Mission:
    """Return the mission of a point's model: a built-in one, or one that its study defines."""
    if isinstance(model, str):
        return MISSIONS[model]
    mission: Mission = model.value
    return mission


def error_model(point: Point, side: str) -> ErrorModel:
    """Return the error model of one side, "reference" or "satellite"."""
    kind = point[f"{side}_errors"]
    scale = point["error_scale"] * point[f"{side}_error_scale"]
    if kind == "normal":
        return NormalErrors(point[f"{side}_sigma_pos"], point[f"{side}_sigma_pm"], scale)
    if kind == "magnitude":
        return MagnitudeErrors(mission_of(point["model"]), point["mission_length"], scale)
    return CatalogueErrors(scale, side) if kind == "catalogue" else NoErrors()


def own_objects(point: Point) -> Catalogue | None:
    """Return the objects of a catalogue that is given as such, None for one that is drawn from a law."""
    if point["catalogue"] == "radio-stars":
        return radio_stars()
    return table_objects(point) if point["catalogue"] == "file" else None


def table_objects(point: Point) -> Catalogue:
    """Return the objects of the file that are brighter than the limit."""
    return _table_objects(point["file"], point["columns"], point["units"], point["pmra_cos_dec"], point["v_max"])


def whole_table(point: Point) -> Catalogue:
    """Return all objects of the file."""
    return _table_objects(point["file"], point["columns"], point["units"], point["pmra_cos_dec"], None)


@lru_cache(maxsize=4)
def _table_objects(
    table: Table,
    columns: tuple[tuple[str, str], ...],
    units: tuple[tuple[str, str], ...],
    pmra_cos_dec: bool | None,
    v_max: float | None,
) -> Catalogue:
    """Make a catalogue once in a process for every check and block; a table is known by its content."""
    if v_max is None:
        return catalogue_from_table(table, dict(columns), pmra_cos_dec, dict(units))
    whole = _table_objects(table, columns, units, pmra_cos_dec, None)
    return whole.take(np.flatnonzero(whole.v_mag <= v_max))


def _sky(point: Point) -> Sky:
    return Sky(point["zone_of_avoidance"] * DEGREE, point["sky_contrast"])


def _draw_catalogue(point: Point, rng: np.random.Generator) -> Catalogue:
    kind, n_obj, sky = point["catalogue"], catalogue_size(point), _sky(point)
    if kind == "synthetic":
        pm = (point["mean_pm"] * MAS, point["pm_distribution"])
        return synthetic(rng, n_obj, point["v_min"], limiting_magnitude(point), sky, *pm)
    if kind == "galaxies":
        return galaxies(rng, n_obj, limiting_magnitude(point), sky)
    if kind == "radio-stars":
        return resample(rng, radio_stars(), n_obj, None if point["positions"] == "own" else sky)
    if kind == "quasars":
        whole = quasars(rng, limiting_magnitude(point), sky, point["counts"] == "completed")
    else:
        whole = table_objects(point)
    if n_obj < len(whole):
        whole = whole.take(np.sort(rng.choice(len(whole), n_obj, replace=False)))
    return whole.moved_to(*sky.positions(rng, n_obj)) if point["positions"] == "isotropic" and kind == "file" else whole


def _family(point: Point) -> tuple[Hashable, int]:
    """Return what decides which catalogue is drawn, and its size: a fainter limit adds quasars at the end."""
    nested = point["catalogue"] == "quasars" and point["n_obj"] is None and limiting_magnitude(point) in V_MAX
    decides = tuple(point[name] for name in _OF_CATALOGUE if not (nested and name == "v_max"))
    return (nested, *decides), catalogue_size(point)


def _radians(vector_mas: Vector, size_mas: float | None) -> Vector:
    vector = np.array(vector_mas) * MAS
    if size_mas is not None:
        length = np.linalg.norm(vector)
        vector = vector / length * size_mas * MAS if length > 0.0 else np.array([size_mas * MAS, 0.0, 0.0])
    return (float(vector[0]), float(vector[1]), float(vector[2]))


def _glide(point: Point) -> Vector:
    given = point["glide"]
    x, y, z = MICROARCSEC * (GALACTIC_GLIDE_UAS_YR * GALACTIC_AXES[0] if given is None else np.array(given))
    return (float(x), float(y), float(z))
