"""What makes the result of a point less certain than it looks."""

import numpy as np

from core.errors import SIDES
from core.expected_errors import errors_of_objects
from core.scenario import catalogue_kind, error_kind
from sweep.contract import Point

LARGE_SHARE = 0.1
"""Of the weight of all objects: one that holds more is named."""


def warn(point: Point) -> list[str]:
    """Return sentences about magnitudes outside of a curve's range, and about objects that decide nearly alone."""
    kind = catalogue_kind(point)
    found = [error_kind(point, side).warning(point, kind) for side in SIDES]
    return [sentence for sentence in (*found, _heaviest(point)) if sentence is not None]


def _heaviest(point: Point) -> str | None:
    """Name the listed object with the largest share of the weight of positions or proper motions."""
    listed = catalogue_kind(point).listed(point)
    if listed is None or point["weighting"] == "equal":
        return None
    objects, name = listed
    variance = np.sum(np.square(errors_of_objects(point, objects)), axis=0)
    if not np.all(variance > 0.0):
        return None
    weight = (1.0 / variance).reshape(2, 2, -1).sum(axis=1)  # of positions and of proper motions
    share = weight / weight.sum(axis=1, keepdims=True)
    heaviest = int(np.argmax(share.max(axis=0)))
    position, motion = (f"{100.0 * part:.0f} %" for part in share[:, heaviest])
    if share[:, heaviest].max() <= LARGE_SHARE:
        return None
    return (
        f"file: {name(heaviest)} holds {motion} of the weight of all proper motions and {position} of that of all "
        f"positions, of {len(objects)} objects; is its magnitude right?  v_min leaves out the bright ones"
    )
