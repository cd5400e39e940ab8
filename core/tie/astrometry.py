"""Five-parameter astrometry of many objects as measured, where anything but the position may be missing."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.core.arrays import Array, Flags, Indices

PAIRS = tuple((i, j) for i in range(5) for j in range(i + 1, 5))
"""The two parameters of each correlation, in the order of the Gaia archive."""


@dataclass(frozen=True)
class Astrometry:
    """N sets of (ra, dec, parallax, pmra, pmdec) with errors; NaN is a missing value.

    ``values`` and ``errors`` (5, N) in rad and rad/yr (pmra is mu_alpha*, the error of ra that of alpha*);
    ``correlations`` (10, N) in the order of `PAIRS`, or None for none; ``epoch`` (N,) in Julian years, NaN where the
    position has none (that of an extragalactic source holds at any epoch); ``radial_velocity`` (N,) in km/s, NaN where
    unknown; ``names`` (N,); ``columns`` are further numbers by name; ``apparent`` (N,) marks positions of a single
    epoch, which the parallax displaces; ``frame`` (N,) is 0 for rows in the reference's frame and the number of a
    mission, from 1, for those in a frame of its own.
    """

    values: Array
    errors: Array
    epoch: Array
    correlations: Array | None = None
    radial_velocity: Array | None = None
    names: NDArray[np.str_] | None = None
    columns: Mapping[str, Array] = field(default_factory=dict)
    apparent: Flags | None = None
    frame: Indices | None = None

    def __len__(self) -> int:
        return len(self.epoch)

    @property
    def present(self) -> Flags:
        """Which parameters have a value with an error; shape (5, N)."""
        return np.isfinite(self.values) & np.isfinite(self.errors)

    def taken(self, part: Indices | slice | Flags) -> "Astrometry":
        """Return some of the objects."""

        def of(array: Any) -> Any:
            if array is None or isinstance(part, slice) or part.dtype == np.bool_:
                return None if array is None else array[..., part]
            return np.take(array, part, axis=-1)  # half the time of indexing

        columns = {name: of(column) for name, column in self.columns.items()}
        arrays = {name: of(array) for name, array in vars(self).items() if name != "columns"}
        return Astrometry(**arrays, columns=columns)

    def covariance(self) -> Array:
        """Return the covariance of the five parameters, zero where one is missing; shape (N, 5, 5)."""
        sigma = np.where(self.present, self.errors, 0.0).T
        found = np.zeros((len(self), 5, 5))
        found[:, range(5), range(5)] = sigma**2
        if self.correlations is not None:
            for correlation, (i, j) in zip(self.correlations, PAIRS, strict=True):
                found[:, i, j] = found[:, j, i] = np.nan_to_num(correlation) * sigma[:, i] * sigma[:, j]
        return found


def joined(*tables: Astrometry) -> Astrometry:
    """Return the rows of some tables as one, without names, radial velocities and further columns."""

    def together(name: str, *shape: int, kind: type = float) -> Any:
        """Concatenate an array of each table, zeros for a table without it."""
        each = ((getattr(table, name), (*shape, len(table))) for table in tables)
        return np.concatenate([np.zeros(size, kind) if given is None else given for given, size in each], axis=-1)

    in_frames = any(table.frame is not None for table in tables)
    return Astrometry(
        values=together("values"),
        errors=together("errors"),
        epoch=together("epoch"),
        correlations=together("correlations", len(PAIRS)),
        apparent=together("apparent", kind=bool),
        frame=together("frame", kind=np.int64) if in_frames else None,
    )


def positive_definite(correlations: Array) -> Flags:
    """Return whether each matrix of ten finite correlations (10, N) is positive definite; shape (N,).

    It computes the Cholesky factors of all matrices at once: eigenvalues of a million of them take many seconds.
    """
    n = correlations.shape[1]
    row = dict(zip(PAIRS, correlations, strict=True))
    factor: dict[tuple[int, int], Array] = {}
    good = np.ones(n, dtype=bool)
    for j in range(5):
        pivot = 1.0 - sum((factor[j, k] ** 2 for k in range(j)), np.zeros(n))
        good &= pivot > 0.0
        root = np.sqrt(np.where(pivot > 0.0, pivot, 1.0))
        for i in range(j + 1, 5):
            factor[i, j] = (row[j, i] - sum((factor[i, k] * factor[j, k] for k in range(j)), np.zeros(n))) / root
    return good


KINDS = {
    (True, True, True): "five-parameter",
    (False, True, True): "three-parameter",
    (False, False, True): "motion",
    (True, False, False): "position",
    (True, False, True): "position and motion",
    (True, True, False): "position and parallax",
    (False, True, False): "parallax",
    (False, False, False): "nothing",
}
"""Names of the kinds of rows by what is present: position, parallax, motion."""


def kinds(rows: Astrometry) -> NDArray[np.str_]:
    """Return the kind of each row, which follows from what is present; shape (N,).

    A position alone is of a "single epoch" where it is marked so.  Raises ValueError where only one coordinate of a
    position or of a motion is present.
    """
    present = rows.present
    for pair, what in (((0, 1), "position"), ((3, 4), "motion")):
        half = np.flatnonzero(present[pair[0]] != present[pair[1]])
        if len(half):
            raise ValueError(f"only one coordinate of the {what} has a value and an error in {named_rows(half)}")
    position, parallax, motion = present[0], present[2], present[3]
    found = np.empty(len(rows), dtype="U24")
    for (a, b, c), name in KINDS.items():
        found[(position == a) & (parallax == b) & (motion == c)] = name
    if rows.apparent is not None:
        found[(found == "position") & rows.apparent] = "single epoch"
    return found


def named_rows(rows: Indices) -> str:
    """Return rows counted from 1, at most five of them."""
    more = f" and {len(rows) - 5} more" if len(rows) > 5 else ""
    return f"row {', '.join(str(row + 1) for row in rows[:5])}{more}"
