"""The physics of a point, from its parameters: catalogue, errors, truth and solution; and the errors to be expected
before any catalogue is drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from linksweep.core.catalogues import CATALOGUES, SIDES, CatalogueKind, NestedDraw
from linksweep.core.errors import ErrorModel, error_model
from linksweep.core.fields import Pattern, Systematics, Vector, ZonalErrors, parse_pattern, rms
from linksweep.core.frames import DEGREE, GALACTIC_AXES, MAS, MICROARCSEC, Array, Weighting
from linksweep.sweep.contract import Point

GALACTIC_GLIDE_UAS_YR = 4.0
"""Glide towards the Galactic centre.  Source: Kovalevsky 2003, as quoted by Metz & Geffert 2004, Sect. 5.1; Gaia EDR3
has since measured 5.05.
"""


@dataclass(frozen=True)
class Scenario:
    """One point's physics: how a catalogue is drawn, its errors, the truth (rad, rad/yr) and how the link is solved.

    With ``random_directions`` each catalogue has a truth of its own, of the length of ``epsilon`` and ``omega``.
    ``aberration`` is a glide (rad/yr) added to the satellite's proper motions; ``solve_glide`` adds it to the unknowns.
    ``method`` says whether the errors of every object are drawn or their effect on the link.  The true errors of a side
    are its ``error_ratio`` times those of its model, which give the weights; ``zonal`` are further errors of the
    satellite, and ``systematics`` are errors of proper motions that are the same in all realisations.
    """

    draw_catalogue: NestedDraw
    reference_errors: ErrorModel
    satellite_errors: ErrorModel
    epsilon: Vector
    omega: Vector
    random_directions: bool = False
    aberration: Vector = (0.0, 0.0, 0.0)
    solve_glide: bool = False
    corrections: bool = True
    weighting: Weighting = "inverse-variance"
    arithmetic: Literal["exact", "stored"] = "exact"
    method: Literal["catalogue", "projected"] = "catalogue"
    reference_error_ratio: float = 1.0
    satellite_error_ratio: float = 1.0
    zonal: ZonalErrors | None = None
    systematics: Systematics = field(default_factory=Systematics)


def scenario(point: Point) -> Scenario:
    """Return the physics of a point (its parameters by name, in the units of `PARAMETERS`)."""
    same = (
        *("solve_glide", "corrections", "weighting", "arithmetic", "method"),
        *("reference_error_ratio", "satellite_error_ratio"),
    )
    glide = point["glide"]
    reference_errors, satellite_errors = error_models(point)
    glide_rad = MICROARCSEC * (GALACTIC_GLIDE_UAS_YR * GALACTIC_AXES[0] if glide is None else np.array(glide))
    return Scenario(
        draw_catalogue=catalogue_kind(point).nested_draw(point),
        reference_errors=reference_errors,
        satellite_errors=satellite_errors,
        epsilon=_radians(point, "epsilon"),
        omega=_radians(point, "omega"),
        random_directions=point["directions"] == "random",
        aberration=tuple(glide_rad.tolist()) if point["aberration"] else (0.0, 0.0, 0.0),
        zonal=zonal_errors(point),
        systematics=systematics(point),
        **{name: point[name] for name in same},
    )


def zonal_errors(point: Point) -> ZonalErrors | None:
    """Return the zonal errors of the satellite at a point, or None."""
    position, motion = point["zonal_pos"], point["zonal_pm"]
    # before zonal_length is read, which does not matter then: the platform asks again only where what was read differs
    if not position and not motion:
        return None
    return ZonalErrors(position * MAS, motion * MAS, point["zonal_length"] * DEGREE)


def systematics(point: Point) -> Systematics:
    """Return the systematic errors of the proper motions at a point; raises ValueError for an invalid motion_field."""
    pattern: Pattern = ()
    if (text := point["motion_field"]) is not None:
        pattern, size = parse_pattern(text), point["motion_field_size"]
        scale = MAS if size is None else MAS * size / rms(pattern)
        pattern = tuple((term, coefficient * scale) for term, coefficient in pattern)
    return Systematics(
        omega_slope=_radians(point, "omega_slope"),
        magnitude_equation=(point["magnitude_equation_pmra"] * MAS, point["magnitude_equation_pmdec"] * MAS),
        v_zero=point["v_zero"],
        pattern=pattern,
    )


def catalogue_kind(point: Point) -> CatalogueKind:
    """Return the kind of a point's catalogue."""
    return CATALOGUES[point["catalogue"]]


def catalogue_size(point: Point) -> int:
    """Return the number of objects of a point's catalogue."""
    n_obj = point["n_obj"]  # first: where it is set, the kind does not matter
    return catalogue_kind(point).size(point) if n_obj is None else int(n_obj)


def error_models(point: Point) -> list[ErrorModel]:
    """Return the error models of the reference and the satellite at a point."""
    return [error_model(point, side) for side in SIDES]


def expected_errors(point: Point, models: Sequence[ErrorModel]) -> Array:
    """Return the errors (mas, mas/yr) of the reference and the satellite before a catalogue is drawn, shape (2, N, 4):
    those of the objects that it lists, or of a single one at the faint limit of a catalogue that follows a law.
    """
    kind = catalogue_kind(point)
    if (objects := kind.objects(point)) is None:
        limits = [model.at_limit(point, kind) for model in models]
        return np.array([[(position, position, motion, motion)] for position, motion in limits])
    with np.errstate(over="ignore"):  # far beyond its range a curve is infinite, which is refused later
        return np.stack([model.standard_errors(objects) for model in models]) / MAS


def _radians(point: Point, name: str) -> Vector:
    """Return a vector of a point, of the length that its parameter NAME_size sets, if it does."""
    size, vector = point[f"{name}_size"], np.array(point[name])
    if size is not None:
        scaled = vector * MAS
        length = np.linalg.norm(scaled)
        # a direction of zeros may be one that is random
        vector = scaled / length * size if length > 0.0 else np.array([size, 0.0, 0.0])
    x, y, z = (vector * MAS).tolist()
    return x, y, z
