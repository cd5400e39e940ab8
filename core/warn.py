"""What makes the result of a point less certain than it looks."""

import numpy as np

from linksweep.core.errors import SIDES
from linksweep.core.scenario import catalogue_kind, error_kind, errors_at_limit, errors_of_objects, own_objects
from linksweep.sweep.contract import Point, SweepError

KINDS = {"positions": ("proper motions", "orientation"), "proper motions": ("positions", "spin")}
"""For each kind of observable: the other kind, and the unknowns that need the first."""

EPOCH, SAME_EPOCH_YR = "ref_epoch", 0.01
"""The column that gives the epoch of a row, and how much epochs may differ without a warning."""

LARGE_SHARE = 0.1
"""Share of the weight of all objects above which an object is named."""


def warn(point: Point) -> list[str]:
    """Return sentences about magnitudes outside of a curve's range, about what is not measured, about positions of
    different epochs, and about objects that decide nearly alone.
    """
    kind = catalogue_kind(point)
    of_errors = [error_kind(point, side).warning(point, kind) for side in SIDES]
    found = (*of_errors, _not_measured(point), _epochs(point), _heaviest(point))
    return [sentence for sentence in found if sentence is not None]


def _not_measured(point: Point) -> str | None:
    """Say which observables have no errors on either side while others have."""
    objects = own_objects(point)
    if objects is None:
        errors = np.sum([errors_at_limit(point, side) for side in SIDES], axis=0)
    else:
        errors = np.add(*errors_of_objects(point, objects)).reshape(2, -1).max(axis=1)
    if errors.all() or not errors.any():
        return None
    missing, (present, unknowns) = list(KINDS.items())[int(np.argmin(errors))]
    return (
        f"{missing} have no errors on either side while {present} have: they are taken as not measured, and the "
        f"{unknowns} is not determined (NaN)"
    )


def _epochs(point: Point) -> str | None:
    """Say that the rows of a file are of different epochs, which the simulation ignores."""
    table = point["file"]
    if table is None or EPOCH not in table.names():
        return None
    try:
        epochs = table.numbers(EPOCH, "yr")
    except SweepError:  # not all rows have one
        return None
    first, last = float(epochs.min()), float(epochs.max())
    if last - first <= SAME_EPOCH_YR:
        return None
    return (
        f"file: {EPOCH} is between {first:.10g} and {last:.10g}, and the simulation takes all rows as of one epoch; "
        "`sweep tie` links rows of different epochs"
    )


def _heaviest(point: Point) -> str | None:
    """Name the listed object with the largest share of the weight of positions or proper motions."""
    listed = catalogue_kind(point).listed(point)
    if listed is None or point["weighting"] == "equal":
        return None
    objects, name = listed
    variance = np.sum(np.square(errors_of_objects(point, objects)), axis=0).reshape(2, 2, -1)
    measured = variance.any(axis=(1, 2))
    if not measured.any():
        return None
    variance[~measured] = 1.0
    weight = (1.0 / variance).sum(axis=1) * measured[:, None]  # of positions and of proper motions
    share = weight / np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    heaviest = int(np.argmax(share.max(axis=0)))
    position, motion = (f"{100.0 * part:.0f} %" for part in share[:, heaviest])
    if share[:, heaviest].max() <= LARGE_SHARE:
        return None
    return (
        f"file: {name(heaviest)} holds {motion} of the weight of all proper motions and {position} of that of all "
        f"positions, of {len(objects)} objects; is its magnitude right?  v_min leaves out the bright ones"
    )
