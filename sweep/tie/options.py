"""The options of a link of tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from linksweep.core.tie.elimination import Weights
from linksweep.core.unknowns import require_mission_name
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import split_assignment
from linksweep.sweep.tie.column_names import TableOptions, require_epoch

Sign = Literal["reference-satellite", "satellite-reference"]
SIGNS: Mapping[Sign, float] = {"reference-satellite": 1.0, "satellite-reference": -1.0}


@dataclass(frozen=True)
class Options:
    """The options of a link of two or more tables.

    ``unknowns`` as in `parse_unknowns`, None for those of orientation and spin that the tables determine; ``degree``
    adds vector spherical harmonics up to it.  ``bins`` are a column and edges.  ``epoch`` (Julian year) is that of the
    orientation, by default the satellite's.  ``known_spin`` is a vector (mas/yr, in the sign of ``sign``) or the path
    of a table by magnitude.  ``jitter`` maps kinds of rows to (mas, mas/yr) added in quadrature.  ``aberration``
    (uas/yr) carries reference positions without an epoch from 2015.0 to the satellite's epoch.  ``missions`` are
    further tables by name, each in a frame of its own with an orientation and a spin; ``mission_options`` say how
    these are read.
    """

    unknowns: str | None = None
    degree: int | None = None
    bins: tuple[str, Sequence[float]] | None = None
    by: str | None = None
    epoch: float | None = None
    weights: Weights = "covariance"
    known_spin: Sequence[float] | str | Path | None = None
    jitter: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    sign: Sign = "reference-satellite"
    corrections: bool = True
    aberration: float = 0.0
    missions: Mapping[str, str | Path] = field(default_factory=dict)
    satellite_options: TableOptions = field(default_factory=TableOptions)
    reference_options: TableOptions = field(default_factory=TableOptions)
    mission_options: Mapping[str, TableOptions] = field(default_factory=dict)

    def check(self) -> None:
        """Raise SweepError for values that are not allowed."""
        if self.sign not in SIGNS:
            raise SweepError(f"sign {self.sign!r}: must be {' or '.join(SIGNS)}")
        if self.weights not in get_args(Weights):
            raise SweepError(f"weights {self.weights!r}: must be covariance, variance or equal")
        require_epoch(self.epoch, "epoch of the orientation")
        if not np.isfinite(self.aberration) or self.aberration < 0.0:
            raise SweepError(f"aberration {self.aberration:g} uas/yr: must be finite and not negative")
        for options in (self.satellite_options, self.reference_options, *self.mission_options.values()):
            require_epoch(options.epoch, "epoch of a table")
        if self.degree is not None and self.degree < 1:
            raise SweepError(f"degree {self.degree}: must be at least 1")
        for name in self.missions:
            try:
                require_mission_name(name)
            except ValueError as error:
                raise SweepError(str(error)) from error
        if unknown := sorted(set(self.mission_options) - set(self.missions)):
            raise SweepError(f"options of {', '.join(unknown)}: no such mission")

    def jitter_of(self, mission: str | None) -> dict[str, tuple[float, float]]:
        """Return the jitter by kind of row of the reference, or of a mission: ``hipparcos:position``."""
        found = {}
        for key, size in self.jitter.items():
            table, colon, kind = key.rpartition(":")
            if (table if colon else None) == mission:
                found[kind] = size
            elif colon and table not in self.missions:
                raise SweepError(f"jitter of {key!r}: no mission {table!r}")
        return found


def parse_bins(text: str) -> tuple[str, list[float]]:
    """Return the column and the edges of a text like phot_g_mean_mag=6,8,10; raises SweepError for any other text."""
    column, edges = split_assignment(text)
    try:
        numbers = [float(part) for part in edges.split(",")]
    except ValueError:
        numbers = []
    if not (column and numbers):
        raise SweepError(f"bins {text!r}: must be written COLUMN=EDGE,EDGE and so on")
    return column, numbers
